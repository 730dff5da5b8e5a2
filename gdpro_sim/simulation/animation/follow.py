"""Points that ride on a moving surface: how an asset's vertices follow those of a motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import (
    consistent_winding,
    degenerate_faces,
    outward_orientation,
    turn_faces,
    weld,
)

SNAP = 1e-5
"""Barycentric weights this near to a corner, and lifts this small beside the surface's size, are rounding."""


@dataclass(frozen=True)
class SurfaceFollower:
    """N points, each on a triangle of a surface or a little off it.

    corners: [N, 3] int64, the triangle's vertices
    weights: [N, 3] float64, rows sum to 1
    lift:    [N, 3] float64 m, from there to the point along the triangle's first edge, across it in the
             triangle, and along its normal; None where all points lie on the surface
    """

    corners: np.ndarray
    weights: np.ndarray
    lift: np.ndarray | None

    def __call__(self, vertices: np.ndarray) -> np.ndarray:
        """[N, 3] float64 m: where the points are when the surface's vertices are at `vertices` [V, 3] m."""
        corners = vertices[self.corners]
        points = np.einsum("nk,nkc->nc", self.weights, corners)
        if self.lift is not None:
            points = points + np.einsum("nk,nkc->nc", self.lift, _frames(corners))
        return points


@dataclass(frozen=True)
class Fit:
    """How far points [N] m lie off a surface, and how they ride on it."""

    follower: SurfaceFollower
    distance: np.ndarray


def fit_to_surface(points: np.ndarray, normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> Fit:
    """Let points [N, 3] m with unit normals [N, 3] ride on the nearest places of a surface.

    vertices [V, 3] m, faces [F, 3]. Of the two sides of a thin wall the one that looks the same way counts.
    Points on a vertex take that vertex alone, so that they repeat its positions. Raises MeshError for a
    surface without area.
    """
    faces = _outward(vertices, faces)
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    index = SurfaceIndex(vertices, faces)
    face, weights = index.closest(points, normals, reach=0.05 * size)
    corners = faces[face].astype(np.int64)
    exact = weights.astype(np.float64)
    at_corner = exact.max(axis=1) > 1.0 - SNAP
    exact[at_corner] = np.eye(3)[exact[at_corner].argmax(axis=1)]
    exact /= exact.sum(axis=1, keepdims=True)
    held = vertices[corners]
    off = points - np.einsum("nk,nkc->nc", exact, held)
    distance = np.linalg.norm(off, axis=1)
    lift = np.einsum("nc,nkc->nk", off, _frames(held))
    lift[distance <= SNAP * size] = 0.0
    return Fit(SurfaceFollower(corners, exact, lift if lift.any() else None), distance)


def torn(rest: np.ndarray, moved: np.ndarray) -> float:
    """How far vertices that lie on each other at `rest` [V, 3] m are apart at most in `moved` [V, 3] m."""
    rows = np.ascontiguousarray(rest.astype(np.float32) + np.float32(0.0)).view(np.dtype((np.void, 12)))
    _, first, inverse = np.unique(rows.ravel(), return_index=True, return_inverse=True)
    return float(np.linalg.norm(moved - moved[first[inverse]], axis=1).max(initial=0.0))


def _outward(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """The faces that have area, wound outward as an imported mesh's are."""
    faces = faces[~degenerate_faces(vertices, faces)]
    if not len(faces):
        raise MeshError("the motion's mesh has no area in its first pose")
    points, welded = weld(vertices.astype(np.float32), faces)
    turned = consistent_winding(welded)[0]
    turned = turned ^ outward_orientation(points, turn_faces(welded, turned))
    return turn_faces(faces, turned)


def _frames(corners: np.ndarray) -> np.ndarray:
    """[N, 3, 3], rows: unit vectors along the first edge, across it, and along the normal."""
    edge = corners[:, 1] - corners[:, 0]
    normal = np.cross(edge, corners[:, 2] - corners[:, 0])
    edge = edge / np.maximum(np.linalg.norm(edge, axis=1, keepdims=True), 1e-300)
    normal = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    return np.stack([edge, np.cross(normal, edge), normal], axis=1)


__all__ = ["Fit", "SurfaceFollower", "fit_to_surface", "torn"]
