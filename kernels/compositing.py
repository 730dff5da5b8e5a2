"""Alpha compositing of depth-sorted Gaussians, front to back, into 16 x 16 pixel tiles.

Both kernels read the records of `gdpro_sim.kernels.projection` and the lists of `gdpro_sim.kernels.tiles`:

    w      = min(0.99, o exp2(-(u^2 + v^2)))     u = a dx + b dy,  v = d dy   (whitened offset from the mean)
    skip     where o exp2(-(u^2 + v^2)) < 1/255
    stop     before a Gaussian that would leave a transmittance T (1 - w) <= 1e-4
    C     += w T c,   T *= 1 - w                 (3D Gaussian Splatting, Kerbl et al. 2023, eq. 3)

Up to four channels are blended at once; more channels run again over the same lists with other `channels`.

`composite_tile` is for CPUs: one index per tile, Gaussians outermost, 16 pixel lanes (a 4 x 4 block) inside.
`composite_pixel` is for GPUs: one index per pixel, 256 neighbours are one tile, so a block shares its list.
"""

import warp as wp

from gdpro_sim.kernels.images import IMAGES
from gdpro_sim.kernels.lanes import CPU_FLAGS, TRANSPOSE
from gdpro_sim.kernels.projection import (
    BOX,
    CHANNELS,
    FACTOR,
    LOG2_CUTOFF,
    LOG2_OPACITY,
    MEAN,
    REACH,
    RECORD,
    TILE,
)

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
LN2 = wp.constant(0.6931471805599453)
BATCH_FORWARD, BATCH_BACKWARD = 32, 16
"""Entries of a list looked at together: BATCH_SIZE in the text, at most 32."""

LOCATE_TILE = f"""
    const int tiles_x = (width + {TILE - 1}) / {TILE}, tiles_y = (height + {TILE - 1}) / {TILE};
    const int camera = tile / (tiles_x * tiles_y);
    const int in_camera = tile - camera * tiles_x * tiles_y;
    const int tile_x = in_camera % tiles_x * {TILE}, tile_y = in_camera / tiles_x * {TILE};
    const int begin = offsets.data[tile];
"""
"""Snippet: `tile`, `offsets`, image size -> camera, tile_x, tile_y (first pixel) and begin of the list."""

LOCATE_PIXEL = f"""
    const int tile = index / {TILE * TILE};
    const int in_tile = index - tile * {TILE * TILE};
{LOCATE_TILE}
    const int x = tile_x + in_tile % {TILE}, y = tile_y + in_tile / {TILE};
    const bool inside = x < width && y < height;
    const size_t pixel = ((size_t)camera * height + y) * width + x;
"""
"""Snippet: `index` -> the same, and pixel x, y, its number, and whether it lies inside the image."""

ARITHMETIC = f"""
    // Read through volatile memory so that they stay in registers: as literals the compiler would fetch each
    // anew at every block, through a 64-bit address. The polynomials are those of exp2_.
#if defined(__AVX512DQ__)
    const volatile float literals[] = {{0.0f, 1.8671303e-3f, 9.0170298e-3f, 5.5799913e-2f, 2.4016444e-1f,
        6.9315130e-1f, 1.0f, {float(ALPHA_MAX)!r}f, {float(LOG2_CUTOFF)!r}f, {float(TRANSMITTANCE_MIN)!r}f}};
#else
    const volatile float literals[] = {{12582912.0f, 1.3264727e-3f, 9.671513e-3f, 5.5507336e-2f,
        2.4022242e-1f,
        6.9314700e-1f, 1.0f, {float(ALPHA_MAX)!r}f, {float(LOG2_CUTOFF)!r}f, {float(TRANSMITTANCE_MIN)!r}f}};
#endif
    const F magic = (F)literals[0], e5 = (F)literals[1], e4 = (F)literals[2], e3 = (F)literals[3],
        e2 = (F)literals[4], e1 = (F)literals[5], one = (F)literals[6], alpha_max = (F)literals[7],
        cutoff = (F)literals[8], transmittance_min = (F)literals[9];
    auto exp2_ = [&](F p) {{
        // p = n + f with whole n, exp2(f) by a minimax polynomial of degree 5, scaled by 2^n (relative error
        // 2e-7).
#if defined(__AVX512DQ__)
        const F f = (F)__builtin_ia32_reduceps512_mask(p, 9, zero, (unsigned short)-1, 4);  // 0 <= f < 1
#else
        const F n = p + magic;  // in the last bits of 1.5 * 2^23: |f| <= 1/2
        const F f = p - (n - magic);
#endif
        F e = fma(f, e5, e4);
        e = fma(e, f, e3);
        e = fma(e, f, e2);
        e = fma(e, f, e1);
        e = fma(e, f, one);
#if defined(__AVX512DQ__)
        return (F)__builtin_ia32_scalefps512_mask(e, p, zero, (unsigned short)-1, 4);
#else
        I exponent, mantissa;
        __builtin_memcpy(&exponent, &n, 64);
        __builtin_memcpy(&mantissa, &e, 64);
        mantissa += exponent << 23;
        F raw;
        __builtin_memcpy(&raw, &mantissa, 64);
        return raw;
#endif
    }};
    // 1 / v: a 14-bit estimate and one step of Newton's method, to about 1 ulp.
    auto reciprocal = [&](F v) {{
#if defined(__AVX512F__)
        const F y = (F)__builtin_ia32_rcp14ps512_mask(v, zero, (unsigned short)-1);
        return fma(y, fma(-v, y, one), y);
#else
        return one / v;
#endif
    }};
"""
"""CPU snippet, after F, I, zero and fma: constants, exp2_ and reciprocal."""

