"""Painted parts of bodies: from vertices of an asset's surface to what a solver moves under them."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.simulation.placement import Placement

LAYER = 1.0
"""Depth of the outermost particles, in distances between neighbours."""


def painted_points(
    points: np.ndarray, placement: Placement, chosen: np.ndarray, depth: float | None
) -> np.ndarray:
    """Ids of `points` [n, 3] m, in the world, whose nearest place on the surface is chosen.

    placement: of the body; its surface is where the points are
    chosen:    [V] bool of surface vertices; a place belongs where they weigh half or more
    depth:     m from the surface; None: the outermost tet vertices or particles

    Where a part is too small for any point, the ones nearest to its vertices.
    """
    surface = placement.surface.astype(np.float64)
    faces = placement.asset.gaussians.faces.cpu().numpy()
    index = SurfaceIndex(surface, faces)
    face, weights = index.closest(points)
    weights = weights.astype(np.float64)
    within = np.ones(len(points), bool)
    tets = placement.asset.tets
    away = np.linalg.norm(np.einsum("pc,pci->pi", weights, surface[faces[face]]) - points, axis=1)
    if depth is not None:
        within = away <= depth
    elif tets is not None and len(tets.vertices) == len(points):
        within[:] = False
        within[boundary(tets.tets)[0]] = True
    elif len(points) > 1:
        within = away <= LAYER * float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    ids = np.flatnonzero(within & (np.einsum("pc,pc->p", weights, chosen[faces[face]]) >= 0.5))
    if len(ids):
        return ids
    candidates = np.flatnonzero(within) if within.any() else np.arange(len(points))
    near = cKDTree(points[candidates]).query(surface[chosen])[1]
    return np.unique(candidates[near])


__all__ = ["painted_points"]
