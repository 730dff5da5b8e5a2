"""A dense float64 rasteriser of surfels to compare with: every ray against every disc, no tiles.

It follows the text of the method (Huang et al., "2D Gaussian Splatting", 2024) in plain torch: each pixel's
ray is intersected with each disc's plane in camera space. Autograd gives the gradient to every input;
decisions are made on detached values.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from tests.reference.splatting import (
    blend,
    camera_points,
    doubles,
    facing,
    intrinsics,
    pixel_grid,
    rotation_matrices,
    scattered,
    shade,
    smallest,
    toward,
    visible,
)

STEEP = 2e-3


@dataclass(frozen=True)
class Rendering:
    """What the dense rasteriser leaves; C cameras, N surfels, D channels. w are the blending weights.

    image [C, H, W, D], alpha [C, H, W], depth [C, H, W] (sum of w times the depth z of the ray's hit), median
    [C, H, W] (z of the last surfel before which more than half passes), normals [C, H, W, 3] (sum of w times
    the world-space normal that faces the camera), distortion [C, H, W] (sum over pairs j before i of
    2 w_i w_j (z_i - z_j)), weights [C, N, H, W] and means2d [C, N, 2] in pixels.

    margin and kink [C, H, W]: see `tests.reference.splatting.Rendering`. Here the margin counts a
    transmittance near 0.5 and two kernels (disc and low-pass) nearly equal, too, and STEEP over the standard
    deviations that a disc's hit moves by from a pixel to the next: discs near edge-on lose digits.
    """

    image: Tensor
    alpha: Tensor
    depth: Tensor
    median: Tensor
    normals: Tensor
    distortion: Tensor
    margin: Tensor
    kink: Tensor
    weights: Tensor
    means2d: Tensor


def rays(K: Tensor, pixels: Tensor) -> Tensor:
    """[..., 3] camera-space directions through pixel positions [..., 2], with z = 1."""
    focal, center = intrinsics(K)
    offsets = pixels - center
    y = offsets[..., 1] / focal[1, 1]
    x = (offsets[..., 0] - focal[0, 1] * y) / focal[0, 0]
    return torch.stack([x, y, torch.ones_like(x)], -1)


def intersect(
    points: Tensor, u_axes: Tensor, v_axes: Tensor, directions: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Hits u, v and t [N, H, W] of rays t d [N or 1, H, W, 3] with planes p + u a + v b; else infinite."""
    normals = torch.linalg.cross(u_axes, v_axes)
    facing_ray = (normals[:, None, None] * directions).sum(-1)
    parallel = facing_ray == 0
    t = (normals * points).sum(-1)[:, None, None] / torch.where(parallel, 1.0, facing_ray)
    hits = t[..., None] * directions - points[:, None, None]
    # The dual basis of a and b in their plane reads u and v off a hit.
    square = (normals * normals).sum(-1, keepdim=True)
    u = torch.einsum("nhwi,ni->nhw", hits, torch.linalg.cross(v_axes, normals) / square)
    v = torch.einsum("nhwi,ni->nhw", hits, torch.linalg.cross(normals, u_axes) / square)
    infinite = torch.full_like(t, float("inf"))
    return tuple(torch.where(parallel, infinite, value) for value in (u, v, t))


@torch.no_grad()
def steepness(points: Tensor, u_axes: Tensor, v_axes: Tensor, K: Tensor, pixels: Tensor) -> Tensor:
    """[N, H, W]: how far the hits (u, v) of rays through pixels [N or 1, H, W, 2] move in a pixel."""
    u, v, _ = intersect(points, u_axes, v_axes, rays(K, pixels))
    total = torch.zeros_like(u)
    for shift in torch.eye(2, dtype=torch.float64) * 1e-4:
        near_u, near_v, _ = intersect(points, u_axes, v_axes, rays(K, pixels + shift))
        total += ((near_u - u) / 1e-4) ** 2 + ((near_v - v) / 1e-4) ** 2
    return total.nan_to_num(float("inf")).sqrt()


def centers2d(points: Tensor, u_axes: Tensor, v_axes: Tensor, K: Tensor) -> tuple[Tensor, Tensor]:
    """[N, 2] pixels: centres of the ellipses that the discs' one-sigma circles project to, and margins [N].

    A circle point is p + cos(s) a + sin(s) b. Its image's outermost x solve
    (p_x - x p_z)^2 = (a_x - x a_z)^2 + (b_x - x b_z)^2, and the centre lies half way between the two. Where
    the circle crosses the camera's plane there is no ellipse: the projected centre is taken instead.
    """
    columns = torch.stack([points, u_axes, v_axes], -1)
    signed = columns * torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64)
    square = (signed[:, 2:] * columns[:, 2:]).sum(-1)
    ahead = square.detach() > 0
    middle = (signed[:, :2] * columns[:, 2:]).sum(-1) / torch.where(ahead, square, 1.0)
    middle = torch.where(ahead, middle, points[:, :2] / points[:, 2:])
    focal, center = intrinsics(K)
    return middle @ focal.T + center, square[:, 0].detach().abs() / points[:, 2].detach() ** 2


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
    sh_degree: int | None = None,
    backgrounds: Tensor | None = None,
    shifts: Tensor | None = None,
) -> Rendering:
    """Render N surfels into C cameras; differentiable in every tensor.

    `shifts` [C, N, H, W, 2], in pixels, move a surfel in the image, for each pixel by itself: the gradient to
    them (at zero) is a pixel's share of that to the surfel's place in the image.
    """
    means, quats, scales, opacities, colors, viewmats, Ks = doubles(
        means, quats, scales, opacities, colors, viewmats, Ks
    )
    count = len(means)
    grid = pixel_grid(width, height)
    results = []
    for camera, (viewmat, K) in enumerate(zip(viewmats, Ks, strict=True)):
        index = visible(camera_points(means, viewmat), near_plane, far_plane)
        points = camera_points(means[index], viewmat)
        directions = toward(points, viewmat)
        own = colors[camera] if colors.ndim == 3 and sh_degree is None else colors
        rgb, color_kinks = shade(own[index], directions, sh_degree)
        axes = rotation_matrices(quats[index])
        normals, cosines = facing(axes[..., 2], directions)
        u_axes = axes[..., 0] * scales[index, :1] @ viewmat[:3, :3].T
        v_axes = axes[..., 1] * scales[index, 1:2] @ viewmat[:3, :3].T

        pixels = grid[None] if shifts is None else grid - shifts[camera][index]
        u, v, t = intersect(points, u_axes, v_axes, rays(K, pixels))
        ahead = t.detach() > 0
        disc = torch.where(ahead, u * u + v * v, float("inf"))
        means2d, whole = centers2d(points, u_axes, v_axes, K)
        low_pass = 2 * ((pixels - means2d[:, None, None]) ** 2).sum(-1)
        hit = (disc <= low_pass).detach()
        raw = opacities[index, None, None] * torch.exp(-0.5 * torch.where(hit, disc, low_pass))
        z = torch.where(hit, t, points[:, 2, None, None])

        weights, transmittances, seen, margin, kink = blend(raw, points[:, 2])
        before = transmittances[:-1].detach()
        margin = torch.minimum(
            margin, smallest([(disc / low_pass - 1).detach().abs(), (before / 0.5 - 1).abs()], seen)
        )
        steep = STEEP / steepness(points, u_axes, v_axes, K, pixels)
        margin = torch.minimum(margin, smallest([steep], seen & hit))
        margin = torch.minimum(margin, smallest([whole], seen & ~hit))
        kink = torch.minimum(torch.minimum(kink, margin), smallest([color_kinks, cosines], seen))

        blended = weights.detach() > 0
        last = torch.where(blended & (before > 0.5), torch.arange(1, len(index) + 1)[:, None, None], 0)
        last = torch.cat([torch.zeros_like(last[:0].sum(0, keepdim=True)), last]).amax(0)
        median = torch.cat([torch.zeros((1, height, width), dtype=torch.float64), z]).gather(0, last[None])[0]

        nearer = torch.cumsum(weights, 0) - weights
        nearer_depth = torch.cumsum(weights * z, 0) - weights * z
        image = torch.einsum("nhw,nc->hwc", weights, rgb)
        if backgrounds is not None:
            image = image + transmittances[-1][..., None] * backgrounds[camera].to("cpu", torch.float64)
        results.append(
            (
                image,
                1 - transmittances[-1],
                (weights * z).sum(0),
                median,
                torch.einsum("nhw,nc->hwc", weights, normals),
                2 * (weights * (z * nearer - nearer_depth)).sum(0),
                margin,
                kink,
                scattered(weights, index, count),
                scattered(means2d, index, count),
            )
        )
    return Rendering(*(torch.stack(list(parts)) for parts in zip(*results, strict=True)))


def depth_normals(depth: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """World-space normals [C, H, W, 3] of depth images [C, H, W]: differences of back-projected points.

    Zero on the border and where the differences have no normal. The pixel of a normal reads four neighbours.
    """
    images = []
    for z, viewmat, K in zip(depth, *doubles(viewmats, Ks), strict=True):
        height, width = z.shape
        points = z[..., None] * rays(K, pixel_grid(width, height))
        world = (points - viewmat[:3, 3]) @ torch.linalg.inv(viewmat[:3, :3]).T
        down = world[2:, 1:-1] - world[:-2, 1:-1]
        right = world[1:-1, 2:] - world[1:-1, :-2]
        normal = torch.linalg.cross(down, right)
        some = (normal.detach() != 0).any(-1, keepdim=True)
        normal = torch.where(some, normal, torch.ones_like(normal))
        normal = torch.where(some, torch.nn.functional.normalize(normal, dim=-1), 0.0)
        images.append(torch.nn.functional.pad(normal, (0, 0, 1, 1, 1, 1)))
    return torch.stack(images)


__all__ = ["STEEP", "Rendering", "centers2d", "depth_normals", "intersect", "rays", "render"]
