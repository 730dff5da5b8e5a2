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

from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.projection import BOX, FACTOR, LOG2_CUTOFF, LOG2_OPACITY, MEAN, REACH, RECORD, TILE

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

TILE_LANES = f"""
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef bool M __attribute__((ext_vector_type(16)));
    const F column = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}};
    const F row = {{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};
    const F block_x = 4.0f * column, block_y = 4.0f * row;
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

    // Transmittance of the pixels of 16 blocks, with the sign as a flag: T > 0 goes on, T < 0 has stopped at |T|.
    F T[16];
    unsigned alive = 0;
    for (int k = 0; k < 16; ++k) {{
        const F x = (float)(4 * (k & 3)) + column, y = (float)(4 * (k >> 2)) + row;
        const I in = (x < (float)x_end) & (y < (float)y_end);
        T[k] = in ? inside : outside;
        if (bits(in)) alive |= 1u << k;
    }}
"""
"""CPU snippet: 16 pixel lanes, 16 blocks of 4 x 4 pixels in a tile; `alive` has a bit per block."""

EXP2 = """
            // exp2(p): p = n + f with |f| <= 1/2 through the 1.5 * 2^23 trick, then a degree-5 minimax polynomial
            // in f (relative error 2e-7) to whose exponent field n is added.
            const F n = p + 12582912.0f;
            const F f = p - (n - 12582912.0f);
            F e = fma(f, (F)1.3264727e-3f, (F)9.671513e-3f);
            e = fma(e, f, (F)5.5507336e-2f);
            e = fma(e, f, (F)2.4022242e-1f);
            e = fma(e, f, (F)6.9314700e-1f);
            e = fma(e, f, (F)1.0f);
            I exponent, mantissa;
            __builtin_memcpy(&exponent, &n, 64);
            __builtin_memcpy(&mantissa, &e, 64);
            mantissa += exponent << 23;
            F raw;
            __builtin_memcpy(&raw, &mantissa, 64);
"""
"""CPU snippet: p -> raw = exp2(p), for -126 < p < 127."""

BLEND = f"""
            const F alpha = __builtin_elementwise_min(raw, (F){float(ALPHA_MAX)!r}f);
            const F t = T[k];
            const F next = fma(-alpha, t, t);
            const I seen = p >= {float(LOG2_CUTOFF)!r}f;
            const I blend = seen & (next > {float(TRANSMITTANCE_MIN)!r}f);
            const F w = blend ? alpha * t : zero;
"""
"""CPU snippet: raw alpha of block k -> weights w of the lanes that blend."""

ADVANCE = """
            T[k] = blend ? next : t;
            const I stop = seen & ~blend;
            if (__builtin_expect(bits(stop & (t > 0.0f)) != 0, 0)) {
                T[k] = stop ? -__builtin_elementwise_abs(t) : T[k];
                if (!bits(T[k] > 0.0f)) alive &= ~(1u << k);
            }
"""
"""CPU snippet: transmittance behind block k."""

ENTRY = f"""
        const size_t g = (size_t)id[at];
        if (end - at > 4) __builtin_prefetch(record + (size_t)id[at + 4] * {RECORD});
        const float* const r = record + g * {RECORD};
        const float dx = (float)tile_x + 0.5f - r[{MEAN}], dy = (float)tile_y + 0.5f - r[{MEAN + 1}];
        const float a = r[{FACTOR}], b = r[{FACTOR + 1}], d = r[{FACTOR + 2}];

        // Blocks the Gaussian can reach: their centre lies in the box grown by the block, and within
        // `reach` of the mean where distance is counted in standard deviations.
        const F bx = block_x + dx, by = block_y + dy;
        const F u_block = fma((F)a, bx, b * by), v_block = d * by;
        const F cu = u_block + 1.5f * (a + b), cv = v_block + 1.5f * d;
        const I hit = (__builtin_elementwise_abs(bx + 1.5f) <= r[{BOX}] + 1.5f)
            & (__builtin_elementwise_abs(by + 1.5f) <= r[{BOX + 1}] + 1.5f)
            & (fma(cu, cu, cv * cv) <= r[{REACH}]);
        unsigned mask = bits(hit) & alive;
        if (!mask) continue;
        *(F*)ub = u_block;
        *(F*)vb = v_block;
        const F u_lane = fma((F)a, column, b * row), v_lane = d * row;
        const float l = r[{LOG2_OPACITY}];
        const float* const c = colour + g * channel_stride;
        const float r0 = c[0], r1 = c[1], r2 = c[2], r3 = c[3];
"""
"""CPU snippet: entry `at` of the list -> its record and the mask of blocks it reaches."""

