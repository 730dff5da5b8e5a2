"""Checks of what callers pass to the rasteriser: one clear line per mistake, naming the argument."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from gdpro_sim.errors import RequestError

INDEX_LIMIT = 2**31 - 1
"""Largest count a 32-bit index can address."""


def check_tensor(
    name: str, value: object, shape: Sequence[int | str], like: torch.Tensor | None = None
) -> torch.Tensor:
    """Return `value` as a contiguous float32 tensor of `shape`; strings in `shape` stand for any size.

    Raises ValueError where it is not one, lies on another device than `like`, or requires grad.
    """
    wanted = "[" + ", ".join(str(s) for s in shape) + "]"
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a float32 torch tensor {wanted}, got {type(value).__name__}")
    got = tuple(value.shape)
    fits = len(got) == len(shape) and all(
        isinstance(s, str) or s == g for s, g in zip(shape, got, strict=True)
    )
    if not fits:
        raise ValueError(f"{name} must have shape {wanted}, got {list(got)}")
    if value.dtype != torch.float32:
        raise ValueError(f"{name} must be torch.float32, got {value.dtype}; convert it with .float()")
    if like is not None and value.device != like.device:
        raise ValueError(f"{name} must be on the device of means, {like.device}, got {value.device}")
    if value.requires_grad:
        raise ValueError(
            f"{name} requires grad, but rasterization has no gradients yet; pass {name}.detach()"
        )
    return value.contiguous()


def check_number(name: str, value: object, minimum: float) -> float:
    """Return a real number >= `minimum`; infinity is allowed, NaN is not. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or value < minimum:
        raise ValueError(f"{name} must be a number >= {minimum:g}, got {value!r}")
    return float(value)


def check_size(name: str, value: object) -> int:
    """Return an image size in pixels >= 1. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise ValueError(f"{name} must be a whole number of pixels >= 1, got {value!r}")
    return value


def check_choice(name: str, value: object, choices: Sequence[str]) -> str:
    """Return one of `choices`. Raises ValueError."""
    if not isinstance(value, str) or value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}, got {value!r}")
    return value


def check_count(what: str, count: int, limit: int = INDEX_LIMIT) -> int:
    """Return `count`. Raises RequestError where it is past `limit`."""
    if count > limit:
        raise RequestError(
            f"{what} come to {count}, past the limit of {limit}: "
            "use fewer Gaussians, a smaller image or fewer cameras at a time"
        )
    return count


__all__ = ["INDEX_LIMIT", "check_choice", "check_count", "check_number", "check_size", "check_tensor"]
