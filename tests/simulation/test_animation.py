"""Motions against closed forms, how assets follow them, and what is recorded."""

from __future__ import annotations

import base64
import json
import logging
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from pxr import Gf, Usd, UsdGeom, UsdSkel

import gdpro_sim
from gdpro_sim.asset import Asset, import_mesh
from gdpro_sim.cli import main
from gdpro_sim.errors import MeshError, RequestError, SceneError
from gdpro_sim.io.animate import animation_scene
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.io.views import render_file
from gdpro_sim.simulation.animation import VertexSource, open_motion
from gdpro_sim.simulation.animation.follow import fit_to_surface
from gdpro_sim.simulation.compile import load_assets
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import check_scene
from tests.asset.sample import sphere
from tests.simulation.animated_files import Glb, bending_tube, bent, quaternion, tube

TINY = {"width": 64, "height": 48}


def z_up(points: np.ndarray) -> np.ndarray:
    """Y up to Z up."""
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)


def triangle(glb: Glb, **extra: Any) -> np.ndarray:
    """The only mesh of a file: one triangle."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    glb.json["meshes"] = [{"primitives": [{"attributes": {"POSITION": glb.array(points)}, **extra}]}]
    return points


# ---- glTF ----


@pytest.mark.parametrize("extra", [False, True])
def test_a_skin_bends_a_tube_as_linear_blend_skinning_says(tmp_path: Path, extra: bool) -> None:
    motion = open_motion(bending_tube(tmp_path / "tube.glb", extra=extra))
    vertices, faces, _ = tube()
    assert isinstance(motion, VertexSource) and np.array_equal(motion.faces, faces)
    assert (motion.begin, motion.end) == (0.0, 2.0)
    for time, degrees in ((-1.0, 0.0), (0.5, 40.0), (1.0, 80.0), (1.75, 20.0), (9.0, 0.0)):
        off = np.abs(motion.vertices(time) - z_up(bent(vertices, degrees))).max()
        assert off < (2e-3 if extra else 1e-6), time


@pytest.mark.parametrize(
    ("how", "degrees"),
    [("LINEAR", 20.0), ("STEP", 0.0), ("CUBICSPLINE", None)],
)
def test_interpolations(tmp_path: Path, how: str, degrees: float | None) -> None:
    motion = open_motion(bending_tube(tmp_path / "tube.glb", how=how))
    if degrees is None:  # Hermite weights of the two quaternions, normalised
        h = 3.0 * 0.25**2 - 2.0 * 0.25**3
        q = (1.0 - h) * np.array(quaternion((0, 0, 1), 0.0)) + h * np.array(quaternion((0, 0, 1), 80.0))
        degrees = 2.0 * math.degrees(math.atan2(q[2], q[3]))
    assert np.allclose(motion.vertices(0.25), z_up(bent(tube()[0], degrees)), atol=1e-6)


def test_morph_targets_add_up_and_nodes_carry(tmp_path: Path) -> None:
    glb = Glb()
    up, wide = np.array([[0.0, 0, 0], [0, 0, 0], [0, 2, 0]]), np.array([[0.0, 0, 0], [3, 0, 0], [0, 0, 0]])
    points = triangle(glb, targets=[{"POSITION": glb.array(up)}, {"POSITION": glb.array(wide)}])
    glb.json["nodes"] = [
        {"children": [1], "rotation": quaternion((0, 1, 0), 90.0), "scale": [2.0, 2.0, 2.0]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 5, 1], "weights": [0.0, 1.0]},
    ]
    glb.animate(1, "weights", [0.0, 2.0], [0.0, 1.0, 1.0, 0.0])
    glb.animate(0, "translation", [0.0, 2.0], [[0, 0, 0], [0, 8, 0]])
    motion = open_motion(glb.save(tmp_path / "morph.glb"), fps=10)
    local = points + 0.25 * up + 0.75 * wide + [0, 0, 5.0]
    world = 2.0 * np.stack([local[:, 2], local[:, 1], -local[:, 0]], 1) + [0, 2.0, 0]
    assert np.allclose(motion.vertices(0.5), z_up(world), atol=1e-6)
    still = 2.0 * np.stack([(points + wide)[:, 2] + 5.0, (points + wide)[:, 1], -(points + wide)[:, 0]], 1)
    assert np.allclose(motion.rest, z_up(still), atol=1e-6), "the file's own weights are its rest"


def test_sparse_and_quantised_accessors_and_buffers_beside(tmp_path: Path) -> None:
    glb = Glb()
    points = triangle(glb)
    glb.json["accessors"][0]["sparse"] = {
        "count": 1,
        "indices": {"bufferView": glb.view(np.array([2], "<u2").tobytes()), "componentType": 5123},
        "values": {"bufferView": glb.view(np.array([0, 7, 0], "<f4").tobytes())},
    }
    glb.json["nodes"] = [{"mesh": 0}]
    turned = np.round(32767 * np.array([[0, 0, 0, 1], [0, 0, math.sqrt(0.5), math.sqrt(0.5)]]))
    glb.animate(0, "rotation", [0.0, 1.0], [[0, 0, 0, 1], [0, 0, 0, 1]])
    sampler = glb.json["animations"][0]["samplers"][0]
    sampler["output"] = glb.array(turned, "i2", normalized=True)
    expected = np.stack([-np.array([0, 0, 7.0]), points[:, 0], np.zeros(3)], 1)
    assert np.allclose(open_motion(glb.save(tmp_path / "a.glb")).vertices(1.0), z_up(expected), atol=1e-4)
    (tmp_path / "some data.bin").write_bytes(glb.binary)
    for uri in (
        "some%20data.bin",
        "data:application/octet-stream;base64," + base64.b64encode(glb.binary).decode(),
    ):
        text = {**glb.json, "buffers": [{"byteLength": len(glb.binary), "uri": uri}]}
        (tmp_path / "b.gltf").write_text(json.dumps(text))
        assert np.allclose(open_motion(tmp_path / "b.gltf").vertices(1.0), z_up(expected), atol=1e-4)
    (tmp_path / "some data.bin").unlink()
    text["buffers"][0]["uri"] = "some%20data.bin"
    (tmp_path / "b.gltf").write_text(json.dumps(text))
    with pytest.raises(MeshError, match=r"its buffer some%20data\.bin is missing"):
        open_motion(tmp_path / "b.gltf")


def _draco(glb: Glb) -> None:
    glb.json["extensionsRequired"] = [
        "KHR_draco_mesh_compression",
        "KHR_mesh_quantization",
        "EXT_meshopt_compression",
    ]


def _no_animation(glb: Glb) -> None:
    del glb.json["animations"]


def _many_joints(glb: Glb) -> None:
    glb.json["skins"][0]["joints"] = [2]


def _two_parents(glb: Glb) -> None:
    glb.json["nodes"][1]["children"] = [3]


def _bad_accessor(glb: Glb) -> None:
    glb.json["accessors"][0]["count"] = 10**6


def _backward(glb: Glb) -> None:
    glb.json["animations"][0]["samplers"][0]["input"] = glb.array([0.0, 2.0, 1.0])


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (_draco, "extensions KHR_draco_mesh_compression, EXT_meshopt_compression, which cannot be read"),
        (_no_animation, r"has no animation \(it has a skin, in one pose\)"),
        (_many_joints, "JOINTS_0 holds 1 of 1 joints"),
        (_two_parents, "node 3 has two parents"),
        (_bad_accessor, "accessor 0 is damaged .*reaches past"),
        (_backward, "keyframe times of node 3 do not ascend"),
    ],
)
def test_gltf_that_cannot_be_read_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, spoil: Callable[[Glb], None], message: str
) -> None:
    save = Glb.save

    def spoiled(self: Glb, path: Path) -> Path:
        spoil(self)
        return save(self, path)

    monkeypatch.setattr(Glb, "save", spoiled)
    with pytest.raises(MeshError, match=message):
        open_motion(bending_tube(tmp_path / "tube.glb"))


def test_clips_are_chosen_by_name_or_number(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    glb = Glb()
    triangle(glb)
    glb.json["nodes"] = [{"mesh": 0}]
    glb.animate(0, "translation", [0.0, 1.0], [[0, 0, 0], [0, 8, 0]])
    first = glb.json["animations"].pop()
    glb.json["animations"] = []
    glb.json.pop("animations")
    glb.animate(0, "translation", [0.0, 3.0], [[0, 0, 0], [0, 5, 0]])
    glb.json["animations"] = [{**first, "name": "walk"}, {**glb.json["animations"][0], "name": "run"}]
    path = glb.save(tmp_path / "two.glb")
    assert open_motion(path).end == 1.0
    assert "has 2 animations, 'walk' is taken; choose another with `clip`: walk, run" in caplog.text
    assert open_motion(path, clip="run").end == open_motion(path, clip="1").end == 3.0
    with pytest.raises(MeshError, match="has no animation 'hop'; it has 'walk', 'run'"):
        open_motion(path, clip="hop")
    (tmp_path / "cut.glb").write_bytes(path.read_bytes()[:300])
    with pytest.raises(MeshError, match="cannot be read as glTF"):
        open_motion(tmp_path / "cut.glb")


# ---- USD ----


def skeleton(path: Path) -> Path:
    """A triangle whose tip rides on a joint that turns by 90 degrees about X in 1 s, and grows wider."""
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 0.01)
    stage.SetStartTimeCode(0)
    stage.SetEndTimeCode(24)
    root = UsdSkel.Root.Define(stage, "/Root")
    skel = UsdSkel.Skeleton.Define(stage, "/Root/Skeleton")
    still, above = Gf.Matrix4d(1), Gf.Matrix4d(1).SetTranslate((0, 0, 100))
    skel.CreateJointsAttr(["a", "a/b"])
    skel.CreateBindTransformsAttr([still, above])
    skel.CreateRestTransformsAttr([still, above])
    animation = UsdSkel.Animation.Define(stage, "/Root/Animation")
    animation.CreateJointsAttr(["a", "a/b"])
    animation.CreateTranslationsAttr([(0, 0, 0), (0, 0, 100)])
    animation.CreateScalesAttr([Gf.Vec3h(1, 1, 1)] * 2)
    rotations = animation.CreateRotationsAttr()
    for code, degrees in ((0, 0), (24, 90)):
        turn = Gf.Rotation((1, 0, 0), degrees).GetQuat()
        rotations.Set([Gf.Quatf(1), Gf.Quatf(turn)], code)
    mesh = UsdGeom.Mesh.Define(stage, "/Root/Mesh")
    mesh.CreatePointsAttr([(0, 0, 0), (100, 0, 0), (0, 0, 200)])
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreateSubdivisionSchemeAttr("none")
    shape = UsdSkel.BlendShape.Define(stage, "/Root/Mesh/wide")
    shape.CreateOffsetsAttr([(60, 0, 0)])
    shape.CreatePointIndicesAttr([1])
    animation.CreateBlendShapesAttr(["wide"])
    weights = animation.CreateBlendShapeWeightsAttr()
    weights.Set([0.0], 0)
    weights.Set([1.0], 24)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    binding.CreateSkeletonRel().SetTargets([skel.GetPath()])
    binding.CreateBlendShapesAttr(["wide"])
    binding.CreateBlendShapeTargetsRel().SetTargets([shape.GetPath()])
    binding.CreateJointIndicesPrimvar(False, 1).Set([0, 0, 1])
    binding.CreateJointWeightsPrimvar(False, 1).Set([1.0, 1.0, 1.0])
    UsdSkel.BindingAPI.Apply(skel.GetPrim()).CreateAnimationSourceRel().SetTargets([animation.GetPath()])
    UsdGeom.Xformable(root).AddTranslateOp().Set((0, 300, 0))
    stage.GetRootLayer().Save()
    return path


def test_usd_skeletons_and_blend_shapes(tmp_path: Path) -> None:
    motion = open_motion(skeleton(tmp_path / "skel.usda"))
    assert (motion.begin, motion.end, motion.fps) == (0.0, 1.0, 24.0)
    for time in (0.0, 0.3, 1.0):
        angle = math.radians(90.0 * time)
        tip = [0.0, 3.0 - math.sin(angle), 1.0 + math.cos(angle)]
        expected = [[0.0, 3.0, 0.0], [1.0 + 0.6 * time, 3.0, 0.0], tip]
        assert np.allclose(motion.vertices(time), expected, atol=1e-5), time


def test_usd_points_and_transforms_with_time_samples(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "move.usda"))
    stage.SetTimeCodesPerSecond(10)
    above = UsdGeom.Xform.Define(stage, "/Up")
    lift = above.AddTranslateOp()
    lift.Set((0, 0, 0), 0)
    lift.Set((0, 6, 0), 20)
    mesh = UsdGeom.Mesh.Define(stage, "/Up/Mesh")
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    points = mesh.CreatePointsAttr()
    points.Set([(0, 0, 0), (1, 0, 0), (0, 1, 0)], 0)
    points.Set([(0, 0, 0), (3, 0, 0), (0, 1, 0)], 20)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.GetRootLayer().Save()
    motion = open_motion(tmp_path / "move.usda")
    assert (motion.begin, motion.end, motion.fps) == (0.0, 2.0, 10.0)
    assert np.allclose(motion.vertices(0.5), [[0, 0, 1.5], [1.5, 0, 1.5], [0, 0, 2.5]])
    counts = mesh.GetFaceVertexIndicesAttr()
    counts.Set([0, 1, 2], 0)
    counts.Set([0, 2, 1], 20)
    stage.GetRootLayer().Save()
    with pytest.raises(MeshError, match="faces of /Up/Mesh change over time"):
        open_motion(tmp_path / "move.usda")


def test_usd_in_which_nothing_moves(tmp_path: Path) -> None:
    stage = Usd.Stage.CreateNew(str(tmp_path / "still.usda"))
    mesh = UsdGeom.Mesh.Define(stage, "/Mesh")
    mesh.CreateFaceVertexCountsAttr([3])
    mesh.CreateFaceVertexIndicesAttr([0, 1, 2])
    mesh.CreatePointsAttr([(0, 0, 0), (1, 0, 0), (0, 1, 0)])
    stage.GetRootLayer().Save()
    with pytest.raises(MeshError, match="nothing in it moves"):
        open_motion(tmp_path / "still.usda")


# ---- mesh sequences ----


def write_obj(path: Path, vertices: np.ndarray, faces: np.ndarray, normals: int = 1) -> None:
    """`normals` of them, so that readers split vertices another way in every file."""
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in vertices]
    lines += [f"vn 0 0 {k + 1}" for k in range(normals)]
    lines += [
        "f " + " ".join(f"{v + 1}//{(f + v) % normals + 1}" for v in face) for f, face in enumerate(faces)
    ]
    path.write_text("\n".join(lines))


def growing(folder: Path, count: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Frames of a ball that grows by half of its size each."""
    folder.mkdir()
    vertices, faces = sphere(6)
    for k in range(count):
        write_obj(folder / f"ball_{k + 8:03d}.obj", (1.0 + 0.5 * k) * vertices, faces, normals=k + 1)
    return vertices, faces


