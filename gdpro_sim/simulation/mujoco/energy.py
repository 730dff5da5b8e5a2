"""Elastic energy and volume ratios of flexes, from their vertices."""

from __future__ import annotations

import numpy as np

from gdpro_sim.simulation.mujoco_model import SoftBody


def deformation_gradients(body: SoftBody, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F [T, 3, 3] of every tet at vertices [P, 3] m, and volumes [T] m^3 at rest."""
    rest, now = body.vertices[body.tets], moved[body.tets]
    before = np.swapaxes(rest[:, 1:] - rest[:, :1], 1, 2)
    after = np.swapaxes(now[:, 1:] - now[:, :1], 1, 2)
    return after @ np.linalg.inv(before), np.linalg.det(before) / 6.0


def elastic_energy(body: SoftBody, moved: np.ndarray) -> float:
    """J at vertices [P, 3] m: the body's law over its tets.

    Stable neo-Hookean: Smith, de Goes & Kim 2018, "Stable Neo-Hookean Flesh Simulation", ACM TOG 37, eq. 14
    without its logarithm. For a grid of nodes it is what the carried tets hold.
    """
    F, volumes = deformation_gradients(body, moved)
    lam = body.young * body.poisson / ((1.0 + body.poisson) * (1.0 - 2.0 * body.poisson))
    mu = body.young / (2.0 * (1.0 + body.poisson))
    if body.stable:
        J = np.linalg.det(F)
        first = np.einsum("tij,tij->t", F, F) - 3.0
        density = 0.5 * mu * first - mu * (J - 1.0) + 0.5 * (lam + mu) * (J - 1.0) ** 2
    else:
        strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
        trace = np.trace(strain, axis1=1, axis2=2)
        density = mu * np.einsum("tij,tij->t", strain, strain) + 0.5 * lam * trace**2
    return float(volumes @ density)


def volume_ratios(body: SoftBody, moved: np.ndarray) -> np.ndarray:
    """det F [T] of every tet."""
    return np.linalg.det(deformation_gradients(body, moved)[0])


__all__ = ["deformation_gradients", "elastic_energy", "volume_ratios"]
