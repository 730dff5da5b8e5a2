"""Projection of 3D Gaussians to 2D ones, forward.

Every Gaussian seen by a camera becomes one record of 16 float32 (a 64-byte cache line):

    MEAN          2  mean in pixels
    FACTOR        3  a, b, d: with u = a dx + b dy and v = d dy, G(dx, dy) = exp2(-(u^2 + v^2)). This is the
                     Cholesky factor of the inverse 2D covariance, so the exponent is a sum of squares
    OPACITY       1  opacity, times the compensation factor where antialiased
    LOG2_OPACITY  1  its base-2 logarithm
    DEPTH         1  camera-space z in metres
    CHANNELS      4  the first four channels to blend
    BOX           2  half extents in pixels of the box outside which alpha < 1/255
    REACH         1  square of: distance in (u, v) at which alpha = 1/255, plus half a 4 x 4 block's diagonal
    COMPENSATION  1  sqrt(det covariance / det blurred covariance) where antialiased, else 1

Culled Gaussians have a record of zeros, an empty rectangle and an infinite sort key. The index of each kernel
is a group of `LANES` Gaussians of one camera (see `gdpro_sim.kernels.lanes`), camera after camera.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import HARMONICS
from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": CPU_FLAGS,
    }
)

vec4s = wp.types.vector(length=4, dtype=wp.int16)

RECORD = wp.constant(16)
MEAN = wp.constant(0)
FACTOR = wp.constant(2)
OPACITY = wp.constant(5)
LOG2_OPACITY = wp.constant(6)
DEPTH = wp.constant(7)
CHANNELS = wp.constant(8)
BOX = wp.constant(12)
REACH = wp.constant(14)
COMPENSATION = wp.constant(15)

TILE = wp.constant(16)
"""Width and height of a tile in pixels."""

LOG2_CUTOFF = wp.constant(-7.994353436858858)
"""log2(1/255): a Gaussian whose alpha is below is skipped."""

HALF_LOG2_E = wp.constant(0.7213475204444817)
"""exp(-q / 2) = exp2(-HALF_LOG2_E q)."""

SQRT_HALF_LOG2_E = wp.constant(0.8493218002880191)

SLACK = wp.constant(1.0001)
"""Boxes grow by this factor so that rounding cannot push a pixel at the cutoff outside."""

ROTATION = """
    // Rotation matrix q of quaternions wxyz of any length but (nearly) zero: NaN there.
    const float* const quat = (const float*)(quats.data + n);
    F wxyz[4];
    load4(quat, wxyz);
    const F qw0 = wxyz[0], qx0 = wxyz[1], qy0 = wxyz[2], qz0 = wxyz[3];
    const F largest_q = max_(max_(abs_(qw0), abs_(qx0)), max_(abs_(qy0), abs_(qz0)));
    const F longest = select(largest_q > 1e-30f, largest_q, splat(0.0f));
    const F qw1 = qw0 / longest, qx1 = qx0 / longest, qy1 = qy0 / longest, qz1 = qz0 / longest;
    const F unit = 1.0f / sqrt_(qw1 * qw1 + qx1 * qx1 + qy1 * qy1 + qz1 * qz1);
    const F qw = qw1 * unit, qx = qx1 * unit, qy = qy1 * unit, qz = qz1 * unit;
    const F q00 = 1.0f - 2.0f * (qy * qy + qz * qz), q01 = 2.0f * (qx * qy - qw * qz),
        q02 = 2.0f * (qx * qz + qw * qy), q10 = 2.0f * (qx * qy + qw * qz),
        q11 = 1.0f - 2.0f * (qx * qx + qz * qz), q12 = 2.0f * (qy * qz - qw * qx),
        q20 = 2.0f * (qx * qz - qw * qy), q21 = 2.0f * (qy * qz + qw * qx),
        q22 = 1.0f - 2.0f * (qx * qx + qy * qy);
