"""MuJoCo behind the solver protocol: rigid bodies, flexes, obstacles that move, a base, bad input."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import ConvexHull

from gdpro_sim.errors import SceneError, SolverError
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Motion
from gdpro_sim.simulation.model import Solver
from gdpro_sim.simulation.mujoco import SolverMuJoCo
from gdpro_sim.simulation.mujoco.contacts import damping_of, restitution_of
from gdpro_sim.simulation.mujoco.soft import grid
from gdpro_sim.simulation.mujoco_model import Control, Joint, MujocoWorld, Shape
from gdpro_sim.simulation.verification.models import tet_box
from gdpro_sim.simulation.verification.mujoco_models import ball, box, flex, world

FRAME = 1.0 / 30.0

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="1"/>
      <geom name="box" type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
    </body>
  </worldbody>
  <actuator><position name="turn" joint="shoulder" kp="200"/></actuator>
  <keyframe><key name="up" qpos="0.5" ctrl="0.5"/></keyframe>
</mujoco>
"""


def motion(times: list[float], shifts: list[list[float]]) -> Motion:
    shape = (len(times), 3)
    return Motion(np.zeros(0, np.int32), np.zeros(3), np.array(times), np.array(shifts), np.zeros(shape))


def test_it_is_a_solver_and_falls() -> None:
    solver = SolverMuJoCo(world(ball(0.1, 2.0, velocity=(1.0, 0.0, 0.0))))
    assert isinstance(solver, Solver)
    for _ in range(10):
        solver.step(FRAME)
    t = 10 * FRAME
    np.testing.assert_allclose(solver.surface_positions(0)[0], [t, 0.0, 2.0 - 0.5 * 9.81 * t * t], atol=3e-3)
    found = solver.diagnostics()
    assert found.time == pytest.approx(t)
    assert found.substeps == 34
    mass = solver.bodies[0].mass  # type: ignore[union-attr]
    assert found.momentum == pytest.approx((mass, 0.0, -mass * 9.81 * t))


def test_states_continue_to_the_same_bytes_in_contact() -> None:
    vertices, tets = tet_box((3, 2, 2), (0.3, 0.2, 0.2), (0.0, 0.0, 0.01))
    soft = flex(vertices, tets, 5e4, 0.4, damping=2e-3)
    model = world(soft, ball(0.05, 0.3), ground=True, timestep=2e-3)
    solver = SolverMuJoCo(model)
    for _ in range(6):
        solver.step(FRAME)
    kept = {key: value.copy() for key, value in solver.state_dict().items()}
    shown = solver.diagnostics()
    for _ in range(6):
        solver.step(FRAME)
    other = SolverMuJoCo(model)
    other.load_state_dict(kept)
    assert other.diagnostics() == shown
    for _ in range(6):
        other.step(FRAME)
    assert other.state_dict()["mujoco"].tobytes() == solver.state_dict()["mujoco"].tobytes()
    solver.reset()
    assert solver.diagnostics().time == 0.0
    with pytest.raises(SolverError, match="another"):
        solver.load_state_dict({"mujoco": np.zeros(3)})


@pytest.mark.parametrize("kind", ["full", "trilinear", "quadratic"])
def test_flexes_keep_their_mass_and_turn_as_they_start(kind: str) -> None:
    vertices, tets = tet_box((4, 2, 2), (0.4, 0.2, 0.2))
    body = flex(vertices, tets, 1e5, 0.3, reduction=kind, cells=(2, 1, 1), angular_velocity=(0.0, 0.0, 2.0))  # type: ignore[arg-type]
    solver = SolverMuJoCo(world(body, gravity=(0.0, 0.0, 0.0), timestep=2e-3))
    first = solver.diagnostics()
    assert float(solver.mjmodel.body_mass.sum()) == pytest.approx(16.0)
    np.testing.assert_allclose(solver.vertices(0), vertices, atol=1e-9)
    for _ in range(10):
        solver.step(FRAME)
    last = solver.diagnostics()
    assert last.angular_momentum[2] == pytest.approx(first.angular_momentum[2], rel=1e-2)
    assert last.min_volume_ratio > 0.9


