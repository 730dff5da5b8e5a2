"""Third stage: tile lists and records -> images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import compositing as kernels
from gdpro_sim.kernels import compositing_backward
from gdpro_sim.kernels.projection import BOX, CHANNELS, MEAN, RECORD, TILE
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.projection import Projection, View
from gdpro_sim.splatting.slabs import add_over_tiles, launch_tiles
from gdpro_sim.splatting.tiles import TileLists

GROUP = 4
"""Channels blended at once."""


@dataclass(frozen=True)
class Composite:
    """What blending leaves.

    image:         [C, H, W, D] float32
    alphas:        [C, H, W, 1] float32, 1 - transmittance
    transmittance: [C, H, W] float32 after the last Gaussian blended; without gradient
    stops:         int32 list positions after the last Gaussian looked at: [C rows columns] for each tile from
                   the tile kernel, [C H W] for each pixel (after the last Gaussian blended) from the other
    """

    image: torch.Tensor
    alphas: torch.Tensor
    transmittance: torch.Tensor
    stops: torch.Tensor


@dataclass(frozen=True)
class Blending:
    """What one blending of `count` <= 4 channels is set to.

    divided: the channel divided by alpha, or -1
    tile:    choose the CPU kernel (one index per tile), else one index per pixel
    absgrad: sum absolute gradients of `means2d`, and leave them in its attribute `absgrad`
    """

    view: View
    count: int
    divided: int
    tile: bool
    absgrad: bool


def composite(
    projection: Projection,
    lists: TileLists,
    features: torch.Tensor | None,
    backgrounds: torch.Tensor,
    divided: int,
    view: View,
    *,
    tile: bool,
    absgrad: bool = False,
) -> Composite:
    """Blend D channels over `backgrounds` [C, D]; channel `divided` is divided by alpha instead (-1: none).

    The first four channels are those of the records; later ones from `features` [N or C N, F], then depth.
    """
    channels = backgrounds.shape[1]
    parts = []
    for first in range(0, channels, GROUP):
        source = None
        if first > 0:
            assert features is not None
            source = pack_channels(projection, features, first)
        last = min(first + GROUP, channels)
        inside = divided - first if first <= divided < last else -1
        blending = Blending(view, last - first, inside, tile, absgrad)
        parts.append(blend(projection, lists, source, backgrounds[:, first:last], blending))
    if len(parts) == 1:
        return parts[0]
    image = torch.cat([part.image for part in parts], dim=-1)
    return Composite(image, parts[0].alphas, parts[0].transmittance, parts[0].stops)


def pack_channels(projection: Projection, features: torch.Tensor, first: int) -> torch.Tensor:
    """Entries first .. first + 3 of (features [N or C N, D], depth), zero past the end: [M, 4]."""
    packed = features[:, first : first + GROUP]
    if len(packed) < len(projection.records):
        packed = packed.repeat(projection.cameras, 1)
    if first <= features.shape[1] < first + GROUP:
        packed = torch.cat([packed, projection.depths.reshape(-1, 1)], dim=1)
    return torch.nn.functional.pad(packed, (0, GROUP - packed.shape[1]))


def blend(
    projection: Projection,
    lists: TileLists,
    channels: torch.Tensor | None,
    backgrounds: torch.Tensor,
    blending: Blending,
) -> Composite:
    """Blend `channels` [M, 4], or where None the records' own, over `backgrounds` [C, count]."""
    size = (len(backgrounds), blending.view.height, blending.view.width)
    image, alphas, transmittance, stops = _Blend.apply(
        projection.records,
        projection.means2d,
        channels,
        backgrounds.contiguous(),
        lists,
        blending,
    )
    return Composite(
        image.view(*size, blending.count), alphas.view(*size, 1), transmittance.view(size), stops
    )


class _Blend(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        records: torch.Tensor,
        means2d: torch.Tensor,
        channels: torch.Tensor | None,
        backgrounds: torch.Tensor,
        lists: TileLists,
        blending: Blending,
    ) -> tuple[torch.Tensor, ...]:
        view = blending.view
        columns, rows = view.tiles
        tiles = len(backgrounds) * rows * columns
        pixels = len(backgrounds) * view.height * view.width
        image = buffers.empty((pixels, blending.count), backgrounds.dtype, backgrounds.device)
        alphas = buffers.empty((pixels,), backgrounds.dtype, backgrounds.device)
        transmittance = buffers.empty((pixels,), backgrounds.dtype, backgrounds.device)
        stops = torch.empty(tiles if blending.tile else pixels, dtype=torch.int32, device=backgrounds.device)
        inputs = [
            *_sources(records, channels, lists),
            array(backgrounds, wp.float32),
            view.width,
            view.height,
            blending.count,
            blending.divided,
        ]
        outputs = [
            array(image, wp.float32),
            array(alphas, wp.float32),
            array(transmittance, wp.float32),
            array(stops, wp.int32),
        ]
        if blending.tile:
            launch_tiles(kernels.composite_tile, lists.offsets, [*inputs, *outputs])
        else:
            count = tiles * int(TILE) ** 2
            launch_chunked(kernels.composite_pixel, count, inputs, outputs, device=device_name(image))
        ctx.save_for_backward(records, means2d, channels, image, transmittance, stops)
        ctx.lists, ctx.blending, ctx.cameras = lists, blending, len(backgrounds)
        ctx.mark_non_differentiable(transmittance, stops)
        ctx.set_materialize_grads(False)
        return image, alphas, transmittance, stops

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        g_image, g_alphas = gradients[:2]
        if g_image is None and g_alphas is None:
            return (None,) * 6
        with beside_torch(ctx.saved_tensors[0]):
            return _blend_backward(ctx, g_image, g_alphas)


