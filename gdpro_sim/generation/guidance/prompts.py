"""Prompts that depend on where the camera is: their texts, their mixture, and Perp-Neg's weights.

A model that reads "front view" and "back view" draws the same face less often on every side. Azimuth 0 looks
at the front (+X), +-pi at the back.
"""

from __future__ import annotations

import math

import torch

VIEWS = ("front", "side", "back")

REPULSION = -2.0
"""Perp-Neg's largest weight of a view that the camera does not have (stable-dreamfusion's default)."""

FRONT_DECAY, SIDE_DECAY = 2.0, 10.0
"""How fast that weight falls as the camera turns to the view (stable-dreamfusion's defaults)."""

NEAR = 0.8
"""From this share of a view on it is not repelled any more."""


def view_texts(prompt: str) -> list[str]:
    """The prompt for each of `VIEWS`."""
    return [f"{prompt}, {view} view" for view in VIEWS]


def view_weights(azimuths: torch.Tensor) -> torch.Tensor:
    """Shares [B, 3] of `VIEWS`, linear in |azimuth| (rad) from front over side (pi / 2) to back (pi)."""
    turn = azimuths.abs().clamp(max=math.pi) / (0.5 * math.pi)
    front, back = (1.0 - turn).clamp(min=0.0), (turn - 1.0).clamp(min=0.0)
    return torch.stack([front, 1.0 - front - back, back], dim=-1)


def repulsion_weights(azimuths: torch.Tensor) -> torch.Tensor:
    """Perp-Neg's weights [B, 2], <= 0, of the front and side prompts as things that must not be seen.

    Seen from behind the front is repelled in full; nothing is where the camera faces it. Continuous but for
    the cut at `NEAR`.

    Source: Armandpour et al., "Re-imagine the Negative Prompt Algorithm" (arXiv 2304.04968), section 4, with
    exponential decays exp(-b share).
    """
    front, side, _ = view_weights(azimuths).unbind(-1)
    behind = azimuths.abs() > 0.5 * math.pi
    of_front = torch.where(front > NEAR, 0.0, REPULSION * torch.exp(-FRONT_DECAY * front))
    of_side = torch.where(side > NEAR, 0.0, REPULSION * torch.exp(-SIDE_DECAY * side))
    return torch.stack([of_front, torch.where(behind, 0.5 * of_side, of_side)], dim=-1)


def perpendicular(vectors: torch.Tensor, direction: torch.Tensor) -> torch.Tensor:
    """What of vectors [K, B, ...] is at right angles to direction [B, ...], each of B on its own."""
    axes = list(range(1, direction.ndim))
    along = (vectors * direction).sum([axis + 1 for axis in axes], keepdim=True)
    square = direction.square().sum(axes, keepdim=True).clamp(min=1e-30)
    return vectors - along / square * direction


def perp_neg(
    negative: torch.Tensor, prompt: torch.Tensor, repelled: torch.Tensor, weights: torch.Tensor
) -> torch.Tensor:
    """The prediction that takes the prompt's place in classifier-free guidance, [B, ...].

    With d = e_prompt - e_neg and d_k = e_k - e_neg it is e_prompt + sum_k w_k (d_k - its part along d).

    negative, prompt: [B, ...] predicted noise; repelled: [K, B, ...]; weights: [B, K], <= 0
    """
    across = perpendicular(repelled - negative, prompt - negative)
    shape = (*weights.T.shape, *[1] * (negative.ndim - 1))
    return prompt + (weights.T.reshape(shape).to(across) * across).sum(0)


__all__ = ["VIEWS", "perp_neg", "perpendicular", "repulsion_weights", "view_texts", "view_weights"]
