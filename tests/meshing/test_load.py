from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.color import SurfaceColors, Texture, linear_to_srgb, srgb_to_linear
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.repair import validate
from gdpro_sim.meshing.surface import DEFAULT_COLOR
from gdpro_sim.meshing.usd_reader import triangulate
from tests.meshing.shapes import (
    cube,
    shared,
    sheet,
    sphere,
    textured_square,
    warp_asset,
    write_obj,
    write_ply,
)


def color_at(mesh, point) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Colour of the surface nearest to a point."""
    from gdpro_sim.meshing.proximity import SurfaceIndex

    face, barycentric = SurfaceIndex(mesh.vertices, mesh.faces).closest(np.asarray([point], np.float64))
    return SurfaceColors(mesh).at(face, barycentric)[0]


def test_obj_is_y_up_and_stl_z_up(tmp_path: Path) -> None:
    import trimesh

    v, f = cube()
    v = v * np.asarray([1.0, 2.0, 3.0], np.float32)
    obj = load_mesh(write_obj(tmp_path / "a.obj", v, f))
    assert np.allclose(np.ptp(obj.vertices, axis=0), [1, 3, 2])
    assert obj.vertices[:, 2].max() == pytest.approx(2.0) and obj.vertices[:, 1].min() == pytest.approx(-3.0)
    trimesh.Trimesh(v, f).export(tmp_path / "a.stl")
    stl = load_mesh(tmp_path / "a.stl")
    assert np.allclose(np.ptp(stl.vertices, axis=0), [1, 2, 3]) and len(stl.vertices) == 8
    assert np.allclose(np.ptp(load_mesh(tmp_path / "a.stl", up="y").vertices, axis=0), [1, 3, 2])
    for mesh in (obj, stl):
        report = validate(mesh.vertices, mesh.faces)
        assert report.watertight and report.volume == pytest.approx(6.0)
        assert len(mesh.sha256) == 64


def test_scale_and_size_warning(tmp_path: Path) -> None:
    v, f = cube()
    path = write_obj(tmp_path / "mm.obj", v * 150, f)
    mesh = load_mesh(path)
    assert any("--scale 0.001" in m for m in mesh.messages) and mesh.diagonal == pytest.approx(150 * 3**0.5)
    scaled = load_mesh(path, scale=0.001)
    assert scaled.diagonal == pytest.approx(0.15 * 3**0.5) and not scaled.messages
    tiny = load_mesh(write_obj(tmp_path / "km.obj", v * 1e-3, f))
    assert any("--scale 1000" in m for m in tiny.messages)


def test_texture_beside_the_file_is_found_and_lies_right(tmp_path: Path) -> None:
    mesh = load_mesh(textured_square(tmp_path), up="z")
    assert any("square.png" in m for m in mesh.messages)
    assert len(mesh.vertices) == 4 and mesh.uv is not None
    for (x, y), rgb in {(0.2, 0.8): (1, 0, 0), (0.8, 0.8): (0, 1, 0), (0.2, 0.2): (0, 0, 1)}.items():
        assert np.array_equal(color_at(mesh, (x, y, 0.0)), [*rgb, 1])


def test_texture_and_color_options(tmp_path: Path) -> None:
    from PIL import Image

    path = textured_square(tmp_path)
    Image.new("RGB", (4, 4), (10, 20, 30)).save(tmp_path / "other.png")
    mesh = load_mesh(path, texture=tmp_path / "other.png")
    assert np.allclose(color_at(mesh, (0.5, 0.0, 0.5))[:3] * 255, [10, 20, 30], atol=1e-3)
    red = load_mesh(path, color="#ff0080")
    assert red.uv is None and np.allclose(color_at(red, (0, 0, 0)), [1, 0, 128 / 255, 1], atol=1e-6)
    assert load_mesh(path, color="tomato").materials[0].base_color[0] == 1.0
    with pytest.raises(MeshError, match="CSS name"):
        load_mesh(path, color="tomatoish")
    with pytest.raises(MeshError, match="both"):
        load_mesh(path, color="red", texture="x.png")
    with pytest.raises(MeshError, match="does not exist"):
        load_mesh(path, texture=tmp_path / "no.png")
    plain = write_obj(tmp_path / "plain.obj", *cube())
    with pytest.raises(MeshError, match="no UV"):
        load_mesh(plain, texture=tmp_path / "other.png")
    (tmp_path / "broken.png").write_bytes(b"no image")
    with pytest.raises(MeshError, match="cannot be read"):
        load_mesh(path, texture=tmp_path / "broken.png")


def test_uncoloured_mesh_gets_the_default(tmp_path: Path) -> None:
    mesh = load_mesh(write_obj(tmp_path / "a.obj", *cube()))
    assert np.allclose(color_at(mesh, (0, 0, 0))[:3], DEFAULT_COLOR)


def test_obj_materials_and_what_is_missing(tmp_path: Path) -> None:
    v, f = cube()
    (tmp_path / "m.mtl").write_text("newmtl a\nKd 1 0 0\nnewmtl b\nKd 0 0 1\nmap_Kd gone.png\n")
    rows = [f"v {x} {y} {z}" for x, y, z in v] + ["usemtl a"]
    rows += [f"f {a} {b} {c}" for a, b, c in f[:6] + 1] + ["usemtl b"]
    rows += [f"f {a} {b} {c}" for a, b, c in f[6:] + 1]
    (tmp_path / "m.obj").write_text("mtllib m.mtl\n" + "\n".join(rows))
    mesh = load_mesh(tmp_path / "m.obj", up="z")
    colors = SurfaceColors(mesh).at(np.arange(12), np.full((12, 3), 1 / 3))
    assert {tuple(c) for c in colors[:, :3].tolist()} == {(1.0, 0.0, 0.0), (0.0, 0.0, 1.0)}
    assert any("gone.png" in m for m in mesh.messages) and validate(mesh.vertices, mesh.faces).watertight
    write_obj(tmp_path / "n.obj", v, f, head="mtllib absent.mtl")
    assert any("absent.mtl" in m for m in load_mesh(tmp_path / "n.obj").messages)


def test_vertex_and_face_colours(tmp_path: Path) -> None:
    import trimesh

    v, f = cube()
    colors = np.zeros((8, 4), np.uint8)
    colors[:, 3] = 255
    colors[v[:, 2] > 0.5, 0] = 200
    trimesh.Trimesh(v, f, vertex_colors=colors, process=False).export(tmp_path / "v.ply")
    mesh = load_mesh(tmp_path / "v.ply")
    assert color_at(mesh, (0.3, 0.4, 1.0))[0] == pytest.approx(200 / 255, abs=1e-6)
    assert color_at(mesh, (0.3, 0.0, 0.5))[0] == pytest.approx(100 / 255, abs=1e-6)


def test_gltf_scene_is_flattened_and_base_colour_encoded(tmp_path: Path) -> None:
    import trimesh

    v, f = cube()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=[128, 0, 0, 255])
    mesh = trimesh.Trimesh(v, f, visual=trimesh.visual.TextureVisuals(material=material), process=False)
    scene = trimesh.Scene()
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix([3, 0, 0]))
    scene.add_geometry(mesh, node_name="mirrored", transform=mirror)
    scene.export(tmp_path / "s.glb")
    out = load_mesh(tmp_path / "s.glb")
    report = validate(out.vertices, out.faces)
    assert report.watertight and report.components == 2 and report.volume == pytest.approx(2.0)
    assert out.vertices[:, 0].min() == pytest.approx(-1.0) and out.vertices[:, 0].max() == pytest.approx(4.0)
    assert np.ptp(out.vertices[:, 2]) == pytest.approx(1.0)
    assert color_at(out, (3.5, 0, 0))[0] == pytest.approx(
        float(linear_to_srgb(np.asarray(128 / 255))), abs=2e-3
    )


def test_collada_axis_and_unit(tmp_path: Path) -> None:
    import trimesh

    v, f = cube()
    trimesh.Trimesh(v * [10, 20, 30], f).export(tmp_path / "a.dae")
    text = (tmp_path / "a.dae").read_text()
    text = text.replace("<up_axis>Y_UP</up_axis>", "<up_axis>Z_UP</up_axis>")
    text = text.replace("<asset>", '<asset><unit name="cm" meter="0.01"/>', 1)
    (tmp_path / "a.dae").write_text(text)
    assert np.allclose(np.ptp(load_mesh(tmp_path / "a.dae").vertices, axis=0), [0.1, 0.2, 0.3], atol=1e-5)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda p: p / "none.obj", "does not exist"),
        (lambda p: p, "directory"),
        (lambda p: _file(p / "a.xyzzy", b"x"), "not supported.*obj"),
        (lambda p: _file(p / "noext", b"x"), "without an extension"),
        (lambda p: _file(p / "a.obj", b""), "empty"),
        (lambda p: _file(p / "a.obj", b"hello world\n"), "no triangles|cannot be read"),
        (lambda p: _file(p / "a.glb", b"garbage" * 20), "cannot be read"),
        (lambda p: _file(p / "a.stl", b"garbage" * 20), "cannot be read|no triangles"),
        (lambda p: _file(p / "a.usd", b"garbage" * 20), "USD"),
        (lambda p: _file(p / "a.usda", b"#usda 1.0\n"), "no visible Mesh"),
        (lambda p: _file(p / "a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"), "no faces"),
        (
            lambda p: _file(p / "a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n"),
            "missing vertices|cannot be read",
        ),
        (lambda p: _file(p / "a.obj", b"v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n"), "zero area"),
        (lambda p: write_ply(p / "a.ply", np.full((3, 3), np.nan), np.asarray([[0, 1, 2]])), "NaN"),
        (
            lambda p: write_ply(p / "a.ply", np.eye(3), np.asarray([[0, 1, 7]])),
            "missing vertices|cannot be read",
        ),
        (
            lambda p: _file(p / "a.ply", b"ply\nformat ascii 1.0\nelement face 10000000\nend_header\n"),
            "limit",
        ),
    ],
)
def test_bad_files_are_refused_in_one_line(tmp_path: Path, make, words: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(MeshError, match=words) as caught:
        load_mesh(make(tmp_path))
    assert caught.value.exit_code == 2 and "\n" not in str(caught.value)


def _file(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


def test_a_huge_stl_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "huge.stl"
    count = 12_000_000
    with path.open("wb") as file:
        file.write(b"\0" * 80 + struct.pack("<I", count))
        file.truncate(84 + 50 * count)  # sparse: takes no disk
    with pytest.raises(MeshError, match="12,000,000 faces is above the limit of 3,000,000; decimate"):
        load_mesh(path)


def test_a_huge_text_file_is_refused_before_reading(tmp_path: Path) -> None:
    path = tmp_path / "huge.obj"
    with path.open("wb") as file:
        file.write(b"v 0 0 0\n")
        file.truncate(700_000_000)
    with pytest.raises(MeshError, match="700 MB is above the limit"):
        load_mesh(path)


def test_bad_options_are_refused(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj", *cube())
    with pytest.raises(MeshError, match="up axis"):
        load_mesh(path, up="w")
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(MeshError, match="scale must be"):
            load_mesh(path, scale=scale)


def test_few_broken_faces_are_dropped_with_a_message(tmp_path: Path) -> None:
    v, f = sphere(3)
    bad = np.concatenate([v, [[np.nan] * 3]]).astype(np.float32)
    extra = np.asarray([[0, 1, len(v)], [0, 0, 1], f[5][[1, 2, 0]]])
    mesh = load_mesh(write_ply(tmp_path / "a.ply", bad, np.concatenate([f, extra])))
    text = " ".join(mesh.messages)
    assert "1 faces with NaN" in text and "zero area" in text and "1 duplicate" in text
    assert validate(mesh.vertices, mesh.faces).watertight and len(mesh.faces) == len(f)


def test_inverted_file_is_turned_outward_with_its_uv(tmp_path: Path) -> None:
    v, f = cube()
    mesh = load_mesh(write_obj(tmp_path / "a.obj", v, f[:, ::-1]))
    assert validate(mesh.vertices, mesh.faces).volume == pytest.approx(1.0)
    assert any("inward" in m for m in mesh.messages)


def usd_stage(path: Path, body: str, axis: str = "Y", unit: float = 1.0) -> Path:
    path.write_text(f'#usda 1.0\n(\n upAxis = "{axis}"\n metersPerUnit = {unit}\n)\n{body}\n')
    return path


QUAD_CUBE = """
 int[] faceVertexCounts = [4, 4, 4, 4, 4, 4]
 int[] faceVertexIndices = [0, 1, 3, 2, 4, 6, 7, 5, 0, 4, 5, 1, 2, 3, 7, 6, 0, 2, 6, 4, 1, 5, 7, 3]
 point3f[] points = [(0,0,0),(0,0,1),(0,1,0),(0,1,1),(1,0,0),(1,0,1),(1,1,0),(1,1,1)]
 uniform token subdivisionScheme = "none"
