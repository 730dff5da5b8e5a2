"""Marching cubes over the cells near a signed-distance field's surface, coarse to fine.

The case tables are Warp's (`warp.geometry.IsoSurfaceMarchingCubes`). The result is closed: a cell next to a
crossing is added until none is missing.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np

CHUNK = 1 << 15
"""Points a field is asked for at once: temporaries stay in the cache."""

SAFETY = 1.4
"""Cells are kept up to this many half diagonals from the surface; 1 would do for exact distances."""


def evaluate(field: Callable[[np.ndarray], np.ndarray], points: np.ndarray) -> np.ndarray:
    """Field values [N] at points [3, N], float32."""
    out = np.empty(points.shape[1], np.float32)
    for start in range(0, points.shape[1], CHUNK):
        part = slice(start, start + CHUNK)
        out[part] = field(np.ascontiguousarray(points[:, part], np.float32))
    return out


def isosurface(
    field: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, cells: int
) -> tuple[np.ndarray, np.ndarray]:
    """Surface of `field` <= 0 inside the box: vertices [V, 3] float32 and faces [F, 3] int32, outward.

    cells: across the longest side of the box. The grid reaches two cells beyond the box; its outermost nodes
    count as outside. Vertices are shared and lie on grid edges; an empty surface gives empty arrays.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    step = float((high - low).max()) / cells
    factor = 1
    while cells // (2 * factor) >= 20:
        factor *= 2
    shape = np.ceil((high - low) / step).astype(np.int64) + 4
    shape = -(-shape // factor) * factor
    origin = 0.5 * (low + high) - 0.5 * shape * step
    active = _near_cells(field, origin, step, shape, factor)
    values, active = _node_values(field, origin, step, shape, active)
    return _triangulate(values, origin, step, shape, active)


def _near_cells(
    field: Callable[[np.ndarray], np.ndarray], origin: np.ndarray, step: float, shape: np.ndarray, factor: int
) -> np.ndarray:
    """Cells [M, 3] that may hold the surface, by halving coarse ones."""
    cells = np.indices(tuple(shape // factor)).reshape(3, -1)
    children = np.indices((2, 2, 2)).reshape(3, 1, 8)
    while factor > 1:
        centres = origin[:, None] + (cells + 0.5) * (step * factor)
        near = np.abs(evaluate(field, centres)) <= SAFETY * 0.5 * np.sqrt(3.0) * step * factor
        cells = (2 * cells[:, near, None] + children).reshape(3, -1)
        factor //= 2
    return cells


_CORNERS = np.asarray([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def _node_values(
    field: Callable[[np.ndarray], np.ndarray],
    origin: np.ndarray,
    step: float,
    shape: np.ndarray,
    cells: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Field on the grid's nodes (NaN where nobody asked) and the cells [3, M] that the surface crosses."""
    nodes = shape + 1
    values = np.full(tuple(nodes), np.nan, np.float32)
    flat = values.reshape(-1)
    offsets = np.ravel_multi_index(_CORNERS.T, tuple(nodes))
    taken = np.zeros(tuple(shape), bool)
    crossed = []
    while cells.shape[1]:
        taken[tuple(cells)] = True
        corner = np.ravel_multi_index(tuple(cells), tuple(nodes))[:, None] + offsets
        wanted = np.zeros(flat.size, bool)
        wanted[corner.ravel()] = True
        wanted &= np.isnan(flat)
        index = np.flatnonzero(wanted)
        place = np.stack(np.unravel_index(index, tuple(nodes)))
        found = evaluate(field, origin[:, None] + place * step)
        # A node on the surface would give faces without area.
        least = np.float32(1e-3 * step)
        found = np.where(np.abs(found) < least, np.where(found <= 0, -least, least), found)
        rim = ((place == 0) | (place == shape[:, None])).any(0)
        flat[index] = np.where(rim, np.maximum(found, least), found)
        inside = flat[corner] < 0
        mixed = inside.any(1) & ~inside.all(1)
        crossed.append(cells[:, mixed])
        cells = _missing(cells[:, mixed], inside[mixed], taken)
    return values, np.concatenate(crossed, axis=1)


def _missing(cells: np.ndarray, inside: np.ndarray, taken: np.ndarray) -> np.ndarray:
    """Neighbours [3, M] not yet looked at, across faces that the surface crosses."""
    found = []
    for axis in range(3):
        for side in (0, 1):
            on_face = inside[:, _CORNERS[:, axis] == side]
            over = on_face.any(1) & ~on_face.all(1)
            neighbour = cells[:, over].copy()
            neighbour[axis] += 2 * side - 1
            neighbour = neighbour[:, (neighbour[axis] >= 0) & (neighbour[axis] < taken.shape[axis])]
            neighbour = neighbour[:, ~taken[tuple(neighbour)]]
            found.append(np.ravel_multi_index(tuple(neighbour), taken.shape))
    return np.stack(np.unravel_index(np.unique(np.concatenate(found)), taken.shape))


@cache
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Warp's tables: corner offsets [8, 3], edge corners [12, 2], first entry of a case [257], edges."""
    from warp.geometry import IsoSurfaceMarchingCubes as Cubes

    return (
        np.asarray(Cubes.CUBE_CORNER_OFFSETS),
        np.asarray(Cubes.EDGE_TO_CORNERS),
        np.asarray(Cubes.CASE_TO_TRI_RANGE),
        np.asarray(Cubes.TRI_LOCAL_INDICES),
    )


def _triangulate(
    values: np.ndarray, origin: np.ndarray, step: float, shape: np.ndarray, cells: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    corners, edges, first, local = _tables()
    nodes = tuple(shape + 1)
    flat = values.reshape(-1)
    order = np.argsort(np.ravel_multi_index(tuple(cells), tuple(shape)), kind="stable")
    base = np.ravel_multi_index(tuple(cells[:, order]), nodes)
    corner_offset = np.ravel_multi_index(corners.T, nodes)
    case = ((flat[base[:, None] + corner_offset] < 0) << np.arange(8)).sum(1)
    count = first[case + 1] - first[case]
    cell = np.repeat(np.arange(len(base)), count)
    entry = np.arange(len(cell)) - np.repeat(np.cumsum(count) - count, count)
    edge = local[np.repeat(first[case], count) + entry]
    # An edge is its lower node and its axis.
    start = corner_offset[edges].min(1)
    axis = np.abs(corners[edges[:, 1]] - corners[edges[:, 0]]).argmax(1)
    key = (base[cell] + start[edge]) * 3 + axis[edge]
    unique, faces = np.unique(key, return_inverse=True)
    low_node, along = unique // 3, unique % 3
    stride = np.asarray([nodes[1] * nodes[2], nodes[2], 1])
    a, b = flat[low_node].astype(np.float64), flat[low_node + stride[along]].astype(np.float64)
    place = np.stack(np.unravel_index(low_node, nodes), 1).astype(np.float64)
    place[np.arange(len(place)), along] += a / (a - b)
    vertices = (origin + place * step).astype(np.float32)
    return vertices, np.ascontiguousarray(faces.reshape(-1, 3)[:, ::-1], dtype=np.int32)


__all__ = ["evaluate", "isosurface"]
