"""Second stage: projected Gaussians -> for each tile, the list of those that touch it, front to back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from gdpro_sim.device import device_name, launch_chunked, thread_count
from gdpro_sim.kernels import tiles as kernels
from gdpro_sim.kernels.projection import vec4s
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.checks import INDEX_LIMIT, check_count
from gdpro_sim.splatting.projection import Projected, View
from gdpro_sim.splatting.sorting import sort_pairs

PART = 4096
"""Fewest Gaussians worth a part (and so a thread) of the counting sort."""


@dataclass(frozen=True)
class TileLists:
    """Lists of C x rows x columns tiles; tile t holds ids[offsets[t] : offsets[t + 1]].

    offsets: [C rows columns + 1] int32
    ids:     [E] int32, record numbers
    """

    offsets: torch.Tensor
    ids: torch.Tensor


def empty_lists(cameras: int, view: View, device: torch.device) -> TileLists:
    columns, rows = view.tiles
    return TileLists(
        torch.zeros(cameras * rows * columns + 1, dtype=torch.int32, device=device),
        torch.empty(0, dtype=torch.int32, device=device),
    )


def _order(projection: Projected) -> torch.Tensor:
    if projection.order is None:
        raise ValueError("the depth order of this projection is gone: its tile lists are made already")
    return projection.order


def count_and_fill(projection: Projected, view: View, limit: int = INDEX_LIMIT) -> TileLists:
    """Counting sort, for CPUs; the lists do not depend on the number of threads.

    Raises RequestError where more than `limit` entries are needed.
    """
    columns, rows = view.tiles
    tiles = projection.cameras * rows * columns
    parts = max(1, min(thread_count(), projection.gaussians // PART))
    rects = array(projection.rects, vec4s)
    order = array(_order(projection), wp.int32)
    counts = torch.zeros((parts, tiles), dtype=torch.int32)
    offsets = torch.empty(tiles + 1, dtype=torch.int32)
    entries = torch.empty(1, dtype=torch.int64)
    inputs = [order, rects, parts, columns, rows]
    counts_array = array(counts, wp.int32)
    launch_chunked(kernels.count_tiles, parts, inputs, [counts_array], device="cpu", minimum=1)
    outputs = [counts_array, array(offsets, wp.int32), array(entries, wp.int64)]
    launch_chunked(kernels.scan_tiles, 1, [], outputs, device="cpu")
    total = check_count("tile list entries", int(entries), limit)
    ids = buffers.empty((total,), torch.int32, offsets.device)
    outputs = [counts_array, array(ids, wp.int32)]
    launch_chunked(kernels.fill_tiles, parts, inputs, outputs, device="cpu", minimum=1)
    return TileLists(offsets, ids)


def expand_and_sort(projection: Projected, view: View, limit: int = INDEX_LIMIT) -> TileLists:
    """The same lists from pairs in depth order and a stable radix sort by tile, for GPUs.

    Raises RequestError where more than `limit` entries are needed.
    """
    columns, rows = view.tiles
    tiles = projection.cameras * rows * columns
    total = len(projection.records)
    device = projection.records.device
    name = device_name(projection.records)
    rects = array(projection.rects, vec4s)
    order = array(_order(projection), wp.int32)
    counts = torch.empty(total, dtype=torch.int32, device=device)
    inputs = [order, rects, projection.gaussians]
    launch_chunked(kernels.count_expansion, total, inputs, [array(counts, wp.int32)], device=name)
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    entries = check_count("tile list entries", int(ends[-1]), min(limit, INDEX_LIMIT // 2))
    if entries == 0:
        return empty_lists(projection.cameras, view, device)
    begins = (ends - counts).to(torch.int32)
    keys = torch.empty(2 * entries, dtype=torch.int32, device=device)
    ids = torch.empty(2 * entries, dtype=torch.int32, device=device)
    keys_array = array(keys, wp.int32)
    inputs = [order, rects, projection.gaussians, array(begins, wp.int32), columns, rows]
    launch_chunked(kernels.expand_tiles, total, inputs, [keys_array, array(ids, wp.int32)], device=name)
    bits = max(1, (tiles - 1).bit_length())
    sort_pairs(keys, ids, entries, bits)
    offsets = torch.empty(tiles + 1, dtype=torch.int32, device=device)
    outputs = [array(offsets, wp.int32)]
    launch_chunked(kernels.find_tiles, entries + 1, [keys_array, entries], outputs, device=name)
    return TileLists(offsets, ids[:entries])


__all__ = ["TileLists", "count_and_fill", "empty_lists", "expand_and_sort"]
