"""Runs a tile kernel that adds to Gaussians, over CPU threads, to the same bits for any number of them."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from gdpro_sim.device import PIECES, launch_chunked, launch_ranges, thread_count
from gdpro_sim.kernels import slabs as kernels
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.tiles import TileLists

TILE_WORK = 32
"""What a tile costs beside its entries, in entries."""

SMALLEST_PIECE = 32
"""Tiles worth a launch of their own."""

SMALLEST_SLAB = 4
"""Rows of tiles worth a slab: in fewer nearly every Gaussian would touch another slab, and be spilled."""

SMALLEST_CLEARED = 8
"""Runs of zeros worth a piece of their own."""

SMALLEST_MERGE = 1 << 15
"""Entries whose spills are worth merging on several threads."""


def balanced_slabs(begins: torch.Tensor, ends: torch.Tensor, slabs: int) -> list[int]:
    """Bounds [slabs + 1] of runs of tiles with about equally many entries, begins[t] .. ends[t] - 1."""
    bounds = torch.empty(slabs + 1, dtype=torch.int32)
    arrays = [array(each, wp.int32) for each in (begins, ends)]
    launch_ranges(kernels.balance, [0, 1], [*arrays, TILE_WORK, array(bounds, wp.int32)])
    return bounds.tolist()


def launch_tiles(kernel: wp.Kernel, offsets: torch.Tensor, arguments: list[Any]) -> None:
    """Run a CPU kernel once per tile, in runs of tiles with about equally many entries, a few per thread."""
    threads, tiles = thread_count(), len(offsets) - 1
    if tiles == 0:
        return
    pieces = 1 if threads == 1 else min(PIECES * threads, -(-tiles // SMALLEST_PIECE))
    launch_ranges(kernel, balanced_slabs(offsets[:-1], offsets[1:], pieces), arguments)


def add_over_tiles(
    kernel: wp.Kernel,
    inputs: list[Any],
    lists: TileLists,
    stops: torch.Tensor,
    columns: int,
    shape: tuple[int, int],
) -> torch.Tensor:
    """Sums float32 of `shape`, M and width, of what the tiles add to each of M Gaussians.

    `kernel` runs on a CPU once per tile, with the arguments: first tile of the launch, `inputs`, first
    and end tile of the slab, where each tile's spills begin [tiles + 1], sums [M, width], spill ids [E] and
    spills [E, width]. It must add to the sums where the Gaussian touches tiles of the slab alone, and else
    write the next of its tile's spills; it may leave out what adds nothing. `columns` tiles make a row.
    """
    tiles = len(lists.offsets) - 1
    width, device = shape[1], stops.device
    sums = buffers.empty(shape, torch.float32, device)
    sums_array = array(sums, wp.float32)
    cleared = -(-sums.numel() // kernels.CLEARED)
    launch_chunked(kernels.clear, cleared, [], [sums_array], device="cpu", minimum=SMALLEST_CLEARED)
    slabs = max(1, min(thread_count(), tiles // (SMALLEST_SLAB * columns)))
    if slabs == 1:
        none = torch.empty(0, dtype=torch.int32)
        spills = torch.empty(0, width)
        arguments = [array(none, wp.int32), sums_array, array(none, wp.int32), array(spills, wp.float32)]
        launch_ranges(kernel, [0, tiles], [*inputs, 0, tiles, *arguments])
        return sums
    bounds = balanced_slabs(lists.offsets[:-1], stops, slabs)
    # A tile spills no more than its entries, so its spills have place at their numbers. Most of this
    # memory is never touched.
    entries = len(lists.ids)
    spill_ids = buffers.empty((entries,), torch.int32, device).fill_(-1)
    spills = buffers.empty((entries, width), torch.float32, device)
    spills_array = [array(spill_ids, wp.int32), array(spills, wp.float32)]
    arguments = [array(lists.offsets, wp.int32), sums_array, *spills_array]

    whole = [*inputs, 0, tiles, *arguments]
    launch_ranges(kernel, bounds, whole, {"slab_begin": bounds[:-1], "slab_end": bounds[1:]})
    parts = thread_count() if entries >= SMALLEST_MERGE else 1
    spilled = [parts, array(lists.offsets, wp.int32), *spills_array, sums_array]
    launch_ranges(kernels.merge_spills, range(parts + 1), spilled)
    return sums


__all__ = ["add_over_tiles", "launch_tiles"]
