"""Memory for large CPU tensors that is used again once every tensor on it is gone.

The operating system hands out new memory page by page and clears each: for images and gradients that come and
go at every step that costs as much as computing them. CUDA tensors come from torch, which keeps its own.
"""

from __future__ import annotations

import math
import threading
import weakref
from collections.abc import Sequence

import numpy as np
import torch

SMALLEST = 1 << 18
"""Tensors of fewer bytes come from torch."""

LARGEST_SUM = 1 << 29
"""Bytes kept free at most."""

ALIGNMENT = 64

_lock = threading.RLock()  # memory may come back inside, when garbage is collected
_free: list[np.ndarray] = []
_free_bytes = 0


def empty(shape: Sequence[int], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """A tensor of `shape` with any content, as `torch.empty`."""
    size = math.prod(shape) * dtype.itemsize
    if device.type != "cpu" or size < SMALLEST:
        return torch.empty(tuple(shape), dtype=dtype, device=device)
    block = _take(size)
    start = -block.ctypes.data % ALIGNMENT
    # Torch keeps this view alive for as long as any tensor shares its memory.
    view = block[start : start + size]
    weakref.finalize(view, _give_back, block).atexit = False
    return torch.from_numpy(view).view(dtype).view(tuple(shape))


def empty_like(tensor: torch.Tensor) -> torch.Tensor:
    """A contiguous tensor of the shape, type and device of another, with any content."""
    return empty(tensor.shape, tensor.dtype, tensor.device)


def _take(size: int) -> np.ndarray:
    global _free_bytes
    # A few sizes for each power of two, so that nearby sizes share memory.
    step = 1 << max(size.bit_length() - 4, 12)
    rounded = -(-size // step) * step + ALIGNMENT
    with _lock:
        for i in range(len(_free) - 1, -1, -1):
            if _free[i].nbytes == rounded:
                _free_bytes -= rounded
                return _free.pop(i)
    return np.empty(rounded, dtype=np.uint8)


def _give_back(block: np.ndarray) -> None:
    global _free_bytes
    with _lock:
        if block.nbytes > LARGEST_SUM:
            return
        _free.append(block)
        _free_bytes += block.nbytes
        while _free_bytes > LARGEST_SUM:  # the one unused for longest goes first
            _free_bytes -= _free.pop(0).nbytes


def free_bytes() -> int:
    """Bytes kept for later."""
    return _free_bytes


def clear() -> None:
    """Hand all memory that is kept for later back to the operating system."""
    global _free_bytes
    with _lock:
        _free.clear()
        _free_bytes = 0


__all__ = ["clear", "empty", "empty_like", "free_bytes"]
