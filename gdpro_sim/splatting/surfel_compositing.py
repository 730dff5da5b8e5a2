"""Third stage for surfels: tile lists and records -> images."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import surfel_compositing as kernels
from gdpro_sim.kernels import surfel_compositing_backward
from gdpro_sim.kernels.projection import TILE
from gdpro_sim.kernels.surfel_compositing_backward import ABSOLUTE
from gdpro_sim.kernels.surfels import CHANNELS, MEAN, RECORD
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.projection import View
from gdpro_sim.splatting.slabs import add_over_tiles, launch_tiles
from gdpro_sim.splatting.surfel_projection import SurfelProjection
from gdpro_sim.splatting.tiles import TileLists

GROUP = 3
"""Channels blended at once, beside depth and normal."""


@dataclass(frozen=True)
class SurfelComposite:
    """What blending leaves; all but the last three carry gradients.

    image:         [C, H, W, D] float32, depth last where asked for
    alphas:        [C, H, W, 1] 1 - transmittance
    normals:       [C, H, W, 3] sum of weight times world-space normal
    distortion:    [C, H, W, 1]
    medians:       [C, H, W, 1] median depth, zero for none
    transmittance: [C, H, W] after the last surfel blended
    depths:        [C, H, W] sum of weight times depth
    stops:         int32 list positions, as those of `gdpro_sim.splatting.compositing.Composite`
    """

    image: torch.Tensor
    alphas: torch.Tensor
    normals: torch.Tensor
    distortion: torch.Tensor
    medians: torch.Tensor
    transmittance: torch.Tensor
    depths: torch.Tensor
    stops: torch.Tensor


@dataclass(frozen=True)
class SurfelBlending:
    """What one blending of `colours` <= 3 channels is set to.

    depth:    blend depth into one channel more, divided by alpha where `divided`
    geometry: blend normals, distortion and median too
    tile:     choose the CPU kernel (one index per tile), else one index per pixel
    absgrad:  sum absolute gradients of `means2d`, and leave them in its attribute `absgrad`
    """

    view: View
    colours: int
    depth: bool
    divided: bool
    geometry: bool
    tile: bool
    absgrad: bool


def composite_surfels(
    projection: SurfelProjection,
    lists: TileLists,
    features: torch.Tensor,
    backgrounds: torch.Tensor,
    view: View,
    *,
    depth: bool,
    divided: bool,
    tile: bool,
    absgrad: bool,
) -> SurfelComposite:
    """Blend D channels over `backgrounds` [C, D], then depth; one pass for each three channels.

    The first three channels are those of the records; later ones from `features` [N or C N, D].
    """
    size = (len(backgrounds), view.height, view.width)
    colours = min(backgrounds.shape[1], GROUP)
    blending = SurfelBlending(view, colours, depth, divided, True, tile, absgrad)
    first = _Blend.apply(
        projection.records,
        projection.means2d,
        None,
        backgrounds[:, :colours].contiguous(),
        lists,
        blending,
    )
    image, alphas, normals, distortion, medians, transmittance, depths, stops = first
    image = image.view(*size, colours + depth)
    if backgrounds.shape[1] > GROUP:
        parts = [image[..., :GROUP]]
        for begin in range(GROUP, backgrounds.shape[1], GROUP):
            background = backgrounds[:, begin : begin + GROUP].contiguous()
            packed = features[:, begin : begin + GROUP]
            if len(packed) < len(projection.records):
                packed = packed.repeat(projection.cameras, 1)
            packed = torch.nn.functional.pad(packed, (0, GROUP - packed.shape[1]))
            more = SurfelBlending(view, background.shape[1], False, False, False, tile, absgrad)
            results = _Blend.apply(projection.records, projection.means2d, packed, background, lists, more)
            parts.append(results[0].view(*size, background.shape[1]))
        image = torch.cat([*parts, image[..., GROUP:]], dim=-1)
    return SurfelComposite(
        image,
        alphas.view(*size, 1),
        normals.view(*size, 3),
        distortion.view(*size, 1),
        medians.view(*size, 1),
        transmittance.view(size),
        depths.view(size),
        stops,
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
        blending: SurfelBlending,
    ) -> tuple[torch.Tensor, ...]:
        view = blending.view
        columns, rows = view.tiles
        cameras = len(backgrounds)
        tiles = cameras * rows * columns
        pixels = cameras * view.height * view.width
        like = backgrounds.dtype, backgrounds.device
        image = buffers.empty((pixels, blending.colours + blending.depth), *like)
        alphas, transmittance = buffers.empty((pixels,), *like), buffers.empty((pixels,), *like)
        stops = torch.empty(tiles if blending.tile else pixels, dtype=torch.int32, device=records.device)
        shown = pixels if blending.geometry else 0
        depths, distortion, medians = (buffers.empty((shown,), *like) for _ in range(3))
        normals = buffers.empty((shown, 3), *like)
        medians_at = buffers.empty((shown,), torch.int32, records.device)
        inputs = [
            *_sources(records, channels, lists),
            array(backgrounds, wp.float32),
            view.width,
            view.height,
            blending.colours,
            blending.divided,
            blending.geometry,
        ]
        outputs = [
            array(image, wp.float32),
            array(alphas, wp.float32),
            array(transmittance, wp.float32),
            array(stops, wp.int32),
            array(depths, wp.float32),
            array(normals, wp.float32),
            array(distortion, wp.float32),
            array(medians, wp.float32),
            array(medians_at, wp.int32),
        ]
        if blending.tile:
            launch_tiles(kernels.surfel_tile, lists.offsets, [*inputs, *outputs])
        else:
            count = tiles * int(TILE) ** 2
            launch_chunked(kernels.surfel_pixel, count, inputs, outputs, device=device_name(image))
        ctx.save_for_backward(
            records,
            means2d,
            channels,
            stops,
            image,
            transmittance,
            depths,
            normals,
            distortion,
            medians_at,
        )
        ctx.lists, ctx.blending, ctx.cameras = lists, blending, cameras
        ctx.mark_non_differentiable(transmittance, depths, stops)
        ctx.set_materialize_grads(False)
        return image, alphas, normals, distortion, medians, transmittance, depths, stops

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        given = gradients[:5]
        records, means2d, channels, stops, *images = ctx.saved_tensors
        if all(gradient is None for gradient in given):
            return (None,) * 6
        image = images[0]
        g_image = torch.zeros_like(image) if given[0] is None else given[0].contiguous()
        nothing = image.new_empty(0)
        rest = [nothing if gradient is None else gradient.contiguous() for gradient in given[1:]]
        if given[2] is None:
            rest[1] = image.new_empty((0, 3))
        blending: SurfelBlending = ctx.blending
        geometry = blending.depth or any(gradient is not None for gradient in given[2:])
        with beside_torch(records):
            sums = gradient_sums(
                records, channels, ctx.lists, stops, images, [g_image, *rest], blending, geometry
            )
        if blending.absgrad:
            total = sums[:, list(ABSOLUTE)].view_as(means2d)
            before = getattr(means2d, "absgrad", None)
            means2d.absgrad = total if before is None else before + total
        g_means2d = sums[:, MEAN : MEAN + 2].reshape(means2d.shape)
        g_channels = None
        if channels is not None:
            g_channels = sums[:, CHANNELS : CHANNELS + GROUP].clone()
            sums[:, CHANNELS : CHANNELS + GROUP] = 0.0
        g_backgrounds = None
        if ctx.needs_input_grad[3]:
            with beside_torch(records):
                pixels = len(image) // max(1, ctx.cameras)
                covered = images[1].view(ctx.cameras, pixels, 1) * g_image.view(
                    ctx.cameras, pixels, image.shape[1]
                )
                g_backgrounds = covered[..., : blending.colours].double().sum(1).float()
        return sums, g_means2d, g_channels, g_backgrounds, None, None


def gradient_sums(
    records: torch.Tensor,
    channels: torch.Tensor | None,
    lists: TileLists,
    stops: torch.Tensor,
    images: list[torch.Tensor],
    gradients: list[torch.Tensor],
    blending: SurfelBlending,
    geometry: bool,
) -> torch.Tensor:
    """Gradients [M, 24] of the records, see `gdpro_sim.kernels.surfel_compositing_backward`.

    images:    image, transmittance, depths, normals, distortion and list positions of medians
    gradients: of image, alphas, normals, distortion and medians; empty ones are zero
    """
    if len(records) == 0 or len(images[0]) == 0:
        return torch.zeros_like(records)
    view = blending.view
    inputs = [
        *_sources(records, channels, lists),
        array(stops, wp.int32),
        view.width,
        view.height,
        blending.colours,
        blending.divided,
        geometry,
        blending.absgrad,
        *(array(saved, wp.float32) for saved in images[:-1]),
        array(images[-1], wp.int32),
        *(array(gradient, wp.float32) for gradient in gradients),
    ]
    if blending.tile:
        return add_over_tiles(
            surfel_compositing_backward.surfel_tile_backward,
            inputs,
            lists,
            stops,
            view.tiles[0],
            (len(records), RECORD),
        )
    sums = torch.zeros_like(records)
    # One launch: pixels add to the same memory, with atomics on a GPU and in turn on a CPU.
    wp.launch(
        surfel_compositing_backward.surfel_pixel_backward,
        dim=(len(lists.offsets) - 1) * int(TILE) ** 2,
        inputs=[0, *inputs, array(sums, wp.float32)],
        device=device_name(records),
    )
    return sums


def weigh_surfels(
    projection: SurfelProjection,
    lists: TileLists,
    result: SurfelComposite,
    blending: SurfelBlending,
    values: torch.Tensor,
) -> torch.Tensor:
    """[M, D] sums over pixels of blending weight times `values` [C H W, D], D <= 3; without gradients."""
    records = projection.records
    count = values.shape[1]
    nothing = values.new_empty(0)
    none = values.new_empty((0, 3))
    images = [
        torch.zeros_like(values),
        result.transmittance.reshape(-1),
        nothing,
        none,
        nothing,
        torch.empty(0, dtype=torch.int32, device=values.device),
    ]
    only = SurfelBlending(blending.view, count, False, False, False, blending.tile, False)
    with beside_torch(values):
        sums = gradient_sums(
            records,
            None,
            lists,
            result.stops,
            images,
            [values, nothing, none, nothing, nothing],
            only,
            False,
        )
    return sums[:, CHANNELS : CHANNELS + count]


def _sources(records: torch.Tensor, channels: torch.Tensor | None, lists: TileLists) -> list[Any]:
    source, offset = (records, CHANNELS) if channels is None else (channels.contiguous(), 0)
    return [
        array(records, wp.float32),
        array(source, wp.float32),
        offset,
        array(lists.offsets, wp.int32),
        array(lists.ids, wp.int32),
    ]


__all__ = [
    "GROUP",
    "SurfelBlending",
    "SurfelComposite",
    "composite_surfels",
    "gradient_sums",
    "weigh_surfels",
]
