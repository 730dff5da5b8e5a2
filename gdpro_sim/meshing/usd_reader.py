"""Triangle meshes out of USD stages: transforms, axes, units, polygons, displayColor and simple preview
surfaces."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.color import linear_to_srgb
from gdpro_sim.meshing.rawmesh import MAX_FACES, WHITE, RawMesh, RawPart, read_image, too_many_faces
from gdpro_sim.meshing.surface import MeshMaterial

UV_NAMES = ("st", "UVMap", "st0", "map1", "uv")


def read_usd(path: Path) -> RawMesh:
    """Read every visible render mesh of a stage at its first time code.

    Transforms are composed, left-handed meshes and mirrored transforms turned, polygons triangulated. Points
    keep the stage's axes and units; `RawMesh.up` and `.unit` say which. Raises `MeshError` when the stage
    cannot be opened or holds no mesh.
    """
    return read_stage(open_stage(path), path)[0]


def open_stage(path: Path) -> Any:
    """A USD stage. Raises `MeshError` when it cannot be opened."""
    from pxr import Tf, Usd

    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        said = re.findall(r" : '(.*?)'\s*$", str(error), flags=re.MULTILINE | re.DOTALL)
        reason = " ".join((said[0] if said else str(error)).split())[:200]
        raise MeshError(f"{path}: cannot be opened as USD ({reason}); check it with usdchecker") from error
    if stage is None:
        raise MeshError(f"{path}: cannot be opened as USD; check it with usdchecker")
    return stage


def read_stage(stage: Any, path: Path) -> tuple[RawMesh, list[Any]]:
    """As `read_usd`, of an open stage: its parts, and the mesh prim that each is of."""
    from pxr import Usd, UsdGeom

    time = Usd.TimeCode.EarliestTime()
    raw = RawMesh(
        up=str(UsdGeom.GetStageUpAxis(stage)).lower(), unit=float(UsdGeom.GetStageMetersPerUnit(stage) or 1.0)
    )
    xforms = UsdGeom.XformCache(time)
    skipped = {"invisible": 0, "guide or proxy": 0}
    other: set[str] = set()
    prims = []
    faces = 0
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies()):
        if not prim.IsA(UsdGeom.Mesh):
            if prim.IsA(UsdGeom.Gprim):
                other.add(str(prim.GetTypeName()))
            continue
        image = UsdGeom.Imageable(prim)
        if image.ComputeVisibility(time) == UsdGeom.Tokens.invisible:
            skipped["invisible"] += 1
            continue
        if image.ComputePurpose() in (UsdGeom.Tokens.guide, UsdGeom.Tokens.proxy):
            skipped["guide or proxy"] += 1
            continue
        matrix = np.array(xforms.GetLocalToWorldTransform(prim), np.float64)
        part = _part(UsdGeom.Mesh(prim), matrix, time, raw.messages)
        if part is not None:
            faces += len(part.faces)
            if faces > MAX_FACES:
                raise too_many_faces(path, faces)
            raw.parts.append(part)
            prims.append(prim)
    for reason, count in skipped.items():
        if count:
            raw.messages.append(f"skipped {count} {reason} mesh prim(s)")
    if other and raw.parts:
        raw.messages.append(f"skipped prims that are no meshes: {', '.join(sorted(other))}")
    if not raw.parts:
        found = f"; it has {', '.join(sorted(other))}, convert them to meshes first" if other else ""
        raise MeshError(f"{path}: the stage holds no visible Mesh prim with faces{found}")
    return raw, prims


def _part(mesh: Any, matrix: np.ndarray, time: Any, messages: list[str]) -> RawPart | None:
    from pxr import UsdGeom

    prim = mesh.GetPrim()
    name = str(prim.GetPath())
    points, counts, indices = (
        attribute.Get(time)
        for attribute in (
            mesh.GetPointsAttr(),
            mesh.GetFaceVertexCountsAttr(),
            mesh.GetFaceVertexIndicesAttr(),
        )
    )
    if not points or not counts or not indices:
        return None
    vertices = np.asarray(points, np.float64)
    sizes, corners = np.asarray(counts, np.int64), np.asarray(indices, np.int64)
    if sizes.min() < 0 or sizes.sum() != len(corners):
        raise MeshError(
            f"{name}: faceVertexCounts add up to {sizes.sum()}, but there are {len(corners)} indices"
        )
    if corners.min() < 0 or corners.max() >= len(vertices):
        bad = corners.min() if corners.min() < 0 else corners.max()
        raise MeshError(f"{name}: faceVertexIndices hold {bad}, outside 0..{len(vertices) - 1}")
    vertices = vertices @ matrix[:3, :3] + matrix[3, :3]
    holes = mesh.GetHoleIndicesAttr().Get(time)
    local, polygon = triangulate(vertices, sizes, corners)
    if holes:
        kept = ~np.isin(polygon, np.asarray(holes))
        local, polygon = local[kept], polygon[kept]
    if not len(local):
        return None
    left = mesh.GetOrientationAttr().Get(time) == UsdGeom.Tokens.leftHanded
    if left != (np.linalg.det(matrix[:3, :3]) < 0.0):
        local = local[:, [0, 2, 1]]
    if mesh.GetSubdivisionSchemeAttr().Get(time) != UsdGeom.Tokens.none:
        messages.append(f"{name} is a subdivision surface; its control cage is used as it is")
    materials, ids = _materials(prim, polygon, messages)
    uv = _uv(prim, time, materials, local, polygon, corners)
    if uv is None:
        materials = [m if m.texture is None else MeshMaterial(m.name) for m in materials]
    colors = None
    if all(m.name == "" for m in materials):
        colors = _display_color(prim, time, local, polygon, corners, len(vertices))
        materials = [MeshMaterial("displayColor", WHITE) if colors is not None else MeshMaterial()]
    return RawPart(vertices, corners[local], ids, materials, uv, colors, _groups(prim, polygon))


def triangulate(
    vertices: np.ndarray, sizes: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Triangles as positions in `corners` [T, 3], and the polygon each came from [T]; in polygon order.

    Quads split along the diagonal that keeps both halves facing the same way, larger polygons by ear
    clipping. Polygons of fewer than three corners are dropped.
    """
    start = np.cumsum(sizes) - sizes
    parts, polygons = [], []
    triangles = np.flatnonzero(sizes == 3)
    parts.append(start[triangles, None] + np.arange(3))
    polygons.append(triangles)
    quads = np.flatnonzero(sizes == 4)
    if len(quads):
        p = vertices[corners[start[quads, None] + np.arange(4)]]
        n1 = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
        n2 = np.cross(p[:, 2] - p[:, 0], p[:, 3] - p[:, 0])
        other = np.einsum("qc,qc->q", n1, n2) < 0.0
        first = np.where(other[:, None], [0, 1, 3], [0, 1, 2])
        second = np.where(other[:, None], [1, 2, 3], [0, 2, 3])
        parts += [start[quads, None] + first, start[quads, None] + second]
        polygons += [quads, quads]
    for polygon in np.flatnonzero(sizes > 4):
        ears = _clip_ears(vertices[corners[start[polygon] : start[polygon] + sizes[polygon]]])
        parts.append(start[polygon] + ears)
        polygons.append(np.full(len(ears), polygon))
    local, owner = np.concatenate(parts), np.concatenate(polygons)
    order = np.argsort(owner, kind="stable")
    return local[order], owner[order]


