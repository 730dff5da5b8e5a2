"""Alpha compositing of depth-sorted surfels, front to back: colours, depth, normals, distortion.

Both kernels read the records of `gdpro_sim.kernels.surfels` and the lists of `gdpro_sim.kernels.tiles`. At
a pixel

    s      = min(u^2 + v^2, log2(e) d^2)          the disc's kernel, where its hit lies ahead, or the low-pass
    w      = min(0.99, o exp2(-s)) T              skip and stop as in `gdpro_sim.kernels.compositing`
    z      = DEPTH / W, or DEPTH where the low-pass is larger
    image += w c,   depth += w z,   normal += w NORMAL
    distortion += 2 w (z A - depth), A = 1 - T    before w is added to them
    median = z of the last blended while T > 1/2

Up to three channels are blended at once; more run again over the same lists with other `channels`, without
what is not colour. `surfel_tile` is for CPUs, one index per tile, `surfel_pixel` for GPUs, one per pixel (see
`gdpro_sim.kernels.compositing`); both compile the same text, for vectors of 16 pixels or for one.
"""

import warp as wp

from gdpro_sim.kernels.compositing import (
    ADVANCE,
    ALPHA_MAX,
    EXP2,
    LN2,
    LOCATE_PIXEL,
    LOCATE_TILE,
    TILE_LANES,
    TRANSMITTANCE_MIN,
)
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.projection import LOG2_CUTOFF
from gdpro_sim.kernels.surfels import (
    BOX,
    CENTER,
    DEPTH,
    EXTENT,
    LOG2_E,
    LOG2_OPACITY,
    MEAN,
    NORMAL,
    REACH,
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

NEAREST = 1.0e-8
"""Smallest W of a hit: nearer to zero the hit is farther than the disc extends, below zero behind the
camera."""

VECTOR = f"""
{TILE_LANES}
    auto min_ = [](F v, F w) {{ return __builtin_elementwise_min(v, w); }};
    auto max_ = [](F v, F w) {{ return __builtin_elementwise_max(v, w); }};
    auto abs_ = [](F v) {{ return __builtin_elementwise_abs(v); }};
#if defined(__AVX512F__)
    // A 14-bit estimate and one step of Newton's method, to about 1 ulp.
    auto reciprocal = [&](F v) {{
        const F y = (F)__builtin_ia32_rcp14ps512_mask(v, zero, (unsigned short)-1);
        return fma(y, fma(-v, y, one), y);
    }};
#else
    auto reciprocal = [&](F v) {{ return one / v; }};
#endif
    const F nearest = (F){NEAREST!r}f, log2_e = (F){LOG2_E!r}f, one_half = (F)0.5f;
    const int SIZE = 16;
"""
"""CPU snippet: vectors of 16 pixels, for the text below."""

SCALAR = f"""
    typedef float F;
    typedef int I;
#if defined(__CUDACC__)
    auto fma = [](F a, F b, F c) {{ return fmaf(a, b, c); }};
#else
    auto fma = [](F a, F b, F c) {{ return __builtin_elementwise_fma(a, b, c); }};
#endif
    auto min_ = [](F v, F w) {{ return v < w ? v : w; }};
    auto max_ = [](F v, F w) {{ return v > w ? v : w; }};
    auto abs_ = [](F v) {{ return v < 0.0f ? -v : v; }};
    auto reciprocal = [](F v) {{ return 1.0f / v; }};
    const F zero = 0.0f, one = 1.0f, one_half = 0.5f, alpha_max = {float(ALPHA_MAX)!r}f,
        cutoff = {float(LOG2_CUTOFF)!r}f;
    const F transmittance_min = {float(TRANSMITTANCE_MIN)!r}f, nearest = {NEAREST!r}f, log2_e = {LOG2_E!r}f;
    const int SIZE = 1, k = 0;
    F T[1] = {{one}};
"""
"""Snippet: one pixel, number 0 of arrays of one, for the text below."""

EXP = f"""
            const F raw = expf({float(LN2)!r}f * p);
"""
"""Snippet for one pixel: p -> raw = exp2(p)."""

RECORD_FIELDS = f"""
        const float u_x = r[{U}], u_y = r[{U + 1}], v_x = r[{V}], v_y = r[{V + 1}];
        const float w_x = r[{SLOPE}], w_y = r[{SLOPE + 1}], depth = r[{DEPTH}];
        const float nx = r[{NORMAL}], ny = r[{NORMAL + 1}], nz = r[{NORMAL + 2}], l = r[{LOG2_OPACITY}];
        const float r0 = c[0], r1 = c[1], r2 = c[2];
"""

ENTRY = f"""
        const size_t g = (size_t)id[at];
        if (end - at > 4) {{
            __builtin_prefetch(record + (size_t)id[at + 4] * {RECORD});
            __builtin_prefetch(record + (size_t)id[at + 4] * {RECORD} + 16);
        }}
        const float* const r = record + g * {RECORD};
        const float* const c = colour + g * channel_stride;
{RECORD_FIELDS}
        // Offsets from centre and mean of the first pixel of each block.
        const float x0 = (float)tile_x + 0.5f, y0 = (float)tile_y + 0.5f;
        const F ex = block_x + (x0 - r[{CENTER}]), ey = block_y + (y0 - r[{CENTER + 1}]);
        const F mx = block_x + (x0 - r[{MEAN}]), my = block_y + (y0 - r[{MEAN + 1}]);
        const F u_block = fma((F)u_x, ex, u_y * ey), v_block = fma((F)v_x, ex, v_y * ey);
        const F w_block = fma((F)w_x, ex, fma((F)w_y, ey, one));

        // Blocks it can reach: they touch the box; and the disc, of which U . e, V . e vary by no more than
        // REACH
        // within the block and W by no more than this; or the low-pass, a circle.
        const float turn = 1.5f * ((w_x < 0.0f ? -w_x : w_x) + (w_y < 0.0f ? -w_y : w_y));
        const F widest = w_block + (1.5f * (w_x + w_y) + turn);
        const F cu = u_block + 1.5f * (u_x + u_y), cv = v_block + 1.5f * (v_x + v_y);
        const F limit = r[{EXTENT}] * widest + r[{REACH}];
        const float blur = r[{EXTENT}] * {LOG2_E**-0.5!r}f + 1.5f;
        const I on_disc = (widest > zero) & (fma(cu, cu, cv * cv) <= limit * limit);
        const I on_blur = (abs_(mx + 1.5f) <= blur) & (abs_(my + 1.5f) <= blur);
        const I in_box = (abs_(block_x + (x0 + 1.5f - r[{BOX}])) <= r[{BOX + 2}] + 1.5f)
            & (abs_(block_y + (y0 + 1.5f - r[{BOX + 1}])) <= r[{BOX + 3}] + 1.5f);
        unsigned mask = bits(in_box & (on_disc | on_blur)) & alive;
        if (!mask) continue;
        unsigned blurred = mask & bits(on_blur);
        mask &= ~blurred;
        *(F*)ub = u_block;
        *(F*)vb = v_block;
        *(F*)wb = w_block;
        *(F*)mxb = mx;
        *(F*)myb = my;
        const F u_lane = fma((F)u_x, column, u_y * row), v_lane = fma((F)v_x, column, v_y * row);
        const F w_lane = fma((F)w_x, column, w_y * row);
"""
"""CPU snippet: entry `at` -> its record, and bits of the blocks reached: by the low-pass or not (`mask`)."""

BLOCK_ARRAYS = "".join(
    f"    float {name}[16] __attribute__((aligned(64)));\n" for name in ("ub", "vb", "wb", "mxb", "myb")
)

IN_BLOCK = """
            const F un = u_lane + ub[k], vn = v_lane + vb[k], wn = w_lane + wb[k];
            const F dx = column + mxb[k], dy = row + myb[k];
"""

_HIT = """
            const F inverse = reciprocal(max_(wn, nearest));
            const F u = un * inverse, v = vn * inverse;
            const F disc = fma(u, u, v * v);
"""

HIT_DISC = f"""{_HIT}
            const I hit = wn > nearest;
            const F p = l - disc;
            const F scale = inverse;
"""
"""Snippet: un = U . e, vn, wn -> p = log2(alpha) where hit, scale = z / DEPTH; far from the low-pass."""

HIT = f"""{_HIT}
            const F low = log2_e * fma(dx, dx, dy * dy);
            const I hit = (wn > nearest) & (disc <= low);
            const F p = l - (hit ? disc : low);
            const F scale = hit ? inverse : one;
"""
"""The same with the low-pass; dx, dy from the mean."""

_WEIGH = """
            const F alpha = min_(raw, alpha_max);
            const F t = T[k];
            const F next = fma(-alpha, t, t);
            const I blend = seen & (next > transmittance_min);
            const F w = blend ? alpha * t : zero;
            const F z = depth * scale;
"""
WEIGH_DISC = f"""
            const I seen = hit & (p >= cutoff);
{_WEIGH}"""
WEIGH = f"""
            const I seen = p >= cutoff;
{_WEIGH}"""
"""Snippets: raw alpha -> weight w of what blends, and depth z."""

_ADD = """
            c0[k] = fma(w, (F)r0, c0[k]);
            c1[k] = fma(w, (F)r1, c1[k]);
            c2[k] = fma(w, (F)r2, c2[k]);
            if (geometry) {
                n0[k] = fma(w, (F)nx, n0[k]);
                n1[k] = fma(w, (F)ny, n1[k]);
                n2[k] = fma(w, (F)nz, n2[k]);
                bend[k] = fma(w, fma(z, one - t, -D[k]), bend[k]);
                D[k] = fma(w, z, D[k]);
                const I middle = blend & (t > one_half);
                median[k] = middle ? z : median[k];
                median_at[k] = middle ? (I)at : median_at[k];
            }
"""

_SUMS = """
    F c0[SIZE], c1[SIZE], c2[SIZE], n0[SIZE], n1[SIZE], n2[SIZE], D[SIZE], bend[SIZE], median[SIZE];
    I median_at[SIZE];
    for (int i = 0; i < SIZE; ++i) {
        c0[i] = c1[i] = c2[i] = n0[i] = n1[i] = n2[i] = D[i] = bend[i] = median[i] = zero;
        median_at[i] = (I)-1;
    }
"""

_WRITE = """
            // Over the background; an expected depth is divided by alpha.
            const float alpha = 1.0f - t;
            float* const out = image_out.data + pixel * channels_out;
            for (int i = 0; i < colours; ++i) out[i] = sum[i] + t * background[i];
            if (channels_out > colours) out[colours] = divided ? sum[3] / (alpha > 1e-10f ? alpha
                : 1e-10f) : sum[3];
            alphas_out.data[pixel] = alpha;
            transmittance_out.data[pixel] = t;
            if (geometry) {
                depths_out.data[pixel] = sum[3];
                for (int i = 0; i < 3; ++i) normals_out.data[3 * pixel + i] = sum[4 + i];
                distortion_out.data[pixel] = 2.0f * sum[7];
                medians_out.data[pixel] = sum[8];
                medians_at_out.data[pixel] = at_median;
            }
"""
"""Snippet: `pixel`, t, the nine sums and at_median -> images."""

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{VECTOR}{_SUMS}{BLOCK_ARRAYS}
    const float* const record = records.data;
    const float* const colour = channels.data + channel_offset;
    const int channel_stride = channels.shape[1];
    const int channels_out = image_out.shape[1];
    const int* const id = ids.data;
    const int end = offsets.data[tile + 1];
    int at = begin;
    for (; at < end && alive; ++at) {{
{ENTRY}
        while (mask) {{
            const int k = __builtin_ctz(mask);
            mask &= mask - 1;
            const F un = u_lane + ub[k], vn = v_lane + vb[k], wn = w_lane + wb[k];
{HIT_DISC}{EXP2}{WEIGH_DISC}{_ADD}{ADVANCE}
        }}
        while (blurred) {{
            const int k = __builtin_ctz(blurred);
            blurred &= blurred - 1;
{IN_BLOCK}{HIT}{EXP2}{WEIGH}{_ADD}{ADVANCE}
        }}
    }}
    const float* const background = backgrounds.data + (size_t)camera * colours;
    for (int y = 0; y < y_end; ++y) {{
        for (int x = 0; x < x_end; ++x) {{
            const int k = (y >> 2) * 4 + (x >> 2), lane = (y & 3) * 4 + (x & 3);
            const float t = T[k][lane] < 0.0f ? -T[k][lane] : T[k][lane];
            const size_t pixel = ((size_t)camera * height + tile_y + y) * width + tile_x + x;
            const float sum[9] = {{c0[k][lane], c1[k][lane], c2[k][lane], D[k][lane],
                n0[k][lane], n1[k][lane], n2[k][lane], bend[k][lane], median[k][lane]}};
            const int at_median = median_at[k][lane];
{_WRITE}
        }}
    }}
    stops_out.data[tile] = at;
#endif
"""

_PIXEL = f"""
{LOCATE_PIXEL}
    if (!inside) return;
{SCALAR}{_SUMS}
    const int channels_out = image_out.shape[1];
    const int end = offsets.data[tile + 1];
    int last = begin;
    for (int at = begin; at < end; ++at) {{
        const size_t g = (size_t)ids.data[at];
        const float* const r = records.data + g * {RECORD};
        const float* const c = channels.data + g * channels.shape[1] + channel_offset;
{RECORD_FIELDS}
        const float ex = (float)x + 0.5f - r[{CENTER}], ey = (float)y + 0.5f - r[{CENTER + 1}];
        const float dx = (float)x + 0.5f - r[{MEAN}], dy = (float)y + 0.5f - r[{MEAN + 1}];
        const float un = u_x * ex + u_y * ey, vn = v_x * ex + v_y * ey, wn = 1.0f + w_x * ex + w_y * ey;
{HIT}
        if (p < cutoff) continue;
{EXP}{WEIGH}
        if (!blend) break;
{_ADD}
        T[0] = next;
        last = at + 1;
    }}
    const float* const background = backgrounds.data + (size_t)camera * colours;
    const float t = T[0];
    const float sum[9] = {{c0[0], c1[0], c2[0], D[0], n0[0], n1[0], n2[0], bend[0], median[0]}};
    const int at_median = median_at[0];
{_WRITE}
    lasts_out.data[pixel] = last;
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
    colours: int,
    divided: bool,
    geometry: bool,
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    stops_out: wp.array[int],
    depths_out: wp.array[float],
    normals_out: wp.array2d[float],
    distortion_out: wp.array[float],
    medians_out: wp.array[float],
    medians_at_out: wp.array[int],
): ...


