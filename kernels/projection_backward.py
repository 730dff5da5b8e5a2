"""Gradients of `gdpro_sim.kernels.projection`: from gradients of records to those of Gaussians and cameras.

Each index is a run of groups of `LANES` Gaussians with all cameras, so that what it writes no other index
writes. Everything the forward pass computed on the way is computed again.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import HARMONICS, HARMONICS_GRADIENT
from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE
from gdpro_sim.kernels.projection import (
    CAMERA,
    CHANNELS,
    COVARIANCE,
    DEPTH,
    FACTOR,
    FACTORS,
    LOG2_OPACITY,
    OPACITY,
    PINHOLE,
    RECORD,
    ROTATION,
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

CAMERA_GRADIENTS = 17
"""Per camera: 9 of the rotation, 3 of the translation, fx, skew, cx, fy, cy."""

LN2 = 0.6931471805599453

QUATERNION_GRADIENT = """
    // Gradient gqij of the rotation matrix -> of the quaternion before normalization.
    const F gw1 = 2.0f * (qx * (gq21 - gq12) + qy * (gq02 - gq20) + qz * (gq10 - gq01));
    const F gx1 = 2.0f * (qy * (gq01 + gq10) + qz * (gq02 + gq20) + qw * (gq21 - gq12)
        - 2.0f * qx * (gq11 + gq22));
    const F gy1 = 2.0f * (qx * (gq01 + gq10) + qz * (gq12 + gq21) + qw * (gq02 - gq20)
        - 2.0f * qy * (gq00 + gq22));
    const F gz1 = 2.0f * (qx * (gq02 + gq20) + qy * (gq12 + gq21) + qw * (gq10 - gq01)
        - 2.0f * qz * (gq00 + gq11));
    const F along_q = gw1 * qw + gx1 * qx + gy1 * qy + gz1 * qz;
    const F inverse_length = unit / longest;
    const F g_qw = (gw1 - along_q * qw) * inverse_length, g_qx = (gx1 - along_q * qx) * inverse_length;
    const F g_qy = (gy1 - along_q * qy) * inverse_length, g_qz = (gz1 - along_q * qz) * inverse_length;
"""
"""Snippet: after ROTATION, gqij -> g_qw, g_qx, g_qy, g_qz."""

WRITE = """
        // The first camera writes, later ones add; what is not drawn or not finite counts nothing.
        auto kept = [&](F v) { return select(shown & finite(v), v, zero); };
        auto write = [&](float* p, int stride, F v) {
            if (camera == 0) store(p, stride, kept(v)); else add(p, stride, kept(v));
        };
        auto write3 = [&](float* p, F v0, F v1, F v2) {
            F sums[3] = {zero, zero, zero};
            if (camera > 0) load3(p, sums);
            sums[0] += kept(v0), sums[1] += kept(v1), sums[2] += kept(v2);
            store3(p, sums);
        };
        auto write4 = [&](float* p, F v0, F v1, F v2, F v3) {
            F sums[4] = {zero, zero, zero, zero};
            if (camera > 0) load4(p, sums);
            sums[0] += kept(v0), sums[1] += kept(v1), sums[2] += kept(v2), sums[3] += kept(v3);
            store4(p, sums);
        };
"""

MEAN_GRADIENT = """
        // (gx, gy, gz) at the camera-space point.
        write3((float*)(g_means_out.data + n), r00 * gx + r10 * gy + r20 * gz, r01 * gx + r11 * gy + r21 * gz,
            r02 * gx + r12 * gy + r22 * gz);
"""

CAMERA_GRADIENT = """
        if (with_cameras) {
            // Sums over this run of groups, of lanes in order, so the result does not depend on the threads.
            const F terms_[17] = {gr00 + gx * mx, gr01 + gx * my, gr02 + gx * mz, gr10 + gy * mx,
                gr11 + gy * my,
                gr12 + gy * mz, gr20 + gz * mx, gr21 + gz * my, gr22 + gz * mz, gx, gy, gz, gfx, gskew,
                    gcx, gfy, gcy};
            float* const sums = g_cameras_out.data + ((size_t)run * cameras + camera) * 17;
            for (int i = 0; i < 17; ++i) sums[i] += total(select(shown & finite(terms_[i]), terms_[i], zero));
        }
