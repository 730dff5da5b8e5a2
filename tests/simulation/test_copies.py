"""Copies of a body: where they stand, what they share, and that each behaves as a body written alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from gdpro_sim.asset import Asset
from gdpro_sim.errors import SceneError
from gdpro_sim.simulation import compile as compiling
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.conditions import Wind
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.run import solver_of
from gdpro_sim.simulation.scene import Scene, check_scene
from tests.simulation.cubes import SIDE, cube_asset, write_cube


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return cube_asset(tmp_path_factory.mktemp("cube"))


def scene_of(copies: Any, body: dict[str, Any] | None = None, **scene: Any) -> Scene:
    box = {"name": "box", "asset": "cube.ply", "position": [0, 0, 1], "material": "jelly", "copies": copies}
    return check_scene({"name": "s", "bodies": box | (body or {}), "ground": None} | scene)


def model_of(asset: Asset, scene: Scene) -> Model:
    return compile_scene(scene, {body.name: asset for body in scene.bodies})


def positions(scene: Scene) -> np.ndarray:
    return np.array([body.position for body in scene.bodies])


def test_rows_grids_and_poses() -> None:
    row = scene_of({"count": 3, "spacing": 0.2})
    assert [body.name for body in row.bodies] == ["box_0", "box_1", "box_2"]
    np.testing.assert_allclose(positions(row), [[0, 0, 1], [0.2, 0, 1], [0.4, 0, 1]])
    steps = scene_of({"count": 2, "spacing": [0, 0.3, 0.5]})
    np.testing.assert_allclose(positions(steps)[1], [0, 0.3, 1.5])
    grid = positions(scene_of({"grid": [2, 3, 2], "spacing": [0.2, 0.3, 0.4]}))
    assert len(np.unique(grid, axis=0)) == 12
    np.testing.assert_allclose(grid.min(0), [-0.1, -0.3, 1])
    np.testing.assert_allclose(grid.max(0), [0.1, 0.3, 1.4])
    np.testing.assert_allclose(grid[0], grid.min(0))
    poses = scene_of({"poses": [{"position": [1, 2, 3]}, {"position": [4, 5, 6], "velocity": [0, 0, 7]}]},
                     {"rotation": [0, 0, 30], "velocity": [1, 0, 0]})  # fmt: skip
    np.testing.assert_allclose(positions(poses), [[1, 2, 3], [4, 5, 6]])
    assert [body.velocity for body in poses.bodies] == [(1, 0, 0), (0, 0, 7)]
    assert all(body.rotation == (0, 0, 30) for body in poses.bodies)


def test_jitter_is_drawn_from_the_seed_and_stays_within_its_bounds() -> None:
    copies = {"grid": [4, 4, 4], "spacing": 1, "jitter": {"position": [0.1, 0.2, 0], "rotation": 10}}
    plain = positions(scene_of(copies | {"jitter": None}))
    one, again, other = (scene_of(copies, seed=seed) for seed in (1, 1, 2))
    assert one == again
    off = positions(one) - plain
    assert (np.abs(off) <= [0.1, 0.2, 0]).all()
    assert (np.ptp(off, axis=0)[:2] > [0.15, 0.3]).all()
    assert np.abs(positions(other) - positions(one)).max() > 0.05
    angles = np.array([body.rotation for body in one.bodies])
    assert np.abs(angles).max() <= 10.0 and (np.ptp(angles, axis=0) > 15).all()


def test_a_checked_scene_is_the_same_scene_when_it_is_read_again() -> None:
    scene = scene_of({"count": 3, "spacing": 1, "jitter": {"rotation": 90}, "colors": ["red", "#00ff00"]})
    assert Scene.model_validate(scene.model_dump(mode="json")).bodies == scene.bodies
    assert [body.copied.color for body in scene.bodies if body.copied] == ["red", "#00ff00", "red"]


@pytest.mark.parametrize(
    ("copies", "message"),
    [
        (0, r"copies.count: must be greater than or equal to 1, got 0"),
        ({"grid": [1, 0, 1]}, r"copies.grid\[1\]: must be greater than or equal to 1"),
        ({"count": 2}, "`count` needs a `spacing` other than 0"),
        ({"grid": [2, 2, 1], "spacing": [1, 0, 0]}, "`grid` needs a `spacing` other than 0 along Y"),
        ({"grid": [100, 100, 2], "spacing": 1}, "a grid may hold 10,000 at most, got 20,000"),
        ({"count": 2, "grid": [1, 1, 1]}, "give one of count, grid and poses, got count and grid"),
        ({"spacing": 1}, "give one of count, grid and poses, got none"),
        ({"poses": []}, "copies.poses: must hold at least one item"),
        ({"poses": {"position": [0, 0, 0]}, "spacing": 1}, "`spacing` belongs to `count` or `grid`"),
        ({"count": 2, "spacing": 1, "jitter": {"position": -1}}, "must not be negative"),
        ({"count": 2, "spacing": 1, "colors": "rde"}, "colour 'rde' is unknown"),
        ({"count": 2, "spacin": 1}, r"copies.spacin: unknown key \(did you mean `spacing`\?\)"),
    ],
)
def test_wrong_copies_are_refused(copies: Any, message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        scene_of(copies)
    assert "\n" not in str(caught.value)


def test_clashing_names_are_listed() -> None:
    others = [{"name": name, "asset": "cube.ply"} for name in ("box_0", "box_2", "box_9")]
    box = {"name": "box", "asset": "cube.ply", "copies": {"count": 3, "spacing": 1}}
    with pytest.raises(
        SceneError, match="copies would be named like other bodies: box_0, box_2; rename those"
    ):
        check_scene({"bodies": [box, *others]})
    with pytest.raises(SceneError, match="two bodies are named 'box'"):
        check_scene({"bodies": [box, {"name": "box", "asset": "cube.ply"}]})
    with pytest.raises(SceneError, match=r"there is no body 'bx' \(did you mean 'box'\?\)"):
        check_scene({"bodies": [box], "wind": {"bodies": ["bx"]}})


@pytest.mark.parametrize("kind", ["fem", "mpm", "mujoco"])
def test_a_copy_falls_as_its_body_alone(cube: Asset, kind: str) -> None:
    options = {"kind": kind} | ({"grid_spacing": 0.04} if kind == "mpm" else {})
    body = {"angular_velocity": [1, 2, 3], "velocity": [0.5, 0, 0]}
    alone, copied = (
        solver_of(model_of(cube, scene_of(copies, body, solver=options)))
        for copies in (None, {"count": 2, "spacing": [0, 0.4, 0]})
    )
    for solver in (alone, copied):
        for _ in range(2):
            solver.step(1 / 100)
    fallen = alone.surface_positions(0)
    for number, shift in enumerate(([0, 0, 0], [0, 0.4, 0])):
        np.testing.assert_allclose(copied.surface_positions(number), fallen + shift, atol=2e-5)
    drop = 1.0 + 0.5 * SIDE - fallen[:, 2].mean()
    assert drop == pytest.approx(0.5 * 9.81 * 0.02**2, rel=0.8), "steps fall a little more or less"


def test_copies_share_the_asset(cube: Asset) -> None:
    scene = scene_of({"count": 3, "spacing": 0.3, "colors": ["red", "blue"]}, {"size": 0.2})
    assets = {"box": cube}
    for body in scene.bodies:
        assert body.copied is not None
        assets[body.name] = compiling.colored(cube, str(body.copied.color))
    one, two, three = (body for body in compile_scene(scene, assets).bodies)
    for other in (two, three):
        assert other.embedding is one.embedding
        for part in ("vertices", "faces", "face_ids", "barycentrics", "log_scales", "opacity_logits"):
            assert getattr(other.gaussians, part) is getattr(one.gaussians, part), part
    assert not np.allclose(one.gaussians.sh, two.gaussians.sh)
    np.testing.assert_array_equal(one.gaussians.sh, three.gaussians.sh)


def test_regions_mean_the_same_part_of_every_copy(cube: Asset) -> None:
    corner = {"minimum": [0.04, 0.04, 1.09]}
    poses = [{"position": [0, 0, 1]}, {"position": [3, 0, 1], "rotation": [0, 0, 90]}]
    turn = {"time": 1, "rotation": [0, 0, 90]}
    pin = corner | {"motion": [turn], "pivot": [0, 0, 1]}
    model = model_of(cube, scene_of({"poses": poses}, {"pins": [pin]}))
    held = np.flatnonzero(model.pinned)
    half = len(model.vertices) // 2
    assert len(held) >= 2
    np.testing.assert_array_equal(held[held >= half] - half, held[held < half])
    np.testing.assert_allclose(model.motions[1].pivot, [3, 0, 1], atol=1e-6)
    # The same corner, which the turn about Z by 90 degrees takes from +X+Y to -X+Y.
    middle = model.vertices[held[held >= half]].mean(0) - [3, 0, 1.05]
    np.testing.assert_allclose(np.sign(middle), [-1, 1, 1])


def test_springs_attachments_and_wind_take_copies_together(cube: Asset) -> None:
    scene = scene_of(
        {"count": 3, "spacing": SIDE * 1.005},
        springs={"ends": [{"body": "box", "point": [0, 0, 1.1]}, {"point": [0, 0, 1.4]}], "stiffness": 10},
        attachments={"bodies": ["box_0", "box"], "stiffness": 50, "distance": 0.01},
        wind=[{"bodies": ["box"]}, {"bodies": ["box_1"]}],
    )
    model = model_of(cube, scene)
    assert model.springs is not None
    np.testing.assert_allclose(model.springs.rest_length[:3], 0.3, atol=1e-6)
    np.testing.assert_allclose(model.springs.anchors[:3, 1, 0], SIDE * 1.005 * np.arange(3), atol=1e-6)
    ties = model.springs.corners[3:]
    assert len(ties) and (ties[:, 0] < model.bodies[0].vertex_range[1]).all()
    winds = [load for load in model.loads if isinstance(load, Wind)]
    assert len(winds[0].faces) == 3 * len(winds[1].faces)


def test_an_attachment_of_copies_ties_those_that_are_near(cube: Asset) -> None:
    bodies = [
        {"name": "box", "asset": "a", "position": [0, 0, 0], "copies": {"count": 4, "spacing": 0.5}},
        {"name": "shelf", "asset": "a", "position": [0.5, 0, -1.002 * SIDE]},
    ]
    ties = {"bodies": ["box", "shelf"], "distance": 0.01, "stiffness": 10}
    scene = check_scene({"bodies": bodies, "attachments": ties, "ground": None})
    springs = model_of(cube, scene).springs
    assert springs is not None
    owner = springs.corners[:, 0, 0] // (len(model_of(cube, scene).vertices) // 5)
    assert set(owner) == {1}
    far = check_scene({"bodies": bodies, "attachments": ties | {"bodies": ["shelf", "box"]}, "ground": None})
    assert model_of(cube, far).springs is not None
    moved = [bodies[0], bodies[1] | {"position": [0, 9, 0]}]
    with pytest.raises(SceneError, match=r"attachments\[0\]: no copies of 'box' and 'shelf' are near enough"):
        model_of(cube, check_scene({"bodies": moved, "attachments": ties, "ground": None}))


@pytest.mark.parametrize("kind", ["fem", "mpm", "mujoco"])
def test_copies_that_overlap_are_named(cube: Asset, kind: str) -> None:
    scene = scene_of({"count": 3, "spacing": [0.07, 0.01, 0.02]}, solver={"kind": kind})
    with pytest.raises(SceneError, match=r"copies 'box_0' and 'box_1' overlap at the start; raise `spacing`"):
        model_of(cube, scene)


def test_an_asset_is_made_once_and_copies_are_coloured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_cube(tmp_path / "cube.ply")
    made = []
    original = compiling.import_mesh
    monkeypatch.setattr(compiling, "import_mesh", lambda *a, **k: made.append(a) or original(*a, **k))
    copies = {"count": 3, "spacing": 1, "colors": ["#ff0000", "#0000ff"]}
    body = {"budget": 300, "asset": str(tmp_path / "cube.ply"), "color": "#808080"}
    assets = load_assets(scene_of(copies, body, solver={"kind": "mpm"}))
    assert len(made) == 1 and list(assets) == ["box", "box_0", "box_1", "box_2"]
    for name, color in (("box_0", [1, 0, 0]), ("box_1", [0, 0, 1]), ("box", [0.5, 0.5, 0.5])):
        colors = assets[name].vertex_colors
        assert colors is not None
        np.testing.assert_allclose(colors, np.broadcast_to(color, colors.shape), atol=0.01)
    textured = trimesh.creation.box((1, 1, 1))
    textured.visual.vertex_colors = [[255, 128, 0, 255]] * 4 + [[0, 255, 0, 255]] * 4
    textured.export(tmp_path / "two.ply")
    body |= {"asset": str(tmp_path / "two.ply"), "color": None}
    tinted = load_assets(scene_of(copies, body, solver={"kind": "mpm"}))
    before, after = tinted["box"].vertex_colors, tinted["box_0"].vertex_colors
    assert before is not None and after is not None
    np.testing.assert_allclose(after, before * [1, 0, 0], atol=1e-6)
