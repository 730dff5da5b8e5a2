"""Gradients of `gdpro_sim.kernels.compositing`, front to back again over the same lists.

With weight w_i = alpha_i T_i, colour c_i and the image's gradient g, and with

    q_i = c_i . g                                       gradient at w_i
    R_i = sum over j > i of w_j q_j + T_end (background . g - g_alpha)     what lies behind i

the gradient at alpha_i is T_i q_i - R_i / (1 - alpha_i). R starts as image . g - T_end g_alpha and loses
w_i q_i at every Gaussian. Sums over a tile's pixels stay in registers and are added once to the Gaussian's
gradient, laid out like its record: MEAN, FACTOR, LOG2_OPACITY, CHANNELS, and in place of BOX the sums over
pixels of the absolute gradient at MEAN (of `absgrad`, Ye et al., "AbsGS", 2024).
"""

import warp as wp

from gdpro_sim.kernels.compositing import (
    ALPHA_MAX,
    BATCH,
    BATCH_BACKWARD,
    BATCH_STATE,
    EXP2,
    LN2,
    LOCATE_PIXEL,
    LOCATE_TILE,
    PIXEL_ALPHA,
    PIXEL_WEIGHT,
    POWER,
    TILE_LANES,
)
from gdpro_sim.kernels.images import IMAGES
from gdpro_sim.kernels.lanes import CPU_FLAGS, SUM_LANES
from gdpro_sim.kernels.projection import (
    BOX,
    CHANNELS,
    FACTOR,
    LOG2_CUTOFF,
    LOG2_OPACITY,
    MEAN,
    RECORD,
)
from gdpro_sim.kernels.slabs import SLAB_ROWS

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

SPILL = """
        float* out;
        if (own >> i & 1) {
            out = sums_out.data + g * WIDTH;
        } else {
            spill_ids_out.data[spill] = (int)g;
            out = spills_out.data + (size_t)spill * WIDTH;
            for (int i = 0; i < WIDTH; ++i) out[i] = 0.0f;
            ++spill;
        }
"""
"""CPU snippet: entry i of the batch, Gaussian `g` -> where its sums of this tile go: to the result where its
bit of `own` is set, that is where it touches tiles of the slab alone (see `gdpro_sim.kernels.slabs`)."""

AGAIN = f"""
{EXP2}
            const F t = T[k];
            const F alpha = raw < alpha_max ? raw : alpha_max;
            const F next = fma(-alpha, t, t);
            const I blend = (p >= cutoff) & (next > least[k]);
            const F w = blend ? alpha * t : zero;
            T[k] = blend ? next : t;
"""
"""CPU snippet: p, of block k -> raw, alpha, what was in front (t) and will be behind (next), weight w.

Every Gaussian that the forward pass blended left at least the transmittance of the end, and whatever lies
behind where it stopped would have left at most 254/255 of that: `least` is 0.999 of it.
"""

STILL_ALIVE = """
        for (unsigned blocks = alive; blocks; blocks &= blocks - 1) {
            const int k = __builtin_ctz(blocks);
            if (!bits(0.998f * T[k] > least[k])) alive &= ~(1u << k);
        }
"""
"""CPU snippet: blocks where all that was blended has been seen are done."""

