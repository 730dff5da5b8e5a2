"""The fixed sparsity of the tangent matrix, and which element blocks add into which entry. Built once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Element blocks are stored row by row for a <= b:
# (0,0) (0,1) (0,2) (0,3) (1,1) (1,2) (1,3) (2,2) (2,3) (3,3).
UPPER_PAIRS = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
UPPER_SLOTS = (1, 2, 3, 5, 6, 8)
BLOCKS_PER_ELEMENT = 10


@dataclass(frozen=True)
class Topology:
    """Compressed 3x3 block rows over P vertices and T tets; all int32.

    offsets, columns:  [P + 1], [N] block rows, columns ascending
    diagonal:          [P] index of entry (i, i) in the rows
    upper, lower:      [M] index of entries (i, j) and (j, i), i < j
    pair_offsets:      [M + 1] into pair_blocks
    pair_blocks:       2 * (10 * element + slot) + (1 if the block enters (i, j) transposed)
    corner_offsets:    [P + 1] into corners
    corners:           4 * element + corner, ascending, of each vertex
    """

    offsets: np.ndarray
    columns: np.ndarray
    diagonal: np.ndarray
    upper: np.ndarray
    lower: np.ndarray
    pair_offsets: np.ndarray
    pair_blocks: np.ndarray
    corner_offsets: np.ndarray
    corners: np.ndarray


def build_topology(tets: np.ndarray, vertex_count: int) -> Topology:
    """Sparsity and gather maps of linear tets; tets [T, 4] int32, vertex ids below `vertex_count`."""
    tets = tets.astype(np.int64)
    element = np.arange(len(tets), dtype=np.int64)

    corners = np.argsort(tets.reshape(-1), kind="stable")
    corner_offsets = _offsets(tets.reshape(-1), vertex_count)

    first = np.concatenate([tets[:, a] for a, _ in UPPER_PAIRS])
    second = np.concatenate([tets[:, b] for _, b in UPPER_PAIRS])
    block = np.concatenate([BLOCKS_PER_ELEMENT * element + slot for slot in UPPER_SLOTS])
    flipped = first > second
    low, high = np.minimum(first, second), np.maximum(first, second)
    order = np.lexsort((block, high, low))
    keys = (low * vertex_count + high)[order]
    unique, begin = np.unique(keys, return_index=True)
    pair_offsets = np.append(begin, len(keys))
    pair_blocks = (2 * block + flipped)[order]

    row, column = unique // vertex_count, unique % vertex_count
    own = np.arange(vertex_count, dtype=np.int64)
    entries = np.concatenate(
        [row * vertex_count + column, column * vertex_count + row, own * vertex_count + own]
    )
    place = np.empty(len(entries), dtype=np.int64)
    sorting = np.argsort(entries, kind="stable")
    place[sorting] = np.arange(len(entries))
    pairs = len(unique)

    return Topology(
        offsets=_offsets(entries // vertex_count, vertex_count),
        columns=_int32(entries[sorting] % vertex_count),
        diagonal=_int32(place[2 * pairs :]),
        upper=_int32(place[:pairs]),
        lower=_int32(place[pairs : 2 * pairs]),
        pair_offsets=_int32(pair_offsets),
        pair_blocks=_int32(pair_blocks),
        corner_offsets=corner_offsets,
        corners=_int32(corners),
    )


def _offsets(rows: np.ndarray, count: int) -> np.ndarray:
    return _int32(np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=count))]))


def _int32(values: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(values, dtype=np.int32)


__all__ = ["BLOCKS_PER_ELEMENT", "UPPER_PAIRS", "UPPER_SLOTS", "Topology", "build_topology"]
