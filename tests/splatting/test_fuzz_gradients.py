"""Degenerate and broken input: forward and backward end, and gradients are finite wherever the input is."""

from __future__ import annotations

import math
from collections.abc import Mapping

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from gdpro_sim.splatting import RasterOptions, rasterization, rasterization_2dgs
from tests.splatting.scenes import cameras, cloud, features, frontal, harmonics

KINDS = ["3d", "surfels"]
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")
MODES = ["RGB", "D", "ED", "RGB+D", "RGB+ED"]

ANYTHING = [0.0, -0.0, 1.0, -1.0, 0.5, 1e-30, 1e30, -1e30, 3e38, 1e-45, math.nan, math.inf, -math.inf]
POSITIONS = [0.0, -0.0, 0.3, -0.3, 1.99, -1.99, 2.5, 1e-45, 1e-20, -1e3]
QUATERNIONS = [0.0, 1.0, -1.0, 0.5, 1e-3, 1e3, 1e-20, 1e-45, 1e20]
SCALES = [0.0, 1e-45, 1e-20, 1e-8, 1e-3, 0.1, 1.0, 1e3, 1e8]
OPACITIES = [0.0, 1e-45, 1e-6, 1 / 255, 0.5, 0.99, 1.0]


def images_of(kind: str, inputs: Mapping[str, object], **options: object) -> tuple[list[Tensor], dict]:
    """All differentiable outputs of a rasteriser, and its dict."""
    method = str(options.pop("method", "auto"))
    if kind == "3d":
        image, alpha, meta = rasterization(
            **inputs, **options, options=RasterOptions(method=method, normals=True)
        )
        return [image, alpha, meta["normals"]], meta
    distloss = options.get("render_mode", "RGB") != "RGB"
    *outputs, meta = rasterization_2dgs(
        **inputs, **options, distloss=distloss, options=RasterOptions(method=method)
    )
    return [o for o in outputs if isinstance(o, Tensor) and o.requires_grad], meta


def run(
    kind: str, inputs: Mapping[str, object], **options: object
) -> tuple[list[Tensor], dict, dict[str, Tensor]]:
    """Outputs, dict and gradients of a random functional of all outputs."""
    taken = {k: v.clone().requires_grad_() if isinstance(v, Tensor) else v for k, v in inputs.items()}
    outputs, meta = images_of(kind, taken, **options)
    g = torch.Generator().manual_seed(0)
    loss = sum((o * torch.randn(o.shape, generator=g)).sum() for o in outputs)
    assert isinstance(loss, Tensor)
    leaves = {k: v for k, v in taken.items() if isinstance(v, Tensor)}
    found = torch.autograd.grad(loss, list(leaves.values()), allow_unused=True)
    gradients = {
        k: torch.zeros_like(v) if f is None else f for (k, v), f in zip(leaves.items(), found, strict=True)
    }
    assert all(f.shape == leaves[k].shape for k, f in gradients.items())
    return outputs, meta, gradients


def assert_none_where_not_drawn(meta: Mapping[str, Tensor], gradients: Mapping[str, Tensor]) -> None:
    away = (meta["radii"] == 0).any(-1).all(0)
    for name in GAUSSIANS:
        assert (gradients[name][away] == 0).all(), name


def assert_finite(outputs: list[Tensor], gradients: Mapping[str, Tensor]) -> None:
    assert all(torch.isfinite(o).all() for o in outputs)
    for name, gradient in gradients.items():
        assert torch.isfinite(gradient).all(), name


def draw(data: st.DataObject, values: list[float], *shape: int) -> Tensor:
    count = math.prod(shape)
    return torch.tensor(data.draw(st.lists(st.sampled_from(values), min_size=count, max_size=count))).reshape(
        shape
    )


def draw_options(data: st.DataObject, kind: str) -> dict[str, object]:
    options = {
        "render_mode": data.draw(st.sampled_from(MODES)),
        "method": data.draw(st.sampled_from(["tile", "pixel"])),
    }
    if kind == "3d" and data.draw(st.booleans()):
        options["rasterize_mode"] = "antialiased"
    return options


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_finite_extremes(kind: str, data: st.DataObject) -> None:
    """Zeros, denormals, huge scales, cameras inside: everything is finite."""
    count = data.draw(st.integers(1, 4))
    width, height = data.draw(st.integers(1, 40)), data.draw(st.integers(1, 40))
    degree = data.draw(st.sampled_from([None, 0, 3]))
    inputs = {
        "means": draw(data, POSITIONS, count, 3),
        "quats": draw(data, QUATERNIONS, count, 4),
        "scales": draw(data, SCALES, count, 3),
        "opacities": draw(data, OPACITIES, count),
        "colors": features(count, 3, 0) if degree is None else harmonics(count, 3, 0),
        **frontal(2.0, 20.0, width, height),
    }
    if data.draw(st.booleans()):
        inputs.update(cameras(2, width, height, distance=data.draw(st.sampled_from([0.01, 0.3, 2.0]))))
    outputs, meta, gradients = run(kind, inputs, sh_degree=degree, **draw_options(data, kind))
    assert_finite(outputs, gradients)
    assert_none_where_not_drawn(meta, gradients)