"""


def test_usd_transforms_axes_units_and_handedness(tmp_path: Path) -> None:
    body = (
        'def Xform "a" { double3 xformOp:translate = (100, 0, 0)\n double3 xformOp:scale = (2, 3, -4)\n'
        ' uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n'
        f' def Mesh "m" {{ {QUAD_CUBE} }}\n'
        f' def Mesh "hidden" {{ {QUAD_CUBE} token visibility = "invisible"\n }}\n'
        f' def Mesh "guide" {{ {QUAD_CUBE} uniform token purpose = "guide"\n }}\n}}'
    )
    mesh = load_mesh(usd_stage(tmp_path / "a.usda", body, "Y", 0.01))
    assert np.allclose(mesh.vertices.min(0), [1.0, 0.0, 0.0], atol=1e-6)
    assert np.allclose(mesh.vertices.max(0), [1.02, 0.04, 0.03], atol=1e-6)
    report = validate(mesh.vertices, mesh.faces)
    assert report.watertight and report.faces == 12 and report.volume == pytest.approx(24e-6, rel=1e-4)
    assert not any("inward" in m for m in mesh.messages)  # the mirrored transform was turned on reading
    assert any("invisible" in m for m in mesh.messages) and any("guide" in m for m in mesh.messages)
    left = QUAD_CUBE + ' uniform token orientation = "leftHanded"\n'
    turned = load_mesh(usd_stage(tmp_path / "b.usda", f'def Mesh "m" {{ {left}\n}}', "Z"))
    assert any("inward" in m for m in turned.messages)  # the data says right-handed, the file says left


@pytest.mark.parametrize("how", ["constant", "uniform", "vertex", "faceVarying"])
def test_usd_display_color(tmp_path: Path, how: str) -> None:
    count = {"constant": 1, "uniform": 6, "vertex": 8, "faceVarying": 24}[how]
    values = ", ".join(["(0.5, 0, 1)"] * count)
    color = f'color3f[] primvars:displayColor = [{values}] (interpolation = "{how}")'
    body = f'def Mesh "m" {{ {QUAD_CUBE} {color}\n}}'
    mesh = load_mesh(usd_stage(tmp_path / "a.usda", body))
    expected = linear_to_srgb(np.asarray([0.5, 0.0, 1.0]))
    assert np.allclose(color_at(mesh, (0.5, -0.5, 1.0))[:3], expected, atol=0.003)


def test_usd_uniform_color_follows_its_face(tmp_path: Path) -> None:
    values = "(1,0,0), (0,1,0), (0,0,1), (1,1,0), (0,1,1), (1,0,1)"
    color = f'color3f[] primvars:displayColor = [{values}] (interpolation = "uniform")'
    body = f'def Mesh "m" {{ {QUAD_CUBE} {color}\n}}'
    mesh = load_mesh(usd_stage(tmp_path / "a.usda", body, "Z"))
    assert np.array_equal(color_at(mesh, (0.0, 0.5, 0.5))[:3], [1, 0, 0])
    assert np.array_equal(color_at(mesh, (1.0, 0.5, 0.5))[:3], [0, 1, 0])


def test_usd_preview_texture(tmp_path: Path) -> None:
    textured_square(tmp_path)
    body = """
