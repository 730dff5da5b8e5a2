"""Read a mesh file into a clean, coloured, metre-sized, Z-up `SurfaceMesh`."""

from __future__ import annotations

import logging
import struct
import zipfile
from pathlib import Path

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.files import sha256_of
from gdpro_sim.meshing.rawmesh import MAX_FACES, WHITE, RawMesh, RawPart, read_image, too_many_faces
from gdpro_sim.meshing.repair import (
    consistent_winding,
    degenerate_faces,
    duplicate_faces,
    outward_orientation,
    turn_faces,
    validate,
    weld,
    weld_seams,
)
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh

logger = logging.getLogger(__name__)

MAX_TEXT_BYTES = 300_000_000
MAX_BINARY_BYTES = 600_000_000
"""File sizes above these are refused before reading: parsing takes several times the size in memory."""

FEW = 0.01
"""Share of broken faces up to which they are dropped with a message."""

LARGEST_DIAGONAL, SMALLEST_DIAGONAL = 100.0, 0.005
USD_SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
TRIMESH_SUFFIXES = (".3mf", ".dae", ".glb", ".gltf", ".obj", ".off", ".ply", ".stl", ".zae")
SUPPORTED = tuple(sorted(USD_SUFFIXES + TRIMESH_SUFFIXES))
BINARY_SUFFIXES = (".glb", ".ply", ".stl", ".usd", ".usdc", ".usdz", ".3mf", ".zae")
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg")


def load_mesh(
    path: str | Path,
    *,
    texture: str | Path | None = None,
    color: str | None = None,
    up: str = "auto",
    scale: float | None = None,
) -> SurfaceMesh:
    """Read a mesh file.

    path:    OBJ, glTF, PLY, STL, OFF, COLLADA, 3MF or USD; scenes are flattened with their transforms
    texture: image to use instead of the file's own; needs UV coordinates in the file
    color:   one colour for everything ("#rrggbb" or a CSS name) instead of the file's own colours
    up:      vertical axis, "y" or "z"; "auto" takes what the file declares, else Z for STL, PLY, OFF and 3MF
             and Y for the rest
    scale:   multiplies lengths, after the unit the file declares (USD, COLLADA and 3MF do; others are metres)

    Vertices are welded by position, zero-area and duplicate faces dropped, winding made consistent and
    normals turned outward; `SurfaceMesh.messages` tells what was done, and warns about a doubtful size.
    Raises `MeshError` for a missing, unreadable, empty, broken or too large file, naming it and the way out.
    """
    path = Path(path)
    check_file(path)
    return clean_mesh(read_raw(path), path, texture=texture, color=color, up=up, scale=scale)


def read_raw(path: Path) -> RawMesh:
    """The parts of a mesh file as they stand in it. Raises `MeshError`."""
    if path.suffix.lower() in USD_SUFFIXES:
        from gdpro_sim.meshing.usd_reader import read_usd

        return read_usd(path)
    from gdpro_sim.meshing.trimesh_reader import read_trimesh

    return read_trimesh(path)


def clean_mesh(
    raw: RawMesh,
    path: Path,
    *,
    texture: str | Path | None = None,
    color: str | None = None,
    up: str = "auto",
    scale: float | None = None,
) -> SurfaceMesh:
    """What `load_mesh` makes of the parts that a reader found in the file `path`."""
    rgb = parse_color(color) if color is not None else None
    if texture is not None and color is not None:
        raise MeshError("a texture and a colour cannot both be given; leave one out")
    image = read_image(Path(texture), str(texture)) if texture is not None else None
    part = _drop_broken(merge_parts(raw.parts), path, raw.messages)
    part.vertices = upright(part.vertices, raw, up, scale)
    if raw.unit != 1.0:
        raw.messages.append(f"the file's unit is {raw.unit:g} m; lengths were converted to metres")
    _color(part, path, rgb, image, raw)
    mesh = _finish(part, path, raw)
    for message in mesh.messages:
        logger.info("%s: %s", path.name, message)
    return mesh


def parse_color(color: str) -> tuple[float, float, float]:
    """sRGB in [0, 1] of "#rrggbb" or a CSS colour name; raises `MeshError` for anything else."""
    from PIL import ImageColor

    try:
        value = ImageColor.getrgb(color)
    except (ValueError, AttributeError):
        raise MeshError(f"colour {color!r} is unknown; write #rrggbb or a CSS name such as tomato") from None
    return value[0] / 255.0, value[1] / 255.0, value[2] / 255.0