@pytest.mark.parametrize("kind", KINDS)
@settings(max_examples=80, deadline=None)
@given(data=st.data())
def test_anything(kind: str, data: st.DataObject) -> None:
    """Any numbers at all: no crash, finite images, and no gradient to what is not drawn."""
    count = data.draw(st.integers(1, 4))
    value = st.sampled_from(ANYTHING) | st.floats(width=32)

    def numbers(*shape: int) -> Tensor:
        n = math.prod(shape)
        return torch.tensor(data.draw(st.lists(value, min_size=n, max_size=n))).reshape(shape)

    inputs = {
        "means": numbers(count, 3),
        "quats": numbers(count, 4),
        "scales": numbers(count, 3),
        "opacities": numbers(count),
        "colors": features(count, 3, 0),
        **frontal(2.0, 20.0, data.draw(st.integers(1, 40)), data.draw(st.integers(1, 40))),
    }
    for name, shape in (("viewmats", (1, 4, 4)), ("Ks", (1, 3, 3)), ("colors", (count, 3))):
        if data.draw(st.integers(0, 3)) == 0:
            inputs[name] = numbers(*shape)
    outputs, meta, gradients = run(kind, inputs, **draw_options(data, kind))
    assert torch.isfinite(outputs[1]).all()
    assert_none_where_not_drawn(meta, gradients)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", [*GAUSSIANS, "sh"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_broken_one_leaves_the_others_alone(kind: str, name: str, bad: float) -> None:
    inputs = {**cloud(30, 1), "colors": features(30, 3, 1), **cameras(2, 33, 30)}
    options = {"render_mode": "RGB+ED"}
    if name == "sh":
        inputs["colors"], options["sh_degree"] = harmonics(30, 1, 1), 1
    key = "colors" if name == "sh" else name
    rest = {k: torch.cat([v[:4], v[5:]]) if k in GAUSSIANS else v for k, v in inputs.items()}
    inputs[key] = inputs[key].clone()
    inputs[key][4].view(-1)[0] = bad
    outputs, meta, gradients = run(kind, inputs, **options)
    expected_outputs, _, expected = run(kind, rest, **options)
    assert (meta["radii"][:, 4] == 0).all()
    assert all(torch.equal(a, b) for a, b in zip(outputs, expected_outputs, strict=True))
    assert_finite(outputs, gradients)
    for each in GAUSSIANS:
        assert (gradients[each][4] == 0).all(), each
        assert torch.equal(torch.cat([gradients[each][:4], gradients[each][5:]]), expected[each]), each
    for each in ("viewmats", "Ks"):
        assert (gradients[each] - expected[each]).norm() <= 1e-5 * expected[each].norm(), each


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("kind", KINDS)
def test_no_gaussians(kind: str, method: str) -> None:
    inputs = {
        **cloud(0, 0),
        "colors": torch.zeros(0, 3),
        **cameras(2, 9, 7),
        "backgrounds": features(2, 3, 0),
    }
    outputs, _, gradients = run(kind, inputs, render_mode="RGB+ED", method=method)
    assert_finite(outputs, gradients)
    assert gradients["means"].shape == (0, 3)
    weights = torch.randn(outputs[0].shape, generator=torch.Generator().manual_seed(0))
    assert (gradients["backgrounds"] - weights[..., :3].sum((1, 2))).abs().max() < 1e-5
    assert (gradients["viewmats"] == 0).all()


@pytest.mark.parametrize("kind", KINDS)
def test_no_cameras(kind: str) -> None:
    inputs = {
        **cloud(5, 0),
        "colors": features(5, 3, 0),
        **cameras(1, 9, 7),
        "viewmats": torch.zeros(0, 4, 4),
        "Ks": torch.zeros(0, 3, 3),
        "backgrounds": torch.zeros(0, 3),
    }
    _, _, gradients = run(kind, inputs, render_mode="RGB+D")
    assert all((gradient == 0).all() for gradient in gradients.values())


