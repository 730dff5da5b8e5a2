"""Surface normals of depth images, and their gradients; see `gdpro_sim.splatting.depth` for the formulas.

With neighbours right, left, down, up of a pixel, its viewing direction (X, Y, 1) and

    A = (z_r - z_l) / (z_r + z_l),  B = (z_d - z_u) / (z_d + z_u)
    p = fx A,  q = fy B + skew A,   m = (p, q, -1 - p X - q Y)

the normal is m R / |m R|, where both sums are positive; else, and on the image's border,
    it is zero. The index
of each kernel is a span of consecutive pixels of one row, worked on in vectors (see
`gdpro_sim.kernels.lanes`).
"""

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

CAMERA_GRADIENTS = 14
"""Per camera: 9 of the rotation, fx, skew, cx, fy, cy."""

_SPAN = f"""
    const int spans = (width + span - 1) / span;
    const int row = index / spans, begin = (index - row * spans) * span;
    const int camera = row / height, y = row - camera * height;
    const int stop = begin + span < width ? begin + span : width;
    int lanes = 1;
{PRELUDE}
    const F zero = splat(0.0f), one = splat(1.0f);
    F numbers = zero;
#if !defined(__CUDACC__)
    for (int j = 0; j < 16; ++j) numbers[j] = (float)j;
#endif
    const float* const z = depth.data + (size_t)row * width;
"""

_NORMAL = """
        const float* const k = (const float*)(intrinsics.data + camera);
        const float fx = k[0], skew = k[1], cx = k[2], fy = k[4], cy = k[5];
        const float* const view = (const float*)(viewmats.data + camera);
        const float r00 = view[0], r01 = view[1], r02 = view[2], r10 = view[4], r11 = view[5], r12 = view[6],
            r20 = view[8], r21 = view[9], r22 = view[10];
        const float Y = ((float)y + 0.5f - cy) / fy;
        // The first and the last pixel of a row have no normal; they read their own depth for both
        // neighbours.
        const F column = numbers + (float)x;
        const I inner = (column > 0.5f) & (column < (float)width - 1.5f);
        F left, right, up, down;
        if (x > 0 && x + LANES < width) {
            left = load(z + x - 1, 1), right = load(z + x + 1, 1);
        } else {
            float before[16], after[16];
            for (int j = 0; j < lanes; ++j) {
                before[j] = z[x + j > 0 ? x + j - 1 : 0];
                after[j] = z[x + j < width - 1 ? x + j + 1 : width - 1];
            }
            left = load(before, 1), right = load(after, 1);
        }
        up = load(z + x - width, 1), down = load(z + x + width, 1);
        const F across0 = right + left, along0 = down + up;
        const I seen = inner & (across0 > 0.0f) & (along0 > 0.0f);
        const F across = select(seen, across0, one), along = select(seen, along0, one);
        const F A = (right - left) / across, B = (down - up) / along;
        const F X = (column + (0.5f - cx - skew * Y)) / fx;
        const F p = fx * A, q = fy * B + skew * A;
        const F m2 = -1.0f - p * X - q * Y;
        const F t0 = p * r00 + q * r10 + m2 * r20, t1 = p * r01 + q * r11 + m2 * r21,
            t2 = p * r02 + q * r12 + m2 * r22;
        const F inverse = 1.0f / sqrt_(t0 * t0 + t1 * t1 + t2 * t2);
        const F n0 = t0 * inverse, n1 = t1 * inverse, n2 = t2 * inverse;
"""

_FORWARD = f"""
{_SPAN}
    float* const normals = normals_out.data + (size_t)row * width * 3;
    for (int x = begin; x < stop; x += LANES) {{
        lanes = stop - x < LANES ? stop - x : LANES;
        float* const out = normals + 3 * x;
        if (y == 0 || y == height - 1) {{
            const F nothing[3] = {{zero, zero, zero}};
            store3(out, nothing);
            continue;
        }}
{_NORMAL}
        const F weight = weights.data ? load(weights.data + (size_t)row * width + x, 1) : one;
        const F normal[3] = {{select(seen, weight * n0, zero), select(seen, weight * n1, zero),
            select(seen, weight * n2, zero)}};
        store3(out, normal);
    }}
"""