_BATCH = (
    BATCH.replace("{declare}", "I reached = (I)0;")
    .replace("{each}", "reached |= hit & (1 << k);")
    .replace(
        "{end}",
        f"""*(I*)(masks + first) = reached;
            own |= bits((fields[{MEAN + 1}] - fields[{BOX + 1}] >= slab_top)
                & (fields[{MEAN + 1}] + fields[{BOX + 1}] <= slab_bottom)) << first;
            for (int j = 0; j < 16 && first + j < held; ++j) {{
                __builtin_prefetch(sums_out.data + (size_t)id[at + first + j] * 16, 1);
            }}""",
    )
)

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{TILE_LANES}{IMAGES}{SUM_LANES}{SLAB_ROWS}
    int spill = spill_begins.shape[0] ? spill_begins.data[tile] : 0;
    F R[16], g0[16], g1[16], g2[16], g3[16];
    F o0[16], o1[16], o2[16], o3[16], on_alpha[16], left[16], least[16];
    F* const gradients[4] = {{g0, g1, g2, g3}};
    F* const values[4] = {{o0, o1, o2, o3}};
    F* const left_planes[1] = {{left}};
    F* const alpha_planes[1] = {{on_alpha}};
    read_image(g_image.data, count, gradients);
    read_image(image.data, count, values);
    read_image(transmittance.data, 1, left_planes);
    if (g_alphas.data) read_image(g_alphas.data, 1, alpha_planes);
    for (int k = 0; k < 16; ++k) {{
        least[k] = 0.999f * left[k];
        if (!g_alphas.data) on_alpha[k] = zero;
        R[k] = zero;
        for (int i = 0; i < 4; ++i) {{
            if (i >= count) {{
                gradients[i][k] = zero;
                continue;
            }}
            R[k] = fma(values[i][k], gradients[i][k], R[k]);
            if (i == divided) {{
                // An expected depth s / alpha counts as s with a gradient at alpha of its own.
                const F alpha = __builtin_elementwise_max(one - left[k], (F)1e-10f);
                gradients[i][k] /= alpha;
                on_alpha[k] -= alpha > 1e-10f ? gradients[i][k] * values[i][k] : zero;
            }}
        }}
        R[k] = fma(-left[k], on_alpha[k], R[k]);
    }}
    const int BATCH_SIZE = {BATCH_BACKWARD};
{BATCH_STATE}
    const int end = stops.data[tile];
    const int WIDTH = {RECORD};
    // Factors of the chain rule that all lanes share: exp2 and squares, see below.
    const float s = {2 * LN2!r}f;
    const F factors = {{s, s, s, s, s, s, s, s, 1, 1, 1, 1, s, s, s, s}};
    for (int at = begin; at < end && alive;) {{
        int masks[BATCH_SIZE] __attribute__((aligned(64)));
        unsigned own = 0;
{_BATCH}
        for (int i = 0; i < held; ++i) {{
            unsigned mask = (unsigned)masks[i] & alive;
            if (!mask) continue;
            const size_t g = (size_t)id[at + i];
            F sum_p = zero, sum_u = zero, sum_v = zero, sum_ux = zero, sum_uy = zero, sum_vy = zero;
            F sum_0 = zero, sum_1 = zero, sum_2 = zero, sum_3 = zero, abs_x = zero, abs_y = zero;
            do {{
                const int k = __builtin_ctz(mask);
                mask &= mask - 1;
                const F x = X[k], y = Y[k];
{POWER}{AGAIN}
                F q = fma((F)r[{CHANNELS}], g0[k], fma((F)r[{CHANNELS + 1}], g1[k],
                    r[{CHANNELS + 2}] * g2[k]));
                if (count > 3) q = fma((F)r[{CHANNELS + 3}], g3[k], q);
                const F behind = fma(-w, q, R[k]);
                R[k] = behind;
                // alpha times the gradient at alpha, with T (1 - alpha) = next.
                const F g_p = (blend & (raw <= alpha_max)) ? w * fma(-behind, reciprocal(next), q) : zero;
                const F g_u = g_p * u, g_v = g_p * v;
                sum_p += g_p;
                sum_u += g_u;
                sum_v += g_v;
                sum_ux = fma(x, g_u, sum_ux);
                sum_uy = fma(y, g_u, sum_uy);
                sum_vy = fma(y, g_v, sum_vy);
                sum_0 = fma(w, g0[k], sum_0);
                sum_1 = fma(w, g1[k], sum_1);
                sum_2 = fma(w, g2[k], sum_2);
                if (count > 3) sum_3 = fma(w, g3[k], sum_3);
                if (absolute) {{
                    abs_x += __builtin_elementwise_abs(a * g_u);
                    abs_y += __builtin_elementwise_abs(fma((F)b, g_u, d * g_v));
                }}
            }} while (mask);
{SPILL}
            // p = l - u^2 - v^2, u = a dx + b dy, v = d dy, with dx, dy from the mean: X, Y plus those of
            // the tile.
            const float* const r = rows[i];
            const float dx = (float)tile_x + 0.5f - r[{MEAN}], dy = (float)tile_y + 0.5f - r[{MEAN + 1}];
            const F sums[16] = {{
                r[{FACTOR}] * sum_u, fma((F)r[{FACTOR + 1}], sum_u, r[{FACTOR + 2}] * sum_v),
                -fma((F)dx, sum_u, sum_ux), -fma((F)dy, sum_u, sum_uy), -fma((F)dy, sum_v, sum_vy),
                zero, 0.5f * sum_p, zero, sum_0, sum_1, sum_2, sum_3, abs_x, abs_y, zero, zero,
            }};
            // In two statements, so that no compiler rounds once here and twice where spills are merged.
            const F added = sum_lanes(sums) * factors;
            F total;
            __builtin_memcpy(&total, out, 64);
            total += added;
            __builtin_memcpy(out, &total, 64);
        }}
        at += held;
{STILL_ALIVE}
    }}
#endif
"""


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
    count: int,
    divided: int,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    slab_begin: int,
    slab_end: int,
    spill_begins: wp.array[int],
    sums_out: wp.array2d[float],
    spill_ids_out: wp.array[int],
    spills_out: wp.array2d[float],
): ...


@wp.kernel
def composite_tile_backward(
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
    count: int,
    divided: int,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    slab_begin: int,
    slab_end: int,
    spill_begins: wp.array[int],
    # Out:
    sums_out: wp.array2d[float],
    spill_ids_out: wp.array[int],
    spills_out: wp.array2d[float],
):
    """Add one tile's gradients of records to `sums_out` or its spills; `image` and on from the forward pass.

    `g_alphas` may be empty: zero. Sums of absolute gradients where `absolute`.
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
        count,
        divided,
        absolute,
        image,
        transmittance,
        g_image,
        g_alphas,
        slab_begin,
        slab_end,
        spill_begins,
        sums_out,
        spill_ids_out,
        spills_out,
    )