"""

RUN_BEGIN = f"""
    const int count = means.shape[0];
    const int cameras = viewmats.shape[0];
    int lanes = lanes_per_group;
{PRELUDE}
    const F zero = splat(0.0f);
    const int groups = (count + lanes_per_group - 1) / lanes_per_group;
    const int end = (run + 1) * groups_per_run < groups ? (run + 1) * groups_per_run : groups;
    for (int group = run * groups_per_run; group < end; ++group)
    for (int camera = 0; camera < cameras; ++camera) {{
        const int n = group * lanes_per_group;
        lanes = count - n < lanes_per_group ? count - n : lanes_per_group;
        const size_t first = (size_t)camera * count + n;
        const short* const rect = (const short*)(rects.data + first);
        float visible[16];
        for (int j = 0; j < lanes; ++j) visible[j] = rect[4 * j + 2] > 0 ? 1.0f : 0.0f;
        const I shown = load(visible, 1) > 0.0f;
{WRITE}
"""
"""Snippet: loop over the groups and cameras of a run; the body must close it."""

_BACKWARD = f"""
{RUN_BEGIN}
{CAMERA}{PINHOLE}{ROTATION}{COVARIANCE}{FACTORS}
        F g[{RECORD}];
        load_rows(g_records.data + first * {RECORD}, {RECORD}, g);
        for (int i = 0; i < {RECORD}; ++i) g[i] = select(shown, g[i], zero);
        const int mean_stride = g_means2d.strides[0] / (int)sizeof(float);
        const float* const g_mean = g_means2d.data + first * mean_stride;
        const F g_mean_x = select(shown, load(g_mean, mean_stride), zero);
        const F g_mean_y = select(shown, load(g_mean + 1, mean_stride), zero);
        F gx = zero, gy = zero, gz = g[{DEPTH}];
        F gr00 = zero, gr01 = zero, gr02 = zero, gr10 = zero, gr11 = zero, gr12 = zero, gr20 = zero,
            gr21 = zero,
            gr22 = zero;

        // Channels.
        if (degree >= 0) {{
{HARMONICS}
            const F g_red = select(shown & (red >= 0.0f), g[{CHANNELS}], zero);
            const F g_green = select(shown & (green >= 0.0f), g[{CHANNELS + 1}], zero);
            const F g_blue = select(shown & (blue >= 0.0f), g[{CHANNELS + 2}], zero);
            gz += g[{CHANNELS + 3}];
{HARMONICS_GRADIENT}
            const F wx = select(shown, gvx, zero), wy = select(shown, gvy, zero), wz = select(shown, gvz,
                zero);
            gx += r00 * wx + r01 * wy + r02 * wz;
            gy += r10 * wx + r11 * wy + r12 * wz;
            gz += r20 * wx + r21 * wy + r22 * wz;
            gr00 += x * wx, gr01 += x * wy, gr02 += x * wz;
            gr10 += y * wx, gr11 += y * wy, gr12 += y * wz;
            gr20 += z * wx, gr21 += z * wy, gr22 += z * wz;
        }} else {{
            const int channels = g_features_out.shape[1];
            float* const g_feature = g_features_out.data + (first % g_features_out.shape[0]) * channels;
            for (int i = 0; i < 4; ++i) {{
                if (i == channels) gz += g[{CHANNELS} + i];
                if (i >= channels) continue;
                if (camera == 0 || g_features_out.shape[0] > count) store(g_feature + i, channels,
                    g[{CHANNELS} + i]);
                else add(g_feature + i, channels, g[{CHANNELS} + i]);
            }}
        }}

        // Opacity, and the compensation of antialiasing.
        const F raw_opacity = load(opacities.data + n, 1);
        F opacity = raw_opacity;
        if (antialiased) opacity = raw_opacity * sqrt_(det / blurred_det);
        const F g_log2 = g[{LOG2_OPACITY}] + g[{OPACITY}] * opacity * {LN2!r}f;
        write(g_opacities_out.data + n, 1, g_log2 / (raw_opacity * {LN2!r}f));

        // Cholesky factors -> blurred covariance.
        const F ratio = xy / blurred_yy;
        const F half = (g[{FACTOR}] - g[{FACTOR + 1}] * ratio) * a * 0.5f / blurred_det;
        F g_xx = -half * blurred_yy;
        F g_xy = 2.0f * half * xy - g[{FACTOR + 1}] * a / blurred_yy;
        F g_yy = (g[{FACTOR + 1}] * a * ratio - 0.5f * g[{FACTOR + 2}] * d) / blurred_yy - half * xy * ratio;
        if (antialiased) {{
            const F g_half = g_log2 * {0.5 / LN2!r}f;
            const F by_det = g_half / det, by_blurred = g_half / blurred_det;
            g_xx += yy * by_det - blurred_yy * by_blurred;
            g_yy += xx * by_det - blurred_xx * by_blurred;
            g_xy -= 2.0f * xy * (by_det - by_blurred);
        }}

        // -> rows of M -> scales, axes and Jacobian.
        const F gmx0 = 2.0f * g_xx * mx0 + g_xy * my0, gmx1 = 2.0f * g_xx * mx1 + g_xy * my1,
            gmx2 = 2.0f * g_xx * mx2 + g_xy * my2;
        const F gmy0 = 2.0f * g_yy * my0 + g_xy * mx0, gmy1 = 2.0f * g_yy * my1 + g_xy * mx1,
            gmy2 = 2.0f * g_yy * my2 + g_xy * mx2;
        write3((float*)(g_scales_out.data + n), gmx0 * ax0 + gmy0 * ay0, gmx1 * ax1 + gmy1 * ay1,
            gmx2 * ax2 + gmy2 * ay2);
        const F hx0 = gmx0 * s0, hx1 = gmx1 * s1, hx2 = gmx2 * s2, hy0 = gmy0 * s0, hy1 = gmy1 * s1,
            hy2 = gmy2 * s2;
        const F gq00 = wx0 * hx0 + wy0 * hy0, gq01 = wx0 * hx1 + wy0 * hy1, gq02 = wx0 * hx2 + wy0 * hy2;
        const F gq10 = wx1 * hx0 + wy1 * hy0, gq11 = wx1 * hx1 + wy1 * hy1, gq12 = wx1 * hx2 + wy1 * hy2;
        const F gq20 = wx2 * hx0 + wy2 * hy0, gq21 = wx2 * hx1 + wy2 * hy1, gq22 = wx2 * hx2 + wy2 * hy2;
        const F gwx0 = q00 * hx0 + q01 * hx1 + q02 * hx2, gwx1 = q10 * hx0 + q11 * hx1 + q12 * hx2,
            gwx2 = q20 * hx0 + q21 * hx1 + q22 * hx2;
        const F gwy0 = q00 * hy0 + q01 * hy1 + q02 * hy2, gwy1 = q10 * hy0 + q11 * hy1 + q12 * hy2,
            gwy2 = q20 * hy0 + q21 * hy1 + q22 * hy2;
        const F gjx0 = r00 * gwx0 + r01 * gwx1 + r02 * gwx2, gjx1 = r10 * gwx0 + r11 * gwx1 + r12 * gwx2,
            gjx2 = r20 * gwx0 + r21 * gwx1 + r22 * gwx2;
        const F gjy1 = r10 * gwy0 + r11 * gwy1 + r12 * gwy2, gjy2 = r20 * gwy0 + r21 * gwy1 + r22 * gwy2;
        gr00 += jx0 * gwx0, gr01 += jx0 * gwx1, gr02 += jx0 * gwx2;
        gr10 += jx1 * gwx0 + jy1 * gwy0, gr11 += jx1 * gwx1 + jy1 * gwy1, gr12 += jx1 * gwx2 + jy1 * gwy2;
        gr20 += jx2 * gwx0 + jy2 * gwy0, gr21 += jx2 * gwx1 + jy2 * gwy1, gr22 += jx2 * gwx2 + jy2 * gwy2;
{QUATERNION_GRADIENT}
        write4((float*)(g_quats_out.data + n), g_qw, g_qx, g_qy, g_qz);

        // Jacobian and mean -> camera-space point and intrinsics.
        const F gpx = -gjx2 * inverse_z, gpy = -gjy2 * inverse_z;
        const I inside_x = (offset_x >= low_x) & (offset_x <= high_x);
        const I inside_y = (offset_y >= low_y) & (offset_y <= high_y);
        const F gox = g_mean_x + select(inside_x, gpx, zero), goy = g_mean_y + select(inside_y, gpy, zero);
        const F gcx = g_mean_x - select(inside_x, zero, gpx), gcy = g_mean_y - select(inside_y, zero, gpy);
        const F gfx = (gjx0 + gox * x) * inverse_z, gskew = (gjx1 + gox * y) * inverse_z;
        const F gfy = (gjy1 + goy * y) * inverse_z;
        gx += gox * fx * inverse_z;
        gy += (gox * skew + goy * fy) * inverse_z;
        gz -= (gox * offset_x + goy * offset_y + gjx0 * jx0 + gjx1 * jx1 + gjx2 * jx2 + gjy1 * jy1
            + gjy2 * jy2)
            * inverse_z;
{MEAN_GRADIENT}{CAMERA_GRADIENT}
    }}
