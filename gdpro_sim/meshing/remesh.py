"""Fewer or more triangles: quadric decimation, and subdivision that stays conforming."""

from __future__ import annotations

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.repair import check_arrays, clean, edge_keys


def decimate(vertices: np.ndarray, faces: np.ndarray, target_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """Quadric decimation (fast-simplification) to about `target_faces` triangles, cleaned afterwards.

    Takes vertices [V, 3] m and faces [F, 3]; returns the same kinds as float32 and int32. A mesh that has no
    more faces than asked comes back cleaned. Colours do not travel with the triangles: look them up on the
    original surface at the closest point (`gdpro_sim.meshing.proximity.SurfaceIndex.closest`).
    Raises `MeshError` when nothing is left.
    """
    import fast_simplification

    check_arrays(vertices, faces)
    if target_faces < 4:
        raise MeshError(f"target_faces must be >= 4, got {target_faces}")
    v, f = np.asarray(vertices, np.float32), np.asarray(faces, np.int32)
    if len(f) > target_faces:
        # Centred and scaled to unit size: the quadrics' fixed thresholds then mean the same for every mesh.
        low, high = v.min(0).astype(np.float64), v.max(0).astype(np.float64)
        centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low)) or 1.0
        unit = (v.astype(np.float64) - centre) / size
        out, kept = unit, np.ascontiguousarray(f)
        for aggression in (5.0, 7.0, 7.0, 10.0, 10.0):  # the first keeps the shape best but may stop short
            out, kept = fast_simplification.simplify(
                out, np.ascontiguousarray(kept), target_count=int(target_faces), agg=aggression
            )
            if len(kept) <= 1.1 * target_faces:
                break
        v, f = (out * size + centre).astype(np.float32), kept.astype(np.int32)
        if not len(f):
            raise MeshError(
                f"decimating {len(faces)} faces to {target_faces} left nothing; ask for more faces"
            )
    return clean(v, f)


def subdivide(
    vertices: np.ndarray, faces: np.ndarray, max_edge: float, *, max_faces: int = 3_000_000
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Split edges longer than `max_edge` metres at their midpoint, in all faces that share them: no
    T-junctions.

    Returns vertices [V', 3] float32 (the old ones first), faces [F', 3] int32, parents [F'] int32 (the
    original face of each) and corners [F', 3, 3] float32 (barycentric coordinates of each corner in its
    parent, so any per-corner attribute is `einsum("fcp,fp...->fc...", corners, attribute[parents])`).
    Raises `MeshError` when more than `max_faces` would be needed.
    """
    check_arrays(vertices, faces)
    if not max_edge > 0.0:
        raise MeshError(f"max_edge must be > 0 m, got {max_edge}")
    v, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    parents = np.arange(len(f))
    corners = np.broadcast_to(np.eye(3), (len(f), 3, 3)).copy()
    while True:
        keys, _ = edge_keys(f)
        unique, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
        start, end = f.ravel()[first], f[:, [1, 2, 0]].ravel()[first]
        long = np.linalg.norm(v[start] - v[end], axis=1) > max_edge * (1.0 + 1e-9)
        if not long.any():
            break
        middle = np.full(len(unique), -1, np.int64)
        middle[long] = len(v) + np.arange(int(long.sum()))
        v = np.concatenate([v, 0.5 * (v[start[long]] + v[end[long]])])
        f, parents, corners = _split(v, f, middle[inverse].reshape(-1, 3), parents, corners)
        if len(f) > max_faces:
            raise MeshError(f"edges of {max_edge:g} m need more than {max_faces} faces; choose a longer edge")
    return v.astype(np.float32), f.astype(np.int32), parents.astype(np.int32), corners.astype(np.float32)


def _split(
    v: np.ndarray, f: np.ndarray, middles: np.ndarray, parents: np.ndarray, corners: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """One round: `middles` [F, 3] is the new vertex on the edge from corner i to i + 1, or -1."""
    split = middles >= 0
    count = split.sum(1)
    out_f, out_p, out_c = [f[count == 0]], [parents[count == 0]], [corners[count == 0]]

    def emit(
        rows: np.ndarray, ids: np.ndarray, weights: np.ndarray, pattern: list[tuple[int, int, int]]
    ) -> None:
        for triple in pattern:
            out_f.append(ids[:, triple])
            out_p.append(parents[rows])
            out_c.append(weights[:, triple])

    def turned(rows: np.ndarray, shift: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Local ids 0, 1, 2 (corners) and 3, 4, 5 (middles of 01, 12, 20), corners rotated by `shift`."""
        order = (np.arange(3) + shift[:, None]) % 3
        ids = np.take_along_axis(f[rows], order, 1)
        weights = np.take_along_axis(corners[rows], order[:, :, None], 1)
        mids = np.take_along_axis(middles[rows], order, 1)
        return np.concatenate([ids, mids], 1), np.concatenate(
            [weights, 0.5 * (weights + weights[:, [1, 2, 0]])], 1
        )

    rows = np.flatnonzero(count == 1)
    ids, weights = turned(rows, np.argmax(split[rows], 1))
    emit(rows, ids, weights, [(0, 3, 2), (3, 1, 2)])
    rows = np.flatnonzero(count == 2)
    # Turned so that the whole edge is 01: middles 4 (on 12) and 5 (on 20); then the shorter diagonal.
    ids, weights = turned(rows, np.argmin(split[rows], 1))
    shorter = np.linalg.norm(v[ids[:, 0]] - v[ids[:, 4]], axis=1) <= np.linalg.norm(
        v[ids[:, 1]] - v[ids[:, 5]], axis=1
    )
    emit(rows[shorter], ids[shorter], weights[shorter], [(4, 2, 5), (0, 1, 4), (0, 4, 5)])
    emit(rows[~shorter], ids[~shorter], weights[~shorter], [(4, 2, 5), (0, 1, 5), (1, 4, 5)])
    rows = np.flatnonzero(count == 3)
    ids, weights = turned(rows, np.zeros(len(rows), np.int64))
    emit(rows, ids, weights, [(0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)])
    f, parents, corners = np.concatenate(out_f), np.concatenate(out_p), np.concatenate(out_c)
    order = np.argsort(parents, kind="stable")
    return f[order], parents[order], corners[order]


__all__ = ["decimate", "subdivide"]
