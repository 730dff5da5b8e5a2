"""A cloud of Gaussians without a mesh, bound to one small triangle each."""

from __future__ import annotations

import math

import torch

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import Gaussians, rotation_matrices

LEAST_EDGE = 1e-3
"""Of the cloud's diagonal: shorter edges would lose the triangle's frame to rounding."""

ROUNDEST = 0.1
"""Least height of a triangle over its base, for the same reason."""

CORNERS = ((-1.0, -1.0 / math.sqrt(3.0)), (1.0, -1.0 / math.sqrt(3.0)), (0.0, 2.0 / math.sqrt(3.0)))
"""Of an equilateral triangle around the origin, its base along the first axis."""


def bind_splats(gaussians: Gaussians) -> BoundGaussians:
    """The same Gaussians, each at the centroid of a triangle of its own.

    The triangle lies across the Gaussian's shortest axis and is two standard deviations wide, so that it
    moves, turns and stretches as the matter under the Gaussian does. No two triangles share a vertex: whoever
    carries the vertices decides what stays together. Raises AssetError for a cloud without Gaussians.
    """
    n = len(gaussians)
    if n == 0:
        raise AssetError("a cloud without Gaussians cannot be bound")
    means, scales = gaussians.means.detach().double(), gaussians.scales.detach().double()
    axes = rotation_matrices(gaussians.quats.detach().double())
    order = torch.argsort(scales, dim=1, stable=True)[:, [0, 2, 1]]  # normal, longest, the other
    scales = torch.gather(scales, 1, order)
    axes = torch.gather(axes, 2, order[:, None].expand(n, 3, 3))
    normal, across = axes[:, :, 0], axes[:, :, 1]
    diagonal = float((means.amax(0) - means.amin(0)).norm())
    base = scales[:, 1].clamp_min(LEAST_EDGE * diagonal).clamp_min(1e-12)
    height = torch.maximum(scales[:, 2], ROUNDEST * base)
    along = torch.stack([across * base[:, None], torch.linalg.cross(normal, across) * height[:, None]], 1)
    corners = torch.tensor(CORNERS, dtype=torch.float64, device=means.device)
    vertices = means[:, None] + torch.einsum("ck,nkd->ncd", corners, along)
    ids = torch.arange(3 * n, dtype=torch.int32, device=means.device)
    opacities = gaussians.opacities.detach().clamp(1e-6, 1.0 - 1e-6)
    return BoundGaussians(
        vertices=vertices.reshape(-1, 3).float(),
        faces=ids.view(n, 3),
        face_ids=ids[:n],
        barycentrics=torch.full((n, 3), 1.0 / 3.0, device=means.device),
        rotations=torch.tensor([1.0, 0.0], device=means.device).repeat(n, 1),
        log_scales=scales.clamp_min(1e-12).log().float(),
        opacity_logits=torch.logit(opacities),
        sh=gaussians.sh.detach().clone(),
    )


__all__ = ["bind_splats"]
