"""Tensors as arguments of kernels."""

from __future__ import annotations

import functools
from typing import Any

import torch
import warp as wp

from gdpro_sim.device import DESCRIPTOR


def array(tensor: torch.Tensor, dtype: type) -> Any:
    """A tensor's memory as an argument of a kernel; vectors and matrices take its last axes.

    It keeps the tensor alive. The last axis must be dense. `wp.from_torch` does the same in three times the
    time.
    """
    scalar, inner, size = _elements(dtype)
    axes = tensor.ndim - len(inner)
    shape, strides = tuple(tensor.shape), tensor.stride()
    dense = tensor.is_contiguous() or (len(inner) < 2 and strides[-1:] == (1,))
    if tensor.dtype != scalar or shape[axes:] != inner or not dense:
        raise TypeError(f"no array of {dtype.__name__}: {shape} of {tensor.dtype}, strides {strides}")
    bytes_ = tuple(size * stride for stride in strides[:axes]) or (size,)
    described = DESCRIPTOR(tensor.data_ptr(), 0, max(axes, 1), shape[:axes] or (1,), bytes_)
    described._ref = tensor
    return described


@functools.cache
def _elements(dtype: type) -> tuple[torch.dtype, tuple[int, ...], int]:
    """Torch's type, inner shape and bytes of a scalar of a Warp type."""
    scalar = getattr(dtype, "_wp_scalar_type_", dtype)
    inner = tuple(getattr(dtype, "_shape_", ()))
    return wp.dtype_to_torch(scalar), inner, wp.types.type_size_in_bytes(scalar)


__all__ = ["array"]
