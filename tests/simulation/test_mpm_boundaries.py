"""MPM's boundaries: obstacles stop, rub and let go; what is held, driven and pushed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import particles as particle_rows
from gdpro_sim.materials import Material
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Force, Hold, Impulse, Motion, Wind
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground, Model, MpmSettings, Particles
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.mpm.boundaries import Obstacles
from gdpro_sim.simulation.mpm.drivers import top_speed
from tests.simulation.fem_models import make_model, tet_box
from tests.simulation.mpm_blocks import BALL, GRAVITY, block, collider, run
from tests.simulation.test_colliders import box_mesh


def tilted(angle: float, rubbing: float | None, **options: Any) -> Model:
    """A block on a plane through the origin that falls off towards +X."""
    turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
    plane = collider(kind="plane", rotation=(0.0, angle, 0.0), friction=rubbing)
    return block(turn=turn, colliders=(plane,), gravity=GRAVITY, **options)


def downhill(solver: SolverMPM, angle: float) -> float:
    """m, of the middle along the plane."""
    along = Rotation.from_euler("y", angle, degrees=True).apply([1.0, 0.0, 0.0])
    return float(solver.positions.mean(axis=0) @ along)


# -- Friction


@pytest.mark.parametrize(
    ("angle", "rubbing", "of_matter"), [(35.0, None, 0.5), (20.0, 0.0, 0.5), (20.0, 0.2, 0.5)]
)
def test_slides_by_the_exact_acceleration_above_the_friction_angle(
    angle: float, rubbing: float | None, of_matter: float
) -> None:
    """However it bounces: what friction takes is mu times what the plane gives, so v_t + mu v_n grows evenly.

    The friction of matter and plane combine by the geometric mean.
    """
    solver = SolverMPM(tilted(angle, rubbing, friction=of_matter))
    mu = of_matter if rubbing is None else np.sqrt(of_matter * rubbing)
    turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
    run(solver, 0.1)
    before, begin = solver.velocities.mean(axis=0) @ turn, solver.time
    run(solver, 0.3)
    gained = solver.velocities.mean(axis=0) @ turn - before
    expected = 9.81 * (np.sin(np.radians(angle)) - mu * np.cos(np.radians(angle)))
    assert (gained[0] + mu * gained[2]) / (solver.time - begin) == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("angle", [15.0, 23.0])
def test_sticks_below_the_friction_angle(angle: float) -> None:
    """atan 0.5 is 26.6 degrees."""
    solver = run(SolverMPM(tilted(angle, None, friction=0.5, damping=10.0)), 0.5)
    settled = downhill(solver, angle)
    run(solver, 0.5)
    assert abs(downhill(solver, angle) - settled) < 2e-4


def test_two_materials_rub_each_by_its_own_friction() -> None:
    """Two blocks far apart on one floor: v = v0 - mu g t, each with its mu."""
    model = block(velocity=(1.0, 0.0, 0.0), gravity=GRAVITY, ground=Ground())
    p = model.particles
    assert p is not None
    other = p.materials[0].model_copy(update={"friction": 0.1})
    both = Particles(
        np.concatenate([p.positions, p.positions + np.float32([0.0, 1.0, 0.0])]),
        np.concatenate([p.velocities] * 2),
        np.concatenate([p.volumes] * 2),
        np.repeat(np.int32([0, 1]), len(p)),
        (p.materials[0], other),
        p.spacing,
    )
    solver = run(SolverMPM(dataclasses.replace(model, particles=both)), 0.15, 0.01)
    first, second = solver.velocities[:, 0].reshape(2, -1).mean(axis=1)
    assert first == pytest.approx(1.0 - 0.5 * 9.81 * 0.15, rel=0.05)
    assert second == pytest.approx(1.0 - 0.1 * 9.81 * 0.15, rel=0.02)


# -- Sticky, slip, separate


def flying(boundary: str, velocity: tuple[float, float, float]) -> SolverMPM:
    plane = collider(kind="plane", boundary=boundary, friction=1.0)
    return SolverMPM(block(velocity=velocity, low=(0.0, 0.0, 0.0), colliders=(plane,), gravity=(0.0,) * 3))


def test_slip_keeps_tangential_momentum_and_does_not_let_go() -> None:
    solver = flying("slip", (1.0, 0.5, -0.2))
    before = solver.diagnostics().momentum
    run(solver, 0.2)
    after = solver.diagnostics().momentum
    assert after[0] == pytest.approx(before[0], rel=1e-5)
    assert after[1] == pytest.approx(before[1], rel=1e-5)
    low = [run(solver, 1 / 60).positions[:, 2].min() for _ in range(20)]
    assert max(low) < 0.0125 * 1.1 and min(low) > 0.0125 * 0.5


def test_sticky_stops_what_touches() -> None:
    solver = run(flying("sticky", (1.0, 0.0, -0.5)), 1 / 30)
    bottom = solver.positions[:, 2] < 0.015
    assert bottom.sum() > 50
    assert np.abs(solver.velocities[bottom]).max() < 0.3
    pulled = solver.positions[bottom, 0].mean()
    run(solver, 0.5)
    assert abs(solver.positions[bottom, 0].mean() - pulled) < 0.025  # half a cell of shear


def test_separate_lets_go_at_once() -> None:
    solver = flying("separate", (0.3, 0.0, 0.4))
    before = solver.diagnostics().momentum
    run(solver, 0.2)
    assert solver.diagnostics().momentum == pytest.approx(before, rel=1e-5, abs=1e-6)
    assert solver.positions[:, 2].min() > 0.0125 + 0.078


def test_matter_meets_the_floor_where_it_is() -> None:
    """Wherever the floor lies between nodes, the lowest particle rests half its spacing above."""
    for height in (0.0, 0.013, -0.021):
        model = block(
            (2, 2, 2),
            low=(0.0, 0.0, height + 0.02),
            young=3e5,
            damping=20.0,
            gravity=GRAVITY,
            ground=Ground(height),
        )
        solver = run(SolverMPM(model), 0.7)
        gap = solver.positions[:, 2].min() - 0.0125 - height
        assert abs(gap) < 0.05 * solver.spacing


def test_a_fast_fall_does_not_pass_through_and_nothing_creeps() -> None:
    model = block(
        low=(0.0, 0.0, 0.1), velocity=(0.0, 0.0, -4.0), damping=8.0, gravity=GRAVITY, ground=Ground()
    )
    solver = run(SolverMPM(model), 0.7)
    lowest = solver.positions[:, 2].min()
    assert lowest > 0.0
    run(solver, 0.5)
    assert solver.positions[:, 2].min() > lowest - 1e-4


@pytest.mark.slow
def test_nothing_creeps_through_a_floor_in_ten_seconds() -> None:
    model = block(
        (2, 2, 4), low=(0.0, 0.0, 0.007), young=3e4, damping=10.0, gravity=GRAVITY, ground=Ground(0.007)
    )
    solver = run(SolverMPM(model), 3.0)
    settled = solver.positions
    run(solver, 10.0)
    assert np.abs(solver.positions - settled).max() < 1e-4


# -- Shapes and motion

SHAPES: dict[str, dict[str, Any]] = {
    "box": {"kind": "box", "size": (0.6, 0.6, 0.2), "position": (0.1, 0.1, -0.1)},
    "sphere": {"kind": "sphere", "radius": 0.6, "position": (0.1, 0.1, -0.6)},
    "capsule": {
        "kind": "capsule", "radius": 0.3, "length": 0.6, "position": (0.1, 0.1, -0.3), "rotation": (0, 90, 0),
    },
    "cylinder": {"kind": "cylinder", "radius": 0.5, "length": 0.2, "position": (0.1, 0.1, -0.1)},
    "heightfield": {"kind": "heightfield", "size": (1.0, 1.0), "heights": [[0.0, 0.0], [0.0, 0.0]]},
}  # fmt: skip


@pytest.mark.parametrize("name", SHAPES)
def test_every_shape_holds_matter_up(name: str) -> None:
    shape = collider(**SHAPES[name])
    model = block(low=(0.0, 0.0, 0.01), damping=20.0, gravity=GRAVITY, colliders=(shape,))
    solver = run(SolverMPM(model), 0.4)
    top = solver.positions[:, 2].max()
    assert 0.16 < top < 0.2
    assert solver.positions[:, 2].min() > (-0.06 if name in ("sphere", "capsule") else 0.0)


def test_a_wall_pushes_at_its_speed() -> None:
    wall = collider(
        kind="box", size=(0.2, 1.0, 1.0), position=(-0.12, 0.0, 0.0), friction=0.0,
        motion=[{"time": 1.0, "translation": (0.5, 0.0, 0.0)}],
    )  # fmt: skip
    solver = run(SolverMPM(block(damping=0.0, young=1e6, colliders=(wall,), gravity=(0.0,) * 3)), 0.5)
    wall_face = -0.02 + 0.25
    assert solver.positions[:, 0].min() > wall_face
    # Pushed without loss it leaves at up to twice the wall's speed.
    assert 0.5 * 0.98 < solver.velocities[:, 0].mean() < 1.0


def struck(shape: Collider, integrator: Any = "explicit") -> SolverMPM:
    """A soft block, and what comes at ten times its speed of sound and more: some 17 cells in 0.02 s."""
    settings = MpmSettings(integrator=integrator)
    model = block(young=2e3, colliders=(shape,), gravity=(0.0,) * 3, mpm=settings)
    solver = SolverMPM(model)
    solver.step(0.02)
    return solver


def test_terrain_that_rises_lifts_what_lies_on_it() -> None:
    terrain = collider(
        kind="heightfield", size=(1.0, 1.0), heights=[[0.0, 0.0], [0.0, 0.0]], position=(0.1, 0.1, 0.0),
        motion=[{"time": 0.2, "translation": (0.0, 0.0, 0.2)}],
    )  # fmt: skip
    solver = SolverMPM(block((2, 2, 2), young=1e6, damping=5.0, colliders=(terrain,), gravity=GRAVITY))
    run(solver, 0.2)
    assert solver.positions[:, 2].min() > 0.2
    assert solver.velocities[:, 2].mean() > 0.9


FAST: dict[str, Any] = {"motion": [{"time": 0.02, "translation": (0.8, 0.0, 0.0)}], "friction": 0.0}


@pytest.mark.parametrize("kind", ["box", "mesh", "implicit"])
def test_what_comes_fast_does_not_pass_through_matter(kind: str) -> None:
    wall = collider(kind="box", size=(0.3, 1.0, 1.0), position=(-0.45, 0.0, 0.0), **FAST)
    if kind == "mesh":
        body = box_mesh((0.3, 1.0, 1.0), position=np.array([-0.45, 0.0, 0.0]), friction=0.0)
        wall = dataclasses.replace(body, motion=wall.motion)
    solver = struck(wall, "implicit" if kind == "implicit" else "explicit")
    assert solver.positions[:, 0].min() > -0.3 + 0.8
    assert solver.velocities[:, 0].min() > 20.0


def test_a_fast_rigid_body_does_not_pass_through_matter() -> None:
    ball = collider(
        kind="sphere", radius=0.15, mass=50.0, position=(-0.3, 0.1, 0.1), velocity=(40.0, 0.0, 0.0)
    )
    solver = struck(ball)
    obstacles = next(b for b in solver.boundaries if isinstance(b, Obstacles))
    away = np.linalg.norm(solver.positions - obstacles.bodies.positions[0], axis=1)
    assert away.min() > 0.15
    carried = 50.0 * 40.0 / (50.0 + 8.0)
    assert solver.velocities[:, 0].mean() > 0.95 * carried


def test_substeps_that_obstacles_ask_for_are_told_of() -> None:
    wall = collider(kind="box", size=(0.3, 1.0, 1.0), position=(-0.45, 0.0, 0.0), **FAST)
    solver = SolverMPM(block(young=2e3, colliders=(wall,), mpm=MpmSettings(max_substeps=10)))
    with pytest.raises(
        SolverError, match=r"at most 10.*: slow down what colliders and pins do, or make cells"
    ):
        solver.step(0.02)


def test_speed_of_what_is_moved() -> None:
    """Of a keyframed motion that begins within the step, and of a spinning one: the farthest point's."""
    points = np.array([[0.3, 0.1, 0.0], [0.1, 0.5, 2.0]])
    late = dataclasses.replace(
        motion(),
        times=np.array([0.0, 0.5, 1.0]),
        translations=np.array([(0.0,) * 3] * 2 + [(3.0, 0.0, 4.0)]),
        rotations=np.zeros((3, 3)),
    )
    assert top_speed(late, points, 0.4, 0.2) == pytest.approx(10.0, rel=1e-9)
    assert top_speed(late, points, 0.0, 0.4) == 0.0
    spinning = motion(turn=720.0)
    assert top_speed(spinning, points, 0.0, 0.1) == pytest.approx(0.4 * 4.0 * np.pi, rel=1e-4)


