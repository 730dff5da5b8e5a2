"""Score distillation: how a picture should change, by a denoiser that has learned what pictures look like.

Interval score matching (ISM) takes a picture up to noise level s by deterministic DDIM, one step further to
t, and compares the guided prediction there with the unguided one at s:

    x_0 = encode(picture) -> x_s (DDIM upward, no prompt) -> x_t (one DDIM step with e_s)
    gradient on x_0 = scale sqrt((1 - alpha_bar_t) / alpha_bar_t) (e_guided(x_t, t) - e_empty(x_s, s))

Score distillation sampling (SDS) noises x_0 at random and compares the guided prediction with that noise; it
is here to compare with, under the same weights and range of t.

Sources: Liang et al., "LucidDreamer" (arXiv 2311.11284), eq. 17, and its code for the schedules; Poole et
al., "DreamFusion" (arXiv 2209.14988), eq. 3.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import ScoreConfig
from gdpro_sim.generation.diffusion import Schedule, add_noise, ddim_move, weighted_residual
from gdpro_sim.generation.protocols import Guidance, ViewBatch


@dataclass(frozen=True)
class ScoreResult:
    """What one evaluation gives.

    x0:       [B, h, w, c] what was noised (latents, or the pictures themselves), with its path to the
              pictures
    gradient: of x0's shape, float32, without NaN; summed over the batch, not averaged
    t, s:     the steps in [0, 999]; s is t for SDS
    invalid:  how many numbers of the gradient were NaN or infinite and became 0
    """

    x0: torch.Tensor
    gradient: torch.Tensor
    t: int
    s: int
    invalid: int


class ScoreDistillation:
    """ISM or SDS with one guidance, as `config` says.

    The only thing it remembers from step to step is how many iterations brought invalid numbers.
    """

    def __init__(self, guidance: Guidance, config: ScoreConfig) -> None:
        if config.t_max <= config.t_min:
            raise GuidanceError(
                f"score.t_max must be larger than score.t_min, got {config.t_max} <= {config.t_min}"
            )
        self.guidance = guidance
        self.config = config
        self.schedule = Schedule(guidance.alphas_cumprod)
        self.invalid_iterations = 0

    def gradient(
        self, images: torch.Tensor, views: ViewBatch, iteration: int, generator: torch.Generator
    ) -> ScoreResult:
        """How x_0 of pictures [B, H, W, 3] in [0, 1] should *not* change: the direction to walk against.

        iteration: finished iterations of the stage, which sets the warm-up
        generator: for the mirroring, t and the noise, in this order

        Raises GuidanceError where more than `config.nan_limit` iterations have brought NaN or infinity.
        """
        config = self.config
        if _uniform(generator) < config.flip_probability and not self.guidance.uses_cameras:
            images = images.flip(2)
        x0 = self.guidance.encode(images, views)
        end, interval = schedules(config, iteration)
        t = config.t_min + int(_uniform(generator) * (end - config.t_min))
        noise = self.noise(x0, generator)
        with torch.no_grad():
            if config.method == "sds":
                s = t
                x_t = add_noise(x0, noise, t, self.schedule)
                reference = noise
            else:
                s = max(t - interval, 0)
                x_s = self.invert(x0, noise, s, views)
                reference = self.guidance.noise_prediction(x_s, s, "empty", views)
                x_t = ddim_move(x_s, reference, s, t, self.schedule)
            guided = self.guidance.guided(x_t, t, views, config.guidance_scale)
            weight = config.gradient_scale * self.schedule.weight(t)
            gradient, invalid = weighted_residual(guided, reference, weight)
        if invalid:
            self._count(x0, gradient, invalid)
        return ScoreResult(x0, gradient, t, s, invalid)

    def loss(
        self, images: torch.Tensor, views: ViewBatch, iteration: int, generator: torch.Generator
    ) -> tuple[torch.Tensor, ScoreResult]:
        """A scalar whose gradient with respect to x_0 is exactly `gradient`'s, and that result.

        Its value is half the squared norm of the gradient, what 1/2 |x_0 - (x_0 - gradient)|^2 would be were
        the bracket held constant. See `gradient`.
        """
        result = self.gradient(images, views, iteration, generator)
        return _Pull.apply(result.x0, result.gradient), result

    def noise(self, x0: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
        """Noise of x_0's shape [B, h, w, c]: N(0, 1) plus a part that a channel of all pictures shares."""
        with beside_torch(x0):
            own = torch.randn(x0.shape, generator=generator, device=generator.device)
            shared = torch.randn(x0.shape[-1], generator=generator, device=generator.device)
            return own.add_(shared, alpha=self.config.shared_noise).to(x0.device)

    def invert(self, x0: torch.Tensor, noise: torch.Tensor, s: int, views: ViewBatch) -> torch.Tensor:
        """x_s: x_0 noised at t = 1, taken upward by DDIM with the predictions for the empty prompt."""
        steps = inversion_steps(s, self.config.inversion_stride)
        x = add_noise(x0, noise, steps[0], self.schedule)
        for t, to in pairwise(steps):
            predicted = self.guidance.noise_prediction(x, t, "empty", views)
            x = ddim_move(x, predicted, t, to, self.schedule)
        return x

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"invalid_iterations": torch.tensor(self.invalid_iterations)}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        self.invalid_iterations = int(state["invalid_iterations"])

    def _count(self, x0: torch.Tensor, gradient: torch.Tensor, invalid: int) -> None:
        self.invalid_iterations += 1
        if self.invalid_iterations <= self.config.nan_limit:
            return
        model = self.guidance.describe().get("kind", type(self.guidance).__name__)
        blame = (
            f"the {model} model; try guidance.dtype=float32"
            if bool(torch.isfinite(x0.detach()).all())
            else "the rendered pictures; lower the learning rates"
        )
        raise GuidanceError(
            f"NaN or infinity in {self.invalid_iterations} iterations, past score.nan_limit="
            f"{self.config.nan_limit} (now in {invalid} of {gradient.numel()} numbers): it comes from {blame}"
        )


