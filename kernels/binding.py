"""Bound Gaussians follow their triangles: frames, affine maps, covariance and spherical harmonics.

The triangle's affine map F takes the rest edges to the moved edges and the rest unit normal to the moved unit
normal, so the covariance F S F^T splits exactly into the normal axis (unchanged) and an in-plane 2 x 2 part.
With the in-plane factor M = G R(phi) diag(s), one Jacobi rotation makes the columns of M orthogonal:
their lengths are the new scales, their directions the new axes, and axis order never jumps between frames.
"""

import warp as wp

from gdpro_sim.kernels.harmonics import harmonics_sum

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

TINY = wp.constant(1e-30)


@wp.struct
class TriangleFrame:
    """Orthonormal frame (normal, along the first edge, completing) and the 2D corners (edge, 0), (p, q)."""

    normal: wp.vec3
    e1: wp.vec3
    e2: wp.vec3
    edge: float
    p: float
    q: float


@wp.func
def triangle_frame(a: wp.vec3, b: wp.vec3, c: wp.vec3) -> TriangleFrame:
    frame = TriangleFrame()
    ab = b - a
    ac = c - a
    frame.edge = wp.length(ab)
    frame.e1 = wp.vec3(1.0, 0.0, 0.0)
    if frame.edge > TINY:
        frame.e1 = ab / frame.edge
    cross = wp.cross(frame.e1, ac)
    frame.q = wp.length(cross)
    if frame.q > TINY:
        frame.normal = cross / frame.q
    else:
        # A collapsed triangle has no normal: any direction across its edge keeps the Gaussian finite.
        axis = wp.vec3(0.0, 0.0, 1.0)
        if wp.abs(frame.e1[2]) > 0.9:
            axis = wp.vec3(0.0, 1.0, 0.0)
        frame.normal = wp.normalize(wp.cross(frame.e1, axis))
    frame.e2 = wp.cross(frame.normal, frame.e1)
    frame.p = wp.dot(ac, frame.e1)
    return frame


@wp.func
def frame_axis(frame: TriangleFrame, x: float, y: float) -> wp.vec3:
    return frame.e1 * x + frame.e2 * y


@wp.func
def quaternion_wxyz(r0: wp.vec3, r1: wp.vec3, r2: wp.vec3) -> wp.vec4:
    """Unit quaternion of the rotation matrix with columns r0, r1, r2 (Shepperd's method)."""
    t = r0[0] + r1[1] + r2[2]
    q = wp.vec4()
    if t > 0.0:
        s = wp.sqrt(t + 1.0) * 2.0
        q = wp.vec4(0.25 * s, (r1[2] - r2[1]) / s, (r2[0] - r0[2]) / s, (r0[1] - r1[0]) / s)
    elif r0[0] > r1[1] and r0[0] > r2[2]:
        s = wp.sqrt(1.0 + r0[0] - r1[1] - r2[2]) * 2.0
        q = wp.vec4((r1[2] - r2[1]) / s, 0.25 * s, (r1[0] + r0[1]) / s, (r2[0] + r0[2]) / s)
    elif r1[1] > r2[2]:
        s = wp.sqrt(1.0 + r1[1] - r0[0] - r2[2]) * 2.0
        q = wp.vec4((r2[0] - r0[2]) / s, (r1[0] + r0[1]) / s, 0.25 * s, (r2[1] + r1[2]) / s)
    else:
        s = wp.sqrt(1.0 + r2[2] - r0[0] - r1[1]) * 2.0
        q = wp.vec4((r0[1] - r1[0]) / s, (r2[0] + r0[2]) / s, (r2[1] + r1[2]) / s, 0.25 * s)
    return q / wp.length(q)


@wp.func
def same(a: wp.vec3, b: wp.vec3) -> bool:
    return a[0] == b[0] and a[1] == b[1] and a[2] == b[2]


@wp.func
def turned(d: wp.vec3, rest: TriangleFrame, moved: TriangleFrame, cos: float, sin: float) -> wp.vec3:
    """R^T d, with R the rotation part of F: frame to frame, and the polar angle of G in the plane."""
    u = wp.dot(d, moved.e1)
    v = wp.dot(d, moved.e2)
    return (
        rest.normal * wp.dot(d, moved.normal) + rest.e1 * (cos * u + sin * v) + rest.e2 * (cos * v - sin * u)
    )