TILE_LANES = f"""
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef bool M __attribute__((ext_vector_type(16)));
    const F column = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}};
    const F row = {{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};
    const I lane_number = {{0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15}};
    const F inside = (F)1.0f, outside = (F)-1.0f, zero = (F)0.0f;
    auto fma = [](F a, F b, F c) {{ return __builtin_elementwise_fma(a, b, c); }};
    auto bits = [](I mask) {{
        M m = __builtin_convertvector(mask, M);
        unsigned short b;
        __builtin_memcpy(&b, &m, 2);
        return (unsigned)b;
    }};
    const int x_end = width - tile_x < {TILE} ? width - tile_x : {TILE};
    const int y_end = height - tile_y < {TILE} ? height - tile_y : {TILE};

{ARITHMETIC}
    // Transmittance of the pixels of 16 blocks, with the sign as a flag: T > 0 goes on, T < 0 has stopped
    // at |T|.
    F T[16], X[16], Y[16];
    unsigned alive = 0;
    for (int k = 0; k < 16; ++k) {{
        X[k] = (float)(4 * (k & 3)) + column;
        Y[k] = (float)(4 * (k >> 2)) + row;
        const I in = (X[k] < (float)x_end) & (Y[k] < (float)y_end);
        T[k] = in ? inside : outside;
        if (bits(in)) alive |= 1u << k;
    }}
"""
"""CPU snippet: 16 pixel lanes, 16 blocks of 4 x 4 pixels in a tile, at X, Y; `alive` has a bit per block."""

EXP2 = """
            const F raw = exp2_(p);
"""
"""CPU snippet: p -> raw = exp2(p), for -126 < p < 127."""

BLEND = """
            const F alpha = raw < alpha_max ? raw : alpha_max;
            const F next = fma(-alpha, t, t);
            const I seen = p >= cutoff;
            const I blend = seen & (next > transmittance_min);
            const F w = blend ? alpha * t : zero;
"""
"""CPU snippet: raw alpha and transmittance t -> weights w of the lanes that blend."""

PASS = """
            const F passed = blend ? next : t;
            t = (seen & ~blend) ? -__builtin_elementwise_abs(t) : passed;
"""
"""CPU snippet: transmittance t behind."""

BATCH_STATE = f"""
    float rows[BATCH_SIZE][{RECORD}] __attribute__((aligned(64)));
    float u0[BATCH_SIZE] __attribute__((aligned(64))), v0[BATCH_SIZE] __attribute__((aligned(64)));
    auto transpose = [](F* rows) {{{TRANSPOSE}
    }};
    const float* const record = records.data;
    const float* const colour = channels.data + channel_offset;
    const int channel_stride = channels.shape[1];
    const bool own_channels = channels.data == records.data;
    const int* const id = ids.data;
"""
"""CPU snippet: what BATCH needs."""

