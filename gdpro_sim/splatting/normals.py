"""Normals of 3D Gaussians: their shortest axes."""

from __future__ import annotations

import torch


def shortest_axes(
    means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, viewmats: torch.Tensor
) -> torch.Tensor:
    """Unit axes [C, N, 3] along which N Gaussians are thinnest, in world space, turned towards C cameras.

    The argument shapes are those of `rasterization`. Gradients reach `quats`; for a quaternion that is
    zero or not finite the axis is that of the identity.
    """
    usable = torch.isfinite(quats).all(1, keepdim=True) & (quats != 0).any(1, keepdim=True)
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    safe = torch.where(usable, quats, identity)
    safe = safe / safe.abs().amax(1, keepdim=True).detach()
    w, x, y, z = torch.nn.functional.normalize(safe, dim=1).unbind(1)
    axes = torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
            torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
            torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
        ],
        1,
    )
    thinnest = torch.argmin(scales.detach(), dim=1)
    axis = axes[torch.arange(len(axes), device=axes.device), thinnest]
    with torch.no_grad():
        rotation = viewmats[:, :3, :3]
        points = means @ rotation.transpose(1, 2) + viewmats[:, None, :3, 3]
        away = (points @ rotation * axis).sum(-1, keepdim=True) > 0
    return torch.where(away, -axis, axis)


__all__ = ["shortest_axes"]