"""


@wp.func_native(_BACKWARD)
def backward_run(
    run: int,
    groups_per_run: int,
    lanes_per_group: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    eps2d: float,
    antialiased: bool,
    with_cameras: bool,
    rects: wp.array[vec4s],
    g_records: wp.array2d[float],
    g_means2d: wp.array2d[float],
    g_means_out: wp.array[wp.vec3],
    g_quats_out: wp.array[wp.vec4],
    g_scales_out: wp.array[wp.vec3],
    g_opacities_out: wp.array[float],
    g_sh_out: wp.array2d[wp.vec3],
    g_features_out: wp.array2d[float],
    g_cameras_out: wp.array3d[float],
): ...


@wp.kernel
def project_backward(
    start: int,
    # In:
    groups_per_run: int,
    lanes: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    width: int,
    height: int,
    eps2d: float,
    antialiased: bool,
    with_cameras: bool,
    rects: wp.array[vec4s],
    g_records: wp.array2d[float],
    g_means2d: wp.array2d[float],
    # Out:
    g_means_out: wp.array[wp.vec3],
    g_quats_out: wp.array[wp.vec4],
    g_scales_out: wp.array[wp.vec3],
    g_opacities_out: wp.array[float],
    g_sh_out: wp.array2d[wp.vec3],
    g_features_out: wp.array2d[float],
    g_cameras_out: wp.array3d[float],
):
    """Gradients of everything `gdpro_sim.kernels.projection.project` reads.

    `g_sh_out` where degree >= 0 (its first (degree + 1)^2 coefficients), else `g_features_out` (its first
    four columns). `g_cameras_out` [runs, C, 17], where `with_cameras`, starts at zero and is to be summed.
    """
    backward_run(
        start + wp.tid(),
        groups_per_run,
        lanes,
        means,
        quats,
        scales,
        opacities,
        sh,
        degree,
        viewmats,
        intrinsics,
        width,
        height,
        eps2d,
        antialiased,
        with_cameras,
        rects,
        g_records,
        g_means2d,
        g_means_out,
        g_quats_out,
        g_scales_out,
        g_opacities_out,
        g_sh_out,
        g_features_out,
        g_cameras_out,
    )