def test_a_belt_carries_what_lies_on_it() -> None:
    belt = collider(
        kind="box", size=(9.0, 1.0, 0.2), position=(0.0, 0.0, -0.1),
        motion=[{"time": 10.0, "translation": (10.0, 0.0, 0.0)}],
    )  # fmt: skip
    solver = run(SolverMPM(block(colliders=(belt,), gravity=GRAVITY, young=1e6, damping=0.0)), 0.1, 0.01)
    assert solver.velocities[:, 0].mean() == pytest.approx(0.5 * 9.81 * 0.1, rel=0.05)  # it slips: mu g t
    run(solver, 0.4)
    assert solver.velocities[:, 0].mean() == pytest.approx(1.0, rel=0.02)


def test_a_sticky_drum_turns_what_it_holds() -> None:
    drum = collider(
        kind="box", size=(0.2, 0.2, 0.1), position=(0.1, 0.1, 0.05), boundary="sticky",
        motion=[{"time": 1.0, "rotation": (0.0, 0.0, 90.0)}],
    )  # fmt: skip
    solver = SolverMPM(block(young=1e6, colliders=(drum,), gravity=(0.0,) * 3))
    start = solver.positions - [0.1, 0.1, 0.0]
    inside = start[:, 2] < 0.05
    run(solver, 0.5)
    expected = Rotation.from_euler("z", 45, degrees=True).apply(start[inside])
    assert np.abs(solver.positions[inside] - [0.1, 0.1, 0.0] - expected).max() < 2e-3


