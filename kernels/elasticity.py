"""Constitutive models: energy density, first Piola-Kirchhoff stress, and the projected Hessian.

Stable neo-Hookean (Smith, de Goes & Kim 2018, "Stable Neo-Hookean Flesh Simulation", ACM TOG 37(2)), eq. 13
without the logarithmic rest-stability term, as in Kim & Eberle, "Dynamic Deformables" (2020), ch. 6:

    Psi(F) = mu/2 (F:F - 3) + U(det F),   U(J) = -mu (J - 1) + L/2 (J - 1)^2 + barrier(J)

with L = lambda + mu so that small strains see the Lame parameters (lambda, mu). The barrier is zero for
J >= 0.2 and grows without bound as J -> 0, so that a line search that rejects infinite energy keeps every
element uninverted: barrier(J) = -k (J - J0)^2 ln(J / J0), the C2 clamped logarithm of Li et al. 2020,
"Incremental Potential Contact", eq. 6, with the volume ratio in place of a distance.

All functions are float64: the incremental potential is compared between nearly equal states, and a stiff
body's stress is a small difference of large numbers. Measured on the CPU, float64 costs about 10 % here.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import project_symmetric

wp.set_module_options({"enable_backward": False})

BARRIER_J = wp.constant(wp.float64(0.2))
"""Volume ratio below which an element resists further compression without bound."""


@wp.func
def determinant_gradient(F: wp.mat33d) -> wp.mat33d:
    """Gradient of det F with respect to F: the cofactor matrix."""
    f0 = wp.vec3d(F[0, 0], F[1, 0], F[2, 0])
    f1 = wp.vec3d(F[0, 1], F[1, 1], F[2, 1])
    f2 = wp.vec3d(F[0, 2], F[1, 2], F[2, 2])
    return wp.matrix_from_cols(wp.cross(f1, f2), wp.cross(f2, f0), wp.cross(f0, f1))


@wp.func
def volumetric_energy(J: wp.float64, mu: wp.float64, lam: wp.float64) -> wp.float64:
    """U(J); infinite for J <= 0. `lam` is the Lame parameter lambda."""
    if J <= wp.float64(0.0):
        return wp.float64(wp.inf)
    L = lam + mu
    d = J - wp.float64(1.0)
    energy = wp.float64(0.5) * L * d * d - mu * d
    if J < BARRIER_J:
        c = J - BARRIER_J
        energy -= wp.float64(2.0) * L * c * c * wp.log(J / BARRIER_J)
    return energy


@wp.func
def volumetric_derivatives(J: wp.float64, mu: wp.float64, lam: wp.float64):
    """(U'(J), U''(J)) for J > 0."""
    L = lam + mu
    first = L * (J - wp.float64(1.0)) - mu
    second = L
    if J < BARRIER_J:
        c = J - BARRIER_J
        ratio = c / J
        log = wp.log(J / BARRIER_J)
        k = wp.float64(2.0) * L
        first -= k * (wp.float64(2.0) * c * log + c * ratio)
        second -= k * (wp.float64(2.0) * log + wp.float64(4.0) * ratio - ratio * ratio)
    return first, second


@wp.func
def energy_density(F: wp.mat33d, mu: wp.float64, lam: wp.float64) -> wp.float64:
    """Psi(F), J/m^3; infinite where det F <= 0."""
    shear = wp.float64(0.5) * mu * (wp.ddot(F, F) - wp.float64(3.0))
    return shear + volumetric_energy(wp.determinant(F), mu, lam)


@wp.func
def piola_stress(F: wp.mat33d, mu: wp.float64, lam: wp.float64) -> wp.mat33d:
    """First Piola-Kirchhoff stress P = mu F + U'(J) cof F, Pa."""
    first, _second = volumetric_derivatives(wp.determinant(F), mu, lam)
    return mu * F + first * determinant_gradient(F)


@wp.func
def projected_pair(diagonal: wp.float64, off: wp.float64) -> wp.vec2d:
    """Projection of [[diagonal, off], [off, diagonal]] to positive semidefinite, as (diagonal, off)."""
    twist = wp.max(diagonal + off, wp.float64(0.0))
    flip = wp.max(diagonal - off, wp.float64(0.0))
    return wp.vec2d(wp.float64(0.5) * (twist + flip), wp.float64(0.5) * (twist - flip))


@wp.func
def principal_hessian(s: wp.vec3d, mu: wp.float64, lam: wp.float64):
    """The projected Hessian of Psi in the frame of the singular vectors.

    Smith et al. 2018, section 4: there it splits into a 3x3 block A over the diagonal of F ("scaling") and,
    for each pair i != j, a 2x2 block [[mu, b_ij], [b_ij, mu]] over (F_ij, F_ji) whose eigenvalues
    mu +- U'(J) s_k are the twist and flip modes.

    Returns A (projected) and `pairs`, whose row k holds (diagonal, off) for the pair without axis k.
    """
    first, second = volumetric_derivatives(s[0] * s[1] * s[2], mu, lam)
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
    p0 = projected_pair(mu, -first * s[0])
    p1 = projected_pair(mu, -first * s[1])
    p2 = projected_pair(mu, -first * s[2])
    pairs = wp.matrix_from_rows(p0, p1, p2)
    return project_symmetric(A), pairs


@wp.func
def principal_block(
    A: wp.mat33d,
    pairs: wp.types.matrix(shape=(3, 2), dtype=wp.float64),
    a: wp.vec3d,
    b: wp.vec3d,
) -> wp.mat33d:
    """Block (a, b) of the element Hessian in the singular frame, for rotated shape gradients V^T grad N."""
    # fmt: off
    return wp.mat33d(
        A[0, 0] * a[0] * b[0] + pairs[2, 0] * a[1] * b[1] + pairs[1, 0] * a[2] * b[2],
        A[0, 1] * a[0] * b[1] + pairs[2, 1] * a[1] * b[0],
        A[0, 2] * a[0] * b[2] + pairs[1, 1] * a[2] * b[0],
        A[0, 1] * a[1] * b[0] + pairs[2, 1] * a[0] * b[1],
        A[1, 1] * a[1] * b[1] + pairs[2, 0] * a[0] * b[0] + pairs[0, 0] * a[2] * b[2],
        A[1, 2] * a[1] * b[2] + pairs[0, 1] * a[2] * b[1],
        A[0, 2] * a[2] * b[0] + pairs[1, 1] * a[0] * b[2],
        A[1, 2] * a[2] * b[1] + pairs[0, 1] * a[1] * b[2],
        A[2, 2] * a[2] * b[2] + pairs[1, 0] * a[0] * b[0] + pairs[0, 0] * a[1] * b[1],
    )
    # fmt: on


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
def viscous_block(s: wp.vec3d, a: wp.vec3d, b: wp.vec3d, mu: wp.float64, lam: wp.float64) -> wp.mat33d:
    """Gauss-Newton block (a, b) of `viscous_energy` in the singular frame; positive semidefinite."""
    S = wp.diag(s)
    inner = mu * wp.outer(b, a) + lam * wp.outer(a, b) + wp.diag(wp.vec3d(mu * wp.dot(a, b)))
    return S * inner * S
