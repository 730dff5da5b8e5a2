"""Values drawn at random, and many simulations at once, against one alone."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.errors import SceneError
from gdpro_sim.materials import Material
from gdpro_sim.simulation.compile import compile_scene
from gdpro_sim.simulation.effects import check_effects
from gdpro_sim.simulation.mujoco import SolverMuJoCo
from gdpro_sim.simulation.mujoco.batch import run_batch
from gdpro_sim.simulation.randomize import draw, expand
from gdpro_sim.simulation.scene import Scene, check_scene
from tests.meshing.shapes import sphere, write_obj

JELLY = Material.model_validate("jelly")

ARM = """
<mujoco model="arm">
  <worldbody>
    <body name="arm" pos="0 0 1">
      <joint name="shoulder" axis="0 1 0" damping="1"/>
      <geom name="bar" type="capsule" fromto="0 0 0 0.4 0 0" size="0.03"/>
    </body>
  </worldbody>
  <actuator><position name="turn" joint="shoulder" kp="200"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    path = write_obj(tmp_path_factory.mktemp("ball") / "ball.obj", *sphere(3, 0.1))
    return tetrahedralize_asset(import_mesh(path, budget=500, tets=False), target_tets=300, method="lattice")


def scene_of(randomize: Any = None, **scene: Any) -> Scene:
    bodies = [
        {"name": name, "asset": "ball.usdc", "position": [x, 0, 0.3], "material": "wood",
         "mujoco": {"form": "rigid", "shape": "sphere"}}
        for name, x in (("left", -0.3), ("right", 0.3))
    ]  # fmt: skip
    given = {"bodies": bodies, "solver": {"kind": "mujoco"}, "duration": 0.5, **scene}
    return check_scene({**given, "randomize": randomize or {}})


def assets_of(scene: Scene, asset: Asset) -> dict[str, Asset]:
    return {body.name: asset for body in scene.bodies}


def drawn(scene: Scene, count: int, seed: int = 0) -> list[dict[str, Any]]:
    variations = expand(scene, scene.randomize)
    return [draw(scene, variations, seed, index)[1] for index in range(count)]


# ---- draws ----


def test_draws_lie_within_their_ranges_and_fill_them() -> None:
    scene = scene_of({
        "bodies.left": {"position": [[-1, 0, 2], [1, 4, 3]], "velocity.z": {"low": -2, "high": 0}},
        "bodies.*.material.density": {"low": 10, "high": 1000, "distribution": "log_uniform"},
        "gravity.z": {"low": 0.5, "high": 1.5, "apply": "scale"},
        "bodies.left.material.friction": {"choices": [0.1, 0.2, 0.3]},
    })  # fmt: skip
    found = drawn(scene, 300)
    places = np.array([values["bodies.left.position"] for values in found])
    assert (places >= [-1, 0, 2]).all() and (places <= [1, 4, 3]).all()
    np.testing.assert_allclose(places.mean(axis=0), [0.0, 2.0, 2.5], atol=0.2)
    np.testing.assert_allclose(places.std(axis=0), np.array([2.0, 4.0, 1.0]) / np.sqrt(12.0), rtol=0.12)
    assert np.abs(np.corrcoef(places.T) - np.eye(3)).max() < 0.17
    density = np.array(
        [[values[f"bodies.{n}.material.density"] for n in ("left", "right")] for values in found]
    )
    assert np.median(density) == pytest.approx(100.0, rel=0.35)
    assert abs(np.corrcoef(np.log(density.T))[0, 1]) < 0.17
    gravity = np.array([values["gravity.z"] for values in found])
    assert -14.72 < gravity.min() < gravity.max() < -4.9
    friction = [values["bodies.left.material.friction"] for values in found]
    assert min(friction.count(value) for value in (0.1, 0.2, 0.3)) > 75


def test_any_rotation_prefers_no_direction() -> None:
    from scipy.spatial.transform import Rotation

    found = drawn(scene_of({"bodies.left.rotation": "any"}), 500)
    angles = [values["bodies.left.rotation"] for values in found]
    matrices = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
    assert np.abs(matrices.mean(axis=0)).max() < 0.12
    np.testing.assert_allclose((matrices**2).mean(axis=0), 1.0 / 3.0, atol=0.08)


