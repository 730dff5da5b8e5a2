"""Surface normals from depth images."""

from __future__ import annotations

import torch

from gdpro_sim.splatting.images import check_images


def depth_to_normals(depth: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor) -> torch.Tensor:
    """World-space unit normals [C, H, W, 3] of the surface in depth images, facing the camera.

    depth     [C, H, W, 1] z along the camera's axis (not along the ray), in the unit of `viewmats`, >= 0
    viewmats  [C, 4, 4] rigid, world to camera, OpenCV axes (+z forward, +y down)
    Ks        [C, 3, 3] pixels, skew Ks[:, 0, 1] included; pixel centres lie at +0.5

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
    _check_matrices(depth, viewmats=viewmats, Ks=Ks)
    if height < 3 or width < 3:
        return depth.expand(-1, -1, -1, 3) * 0.0
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
