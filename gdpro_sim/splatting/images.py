"""Checks of images that losses and image operations are given."""

from __future__ import annotations

from collections.abc import Sequence

import torch


def check_images(
    name: str, value: object, axes: int | None = None, channels: int | None = None
) -> torch.Tensor:
    """Return `value`, floating-point images [..., H, W, D] with H, W, D >= 1. Raises ValueError.

    axes:     how many axes there must be, at least three where None
    channels: what D must be
    """
    wanted = {None: "[..., H, W, ", 3: "[H, W, ", 4: "[C, H, W, "}[axes] + f"{channels or 'D'}]"
    if not isinstance(value, torch.Tensor):
        raise ValueError(f"{name} must be a torch tensor {wanted}, got {type(value).__name__}")
    shape = list(value.shape)
    if (len(shape) < 3 if axes is None else len(shape) != axes) or 0 in shape[-3:]:
        raise ValueError(f"{name} must have shape {wanted}, no axis of an image empty, got {shape}")
    if channels is not None and shape[-1] != channels:
        raise ValueError(f"{name} must have shape {wanted}, got {shape}")
    if not value.is_floating_point():
        raise ValueError(f"{name} must hold floating-point values, got {value.dtype}")
    return value


def check_alike(names: Sequence[str], *images: torch.Tensor) -> None:
    """Raise ValueError unless all images have the shape, dtype and device of the first."""
    first = images[0]
    for name, image in zip(names[1:], images[1:], strict=True):
        if not isinstance(image, torch.Tensor):
            raise ValueError(f"{name} must be a torch tensor, got {type(image).__name__}")
        if image.shape != first.shape:
            raise ValueError(
                f"{name} must have the shape of {names[0]}, {list(first.shape)}, got {list(image.shape)}"
            )
        if image.dtype != first.dtype or image.device != first.device:
            raise ValueError(
                f"{name} must be {first.dtype} on {first.device} as {names[0]} is, "
                f"got {image.dtype} on {image.device}"
            )


__all__ = ["check_alike", "check_images"]
