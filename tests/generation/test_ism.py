"""Score distillation against float64 closed forms, and what it does with bad numbers."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation import diffusion
from gdpro_sim.generation.config import ScoreConfig
from gdpro_sim.generation.ism import ScoreDistillation, inversion_steps, mean_evaluations, schedules
from gdpro_sim.generation.protocols import Condition, ViewBatch, step_generator
from tests.conditions import needs_gpu
from tests.reference import diffusion as oracle

ALPHAS = oracle.schedule()
SHAPE = (2, 6, 5, 3)
Predict = Callable[[torch.Tensor, int], torch.Tensor]


def numbers(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).normal(0.4, 0.3, SHAPE)


def looking(batch: int = 2, size: int = 8) -> ViewBatch:
    cameras = Cameras.look_at([[5.0, 0.3 * i, 1.0] for i in range(batch)], [0.0, 0.0, 0.0], vertical_fov=0.5,
                              width=size, height=size)  # fmt: skip
    return ViewBatch(cameras, torch.zeros(batch, 3), torch.zeros(batch), torch.zeros(batch))


class Analytic:
    """A guidance made of float64 oracles, asked in float32, that counts how often it is asked."""

    native_resolution = None

    def __init__(self, empty: oracle.Denoiser, negative: oracle.Denoiser, prompt: oracle.Denoiser) -> None:
        self.alphas_cumprod = torch.tensor(ALPHAS, dtype=torch.float32)
        self.uses_cameras = True
        self.denoisers = {"empty": empty, "negative": negative, "prompt": prompt}
        self.asked: list[tuple[str, int]] = []

    def views(self, proposed: ViewBatch, generator: torch.Generator) -> ViewBatch:
        return proposed

    def encode(self, images: torch.Tensor, views: ViewBatch) -> torch.Tensor:
        return images

    def noise_prediction(
        self, x_t: torch.Tensor, t: int, condition: Condition, views: ViewBatch
    ) -> torch.Tensor:
        self.asked.append((condition, t))
        return torch.tensor(self.denoisers[condition](x_t.double().numpy(), t), dtype=torch.float32)

    def guided(self, x_t: torch.Tensor, t: int, views: ViewBatch, scale: float) -> torch.Tensor:
        negative = self.noise_prediction(x_t, t, "negative", views)
        return diffusion.guidance_mix(negative, self.noise_prediction(x_t, t, "prompt", views), scale)

    def describe(self) -> dict[str, object]:
        return {"kind": "analytic"}


class GivenNoise(ScoreDistillation):
    given: torch.Tensor

    def noise(self, x0: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        return self.given


def real(
    guidance: Analytic,
    x0: np.ndarray,
    noise: np.ndarray,
    *,
    t: int,
    interval: int = 80,
    stride: int = 200,
    scale: float = 7.5,
    method: str = "ism",
) -> np.ndarray:
    """The code's gradient for one t, before the factor 0.1."""
    config = ScoreConfig(method=method, t_min=t, t_max=t + 1, t_warmup=0, warmup=0, interval=interval,
                         interval_warmup=0, inversion_stride=stride, guidance_scale=scale, gradient_scale=1.0,
                         flip_probability=0.0)  # fmt: skip
    score = GivenNoise(guidance, config)
    score.given = torch.tensor(noise, dtype=torch.float32)
    images = torch.tensor(x0, dtype=torch.float32)
    result = score.gradient(images, looking(), 0, torch.Generator().manual_seed(0))
    assert result.t == t and result.invalid == 0
    assert result.s == (t if method == "sds" else max(t - interval, 0))
    return result.gradient.double().numpy()


def error(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a - b).max() / np.abs(b).max())


@pytest.mark.parametrize(("t", "interval", "stride"), [(20, 80, 200), (300, 80, 200), (979, 100, 50)])
def test_point_mass_with_flat_unconditional_pulls_straight(t: int, interval: int, stride: int) -> None:
    x0, m, noise = numbers(0), numbers(1), numbers(2)
    point = oracle.gaussian(ALPHAS, m, 0.0)
    expected = 7.5 * (x0 + oracle.sigma(ALPHAS, 1) / oracle.signal(ALPHAS, 1) * noise - m)
    s = max(t - interval, 0)
    exact = oracle.ism(ALPHAS, x0, noise, t, s, stride, 7.5, oracle.flat, oracle.flat, point)
    assert error(exact, expected) < 1e-13
    got = real(Analytic(oracle.flat, oracle.flat, point), x0, noise, t=t, interval=interval, stride=stride)
    assert error(got, expected) < 2e-5