def test_a_draw_depends_on_seed_number_and_path_alone() -> None:
    few, more = {"gravity.z": [-10, -9]}, {"camera.azimuth": [0, 90], "gravity.z": [-10, -9]}
    alone, beside = drawn(scene_of(few), 5), drawn(scene_of(more), 5)
    assert [v["gravity.z"] for v in alone] == [v["gravity.z"] for v in beside]
    assert drawn(scene_of(few), 5) == alone
    assert drawn(scene_of(few), 5, seed=1) != alone
    assert len({v["gravity.z"] for v in alone}) == 5
    scene = scene_of(more)
    variations = expand(scene, scene.randomize)
    first, second = (draw(scene, variations, 0, 3, camera=k)[1] for k in (0, 1))
    assert first["camera.azimuth"] != second["camera.azimuth"] and first["gravity.z"] == second["gravity.z"]


def test_what_is_drawn_stands_in_the_scene() -> None:
    scene = scene_of({
        "bodies.left.velocity.x": [1, 2], "bodies.right.mujoco.restitution": [0.2, 0.9],
        "bodies.right.position.z": {"low": 0.1, "high": 0.2, "apply": "add"},
    })  # fmt: skip
    changed, values = draw(scene, expand(scene, scene.randomize), 0, 7)
    left, right = changed.bodies
    assert left.velocity == (values["bodies.left.velocity.x"], 0.0, 0.0)
    assert right.mujoco.restitution == values["bodies.right.mujoco.restitution"]
    assert right.mujoco.shape == "sphere"
    assert 0.4 <= right.position[2] == values["bodies.right.position.z"] <= 0.5
    assert (left.position, changed.solver, changed.folder) == (
        scene.bodies[0].position,
        scene.solver,
        scene.folder,
    )


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ({"gravity.z": [1, -1]}, "gravity.z: the range is inverted: low 1.0 lies above high -1.0"),
        ({"gravity.z": 3}, "gravity.z: give .low, high."),
        ({"gravity.z": {"low": 1}}, "gravity.z: give both low and high"),
        ({"gravity": [[0, 0], [0, 0, 1]]}, "equally long"),
        ({"gravity.z": {"low": -1, "high": 1, "distribution": "log_uniform"}}, "log_uniform needs low > 0"),
        ({"gravity.z": {"low": -1, "high": 1, "aply": "add"}}, "did you mean `apply`"),
        ({"gravity.z": "any"}, "is for a `rotation`"),
        ({"bodies.lift.position": [0, 1]}, "bodies has no 'lift' .did you mean 'left'"),
        ({"bodies.left.friction": [0, 1]}, "did you mean 'material.friction'"),
        ({"bodies.left.asset": {"choices": ["a.usdc"]}}, "stays the same in all rollouts"),
        ({"duration": [1, 2]}, "stays the same"),
        ({"solver.controls.turn": [0, 1]}, "nothing inside"),
        ({"bodies": [0, 1]}, "holds several values"),
        ({"bodies.*.velocity.x": [0, 1], "bodies.left.velocity.x": [0, 2]}, "given twice"),
        ({"bodies.left.material.poisson": [0.6, 0.9]}, "must be less than 0.5"),
        ({"camera.distance": {"low": 1, "high": 2, "apply": "scale"}}, "needs a value in the scene"),
    ],
)
def test_wrong_variations_are_told_in_one_line(randomize: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        drawn(scene_of(randomize), 1)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("randomize", "message"),
    [
        ({"bodies.left.material.young": [1e9, 2e9]}, "material.young: has no effect on this scene"),
        ({"bodies.left.position.z": [-0.3, 0.2]}, "at -0.3: .*below the ground"),
        ({"camera.azimuth": [0, 90]}, "has no effect without images"),
    ],
)
def test_variations_without_effect_are_refused(ball: Asset, randomize: dict[str, Any], message: str) -> None:
    scene = scene_of(randomize)
    with pytest.raises(SceneError, match=message):
        check_effects(scene, expand(scene, scene.randomize), assets_of(scene, ball), pictures=False)


