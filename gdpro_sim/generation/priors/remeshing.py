"""What priors made of surfaces share: a closed surface of any mesh, smoothing, and colours carried over."""

from __future__ import annotations

import numpy as np
from scipy import sparse

from gdpro_sim.generation.objects.isosurface import isosurface
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import face_components, face_normals, signed_volume
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh

TAUBIN = (0.5, -0.53)
"""Steps towards and away from the neighbours' mean that smooth without shrinking (Taubin 1995)."""

CAP = 1.0
"""Cells off the original surface from which a vertex belongs to the lid of a hole."""

LEAN = 0.1
"""Share of the way to the face's middle at which a corner's colour is looked up, so that a face beside a
colour border takes its own side's."""


def solid(
    vertices: np.ndarray, faces: np.ndarray, cells: int, thickness: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """A closed surface around what a mesh encloses, `cells` across: openings get lids, overlaps are joined.

    Inside is where the generalised winding number is above one half (Jacobson et al. 2013). With a
    `thickness` the surface itself becomes solid too, that far to both sides, so that sheets stay.
    Returns vertices [V, 3] float32 and faces [F, 3] int32; empty where nothing is inside.
    """
    v = np.asarray(vertices, np.float64)
    low, high = v.min(0) - thickness, v.max(0) + thickness
    step = float((high - low).max()) / cells
    index = SurfaceIndex(v, faces, winding=True)

    def field(points: np.ndarray) -> np.ndarray:
        where = np.ascontiguousarray(points.T, np.float64)
        distance = distances(index, v, faces, where)
        signed = np.where(index.inside(where), -distance, distance)
        return (np.minimum(signed, distance - thickness) if thickness > 0.0 else signed).astype(np.float32)

    out, triangles = isosurface(field, low, high, cells)
    if len(out):
        lids = distances(index, v, faces, out) > max(thickness, 0.0) + CAP * step
        if lids.any():
            out = smoothed(out, triangles, 30, only=lids)
    return out, triangles


def distances(index: SurfaceIndex, vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Unsigned distances [N] of points [N, 3] from the mesh that `index` was made of."""
    which, barycentric = index.closest(points)
    nearest = np.einsum("nc,ncd->nd", barycentric, vertices[faces[which]])
    return np.linalg.norm(nearest - points, axis=1)


def neighbours_mean(faces: np.ndarray, count: int) -> sparse.csr_matrix:
    """Matrix [count, count] that takes vertex values to the mean of their neighbours'."""
    a, b = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    rows, columns = np.concatenate([a, b]), np.concatenate([b, a])
    matrix = sparse.csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    matrix.data[:] = 1.0
    degree = np.maximum(np.asarray(matrix.sum(1)).ravel(), 1.0)
    return sparse.diags(1.0 / degree) @ matrix


def smoothed(
    vertices: np.ndarray, faces: np.ndarray, iterations: int, *, only: np.ndarray | None = None
) -> np.ndarray:
    """Vertices [V, 3] float32 after Taubin smoothing; where `only` [V] is given, the others stay."""
    mean = neighbours_mean(faces, len(vertices))
    v = np.asarray(vertices, np.float64).copy()
    move = np.ones(len(v), bool) if only is None else only
    for _ in range(iterations):
        for step in TAUBIN:
            v[move] += step * (mean @ v - v)[move]
    return v.astype(np.float32)


def without_crumbs(
    vertices: np.ndarray, faces: np.ndarray, share: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """The mesh without pieces of less than `share` of the largest one's volume, and how many are left."""
    label = face_components(faces)
    volumes = np.asarray(
        [abs(signed_volume(vertices, faces[label == i])) for i in range(int(label.max()) + 1)]
    )
    keep = volumes >= share * volumes.max()
    kept = faces[keep[label]]
    used, compact = np.unique(kept, return_inverse=True)
    return vertices[used], compact.reshape(-1, 3).astype(np.int32), int(keep.sum())


def coloured_like(
    vertices: np.ndarray, faces: np.ndarray, original: SurfaceMesh, messages: tuple[str, ...] = ()
) -> SurfaceMesh:
    """A mesh with each corner coloured as the closest point of `original` that looks the same way."""
    v = np.asarray(vertices, np.float64)
    corner = v[faces]
    points = corner + LEAN * (corner.mean(1, keepdims=True) - corner)
    normals = face_normals(v, faces)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    index = SurfaceIndex(original.vertices, original.faces)
    which, barycentric = index.closest(
        points.reshape(-1, 3), np.repeat(normals, 3, axis=0), reach=0.05 * original.diagonal
    )
    areas = np.repeat(np.linalg.norm(face_normals(v, faces), axis=1) / 6.0, 3)
    rgba = SurfaceColors(original).at(which, barycentric, areas)
    colors = (rgba.reshape(-1, 3, 4) * 255.0 + 0.5).astype(np.uint8)
    colors[..., 3] = 255
    return mesh_of(vertices, faces, colors, original.source, original.sha256, messages)


def mesh_of(
    vertices: np.ndarray,
    faces: np.ndarray,
    colors: np.ndarray,
    source: str = "",
    sha256: str = "",
    messages: tuple[str, ...] = (),
) -> SurfaceMesh:
    """A mesh with corner colours [F, 3, 4] uint8 and no texture."""
    return SurfaceMesh(
        np.ascontiguousarray(vertices, np.float32),
        np.ascontiguousarray(faces, np.int32),
        None,
        np.ascontiguousarray(colors),
        np.zeros(len(faces), np.int32),
        (MeshMaterial("prior", (1.0, 1.0, 1.0, 1.0)),),
        source,
        sha256,
        messages,
    )


__all__ = ["coloured_like", "distances", "mesh_of", "neighbours_mean", "smoothed", "solid", "without_crumbs"]
