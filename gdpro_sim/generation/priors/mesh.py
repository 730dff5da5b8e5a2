"""Any mesh as a prior: read, checked, and closed where it is not."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.generation.priors.remeshing import coloured_like, distances, solid, without_crumbs
from gdpro_sim.generation.protocols import CoarseMesh
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.remesh import decimate
from gdpro_sim.meshing.repair import face_areas, validate
from gdpro_sim.meshing.surface import SurfaceMesh

log = logging.getLogger(__name__)

CELLS = 128
"""Across a surface that has to be made anew."""

FACES = 30_000
"""A prior with more is decimated to so many."""

FACES_PER_CELL = 3.2
COARSEST = 16
"""Cells across below which faces are not reduced further."""

SAMPLES = 4000
LOST = 0.02
"""Share of the surface further than LOST_CELLS from the closed one, from which it counts as lost: sheets."""

LOST_CELLS = 1.5
THICKNESS = 0.75
"""Cells that a sheet gets to either side."""

CRUMB = 1e-4
"""Pieces of less than this share of the largest one's volume are dropped."""


class MeshPrior:
    """A mesh, or a mesh file, as it is where it is one closed piece of at most `FACES` faces.

    An open one, or one of several pieces, gets a new closed surface around what it encloses; sheets that
    enclose nothing are given a thickness. Colours are looked up at the closest point of the original. What
    was done is in the result's description and messages.
    """

    def __init__(self, mesh: SurfaceMesh | str | Path) -> None:
        self.original = mesh if isinstance(mesh, SurfaceMesh) else load_mesh(mesh)

    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """The closed mesh in metres, whatever is asked for. Raises MeshError where nothing can be closed."""
        surface, done = closed(self.original)
        for line in done:
            log.info("%s: %s", self.original.source or "mesh", line)
        return CoarseMesh(
            surface, None, {**self.describe(), "done": done, "faces": len(surface.faces), "metric": True}
        )

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        report = validate(self.original.vertices, self.original.faces)
        return {
            "kind": "mesh",
            "label": "a mesh that was given",
            "source": self.original.source,
            "sha256": self.original.sha256,
            "given": {
                "faces": report.faces,
                "pieces": report.components,
                "open_edges": report.boundary_edges,
                "closed": report.watertight,
            },
        }


def closed(mesh: SurfaceMesh, cells: int = CELLS, faces: int = FACES) -> tuple[SurfaceMesh, list[str]]:
    """`mesh` as one closed surface of at most about `faces` faces, and what was done to it, a line each.

    Raises MeshError for a mesh without extent.
    """
    report = validate(mesh.vertices, mesh.faces)
    if not report.area > 0.0:
        raise MeshError(f"{mesh.source or 'mesh'}: its faces have no area; give a surface")
    done: list[str] = []
    v, f = mesh.vertices, mesh.faces
    if not (report.watertight and report.components == 1):
        why = f"{report.boundary_edges} open edges" if report.boundary_edges else ""
        if not why and not report.watertight:
            why = f"{report.non_manifold_edges} edges with more than two faces"
        pieces = f"{report.components} pieces" if report.components > 1 else ""
        v, f, how = _solid(mesh, cells)
        done.append(
            f"made a closed surface of {cells} cells across ({' and '.join(filter(None, [pieces, why]))})"
        )
        done += how
    if len(f) > faces:
        before = len(f)
        v, f = _fewer(v, f, faces)
        done.append(f"reduced {before} faces to {len(f)}")
    if not done:
        return mesh, []
    return coloured_like(v, f, mesh, (*mesh.messages, *done)), done


def _solid(mesh: SurfaceMesh, cells: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    done = []
    step = float(np.ptp(mesh.vertices, axis=0).max()) / cells
    v, f = solid(mesh.vertices, mesh.faces, cells)
    if not len(f) or _lost(mesh, v, f, LOST_CELLS * step) > LOST:
        thickness = THICKNESS * step
        v, f = solid(mesh.vertices, mesh.faces, cells, thickness)
        done.append(f"gave sheets a thickness of {2.0 * thickness:.2g} m")
    v, f, pieces = without_crumbs(v, f, CRUMB)
    if pieces > 1:
        done.append(
            f"{pieces} pieces do not touch; extraction keeps the largest unless extraction.keep is all"
        )
    return v, f, done


def _fewer(vertices: np.ndarray, faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface with about `count` faces: decimated, or made anew where that would tear it."""
    v, f = decimate(vertices, faces, count)
    if validate(v, f).watertight:
        return v, f
    # Marching cubes makes about three triangles for each square of a cell's size.
    step = (FACES_PER_CELL * float(face_areas(vertices, faces).sum()) / count) ** 0.5
    cells = int(float(np.ptp(vertices, axis=0).max()) / step)
    while True:
        v, f = solid(vertices, faces, max(cells, COARSEST))
        if len(f) <= count or cells <= COARSEST:
            return v, f
        cells = int(0.95 * cells)


def _lost(mesh: SurfaceMesh, vertices: np.ndarray, faces: np.ndarray, reach: float) -> float:
    """Share of the mesh's outside that is further than `reach` from another surface.

    What lies inside the other surface is not lost: it was swallowed by another part.
    """
    draw = np.random.default_rng(0)
    areas = face_areas(mesh.vertices, mesh.faces)
    which = draw.choice(len(areas), SAMPLES, p=areas / areas.sum())
    weights = draw.dirichlet(np.ones(3), SAMPLES)
    points = np.einsum("nc,ncd->nd", weights, mesh.vertices.astype(np.float64)[mesh.faces[which]])
    index = SurfaceIndex(vertices, faces, winding=True)
    far = distances(index, vertices.astype(np.float64), faces, points) > reach
    return float((far & ~index.inside(points)).mean())


__all__ = ["MeshPrior", "closed"]