@wp.kernel
def follow_triangles(
    start: int,
    # In:
    rest_vertices: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    faces: wp.array2d[int],
    face_ids: wp.array[int],
    barycentrics: wp.array[wp.vec3],
    rotations: wp.array[wp.vec2],
    log_scales: wp.array[wp.vec3],
    sh: wp.array2d[wp.vec3],
    sh_directions: wp.array[wp.vec3],
    sh_inverse: wp.array2d[float],
    rotate_degree: int,
    # Out:
    means_out: wp.array[wp.vec3],
    quats_out: wp.array[wp.vec4],
    scales_out: wp.array[wp.vec3],
    sh_out: wp.array2d[wp.vec3],
):
    i = start + wp.tid()
    f = face_ids[i]
    ia = faces[f, 0]
    ib = faces[f, 1]
    ic = faces[f, 2]
    ra = rest_vertices[ia]
    rb = rest_vertices[ib]
    rc = rest_vertices[ic]
    a = vertices[ia]
    b = vertices[ib]
    c = vertices[ic]
    w = barycentrics[i]
    means_out[i] = a * w[0] + b * w[1] + c * w[2]

    z = rotations[i]
    norm = wp.length(z)
    x = float(1.0)
    y = float(0.0)
    if norm > TINY:
        x = z[0] / norm
        y = z[1] / norm
    ls = log_scales[i]
    s0 = wp.exp(ls[0])
    s1 = wp.exp(ls[1])
    s2 = wp.exp(ls[2])

    moved = triangle_frame(a, b, c)
    at_rest = same(a, ra) and same(b, rb) and same(c, rc)
    if not at_rest:
        rest = triangle_frame(ra, rb, rc)
        edge = wp.max(rest.edge, TINY)
        q = wp.max(rest.q, TINY)
        g11 = moved.edge / edge
        g22 = moved.q / q
        g12 = (moved.p - rest.p * g11) / q
        ax = (g11 * x + g12 * y) * s1
        ay = g22 * y * s1
        bx = (g12 * x - g11 * y) * s2
        by = g22 * x * s2
        # One-sided Jacobi (Hestenes 1958): the smaller rotation that makes the columns orthogonal.
        dot = ax * bx + ay * by
        aa = ax * ax + ay * ay
        bb = bx * bx + by * by
        if wp.abs(dot) > 1e-7 * wp.sqrt(aa * bb):
            zeta = (bb - aa) / (2.0 * dot)
            t = 1.0 / (wp.abs(zeta) + wp.sqrt(1.0 + zeta * zeta))
            if zeta < 0.0:
                t = -t
            jc = 1.0 / wp.sqrt(1.0 + t * t)
            js = jc * t
            nx = jc * ax - js * bx
            ny = jc * ay - js * by
            bx = js * ax + jc * bx
            by = js * ay + jc * by
            ax = nx
            ay = ny
        s1 = wp.sqrt(ax * ax + ay * ay)
        s2 = wp.sqrt(bx * bx + by * by)
        if s1 >= s2 and s1 > TINY:
            x = ax / s1
            y = ay / s1
        elif s2 > TINY:
            x = by / s2
            y = -bx / s2
        if rotate_degree > 0:
            trace = g11 + g22
            polar = wp.sqrt(trace * trace + g12 * g12)
            cos = float(1.0)
            sin = float(0.0)
            if polar > TINY:
                cos = trace / polar
                sin = -g12 / polar
            # f'(d) = f(R^T d): sample along fixed directions, then solve for the coefficients.
            count = (rotate_degree + 1) * (rotate_degree + 1)
            for k in range(count):
                sh_out[i, k] = wp.vec3()
            for j in range(count):
                d = turned(sh_directions[j], rest, moved, cos, sin)
                value = harmonics_sum(sh, i, rotate_degree, d)
                for k in range(count):
                    sh_out[i, k] += sh_inverse[k, j] * value
    elif rotate_degree > 0:
        for k in range((rotate_degree + 1) * (rotate_degree + 1)):
            sh_out[i, k] = sh[i, k]

    scales_out[i] = wp.vec3(s0, s1, s2)
    quats_out[i] = quaternion_wxyz(moved.normal, frame_axis(moved, x, y), frame_axis(moved, -y, x))