def test_a_collider_is_there_from_start_to_end() -> None:
    floor = collider(kind="plane", boundary="separate", friction=0.0, end=0.1)
    solver = run(SolverMPM(block(colliders=(floor,), gravity=GRAVITY)), 0.1, 0.02)
    assert abs(solver.velocities[:, 2].mean()) < 0.1
    run(solver, 0.1, 0.02)
    assert solver.velocities[:, 2].mean() == pytest.approx(-0.981, abs=0.11)
    late = collider(kind="plane", start=10.0)
    solver = run(SolverMPM(block(colliders=(late,), gravity=GRAVITY)), 0.1, 0.02)
    assert solver.velocities[:, 2].mean() == pytest.approx(-0.981, rel=1e-4)


def test_a_corner_of_two_planes_holds_matter_from_both_sides() -> None:
    sides = tuple(collider(kind="plane", normal=(s, 0.0, 1.0), friction=0.0) for s in (1.0, -1.0))
    turn = Rotation.from_euler("y", 45, degrees=True).as_matrix()
    model = block(low=(-0.2, 0.0, 0.0), turn=turn, colliders=sides, gravity=GRAVITY, damping=20.0, young=1e6)
    solver = run(SolverMPM(model), 0.7)
    x = solver.positions
    for s in (1.0, -1.0):
        gap = (x @ np.array([s, 0.0, 1.0]) / np.sqrt(2.0)).min() - 0.0125
        assert abs(gap) < 0.1 * solver.spacing
    assert np.abs(solver.velocities).max() < 2e-2


