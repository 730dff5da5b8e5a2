"""Orders of projected Gaussians by depth."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp

from gdpro_sim.device import launch_ranges, thread_count
from gdpro_sim.kernels import sorting as kernels
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array

PART = 1 << 14
"""Fewest Gaussians worth a part of the sort (and so a thread)."""


def keys_and_order(cameras: int, count: int, device: torch.device) -> tuple[torch.Tensor, torch.Tensor]:
    """Memory for depths float32 and numbers int32 of `count` Gaussians for each camera, for `sort_by_depth`.

    Rows are longer where the sort needs room: the first `count` columns count.
    """
    width = count if device.type == "cpu" else 2 * count
    keys = buffers.empty((cameras, width), torch.float32, device)
    return keys, buffers.empty((cameras, width), torch.int32, device)


def sort_by_depth(keys: torch.Tensor, order: torch.Tensor, count: int) -> None:
    """Sort the numbers in each row of `order` by `keys` >= 0, in place; equal ones stay as they are.

    Both as `keys_and_order` makes them; `keys` is spent.
    """
    cameras = len(keys)
    if count == 0 or cameras == 0:
        return
    if keys.device.type != "cpu":
        for camera in range(cameras):
            sort_pairs(keys[camera], order[camera], count)
        return
    pairs = buffers.empty((2, count), torch.int64, keys.device)
    parts = max(1, min(thread_count(), count // PART))
    counts = torch.empty((parts, kernels.BUCKETS), dtype=torch.int32)
    counts_array = array(counts, wp.int32)
    for camera in range(cameras):
        arrays = [
            array(keys[camera], wp.float32),
            array(order[camera], wp.int32),
            array(pairs, wp.int64),
        ]
        if parts == 1:
            launch_ranges(kernels.sort_alone, [0, 1], arrays)
            continue
        for number in range(kernels.DIGITS):
            given = [parts, number, *arrays, counts_array]
            launch_ranges(kernels.count_digits, range(parts + 1), given)
            launch_ranges(kernels.move_pairs, range(parts + 1), given)


def sort_pairs(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int = 32) -> None:
    """Sort `values` [2 count] with their `keys` [2 count] by the keys' lowest `bits`; stable, in place."""
    keys_array: Any = wp.from_torch(keys)
    values_array: Any = wp.from_torch(values)
    wp.utils.radix_sort_pairs(keys_array, values_array, count, end_bit=bits)


__all__ = ["keys_and_order", "sort_by_depth", "sort_pairs"]