def check_file(path: Path) -> None:
    """Refuse, before reading, what cannot be a readable mesh of at most `MAX_FACES` triangles."""
    if path.is_dir():
        raise MeshError(f"{path} is a directory; name a mesh file ({_supported()})")
    if not path.exists():
        raise MeshError(f"{path} does not exist")
    suffix = path.suffix.lower()
    if suffix not in SUPPORTED:
        named = f"format {suffix!r}" if suffix else "a file without an extension"
        raise MeshError(f"{path}: {named} is not supported; convert it to one of {_supported()}")
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            head = file.read(4096)
    except OSError as error:
        raise MeshError(f"{path} cannot be read: {error.strerror or error}") from error
    if size == 0:
        raise MeshError(f"{path} is empty (0 bytes)")
    if suffix == ".stl" and size >= 84:
        count = struct.unpack("<I", head[80:84])[0]
        if size == 84 + 50 * count and count > MAX_FACES:
            raise too_many_faces(path, count)
    if suffix == ".ply":
        for line in head.split(b"end_header")[0].splitlines():
            words = line.split()
            if words[:2] == [b"element", b"face"] and len(words) == 3 and words[2].isdigit():
                if int(words[2]) > MAX_FACES:
                    raise too_many_faces(path, int(words[2]))
    if suffix in (".3mf", ".zae") and zipfile.is_zipfile(path):
        with zipfile.ZipFile(path) as archive:
            size = sum(entry.file_size for entry in archive.infolist())
    limit = MAX_BINARY_BYTES if suffix in BINARY_SUFFIXES else MAX_TEXT_BYTES
    if size > limit:
        raise MeshError(
            f"{path}: {size / 1e6:.0f} MB is above the limit of {limit / 1e6:.0f} MB for {suffix}; "
            f"decimate the mesh to at most {MAX_FACES:,} faces first"
        )


def _supported() -> str:
    return ", ".join(s[1:] for s in SUPPORTED)


def merge_parts(parts: list[RawPart]) -> RawPart:
    """One part of several, their vertices and faces one after the other."""
    if len(parts) == 1:
        return parts[0]
    faces = np.concatenate([p.faces for p in parts])
    offset, row, material = 0, 0, 0
    uv = np.zeros((len(faces), 3, 2), np.float32) if any(p.uv is not None for p in parts) else None
    colors = np.full((len(faces), 3, 4), 255, np.uint8) if any(p.colors is not None for p in parts) else None
    ids = np.empty(len(faces), np.int32)
    materials: list[MeshMaterial] = []
    groups = {name: np.zeros(len(faces), bool) for part in parts for name in part.groups}
    for part in parts:
        rows = slice(row, row + len(part.faces))
        faces[rows] += offset
        ids[rows] = part.material_ids + material
        if uv is not None and part.uv is not None:
            uv[rows] = part.uv
        if colors is not None and part.colors is not None:
            colors[rows] = part.colors
        for name, own in part.groups.items():
            groups[name][rows] = own
        offset, row, material = offset + len(part.vertices), rows.stop, material + len(part.materials)
        materials += part.materials
    return RawPart(np.concatenate([p.vertices for p in parts]), faces, ids, materials, uv, colors, groups)


def _keep(part: RawPart, mask: np.ndarray) -> RawPart:
    return RawPart(
        part.vertices,
        part.faces[mask],
        part.material_ids[mask],
        part.materials,
        part.uv[mask] if part.uv is not None else None,
        part.colors[mask] if part.colors is not None else None,
        {name: own[mask] for name, own in part.groups.items()},
    )


def _drop_broken(part: RawPart, path: Path, messages: list[str]) -> RawPart:
    """Drop the few faces with NaN, infinite or absurd vertices; refuse a mesh with many."""
    good = (np.abs(part.vertices) < 1e15).all(1)  # False for NaN
    if good.all():
        return part
    bad = ~good[part.faces].all(1)
    count = int(bad.sum())
    if count > FEW * len(bad):
        raise MeshError(
            f"{path}: {count} of {len(bad)} faces have NaN or infinite vertices; re-export the mesh"
        )
    if count:
        messages.append(f"dropped {count} faces with NaN or infinite vertices")
    part = _keep(part, ~bad)
    part.vertices = np.where(good[:, None], part.vertices, 0.0)
    return part


def upright(vertices: np.ndarray, raw: RawMesh, up: str = "auto", scale: float | None = None) -> np.ndarray:
    """Vertices [V, 3] of `raw` in metres, turned so that its vertical axis, or `up`, becomes +Z.

    `up` and `scale` as in `load_mesh`. Raises `MeshError` for others.
    """
    if up not in ("auto", "y", "z"):
        raise MeshError(f"up axis must be auto, y or z, got {up!r}")
    if scale is not None and not (np.isfinite(scale) and scale > 0.0):
        raise MeshError(f"scale must be > 0, got {scale}")
    x, y, z = vertices.T
    axis = raw.up if up == "auto" else up
    if axis == "y":
        vertices = np.stack([x, -z, y], 1)
    elif axis == "x":
        vertices = np.stack([-z, y, x], 1)
    return vertices * (raw.unit * (scale or 1.0))