# -- Domain


def test_particles_stay_in_the_domain() -> None:
    domain = ((-0.05, -0.05, -0.05), (0.35, 0.35, 0.35))
    model = block(velocity=(3.0, 2.0, -4.0), young=3e4, mpm=MpmSettings(domain=domain), gravity=GRAVITY)
    solver = SolverMPM(model)
    for _ in range(40):
        solver.step(1 / 60)
        x = solver.positions
        assert (x >= np.float32(domain[0])).all() and (x <= np.float32(domain[1])).all()


@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
@pytest.mark.parametrize("floor", [None, Ground()])
def test_a_full_tank_is_as_dense_at_its_walls_as_inside(kernel: Any, floor: Ground | None) -> None:
    """Of the grid around particles; without what would lie inside the walls an eighth of it in corners.

    Two obstacles that fill the same space, the ground and a wall of the domain, count once.
    """
    settings = MpmSettings(domain=((0.0, 0.0, 0.0), (0.2, 0.2, 0.2)), kernel=kernel)
    model = block(mpm=settings, ground=floor)
    assert model.particles is not None
    water = Material(model="fluid", bulk_modulus=1.0e5, viscosity=0.0, density=1000.0)
    solver = SolverMPM(
        dataclasses.replace(model, particles=dataclasses.replace(model.particles, materials=(water,)))
    )
    solver.step(1e-4)
    density = solver.grid.rows(int(particle_rows.DENSITY), 1)[:, 0]
    assert density.mean() == pytest.approx(1000.0, rel=0.03)
    assert np.abs(density - 1000.0).max() < 150.0


