"""Gradients of `gdpro_sim.kernels.surfel_compositing`, front to back again over the same lists.

With weight w_i = alpha_i T_i, and with q_i the gradient at w_i of all images,

    q_i = c_i . g + z_i g_depth + NORMAL_i . g_normal + 2 g_distortion (z_i B_i + D - D_i - D_(i-1))
    B_i = A_(i-1) - (A - A_i)           A_i, D_i: sums of w and w z up to i; A, D: of all

the gradient at alpha_i is T_i q_i - R_i / (1 - alpha_i) with R_i as in
`gdpro_sim.kernels.compositing_backward`: it starts as the sum of all w_j q_j, where those of the distortion
add up to twice it, and loses w_i q_i at every surfel. The gradient at z_i is
w_i (g_depth + 2 g_distortion B_i), and that of the median where i is the median. Sums over a tile's pixels
go to the surfel's gradient, see `gdpro_sim.kernels.surfels_backward`; in place of EXTENT and BLUR the
sums over pixels of the absolute gradient at the mean.
"""

import warp as wp

from gdpro_sim.kernels.compositing import BATCH_BACKWARD, LN2, LOCATE_PIXEL, LOCATE_TILE
from gdpro_sim.kernels.compositing_backward import AGAIN, SPILL, STILL_ALIVE, WARP_SUMS
from gdpro_sim.kernels.images import IMAGES
from gdpro_sim.kernels.lanes import CPU_FLAGS, SUM_LANES
from gdpro_sim.kernels.slabs import SLAB_ROWS
from gdpro_sim.kernels.surfel_compositing import (
    BATCH,
    BATCH_STATE,
    EXP,
    HIT,
    HIT_DISC,
    LOW,
    PIXEL_RAY,
    RAY,
    SCALAR,
    VECTOR,
    WEIGH,
)
from gdpro_sim.kernels.surfels import (
    BLUR,
    BOX,
    CENTER,
    CHANNELS,
    DEPTH,
    EXTENT,
    LOG2_OPACITY,
    MEAN,
    NORMAL,
    RECORD,
    SLOPE,
    U,
    V,
)

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

ABSOLUTE = (EXTENT, BLUR)
"""Where the sums of absolute gradients at the mean's x and y go."""

_STATE = """
    F R[SIZE], D[SIZE], g0[SIZE], g1[SIZE], g2[SIZE], g_depth[SIZE], h0[SIZE], h1[SIZE], h2[SIZE];
    F g_bend[SIZE], D_all[SIZE], T_end[SIZE], g_median[SIZE];
    I median_at[SIZE];
    const bool with_distortion = g_distortion.data != 0, with_median = g_medians.data != 0;
    for (int i = 0; i < SIZE; ++i) {
        R[i] = D[i] = g0[i] = g1[i] = g2[i] = g_depth[i] = h0[i] = h1[i] = h2[i] = zero;
        g_bend[i] = D_all[i] = T_end[i] = g_median[i] = zero;
        median_at[i] = (I)-1;
    }
"""

_PIXEL_GRADIENT = """
            // An expected depth D / alpha counts as D with a gradient at alpha of its own.
            float behind = 0.0f, on_alpha = g_alphas.data ? g_alphas.data[pixel] : 0.0f;
            float gradient[4] = {0.0f, 0.0f, 0.0f, 0.0f}, normal[3] = {0.0f, 0.0f, 0.0f};
            const float t_end = transmittance.data[pixel];
            for (int i = 0; i < channels_out; ++i) {
                float g = g_image.data[pixel * channels_out + i];
                const float value = image.data[pixel * channels_out + i];
                behind += value * g;
                if (i == colours && divided) {
                    const float alpha = 1.0f - t_end;
                    if (alpha > 1e-10f) on_alpha -= g * value / alpha;
                    g /= alpha > 1e-10f ? alpha : 1e-10f;
                }
                gradient[i < colours ? i : 3] = g;
            }
            if (g_normals.data) {
                for (int i = 0; i < 3; ++i) {
                    normal[i] = g_normals.data[3 * pixel + i];
                    behind += normal[i] * normals.data[3 * pixel + i];
                }
            }
            if (with_distortion) behind += 2.0f * g_distortion.data[pixel] * distortion.data[pixel];
            behind -= t_end * on_alpha;
"""
"""Snippet: `pixel` -> gradients at its sums and `behind`, the first R."""

