"""Coloured triangle meshes as plain arrays: what a mesh file becomes once it is read and cleaned."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from gdpro_sim.errors import MeshError

DEFAULT_COLOR = (0.80, 0.62, 0.47)
"""sRGB colour of a mesh that brings none: light clay."""


@dataclass(frozen=True)
class MeshMaterial:
    """How some faces are coloured: base colour times texture times corner colour.

    name:       as the file names it
    base_color: RGBA, sRGB-encoded, each in [0, 1]
    texture:    uint8 [H, W, 4] sRGB-encoded, first row at the top (v = 1), or None
    cutout:     the texture's alpha is opacity (else alpha is ignored)
    """

    name: str = "default"
    base_color: tuple[float, float, float, float] = (*DEFAULT_COLOR, 1.0)
    texture: np.ndarray | None = None
    cutout: bool = False


@dataclass(frozen=True)
class SurfaceMesh:
    """A triangle mesh welded for physics, coloured per corner so that UV seams survive the welding.

    vertices:     [V, 3] float32, metres, Z up
    faces:        [F, 3] int32, counter-clockwise seen from outside
    uv:           [F, 3, 2] float32 per corner, v up, or None
    colors:       [F, 3, 4] uint8 per corner, sRGB-encoded, or None
    material_ids: [F] int32 into `materials`
    materials:    at least one
    source:       the file it came from ("" when made in memory)
    sha256:       of the file's bytes ("" when made in memory)
    messages:     what the reader noticed, repaired or assumed; one sentence each
    groups:       [F] bool of the faces in each, by the file's names for parts that are no materials
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray | None
    colors: np.ndarray | None
    material_ids: np.ndarray
    materials: tuple[MeshMaterial, ...]
    source: str = ""
    sha256: str = ""
    messages: tuple[str, ...] = ()
    groups: Mapping[str, np.ndarray] = field(default_factory=dict)

    def __post_init__(self) -> None:
        f = len(self.faces)
        wanted: list[tuple[str, np.ndarray | None, tuple[int, ...], type]] = [
            ("vertices", self.vertices, (len(self.vertices), 3), np.float32),
            ("faces", self.faces, (f, 3), np.int32),
            ("uv", self.uv, (f, 3, 2), np.float32),
            ("colors", self.colors, (f, 3, 4), np.uint8),
            ("material_ids", self.material_ids, (f,), np.int32),
        ]
        for name, array, shape, dtype in wanted:
            if array is not None and (array.shape != shape or array.dtype != dtype):
                raise MeshError(
                    f"SurfaceMesh.{name} must be {np.dtype(dtype).name} {shape}, "
                    f"got {array.dtype} {array.shape}"
                )
        if not self.materials:
            raise MeshError("SurfaceMesh.materials must hold at least one material")
        if f and not 0 <= int(self.material_ids.min()) <= int(self.material_ids.max()) < len(self.materials):
            raise MeshError(f"SurfaceMesh.material_ids must lie in [0, {len(self.materials)})")

    @staticmethod
    def from_arrays(
        vertices: np.ndarray, faces: np.ndarray, *, color: tuple[float, float, float] = DEFAULT_COLOR
    ) -> SurfaceMesh:
        """A mesh of one plain sRGB `color` from vertices [V, 3] m and faces [F, 3]; taken as it is, not
        cleaned."""
        return SurfaceMesh(
            np.ascontiguousarray(vertices, dtype=np.float32),
            np.ascontiguousarray(faces, dtype=np.int32),
            None,
            None,
            np.zeros(len(faces), np.int32),
            (MeshMaterial("color", (*color, 1.0)),),
        )

    @property
    def diagonal(self) -> float:
        """Length of the bounding box's diagonal in metres; 0 for an empty mesh."""
        if not len(self.vertices):
            return 0.0
        return float(np.linalg.norm(np.ptp(self.vertices.astype(np.float64), axis=0)))


__all__ = ["DEFAULT_COLOR", "MeshMaterial", "SurfaceMesh"]
