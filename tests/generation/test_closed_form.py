"""Scores of known pictures against float64 mixtures, and what they do to a picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import ScoreConfig
from gdpro_sim.generation.guidance.closed_form import ClosedFormScore
from gdpro_sim.generation.ism import ScoreDistillation
from gdpro_sim.generation.protocols import ViewBatch, step_generator
from tests.reference import diffusion as oracle

ALPHAS = oracle.schedule()
BATCH, SIZE = 2, 12


class Known(ClosedFormScore):
    """Targets given as an array [K, B, H, W, 3]."""

    def __init__(self, targets: np.ndarray, **options: Any) -> None:
        super().__init__(**options)
        self.given = torch.tensor(targets, dtype=torch.float32)
        self.asked = 0

    def targets(self, views: ViewBatch) -> torch.Tensor:
        self.asked += 1
        return self.given

    def describe(self) -> dict[str, Any]:
        return {"kind": "known"}


def looking(size: int = SIZE, distance: float = 5.0, field: float = 0.5) -> ViewBatch:
    eyes = [[distance, 0.0, 0.0], [0.0, distance, 0.0]]
    cameras = Cameras.look_at(eyes, [0.0, 0.0, 0.0], vertical_fov=field, width=size, height=size)
    return ViewBatch(cameras, torch.zeros(BATCH, 3), torch.zeros(BATCH), torch.zeros(BATCH))


def pictures(seed: int, *lead: int, spread: float = 0.3) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.5, spread, (*lead, BATCH, SIZE, SIZE, 3))


@pytest.mark.parametrize("width", [0.0, 0.2])
@pytest.mark.parametrize("count", [1, 4])
def test_prediction_equals_the_exact_mixture(count: int, width: float) -> None:
    # Targets so close to each other that several of them matter.
    targets = 0.5 + 0.02 * (pictures(0, count) - 0.5)
    score = Known(targets, kernel_width=width)
    views = looking()
    for t in (30, 400, 900):
        x = oracle.noised(ALPHAS, pictures(1), np.random.default_rng(2).normal(size=targets.shape[1:]), t)
        got = score.noise_prediction(torch.tensor(x, dtype=torch.float32), t, "prompt", views).numpy()
        exact = np.stack([oracle.mixture(ALPHAS, targets[:, b], width)(x[b], t) for b in range(BATCH)])
        np.testing.assert_allclose(got, exact, rtol=1e-3, atol=2e-4)
    for condition in ("empty", "negative"):
        assert not score.noise_prediction(torch.ones(BATCH, SIZE, SIZE, 3), 500, condition, views).any()


def test_weights_pick_the_nearest_instance_of_each_view() -> None:
    targets = pictures(0, 3)
    views = looking()
    score = Known(targets)
    x = torch.tensor(np.stack([targets[2, 0], targets[0, 1]]), dtype=torch.float32)
    signal, sigma = oracle.signal(ALPHAS, 200), oracle.sigma(ALPHAS, 200)
    predicted = score.noise_prediction(signal * x, 200, "prompt", views)
    torch.testing.assert_close(predicted, torch.zeros_like(x), rtol=0.0, atol=1e-5 / sigma)


def test_interval_score_matching_pulls_with_the_stated_strength() -> None:
    """7.5 (x - m), or that times (1 - a) / (a h^2 + 1 - a) with a kernel of width h."""
    m = pictures(0, 1)
    for width in (0.0, 0.3):
        config = ScoreConfig(t_min=300, t_max=301, t_warmup=0, warmup=0, gradient_scale=1.0)
        score = ScoreDistillation(Known(m, kernel_width=width), config)
        x = torch.tensor(pictures(1), dtype=torch.float32)
        generator = step_generator(0, "s", 0)
        result = score.gradient(x, looking(), 0, generator)
        replay = step_generator(0, "s", 0)
        torch.rand((), generator=replay, dtype=torch.float64)
        torch.rand((), generator=replay, dtype=torch.float64)
        noise = score.noise(x, replay).double().numpy()
        factor = (1.0 - ALPHAS[300]) / (ALPHAS[300] * width**2 + 1.0 - ALPHAS[300])
        shifted = x.double().numpy() + oracle.sigma(ALPHAS, 1) / oracle.signal(ALPHAS, 1) * noise
        np.testing.assert_allclose(result.gradient.numpy(), 7.5 * factor * (shifted - m[0]), atol=2e-4)


def test_descent_arrives_at_a_target() -> None:
    """Among four instances each view settles on one and reaches it."""
    targets = pictures(0, 4)
    guidance = Known(targets)
    score = ScoreDistillation(guidance, ScoreConfig())
    views = looking()
    x = torch.full((BATCH, SIZE, SIZE, 3), 0.5, requires_grad=True)
    first = guidance.psnr(x, views)
    for i in range(60):
        generator = step_generator(0, "descent", i)
        loss, _ = score.loss(x, guidance.views(views, generator), i, generator)
        (pull,) = torch.autograd.grad(loss, x)
        with torch.no_grad():
            x -= 0.2 * pull
    nearest = (torch.tensor(targets) - x.detach()).square().mean((2, 3, 4)).amin(0)
    assert first < 12.0
    assert bool((nearest < 3e-3).all())


def test_references_are_drawn_once_for_the_same_views() -> None:
    guidance = Known(pictures(0, 1))
    views, other = looking(), looking()
    score = ScoreDistillation(guidance, ScoreConfig())
    x = torch.zeros(BATCH, SIZE, SIZE, 3)
    score.gradient(x, views, 0, step_generator(0, "s", 0))
    assert guidance.psnr(x, views) == pytest.approx(-10.0 * np.log10(np.mean(pictures(0, 1) ** 2)), rel=1e-5)
    assert guidance.asked == 1
    guidance.psnr(x, other)
    assert guidance.asked == 2


def test_psnr_is_that_of_the_nearest_instance() -> None:
    targets = pictures(0, 3)
    x = torch.tensor(targets[1] + 0.1, dtype=torch.float32)
    assert Known(targets).psnr(x, looking()) == pytest.approx(20.0, abs=1e-3)


def test_jitter_shifts_each_target_by_lengths_across_the_view() -> None:
    """A bright spot moves by as many pixels as a point of the object would."""
    size, distance, field = 64, 5.0, 0.5
    views = looking(size, distance, field)
    rows, columns = np.mgrid[:size, :size] + 0.5
    blob = np.exp(-((rows - 32.0) ** 2 + (columns - 32.0) ** 2) / (2 * 3.0**2))
    targets = np.broadcast_to(blob[None, None, ..., None], (1, BATCH, size, size, 3))
    score = Known(targets, jitter=0.1)
    t = 500
    signal, sigma = oracle.signal(ALPHAS, t), oracle.sigma(ALPHAS, t)

    def centres() -> np.ndarray:
        predicted = score.noise_prediction(torch.zeros(BATCH, size, size, 3), t, "prompt", views)
        shown = (-predicted * sigma / signal)[..., 0].double().numpy()
        total = shown.sum((1, 2))
        return np.stack([(shown * columns).sum((1, 2)) / total, (shown * rows).sum((1, 2)) / total], 1) - 32.0

    pixels = float(views.cameras.Ks[0, 0, 0]) / distance
    found = []
    for i in range(150):
        assert score.views(views, step_generator(0, "s", i)) is views
        found.append(centres())
    assert np.abs(found[0] - found[1]).max() > 0.1
    assert np.abs(found[0][0] - found[0][1]).max() > 0.1  # each view its own
    spread = np.std(found, axis=0)
    np.testing.assert_allclose(spread, 0.1 * pixels, rtol=0.2)
    score.views(views, step_generator(0, "s", 0))
    np.testing.assert_array_equal(centres(), found[0])
    with pytest.raises(ValueError, match="call views"):
        one = Cameras(views.cameras.viewmats[:1], views.cameras.Ks[:1], size, size)
        lone = ViewBatch(one, torch.zeros(1, 3), torch.zeros(1), torch.zeros(1))
        score.given = score.given[:, :1]
        score.noise_prediction(torch.zeros(1, size, size, 3), t, "prompt", lone)


def test_bad_input_is_refused() -> None:
    with pytest.raises(GuidanceError, match=r"must be >= 0, got -0.1 and 0.0"):
        Known(pictures(0, 1), kernel_width=-0.1)
    with pytest.raises(ValueError, match=r"targets must be \[K, 2, 12, 12, 3\]"):
        Known(pictures(0, 1)[:, :1]).reference(looking())
