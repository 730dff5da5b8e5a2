"""Small random scenes for the rasteriser's tests."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from gdpro_sim.cameras import Cameras


def cloud(count: int, seed: int, *, size: float = 0.12) -> dict[str, Tensor]:
    """Arguments `means, quats, scales, opacities` of Gaussians in a ball of radius about 1 m."""
    g = torch.Generator().manual_seed(seed)
    return {
        "means": torch.randn(count, 3, generator=g) * 0.5,
        "quats": torch.randn(count, 4, generator=g) * 3.0,
        "scales": size * torch.exp(0.7 * torch.randn(count, 3, generator=g)),
        "opacities": torch.sigmoid(0.8 + 1.5 * torch.randn(count, generator=g)),
    }


def features(count: int, channels: int, seed: int) -> Tensor:
    return torch.rand(count, channels, generator=torch.Generator().manual_seed(seed + 1000))


def harmonics(count: int, degree: int, seed: int) -> Tensor:
    g = torch.Generator().manual_seed(seed + 2000)
    return 0.4 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)


def cameras(count: int, width: int, height: int, *, distance: float = 3.0) -> dict[str, object]:
    """Arguments `viewmats, Ks, width, height` of cameras around the origin, principal point off centre."""
    eyes = [
        [distance * math.cos(2.1 * i + 0.3), distance * math.sin(2.1 * i + 0.3), 0.4 + 0.3 * i]
        for i in range(count)
    ]
    views = Cameras.look_at(eyes, [0.0, 0.0, 0.0], vertical_fov=0.8, width=width, height=height)
    Ks = views.Ks.clone()
    Ks[:, 0, 0] *= 1.1
    Ks[:, 0, 2] += 1.7
    Ks[:, 1, 2] -= 0.9
    return {"viewmats": views.viewmats, "Ks": Ks, "width": width, "height": height}


def frontal(depth: float, focal: float, width: int, height: int) -> dict[str, object]:
    """One camera at the origin looking along +z; a point at (0, 0, depth) lands in the middle."""
    K = torch.tensor([[[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]]])
    return {"viewmats": torch.eye(4)[None], "Ks": K, "width": width, "height": height}
