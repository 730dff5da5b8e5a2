"""MuJoCo with springs, attachments, loads, height fields and callbacks, and what a base looks like."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.errors import SceneError, SolverError
from gdpro_sim.meshing.convex import MassProperties, fit_primitive
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.simulation.compile import check_supported
from gdpro_sim.simulation.mujoco import SolverMuJoCo
from gdpro_sim.simulation.mujoco.wind import blown
from gdpro_sim.simulation.mujoco_model import MujocoWorld, RigidBody, SoftBody
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import check_scene
from gdpro_sim.simulation.verification import mujoco_forces
from gdpro_sim.simulation.verification.framework import run_problem
from gdpro_sim.simulation.verification.models import tet_box
from gdpro_sim.simulation.verification.mujoco_models import ball, world
from tests.meshing.shapes import write_obj

FRAME = 1.0 / 30.0
STEEL = {"preset": "steel", "density": 500.0}

ARM = """
<mujoco>
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="5"/>
      <geom name="look" type="box" pos="0.2 0 0" size="0.2 0.02 0.02" rgba="1 0 0 1" group="2"/>
      <geom name="touch" type="box" pos="0.2 0 0" size="0.2 0.02 0.02" group="3"/>
    </body>
  </worldbody>
  <actuator><position name="turn" joint="shoulder" kp="200"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    vertices, tets = tet_box((2, 2, 2), (0.2, 0.2, 0.2), (-0.1, -0.1, 0.0))
    faces, _ = boundary(tets)
    path = write_obj(tmp_path_factory.mktemp("cube") / "cube.obj", vertices, faces)
    asset = import_mesh(path, budget=500, tets=False, up="z")
    return tetrahedralize_asset(asset, target_tets=200, method="lattice")


def simulation(asset: Asset, *bodies: dict, **scene: object) -> Simulation:
    whole = [{"name": f"b{k}", "asset": "cube.usdc", "material": "jelly", **b} for k, b in enumerate(bodies)]
    made = check_scene({"bodies": whole, "solver": {"kind": "mujoco"}, "ground": None, **scene})
    return Simulation(made, {body.name: asset for body in made.bodies}, device="cpu")


def hard(height: float, **options: object) -> dict:
    return {"position": [0, 0, height], "material": STEEL, "mujoco": {"shape": "box", **options}}


@pytest.mark.parametrize("item", mujoco_forces.PROBLEMS, ids=lambda item: item.name)
def test_forces_have_their_known_answers(item: object) -> None:
    result = run_problem(item)  # type: ignore[arg-type]
    assert result.passed, [str(check) for check in result.checks if not check.passed] or result.failure


def test_soft_bodies_hang_on_rigid_ones_and_those_on_each_other(cube: Asset) -> None:
    soft = {"position": [0, 0, 0.2], "material": {"preset": "jelly", "young": 2e5}}
    made = simulation(
        cube, hard(0.4, joint="fixed"), soft, hard(0.0), hard(-0.2),
        attachments=[{"bodies": ["b1", "b0"]}, {"bodies": ["b1", "b2"]}, {"bodies": ["b3", "b2"]}],
        duration=0.6,
    )  # fmt: skip
    world_ = made.model.mujoco
    assert world_ is not None and world_.welds == ((3, 2),) and made.model.springs is None
    (flex,) = [body for body in world_.bodies if isinstance(body, SoftBody)]
    assert [tie.body for tie in flex.ties] == [0, 2]
    total = sum(b.mass if isinstance(b, RigidBody) else b.masses.sum() for b in world_.bodies)
    assert float(made.solver.mjmodel.body_mass.sum()) == pytest.approx(total)  # type: ignore[attr-defined]
    frames = list(made)
    low = [float(body.vertices[:, 2].min()) for body in frames[-1].bodies]
    assert low[0] == pytest.approx(0.4, abs=1e-6)
    assert -0.03 < low[2] < -0.001
    assert low[3] == pytest.approx(low[2] - 0.2, abs=2e-3)


@pytest.mark.parametrize(
    ("form", "stiffness"), [("trilinear", None), ("full", 2e4)], ids=["grid", "springs of a full flex"]
)
def test_ties_of_grids_are_springs(cube: Asset, form: str, stiffness: float | None) -> None:
    soft = {"position": [0, 0, 0.0], "mujoco": {"form": form}, "material": {"preset": "jelly", "young": 1e5}}
    ties = {"bodies": ["b1", "b0"], "stiffness": stiffness, "distance": 0.03}
    made = simulation(cube, hard(0.2, joint="fixed"), soft, attachments=ties, duration=0.5)
    assert made.model.springs is not None
    frames = list(made)
    assert -0.03 < float(frames[-1].bodies[1].vertices[:, 2].min()) < -0.001
    assert frames[-1].diagnostics.force_energy > 0.0


