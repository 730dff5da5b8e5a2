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
    COMPENSATION  1  sqrt(det covariance / det blurred covariance) where antialiased, else 1

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


@wp.func
def rotation_of(quat: wp.vec4) -> wp.mat33:
    """Rotation matrix of a quaternion wxyz of any nonzero length; NaN for zero."""
    q = quat / wp.max(wp.abs(quat))
    q = q * wp.sqrt(2.0 / wp.dot(q, q))
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - (y * y + z * z), x * y - w * z, x * z + w * y,
        x * y + w * z, 1.0 - (x * x + z * z), y * z - w * x,
        x * z - w * y, y * z + w * x, 1.0 - (x * x + y * y),
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
def visible(rect: vec4s) -> bool:
    return rect[2] > wp.int16(0)


@wp.func
def clear(i: int, records_out: wp.array2d[float], radii_out: wp.array[wp.vec2i], rects_out: wp.array[vec4s]):
    """Write the record of a culled Gaussian."""
    for j in range(RECORD):
        records_out[i, j] = 0.0
    radii_out[i] = wp.vec2i(0, 0)
    rects_out[i] = vec4s(wp.int16(0))


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
    rects_out: wp.array[vec4s],
    keys_out: wp.array2d[float],
    order_out: wp.array2d[int],
):
    """EWA splatting (Zwicker et al. 2001, eq. 26-31) of Gaussian i % N by camera i / N."""
    i = start + wp.tid()
    camera = i / means.shape[0]
    n = i - camera * means.shape[0]
    viewmat = viewmats[camera]
    k = intrinsics[camera]

    keys_out[camera, n] = wp.inf
    order_out[camera, n] = i

    p = camera_point(viewmat, means[n])
    z = p[2]
    if not (z >= near and z <= far and z > 0.0):
        clear(i, records_out, radii_out, rects_out)
        return
    offset_x = (k[0, 0] * p[0] + k[0, 1] * p[1]) / z
    offset_y = k[1, 1] * p[1] / z
    mean_x = offset_x + k[0, 2]
    mean_y = offset_y + k[1, 2]

    # Perspective is linearized at the mean, pulled to at most 0.15 image sizes outside the image: farther out
    # the linearization would blow Gaussians up (as in the code of 3D Gaussian Splatting).
    margin_x = 0.15 * float(width)
    margin_y = 0.15 * float(height)
    offset_x = wp.clamp(offset_x, -k[0, 2] - margin_x, float(width) - k[0, 2] + margin_x)
    offset_y = wp.clamp(offset_y, -k[1, 2] - margin_y, float(height) - k[1, 2] + margin_y)
    row_x = wp.vec3(k[0, 0], k[0, 1], -offset_x) / z
    row_y = wp.vec3(0.0, k[1, 1], -offset_y) / z

    # 2D covariance M M^T of the rows m_x, m_y of M = J R_view R S.
    to_camera = wp.transpose(view_rotation(viewmat))
    to_axes = wp.transpose(rotation_of(quats[n]))
    m_x = wp.cw_mul(to_axes * (to_camera * row_x), scales[n])
    m_y = wp.cw_mul(to_axes * (to_camera * row_y), scales[n])
    xx = wp.dot(m_x, m_x)
    yy = wp.dot(m_y, m_y)
    xy = wp.dot(m_x, m_y)
    # Lagrange's identity: |m_x|^2 |m_y|^2 - (m_x . m_y)^2 without its cancellation.
    normal = wp.cross(m_x, m_y)
    det = wp.dot(normal, normal)
    det_blurred = det + eps2d * (xx + yy) + eps2d * eps2d
    deviation_x = wp.sqrt(xx + eps2d)
    deviation_y = wp.sqrt(yy + eps2d)

    compensation = wp.float32(1.0)
    if antialiased:
        compensation = wp.sqrt(det / det_blurred)
    opacity = opacities[n] * compensation
    log2_opacity = wp.log2(opacity)
    extent2 = log2_opacity - LOG2_CUTOFF
    extent = wp.sqrt(extent2)

    d = SQRT_HALF_LOG2_E / deviation_y
    a = deviation_y * SQRT_HALF_LOG2_E / wp.sqrt(det_blurred)
    b = -a * xy / (yy + eps2d)
    box_x = extent * deviation_x * (SLACK / SQRT_HALF_LOG2_E)
    box_y = extent * deviation_y * (SLACK / SQRT_HALF_LOG2_E)

    # Pixels whose centre lies in the box, then the tiles they lie in (end exclusive).
    x0 = wp.max(wp.ceil(mean_x - box_x - 0.5), 0.0)
    y0 = wp.max(wp.ceil(mean_y - box_y - 0.5), 0.0)
    x1 = wp.min(wp.floor(mean_x + box_x - 0.5), float(width - 1))
    y1 = wp.min(wp.floor(mean_y + box_y - 0.5), float(height - 1))
    # A sum of magnitudes is finite only where all its terms are.
    size = wp.abs(mean_x) + wp.abs(mean_y) + a + wp.abs(b) + d + box_x + box_y + extent2 + det_blurred
    drawn = extent2 >= 0.0 and wp.isfinite(size) and x0 <= x1 and y0 <= y1
    if not drawn or (box_x <= radius_clip and box_y <= radius_clip):
        clear(i, records_out, radii_out, rects_out)
        return

    block = 1.5 * wp.sqrt((a + wp.abs(b)) * (a + wp.abs(b)) + d * d)
    reach = (extent + block) * SLACK
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
    records_out[i, REACH] = reach * reach
    records_out[i, COMPENSATION] = compensation
    radii_out[i] = wp.vec2i(int(wp.min(wp.ceil(box_x), 1.0e9)), int(wp.min(wp.ceil(box_y), 1.0e9)))
    rects_out[i] = vec4s(
        wp.int16(int(x0) / TILE),
        wp.int16(int(y0) / TILE),
        wp.int16(int(x1) / TILE + 1),
        wp.int16(int(y1) / TILE + 1),
    )
    keys_out[camera, n] = z


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
    rects_out: wp.array[vec4s],
):
    """Channels = max(0, SH(direction from the camera) + 0.5), depth. Culls where the colour is not finite."""
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
        clear(i, records_out, radii_out, rects_out)
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
    rects_out: wp.array[vec4s],
):
    """Channels = the first four of features and depth, row i % rows. Culls where a feature is not finite."""
    i = start + wp.tid()
    if not visible(rects_out[i]):
        return
    row = i % features.shape[0]
    for j in range(features.shape[1]):
        value = features[row, j]
        if not (wp.isfinite(value)):
            clear(i, records_out, radii_out, rects_out)
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
    rects: wp.array[vec4s],
    first: int,
    # Out:
    channels_out: wp.array2d[float],
):
    """Channels first .. first + 3 of features followed by depth; past the end, zeros."""
    i = start + wp.tid()
    row = i % features.shape[0]
    for j in range(4):
        value = wp.float32(0.0)
        if visible(rects[i]):
            if first + j < features.shape[1]:
                value = features[row, first + j]
            elif first + j == features.shape[1]:
                value = records[i, DEPTH]
        channels_out[i, j] = value
