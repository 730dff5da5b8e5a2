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


HARMONICS = f"""
    // Unit direction from the camera, for a rigid view matrix: R^T (R mean + t), normalized.
    const F vx = r00 * x + r10 * y + r20 * z, vy = r01 * x + r11 * y + r21 * z,
        vz = r02 * x + r12 * y + r22 * z;
    const F distance = sqrt_(vx * vx + vy * vy + vz * vz);
    const F ux = vx / distance, uy = vy / distance, uz = vz / distance;
    const F uxx = ux * ux, uyy = uy * uy, uzz = uz * uz;
    const int terms = (degree + 1) * (degree + 1);
    F basis[16];
    basis[0] = splat({float(C0)!r}f);
    if (degree >= 1) {{
        basis[1] = {-C1!r}f * uy;
        basis[2] = {float(C1)!r}f * uz;
        basis[3] = {-C1!r}f * ux;
    }}
    if (degree >= 2) {{
        basis[4] = {float(C2_0)!r}f * ux * uy;
        basis[5] = {-C2_0!r}f * uy * uz;
        basis[6] = {float(C2_1)!r}f * (2.0f * uzz - uxx - uyy);
        basis[7] = {-C2_0!r}f * ux * uz;
        basis[8] = {float(C2_2)!r}f * (uxx - uyy);
    }}
    if (degree >= 3) {{
        basis[9] = {float(C3_0)!r}f * uy * (uyy - 3.0f * uxx);
        basis[10] = {float(C3_1)!r}f * ux * uy * uz;
        basis[11] = {-C3_2!r}f * uy * (4.0f * uzz - uxx - uyy);
        basis[12] = {float(C3_3)!r}f * uz * (2.0f * uzz - 3.0f * uxx - 3.0f * uyy);
        basis[13] = {-C3_2!r}f * ux * (4.0f * uzz - uxx - uyy);
        basis[14] = {float(C3_4)!r}f * uz * (uxx - uyy);
        basis[15] = {float(C3_0)!r}f * ux * (3.0f * uyy - uxx);
    }}
    const int stride = 3 * sh.shape[1];
    const float* const coefficients = (const float*)sh.data + (size_t)n * stride;
    F term[48];
    const int whole = 3 * terms / 16 * 16;
    for (int i = 0; i < whole; i += 16) load_rows(coefficients + i, stride, term + i);
    for (int i = whole; i < 3 * terms; ++i) term[i] = load(coefficients + i, stride);
    F red = splat(0.5f), green = splat(0.5f), blue = splat(0.5f);
    for (int k = 0; k < terms; ++k) {{
        red += basis[k] * term[3 * k];
        green += basis[k] * term[3 * k + 1];
        blue += basis[k] * term[3 * k + 2];
    }}
"""
"""Snippet (see `gdpro_sim.kernels.lanes`): camera point x, y, z, rotation rij, `sh` and first Gaussian `n` ->
red, green, blue = sum + 0.5, and what the gradient needs: term, basis, (ux, uy, uz), distance."""

HARMONICS_GRADIENT = f"""
    // g_red, g_green, g_blue -> gradients of the coefficients and of the direction (gux, guy, guz).
    F gux = splat(0.0f), guy = splat(0.0f), guz = splat(0.0f);
    float* const g_coefficients = (float*)g_sh_out.data + (size_t)n * stride;
    F along[16];
    for (int k = 0; k < terms; ++k) {{
        along[k] = g_red * term[3 * k] + g_green * term[3 * k + 1] + g_blue * term[3 * k + 2];
        along[k] = select(shown, along[k], splat(0.0f));
        term[3 * k] = select(shown, basis[k] * g_red, splat(0.0f));
        term[3 * k + 1] = select(shown, basis[k] * g_green, splat(0.0f));
        term[3 * k + 2] = select(shown, basis[k] * g_blue, splat(0.0f));
    }}
    for (int i = 0; i < 3 * terms; ++i) if (camera > 0) term[i] += load(g_coefficients + i, stride);
    for (int i = whole; i < 3 * terms; ++i) store(g_coefficients + i, stride, term[i]);
    for (int i = 0; i < whole; i += 16) store_rows(g_coefficients + i, stride, term + i);
    if (degree >= 1) {{
        gux -= {float(C1)!r}f * along[3];
        guy -= {float(C1)!r}f * along[1];
        guz += {float(C1)!r}f * along[2];
    }}
    if (degree >= 2) {{
        const F a4 = {float(C2_0)!r}f * along[4], a5 = {float(C2_0)!r}f * along[5];
        const F a6 = {2 * C2_1!r}f * along[6], a7 = {float(C2_0)!r}f * along[7],
            a8 = {2 * C2_2!r}f * along[8];
        gux += uy * a4 - ux * a6 - uz * a7 + ux * a8;
        guy += ux * a4 - uz * a5 - uy * a6 - uy * a8;
        guz += 2.0f * uz * a6 - uy * a5 - ux * a7;
    }}
    if (degree >= 3) {{
        const F a9 = {3 * C3_0!r}f * along[9], a10 = {float(C3_1)!r}f * along[10];
        const F a11 = {float(C3_2)!r}f * along[11], a12 = {3 * C3_3!r}f * along[12];
        const F a13 = {float(C3_2)!r}f * along[13], a14 = {float(C3_4)!r}f * along[14];
        const F a15 = {3 * C3_0!r}f * along[15];
        const F disc = 4.0f * uzz - uxx - uyy;
        gux += uy * uz * a10 - 2.0f * ux * uy * (a9 - a11) - 2.0f * ux * uz * (a12 - a14)
            - (disc - 2.0f * uxx) * a13 + (uyy - uxx) * a15;
        guy += (uyy - uxx) * a9 + ux * uz * a10 - (disc - 2.0f * uyy) * a11 - 2.0f * uy * uz * (a12 + a14)
            + 2.0f * ux * uy * (a13 + a15);
        guz += ux * uy * a10 - 8.0f * uz * (uy * a11 + ux * a13) + (2.0f * uzz - uxx - uyy) * a12
            + (uxx - uyy) * a14;
    }}
    const F radial = gux * ux + guy * uy + guz * uz;
    const F gvx = (gux - radial * ux) / distance, gvy = (guy - radial * uy) / distance,
        gvz = (guz - radial * uz) / distance;
"""
"""Snippet: after HARMONICS, with `shown` a mask of the lanes drawn and zero colour gradients elsewhere ->
(gvx, gvy, gvz), the gradient of R^T (x, y, z); writes `g_sh_out`, or adds to it where camera > 0."""
