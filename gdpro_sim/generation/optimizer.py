"""Adam over named tensors whose rows may come and go, with learning rates that fall while it runs."""

from __future__ import annotations

from collections.abc import Mapping

import torch

BETAS = (0.9, 0.999)
EPSILON = 1e-15
"""3D Gaussian Splatting's: gradients of a Gaussian that covers little are small, and count as much."""


class Adam:
    """Kingma and Ba, "Adam" (arXiv 1412.6980), algorithm 1, over leaf tensors by name.

    rates: learning rate of each name at the first and at the last step; it falls geometrically between

    The leaves are in `parameters`; `regather` puts new ones there.
    """

    def __init__(
        self, parameters: Mapping[str, torch.Tensor], rates: Mapping[str, tuple[float, float]]
    ) -> None:
        if set(parameters) != set(rates):
            raise ValueError(f"rates {sorted(rates)} must name the parameters {sorted(parameters)}")
        self.rates = dict(rates)
        self.steps = 0
        self.parameters: dict[str, torch.Tensor] = {}
        self._first: dict[str, torch.Tensor] = {}
        self._second: dict[str, torch.Tensor] = {}
        for name, value in parameters.items():
            self._take(name, value, torch.zeros_like(value), torch.zeros_like(value))

    def __getitem__(self, name: str) -> torch.Tensor:
        return self.parameters[name]

    @torch.no_grad()
    def step(self, share: float) -> None:
        """One step down the leaves' gradients, which are dropped; `share` of the run is done, in [0, 1].

        A leaf without a gradient stays, and so do its moments.
        """
        self.steps += 1
        for name, value in self.parameters.items():
            if value.grad is not None:
                value.add_(self.direction(name, value.grad, share))
                value.grad = None

    @torch.no_grad()
    def direction(self, name: str, gradient: torch.Tensor, share: float) -> torch.Tensor:
        """What to add to a leaf for its `gradient` at this step; updates its moments. See `step`."""
        a, b = BETAS
        first, second = self._first[name], self._second[name]
        first.mul_(a).add_(gradient, alpha=1.0 - a)
        second.mul_(b).addcmul_(gradient, gradient, value=1.0 - b)
        start, end = self.rates[name]
        rate = start * (end / start) ** share / (1.0 - a**self.steps)
        root = second.sqrt().mul_((1.0 - b**self.steps) ** -0.5).add_(EPSILON)
        return first.div(root).mul_(-rate)

    @torch.no_grad()
    def regather(self, rows: torch.Tensor, fresh: torch.Tensor) -> None:
        """Make row i of every leaf what row `rows[i]` was; where `fresh[i]`, its moments start from zero."""
        for name, value in self.parameters.items():
            first, second = self._first[name][rows], self._second[name][rows]
            first[fresh], second[fresh] = 0.0, 0.0
            self._take(name, value[rows], first, second)

    @torch.no_grad()
    def forget(self, name: str) -> None:
        """Set the moments of one leaf to zero."""
        self._first[name].zero_()
        self._second[name].zero_()

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Copies: the leaves as `NAME`, moments as `NAME.first` and `NAME.second`, and `steps`."""
        state = {"steps": torch.tensor(self.steps)}
        for name, value in self.parameters.items():
            state[name] = value.detach().clone()
            state[f"{name}.first"] = self._first[name].clone()
            state[f"{name}.second"] = self._second[name].clone()
        return state

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        """Raises KeyError where a leaf is missing, ValueError for one too many or of another shape."""
        surplus = set(state) - set(self.state_dict())
        if surplus:
            raise ValueError(f"unexpected: {', '.join(sorted(surplus))}")
        parts = {}
        for name, value in self.parameters.items():
            parts[name] = [state[f"{name}{suffix}"] for suffix in ("", ".first", ".second")]
            for part in parts[name]:
                if part.shape[1:] != value.shape[1:] or len(part) != len(parts[name][0]):
                    raise ValueError(f"{name} must be [rows, {value.shape[1:]}], got {list(part.shape)}")
        for name, saved in parts.items():
            self._take(name, *(part.to(self.parameters[name]).clone() for part in saved))
        self.steps = int(state["steps"])

    def _take(self, name: str, value: torch.Tensor, first: torch.Tensor, second: torch.Tensor) -> None:
        self.parameters[name] = value.detach().clone().contiguous().requires_grad_()
        self._first[name], self._second[name] = first, second


__all__ = ["BETAS", "EPSILON", "Adam"]
