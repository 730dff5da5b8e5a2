"""Eigenvalues, singular values and the nearest semidefinite matrix of 3x3 matrices, float64.

Warp's own `svd3` and `eig3` are float32 approximations (errors of 3e-3 to 5e-3, measured); these are exact to
round-off.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

JACOBI_SWEEPS = wp.constant(8)


@wp.func
def jacobi_rotation(app: wp.float64, aqq: wp.float64, apq: wp.float64):
    """Cosine and sine of the rotation that diagonalises a symmetric 2x2 (Golub & Van Loan, 8.5.2)."""
    c = wp.float64(1.0)
    s = wp.float64(0.0)
    if apq != wp.float64(0.0):
        tau = (aqq - app) / (wp.float64(2.0) * apq)
        t = wp.float64(1.0) / (wp.abs(tau) + wp.sqrt(wp.float64(1.0) + tau * tau))
        if tau < wp.float64(0.0):
            t = -t
        c = wp.float64(1.0) / wp.sqrt(wp.float64(1.0) + t * t)
        s = t * c
    return c, s


@wp.func
def eigen_symmetric(A: wp.mat33d):
    """Eigenvalues and eigenvectors (columns, a rotation) of a symmetric 3x3 by cyclic Jacobi sweeps."""
    a00 = A[0, 0]
    a11 = A[1, 1]
    a22 = A[2, 2]
    a01 = A[0, 1]
    a02 = A[0, 2]
    a12 = A[1, 2]
    v0 = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
    v1 = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
    v2 = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    for _sweep in range(JACOBI_SWEEPS):
        off = a01 * a01 + a02 * a02 + a12 * a12
        if off <= wp.float64(1.0e-24) * (a00 * a00 + a11 * a11 + a22 * a22):
            break
        c, s = jacobi_rotation(a00, a11, a01)
        b00 = c * c * a00 - wp.float64(2.0) * c * s * a01 + s * s * a11
        b11 = s * s * a00 + wp.float64(2.0) * c * s * a01 + c * c * a11
        b02 = c * a02 - s * a12
        b12 = s * a02 + c * a12
        w0 = c * v0 - s * v1
        v1 = s * v0 + c * v1
        v0 = w0
        a00 = b00
        a11 = b11
        a01 = wp.float64(0.0)
        a02 = b02
        a12 = b12

        c, s = jacobi_rotation(a00, a22, a02)
        b00 = c * c * a00 - wp.float64(2.0) * c * s * a02 + s * s * a22
        b22 = s * s * a00 + wp.float64(2.0) * c * s * a02 + c * c * a22
        b01 = c * a01 - s * a12
        b12 = s * a01 + c * a12
        w0 = c * v0 - s * v2
        v2 = s * v0 + c * v2
        v0 = w0
        a00 = b00
        a22 = b22
        a02 = wp.float64(0.0)
        a01 = b01
        a12 = b12

        c, s = jacobi_rotation(a11, a22, a12)
        b11 = c * c * a11 - wp.float64(2.0) * c * s * a12 + s * s * a22
        b22 = s * s * a11 + wp.float64(2.0) * c * s * a12 + c * c * a22
        b01 = c * a01 - s * a02
        b02 = s * a01 + c * a02
        w0 = c * v1 - s * v2
        v2 = s * v1 + c * v2
        v1 = w0
        a11 = b11
        a22 = b22
        a12 = wp.float64(0.0)
        a01 = b01
        a02 = b02
    return wp.vec3d(a00, a11, a22), wp.matrix_from_cols(v0, v1, v2)


@wp.func
def singular_value_decomposition(F: wp.mat33d):
    """F = U diag(s) V^T with U and V rotations; s[2], the smallest in size, carries the sign of det F."""
    values, vectors = eigen_symmetric(wp.transpose(F) * F)
    e0 = values[0]
    e1 = values[1]
    e2 = values[2]
    v0 = wp.vec3d(vectors[0, 0], vectors[1, 0], vectors[2, 0])
    v1 = wp.vec3d(vectors[0, 1], vectors[1, 1], vectors[2, 1])
    v2 = wp.vec3d(vectors[0, 2], vectors[1, 2], vectors[2, 2])
    if e0 < e1:
        t = e0
        e0 = e1
        e1 = t
        w = v0
        v0 = v1
        v1 = w
    if e0 < e2:
        t = e0
        e0 = e2
        e2 = t
        w = v0
        v0 = v2
        v2 = w
    if e1 < e2:
        w = v1
        v1 = v2
        v2 = w
    v2 = wp.cross(v0, v1)
    f0 = F * v0
    s0 = wp.length(f0)
    u0 = f0 / s0
    f1 = F * v1
    w1 = f1 - wp.dot(f1, u0) * u0
    s1 = wp.length(w1)
    u1 = w1 / s1
    if s1 <= wp.float64(1.0e-12) * s0:
        # F squeezes space to a line: any direction perpendicular to u0 serves.
        axis = wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))
        if wp.abs(u0[0]) > wp.float64(0.7):
            axis = wp.vec3d(wp.float64(0.0), wp.float64(1.0), wp.float64(0.0))
        u1 = wp.normalize(wp.cross(u0, axis))
    u2 = wp.cross(u0, u1)
    s2 = wp.dot(u2, F * v2)
    return wp.matrix_from_cols(u0, u1, u2), wp.vec3d(s0, s1, s2), wp.matrix_from_cols(v0, v1, v2)


@wp.func
def project_symmetric(A: wp.mat33d) -> wp.mat33d:
    """The nearest positive semidefinite matrix in the Frobenius norm."""
    minor = A[0, 0] * A[1, 1] - A[0, 1] * A[0, 1]
    # Sylvester's criterion: most elements pass and skip the eigenvectors.
    if A[0, 0] > wp.float64(0.0) and minor > wp.float64(0.0) and wp.determinant(A) > wp.float64(0.0):
        return A
    values, vectors = eigen_symmetric(A)
    clamped = wp.vec3d(
        wp.max(values[0], wp.float64(0.0)),
        wp.max(values[1], wp.float64(0.0)),
        wp.max(values[2], wp.float64(0.0)),
    )
    return vectors * wp.diag(clamped) * wp.transpose(vectors)
