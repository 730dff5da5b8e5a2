"""A diffusion model's noise schedule, and the elementwise arithmetic of score distillation.

Everything works on contiguous tensors where they lie, by the kernels of `gdpro_sim.kernels.diffusion` on
their own memory; half-precision inputs are cast to float32 on their device first. Nothing has a gradient.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import warp as wp

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.kernels import diffusion as kernels
from gdpro_sim.splatting.arrays import array

STEPS = 1000
"""Steps of the noise schedule."""

SPAN = 4096
"""Numbers that an index of a kernel covers on a CPU."""

SPANS = 16
"""Fewest spans worth a thread of their own on a CPU."""


def scaled_linear_schedule(first: float = 0.00085, last: float = 0.012) -> torch.Tensor:
    """alpha_bar [1000] float32, falling, of betas whose square roots are evenly spaced.

    Source: the schedule of Stable Diffusion (Rombach et al. 2022), with its first and last beta.
    """
    betas = torch.linspace(math.sqrt(first), math.sqrt(last), STEPS, dtype=torch.float64).square()
    return torch.cumprod(1.0 - betas, 0).float()


class Schedule:
    """Signal sqrt(alpha_bar) and sigma sqrt(1 - alpha_bar) by step, from alphas_cumprod [1000] in (0, 1)."""

    def __init__(self, alphas_cumprod: torch.Tensor) -> None:
        if alphas_cumprod.shape != (STEPS,):
            raise ValueError(f"alphas_cumprod must be [{STEPS}], got {list(alphas_cumprod.shape)}")
        self._alphas = alphas_cumprod.detach().double().cpu().tolist()
        if not (0.0 < min(self._alphas) and max(self._alphas) < 1.0):
            raise ValueError(
                f"alphas_cumprod must lie between 0 and 1, got {min(self._alphas)!r} to {max(self._alphas)!r}"
            )

    def signal(self, t: int) -> float:
        return math.sqrt(self._alphas[t])

    def sigma(self, t: int) -> float:
        return math.sqrt(1.0 - self._alphas[t])

    def weight(self, t: int) -> float:
        """sigma / signal, the factor from a difference of noises to one of clean pictures."""
        return self.sigma(t) / self.signal(t)


def combine(x: torch.Tensor, a: float, y: torch.Tensor, b: float) -> torch.Tensor:
    """a x + b y; x and y of one shape and device. Raises ValueError."""
    x, y = _numbers(x=x, y=y)
    return _launch(kernels.combine, [_flat(x), a, _flat(y), b], torch.empty_like(x))


def add_noise(x0: torch.Tensor, noise: torch.Tensor, t: int, schedule: Schedule) -> torch.Tensor:
    """x_t = signal x_0 + sigma noise (Ho et al. 2020, eq. 4)."""
    return combine(x0, schedule.signal(t), noise, schedule.sigma(t))


def ddim_move(x: torch.Tensor, noise: torch.Tensor, t: int, to: int, schedule: Schedule) -> torch.Tensor:
    """x at step `to`, above or below t, given the noise predicted in x at step t; deterministic DDIM.

    Source: Song et al., "Denoising Diffusion Implicit Models" (2021), eq. 12 with sigma_t = 0.
    """
    x, noise = _numbers(x=x, noise=noise)
    factors = [schedule.signal(t), schedule.sigma(t), schedule.signal(to), schedule.sigma(to)]
    return _launch(kernels.ddim_move, [_flat(x), _flat(noise), *factors], torch.empty_like(x))


def guidance_mix(negative: torch.Tensor, positive: torch.Tensor, scale: float) -> torch.Tensor:
    """e_neg + scale (e_pos - e_neg), of two predictions; scale 0 is the negative, 1 the positive."""
    negative, positive = _numbers(negative=negative, positive=positive)
    return _launch(
        kernels.guidance_mix, [_flat(negative), _flat(positive), scale], torch.empty_like(negative)
    )


def weighted_residual(
    minuend: torch.Tensor, subtrahend: torch.Tensor, weight: float
) -> tuple[torch.Tensor, int]:
    """weight (minuend - subtrahend) with zeros where that is not finite, and how many numbers were not."""
    minuend, subtrahend = _numbers(minuend=minuend, subtrahend=subtrahend)
    out = torch.empty_like(minuend)
    invalid = torch.empty(_spans(out)[1], dtype=torch.int32, device=out.device)
    inputs = [_flat(minuend), _flat(subtrahend), weight]
    _launch(kernels.weighted_residual, inputs, out, array(invalid, wp.int32))
    return out, int(invalid.sum())


def _flat(tensor: torch.Tensor) -> Any:
    return array(tensor.view(-1), wp.float32)


def _spans(out: torch.Tensor) -> tuple[int, int]:
    """Numbers in a span on the tensor's device, and how many spans there are."""
    span = SPAN if out.device.type == "cpu" else 1
    return span, -(-out.numel() // span)


def _launch(kernel: wp.Kernel, inputs: list[Any], out: torch.Tensor, *others: Any) -> torch.Tensor:
    span, count = _spans(out)
    with beside_torch(out):
        outputs = [_flat(out), *others]
        launch_chunked(kernel, count, [span, *inputs], outputs, device=device_name(out), minimum=SPANS)
    return out


def _numbers(**tensors: torch.Tensor) -> list[torch.Tensor]:
    """The tensors in contiguous float32, which they usually are. Raises ValueError where they differ."""
    (first_name, first), *others = tensors.items()
    for name, tensor in others:
        if tensor.shape != first.shape or tensor.device != first.device:
            raise ValueError(
                f"{name} must have shape {list(first.shape)} on {first.device} as {first_name}, "
                f"got {list(tensor.shape)} on {tensor.device}"
            )
    return [tensor.detach().float().contiguous() for tensor in tensors.values()]


__all__ = [
    "STEPS",
    "Schedule",
    "add_noise",
    "combine",
    "ddim_move",
    "guidance_mix",
    "scaled_linear_schedule",
    "weighted_residual",
]
