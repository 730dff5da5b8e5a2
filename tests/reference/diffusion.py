"""Readable float64 oracle of score distillation and of ideal denoisers; NumPy, one array at a time."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

Denoiser = Callable[[np.ndarray, int], np.ndarray]
"""Predicted noise of x at step t."""


def schedule(steps: int = 1000, first: float = 0.00085, last: float = 0.012) -> np.ndarray:
    """alpha_bar of betas that are evenly spaced in their square roots."""
    alphas, product = [], 1.0
    for i in range(steps):
        root = math.sqrt(first) + (math.sqrt(last) - math.sqrt(first)) * i / (steps - 1)
        product *= 1.0 - root * root
        alphas.append(product)
    return np.array(alphas)


def signal(alphas: np.ndarray, t: int) -> float:
    return math.sqrt(alphas[t])


def sigma(alphas: np.ndarray, t: int) -> float:
    return math.sqrt(1.0 - alphas[t])


def noised(alphas: np.ndarray, x0: np.ndarray, noise: np.ndarray, t: int) -> np.ndarray:
    return signal(alphas, t) * x0 + sigma(alphas, t) * noise


def ddim(alphas: np.ndarray, x: np.ndarray, noise: np.ndarray, t: int, to: int) -> np.ndarray:
    clean = (x - sigma(alphas, t) * noise) / signal(alphas, t)
    return noised(alphas, clean, noise, to)


def invert(
    alphas: np.ndarray, x0: np.ndarray, noise: np.ndarray, s: int, stride: int, empty: Denoiser
) -> np.ndarray:
    """x_s: start at step 1, walk upward in strides, cut the last one."""
    at, x = 1, noised(alphas, x0, noise, 1)
    while True:
        to = min((at // stride + 1) * stride, s)
        x = ddim(alphas, x, empty(x, at), at, to)
        at = to
        if at == s:
            return x


def ism(
    alphas: np.ndarray,
    x0: np.ndarray,
    noise: np.ndarray,
    t: int,
    s: int,
    stride: int,
    scale: float,
    empty: Denoiser,
    negative: Denoiser,
    prompt: Denoiser,
) -> np.ndarray:
    """The gradient of interval score matching before the factor 0.1."""
    x_s = invert(alphas, x0, noise, s, stride, empty)
    e_s = empty(x_s, s)
    x_t = ddim(alphas, x_s, e_s, s, t)
    e_t = negative(x_t, t) + scale * (prompt(x_t, t) - negative(x_t, t))
    return sigma(alphas, t) / signal(alphas, t) * (e_t - e_s)


def sds(
    alphas: np.ndarray,
    x0: np.ndarray,
    noise: np.ndarray,
    t: int,
    scale: float,
    negative: Denoiser,
    prompt: Denoiser,
) -> np.ndarray:
    """The gradient of score distillation sampling under the same weight."""
    x_t = noised(alphas, x0, noise, t)
    e_t = negative(x_t, t) + scale * (prompt(x_t, t) - negative(x_t, t))
    return sigma(alphas, t) / signal(alphas, t) * (e_t - noise)


def flat(x: np.ndarray, t: int) -> np.ndarray:
    """Every picture is equally likely."""
    return np.zeros_like(x)


def gaussian(alphas: np.ndarray, mean: np.ndarray, width: float) -> Denoiser:
    """Pictures are N(mean, width^2); width 0: a point mass."""

    def predict(x: np.ndarray, t: int) -> np.ndarray:
        spread = alphas[t] * width**2 + 1.0 - alphas[t]
        return sigma(alphas, t) * (x - signal(alphas, t) * mean) / spread

    return predict


def mixture(alphas: np.ndarray, means: np.ndarray, width: float) -> Denoiser:
    """Pictures are an even mixture of N(means[k], width^2); x and means[k] are one picture."""

    def predict(x: np.ndarray, t: int) -> np.ndarray:
        spread = alphas[t] * width**2 + 1.0 - alphas[t]
        logs = np.array([-np.sum((x - signal(alphas, t) * m) ** 2) / (2.0 * spread) for m in means])
        weights = np.exp(logs - logs.max())
        weights /= weights.sum()
        clean = np.zeros_like(x)
        for weight, mean in zip(weights, means, strict=True):
            pulled = signal(alphas, t) * width**2 * x + (1.0 - alphas[t]) * mean
            clean += weight * pulled / spread
        return (x - signal(alphas, t) * clean) / sigma(alphas, t)

    return predict
