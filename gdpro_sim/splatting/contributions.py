"""How much of each image is each Gaussian's."""

from __future__ import annotations

from typing import Any

import torch

from gdpro_sim.device import torch_stream
from gdpro_sim.kernels.projection import CHANNELS
from gdpro_sim.splatting.checks import check_tensor
from gdpro_sim.splatting.compositing import GROUP, Blending, Composite, gradient_sums
from gdpro_sim.splatting.projection import Projection
from gdpro_sim.splatting.tiles import TileLists


def contributions(meta: dict[str, Any], values: torch.Tensor | None = None) -> torch.Tensor:
    """Sum over pixels of each Gaussian's blending weight alpha T, after `rasterization` has given `meta`.

    Returns [C, N] float32, or where `values` [C, H, W, D] is given [C, N, D], the sum of weight times value:
    divided by the former, the mean of what the Gaussian shows. Zero for Gaussians that are not drawn, or that
    are hidden. Without gradients. Raises ValueError where `values` does not fit.
    """
    projection: Projection = meta["projection"]
    lists: TileLists = meta["tile_lists"]
    result: Composite = meta["composite"]
    blending: Blending = meta["blending"]
    cameras, height, width = result.transmittance.shape
    like = result.transmittance
    if values is None:
        shown = like.new_ones((cameras, height, width, 1))
    else:
        shown = check_tensor("values", values, (cameras, height, width, "D"), like).detach()
    channels = shown.shape[-1]
    sums = []
    for first in range(0, channels, GROUP):
        count = min(GROUP, channels - first)
        weights = shown[..., first : first + count].reshape(-1, count).contiguous()
        if len(projection.records) == 0 or len(weights) == 0:
            sums.append(like.new_zeros((len(projection.records), count)))
            continue
        with torch_stream(like):
            total = gradient_sums(
                projection.records,
                None,
                lists,
                projection.rects,
                result.stops,
                torch.zeros_like(weights),
                like.reshape(-1),
                weights,
                like.new_empty(0),
                Blending(blending.view, count, -1, blending.tile, False),
            )
        sums.append(total[:, CHANNELS : CHANNELS + count])
    both = torch.cat(sums, dim=1).view(cameras, -1, channels) if sums else like.new_zeros((cameras, 0, 0))
    return both[..., 0] if values is None else both


__all__ = ["contributions"]
