"""Degenerate scenes give a defined image; malformed arguments give one clear line."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from gdpro_sim.errors import RequestError
from gdpro_sim.splatting import RasterOptions, rasterization
from tests.splatting.scenes import cameras, cloud, features, frontal, harmonics

VALUES = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-30, 1e30, -1e30, 3e38, 1e-45, math.nan, math.inf, -math.inf]


def test_no_gaussians_and_no_cameras() -> None:
    background = torch.tensor([[0.1, 0.2, 0.3]])
    image, alpha, meta = rasterization(
        **cloud(0, 0),
        colors=torch.zeros(0, 3),
        **cameras(1, 9, 7),
        backgrounds=background,
        render_mode="RGB+ED",
    )
    assert torch.equal(image, torch.tensor([0.1, 0.2, 0.3, 0.0]).expand(1, 7, 9, 4))
    assert torch.equal(alpha, torch.zeros(1, 7, 9, 1))
    assert meta["means2d"].shape == (1, 0, 2)
    none = {**cameras(1, 9, 7), "viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}
    image, alpha, _ = rasterization(**cloud(5, 0), colors=features(5, 3, 0), **none)
    assert image.shape == (0, 7, 9, 3)
    assert alpha.shape == (0, 7, 9, 1)


@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_all_culled_is_background(method: str) -> None:
    scene, views = cloud(20, 0), cameras(1, 20, 20)
    image, alpha, meta = rasterization(
        **scene,
        colors=features(20, 3, 0),
        **views,
        near_plane=100.0,
        backgrounds=torch.ones(1, 3),
        options=RasterOptions(method=method),
    )
    assert torch.equal(image, torch.ones_like(image))
    assert torch.equal(alpha, torch.zeros_like(alpha))
    assert torch.equal(meta["radii"], torch.zeros_like(meta["radii"]))
    assert len(meta["flatten_ids"]) == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", ["means", "quats", "scales", "opacities", "colors", "sh"])
def test_not_finite_is_not_drawn(name: str, bad: float) -> None:
    scene, views = cloud(30, 1), cameras(1, 30, 30)
    key = "colors" if name == "sh" else name
    scene["colors"] = harmonics(30, 1, 1) if name == "sh" else features(30, 3, 1)
    degree = {"sh_degree": 1} if name == "sh" else {}
    rest = {k: torch.cat([v[:4], v[5:]]) for k, v in scene.items()}
    scene[key] = scene[key].clone()
    scene[key][4].view(-1)[0] = bad
    image, alpha, meta = rasterization(**scene, **views, **degree)
    expected, expected_alpha, _ = rasterization(**rest, **views, **degree)
    assert torch.equal(image, expected)
    assert torch.equal(alpha, expected_alpha)
    assert (meta["radii"][0, 4] == 0).all()


def test_zero_quaternion_and_zero_scale() -> None:
    scene, views = cloud(10, 2), cameras(1, 30, 30)
    scene["quats"][3] = 0.0
    scene["scales"][5] = 0.0
    _, _, meta = rasterization(**scene, colors=features(10, 3, 2), **views)
    assert (meta["radii"][0, 3] == 0).all()
    assert (meta["radii"][0, 5] > 0).all()


def test_camera_inside_and_splat_larger_than_the_image() -> None:
    scene, views = cloud(300, 3), cameras(1, 32, 32, distance=0.2)
    image, alpha, _ = rasterization(**scene, colors=features(300, 3, 3), **views)
    assert torch.isfinite(image).all()
    assert alpha.min() > 0.5
    huge = {k: v[:1].clone() for k, v in cloud(1, 0).items()}
    huge["means"][0], huge["scales"][0], huge["opacities"][0] = 0.0, 1000.0, 0.5
    huge["means"][0, 2] = 2.0
    _, alpha, _ = rasterization(**huge, colors=torch.ones(1, 3), **frontal(2.0, 100.0, 33, 17))
    assert (alpha - 0.5).abs().max() < 1e-4


def test_one_pixel() -> None:
    scene = {k: v[:1].clone() for k, v in cloud(1, 0).items()}
    scene["means"][0] = torch.tensor([0.0, 0.0, 2.0])
    scene["opacities"][0] = 0.6
    image, alpha, _ = rasterization(**scene, colors=torch.ones(1, 3), **frontal(2.0, 10.0, 1, 1))
    assert image.shape == (1, 1, 1, 3)
    assert alpha.item() == pytest.approx(0.6, abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_any_numbers_give_a_finite_image(data: st.DataObject) -> None:
    count = data.draw(st.integers(1, 4))
    value = st.sampled_from(VALUES) | st.floats(width=32)

    def numbers(*shape: int) -> torch.Tensor:
        n = math.prod(shape)
        return torch.tensor(data.draw(st.lists(value, min_size=n, max_size=n))).reshape(shape)

    width, height = data.draw(st.integers(1, 40)), data.draw(st.integers(1, 40))
    views = frontal(2.0, 20.0, width, height)
    if data.draw(st.booleans()):
        views["viewmats"] = numbers(1, 4, 4)
    if data.draw(st.booleans()):
        views["Ks"] = numbers(1, 3, 3)
    colors = torch.rand(count, 3)
    image, alpha, meta = rasterization(
        numbers(count, 3), numbers(count, 4), numbers(count, 3), numbers(count), colors, **views
    )
    assert torch.isfinite(image).all()
    assert ((alpha >= 0) & (alpha <= 1)).all()
    assert (meta["radii"] >= 0).all()


def call(**changes: object) -> None:
    arguments = {**cloud(4, 0), "colors": features(4, 3, 0), **cameras(1, 8, 8), **changes}
    rasterization(**arguments)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": torch.zeros(4, 2)}, r"means must have shape \[N, 3\], got \[4, 2\]"),
        ({"quats": torch.zeros(5, 4)}, r"quats must have shape \[4, 4\], got \[5, 4\]"),
        (
            {"scales": torch.zeros(4, 3, dtype=torch.float64)},
            r"scales must be torch.float32, got torch.float64",
        ),
        ({"opacities": torch.zeros(4, 1)}, r"opacities must have shape \[4\], got \[4, 1\]"),
        ({"opacities": [0.0] * 4}, r"opacities must be a float32 torch tensor \[4\], got list"),
        ({"colors": torch.zeros(4, 0)}, r"colors must have at least one channel"),
        ({"colors": torch.zeros(2, 4, 3)}, r"colors must have shape \[1, 4, D\], got \[2, 4, 3\]"),
        ({"colors": torch.zeros(4, 3, 3), "sh_degree": 1}, r"at least 4 coefficients for sh_degree 1"),
        ({"colors": torch.zeros(4, 25, 3), "sh_degree": 4}, r"sh_degree must be 0, 1, 2, 3 or None, got 4"),
        ({"viewmats": torch.eye(4)}, r"viewmats must have shape \[C, 4, 4\], got \[4, 4\]"),
        ({"Ks": torch.zeros(2, 3, 3)}, r"Ks must have shape \[1, 3, 3\], got \[2, 3, 3\]"),
        ({"width": 0}, r"width must be a whole number of pixels >= 1, got 0"),
        ({"height": 8.0}, r"height must be a whole number of pixels >= 1, got 8.0"),
        ({"near_plane": -1.0}, r"near_plane must be a number >= 0, got -1.0"),
        ({"eps2d": math.nan}, r"eps2d must be a number >= 0, got nan"),
        ({"backgrounds": torch.zeros(1, 4)}, r"backgrounds must have shape \[1, 3\], got \[1, 4\]"),
        ({"render_mode": "rgb"}, r"render_mode must be one of RGB, D, ED, RGB\+D, RGB\+ED, got 'rgb'"),
        ({"rasterize_mode": "soft"}, r"rasterize_mode must be one of classic, antialiased, got 'soft'"),
        ({"packed": True}, r"packed must be False, the only choice here, got True"),
        ({"tile_size": 8}, r"tile_size must be 16, the only choice here, got 8"),
    ],
)
def test_malformed_arguments(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call(**changes)


def test_malformed_options() -> None:
    with pytest.raises(
        ValueError, match=r"RasterOptions\.method must be one of auto, tile, pixel, got 'gpu'"
    ):
        RasterOptions(method="gpu")
    with pytest.raises(
        ValueError, match="max_tile_entries must be a whole number from 0 to 2147483647, got -1"
    ):
        RasterOptions(max_tile_entries=-1)


def test_counts_past_32_bits_are_refused() -> None:
    with pytest.raises(
        RequestError, match=r"image values .* come to 3000000000000, past the limit of 2147483647"
    ):
        call(width=1_000_000, height=1_000_000)
    with pytest.raises(RequestError, match="image columns or rows come to 524288"):
        call(width=524_288, height=1)


def test_strided_input_is_taken_as_it_is() -> None:
    scene, views = cloud(40, 4), cameras(1, 30, 30)
    colors = features(40, 3, 4)
    expected, _, _ = rasterization(**scene, colors=colors, **views)
    strided = {k: torch.stack([v, v + 1], -1)[..., 0] for k, v in scene.items()}
    image, _, _ = rasterization(**strided, colors=colors.T.contiguous().T, **views)
    assert torch.equal(image, expected)
