"""Surface normals from depth images."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import depth as kernels
from gdpro_sim.splatting import buffers
from gdpro_sim.splatting.arrays import array
from gdpro_sim.splatting.images import check_alike, check_images


def depth_to_normals(
    depth: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor, weights: torch.Tensor | None = None
) -> torch.Tensor:
    """World-space unit normals [C, H, W, 3] of the surface in depth images, facing the camera.

    depth     [C, H, W, 1] z along the camera's axis (not along the ray), in the unit of `viewmats`, >= 0
    viewmats  [C, 4, 4] rigid, world to camera, OpenCV axes (+z forward, +y down)
    Ks        [C, 3, 3] pixels, skew Ks[:, 0, 1] included; pixel centres lie at +0.5
    weights   [C, H, W, 1] factors of the normals, to which there is no gradient

    The normal of a pixel is the cross product of the central differences, down and right, of its neighbours'
    back-projected points (gsplat's convention). It is zero on the image's border, and where both neighbours
    of either direction have no depth (zero). Differentiable in everything; same device and dtype, float32 or
    float64. Raises ValueError where a shape or dtype does not fit.

    Derivation: with the viewing direction (X, Y, 1) of a pixel and z of the neighbours right, left, down and
    up, the cross product is a positive multiple of (p, q, -1 - p X - q Y), where
    p = fx (z_r - z_l) / (z_r + z_l) and q = fy (z_d - z_u) / (z_d + z_u) + p skew / fx. It does not depend on
    the unit of length, and its product with the viewing direction is -1: it always faces the camera.
    """
    depth = check_images("depth", depth, 4, channels=1)
    height, width = depth.shape[1:3]
    if weights is not None:
        weights = check_images("weights", weights, 4, channels=1)
        check_alike(("depth", "weights"), depth, weights)
    _check_matrices(depth, viewmats=viewmats, Ks=Ks)
    if height < 3 or width < 3:
        return depth.expand(-1, -1, -1, 3) * 0.0
    if depth.dtype == torch.float32:
        factors = depth.new_empty(0) if weights is None else weights.detach().contiguous()
        return _Normals.apply(depth.contiguous(), viewmats.contiguous(), Ks.contiguous(), factors)
    normals = _normals(depth, viewmats, Ks)
    return normals if weights is None else normals * weights.detach()


def _normals(depth: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor) -> torch.Tensor:
    """The same in torch, in any precision."""
    height, width = depth.shape[1:3]
    z = depth[..., 0]
    fx, skew, cx = (Ks[:, 0, i, None, None] for i in range(3))
    fy, cy = (Ks[:, 1, i, None, None] for i in (1, 2))
    x = torch.arange(1, width - 1, dtype=z.dtype, device=z.device) + 0.5
    y = (torch.arange(1, height - 1, dtype=z.dtype, device=z.device) + 0.5)[:, None]
    direction_y = (y - cy) / fy
    direction_x = (x - cx - skew * direction_y) / fx

    right, left = z[:, 1:-1, 2:], z[:, 1:-1, :-2]
    down, up = z[:, 2:, 1:-1], z[:, :-2, 1:-1]
    across, along = right + left, down + up
    seen = (across > 0.0) & (along > 0.0)
    one = torch.ones((), dtype=z.dtype, device=z.device)
    p = (right - left) / torch.where(seen, across, one) * fx
    q = (down - up) / torch.where(seen, along, one) * fy + p * (skew / fx)
    normal = torch.stack([p, q, -1.0 - p * direction_x - q * direction_y], dim=-1)
    # Turned before it is normalised: exact for any invertible view matrix, not only for rotations.
    normal = torch.einsum("chwi,cij->chwj", normal, viewmats[:, :3, :3])
    normal = normal / torch.linalg.vector_norm(normal, dim=-1, keepdim=True)
    normal = torch.where(seen[..., None], normal, torch.zeros_like(one))
    return torch.nn.functional.pad(normal, (0, 0, 1, 1, 1, 1))


class _Normals(torch.autograd.Function):
    """The same in float32, by kernels."""

    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, depth: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor, weights: torch.Tensor
    ) -> torch.Tensor:
        normals = buffers.empty((*depth.shape[:3], 3), depth.dtype, depth.device)
        inputs, indices = _spans(depth, viewmats, Ks)
        inputs.append(array(weights.view(-1), wp.float32))
        outputs = [array(normals.view(-1), wp.float32)]
        with beside_torch(depth):
            launch_chunked(
                kernels.depth_normals, indices, inputs, outputs, device=device_name(depth), minimum=32
            )
        ctx.save_for_backward(depth, viewmats, Ks, weights)
        return normals

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        depth, viewmats, Ks, weights = ctx.saved_tensors
        inputs, indices = _spans(depth, viewmats, Ks)
        with_cameras = ctx.needs_input_grad[1] or ctx.needs_input_grad[2]
        g_ratios = buffers.empty((2, depth.numel()), depth.dtype, depth.device)
        g_cameras = depth.new_empty((indices if with_cameras else 0, kernels.CAMERA_GRADIENTS))
        g_depth = buffers.empty_like(depth)
        device = device_name(depth)
        with beside_torch(depth):
            given = [
                array(weights.view(-1), wp.float32),
                array(gradients[0].contiguous().view(-1), wp.float32),
            ]
            outputs = [array(g_ratios, wp.float32), array(g_cameras, wp.float32)]
            launch_chunked(
                kernels.depth_normals_backward, indices, [*inputs, *given], outputs, device=device, minimum=32
            )
            span, z, _, _, width, height = inputs
            inputs = [span, z, width, height, array(g_ratios, wp.float32)]
            outputs = [array(g_depth.view(-1), wp.float32)]
            launch_chunked(kernels.depth_normals_gather, indices, inputs, outputs, device=device, minimum=32)
        if not with_cameras or indices == 0:
            return g_depth, None, None, None
        # A cumulative sum goes in order, a sum as it likes.
        total = torch.cumsum(g_cameras.double().view(len(depth), -1, kernels.CAMERA_GRADIENTS), 1)[
            :, -1
        ].float()
        g_viewmats, g_Ks = torch.zeros_like(viewmats), torch.zeros_like(Ks)
        g_viewmats[:, :3, :3] = total[:, :9].view(-1, 3, 3)
        g_Ks[:, 0] = total[:, 9:12]
        g_Ks[:, 1, 1:] = total[:, 12:]
        return g_depth, g_viewmats, g_Ks, None


def _spans(depth: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor) -> tuple[list[Any], int]:
    """First arguments of the kernels, and their number of indices."""
    count, height, width = depth.shape[:3]
    span = width if depth.device.type == "cpu" else 32
    inputs = [
        span,
        array(depth.view(-1), wp.float32),
        array(viewmats, wp.mat44),
        array(Ks, wp.mat33),
        width,
        height,
    ]
    return inputs, count * height * -(-width // span)


def _check_matrices(depth: torch.Tensor, *, viewmats: object, Ks: object) -> None:
    """Raise ValueError unless there is one matrix of each kind for each depth image [C, H, W, 1], alike."""
    for name, matrix, size in (("viewmats", viewmats, 4), ("Ks", Ks, 3)):
        wanted = [len(depth), size, size]
        if not isinstance(matrix, torch.Tensor) or list(matrix.shape) != wanted:
            got = list(matrix.shape) if isinstance(matrix, torch.Tensor) else type(matrix).__name__
            raise ValueError(f"{name} must have shape {wanted}, one for each depth image, got {got}")
        if matrix.dtype != depth.dtype or matrix.device != depth.device:
            raise ValueError(
                f"{name} must be {depth.dtype} on {depth.device} as depth is, "
                f"got {matrix.dtype} on {matrix.device}"
            )


__all__ = ["depth_to_normals"]
