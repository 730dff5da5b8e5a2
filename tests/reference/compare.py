"""Gradients of a rasteriser and of its reference, compared through a random linear functional of outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

KINK = 2e-4
"""Pixels nearer than this to a decision or a jump of the gradient have no weight."""

Outputs = dict[str, Tensor]
Gradients = dict[str, Tensor]


def in_mode(mode: str, image: Tensor, depth: Tensor, alpha: Tensor) -> Tensor:
    """Channels of a render mode from image [C, H, W, D], accumulated depth and alpha [C, H, W]."""
    if mode.endswith("ED"):
        depth = depth / alpha.clamp(min=1e-10)
    parts = [image] if mode.startswith("RGB") else []
    return torch.cat([*parts, depth[..., None]] if mode != "RGB" else parts, -1)


def covered(mode: str, kink: Tensor, alpha: Tensor) -> Tensor:
    """`kink`, also zero in modes with expected depth where 0 < alpha < 0.1: 1 - T has few digits there."""
    few = (alpha > 0) & (alpha < 0.1) & mode.endswith("ED")
    return torch.where(few, 0.0, kink)


def functional(shapes: Outputs, kink: Tensor, seed: int = 0, least: float = 0.8) -> Outputs:
    """Weights for outputs [C, H, W, ...]: normal numbers that float32 holds, zero at pixels near a kink."""
    g = torch.Generator().manual_seed(seed)
    smooth = kink > KINK
    assert smooth.float().mean() >= least
    return {
        name: torch.randn(output.shape, generator=g) * smooth.view(*smooth.shape, *[1] * (output.ndim - 3))
        for name, output in shapes.items()
    }


def apply(weights: Outputs, outputs: Outputs) -> Tensor:
    return sum((weights[name].to(outputs[name].dtype) * outputs[name]).sum() for name in weights)  # type: ignore


def leaves(tensors: Mapping[str, Tensor], dtype: torch.dtype) -> dict[str, Tensor]:
    return {name: tensor.detach().to(dtype).clone().requires_grad_() for name, tensor in tensors.items()}


def gradients(loss: Tensor, inputs: Mapping[str, Tensor]) -> Gradients:
    """Gradients to all inputs, zeros where one is not used."""
    found = torch.autograd.grad(loss, list(inputs.values()), allow_unused=True, retain_graph=True)
    return {
        name: torch.zeros_like(tensor) if gradient is None else gradient
        for (name, tensor), gradient in zip(inputs.items(), found, strict=True)
    }


def errors(got: Gradients, expected: Gradients) -> dict[str, float]:
    """The larger of |got - expected| / |expected| and max|got - expected| / max|expected|, for each input.

    A gradient that is nothing but rounding beside the largest of the others counts as zero.
    """
    largest = max(reference.norm().item() for reference in expected.values())
    found = {}
    for name, reference in expected.items():
        difference = got[name].double() - reference
        assert torch.isfinite(difference).all(), name
        if difference.numel() == 0 or reference.norm() <= 1e-10 * largest:
            found[name] = difference.norm().item() / largest if largest else difference.norm().item()
        else:
            found[name] = max(
                (difference.norm() / reference.norm()).item(),
                (difference.abs().max() / reference.abs().max()).item(),
            )
    return found


def compare(
    inputs: Mapping[str, Tensor],
    product: Callable[[Mapping[str, Tensor]], Outputs],
    reference: Callable[[Mapping[str, Tensor]], tuple[Outputs, Tensor]],
    seed: int = 0,
    least: float = 0.8,
) -> dict[str, float]:
    """Errors of the product's float32 gradients; `reference` returns outputs and the kink image [C, H, W]."""
    singles, doubles = leaves(inputs, torch.float32), leaves(inputs, torch.float64)
    expected, kink = reference(doubles)
    got = product(singles)
    assert {k: v.shape for k, v in got.items()} == {k: v.shape for k, v in expected.items()}
    weights = functional(expected, kink, seed, least)
    return errors(gradients(apply(weights, got), singles), gradients(apply(weights, expected), doubles))


__all__ = ["KINK", "apply", "compare", "covered", "errors", "functional", "gradients", "in_mode", "leaves"]
