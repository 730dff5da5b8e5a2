"""Fixed points of maps that are known only by their values."""

from __future__ import annotations

import numpy as np


class QuasiNewton:
    """Broyden's method from the plain fixed-point iteration on: each secant corrects the inverse Jacobian.

    Source: Broyden 1965, "A class of methods for solving nonlinear simultaneous equations", Mathematics of
    Computation 19, his first method in its inverse form.
    """

    def __init__(self, size: int) -> None:
        self._inverse = np.eye(size)  # of minus the residual's Jacobian
        self._last: tuple[np.ndarray, np.ndarray] | None = None

    def next(self, guess: np.ndarray, found: np.ndarray) -> np.ndarray:
        """Where to look next, [n]: the map takes `guess` [n] to `found` [n]."""
        residual = found - guess
        if self._last is not None:
            moved, less = guess - self._last[0], self._last[1] - residual
            expected = self._inverse @ less
            weight = float(moved @ expected)
            if abs(weight) > 1e-12 * float(moved @ moved):
                self._inverse += np.outer(moved - expected, moved @ self._inverse) / weight
        self._last = (guess, residual)
        result: np.ndarray = guess + self._inverse @ residual
        return result


__all__ = ["QuasiNewton"]
