"""Surfaces carried by particles, float64: one vertex, one patch at a time."""

from __future__ import annotations

import numpy as np


def bounded(f: np.ndarray, stretch: float, anisotropy: float) -> np.ndarray:
    """F [3, 3] with s0 <= anisotropy * s1 cut short, then s2 >= s0 / anisotropy thickened."""
    if not np.isfinite(f).all():
        return np.eye(3)
    u, s, vt = np.linalg.svd(f)
    if np.linalg.det(u) * np.linalg.det(vt) < 0.0:  # the sign goes to the least singular value
        u[:, 2], s[2] = -u[:, 2], -s[2]
    s0, s1, s2 = np.clip(s, 1.0 / stretch, stretch)
    s0 = min(s0, anisotropy * s1)
    s2 = max(s2, s0 / anisotropy)
    return u @ np.diag([s0, s1, s2]) @ vt


def blend(
    point: np.ndarray, rest: np.ndarray, positions: np.ndarray, deformations: np.ndarray, count: int = 8
) -> np.ndarray:
    """Where the `count` nearest particles take a point: sum of w (x_p + F_p (X - X_p))."""
    distance = np.linalg.norm(rest - point, axis=1)
    order = np.argsort(distance)
    reach = distance[order[min(count, len(rest) - 1)]]
    near = order[:count]
    weights = np.maximum(1.0 - (distance[near] / reach) ** 2, 0.0) ** 2
    moved = positions[near] + np.einsum("nij,nj->ni", deformations[near], point - rest[near])
    return (weights[:, None] * moved).sum(0) / weights.sum()
