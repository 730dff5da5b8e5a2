"""A dense float64 rasteriser of 3D Gaussians to compare with: every Gaussian against every pixel, no tiles.

It follows the text of the method (Kerbl et al. 2023; EWA projection, Zwicker et al. 2002) in plain torch,
so that autograd gives the gradient to every input. Decisions (cull, sort, skip, stop, facing) are made on
detached values.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rendering:
    """What the dense rasteriser leaves; C cameras, N Gaussians, D channels.

    image [C, H, W, D], alpha [C, H, W], depth [C, H, W] (sum of weight times z) and normals [C, H, W, 3]
    (sum of weight times world-space shortest axis, facing the camera); weights [C, N, H, W] of blending and
    means2d [C, N, 2] in pixels, both zero where a Gaussian is culled.

    margin [C, H, W] says how near a pixel comes to a decision that float32 may take otherwise: the smallest
    relative distance of an alpha to 1/255 or of a transmittance to 1e-4, and 300 times that between the
    depths of two Gaussians seen there. kink [C, H, W] is the smallest of the margin and the distances to
    where a gradient jumps: of an alpha to 0.99, of a colour to the clamp at 0, of a mean to where it is
    pulled in. With `normals`, of a view direction to grazing and of the two shortest axes to each other, too.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    normals: Tensor
    margin: Tensor
    kink: Tensor
    weights: Tensor
    means2d: Tensor


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


def camera_points(means: Tensor, viewmat: Tensor) -> Tensor:
    """[N, 3] world -> camera; the twelve numbers of a view matrix [4, 4] are taken as they are."""
    return means @ viewmat[:3, :3].T + viewmat[:3, 3]


def intrinsics(K: Tensor) -> tuple[Tensor, Tensor]:
    """[2, 2] focal lengths and skew, [2] principal point: the five entries of K [3, 3] that count."""
    zero = torch.zeros_like(K[0, 0])
    focal = torch.stack([torch.stack([K[0, 0], K[0, 1]]), torch.stack([zero, K[1, 1]])])
    return focal, K[:2, 2]


def pixel_grid(width: int, height: int) -> Tensor:
    """[H, W, 2] pixel centres (x, y)."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    return torch.stack([x, y], -1).to(torch.float64)


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
    points = camera_points(means, viewmat)
    z = points[:, 2]
    focal, center = intrinsics(K)
    pixels = points[:, :2] @ focal.T / z[:, None] + center
    # Jacobian of the pinhole projection, at the mean pulled to 0.15 image sizes outside the image.
    size = torch.tensor([width, height], dtype=means.dtype)
    ray = torch.minimum(torch.maximum(pixels, -0.15 * size), 1.15 * size) - center
    jacobian = torch.cat([focal.expand(len(z), 2, 2), -ray[:, :, None]], dim=2) / z[:, None, None]
    axes = rotation_matrices(quats) * scales[:, None, :]
    camera = viewmat[:3, :3] @ (axes @ axes.transpose(1, 2)) @ viewmat[:3, :3].T
    covariance = jacobian @ camera @ jacobian.transpose(1, 2)
    blurred = covariance + eps2d * torch.eye(2, dtype=means.dtype)
    compensation = (torch.linalg.det(covariance) / torch.linalg.det(blurred)).clamp(min=0).sqrt()
    return pixels, blurred, z, compensation


def visible(points: Tensor, near_plane: float, far_plane: float) -> Tensor:
    """Indices of camera-space points [N, 3] between the planes, in ascending depth."""
    z = points[:, 2].detach()
    order = torch.argsort(z, stable=True)
    return order[(z[order] >= near_plane) & (z[order] <= far_plane) & (z[order] > 0)]


def toward(points: Tensor, viewmat: Tensor) -> Tensor:
    """Unit world-space directions [N, 3] from the camera to camera-space points, for a rigid view matrix."""
    return torch.nn.functional.normalize(points @ viewmat[:3, :3], dim=-1)


def shade(colors: Tensor, directions: Tensor, sh_degree: int | None) -> tuple[Tensor, Tensor]:
    """Colours [N, D] of spherical harmonics [N, K, 3] (or the features as they are), and kinks [N]."""
    if sh_degree is None:
        return colors, torch.ones(len(colors), dtype=torch.float64)
    basis = harmonics(directions, sh_degree)
    rgb = torch.einsum("nk,nkc->nc", basis, colors[:, : basis.shape[1]]) + 0.5
    return rgb.clamp(min=0), rgb.detach().abs().amin(-1)


def facing(axes: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Unit axes [N, 3] turned against `directions` [N, 3], and kinks [N]: cosines between them."""
    cosines = (axes * directions).sum(-1).detach()
    return torch.where(cosines[:, None] > 0, -axes, axes), cosines.abs()


def smallest(kinks: Iterable[Tensor], where: Tensor) -> Tensor:
    """[H, W]: the smallest of the kinks ([N] or [N, H, W] each) of Gaussians `where` [N, H, W], at most 1."""
    least = torch.ones(where.shape[1:], dtype=torch.float64)
    for kink in kinks:
        here = kink if kink.ndim == 3 else kink[:, None, None]
        marked = torch.where(where, here, 1.0)
        least = torch.minimum(least, torch.cat([marked, least[None]]).amin(0))
    return least