_BACKWARD = f"""
{_SPAN}
    float sums[{CAMERA_GRADIENTS}];
    for (int i = 0; i < {CAMERA_GRADIENTS}; ++i) sums[i] = 0.0f;
    const float* const gradients = g_normals.data + (size_t)row * width * 3;
    float* const g_across = g_ratios_out.data + (size_t)row * width;
    float* const g_along = g_across + (size_t)g_ratios_out.shape[1];
    for (int x = begin; x < stop; x += LANES) {{
        lanes = stop - x < LANES ? stop - x : LANES;
        if (y == 0 || y == height - 1) {{
            store(g_across + x, 1, zero);
            store(g_along + x, 1, zero);
            continue;
        }}
{_NORMAL}
        F g[3];
        load3(gradients + 3 * x, g);
        const F weight = weights.data ? load(weights.data + (size_t)row * width + x, 1) : one;
        const F g0 = g[0] * weight, g1 = g[1] * weight, g2 = g[2] * weight;
        const F along_n = g0 * n0 + g1 * n1 + g2 * n2;
        const F h0 = (g0 - along_n * n0) * inverse, h1 = (g1 - along_n * n1) * inverse,
            h2 = (g2 - along_n * n2) * inverse;
        const F gm0 = r00 * h0 + r01 * h1 + r02 * h2, gm1 = r10 * h0 + r11 * h1 + r12 * h2;
        const F gm2 = r20 * h0 + r21 * h1 + r22 * h2;
        const F gp = gm0 - X * gm2, gq = gm1 - Y * gm2;
        store(g_across + x, 1, select(seen, 2.0f * (fx * gp + skew * gq) / across, zero));
        store(g_along + x, 1, select(seen, 2.0f * fy * gq / along, zero));
        if (g_cameras_out.shape[0] > 0) {{
            const F gX = -p * gm2, gY = -q * gm2 - gX * (skew / fx);
            const F terms[{CAMERA_GRADIENTS}] = {{p * h0, p * h1, p * h2, q * h0, q * h1, q * h2, m2 * h0,
                m2 * h1, m2 * h2,
                gp * A - gX * X / fx, gq * A - gX * Y / fx, -gX / fx, gq * B - gY * Y / fy, -gY / fy}};
            for (int i = 0; i < {CAMERA_GRADIENTS}; ++i) sums[i] += total(select(seen, terms[i], zero));
        }}
    }}
    if (g_cameras_out.shape[0] > 0) {{
        for (int i = 0; i < {CAMERA_GRADIENTS}; ++i) g_cameras_out.data[(size_t)index * {CAMERA_GRADIENTS}
            + i] = sums[i];
    }}
"""

_GATHER = f"""
{_SPAN}
    // A(x - 1) has this pixel to its right, A(x + 1) to its left: dA/dz_r = 2 z_l / (z_r + z_l)^2, and so on.
    const float* const g_across = g_ratios.data + (size_t)row * width;
    const float* const g_along = g_across + (size_t)g_ratios.shape[1];
    float* const out = g_depth_out.data + (size_t)row * width;
    for (int x = begin; x < stop; x += LANES) {{
        lanes = stop - x < LANES ? stop - x : LANES;
        const F here = load(z + x, 1);
        F gradient = zero;
        auto share = [&](const float* g, const float* other, float sign) {{
            const F far_ = load(other, 1), sum = here + far_;
            gradient += sign * load(g, 1) * (far_ / select(sum > 0.0f, sum, one));
        }};
        if (x >= 2 && x + LANES + 2 <= width) {{
            share(g_across + x - 1, z + x - 2, 1.0f);
            share(g_across + x + 1, z + x + 2, -1.0f);
        }} else {{
            float g_left[16], g_right[16], left[16], right[16];
            for (int j = 0; j < lanes; ++j) {{
                const int at = x + j;
                g_left[j] = at >= 2 ? g_across[at - 1] : 0.0f;
                left[j] = at >= 2 ? z[at - 2] : 0.0f;
                g_right[j] = at + 2 < width ? g_across[at + 1] : 0.0f;
                right[j] = at + 2 < width ? z[at + 2] : 0.0f;
            }}
            share(g_left, left, 1.0f);
            share(g_right, right, -1.0f);
        }}
        if (y >= 2) share(g_along + x - width, z + x - 2 * width, 1.0f);
        if (y + 2 < height) share(g_along + x + width, z + x + 2 * width, -1.0f);
        store(out + x, 1, gradient);
    }}
"""


@wp.func_native(_FORWARD)
def normals_of_span(
    index: int,
    span: int,
    depth: wp.array[float],
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    weights: wp.array[float],
    normals_out: wp.array[float],
): ...


@wp.kernel
def depth_normals(
    start: int,
    # In:
    span: int,
    depth: wp.array[float],
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    weights: wp.array[float],
    # Out:
    normals_out: wp.array[float],
):
    """Normals [C H W 3] of depth [C H W], times weights [C H W] or, where empty, one. `span` >= 1."""
    normals_of_span(start + wp.tid(), span, depth, viewmats, intrinsics, width, height, weights, normals_out)


@wp.func_native(_BACKWARD)
def gradients_of_span(
    index: int,
    span: int,
    depth: wp.array[float],
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    weights: wp.array[float],
    g_normals: wp.array[float],
    g_ratios_out: wp.array2d[float],
    g_cameras_out: wp.array2d[float],
): ...


@wp.kernel
def depth_normals_backward(
    start: int,
    # In:
    span: int,
    depth: wp.array[float],
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    weights: wp.array[float],
    g_normals: wp.array[float],
    # Out:
    g_ratios_out: wp.array2d[float],
    g_cameras_out: wp.array2d[float],
):
    """Gradients of A and B, times 2 over their denominators: [2, C H W];
    and each span's share of the cameras'.

    `g_cameras_out` [spans of all rows, 14] may be empty: not wanted.
    """
    gradients_of_span(
        start + wp.tid(),
        span,
        depth,
        viewmats,
        intrinsics,
        width,
        height,
        weights,
        g_normals,
        g_ratios_out,
        g_cameras_out,
    )


@wp.func_native(_GATHER)
def gather_span(
    index: int,
    span: int,
    depth: wp.array[float],
    width: int,
    height: int,
    g_ratios: wp.array2d[float],
    g_depth_out: wp.array[float],
): ...


@wp.kernel
def depth_normals_gather(
    start: int,
    # In:
    span: int,
    depth: wp.array[float],
    width: int,
    height: int,
    g_ratios: wp.array2d[float],
    # Out:
    g_depth_out: wp.array[float],
):
    """Gradient of depth from what `depth_normals_backward` left."""
    gather_span(start + wp.tid(), span, depth, width, height, g_ratios, g_depth_out)