def test_what_starts_outside_the_domain_is_refused() -> None:
    with pytest.raises(SolverError, match="start outside the domain"):
        SolverMPM(block(mpm=MpmSettings(domain=((0.0,) * 3, (0.1,) * 3))))
    with pytest.raises(SolverError, match="must lie above"):
        SolverMPM(block(mpm=MpmSettings(domain=((0.0,) * 3, (0.0,) * 3))))


# -- Held, driven, pushed


def test_what_is_held_stays_and_does_not_creep() -> None:
    """A bar that hangs by its upper end stretches as it should, and keeps so."""
    model = block((2, 2, 8), young=1e5, poisson=0.0, damping=20.0, gravity=GRAVITY)
    assert model.particles is not None
    top = np.flatnonzero(model.particles.positions[:, 2] > 0.3).astype(np.int32)
    solver = run(SolverMPM(dataclasses.replace(model, holds=(Hold(top),))), 0.6)
    start = model.particles.positions
    assert np.array_equal(solver.positions[top].astype(np.float32), start[top])
    assert not solver.velocities[top].any()
    sag = start[:, 2].min() - solver.positions[:, 2].min()
    assert sag == pytest.approx(1000.0 * 9.81 * 0.3**2 / (2.0 * 1e5), rel=0.1)
    deformed = solver.deformations[top]
    run(solver, 0.6)
    assert start[:, 2].min() - solver.positions[:, 2].min() == pytest.approx(sag, rel=0.01)
    assert np.abs(solver.deformations[top] - deformed).max() < 2e-3


def motion(
    *, shift: tuple[float, float, float] = (0.0,) * 3, turn: float = 0.0, seconds: float = 1.0
) -> Motion:
    """Over some seconds; turned about the vertical axis through (0.1, 0.1)."""
    return Motion(
        vertices=np.zeros(0, np.int32),
        pivot=np.array([0.1, 0.1, 0.0]),
        times=np.array([0.0, seconds]),
        translations=np.array([(0.0,) * 3, shift]),
        rotations=np.radians([(0.0,) * 3, (0.0, 0.0, turn)]),
    )


