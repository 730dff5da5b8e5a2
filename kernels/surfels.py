"""Projection of surfels, flat Gaussians on discs, forward.

A surfel lies in the plane of its rotation's first two columns and is seen where a pixel's ray meets it (Huang
et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields", 2024). With e the pixel's offset
from the projected centre, the hit has

    u = (U . e) / W,   v = (V . e) / W,   z = DEPTH / W,   W = 1 + SLOPE . e

exactly: perspective is a ratio of linear functions of the pixel, and the centre is seen at e = 0. u and v
are in standard deviations times sqrt(log2(e) / 2), so that the disc's kernel is exp2(-(u^2 + v^2)). A
low-pass exp2(-log2(e) d^2), d the pixel's offset from the mean, stands in where it is larger: for discs
thinner than a pixel. Every surfel seen by a camera becomes one record of 24 float32:

    MEAN          2  centre in pixels of the ellipse that the one-sigma circle projects to; where that circle
                     reaches behind the camera, CENTER
    CENTER        2  projected centre in pixels
    U, V, SLOPE   6  1/pixel
    EXTENT        1  sqrt(u^2 + v^2) where alpha = 1/255
    BLUR          1  pixels from the mean in x or y outside which no pixel's low-pass is both seen and larger
    BOX           4  centre and half extents in pixels of the box outside which alpha < 1/255
    LOG2_OPACITY  1  base-2 logarithm of the opacity
    DEPTH         1  camera-space z of the centre in metres
    NORMAL        3  world-space unit normal, facing the camera
    CHANNELS      3  the first three channels to blend

The first 16 tell which pixels it can reach. Culled surfels have a record of zeros, an empty rectangle and an
infinite sort key. The index of the kernel is a group of `LANES` surfels of one camera (see
`gdpro_sim.kernels.lanes`), camera after camera.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import HARMONICS
from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE
from gdpro_sim.kernels.projection import (
    BIN,
    CAMERA,
    LOG2_CUTOFF,
    PINHOLE,
    PIXEL_BOX,
    ROTATION,
    SLACK,
    SQRT_HALF_LOG2_E,
    vec4s,
)

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

RECORD = 24
MEAN = 0
CENTER = 2
U = 4
V = 6
SLOPE = 8
EXTENT = 10
BLUR = 11
BOX = 12
LOG2_OPACITY = 16
DEPTH = 17
NORMAL = 18
CHANNELS = 21

LOG2_E = 1.4426950408889634

GRAZING = 1.0e-7
"""Sine, nearly, of the smallest angle between disc and ray to the centre; flatter discs count as so much."""

STEEPEST = 1.0e12
"""Largest U, V in 1/pixel: keeps squares of u and v meaningful for discs of no size."""

SURFEL = f"""
    // Tangents a, b in camera space; z times their images' directions at the centre, pixels.
    const int scale_stride = scales.shape[1];
    const float* const scale = scales.data + (size_t)n * scale_stride;
    F deviations[3];
    if (scale_stride == 3) {{
        load3(scale, deviations);
    }} else {{
        deviations[0] = load(scale, scale_stride), deviations[1] = load(scale + 1, scale_stride);
    }}
    const F s0 = deviations[0], s1 = deviations[1];

    // In double precision: nearly from its edge, a disc's image is made of differences of nearly equal terms.
#if defined(__CUDACC__)
    typedef double D;
    auto wide = [](F v) {{ return (double)v; }};
    auto narrow = [](D v) {{ return (float)v; }};
#else
    typedef double D __attribute__((ext_vector_type(16)));
    auto wide = [](F v) {{ return __builtin_convertvector(v, D); }};
    auto narrow = [](D v) {{ return __builtin_convertvector(v, F); }};
