"""What terms that are forces, not contact, have in common."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import launch_chunked
from gdpro_sim.simulation.fem.rest import RestShapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model


class ForceTerm:
    """A smooth `gdpro_sim.simulation.fem.term.Term` on the vertices `ids` [n] of a model.

    Nothing stands in the way of a step, nothing changes from step to step, nothing is lagged.
    """

    energies = 0
    frequency = 0.0

    def __init__(self, model: Model, ids: np.ndarray) -> None:
        self.device = model.device
        self.count = len(ids)
        self.vertices = integers(ids, model.device)

    def begin(self, step: Step) -> None:
        """Nothing depends on the step."""

    def lag(self, x: wp.array) -> None:
        """Nothing is held fixed for a while."""

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        """No energy."""

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        return None

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        return 1.0

    def finish(self, x: wp.array) -> None:
        """Nothing is carried along."""

    def stored(self, x: wp.array) -> float:
        return 0.0

    def state(self) -> dict[str, wp.array]:
        return {}

    def report(self, x: wp.array) -> dict[str, float]:
        """Not a contact."""
        return {}

    def launch(self, kernel: wp.Kernel, count: int, inputs: list[Any], outputs: list[Any]) -> None:
        launch_chunked(kernel, count, inputs, outputs, device=self.device)


def share_of_step(step: Step, start: float, end: float) -> float:
    """Which part of a step a load acts that acts from `start` to `end` s; whether, where no time passes."""
    if step.end <= step.start:
        return float(start <= step.end <= end)
    overlap = min(end, step.end) - max(start, step.start)
    return min(1.0, max(0.0, overlap / (step.end - step.start)))


def stable_frequency(stiffness: np.ndarray, damping: np.ndarray, free: np.ndarray, rest: RestShapes) -> float:
    """rad/s for explicit steps, from what holds and damps each vertex: [P] N/m and N s/m.

    2 / it is stable for symplectic Euler where both act: W^2 = g W + w^2 by the criterion of Jury. Terms are
    combined as roots of sums of squares, which a fifth more damping makes up for.
    """
    chosen = free & (rest.mass > 0.0)
    g = 1.2 * damping[chosen] / rest.mass[chosen]
    squared = stiffness[chosen] / rest.mass[chosen]
    return float((0.5 * (g + np.sqrt(g * g + 4.0 * squared))).max(initial=0.0))


def ever_free(model: Model) -> np.ndarray:
    """[P] bool: vertices that are not pinned, or not for ever."""
    if model.release is None:
        return ~model.pinned
    return ~model.pinned | np.isfinite(model.release)


def integers(values: np.ndarray, device: str) -> wp.array:
    """int32 on the device."""
    return wp.array(np.ascontiguousarray(values, dtype=np.int32), dtype=wp.int32, device=device)


def vectors(values: np.ndarray, device: str) -> wp.array:
    """vec3d on the device."""
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=wp.vec3d, device=device)


def grouped(owners: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Items by owner, each group ascending: (offsets [count + 1], items [n])."""
    offsets = np.concatenate([[0], np.cumsum(np.bincount(owners, minlength=count))])
    return offsets, np.argsort(owners, kind="stable")


__all__ = [
    "ForceTerm",
    "ever_free",
    "grouped",
    "integers",
    "share_of_step",
    "stable_frequency",
    "vectors",
]