@wp.kernel
def surfel_tile(
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
    colours: int,
    divided: bool,
    geometry: bool,
    # Out:
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    stops_out: wp.array[int],
    depths_out: wp.array[float],
    normals_out: wp.array2d[float],
    distortion_out: wp.array[float],
    medians_out: wp.array[float],
    medians_at_out: wp.array[int],
):
    """Blend channels[g, channel_offset + j] into image channel j < colours <= 3, and depth into the next, if
    any.

    That depth is divided by alpha where `divided`. What follows `stops_out` (the list position where the tile
    had nothing left to blend) is written where `geometry`; medians' list positions are -1 for none.
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
        colours,
        divided,
        geometry,
        image_out,
        alphas_out,
        transmittance_out,
        stops_out,
        depths_out,
        normals_out,
        distortion_out,
        medians_out,
        medians_at_out,
    )


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
    colours: int,
    divided: bool,
    geometry: bool,
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    lasts_out: wp.array[int],
    depths_out: wp.array[float],
    normals_out: wp.array2d[float],
    distortion_out: wp.array[float],
    medians_out: wp.array[float],
    medians_at_out: wp.array[int],
): ...


@wp.kernel
def surfel_pixel(
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
    colours: int,
    divided: bool,
    geometry: bool,
    # Out:
    image_out: wp.array2d[float],
    alphas_out: wp.array[float],
    transmittance_out: wp.array[float],
    lasts_out: wp.array[int],
    depths_out: wp.array[float],
    normals_out: wp.array2d[float],
    distortion_out: wp.array[float],
    medians_out: wp.array[float],
    medians_at_out: wp.array[int],
):
    """The same for one pixel: index / 256 is the tile, index % 256 the pixel in it.

    `lasts_out` holds the list position after the last surfel blended.
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
        colours,
        divided,
        geometry,
        image_out,
        alphas_out,
        transmittance_out,
        lasts_out,
        depths_out,
        normals_out,
        distortion_out,
        medians_out,
        medians_at_out,
    )
