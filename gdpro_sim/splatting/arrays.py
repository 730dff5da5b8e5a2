"""Tensors as arguments of kernels."""

from __future__ import annotations

from typing import Any

import torch
import warp as wp


def array(tensor: torch.Tensor, dtype: type) -> Any:
    """The tensor's memory as a kernel argument; trailing axes become a vector or matrix where `dtype` is one.

    It keeps the tensor alive.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


__all__ = ["array"]
