"""Third stage: tile lists and records -> images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
import warp as wp

from gdpro_sim.device import device_name, launch_chunked, run_chunks, thread_count
from gdpro_sim.kernels import compositing as kernels
from gdpro_sim.kernels.projection import CHANNELS
from gdpro_sim.splatting.projection import Projection, View, array, pack_channels
from gdpro_sim.splatting.tiles import TileLists

GROUP = 4
"""Channels blended at once."""


@dataclass(frozen=True)
class Composite:
    """What blending leaves.

    image:         [C, H, W, D] float32
    alphas:        [C, H, W, 1] float32, 1 - transmittance
    transmittance: [C, H, W] float32 after the last Gaussian blended
    stops:         int32 list positions after the last Gaussian looked at: [C rows columns] for each tile from
                   `tile=True`, [C, H, W] for each pixel (after the last Gaussian blended) otherwise
    """

    image: torch.Tensor
    alphas: torch.Tensor
    transmittance: torch.Tensor
    stops: torch.Tensor


def composite(
    projection: Projection,
    lists: TileLists,
    features: torch.Tensor | None,
    backgrounds: torch.Tensor,
    divided: int,
    view: View,
    *,
    tile: bool,
) -> Composite:
    """Blend D channels over `backgrounds` [C, D]; channel `divided` is divided by alpha instead (-1: none).

    The first four channels are those of the records; later ones from `features` [N or C N, F], then depth.
    `tile` chooses the CPU kernel (one index per tile), else one index per pixel.
    """
    cameras, channels = backgrounds.shape
    columns, rows = view.tiles
    tiles = cameras * rows * columns
    device = backgrounds.device
    pixels = cameras * view.height * view.width
    image = backgrounds.new_empty((pixels, channels))
    alphas = backgrounds.new_empty(pixels)
    transmittance = backgrounds.new_empty(pixels)
    stops = torch.empty(tiles if tile else pixels, dtype=torch.int32, device=device)
    records = array(projection.records, wp.float32)
    outputs = [
        array(image, wp.float32),
        array(alphas, wp.float32),
        array(transmittance, wp.float32),
        array(stops, wp.int32),
    ]
    for first in range(0, channels, GROUP):
        if first == 0:
            source, offset = records, int(CHANNELS)
        else:
            assert features is not None
            source, offset = array(pack_channels(projection, features, first), wp.float32), 0
        inputs = [
            records,
            source,
            offset,
            array(lists.offsets, wp.int32),
            array(lists.ids, wp.int32),
            array(backgrounds, wp.float32),
            view.width,
            view.height,
            first,
            min(GROUP, channels - first),
            divided - first,
        ]
        if tile:
            _launch_balanced(lists.offsets, [*inputs, *outputs])
        else:
            count = tiles * int(kernels.TILE) ** 2
            launch_chunked(kernels.composite_pixel, count, inputs, outputs, device=device_name(backgrounds))
    size = (cameras, view.height, view.width)
    return Composite(
        image.view(*size, channels),
        alphas.view(*size, 1),
        transmittance.view(size),
        stops if tile else stops.view(size),
    )


def _launch_balanced(offsets: torch.Tensor, arguments: list[object]) -> None:
    """One launch per thread, over runs of tiles with about equally many entries (an empty tile counts 32)."""
    tiles = len(offsets) - 1
    threads = thread_count()
    if threads == 1:
        wp.launch(kernels.composite_tile, dim=tiles, inputs=[0, *arguments], device="cpu")
        return
    wp.load_module(kernels, device="cpu")
    pieces = min(tiles, 64 * threads)
    work = offsets.to(torch.int64) + 32 * torch.arange(tiles + 1)
    shares = torch.arange(1, pieces) * int(work[-1]) // pieces
    bounds = [0, *torch.searchsorted(work, shares).tolist(), tiles]

    def launch(begin: int, end: int) -> None:
        first, last = bounds[begin], bounds[end]
        if first < last:
            wp.launch(kernels.composite_tile, dim=last - first, inputs=[first, *arguments], device="cpu")

    run_chunks(launch, pieces)


__all__ = ["Composite", "composite"]