def test_no_pull_at_the_target() -> None:
    m, none = numbers(1), np.zeros(SHAPE)
    point = oracle.gaussian(ALPHAS, m, 0.0)
    exact = oracle.ism(ALPHAS, m, none, 500, 420, 200, 7.5, oracle.flat, oracle.flat, point)
    assert np.abs(exact).max() < 1e-12
    got = real(Analytic(oracle.flat, oracle.flat, point), m, none, t=500)
    assert np.abs(got).max() < 2e-5


def test_equal_unconditional_and_conditional_point_masses_pull_nowhere() -> None:
    """Not a way to test a score: the gradient is zero wherever the picture is."""
    x0, noise = numbers(0), numbers(2)
    point = oracle.gaussian(ALPHAS, numbers(1), 0.0)
    assert np.abs(oracle.ism(ALPHAS, x0, noise, 400, 320, 200, 7.5, point, point, point)).max() < 1e-12
    assert np.abs(real(Analytic(point, point, point), x0, noise, t=400)).max() < 1e-4


def test_whole_gradient_equals_the_oracle() -> None:
    """With three Gaussian denoisers of their own nothing cancels."""
    x0, noise = numbers(0), numbers(2)
    parts = [oracle.gaussian(ALPHAS, numbers(3 + i), 0.3 + 0.2 * i) for i in range(3)]
    for t, interval, stride in ((20, 80, 200), (281, 80, 200), (450, 31, 70), (979, 100, 200)):
        exact = oracle.ism(ALPHAS, x0, noise, t, max(t - interval, 0), stride, 7.5, *parts)
        got = real(Analytic(*parts), x0, noise, t=t, interval=interval, stride=stride)
        assert error(got, exact) < 5e-5
    exact = oracle.sds(ALPHAS, x0, noise, 321, 7.5, parts[1], parts[2])
    assert error(real(Analytic(*parts), x0, noise, t=321, method="sds"), exact) < 5e-5


def test_inversion_follows_the_exact_path_to_first_order() -> None:
    """Of N(mu, w^2): sqrt(a) mu + (S_s / S_1)(x_1 - sqrt(a_1) mu), S^2 = a w^2 + 1 - a."""
    mu, width, s = 0.3, 0.5, 500
    noise = numbers(2)
    denoiser = oracle.gaussian(ALPHAS, np.full(SHAPE, mu), width)
    x1 = oracle.noised(ALPHAS, numbers(0), noise, 1)
    spread = [math.sqrt(ALPHAS[t] * width**2 + 1.0 - ALPHAS[t]) for t in (1, s)]
    exact = math.sqrt(ALPHAS[s]) * mu + spread[1] / spread[0] * (x1 - math.sqrt(ALPHAS[1]) * mu)
    errors = {}
    for stride in (200, 100, 50, 25, 10):
        score = ScoreDistillation(Analytic(denoiser, denoiser, denoiser),
                                  ScoreConfig(inversion_stride=stride))  # fmt: skip
        given = [torch.tensor(a, dtype=torch.float32) for a in (numbers(0), noise)]
        got = score.invert(given[0], given[1], s, looking()).double().numpy()
        assert error(got, oracle.invert(ALPHAS, numbers(0), noise, s, stride, denoiser)) < 1e-5
        errors[stride] = error(got, exact)
    assert errors[200] > errors[100] > errors[50] > errors[25] > errors[10]
    assert 1.6 < errors[50] / errors[25] < 2.6
    assert errors[10] < 0.1 * errors[200]


def test_smallest_interval_gives_the_guided_difference() -> None:
    """interval -> 1: weight g (e_prompt - e_empty) at x_t, when negative and empty are one."""
    x0, noise = numbers(0), numbers(2)
    empty = oracle.gaussian(ALPHAS, numbers(3), 0.5)
    prompt = oracle.gaussian(ALPHAS, numbers(4), 0.3)
    t = 400
    got = real(Analytic(empty, empty, prompt), x0, noise, t=t, interval=1)
    x_s = oracle.invert(ALPHAS, x0, noise, t - 1, 200, empty)
    x_t = oracle.ddim(ALPHAS, x_s, empty(x_s, t - 1), t - 1, t)
    weight = oracle.sigma(ALPHAS, t) / oracle.signal(ALPHAS, t)
    assert error(got, weight * 7.5 * (prompt(x_t, t) - empty(x_t, t))) < 2e-3


