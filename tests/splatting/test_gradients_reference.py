"""The dense float64 references against finite differences."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from tests.reference import splatting
from tests.splatting.scenes import cameras, cloud, features, harmonics

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
USED = torch.tensor([[1.0, 1.0, 1.0], [0.0, 1.0, 1.0], [0.0, 0.0, 0.0]])
"""The entries of K that images depend on."""


def weights_like(outputs: list[Tensor], kink: Tensor, seed: int = 0) -> list[Tensor]:
    """Random weights for outputs [C, H, W, ...], zero at pixels near a kink."""
    g = torch.Generator().manual_seed(seed)
    smooth = (kink > 1e-3).double()
    assert smooth.mean() > 0.8
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
