"""The image against the dense float64 reference."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.splatting import RasterOptions, rasterization
from tests.reference.splatting import rasterize
from tests.splatting.scenes import cameras, cloud, features, harmonics

TOLERANCE = 2e-6
MARGIN = 2e-4


def assert_close(image: torch.Tensor, expected: torch.Tensor, margin: torch.Tensor, tolerance: float) -> None:
    """`image` equals `expected` where no threshold is within MARGIN, which is nearly everywhere."""
    error = (image.double() - expected).abs()
    if error.ndim == margin.ndim + 1:
        error = error.amax(-1)
    away = margin > MARGIN
    assert away.float().mean() > 0.95
    assert error[away].max() <= tolerance
    assert (error > 1e-3).sum() == 0


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("seed", [0, 1, 2, 3])
def test_colour_alpha_and_depth(seed: int, method: str) -> None:
    scene, views = cloud(150, seed), cameras(1, 61, 45)
    colors, background = features(150, 3, seed), torch.tensor([[0.2, 0.7, 0.4]])
    image, alpha, meta = rasterization(
        **scene,
        colors=colors,
        **views,
        backgrounds=background,
        render_mode="RGB+D",
        options=RasterOptions(method=method),
    )
    expected, expected_alpha, expected_depth, margin = rasterize(
        **scene, colors=colors, **views, backgrounds=background
    )
    assert image.shape == (1, 45, 61, 4)
    assert alpha.shape == (1, 45, 61, 1)
    assert_close(image[..., :3], expected, margin, TOLERANCE)
    assert_close(alpha[..., 0], expected_alpha, margin, TOLERANCE)
    assert_close(image[..., 3], expected_depth, margin, 3 * TOLERANCE)
    assert_close(meta["transmittance"], 1 - expected_alpha, margin, TOLERANCE)
    assert expected_alpha.max() > 0.9


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_spherical_harmonics(degree: int) -> None:
    scene, views = cloud(120, 10 + degree), cameras(2, 40, 33)
    colors = harmonics(120, 3, degree)
    image, _, _ = rasterization(**scene, colors=colors, **views, sh_degree=degree)
    expected, _, _, margin = rasterize(**scene, colors=colors, **views, sh_degree=degree)
    assert_close(image, expected, margin, TOLERANCE)


def test_antialiased() -> None:
    scene, views = cloud(200, 5, size=0.02), cameras(1, 48, 48)
    colors = features(200, 3, 5)
    image, alpha, _ = rasterization(**scene, colors=colors, **views, rasterize_mode="antialiased")
    expected, expected_alpha, _, margin = rasterize(**scene, colors=colors, **views, antialiased=True)
    assert_close(image, expected, margin, TOLERANCE)
    assert_close(alpha[..., 0], expected_alpha, margin, TOLERANCE)
    classic, _, _ = rasterization(**scene, colors=colors, **views)
    assert (classic - image).abs().max() > 0.05


def test_expected_depth() -> None:
    scene, views = cloud(100, 6), cameras(1, 50, 40)
    colors = features(100, 3, 6)
    both, alpha, _ = rasterization(**scene, colors=colors, **views, render_mode="RGB+ED")
    alone, _, _ = rasterization(**scene, colors=colors, **views, render_mode="ED")
    summed, _, _ = rasterization(**scene, colors=colors, **views, render_mode="D")
    assert torch.equal(both[..., 3:], alone)
    _, expected_alpha, expected_depth, margin = rasterize(**scene, colors=colors, **views)
    assert_close(summed[..., 0], expected_depth, margin, 3 * TOLERANCE)
    # 1 - T in float32 limits the quotient where little is covered.
    solid = (expected_alpha > 0.05) & (margin > MARGIN)
    assert (alone[..., 0].double() - expected_depth / expected_alpha)[solid].abs().max() < 2e-5
    assert torch.equal(alone[alpha == 0], torch.zeros_like(alone[alpha == 0]))


@pytest.mark.parametrize("channels", [1, 2, 4, 5, 9])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_feature_channels(channels: int, mode: str, method: str) -> None:
    scene, views = cloud(60, 7), cameras(2, 33, 20)
    colors, background = features(60, channels, 7), features(2, channels, 8)
    image, _, _ = rasterization(
        **scene,
        colors=colors,
        **views,
        backgrounds=background,
        render_mode=mode,
        options=RasterOptions(method=method),
    )
    expected, _, _, margin = rasterize(**scene, colors=colors, **views, backgrounds=background)
    assert image.shape[-1] == channels + (mode != "RGB")
    assert_close(image[..., :channels], expected, margin, TOLERANCE)
    if mode != "RGB":
        options = RasterOptions(method=method)
        depth, _, _ = rasterization(**scene, colors=colors, **views, render_mode="ED", options=options)
        assert (image[..., channels:] - depth).abs().max() < 1e-6


@pytest.mark.parametrize("mode", ["RGB", "D", "ED", "RGB+D", "RGB+ED"])
def test_batch_equals_loop(mode: str) -> None:
    scene, views = cloud(80, 9), cameras(3, 37, 35)
    colors = torch.stack([features(80, 3, i) for i in range(3)])
    batch, alphas, meta = rasterization(**scene, colors=colors, **views, render_mode=mode)
    for i in range(3):
        one = {**views, "viewmats": views["viewmats"][i : i + 1], "Ks": views["Ks"][i : i + 1]}
        image, alpha, single = rasterization(**scene, colors=colors[i], **one, render_mode=mode)
        assert torch.equal(batch[i], image[0])
        assert torch.equal(alphas[i], alpha[0])
        assert torch.equal(meta["means2d"][i], single["means2d"][0])
        assert torch.equal(meta["radii"][i], single["radii"][0])


def test_skewed_pixels_and_planes() -> None:
    scene, views = cloud(100, 11), cameras(1, 40, 40)
    views["Ks"][:, 0, 1] = 6.0
    colors = features(100, 3, 11)
    planes = {"near_plane": 2.5, "far_plane": 3.4}
    image, _, meta = rasterization(**scene, colors=colors, **views, **planes)
    expected, _, _, margin = rasterize(**scene, colors=colors, **views, **planes)
    assert_close(image, expected, margin, TOLERANCE)
    drawn = meta["radii"][0, :, 0] > 0
    assert 0 < drawn.sum() < 100
    assert meta["depths"][0, drawn].min() >= 2.5
    assert meta["depths"][0, drawn].max() <= 3.4


def test_projection_in_meta() -> None:
    from tests.reference.splatting import project

    scene, views = cloud(50, 12), cameras(1, 64, 64)
    _, _, meta = rasterization(**scene, colors=features(50, 3, 12), **views)
    doubles = [
        t.double()
        for t in (scene["means"], scene["quats"], scene["scales"], views["viewmats"][0], views["Ks"][0])
    ]
    means2d, covariance, depths, _ = project(*doubles, 64, 64, 0.3)
    drawn = meta["radii"][0, :, 0] > 0
    assert drawn.sum() > 40
    assert (meta["means2d"][0] - means2d)[drawn].abs().max() < 2e-5
    assert (meta["depths"][0] - depths)[drawn].abs().max() < 2e-6
    inverse = torch.linalg.inv(covariance)
    conics = torch.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], -1)
    assert (meta["projection"].conics[0] - conics)[drawn].abs().max() < 1e-5
    cut = 2 * torch.log(255 * scene["opacities"].double())
    extents = (cut[:, None] * torch.stack([covariance[:, 0, 0], covariance[:, 1, 1]], -1)).sqrt()
    difference = (meta["radii"][0] - extents)[drawn]
    assert difference.min() >= 0
    assert difference.max() < 1.01


@pytest.mark.parametrize("seed", [0, 1])
def test_camera_inside_the_cloud(seed: int) -> None:
    """Gaussians past the image border: perspective is linearized at a point pulled in."""
    scene, views = cloud(150, 20 + seed, size=0.15), cameras(1, 40, 30, distance=0.4)
    colors = features(150, 3, seed)
    image, alpha, meta = rasterization(**scene, colors=colors, **views)
    expected, expected_alpha, _, margin = rasterize(**scene, colors=colors, **views)
    means2d, radii = meta["means2d"][0], meta["radii"][0]
    size = torch.tensor([40, 30])
    beyond = ((means2d < -0.15 * size) | (means2d > 1.15 * size)).any(1) & (radii > 0).all(1)
    assert beyond.sum() > 5
    assert_close(image, expected, margin, 5 * TOLERANCE)
    assert_close(alpha[..., 0], expected_alpha, margin, 5 * TOLERANCE)
