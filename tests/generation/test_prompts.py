"""View-dependent prompts: shares, Perp-Neg's weights and its mixture."""

from __future__ import annotations

import math

import numpy as np
import torch

from gdpro_sim.generation.guidance import prompts


def degrees(*values: float) -> torch.Tensor:
    return torch.tensor([math.radians(v) for v in values])


def test_texts_name_the_view() -> None:
    assert prompts.view_texts("a red mug") == [
        "a red mug, front view",
        "a red mug, side view",
        "a red mug, back view",
    ]


def test_shares_are_linear_in_the_azimuth_and_the_same_for_both_sides() -> None:
    shares = prompts.view_weights(degrees(0.0, 45.0, 90.0, 135.0, 180.0, -45.0, -180.0))
    expected = [[1, 0, 0], [0.5, 0.5, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1], [0.5, 0.5, 0], [0, 0, 1]]
    torch.testing.assert_close(shares, torch.tensor(expected), rtol=0.0, atol=1e-6)
    fine = prompts.view_weights(torch.linspace(-math.pi, math.pi, 721))
    assert float(fine.min()) >= -1e-6
    torch.testing.assert_close(fine.sum(1), torch.ones(721))


def test_what_the_camera_cannot_see_is_repelled() -> None:
    front, side = prompts.repulsion_weights(degrees(0.0, 45.0, 90.0, 135.0, 180.0, -135.0)).T
    e = math.exp
    torch.testing.assert_close(front, torch.tensor([0.0, -2 * e(-1.0), -2.0, -2.0, -2.0, -2.0]))
    torch.testing.assert_close(side, torch.tensor([-2.0, -2 * e(-5.0), 0.0, -e(-5.0), -1.0, -e(-5.0)]))


def test_perp_neg_keeps_the_prompts_own_direction() -> None:
    generator = torch.Generator().manual_seed(0)
    negative, prompt = torch.randn(2, 3, 4, 4, 2, generator=generator)
    repelled = torch.randn(2, 3, 4, 4, 2, generator=generator)
    weights = torch.tensor([[-1.0, 0.0], [-0.5, -2.0], [0.0, 0.0]])
    mixed = prompts.perp_neg(negative, prompt, repelled, weights).double().numpy()
    for b in range(3):
        d = (prompt - negative)[b].double().numpy().ravel()
        expected = prompt[b].double().numpy().ravel()
        for k in range(2):
            r = (repelled[k] - negative)[b].double().numpy().ravel()
            across = r - (r @ d) / (d @ d) * d
            assert abs(across @ d) < 1e-5
            expected = expected + float(weights[b, k]) * across
        np.testing.assert_allclose(mixed[b].ravel(), expected, atol=1e-5)
    np.testing.assert_array_equal(mixed[2], prompt[2].double().numpy())
    same = prompts.perp_neg(negative, negative, repelled, weights)
    assert bool(torch.isfinite(same).all())