def test_gradient_is_affine_in_the_guidance_scale() -> None:
    x0, noise = numbers(0), numbers(2)
    parts = [oracle.gaussian(ALPHAS, numbers(3 + i), 0.3 + 0.2 * i) for i in range(3)]
    at = {g: real(Analytic(*parts), x0, noise, t=300, scale=g) for g in (0.0, 1.0, 7.5)}
    assert error(at[0.0] + 7.5 * (at[1.0] - at[0.0]), at[7.5]) < 1e-4


def test_the_noise_of_intervals_is_far_below_that_of_random_noising() -> None:
    """Standard deviation over the noise of a gradient, for a broad unconditional and a narrow conditional."""
    x0 = numbers(0)
    broad = oracle.gaussian(ALPHAS, np.full(SHAPE, 0.5), 0.5)
    narrow = oracle.gaussian(ALPHAS, np.full(SHAPE, 0.5), 0.1)
    for t, least in ((100, 2.0), (300, 8.0), (500, 12.0)):
        spread = {}
        for method in ("ism", "sds"):
            draws = [np.random.default_rng(i).normal(size=SHAPE) for i in range(40)]
            got = [real(Analytic(broad, broad, narrow), x0, n, t=t, method=method) for n in draws]
            spread[method] = float(np.std(got, axis=0).mean())
        assert spread["sds"] > least * spread["ism"], (t, spread)


