"""Gradients of 3D Gaussians against the dense float64 reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gdpro_sim import device
from gdpro_sim.splatting import RasterOptions, contributions, rasterization
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
from tests.reference.splatting import project, render
from tests.splatting.scenes import cameras, cloud, features, harmonics

TOLERANCE = 1e-4
WIDTH, HEIGHT = 37, 29
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]


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
    """Every tensor that `rasterization` is differentiable in."""
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


def product_outputs(
    inputs: Mapping[str, Tensor],
    mode: str,
    size: tuple[int, int],
    *,
    normals: bool = False,
    **options: object,
) -> dict[str, Tensor]:
    method = str(options.pop("method", "auto"))
    image, alpha, meta = rasterization(
        **inputs,
        width=size[0],
        height=size[1],
        render_mode=mode,
        options=RasterOptions(method=method, normals=normals),
        **options,
    )
    outputs = {"image": image, "alpha": alpha[..., 0]}
    return {**outputs, "normals": meta["normals"]} if normals else outputs


def worst(
    inputs: Mapping[str, Tensor],
    mode: str = "RGB",
    size: tuple[int, int] = (WIDTH, HEIGHT),
    *,
    seed: int = 0,
    least: float = 0.6,
    normals: bool = False,
    method: str = "auto",
    antialiased: bool = False,
    **options: object,
) -> dict[str, float]:
    """Errors of every gradient for a scene in a mode."""

    def product(given: Mapping[str, Tensor]) -> dict[str, Tensor]:
        rasterize_mode = "antialiased" if antialiased else "classic"
        return product_outputs(
            given, mode, size, normals=normals, method=method, rasterize_mode=rasterize_mode, **options
        )

    def reference(given: Mapping[str, Tensor]) -> tuple[dict[str, Tensor], Tensor]:
        result = render(
            **given, width=size[0], height=size[1], antialiased=antialiased, normals=normals, **options
        )
        outputs = {"image": in_mode(mode, result.image, result.depth, result.alpha), "alpha": result.alpha}
        return {**outputs, "normals": result.normals} if normals else outputs, covered(
            mode, result.kink, result.alpha
        )

    return compare(inputs, product, reference, seed, least)


def assert_small(found: dict[str, float], tolerance: float = TOLERANCE) -> None:
    assert max(found.values()) <= tolerance, found


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("seed", range(4))
def test_every_input_in_every_mode(seed: int, mode: str) -> None:
    assert_small(worst(inputs_of(60, seed), mode, seed=seed))


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("seed", [10, 11])
def test_harmonics(seed: int, degree: int) -> None:
    """The coefficients, and through the direction of view means and view matrices."""
    assert_small(worst(inputs_of(60, seed, degree=degree), "RGB+D", sh_degree=degree))


def test_fewer_harmonics_than_given() -> None:
    inputs = inputs_of(40, 12, degree=3)
    assert_small(worst(inputs, sh_degree=1))
    given = leaves(inputs, torch.float32)
    apply_all = product_outputs(given, "RGB", (WIDTH, HEIGHT), sh_degree=1)["image"].sum()
    assert (gradients(apply_all, given)["colors"][:, 4:] == 0).all()


@pytest.mark.parametrize("channels", [1, 3, 4, 5, 9])
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED"])
@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_feature_channels(channels: int, mode: str, method: str) -> None:
    assert_small(worst(inputs_of(40, 13, channels=channels), mode, method=method))


@pytest.mark.parametrize("channels", [3, 6])
def test_colours_of_each_camera(channels: int) -> None:
    inputs = inputs_of(40, 14, channels=channels)
    inputs["colors"] = torch.stack([features(40, channels, 15), features(40, channels, 16)])
    assert_small(worst(inputs, "RGB+D"))


def test_without_backgrounds() -> None:
    inputs = inputs_of(40, 17)
    del inputs["backgrounds"]
    assert_small(worst(inputs, "RGB+ED"))


@pytest.mark.parametrize("size", [0.01, 0.03, 0.12])
@pytest.mark.parametrize("degree", [None, 2])
def test_antialiased(size: float, degree: int | None) -> None:
    inputs = inputs_of(80, 18, size=size, degree=degree)
    assert_small(worst(inputs, "RGB+D", antialiased=True, sh_degree=degree))


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("antialiased", [False, True])
def test_normals(method: str, antialiased: bool) -> None:
    for seed in (20, 21, 22):
        inputs = inputs_of(50, seed)
        assert_small(worst(inputs, "RGB+ED", normals=True, method=method, antialiased=antialiased))


@pytest.mark.parametrize("seed", range(30, 36))
def test_camera_inside_the_cloud(seed: int) -> None:
    """Some means lie far outside the image, where perspective is linearized at a point pulled in."""
    inputs = inputs_of(60, seed, degree=1, distance=0.4, size=0.1)
    assert_small(worst(inputs, "RGB+ED", sh_degree=1, least=0.5, near_plane=0.05))


def test_skewed_pixels_planes_and_blur() -> None:
    inputs = inputs_of(80, 40)
    inputs["Ks"][:, 0, 1] = 6.0
    assert_small(worst(inputs, "RGB+D", near_plane=2.5, far_plane=3.4, eps2d=0.7))


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("opacity", [(0.02, 0.05), (0.1, 0.3), (0.3, 0.7)], ids=["faint", "medium", "dense"])
def test_long_lists(opacity: tuple[float, float], method: str) -> None:
    """Hundreds of Gaussians in a pixel: blending to the last of them, or stopping somewhere on the way."""
    inputs = inputs_of(600, 41, views=1, size=0.3, width=20, height=18)
    inputs["opacities"] = opacity[0] + opacity[1] * inputs["opacities"]
    assert_small(worst(inputs, "RGB+ED", (20, 18), least=0.3, method=method))


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
        distance=data.draw(st.sampled_from([1.0, 3.0, 8.0]), "distance"),
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
        normals=data.draw(st.booleans(), "normals"),
        method=data.draw(st.sampled_from(["tile", "pixel"]), "method"),
        antialiased=data.draw(st.booleans(), "antialiased"),
        sh_degree=degree,
        near_plane=0.2,
    )
    # In a tiny image the digits that 1 - T loses do not average out.
    assert_small(found, (3 if mode.endswith("ED") else 1) * TOLERANCE)


@pytest.mark.parametrize("method", ["tile", "pixel"])
def test_gradients_of_projected_means(method: str) -> None:
    """`means2d.grad` and, for densification, `means2d.absgrad`: the sum of each pixel's absolute share."""
    inputs = inputs_of(12, 42, width=23, height=19)
    given = leaves(inputs, torch.float32)
    image, alpha, meta = rasterization(
        **given, width=23, height=19, render_mode="RGB+D", absgrad=True, options=RasterOptions(method=method)
    )
    meta["means2d"].retain_grad()
    shifts = torch.zeros(2, 12, 19, 23, 2, dtype=torch.float64, requires_grad=True)
    result = render(**inputs, width=23, height=19, shifts=shifts)
    expected = {"image": in_mode("RGB+D", result.image, result.depth, result.alpha), "alpha": result.alpha}
    weights = functional(expected, result.kink)
    apply(weights, {"image": image, "alpha": alpha[..., 0]}).backward()
    (shares,) = torch.autograd.grad(apply(weights, expected), shifts)
    assert meta["means2d"].shape == (2, 12, 2)
    got = {"grad": meta["means2d"].grad, "absgrad": meta["means2d"].absgrad}
    assert_small(errors(got, {"grad": shares.sum((2, 3)), "absgrad": shares.abs().sum((2, 3))}))
    assert (got["absgrad"] >= got["grad"].abs() * (1 - 1e-5)).all()
    assert all(given[name].grad is not None for name in given)


