"""Mesh files read through trimesh: OBJ, glTF, PLY, STL, OFF, COLLADA, 3MF."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.color import linear_to_srgb
from gdpro_sim.meshing.obj_file import read_obj
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.rawmesh import MAX_FACES, WHITE, RawMesh, RawPart, image_array, too_many_faces
from gdpro_sim.meshing.surface import DEFAULT_COLOR, MeshMaterial

UP_AXIS = {".stl": "z", ".ply": "z", ".off": "z", ".3mf": "z"}
"""Vertical axis by file extension; the rest (OBJ, glTF, ...) is Y up."""

HEAD_BYTES = 65536


def read_trimesh(path: Path) -> RawMesh:
    """Read a file with trimesh. Raises `MeshError` when trimesh cannot, or finds no triangles."""
    import trimesh

    kind = path.suffix.lower()
    raw = RawMesh(up=UP_AXIS.get(kind, "y"))
    try:
        scene = trimesh.load_scene(str(path), process=False)
    except (KeyboardInterrupt, MemoryError):
        raise
    except BaseException as error:  # trimesh raises whatever its parsers raise
        reason = " ".join(str(error).split()) or type(error).__name__
        raise MeshError(
            f"{path}: cannot be read as {kind[1:].upper()} ({reason[:200]}); "
            f"the file is damaged or not {kind}"
        ) from error
    clouds = 0
    nodes = [(node, scene.graph[node]) for node in sorted(scene.graph.nodes_geometry)]
    total = sum(len(getattr(scene.geometry[name], "faces", ())) for _, (_, name) in nodes)
    if total > MAX_FACES:
        raise too_many_faces(path, total)
    for _, (transform, name) in nodes:
        geometry = scene.geometry[name]
        if isinstance(geometry, trimesh.Trimesh) and len(geometry.faces):
            raw.parts.append(
                _part(geometry, np.asarray(transform, np.float64), kind, str(name), raw.messages)
            )
        elif len(getattr(geometry, "vertices", ())):
            clouds += 1
    if not raw.parts:
        if clouds:
            raise MeshError(
                f"{path}: holds points or lines but no faces; reconstruct a triangle mesh from them first "
                "(MeshLab: screened Poisson)"
            )
        raise MeshError(f"{path}: holds no triangles; export a triangle mesh")
    if kind in (".dae", ".zae"):
        _collada_axes(path, raw)
    elif kind == ".3mf":
        _declared_unit(scene, raw)
    elif kind == ".obj":
        _missing_obj_files(path, raw.messages)
        _obj_groups(path, raw.parts)
    return raw


def _part(mesh: Any, transform: np.ndarray, kind: str, name: str, messages: list[str]) -> RawPart:
    vertices = np.asarray(mesh.vertices, np.float64)
    faces = np.asarray(mesh.faces, np.int64)
    inside = np.all((faces >= 0) & (faces < len(vertices)), axis=1)
    if not inside.all():
        bad = int((~inside).sum())
        if bad > 0.01 * len(faces):
            raise MeshError(
                f"mesh {name!r}: {bad} of {len(faces)} faces point at missing vertices; re-export it"
            )
        messages.append(f"mesh {name!r}: dropped {bad} faces that point at missing vertices")
    uv, colors, ids, materials = corner_looks(mesh, faces[inside], inside, kind)
    faces = faces[inside]
    if not np.allclose(transform, np.eye(4), rtol=0.0, atol=0.0):
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
        if np.linalg.det(transform[:3, :3]) < 0.0:
            order = [0, 2, 1]
            faces = faces[:, order]
            uv = uv[:, order] if uv is not None else None
            colors = colors[:, order] if colors is not None else None
    return RawPart(vertices, faces, ids, materials, uv, colors)


def corner_looks(
    mesh: Any, faces: np.ndarray, kept: np.ndarray, kind: str
) -> tuple[np.ndarray | None, np.ndarray | None, np.ndarray, list[MeshMaterial]]:
    """Per-corner UV and colours, material of each face, materials."""
    visual = mesh.visual
    ids = np.zeros(len(faces), np.int32)
    plain = [MeshMaterial()]
    if getattr(visual, "kind", None) == "texture":
        corner_uv = getattr(visual, "uv", None)
        uv = None
        if corner_uv is not None and len(corner_uv) == len(mesh.vertices):
            uv = np.asarray(corner_uv, np.float32)[:, :2][faces]
        material = visual.material
        several = getattr(material, "materials", None)
        if several:
            which = getattr(visual, "face_materials", None)
            if which is not None and len(which) == len(kept):
                ids = np.clip(np.asarray(which, np.int32)[kept], 0, len(several) - 1)
            return uv, None, ids, [_material(m, kind, uv is not None) for m in several]
        return uv, None, ids, [_material(material, kind, uv is not None)]
    if getattr(visual, "kind", None) == "vertex" and len(visual.vertex_colors) == len(mesh.vertices):
        colors = np.asarray(visual.vertex_colors, np.uint8)[faces]
    elif getattr(visual, "kind", None) == "face" and len(visual.face_colors) == len(kept):
        colors = np.repeat(np.asarray(visual.face_colors, np.uint8)[kept][:, None], 3, axis=1)
    else:
        return None, None, ids, plain
    if kind in (".gltf", ".glb"):  # COLOR_0 is linear light by the glTF specification
        table = np.round(linear_to_srgb(np.arange(256) / 255.0) * 255.0).astype(np.uint8)
        colors = np.concatenate([table[colors[..., :3]], colors[..., 3:]], axis=2)
    return None, np.ascontiguousarray(colors), ids, [MeshMaterial("vertex colours", WHITE)]


def _material(material: Any, kind: str, has_uv: bool) -> MeshMaterial:
    if material is None:
        return MeshMaterial()
    name = str(material.name or "material")
    if hasattr(material, "baseColorFactor"):  # PBR
        image = material.baseColorTexture
        factor = material.baseColorFactor
        base = np.ones(4)
        if factor is not None:
            factor = np.asarray(factor)
            scale = 255.0 if np.issubdtype(factor.dtype, np.integer) else 1.0
            base[: factor.size] = factor.ravel()[:4] / scale
        elif image is None and kind not in (".gltf", ".glb"):
            return MeshMaterial(name)
        if kind in (".gltf", ".glb"):
            base[:3] = linear_to_srgb(base[:3])
        mode = str(getattr(material, "alphaMode", None) or "OPAQUE")
        if mode == "OPAQUE":
            base[3] = 1.0
        texture = image_array(image) if image is not None and has_uv else None
        return MeshMaterial(name, _rgba(base), texture, mode != "OPAQUE")
    image = getattr(material, "image", None)
    if image is not None and image.size == (2, 2) and not hasattr(material, "_name"):
        image = None  # trimesh's stand-in for "no material"
    if image is not None and has_uv:
        return MeshMaterial(name, WHITE, image_array(image))
    stated = {str(key).lower() for key in (getattr(material, "kwargs", None) or {})}
    if "kd" not in stated and not hasattr(material, "_name"):
        return MeshMaterial(name, (*DEFAULT_COLOR, 1.0))
    base = np.asarray(material.diffuse, np.float64) / 255.0
    base[3] = 1.0
    return MeshMaterial(name, _rgba(base))


def _rgba(value: np.ndarray) -> tuple[float, float, float, float]:
    r, g, b, a = (float(x) for x in np.clip(value, 0.0, 1.0))
    return r, g, b, a


def _collada_axes(path: Path, raw: RawMesh) -> None:
    """COLLADA states its axis and unit in <asset>; trimesh applies neither."""
    if path.suffix.lower() == ".dae":
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES).decode("utf-8", "replace")
        axis = re.search(r"<up_axis>\s*([XYZ])_UP", head)
        unit = re.search(r"<unit\b[^>]*\bmeter\s*=\s*[\"']([0-9.eE+-]+)[\"']", head)
        if axis:
            raw.up = axis.group(1).lower()
        if unit:
            raw.unit = float(unit.group(1))


def _declared_unit(scene: Any, raw: RawMesh) -> None:
    from trimesh.units import unit_conversion

    units = scene.units or next((g.units for g in scene.geometry.values() if getattr(g, "units", None)), None)
    if units:
        try:
            raw.unit = float(unit_conversion(str(units), "meters"))
        except Exception:  # an unknown name
            raw.messages.append(f"unit {units!r} is unknown and was read as metres")


def _obj_groups(path: Path, parts: list[RawPart]) -> None:
    """Tell parts which of their faces are in which of the file's groups, by where they are."""
    data = path.read_bytes()
    if not data.startswith((b"g ", b"o ")) and b"\ng " not in data and b"\no " not in data:
        return
    found = read_obj(path)
    triangles, polygons = found.triangles()
    inside = ((triangles >= 0) & (triangles < len(found.points))).all(axis=1)
    triangles, polygons = triangles[inside], polygons[inside]
    groups = {name: np.isin(polygons, ids) for name, ids in found.groups.items()}
    groups = {name: own for name, own in groups.items() if not own.all()}
    if not groups:
        return
    index = SurfaceIndex(found.points, triangles)
    for part in parts:
        nearest, _ = index.closest(part.vertices[part.faces].mean(axis=1))
        part.groups = {name: own[nearest] for name, own in groups.items()}


def _missing_obj_files(path: Path, messages: list[str]) -> None:
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES).decode("utf-8", "replace")
    for name in re.findall(r"^mtllib\s+(.+?)\s*$", head, flags=re.MULTILINE):
        library = path.parent / name
        if not library.is_file():
            messages.append(f"material library {name!r} is missing beside {path.name}; its colours are lost")
            continue
        for image in re.findall(
            r"^\s*map_Kd\s+(.+?)\s*$", library.read_text("utf-8", "replace"), flags=re.M | re.I
        ):
            if not (path.parent / image).is_file():
                messages.append(
                    f"texture {image!r} named in {name} is missing; its material's plain colour is used"
                )


__all__ = ["corner_looks", "read_trimesh"]