def _blend_backward(
    ctx: Any, g_image: torch.Tensor | None, g_alphas: torch.Tensor | None
) -> tuple[torch.Tensor | None, ...]:
    records, means2d, channels, image, transmittance, stops = ctx.saved_tensors
    g_image = torch.zeros_like(image) if g_image is None else g_image.contiguous()
    g_alphas = image.new_empty(0) if g_alphas is None else g_alphas.contiguous()
    blending: Blending = ctx.blending
    g_backgrounds = None
    if ctx.needs_input_grad[3]:
        pixels = blending.view.height * blending.view.width
        covered = (transmittance[:, None] * g_image).view(ctx.cameras, pixels, blending.count)
        g_backgrounds = covered.double().sum(1).float()
        if blending.divided >= 0:
            g_backgrounds[:, blending.divided] = 0.0
    if len(records) == 0:
        return torch.zeros_like(records), torch.zeros_like(means2d), None, g_backgrounds, None, None
    sums = gradient_sums(
        records, channels, ctx.lists, stops, image, transmittance, g_image, g_alphas, blending
    )
    if blending.absgrad:
        total = sums[:, BOX : BOX + 2].view_as(means2d).clone()
        before = getattr(means2d, "absgrad", None)
        means2d.absgrad = total if before is None else before + total
    g_means2d = sums[:, MEAN : MEAN + 2].reshape(means2d.shape)
    g_channels = None
    if channels is not None:
        g_channels = sums[:, CHANNELS : CHANNELS + GROUP].clone()
        sums[:, CHANNELS : CHANNELS + GROUP] = 0.0
    return sums, g_means2d, g_channels, g_backgrounds, None, None


def gradient_sums(
    records: torch.Tensor,
    channels: torch.Tensor | None,
    lists: TileLists,
    stops: torch.Tensor,
    image: torch.Tensor,
    transmittance: torch.Tensor,
    g_image: torch.Tensor,
    g_alphas: torch.Tensor,
    blending: Blending,
) -> torch.Tensor:
    """Gradients [M, 16] of records, see `gdpro_sim.kernels.compositing_backward`; CHANNELS those blended."""
    view = blending.view
    inputs = [
        *_sources(records, channels, lists),
        array(stops, wp.int32),
        view.width,
        view.height,
        blending.count,
        blending.divided,
        blending.absgrad,
        array(image, wp.float32),
        array(transmittance, wp.float32),
        array(g_image, wp.float32),
        array(g_alphas, wp.float32),
    ]
    if blending.tile:
        return add_over_tiles(
            compositing_backward.composite_tile_backward,
            inputs,
            lists,
            stops,
            view.tiles[0],
            (len(records), int(RECORD)),
        )
    sums = torch.zeros_like(records)
    # One launch: pixels add to the same memory, with atomics on a GPU and in turn on a CPU.
    wp.launch(
        compositing_backward.composite_pixel_backward,
        dim=(len(lists.offsets) - 1) * int(TILE) ** 2,
        inputs=[0, *inputs, array(sums, wp.float32)],
        device=device_name(records),
    )
    return sums


def weigh(
    projection: Projection, lists: TileLists, result: Composite, view: View, tile: bool, values: torch.Tensor
) -> torch.Tensor:
    """Sums over pixels of weight times `values` [C H W, count <= 4]: [M, count], without gradients."""
    count = values.shape[1]
    if len(projection.records) == 0:
        return values.new_zeros((0, count))
    # The gradient of an image at the colours is the sum of weight times the image's gradient.
    sums = gradient_sums(
        projection.records.detach(),
        None,
        lists,
        result.stops,
        torch.zeros_like(values),
        result.transmittance.reshape(-1),
        values,
        values.new_empty(0),
        Blending(view, count, -1, tile, False),
    )
    return sums[:, CHANNELS : CHANNELS + count]


def _sources(records: torch.Tensor, channels: torch.Tensor | None, lists: TileLists) -> list[Any]:
    source, offset = (records, int(CHANNELS)) if channels is None else (channels, 0)
    return [
        array(records, wp.float32),
        array(source, wp.float32),
        offset,
        array(lists.offsets, wp.int32),
        array(lists.ids, wp.int32),
    ]


__all__ = ["GROUP", "Blending", "Composite", "blend", "composite", "gradient_sums", "pack_channels", "weigh"]
