"""Constitutive laws: energy density, first Piola-Kirchhoff stress, and the projected Hessian.

With singular values s of F (U diag(s) V^T, rotations), J = det F and Lame parameters mu, lambda, J/m^3:

    STABLE_NEO_HOOKEAN  mu/2 (F:F - 3) - mu (J - 1) + (lambda + mu)/2 (J - 1)^2 + barrier(J)
    NEO_HOOKEAN         mu/2 (F:F - 3) - mu log J + lambda/2 (log J)^2
    COROTATED           mu sum_i (s_i - 1)^2 + lambda/2 (J - 1)^2 + barrier(J)
    STVK_HENCKY         mu sum_i (log s_i)^2 + lambda/2 (sum_i log s_i)^2, limited by a yield stress
    LINEAR              mu e:e + lambda/2 tr(e)^2,  e = (F + F^T)/2 - 1

Sources, in this order: Smith, de Goes & Kim 2018, "Stable Neo-Hookean Flesh Simulation", ACM TOG 37(2),
eq. 13 without the logarithmic rest-stability term, as in Kim & Eberle 2020, "Dynamic Deformables", ch. 6;
Sifakis & Barbic 2012, "FEM simulation of 3D deformable solids", sec. 3.5; Stomakhin et al. 2012,
"Energetically consistent invertible elasticity" (fixed corotated); Klar et al. 2016, "Drucker-Prager
elastoplasticity for sand animation", and `gdpro_sim.kernels.plasticity`; Sifakis & Barbic 2012, sec. 3.2. All
agree at small strains. The scaling, twist and flip modes of the Hessians: Smith, de Goes & Kim 2019,
"Analytic eigensystems for isotropic distortion energies", ACM TOG 38(1).

Inversion. The two laws with logarithms are infinite at J <= 0 by themselves. The barrier makes the stable
neo-Hookean and the corotated law so: it is zero for J >= 0.2 and grows without bound as J -> 0,
barrier(J) = -2 (lambda + mu) (J - 0.2)^2 log(J / 0.2), the C2 clamped logarithm of Li et al. 2020,
"Incremental Potential Contact", eq. 6, with the volume ratio in place of a distance. A line search that
rejects infinite energy then keeps every element uninverted. Linear elasticity is meant for small strains and
rotations and knows no inversion: its energy is finite everywhere.

All functions are float64: the incremental potential is compared between nearly equal states, and a stiff
body's stress is a small difference of large numbers. Measured on the CPU, float64 costs about 10 % here.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import project_symmetric, singular_value_decomposition
from gdpro_sim.kernels.plasticity import ROOT_SIX, deviator, equivalent_stress, excess_stress, log_stretches

wp.set_module_options({"enable_backward": False})

STABLE_NEO_HOOKEAN = wp.constant(0)
NEO_HOOKEAN = wp.constant(1)
COROTATED = wp.constant(2)
STVK_HENCKY = wp.constant(3)
LINEAR = wp.constant(4)

BARRIER_J = wp.constant(wp.float64(0.2))
"""Volume ratio below which an element resists further compression without bound."""


@wp.struct
class Constants:
    """What a law knows of one element or particle."""

    law: int
    mu: wp.float64  # Lame parameters, Pa
    lam: wp.float64
    limit: wp.float64  # present yield stress, Pa; inf: elastic. STVK_HENCKY alone yields
    hardening: wp.float64  # growth of the yield stress with plastic strain, Pa
    exact: int  # not 0: Hessians as they are, not projected
    pressure: wp.float64  # Pa, added to dPsi/dJ in stress and Hessian, not in the energy; LINEAR takes none


@wp.func
def determinant_gradient(F: wp.mat33d) -> wp.mat33d:
    """Gradient of det F with respect to F: the cofactor matrix."""
    f0 = wp.vec3d(F[0, 0], F[1, 0], F[2, 0])
    f1 = wp.vec3d(F[0, 1], F[1, 1], F[2, 1])
    f2 = wp.vec3d(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1))


# ---- laws of F:F or |F - R|^2 plus a function U of J: neo-Hookean, stable neo-Hookean, corotated ----


@wp.func
def volumetric_energy(J: wp.float64, m: Constants) -> wp.float64:
    """U(J) for J > 0, J/m^3."""
    if m.law == NEO_HOOKEAN:
        log = wp.log(J)
        return wp.float64(0.5) * m.lam * log * log - m.mu * log
    L = m.lam
    slope = wp.float64(0.0)
    if m.law == STABLE_NEO_HOOKEAN:
        L += m.mu
        slope = m.mu
    d = J - wp.float64(1.0)
    energy = wp.float64(0.5) * L * d * d - slope * d
    if J < BARRIER_J:
        c = J - BARRIER_J
        energy -= wp.float64(2.0) * (m.lam + m.mu) * c * c * wp.log(J / BARRIER_J)
    return energy


@wp.func
def volumetric_derivatives(J: wp.float64, m: Constants):
    """(U'(J), U''(J)) for J > 0, Pa."""
    if m.law == NEO_HOOKEAN:
        slope = (m.lam * wp.log(J) - m.mu) / J
        return slope, (m.lam / J - slope) / J
    L = m.lam
    first = wp.float64(0.0)
    if m.law == STABLE_NEO_HOOKEAN:
        L += m.mu
        first = -m.mu
    first += L * (J - wp.float64(1.0))
    second = L
    if J < BARRIER_J:
        c = J - BARRIER_J
        ratio = c / J
        log = wp.log(J / BARRIER_J)
        k = wp.float64(2.0) * (m.lam + m.mu)
        first -= k * (wp.float64(2.0) * c * log + c * ratio)
        second -= k * (wp.float64(2.0) * log + wp.float64(4.0) * ratio - ratio * ratio)
    return first, second


@wp.func
def projected_pair(flip: wp.float64, twist: wp.float64, m: Constants) -> wp.vec2d:
    """[[diagonal, off], [off, diagonal]], positive semidefinite unless m.exact, as (diagonal, off).

    Its eigenvalues are diagonal + off for the symmetric combination (flip) and diagonal - off for the
    antisymmetric one (twist).
    """
    up = flip
    down = twist
    if m.exact == 0:
        up = wp.max(flip, wp.float64(0.0))
        down = wp.max(twist, wp.float64(0.0))
    return wp.vec2d(wp.float64(0.5) * (up + down), wp.float64(0.5) * (up - down))


# ---- Hencky's law, with the condensed potential W of `gdpro_sim.kernels.plasticity` ----


@wp.func
def hencky_energy(s: wp.vec3d, m: Constants) -> wp.float64:
    """W, J/m^3; infinite where the last singular value is not positive."""
    if s[2] <= wp.float64(0.0):
        return wp.float64(wp.inf)
    e = log_stretches(s)
    trace = e[0] + e[1] + e[2]
    over = excess_stress(e, m.mu, m.limit)
    elastic = m.mu * wp.dot(e, e) + wp.float64(0.5) * m.lam * trace * trace
    return elastic - wp.float64(0.5) * over * over / (wp.float64(3.0) * m.mu + m.hardening)


@wp.func
def hencky_shear(e: wp.vec3d, m: Constants) -> wp.float64:
    """Secant shear modulus: mu, or what plastic flow leaves of it, Pa."""
    over = excess_stress(e, m.mu, m.limit)
    shear = m.mu
    if over > wp.float64(0.0):
        share = wp.float64(3.0) * m.mu / (wp.float64(3.0) * m.mu + m.hardening)
        shear -= m.mu * share * over / equivalent_stress(e, m.mu)
    return shear


@wp.func
def hencky_stress(e: wp.vec3d, shear: wp.float64, m: Constants) -> wp.vec3d:
    """Principal Kirchhoff stresses dW/de, Pa."""
    pressure = (m.lam + wp.float64(2.0) / wp.float64(3.0) * m.mu) * (e[0] + e[1] + e[2])
    return wp.float64(2.0) * shear * deviator(e) + wp.vec3d(pressure, pressure, pressure)


@wp.func
def hencky_quotient(a: wp.float64, b: wp.float64, stress: wp.float64, shear: wp.float64) -> wp.float64:
    """(P_a - P_b) / (a - b) of two stretches, P = (principal Kirchhoff stress) / stretch, exact as a -> b.

    log(u) / (u - 1) of a rounded u near 1 keeps full precision (Higham 2002, "Accuracy and Stability of
    Numerical Algorithms", sec. 1.14.1).
    """
    u = a / b
    ratio = wp.float64(1.0)
    if u != wp.float64(1.0):
        ratio = u * wp.log(u) / (u - wp.float64(1.0))
    return (wp.float64(2.0) * shear * ratio - stress) / (a * b)


@wp.func
def hencky_hessian(s: wp.vec3d, m: Constants):
    """`principal_hessian` of Hencky's law."""
    e = log_stretches(s)
    shear = hencky_shear(e, m)
    tau = hencky_stress(e, shear, m)
    bulk = m.lam + wp.float64(2.0) / wp.float64(3.0) * m.mu
    off = bulk - wp.float64(2.0) / wp.float64(3.0) * shear
    ones = wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
    H = off * wp.outer(ones, ones) + wp.diag(wp.float64(2.0) * shear * ones - tau)
    if shear < m.mu:
        # The radial direction hardens by H alone; the others keep the secant modulus.
        q = equivalent_stress(e, m.mu)
        share = wp.float64(3.0) * m.mu / (wp.float64(3.0) * m.mu + m.hardening)
        n = (ROOT_SIX * m.mu / q) * deviator(e)
        H -= (wp.float64(2.0) * m.mu * share * m.limit / q) * wp.outer(n, n)
    inverse = wp.diag(wp.vec3d(wp.float64(1.0) / s[0], wp.float64(1.0) / s[1], wp.float64(1.0) / s[2]))
    P = inverse * tau
    more = m.pressure * s
    flip0 = hencky_quotient(s[1], s[2], tau[1], shear) - more[0]
    flip1 = hencky_quotient(s[0], s[2], tau[0], shear) - more[1]
    flip2 = hencky_quotient(s[0], s[1], tau[0], shear) - more[2]
    p0 = projected_pair(flip0, (P[1] + P[2]) / (s[1] + s[2]) + more[0], m)
    p1 = projected_pair(flip1, (P[0] + P[2]) / (s[0] + s[2]) + more[1], m)
    p2 = projected_pair(flip2, (P[0] + P[1]) / (s[0] + s[1]) + more[2], m)
    zero = wp.float64(0.0)
    A = inverse * H * inverse
    A += wp.mat33d(zero, more[2], more[1], more[2], zero, more[0], more[1], more[0], zero)
    if m.exact == 0:
        A = project_symmetric(A)
    return A, wp.matrix_from_rows(p0, p1, p2)


# ---- every law ----


@wp.func
def linear_energy(F: wp.mat33d, m: Constants) -> wp.float64:
    e = wp.float64(0.5) * (F + wp.transpose(F)) - wp.identity(n=3, dtype=wp.float64)
    trace = wp.trace(e)
    return m.mu * wp.ddot(e, e) + wp.float64(0.5) * m.lam * trace * trace


@wp.func
def neo_hookean_energy(F: wp.mat33d, m: Constants) -> wp.float64:
    """Of both neo-Hookean laws; infinite where det F <= 0."""
    J = wp.determinant(F)
    if J <= wp.float64(0.0):
        return wp.float64(wp.inf)
    return wp.float64(0.5) * m.mu * (wp.ddot(F, F) - wp.float64(3.0)) + volumetric_energy(J, m)


@wp.func
def needs_stretches(law: int) -> bool:
    """Whether the energy is a function of the singular values of F."""
    return law == STVK_HENCKY or law == COROTATED


@wp.func
def energy_density(F: wp.mat33d, s: wp.vec3d, m: Constants) -> wp.float64:
    """Psi(F), J/m^3; infinite where det F <= 0, but for LINEAR. s are the singular values of F if needed."""
    if m.law == LINEAR:
        return linear_energy(F, m)
    if m.law == STABLE_NEO_HOOKEAN or m.law == NEO_HOOKEAN:
        return neo_hookean_energy(F, m)
    J = wp.determinant(F)
    if J <= wp.float64(0.0):
        return wp.float64(wp.inf)
    if m.law == STVK_HENCKY:
        return hencky_energy(s, m)
    d = s - wp.vec3d(wp.float64(1.0), wp.float64(1.0), wp.float64(1.0))
    return m.mu * wp.dot(d, d) + volumetric_energy(J, m)


@wp.func
def piola_stress_in_frame(F: wp.mat33d, U: wp.mat33d, s: wp.vec3d, V: wp.mat33d, m: Constants) -> wp.mat33d:
    """First Piola-Kirchhoff stress dPsi/dF, Pa, for F = U diag(s) V^T; LINEAR does not look at the latter."""
    if m.law == LINEAR:
        e = wp.float64(0.5) * (F + wp.transpose(F)) - wp.identity(n=3, dtype=wp.float64)
        return wp.float64(2.0) * m.mu * e + m.lam * wp.trace(e) * wp.identity(n=3, dtype=wp.float64)
    if m.law == STVK_HENCKY:
        e_log = log_stretches(s)
        tau = hencky_stress(e_log, hencky_shear(e_log, m), m)
        P = wp.diag(wp.vec3d(tau[0] / s[0], tau[1] / s[1], tau[2] / s[2]))
        return U * P * wp.transpose(V) + m.pressure * determinant_gradient(F)
    first, _second = volumetric_derivatives(wp.determinant(F), m)
    stress = m.mu * F + (first + m.pressure) * determinant_gradient(F)
    if m.law == COROTATED:
        stress += m.mu * F - wp.float64(2.0) * m.mu * (U * wp.transpose(V))
    return stress


@wp.func
def piola_stress(F: wp.mat33d, m: Constants) -> wp.mat33d:
    """First Piola-Kirchhoff stress dPsi/dF, Pa, where F is not inverted."""
    U = wp.identity(n=3, dtype=wp.float64)
    V = wp.identity(n=3, dtype=wp.float64)
    s = wp.vec3d()
    if needs_stretches(m.law):
        U, s, V = singular_value_decomposition(F)
    return piola_stress_in_frame(F, U, s, V, m)


@wp.func
def principal_hessian(s: wp.vec3d, m: Constants):
    """The Hessian of Psi in the frame of the singular vectors; for LINEAR, in that of the axes.

    It is projected to positive semidefinite unless m.exact.

    There it splits into a 3x3 block A over the diagonal of F ("scaling") and, for each pair i != j, a 2x2
    block over (F_ij, F_ji) with the eigenvalues (P_i - P_j) / (s_i - s_j) ("flip") and
    (P_i + P_j) / (s_i + s_j) ("twist"), P_i = dPsi/ds_i (Smith et al. 2019).

    Returns A and `pairs`, whose row k holds (diagonal, off) for the pair without axis k.
    """
    if m.law == STVK_HENCKY:
        return hencky_hessian(s, m)
    if m.law == LINEAR:
        row = wp.vec2d(m.mu, m.mu)
        whole = m.lam + wp.float64(2.0) * m.mu
        # fmt: off
        B = wp.mat33d(
            whole, m.lam, m.lam,
            m.lam, whole, m.lam,
            m.lam, m.lam, whole,
        )
        # fmt: on
        return B, wp.matrix_from_rows(row, row, row)
    first, second = volumetric_derivatives(s[0] * s[1] * s[2], m)
    first += m.pressure
    mu = m.mu
    less = wp.vec3d()
    if m.law == COROTATED:
        mu = wp.float64(2.0) * m.mu
        turn = wp.float64(4.0) * m.mu
        less = wp.vec3d(turn / (s[1] + s[2]), turn / (s[0] + s[2]), turn / (s[0] + s[1]))
    c = wp.vec3d(s[1] * s[2], s[2] * s[0], s[0] * s[1])
    a01 = second * c[0] * c[1] + first * s[2]
    a02 = second * c[0] * c[2] + first * s[1]
    a12 = second * c[1] * c[2] + first * s[0]
    # fmt: off
    A = wp.mat33d(
        mu + second * c[0] * c[0], a01, a02,
        a01, mu + second * c[1] * c[1], a12,
        a02, a12, mu + second * c[2] * c[2],
    )
    # fmt: on
    p0 = projected_pair(mu - first * s[0], mu + first * s[0] - less[0], m)
    p1 = projected_pair(mu - first * s[1], mu + first * s[1] - less[1], m)
    p2 = projected_pair(mu - first * s[2], mu + first * s[2] - less[2], m)
    if m.exact == 0:
        A = project_symmetric(A)
    return A, wp.matrix_from_rows(p0, p1, p2)


@wp.func
def green_strain_increment(F: wp.mat33d, C_previous: wp.mat33d) -> wp.mat33d:
    """(F^T F - C_previous) / 2: zero for any rigid motion since C_previous was taken."""
    return wp.float64(0.5) * (wp.transpose(F) * F - C_previous)


@wp.func
def viscous_energy(strain: wp.mat33d, mu: wp.float64, lam: wp.float64) -> wp.float64:
    """Dissipation potential mu |dE|^2 + lam/2 tr(dE)^2 of a Green-strain increment.

    With (mu, lam) = (Lame parameters) * stiffness damping / dt this is Rayleigh's stiffness damping at small
    strain, but objective: rigid rotation is not damped.
    """
    trace = wp.trace(strain)
    return mu * wp.ddot(strain, strain) + wp.float64(0.5) * lam * trace * trace


@wp.func
def viscous_stress(F: wp.mat33d, strain: wp.mat33d, mu: wp.float64, lam: wp.float64) -> wp.mat33d:
    """First Piola-Kirchhoff stress of `viscous_energy`: F (2 mu dE + lam tr(dE) I)."""
    second = wp.float64(2.0) * mu * strain + lam * wp.trace(strain) * wp.identity(n=3, dtype=wp.float64)
    return F * second


@wp.func
def viscous_hessian(s: wp.vec3d, mu: wp.float64, lam: wp.float64):
    """Gauss-Newton Hessian of `viscous_energy` in the frame of the singular vectors, positive semidefinite.

    Returns A and, in row k of `pairs`, the entries (F_ij, F_ij), (F_ji, F_ji) and (F_ij, F_ji) for the pair
    i < j without axis k.
    """
    squares = wp.cw_mul(s, s)
    A = lam * wp.outer(s, s) + wp.float64(2.0) * mu * wp.diag(squares)
    pairs = mu * wp.matrix_from_rows(
        wp.vec3d(squares[1], squares[2], s[1] * s[2]),
        wp.vec3d(squares[0], squares[2], s[0] * s[2]),
        wp.vec3d(squares[0], squares[1], s[0] * s[1]),
    )
    return A, pairs
