"""Gaussians where they are needed: clone, split and prune while they are learned.

After Kerbl et al., "3D Gaussian Splatting" (2023), section 5: where shifting a Gaussian's picture would
change the loss much, it stands for more than it can show; a small one is doubled, a large one split.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch

from gdpro_sim.gaussians import rotation_matrices
from gdpro_sim.generation.config import SurfelConfig
from gdpro_sim.generation.optimizer import Adam

RESET_OPACITY = 0.01
"""What a reset leaves of every opacity at most (3D Gaussian Splatting's code)."""


class Densification:
    """When and where Gaussians are made and dropped, over leaves "means", "quats", "log_scales" and "logits".

    log_scales may be [N, 2] (surfels) or [N, 3]. Lengths are in the unit frame, whose extent is 1.
    """

    def __init__(self, config: SurfelConfig, count: int, device: torch.device) -> None:
        self.config = config
        self._sums = torch.zeros(count, device=device)
        self._seen = torch.zeros(count, device=device)

    def collects(self, iteration: int) -> bool:
        """Whether this iteration's gradients are wanted."""
        return iteration < self.config.densify_until

    @torch.no_grad()
    def collect(self, gradients: torch.Tensor, radii: torch.Tensor, width: int, height: int) -> None:
        """Take in one backward pass: gradients [C, N, 2] at projected centres and radii [C, N, 2], pixels."""
        half = gradients.new_tensor([0.5 * width, 0.5 * height])
        seen = (radii > 0).all(-1)
        self._sums += torch.where(seen, (gradients * half).norm(dim=-1), 0.0).sum(0)
        self._seen += seen.sum(0)

    def mean_gradients(self) -> torch.Tensor:
        """Mean length of the gradient over the views each Gaussian was seen in, NDC; [N]."""
        return self._sums / self._seen.clamp(min=1.0)

    @torch.no_grad()
    def update(self, adam: Adam, iteration: int, generator: torch.Generator) -> None:
        """After step `iteration` (counted from 1): whatever is due then.

        The order of the Gaussians that stay does not change; new ones come last.
        """
        c = self.config
        if c.densify_from < iteration <= c.densify_until and iteration % c.densify_every == 0:
            self._prune(adam)
            self._grow(adam, generator)
            self._restart(len(adam["means"]))
        if c.reset_every and iteration <= c.densify_until and iteration % c.reset_every == 0:
            adam["logits"].clamp_(max=float(torch.logit(torch.tensor(RESET_OPACITY))))
            adam.forget("logits")

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"sums": self._sums.clone(), "seen": self._seen.clone()}

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        self._sums = state["sums"].to(self._sums).clone()
        self._seen = state["seen"].to(self._seen).clone()

    def _restart(self, count: int) -> None:
        self._sums, self._seen = self._sums.new_zeros(count), self._seen.new_zeros(count)

    def _prune(self, adam: Adam) -> None:
        """Drop the transparent ones, the last one never."""
        opacities = adam["logits"].sigmoid()
        keep = opacities >= self.config.prune_opacity
        keep[opacities.argmax()] = True
        rows = torch.nonzero(keep)[:, 0]
        if len(rows) < len(keep):
            adam.regather(rows, torch.zeros(len(rows), dtype=torch.bool, device=rows.device))
            self._sums, self._seen = self._sums[rows], self._seen[rows]

    def _grow(self, adam: Adam, generator: torch.Generator) -> None:
        """Double small ones, split large ones; those with the largest gradients first, up to the cap."""
        c = self.config
        gradients = self.mean_gradients()
        count = len(gradients)
        order = torch.argsort(gradients, descending=True, stable=True)
        wanted = min(int((gradients > c.densify_gradient).sum()), max(c.maximum - count, 0))
        chosen = order[:wanted].sort().values
        if not wanted:
            return
        large = adam["log_scales"][chosen].amax(1) > torch.log(gradients.new_tensor(c.split_size))
        split = chosen[large]
        fresh = torch.zeros(count + wanted, dtype=torch.bool, device=chosen.device)
        fresh[split], fresh[count:] = True, True
        adam.regather(torch.cat([torch.arange(count, device=chosen.device), chosen]), fresh)
        # Of a split one both halves are new: drawn from it, and smaller.
        for rows in (split, count + torch.nonzero(large)[:, 0]):
            scales = adam["log_scales"][rows].exp()
            draws = torch.randn(scales.shape, generator=generator).to(scales)
            axes = rotation_matrices(adam["quats"][rows])[:, :, : scales.shape[1]]
            adam["means"][rows] += torch.einsum("nij,nj->ni", axes, scales * draws)
            adam["log_scales"][rows] -= torch.log(scales.new_tensor(c.split_factor))


__all__ = ["RESET_OPACITY", "Densification"]
