"""Coulomb friction between surfaces that keep a gap: springs in the tangent plane that slip at the limit.

As on the ground (`gdpro_sim.kernels.contact`), friction is elastic-perfectly-plastic: for a fixed normal
force its potential is Huber's in the slip, quadratic while it sticks and linear while it slides. Which
elements touch changes from step to step, so what the springs hold is kept at the vertices, as a share of
Coulomb's limit: each vertex has the mean share of the contacts it takes part in, weighted by their limits,
against what it touches, and a contact starts from the mean of its vertices'. The whole friction force is the
same before and after as long as the normal forces are, so what sticks does not creep.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import ipctk
import numpy as np
import scipy.sparse as sparse


class Stencils(NamedTuple):
    """K contacts as friction sees them, held fixed for a while.

    ids:       [K, 4] surface vertices; those that a contact lacks are its first with weight 0
    weights:   [K, 4] sum_a weights_a x_a is the vector between the two closest points
    normal:    [K, 3] unit
    limit:     [K] Coulomb's limit mu |normal force|, N
    stiffness: [K] N/m
    slip:      [K, 3] m, stretch at the start of the step
    """

    ids: np.ndarray
    weights: np.ndarray
    normal: np.ndarray
    limit: np.ndarray
    stiffness: np.ndarray
    slip: np.ndarray


def gather(
    tangential: ipctk.TangentialCollisions,
    x: np.ndarray,
    edges: np.ndarray,
    faces: np.ndarray,
    stiffness: np.ndarray,
    share: np.ndarray,
) -> Stencils:
    """Stencils of the toolkit's collisions at x [S, 3].

    stiffness: [S] N/m per m^2 of contact; a contact has the softer of its two sides'
    share:     [S, 3] friction at the start of the step, as a share of its limit
    """
    count = len(tangential)
    ids, weights = np.zeros((count, 4), np.int64), np.zeros((count, 4))
    limit, area = np.zeros(count), np.zeros(count)
    for k in range(count):
        collision = tangential[k]
        size = collision.num_vertices()
        ids[k] = collision.vertex_ids(edges, faces)
        ids[k, size:] = ids[k, 0]
        weights[k, :size] = collision.compute_coefficients(x, edges, faces)
        area[k] = collision.weight
        limit[k] = collision.mu_s * collision.normal_force_magnitude * area[k]
    gap = np.einsum("ka,kai->ki", weights, x[ids])
    normal = gap / np.maximum(np.linalg.norm(gap, axis=1, keepdims=True), 1e-300)
    sides = np.stack([np.maximum(weights, 0.0), np.maximum(-weights, 0.0)])
    softer = np.einsum("ska,ka->sk", sides, stiffness[ids]).min(axis=0)
    springs = area * softer
    held = 0.5 * _tangential(np.einsum("ka,kai->ki", weights, share[ids]), normal)
    start = (limit / np.maximum(springs, 1e-300))[:, None] * held
    return Stencils(ids, weights, normal, limit, springs, start)


def _tangential(vectors: np.ndarray, normal: np.ndarray) -> np.ndarray:
    return vectors - np.einsum("ki,ki->k", vectors, normal)[:, None] * normal


def _stretch(stencils: Stencils, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Stretch [K, 3] after the vertices have `moved` [S, 3], and its length."""
    motion = np.einsum("ka,kai->ki", stencils.weights, moved[stencils.ids])
    stretch = stencils.slip + _tangential(motion, stencils.normal)
    return stretch, np.linalg.norm(stretch, axis=1)


def energy(stencils: Stencils, moved: np.ndarray) -> float:
    """Huber potential of all springs, J."""
    _, length = _stretch(stencils, moved)
    k, limit = stencils.stiffness, stencils.limit
    sticks = k * length <= limit
    sliding = limit * (length - 0.5 * limit / np.maximum(k, 1e-300))
    return float(np.where(sticks, 0.5 * k * length * length, sliding).sum())


def gradient(stencils: Stencils, moved: np.ndarray) -> np.ndarray:
    """[S, 3] N."""
    stretch, length = _stretch(stencils, moved)
    factor = np.minimum(stencils.stiffness, stencils.limit / np.maximum(length, 1e-300))
    force = stencils.weights[:, :, None] * (factor[:, None] * stretch)[:, None, :]
    return np.stack(
        [
            np.bincount(stencils.ids.ravel(), weights=force[:, :, i].ravel(), minlength=len(moved))
            for i in range(3)
        ],
        axis=1,
    )


def hessian(stencils: Stencils, moved: np.ndarray) -> Any:
    """Positive semidefinite scipy.sparse.bsr_matrix of 3x3 blocks over the S vertices, N/m."""
    stretch, length = _stretch(stencils, moved)
    slides = stencils.stiffness * length > stencils.limit
    factor = np.where(slides, stencils.limit / np.maximum(length, 1e-300), stencils.stiffness)
    direction = np.where(slides[:, None], stretch / np.maximum(length, 1e-300)[:, None], 0.0)
    plane = (
        np.eye(3)
        - stencils.normal[:, :, None] * stencils.normal[:, None, :]
        - direction[:, :, None] * direction[:, None, :]
    )
    pairs = stencils.weights[:, :, None] * stencils.weights[:, None, :]
    blocks = pairs[:, :, :, None, None] * (factor[:, None, None] * plane)[:, None, None]
    rows, columns = np.broadcast_arrays(stencils.ids[:, :, None], stencils.ids[:, None, :])
    return sum_blocks(rows.ravel(), columns.ravel(), blocks.reshape(-1, 3, 3), len(moved))


def sum_blocks(rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, count: int) -> Any:
    """scipy.sparse.bsr_matrix of `count` block rows with blocks [N, 3, 3] added at (rows, columns)."""
    order = np.lexsort((columns, rows))
    rows, columns = rows[order], columns[order]
    first = np.flatnonzero(np.append(True, (np.diff(rows) != 0) | (np.diff(columns) != 0)))
    summed = np.add.reduceat(blocks[order], first, axis=0)
    offsets = np.append(0, np.cumsum(np.bincount(rows[first], minlength=count)))
    return sparse.bsr_matrix((summed, columns[first], offsets), shape=(3 * count, 3 * count))


def shares(stencils: Stencils, moved: np.ndarray) -> np.ndarray:
    """Friction after a step at the vertices, [S, 3], as a share of its limit; contacts hold no more."""
    stretch, length = _stretch(stencils, moved)
    most = stencils.limit / np.maximum(stencils.stiffness, 1e-300)
    held = stretch / np.maximum(np.maximum(length, most), 1e-300)[:, None]
    importance = np.abs(stencils.weights) * stencils.limit[:, None]
    signed = (np.sign(stencils.weights) * importance)[:, :, None] * held[:, None, :]
    ids, count = stencils.ids.ravel(), len(moved)
    total = np.bincount(ids, weights=importance.ravel(), minlength=count)
    sums = [np.bincount(ids, weights=signed[:, :, i].ravel(), minlength=count) for i in range(3)]
    return np.stack(sums, axis=1) / np.maximum(total, 1e-300)[:, None]


__all__ = ["Stencils", "energy", "gather", "gradient", "hessian", "shares", "sum_blocks"]
