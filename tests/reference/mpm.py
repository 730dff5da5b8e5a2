"""Material point method, readable and in float64: the oracle for transfers and for the explicit solver.

One affine particle-in-cell step (Jiang et al. 2015, "The affine particle-in-cell method") with stress by
moving least squares (Hu et al. 2018, eq. 16) over a list of nodes, without blocks, tiles and vectors. The
grid's nodes lie at integer multiples of the spacing.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

WIDTHS = {"quadratic": 3, "cubic": 4}


@dataclass(frozen=True)
class Cloud:
    """Particles: positions, velocities [N, 3], affine, deformations [N, 3, 3], masses, volumes [N]."""

    positions: np.ndarray
    velocities: np.ndarray
    affine: np.ndarray
    deformations: np.ndarray
    masses: np.ndarray
    volumes: np.ndarray


def cloud(positions: np.ndarray, velocities: np.ndarray, masses: np.ndarray, volumes: np.ndarray) -> Cloud:
    """Undeformed particles without velocity gradient."""
    count = len(positions)
    return Cloud(
        np.asarray(positions, np.float64),
        np.asarray(velocities, np.float64),
        np.zeros((count, 3, 3)),
        np.tile(np.eye(3), (count, 1, 1)),
        np.asarray(masses, np.float64),
        np.asarray(volumes, np.float64),
    )


def inertia(kernel: str, spacing: float) -> float:
    """D, m^2: sum of weight times squared distance along an axis, the same wherever the particle is."""
    return spacing**2 / {"quadratic": 4.0, "cubic": 3.0}[kernel]


def spline(kernel: str, distance: np.ndarray) -> np.ndarray:
    """B-spline at a distance in cells (Steffen, Kirby & Berzins 2008)."""
    d = np.abs(distance)
    if kernel == "quadratic":
        return np.where(d < 0.5, 0.75 - d**2, np.where(d < 1.5, 0.5 * (1.5 - d) ** 2, 0.0))
    return np.where(d < 1.0, d**3 / 2.0 - d**2 + 2.0 / 3.0, np.where(d < 2.0, (2.0 - d) ** 3 / 6.0, 0.0))


@dataclass(frozen=True)
class Stencil:
    """Nodes that each particle reaches: [N, K, 3] int, weights [N, K], arms [N, K, 3] m from the particle."""

    nodes: np.ndarray
    weights: np.ndarray
    arms: np.ndarray


def stencil(kernel: str, positions: np.ndarray, spacing: float) -> Stencil:
    width = WIDTHS[kernel]
    u = positions / spacing
    first = np.floor(u - 0.5 if width == 3 else u - 1.0).astype(np.int64)
    offsets = np.stack(np.meshgrid(*[np.arange(width)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    nodes = first[:, None, :] + offsets[None]
    away = nodes - u[:, None, :]
    return Stencil(nodes, spline(kernel, away).prod(axis=2), away * spacing)


@dataclass(frozen=True)
class Nodes:
    """Nodes with mass: their numbers [M, 3], masses [M] kg, velocities [M, 3] m/s.

    places: [N, K] row of each node that a particle reaches
    """

    numbers: np.ndarray
    masses: np.ndarray
    velocities: np.ndarray
    places: np.ndarray


def to_grid(
    particles: Cloud, reach: Stencil, *, affine: bool, forces: np.ndarray, h: float, inertia: float
) -> Nodes:
    """Mass and velocity of the nodes; `forces` [N, 3, 3] J is Kirchhoff stress times volume at rest."""
    spin = particles.masses[:, None, None] * particles.affine * float(affine) - h / inertia * forces
    momentum = (particles.masses[:, None] * particles.velocities)[:, None, :] + np.einsum(
        "nij,nkj->nki", spin, reach.arms
    )
    numbers, places = np.unique(reach.nodes.reshape(-1, 3), axis=0, return_inverse=True)
    places = places.reshape(reach.weights.shape)
    masses, sums = np.zeros(len(numbers)), np.zeros((len(numbers), 3))
    np.add.at(masses, places, reach.weights * particles.masses[:, None])
    np.add.at(sums, places, reach.weights[:, :, None] * momentum)
    return Nodes(numbers, masses, sums / np.maximum(masses, 1e-300)[:, None], places)


def to_particles(reach: Stencil, places: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(sum w v [N, 3], sum w v r^T [N, 3, 3]) of the nodes' `values` [M, 3]."""
    parts = reach.weights[:, :, None] * values[places]
    return parts.sum(axis=1), np.einsum("nki,nkj->nij", parts, reach.arms)


def step(
    particles: Cloud,
    h: float,
    *,
    spacing: float,
    kernel: str = "quadratic",
    transfer: str = "apic",
    flip_ratio: float = 0.95,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    stress: Callable[[np.ndarray], np.ndarray] | None = None,
) -> Cloud:
    """One substep of h seconds.

    stress: Kirchhoff stress [N, 3, 3] Pa of deformation gradients [N, 3, 3]; None: there is none
    """
    reach, D = stencil(kernel, particles.positions, spacing), inertia(kernel, spacing)
    forces = np.zeros_like(particles.deformations)
    if stress is not None:
        forces = particles.volumes[:, None, None] * stress(particles.deformations)
    affine = transfer != "pic"
    before = to_grid(particles, reach, affine=affine, forces=0.0 * forces, h=h, inertia=D)
    nodes = to_grid(particles, reach, affine=affine, forces=forces, h=h, inertia=D)
    after = nodes.velocities + h * np.asarray(gravity)
    v, moment = to_particles(reach, nodes.places, after)
    C = moment / D
    share = flip_ratio if transfer == "flip" else 0.0
    change, _ = to_particles(reach, nodes.places, after - before.velocities)
    return replace(
        particles,
        positions=particles.positions + h * v,
        velocities=share * (particles.velocities + change) + (1.0 - share) * v,
        affine=C,
        deformations=particles.deformations + h * C @ particles.deformations,
    )


def momenta(particles: Cloud, inertia: float) -> tuple[np.ndarray, np.ndarray]:
    """Linear and angular momentum about the origin; that of the velocity gradients counts."""
    p = particles.masses[:, None] * particles.velocities
    C = particles.affine
    spin = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], axis=1)
    turning = np.cross(particles.positions, p) + inertia * particles.masses[:, None] * spin
    return p.sum(axis=0), turning.sum(axis=0)
