"""Carry a surface with a tet mesh: unclamped barycentric coordinates of each vertex in its nearest tet."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.tetmesh import Embedding, TetMesh

WEIGHT_LIMIT = 4.0
"""A weight beyond this marks a sliver that would amplify motion; another tet near by is taken then."""

CHUNK = 20_000
CANDIDATES = 48


def embed_surface(tetmesh: TetMesh, vertices: np.ndarray) -> Embedding:
    """Embed surface vertices [V, 3] m: the tet that holds each, or the nearest one, with unclamped weights.

    A moved vertex is `einsum("vw,vwc->vc", weights, moved[tets[tet_ids]])`. At rest that gives the vertex
    back, for vertices outside too, because weights extrapolate. Raises `MeshError` for non-finite vertices.
    """
    points = np.asarray(vertices, np.float64)
    if points.ndim != 2 or points.shape[1] != 3:
        raise MeshError(f"vertices to embed must have shape [V, 3], got {points.shape}")
    if not np.isfinite(points).all():
        raise MeshError("vertices to embed hold NaN or infinite values")
    if not len(tetmesh.tets):
        raise MeshError("cannot embed a surface in a tet mesh without tets")
    corner, inverse, origin = _frames(tetmesh)
    tet_ids = _containing(corner, inverse, origin, points)
    outside = np.flatnonzero(tet_ids < 0)
    if len(outside):
        faces, owners = boundary(tetmesh.tets)
        near, _ = SurfaceIndex(tetmesh.vertices, faces).closest(points[outside])
        tet_ids[outside] = owners[near]
    weights = _weights(inverse, origin, tet_ids, points)
    wild = np.flatnonzero(np.abs(weights).max(1) > WEIGHT_LIMIT)
    if len(wild):
        count = min(CANDIDATES, len(corner))
        near = cKDTree(corner.mean(1)).query(points[wild], k=count)[1].reshape(len(wild), count)
        options = _weights(inverse, origin, near.ravel(), np.repeat(points[wild], count, axis=0))
        options = options.reshape(len(wild), count, 4)
        best = np.abs(options).max(2).argmin(1)
        rows = np.arange(len(wild))
        better = np.abs(options[rows, best]).max(1) < np.abs(weights[wild]).max(1)
        tet_ids[wild[better]] = near[rows, best][better]
        weights[wild[better]] = options[rows, best][better]
    return Embedding(tet_ids.astype(np.int32), _float32_rows(weights))


def containing_tets(tetmesh: TetMesh, points: np.ndarray) -> np.ndarray:
    """The tet that each point [N, 3] m lies in, -1 for none; int64 [N]."""
    return _containing(*_frames(tetmesh), np.asarray(points, np.float64))


def boundary(tets: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward triangles [B, 3] int32 that belong to one tet only, and that tet [B]."""
    faces = tets[:, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]].reshape(-1, 3)
    key = np.sort(faces, axis=1)
    _, first, counts = np.unique(key, axis=0, return_index=True, return_counts=True)
    single = np.sort(first[counts == 1])
    return np.ascontiguousarray(faces[single], np.int32), single // 4


def _frames(tetmesh: TetMesh) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Corners [T, 4, 3], inverse edge matrices [T, 3, 3] and first corners [T, 3], float64."""
    corner = tetmesh.vertices.astype(np.float64)[tetmesh.tets]
    return corner, np.linalg.inv(np.swapaxes(corner[:, 1:] - corner[:, :1], 1, 2)), corner[:, 0]


def _weights(inverse: np.ndarray, origin: np.ndarray, tet_ids: np.ndarray, points: np.ndarray) -> np.ndarray:
    rest = np.einsum("nij,nj->ni", inverse[tet_ids], points - origin[tet_ids])
    return np.concatenate([1.0 - rest.sum(1, keepdims=True), rest], axis=1)


def _containing(
    corner: np.ndarray, inverse: np.ndarray, origin: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """The tet that holds each point, -1 for none: a uniform grid lists the tets whose boxes reach each
    cell."""
    low, high = corner.min(1), corner.max(1)
    base = low.min(0)
    extent = np.maximum(high.max(0) - base, 1e-30)
    size = float((extent.prod() / len(corner)) ** (1.0 / 3.0)) or float(extent.max())
    shape = np.clip(np.ceil(extent / size), 1, 128).astype(np.int64)
    cell = extent / shape
    first = np.clip(((low - base) / cell).astype(np.int64), 0, shape - 1)
    last = np.clip(((high - base) / cell).astype(np.int64), 0, shape - 1)
    span = last - first + 1
    owners, local = _expand(span.prod(1))
    x = local // (span[owners, 1] * span[owners, 2])
    y = local // span[owners, 2] % span[owners, 1]
    z = local % span[owners, 2]
    keys = np.ravel_multi_index(tuple((first[owners] + np.stack([x, y, z], 1)).T), tuple(shape))
    order = np.argsort(keys, kind="stable")
    listed = owners[order]
    starts = np.searchsorted(keys[order], np.arange(int(shape.prod()) + 1))

    out = np.full(len(points), -1, np.int64)
    where = np.floor((points - base) / cell).astype(np.int64)
    inside = np.flatnonzero(((where >= 0) & (where < shape)).all(1))
    for begin in range(0, len(inside), CHUNK):
        rows = inside[begin : begin + CHUNK]
        key = np.ravel_multi_index(tuple(where[rows].T), tuple(shape))
        who, step = _expand(starts[key + 1] - starts[key])
        tets = listed[starts[key][who] + step]
        depth = _weights(inverse, origin, tets, points[rows[who]]).min(1)
        good = depth >= -1e-9
        who, tets, depth = who[good], tets[good], depth[good]
        best = np.lexsort((depth, who))  # the last of each point is the deepest
        out[rows[who[best]]] = tets[best]
    return out


def _expand(counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For each i, counts[i] rows: (i repeated, 0 .. counts[i] - 1)."""
    owner = np.repeat(np.arange(len(counts)), counts)
    return owner, np.arange(len(owner)) - np.repeat(np.cumsum(counts) - counts, counts)


def _float32_rows(weights: np.ndarray) -> np.ndarray:
    """Round to float32 so that each row still sums to 1: the largest weight takes up the rounding."""
    out = weights.astype(np.float32)
    rows, largest = np.arange(len(out)), np.abs(weights).argmax(1)
    rest = out.astype(np.float64)
    rest[rows, largest] = 0.0
    out[rows, largest] = 1.0 - rest.sum(1)
    return out


__all__ = ["boundary", "containing_tets", "embed_surface"]