BATCH = f"""
        // The next entries of the list, copied to `rows`, 16 at a time side by side in lanes: offset of
        // the tile's first pixel from the mean, in pixels and whitened, and the blocks each can reach:
        // those whose centre lies in the box grown by the block, and within `reach` of the mean in
        // standard deviations.
        const int held = end - at < BATCH_SIZE ? end - at : BATCH_SIZE;
        for (int first = 0; first < held; first += 16) {{
            F fields[{RECORD}];
            for (int j = 0; j < 16; ++j) {{
                const int i = first + j < held ? first + j : held - 1;
                __builtin_memcpy(&fields[j], record + (size_t)id[at + i] * {RECORD}, 64);
                *(F*)rows[first + j] = fields[j];
                if (!own_channels) {{
                    __builtin_memcpy(rows[first + j] + {CHANNELS},
                        colour + (size_t)id[at + i] * channel_stride, 16);
                }}
                if (i + BATCH_SIZE < end - at) {{
                    __builtin_prefetch(record + (size_t)id[at + i + BATCH_SIZE] * {RECORD});
                }}
            }}
            transpose(fields);
            const F a = fields[{FACTOR}], b = fields[{FACTOR + 1}], d = fields[{FACTOR + 2}];
            const F dx = (float)tile_x + 0.5f - fields[{MEAN}],
                dy = (float)tile_y + 0.5f - fields[{MEAN + 1}];
            *(F*)(u0 + first) = fma(a, dx, b * dy);
            *(F*)(v0 + first) = d * dy;
            const F reach_x = fields[{BOX}] + 1.5f, reach_y = fields[{BOX + 1}] + 1.5f;
            F along[4], across[4], square[4];
            I in_x[4], in_y[4];
            const I there = first + lane_number < held;
            for (int i = 0; i < 4; ++i) {{
                const F cx = dx + (4.0f * i + 1.5f), cy = dy + (4.0f * i + 1.5f), cv = d * cy;
                in_x[i] = (__builtin_elementwise_abs(cx) <= reach_x) & there;
                in_y[i] = __builtin_elementwise_abs(cy) <= reach_y;
                along[i] = a * cx;
                across[i] = b * cy;
                square[i] = cv * cv;
            }}
            {{declare}}
            for (int k = 0; k < 16; ++k) {{
                const F cu = along[k & 3] + across[k >> 2];
                const I hit = in_x[k & 3] & in_y[k >> 2] & (fma(cu, cu, square[k >> 2]) <= fields[{REACH}]);
                {{each}}
            }}
            {{end}}
        }}
"""
"""CPU snippet: list from `at` on -> `held` entries in `rows`, u0, v0; {each} takes the mask `hit` of the 16
entries from `first` on that reach block k, between {declare} and {end}."""

POWER = f"""
            const float* const r = rows[i];
            const float a = r[{FACTOR}], b = r[{FACTOR + 1}], d = r[{FACTOR + 2}];
            const F u = fma((F)a, x, fma((F)b, y, (F)u0[i])), v = fma((F)d, y, (F)v0[i]);
            const F p = fma(-v, v, fma(-u, u, (F)r[{LOG2_OPACITY}]));
"""
"""CPU snippet: base-2 logarithm p of alpha of entry i of the batch at the lanes x, y."""

_BATCH = (
    BATCH.replace("{declare}", "").replace("{each}", "entries[k] |= bits(hit) << first;").replace("{end}", "")
)

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{TILE_LANES}{IMAGES}
    const int BATCH_SIZE = {BATCH_FORWARD};
{BATCH_STATE}
    F c0[16], c1[16], c2[16], c3[16];
    for (int k = 0; k < 16; ++k) c0[k] = c1[k] = c2[k] = c3[k] = zero;
    fetch_image(image_out.data, count);
    fetch_image(alphas_out.data, 1);
    fetch_image(transmittance_out.data, 1);
    const int end = offsets.data[tile + 1];
    int at = begin;
    while (at < end && alive) {{
        unsigned entries[16] = {{0}};
{_BATCH}
        // Block after block, so that its transmittance and colours stay in registers over the batch.
        for (unsigned blocks = alive; blocks; blocks &= blocks - 1) {{
            const int k = __builtin_ctz(blocks);
            unsigned left = entries[k];
            if (!left) continue;
            const F x = X[k], y = Y[k];
            F t = T[k], k0 = c0[k], k1 = c1[k], k2 = c2[k], k3 = c3[k];
            do {{
                const int i = __builtin_ctz(left);
                left &= left - 1;
{POWER}{EXP2}{BLEND}{PASS}
                k0 = fma(w, (F)r[{CHANNELS}], k0);
                k1 = fma(w, (F)r[{CHANNELS + 1}], k1);
                k2 = fma(w, (F)r[{CHANNELS + 2}], k2);
                k3 = fma(w, (F)r[{CHANNELS + 3}], k3);
            }} while (left);
            T[k] = t, c0[k] = k0, c1[k] = k1, c2[k] = k2, c3[k] = k3;
            if (!bits(t > 0.0f)) alive &= ~(1u << k);
        }}
        at += held;
    }}

    // Over the background; expected depth is divided by alpha.
    const float* const background = backgrounds.data + (size_t)camera * count;
    F* const sums[4] = {{c0, c1, c2, c3}};
    F alphas[16];
    for (int k = 0; k < 16; ++k) {{
        T[k] = __builtin_elementwise_abs(T[k]);
        alphas[k] = one - T[k];
        for (int i = 0; i < count; ++i) {{
            if (i == divided) sums[i][k] /= __builtin_elementwise_max(alphas[k], (F)1e-10f);
            else sums[i][k] = fma(T[k], (F)background[i], sums[i][k]);
        }}
    }}
    const F* const planes[4] = {{c0, c1, c2, c3}};
    const F* const alpha_planes[1] = {{alphas}};
    const F* const transmittance_planes[1] = {{T}};
    write_image(image_out.data, count, planes);
    write_image(alphas_out.data, 1, alpha_planes);
    write_image(transmittance_out.data, 1, transmittance_planes);
    stops_out.data[tile] = at;