def _clip_ears(points: np.ndarray) -> np.ndarray:
    """Ear clipping of one simple polygon [n, 3] projected along its normal; falls back to a fan. [n - 2,
    3]."""
    following = np.roll(points, -1, axis=0)
    normal = np.cross(points - points[0], following - points[0]).sum(0)
    axis = int(np.argmax(np.abs(normal)))
    keep = [(axis + 1) % 3, (axis + 2) % 3]
    flat = points[:, keep] * np.array([1.0, 1.0 if normal[axis] >= 0.0 else -1.0])

    def cross(a: int, b: int, c: int) -> float:
        u, w = flat[b] - flat[a], flat[c] - flat[a]
        return float(u[0] * w[1] - u[1] * w[0])

    left = list(range(len(points)))
    out = []
    while len(left) > 3:
        for i in range(len(left)):
            a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
            if cross(a, b, c) <= 0.0:
                continue
            if all(
                min(cross(a, b, p), cross(b, c, p), cross(c, a, p)) < 0.0 for p in left if p not in (a, b, c)
            ):
                out.append((a, b, c))
                left.pop(i)
                break
        else:
            break
    out += [(left[0], left[i], left[i + 1]) for i in range(1, len(left) - 1)]
    return np.asarray(out, np.int64)


def _corner_values(
    primvar: Any, time: Any, local: np.ndarray, polygon: np.ndarray, corners: np.ndarray
) -> np.ndarray | None:
    """A primvar at every triangle corner [T, 3, C], whatever its interpolation; None where sizes do not
    fit."""
    from pxr import UsdGeom

    values = primvar.ComputeFlattened(time)
    if not values:
        return None
    array = np.asarray(values, np.float64)
    how = primvar.GetInterpolation()
    if how == UsdGeom.Tokens.constant:
        index = np.zeros_like(local)
    elif how == UsdGeom.Tokens.uniform:
        index = np.repeat(polygon[:, None], 3, axis=1)
    elif how == UsdGeom.Tokens.faceVarying:
        index = local
    else:
        index = corners[local]
    return array[index] if index.max() < len(array) else None