@pytest.mark.parametrize("antialiased", [False, True])
def test_losses_on_projected_gaussians(antialiased: bool) -> None:
    """Losses on meta's means2d, depths and opacities, alone and beside the image's."""
    inputs = inputs_of(30, 43, size=0.03)
    given, doubles = leaves(inputs, torch.float32), leaves(inputs, torch.float64)
    rasterize_mode = "antialiased" if antialiased else "classic"
    image, _, meta = rasterization(**given, width=WIDTH, height=HEIGHT, rasterize_mode=rasterize_mode)
    result = render(**doubles, width=WIDTH, height=HEIGHT, antialiased=antialiased)
    drawn = (meta["radii"] > 0).all(-1)
    assert drawn.sum() > 40
    own = ("means", "quats", "scales")
    parts = [
        project(*(doubles[k] for k in own), viewmat, K, WIDTH, HEIGHT, 0.3)
        for viewmat, K in zip(doubles["viewmats"], doubles["Ks"], strict=True)
    ]
    factors = torch.stack([part[3] for part in parts]) if antialiased else torch.ones(2, 30)
    expected = {
        "means2d": torch.stack([part[0] for part in parts]),
        "depths": torch.stack([part[2] for part in parts]),
        "opacities": doubles["opacities"] * factors,
    }
    g = torch.Generator().manual_seed(0)
    weights = {k: torch.randn(meta[k].shape, generator=g) for k in expected}
    for weight in weights.values():
        weight *= drawn if weight.ndim == 2 else drawn[..., None]
    losses = {k: (weights[k] * meta[k]).sum() for k in weights}
    references = {k: (weights[k] * expected[k]).sum() for k in weights}
    for name in weights:
        assert_small(errors(gradients(losses[name], given), gradients(references[name], doubles)))
    picture = functional({"image": result.image}, result.kink)
    loss = sum(losses.values()) + apply(picture, {"image": image})
    reference = sum(references.values()) + apply(picture, {"image": result.image})
    assert_small(errors(gradients(loss, given), gradients(reference, doubles)))