_GRADIENT = f"""
            F q = fma((F)c[0], g0[k], fma((F)c[1], g1[k], c[2] * g2[k]));
            F g_z = zero;
            if (geometry) {{
                q = fma((F)r[{NORMAL}], h0[k], fma((F)r[{NORMAL + 1}], h1[k], q));
                q = fma((F)r[{NORMAL + 2}], h2[k], q);
                g_z = g_depth[k];
                q = fma(z, g_z, q);
                if (with_distortion) {{
                    const F before = D[k], now = fma(w, z, before);
                    const F B = (one - t) - ((t - w) - T_end[k]);
                    g_z = fma(g_bend[k], B, g_z);
                    q = fma(g_bend[k], fma(z, B, (D_all[k] - before) - now), q);
                    D[k] = now;
                }}
                g_z = w * g_z;
                if (with_median) g_z += median_at[k] == (I)number ? g_median[k] : zero;
            }}
            const F behind = fma(-w, q, R[k]);
            R[k] = behind;
            // alpha times the gradient at alpha, with T (1 - alpha) = next.
            const F g_log = {2 * LN2!r}f * w * fma(-behind, reciprocal(next), q);
            const F g_p = (blend & (raw <= alpha_max)) ? g_log : zero;
"""
"""Snippet: weight and depth of block k -> gradient g_z at z and g_p, 2 ln 2 times that at p."""

_CHAIN = """
            const F g_u = g_p * inverse * u, g_v = g_p * inverse * v;
            const F g_depth_ = g_z * inverse;
            const F g_w = fma(g_u, u, fma(g_v, v, -g_depth_ * z));
"""
"""Snippet: -> minus the gradients at U . e and V . e, that at W and that at DEPTH, where the disc is hit."""

_CHAIN_BLUR = """
            const F on_disc_p = hit ? g_p : zero, g_low = log2_e * (hit ? zero : g_p);
            const F g_u = on_disc_p * inverse * u, g_v = on_disc_p * inverse * v;
            const F g_depth_ = g_z * scale;
            const F g_w = fma(g_u, u, fma(g_v, v, hit ? -g_depth_ * z : zero));
"""

_ADD = """
            sum_p += g_p;
            sum_z += g_depth_;
            sum_u += g_u;
            sum_v += g_v;
            sum_w += g_w;
            sum_ux = fma(at_x, g_u, sum_ux);
            sum_uy = fma(at_y, g_u, sum_uy);
            sum_vx = fma(at_x, g_v, sum_vx);
            sum_vy = fma(at_y, g_v, sum_vy);
            sum_wx = fma(at_x, g_w, sum_wx);
            sum_wy = fma(at_y, g_w, sum_wy);
            sum_0 = fma(w, g0[k], sum_0);
            sum_1 = fma(w, g1[k], sum_1);
            sum_2 = fma(w, g2[k], sum_2);
            if (geometry) {
                sum_n0 = fma(w, h0[k], sum_n0);
                sum_n1 = fma(w, h1[k], sum_n1);
                sum_n2 = fma(w, h2[k], sum_n2);
            }
"""

_ABSOLUTE = f"""
            if (absolute) {{
                abs_x += abs_(fma((F)r[{U}], g_u, fma((F)r[{V}], g_v, -r[{SLOPE}] * g_w)) LOW_X);
                abs_y += abs_(fma((F)r[{U + 1}], g_u, fma((F)r[{V + 1}], g_v, -r[{SLOPE + 1}] * g_w)) LOW_Y);
            }}
"""

_ADD_DISC = _ADD + _ABSOLUTE.replace(" LOW_X", "").replace(" LOW_Y", "")
_ADD_BLUR = (
    _ADD
    + """
            sum_lx = fma(dx, g_low, sum_lx);
            sum_ly = fma(dy, g_low, sum_ly);
"""
    + _ABSOLUTE.replace("LOW_X", "+ dx * g_low").replace("LOW_Y", "+ dy * g_low")
)

_ZERO = """
            F sum_p = zero, sum_z = zero, sum_u = zero, sum_v = zero, sum_w = zero, sum_lx = zero,
                sum_ly = zero;
            F sum_ux = zero, sum_uy = zero, sum_vx = zero, sum_vy = zero, sum_wx = zero, sum_wy = zero;
            F sum_0 = zero, sum_1 = zero, sum_2 = zero, sum_n0 = zero, sum_n1 = zero, sum_n2 = zero;
            F abs_x = zero, abs_y = zero;
"""