POWER = """
            const F u = u_lane + ub[k], v = v_lane + vb[k];
            const F p = fma(-v, v, fma(-u, u, (F)l));
"""
"""CPU snippet: base-2 logarithm p of alpha at the lanes of block k."""

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{TILE_LANES}
    F c0[16], c1[16], c2[16], c3[16];
    for (int k = 0; k < 16; ++k) c0[k] = c1[k] = c2[k] = c3[k] = zero;
    float ub[16] __attribute__((aligned(64))), vb[16] __attribute__((aligned(64)));
    const float* const record = records.data;
    const float* const colour = channels.data + channel_offset;
    const int channel_stride = channels.shape[1];
    const int* const id = ids.data;
    const int end = offsets.data[tile + 1];
    int at = begin;
    for (; at < end && alive; ++at) {{
{ENTRY}
        do {{
            const int k = __builtin_ctz(mask);
            mask &= mask - 1;
{POWER}{EXP2}{BLEND}
            c0[k] = fma(w, (F)r0, c0[k]);
            c1[k] = fma(w, (F)r1, c1[k]);
            c2[k] = fma(w, (F)r2, c2[k]);
            if (count > 3) c3[k] = fma(w, (F)r3, c3[k]);
{ADVANCE}
        }} while (mask);
    }}

    // Write what lies inside the image, over the background; expected depth is divided by alpha.
    const float* const background = backgrounds.data + (size_t)camera * count;
    for (int y = 0; y < y_end; ++y) {{
        for (int x = 0; x < x_end; ++x) {{
            const int k = (y >> 2) * 4 + (x >> 2), lane = (y & 3) * 4 + (x & 3);
            const float t = T[k][lane] < 0.0f ? -T[k][lane] : T[k][lane];
            const float alpha = 1.0f - t;
            const float sum[4] = {{c0[k][lane], c1[k][lane], c2[k][lane], c3[k][lane]}};
            const size_t pixel = ((size_t)camera * height + tile_y + y) * width + tile_x + x;
            float* const out = image_out.data + pixel * count;
            for (int i = 0; i < count; ++i) {{
                out[i] = sum[i] + t * background[i];
                if (i == divided) out[i] = sum[i] / (alpha > 1e-10f ? alpha : 1e-10f);
            }}
            transmittance_out.data[pixel] = t;
            alphas_out.data[pixel] = alpha;
        }}
    }}
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


@wp.func
def log2_alpha(records: wp.array2d[float], i: int, px: float, py: float) -> float:
    """Base-2 logarithm of a Gaussian's alpha at a pixel position, before the 0.99 limit."""
    dx = px - records[i, MEAN]
    dy = py - records[i, MEAN + 1]
    u = records[i, FACTOR] * dx + records[i, FACTOR + 1] * dy
    v = records[i, FACTOR + 2] * dy
    return records[i, LOG2_OPACITY] - u * u - v * v


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

    `last_out` holds the list position after the last Gaussian blended.
    """
    i = start + wp.tid()
    tile = i / (TILE * TILE)
    in_tile = i - tile * (TILE * TILE)
    tiles_x = (width + TILE - 1) / TILE
    tiles_y = (height + TILE - 1) / TILE
    camera = tile / (tiles_x * tiles_y)
    in_camera = tile - camera * tiles_x * tiles_y
    x = in_camera % tiles_x * TILE + in_tile % TILE
    y = in_camera / tiles_x * TILE + in_tile / TILE
    if x >= width or y >= height:
        return

    transmittance = wp.float32(1.0)
    blended = wp.vec4(0.0, 0.0, 0.0, 0.0)
    begin = offsets[tile]
    last = wp.int32(begin)
    for at in range(begin, offsets[tile + 1]):
        g = ids[at]
        power = log2_alpha(records, g, float(x) + 0.5, float(y) + 0.5)
        if power >= LOG2_CUTOFF:
            alpha = wp.min(wp.exp(LN2 * power), ALPHA_MAX)
            weight = alpha * transmittance
            if transmittance - weight <= TRANSMITTANCE_MIN:
                break
            for j in range(count):
                blended[j] += weight * channels[g, channel_offset + j]
            transmittance -= weight
            last = at + 1

    pixel = (camera * height + y) * width + x
    alpha = 1.0 - transmittance
    for j in range(count):
        value = blended[j] + transmittance * backgrounds[camera, j]
        if j == divided:
            value = blended[j] / wp.max(alpha, 1.0e-10)
        image_out[pixel, j] = value
    alphas_out[pixel] = alpha
    transmittance_out[pixel] = transmittance
    last_out[pixel] = last