def test_what_holds_bodies_twice_is_refused(cube: Asset) -> None:
    three = [{"bodies": [f"b{a}", f"b{b}"]} for a, b in ((0, 1), (1, 2), (0, 2))]
    with pytest.raises(SceneError, match=r"attachments.2.: 'b0' and 'b2' are held .* closes a loop"):
        simulation(cube, hard(0.0), hard(0.2), hard(0.1), attachments=three)
    with pytest.raises(SceneError, match="closes a loop"):
        simulation(
            cube, hard(0.0, joint="fixed"), hard(0.2, joint="fixed"), attachments={"bodies": ["b0", "b1"]}
        )
    soft = {"position": [0, 0, 0.2]}
    with pytest.raises(SceneError, match="name the soft body first"):
        simulation(cube, hard(0.0), soft, attachments={"bodies": ["b0", "b1"]})
    with pytest.raises(SceneError, match="pinned or tied already"):
        simulation(
            cube, hard(0.0), {**soft, "pins": {"side": "bottom"}}, attachments={"bodies": ["b1", "b0"]}
        )


def test_loads_of_scenes_move_rigid_bodies(cube: Asset) -> None:
    still = {"gravity": [0, 0, 0], "duration": 0.5}
    pushed = {**hard(0.0), "impulses": {"velocity": [1, 0, 0], "time": 0.1}}
    pulled = {**hard(1.0), "forces": {"side": "top", "force": [0, 8, 0]}}
    pressed = {**hard(2.0), "pressures": {"side": "top", "fraction": 0.01, "pressure": 100.0}}
    made = simulation(cube, pushed, pulled, pressed, **still)
    for _ in range(15):
        made.solver.step(FRAME)
    velocities = made.solver.mjdata.qvel.reshape(3, 6)  # type: ignore[attr-defined]
    np.testing.assert_allclose(velocities[0, :3], [1, 0, 0], atol=1e-9)
    mass = float(made.solver.mjmodel.body_mass[1])  # type: ignore[attr-defined]
    assert velocities[1, 1] == pytest.approx(8.0 * 0.5 / mass, rel=1e-6)
    assert velocities[1, 3] < -0.5  # above the centre: it turns
    assert velocities[2, 2] == pytest.approx(-100.0 * 0.04 * 0.5 / mass, rel=0.02)


def test_wind_is_that_of_the_finite_elements() -> None:
    """Forces on one triangle against the formula, term by term."""
    from gdpro_sim.simulation.conditions import Wind

    area, u = np.array([[0.0, 0.0, -2.0]]), np.array([[3.0, 0.0, 4.0]])
    air = Wind(np.zeros((1, 3), np.int32), (0, 0, 0), 1.2, 1.1, 0.7)
    s, speed, n = 4.0, 5.0, np.array([0.0, 0.0, 1.0])
    exact = 0.6 * 2.0 * (1.1 * s * u[0] + 0.7 * s * (speed * n - s * u[0] / speed))
    np.testing.assert_allclose(blown(air, area, u)[0], exact, rtol=1e-12)
    assert not blown(air, -area, u).any()


def test_stiff_springs_shorten_the_steps() -> None:
    solver = SolverMuJoCo(mujoco_forces.hung(4e7))
    assert solver.substeps(FRAME) > 40
    for _ in range(10):
        solver.step(FRAME)
    assert float(solver.mjdata.qpos[2]) == pytest.approx(1.0, abs=1e-4)


def test_states_continue_under_loads(cube: Asset) -> None:
    made = simulation(
        cube, {"position": [0, 0, 1]}, wind={"velocity": [5, 0, 0]},
        springs={"ends": [{"body": "b0", "point": [0, 0, 1.1]}, {"point": [0, 0, 2]}], "stiffness": 100},
    )  # fmt: skip
    for _ in range(3):
        made.solver.step(FRAME)
    kept = {key: value.copy() for key, value in made.solver.state_dict().items()}
    for _ in range(3):
        made.solver.step(FRAME)
    end = made.solver.state_dict()["mujoco"].tobytes()
    made.solver.load_state_dict(kept)
    for _ in range(3):
        made.solver.step(FRAME)
    assert made.solver.state_dict()["mujoco"].tobytes() == end


