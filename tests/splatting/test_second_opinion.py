"""gsplat's torch code, which runs on a CPU, as a second opinion on projection, harmonics and surfels."""

from __future__ import annotations

import pytest
import torch
from gsplat.cuda._torch_impl import (
    _fully_fused_projection,
    _quat_scale_to_covar_preci,
    _spherical_harmonics,
)
from gsplat.cuda._torch_impl_2dgs import _fully_fused_projection_2dgs
from gsplat.utils import depth_to_normal
from torch import Tensor

from gdpro_sim.splatting import rasterization
from tests.reference import splatting, surfels
from tests.splatting.scenes import cameras, cloud, features, harmonics

WIDTH, HEIGHT = 53, 37


def scene_and_views(seed: int, distance: float = 3.0) -> tuple[dict[str, Tensor], dict[str, object]]:
    return cloud(40, seed), cameras(3, WIDTH, HEIGHT, distance=distance)


def double(scene: dict[str, Tensor], *names: str) -> list[Tensor]:
    return [scene[name].double() for name in names]


def their_projection(scene: dict[str, Tensor], views: dict[str, object]) -> tuple[Tensor, ...]:
    covariances, _ = _quat_scale_to_covar_preci(*double(scene, "quats", "scales"), compute_preci=False)
    viewmats, Ks = (views[k].double() for k in ("viewmats", "Ks"))
    return _fully_fused_projection(
        scene["means"].double(), covariances, viewmats, Ks, WIDTH, HEIGHT, calc_compensations=True
    )


