"""What a part of the incremental potential beside inertia and elements does: contact, springs, pressure."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import warp as wp


@dataclass(frozen=True)
class Step:
    """One implicit solve, as its terms see it.

    time:  s, at which forces act: the end of the step (of its half, for the implicit midpoint rule)
    h:     s, the step of E: velocities of an iterate are (x - base) / h. inf where there is no inertia
    x, v:  [P] vec3d state at the start of the step, m and m/s
    base:  [P] vec3d m
    held:  [P] vec3d m, where fixed vertices are to be at `time`; a term that moves them writes here
    start, end: s, the whole step that this solve belongs to; equal where there is no inertia
    """

    time: float
    h: float
    x: wp.array
    v: wp.array
    base: wp.array
    held: wp.array
    start: float = 0.0
    end: float = 0.0


class Term(Protocol):
    """Terms keep their own device arrays, sized once. Sums are in an order of the problem's own.

    energies:  how many values `energy` writes
    frequency: rad/s, at least the largest that the term alone gives any free vertex; for explicit steps
    """

    energies: int
    frequency: float

    def begin(self, step: Step) -> None:
        """A solve starts; called before anything else of it."""

    def lag(self, x: wp.array) -> None:
        """Take from x what is held fixed for a while: friction limits, contact candidates.

        Called at the start and before the first Newton iterations of a solve; the energy may jump.
        """

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        """Write energies in J to energies[first : first + self.energies]; inf where x is not admissible."""

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        """Add to gradient [P] vec3d, N, and to the diagonal blocks [P] mat33d, N/m.

        Returns the off-diagonal blocks, a symmetric scipy.sparse.bsr_matrix of 3x3 blocks over all vertices
        with nothing on the diagonal, or None where no two vertices are coupled. The whole contribution to
        the Hessian must be positive semidefinite.
        """

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        """Share in [0, 1] of `direction` [P] vec3d m that x can go without passing through anything."""

    def finish(self, x: wp.array) -> None:
        """x [P] was accepted as the solution of the step that began last."""

    def stored(self, x: wp.array) -> float:
        """Energy held at x between steps, J: what comes back when the term lets go."""

    def state(self) -> dict[str, wp.array]:
        """Arrays that change from step to step; saved with the solver's state and restored in place."""

    def report(self, x: wp.array) -> dict[str, float]:
        """Figures for `Diagnostics`: contacts (count), penetration (m, largest).

        While anything is in contact the midpoint rule gives way to backward Euler.
        """


def hosted(array: wp.array) -> np.ndarray:
    """The array's values on the host; on the CPU the memory itself."""
    values: np.ndarray = array.numpy()
    return values


__all__ = ["Step", "Term", "hosted"]