def _color(
    part: RawPart, path: Path, rgb: tuple[float, float, float] | None, image: np.ndarray | None, raw: RawMesh
) -> None:
    """Apply the caller's colour or texture, or find the texture that lies beside an uncoloured file."""
    if rgb is not None:
        part.uv = part.colors = None
        part.materials = [MeshMaterial("color", (*rgb, 1.0))]
        part.material_ids = np.zeros(len(part.faces), np.int32)
        return
    plain = MeshMaterial().base_color
    if image is not None:
        if part.uv is None:
            raise MeshError(
                f"{path}: has no UV coordinates for a texture; leave it out or give a colour instead"
            )
        part.colors = None
    elif part.uv is not None and part.colors is None:
        if all(m.texture is None and m.base_color == plain for m in part.materials):
            for beside in (path.with_suffix(suffix) for suffix in IMAGE_SUFFIXES):
                if beside.is_file():
                    image = read_image(beside, str(beside))
                    raw.messages.append(f"used {beside.name}, which lies beside the file, as its texture")
                    break
    if image is not None:
        part.materials = [MeshMaterial("texture", WHITE, image)]
        part.material_ids = np.zeros(len(part.faces), np.int32)
    elif part.uv is not None and all(m.texture is None for m in part.materials):
        part.uv = None


def _finish(part: RawPart, path: Path, raw: RawMesh) -> SurfaceMesh:
    messages = raw.messages
    vertices, faces = weld(part.vertices.astype(np.float32), part.faces)
    part.faces = weld_seams(vertices, faces)
    flat = degenerate_faces(vertices, faces)
    if flat.any():
        messages.append(f"dropped {int(flat.sum())} of {len(flat)} faces of zero area")
        part = _keep(part, ~flat)
    twice = duplicate_faces(part.faces) if len(part.faces) else np.zeros(0, bool)
    if twice.any():
        messages.append(f"dropped {int(twice.sum())} duplicate faces")
        part = _keep(part, ~twice)
    if not len(part.faces):
        raise MeshError(f"{path}: every face has zero area; nothing is left to draw or simulate")
    for mask, what in (
        (consistent_winding(part.faces)[0], "that were wound against their neighbours"),
        (None, "that pointed inward"),
    ):
        if mask is None:
            mask = outward_orientation(vertices, part.faces)
        if mask.any():
            messages.append(f"turned {int(mask.sum())} faces {what}")
            part.faces = turn_faces(part.faces, mask)
            part.uv = turn_faces(part.uv, mask) if part.uv is not None else None
            part.colors = turn_faces(part.colors, mask) if part.colors is not None else None
    vertices, faces = weld(vertices, part.faces)
    report = validate(vertices, faces)
    if report.boundary_edges or report.non_manifold_edges:
        messages.append(
            f"the surface is not closed: {report.boundary_edges} open and {report.non_manifold_edges} "
            "non-manifold edges"
        )
    diagonal = float(np.linalg.norm(np.ptp(vertices.astype(np.float64), axis=0)))
    if diagonal > LARGEST_DIAGONAL or diagonal < SMALLEST_DIAGONAL:
        messages.append(_size_warning(diagonal))
    return SurfaceMesh(
        vertices,
        faces,
        part.uv,
        part.colors,
        part.material_ids.astype(np.int32),
        tuple(part.materials),
        str(path),
        sha256_of(path) if path.is_file() else "",
        tuple(messages),
        part.groups,
    )


def _size_warning(diagonal: float) -> str:
    """Offer the power of ten that makes the diagonal about a metre: 0.001 for millimetres read as metres."""
    factor = 0.001 if 100.0 < diagonal <= 1e5 else 10.0 ** -round(float(np.log10(diagonal)))
    if diagonal < SMALLEST_DIAGONAL:
        factor = 1000.0 if diagonal * 1000.0 >= 0.005 else factor
    return (
        f"warning: the mesh is {diagonal:.4g} m across, which is doubtful; `--scale {factor:g}` would make "
        f"it {diagonal * factor:.3g} m"
    )


__all__ = [
    "MAX_FACES",
    "SUPPORTED",
    "clean_mesh",
    "load_mesh",
    "merge_parts",
    "parse_color",
    "read_raw",
    "upright",
]