_BATCH = (
    BATCH.replace("{declare}", "I reached = (I)0, softened = (I)0;")
    .replace("{each}", "reached |= (low | disc) & (1 << k); softened |= low & (1 << k);")
    .replace(
        "{end}",
        f"""*(I*)(masks + first) = reached;
            *(I*)(blurs + first) = softened;
            own |= bits((fields[{BOX + 1}] - fields[{BOX + 3}] >= slab_top)
                & (fields[{BOX + 1}] + fields[{BOX + 3}] <= slab_bottom)) << first;
            for (int j = 0; j < 16 && first + j < held; ++j) {{
                const float* const sum = sums_out.data + (size_t)id[at + first + j] * {RECORD};
                __builtin_prefetch(sum, 1);
                __builtin_prefetch(sum + 16, 1);
            }}""",
    )
)

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{VECTOR}{IMAGES}{SUM_LANES}{SLAB_ROWS}
    const int BATCH_SIZE = {BATCH_BACKWARD};
{BATCH_STATE}
    const int channels_out = image.shape[1];
{_STATE}
    F least[16];
    // R starts as the sum of all images times their gradients, as in the text for one pixel below. An
    // expected
    // depth D / alpha counts as D with a gradient at alpha of its own.
    {{
        F end_[16], on_alpha[16], value[4][16];
        F* const ends[1] = {{end_}};
        F* const on_alphas[1] = {{on_alpha}};
        F* const values[4] = {{value[0], value[1], value[2], value[3]}};
        F* const own[4] = {{g0, g1, g2, g_depth}};
        F* gradients[4];
        for (int i = 0; i < channels_out; ++i) gradients[i] = i < colours ? own[i] : g_depth;
        for (int k = 0; k < 16; ++k) on_alpha[k] = zero;
        read_image(transmittance.data, 1, ends);
        if (g_alphas.data) read_image(g_alphas.data, 1, on_alphas);
        read_image(image.data, channels_out, values);
        read_image(g_image.data, channels_out, gradients);
        for (int k = 0; k < 16; ++k) {{
            for (int i = 0; i < channels_out; ++i) R[k] = fma(value[i][k], gradients[i][k], R[k]);
            if (divided) {{
                const F alpha = one - end_[k];
                const F share = g_depth[k] / max_(alpha, (F)1e-10f);
                on_alpha[k] -= alpha > (F)1e-10f ? share * value[colours][k] : zero;
                g_depth[k] = share;
            }}
            R[k] = fma(-end_[k], on_alpha[k], R[k]);
            T_end[k] = end_[k];
            least[k] = 0.999f * end_[k];
        }}
        if (g_normals.data) {{
            F* const own_normals[3] = {{h0, h1, h2}};
            read_image(normals.data, 3, values);
            read_image(g_normals.data, 3, own_normals);
            for (int k = 0; k < 16; ++k) {{
                R[k] = fma(value[0][k], h0[k], fma(value[1][k], h1[k], fma(value[2][k], h2[k], R[k])));
            }}
        }}
        if (with_distortion) {{
            F* const bends[1] = {{g_bend}};
            F* const depth_sums[1] = {{D_all}};
            read_image(distortion.data, 1, values);
            read_image(g_distortion.data, 1, bends);
            read_image(depths.data, 1, depth_sums);
            for (int k = 0; k < 16; ++k) {{
                g_bend[k] = g_bend[k] + g_bend[k];
                R[k] = fma(value[0][k], g_bend[k], R[k]);
            }}
        }}
        if (with_median) {{
            F* const own_medians[1] = {{g_median}};
            F* const positions[1] = {{(F*)median_at}};
            read_image(g_medians.data, 1, own_medians);
            read_image((const float*)medians_at.data, 1, positions);
        }}
    }}

    int spill = spill_begins.shape[0] ? spill_begins.data[tile] : 0;
    const int end = stops.data[tile];
    const int WIDTH = {RECORD};
    for (int at = begin; at < end && alive;) {{
        int masks[BATCH_SIZE] __attribute__((aligned(64))),
            blurs[BATCH_SIZE] __attribute__((aligned(64)));
        unsigned own = 0;
{_BATCH}
        for (int i = 0; i < held; ++i) {{
            const int number = at + i;
            unsigned mask = (unsigned)masks[i] & alive;
            if (!mask) continue;
            unsigned blurred = mask & (unsigned)blurs[i];
            mask &= ~blurred;
            const size_t g = (size_t)id[number];
{_ZERO}
            while (mask) {{
                const int k = __builtin_ctz(mask);
                mask &= mask - 1;
                const F x = X[k], y = Y[k], at_x = x, at_y = y;
{RAY}{HIT_DISC}{AGAIN}{_GRADIENT}{_CHAIN}{_ADD_DISC}
            }}
            while (blurred) {{
                const int k = __builtin_ctz(blurred);
                blurred &= blurred - 1;
                const F x = X[k], y = Y[k], at_x = x, at_y = y;
{RAY}{LOW}{HIT}{AGAIN}{_GRADIENT}{_CHAIN_BLUR}{_ADD_BLUR}
            }}
{SPILL}
            // Offsets e from the centre are X, Y plus those of the tile.
            const float* const r = rows[i];
            const F ex = (F)((float)tile_x + 0.5f - r[{CENTER}]),
                ey = (F)((float)tile_y + 0.5f - r[{CENTER + 1}]);
            const F center_x = fma((F)r[{U}], sum_u, fma((F)r[{V}], sum_v, -r[{SLOPE}] * sum_w));
            const F center_y = fma((F)r[{U + 1}], sum_u, fma((F)r[{V + 1}], sum_v, -r[{SLOPE + 1}] * sum_w));
            const F sums[16] = {{
                center_x + sum_lx, center_y + sum_ly, center_x, center_y,
                -fma(ex, sum_u, sum_ux), -fma(ey, sum_u, sum_uy), -fma(ex, sum_v, sum_vx),
                    -fma(ey, sum_v, sum_vy),
                fma(ex, sum_w, sum_wx), fma(ey, sum_w, sum_wy), abs_x, abs_y, zero, zero, zero, zero,
            }};
            F total;
            __builtin_memcpy(&total, out, 64);
            total += sum_lanes(sums);
            __builtin_memcpy(out, &total, 64);
            const F b0 = MERGE_4(one_half * sum_p, sum_n2), b1 = MERGE_4(sum_z, sum_0);
            const F b2 = MERGE_4(sum_n0, sum_1), b3 = MERGE_4(sum_n1, sum_2);
            const F c0 = MERGE_2(b0, b2), c1 = MERGE_2(b1, b3), b = MERGE_1(c0, c1), later = MERGE_8(b, b);
            for (int j = 0; j < 8; ++j) out[16 + j] += later[j];
        }}
        at += held;
{STILL_ALIVE}
    }}