"""
"""Snippet: `quats`, first Gaussian `n` -> qij, and what the gradient needs: qw..qz, longest, unit."""

CAMERA = """
    // Camera-space point (x, y, z) = R mean + t.
    const float* const view = (const float*)(viewmats.data + camera);
    const float r00 = view[0], r01 = view[1], r02 = view[2], r10 = view[4], r11 = view[5], r12 = view[6],
        r20 = view[8], r21 = view[9], r22 = view[10];
    const float* const mean = (const float*)(means.data + n);
    F position[3];
    load3(mean, position);
    const F mx = position[0], my = position[1], mz = position[2];
    const F x = r00 * mx + r01 * my + r02 * mz + view[3];
    const F y = r10 * mx + r11 * my + r12 * mz + view[7];
    const F z = r20 * mx + r21 * my + r22 * mz + view[11];
"""
"""Snippet: `viewmats`, `means` -> x, y, z and the rotation rij."""

PINHOLE = """
    const float* const k = (const float*)(intrinsics.data + camera);
    const float fx = k[0], skew = k[1], cx = k[2], fy = k[4], cy = k[5];
    const F inverse_z = 1.0f / z;
    const F offset_x = (fx * x + skew * y) * inverse_z;
    const F offset_y = fy * y * inverse_z;
"""
"""Snippet: pixel offsets from the principal point."""

COVARIANCE = """
    // Perspective is linearized at the mean, pulled to at most 0.15 image sizes outside the image: farther
    // out the linearization would blow Gaussians up (as in the code of 3D Gaussian Splatting).
    const float low_x = -cx - 0.15f * (float)width, high_x = (float)width - cx + 0.15f * (float)width;
    const float low_y = -cy - 0.15f * (float)height, high_y = (float)height - cy + 0.15f * (float)height;
    const F pulled_x = min_(max_(offset_x, splat(low_x)), splat(high_x));
    const F pulled_y = min_(max_(offset_y, splat(low_y)), splat(high_y));

    // Rows of the projection's Jacobian in camera space, then in world space.
    const F jx0 = fx * inverse_z, jx1 = skew * inverse_z, jx2 = -pulled_x * inverse_z;
    const F jy1 = fy * inverse_z, jy2 = -pulled_y * inverse_z;
    const F wx0 = r00 * jx0 + r10 * jx1 + r20 * jx2, wx1 = r01 * jx0 + r11 * jx1 + r21 * jx2,
        wx2 = r02 * jx0 + r12 * jx1 + r22 * jx2;
    const F wy0 = r10 * jy1 + r20 * jy2, wy1 = r11 * jy1 + r21 * jy2, wy2 = r12 * jy1 + r22 * jy2;

    // Along the Gaussian's axes, then times its scales: the 2D covariance is M M^T with rows m_x, m_y.
    const float* const scale = (const float*)(scales.data + n);
    F deviations[3];
    load3(scale, deviations);
    const F s0 = deviations[0], s1 = deviations[1], s2 = deviations[2];
    const F ax0 = q00 * wx0 + q10 * wx1 + q20 * wx2, ax1 = q01 * wx0 + q11 * wx1 + q21 * wx2,
        ax2 = q02 * wx0 + q12 * wx1 + q22 * wx2;
    const F ay0 = q00 * wy0 + q10 * wy1 + q20 * wy2, ay1 = q01 * wy0 + q11 * wy1 + q21 * wy2,
        ay2 = q02 * wy0 + q12 * wy1 + q22 * wy2;
    const F mx0 = s0 * ax0, mx1 = s1 * ax1, mx2 = s2 * ax2, my0 = s0 * ay0, my1 = s1 * ay1, my2 = s2 * ay2;
    const F xx = mx0 * mx0 + mx1 * mx1 + mx2 * mx2, yy = my0 * my0 + my1 * my1 + my2 * my2;
    const F xy = mx0 * my0 + mx1 * my1 + mx2 * my2;
    // Lagrange's identity: |m_x|^2 |m_y|^2 - (m_x . m_y)^2 without its cancellation.
    const F n0 = mx1 * my2 - mx2 * my1, n1 = mx2 * my0 - mx0 * my2, n2 = mx0 * my1 - mx1 * my0;
    const F det = n0 * n0 + n1 * n1 + n2 * n2;
    const F blurred_xx = xx + eps2d, blurred_yy = yy + eps2d;
    const F blurred_det = det + eps2d * (xx + yy) + eps2d * eps2d;
