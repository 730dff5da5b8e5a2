"""What follows from the undeformed elements: shapes, volumes, masses, stiffnesses."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.model import Model


class RestShapes(NamedTuple):
    """Float64 throughout.

    inverse:      [T, 3, 3] rows are grad N_1..N_3, 1/m
    volume:       [T] m^3, weighted by fill
    mu, lam:      [T] Lame parameters, Pa
    law:          [T] int32 constitutive law of `gdpro_sim.kernels.elasticity`
    yield_stress: [T] Pa, inf where the element stays elastic
    hardening:    [T] Pa
    mass:         [P] kg, a quarter of each element's
    mass_damping: [P] Rayleigh mass damping, 1/s
    stiffness:    [P] N/m, what holds a vertex while its neighbours stay: sum of V (lam + 2 mu) |grad N|^2
    frequency:    largest angular frequency that any element could have on its own, rad/s: a bound for the
                  whole mesh (Irons & Treharne 1971)
    """

    inverse: np.ndarray
    volume: np.ndarray
    mu: np.ndarray
    lam: np.ndarray
    law: np.ndarray
    yield_stress: np.ndarray
    hardening: np.ndarray
    mass: np.ndarray
    mass_damping: np.ndarray
    stiffness: np.ndarray
    frequency: float


def rest_shapes(model: Model) -> RestShapes:
    """Raises SolverError for an element without volume at rest, or whose law is none or cannot yield."""
    corners = model.vertices.astype(np.float64)[model.tets]
    shape = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    full_volume = np.linalg.det(shape) / 6.0
    bad = np.flatnonzero(~(full_volume > 0.0))
    if len(bad):
        raise SolverError(
            f"element {bad[0]} has volume {full_volume[bad[0]]:.3g} m^3 at rest ({len(bad)} such elements); "
            "every tet must have positive volume: repair or re-tetrahedralize the mesh"
        )
    volume = full_volume * model.fill
    young, poisson = model.young.astype(np.float64), model.poisson.astype(np.float64)
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))

    density = model.density.astype(np.float64)
    share = np.repeat(density * volume / 4.0, 4)
    ids, count = model.tets.reshape(-1), len(model.vertices)
    mass = np.bincount(ids, weights=share, minlength=count)
    damped = np.bincount(ids, weights=share * np.repeat(model.rayleigh_mass, 4), minlength=count)
    mass_damping = np.divide(damped, mass, out=np.zeros(count), where=mass > 0.0)

    inverse = np.linalg.inv(shape)
    gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)
    squares = np.einsum("eai,eai->ea", gradients, gradients)
    modulus = lam + 2.0 * mu
    per_corner = (volume * modulus)[:, None] * squares
    stiffness = np.bincount(ids, weights=per_corner.reshape(-1), minlength=count)
    # The element's stiffness is below the sum of its corners', its masses are rho V / 4.
    frequency = float(np.sqrt((4.0 * modulus * squares.sum(1) / density).max(initial=0.0)))
    laws = _laws(model)
    return RestShapes(inverse, volume, mu, lam, *laws, mass, mass_damping, stiffness, frequency)


def _laws(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Law, yield stress and hardening of every element, checked."""
    count = len(model.tets)
    law = np.zeros(count, np.int32) if model.law is None else model.law.astype(np.int32)
    limit = np.full(count, np.inf) if model.yield_stress is None else model.yield_stress.astype(np.float64)
    hardening = np.zeros(count) if model.hardening is None else model.hardening.astype(np.float64)
    for bad, problem in (
        (
            (law < 0) | (law >= len(LAWS)),
            f"law must be a number below {len(LAWS)} of gdpro_sim.materials.LAWS; what flows, MPM alone can "
            "simulate",
        ),
        (~(limit > 0.0), "yield stress must be > 0 Pa (inf: elastic)"),
        (~(np.isfinite(hardening) & (hardening >= 0.0)), "hardening must be finite and >= 0 Pa"),
        (np.isfinite(limit) & (law != LAWS.index("stvk_hencky")), 'only the law "stvk_hencky" can yield'),
    ):
        if bad.any():
            e = int(np.argmax(bad))
            raise SolverError(
                f"element {e} has law {law[e]}, yield stress {limit[e]:g} Pa, hardening {hardening[e]:g} Pa: "
                f"{problem}"
            )
    return law, limit, hardening


def reals(values: np.ndarray, device: str) -> wp.array:
    """float64 on the device."""
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=wp.float64, device=device)


__all__ = ["RestShapes", "reals", "rest_shapes"]
