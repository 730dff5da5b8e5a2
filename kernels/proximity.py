"""Closest points on a triangle mesh, rays, and inside tests by the generalised winding number."""

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.kernel
def closest_point(
    start: int,
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    # Out:
    face_out: wp.array[int],
    barycentric_out: wp.array[wp.vec3],
):
    """Nearest face of each point, and barycentric coordinates of the nearest point on it; face -1 for
    none."""
    i = start + wp.tid()
    query = wp.mesh_query_point_no_sign(mesh, points[i], 1.0e10)
    face_out[i] = -1
    barycentric_out[i] = wp.vec3(1.0, 0.0, 0.0)
    if query.result:
        face_out[i] = query.face
        barycentric_out[i] = wp.vec3(query.u, query.v, 1.0 - query.u - query.v)


@wp.kernel
def closest_point_facing(
    start: int,
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    reach: float,
    # Out:
    face_out: wp.array[int],
    barycentric_out: wp.array[wp.vec3],
):
    """As `closest_point`, but a face that looks away from `normals` loses to one along the normal within
    `reach`.

    So a point of one side of a thin wall is not taken for the other side.
    """
    i = start + wp.tid()
    p = points[i]
    n = normals[i]
    query = wp.mesh_query_point_no_sign(mesh, p, 1.0e10)
    face_out[i] = -1
    barycentric_out[i] = wp.vec3(1.0, 0.0, 0.0)
    if query.result:
        face = query.face
        u = query.u
        v = query.v
        if wp.dot(wp.mesh_eval_face_normal(mesh, face), n) < 0.0:
            best = reach
            for side in range(2):
                direction = n
                if side == 1:
                    direction = -n
                hit = wp.mesh_query_ray(mesh, p, direction, best)
                if hit.result and wp.dot(hit.normal, n) > 0.0:
                    best = hit.t
                    face = hit.face
                    u = hit.u
                    v = hit.v
        face_out[i] = face
        barycentric_out[i] = wp.vec3(u, v, 1.0 - u - v)


@wp.kernel
def first_hit(
    start: int,
    # In:
    mesh: wp.uint64,
    origins: wp.array[wp.vec3],
    directions: wp.array[wp.vec3],
    # Out:
    face_out: wp.array[int],
    barycentric_out: wp.array[wp.vec3],
):
    """First face each ray meets, from either side, and barycentric coordinates of where; face -1 for none."""
    i = start + wp.tid()
    hit = wp.mesh_query_ray(mesh, origins[i], directions[i], 1.0e10)
    face_out[i] = -1
    barycentric_out[i] = wp.vec3(1.0, 0.0, 0.0)
    if hit.result:
        face_out[i] = hit.face
        barycentric_out[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)


@wp.kernel
def openness(
    start: int,
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    rays: int,
    lift: float,
    reach: float,
    # Out:
    open_out: wp.array[float],
):
    """Share of cosine-weighted rays from a surface point that meet nothing within `reach`; rays start `lift`
    above."""
    i = start + wp.tid()
    n = normals[i]
    axis = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.8:
        axis = wp.vec3(0.0, 1.0, 0.0)
    t = wp.normalize(wp.cross(n, axis))
    b = wp.cross(n, t)
    origin = points[i] + n * lift
    free = wp.int32(0)
    for k in range(rays):
        # A Fibonacci spiral on the disc, projected up to the hemisphere: even in cosine.
        r2 = (float(k) + 0.5) / float(rays)
        r = wp.sqrt(r2)
        phi = 2.39996323 * float(k)
        direction = t * (r * wp.cos(phi)) + b * (r * wp.sin(phi)) + n * wp.sqrt(1.0 - r2)
        if not wp.mesh_query_ray_anyhit(mesh, origin, direction, reach):
            free += 1
    open_out[i] = float(free) / float(rays)


@wp.kernel
def inside(
    start: int,
    # In:
    mesh: wp.uint64,
    points: wp.array[wp.vec3],
    level: float,
    # Out:
    inside_out: wp.array[int],
):
    """1 where the generalised winding number is above `level`, else 0."""
    i = start + wp.tid()
    query = wp.mesh_query_point_sign_winding_number(mesh, points[i], 1.0e10, 2.0, level)
    inside_out[i] = 0
    if query.result and query.sign < 0.0:
        inside_out[i] = 1
