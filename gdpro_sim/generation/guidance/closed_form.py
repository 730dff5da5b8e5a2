"""Scores that are known exactly: the noise an ideal denoiser would predict for known pictures.

The pictures of a view are K targets, each with a Gaussian of width h around it. With x_t = signal x_0 +
sigma noise the posterior mean of x_0 is a weighted mean over the targets y_k,

    E[x_0 | x_t] = sum_k w_k (signal h^2 x_t + sigma^2 y_k) / v,   v = signal^2 h^2 + sigma^2
    w_k  ~  exp(-|x_t - signal y_k|^2 / (2 v))    over all numbers of one picture

and the predicted noise is (x_t - signal E) / sigma = (sigma / v) (x_t - signal sum_k w_k y_k) (Tweedie's
formula). Without a prompt every picture is equally likely: E = x_t / signal, so the predicted noise is zero,
for the empty and for the negative prompt alike. With K = 1 and h = 0, interval score matching then pulls a
picture straight towards its target: gradient = guidance scale (x_0 + noise - y).

What follows such a score is fitted to known pictures through the whole pipeline; it is no text-to-3D model.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any

import torch

from gdpro_sim.device import beside_torch
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.diffusion import Schedule, combine, guidance_mix, scaled_linear_schedule
from gdpro_sim.generation.protocols import Condition, ViewBatch


class ClosedFormScore(ABC):
    """A guidance over known pictures; a subclass says which, in `targets`, and what it is, in `describe`.

    kernel_width: h, standard deviation in colour units; 0: the targets alone are right
    jitter:       standard deviation of a random shift of every target, drawn anew for each step and view,
                  in lengths of the unit frame across the view (the object's radius is 1). It stands for a
                  denoiser that does not quite know what it wants.
    device:       where the targets, hence the pictures, lie
    """

    uses_cameras: bool = True
    native_resolution: int | None = None

    def __init__(
        self, *, kernel_width: float = 0.0, jitter: float = 0.0, device: torch.device | str = "cpu"
    ) -> None:
        if kernel_width < 0.0 or jitter < 0.0:
            raise GuidanceError(f"kernel_width and jitter must be >= 0, got {kernel_width} and {jitter}")
        self.kernel_width = kernel_width
        self.jitter = jitter
        self.alphas_cumprod = scaled_linear_schedule().to(device)
        self._schedule = Schedule(self.alphas_cumprod)
        self._shifts: torch.Tensor | None = None
        self._seen: tuple[ViewBatch, torch.Tensor] | None = None

    @abstractmethod
    def targets(self, views: ViewBatch) -> torch.Tensor:
        """The pictures that are right for `views`: [K, B, H, W, 3] in [0, 1], float32, over its backgrounds.

        Of the kind `views.kind` and the size of its cameras; no gradient.
        """

    @abstractmethod
    def describe(self) -> dict[str, Any]:
        """See `Guidance.describe`."""

    def views(self, proposed: ViewBatch, generator: torch.Generator) -> ViewBatch:
        """`proposed`; draws the step's shifts. A subclass that knows other cameras calls this with its own.

        Nothing else of a step is remembered, so that a resumed run draws what an uninterrupted one draws.
        """
        self._shifts = None
        if self.jitter > 0.0:
            shape = (len(proposed.cameras), 2)
            self._shifts = self.jitter * torch.randn(shape, generator=generator, device=generator.device)
        return proposed

    def reference(self, views: ViewBatch) -> torch.Tensor:
        """`targets(views)`, not shifted; kept until other views are asked for, so they are drawn once."""
        if self._seen is None or self._seen[0] is not views:
            with torch.no_grad():
                targets = self.targets(views)
            size = (len(views.cameras), views.cameras.height, views.cameras.width, 3)
            if targets.ndim != 5 or targets.shape[1:] != size or not len(targets):
                raise ValueError(f"targets must be [K, {', '.join(map(str, size))}], got {targets.shape}")
            self._seen = (views, targets)
        return self._seen[1]

    def psnr(self, images: torch.Tensor, views: ViewBatch) -> float:
        """Peak signal-to-noise ratio of pictures [B, H, W, 3] against the target nearest to them, dB."""
        errors = (self.reference(views) - images.detach()).square().mean((1, 2, 3, 4))
        return -10.0 * math.log10(max(float(errors.min()), 1e-12))

    def encode(self, images: torch.Tensor, views: ViewBatch) -> torch.Tensor:
        """The pictures themselves: this score lives in colours."""
        return images

    def noise_prediction(
        self, x_t: torch.Tensor, t: int, condition: Condition, views: ViewBatch
    ) -> torch.Tensor:
        """The ideal denoiser's prediction, see the module. `condition` other than "prompt": zero."""
        if condition != "prompt":
            return torch.zeros_like(x_t)
        signal, sigma = self._schedule.signal(t), self._schedule.sigma(t)
        variance = signal**2 * self.kernel_width**2 + sigma**2
        targets = self.reference(views)
        with torch.no_grad(), beside_torch(x_t):
            targets = self._shifted(targets, views)
            mean = targets[0]
            if len(targets) > 1:
                squares = (x_t - signal * targets).double().square().sum((2, 3, 4))
                weights = torch.softmax(-squares / (2.0 * variance), 0).to(targets.dtype)
                mean = torch.einsum("kb,kbhwc->bhwc", weights, targets)
        return combine(x_t, sigma / variance, mean, -signal * sigma / variance)

    def guided(self, x_t: torch.Tensor, t: int, views: ViewBatch, scale: float) -> torch.Tensor:
        """e_neg + scale (e_prompt - e_neg), where e_neg is zero."""
        negative = self.noise_prediction(x_t, t, "negative", views)
        return guidance_mix(negative, self.noise_prediction(x_t, t, "prompt", views), scale)

    def _shifted(self, targets: torch.Tensor, views: ViewBatch) -> torch.Tensor:
        """Targets [K, B, H, W, 3], each view's shifted as drawn; what comes in repeats the picture's edge."""
        if self._shifts is None:
            return targets
        cameras = views.cameras
        if len(self._shifts) != len(cameras):
            raise ValueError(
                f"{len(cameras)} views, but shifts were drawn for {len(self._shifts)}: call views() before"
            )
        batch, height, width = targets.shape[1:4]
        # Pixels a unit length across the view has at the object, as a share of half the picture.
        focal = torch.stack([cameras.Ks[:, 0, 0] / width, cameras.Ks[:, 1, 1] / height], 1)
        share = 2.0 * focal / torch.linalg.vector_norm(cameras.positions, dim=1, keepdim=True)
        affine = torch.eye(2, 3, device=targets.device).repeat(batch, 1, 1)
        affine[:, :, 2] = (self._shifts.to(share.device) * share).to(targets.device)
        grid = torch.nn.functional.affine_grid(affine, [batch, 1, height, width], align_corners=False)
        moved = [
            torch.nn.functional.grid_sample(
                target.permute(0, 3, 1, 2), grid, padding_mode="border", align_corners=False
            ).permute(0, 2, 3, 1)
            for target in targets
        ]
        return torch.stack(moved)


__all__ = ["ClosedFormScore"]