"""
"""Snippet: EWA splatting (Zwicker et al. 2001, eq. 26-31)."""

FACTORS = f"""
    const F deviation_x = sqrt_(blurred_xx), deviation_y = sqrt_(blurred_yy);
    const F d = {SQRT_HALF_LOG2_E!r}f / deviation_y;
    const F a = deviation_y * {SQRT_HALF_LOG2_E!r}f / sqrt_(blurred_det);
    const F b = -a * xy / blurred_yy;
"""
"""Snippet: the Cholesky factor of the inverse blurred covariance, times sqrt(log2(e) / 2)."""

PIXEL_BOX = """
    // Pixels whose centre lies in the box, then the tiles they lie in (end exclusive).
    const F x0 = max_(ceil_(mean_x - box_x - 0.5f), splat(0.0f));
    const F y0 = max_(ceil_(mean_y - box_y - 0.5f), splat(0.0f));
    const F x1 = min_(floor_(mean_x + box_x - 0.5f), splat((float)(width - 1)));
    const F y1 = min_(floor_(mean_y + box_y - 0.5f), splat((float)(height - 1)));
"""
"""Snippet: box of half extents box_x, box_y around mean_x, mean_y -> first and last pixels x0, y0, x1, y1."""

BIN = f"""
    const F largest = splat(1.0e9f);
    const I radius_x = to_int(select(drawn, min_(ceil_(box_x), largest), zero));
    const I radius_y = to_int(select(drawn, min_(ceil_(box_y), largest), zero));
    const F tile = splat({1 / TILE!r}f);
    const I begin_x = to_int(select(drawn, x0 * tile, zero)), begin_y = to_int(select(drawn, y0 * tile,
        zero));
    const I end_x = to_int(select(drawn, x1 * tile + 1.0f, zero));
    const I end_y = to_int(select(drawn, y1 * tile + 1.0f, zero));
    const F key = select(drawn, z, splat(1.0f / 0.0f));
    store(keys_out.data + (size_t)camera * keys_out.shape[1] + n, 1, key);
    int* const radius = (int*)(radii_out.data + first);
    short* const rect = (short*)(rects_out.data + first);
    int* const order = order_out.data + (size_t)camera * order_out.shape[1] + n;
    // By way of memory: a lane whose number is not a constant is slow to take from a vector.
    const I numbers[6] = {{radius_x, radius_y, begin_x, begin_y, end_x, end_y}};
    int number[6][16];
    for (int i = 0; i < 6; ++i) memcpy(number[i], &numbers[i], sizeof(I));
    for (int j = 0; j < lanes; ++j) {{
        radius[2 * j] = number[0][j];
        radius[2 * j + 1] = number[1][j];
        for (int i = 0; i < 4; ++i) rect[4 * j + i] = (short)number[2 + i][j];
        order[j] = (int)first + j;
    }}
"""
"""Snippet: `drawn`, z, the box and its pixels -> radii, tiles touched, sort key and number."""

_PROJECT = f"""
    const int groups = (means.shape[0] + lanes_per_group - 1) / lanes_per_group;
    const int camera = group / groups;
    const int n = (group - camera * groups) * lanes_per_group;
    const int left = means.shape[0] - n;
    const int lanes = left < lanes_per_group ? left : lanes_per_group;
    const size_t first = (size_t)camera * means.shape[0] + n;
{PRELUDE}{CAMERA}{PINHOLE}{ROTATION}{COVARIANCE}{FACTORS}
    const F mean_x = offset_x + cx, mean_y = offset_y + cy;
    F compensation = splat(1.0f);
    if (antialiased) compensation = sqrt_(det / blurred_det);
    const F opacity = load(opacities.data + n, 1) * compensation;
    const F log2_opacity = log2_(max_(opacity, splat(1.2e-38f)));
    const F extent2 = log2_opacity - {LOG2_CUTOFF!r}f;
    const F extent = sqrt_(max_(extent2, splat(0.0f)));
    const F box_x = extent * deviation_x * {SLACK / SQRT_HALF_LOG2_E!r}f;
    const F box_y = extent * deviation_y * {SLACK / SQRT_HALF_LOG2_E!r}f;