#endif
"""

assert (MEAN, CENTER, U, V, SLOPE, *ABSOLUTE) == (0, 2, 4, 6, 8, 10, 11)
assert (LOG2_OPACITY, DEPTH, NORMAL, CHANNELS) == (16, 17, 18, 21), "the order of the sums above"


@wp.func_native(_TILE)
def tile_backward(
    tile: int,
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    stops: wp.array[int],
    width: int,
    height: int,
    colours: int,
    divided: bool,
    geometry: bool,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    depths: wp.array[float],
    normals: wp.array2d[float],
    distortion: wp.array[float],
    medians_at: wp.array[int],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    g_normals: wp.array2d[float],
    g_distortion: wp.array[float],
    g_medians: wp.array[float],
    slab_begin: int,
    slab_end: int,
    spill_begins: wp.array[int],
    sums_out: wp.array2d[float],
    spill_ids_out: wp.array[int],
    spills_out: wp.array2d[float],
): ...


@wp.kernel
def surfel_tile_backward(
    start: int,
    # In:
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    stops: wp.array[int],
    width: int,
    height: int,
    colours: int,
    divided: bool,
    geometry: bool,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    depths: wp.array[float],
    normals: wp.array2d[float],
    distortion: wp.array[float],
    medians_at: wp.array[int],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    g_normals: wp.array2d[float],
    g_distortion: wp.array[float],
    g_medians: wp.array[float],
    slab_begin: int,
    slab_end: int,
    spill_begins: wp.array[int],
    # Out:
    sums_out: wp.array2d[float],
    spill_ids_out: wp.array[int],
    spills_out: wp.array2d[float],
):
    """Add one tile's gradients of records to `sums_out` or its spills; `image` and on from the forward pass.

    Gradients of images other than `g_image` may be empty: zero. Sums of absolute gradients where `absolute`.
    """
    tile_backward(
        start + wp.tid(),
        records,
        channels,
        channel_offset,
        offsets,
        ids,
        stops,
        width,
        height,
        colours,
        divided,
        geometry,
        absolute,
        image,
        transmittance,
        depths,
        normals,
        distortion,
        medians_at,
        g_image,
        g_alphas,
        g_normals,
        g_distortion,
        g_medians,
        slab_begin,
        slab_end,
        spill_begins,
        sums_out,
        spill_ids_out,
        spills_out,
    )


_PIXEL = f"""
{LOCATE_PIXEL}{WARP_SUMS}{SCALAR}
    const int channels_out = image.shape[1];
{_STATE}
    if (inside) {{
{_PIXEL_GRADIENT}
        R[0] = behind;
        g0[0] = gradient[0], g1[0] = gradient[1], g2[0] = gradient[2], g_depth[0] = gradient[3];
        h0[0] = normal[0], h1[0] = normal[1], h2[0] = normal[2];
        if (with_distortion) {{
            g_bend[0] = 2.0f * g_distortion.data[pixel];
            D_all[0] = depths.data[pixel];
            T_end[0] = t_end;
        }}
        if (with_median) {{
            g_median[0] = g_medians.data[pixel];
            median_at[0] = medians_at.data[pixel];
        }}
    }}
    const int last = inside ? stops.data[pixel] : begin;
    const int end = warp_max(last);
    F t = one;
    for (int at = begin; at < end; ++at) {{
{PIXEL_RAY}{HIT}
        const bool blends = at < last && p >= cutoff;
        if (!warp_any(blends)) continue;
{_ZERO}
        if (blends) {{
            const int number = at;
            const float at_x = ex, at_y = ey;
{EXP}{WEIGH}{_GRADIENT}{_CHAIN_BLUR}{_ADD_BLUR}
            t = next;
        }}
        const float center_x = r[{U}] * sum_u + r[{V}] * sum_v - r[{SLOPE}] * sum_w;
        const float center_y = r[{U + 1}] * sum_u + r[{V + 1}] * sum_v - r[{SLOPE + 1}] * sum_w;
        float* const out = sums_out.data + g * {RECORD};
        warp_add(out + {MEAN}, center_x + sum_lx);
        warp_add(out + {MEAN + 1}, center_y + sum_ly);
        warp_add(out + {CENTER}, center_x);
        warp_add(out + {CENTER + 1}, center_y);
        warp_add(out + {U}, -sum_ux);
        warp_add(out + {U + 1}, -sum_uy);
        warp_add(out + {V}, -sum_vx);
        warp_add(out + {V + 1}, -sum_vy);
        warp_add(out + {SLOPE}, sum_wx);
        warp_add(out + {SLOPE + 1}, sum_wy);
        warp_add(out + {LOG2_OPACITY}, 0.5f * sum_p);
        warp_add(out + {CHANNELS}, sum_0);
        warp_add(out + {CHANNELS + 1}, sum_1);
        warp_add(out + {CHANNELS + 2}, sum_2);
        if (geometry) {{
            warp_add(out + {DEPTH}, sum_z);
            warp_add(out + {NORMAL}, sum_n0);
            warp_add(out + {NORMAL + 1}, sum_n1);
            warp_add(out + {NORMAL + 2}, sum_n2);
        }}
        if (absolute) {{
            warp_add(out + {ABSOLUTE[0]}, abs_x);
            warp_add(out + {ABSOLUTE[1]}, abs_y);
        }}
    }}