def blend(raw: Tensor, z: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Front-to-back blending of alphas [N, H, W] before their limit, at depths z [N].

    Returns weights [N, H, W], transmittances [N + 1, H, W] before each and after all, which Gaussians a pixel
    sees [N, H, W], its margin and its kink [H, W].
    """
    alpha = raw.clamp(max=0.99)
    one = torch.ones((1, *raw.shape[1:]), dtype=raw.dtype)
    with torch.no_grad():
        seen = raw >= 1 / 255
        after = torch.cumprod(torch.where(seen, 1 - alpha, 1.0), 0)
        going = torch.cat([one, after])[:-1] > 1e-4
        seen = seen & going
        blended = seen & (after > 1e-4)
        gaps = 300 * z.diff() / z[1:]
        margin = torch.minimum(
            smallest([(raw * 255 - 1).abs()], going), smallest([gaps], seen[1:] & seen[:-1])
        )
        margin = torch.minimum(margin, smallest([(after / 1e-4 - 1).abs()], seen))
        kink = torch.minimum(margin, smallest([(raw / 0.99 - 1).abs()], seen))
    alpha = torch.where(blended, alpha, 0.0)
    transmittances = torch.cat([one, torch.cumprod(1 - alpha, 0)])
    return alpha * transmittances[:-1], transmittances, seen, margin, kink


def scattered(values: Tensor, index: Tensor, count: int) -> Tensor:
    """Rows `values` put at `index` of `count` rows of zeros."""
    return torch.zeros((count, *values.shape[1:]), dtype=values.dtype).index_copy(0, index, values)


def doubles(*tensors: Tensor) -> list[Tensor]:
    return [t.to("cpu", torch.float64) for t in tensors]


def render(
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
    normals: bool = False,
    shifts: Tensor | None = None,
) -> Rendering:
    """Render N Gaussians into C cameras; differentiable in every tensor.

    `shifts` [C, N, H, W, 2] are added to the pixel means, for each pixel by itself: the gradient to them (at
    zero) is a pixel's share of that to the means.
    """
    means, quats, scales, opacities, colors, viewmats, Ks = doubles(
        means, quats, scales, opacities, colors, viewmats, Ks
    )
    count = len(means)
    grid = pixel_grid(width, height)
    results = []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        index = visible(camera_points(means, viewmat), near_plane, far_plane)
        pixels, covariance, z, compensation = project(
            means[index], quats[index], scales[index], viewmat, K, width, height, eps2d
        )
        directions = toward(camera_points(means[index], viewmat), viewmat)
        rgb, kinks = shade(
            (colors[camera] if colors.ndim == 3 and sh_degree is None else colors)[index],
            directions,
            sh_degree,
        )
        opacity = opacities[index] * compensation if antialiased else opacities[index]

        centers = pixels[:, None, None, :].expand(-1, height, width, 2)
        if shifts is not None:
            centers = centers + shifts[camera][index]
        offsets = grid - centers
        quadratic = torch.einsum("nhwi,nij,nhwj->nhw", offsets, torch.linalg.inv(covariance), offsets)
        raw = opacity[:, None, None] * torch.exp(-0.5 * quadratic)
        weights, transmittances, seen, margin, kink = blend(raw, z)

        ordered, shortest = scales[index].detach().sort(dim=-1, stable=True)
        axes = rotation_matrices(quats[index])
        axes = axes.gather(2, shortest[:, None, :1].expand(-1, 3, 1))[..., 0]
        axes, cosines = facing(axes, directions)

        size = torch.tensor([width, height], dtype=torch.float64)
        bounds = torch.stack([-0.15 * size, 1.15 * size])
        pulled = ((pixels.detach()[:, None] - bounds).abs() / size).flatten(1).amin(-1)
        jumps = [kinks, pulled]
        if normals:
            jumps += [cosines, (ordered[:, 1] - ordered[:, 0]) / ordered[:, 0]]
        kink = torch.minimum(kink, smallest(jumps, seen))

        image = torch.einsum("nhw,nc->hwc", weights, rgb)
        if backgrounds is not None:
            image = image + transmittances[-1][..., None] * backgrounds[camera].to("cpu", torch.float64)
        results.append(
            (
                image,
                1 - transmittances[-1],
                torch.einsum("nhw,n->hw", weights, z),
                torch.einsum("nhw,nc->hwc", weights, axes),
                margin,
                kink,
                scattered(weights, index, count),
                scattered(pixels, index, count),
            )
        )
    return Rendering(*(torch.stack(list(parts)) for parts in zip(*results, strict=True)))


def rasterize(*arguments: object, **options: object) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Image, alpha, depth and margin of `render`."""
    result = render(*arguments, **options)  # type: ignore[arg-type]
    return result.image, result.alpha, result.depth, result.margin


__all__ = [
    "Rendering",
    "blend",
    "camera_points",
    "doubles",
    "facing",
    "harmonics",
    "intrinsics",
    "pixel_grid",
    "project",
    "rasterize",
    "render",
    "rotation_matrices",
    "scattered",
    "shade",
    "smallest",
    "toward",
    "visible",
]