def _display_color(
    prim: Any, time: Any, local: np.ndarray, polygon: np.ndarray, corners: np.ndarray, count: int
) -> np.ndarray | None:
    from pxr import UsdGeom

    gprim = UsdGeom.Gprim(prim)
    primvar = gprim.GetDisplayColorPrimvar()
    if not primvar or not primvar.HasAuthoredValue():
        primvar = UsdGeom.PrimvarsAPI(prim).FindPrimvarWithInheritance("displayColor")
        if not primvar or not primvar.HasAuthoredValue():
            return None
    rgb = _corner_values(primvar, time, local, polygon, corners)
    if rgb is None or rgb.shape[-1] != 3:
        return None
    out = np.full((*rgb.shape[:2], 4), 255, np.uint8)
    out[..., :3] = np.round(linear_to_srgb(rgb) * 255.0)
    opacity = gprim.GetDisplayOpacityPrimvar()
    if opacity and opacity.HasAuthoredValue():
        alpha = _corner_values(opacity, time, local, polygon, corners)
        if alpha is not None:
            out[..., 3] = np.round(np.clip(alpha, 0.0, 1.0).reshape(out.shape[:2]) * 255.0)
    return out


def _uv(
    prim: Any,
    time: Any,
    materials: list[MeshMaterial],
    local: np.ndarray,
    polygon: np.ndarray,
    corners: np.ndarray,
) -> np.ndarray | None:
    from pxr import UsdGeom

    primvars = UsdGeom.PrimvarsAPI(prim)
    for name in UV_NAMES:
        primvar = primvars.FindPrimvarWithInheritance(name)
        if primvar and primvar.HasAuthoredValue():
            values = _corner_values(primvar, time, local, polygon, corners)
            if values is not None and values.ndim == 3 and values.shape[-1] == 2:
                return values.astype(np.float32)
    return None


def _materials(prim: Any, polygon: np.ndarray, messages: list[str]) -> tuple[list[MeshMaterial], np.ndarray]:
    """Bound materials, subsets included, and the material of each triangle. A nameless one stands for
    none."""
    from pxr import UsdGeom, UsdShade

    materials = [_material(prim, messages)]
    ids = np.zeros(len(polygon), np.int32)
    for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim)):
        if subset.GetElementTypeAttr().Get() != UsdGeom.Tokens.face:
            continue
        if not UsdShade.MaterialBindingAPI(subset.GetPrim()).ComputeBoundMaterial()[0]:
            continue
        ids[np.isin(polygon, np.asarray(subset.GetIndicesAttr().Get(), np.int64))] = len(materials)
        materials.append(_material(subset.GetPrim(), messages))
    return materials, ids


def _groups(prim: Any, polygon: np.ndarray) -> dict[str, np.ndarray]:
    """Subsets of faces that have no material of their own, [T] bool of the triangles in each."""
    from pxr import UsdGeom, UsdShade

    return {
        str(subset.GetPrim().GetName()): np.isin(polygon, np.asarray(subset.GetIndicesAttr().Get(), np.int64))
        for subset in UsdGeom.Subset.GetAllGeomSubsets(UsdGeom.Imageable(prim))
        if subset.GetElementTypeAttr().Get() == UsdGeom.Tokens.face
        and not UsdShade.MaterialBindingAPI(subset.GetPrim()).GetDirectBinding().GetMaterial()
    }


def _material(prim: Any, messages: list[str]) -> MeshMaterial:
    from pxr import UsdShade

    none = MeshMaterial("")
    material = UsdShade.MaterialBindingAPI(prim).ComputeBoundMaterial()[0]
    if not material:
        return none
    shader = material.ComputeSurfaceSource()[0]
    if not shader or shader.GetIdAttr().Get() != "UsdPreviewSurface":
        return none
    name = str(material.GetPrim().GetName())
    color = shader.GetInput("diffuseColor")
    if not color:
        return MeshMaterial(name, _preview((0.18, 0.18, 0.18)))
    sources = color.GetConnectedSources()[0]
    if not sources:
        value = color.Get()
        return MeshMaterial(name, _preview(value if value is not None else (0.18, 0.18, 0.18)))
    texture = UsdShade.Shader(sources[0].source.GetPrim())
    if not texture or texture.GetIdAttr().Get() != "UsdUVTexture" or not texture.GetInput("file"):
        messages.append(f"material {name!r}: its diffuseColor is a shading network that is not understood")
        return none
    asset = texture.GetInput("file").Get()
    try:
        return MeshMaterial(name, WHITE, _asset_image(asset))
    except MeshError as error:
        messages.append(f"material {name!r}: {error}; the default colour is used")
        return none


def _asset_image(asset: Any) -> np.ndarray:
    """Read a texture through USD's asset resolver, which also reaches into .usdz packages."""
    from pxr import Ar

    where = str(asset.resolvedPath or asset.path)
    opened = Ar.GetResolver().OpenAsset(Ar.ResolvedPath(where))
    if opened is None:
        raise MeshError(f"texture {asset.path} does not exist")
    with opened:
        return read_image(bytes(opened.GetBuffer()), asset.path)


def _preview(value: Any) -> tuple[float, float, float, float]:
    r, g, b = (float(x) for x in linear_to_srgb(np.asarray(value, np.float64)))
    return r, g, b, 1.0


__all__ = ["open_stage", "read_stage", "read_usd", "triangulate"]
