"""Vertices over time, and the files that hold them."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.files import atomic_write
from gdpro_sim.meshing.load import USD_SUFFIXES, clean_mesh, upright
from gdpro_sim.meshing.rawmesh import RawMesh
from gdpro_sim.meshing.surface import SurfaceMesh

MOST_FRAMES = 100_000


@runtime_checkable
class VertexSource(Protocol):
    """A mesh whose vertices move and whose faces stay. SI units, Z up.

    faces:      [F, 3] int32
    rest:       [V, 3] float64 m, the pose that a look is bound to
    fps:        frames per second of its own
    begin, end: s, its first and last moment; before and after them it stands still
    """

    @property
    def faces(self) -> np.ndarray: ...

    @property
    def rest(self) -> np.ndarray: ...

    @property
    def fps(self) -> float: ...

    @property
    def begin(self) -> float: ...

    @property
    def end(self) -> float: ...

    def vertices(self, time: float) -> np.ndarray:
        """[V, 3] float64 m at `time` s."""


@dataclass(frozen=True)
class Motion:
    """A `VertexSource` read from a file, with what the mesh looks like.

    path:  the file, or folder
    look:  parts at rest, in the file's axes and unit; its vertices need not be in the order of the motion's
    pose:  vertices [V, 3] at a time in s, in the file's axes and unit
    still: vertices [V, 3] at rest, in the file's axes and unit
    up, scale: as in `gdpro_sim.meshing.load.load_mesh`
    notes: what the reader left out or chose; one sentence each
    """

    path: Path
    look: RawMesh
    faces: np.ndarray
    still: np.ndarray
    pose: Callable[[float], np.ndarray]
    fps: float
    begin: float
    end: float
    up: str = "auto"
    scale: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def rest(self) -> np.ndarray:
        return upright(self.still, self.look, self.up, self.scale)

    def vertices(self, time: float) -> np.ndarray:
        """[V, 3] float64 m at `time` s. Raises MeshError where they are not finite."""
        found = upright(self.pose(min(max(time, self.begin), self.end)), self.look, self.up, self.scale)
        if not np.isfinite(found).all():
            raise MeshError(f"{self.path}: vertices are NaN or infinite at {time:.3f} s; export it again")
        return found

    def surface(self, *, color: str | None = None, texture: str | Path | None = None) -> SurfaceMesh:
        """The mesh at rest, cleaned and coloured as `gdpro_sim.meshing.load.load_mesh` does it."""
        raw = RawMesh(
            [replace(part) for part in self.look.parts],
            self.look.up,
            self.look.unit,
            list(self.look.messages),
        )
        return clean_mesh(raw, self.path, texture=texture, color=color, up=self.up, scale=self.scale)


def open_motion(
    path: str | Path,
    *,
    fps: float | None = None,
    clip: str | None = None,
    up: str = "auto",
    scale: float | None = None,
) -> Motion:
    """The motion in a file: a glTF or USD scene, an .npz, or a folder of numbered meshes.

    fps:  of numbered meshes, 30 where not given; of the others, in place of their own
    clip: name or number of one of a glTF file's animations; default: the first
    up, scale: as in `gdpro_sim.meshing.load.load_mesh`

    An .npz holds `vertices` [T, V, 3] and `faces` [F, 3], and may hold `rest` [V, 3] (default: the first
    frame), `colors` [V, 3] (sRGB, uint8 or floats in [0, 1]), `fps`, `begin` (s) and `up` ("y" or "z").
    glTF: skins, morph targets and moving nodes; USD: the same as UsdSkel and transforms, and points with time
    samples.
    Raises MeshError where the file cannot be read, holds no motion, or its topology changes.
    """
    file = Path(path)
    if not file.exists():
        raise MeshError(f"{file} does not exist")
    if fps is not None and not (math.isfinite(fps) and fps > 0.0):
        raise RequestError(f"fps must be a finite number > 0, got {fps}")
    suffix = file.suffix.lower()
    if clip is not None and suffix not in (".glb", ".gltf"):
        raise RequestError(f"a clip is one of a glTF file's animations, but {file.name} is none")
    # Readers are imported here: each is needed for its own kind of file alone.
    if file.is_dir():
        from gdpro_sim.simulation.animation.sequence import read_folder

        motion = read_folder(file, fps or 30.0)
    elif suffix == ".npz":
        from gdpro_sim.simulation.animation.sequence import read_arrays

        motion = read_arrays(file, fps)
    elif suffix in (".glb", ".gltf"):
        from gdpro_sim.simulation.animation.gltf import read_gltf

        motion = read_gltf(file, fps or 30.0, clip)
    elif suffix in USD_SUFFIXES:
        from gdpro_sim.simulation.animation.usd import read_animated_usd

        motion = read_animated_usd(file, fps)
    else:
        raise MeshError(
            f"{file}: {suffix or 'a file without suffix'} holds no motion; give a folder of numbered meshes, "
            "an .npz, a .glb or .gltf, or a USD file"
        )
    motion = replace(motion, up=up, scale=scale)
    if not len(motion.rest):  # checks up and scale as well
        raise MeshError(f"{file}: holds no vertices")
    return motion


def save_motion(path: str | Path, source: VertexSource) -> None:
    """Write a source's own frames as an .npz that `open_motion` reads. Raises RequestError or OutputError."""
    count = round((source.end - source.begin) * source.fps) + 1
    if not 1 <= count <= MOST_FRAMES:
        raise RequestError(
            f"a motion from {source.begin:g} to {source.end:g} s at {source.fps:g} frames a second is not "
            f"between 1 and {MOST_FRAMES:,} frames long"
        )
    frames = [source.vertices(source.begin + k / source.fps) for k in range(count)]
    with atomic_write(path) as temporary:
        np.savez(
            temporary,
            vertices=np.stack(frames),
            faces=source.faces,
            rest=source.rest,
            fps=source.fps,
            begin=source.begin,
            up="z",
        )


__all__ = ["Motion", "VertexSource", "open_motion", "save_motion"]