#endif
    const D dw = wide(qw0), dx = wide(qx0), dy = wide(qy0), dz = wide(qz0);
    const D twice = 2.0 / (dw * dw + dx * dx + dy * dy + dz * dz);
    const D d00 = 1.0 - twice * (dy * dy + dz * dz), d10 = twice * (dx * dy + dw * dz),
        d20 = twice * (dx * dz - dw * dy), d01 = twice * (dx * dy - dw * dz),
        d11 = 1.0 - twice * (dx * dx + dz * dz), d21 = twice * (dy * dz + dw * dx);
    const double e00 = r00, e01 = r01, e02 = r02, e10 = r10, e11 = r11, e12 = r12, e20 = r20, e21 = r21,
        e22 = r22, e03 = view[3], e13 = view[7], e23 = view[11], fx_ = fx, skew_ = skew, fy_ = fy;
    const D ax_ = e00 * d00 + e01 * d10 + e02 * d20, ay_ = e10 * d00 + e11 * d10 + e12 * d20,
        az_ = e20 * d00 + e21 * d10 + e22 * d20;
    const D bx_ = e00 * d01 + e01 * d11 + e02 * d21, by_ = e10 * d01 + e11 * d11 + e12 * d21,
        bz_ = e20 * d01 + e21 * d11 + e22 * d21;
    const D px = wide(mx), py = wide(my), pz = wide(mz);
    const D x_ = e00 * px + e01 * py + e02 * pz + e03, y_ = e10 * px + e11 * py + e12 * pz + e13,
        z_ = e20 * px + e21 * py + e22 * pz + e23;
    const D ox = (fx_ * x_ + skew_ * y_) / z_, oy = fy_ * y_ / z_;
    const D iax_ = fx_ * ax_ + skew_ * ay_ - ox * az_, iay_ = fy_ * ay_ - oy * az_;
    const D ibx_ = fx_ * bx_ + skew_ * by_ - ox * bz_, iby_ = fy_ * by_ - oy * bz_;
    const F ax = narrow(ax_), ay = narrow(ay_), az = narrow(az_);
    const F bx = narrow(bx_), by = narrow(by_), bz = narrow(bz_);
    const F iax = narrow(iax_), iay = narrow(iay_), ibx = narrow(ibx_), iby = narrow(iby_);
    const F center_x = narrow(ox + (double)cx), center_y = narrow(oy + (double)cy);
    // What a unit square of the disc covers, times z^2; zero for a disc seen from its edge.
    const F covered = narrow(iax_ * iby_ - iay_ * ibx_);
    const F least = {GRAZING!r}f * (iax * iax + iay * iay + ibx * ibx + iby * iby);
    const I grazing = abs_(covered) < least;
    const F area = select(grazing, select(covered < 0.0f, -least, least), covered);
    const F inverse_area = 1.0f / area;
    const F steepest = splat({STEEPEST!r}f);
    const F along = {SQRT_HALF_LOG2_E!r}f * z * inverse_area;
    const F pu = max_(min_(along / s0, steepest), -steepest),
        pv = max_(min_(along / s1, steepest), -steepest);
    const F u_x = pu * iby, u_y = -pu * ibx, v_x = -pv * iay, v_y = pv * iax;
    const F w_x = narrow(bz_ * iay_ - az_ * iby_) * inverse_area;
    const F w_y = narrow(az_ * ibx_ - bz_ * iax_) * inverse_area;

    // Centre of the one-sigma circle's image, from the projected centre.
    const F sa = s0 * s0 * az, sb = s1 * s1 * bz;
    const F behind = sa * az + sb * bz;
    const F ahead = z * z - behind;
    const I whole = ahead > 1.0e-6f * z * z;
    const F shift_x = select(whole, -(sa * iax + sb * ibx) / ahead, splat(0.0f));
    const F shift_y = select(whole, -(sa * iay + sb * iby) / ahead, splat(0.0f));

    // The normal turned towards the camera.
    const F nx = r00 * q02 + r01 * q12 + r02 * q22, ny = r10 * q02 + r11 * q12 + r12 * q22,
        nz = r20 * q02 + r21 * q12 + r22 * q22;
    const F side = select(nx * x + ny * y + nz * z > 0.0f, splat(-1.0f), splat(1.0f));
