"""Materials of MPM particles in textbook form, float64, one particle at a time.

Everything goes by the singular value decomposition F = U diag(s) V^T. Sources: `gdpro_sim.kernels.mpm_laws`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import brentq

from gdpro_sim.materials import Material
from tests.reference.elasticity import barrier

OPENING = 0.02
"""Log of volume gained over which wet sand loses its cohesion."""

LOOSE = 2.0
"""Largest J - 1 a fluid remembers."""


@dataclass
class Answer:
    """tau: Kirchhoff stress, Pa; F: elastic deformation gradient; memory, passed, damage: see the kernels."""

    tau: np.ndarray
    F: np.ndarray
    memory: float = 0.0
    passed: float = 0.0
    damage: float = 0.0


def signed_svd(F: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """F = U diag(s) V with rotations; the last of s carries the sign of det F."""
    U, s, V = np.linalg.svd(F)
    if np.linalg.det(U) < 0:
        U[:, 2] *= -1
        s[2] *= -1
    if np.linalg.det(V) < 0:
        V[2] *= -1
        s[2] *= -1
    return U, s, V


def principal_stress(model: str, s: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """Principal Kirchhoff stresses of the elastic laws, Pa."""
    J = float(np.prod(s))
    if model == "neo_hookean":
        return mu * (s**2 - 1) + lam * math.log(J)
    if model == "stable_neo_hookean":
        return mu * s**2 + J * (-mu + (lam + mu) * (J - 1) + barrier(J, lam, mu)[1])
    if model == "corotated":
        return 2 * mu * s * (s - 1) + J * (lam * (J - 1) + barrier(J, lam, mu)[1])
    e = np.log(s)
    return 2 * mu * e + lam * e.sum()


def von_mises(e: np.ndarray, plastic: float, m: Material, mu: float) -> tuple[np.ndarray, float]:
    """Strains after radial return, and the growth of plastic strain."""
    dev = e - e.mean()
    q = math.sqrt(6) * mu * np.linalg.norm(dev)
    over = q - (m.yield_stress or math.inf) - m.hardening * plastic
    if over <= 0:
        return e, 0.0
    growth = over / (3 * mu + m.hardening)
    return e - 3 * mu * growth / q * dev, growth


def herschel_bulkley(e: np.ndarray, h: float, m: Material, mu: float) -> tuple[np.ndarray, float]:
    """Strains after an implicit step of viscoplastic flow, and the growth of plastic strain.

    Shear stress relaxes by mu h rate, and stress = yield + k rate^n holds at the end.
    """
    assert m.yield_stress is not None
    dev = e - e.mean()
    size = float(np.linalg.norm(dev))
    shear, limit = math.sqrt(2) * mu * size, m.yield_stress / math.sqrt(3)
    if shear <= limit or h == 0:
        return e, 0.0

    def off(rate: float) -> float:
        return limit + m.viscosity * rate**m.flow_index - (shear - mu * h * rate)

    rate = brentq(off, 0.0, (shear - limit) / (mu * h), xtol=1e-300, rtol=1e-15)
    lost = mu * h * rate / shear
    return e - lost * dev, math.sqrt(2 / 3) * size * lost


def drucker_prager(
    e: np.ndarray, gained: float, m: Material, lam: float, mu: float
) -> tuple[np.ndarray, float]:
    """Strains after projection to the cone, and the log of the volume gained in the open."""
    assert m.friction_angle is not None
    angle = math.radians(m.friction_angle)
    alpha = math.sqrt(2 / 3) * 2 * math.sin(angle) / (3 - math.sin(angle))
    tip = m.cohesion / math.tan(angle) / (lam + 2 / 3 * mu) * min(max(1 - gained / OPENING, 0.0), 1.0)
    shifted = e + gained / 3
    if shifted.sum() >= tip:
        return np.full(3, tip / 3), gained + e.sum() - tip
    dev = shifted - shifted.mean()
    size = float(np.linalg.norm(dev))
    over = size + (3 * lam + 2 * mu) / (2 * mu) * (shifted.sum() - tip) * alpha
    if over > 0:
        shifted = shifted - over / size * dev
    return shifted, 0.0


def answer(
    m: Material,
    F: np.ndarray,
    C: np.ndarray,
    h: float,
    *,
    memory: float = 0.0,
    passed: float = 0.0,
    volume: float = 1.0,
) -> Answer:
    """What a particle answers to the trial deformation gradient F and velocity gradient C."""
    lam, mu = m.lame
    D = (C + C.T) / 2
    if m.model == "fluid":
        J = (1 + memory) * float(np.linalg.det(np.eye(3) + h * C))
        J = min(max(J, 0.3), 1 + LOOSE)
        p = max(lam / 7 * (J**-7 - 1), 0.0)
        tau = -J * p * np.eye(3) + 2 * m.viscosity * min(J, 1.0) * (D - np.trace(D) / 3 * np.eye(3))
        tau += m.rayleigh_stiffness * lam * np.trace(D) * np.eye(3)
        return Answer(tau, np.eye(3), J - 1)
    U, s, V = signed_svd(F)
    if np.prod(s) < 0.01:
        s = np.maximum(s, 0.05)
    hard, damage, e = 1.0, 0.0, np.log(s)
    if m.model == "stvk_hencky":
        e, growth = von_mises(e, memory, m, mu)
        memory += growth
        s = np.exp(e)
    elif m.model == "herschel_bulkley":
        e, growth = herschel_bulkley(e, h, m, mu)
        memory += growth
        s = np.exp(e)
    elif m.model == "drucker_prager":
        e, memory = drucker_prager(e, memory, m, lam, mu)
        s = np.exp(e)
    elif m.model == "snow":
        kept = np.clip(s, 1 - m.critical_compression, 1 + m.critical_stretch)
        packed = (1 + memory) * float(np.prod(s) / np.prod(kept))
        memory, s = min(max(packed, 0.6), 20.0) - 1, kept
        hard = math.exp(-m.snow_hardening * memory)
    model = {"snow": "corotated"}.get(m.model, m.model)
    t = hard * principal_stress(model, s, lam, mu)
    if m.tensile_strength is not None:
        strength = m.tensile_strength
        passed = max(passed, float(t.max()) / np.prod(s) / strength - 1)
        band = 2 * volume ** (1 / 3)
        spread = max((m.fracture_energy or 0.0) * m.young / strength**2 / band - 0.5, 0.1)
        damage = 1 - math.exp(-passed / spread) / (1 + passed)
        t = np.where(t > 0, (1 - damage) * t, t)
        if damage > 0.99:
            s = np.minimum(s, 2.0)
    tau = (U * t) @ U.T
    whole = m.rayleigh_stiffness * (1 - damage)
    tau += whole * (2 * mu * D + lam * np.trace(D) * np.eye(3))
    return Answer(tau, (U * s) @ V, memory, passed, damage)
