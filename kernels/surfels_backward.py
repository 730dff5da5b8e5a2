"""Gradients of `gdpro_sim.kernels.surfels`: from gradients of records to those of surfels and cameras.

Gradients of records are laid out like records: MEAN, CENTER (that of the mean holds its own and the centre's
share: what moving the surfel's whole picture changes), U, V, SLOPE, LOG2_OPACITY, CHANNELS, DEPTH and NORMAL.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import HARMONICS, HARMONICS_GRADIENT
from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE
from gdpro_sim.kernels.projection import CAMERA, PINHOLE, ROTATION, vec4s
from gdpro_sim.kernels.projection_backward import (
    CAMERA_GRADIENT,
    LN2,
    MEAN_GRADIENT,
    QUATERNION_GRADIENT,
    RUN_BEGIN,
)
from gdpro_sim.kernels.surfels import (
    CENTER,
    CHANNELS,
    DEPTH,
    LOG2_OPACITY,
    NORMAL,
    RECORD,
    SLOPE,
    STEEPEST,
    SURFEL,
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

assert PRELUDE in RUN_BEGIN

_BACKWARD = f"""
{RUN_BEGIN}
{CAMERA}{PINHOLE}{ROTATION}{SURFEL}
        F g[{RECORD}];
        load_rows(g_records.data + first * {RECORD} + {RECORD - 16}, {RECORD}, g + {RECORD - 16});
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
{HARMONICS_GRADIENT}
            const F wx = select(shown, gvx, zero), wy = select(shown, gvy, zero),
                wz = select(shown, gvz, zero);
            gx += r00 * wx + r01 * wy + r02 * wz;
            gy += r10 * wx + r11 * wy + r12 * wz;
            gz += r20 * wx + r21 * wy + r22 * wz;
            gr00 += x * wx, gr01 += x * wy, gr02 += x * wz;
            gr10 += y * wx, gr11 += y * wy, gr12 += y * wz;
            gr20 += z * wx, gr21 += z * wy, gr22 += z * wz;
        }} else {{
            const int channels = g_features_out.shape[1];
            float* const g_feature = g_features_out.data + (first % g_features_out.shape[0]) * channels;
            for (int i = 0; i < 3 && i < channels; ++i) {{
                if (camera == 0 || g_features_out.shape[0] > count) store(g_feature + i, channels,
                    g[{CHANNELS} + i]);
                else add(g_feature + i, channels, g[{CHANNELS} + i]);
            }}
        }}
        write(g_opacities_out.data + n, 1, g[{LOG2_OPACITY}] / (load(opacities.data + n, 1) * {LN2!r}f));

        // U, V and SLOPE -> images of the tangents, z and scales.
        // What is limited does not depend on what it was before.
        const F g_pu = select(abs_(pu) < {STEEPEST!r}f, g[{U}] * iby - g[{U + 1}] * ibx, zero);
        const F g_pv = select(abs_(pv) < {STEEPEST!r}f, g[{V + 1}] * iax - g[{V}] * iay, zero);
        const F wax = g[{SLOPE}] * inverse_area, way = g[{SLOPE + 1}] * inverse_area;
        F g_iay = wax * bz - g[{V}] * pv, g_iax = g[{V + 1}] * pv - way * bz;
        F g_iby = g[{U}] * pu - wax * az, g_ibx = way * az - g[{U + 1}] * pu;
        F g_az = way * ibx - wax * iby, g_bz = wax * iay - way * iax;
        const F both = g_pu * pu + g_pv * pv;
        const F g_covered = select(
            grazing, zero, -(both + g[{SLOPE}] * w_x + g[{SLOPE + 1}] * w_y) * inverse_area);
        g_iax += g_covered * iby, g_iby += g_covered * iax, g_iay -= g_covered * ibx,
            g_ibx -= g_covered * iay;
        gz += both / z;
        F g_s0 = -g_pu * pu / s0, g_s1 = -g_pv * pv / s1;

        // What moves the mean moves the centre with it; the rest moves it alone.
        const F g_shift_x = g_mean_x - g[{CENTER}], g_shift_y = g_mean_y - g[{CENTER + 1}];
        const F hx = select(whole, -g_shift_x / ahead, zero), hy = select(whole, -g_shift_y / ahead, zero);
        const F g_ahead = hx * shift_x + hy * shift_y;
        const F ha = hx * iax + hy * iay - g_ahead * az, hb = hx * ibx + hy * iby - g_ahead * bz;
        g_iax += hx * sa, g_iay += hy * sa, g_ibx += hx * sb, g_iby += hy * sb;
        g_az += s0 * s0 * (ha - g_ahead * az), g_bz += s1 * s1 * (hb - g_ahead * bz);
        g_s0 += 2.0f * s0 * az * ha, g_s1 += 2.0f * s1 * bz * hb;
        gz += 2.0f * z * g_ahead;
        float* const g_scale = g_scales_out.data + (size_t)n * scale_stride;
        if (scale_stride == 3) {{
            write3(g_scale, g_s0, g_s1, zero);
        }} else {{
            write(g_scale, scale_stride, g_s0);
            write(g_scale + 1, scale_stride, g_s1);
        }}

        // -> tangents, offset and intrinsics.
        const F gax = fx * g_iax, gay = skew * g_iax + fy * g_iay,
            gaz = g_az - offset_x * g_iax - offset_y * g_iay;
        const F gbx = fx * g_ibx, gby = skew * g_ibx + fy * g_iby,
            gbz = g_bz - offset_x * g_ibx - offset_y * g_iby;
        const F gox = g_mean_x - az * g_iax - bz * g_ibx, goy = g_mean_y - az * g_iay - bz * g_iby;
        const F gcx = g_mean_x, gcy = g_mean_y;
        const F gfx = ax * g_iax + bx * g_ibx + gox * x * inverse_z;
        const F gskew = ay * g_iax + by * g_ibx + gox * y * inverse_z;
        const F gfy = ay * g_iay + by * g_iby + goy * y * inverse_z;
        gx += gox * fx * inverse_z;
        gy += (gox * skew + goy * fy) * inverse_z;
        gz -= (gox * offset_x + goy * offset_y) * inverse_z;

        // Tangents and normal -> rotation.
        gr00 += gax * q00 + gbx * q01, gr01 += gax * q10 + gbx * q11, gr02 += gax * q20 + gbx * q21;
        gr10 += gay * q00 + gby * q01, gr11 += gay * q10 + gby * q11, gr12 += gay * q20 + gby * q21;
        gr20 += gaz * q00 + gbz * q01, gr21 += gaz * q10 + gbz * q11, gr22 += gaz * q20 + gbz * q21;
        const F gq00 = r00 * gax + r10 * gay + r20 * gaz, gq10 = r01 * gax + r11 * gay + r21 * gaz,
            gq20 = r02 * gax + r12 * gay + r22 * gaz;
        const F gq01 = r00 * gbx + r10 * gby + r20 * gbz, gq11 = r01 * gbx + r11 * gby + r21 * gbz,
            gq21 = r02 * gbx + r12 * gby + r22 * gbz;
        const F gq02 = side * g[{NORMAL}], gq12 = side * g[{NORMAL + 1}], gq22 = side * g[{NORMAL + 2}];
{QUATERNION_GRADIENT}
        write4((float*)(g_quats_out.data + n), g_qw, g_qx, g_qy, g_qz);
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
    scales: wp.array2d[float],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    with_cameras: bool,
    rects: wp.array[vec4s],
    g_records: wp.array2d[float],
    g_means2d: wp.array2d[float],
    g_means_out: wp.array[wp.vec3],
    g_quats_out: wp.array[wp.vec4],
    g_scales_out: wp.array2d[float],
    g_opacities_out: wp.array[float],
    g_sh_out: wp.array2d[wp.vec3],
    g_features_out: wp.array2d[float],
    g_cameras_out: wp.array3d[float],
): ...


@wp.kernel
def project_surfels_backward(
    start: int,
    # In:
    groups_per_run: int,
    lanes: int,
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array2d[float],
    opacities: wp.array[float],
    sh: wp.array2d[wp.vec3],
    degree: int,
    viewmats: wp.array[wp.mat44],
    intrinsics: wp.array[wp.mat33],
    with_cameras: bool,
    rects: wp.array[vec4s],
    g_records: wp.array2d[float],
    g_means2d: wp.array2d[float],
    # Out:
    g_means_out: wp.array[wp.vec3],
    g_quats_out: wp.array[wp.vec4],
    g_scales_out: wp.array2d[float],
    g_opacities_out: wp.array[float],
    g_sh_out: wp.array2d[wp.vec3],
    g_features_out: wp.array2d[float],
    g_cameras_out: wp.array3d[float],
):
    """Gradients of everything `gdpro_sim.kernels.surfels.project_surfels` reads.

    `g_sh_out` where degree >= 0 (its first (degree + 1)^2 coefficients), else `g_features_out` (its first
    three columns). `g_cameras_out` [runs, C, 17], where `with_cameras`, starts at zero and is to be summed.
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
