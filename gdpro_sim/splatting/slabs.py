"""Runs a tile kernel that adds to Gaussians, over CPU threads, to the same bits for any number of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
import warp as wp

from gdpro_sim.device import run_chunks, thread_count
from gdpro_sim.kernels import slabs as kernels
from gdpro_sim.kernels.projection import vec4s
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.projection import View, array
from gdpro_sim.splatting.tiles import TileLists

TILE_WORK = 32
"""What a tile costs beside its entries, in entries."""


def balanced_slabs(begins: torch.Tensor, ends: torch.Tensor, slabs: int) -> list[int]:
    """Bounds [slabs + 1] of consecutive runs of tiles with about equally many entries begins[t] .. ends[t]."""
    tiles = len(begins)
    work = torch.cumsum(ends.to(torch.int64) - begins + TILE_WORK, 0)
    shares = torch.arange(1, slabs) * int(work[-1]) // slabs
    return [0, *torch.searchsorted(work, shares).tolist(), tiles]


def add_over_tiles(
    launch: Callable[[int, int, list[Any]], None],
    module: Any,
    lists: TileLists,
    stops: torch.Tensor,
    rects: torch.Tensor,
    view: View,
    width: int,
) -> torch.Tensor:
    """Sums [M, width] float32 of what the tiles add to each of M Gaussians.

    `launch(first, last, arguments)` runs a kernel of `module` over tiles first .. last - 1 with these last
    arguments: rects, slab begin, slab end, spill begins [tiles], sums [M, width], spill ids, spills
    [spills, width]. The kernel must add to `sums` where the Gaussian touches tiles of the slab alone, and
    else write the next of its tile's spills; it may leave out what adds nothing.
    """
    tiles = len(lists.offsets) - 1
    columns, rows = view.tiles
    rects_array = array(rects, vec4s)
    sums = buffers.empty((len(rects), width), torch.float32, rects.device).zero_()
    sums_array = array(sums, wp.float32)
    slabs = min(thread_count(), tiles)
    if slabs == 1:
        none = torch.empty(0, dtype=torch.int32)
        spills = torch.empty(0, width)
        arguments = [array(none, wp.int32), sums_array, array(none, wp.int32), array(spills, wp.float32)]
        launch(0, tiles, [rects_array, 0, tiles, *arguments])
        return sums
    wp.load_module(module, device="cpu")
    wp.load_module(kernels, device="cpu")
    bounds = balanced_slabs(lists.offsets[:-1], stops, slabs)
    counts = torch.zeros(tiles, dtype=torch.int32)

    def count(first: int, last: int) -> None:
        for slab in range(first, last):
            begin, end = bounds[slab], bounds[slab + 1]
            inputs = [
                array(lists.offsets, wp.int32),
                array(stops, wp.int32),
                array(lists.ids, wp.int32),
                rects_array,
                columns,
                rows,
                begin,
                end,
                array(counts, wp.int32),
            ]
            if begin < end:
                wp.launch(kernels.count_spills, dim=end - begin, inputs=[begin, *inputs], device="cpu")

    run_chunks(count, slabs)
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    total = int(ends[-1])
    begins = (ends - counts).to(torch.int32)
    spill_ids = torch.full((total,), -1, dtype=torch.int32)
    spills = buffers.empty((total, width), torch.float32, rects.device)
    arguments = [
        array(begins, wp.int32),
        sums_array,
        array(spill_ids, wp.int32),
        array(spills, wp.float32),
    ]

    def run(first: int, last: int) -> None:
        for slab in range(first, last):
            begin, end = bounds[slab], bounds[slab + 1]
            if begin < end:
                launch(begin, end, [rects_array, begin, end, *arguments])

    run_chunks(run, slabs)
    parts = slabs if total > 4096 else 1
    inputs = [parts, array(spill_ids, wp.int32), array(spills, wp.float32), sums_array]

    def merge(first: int, last: int) -> None:
        wp.launch(kernels.merge_spills, dim=last - first, inputs=[first, *inputs], device="cpu")

    run_chunks(merge, parts)
    return sums


__all__ = ["add_over_tiles", "balanced_slabs"]
