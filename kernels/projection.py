"""Projection of 3D Gaussians to 2D ones, and their colours.

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
    COMPENSATION  1  sqrt(det covariance / det blurred covariance)

Culled Gaussians have a record of zeros, an empty rectangle and an infinite sort key.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import harmonics_sum

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native",
    }
)

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

SLACK = wp.constant(1.0001)
"""Boxes grow by this factor so that rounding cannot push a pixel at the cutoff outside."""


@wp.func
def rotation_of(quat: wp.vec4) -> wp.mat33:
    """Rotation matrix of a quaternion wxyz of any nonzero length; NaN for zero."""
    q = quat / wp.max(wp.abs(quat))
    q = q / wp.length(q)
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def view_rotation(viewmat: wp.mat44) -> wp.mat33:
    return wp.mat33(
        viewmat[0, 0], viewmat[0, 1], viewmat[0, 2],
        viewmat[1, 0], viewmat[1, 1], viewmat[1, 2],
        viewmat[2, 0], viewmat[2, 1], viewmat[2, 2],
    )  # fmt: skip


@wp.func
def camera_point(viewmat: wp.mat44, mean: wp.vec3) -> wp.vec3:
    return view_rotation(viewmat) * mean + wp.vec3(viewmat[0, 3], viewmat[1, 3], viewmat[2, 3])


@wp.func
def linearization_point(p: wp.vec3, k: wp.mat33, width: float, height: float) -> wp.vec3:
    """The point at which perspective is linearized: p, pulled to at most 0.15 image widths past the border.

    Farther out the linearization would blow a Gaussian up (as in the 3D Gaussian Splatting code).
    """
    margin_x = 0.15 * width / k[0, 0]
    margin_y = 0.15 * height / k[1, 1]
    x = wp.clamp(p[0] / p[2], -k[0, 2] / k[0, 0] - margin_x, (width - k[0, 2]) / k[0, 0] + margin_x)
    y = wp.clamp(p[1] / p[2], -k[1, 2] / k[1, 1] - margin_y, (height - k[1, 2]) / k[1, 1] + margin_y)
    return wp.vec3(x * p[2], y * p[2], p[2])


@wp.kernel
def project(
    start: int,
    # In:
    means: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    opacities: wp.array[float],
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
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[wp.vec4i],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
):
    """EWA splatting (Zwicker et al. 2001, eq. 26-31) of Gaussian i % N by camera i / N."""
    i = start + wp.tid()
    camera = i / means.shape[0]
    n = i - camera * means.shape[0]
    viewmat = viewmats[camera]
    k = intrinsics[camera]

    for j in range(RECORD):
        records_out[i, j] = 0.0
    radii_out[i] = wp.vec2i(0, 0)
    rects_out[i] = wp.vec4i(0, 0, 0, 0)
    keys_out[camera, n] = wp.inf
    order_out[camera, n] = i

    p = camera_point(viewmat, means[n])
    z = p[2]
    if not (z >= near and z <= far and z > 0.0):
        return
    mean_x = (k[0, 0] * p[0] + k[0, 1] * p[1]) / z + k[0, 2]
    mean_y = k[1, 1] * p[1] / z + k[1, 2]

    # 2D covariance M M^T of the rows m_x, m_y of M = J R_view R S.
    q = linearization_point(p, k, float(width), float(height))
    row_x = wp.vec3(k[0, 0] / z, k[0, 1] / z, -(k[0, 0] * q[0] + k[0, 1] * q[1]) / (z * z))
    row_y = wp.vec3(0.0, k[1, 1] / z, -k[1, 1] * q[1] / (z * z))
    axes = wp.transpose(view_rotation(viewmat) * rotation_of(quats[n]))
    m_x = wp.cw_mul(axes * row_x, scales[n])
    m_y = wp.cw_mul(axes * row_y, scales[n])
    xx = wp.dot(m_x, m_x)
    yy = wp.dot(m_y, m_y)
    xy = wp.dot(m_x, m_y)
    # Lagrange's identity: |m_x|^2 |m_y|^2 - (m_x . m_y)^2 without its cancellation.
    normal = wp.cross(m_x, m_y)
    det = wp.dot(normal, normal)
    det_blurred = det + eps2d * (xx + yy) + eps2d * eps2d
    xx += eps2d
    yy += eps2d

    compensation = wp.sqrt(det / det_blurred)
    opacity = opacities[n]
    if antialiased:
        opacity *= compensation
    log2_opacity = wp.log2(opacity)
    reach = log2_opacity - LOG2_CUTOFF
    if not (reach >= 0.0):
        return

    a = wp.sqrt(HALF_LOG2_E * yy / det_blurred)
    b = -a * xy / yy
    d = wp.sqrt(HALF_LOG2_E / yy)
    box_x = wp.sqrt(reach * xx / HALF_LOG2_E) * SLACK
    box_y = wp.sqrt(reach * yy / HALF_LOG2_E) * SLACK
    # A sum of magnitudes is finite only where all its terms are.
    if not (wp.isfinite(wp.abs(mean_x) + wp.abs(mean_y) + a + wp.abs(b) + d + box_x + box_y + reach + det_blurred)):
        return
    if box_x <= radius_clip and box_y <= radius_clip:
        return

    # Pixels whose centre lies in the box, then the tiles they lie in (end exclusive).
    x0 = wp.max(wp.ceil(mean_x - box_x - 0.5), 0.0)
    y0 = wp.max(wp.ceil(mean_y - box_y - 0.5), 0.0)
    x1 = wp.min(wp.floor(mean_x + box_x - 0.5), float(width - 1))
    y1 = wp.min(wp.floor(mean_y + box_y - 0.5), float(height - 1))
    if x0 > x1 or y0 > y1:
        return

    block = 1.5 * wp.sqrt((a + wp.abs(b)) * (a + wp.abs(b)) + d * d)
    distance = (wp.sqrt(reach) + block) * SLACK
    records_out[i, MEAN] = mean_x
    records_out[i, MEAN + 1] = mean_y
    records_out[i, FACTOR] = a
    records_out[i, FACTOR + 1] = b
    records_out[i, FACTOR + 2] = d
    records_out[i, OPACITY] = opacity
    records_out[i, LOG2_OPACITY] = log2_opacity
    records_out[i, DEPTH] = z
    records_out[i, BOX] = box_x
    records_out[i, BOX + 1] = box_y
    records_out[i, REACH] = distance * distance
    records_out[i, COMPENSATION] = compensation
    radii_out[i] = wp.vec2i(int(wp.min(wp.ceil(box_x), 1.0e9)), int(wp.min(wp.ceil(box_y), 1.0e9)))
    rects_out[i] = wp.vec4i(
        int(x0) / TILE,
        int(y0) / TILE,
        int(x1) / TILE + 1,
        int(y1) / TILE + 1,
    )
    keys_out[camera, n] = z


@wp.func
def visible(rect: wp.vec4i) -> bool:
    return rect[2] > 0


@wp.func
def cull(i: int, records_out: wp.array2d[float], radii_out: wp.array[wp.vec2i], rects_out: wp.array[wp.vec4i]):
    """Turn a record already written into that of a culled Gaussian."""
    for j in range(RECORD):
        records_out[i, j] = 0.0
    radii_out[i] = wp.vec2i(0, 0)
    rects_out[i] = wp.vec4i(0, 0, 0, 0)


@wp.kernel
def shade_harmonics(
    start: int,
    # In:
    means: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    degree: int,
    viewmats: wp.array[wp.mat44],
    # Out:
    records_out: wp.array2d[float],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[wp.vec4i],
):
    """Channels = max(0, SH(direction from the camera) + 0.5), depth. Culls Gaussians whose colour is not finite."""
    i = start + wp.tid()
    if not visible(rects_out[i]):
        return
    camera = i / means.shape[0]
    n = i - camera * means.shape[0]
    # R^T (R x + t) = x - camera centre, for a rigid view matrix.
    p = camera_point(viewmats[camera], means[n])
    direction = wp.normalize(wp.transpose(view_rotation(viewmats[camera])) * p)
    rgb = harmonics_sum(sh, n, degree, direction) + wp.vec3(0.5, 0.5, 0.5)
    if not (wp.isfinite(rgb)):
        cull(i, records_out, radii_out, rects_out)
        return
    for j in range(3):
        records_out[i, CHANNELS + j] = wp.max(rgb[j], 0.0)
    records_out[i, CHANNELS + 3] = p[2]


@wp.kernel
def shade_features(
    start: int,
    # In:
    features: wp.array2d[float],
    # Out:
    records_out: wp.array2d[float],
    radii_out: wp.array[wp.vec2i],
    rects_out: wp.array[wp.vec4i],
):
    """Channels = the first four of features and depth; row i % rows. Culls where any feature is not finite."""
    i = start + wp.tid()
    if not visible(rects_out[i]):
        return
    row = i % features.shape[0]
    for j in range(features.shape[1]):
        value = features[row, j]
        if not (wp.isfinite(value)):
            cull(i, records_out, radii_out, rects_out)
            return
        if j < 4:
            records_out[i, CHANNELS + j] = value
    if features.shape[1] < 4:
        records_out[i, CHANNELS + features.shape[1]] = records_out[i, DEPTH]


@wp.kernel
def pack_channels(
    start: int,
    # In:
    features: wp.array2d[float],
    records: wp.array2d[float],
    rects: wp.array[wp.vec4i],
    first: int,
    # Out:
    channels_out: wp.array2d[float],
):
    """Channels first .. first + 3 of features followed by depth; past the end, zeros."""
    i = start + wp.tid()
    row = i % features.shape[0]
    for j in range(4):
        value = float(0.0)
        if visible(rects[i]):
            if first + j < features.shape[1]:
                value = features[row, first + j]
            elif first + j == features.shape[1]:
                value = records[i, DEPTH]
        channels_out[i, j] = value
