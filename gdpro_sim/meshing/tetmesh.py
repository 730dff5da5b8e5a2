"""Tetrahedral meshes and the embedding that carries a surface with them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdpro_sim.errors import MeshError


@dataclass(frozen=True)
class TetMesh:
    """A tetrahedral mesh with positive volumes, and how it was made.

    vertices: [P, 3] float32, metres
    tets:     [T, 4] int32, det[v1-v0, v2-v0, v3-v0] > 0
    fill:     [T] float32 in (0, 1], the fraction of each element's volume that is material
              (1 everywhere for a body-fitted mesh; a lattice has partly filled cells at the surface)
    method:   "tetwild" or "lattice"
    """

    vertices: np.ndarray
    tets: np.ndarray
    fill: np.ndarray
    method: str

    def __post_init__(self) -> None:
        v, t, f = self.vertices, self.tets, self.fill
        if v.ndim != 2 or v.shape[1] != 3 or v.dtype != np.float32:
            raise MeshError(f"TetMesh.vertices must be float32 [P, 3], got {v.dtype} {v.shape}")
        if t.ndim != 2 or t.shape[1] != 4 or t.dtype != np.int32:
            raise MeshError(f"TetMesh.tets must be int32 [T, 4], got {t.dtype} {t.shape}")
        if f.shape != (len(t),) or f.dtype != np.float32:
            raise MeshError(f"TetMesh.fill must be float32 [{len(t)}], got {f.dtype} {f.shape}")

    def volumes(self) -> np.ndarray:
        """Signed volume of every element in float64, m^3, not weighted by fill; [T]."""
        v = self.vertices.astype(np.float64)[self.tets]
        return np.linalg.det(v[:, 1:] - v[:, :1]) / 6.0


@dataclass(frozen=True)
class Embedding:
    """Where each surface vertex sits in a tet mesh: unclamped barycentric coordinates of its nearest tet.

    tet_ids: [V] int32
    weights: [V, 4] float32, rows sum to 1, may be negative for a vertex just outside
    """

    tet_ids: np.ndarray
    weights: np.ndarray


__all__ = ["Embedding", "TetMesh"]
