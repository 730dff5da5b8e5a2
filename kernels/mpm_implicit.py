"""What particles add to backward Euler on the MPM grid: energy, forces, stiffness.

The velocities v of the nodes at the end of a substep of h seconds minimise (Gast et al. 2015, "Optimization
integrator for large time steps", IEEE TVCG 21(10); Jiang et al. 2016, "The material point method for
simulating continuum materials", SIGGRAPH courses, ch. 10; here with the velocity gradients of MLS-MPM)

    E(v) = sum_i m_i/2 |v_i - v*_i|^2 + sum_p V Psi((1 + h C) F),   C = sum_i w v_i r_i^T / D

where v* is what momentum and gravity alone lead to, F the elastic deformation gradient so far, and w, r_i, D
are those of `gdpro_sim.kernels.mpm_transfer`. With the first Piola-Kirchhoff stress P of Psi,

    dE/dv_i = m_i (v_i - v*_i) + sum_p w G r_i / D,   G = h V P F^T

and the product with the Hessian replaces P by its change dP under dF = h dC F. In the frame of the singular
vectors of the trial gradient U diag(s) V^T, with B = h F V, dC changes U^T dF V = U^T dC B, and an isotropic
law's Hessian splits into a block A over the diagonal and pairs of the rest
(`gdpro_sim.kernels.elasticity.principal_hessian`): that is what is kept of each particle, in float32, in an
array `work` with the rows below and as many columns as the particles' own.

    GRADIENT  9  C, row by row
    MOMENT    9  G
    LEFT      9  U
    RIGHT     9  B
    SCALING   6  V A: 00 11 22 01 02 12
    PAIRS     9  V times (F_ij, F_ij), (F_ji, F_ji), (F_ij, F_ji) for (i, j) = (1, 2), (0, 2), (0, 1)

Stiffness damping adds the dissipation of `viscous_energy`. Energies and laws are float64;
`gdpro_sim.kernels.mpm_stiffness` has the transfers, `gdpro_sim.kernels.mpm_newton` what nodes do.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import singular_value_decomposition
from gdpro_sim.kernels.elasticity import (
    Constants,
    energy_density,
    green_strain_increment,
    needs_stretches,
    piola_stress_in_frame,
    principal_hessian,
    viscous_energy,
    viscous_hessian,
    viscous_stress,
)
from gdpro_sim.kernels.mpm_laws import DAMPING, LAM, LAW, MU
from gdpro_sim.kernels.particles import DEFORMATION, DEFORMATION_LOW, VOLUME, read_compensated

wp.set_module_options({"enable_backward": False})

GRADIENT = wp.constant(0)
MOMENT = wp.constant(9)
LEFT = wp.constant(18)
RIGHT = wp.constant(27)
SCALING = wp.constant(36)
PAIRS = wp.constant(42)
WORK = wp.constant(51)


@wp.func
def constants_of(row: int, exact: int, table: wp.array2d[float]) -> Constants:
    """Of an elastic material, from the table of `gdpro_sim.kernels.mpm_laws`."""
    m = Constants()
    m.law = int(table[row, LAW])
    m.mu = wp.float64(table[row, MU])
    m.lam = wp.float64(table[row, LAM])
    m.limit = wp.float64(wp.inf)
    m.exact = exact
    return m


@wp.func
def trial_gradient(h: float, i: int, work: wp.array2d[float], F: wp.mat33d) -> wp.mat33d:
    """(1 + h C) F"""
    C = wp.mat33d()
    for k in range(9):
        C[k // 3, k % 3] = wp.float64(work[GRADIENT + k, i])
    return F + wp.float64(h) * (C * F)


@wp.kernel
def trial_energy(
    start: int,
    # In:
    h: float,
    matter: wp.array[wp.int32],
    table: wp.array2d[float],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Elastic and damping energy of each particle, J, of the velocity gradients in `work`.

    Infinite where a particle is turned inside out.
    """
    i = start + wp.tid()
    F = read_compensated(particles, DEFORMATION, DEFORMATION_LOW, i)
    trial = trial_gradient(h, i, work, F)
    m = constants_of(matter[i], 0, table)
    s = wp.vec3d()
    if needs_stretches(m.law):
        _U, s, _V = singular_value_decomposition(trial)
    density = energy_density(trial, s, m)
    damping = wp.float64(table[matter[i], DAMPING]) / wp.float64(h)
    if damping > wp.float64(0.0):
        strain = green_strain_increment(trial, wp.transpose(F) * F)
        density += viscous_energy(strain, damping * m.mu, damping * m.lam)
    energy_out[i] = wp.float64(particles[VOLUME, i]) * density


@wp.func
def write_rows(m: wp.mat33d, row: int, i: int, work: wp.array2d[float]):
    for k in range(9):
        work[row + k, i] = float(m[k // 3, k % 3])


@wp.kernel
def linearise(
    start: int,
    # In:
    h: float,
    exact: int,
    matter: wp.array[wp.int32],
    table: wp.array2d[float],
    particles: wp.array2d[float],
    # Out:
    work_out: wp.array2d[float],
):
    """All rows of `work` past GRADIENT; Hessians are projected to positive semidefinite unless `exact`."""
    i = start + wp.tid()
    F = read_compensated(particles, DEFORMATION, DEFORMATION_LOW, i)
    trial = trial_gradient(h, i, work_out, F)
    m = constants_of(matter[i], exact, table)
    U, s, V = singular_value_decomposition(trial)
    stress = piola_stress_in_frame(trial, U, s, V, m)
    A, flips = principal_hessian(s, m)
    pairs = wp.mat33d()
    for k in range(3):
        pairs[k, 0] = flips[k, 0]
        pairs[k, 1] = flips[k, 0]
        pairs[k, 2] = flips[k, 1]
    damping = wp.float64(table[matter[i], DAMPING]) / wp.float64(h)
    if damping > wp.float64(0.0):
        mu = damping * m.mu
        lam = damping * m.lam
        strain = green_strain_increment(trial, wp.transpose(F) * F)
        stress += viscous_stress(trial, strain, mu, lam)
        more, more_pairs = viscous_hessian(s, mu, lam)
        A += more
        pairs += more_pairs
    volume = wp.float64(particles[VOLUME, i])
    step = wp.float64(h)
    write_rows((step * volume) * (stress * wp.transpose(F)), MOMENT, i, work_out)
    write_rows(U, LEFT, i, work_out)
    write_rows(step * (F * V), RIGHT, i, work_out)
    for k in range(3):
        work_out[SCALING + k, i] = float(volume * A[k, k])
    work_out[SCALING + 3, i] = float(volume * A[0, 1])
    work_out[SCALING + 4, i] = float(volume * A[0, 2])
    work_out[SCALING + 5, i] = float(volume * A[1, 2])
    write_rows(volume * pairs, PAIRS, i, work_out)
