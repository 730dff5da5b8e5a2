"""What the benchmark counts, times and calls its bound is what it says."""

from __future__ import annotations

import math

import torch

from gdpro_sim.splatting import rasterization
from tests.benchmarks.bench_splatting import Case, stages
from tests.benchmarks.splatting_scene import blended_pairs
from tests.benchmarks.vector_bound import vector_bound
from tests.splatting.scenes import frontal


def test_pairs_of_one_gaussian_are_its_pixels() -> None:
    """Alpha is at least 1/255 within a circle of radius sigma sqrt(2 ln(255 o)); a second one doubles it."""
    scene = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]),
        "scales": torch.full((1, 3), 0.06),
        "opacities": torch.tensor([0.4]),
        "colors": torch.ones(1, 1),
    }
    camera = frontal(2.0, 200.0, 70, 50)
    radius2 = (6.0**2 + 0.3) * 2.0 * math.log(255 * 0.4)
    y, x = torch.meshgrid(torch.arange(50) + 0.5 - 25, torch.arange(70) + 0.5 - 35, indexing="ij")
    inside = int((x**2 + y**2 <= radius2).sum())
    assert abs(blended_pairs(rasterization(**scene, **camera)[2]) - inside) <= 4
    twice = {name: tensor.repeat(2, *[1] * (tensor.ndim - 1)) for name, tensor in scene.items()}
    assert abs(blended_pairs(rasterization(**twice, **camera)[2]) - 2 * inside) <= 8


def test_pairs_stop_with_the_blending() -> None:
    """Behind three Gaussians of 0.95 passes 1.25e-4; a fourth would leave less than 1e-4."""
    scene = {
        "means": torch.tensor([[0.0, 0.0, 2.0]]).repeat(6, 1),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(6, 1),
        "scales": torch.full((6, 3), 0.06),
        "opacities": torch.full((6,), 0.95),
        "colors": torch.ones(6, 1),
    }
    assert blended_pairs(rasterization(**scene, **frontal(2.0, 200.0, 1, 1))[2]) == 3


def test_stages_and_bound_run() -> None:
    case = Case(50, 32, 1)
    assert list(stages(case, 1)) == [
        "project", "tiles", "composite", "composite backward", "project backward",
    ]  # fmt: skip
    for draw in (case.geometry, case.surfels):
        assert [image.shape[-1] for image in draw(case.inputs)] == [3, 1, 3, 1]
        case.timed(draw, 1)
    bound = vector_bound(repeats=1, rounds=4)
    assert bound.forward > 1e6 and bound.backward > 1e6