#endif
"""


@wp.func_native(_TILE)
def blend_tile(
    tile: int,
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    backgrounds: wp.array2d[float],
    width: int,
    height: int,
    count: int,
    divided: int,
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    stops_out: wp.array[int],
): ...


@wp.kernel
def composite_tile(
    start: int,
    # In:
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    backgrounds: wp.array2d[float],
    width: int,
    height: int,
    count: int,
    divided: int,
    # Out:
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    stops_out: wp.array[int],
):
    """Blend channels[g, channel_offset + j] into image channel j < count <= 4.

    `divided` is the channel divided by alpha (expected depth), or -1. `stops_out` holds the list position
    where a tile had nothing left to blend.
    """
    blend_tile(
        start + wp.tid(),
        records,
        channels,
        channel_offset,
        offsets,
        ids,
        backgrounds,
        width,
        height,
        count,
        divided,
        image_out,
        alphas_out,
        transmittance_out,
        stops_out,
    )


PIXEL_ALPHA = f"""
        const size_t g = (size_t)ids.data[at];
        const float* const r = records.data + g * {RECORD};
        const float dx = (float)x + 0.5f - r[{MEAN}], dy = (float)y + 0.5f - r[{MEAN + 1}];
        const float u = fmaf(r[{FACTOR}], dx, r[{FACTOR + 1}] * dy), v = r[{FACTOR + 2}] * dy;
        const float p = fmaf(-v, v, fmaf(-u, u, r[{LOG2_OPACITY}]));
"""
"""Snippet: entry `at` at pixel x, y -> its record r, offset dx, dy, u, v and base-2 logarithm p of alpha."""

PIXEL_WEIGHT = f"""
            const float raw = exp2f(p);
            const float alpha = raw < {float(ALPHA_MAX)!r}f ? raw : {float(ALPHA_MAX)!r}f;
            const float next = fmaf(-alpha, T, T);
"""
"""Snippet: p and transmittance T -> alpha, and the transmittance behind."""

_PIXEL = f"""
{LOCATE_PIXEL}
    if (!inside) return;
    const int end = offsets.data[tile + 1];
    const float* const colour = channels.data + channel_offset;
    const int channel_stride = channels.shape[1];
    float T = 1.0f, c0 = 0.0f, c1 = 0.0f, c2 = 0.0f, c3 = 0.0f;
    int last = begin;
    for (int at = begin; at < end; ++at) {{
{PIXEL_ALPHA}
        if (p >= {float(LOG2_CUTOFF)!r}f) {{
{PIXEL_WEIGHT}
            if (next <= {float(TRANSMITTANCE_MIN)!r}f) break;
            const float* const c = colour + g * channel_stride;
            const float w = alpha * T;
            c0 = fmaf(w, c[0], c0);
            c1 = fmaf(w, c[1], c1);
            c2 = fmaf(w, c[2], c2);
            c3 = fmaf(w, c[3], c3);
            T = next;
            last = at + 1;
        }}
    }}
    const float alpha = 1.0f - T;
    const float* const background = backgrounds.data + (size_t)camera * count;
    float* const out = image_out.data + pixel * count;
    auto write = [&](int i, float sum) {{
        if (i >= count) return;
        out[i] = i == divided ? sum / (alpha > 1e-10f ? alpha : 1e-10f) : fmaf(T, background[i], sum);
    }};
    write(0, c0), write(1, c1), write(2, c2), write(3, c3);
    alphas_out.data[pixel] = alpha;
    transmittance_out.data[pixel] = T;
    last_out.data[pixel] = last;
"""


@wp.func_native(_PIXEL)
def blend_pixel(
    index: int,
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    backgrounds: wp.array2d[float],
    width: int,
    height: int,
    count: int,
    divided: int,
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    last_out: wp.array[int],
): ...


@wp.kernel
def composite_pixel(
    start: int,
    # In:
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    offsets: wp.array[int],
    ids: wp.array[int],
    backgrounds: wp.array2d[float],
    width: int,
    height: int,
    count: int,
    divided: int,
    # Out:
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    last_out: wp.array[int],
):
    """The same for one pixel: index / 256 is the tile, index % 256 the pixel in it.

    `last_out` holds the list position after the last Gaussian blended. Channels come in rows of four or more.
    """
    blend_pixel(
        start + wp.tid(),
        records,
        channels,
        channel_offset,
        offsets,
        ids,
        backgrounds,
        width,
        height,
        count,
        divided,
        image_out,
        alphas_out,
        transmittance_out,
        last_out,
    )