def test_folders_of_numbered_meshes(tmp_path: Path) -> None:
    vertices, _ = growing(tmp_path / "ball")
    motion = open_motion(tmp_path / "ball", fps=10, scale=2.0)
    assert motion.end == pytest.approx(0.3)
    assert np.allclose(motion.vertices(0.2), 4.0 * z_up(vertices), atol=1e-6)
    assert np.allclose(motion.vertices(0.15), 3.5 * z_up(vertices), atol=1e-6), "linear in between"
    (tmp_path / "ball" / "ball_009.obj").unlink()
    with pytest.raises(MeshError, match="frames 8 to 11 lack 9"):
        open_motion(tmp_path / "ball")


def test_wrong_sequences_are_refused(tmp_path: Path) -> None:
    vertices, faces = growing(tmp_path / "ball")
    write_obj(tmp_path / "ball" / "ball_012.obj", vertices, faces[::-1])
    with pytest.raises(MeshError, match=r"ball_012.obj joins its vertices otherwise than ball_008.obj"):
        open_motion(tmp_path / "ball")
    write_obj(tmp_path / "ball" / "ball_012.obj", vertices[:-1], faces[:5])
    with pytest.raises(MeshError, match=r"ball_012.obj has 61 vertices, but ball_008.obj has 62"):
        open_motion(tmp_path / "ball")
    (tmp_path / "ball" / "ball_012.obj").rename(tmp_path / "ball" / "cat_012.obj")
    with pytest.raises(MeshError, match=r"several sequences \(ball_#.obj, cat_#.obj\)"):
        open_motion(tmp_path / "ball")
    (tmp_path / "none").mkdir()
    with pytest.raises(MeshError, match="holds no numbered meshes"):
        open_motion(tmp_path / "none")


