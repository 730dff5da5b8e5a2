"""Images and gradients of surfels against the dense float64 reference."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gdpro_sim import device
from gdpro_sim.splatting import RasterOptions, contributions, rasterization_2dgs
from tests.reference.compare import (
    KINK,
    apply,
    compare,
    covered,
    errors,
    functional,
    gradients,
    in_mode,
    leaves,
)
from tests.reference.surfels import depth_normals, render
from tests.splatting.scenes import cameras, cloud, features, frontal, harmonics

TOLERANCE = 1e-4
WIDTH, HEIGHT = 37, 29
SIZE = (WIDTH, HEIGHT)
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]
OUTPUTS = ("image", "alpha", "normals", "distortion", "median")


def inputs_of(
    count: int,
    seed: int,
    *,
    views: int = 2,
    channels: int = 3,
    degree: int | None = None,
    size: float = 0.12,
    distance: float = 3.0,
    width: int = WIDTH,
    height: int = HEIGHT,
) -> dict[str, Tensor]:
    """Every tensor that `rasterization_2dgs` is differentiable in."""
    made = cameras(views, width, height, distance=distance)
    colors = features(count, channels, seed) if degree is None else harmonics(count, degree, seed)
    background = features(views, channels if degree is None else 3, seed + 5)
    return {
        **cloud(count, seed, size=size),
        "colors": colors,
        "viewmats": made["viewmats"],
        "Ks": made["Ks"],
        "backgrounds": background,
    }


def wider(kink: Tensor) -> Tensor:
    """The smallest of a pixel's and its neighbours', which its normal from depth reads."""
    return -torch.nn.functional.max_pool2d(-kink, 3, stride=1, padding=1)


def product_outputs(
    inputs: Mapping[str, Tensor], mode: str, size: tuple[int, int] = SIZE, **options: object
) -> dict[str, Tensor]:
    method = str(options.pop("method", "auto"))
    image, alpha, normals, from_depth, distortion, median, _ = rasterization_2dgs(
        **inputs,
        width=size[0],
        height=size[1],
        render_mode=mode,
        distloss=mode != "RGB",
        options=RasterOptions(method=method),
        **options,
    )
    outputs = {"image": image, "alpha": alpha[..., 0], "normals": normals}
    if mode != "RGB":
        outputs = {**outputs, "distortion": distortion[..., 0], "median": median[..., 0]}
    return {**outputs, "from_depth": from_depth} if mode == "RGB+ED" else outputs


def reference_outputs(
    inputs: Mapping[str, Tensor], mode: str, size: tuple[int, int] = SIZE, **options: object
) -> tuple[dict[str, Tensor], Tensor, Tensor]:
    """Outputs, margin and kink."""
    depth_mode = options.pop("depth_mode", "expected")
    result = render(**inputs, width=size[0], height=size[1], **options)
    image = in_mode(mode, result.image, result.depth, result.alpha)
    outputs = {"image": image, "alpha": result.alpha, "normals": result.normals}
    if mode != "RGB":
        outputs = {**outputs, "distortion": result.distortion, "median": result.median}
    if mode == "RGB+ED":
        depth = image[..., -1] if depth_mode == "expected" else result.median
        from_depth = depth_normals(depth, inputs["viewmats"], inputs["Ks"])
        outputs["from_depth"] = from_depth * result.alpha.detach()[..., None]
    return outputs, result.margin, result.kink


def worst(
    inputs: Mapping[str, Tensor],
    mode: str = "RGB+D",
    size: tuple[int, int] = SIZE,
    *,
    only: tuple[str, ...] = OUTPUTS,
    seed: int = 0,
    least: float = 0.6,
    method: str = "auto",
    **options: object,
) -> dict[str, float]:
    """Errors of every gradient for a scene in a mode, through the outputs named in `only`."""

    def product(given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        outputs = product_outputs(given, mode, size, method=method, **options)
        return {k: v for k, v in outputs.items() if k in only}

    def reference(given: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        outputs, _, kink = reference_outputs(given, mode, size, **options)
        kink = covered(mode, kink, outputs["alpha"])
        return {k: v for k, v in outputs.items() if k in only}, wider(kink) if "from_depth" in only else kink

    return compare(inputs, product, reference, seed, least)


def assert_small(found: dict[str, float], tolerance: float = TOLERANCE) -> None:
    assert max(found.values()) <= tolerance, found


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("seed", range(4))
def test_images(seed: int, method: str) -> None:
    inputs = inputs_of(100, seed)
    with torch.no_grad():
        got = product_outputs(inputs, "RGB+ED", method=method)
        expected, margin, _ = reference_outputs(inputs, "RGB+ED")
    away, far = margin > KINK, margin > 5 * KINK
    assert away.float().mean() > 0.95
    assert far.float().mean() > 0.5
    solid = expected["alpha"] > 0.05
    assert (got["image"][..., 3] - expected["image"][..., 3])[solid & away].abs().max() <= 5e-5
    got["image"], expected["image"] = got["image"][..., :3], expected["image"][..., :3]
    for name in OUTPUTS:
        error = (got[name].double() - expected[name]).abs()
        error = error.amax(-1) if error.ndim == 4 else error
        # At 30 pixels the float32 centre of a low-pass is good to 1e-6 pixels, and so is alpha.
        assert error[far].max() <= 3e-6, name
        assert error[away].max() <= 6e-6, name
    interior = (wider(margin) > KINK) & (-wider(-expected["alpha"]) > 0.05)
    assert (got["from_depth"] - expected["from_depth"])[interior].abs().max() <= 2e-3


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(4))
def test_every_input_in_every_mode(seed: int, mode: str) -> None:
    assert_small(worst(inputs_of(50, seed), mode, seed=seed))


@pytest.mark.parametrize("name", OUTPUTS)
@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_each_output_alone(name: str, method: str) -> None:
    assert_small(worst(inputs_of(50, 10), "RGB+D", only=(name,), method=method))


@pytest.mark.parametrize("depth_mode", ["expected", "median"])
def test_normals_from_depth(depth_mode: str) -> None:
    """Differences of neighbouring depths lose digits in float32, so these gradients are less exact."""
    inputs = inputs_of(40, 11, size=0.25)
    found = worst(inputs, "RGB+ED", only=("from_depth",), least=0.2, depth_mode=depth_mode)
    assert_small(found, 2e-3)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_harmonics(degree: int) -> None:
    assert_small(worst(inputs_of(50, 12, degree=degree), "RGB+D", sh_degree=degree))


@pytest.mark.parametrize("channels", [1, 3, 4, 5, 9])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_feature_channels(channels: int, mode: str, method: str) -> None:
    assert_small(worst(inputs_of(40, 13, channels=channels), mode, method=method))


def test_colours_of_each_camera_and_no_backgrounds() -> None:
    inputs = inputs_of(40, 14)
    inputs["colors"] = torch.stack([features(40, 3, 15), features(40, 3, 16)])
    del inputs["backgrounds"]
    assert_small(worst(inputs, "RGB+D"))


def test_two_scales() -> None:
    """The third scale is ignored and may be left out."""
    inputs = inputs_of(40, 16)
    whole = gradients_of(inputs)
    short = gradients_of({**inputs, "scales": inputs["scales"][:, :2]})
    assert (whole["scales"][:, 2] == 0).all()
    assert torch.equal(whole["scales"][:, :2], short["scales"])
    assert all(torch.equal(whole[k], short[k]) for k in whole if k != "scales")


@pytest.mark.parametrize("size", [0.002, 0.01])
def test_small_surfels(size: float) -> None:
    """Where the low-pass is stronger than the disc: gradients through the projected centre."""
    inputs = inputs_of(150, 17, size=size)
    assert_small(worst(inputs, "RGB+D"))


@pytest.mark.parametrize("seed", range(30, 34))
def test_camera_inside_the_cloud(seed: int) -> None:
    inputs = inputs_of(50, seed, degree=1, distance=0.4, size=0.1)
    assert_small(worst(inputs, "RGB+ED", sh_degree=1, least=0.3, near_plane=0.3))


def test_skewed_pixels_and_planes() -> None:
    inputs = inputs_of(80, 40)
    inputs["Ks"][:, 0, 1] = 6.0
    assert_small(worst(inputs, "RGB+D", near_plane=2.5, far_plane=3.4))


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("opacity", [(0.02, 0.05), (0.1, 0.3), (0.3, 0.7)], ids=["faint", "medium", "dense"])
def test_long_lists(opacity: tuple[float, float], method: str) -> None:
    """Hundreds of Gaussians in a pixel: blending to the last of them, or stopping somewhere on the way."""
    inputs = inputs_of(600, 41, views=1, size=0.3, width=20, height=18)
    inputs["opacities"] = opacity[0] + opacity[1] * inputs["opacities"]
    assert_small(worst(inputs, "RGB+ED", (20, 18), least=0.1, method=method))


@pytest.mark.parametrize("cosine", [0.3, 0.03, 0.003])
def test_grazing(cosine: float) -> None:
    """A disc seen nearly edge-on: float32 loses digits with the square of the cosine, and no more."""
    inputs = {k: v[:1].clone() for k, v in cloud(1, 0).items()}
    half = 0.5 * (math.acos(cosine))
    inputs["means"] = torch.tensor([[0.01, -0.02, 2.0]])
    inputs["quats"] = torch.tensor([[math.cos(half), math.sin(half), 0.0, 0.0]])
    inputs["scales"] = torch.full((1, 3), 0.7)
    inputs["opacities"] = torch.tensor([0.8])
    inputs = {**inputs, "colors": features(1, 3, 0), "backgrounds": features(1, 3, 1)}
    view = frontal(2.0, 40.0, 37, 29)
    inputs.update({k: view[k] for k in ("viewmats", "Ks")})
    found = worst(inputs, "RGB+D", least=0.0)
    assert_small(found, max(TOLERANCE, 1e-6 / cosine**2))


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_any_scene(data: st.DataObject) -> None:
    count = data.draw(st.integers(4, 40), "count")  # sums over fewer may cancel
    width, height = data.draw(st.integers(1, 40), "width"), data.draw(st.integers(1, 30), "height")
    degree = data.draw(st.sampled_from([None, 0, 1, 2, 3]), "degree")
    seed = data.draw(st.integers(0, 10**6), "seed")
    inputs = inputs_of(
        count,
        seed,
        views=data.draw(st.integers(1, 3), "views"),
        channels=data.draw(st.sampled_from([1, 2, 3, 4, 5, 9]), "channels"),
        degree=degree,
        size=data.draw(st.sampled_from([0.01, 0.05, 0.2]), "size"),
        distance=data.draw(st.sampled_from([3.0, 8.0]), "distance"),
        width=width,
        height=height,
    )
    mode = data.draw(st.sampled_from(MODES), "mode")
    found = worst(
        inputs,
        mode,
        (width, height),
        seed=seed,
        least=0.0,
        method=data.draw(st.sampled_from(["tile", "pixel"]), "method"),
        sh_degree=degree,
        near_plane=0.5,
    )
    # In a tiny image the digits that 1 - T loses do not average out.
    assert_small(found, (3 if mode.endswith("ED") else 1) * TOLERANCE)


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("channels", [1, 3])
def test_contributions(method: str, channels: int) -> None:
    inputs = inputs_of(50, 44)
    *_, meta = rasterization_2dgs(**inputs, width=WIDTH, height=HEIGHT, options=RasterOptions(method=method))
    result = render(**inputs, width=WIDTH, height=HEIGHT)
    values = torch.randn(2, HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(0))
    values *= (result.margin > KINK)[..., None]
    got = contributions(meta, values)
    expected = torch.einsum("cnhw,chwd->cnd", result.weights, values.double())
    assert got.shape == (2, 50, channels)
    assert (got - expected).abs().max() <= 2e-5 * expected.abs().max()
    assert (contributions(meta) - result.weights.sum((2, 3))).abs().max() < 1.5 / 255


def test_flips_at_thresholds_are_few_and_small() -> None:
    flips = pixels = 0
    for seed in range(8):
        inputs = inputs_of(100, 100 + seed)
        with torch.no_grad():
            got = product_outputs(inputs, "RGB")
            expected, margin, _ = reference_outputs(inputs, "RGB")
        error = torch.maximum(
            (got["image"] - expected["image"]).abs().amax(-1), (got["alpha"] - expected["alpha"]).abs()
        )
        flipped = error > 1e-5
        assert (margin[flipped] < 5 * KINK).all()
        assert error.max() < 1.01 / 255
        flips, pixels = flips + int(flipped.sum()), pixels + flipped.numel()
    assert flips <= 5e-4 * pixels


def gradients_of(inputs: Mapping[str, Tensor], mode: str = "RGB+ED", **options: object) -> dict[str, Tensor]:
    """Product gradients of a random functional of all outputs and pixels."""
    given = leaves(inputs, torch.float32)
    outputs = product_outputs(given, mode, **options)
    weights = functional(outputs, torch.ones(outputs["alpha"].shape))
    return gradients(apply(weights, outputs), given)


def test_order_of_input_does_not_matter() -> None:
    inputs = inputs_of(120, 45, degree=1)
    order = torch.randperm(120, generator=torch.Generator().manual_seed(1))
    shared = ("viewmats", "Ks", "backgrounds")
    shuffled = {k: v if k in shared else v[order] for k, v in inputs.items()}
    one, other = gradients_of(inputs, sh_degree=1), gradients_of(shuffled, sh_degree=1)
    for name in inputs:
        if name in shared:
            assert (one[name] - other[name]).norm() <= 1e-5 * one[name].norm(), name
        else:
            assert torch.equal(one[name][order], other[name]), name


@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_batch_equals_loop(method: str) -> None:
    inputs = inputs_of(80, 46, views=3)
    given = leaves(inputs, torch.float32)
    outputs = product_outputs(given, "RGB+ED", method=method)
    weights = functional(outputs, torch.ones(outputs["alpha"].shape))
    batch = gradients(apply(weights, outputs), given)
    summed = {name: torch.zeros_like(tensor) for name, tensor in given.items()}
    own = ("viewmats", "Ks", "backgrounds")
    for i in range(3):
        one = leaves({k: v[i : i + 1] if k in own else v for k, v in inputs.items()}, torch.float32)
        single = product_outputs(one, "RGB+ED", method=method)
        assert all(torch.equal(single[k][0], outputs[k][i]) for k in single)
        found = gradients(apply({k: w[i : i + 1] for k, w in weights.items()}, single), one)
        for name in summed:
            if name in own:
                summed[name][i] = found[name][0]
            else:
                summed[name] += found[name]
    for name in summed:
        assert (batch[name] - summed[name]).norm() <= 1e-5 * batch[name].norm(), name


@pytest.mark.parametrize("degree", [None, 3])
def test_methods_agree(degree: int | None) -> None:
    inputs = inputs_of(100, 47, degree=degree)
    tile = gradients_of(inputs, "RGB+D", method="tile", sh_degree=degree)
    pixel = gradients_of(inputs, "RGB+D", method="pixel", sh_degree=degree)
    assert_small(errors(pixel, {name: gradient.double() for name, gradient in tile.items()}))


@pytest.fixture
def threads() -> Iterator[None]:
    before = device.thread_count()
    yield
    device.set_thread_count(before)


@pytest.mark.usefixtures("threads")
@pytest.mark.parametrize("channels", [3, 7])
def test_threads_do_not_change_a_bit(channels: int) -> None:
    inputs = inputs_of(3000, 48, channels=channels, size=0.04, width=150, height=110)
    results = []
    for count in (1, 2, 8):
        device.set_thread_count(count)
        given = leaves(inputs, torch.float32)
        outputs = product_outputs(given, "RGB+ED", (150, 110))
        weights = functional(outputs, torch.ones(outputs["alpha"].shape))
        results.append({**outputs, **gradients(apply(weights, outputs), given)})
    for other in results[1:]:
        for name, value in results[0].items():
            assert torch.equal(value, other[name]), name


@pytest.mark.parametrize("mode", ["RGB", "RGB+D"])
@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_projected_means_for_densification(method: str, mode: str) -> None:
    """`means2d.grad`: gradient to a surfel's place in the image; `absgrad`: of absolute shares of pixels."""
    inputs = inputs_of(12, 42, width=23, height=19)
    given = leaves(inputs, torch.float32)
    outputs = rasterization_2dgs(
        **given, width=23, height=19, render_mode=mode, absgrad=True, options=RasterOptions(method=method)
    )
    meta = outputs[-1]
    meta["means2d"].retain_grad()
    shifts = torch.zeros(2, 12, 19, 23, 2, dtype=torch.float64, requires_grad=True)
    result = render(**inputs, width=23, height=19, shifts=shifts)
    expected = {"image": in_mode(mode, result.image, result.depth, result.alpha), "normals": result.normals}
    weights = functional(expected, result.kink)
    apply(weights, {"image": outputs[0], "normals": outputs[2]}).backward()
    (shares,) = torch.autograd.grad(apply(weights, expected), shifts)
    assert meta["means2d"].shape == (2, 12, 2)
    got = {"grad": meta["means2d"].grad, "absgrad": meta["means2d"].absgrad}
    assert_small(errors(got, {"grad": shares.sum((2, 3)), "absgrad": shares.abs().sum((2, 3))}))