def test_driven_particles_go_where_they_are_taken_and_take_the_rest_along() -> None:
    way = motion(shift=(0.3, 0.0, 0.1), turn=180.0)
    model = block(young=1e6, gravity=(0.0,) * 3)
    assert model.particles is not None
    start = model.particles.positions.astype(np.float64)
    low = np.flatnonzero(start[:, 2] < 0.1).astype(np.int32)
    solver = run(SolverMPM(dataclasses.replace(model, holds=(Hold(low, way),))), 0.5)
    turned = (
        Rotation.from_euler("z", 90, degrees=True).apply(start - way.pivot) + way.pivot + [0.15, 0.0, 0.05]
    )
    assert np.abs(solver.positions[low] - turned[low]).max() < 1e-6
    assert np.abs(solver.positions - turned).max() < 0.04  # the rest has started with a jerk
    assert np.linalg.det(solver.deformations[low]) == pytest.approx(1.0, abs=0.05)


def test_holds_begin_and_end() -> None:
    model = block(gravity=GRAVITY)
    everything = np.arange(len(model.particles or ()), dtype=np.int32)
    hold = Hold(everything, start=0.1, release=0.2)
    solver = run(SolverMPM(dataclasses.replace(model, holds=(hold,))), 0.1, 0.02)
    fallen = solver.positions[:, 2].mean()
    assert fallen == pytest.approx(0.1 - 0.5 * 9.81 * 0.01, abs=1e-3)
    run(solver, 0.1, 0.02)
    assert solver.positions[:, 2].mean() == pytest.approx(fallen, abs=1e-4)
    run(solver, 0.1, 0.02)
    assert solver.velocities[:, 2].mean() == pytest.approx(-0.981, rel=1e-2)


def test_forces_and_impulses_give_what_they_say() -> None:
    model = block(gravity=(0.0,) * 3)
    ids = np.arange(len(model.particles or ()), dtype=np.int32)
    each = np.full((len(ids), 3), 1.0 / len(ids))
    loads = (
        Force(ids, 5.0 * each, start=0.01, end=0.03),
        Impulse(ids, 2.0 * each, time=0.05),
        Impulse(ids[:1], 0.01 * np.ones((1, 3)), time=0.0),
    )
    solver = SolverMPM(dataclasses.replace(model, loads=loads))
    for seconds, expected in ((0.02, 0.01 + 0.05), (0.02, 0.01 + 0.1), (0.02, 2.11)):
        run(solver, seconds, 0.01)
        assert solver.diagnostics().momentum == pytest.approx((expected,) * 3, rel=1e-4)
    saved = solver.state_dict()
    solver.load_state_dict(saved)
    run(solver, 0.02, 0.01)
    assert solver.diagnostics().momentum == pytest.approx((2.11,) * 3, rel=1e-4)


def test_loads_on_surfaces_are_refused() -> None:
    wind = Wind(np.zeros((1, 3), np.int32), (1.0, 0.0, 0.0), 1.2, 1.0, 0.0)
    with pytest.raises(SolverError, match="no wind loads"):
        SolverMPM(block(loads=(wind,)))


# -- Reproducible


@pytest.fixture
def restore_threads() -> Iterator[None]:
    count = devices.thread_count()
    yield
    devices.set_thread_count(count)


