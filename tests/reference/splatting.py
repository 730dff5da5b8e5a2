"""A dense float64 rasteriser of 3D Gaussians to compare with: every Gaussian against every pixel, no tiles.

It follows the text of the method (Kerbl et al. 2023; EWA projection, Zwicker et al. 2002) in plain torch.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotation_matrices(quats: Tensor) -> Tensor:
    """[N, 4] wxyz -> [N, 3, 3]."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [
        [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
    ]
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def harmonics(directions: Tensor, degree: int) -> Tensor:
    """Real spherical harmonics [N, (degree + 1)^2] of unit directions [N, 3], as polynomials."""
    x, y, z = directions.unbind(-1)
    pi = torch.pi
    one = torch.ones_like(x)
    basis = [one * (1 / (4 * pi)) ** 0.5]
    if degree > 0:
        c = (3 / (4 * pi)) ** 0.5
        basis += [-c * y, c * z, -c * x]
    if degree > 1:
        c = (15 / (4 * pi)) ** 0.5
        basis += [
            c * x * y,
            -c * y * z,
            (5 / (16 * pi)) ** 0.5 * (3 * z * z - 1),
            -c * x * z,
            c / 2 * (x * x - y * y),
        ]
    if degree > 2:
        c, d = (35 / (32 * pi)) ** 0.5, (21 / (32 * pi)) ** 0.5
        basis += [
            -c * y * (3 * x * x - y * y),
            (105 / (4 * pi)) ** 0.5 * x * y * z,
            -d * y * (5 * z * z - 1),
            (7 / (16 * pi)) ** 0.5 * z * (5 * z * z - 3),
            -d * x * (5 * z * z - 1),
            (105 / (16 * pi)) ** 0.5 * z * (x * x - y * y),
            -c * x * (x * x - 3 * y * y),
        ]
    return torch.stack(basis, -1)


def project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
    eps2d: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Pixel means [N, 2], blurred covariances [N, 2, 2], depths [N], compensations [N] of one camera."""
    points = means @ viewmat[:3, :3].T + viewmat[:3, 3]
    z = points[:, 2]
    pixels = points @ K[:2].T / z[:, None]
    # Jacobian of the pinhole projection, at the mean pulled to 0.15 image sizes outside the image.
    size = torch.tensor([width, height], dtype=means.dtype)
    center = K[:2, 2]
    ray = torch.minimum(torch.maximum(pixels - center, -center - 0.15 * size), size - center + 0.15 * size)
    jacobian = torch.cat([K[:2, :2].expand(len(z), 2, 2), -ray[:, :, None]], dim=2) / z[:, None, None]
    axes = rotation_matrices(quats) * scales[:, None, :]
    camera = viewmat[:3, :3] @ (axes @ axes.transpose(1, 2)) @ viewmat[:3, :3].T
    covariance = jacobian @ camera @ jacobian.transpose(1, 2)
    blurred = covariance + eps2d * torch.eye(2, dtype=means.dtype)
    compensation = (torch.linalg.det(covariance) / torch.linalg.det(blurred)).clamp(min=0).sqrt()
    return pixels, blurred, z, compensation


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    antialiased: bool = False,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Images [C, H, W, D], alphas [C, H, W], accumulated depths [C, H, W] and margins [C, H, W], float64.

    A margin says how near a pixel comes to a threshold that float32 may decide otherwise: the smallest
    relative distance of an alpha to 1/255, or of a transmittance to 1e-4. Depths must not be near ties.
    """
    tensors = [means, quats, scales, opacities, colors, viewmats, Ks]
    means, quats, scales, opacities, colors, viewmats, Ks = (t.to("cpu", torch.float64) for t in tensors)
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    grid = torch.stack([x, y], -1).to(torch.float64)
    results = []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        pixels, covariance, z, compensation = project(means, quats, scales, viewmat, K, width, height, eps2d)
        if sh_degree is not None:
            center = torch.linalg.inv(viewmat)[:3, 3]
            basis = harmonics(torch.nn.functional.normalize(means - center, dim=-1), sh_degree)
            rgb = (torch.einsum("nk,nkc->nc", basis, colors[:, : basis.shape[1]]) + 0.5).clamp(min=0)
        else:
            rgb = colors[camera] if colors.ndim == 3 else colors
        weight = opacities * compensation if antialiased else opacities
        transmittance = torch.ones(height, width, dtype=torch.float64)
        going = torch.ones(height, width, dtype=torch.bool)
        image = torch.zeros(height, width, rgb.shape[1], dtype=torch.float64)
        depth = torch.zeros(height, width, dtype=torch.float64)
        margin = torch.ones(height, width, dtype=torch.float64)
        for n in torch.argsort(z).tolist():
            if not near_plane <= z[n] <= far_plane:
                continue
            offset = grid - pixels[n]
            quadratic = torch.einsum("hwi,ij,hwj->hw", offset, torch.linalg.inv(covariance[n]), offset)
            raw = weight[n] * torch.exp(-0.5 * quadratic)
            alpha = raw.clamp(max=0.99)
            seen = going & (raw >= 1 / 255)
            after = transmittance * (1 - alpha)
            margin = torch.where(going, torch.minimum(margin, (raw * 255 - 1).abs()), margin)
            margin = torch.where(seen, torch.minimum(margin, (after / 1e-4 - 1).abs()), margin)
            going = going & ~(seen & (after <= 1e-4))
            w = torch.where(seen & going, alpha * transmittance, 0.0)
            image += w[..., None] * rgb[n]
            depth += w * z[n]
            transmittance = torch.where(seen & going, after, transmittance)
        if backgrounds is not None:
            image += transmittance[..., None] * backgrounds[camera].to("cpu", torch.float64)
        results.append((image, 1 - transmittance, depth, margin))
    image, alpha, depth, margin = (torch.stack(list(parts)) for parts in zip(*results, strict=True))
    return image, alpha, depth, margin
