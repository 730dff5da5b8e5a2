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

import platform

import warp as wp

from gdpro_sim.kernels.projection import BOX, FACTOR, LOG2_CUTOFF, LOG2_OPACITY, MEAN, REACH, RECORD, TILE

X86 = platform.machine().lower() in ("x86_64", "amd64")
"""Other processors have no choice of vector width, and their compilers no such flag."""

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native" + (" -mprefer-vector-width=512" if X86 else ""),
    }
)

ALPHA_MAX = wp.constant(0.99)
TRANSMITTANCE_MIN = wp.constant(1.0e-4)
LN2 = wp.constant(0.6931471805599453)


@wp.func
def log2_alpha(records: wp.array2d[float], i: int, px: float, py: float) -> float:
    """Base-2 logarithm of a Gaussian's alpha at a pixel position, before the 0.99 limit."""
    dx = px - records[i, MEAN]
    dy = py - records[i, MEAN + 1]
    u = records[i, FACTOR] * dx + records[i, FACTOR + 1] * dy
    v = records[i, FACTOR + 2] * dy
    return records[i, LOG2_OPACITY] - u * u - v * v


# The state of a pixel's blending is its transmittance T with the sign as a flag: T > 0 goes on, T < 0 has
# stopped at |T|. exp2(p): p = n + f with |f| <= 1/2 through the 1.5 * 2^23 trick, then a degree-5 minimax
# polynomial in f (relative error 2e-7) whose exponent field n is added to.
_TILE_SNIPPET = f"""
#if !defined(__CUDACC__)
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    typedef bool M __attribute__((ext_vector_type(16)));
    const F column = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}};
    const F row = {{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};
    const F block_x = 4.0f * column, block_y = 4.0f * row;
    const float inside = 1.0f, outside = -1.0f;

    F T[16], c0[16], c1[16], c2[16], c3[16];
    float ub[16] __attribute__((aligned(64))), vb[16] __attribute__((aligned(64)));
    auto fma = [](F a, F b, F c) {{ return __builtin_elementwise_fma(a, b, c); }};
    auto bits = [](I mask) {{
        M m = __builtin_convertvector(mask, M);
        unsigned short b;
        __builtin_memcpy(&b, &m, 2);
        return (unsigned)b;
    }};

    unsigned alive = 0;
    for (int k = 0; k < 16; ++k) {{
        const F x = (float)tile_x + (float)(4 * (k & 3)) + column;
        const F y = (float)tile_y + (float)(4 * (k >> 2)) + row;
        const I in = (x < (float)width) & (y < (float)height);
        T[k] = in ? (F)inside : (F)outside;
        c0[k] = c1[k] = c2[k] = c3[k] = (F)0.0f;
        if (bits(in)) alive |= 1u << k;
    }}

    const float* const record = records.data;
    const float* const colour = channels.data + channel_offset;
    const int* const id = ids.data;
    int at = begin;
    for (; at < end && alive; ++at) {{
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
        do {{
            const int k = __builtin_ctz(mask);
            mask &= mask - 1;
            const F u = u_lane + ub[k], v = v_lane + vb[k];
            const F p = fma(-v, v, fma(-u, u, (F)l));
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
            F alpha;
            __builtin_memcpy(&alpha, &mantissa, 64);
            alpha = __builtin_elementwise_min(alpha, (F)0.99f);
            const F t = T[k];
            const F weight = alpha * t;
            const F next = fma(-alpha, t, t);
            const I seen = p >= {float(LOG2_CUTOFF)!r}f;
            const I blend = seen & (next > 1.0e-4f);
            const I stop = seen & ~blend;
            const F w = blend ? weight : (F)0.0f;
            c0[k] = fma(w, (F)r0, c0[k]);
            c1[k] = fma(w, (F)r1, c1[k]);
            c2[k] = fma(w, (F)r2, c2[k]);
            c3[k] = fma(w, (F)r3, c3[k]);
            T[k] = blend ? next : t;
            if (__builtin_expect(bits(stop & (t > 0.0f)) != 0, 0)) {{
                T[k] = stop ? -__builtin_elementwise_abs(t) : T[k];
                if (!bits(T[k] > 0.0f)) alive &= ~(1u << k);
            }}
        }} while (mask);
    }}

    // Write what lies inside the image, over the background; expected depth is divided by alpha.
    const int x_end = width - tile_x < {TILE} ? width - tile_x : {TILE};
    const int y_end = height - tile_y < {TILE} ? height - tile_y : {TILE};
    const float* const background = backgrounds.data + (size_t)camera * image_channels + first_channel;
    for (int y = 0; y < y_end; ++y) {{
        for (int x = 0; x < x_end; ++x) {{
            const int k = (y >> 2) * 4 + (x >> 2), lane = (y & 3) * 4 + (x & 3);
            const float t = T[k][lane] < 0.0f ? -T[k][lane] : T[k][lane];
            const float alpha = 1.0f - t;
            const float sum[4] = {{c0[k][lane], c1[k][lane], c2[k][lane], c3[k][lane]}};
            const size_t pixel = ((size_t)camera * height + tile_y + y) * width + tile_x + x;
            float* const out = image_out.data + pixel * image_channels + first_channel;
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


@wp.func_native(_TILE_SNIPPET)
def blend_tile(
    records: wp.array2d[float],
    channels: wp.array2d[float],
    channel_offset: int,
    channel_stride: int,
    ids: wp.array[int],
    begin: int,
    end: int,
    backgrounds: wp.array2d[float],
    tile: int,
    camera: int,
    tile_x: int,
    tile_y: int,
    width: int,
    height: int,
    image_channels: int,
    first_channel: int,
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
    first_channel: int,
    count: int,
    divided: int,
    # Out:
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    stops_out: wp.array[int],
):
    """Blend channel `channels[g, channel_offset + j]` into image channel first_channel + j, j < count <= 4.

    `divided` is the one divided by alpha (expected depth), or -1. `stops_out` holds the list position
    where a tile had nothing left to blend.
    """
    tile = start + wp.tid()
    tiles_x = (width + TILE - 1) / TILE
    tiles_y = (height + TILE - 1) / TILE
    camera = tile / (tiles_x * tiles_y)
    in_camera = tile - camera * tiles_x * tiles_y
    blend_tile(
        records,
        channels,
        channel_offset,
        channels.shape[1],
        ids,
        offsets[tile],
        offsets[tile + 1],
        backgrounds,
        tile,
        camera,
        in_camera % tiles_x * TILE,
        in_camera / tiles_x * TILE,
        width,
        height,
        backgrounds.shape[1],
        first_channel,
        count,
        divided,
        image_out,
        alphas_out,
        transmittance_out,
        stops_out,
    )


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
    first_channel: int,
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
        value = blended[j] + transmittance * backgrounds[camera, first_channel + j]
        if j == divided:
            value = blended[j] / wp.max(alpha, 1.0e-10)
        image_out[pixel, first_channel + j] = value
    alphas_out[pixel] = alpha
    transmittance_out[pixel] = transmittance
    last_out[pixel] = last
