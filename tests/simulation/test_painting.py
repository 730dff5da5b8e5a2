"""Painted parts: vertex groups, colours and masks choose the vertices and particles under them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Usd, UsdGeom

from gdpro_sim.asset import Asset, import_mesh
from gdpro_sim.cli import main
from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.scene import check_scene
from tests.simulation.cubes import SIDE, cube_asset


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return cube_asset(tmp_path_factory.mktemp("cube"), target_tets=400)


def model_of(asset: Asset, pin: dict[str, Any], kind: str = "fem", **body: Any) -> Model:
    options = {"kind": kind} | ({"grid_spacing": 0.03} if kind == "mpm" else {})
    box = {"name": "box", "asset": "a", "position": [1, 2, 3], "material": "jelly", "pins": pin} | body
    scene = check_scene({"bodies": box, "solver": options})
    return compile_scene(scene, {item.name: asset for item in scene.bodies})


@pytest.mark.parametrize("pin", [{"group": "lid"}, {"painted": "red"}, {"painted": "#f01010"}])
def test_a_lid_is_the_outermost_layer_at_the_top(cube: Asset, pin: dict[str, Any]) -> None:
    fem = model_of(cube, pin, rotation=[90, 0, 0])
    surface = fem.vertices[:, 2].max()
    assert fem.pinned.any()
    ends = fem.vertices[fem.pinned, 1]
    assert ends.max() < 2 - 0.3 * SIDE, "the lid looks to -Y after the turn"
    assert np.ptp(fem.vertices[fem.pinned, 2]) > 0.7 * SIDE and surface > 3
    mpm = model_of(cube, pin, "mpm")
    assert mpm.particles is not None
    heights = mpm.particles.positions[mpm.holds[0].particles, 2] - 3
    assert heights.min() > 0.75 * SIDE
    layer = (mpm.particles.positions[:, 2] - 3 > SIDE - mpm.particles.spacing).sum()
    assert len(heights) == pytest.approx(layer, rel=0.5)


def test_depth_reaches_further_down(cube: Asset) -> None:
    shallow, deep = (
        model_of(cube, {"group": "lid", "depth": depth}, "mpm").holds[0].particles for depth in (0.02, 0.04)
    )
    assert set(shallow) < set(deep)


def test_a_group_smaller_than_the_tets_still_holds_what_is_nearest(cube: Asset) -> None:
    corner = int(np.linalg.norm(cube.gaussians.vertices.numpy() - SIDE, axis=1).argmin())
    model = model_of(replace(cube, groups={"tip": np.array([corner], np.int32)}), {"group": "tip"})
    held = model.vertices[model.pinned]
    assert 1 <= len(held) <= 8
    np.testing.assert_allclose(held.mean(0), [1 + SIDE / 2, 2 + SIDE / 2, 3 + SIDE], atol=0.4 * SIDE)


def test_copies_are_painted_as_their_asset_whatever_their_colour(tmp_path: Path) -> None:
    cube_asset(tmp_path).save(tmp_path / "cube.usdc")
    copies = {"count": 2, "spacing": 1, "colors": ["blue", "green"]}
    body = {"name": "box", "asset": "cube.usdc", "pins": {"painted": "red"}, "copies": copies}
    scene = check_scene({"bodies": body, "folder": tmp_path})
    model = compile_scene(scene, load_assets(scene))
    half = len(model.vertices) // 2
    assert model.pinned.any()
    np.testing.assert_array_equal(model.pinned[:half], model.pinned[half:])


@pytest.mark.parametrize(
    ("pin", "message"),
    [
        ({"group": "lit"}, r"pins\[0\].group: the asset has no vertex group 'lit' \(did you mean 'lid'\?\)"),
        (
            {"painted": "blue"},
            r"pins\[0\].painted: no vertex is painted blue within 0.15; .* #[0-9a-f]{6}, is",
        ),
        ({"painted": "blu"}, r"pins\[0\].painted: colour 'blu' is unknown"),
        ({"group": "lid", "painted": "red"}, "give one of box, .*, got a group and a painted colour"),
        ({"group": "lid", "tolerance": 0.1}, "`tolerance` belongs to a `painted` colour"),
        ({"side": "top", "depth": 0.1}, "`depth` belongs to a `group` or a `painted` colour"),
    ],
)
def test_wrong_painted_parts_are_refused(cube: Asset, pin: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message) as caught:
        model_of(cube, pin)
    assert "\n" not in str(caught.value)


OBJ = "mtllib two.mtl\n"
"""A slab of two materials, and a UV map from its X and Y."""


def write_slab(folder: Path) -> Path:
    """A slab on [-1, 1]^2, 0.4 thick: material `left` at x < 0, else `right`; UV from X and Y."""
    mesh = trimesh.creation.box((2, 2, 0.4)).subdivide().subdivide().subdivide()
    lines = [OBJ, *(f"v {x} {z} {-y}" for x, y, z in mesh.vertices)]
    lines += [f"vt {0.5 + 0.48 * x} {0.5 + 0.48 * y}" for x, y, _ in mesh.vertices]
    left = mesh.triangles_center[:, 0] < 0
    for name, faces in (("left", mesh.faces[left]), ("right", mesh.faces[~left])):
        lines += [f"usemtl {name}", *("f " + " ".join(f"{i}/{i}" for i in face + 1) for face in faces)]
    (folder / "two.obj").write_text("\n".join(lines))
    (folder / "two.mtl").write_text("newmtl left\nKd 1 0 0\nnewmtl right\nKd 0 0 1\n")
    return folder / "two.obj"


def test_named_parts_of_a_mesh_become_groups(tmp_path: Path) -> None:
    mesh = trimesh.creation.box((1, 1, 1)).subdivide()
    top = mesh.triangles_center[:, 2] > 0.49
    right = mesh.triangles_center[:, 0] > 0.49
    lines = ["g", "o Box", *(f"v {x} {y} {z}" for x, y, z in mesh.vertices)]
    for names, faces in (("", ~top & ~right), ("lid red", top), ("side", right)):
        lines += [f"g {names}", *(f"f {a} {b} {c}" for a, b, c in mesh.faces[faces] + 1)]
    (tmp_path / "box.obj").write_text("\n".join(lines))
    stage = Usd.Stage.CreateNew(str(tmp_path / "box.usda"))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    prim = UsdGeom.Mesh.Define(stage, "/Box")
    prim.CreatePointsAttr(mesh.vertices.astype(np.float32))
    prim.CreateFaceVertexCountsAttr([3] * len(mesh.faces))
    prim.CreateFaceVertexIndicesAttr(mesh.faces.ravel().astype(np.int32))
    for name, faces in (("lid", top), ("side", right)):
        UsdGeom.Subset.CreateGeomSubset(prim, name, "face", np.flatnonzero(faces).tolist())
    stage.Save()
    expected = {"box.obj": {"lid", "red", "side"}, "box.usda": {"lid", "side"}}
    for file, names in expected.items():
        asset = import_mesh(tmp_path / file, budget=300, tets=False, up="z")
        points = asset.gaussians.vertices.numpy()
        assert set(asset.groups) == names
        assert set(asset.groups["lid"]) == set(np.flatnonzero(points[:, 2] > 0.49))
        assert set(asset.groups["side"]) == set(np.flatnonzero(points[:, 0] > 0.49))


def test_materials_and_masks_of_a_mesh_become_groups(tmp_path: Path) -> None:
    slab = write_slab(tmp_path)
    rows = np.arange(64)[:, None] < 16  # the first rows are the top of the map, v = 1
    mask = Image.fromarray(np.where(rows, 255, 0).repeat(64, axis=1).astype(np.uint8))
    mask.save(tmp_path / "back.png")
    asset = import_mesh(slab, budget=4000, tets=False, masks={"back": tmp_path / "back.png"})
    assert set(asset.groups) == {"left", "right", "back"}
    x, y, _ = asset.gaussians.vertices.numpy().T
    assert set(np.flatnonzero(x < -0.05)) <= set(asset.groups["left"])
    assert x[asset.groups["left"]].max() < 0.05 and x[asset.groups["right"]].min() > -0.05
    assert set(np.flatnonzero(y > 0.6)) <= set(asset.groups["back"])
    assert y[asset.groups["back"]].min() > 0.3
    asset.save(tmp_path / "slab.usdc")
    again = Asset.load(tmp_path / "slab.usdc")
    assert list(again.groups) == list(asset.groups)
    assert asset.summary()["groups"]["back"] == len(asset.groups["back"])
    Image.new("L", (8, 8), 100).save(tmp_path / "none.png")
    with pytest.raises(MeshError, match=r"group 'none': .*none.png paints no face of two.obj"):
        import_mesh(slab, budget=4000, tets=False, masks={"none": tmp_path / "none.png"})


def test_masks_on_the_command_line_and_in_a_scene(tmp_path: Path, monkeypatch: Any, capsys: Any) -> None:
    slab = write_slab(tmp_path)
    Image.new("L", (8, 8), 255).save(tmp_path / "all.png")
    command = ["gdpro", "import", str(slab), "-o", str(tmp_path / "a.usdc"), "--tets", "0", "--budget", "500"]
    for masks, code, said in (
        (["--mask", f"all={tmp_path / 'all.png'}", "--quiet"], 0, ""),
        (["--mask", "all"], 2, "--mask must be NAME=IMAGE, got 'all'"),
        (["--mask", "all=no.png"], 2, "no.png"),
    ):
        monkeypatch.setattr("sys.argv", [*command, *masks])
        with pytest.raises(SystemExit) as left:
            main()
        assert (left.value.code, said in capsys.readouterr().err) == (code, True)
    assert len(Asset.load(tmp_path / "a.usdc").groups["all"]) > 50
    body = {"asset": "a.usdc", "masks": {"all": "all.png"}}
    with pytest.raises(SceneError, match=r"bodies\[a\].masks: applies to a mesh"):
        load_assets(check_scene({"bodies": body, "folder": tmp_path}))
    with pytest.raises(SceneError, match=r"bodies\[two\].masks.all: .*no.png: no such file"):
        missing = {"asset": "two.obj", "masks": {"all": "no.png"}}
        load_assets(check_scene({"bodies": missing, "folder": tmp_path}))