def Material "mat" { token outputs:surface.connect = </mat/s.outputs:surface>
 def Shader "s" { uniform token info:id = "UsdPreviewSurface"
  color3f inputs:diffuseColor.connect = </mat/t.outputs:rgb>
  token outputs:surface
 }
 def Shader "t" { uniform token info:id = "UsdUVTexture"
  asset inputs:file = @./square.png@
  float3 outputs:rgb
 }
}
def Mesh "m" ( prepend apiSchemas = ["MaterialBindingAPI"] ) {
 rel material:binding = </mat>
 int[] faceVertexCounts = [4]
 int[] faceVertexIndices = [0, 1, 2, 3]
 point3f[] points = [(0,0,0),(1,0,0),(1,1,0),(0,1,0)]
 texCoord2f[] primvars:st = [(0,0),(1,0),(1,1),(0,1)] (interpolation = "faceVarying")
 uniform token subdivisionScheme = "none"
}
"""
    mesh = load_mesh(usd_stage(tmp_path / "a.usda", body, "Z"))
    assert np.array_equal(color_at(mesh, (0.2, 0.8, 0.0))[:3], [1, 0, 0])
    from pxr import UsdUtils

    assert UsdUtils.CreateNewUsdzPackage(str(tmp_path / "a.usda"), str(tmp_path / "a.usdz"))
    packed = load_mesh(tmp_path / "a.usdz")
    assert np.array_equal(color_at(packed, (0.2, 0.8, 0.0))[:3], [1, 0, 0])
    (tmp_path / "square.png").unlink()
    assert any("square.png" in m for m in load_mesh(tmp_path / "a.usda").messages)


def test_usd_bad_indices_are_refused(tmp_path: Path) -> None:
    body = (
        'def Mesh "m" { int[] faceVertexCounts = [3]\n int[] faceVertexIndices = [0, 1, 9]\n'
        " point3f[] points = [(0,0,0),(1,0,0),(1,1,0)]\n}"
    )
    with pytest.raises(MeshError, match=r"hold 9, outside 0\.\.2"):
        load_mesh(usd_stage(tmp_path / "a.usda", body))


def test_polygons_triangulate_to_their_area() -> None:
    # A concave quad, an L of six corners, a triangle, and a two-corner polygon that vanishes.
    dart = [(0, 0), (2, 0), (0.5, 0.5), (0, 2)]
    ell = [(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)]
    flat = np.asarray([*dart, *ell, (0, 0), (1, 0), (0, 1), (0, 0), (1, 1)], float)
    points = np.concatenate([flat, np.zeros((len(flat), 1))], 1)
    local, polygon = triangulate(points, np.asarray([4, 6, 3, 2]), np.arange(len(points)))
    p = flat[local]
    doubled = np.cross(
        np.concatenate([p[:, 1] - p[:, 0], np.zeros((len(p), 1))], 1),
        np.concatenate([p[:, 2] - p[:, 0], np.zeros((len(p), 1))], 1),
    )[:, 2]
    assert (doubled > 0).all()
    assert np.allclose(np.bincount(polygon, weights=doubled / 2), [1.0, 3.0, 0.5])


def test_texture_filtering() -> None:
    image = np.zeros((8, 8, 4), np.uint8)
    image[::2, ::2] = image[1::2, 1::2] = 255
    texture = Texture(image)
    exact = texture.sample(np.asarray([[0.5 / 8, 1 - 0.5 / 8], [1.5 / 8, 1 - 0.5 / 8]]))
    assert exact[:, 0].tolist() == [1.0, 0.0]
    blurred = texture.sample(np.random.default_rng(0).random((50, 2)), np.full(50, 16.0))
    assert np.allclose(blurred, 0.5, atol=0.01)
    wrapped = texture.sample(np.asarray([[3.0 + 0.5 / 8, -2.0 + 1 - 0.5 / 8]]))
    assert wrapped[0, 0] == 1.0


def test_srgb_round_trip() -> None:
    x = np.linspace(0, 1, 257)
    assert np.allclose(linear_to_srgb(srgb_to_linear(x)), x, atol=1e-6)
    assert linear_to_srgb(np.asarray(0.214))[()] == pytest.approx(0.5, abs=1e-3)


def test_spot_is_closed_and_textured() -> None:
    mesh = load_mesh(shared("spot.obj"))
    report = validate(mesh.vertices, mesh.faces)
    assert report.watertight and report.faces == 5856 and len(mesh.vertices) == 2930
    assert mesh.materials[0].texture is not None and any("spot.png" in m for m in mesh.messages)
    colors = SurfaceColors(mesh).at(np.arange(5856), np.full((5856, 3), 1 / 3))
    assert np.ptp(colors[:, 0]) > 0.5
    assert np.ptp(mesh.vertices[:, 2]) > 1.6  # it stands


def test_bunny_stands_upright() -> None:
    mesh = load_mesh(warp_asset("bunny.usd"))
    assert validate(mesh.vertices, mesh.faces).watertight
    assert mesh.vertices[:, 2].min() == pytest.approx(0.021, abs=1e-3)


def test_open_mesh_says_so(tmp_path: Path) -> None:
    mesh = load_mesh(write_obj(tmp_path / "a.obj", *sheet(3)))
    assert any("12 open" in m for m in mesh.messages)


def test_gltf_with_missing_buffer_is_one_clear_error(tmp_path: Path) -> None:
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"uri": "gone.bin", "byteLength": 4}],
        "scenes": [{}],
    }
    (tmp_path / "a.gltf").write_text(json.dumps(document))
    with pytest.raises(MeshError):
        load_mesh(tmp_path / "a.gltf")
