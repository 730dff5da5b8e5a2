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
    ALPHA_MAX,
    BATCH_FORWARD,
    EXP2,
    LN2,
    LOCATE_PIXEL,
    LOCATE_TILE,
    PASS,
    TILE_LANES,
    TRANSMITTANCE_MIN,
)
from gdpro_sim.kernels.images import IMAGES
from gdpro_sim.kernels.lanes import CPU_FLAGS, TRANSPOSE
from gdpro_sim.kernels.projection import LOG2_CUTOFF, SLACK
from gdpro_sim.kernels.surfels import (
    BLUR,
    BOX,
    CENTER,
    CHANNELS,
    DEPTH,
    EXTENT,
    LOG2_E,
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

NEAREST = 1.0e-8
"""Smallest W of a hit: nearer to zero the hit is farther than the disc extends, below zero behind the
camera."""

VECTOR = f"""
{TILE_LANES}
    // One instruction each; of NaN and w, w.
    auto min_ = [](F v, F w) {{ return v < w ? v : w; }};
    auto max_ = [](F v, F w) {{ return v > w ? v : w; }};
    auto abs_ = [](F v) {{ return __builtin_elementwise_abs(v); }};
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
"""
"""Snippet: one pixel, number 0 of arrays of one, for the text below."""

EXP = f"""
            const F raw = expf({float(LN2)!r}f * p);
"""
"""Snippet for one pixel: p -> raw = exp2(p)."""

BATCH_STATE = f"""
    float rows[BATCH_SIZE][{RECORD}] __attribute__((aligned(64)));
    float u0[BATCH_SIZE] __attribute__((aligned(64))), v0[BATCH_SIZE] __attribute__((aligned(64)));
    float w0[BATCH_SIZE] __attribute__((aligned(64)));
    float mx0[BATCH_SIZE] __attribute__((aligned(64))), my0[BATCH_SIZE] __attribute__((aligned(64)));
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
        // The next entries of the list, copied to `rows`, 16 at a time side by side in lanes: U . e, V . e, W
        // and the offset from the mean at the tile's first pixel, and the blocks each can reach. Those touch
        // its box, and its low-pass or its disc: within a block (U . e, V . e) varies by `reach` and
        // W by `turn` at most.
        const int held = end - at < BATCH_SIZE ? end - at : BATCH_SIZE;
        for (int first = 0; first < held; first += 16) {{
            F fields[16];
            for (int j = 0; j < 16; ++j) {{
                const int i = first + j < held ? first + j : held - 1;
                const float* const from = record + (size_t)id[at + i] * {RECORD};
                __builtin_memcpy(&fields[j], from, 64);
                __builtin_memcpy(rows[first + j], from, {4 * RECORD});
                if (!own_channels) {{
                    __builtin_memcpy(rows[first + j] + {CHANNELS}, colour + (size_t)id[at
                        + i] * channel_stride, 12);
                }}
                if (i + BATCH_SIZE < end - at) {{
                    const float* const next = record + (size_t)id[at + i + BATCH_SIZE] * {RECORD};
                    __builtin_prefetch(next);
                    __builtin_prefetch(next + 16);
                }}
            }}
            transpose(fields);
            const F u_x = fields[{U}], u_y = fields[{U + 1}], v_x = fields[{V}], v_y = fields[{V + 1}];
            const F w_x = fields[{SLOPE}], w_y = fields[{SLOPE + 1}];
            const F x0 = (F)((float)tile_x + 0.5f), y0 = (F)((float)tile_y + 0.5f);
            const F ex = x0 - fields[{CENTER}], ey = y0 - fields[{CENTER + 1}];
            const F mx = x0 - fields[{MEAN}], my = y0 - fields[{MEAN + 1}];
            const F u = fma(u_x, ex, u_y * ey), v = fma(v_x, ex, v_y * ey),
                w = fma(w_x, ex, fma(w_y, ey, one));
            *(F*)(u0 + first) = u;
            *(F*)(v0 + first) = v;
            *(F*)(w0 + first) = w;
            *(F*)(mx0 + first) = mx;
            *(F*)(my0 + first) = my;
            const F turn = 1.5f * (abs_(w_x) + abs_(w_y)), doubtful = 2.02f * turn + 1.0e-3f;
            const F blur = fields[{BLUR}] + 1.5f;
            const F corner_u = u_x + u_y, corner_v = v_x + v_y, other_u = u_x - u_y, other_v = v_x - v_y;
            const F reach = {1.5 * float(SLACK)!r}f * __builtin_elementwise_sqrt(max_(
                fma(corner_u, corner_u, corner_v * corner_v), fma(other_u, other_u, other_v * other_v)));
            const F half_x = fields[{BOX + 2}] + 1.5f, half_y = fields[{BOX + 3}] + 1.5f;
            F across_u[4], across_v[4], across_w[4], down_u[4], down_v[4], down_w[4];
            I in_x[4], in_y[4], blur_x[4], blur_y[4];
            const I there = first + lane_number < held;
            for (int i = 0; i < 4; ++i) {{
                const float middle = 4.0f * i + 1.5f;
                across_u[i] = fma(u_x, (F)middle, u), down_u[i] = u_y * middle;
                across_v[i] = fma(v_x, (F)middle, v), down_v[i] = v_y * middle;
                across_w[i] = fma(w_x, (F)middle, w + turn), down_w[i] = w_y * middle;
                in_x[i] = (abs_(x0 + middle - fields[{BOX}]) <= half_x) & there;
                in_y[i] = abs_(y0 + middle - fields[{BOX + 1}]) <= half_y;
                blur_x[i] = abs_(mx + middle) <= blur;
                blur_y[i] = abs_(my + middle) <= blur;
            }}
            {{declare}}
            for (int k = 0; k < 16; ++k) {{
                const F cu = across_u[k & 3] + down_u[k >> 2], cv = across_v[k & 3] + down_v[k >> 2];
                const F widest = across_w[k & 3] + down_w[k >> 2];
                const F limit = fma(fields[{EXTENT}], widest, reach);
                const I touched = in_x[k & 3] & in_y[k >> 2];
                const I disc = touched & (widest > zero) & (fma(cu, cu, cv * cv) <= limit * limit);
                const I low = (touched & blur_x[k & 3] & blur_y[k >> 2]) | (disc & (widest < doubtful));
                {{each}}
            }}
            {{end}}
        }}
"""
"""CPU snippet: list from `at` on -> `held` entries in `rows`, u0 .. my0; {each}, between {declare} and {end},
takes masks of the 16 entries from `first` on: whose `disc` may reach block k, and which need HIT (`low`)."""

RAY = f"""
            const float* const r = rows[i];
            const float* const c = r + {CHANNELS};
            const F un = fma((F)r[{U}], x, fma((F)r[{U + 1}], y, (F)u0[i]));
            const F vn = fma((F)r[{V}], x, fma((F)r[{V + 1}], y, (F)v0[i]));
            const F wn = fma((F)r[{SLOPE}], x, fma((F)r[{SLOPE + 1}], y, (F)w0[i]));
"""
LOW = """
            const F dx = x + mx0[i], dy = y + my0[i];
"""
"""CPU snippets: entry i of the batch, lanes x, y -> what HIT needs."""

PIXEL_RAY = f"""
        const size_t g = (size_t)ids.data[at];
        const float* const r = records.data + g * {RECORD};
        const float* const c = channels.data + g * channels.shape[1] + channel_offset;
        const float ex = (float)x + 0.5f - r[{CENTER}], ey = (float)y + 0.5f - r[{CENTER + 1}];
        const float dx = (float)x + 0.5f - r[{MEAN}], dy = (float)y + 0.5f - r[{MEAN + 1}];
        const float un = r[{U}] * ex + r[{U + 1}] * ey, vn = r[{V}] * ex + r[{V + 1}] * ey;
        const float wn = 1.0f + r[{SLOPE}] * ex + r[{SLOPE + 1}] * ey;
"""
"""Snippet for one pixel: entry `at` -> the same."""

HIT_DISC = f"""
            const F inverse = reciprocal(wn);
            const F u = un * inverse, v = vn * inverse;
            const F p = fma(-u, u, fma(-v, v, (F)r[{LOG2_OPACITY}]));
            const F z = inverse * r[{DEPTH}];
"""
"""Snippet: un = U . e, vn, wn -> p = log2(alpha) and z, where the disc is sure to be hit."""

HIT = f"""
            const F inverse = reciprocal(max_(wn, nearest));
            const F u = un * inverse, v = vn * inverse;
            const F disc = fma(u, u, v * v);
            const F low = log2_e * fma(dx, dx, dy * dy);
            const I hit = (wn > nearest) & (disc <= low);
            const F p = r[{LOG2_OPACITY}] - (hit ? disc : low);
            const F scale = hit ? inverse : one;
            const F z = scale * r[{DEPTH}];
"""
"""The same with the low-pass, and where the disc is not hit, and scale = z / DEPTH; dx, dy from the mean."""

WEIGH = """
            const I seen = p >= cutoff;
            const F alpha = min_(raw, alpha_max);
            const F next = fma(-alpha, t, t);
            const I blend = seen & (next > transmittance_min);
            const F w = blend ? alpha * t : zero;
"""
"""Snippet: raw alpha and transmittance t -> weight w of what blends."""

_ADD = f"""
            c0 = fma(w, (F)c[0], c0);
            c1 = fma(w, (F)c[1], c1);
            c2 = fma(w, (F)c[2], c2);
            if (geometry) {{
                n0 = fma(w, (F)r[{NORMAL}], n0);
                n1 = fma(w, (F)r[{NORMAL + 1}], n1);
                n2 = fma(w, (F)r[{NORMAL + 2}], n2);
                bend = fma(w, fma(z, one - t, -D), bend);
                D = fma(w, z, D);
                if (open) {{
                    const I middle = blend & (t > one_half);
                    median = middle ? z : median;
                    median_at = middle ? (I)number : median_at;
                }}
            }}
"""
"""Snippet: adds weight w of entry `number` of the list; `open` where T > 1/2 anywhere."""

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

_SUMS = ("c0", "c1", "c2", "D", "n0", "n1", "n2", "bend", "median")

_BATCH = (
    BATCH.replace("{declare}", "")
    .replace("{each}", "entries[k] |= bits(low | disc) << first; blurred[k] |= bits(low) << first;")
    .replace("{end}", "")
)

_TILE = f"""
#if !defined(__CUDACC__)
{LOCATE_TILE}{VECTOR}{IMAGES}
    const int BATCH_SIZE = {BATCH_FORWARD};
{BATCH_STATE}
    F {", ".join(f"{name}_[16]" for name in _SUMS)};
    I median_at_[16];
    for (int k = 0; k < 16; ++k) {{
        {" = ".join(f"{name}_[k]" for name in _SUMS)} = zero;
        median_at_[k] = (I)-1;
    }}
    const int channels_out = image_out.shape[1];
    fetch_image(image_out.data, channels_out);
    fetch_image(alphas_out.data, 1);
    fetch_image(transmittance_out.data, 1);
    if (geometry) {{
        fetch_image(depths_out.data, 1);
        fetch_image(normals_out.data, 3);
        fetch_image(distortion_out.data, 1);
        fetch_image(medians_out.data, 1);
        fetch_image((float*)medians_at_out.data, 1);
    }}
    const int end = offsets.data[tile + 1];
    int at = begin;
    while (at < end && alive) {{
        unsigned entries[16] = {{0}}, blurred[16] = {{0}};
{_BATCH}
        // Block after block, so that what it has blended stays in registers over the batch.
        for (unsigned blocks = alive; blocks; blocks &= blocks - 1) {{
            const int k = __builtin_ctz(blocks);
            unsigned left = entries[k];
            if (!left) continue;
            const F x = X[k], y = Y[k];
            F t = T[k], {", ".join(f"{name} = {name}_[k]" for name in _SUMS)};
            I median_at = median_at_[k];
            const bool open = bits(t > one_half) != 0;
            do {{
                const int i = __builtin_ctz(left), number = at + i;
                left &= left - 1;
{RAY}
                if (blurred[k] >> i & 1) {{
{LOW}{HIT}{EXP2}{WEIGH}{_ADD}{PASS}
                }} else {{
{HIT_DISC}{EXP2}{WEIGH}{_ADD}{PASS}
                }}
            }} while (left);
            T[k] = t, {", ".join(f"{name}_[k] = {name}" for name in _SUMS)}, median_at_[k] = median_at;
            if (!bits(t > 0.0f)) alive &= ~(1u << k);
        }}
        at += held;
    }}

    // Over the background; an expected depth is divided by alpha.
    const float* const background = backgrounds.data + (size_t)camera * colours;
    F A_[16];
    F* const sums[4] = {{c0_, c1_, c2_, D_}};
    for (int k = 0; k < 16; ++k) {{
        T[k] = abs_(T[k]);
        A_[k] = one - T[k];
        for (int i = 0; i < colours; ++i) sums[i][k] = fma(T[k], (F)background[i], sums[i][k]);
    }}
    const F* const alphas[1] = {{A_}};
    const F* const transmittances[1] = {{T}};
    const F* const depths[1] = {{D_}};
    write_image(alphas_out.data, 1, alphas);
    write_image(transmittance_out.data, 1, transmittances);
    if (geometry) {{
        for (int k = 0; k < 16; ++k) bend_[k] = bend_[k] + bend_[k];
        const F* const normals[3] = {{n0_, n1_, n2_}};
        const F* const distortions[1] = {{bend_}};
        const F* const medians[1] = {{median_}};
        const F* const medians_at[1] = {{(const F*)median_at_}};
        write_image(depths_out.data, 1, depths);
        write_image(normals_out.data, 3, normals);
        write_image(distortion_out.data, 1, distortions);
        write_image(medians_out.data, 1, medians);
        write_image((float*)medians_at_out.data, 1, medians_at);
    }}
    if (divided) for (int k = 0; k < 16; ++k) D_[k] = D_[k] / max_(A_[k], (F)1e-10f);
    const F* planes[4];
    for (int i = 0; i < channels_out; ++i) planes[i] = i < colours ? sums[i] : D_;
    write_image(image_out.data, channels_out, planes);
    stops_out.data[tile] = at;
#endif
"""

_PIXEL = f"""
{LOCATE_PIXEL}
    if (!inside) return;
{SCALAR}
    F t = one, {", ".join(f"{name} = zero" for name in _SUMS)};
    I median_at = -1;
    const bool open = true;
    const int channels_out = image_out.shape[1];
    const int end = offsets.data[tile + 1];
    int last = begin;
    for (int at = begin; at < end; ++at) {{
{PIXEL_RAY}{HIT}
        if (p < cutoff) continue;
{EXP}{WEIGH}
        if (!blend) break;
        const int number = at;
{_ADD}
        t = next;
        last = at + 1;
    }}
    const float* const background = backgrounds.data + (size_t)camera * colours;
    const float sum[9] = {{{", ".join(_SUMS)}}};
    const int at_median = median_at;
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