{PIXEL_BOX}    // A sum of magnitudes is finite only where all its terms are.
    const F size = abs_(mean_x) + abs_(mean_y) + a + abs_(b) + d + box_x + box_y + opacity + blurred_det;
    I drawn = (z >= near) & (z <= far) & (z > 0.0f) & (extent2 >= 0.0f) & (opacity > 0.0f) & finite(size)
        & (x0 <= x1) & (y0 <= y1) & ((box_x > radius_clip) | (box_y > radius_clip));

    const F zero = splat(0.0f);
    F fields[16];
    if (any(drawn)) {{
        if (degree >= 0) {{
{HARMONICS}
            drawn = drawn & finite(red) & finite(green) & finite(blue);
            fields[{CHANNELS}] = max_(red, zero);
            fields[{CHANNELS + 1}] = max_(green, zero);
            fields[{CHANNELS + 2}] = max_(blue, zero);
            fields[{CHANNELS + 3}] = z;
        }} else {{
            const int width_ = features.shape[1];
            const float* const feature = features.data + (first % features.shape[0]) * width_;
            for (int i = 0; i < 4; ++i) fields[{CHANNELS} + i] = i == width_ ? z : zero;
            for (int i = 0; i < width_; ++i) {{
                const F value = load(feature + i, width_);
                drawn = drawn & finite(value);
                if (i < 4) fields[{CHANNELS} + i] = value;
            }}
        }}
    }}
    const F reach_a = a + abs_(b);
    const F reach = (extent + 1.5f * sqrt_(reach_a * reach_a + d * d)) * {float(SLACK)!r}f;
    fields[{MEAN}] = mean_x;
    fields[{MEAN + 1}] = mean_y;
    fields[{FACTOR}] = a;
    fields[{FACTOR + 1}] = b;
    fields[{FACTOR + 2}] = d;
    fields[{OPACITY}] = opacity;
    fields[{LOG2_OPACITY}] = log2_opacity;
    fields[{DEPTH}] = z;
    fields[{BOX}] = box_x;
    fields[{BOX + 1}] = box_y;
    fields[{REACH}] = reach * reach;
    fields[{COMPENSATION}] = compensation;
    float* const record = records_out.data + first * 16;
    for (int i = 0; i < 16; ++i) fields[i] = select(drawn, fields[i], zero);
    float* const mean2d = (float*)(means2d_out.data + first);
    store(mean2d, 2, fields[{MEAN}]);
    store(mean2d + 1, 2, fields[{MEAN + 1}]);
    store_rows(record, 16, fields);
{BIN}"""


@wp.func_native(_PROJECT)
def project_group(
    group: int,
    lanes_per_group: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
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
    eps2d: float,
    antialiased: bool,
    records_out: wp.array2d[float],
    means2d_out: wp.array[wp.vec2],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[vec4s],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
): ...


@wp.kernel
def project(
    start: int,
    # In:
    lanes: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
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
    eps2d: float,
    antialiased: bool,
    # Out:
    records_out: wp.array2d[float],
    means2d_out: wp.array[wp.vec2],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[vec4s],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
):
    """One record for each camera and Gaussian; culls what is not seen, not finite or fainter than 1/255.

    Channels are max(0, SH(direction from the camera) + 0.5) and depth where degree >= 0; else the first four
    of features and depth, row i % rows. `lanes` is 16 on a CPU and 1 on a GPU.
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
        eps2d,
        antialiased,
        records_out,
        means2d_out,
        radii_out,
        rects_out,
        keys_out,
        order_out,
    )