@wp.kernel
def bind_triangles_backward(
    start: int,
    # In:
    vertices: wp.array[wp.vec3],
    faces: wp.array2d[int],
    offsets: wp.array[int],
    order: wp.array[int],
    barycentrics: wp.array[wp.vec3],
    rotations: wp.array[wp.vec2],
    quats: wp.array[wp.vec4],
    scales: wp.array[wp.vec3],
    g_means: wp.array[wp.vec3],
    g_quats: wp.array[wp.vec4],
    g_scales: wp.array[wp.vec3],
    # Out:
    g_corners_out: wp.array2d[wp.vec3],
    g_rotations_out: wp.array[wp.vec2],
    g_log_scales_out: wp.array[wp.vec3],
):
    """Gradients of the rest pose of `follow_triangles`, one face: its Gaussians are order[offsets[f]...].

    A small turn w of a Gaussian moves its quaternion by (0, w) q / 2, which gives a torque dL/dw; in the
    plane it turns the complex number, and the sum over a face's Gaussians turns the frame, whose axes follow
    the corners: with ab = (l, 0) and ac = (p, q) in the plane, w . e2 = -db.n / l, w . n = db.e2 / l and
    w . e1 = (dc.n - db.n p / l) / q for corner moves db, dc relative to the first corner.
    """
    f = start + wp.tid()
    a = vertices[faces[f, 0]]
    b = vertices[faces[f, 1]]
    c = vertices[faces[f, 2]]
    frame = triangle_frame(a, b, c)
    ga = wp.vec3()
    gb = wp.vec3()
    gc = wp.vec3()
    torque = wp.vec3()
    for k in range(offsets[f], offsets[f + 1]):
        i = order[k]
        w = barycentrics[i]
        g = g_means[i]
        ga += g * w[0]
        gb += g * w[1]
        gc += g * w[2]
        q = quats[i]
        h = g_quats[i]
        turn = 0.5 * wp.vec3(
            -h[0] * q[1] + h[1] * q[0] - h[2] * q[3] + h[3] * q[2],
            -h[0] * q[2] + h[1] * q[3] + h[2] * q[0] - h[3] * q[1],
            -h[0] * q[3] - h[1] * q[2] + h[2] * q[1] + h[3] * q[0],
        )
        torque += turn
        z = rotations[i]
        norm = wp.dot(z, z)
        spin = float(0.0)
        if norm > TINY:
            spin = wp.dot(turn, frame.normal) / norm
        g_rotations_out[i] = wp.vec2(-z[1] * spin, z[0] * spin)
        g_log_scales_out[i] = wp.cw_mul(g_scales[i], scales[i])
    if frame.edge > TINY and frame.q > TINY:
        t1 = wp.dot(torque, frame.e1)
        t2 = wp.dot(torque, frame.e2)
        tn = wp.dot(torque, frame.normal)
        tb = frame.e2 * (tn / frame.edge) - frame.normal * ((t2 + t1 * frame.p / frame.q) / frame.edge)
        tc = frame.normal * (t1 / frame.q)
        ga -= tb + tc
        gb += tb
        gc += tc
    g_corners_out[f, 0] = ga
    g_corners_out[f, 1] = gb
    g_corners_out[f, 2] = gc


@wp.kernel
def gather_corners(
    start: int,
    # In:
    offsets: wp.array[int],
    corners: wp.array[int],
    values: wp.array[wp.vec3],
    # Out:
    sums_out: wp.array[wp.vec3],
):
    """Sum of corner values at each vertex; its corners (3 face + corner) are corners[offsets[v]...]."""
    v = start + wp.tid()
    total = wp.vec3()
    for k in range(offsets[v], offsets[v + 1]):
        total += values[corners[k]]
    sums_out[v] = total
