"""Constitutive laws in textbook form, float64, for the kernels to be compared with.

Stresses are written with matrices (rotation, logarithmic strain, inverse), not in the principal axes that the
kernels work in. Sources: `gdpro_sim.kernels.elasticity`.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.linalg import polar
from scipy.optimize import minimize_scalar

BARRIER_J = 0.2


def barrier(J: float, lam: float, mu: float) -> tuple[float, float]:
    """Energy density and its derivative of the guard against inversion."""
    if J >= BARRIER_J:
        return 0.0, 0.0
    k, c, log = 2 * (lam + mu), J - BARRIER_J, math.log(J / BARRIER_J)
    return -k * c * c * log, -k * (2 * c * log + c * c / J)


def log_stretch(F: np.ndarray) -> np.ndarray:
    """Logarithm of the left stretch tensor (F F^T)^(1/2): Hencky's strain, spatial."""
    U, s, _ = np.linalg.svd(F)
    return (U * np.log(s)) @ U.T


def energy_density(law: str, F: np.ndarray, lam: float, mu: float) -> float:
    """Psi(F), J/m^3."""
    J, eye = float(np.linalg.det(F)), np.eye(3)
    if law == "linear":
        e = (F + F.T) / 2 - eye
        return mu * np.sum(e * e) + lam / 2 * np.trace(e) ** 2
    if J <= 0:
        return math.inf
    if law == "stable_neo_hookean":
        volume = -mu * (J - 1) + (lam + mu) / 2 * (J - 1) ** 2 + barrier(J, lam, mu)[0]
        return mu / 2 * (np.sum(F * F) - 3) + volume
    if law == "neo_hookean":
        return mu / 2 * (np.sum(F * F) - 3) - mu * math.log(J) + lam / 2 * math.log(J) ** 2
    if law == "corotated":
        return mu * np.sum((F - polar(F)[0]) ** 2) + lam / 2 * (J - 1) ** 2 + barrier(J, lam, mu)[0]
    if law == "stvk_hencky":
        e = log_stretch(F)
        return mu * np.sum(e * e) + lam / 2 * np.trace(e) ** 2
    raise ValueError(law)


def piola(law: str, F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """First Piola-Kirchhoff stress dPsi/dF, Pa."""
    J, eye = float(np.linalg.det(F)), np.eye(3)
    if law == "linear":
        e = (F + F.T) / 2 - eye
        return 2 * mu * e + lam * np.trace(e) * eye
    inverse = np.linalg.inv(F).T
    if law == "stable_neo_hookean":
        return mu * F + (-mu + (lam + mu) * (J - 1) + barrier(J, lam, mu)[1]) * J * inverse
    if law == "neo_hookean":
        return mu * (F - inverse) + lam * math.log(J) * inverse
    if law == "corotated":
        return 2 * mu * (F - polar(F)[0]) + (lam * (J - 1) + barrier(J, lam, mu)[1]) * J * inverse
    if law == "stvk_hencky":
        e = log_stretch(F)
        return (2 * mu * e + lam * np.trace(e) * eye) @ inverse
    raise ValueError(law)


def hessian(stress: Callable[[np.ndarray], np.ndarray], F: np.ndarray, step: float = 1e-5) -> np.ndarray:
    """dP/dF by fourth-order central differences, [9, 9] over F flattened row by row."""
    h = step * min(np.linalg.svd(F, compute_uv=False))
    H = np.zeros((9, 9))
    for k in range(9):
        d = np.zeros(9)
        d[k] = h
        d = d.reshape(3, 3)
        slope = 8 * (stress(F + d) - stress(F - d)) - (stress(F + 2 * d) - stress(F - 2 * d))
        H[:, k] = slope.reshape(9) / (12 * h)
    return (H + H.T) / 2


def project(H: np.ndarray) -> np.ndarray:
    """Nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


def plastic_energy(F: np.ndarray, lam: float, mu: float, limit: float, hardening: float) -> float:
    """Least elastic energy plus dissipation over the plastic flow of a step, J/m^3: no return mapping here.

    The flow is sqrt(3/2) p along the trial strain's deviator; it costs limit p + hardening p^2 / 2.
    """
    e = log_stretch(F)
    deviator = e - np.trace(e) / 3 * np.eye(3)
    size = math.sqrt(np.sum(deviator**2))
    bulk = (lam + 2 / 3 * mu) / 2 * np.trace(e) ** 2

    def energy(p: float) -> float:
        return mu * (size - math.sqrt(1.5) * p) ** 2 + bulk + limit * p + hardening / 2 * p * p

    found = minimize_scalar(energy, bounds=(0.0, size), method="bounded", options={"xatol": 1e-14})
    return min(energy(0.0), float(found.fun))
