"""Closed forms of the constitutive laws: a bar stretched freely, simple shear, flow under tension.

Sources: the energies of `gdpro_sim.kernels.elasticity`, in textbook form; von Mises flow with linear
isotropic hardening: Simo & Hughes 1998, "Computational Inelasticity", sec. 1.2.
"""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import brentq


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(lambda, mu) in Pa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def uniaxial(law: str, stretch: float, young: float, poisson: float) -> tuple[float, float]:
    """(lateral stretch, axial first Piola stress) of a bar stretched freely, in closed form.

    The corotated and the neo-Hookean law leave one equation for the lateral stretch.
    """
    lam, mu = lame(young, poisson)
    if law == "linear":
        return 1 - poisson * (stretch - 1), young * (stretch - 1)
    if law == "stvk_hencky":
        return stretch**-poisson, young * math.log(stretch) / stretch
    if law == "stable_neo_hookean":
        L = lam + mu
        s = math.sqrt(((L + mu) * stretch - mu) / L) / stretch
    elif law == "neo_hookean":
        s = brentq(lambda s: mu * (s * s - 1) + lam * math.log(stretch * s * s), 1e-3, 10, xtol=1e-15)
    elif law == "corotated":

        def lateral(s: float) -> float:
            return 2 * mu * (s - 1) + lam * (stretch * s * s - 1) * stretch * s

        s = brentq(lateral, 0.3, 3, xtol=1e-15)
        return s, 2 * mu * (stretch - 1) + lam * (stretch * s * s - 1) * s * s
    else:
        raise ValueError(law)
    return s, mu * (stretch - s * s / stretch)


def simple_shear(law: str, shear: float, mu: float) -> np.ndarray:
    """Cauchy stress, Pa, of x = X + shear * Y e_x (linear: the stress of small strains)."""
    if law == "linear":
        s11 = s22 = 0.0
        s12 = mu * shear
    elif law in ("stable_neo_hookean", "neo_hookean"):
        s11, s22, s12 = mu * shear**2, 0.0, mu * shear
    elif law == "corotated":
        # R turns by atan(shear / 2); sigma = 2 mu (F - R) F^T.
        c, s = 1 / math.hypot(1, shear / 2), shear / 2 / math.hypot(1, shear / 2)
        s11 = 2 * mu * (1 + shear**2 - c - shear * s)
        s22, s12 = 2 * mu * (1 - c), 2 * mu * (shear - s)
    elif law == "stvk_hencky":
        tau = 2 * mu * math.asinh(shear / 2) / math.hypot(2, shear)
        s11, s22, s12 = shear * tau, -shear * tau, 2 * tau
    else:
        raise ValueError(law)
    return np.array([[s11, s12, 0.0], [s12, s22, 0.0], [0.0, 0.0, 0.0]])


def plastic_uniaxial(
    stretch: float, young: float, poisson: float, limit: float, hardening: float
) -> tuple[float, float]:
    """(lateral stretch, axial first Piola stress) of a Hencky bar stretched past its yield stress, Pa.

    The logarithmic strain is tau / E + (tau - limit) / hardening; its plastic part keeps the volume.
    """
    strain = math.log(stretch)
    tau = young * (limit + hardening * strain) / (young + hardening)
    if tau <= limit:
        raise ValueError(f"a stretch of {stretch} does not reach the yield stress")
    flow = (tau - limit) / hardening
    return math.exp(-poisson * tau / young - flow / 2), tau / stretch


__all__ = ["lame", "plastic_uniaxial", "simple_shear", "uniaxial"]