def test_radius_clip_and_two_backwards() -> None:
    """A clipped surfel has no gradient, the others theirs; a second backward adds the same again."""
    inputs = inputs_of(60, 53, size=0.05)
    given = leaves(inputs, torch.float32)
    image, alpha, *_, meta = rasterization_2dgs(
        **given, width=WIDTH, height=HEIGHT, radius_clip=3.0, render_mode="RGB+ED"
    )
    loss = image.square().sum() + alpha.sum()
    clipped = (meta["radii"] == 0).all(-1).all(0)
    assert 5 < clipped.sum() < 55
    loss.backward(retain_graph=True)
    once = {k: v.grad.clone() for k, v in given.items()}
    assert all((once[k][clipped] == 0).all() for k in ("means", "quats", "scales", "opacities", "colors"))
    assert (once["colors"][~clipped] != 0).any()
    loss.backward()
    assert all(torch.equal(v.grad, 2 * once[k]) for k, v in given.items())


def test_entries_without_effect_have_no_gradient() -> None:
    inputs = inputs_of(60, 51)
    inputs["means"][:5] = -inputs["viewmats"][0, :3, :3].T @ torch.tensor([0.0, 0.0, 50.0])
    inputs["opacities"][5:8] = 0.0
    found = gradients_of(inputs, far_plane=20.0)
    assert (found["viewmats"][:, 3] == 0).all()
    assert (found["Ks"] != 0).all(0).tolist() == [[True, True, True], [False, True, True], [False] * 3]
    for name in ("means", "quats", "scales", "opacities", "colors"):
        assert (found[name][:5] == 0).all(), name
    for name in ("means", "quats", "scales", "colors"):
        assert (found[name][5:8] == 0).all(), name