def test_arrays(tmp_path: Path) -> None:
    vertices, faces = sphere(4)
    path = tmp_path / "m.npz"
    frames = np.stack([vertices, 2.0 * vertices])
    np.savez(path, vertices=frames, faces=faces, fps=5.0, colors=np.full((len(vertices), 3), [1.0, 0.0, 0.0]))
    motion = open_motion(path)
    assert motion.end == 0.2 and np.allclose(motion.vertices(0.1), 1.5 * vertices)
    assert motion.surface().colors is not None and motion.surface().colors[0, 0].tolist() == [255, 0, 0, 255]
    for wrong, message in (
        ({"vertices": frames}, "no array 'faces'; it holds vertices"),
        ({"vertices": vertices, "faces": faces}, r"must be numbers \[T, V, 3\]"),
        ({"vertices": frames[:1], "faces": faces}, "one frame is no motion"),
        ({"vertices": frames * np.nan, "faces": faces}, "NaN"),
        ({"vertices": frames, "faces": faces + 99}, "outside"),
        ({"vertices": frames, "faces": faces, "colors": frames}, "colors must be"),
    ):
        np.savez(path, **wrong)
        with pytest.raises(MeshError, match=message):
            open_motion(path)
    path.write_bytes(b"no zip")
    with pytest.raises(MeshError, match=r"cannot be read as \.npz"):
        open_motion(path)
    (tmp_path / "a.stl").write_text("")
    with pytest.raises(MeshError, match=r"\.stl holds no motion"):
        open_motion(tmp_path / "a.stl")