WARP_SUMS = """
#if defined(__CUDACC__)
    auto warp_max = [](int v) {
        for (int step = 16; step > 0; step >>= 1) v = max(v, __shfl_xor_sync(0xffffffffu, v, step));
        return v;
    };
    auto warp_any = [](bool v) { return __any_sync(0xffffffffu, v) != 0; };
    auto warp_add = [](float* p, float v) {
        for (int step = 16; step > 0; step >>= 1) v += __shfl_xor_sync(0xffffffffu, v, step);
        if ((threadIdx.x & 31) == 0) atomicAdd(p, v);
    };
#else
    auto warp_max = [](int v) { return v; };
    auto warp_any = [](bool v) { return v; };
    auto warp_add = [](float* p, float v) { *p += v; };
#endif
"""
"""Snippet: sums over the 32 pixels of a CUDA warp, which all must come to; over the one pixel on a CPU."""

_PIXEL = f"""
{LOCATE_PIXEL}{WARP_SUMS}
    // The image's gradient at the sums, zero past the last channel, and R.
    float g0 = 0.0f, g1 = 0.0f, g2 = 0.0f, g3 = 0.0f, R = 0.0f, T = 1.0f;
    if (inside) {{
        const float left = transmittance.data[pixel];
        const float alpha = 1.0f - left > 1e-10f ? 1.0f - left : 1e-10f;
        float on_alpha = g_alphas.data ? g_alphas.data[pixel] : 0.0f;
        auto read = [&](int i) {{
            if (i >= count) return 0.0f;
            const float value = image.data[pixel * count + i];
            float gradient = g_image.data[pixel * count + i];
            R += value * gradient;
            if (i == divided) {{
                // An expected depth s / alpha counts as s with a gradient at alpha of its own.
                gradient /= alpha;
                if (alpha > 1e-10f) on_alpha -= gradient * value;
            }}
            return gradient;
        }};
        g0 = read(0), g1 = read(1), g2 = read(2), g3 = read(3);
        R -= left * on_alpha;
    }}
    const int last = inside ? stops.data[pixel] : begin;
    const int end = warp_max(last);
    const float* const colour = channels.data + channel_offset;
    const int channel_stride = channels.shape[1];
    for (int at = begin; at < end; ++at) {{
{PIXEL_ALPHA}
        const bool blend = at < last && p >= {float(LOG2_CUTOFF)!r}f;
        if (!warp_any(blend)) continue;
        float w = 0.0f, g_p = 0.0f;
        if (blend) {{
{PIXEL_WEIGHT}
            const float* const c = colour + g * channel_stride;
            w = alpha * T;
            const float q = c[0] * g0 + c[1] * g1 + c[2] * g2 + c[3] * g3;
            R -= w * q;
            if (raw <= {float(ALPHA_MAX)!r}f) g_p = (T * q - R / (1.0f - alpha)) * raw * {2 * LN2!r}f;
            T = next;
        }}
        const float g_u = g_p * u, g_v = g_p * v;
        const float g_x = r[{FACTOR}] * g_u, g_y = r[{FACTOR + 1}] * g_u + r[{FACTOR + 2}] * g_v;
        float* const out = sums_out.data + g * {RECORD};
        warp_add(out + {MEAN}, g_x);
        warp_add(out + {MEAN + 1}, g_y);
        warp_add(out + {FACTOR}, -g_u * dx);
        warp_add(out + {FACTOR + 1}, -g_u * dy);
        warp_add(out + {FACTOR + 2}, -g_v * dy);
        warp_add(out + {LOG2_OPACITY}, 0.5f * g_p);
        warp_add(out + {CHANNELS}, w * g0);
        if (count > 1) warp_add(out + {CHANNELS + 1}, w * g1);
        if (count > 2) warp_add(out + {CHANNELS + 2}, w * g2);
        if (count > 3) warp_add(out + {CHANNELS + 3}, w * g3);
        if (absolute) {{
            warp_add(out + {BOX}, fabsf(g_x));
            warp_add(out + {BOX + 1}, fabsf(g_y));
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
    count: int,
    divided: int,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
    sums_out: wp.array2d[float],
): ...


@wp.kernel
def composite_pixel_backward(
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
    count: int,
    divided: int,
    absolute: bool,
    image: wp.array2d[float],
    transmittance: wp.array[float],
    g_image: wp.array2d[float],
    g_alphas: wp.array[float],
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
        count,
        divided,
        absolute,
        image,
        transmittance,
        g_image,
        g_alphas,
        sums_out,
    )