@pytest.mark.parametrize("distance", [3.0, 0.4])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_projection(seed: int, distance: float) -> None:
    """Distance 0.4 puts cameras inside, where means are pulled toward the image to linearize perspective."""
    scene, views = scene_and_views(seed, distance)
    _, means2d, depths, conics, compensations = their_projection(scene, views)
    ahead = depths > 0.01
    for camera in range(3):
        own = [views[k][camera].double() for k in ("viewmats", "Ks")]
        pixels, covariances, z, factors = splatting.project(
            *double(scene, "means", "quats", "scales"), *own, WIDTH, HEIGHT, 0.3
        )
        inverse = torch.linalg.inv(covariances)
        upper = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
        for ours, theirs in (
            (pixels, means2d),
            (z, depths),
            (upper, conics),
            (factors, compensations),
        ):
            torch.testing.assert_close(
                ours[ahead[camera]], theirs[camera][ahead[camera]], rtol=1e-9, atol=1e-9
            )

    _, _, meta = rasterization(**scene, colors=features(40, 3, seed), **views, rasterize_mode="antialiased")
    drawn = (meta["radii"] > 0).all(-1)
    assert drawn.sum() > 20
    assert ahead[drawn].all()
    torch.testing.assert_close(meta["means2d"].double()[drawn], means2d[drawn], rtol=1e-5, atol=1e-4)
    torch.testing.assert_close(meta["depths"].double()[drawn], depths[drawn], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(meta["projection"].conics.double()[drawn], conics[drawn], rtol=1e-4, atol=1e-6)
    opacities = compensations * scene["opacities"]
    torch.testing.assert_close(meta["opacities"].double()[drawn], opacities[drawn], rtol=1e-4, atol=1e-6)


def test_radii() -> None:
    """Their box holds an opaque Gaussian down to 1/255; ours is the same for those and smaller for others."""
    scene, views = scene_and_views(3)
    theirs = their_projection(scene, views)[0]
    _, _, meta = rasterization(**scene, colors=features(40, 3, 3), **views)
    assert (meta["radii"] <= theirs).all()
    opaque = {**scene, "opacities": torch.ones(40)}
    _, _, meta = rasterization(**opaque, colors=features(40, 3, 3), **views)
    drawn = (meta["radii"] > 0).all(-1)
    assert drawn.sum() > 60
    difference = (theirs - meta["radii"])[drawn]
    assert difference.min() >= 0
    assert difference.max() <= 1
    assert (difference == 0).float().mean() > 0.9


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics(degree: int) -> None:
    scene, views = scene_and_views(4)
    sh = harmonics(40, 3, degree)
    viewmats = views["viewmats"].double()
    centers = torch.linalg.inv(viewmats)[:, :3, 3]
    directions = scene["means"].double() - centers[:, None]
    coefficients = sh.double().expand(3, -1, -1, -1)
    theirs = (_spherical_harmonics(degree, directions, coefficients) + 0.5).clamp(min=0)
    for camera in range(3):
        points = splatting.camera_points(scene["means"].double(), viewmats[camera])
        ours, _ = splatting.shade(sh.double(), splatting.toward(points, viewmats[camera]), degree)
        torch.testing.assert_close(ours, theirs[camera], rtol=1e-6, atol=1e-6)

    image, _, _ = rasterization(**scene, colors=sh, **views, sh_degree=degree)
    expected, _, _ = rasterization(**scene, colors=theirs.float(), **views)
    assert (image - expected).abs().max() < 1e-5


def their_hits(transforms: Tensor) -> tuple[Tensor, Tensor]:
    """(u, v) [N, H, W, 2] and depth [N, H, W] of every pixel's ray on every surfel, from [N, 3, 3]."""
    x, y = splatting.pixel_grid(WIDTH, HEIGHT)[..., None].unbind(-2)
    rows_x, rows_y, rows_z = transforms[:, None, None].unbind(-2)
    crossed = torch.linalg.cross(x * rows_z - rows_x, y * rows_z - rows_y)
    uv = crossed[..., :2] / crossed[..., 2:]
    return uv, (rows_z[..., :2] * uv).sum(-1) + rows_z[..., 2]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_surfels(seed: int) -> None:
    scene, views = scene_and_views(seed)
    unit = torch.cat(
        [scene["scales"][:, :2], torch.ones(40, 1)], -1
    )  # their normal has the third scale's length
    viewmats, Ks = (views[k].double() for k in ("viewmats", "Ks"))
    _, means2d, depths, transforms, normals = _fully_fused_projection_2dgs(
        *double(scene, "means", "quats"), unit.double(), viewmats, Ks, WIDTH, HEIGHT
    )
    ahead = depths > 0.01
    for camera in range(3):
        viewmat, K, seen = viewmats[camera], Ks[camera], ahead[camera]
        points = splatting.camera_points(scene["means"].double(), viewmat)
        rotations = splatting.rotation_matrices(scene["quats"].double())
        axes = viewmat[:3, :3] @ rotations * scene["scales"].double()[:, None]
        a, b = axes[..., 0], axes[..., 1]
        # Where the circle crosses the camera's plane theirs is the middle of a hyperbola.
        centers, _ = surfels.centers2d(points, a, b, K)
        whole = seen & (points[:, 2] ** 2 > a[:, 2] ** 2 + b[:, 2] ** 2)
        assert whole.sum() > 30
        torch.testing.assert_close(centers[whole], means2d[camera][whole])
        facing, _ = splatting.facing(rotations[..., 2], splatting.toward(points, viewmat))
        torch.testing.assert_close((facing @ viewmat[:3, :3].T)[seen], normals[camera][seen])

        theirs, z = their_hits(transforms[camera])
        u, v, t = surfels.intersect(points, a, b, surfels.rays(K, splatting.pixel_grid(WIDTH, HEIGHT)[None]))
        torch.testing.assert_close(torch.stack([u, v], -1)[seen], theirs[seen], rtol=1e-6, atol=1e-6)
        torch.testing.assert_close(t[seen], z[seen], rtol=1e-6, atol=1e-6)


def test_normals_from_depth() -> None:
    views = cameras(3, WIDTH, HEIGHT)
    viewmats, Ks = (views[k].double() for k in ("viewmats", "Ks"))
    depth = 1 + torch.rand(3, HEIGHT, WIDTH, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    theirs = depth_to_normal(depth[..., None], torch.linalg.inv(viewmats), Ks)
    torch.testing.assert_close(surfels.depth_normals(depth, viewmats, Ks), theirs, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("index", range(6))
def test_image_of_one_surfel(index: int) -> None:
    """Alpha, depth and normal from a single surfel's transform: the stronger of disc and low-pass."""
    from gdpro_sim.splatting import rasterization_2dgs

    scene, views = cloud(6, 7, size=0.2), cameras(1, WIDTH, HEIGHT)
    one = {k: v[index : index + 1] for k, v in scene.items()}
    unit = torch.cat([one["scales"][:, :2], torch.ones(1, 1)], -1)
    viewmats, Ks = (views[k].double() for k in ("viewmats", "Ks"))
    _, means2d, depths, transforms, normals = _fully_fused_projection_2dgs(
        *double(one, "means", "quats"), unit.double(), viewmats, Ks, WIDTH, HEIGHT
    )
    uv, z = their_hits(transforms[0])
    disc = (uv[0] ** 2).sum(-1)
    low_pass = 2 * ((splatting.pixel_grid(WIDTH, HEIGHT) - means2d[0, 0]) ** 2).sum(-1)
    raw = one["opacities"] * torch.exp(-0.5 * torch.minimum(disc, low_pass))
    expected = torch.where(raw >= 1 / 255, raw.clamp(max=0.99), 0.0)

    image, alpha, normal, *_ = rasterization_2dgs(
        **one, colors=torch.ones(1, 3), **views, render_mode="RGB+ED"
    )
    away = ((raw * 255 - 1).abs() > 1e-3) & ((disc / low_pass - 1).abs() > 1e-3)
    assert (expected > 0).sum() > 10
    assert (alpha[0, ..., 0] - expected)[away].abs().max() < 1e-5
    seen = away & (expected > 0)
    depth = torch.where(disc <= low_pass, z[0], depths[0, 0])
    assert (image[0, ..., 3] - depth)[seen].abs().max() < 1e-4
    world = normals[0, 0] @ viewmats[0, :3, :3]
    assert (normal[0] - expected[..., None] * world)[seen].abs().max() < 1e-5
