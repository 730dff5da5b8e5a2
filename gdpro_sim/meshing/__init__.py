"""From a mesh file to a clean coloured surface, its tetrahedra, and the embedding of one in the other.

Public names are imported on first use: the heavy libraries behind them load only where they are needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

_PUBLIC = {
    "Embedding": "tetmesh",
    "MeshMaterial": "surface",
    "MeshReport": "repair",
    "SurfaceMesh": "surface",
    "TetMesh": "tetmesh",
    "decimate": "remesh",
    "embed_surface": "embedding",
    "load_mesh": "load",
    "subdivide": "remesh",
    "tetrahedralize": "tetrahedralize",
    "validate": "repair",
}

if TYPE_CHECKING:
    from gdpro_sim.meshing.embedding import embed_surface
    from gdpro_sim.meshing.load import load_mesh
    from gdpro_sim.meshing.remesh import decimate, subdivide
    from gdpro_sim.meshing.repair import MeshReport, validate
    from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh
    from gdpro_sim.meshing.tetmesh import Embedding, TetMesh
    from gdpro_sim.meshing.tetrahedralize import tetrahedralize


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        return getattr(importlib.import_module(f"{__name__}.{_PUBLIC[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


__all__ = [
    "Embedding",
    "MeshMaterial",
    "MeshReport",
    "SurfaceMesh",
    "TetMesh",
    "decimate",
    "embed_surface",
    "load_mesh",
    "subdivide",
    "tetrahedralize",
    "validate",
]