"""
"""Snippet: CAMERA, PINHOLE, ROTATION -> centre, U, V, SLOPE as u_x .. w_y, shift from it to MEAN, side."""

_PROJECT = f"""
    const int groups = (means.shape[0] + lanes_per_group - 1) / lanes_per_group;
    const int camera = group / groups;
    const int n = (group - camera * groups) * lanes_per_group;
    const int left = means.shape[0] - n;
    const int lanes = left < lanes_per_group ? left : lanes_per_group;
    const size_t first = (size_t)camera * means.shape[0] + n;
{PRELUDE}{CAMERA}{PINHOLE}{ROTATION}{SURFEL}
    const F zero = splat(0.0f);
    const F opacity = load(opacities.data + n, 1);
    const F log2_opacity = log2_(max_(opacity, splat(1.2e-38f)));
    const F extent2 = log2_opacity - {LOG2_CUTOFF!r}f;
    const F extent = sqrt_(max_(extent2, zero));

    // Box around the image of the disc's part above the cutoff, where it is before the camera: the outermost
    // x of the circle of r standard deviations solve (x z)^2 = r^2 ((ia - x az)^2 s0^2 + (ib - x bz)^2 s1^2).
    const F r2 = extent2 * {float(SQRT_HALF_LOG2_E) ** -2!r}f;
    const F front = z * z - r2 * behind;
    const I bounded = front > 0.01f * z * z;
    const F scaled = r2 / front;
    const F mid_x = -scaled * (sa * iax + sb * ibx), mid_y = -scaled * (sa * iay + sb * iby);
    const F ea = s0 * s0 * scaled, eb = s1 * s1 * scaled;
    const F half_x = sqrt_(mid_x * mid_x + ea * iax * iax + eb * ibx * ibx);
    const F half_y = sqrt_(mid_y * mid_y + ea * iay * iay + eb * iby * iby);
    const F blur = extent * {float(SLACK) * LOG2_E**-0.5!r}f;
    const F low_x = min_(mid_x - half_x, shift_x - blur), high_x = max_(mid_x + half_x, shift_x + blur);
    const F low_y = min_(mid_y - half_y, shift_y - blur), high_y = max_(mid_y + half_y, shift_y + blur);
    const F mean_x = select(bounded, center_x + 0.5f * (low_x + high_x), splat(0.5f * (float)width));
    const F mean_y = select(bounded, center_y + 0.5f * (low_y + high_y), splat(0.5f * (float)height));
    const float slack = {0.5 * float(SLACK)!r}f;
    const F box_x = select(bounded, (high_x - low_x) * slack + 1.0e-6f * abs_(center_x), splat((float)width));
    const F box_y = select(bounded, (high_y - low_y) * slack + 1.0e-6f * abs_(center_y),
        splat((float)height));

