"""The dense float64 references against finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.reference import splatting, surfels
from tests.reference.compare import KINK
from tests.splatting.scenes import cameras, cloud, features, harmonics

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
USED = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
"""The entries of K that images depend on."""


def weights_like(outputs: list[Tensor], kink: Tensor, seed: int = 0) -> list[Tensor]:
    """Random weights for outputs [C, H, W, ...], zero at pixels near a kink."""
    g = torch.Generator().manual_seed(seed)
    smooth = (kink > KINK).double()
    assert smooth.mean() > 0.7
    return [
        torch.randn(o.shape, generator=g, dtype=torch.float64)
        * smooth.reshape(smooth.shape + (1,) * (o.ndim - 3))
        for o in outputs
    ]


@pytest.mark.parametrize(
    ("degree", "antialiased", "distance"),
    [(None, False, 3.0), (3, True, 3.0), (1, False, 0.5)],
    ids=["features", "harmonics, antialiased", "camera inside"],
)
def test_3d(degree: int | None, antialiased: bool, distance: float) -> None:
    count, views = 5, cameras(2, 7, 6, distance=distance)
    scene = cloud(count, 1, size=0.3)
    scene["colors"] = features(count, 2, 1) if degree is None else harmonics(count, degree, 1)
    scene["backgrounds"] = features(2, 2 if degree is None else 3, 2)
    scene["viewmats"], scene["Ks"] = views["viewmats"], views["Ks"]
    scene["Ks"][:, 0, 1] = 0.8
    inputs = [scene[name].double().requires_grad_() for name in NAMES]
    options = {"sh_degree": degree, "antialiased": antialiased, "normals": True}

    def outputs(*tensors: Tensor) -> tuple[list[Tensor], Tensor]:
        result = splatting.render(**dict(zip(NAMES, tensors, strict=True)), width=7, height=6, **options)
        return [result.image, result.alpha, result.depth, result.normals], result.kink

    first, kink = outputs(*inputs)
    assert first[1].max() > 0.7
    weights = weights_like(first, kink)

    def loss(*tensors: Tensor) -> Tensor:
        return sum((w * o).sum() for w, o in zip(weights, outputs(*tensors)[0], strict=True))

    assert torch.autograd.gradcheck(loss, inputs, atol=1e-6, rtol=1e-6, fast_mode=True)
    gradients = dict(zip(NAMES, torch.autograd.grad(loss(*inputs), inputs), strict=True))
    assert all(g.abs().max() > 0 for g in gradients.values())
    assert (gradients["Ks"] != 0).all(0).equal(USED.bool())
    assert (gradients["viewmats"][:, 3] == 0).all()


@pytest.mark.parametrize(
    ("degree", "distance"),
    [(None, 3.0), (3, 3.0), (1, 0.5)],
    ids=["features", "harmonics", "camera inside"],
)
def test_surfels(degree: int | None, distance: float) -> None:
    count, views = 5, cameras(2, 7, 6, distance=distance)
    scene = cloud(count, 1, size=0.3)
    scene["colors"] = features(count, 2, 1) if degree is None else harmonics(count, degree, 1)
    scene["backgrounds"] = features(2, 2 if degree is None else 3, 2)
    scene["viewmats"], scene["Ks"] = views["viewmats"], views["Ks"]
    scene["Ks"][:, 0, 1] = 0.8
    inputs = [scene[name].double().requires_grad_() for name in NAMES]

    def outputs(*tensors: Tensor) -> tuple[list[Tensor], Tensor]:
        given = dict(zip(NAMES, tensors, strict=True))
        result = surfels.render(**given, width=7, height=6, sh_degree=degree)
        depth = result.depth / result.alpha.clamp(min=1e-10)
        from_depth = surfels.depth_normals(depth, given["viewmats"], given["Ks"])
        images = [result.image, result.alpha, result.depth, result.median, result.normals, result.distortion]
        kink = -torch.nn.functional.max_pool2d(-result.kink, 3, stride=1, padding=1)
        return [*images, from_depth], kink

    first, kink = outputs(*inputs)
    assert first[1].max() > 0.7
    weights = weights_like(first, kink)

    def loss(*tensors: Tensor) -> Tensor:
        return sum((w * o).sum() for w, o in zip(weights, outputs(*tensors)[0], strict=True))

    assert torch.autograd.gradcheck(loss, inputs, atol=1e-6, rtol=1e-6, fast_mode=True)
    gradients = dict(zip(NAMES, torch.autograd.grad(loss(*inputs), inputs), strict=True))
    assert all(g.abs().max() > 0 for g in gradients.values())
    assert (gradients["scales"][:, 2] == 0).all()
    assert (gradients["Ks"] != 0).all(0).equal(USED.bool())


def test_centre_of_a_projected_circle() -> None:
    scene, views = cloud(6, 3, size=0.2), cameras(1, 40, 30)
    viewmat, K = views["viewmats"][0].double(), views["Ks"][0].double()
    K[0, 1] = 3.0
    points = splatting.camera_points(scene["means"].double(), viewmat)
    axes = (
        viewmat[:3, :3]
        @ splatting.rotation_matrices(scene["quats"].double())
        * scene["scales"].double()[:, None]
    )
    angle = torch.linspace(0, 2 * torch.pi, 20001, dtype=torch.float64)[:, None, None]
    circle = points + angle.cos() * axes[..., 0] + angle.sin() * axes[..., 1]
    assert circle[..., 2].min() > 0
    pixels = (circle @ K.T)[..., :2] / circle[..., 2:]
    middle = (pixels.amax(0) + pixels.amin(0)) / 2
    assert (surfels.centers2d(points, axes[..., 0], axes[..., 1], K)[0] - middle).abs().max() < 1e-5