def tumbling() -> Model:
    colliders = (
        collider(kind="sphere", radius=0.1, position=(0.1, 0.1, -0.2)),
        collider(**BALL, position=(0.1, 0.1, 0.35), velocity=(0.0, 0.0, -2.0)),
        box_mesh((1.0, 1.0, 0.2), position=np.array([0.0, 0.0, -0.3])),
        collider(
            kind="box", size=(0.2,) * 3, position=(-0.15, 0, 0), boundary="sticky", end=0.08,
            motion=[{"time": 1.0, "translation": (0.5, 0, 0)}],
        ),
    )  # fmt: skip
    model = block(
        velocity=(0.0, 0.0, -1.0), gravity=GRAVITY, colliders=colliders,
        mpm=MpmSettings(domain=((-0.4,) * 3, (0.8,) * 3)),
    )  # fmt: skip
    ids = np.arange(100, dtype=np.int32)
    return dataclasses.replace(
        model,
        holds=(Hold(ids, motion(shift=(0.0, 0.0, -0.1)), start=0.02, release=0.06),),
        loads=(Force(ids, np.ones((100, 3)), end=0.05), Impulse(ids, 0.01 * np.ones((100, 3)), time=0.07)),
    )


def test_thread_count_and_restart_do_not_change_a_byte(restore_threads: None) -> None:
    results = []
    for threads in (1, 2, 8):
        devices.set_thread_count(threads)
        solver = SolverMPM(tumbling())
        for k in range(6):
            if k == 3 and threads == 2:
                state = solver.state_dict()
                solver = SolverMPM(tumbling())
                solver.load_state_dict(state)
            solver.step(1 / 60)
        results.append({name: value.tobytes() for name, value in solver.state_dict().items()})
    assert results[0] == results[1] == results[2]


# -- Bad input


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "plane", "mass": 1.0},
        {"kind": "sphere", "radius": 0.1, "mass": 0.0},
        {"kind": "sphere", "radius": 0.1, "mass": 1.0, "motion": [{"time": 1.0}]},
        {"kind": "sphere", "radius": 0.1, "velocity": (1.0, 0.0, 0.0)},
        {"kind": "sphere", "radius": 0.1, "start": 1.0, "end": 0.5},
        {"kind": "sphere", "radius": 0.1, "boundary": "bouncy"},
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        collider(**options)


def test_fem_refuses_what_only_mpm_knows() -> None:
    vertices, tets = tet_box((1, 1, 1), (0.1,) * 3, (0.0, 0.0, 1.0))
    model = make_model(vertices, tets)
    for options in ({"boundary": "sticky"}, {"mass": 1.0}, {"end": 1.0}):
        ball = collider(kind="sphere", radius=0.1, name="ball", **options)
        with pytest.raises(SolverError, match=f"collider 'ball'.*{next(iter(options))}"):
            SolverFEM(dataclasses.replace(model, colliders=(ball,)))
    with pytest.raises(SolverError, match="boundary"):
        SolverFEM(dataclasses.replace(model, ground=Ground(boundary="slip")))


def test_a_thin_collider_is_told_of(caplog: pytest.LogCaptureFixture) -> None:
    shelf = collider(kind="box", name="shelf", size=(1.0, 1.0, 0.05), position=(0.0, 0.0, -0.1))
    board = box_mesh((1.0, 1.0, 0.04), name="board", position=np.array([0.0, 0.0, -0.3]))
    crate = box_mesh((1.0, 1.0, 0.4), name="crate", position=np.array([0.0, 0.0, -0.6]))
    hill = collider(
        kind="heightfield", name="hill", size=(1.0, 1.0), heights=[[0, 0], [0, 0]], position=(0, 0, -1)
    )
    SolverMPM(block(colliders=(shelf, board, crate, hill))).step(1e-3)
    assert "'shelf' is 0.05 m thick" in caplog.text and "'board' is 0.04 m thick or less in" in caplog.text
    assert "crate" not in caplog.text and "hill" not in caplog.text


def test_matter_that_starts_inside_a_collider_is_refused() -> None:
    crate = {"kind": "box", "name": "crate", "size": (1.0, 1.0, 0.4), "position": (0.0, 0.0, -0.08)}
    with pytest.raises(
        SolverError, match=r"starts 0\.107 m inside collider 'crate', more than a cell of 0\.05"
    ):
        SolverMPM(block(colliders=(collider(**crate),)))
    SolverMPM(block(colliders=(collider(**crate, boundary="sticky"), collider(**crate, start=1.0))))
