"""Conjugate gradients preconditioned by a symmetric block Gauss-Seidel sweep, as textbooks have them."""

from __future__ import annotations

import numpy as np


def gauss_seidel_cg(
    matrix: np.ndarray, diagonal: np.ndarray, strictly_upper: np.ndarray, load: np.ndarray, steps: int
) -> np.ndarray:
    """x [n] after `steps` of matrix x = load, M = (D + L) D^-1 (D + L)^T (Saad, 2nd ed., algorithm 9.1).

    diagonal:       [n / 3, 3, 3] blocks of D
    strictly_upper: [n, n] L^T, by blocks
    """
    d = np.zeros_like(matrix)
    for i, block in enumerate(diagonal):
        d[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = block
    lower = d + strictly_upper.T

    def precondition(r: np.ndarray) -> np.ndarray:
        forward = _block_substitute(lower, diagonal, r)
        return _block_substitute(lower.T, diagonal, d @ forward, backward=True)

    x = np.zeros_like(load)
    r = load.copy()
    z = precondition(r)
    p = z.copy()
    for _ in range(steps):
        q = matrix @ p
        rz = r @ z
        alpha = rz / (p @ q)
        x += alpha * p
        r -= alpha * q
        z = precondition(r)
        p = z + (r @ z) / rz * p
    return x


def _block_substitute(
    triangle: np.ndarray, diagonal: np.ndarray, load: np.ndarray, *, backward: bool = False
) -> np.ndarray:
    found = np.zeros_like(load)
    order = range(len(diagonal))
    for i in reversed(order) if backward else order:
        rows = slice(3 * i, 3 * i + 3)
        rest = load[rows] - triangle[rows] @ found
        found[rows] = np.linalg.solve(diagonal[i], rest)
    return found


__all__ = ["gauss_seidel_cg"]