def test_a_grid_carries_what_is_in_it() -> None:
    vertices, tets = tet_box((4, 3, 2), (0.41, 0.23, 0.17), (0.3, -0.1, 0.0))
    for kind, cells in (("trilinear", (3, 2, 1)), ("quadratic", (2, 1, 1))):
        nodes, weights = grid(flex(vertices, tets, 1e5, 0.3, reduction=kind, cells=cells))
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(weights @ nodes, vertices, atol=1e-12)


def test_pins_move_flexes() -> None:
    vertices, tets = tet_box((4, 1, 1), (0.4, 0.1, 0.1))
    held = vertices[:, 0] < 1e-9
    moved = replace(
        motion([0.0, 1.0], [[0, 0, 0], [0, 0, 0.3]]), vertices=np.flatnonzero(held).astype(np.int32)
    )
    for kind in ("full", "trilinear"):
        body = flex(
            vertices, tets, 1e6, 0.3, damping=1e-2, pinned=held, motions=(moved,), reduction=kind,
            cells=(4, 1, 1),
        )  # fmt: skip
        solver = SolverMuJoCo(world(body, timestep=2e-3, gravity=(0.0, 0.0, 0.0)))
        for _ in range(30):
            solver.step(FRAME)
        np.testing.assert_allclose(
            solver.vertices(0)[held], vertices[held] + np.array([0, 0, 0.3]), atol=1e-6
        )
        solver.step(1.0)
        np.testing.assert_allclose(solver.vertices(0), vertices + np.array([0, 0, 0.3]), atol=2e-2)


