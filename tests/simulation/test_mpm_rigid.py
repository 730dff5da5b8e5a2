"""Rigid bodies among MPM's particles, and on planes: momentum, rest, rolling, inertia."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.mpm.boundaries import Obstacles, collider_poses
from gdpro_sim.simulation.mpm.rigid import RigidBodies, recentred
from tests.simulation.mpm_blocks import BALL, GRAVITY, block, collider, run
from tests.simulation.test_colliders import box_mesh


def bodies_of(solver: SolverMPM) -> RigidBodies:
    (found,) = (b.bodies for b in solver.boundaries if isinstance(b, Obstacles))
    return found


@pytest.mark.parametrize(
    "options",
    [
        {**BALL, "position": (0.3, 0.11, 0.12), "velocity": (-2.0, 0.0, 0.0), "angular_velocity": (0, 0, 20)},
        {**BALL, "mass": 0.05, "position": (0.3, 0.13, 0.1), "velocity": (-2.0, 0.0, 0.0)},
        {**BALL, "mass": 0.3, "position": (0.28, 0.1, 0.1), "velocity": (-1.0, 0, 0), "boundary": "sticky"},
        {
            "kind": "box", "size": (0.1, 0.2, 0.12), "mass": 3.0, "position": (0.3, 0.15, 0.1),
            "velocity": (-2, 0, 0),
        },
    ],
    ids=["ball", "light ball", "sticky ball", "box"],
)  # fmt: skip
def test_a_rigid_body_and_matter_keep_their_momentum(options: dict[str, Any]) -> None:
    keeps_momentum(collider(**options))


def test_a_rigid_mesh_and_matter_keep_their_momentum() -> None:
    place = {"position": np.array([0.3, 0.15, 0.1]), "velocity": (-2.0, 0.0, 0.0)}
    keeps_momentum(box_mesh((0.1, 0.2, 0.12), mass=3.0, **place))


def keeps_momentum(body: Collider) -> None:
    """Together with a block that it runs into; and what it loses is more than a little."""
    solver = SolverMPM(block(gravity=(0.0,) * 3, colliders=(body,)))
    bodies = bodies_of(solver)
    before = np.array([bodies.momentum, bodies.angular_momentum])
    energy = bodies.kinetic_energy
    run(solver, 0.3)
    d = solver.diagnostics()
    after = np.array([d.momentum, d.angular_momentum])
    scale = np.linalg.norm(before[0])
    assert np.abs(bodies.momentum - before[0]).max() > 0.2 * scale  # they have met
    assert np.abs(after - before).max() < 2e-5 * scale
    assert d.kinetic_energy + d.elastic_energy < energy * 1.001


def test_a_rigid_body_rests_on_matter_and_sinks_by_its_weight() -> None:
    """A slab of 0.2 x 0.2 m on a cube with the same faces: E strain = weight / area."""
    slab = collider(kind="box", size=(0.2, 0.2, 0.1), position=(0.1, 0.1, 0.25), mass=10.0, friction=0.0)
    model = block(
        young=1e5,
        poisson=0.0,
        damping=20.0,
        gravity=GRAVITY,
        colliders=(slab,),
        ground=Ground(),
        friction=0.0,
    )
    solver = run(SolverMPM(model), 1.5)
    sag = 0.25 - bodies_of(solver).positions[0, 2]
    expected = 0.2 * (10.0 * 9.81 / 0.04 + 0.5 * 1000.0 * 9.81 * 0.2) / 1e5
    assert abs(sag - expected) < 0.06 * solver.spacing
    assert np.abs(bodies_of(solver).velocities).max() < 1e-2


def far(**model: Any) -> Model:
    """A model whose matter takes no part, and little time."""
    return block((1, 1, 1), young=1e4, **model)


@pytest.mark.parametrize("kind", ["sphere", "box", "capsule", "cylinder", "mesh"])
def test_rigid_bodies_meet_the_ground(kind: str) -> None:
    shapes: dict[str, dict[str, Any]] = {
        "sphere": {"radius": 0.1},
        "box": {"size": (0.2, 0.3, 0.2)},
        "capsule": {"radius": 0.1, "length": 0.2, "rotation": (90.0, 0.0, 0.0)},
        "cylinder": {"radius": 0.1, "length": 0.2},
    }
    common: dict[str, Any] = {"mass": 2.0, "position": (2.0, 0.0, 0.15)}
    if kind == "mesh":
        body = box_mesh((0.2, 0.3, 0.2), mass=2.0, position=np.array([2.0, 0.0, 0.15]))
    else:
        body = collider(kind=kind, **shapes[kind], **common)
    solver = run(SolverMPM(far(colliders=(body,), gravity=GRAVITY, ground=Ground())), 0.4)
    (turn, shift), *_ = collider_poses(solver.boundaries, solver.model, solver.time)
    assert bodies_of(solver).positions[0, 2] == pytest.approx(0.1, abs=1e-6)
    assert np.abs(bodies_of(solver).velocities).max() < 1e-6
    assert np.abs(turn - np.eye(3)).max() < 1e-6
    assert shift == pytest.approx((0.0, 0.0, -0.05), abs=1e-6)


def test_a_ball_that_slides_begins_to_roll() -> None:
    """v = 5/7 of what it had, however it rubs."""
    ball = collider(
        kind="sphere", radius=0.1, mass=1.0, position=(2.0, 0, 0.1), velocity=(0.7, 0, 0), friction=0.4
    )
    solver = run(SolverMPM(far(colliders=(ball,), gravity=GRAVITY, ground=Ground())), 0.3)
    bodies = bodies_of(solver)
    assert bodies.velocities[0, 0] == pytest.approx(0.5, rel=1e-3)
    assert bodies.angular_velocities[0, 1] == pytest.approx(5.0, rel=1e-3)


def test_a_free_body_keeps_its_angular_momentum_and_energy() -> None:
    box = collider(
        kind="box", size=(0.1, 0.2, 0.3), mass=1.0, position=(2, 0, 0), angular_velocity=(0.1, 5.0, 0.1)
    )
    bodies = RigidBodies([box], (0.0, 0.0, 0.0))
    energy, momentum = bodies.kinetic_energy, bodies.angular_momentum
    for _ in range(2000):
        bodies.begin(1e-3)
        bodies.move(1e-3, [])
    assert bodies.angular_momentum == pytest.approx(momentum, rel=1e-12)
    assert bodies.kinetic_energy == pytest.approx(energy, rel=2e-2)


def test_inertia_of_a_mesh_is_that_of_its_shape() -> None:
    mesh = recentred(box_mesh((0.2, 0.3, 0.4), mass=2.0, position=np.array([1.0, 2.0, 3.0])))
    box = collider(kind="box", size=(0.2, 0.3, 0.4), mass=2.0, position=(1.0, 2.0, 3.0))
    found = [RigidBodies([item], (0.0, 0.0, 0.0)) for item in (mesh, box)]
    assert found[0].inertia(0) == pytest.approx(found[1].inertia(0), rel=1e-9, abs=1e-12)
    assert found[0].positions == pytest.approx(found[1].positions)


@pytest.mark.parametrize("others", [0, 1])
def test_free_bodies_that_would_pass_through_others_are_told_of(
    caplog: pytest.LogCaptureFixture, others: int
) -> None:
    ball = collider(kind="sphere", name="ball", radius=0.3, position=(0.0, 0.0, 1.0), mass=1.0)
    post = collider(kind="box", name="post", size=(0.4, 0.4, 2.0), position=(1.0, 0.0, 0.0))
    run(SolverMPM(block(colliders=(ball, *[post] * others), ground=Ground())), 0.01, 0.01)
    assert ("ball, post" in caplog.text and "coupled" in caplog.text) == bool(others)
