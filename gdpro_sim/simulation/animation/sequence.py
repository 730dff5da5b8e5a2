"""Mesh sequences: folders of numbered mesh files, and arrays."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.load import SUPPORTED, check_file, merge_parts, read_raw
from gdpro_sim.meshing.obj_file import ObjFile, read_obj
from gdpro_sim.meshing.rawmesh import WHITE, RawMesh, RawPart
from gdpro_sim.meshing.repair import check_arrays
from gdpro_sim.meshing.surface import MeshMaterial
from gdpro_sim.simulation.animation.source import Motion

MEMORY = 4 << 30
"""Bytes of positions past which a sequence is refused: all frames are checked, and kept, before the first."""

LISTED = 12
"""Missing frames that a message names."""


def read_folder(folder: Path, fps: float) -> Motion:
    """One mesh per file, in the order of the last number in their names; the first one has the look.

    Raises MeshError for several sequences in one folder, missing numbers and changing topology.
    """
    files = _numbered(folder)
    check_file(files[0])
    look = read_raw(files[0])
    first, faces = _topology(files[0])
    frames = np.empty((len(files), *first.shape), np.float32)
    if frames.nbytes > MEMORY:
        raise MeshError(
            f"{folder}: {len(files)} frames of {len(first):,} vertices take {frames.nbytes / 2**30:.1f} GiB, "
            f"above the limit of {MEMORY >> 30}; split or decimate the sequence"
        )
    for number, file in enumerate(files):
        points, polygons = (first, faces) if number == 0 else _topology(file)
        _check_same(file, files[0], points, first, polygons, faces)
        frames[number] = points
    return _motion(folder, look, _triangles(files[0], first, faces), frames, fps, rest=first, begin=0.0)


def read_arrays(file: Path, fps: float | None) -> Motion:
    """Arrays as `gdpro_sim.simulation.animation.open_motion` describes them. Raises MeshError."""
    try:
        with np.load(file, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise MeshError(f"{file} cannot be read as .npz ({error})") from error
    for name in ("vertices", "faces"):
        if name not in arrays:
            raise MeshError(
                f"{file} has no array {name!r}; it holds {', '.join(sorted(arrays)) or 'nothing'}"
            )
    frames, faces = np.asarray(arrays["vertices"]), arrays["faces"]
    if frames.ndim != 3 or frames.shape[2] != 3 or not len(frames) or frames.dtype.kind not in "fiu":
        raise MeshError(
            f"{file}: vertices must be numbers [T, V, 3], got {frames.dtype} {list(frames.shape)}"
        )
    check_arrays(frames[0], faces, str(file))
    faces = faces.astype(np.int32)
    colors, material = None, MeshMaterial()
    if "colors" in arrays:
        colors, material = (
            _corner_colors(file, arrays["colors"], frames.shape[1])[faces],
            MeshMaterial("", WHITE),
        )
    own = float(arrays["fps"]) if "fps" in arrays else 30.0
    if not own > 0.0:
        raise MeshError(f"{file}: fps must be > 0, got {own}")
    up = str(arrays["up"]) if "up" in arrays else "z"
    if up not in ("y", "z"):
        raise MeshError(f"{file}: up must be y or z, got {up!r}")
    rest = np.asarray(arrays.get("rest", frames[0]), np.float64)
    if rest.shape != frames.shape[1:]:
        raise MeshError(f"{file}: rest must be {list(frames.shape[1:])}, got {list(rest.shape)}")
    part = RawPart(rest, faces.astype(np.int64), np.zeros(len(faces), np.int32), [material], None, colors)
    begin = float(arrays.get("begin", 0.0))
    return _motion(file, RawMesh([part], up=up), faces, frames, fps or own, rest=rest, begin=begin)


def _corner_colors(file: Path, colors: np.ndarray, count: int) -> np.ndarray:
    """uint8 RGBA [V, 4] of vertex colours."""
    if colors.shape != (count, 3):
        raise MeshError(f"{file}: colors must be [{count}, 3] like the vertices, got {list(colors.shape)}")
    if colors.dtype.kind == "f":
        colors = np.round(255.0 * np.clip(colors, 0.0, 1.0))
    return np.column_stack([colors, np.full(count, 255)]).astype(np.uint8)


def _motion(
    path: Path,
    look: RawMesh,
    faces: np.ndarray,
    frames: np.ndarray,
    fps: float,
    *,
    rest: np.ndarray,
    begin: float,
) -> Motion:
    last = len(frames) - 1
    if last < 1:
        raise MeshError(f"{path}: one frame is no motion; give two at least")
    broken = ~np.isfinite(frames).all(axis=(1, 2))
    if broken.any():
        raise MeshError(
            f"{path}: frame {int(broken.argmax())} holds NaN or infinite vertices; export it again"
        )

    def pose(time: float) -> np.ndarray:
        at = min(max((time - begin) * fps, 0.0), float(last))
        if abs(at - round(at)) < 1e-6:  # a frame is itself, whatever rounding did to its time
            return frames[round(at)].astype(np.float64)
        before = min(int(at), last - 1)
        share = at - before
        a, b = (frames[k].astype(np.float64) for k in (before, before + 1))
        return (1.0 - share) * a + share * b

    return Motion(path, look, faces, rest, pose, fps, begin, begin + last / fps)


def _numbered(folder: Path) -> list[Path]:
    """The numbered mesh files of a folder in order."""
    found: dict[tuple[str, str], dict[int, Path]] = {}
    for file in sorted(folder.iterdir()):
        match = re.fullmatch(r"(.*?)(\d+)(\D*)", file.stem)
        if match is None or file.suffix.lower() not in SUPPORTED or file.name.startswith("."):
            continue
        series = found.setdefault((match[1], f"{match[3]}{file.suffix}"), {})
        number = int(match[2])
        if number in series:
            raise MeshError(f"{folder}: {series[number].name} and {file.name} are the same frame {number}")
        series[number] = file
    if not found:
        raise MeshError(
            f"{folder}: holds no numbered meshes, such as frame_0001.obj; formats: "
            f"{', '.join(suffix[1:] for suffix in SUPPORTED)}"
        )
    if len(found) > 1:
        names = ", ".join(f"{start}#{end}" for start, end in sorted(found))
        raise MeshError(f"{folder}: holds several sequences ({names}); give each a folder of its own")
    (series,) = found.values()
    missing = sorted(set(range(min(series), max(series) + 1)) - set(series))
    if missing:
        shown = ", ".join(str(number) for number in missing[:LISTED])
        more = f" and {len(missing) - LISTED} more" if len(missing) > LISTED else ""
        raise MeshError(
            f"{folder}: frames {min(series)} to {max(series)} lack {shown}{more}; export them, or number the "
            "files without gaps"
        )
    return [series[number] for number in sorted(series)]


def _topology(file: Path) -> tuple[np.ndarray, np.ndarray]:
    """Points [V, 3] and what joins them: triangles [F, 3], of an OBJ its polygons as a row of integers.

    Mesh readers split an OBJ's vertices where its normals differ, frame by frame; here they stand as written.
    """
    check_file(file)
    if file.suffix.lower() == ".obj":
        found = read_obj(file)
        return found.points, found.polygons
    part = merge_parts(read_raw(file).parts)
    return part.vertices, part.faces


def _triangles(file: Path, points: np.ndarray, faces: np.ndarray) -> np.ndarray:
    if faces.ndim == 1:
        faces, _ = ObjFile(points, faces).triangles()
    check_arrays(points, faces, str(file))
    return faces.astype(np.int32)


def _check_same(
    file: Path, first: Path, points: np.ndarray, start: np.ndarray, faces: np.ndarray, known: np.ndarray
) -> None:
    if len(points) != len(start):
        raise MeshError(
            f"{file} has {len(points):,} vertices, but {first.name} has {len(start):,}: the topology of a "
            "sequence must not change; export it without remeshing"
        )
    if not np.array_equal(faces, known):
        raise MeshError(
            f"{file} joins its vertices otherwise than {first.name}: the topology of a sequence must not "
            "change; export it with the vertex order kept"
        )


__all__ = ["read_arrays", "read_folder"]
