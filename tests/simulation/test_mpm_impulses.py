"""What matter gives to guided colliders: balances of momentum, weight, and the same bytes for all threads."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Guide
from gdpro_sim.simulation.model import Model, MpmSettings
from gdpro_sim.simulation.mpm import SolverMPM
from tests.simulation.mpm_blocks import GRAVITY, block, collider
from tests.simulation.test_colliders import box_mesh

STEP = 0.01


def guided(item: Collider, centre: tuple[float, float, float]) -> Collider:
    return dataclasses.replace(item, motion=Guide(np.asarray(centre)))


def momentum(solver: SolverMPM) -> np.ndarray:
    """[6] kg m/s and kg m^2/s about the world's origin, of the particles."""
    figures = solver.diagnostics()
    return np.array([*figures.momentum, *figures.angular_momentum])


def tell(solver: SolverMPM, item: Collider, velocity: np.ndarray, spin: np.ndarray, h: float) -> None:
    """Lead a guided collider through the next step."""
    guide, start = item.motion, solver.time
    assert isinstance(guide, Guide)

    def pose(time: float) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_rotvec(time * spin).as_matrix()
        return turn, guide.centre + time * velocity - turn @ guide.centre

    guide.tell(start, start + h, pose(start), pose(start + h))


def crossing(integrator: str) -> tuple[Model, Collider, Collider]:
    """A block between a spinning box, a mesh off its middle, and a ball that comes the other way."""
    middle = (-0.13, 0.02, 0.07)
    box = guided(box_mesh((0.25, 0.25, 0.25), position=np.array(middle)), middle)
    ball = guided(collider(kind="sphere", radius=0.08, position=(0.3, 0.13, 0.11)), (0.3, 0.13, 0.11))
    settings = MpmSettings(integrator=integrator)
    return block(colliders=(box, ball), mpm=settings, gravity=(0.0, 0.0, 0.0)), box, ball


@pytest.mark.parametrize(
    ("integrator", "linear", "angular"), [("explicit", 1e-6, 1e-6), ("implicit", 1e-5, 0.03)]
)
def test_what_matter_loses_colliders_get(integrator: str, linear: float, angular: float) -> None:
    """In every step what matter gains and what colliders get add up to 0, and so do their moments.

    Internal forces of an implicit substep have a moment of their own, as they act where matter goes.
    """
    model, box, ball = crossing(integrator)
    solver, total, errors = SolverMPM(model), np.zeros((2, 6)), []
    assert not solver.collider_impulses().any()
    for _ in range(8):
        before = momentum(solver)
        tell(solver, box, np.array([0.8, 0.0, 0.1]), np.array([0.0, 3.0, 1.0]), STEP)
        tell(solver, ball, np.array([-0.7, 0.1, 0.0]), np.zeros(3), STEP)
        solver.step(STEP)
        given = solver.collider_impulses()
        errors.append(momentum(solver) - before + given.sum(axis=0))
        total += given
    assert (np.linalg.norm(total, axis=1) > 1.0).all()  # N s: both are met
    assert np.abs(np.sum(errors, axis=0)[:3]).max() <= linear * np.abs(total[:, :3]).max()
    assert np.abs(np.sum(errors, axis=0)[3:]).max() <= angular * np.abs(total[:, 3:]).max()


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
@pytest.mark.parametrize("shape", ["box", "mesh"])
def test_a_table_bears_the_weight_where_it_is(integrator: str, shape: str) -> None:
    """A damped block of 8 kg on a guided table presses with its weight, where its middle is."""
    middle = (0.0, 0.0, -0.1)
    table = collider(kind="box", size=(0.8, 0.8, 0.2), position=middle)
    if shape == "mesh":
        table = box_mesh((0.8, 0.8, 0.2), position=np.array(middle))
    settings = MpmSettings(integrator=integrator)
    floor = collider(kind="plane", position=(0.0, 0.0, -1.0))
    solver = SolverMPM(
        block(
            damping=60.0,
            colliders=(floor, guided(table, middle)),
            gravity=GRAVITY,
            mpm=settings,
            low=(-0.05, 0.02, 0.0),
        )
    )
    given = []
    for _ in range(25):
        solver.step(STEP)
        given.append(solver.collider_impulses() / STEP)
    x, y, _ = solver.positions.mean(axis=0)
    weight = 8.0 * 9.81
    first, second = np.mean(given[-5:], axis=0)
    assert not first.any()
    assert second == pytest.approx([0.0, 0.0, -weight, -weight * y, weight * x, 0.0], abs=5e-3 * weight)


def test_a_belt_takes_the_friction_that_it_gives() -> None:
    """A block slides on a plate that moves along under it: mu times the weight, while it slides."""
    plate = collider(kind="box", size=(2.0, 2.0, 0.2), position=(0.0, 0.0, -0.1))
    plate = guided(plate, (0.0, 0.0, -0.1))
    solver, given = SolverMPM(block(friction=0.3, colliders=(plate,), gravity=GRAVITY)), np.zeros(6)
    for _ in range(10):
        tell(solver, plate, np.array([2.0, 0.0, 0.0]), np.zeros(3), STEP)
        solver.step(STEP)
        given += solver.collider_impulses()[0]
    assert given[0] == pytest.approx(0.3 * given[2], rel=1e-3)
    assert momentum(solver)[0] == pytest.approx(-given[0], rel=1e-5)


@pytest.fixture
def restore_threads() -> Iterator[None]:
    before = devices.thread_count()
    yield
    devices.set_thread_count(before)


@pytest.mark.parametrize("integrator", ["explicit", "implicit"])
def test_threads_and_restart_change_no_byte(restore_threads: None, integrator: str) -> None:
    found = []
    for threads in (1, 3):
        devices.set_thread_count(threads)
        model, box, ball = crossing(integrator)
        solver = SolverMPM(model)

        def step(solver: SolverMPM, box: Collider = box, ball: Collider = ball) -> np.ndarray:
            tell(solver, box, np.array([0.8, 0.0, 0.1]), np.array([0.0, 3.0, 1.0]), STEP)
            tell(solver, ball, np.array([-0.7, 0.1, 0.0]), np.zeros(3), STEP)
            solver.step(STEP)
            return solver.collider_impulses()

        for _ in range(4):
            step(solver)
        state = solver.state_dict()
        found += [step(solver)]
        solver.load_state_dict(state)
        found += [step(solver)]
    assert found[0].any()
    for other in found[1:]:
        assert np.array_equal(found[0], other)


def test_a_failed_step_leaves_the_impulses_of_the_one_before() -> None:
    model, box, _ = crossing("explicit")
    solver = SolverMPM(dataclasses.replace(model, mpm=MpmSettings(max_substeps=40)))
    for _ in range(3):
        tell(solver, box, np.array([0.8, 0.0, 0.1]), np.zeros(3), STEP)
        solver.step(STEP)
    before = solver.collider_impulses()
    with pytest.raises(SolverError, match="substeps"):
        solver.step(1.0)
    assert before.any()
    assert np.array_equal(solver.collider_impulses(), before)