def test_moves_equal_those_of_diffusers() -> None:
    from diffusers import DDIMScheduler

    scheduler = DDIMScheduler(beta_start=0.00085, beta_end=0.012, beta_schedule="scaled_linear",
                              clip_sample=False, set_alpha_to_one=False)  # fmt: skip
    torch.testing.assert_close(
        diffusion.scaled_linear_schedule(), scheduler.alphas_cumprod, rtol=2e-5, atol=0
    )
    schedule = diffusion.Schedule(scheduler.alphas_cumprod)
    x, noise = (torch.tensor(numbers(i), dtype=torch.float32) for i in (0, 1))
    for steps, t in ((10, 999), (10, 301), (50, 41), (1000, 500)):
        scheduler.set_timesteps(steps)
        expected = scheduler.step(noise, t, x).prev_sample
        got = diffusion.ddim_move(x, noise, t, t - 1000 // steps, schedule)
        torch.testing.assert_close(got, expected, rtol=1e-6, atol=5e-7)
        back = diffusion.ddim_move(got, noise, t - 1000 // steps, t, schedule)
        torch.testing.assert_close(back, x, rtol=1e-5, atol=1e-5)
    noised = scheduler.add_noise(x, noise, torch.tensor([300, 300]))
    torch.testing.assert_close(diffusion.add_noise(x, noise, 300, schedule), noised, rtol=1e-6, atol=1e-6)


def test_elementwise_parts_on_long_and_half_precision_numbers() -> None:
    x, y = torch.randn(3 * diffusion.SPAN + 17), torch.randn(3 * diffusion.SPAN + 17)
    torch.testing.assert_close(diffusion.combine(x, 0.3, y, -2.0), 0.3 * x - 2.0 * y, rtol=0.0, atol=1e-6)
    torch.testing.assert_close(diffusion.guidance_mix(x, y, 7.5), x + 7.5 * (y - x), rtol=0.0, atol=1e-5)
    half = diffusion.guidance_mix(x.half(), y.half(), 7.5)
    assert half.dtype == torch.float32
    expected = x.half().float() + 7.5 * (y.half().float() - x.half().float())
    torch.testing.assert_close(half, expected, rtol=0.0, atol=1e-5)
    with pytest.raises(ValueError, match=r"y must have shape \[12305\]"):
        diffusion.combine(x, 1.0, y[:5], 1.0)


def test_steps_of_the_inversion() -> None:
    guidance = Analytic(oracle.flat, oracle.flat, oracle.flat)
    score = ScoreDistillation(guidance, ScoreConfig())
    assert inversion_steps(420, 200) == [1, 200, 400, 420]
    assert inversion_steps(400, 200) == [1, 200, 400]
    assert inversion_steps(0, 200) == [1, 0]
    for s in (0, 1, 2, 199, 200, 201, 899):
        guidance.asked.clear()
        x = torch.zeros(SHAPE)
        score.invert(x, x, s, looking())
        assert len(guidance.asked) == max(1, math.ceil(s / 200))
        assert all(condition == "empty" for condition, _ in guidance.asked)
    assert inversion_steps(4, 1) == [1, 2, 3, 4]


def test_schedules_over_the_iterations() -> None:
    guidance = Analytic(oracle.flat, oracle.flat, oracle.flat)
    score = ScoreDistillation(guidance, ScoreConfig())
    expected = [(980, 100), (740, 90), (500, 80), (500, 80)]
    assert [schedules(score.config, i) for i in (0, 500, 1000, 5000)] == expected
    images = torch.zeros(SHAPE)

    def drawn(iteration: int) -> list[tuple[int, int]]:
        results = [score.gradient(images, looking(), iteration, torch.Generator().manual_seed(i))
                   for i in range(200)]  # fmt: skip
        return [(r.t, r.s) for r in results]

    early, late = drawn(0), drawn(1000)
    assert all(20 <= t < 980 and s == max(t - 100, 0) for t, s in early)
    assert all(20 <= t < 500 and s == max(t - 80, 0) for t, s in late)
    assert max(t for t, _ in early) > 900 and min(t for t, _ in early) < 100
    assert 480 < max(t for t, _ in late) < 500 and min(t for t, _ in late) < 40
    guidance.asked.clear()
    result = score.gradient(images, looking(), 0, torch.Generator().manual_seed(3))
    assert len(guidance.asked) == max(1, math.ceil(result.s / 200)) + 3
    assert schedules(ScoreConfig(warmup=0), 0) == (500, 80)
    drawn_evaluations = [max(1, math.ceil(s / 200)) + 3 for _, s in late]
    mean = mean_evaluations(ScoreConfig(warmup=0), 10)
    assert mean == pytest.approx(np.mean(drawn_evaluations), abs=0.15)
    assert mean_evaluations(ScoreConfig(), 1000) > mean
    assert mean_evaluations(ScoreConfig(method="sds"), 10) == 2.0


def test_noise_has_a_part_each_channel_shares() -> None:
    score = ScoreDistillation(Analytic(oracle.flat, oracle.flat, oracle.flat), ScoreConfig(shared_noise=3.0))
    noise = score.noise(torch.zeros(4, 40, 40, 3), torch.Generator().manual_seed(0))
    means = noise.mean((1, 2))
    torch.testing.assert_close(means, means[:1].expand(4, 3), rtol=0.0, atol=0.12)
    assert means.std(1).min() > 0.5
    plain = ScoreDistillation(score.guidance, ScoreConfig(shared_noise=0.0))
    assert (
        abs(float(plain.noise(torch.zeros(4, 40, 40, 3), torch.Generator().manual_seed(0)).std()) - 1) < 0.02
    )


def test_backward_applies_exactly_the_gradient() -> None:
    parts = [oracle.gaussian(ALPHAS, numbers(3 + i), 0.3) for i in range(3)]
    score = ScoreDistillation(Analytic(*parts), ScoreConfig())
    images = torch.tensor(numbers(0), dtype=torch.float32, requires_grad=True)
    loss, result = score.loss(images, looking(), 0, torch.Generator().manual_seed(0))
    (3.0 * loss).backward()
    assert torch.equal(images.grad, 3.0 * result.gradient)
    assert float(loss.detach()) == pytest.approx(0.5 * float(result.gradient.square().sum()), rel=1e-6)
    assert not result.gradient.requires_grad


def test_pictures_are_mirrored_only_where_the_score_knows_no_camera() -> None:
    m = numbers(1)
    guidance = Analytic(oracle.flat, oracle.flat, oracle.gaussian(ALPHAS, m, 0.0))
    config = ScoreConfig(flip_probability=1.0, shared_noise=0.0)
    images = torch.tensor(m, dtype=torch.float32)

    def size() -> float:
        score = GivenNoise(guidance, config)
        score.given = torch.zeros(SHAPE)
        return float(
            score.gradient(images, looking(), 0, torch.Generator().manual_seed(0)).gradient.abs().max()
        )

    assert size() < 1e-5
    guidance.uses_cameras = False
    assert size() > 0.01
    images = images.flip(2).requires_grad_()
    assert size() < 1e-5
    score = GivenNoise(guidance, config)
    score.given = torch.zeros(SHAPE)
    start = torch.tensor(numbers(0), dtype=torch.float32, requires_grad=True)
    loss, result = score.loss(start, looking(), 0, torch.Generator().manual_seed(0))
    loss.backward()
    assert torch.equal(start.grad, result.gradient.flip(2))


def test_the_same_seed_gives_the_same_bytes() -> None:
    parts = [oracle.gaussian(ALPHAS, numbers(3 + i), 0.3) for i in range(3)]
    score = ScoreDistillation(Analytic(*parts), ScoreConfig())
    images = torch.tensor(numbers(0), dtype=torch.float32)
    again = [score.gradient(images, looking(), 7, step_generator(1, "s", 7)).gradient for _ in range(2)]
    assert torch.equal(*again)
    other = score.gradient(images, looking(), 7, step_generator(2, "s", 7)).gradient
    assert not torch.equal(other, again[0])


class Faulty(Analytic):
    """Two numbers of every prompted prediction are not finite."""

    def noise_prediction(
        self, x_t: torch.Tensor, t: int, condition: Condition, views: ViewBatch
    ) -> torch.Tensor:
        predicted = super().noise_prediction(x_t, t, condition, views)
        if condition == "prompt":
            predicted.view(-1)[3], predicted.view(-1)[7] = float("nan"), float("inf")
        return predicted


def test_invalid_numbers_are_zeroed_and_counted_until_the_limit() -> None:
    guidance = Faulty(oracle.flat, oracle.flat, oracle.gaussian(ALPHAS, numbers(1), 0.0))
    score = ScoreDistillation(guidance, ScoreConfig(nan_limit=2))
    images = torch.tensor(numbers(0), dtype=torch.float32, requires_grad=True)
    for _ in range(2):
        loss, result = score.loss(images, looking(), 0, torch.Generator().manual_seed(0))
        loss.backward()
        assert result.invalid == 2
        assert result.gradient.view(-1)[[3, 7]].tolist() == [0.0, 0.0]
        assert bool(torch.isfinite(images.grad).all()) and bool(torch.isfinite(loss))
    resumed = ScoreDistillation(guidance, ScoreConfig(nan_limit=2))
    resumed.load_state_dict(score.state_dict())
    with pytest.raises(GuidanceError, match=r"in 3 iterations, past score.nan_limit=2 .*analytic model"):
        resumed.gradient(images, looking(), 0, torch.Generator().manual_seed(0))
    broken = images.detach().clone()
    broken[0, 0, 0, 0] = float("nan")
    with pytest.raises(GuidanceError, match="comes from the rendered pictures"):
        resumed.gradient(broken, looking(), 0, torch.Generator().manual_seed(0))


def test_bad_ranges_are_refused() -> None:
    guidance = Analytic(oracle.flat, oracle.flat, oracle.flat)
    with pytest.raises(GuidanceError, match=r"score.t_max must be larger than score.t_min, got 20 <= 20"):
        ScoreDistillation(guidance, ScoreConfig(t_min=20, t_max=20))
    with pytest.raises(ValueError, match="alphas_cumprod must be"):
        diffusion.Schedule(torch.ones(10))
    with pytest.raises(ValueError, match="between 0 and 1"):
        diffusion.Schedule(torch.ones(1000))


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("dtype", [torch.float32, torch.float16, torch.bfloat16])
def test_cuda_equals_cpu(dtype: torch.dtype) -> None:
    schedule = diffusion.Schedule(diffusion.scaled_linear_schedule())
    x, y = (torch.randn(2, 33, 31, 4).to(dtype) for _ in range(2))
    x.view(-1)[5] = float("nan")

    def everything(a: torch.Tensor, b: torch.Tensor) -> list[torch.Tensor]:
        residual, invalid = diffusion.weighted_residual(a, b, 3.0)
        assert invalid == 1
        parts = [diffusion.combine(a, 0.2, b, 3.0), diffusion.ddim_move(a, b, 100, 700, schedule),
                 diffusion.guidance_mix(a, b, 7.5)]  # fmt: skip
        return [residual, *parts]

    for cpu, gpu in zip(everything(x, y), everything(x.cuda(), y.cuda()), strict=True):
        assert gpu.is_cuda
        torch.testing.assert_close(gpu.cpu(), cpu, rtol=1e-5, atol=1e-5, equal_nan=True)