def test_boxes_of_cubes_stand_as_the_cubes_do() -> None:
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    for sides in ((1.0, 1.0, 1.0), (1.0, 1.0, 2.0), (2.0, 1.0, 1.0)):
        squares = np.square(sides)
        inertia = turn @ np.diag(squares.sum() - squares) @ turn.T * np.prod(sides) / 12.0
        fit = fit_primitive("box", MassProperties(float(np.prod(sides)), np.zeros(3), inertia), turn)
        along = np.abs(turn.T @ fit.rotation)
        np.testing.assert_allclose(np.sort(along, axis=0), [[0] * 3, [0] * 3, [1] * 3], atol=1e-9)
        np.testing.assert_allclose(along @ fit.size, np.array(sides) / 2, atol=1e-9)


# ---- a base ----


def with_arm(folder: Path, text: str = ARM, **options: object) -> SolverMuJoCo:
    (folder / "arm.xml").write_text(text)
    model = world(ball(0.1, 3.0))
    assert model.mujoco is not None
    own = MujocoWorld(model.mujoco.bodies, model.mujoco.settings, folder / "arm.xml", **options)  # type: ignore[arg-type]
    return SolverMuJoCo(replace(model, mujoco=own))


def test_callbacks_tell_actuators(tmp_path: Path) -> None:
    solver = with_arm(tmp_path)
    times = []

    def act(time: float, data: object) -> dict[str, float]:
        times.append(time)
        return {"turn": 0.5}

    solver.callback = act
    for _ in range(30):
        solver.step(FRAME)
    assert float(solver.mjdata.joint("shoulder").qpos[0]) == pytest.approx(0.5, abs=0.05)
    assert len(times) == 30 * solver.substeps(FRAME) and not solver.open_loop
    solver.callback = lambda time, data: np.array([-0.5])
    for _ in range(30):
        solver.step(FRAME)
    assert float(solver.mjdata.joint("shoulder").qpos[0]) == pytest.approx(-0.5, abs=0.05)


@pytest.mark.parametrize(
    ("told", "message"),
    [
        (lambda t, d: {"trun": 1.0}, "no actuator 'trun' .did you mean 'turn'"),
        (lambda t, d: {"turn": np.float64("nan")}, "'turn' is told nan, which is no finite number"),
        (lambda t, d: [1.0, 2.0], "array of 1 numbers"),
        (lambda t, d: "left", "array of 1 numbers"),
        (lambda t, d: 1 / 0, "raised ZeroDivisionError: .*test_mujoco_forces.py, line"),
    ],
)
def test_bad_callbacks_are_named_and_the_state_kept(tmp_path: Path, told: object, message: str) -> None:
    solver = with_arm(tmp_path)
    before = solver.state_dict()["mujoco"].copy()
    solver.callback = told  # type: ignore[assignment]
    with pytest.raises(SolverError, match=message):
        solver.step(FRAME)
    np.testing.assert_array_equal(solver.state_dict()["mujoco"], before)


def test_what_is_seen_of_a_base_moves_with_it(tmp_path: Path) -> None:
    solver = with_arm(tmp_path)
    (link,) = solver.links
    assert link.name == "look" and link.kind == "box" and link.color == (1.0, 0.0, 0.0)
    np.testing.assert_allclose(solver.link_poses()[0], np.eye(3, 4), atol=1e-12)
    solver.callback = lambda time, data: {"turn": 0.5}
    for _ in range(30):
        solver.step(FRAME)
    angle = float(solver.mjdata.joint("shoulder").qpos[0])
    pose = solver.link_poses()[0]
    tip = pose @ [0.4, 0.0, 1.0, 1.0]
    np.testing.assert_allclose(tip, [0.4 * np.cos(angle), 0.0, 1.0 - 0.4 * np.sin(angle)], atol=1e-9)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("<mujoco>\n<worldbody>\n<geom size='1' colour='red'/></worldbody></mujoco>", "colour.*line 3"),
        ("<mujoco>\n<asset><mesh file='gone.stl'/></asset></mujoco>", r"gone.stl.*\(.*base.xml, line 2\)"),
        ("<mujoco>\n<include file='part.xml'/></mujoco>", r"colour.*\(.*part.xml, line 3\)"),
    ],
)
def test_broken_bases_are_said_with_file_and_line_before_assets_are_prepared(
    tmp_path: Path, text: str, message: str
) -> None:
    (tmp_path / "part.xml").write_text("<mujoco>\n<worldbody>\n<geom colour='red'/></worldbody></mujoco>")
    (tmp_path / "base.xml").write_text(text)
    scene = check_scene(
        {
            "bodies": [{"asset": "none.obj"}],
            "solver": {"kind": "mujoco", "base": "base.xml"},
            "folder": tmp_path,
        }
    )
    with pytest.raises(SceneError, match=message):
        check_supported(scene)