# ---- following ----


def animated(asset: str | Path, budget: int = 600, **animation: Any) -> Simulation:
    body = {"name": "it", "asset": str(asset), "anchor": "origin", "budget": budget, "animation": animation}
    scene = check_scene({"bodies": [body], "ground": None, "solver": {"kind": "animation"}, "fps": 4})
    return Simulation(scene, load_assets(scene), device="cpu")


def test_an_imported_mesh_keeps_the_order_of_its_motion_through_welding(tmp_path: Path) -> None:
    simulation = animated(bending_tube(tmp_path / "tube.glb"), budget=2000)
    vertices, _, _ = tube()
    asset = simulation.assets["it"]
    assert len(asset.gaussians.vertices) != len(vertices), "the seam is welded, long edges are split"
    bound = simulation.model.bodies[0].gaussians
    assert float(bound.sh.std(dim=0).max()) > 0.5, "the texture is on it"
    for frame in simulation:
        source = z_up(bent(vertices, 80.0 * (1.0 - abs(1.0 - min(frame.time, 2.0)))))
        seen = frame.bodies[0].vertices.astype(np.float64)
        rest = asset.gaussians.vertices.numpy()
        same = np.abs(rest[:, None] - z_up(vertices)[None]).max(2) < 1e-6
        row, column = np.nonzero(same)
        assert len(np.unique(row)) > 150
        assert np.abs(seen[row] - source[column]).max() < 1e-6, frame.time
    assert frame.time == 3.0 and np.allclose(seen, rest, atol=1e-6), "it rests at the end"


