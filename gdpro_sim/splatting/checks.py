"""Checks of what callers pass to the rasteriser: one clear line per mistake, naming the argument."""

from __future__ import annotations

import math
import operator
from collections.abc import Sequence
from typing import SupportsIndex

import torch

from gdpro_sim.errors import RequestError

INDEX_LIMIT = 2**31 - 1
"""Largest count a 32-bit index can address."""


def check_tensor(
    name: str, value: object, shape: Sequence[int | str], like: torch.Tensor | None = None
) -> torch.Tensor:
    """Return `value` as a contiguous float32 tensor of `shape`; strings in `shape` stand for any size.

    Raises ValueError where it is not one or lies on another device than `like`.
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
    return value.contiguous()


def check_number(name: str, value: object, minimum: float) -> float:
    """Return a real number >= `minimum`; infinity is allowed, NaN is not. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value) or value < minimum:
        raise ValueError(f"{name} must be a number >= {minimum:g}, got {value!r}")
    return float(value)


def check_size(name: str, value: object) -> int:
    """Return an image size in pixels >= 1. Raises ValueError."""
    if isinstance(value, bool) or not isinstance(value, SupportsIndex) or operator.index(value) < 1:
        raise ValueError(f"{name} must be a whole number of pixels >= 1, got {value!r}")
    return operator.index(value)


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


def check_colors(
    colors: object, sh_degree: int | None, cameras: int, count: int, means: torch.Tensor
) -> torch.Tensor:
    """Return `colors` for C cameras and N Gaussians: [N, K, 3] where `sh_degree` is given, else [(C,) N, D].

    Raises ValueError.
    """
    if sh_degree is None:
        if isinstance(colors, torch.Tensor) and colors.ndim == 3:
            colors = check_tensor("colors", colors, (cameras, count, "D"), means)
        else:
            colors = check_tensor("colors", colors, (count, "D"), means)
        if colors.shape[-1] < 1:
            raise ValueError(f"colors must have at least one channel, got shape {list(colors.shape)}")
        return colors
    if isinstance(sh_degree, bool) or not isinstance(sh_degree, int) or not 0 <= sh_degree <= 3:
        raise ValueError(f"sh_degree must be 0, 1, 2, 3 or None, got {sh_degree!r}")
    colors = check_tensor("colors", colors, (count, "K", 3), means)
    if colors.shape[1] < (sh_degree + 1) ** 2:
        raise ValueError(
            f"colors must hold at least {(sh_degree + 1) ** 2} coefficients for sh_degree {sh_degree}, "
            f"got shape {list(colors.shape)}"
        )
    return colors


GSPLAT_ARGUMENTS: dict[str, tuple[object, ...]] = {
    "packed": (False,),
    "tile_size": (16,),
    "sparse_grad": (False,),
    "distributed": (False,),
    "camera_model": ("pinhole",),
    "segmented": (False,),
    "covars": (None,),
    "with_ut": (False,),
    "with_eval3d": (False,),
    "radial_coeffs": (None,),
    "tangential_coeffs": (None,),
    "thin_prism_coeffs": (None,),
    "ftheta_coeffs": (None,),
    "viewmats_rs": (None,),
}
"""gsplat's arguments that have one meaning here, and the values that ask for it."""


def check_gsplat_arguments(function: str, arguments: dict[str, object]) -> None:
    """Accept gsplat's other arguments where they ask for what is done anyway.

    Raises ValueError where they ask for something else, TypeError where gsplat has no such argument.
    """
    for name, value in arguments.items():
        if name == "channel_chunk":  # how many channels at once changes no result
            continue
        if name == "rolling_shutter" and getattr(value, "name", value) == "GLOBAL":
            continue
        if name not in GSPLAT_ARGUMENTS:
            raise TypeError(f"{function} got an unexpected argument {name!r}")
        if not any(type(value) is type(allowed) and value == allowed for allowed in GSPLAT_ARGUMENTS[name]):
            allowed = " or ".join(repr(a) for a in GSPLAT_ARGUMENTS[name])
            raise ValueError(f"{name} must be {allowed}, the only choice here, got {value!r}")


__all__ = [
    "INDEX_LIMIT",
    "check_choice",
    "check_colors",
    "check_count",
    "check_gsplat_arguments",
    "check_number",
    "check_size",
    "check_tensor",
]
