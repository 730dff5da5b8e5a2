"""First stage: Gaussians in space -> records of coloured 2D Gaussians, one for each camera and Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import projection as kernels
from gdpro_sim.kernels import projection_backward
from gdpro_sim.kernels.projection import vec4s
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.sorting import keys_and_order, sort_by_depth


@dataclass(frozen=True)
class View:
    """C cameras and the image they make, checked. near, far in metres; the rest in pixels."""

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int
    near: float
    far: float
    radius_clip: float
    eps2d: float
    antialiased: bool

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        tile = int(kernels.TILE)
        return -(-self.width // tile), -(-self.height // tile)


@dataclass(frozen=True)
class Projected:
    """C x N projected Gaussians or surfels; M = C N, record c N + n is number n seen by camera c.

    records: [M, R] float32, zeros where culled. All but its means carry gradients: `means2d` does
    means2d: [C, N, 2] pixels
    radii:   [M, 2] int32, half extents in pixels of the box outside which alpha < 1/255; zeros where culled
    rects:   [M, 4] int16, tiles touched: x begin, y begin, x end, y end (exclusive); zeros where culled
    order:   [C, N or more] int32, of which order[:, :N] are record numbers in ascending depth, culled ones
             last; None once the tile lists are made
    """

    records: torch.Tensor
    means2d: torch.Tensor
    radii: torch.Tensor
    rects: torch.Tensor
    order: torch.Tensor | None

    @property
    def cameras(self) -> int:
        return int(self.means2d.shape[0])

    @property
    def gaussians(self) -> int:
        return int(self.means2d.shape[1])

    def _field(self, first: int, width: int) -> torch.Tensor:
        whole = self.records.shape[1]
        return self.records.view(self.cameras, self.gaussians, whole)[..., first : first + width]


@dataclass(frozen=True)
class Projection(Projected):
    """3D Gaussians projected. records: [M, 16], see `gdpro_sim.kernels.projection`."""

    @property
    def depths(self) -> torch.Tensor:
        """[C, N] camera-space z in metres, a view of the records."""
        return self._field(kernels.DEPTH, 1)[..., 0]

    @property
    def opacities(self) -> torch.Tensor:
        """[C, N] opacities, times the compensation factor where antialiased; a view of the records."""
        return self._field(kernels.OPACITY, 1)[..., 0]

    @property
    def conics(self) -> torch.Tensor:
        """[C, N, 3] upper triangle of the inverse 2D covariance, 1/pixel^2; computed on each access."""
        a, b, d = self._field(kernels.FACTOR, 3).unbind(-1)
        return torch.stack([a * a, a * b, b * b + d * d], dim=-1) / kernels.HALF_LOG2_E


def lanes_of(tensor: torch.Tensor) -> int:
    """How many Gaussians a kernel works on at once, see `gdpro_sim.kernels.lanes`."""
    return 16 if tensor.device.type == "cpu" else 1


def project(
    gaussians: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    colors: torch.Tensor,
    degree: int | None,
    view: View,
) -> Projection:
    """Project N Gaussians (means, quats, scales, opacities) into C cameras, and sort by depth.

    The first four channels of the records are colour and depth from `colors` [N, K, 3] of spherical harmonics
    where `degree` is given, else the first four of (`colors` [N or C N, D], depth), D >= 0.
    """
    no_harmonics, no_features = colors.new_empty((0, 1, 3)), colors.new_empty((0, 1))
    sh, features = (no_harmonics, colors) if degree is None else (colors, no_features)
    result = _Project.apply(*gaussians, sh, features, view.viewmats, view.Ks, degree, view)
    return Projection(*result)


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
        records = buffers.empty((total, int(kernels.RECORD)), means.dtype, means.device)
        means2d = buffers.empty((cameras, count, 2), means.dtype, means.device)
        radii = buffers.empty((total, 2), torch.int32, means.device)
        rects = buffers.empty((total, 4), torch.int16, means.device)
        keys, order = keys_and_order(cameras, count, means.device)
        lanes = lanes_of(means)
        launch_chunked(
            kernels.project,
            cameras * -(-count // lanes),
            [
                lanes,
                array(means, wp.vec3),
                array(quats, wp.vec4),
                array(scales, wp.vec3),
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
                view.eps2d,
                view.antialiased,
            ],
            [
                array(records, wp.float32),
                array(means2d.view(total, 2), wp.vec2),
                array(radii, wp.vec2i),
                array(rects, vec4s),
                array(keys, wp.float32),
                array(order, wp.int32),
            ],
            device=device_name(means),
            minimum=256,
        )
        sort_by_depth(keys, order, count)
        ctx.save_for_backward(means, quats, scales, opacities, sh, features, viewmats, Ks, rects)
        ctx.degree, ctx.view = degree, view
        ctx.mark_non_differentiable(radii, rects, order)
        ctx.set_materialize_grads(False)
        return records, means2d, radii, rects, order

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor | None) -> tuple[torch.Tensor | None, ...]:
        view: View = ctx.view
        kernel = projection_backward.project_backward
        settings = [view.width, view.height, view.eps2d, view.antialiased]
        return backward_of_projection(ctx, gradients, kernel, settings, int(kernels.RECORD), wp.vec3, 4)


def backward_of_projection(
    ctx: Any,
    gradients: tuple[torch.Tensor | None, ...],
    kernel: wp.Kernel,
    settings: list[Any],
    record: int,
    scale_type: type,
    channels: int,
) -> tuple[torch.Tensor | None, ...]:
    """Gradients at what a projection was given, from those at its records [M, `record`] and means2d.

    `kernel` takes `settings` after the intrinsics; records hold the first `channels` features. Fits a forward
    whose first eight arguments and saved tensors are those of `_Project`, with two more without gradients.
    """
    g_records, g_means2d = gradients[:2]
    if g_records is None and g_means2d is None:
        return (None,) * 10
    means, quats, scales, opacities, sh, features, viewmats, Ks, rects = ctx.saved_tensors
    cameras, total = len(viewmats), len(rects)
    with beside_torch(means):
        if g_records is None:
            g_records = means.new_zeros((total, record))
        if g_means2d is None:
            g_means2d = means.new_zeros((total, 2))
        g_means, g_quats = buffers.empty_like(means), buffers.empty_like(quats)
        g_scales, g_opacities = buffers.empty_like(scales), buffers.empty_like(opacities)
        whole = ctx.degree is None or (ctx.degree + 1) ** 2 == sh.shape[1]
        g_sh = buffers.empty_like(sh) if whole else buffers.empty_like(sh).zero_()
        g_features = buffers.empty_like(features)
        if features.shape[1] > channels:
            g_features.zero_()
        with_cameras = bool(ctx.needs_input_grad[6] or ctx.needs_input_grad[7])
        lanes = lanes_of(means)
        groups = -(-len(means) // lanes)
        groups_per_run = 64 if lanes > 1 or with_cameras else 1
        runs = -(-groups // groups_per_run)
        count = projection_backward.CAMERA_GRADIENTS
        g_cameras = means.new_zeros((runs if with_cameras else 0, cameras, count))
        launch_chunked(
            kernel,
            runs,
            [
                groups_per_run,
                lanes,
                array(means, wp.vec3),
                array(quats, wp.vec4),
                array(scales, scale_type),
                array(opacities, wp.float32),
                array(sh, wp.vec3),
                -1 if ctx.degree is None else ctx.degree,
                array(viewmats, wp.mat44),
                array(Ks, wp.mat33),
                *settings,
                with_cameras,
                array(rects, vec4s),
                array(g_records.contiguous(), wp.float32),
                array(g_means2d.reshape(total, 2), wp.float32),
            ],
            [
                array(g_means, wp.vec3),
                array(g_quats, wp.vec4),
                array(g_scales, scale_type),
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


def camera_gradients(sums: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Partial sums [runs, C, 17] of `projection_backward` -> gradients [C, 4, 4] and [C, 3, 3]."""
    # A cumulative sum goes in order, a sum as it likes.
    total = torch.cumsum(sums.double(), 0)[-1].float() if len(sums) else sums.new_zeros(sums.shape[1:])
    g_viewmats = total.new_zeros((len(total), 4, 4))
    g_viewmats[:, :3, :3] = total[:, :9].view(-1, 3, 3)
    g_viewmats[:, :3, 3] = total[:, 9:12]
    g_Ks = total.new_zeros((len(total), 3, 3))
    g_Ks[:, 0] = total[:, 12:15]
    g_Ks[:, 1, 1:] = total[:, 15:17]
    return g_viewmats, g_Ks


__all__ = [
    "Projected",
    "Projection",
    "View",
    "backward_of_projection",
    "lanes_of",
    "project",
]