def test_points_off_a_surface_keep_their_distance() -> None:
    vertices, faces = sphere(8)
    rng = np.random.default_rng(0)
    points = rng.normal(size=(50, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    inside_out = faces[:, ::-1]
    fit = fit_to_surface(1.05 * points, points, vertices.astype(np.float64), inside_out)
    assert 0.03 < fit.distance.max() < 0.09
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = fit.follower(vertices @ turn.T + [1.0, 2.0, 3.0])
    assert np.allclose(moved, 1.05 * points @ turn.T + [1.0, 2.0, 3.0], atol=1e-5), "rigid motions are kept"


def test_an_asset_made_before_follows_the_motion_of_its_mesh(tmp_path: Path) -> None:
    growing(tmp_path / "ball")
    import_mesh(tmp_path / "ball" / "ball_008.obj", budget=600, tets=False).save(tmp_path / "ball.usdc")
    simulation = animated(tmp_path / "ball.usdc", file=str(tmp_path / "ball"), fps=2)
    last = list(simulation)[2]
    assert last.time == 0.5
    rest = simulation.assets["it"].gaussians
    assert np.allclose(last.bodies[0].vertices, 1.5 * rest.vertices.numpy(), atol=1e-5)
    assert torch.allclose(last.bodies[0].gaussians.means, 1.5 * rest.gaussians().means, atol=1e-5)
    with pytest.raises(
        SceneError, match=r"vertices lie more than 0.0693 m off the mesh of ball, up to 0.5 m"
    ):
        animated(tmp_path / "ball.usdc", file=str(tmp_path / "ball"), scale=0.5, tolerance=0.04)


def test_parts_of_a_motion_loop_and_stand_where_the_scene_puts_them(tmp_path: Path) -> None:
    growing(tmp_path / "ball")
    scene = check_scene(
        {
            "bodies": [
                {"name": "it", "asset": str(tmp_path / "ball"), "budget": 600, "position": [5.0, 0.0, 0.0],
                 "scale": 0.1, "anchor": "origin",
                 "animation": {"fps": 2, "start": 0.5, "end": 1.5, "speed": 2.0, "loop": True}},
                {"name": "still", "asset": str(tmp_path / "ball" / "ball_008.obj"), "budget": 600},
            ],
            "ground": None, "solver": {"kind": "animation"}, "fps": 4, "duration": 2.0,
        }
    )  # fmt: skip
    sizes = []
    for frame in Simulation(scene, load_assets(scene), device="cpu"):
        sizes.append(float(frame.bodies[0].vertices[:, 0].max()) - 5.0)
        assert np.ptp(frame.bodies[1].vertices[:, 2]) == pytest.approx(2.0)
    assert np.allclose(sizes, [0.15, 0.2, 0.25, 0.2, 0.25, 0.2, 0.25, 0.2, 0.25], atol=1e-5)


def test_a_mesh_that_comes_apart_where_it_was_one_is_told(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    vertices, faces = sphere(4)
    two = np.concatenate([vertices, vertices + np.array([2.0, 0.0, 0.0])])
    two[len(vertices) + vertices[:, 0].argmin()] = vertices[vertices[:, 0].argmax()]  # they touch in a vertex
    apart = two.copy()
    apart[len(vertices) :, 0] += 0.3
    np.savez(tmp_path / "m.npz", vertices=[two, apart], faces=np.concatenate([faces, faces + len(vertices)]))
    animated(tmp_path / "m.npz")
    assert "lie in one place at rest come apart by up to 0.3 m" in caplog.text


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"solver": {"kind": "fem"}},
            "belongs to `solver: {kind: animation}`, but the scene's solver is fem",
        ),
        ({"wind": {"velocity": [1, 0, 0]}}, "wind: has no effect without physics"),
        ({"body": {"velocity": [1, 0, 0]}}, r"bodies\[it\].velocity: has no effect"),
        ({"animation": {"start": 9.0}}, "is not within the motion, which lasts from 0 to 2 s"),
        ({"animation": {"start": 1.0, "end": 0.5}}, "end must lie after start 1 s, got 0.5 s"),
        ({"animation": {"file": "none.glb"}}, "none.glb: no such file"),
        ({"animation": {"clip": "hop"}}, "has no animation 'hop'"),
        ({"animation": {"speed": 0}}, "speed"),
    ],
)
def test_wrong_scenes_are_refused(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    path = bending_tube(tmp_path / "tube.glb")
    body = {"name": "it", "asset": str(path), "budget": 300, "animation": change.pop("animation", {})}
    data = {"bodies": [{**body, **change.pop("body", {})}], "ground": None, "solver": {"kind": "animation"}}
    with pytest.raises(RequestError, match=message):
        scene = check_scene({**data, **change})
        Simulation(scene, load_assets(scene), device="cpu")


# ---- recording ----


def test_an_animation_is_recorded_rendered_and_resumed(tmp_path: Path) -> None:
    path = bending_tube(tmp_path / "tube.glb")
    options: dict[str, Any] = {
        "fps": 2,
        "budget": 300,
        "camera": TINY,
        "end": 1.0,
        "loop": 2,
        "device": "cpu",
    }
    first = gdpro_sim.animate(path, tmp_path / "a", **options)
    reader = SimulationReader(first.simulation)
    assert len(reader) == first.frame_count == 5 and first.resumed_frames == 0
    assert first.video.stat().st_size > 0 and first.contact_sheet.stat().st_size > 0
    heights = [float(reader.frame(k).bodies[0].vertices[:, 2].max()) for k in range(5)]
    assert heights[2] < heights[1] < heights[0] and heights[4] == heights[2]
    assert np.array_equal(reader.frame(3).bodies[0].vertices, reader.frame(1).bodies[0].vertices)

    pictures = render_file(first.simulation, tmp_path / "again", device="cpu")
    assert [p.read_bytes() for p in pictures] == [p.read_bytes() for p in sorted(first.frames.iterdir())]

    class Stop(Exception):
        pass

    def stop(phase: str, done: int, total: int) -> None:
        if phase == "simulate" and done == 3:
            raise Stop

    with pytest.raises(Stop):
        gdpro_sim.animate(path, tmp_path / "b", on_progress=stop, **options)
    second = gdpro_sim.animate(path, tmp_path / "b", **options)
    assert second.resumed_frames == 3
    for a, b in zip(sorted(first.frames.iterdir()), sorted(second.frames.iterdir()), strict=True):
        assert a.read_bytes() == b.read_bytes()


def test_any_vertex_source_can_move_an_asset(tmp_path: Path) -> None:
    class Swing:
        rest = z_up(tube()[0])
        faces = tube()[1].astype(np.int32)
        fps, begin, end = 4.0, 2.0, 3.0

        def vertices(self, time: float) -> np.ndarray:
            return self.rest + np.array([0.0, time, 0.0])  # never at rest

    asset = animated(bending_tube(tmp_path / "tube.glb")).assets["it"]
    scene = animation_scene(asset, tmp_path / "out", motion=Swing())
    assert (scene.duration, scene.fps) == (1.0, 4)
    frames = list(Simulation(scene, load_assets(scene), device="cpu"))
    moved = frames[3].bodies[0].vertices - asset.gaussians.vertices.numpy()
    assert np.allclose(moved, [0.0, 2.75, 0.0], atol=1e-6)
    with pytest.raises(RequestError, match="an asset does not move by itself"):
        animation_scene(asset, tmp_path / "out")
    for wrong, message in (
        ({"loop": 0}, "loop must be >= 1"),
        ({"speed": -1.0}, "speed must be"),
        ({"start": 2.5, "end": 9.0}, "which lasts from 2 to 3 s"),
        ({"motion": "none.glb"}, "none.glb: no such file or folder"),
    ):
        with pytest.raises(RequestError, match=message):
            animation_scene(asset, tmp_path / "out", **{"motion": Swing(), **wrong})


def test_the_command_says_what_is_wrong_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    bending_tube(tmp_path / "tube.glb")
    monkeypatch.chdir(tmp_path)
    for arguments, expected in (
        (["none.glb"], "none.glb: no such file"),
        (["tube.glb", "--motion", "none"], "none: no such file"),
        (["tube.glb", "--clip", "hop"], "has no animation 'hop'; it has 'move'"),
        (["tube.glb", "--start", "5"], "5 to 2 s is not within tube.glb, which lasts from 0 to 2 s"),
        (["tube.glb", "--scale", "-1"], "scale must be > 0, got -1.0"),
        (["tube.glb", "--up", "w"], "--up must be one of auto, y, z"),
        (["tube.glb", "--width", "101"], "must be even"),
        (["tube.glb", "--tolerance", "0"], "tolerance"),
    ):
        monkeypatch.setattr(sys, "argv", ["gdpro", "animate", *arguments, "-o", "x"])
        with pytest.raises(SystemExit) as stopped:
            main()
        errors = capsys.readouterr().err.strip().splitlines()
        assert stopped.value.code == 2 and len(errors) == 1 and expected in errors[0], (arguments, errors)
    logging.getLogger().setLevel(logging.WARNING)


def test_assets_of_the_motion_are_saved(tmp_path: Path) -> None:
    asset = animated(bending_tube(tmp_path / "tube.glb")).assets["it"]
    asset.save(tmp_path / "tube.usdc")
    assert Asset.load(tmp_path / "tube.usdc").provenance["options"]["motion"] == ["animation 'move'"]