def test_radius_clip_and_two_backwards() -> None:
    """A clipped Gaussian has no gradient, the others theirs; a second backward adds the same again."""
    inputs = inputs_of(60, 53, size=0.05)
    given = leaves(inputs, torch.float32)
    image, alpha, meta = rasterization(
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


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("channels", [1, 3, 6])
def test_contributions(method: str, channels: int) -> None:
    inputs = inputs_of(50, 44)
    _, _, meta = rasterization(**inputs, width=WIDTH, height=HEIGHT, options=RasterOptions(method=method))
    result = render(**inputs, width=WIDTH, height=HEIGHT)
    values = torch.randn(2, HEIGHT, WIDTH, channels, generator=torch.Generator().manual_seed(0))
    values *= (result.margin > KINK)[..., None]
    got = contributions(meta, values)
    expected = torch.einsum("cnhw,chwd->cnd", result.weights, values.double())
    assert got.shape == (2, 50, channels)
    assert (got - expected).abs().max() <= 1e-5 * expected.abs().max()
    sums = contributions(meta)
    assert sums.shape == (2, 50)
    # A decision that falls otherwise in float32 moves a pixel's weight by 1/255.
    assert (sums - result.weights.sum((2, 3))).abs().max() < 1.01 / 255
    assert not sums.requires_grad


def test_flips_at_thresholds_are_few_and_small() -> None:
    """Pixels where float32 decides otherwise than float64: all of them near a threshold, and bounded."""
    flips = pixels = 0
    for seed in range(8):
        inputs = inputs_of(150, 100 + seed, width=61, height=45)
        with torch.no_grad():
            image, alpha, _ = rasterization(**inputs, width=61, height=45)
            result = render(**inputs, width=61, height=45)
        error = torch.maximum((image - result.image).abs().amax(-1), (alpha[..., 0] - result.alpha).abs())
        flipped = error > 5e-6
        assert (result.margin[flipped] < KINK).all()
        assert error.max() < 1.01 / 255
        flips, pixels = flips + int(flipped.sum()), pixels + flipped.numel()
    assert flips <= 2e-4 * pixels


def gradients_of(inputs: Mapping[str, Tensor], mode: str = "RGB+ED", **options: object) -> dict[str, Tensor]:
    """Product gradients of a random functional of all pixels."""
    size = (WIDTH, HEIGHT)
    given = leaves(inputs, torch.float32)
    outputs = product_outputs(given, mode, size, normals=True, **options)
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
    outputs = product_outputs(given, "RGB+ED", (WIDTH, HEIGHT), normals=True, method=method)
    weights = functional(outputs, torch.ones(outputs["alpha"].shape))
    batch = gradients(apply(weights, outputs), given)
    summed = {name: torch.zeros_like(tensor) for name, tensor in given.items()}
    own = ("viewmats", "Ks", "backgrounds")
    for i in range(3):
        one = leaves({k: v[i : i + 1] if k in own else v for k, v in inputs.items()}, torch.float32)
        single = product_outputs(one, "RGB+ED", (WIDTH, HEIGHT), normals=True, method=method)
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
    inputs = inputs_of(150, 47, degree=degree)
    tile = gradients_of(inputs, method="tile", sh_degree=degree)
    pixel = gradients_of(inputs, method="pixel", sh_degree=degree)
    assert_small(errors(pixel, {name: gradient.double() for name, gradient in tile.items()}), 2e-5)


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
        image, alpha, meta = rasterization(
            **given,
            width=150,
            height=110,
            render_mode="RGB+ED",
            absgrad=True,
            options=RasterOptions(normals=True),
        )
        meta["means2d"].retain_grad()
        weights = torch.randn(image.shape, generator=torch.Generator().manual_seed(0))
        ((image * weights).sum() + alpha.square().sum() + (meta["normals"] ** 3).sum()).backward()
        with torch.no_grad():
            extra = {
                "means2d": meta["means2d"].grad,
                "absgrad": meta["means2d"].absgrad,
                "contributions": contributions(meta),
                "colours": contributions(meta, image.detach()),
            }
        results.append({**{k: v.grad for k, v in given.items()}, **extra})
    for other in results[1:]:
        for name, gradient in results[0].items():
            assert torch.equal(gradient, other[name]), name


def test_only_what_is_asked_for() -> None:
    """A gradient to one input alone is the same as to all; others stay without."""
    inputs = inputs_of(50, 49)
    every = gradients_of(inputs)
    for name in inputs:
        given = {k: v.clone().requires_grad_(k == name) for k, v in inputs.items()}
        outputs = product_outputs(given, "RGB+ED", (WIDTH, HEIGHT), normals=True)
        weights = functional(outputs, torch.ones(outputs["alpha"].shape))
        apply(weights, outputs).backward()
        assert torch.equal(given[name].grad, every[name]), name
        assert all(v.grad is None for k, v in given.items() if k != name)


def test_any_part_of_the_outputs() -> None:
    """Losses on one output alone, with expanded, strided and absent gradients."""
    inputs = inputs_of(50, 50)
    given = leaves(inputs, torch.float32)
    outputs = product_outputs(given, "RGB+D", (WIDTH, HEIGHT), normals=True)
    weights = functional(outputs, torch.ones(outputs["alpha"].shape))
    whole = gradients(apply(weights, outputs), given)
    parts = [gradients((weights[k] * outputs[k]).sum(), given) for k in outputs]
    for name in given:
        summed = parts[0][name] + parts[1][name] + parts[2][name]
        assert (summed - whole[name]).norm() <= 1e-5 * whole[name].norm(), name
    ones = gradients(outputs["image"].sum(), given)
    dense = gradients((outputs["image"] * torch.ones_like(outputs["image"])).sum(), given)
    strided = gradients(outputs["image"].permute(3, 2, 1, 0).contiguous().flip(0).sum(), given)
    assert all(torch.equal(ones[k], dense[k]) and torch.equal(ones[k], strided[k]) for k in given)


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


def test_quaternions_of_any_length() -> None:
    """The gradient is at right angles to the quaternion and inversely proportional to its length."""
    inputs = inputs_of(40, 52)
    found = gradients_of(inputs)["quats"]
    scaled = gradients_of({**inputs, "quats": inputs["quats"] * 256.0})["quats"]
    along = (found * inputs["quats"]).sum(-1).abs() / (
        found.norm(dim=-1) * inputs["quats"].norm(dim=-1) + 1e-30
    )
    assert along.max() < 1e-4
    assert (scaled * 256.0 - found).norm() <= 1e-5 * found.norm()