{PIXEL_BOX}    // A sum of magnitudes is finite only where all its terms are.
    const F size = abs_(u_x) + abs_(u_y) + abs_(v_x) + abs_(v_y) + abs_(w_x) + abs_(w_y) + abs_(s0) + abs_(s1)
        + abs_(q00) + abs_(q12) + abs_(opacity) + box_x + box_y + z * 1.0e16f;
    const F far_out = abs_(center_x) + abs_(center_y) + abs_(shift_x) + abs_(shift_y);
    I drawn = (z >= near) & (z <= far) & (z > 0.0f) & (extent2 >= 0.0f) & (opacity > 0.0f) & finite(size)
        & (far_out < {STEEPEST!r}f) & (x0 <= x1) & (y0 <= y1)
            & ((box_x > radius_clip) | (box_y > radius_clip));

    F fields[{RECORD}];
    if (any(drawn)) {{
        if (degree >= 0) {{
{HARMONICS}
            drawn = drawn & finite(red) & finite(green) & finite(blue);
            fields[{CHANNELS}] = max_(red, zero);
            fields[{CHANNELS + 1}] = max_(green, zero);
            fields[{CHANNELS + 2}] = max_(blue, zero);
        }} else {{
            const int width_ = features.shape[1];
            const float* const feature = features.data + (first % features.shape[0]) * width_;
            for (int i = 0; i < 3; ++i) fields[{CHANNELS} + i] = zero;
            for (int i = 0; i < width_; ++i) {{
                const F value = load(feature + i, width_);
                drawn = drawn & finite(value);
                if (i < 3) fields[{CHANNELS} + i] = value;
            }}
        }}
    }}

    // With s the largest |(U . e, V . e)| / |e| and t = sqrt(log2(e)), the low-pass is larger only where
    // t W d < s |e|. So where 0.9 t > s, and W > 0.9 all over the low-pass, it is larger at most at
    // d < shift s / (0.9 t - s): hardly anywhere, and where no pixel's centre lies in that square, nowhere.
    const F trace = u_x * u_x + u_y * u_y + v_x * v_x + v_y * v_y, det = u_x * v_y - u_y * v_x;
    const F gap = sqrt_(max_(trace * trace - 4.0f * det * det, zero));
    const F steep = sqrt_(0.5f * (trace + gap)) * {float(SLACK)!r}f;
    const F shift = sqrt_(shift_x * shift_x + shift_y * shift_y);
    const F slope = sqrt_(w_x * w_x + w_y * w_y);
    const F margin = {0.9 * LOG2_E**0.5!r}f - steep;
    const F tight = shift * steep / margin * 1.01f + 1.0e-3f + 1.0e-6f * (abs_(center_x) + abs_(center_y));
    const I gentle = (margin > 0.05f) & (slope * (blur + shift) < 0.1f) & (tight < blur);
    const F pixel_x = center_x + shift_x - 0.5f, pixel_y = center_y + shift_y - 0.5f;
    const F off_x = abs_(pixel_x - floor_(pixel_x + 0.5f)), off_y = abs_(pixel_y - floor_(pixel_y + 0.5f));
    const F nowhere = splat(-1.0e9f);
    const F blurred = select(gentle, select((off_x > tight) | (off_y > tight), nowhere, tight), blur);
    fields[{MEAN}] = center_x + shift_x;
    fields[{MEAN + 1}] = center_y + shift_y;
    fields[{CENTER}] = center_x;
    fields[{CENTER + 1}] = center_y;
    fields[{U}] = u_x;
    fields[{U + 1}] = u_y;
    fields[{V}] = v_x;
    fields[{V + 1}] = v_y;
    fields[{SLOPE}] = w_x;
    fields[{SLOPE + 1}] = w_y;
    fields[{LOG2_OPACITY}] = log2_opacity;
    fields[{EXTENT}] = extent * {float(SLACK)!r}f;
    fields[{DEPTH}] = z;
    fields[{NORMAL}] = side * q02;
    fields[{NORMAL + 1}] = side * q12;
    fields[{NORMAL + 2}] = side * q22;
    fields[{BOX}] = mean_x;
    fields[{BOX + 1}] = mean_y;
    fields[{BOX + 2}] = box_x;
    fields[{BOX + 3}] = box_y;
    fields[{BLUR}] = blurred;
    float* const record = records_out.data + first * {RECORD};
    F later[16];
    for (int i = 0; i < {RECORD}; ++i) fields[i] = select(drawn, fields[i], zero);
    for (int i = 0; i < 16; ++i) later[i] = fields[{RECORD - 16} + i];
    store_rows(record, {RECORD}, fields);
    store_rows(record + {RECORD - 16}, {RECORD}, later);
{BIN}"""


@wp.func_native(_PROJECT)
def project_group(
    group: int,
    lanes_per_group: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array2d[float],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    features: wp.array2d[float],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    near: float,
    far: float,
    radius_clip: float,
    records_out: wp.array2d[float],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[vec4s],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
): ...


@wp.kernel
def project_surfels(
    start: int,
    # In:
    lanes: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array2d[float],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    features: wp.array2d[float],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    near: float,
    far: float,
    radius_clip: float,
    # Out:
    records_out: wp.array2d[float],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[vec4s],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
):
    """One record for each camera and surfel; culls what is not seen, not finite or fainter than 1/255.

    Channels are max(0, SH(direction from the camera) + 0.5) where degree >= 0, else the first three of
    features, row i % rows. `lanes` is 16 on a CPU and 1 on a GPU.
    """
    project_group(
        start + wp.tid(),
        lanes,
        means,
        quats,
        scales,
        opacities,
        sh,
        features,
        degree,
        viewmats,
        intrinsics,
        width,
        height,
        near,
        far,
        radius_clip,
        records_out,
        radii_out,
        rects_out,
        keys_out,
        order_out,
    )
