"""How much of each image is each Gaussian's."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from gdpro_sim.device import beside_torch
from gdpro_sim.splatting.checks import check_tensor
from gdpro_sim.splatting.compositing import Composite

GROUP = 3
"""Values weighed at once."""

Weigh = Callable[[torch.Tensor], torch.Tensor]
"""Values [C H W, count <= 3] -> sums of weight times value [M, count]."""


def contributions(meta: dict[str, Any], values: torch.Tensor | None = None) -> torch.Tensor:
    """Sum over pixels of each Gaussian's blending weight alpha T.

    `meta` is what `rasterization` or `rasterization_2dgs` gave.

    Returns [C, N] float32, or where `values` [C, H, W, D] is given [C, N, D], the sum of weight times value:
    divided by the former, the mean of what the Gaussian shows. Zero for Gaussians that are not drawn, or that
    are hidden. Without gradients. Raises ValueError where `values` does not fit.
    """
    if "batches" in meta:
        raise ValueError('meta has batch axes: ask for each of meta["batches"]')
    result: Composite = meta["composite"]
    weigh: Weigh = meta["weigh"]
    cameras, height, width = result.transmittance.shape
    like = result.transmittance
    if values is None:
        shown = like.new_ones((cameras, height, width, 1))
    else:
        shown = check_tensor("values", values, (cameras, height, width, "D"), like).detach()
    channels = shown.shape[-1]
    sums = [like.new_zeros((len(meta["projection"].records), 0))]
    for first in range(0, channels, GROUP):
        part = shown[..., first : first + GROUP]
        with beside_torch(like):
            sums.append(weigh(part.reshape(-1, part.shape[-1]).contiguous()))
    both = torch.cat(sums, dim=1).view(cameras, meta["projection"].gaussians, channels)
    return both[..., 0] if values is None else both


__all__ = ["Weigh", "contributions"]
