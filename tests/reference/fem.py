"""The float64 finite element oracle of the verification problems, and what only the tests ask of it."""

from __future__ import annotations

import numpy as np

from gdpro_sim.simulation.verification.reference import (
    BARRIER_J,
    ReferenceFem,
    cofactor,
    energy_density,
    hessian,
    lame,
    piola,
    project,
    volumetric,
)


def uniaxial_lateral(stretch: float, young: float, poisson: float) -> tuple[float, float]:
    """(lateral stretch, axial first Piola stress) of a bar stretched freely: P_22 = 0 by bisection."""
    lam, mu = lame(young, poisson)

    def lateral_stress(s: float) -> float:
        return float(piola(np.diag([stretch, s, s]), lam, mu)[1, 1])

    low, high = 0.5, 2.0
    for _ in range(100):
        middle = (low + high) / 2
        if lateral_stress(middle) < 0:
            low = middle
        else:
            high = middle
    return low, float(piola(np.diag([stretch, low, low]), lam, mu)[0, 0])


__all__ = [
    "BARRIER_J",
    "ReferenceFem",
    "cofactor",
    "energy_density",
    "hessian",
    "lame",
    "piola",
    "project",
    "uniaxial_lateral",
    "volumetric",
]
