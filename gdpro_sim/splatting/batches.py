"""Leading batch axes, as gsplat has them: scene after scene, results stacked."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Callable
from typing import Any, TypeVar, cast

import torch

Render = TypeVar("Render", bound=Callable[..., tuple[Any, ...]])

BATCHED = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
"""Arguments that have the batch axes."""


def batched(render: Render) -> Render:
    """Let a rasteriser take `means` [..., N, 3] and all other tensors with the same leading axes.

    Every image it returns has them too. In the last result, `meta`, tensors of one shape are stacked, and
    `meta["batches"]` lists what each scene gave: gradients at `means2d` are found there.
    """
    signature = inspect.signature(render)

    @functools.wraps(render)
    def with_batches(*args: Any, **kwargs: Any) -> tuple[Any, ...]:
        means = args[0] if args else kwargs.get("means")
        if not isinstance(means, torch.Tensor) or means.ndim <= 2:
            return render(*args, **kwargs)
        bound = signature.bind(*args, **kwargs)
        axes = means.shape[:-2]
        if math.prod(axes) == 0:
            raise ValueError(f"means must hold at least one scene, got shape {list(means.shape)}")
        flat = {}
        for name in BATCHED:
            value = bound.arguments.get(name)
            if value is None:
                continue
            if not isinstance(value, torch.Tensor) or value.shape[: len(axes)] != axes:
                got = list(value.shape) if isinstance(value, torch.Tensor) else type(value).__name__
                raise ValueError(f"{name} must begin with the batch axes of means, {list(axes)}, got {got}")
            flat[name] = value.reshape(math.prod(axes), *value.shape[len(axes) :])
        results = []
        for i in range(math.prod(axes)):
            call = {**bound.arguments, **{name: value[i] for name, value in flat.items()}}
            extra = call.pop(_extra(signature), {})
            results.append(render(**call, **extra))
        images = [
            None if parts[0] is None else torch.stack(list(parts)).reshape(*axes, *parts[0].shape)
            for parts in zip(*(result[:-1] for result in results), strict=True)
        ]
        return (*images, _stack([result[-1] for result in results], axes))

    return cast(Render, with_batches)


def _extra(signature: inspect.Signature) -> str:
    """The name of the ** parameter."""
    kinds = {p.kind: name for name, p in signature.parameters.items()}
    return kinds.get(inspect.Parameter.VAR_KEYWORD, "")


def _stack(metas: list[dict[str, Any]], axes: torch.Size) -> dict[str, Any]:
    stacked: dict[str, Any] = {"batches": metas}
    for name, first in metas[0].items():
        if isinstance(first, int | float):
            stacked[name] = first
        if isinstance(first, torch.Tensor) and all(meta[name].shape == first.shape for meta in metas):
            stacked[name] = torch.stack([meta[name] for meta in metas]).reshape(*axes, *first.shape)
    return stacked


__all__ = ["batched"]