def schedules(config: ScoreConfig, iteration: int) -> tuple[int, int]:
    """What t is drawn below, at most 1000, and the interval t - s, once `iteration` iterations are done.

    With omega = max(1 - iteration / warmup, 0): t_max + t_warmup omega and interval + interval_warmup omega.
    """
    omega = max(1.0 - iteration / config.warmup, 0.0) if config.warmup else 0.0
    end = min(int(config.t_max + config.t_warmup * omega), 1000)
    return end, int(config.interval + config.interval_warmup * omega)


def inversion_steps(s: int, stride: int) -> list[int]:
    """Steps 1, stride, 2 stride, ... s that the inversion visits.

    That is max(1, ceil(s / stride)) moves (for stride 1, one less).
    """
    return [1, *(t for t in range(stride, s, stride) if t > 1), s]


def mean_evaluations(config: ScoreConfig, iterations: int) -> float:
    """Evaluations of the denoiser that an iteration asks for each picture, averaged over a run."""
    if config.method == "sds":
        return 2.0
    total = 0.0
    for iteration in range(max(iterations, 1)):
        end, interval = schedules(config, iteration)
        s = np.maximum(np.arange(config.t_min, end) - interval, 0)
        total += float(np.maximum(np.ceil(s / config.inversion_stride), 1.0).mean()) + 3.0
    return total / max(iterations, 1)


def _uniform(generator: torch.Generator) -> float:
    """A random number in [0, 1)."""
    return float(torch.rand((), generator=generator, device=generator.device, dtype=torch.float64))


class _Pull(torch.autograd.Function):
    """Half the squared norm of a given gradient, which is also what goes back to x_0."""

    @staticmethod
    def forward(ctx: Any, x0: torch.Tensor, gradient: torch.Tensor) -> torch.Tensor:  # type: ignore[override]
        ctx.save_for_backward(gradient)
        ctx.dtype = x0.dtype
        return 0.5 * gradient.square().sum()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return (gradients[0] * gradient).to(ctx.dtype), None


__all__ = ["ScoreDistillation", "ScoreResult", "inversion_steps", "mean_evaluations", "schedules"]