"""


@wp.func_native(_PIXEL)
def pixel_backward(
    index: int,
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    stops: wp.array[int],
    width: int,
    height: int,
    colours: int,
    divided: bool,
    geometry: bool,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    depths: wp.array[float],
    normals: wp.array2d[float],
    distortion: wp.array[float],
    medians_at: wp.array[int],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    g_normals: wp.array2d[float],
    g_distortion: wp.array[float],
    g_medians: wp.array[float],
    sums_out: wp.array2d[float],
): ...


@wp.kernel
def surfel_pixel_backward(
    start: int,
    # In:
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    stops: wp.array[int],
    width: int,
    height: int,
    colours: int,
    divided: bool,
    geometry: bool,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    depths: wp.array[float],
    normals: wp.array2d[float],
    distortion: wp.array[float],
    medians_at: wp.array[int],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    g_normals: wp.array2d[float],
    g_distortion: wp.array[float],
    g_medians: wp.array[float],
    # Out:
    sums_out: wp.array2d[float],
):
    """The same for one pixel; launch with blocks of whole warps, or on a CPU from one thread alone."""
    pixel_backward(
        start + wp.tid(),
        records,
        channels,
        channel_offset,
        offsets,
        ids,
        stops,
        width,
        height,
        colours,
        divided,
        geometry,
        absolute,
        image,
        transmittance,
        depths,
        normals,
        distortion,
        medians_at,
        g_image,
        g_alphas,
        g_normals,
        g_distortion,
        g_medians,
        sums_out,
    )
