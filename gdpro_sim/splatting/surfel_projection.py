"""First stage for surfels: discs in space -> records of how each pixel's ray meets them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import device_name, launch_chunked
from gdpro_sim.kernels import surfels as kernels
from gdpro_sim.kernels import surfels_backward
from gdpro_sim.kernels.projection import vec4s
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.projection import (
    Projected,
    View,
    backward_of_projection,
    lanes_of,
)
from gdpro_sim.splatting.sorting import keys_and_order, sort_by_depth


@dataclass(frozen=True)
class SurfelProjection(Projected):
    """Surfels projected. records: [M, 24], see `gdpro_sim.kernels.surfels`."""

    @property
    def depths(self) -> torch.Tensor:
        """[C, N] camera-space z of centres in metres, a view of the records."""
        return self._field(kernels.DEPTH, 1)[..., 0]

    @property
    def normals(self) -> torch.Tensor:
        """[C, N, 3] world-space unit normals facing the cameras, a view of the records."""
        return self._field(kernels.NORMAL, 3)


def project_surfels(
    surfels: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    colors: torch.Tensor,
    degree: int | None,
    view: View,
) -> SurfelProjection:
    """Project N surfels (means, quats, scales [N, >= 2], opacities) into C cameras; sort by depth.

    The first three channels of the records are colours from `colors` [N, K, 3] of spherical harmonics where
    `degree` is given, else the first three of `colors` [N or C N, D], D >= 0.
    """
    no_harmonics, no_features = colors.new_empty((0, 1, 3)), colors.new_empty((0, 1))
    sh, features = (no_harmonics, colors) if degree is None else (colors, no_features)
    return SurfelProjection(*_Project.apply(*surfels, sh, features, view.viewmats, view.Ks, degree, view))


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        means: torch.Tensor,
        quats: torch.Tensor,
        scales: torch.Tensor,
        opacities: torch.Tensor,
        sh: torch.Tensor,
        features: torch.Tensor,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        degree: int | None,
        view: View,
    ) -> tuple[torch.Tensor, ...]:
        cameras, count = len(viewmats), len(means)
        total = cameras * count
        records = buffers.empty((total, kernels.RECORD), means.dtype, means.device)
        radii = buffers.empty((total, 2), torch.int32, means.device)
        rects = buffers.empty((total, 4), torch.int16, means.device)
        keys, order = keys_and_order(cameras, count, means.device)
        lanes = lanes_of(means)
        launch_chunked(
            kernels.project_surfels,
            cameras * -(-count // lanes),
            [
                lanes,
                array(means, wp.vec3),
                array(quats, wp.vec4),
                array(scales, wp.float32),
                array(opacities, wp.float32),
                array(sh, wp.vec3),
                array(features, wp.float32),
                -1 if degree is None else degree,
                array(viewmats, wp.mat44),
                array(Ks, wp.mat33),
                view.width,
                view.height,
                view.near,
                view.far,
                view.radius_clip,
            ],
            [
                array(records, wp.float32),
                array(radii, wp.vec2i),
                array(rects, vec4s),
                array(keys, wp.float32),
                array(order, wp.int32),
            ],
            device=device_name(means),
            minimum=256,
        )
        sort_by_depth(keys, order, count)
        means2d = records.view(cameras, count, kernels.RECORD)[..., :2].contiguous()
        ctx.save_for_backward(means, quats, scales, opacities, sh, features, viewmats, Ks, rects)
        ctx.degree = degree
        ctx.mark_non_differentiable(radii, rects, order)
        ctx.set_materialize_grads(False)
        return records, means2d, radii, rects, order

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        kernel = surfels_backward.project_surfels_backward
        return backward_of_projection(ctx, gradients, kernel, [], kernels.RECORD, wp.float32, 3)


__all__ = ["SurfelProjection", "project_surfels"]
