"""Rigid bodies of MuJoCo among soft ones, in one solver."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.colliders import Collider, shape_collider
from gdpro_sim.simulation.conditions import Guide
from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.coupled.base import base_links
from gdpro_sim.simulation.coupled.quasi_newton import QuasiNewton
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Solver
from gdpro_sim.simulation.mujoco_model import MujocoSettings, MujocoWorld
from gdpro_sim.simulation.verification.coupling_models import (
    ball,
    coupled,
    drop_on_jelly,
    jelly_block,
    masses,
    momentum,
    total_energy,
    total_momentum,
)
from gdpro_sim.simulation.verification.models import make_model, tet_box

FREE = (0.0, 0.0, 0.0)


def impact(density: float = 3000.0, **options: object) -> SolverCoupled:
    """A ball right before it meets a jelly in free space."""
    block = jelly_block((3, 3, 3), (0.2, 0.2, 0.2), gravity=FREE)
    body = ball(
        0.06, density, (0.02, 0.0, 0.062), velocity=(0.3, 0.0, -1.0), angular_velocity=(0.0, 5.0, 0.0)
    )
    return SolverCoupled(coupled(block, body, **options))  # type: ignore[arg-type]


# ---- impulses of finite elements on guided colliders ----


@pytest.mark.parametrize("rule", ["backward-euler", "bdf2", "midpoint", "explicit"])
def test_impulses_are_what_momentum_changes_by(rule: str) -> None:
    guide = Guide(np.array([0.0, 0.0, -0.1]))
    obstacle = shape_collider(
        "sphere", (0.1,), name="ball", motion=guide, position=np.array([0.0, 0.0, -0.1])
    )
    vertices, tets = tet_box((2, 2, 2), (0.2,) * 3, (-0.08, -0.1, 0.002))
    model = make_model(
        vertices, tets, young=2e4, velocities=np.tile([0.3, 0.0, -1.0], (len(vertices), 1)), substeps=2,
        colliders=(Collider.floor(-9.0), obstacle), integrator=rule, gravity=FREE, newton_tolerance=1e-6,
        cg_tolerance=1e-6,
    )  # fmt: skip
    solver, mass = SolverFEM(model), masses(model)

    def momenta() -> np.ndarray:
        x, v = solver.positions, solver.velocities
        return np.append(mass @ v, (mass[:, None] * np.cross(x, v)).sum(0))

    before, given, pushed = momenta(), np.zeros(6), False
    for k in range(45):
        here, there = (np.array([0.0, 0.0, 0.004 * min(i, 8)]) for i in (k, k + 1))
        guide.tell(solver.time, solver.time + 0.004, (np.eye(3), here), (np.eye(3), there))
        solver.step(0.004)
        impulses = solver.collider_impulses()
        assert np.all(impulses[0] == 0.0)  # nobody guides it
        given += impulses[1]
        pushed |= bool(np.any(impulses[1]))
    assert pushed and not np.any(solver.collider_impulses()[1])  # it has come off again
    off = np.abs(momenta() - before + given)
    assert off[:3].max() < 1e-5 * np.abs(given[:3]).max()
    assert off[3:].max() < 0.03 * np.abs(given[3:]).max()  # implicit steps lose some of a spin by themselves


def test_a_failed_step_leaves_impulses(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = impact().solvers["fem"]
    assert isinstance(solver, SolverFEM)
    guide = solver.model.colliders[0].motion
    assert isinstance(guide, Guide)
    still, lower = (np.eye(3), np.zeros(3)), (np.eye(3), np.array([0.0, 0.0, -0.02]))
    guide.tell(0.0, 0.002, still, lower)
    solver.step(0.002)
    kept = solver.collider_impulses()
    assert kept.any()

    def fail(*_: object) -> None:
        raise SolverError("no")

    monkeypatch.setattr(solver, "_advance", fail)
    with pytest.raises(SolverError):
        solver.step(0.002)
    assert np.array_equal(solver.collider_impulses(), kept)
    solver.reset()
    assert not solver.collider_impulses().any()


# ---- the coupling ----


def test_fixed_point_of_an_affine_map_that_plain_iteration_leaves() -> None:
    matrix, shift = np.array([[-3.0, 0.5], [0.2, -8.0]]), np.array([1.0, 2.0])
    guess, method = np.zeros(2), QuasiNewton(2)
    for _ in range(8):
        guess = method.next(guess, matrix @ guess + shift)
    assert np.allclose(guess, np.linalg.solve(np.eye(2) - matrix, shift), atol=1e-9)


@pytest.mark.parametrize("density", [100.0, 20000.0])
def test_momentum_is_kept_and_energy_not_made(density: float) -> None:
    solver = impact(density, step=4e-3)
    assert isinstance(solver, Solver)
    before, energy = total_momentum(solver), total_energy(solver)
    for _ in range(6):
        solver.step(8e-3)
        assert solver.diagnostics().converged
        assert total_energy(solver) < energy * (1.0 + 1e-6)
    change = total_momentum(solver) - before
    assert np.abs(change[:3]).max() < 1e-4 * np.linalg.norm(before[:3])
    assert np.abs(change[3:]).max() < 1e-2 * 0.06 * np.linalg.norm(before[:3])
    assert abs(momentum(solver, "mujoco")[2]) < 0.95 * np.linalg.norm(before[:3])  # they have met


def test_impulses_of_ground_and_gravity_account_for_a_drop() -> None:
    lines = list(drop_on_jelly(height=0.005, duration=0.12, step=8e-3))
    assert lines[-1].ball > -0.5 * 1.8 * 9.81 * 0.12  # it is held up
    assert max(abs(line.ball + line.jelly - line.balance) for line in lines) < 1e-3


def test_disagreement_is_halved_then_told(caplog: pytest.LogCaptureFixture) -> None:
    solver = impact(step=8e-3, iterations=1, tolerance=1e-9)  # met by no impact
    with caplog.at_level(logging.WARNING):
        solver.step(24e-3)
    diagnostics = solver.diagnostics()
    assert not diagnostics.converged and diagnostics.residual > 1e-9
    assert solver.rounds >= 16
    assert "what soft bodies met moved otherwise" in caplog.text


def test_state_continues_to_the_same_bytes() -> None:
    solver = impact(step=4e-3)
    for _ in range(2):
        solver.step(8e-3)
    kept = solver.state_dict()
    solver.step(8e-3)
    other = impact(step=4e-3)
    other.load_state_dict(kept)
    other.step(8e-3)
    ends = solver.state_dict(), other.state_dict()
    assert all(np.array_equal(ends[0][name], ends[1][name]) for name in ends[0])
    solver.reset()
    fresh = impact(step=4e-3).state_dict()
    assert all(np.array_equal(value, fresh[name]) for name, value in solver.state_dict().items())
    with pytest.raises(SolverError, match="'push'"):
        other.load_state_dict({**kept, "push": np.zeros((2, 6))})


def test_a_failed_step_leaves_the_state(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = impact(step=4e-3)
    solver.step(8e-3)
    before, impulses = solver.state_dict(), solver.collider_impulses("fem")
    fem = solver.solvers["fem"]
    whole, calls = fem.step, []

    def breaks(dt: float) -> None:
        calls.append(dt)
        if len(calls) > 2:
            raise SolverError("an element is lost")
        whole(dt)

    monkeypatch.setattr(fem, "step", breaks)
    with pytest.raises(SolverError, match="an element is lost"):
        solver.step(16e-3)
    assert min(calls) == pytest.approx(4e-3 / 16)  # shorter steps were tried
    assert all(np.array_equal(before[name], value) for name, value in solver.state_dict().items())
    assert np.array_equal(solver.collider_impulses("fem"), impulses)
    with pytest.raises(SolverError, match="> 0 s"):
        solver.step(0.0)


def test_links_of_a_base_stand_where_its_keyframe_has_them(tmp_path: Path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text("""<mujoco><worldbody>
        <geom name="table" type="box" size="1 1 .1" pos="0 0 -.1"/>
        <geom name="seen" type="box" size="1 1 1" contype="0" conaffinity="0"/>
        <body name="arm" pos="0 0 .5"><joint name="turn" axis="0 1 0"/>
          <geom name="rod" type="capsule" size=".02 .1" pos=".1 0 0" euler="0 90 0"/>
          <geom type="ellipsoid" size=".03 .04 .05" pos=".2 0 0"/></body>
        </worldbody><keyframe><key name="up" qpos="-1.5707963267948966"/></keyframe></mujoco>""")
    world = MujocoWorld((), MujocoSettings(), base=path, keyframe="up")
    links, still = base_links(replace(jelly_block((1, 1, 1), (1.0, 1.0, 1.0)), mujoco=world))
    assert [item.name for item in still] == ["table"]
    (arm,) = links
    rod, ellipsoid = arm.colliders
    assert arm.of_base and arm.body == 1 and rod.kind == "capsule" and rod.name == "rod"
    assert np.allclose(rod.position, [0.0, 0.0, 0.6]) and np.allclose(abs(rod.rotation[:, 2]), [0, 0, 1])
    assert ellipsoid.kind == "mesh" and ellipsoid.name == "arm[1]" and ellipsoid.vertices is not None
    assert np.allclose(ellipsoid.vertices.max(0), [0.03, 0.04, 0.05])
