"""First stage for surfels: discs in space -> records of how each pixel's ray meets them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import surfels as kernels
from gdpro_sim.kernels import surfels_backward
from gdpro_sim.kernels.projection import vec4s
from gdpro_sim.kernels.projection_backward import CAMERA_GRADIENTS
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.projection import Projected, View, array, camera_gradients, lanes_of, sort_pairs


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
        keys = torch.empty((cameras, 2 * count), device=means.device)
        order = torch.empty((cameras, 2 * count), dtype=torch.int32, device=means.device)
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
        for camera in range(cameras if count > 0 else 0):
            sort_pairs(keys[camera], order[camera], count)
        means2d = records.view(cameras, count, kernels.RECORD)[..., :2].contiguous()
        ctx.save_for_backward(means, quats, scales, opacities, sh, features, viewmats, Ks, rects)
        ctx.degree = degree
        ctx.mark_non_differentiable(radii, rects, order)
        ctx.set_materialize_grads(False)
        return records, means2d, radii, rects, order

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        g_records, g_means2d = gradients[:2]
        means, quats, scales, opacities, sh, features, viewmats, Ks, rects = ctx.saved_tensors
        if g_records is None and g_means2d is None:
            return (None,) * 10
        cameras, total = len(viewmats), len(rects)
        if g_records is None:
            g_records = means.new_zeros((total, kernels.RECORD))
        if g_means2d is None:
            g_means2d = means.new_zeros((total, 2))
        g_means, g_quats = buffers.empty_like(means), buffers.empty_like(quats)
        g_scales, g_opacities = buffers.empty_like(scales), buffers.empty_like(opacities)
        whole = ctx.degree is None or (ctx.degree + 1) ** 2 == sh.shape[1]
        g_sh = buffers.empty_like(sh) if whole else buffers.empty_like(sh).zero_()
        g_features = buffers.empty_like(features)
        if features.shape[1] > 3:
            g_features.zero_()
        with_cameras = bool(ctx.needs_input_grad[6] or ctx.needs_input_grad[7])
        lanes = lanes_of(means)
        groups = -(-len(means) // lanes)
        groups_per_run = 64 if lanes > 1 or with_cameras else 1
        runs = -(-groups // groups_per_run)
        g_cameras = means.new_zeros((runs if with_cameras else 0, cameras, CAMERA_GRADIENTS))
        with beside_torch(means):
            launch_chunked(
                surfels_backward.project_surfels_backward,
                runs,
                [
                    groups_per_run,
                    lanes,
                    array(means, wp.vec3),
                    array(quats, wp.vec4),
                    array(scales, wp.float32),
                    array(opacities, wp.float32),
                    array(sh, wp.vec3),
                    -1 if ctx.degree is None else ctx.degree,
                    array(viewmats, wp.mat44),
                    array(Ks, wp.mat33),
                    with_cameras,
                    array(rects, vec4s),
                    array(g_records.contiguous(), wp.float32),
                    array(g_means2d.reshape(total, 2).contiguous(), wp.float32),
                ],
                [
                    array(g_means, wp.vec3),
                    array(g_quats, wp.vec4),
                    array(g_scales, wp.float32),
                    array(g_opacities, wp.float32),
                    array(g_sh, wp.vec3),
                    array(g_features, wp.float32),
                    array(g_cameras, wp.float32),
                ],
                device=device_name(means),
                minimum=4,
            )
        if cameras == 0:
            for gradient in (g_means, g_quats, g_scales, g_opacities, g_sh, g_features):
                gradient.zero_()
        g_viewmats, g_Ks = camera_gradients(g_cameras) if with_cameras else (None, None)
        return g_means, g_quats, g_scales, g_opacities, g_sh, g_features, g_viewmats, g_Ks, None, None


__all__ = ["SurfelProjection", "project_surfels"]