@pytest.mark.parametrize("method", ["tile", "pixel"])
@pytest.mark.parametrize("kind", KINDS)
def test_nothing_drawn(kind: str, method: str) -> None:
    inputs = {
        **cloud(20, 0),
        "colors": features(20, 3, 0),
        **cameras(2, 20, 21),
        "backgrounds": torch.ones(2, 3),
    }
    outputs, meta, gradients = run(kind, inputs, near_plane=100.0, render_mode="RGB+ED", method=method)
    assert (meta["radii"] == 0).all()
    assert_finite(outputs, gradients)
    assert all((gradients[k] == 0).all() for k in gradients if k != "backgrounds")
    assert (gradients["backgrounds"] != 0).all()


@pytest.mark.parametrize("size", [(1, 1), (1, 17), (16, 16), (17, 15), (33, 1)])
@pytest.mark.parametrize("opacity", [0.0, 1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_sizes_and_opacities(kind: str, opacity: float, size: tuple[int, int]) -> None:
    inputs = {**cloud(60, 2), "colors": features(60, 5, 2), **cameras(2, *size)}
    inputs["opacities"] = torch.full((60,), opacity)
    outputs, meta, gradients = run(kind, inputs, render_mode="RGB+ED")
    assert_finite(outputs, gradients)
    assert_none_where_not_drawn(meta, gradients)
    assert ((meta["radii"] > 0).any()) == (opacity > 0)


@pytest.mark.parametrize("distance", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("kind", KINDS)
def test_cameras_inside(kind: str, distance: float) -> None:
    inputs = {
        **cloud(300, 3),
        "colors": harmonics(300, 3, 3),
        **cameras(3, 35, 30, distance=max(distance, 1e-3)),
    }
    outputs, meta, gradients = run(kind, inputs, sh_degree=3, render_mode="RGB+ED")
    assert_finite(outputs, gradients)
    assert_none_where_not_drawn(meta, gradients)


@pytest.mark.parametrize("kind", KINDS)
def test_mean_at_the_camera_centre(kind: str) -> None:
    """No direction of view: harmonics are undefined there, but with near plane 0 nothing may break."""
    inputs = {**cloud(4, 4), "colors": harmonics(4, 3, 4), **frontal(2.0, 30.0, 20, 20)}
    inputs["means"] = torch.tensor([[0.0, 0.0, 0.0], [0.0, 0.0, 1e-20], [0.0, 0.0, 1e-38], [0.0, 0.0, 2.0]])
    outputs, meta, gradients = run(kind, inputs, sh_degree=3, render_mode="RGB+D", near_plane=0.0)
    assert_finite(outputs, gradients)
    assert_none_where_not_drawn(meta, gradients)


@pytest.mark.parametrize("kind", KINDS)
def test_a_thousand_in_one_place(kind: str) -> None:
    """Equal depths, opaque: the first few hide the rest, which get no gradient."""
    one = cloud(1, 5)
    inputs = {k: v.repeat(1000, *[1] * (v.ndim - 1)) for k, v in one.items()}
    inputs["means"] = torch.tensor([[0.0, 0.0, 2.0]]).repeat(1000, 1)
    inputs["opacities"] = torch.ones(1000)
    inputs = {**inputs, "colors": features(1000, 3, 5), **frontal(2.0, 30.0, 20, 20)}
    outputs, _, gradients = run(kind, inputs, render_mode="RGB+ED")
    assert_finite(outputs, gradients)
    assert (gradients["colors"][:2].abs().sum(-1) > 0).all()


@pytest.mark.parametrize("length", [1e-45, 1e-42, 1e-38, 1e-30, 1e-15, 1e15, 1e30, 1e38])
@pytest.mark.parametrize("kind", KINDS)
def test_quaternions_of_extreme_length(kind: str, length: float) -> None:
    """The gradient goes as the inverse of the length, which float32 cannot hold for the shortest."""
    inputs = {**cloud(20, 6), "colors": features(20, 3, 6), **cameras(2, 30, 30)}
    inputs["quats"] = (inputs["quats"] / inputs["quats"].norm(dim=-1, keepdim=True)).double() * length
    inputs["quats"] = inputs["quats"].float()
    outputs, meta, gradients = run(kind, inputs, render_mode="RGB+ED")
    assert_finite(outputs, gradients)
    assert_none_where_not_drawn(meta, gradients)
