"""Real spherical harmonics up to degree 3, in the order and with the signs of 3D Gaussian Splatting.

The basis is Sloan, "Efficient Spherical Harmonic Evaluation" (JCGT 2013), with the Condon-Shortley phase.
"""

import warp as wp

C0 = wp.constant(0.28209479177387814)
C1 = wp.constant(0.4886025119029199)
C2_0 = wp.constant(1.0925484305920792)
C2_1 = wp.constant(0.31539156525252005)
C2_2 = wp.constant(0.5462742152960396)
C3_0 = wp.constant(0.5900435899266435)
C3_1 = wp.constant(2.890611442640554)
C3_2 = wp.constant(0.4570457994644658)
C3_3 = wp.constant(0.3731763325901154)
C3_4 = wp.constant(1.445305721320277)


@wp.func
def harmonics_sum(sh: wp.array2d[wp.vec3], i: int, degree: int, direction: wp.vec3) -> wp.vec3:
    """Sum over k < (degree + 1)^2 of sh[i, k] Y_k(direction); `direction` has unit length."""
    x = direction[0]
    y = direction[1]
    z = direction[2]
    value = C0 * sh[i, 0]
    if degree >= 1:
        value += C1 * (z * sh[i, 2] - y * sh[i, 1] - x * sh[i, 3])
    if degree >= 2:
        xx = x * x
        yy = y * y
        zz = z * z
        value += C2_0 * (x * y * sh[i, 4] - y * z * sh[i, 5] - x * z * sh[i, 7])
        value += C2_1 * (2.0 * zz - xx - yy) * sh[i, 6] + C2_2 * (xx - yy) * sh[i, 8]
        if degree >= 3:
            value += C3_0 * (y * (yy - 3.0 * xx) * sh[i, 9] + x * (3.0 * yy - xx) * sh[i, 15])
            value += C3_1 * x * y * z * sh[i, 10] + C3_4 * z * (xx - yy) * sh[i, 14]
            value -= C3_2 * (4.0 * zz - xx - yy) * (y * sh[i, 11] + x * sh[i, 13])
            value += C3_3 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy) * sh[i, 12]
    return value