def test_pins_too_small_for_the_grid_are_refused() -> None:
    vertices, tets = tet_box((8, 2, 2), (0.4, 0.1, 0.1))
    held = np.zeros(len(vertices), bool)
    held[len(vertices) // 2] = True
    body = flex(vertices, tets, 1e6, 0.3, pinned=held, reduction="trilinear", cells=(2, 1, 1))
    with pytest.raises(SceneError, match="pins are smaller than a cell"):
        SolverMuJoCo(world(body))


def test_a_moved_obstacle_carries_what_lies_on_it() -> None:
    lift = Collider(
        "belt", "box", size=(1.0, 1.0, 0.05), position=np.array([0.0, 0.0, -0.05]), friction=0.8,
        motion=motion([0.0, 1.0], [[0, 0, 0], [0.3, 0, 0.1]]),
    )  # fmt: skip
    body = box((0.1, 0.1, 0.05), np.array([0.0, 0.0, 0.05]), friction=0.8)
    solver = SolverMuJoCo(world(body, colliders=(lift,)))
    assert solver.diagnostics().momentum == pytest.approx((0.0, 0.0, 0.0))
    for _ in range(45):
        solver.step(FRAME)
    moved = solver.surface_positions(0)[0]
    np.testing.assert_allclose(moved, [0.3, 0.0, 0.15], atol=6e-3)


def test_friction_of_two_is_their_geometric_mean() -> None:
    degrees = 25.0  # tan is 0.466: between 0.4 = sqrt(0.2 0.8) and 0.8
    angle = math.radians(degrees)
    normal = np.array([math.sin(angle), 0.0, math.cos(angle)])
    turn = np.stack([[math.cos(angle), 0.0, -math.sin(angle)], [0.0, 1.0, 0.0], normal], axis=1)
    body = box((0.1, 0.1, 0.05), 0.05 * normal, turn, friction=0.8)
    solver = SolverMuJoCo(world(body, colliders=(Collider("slope", "plane", rotation=turn, friction=0.2),)))
    for _ in range(15):
        solver.step(FRAME)
    way = float((solver.surface_positions(0)[0] - 0.05 * normal) @ turn[:, 0])
    exact = 0.5 * 9.81 * (math.sin(angle) - 0.4 * math.cos(angle)) * 0.25
    assert way == pytest.approx(exact, rel=0.05)


def test_damping_gives_the_restitution_asked_for() -> None:
    assert restitution_of(0.0) == pytest.approx(1.0, abs=1e-3)
    for wanted in (0.2, 0.5, 0.9):
        assert restitution_of(damping_of(wanted)) == pytest.approx(wanted, abs=1e-3)


def test_hinges_stop_at_their_limits() -> None:
    joint = Joint("hinge", (-0.5, 0.0, 0.0), (0.0, 1.0, 0.0), damping=5.0, limits=(-1.0, 0.4))
    solver = SolverMuJoCo(world(box((0.5, 0.02, 0.02), np.zeros(3), joint=joint)))
    for _ in range(60):
        solver.step(FRAME)
    assert float(solver.mjdata.qpos[0]) == pytest.approx(0.4, abs=0.02)


# ---- a base ----


def test_bodies_join_a_base_whose_actuators_follow_keyframes(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    model = world(box((0.05, 0.05, 0.05), np.array([2.0, 0.0, 0.05])), ground=True)
    control = Control("turn", np.array([0.0, 0.5]), np.array([0.5, -0.5]))
    base = MujocoWorld(model.mujoco.bodies, model.mujoco.settings, tmp_path / "arm.xml", "up", (control,))  # type: ignore[union-attr]
    solver = SolverMuJoCo(replace(model, mujoco=base))
    assert solver.renamed == (("box", "box-2"),)
    assert float(solver.mjdata.joint("shoulder").qpos[0]) == 0.5
    for _ in range(60):
        solver.step(FRAME)
    assert float(solver.mjdata.joint("shoulder").qpos[0]) == pytest.approx(-0.5, abs=0.1)
    np.testing.assert_allclose(solver.surface_positions(0)[0], [2.0, 0.0, 0.05], atol=1e-4)


@pytest.mark.parametrize(
    ("text", "changes", "message"),
    [
        ("<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>", {}, "MuJoCo cannot compile it: .*size"),
        ("<mujoco><worl", {}, "MuJoCo cannot compile it"),
        (ARM, {"keyframe": "down"}, "keyframe 'down': there is none; there are: 'up'"),
        (ARM, {"controls": (Control("lift", np.zeros(1), np.zeros(1)),)}, "actuator 'lift': .* 'turn'"),
    ],
)
def test_bad_bases_are_refused(tmp_path: Path, text: str, changes: dict, message: str) -> None:
    (tmp_path / "base.xml").write_text(text)
    model = world(ball(0.1, 1.0))
    assert model.mujoco is not None
    broken = replace(model, mujoco=replace(model.mujoco, base=tmp_path / "base.xml", **changes))
    with pytest.raises(SceneError, match=message):
        SolverMuJoCo(broken)


GREEDY = """
<mujoco>
  <compiler boundmass="0.5" boundinertia="0.1" settotalmass="50" fusestatic="true" inertiafromgeom="true"/>
  <default>
    <geom margin="0.1" friction="0" contype="0" conaffinity="0"/>
    <joint stiffness="10" damping="30" armature="2"/>
    <mesh scale="0.001 0.001 0.001"/>
  </default>
  <worldbody>
    <body name="own" pos="5 0 0"><joint/><geom size="0.1"/></body>
    <body name="still" pos="3 0 0"><geom size="0.1"/></body>
  </worldbody>
</mujoco>
"""


def test_what_a_base_sets_for_its_parts_does_not_reach_bodies(tmp_path: Path) -> None:
    (tmp_path / "base.xml").write_text(GREEDY)
    half = 0.05
    corners = half * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    solid = Shape("mesh", vertices=corners, faces=ConvexHull(corners).simplices)
    body = replace(box((half,) * 3, np.array([0.0, 0.0, 0.5])), shapes=(solid,), mass=0.01)
    body = replace(body, inertia=body.inertia * 1e-2)
    found = []
    for base in (None, tmp_path / "base.xml"):
        model = world(body, ground=True)
        assert model.mujoco is not None
        solver = SolverMuJoCo(replace(model, mujoco=replace(model.mujoco, base=base)))
        for _ in range(20):
            solver.step(FRAME)
        found.append(solver.surface_positions(0)[0])
    assert solver.mjmodel.body_mass.tolist() == pytest.approx([0.0, 25.0, 25.0, 0.01])
    np.testing.assert_allclose(found[1], found[0], atol=1e-3)
    assert found[1][2] == pytest.approx(half, abs=1e-3)


def test_bodies_that_start_inside_a_base_are_named(tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(ARM)
    model = world(box((0.05, 0.05, 0.05), np.array([0.4, 0.0, 1.0])), ball(0.1, 3.0))
    assert model.mujoco is not None
    (told,) = SolverMuJoCo(replace(model, mujoco=replace(model.mujoco, base=tmp_path / "arm.xml"))).overlaps()
    assert told[:2] == ("box", "arm") and 0.05 < told[2] < 0.1