# ---- many at once ----


def run(
    scenes: list[Scene], asset: Asset, threads: int, change: Callable[[SolverMuJoCo], None] = lambda s: None
) -> tuple[list[str | None], dict[tuple[int, int], bytes]]:
    solvers = [SolverMuJoCo(compile_scene(scene, assets_of(scene, asset))) for scene in scenes]
    for solver in solvers:
        change(solver)
    states: dict[tuple[int, int], bytes] = {}

    def seen(k: int, frame: int) -> None:
        states[k, frame] = solvers[k].state_dict()["mujoco"].tobytes()

    failures = run_batch(solvers, scenes[0].frame_count, 1.0 / scenes[0].fps, seen, threads=threads)
    return failures, states


def alone(scene: Scene, asset: Asset) -> list[bytes]:
    solver = SolverMuJoCo(compile_scene(scene, assets_of(scene, asset)))
    states = [solver.state_dict()["mujoco"].tobytes()]
    for _ in range(scene.frame_count - 1):
        solver.step(1.0 / scene.fps)
        states.append(solver.state_dict()["mujoco"].tobytes())
    return states


@pytest.mark.parametrize("kind", ["free", "controls", "moved", "soft"])
def test_rollouts_are_what_the_solver_does_alone(ball: Asset, kind: str, tmp_path: Any) -> None:
    given: dict[str, Any] = {}
    if kind == "controls":
        (tmp_path / "arm.xml").write_text(ARM)
        keys = [{"time": 0.0, "value": 0.0}, {"time": 0.3, "value": 0.8}]
        given["solver"] = {"kind": "mujoco", "base": str(tmp_path / "arm.xml"), "controls": {"turn": keys}}
    if kind == "moved":
        motion = [{"time": 0.1, "translation": [0.15, 0, 0]}]
        given["duration"] = 0.1
        given["colliders"] = [
            {"kind": "box", "size": [0.1, 0.4, 0.4], "position": [-0.6, 0, 0.2], "motion": motion}
        ]
    randomize: dict[str, Any] = {
        "bodies.*.velocity": [[-1, -1, -1], [1, 1, 0]],
        "bodies.*.material.friction": {"choices": [0.2, 0.2, 0.5]},
    }
    if kind == "controls":
        randomize["solver.controls.turn.*.value"] = [-1, 1]
    scene = scene_of(randomize, **given)
    if kind == "soft":
        bodies = [body.model_copy(update={"mujoco": None, "material": JELLY}) for body in scene.bodies]
        scene = scene.model_copy(update={"bodies": tuple(bodies), "duration": 0.1})
    variations = expand(scene, scene.randomize)
    scenes = [draw(scene, variations, 0, index)[0] for index in range(2)]
    failures, one = run(scenes, ball, threads=1)
    assert failures == [None] * 2
    assert len(one) == 2 * scene.frame_count and len(set(one.values())) == len(one)
    _, two = run(scenes, ball, threads=2)
    assert one == two
    for k, changed in enumerate(scenes):
        assert [one[k, frame] for frame in range(scene.frame_count)] == alone(changed, ball)


def test_one_that_fails_leaves_the_others_alone(ball: Asset) -> None:
    scenes = [scene_of(bodies=[{**_body(), "velocity": [speed, 0, 0]}]) for speed in (0.0, 1e200, 1.0)]
    failures, states = run(scenes, ball, threads=2)
    assert failures[0] is None and failures[2] is None
    assert "MuJoCo failed near" in str(failures[1])
    frames = scenes[0].frame_count
    assert [(0, k) in states and (2, k) in states for k in range(frames)] == [True] * frames
    assert (1, frames - 1) not in states


def _body() -> dict[str, Any]:
    return {"name": "left", "asset": "ball.usdc", "position": [0, 0, 0.3], "material": "wood",
            "mujoco": {"form": "rigid", "shape": "sphere"}}  # fmt: skip
