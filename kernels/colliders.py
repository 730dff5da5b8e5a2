"""Rigid obstacles as signed distances, and every vertex's contact with one of them.

A collider's signed distance is positive outside, its gradient is the outward normal, and it changes by no
more than a point moves: conservative advancement along a vertex's way (Mirtich 1996) finds how far it can go.
Curvature of the surface adds nothing to the Hessian: outside a convex shape its part is negative.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.contact import (
    Normal,
    friction_anchor,
    friction_energy,
    friction_gradient,
    friction_hessian,
    normal_energy,
    normal_force,
    normal_stiffness,
)

wp.set_module_options({"enable_backward": False})

PLANE = wp.constant(0)
BOX = wp.constant(1)
SPHERE = wp.constant(2)
CAPSULE = wp.constant(3)
CYLINDER = wp.constant(4)
MESH = wp.constant(5)

ADVANCES = wp.constant(32)
"""Steps of conservative advancement before what has been reached is taken."""

KEPT_ROOM = wp.constant(wp.float64(0.1))
"""Share of its room that one step leaves a vertex at least."""


@wp.struct
class Collider:
    """One obstacle where it stands now; points of its frame are rotation * q + position in the world.

    size: plane: free side z > 0; box: half extents; sphere: radius; capsule, cylinder: radius, half the
          length along z (without the caps); mesh: reach of its distance, m
    """

    kind: int
    size: wp.vec3d
    position: wp.vec3d
    rotation: wp.mat33d
    mesh: wp.uint64
    points: wp.array[wp.vec3d]  # of the mesh, in its frame
    triangles: wp.array[wp.int32]


@wp.struct
class Touch:
    """How each vertex meets the colliders."""

    friction: wp.array[wp.float64]
    stiffness: wp.array[wp.float64]  # N/m, along the normal
    stick: wp.array[wp.float64]  # N/m, in the tangent plane
    ramp: wp.array[wp.float64]  # m
    offset: wp.array[wp.float64]  # m
    room: wp.float64  # m behind the collider's surface, 0 for endless


@wp.func
def with_sign(size: wp.float64, sign: wp.float64) -> wp.float64:
    if sign < wp.float64(0.0):
        return -size
    return size


@wp.func
def box_distance(q: wp.vec3d, half: wp.vec3d):
    """Signed distance to a box around the origin, and the outward normal."""
    zero = wp.float64(0.0)
    a = wp.vec3d(wp.abs(q[0]) - half[0], wp.abs(q[1]) - half[1], wp.abs(q[2]) - half[2])
    out = wp.vec3d(wp.max(a[0], zero), wp.max(a[1], zero), wp.max(a[2], zero))
    distance = wp.length(out)
    normal = wp.vec3d()
    if distance > zero:
        normal = (
            wp.vec3d(with_sign(out[0], q[0]), with_sign(out[1], q[1]), with_sign(out[2], q[2])) / distance
        )
    else:
        one = wp.float64(1.0)
        if a[0] >= a[1] and a[0] >= a[2]:
            distance = a[0]
            normal = wp.vec3d(with_sign(one, q[0]), zero, zero)
        elif a[1] >= a[2]:
            distance = a[1]
            normal = wp.vec3d(zero, with_sign(one, q[1]), zero)
        else:
            distance = a[2]
            normal = wp.vec3d(zero, zero, with_sign(one, q[2]))
    return distance, normal


@wp.func
def ball_distance(q: wp.vec3d, radius: wp.float64):
    """Signed distance to a ball around the origin, and the outward normal."""
    length = wp.length(q)
    normal = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    if length > wp.float64(0.0):
        normal = q / length
    return length - radius, normal


@wp.func
def cylinder_distance(q: wp.vec3d, radius: wp.float64, half: wp.float64):
    """Signed distance to a cylinder along z around the origin, and the outward normal."""
    zero = wp.float64(0.0)
    across = wp.sqrt(q[0] * q[0] + q[1] * q[1])
    side = wp.vec3d(wp.float64(1.0), zero, zero)
    if across > zero:
        side = wp.vec3d(q[0] / across, q[1] / across, zero)
    cap = wp.vec3d(zero, zero, with_sign(wp.float64(1.0), q[2]))
    a = across - radius
    b = wp.abs(q[2]) - half
    distance = wp.max(a, b)
    normal = cap
    if a > zero and b > zero:
        distance = wp.sqrt(a * a + b * b)
        normal = (a * side + b * cap) / distance
    elif a > b:
        normal = side
    return distance, normal


@wp.func
def nearest_on_triangle(q: wp.vec3d, a: wp.vec3d, b: wp.vec3d, c: wp.vec3d) -> wp.vec3d:
    """Ericson, "Real-Time Collision Detection", section 5.1.5."""
    zero = wp.float64(0.0)
    ab = b - a
    ac = c - a
    aq = q - a
    d1 = wp.dot(ab, aq)
    d2 = wp.dot(ac, aq)
    if d1 <= zero and d2 <= zero:
        return a
    bq = q - b
    d3 = wp.dot(ab, bq)
    d4 = wp.dot(ac, bq)
    if d3 >= zero and d4 <= d3:
        return b
    vc = d1 * d4 - d3 * d2
    if vc <= zero and d1 >= zero and d3 <= zero:
        return a + ab * (d1 / (d1 - d3))
    cq = q - c
    d5 = wp.dot(ab, cq)
    d6 = wp.dot(ac, cq)
    if d6 >= zero and d5 <= d6:
        return c
    vb = d5 * d2 - d1 * d6
    if vb <= zero and d2 >= zero and d6 <= zero:
        return a + ac * (d2 / (d2 - d6))
    va = d3 * d6 - d5 * d4
    if va <= zero and d4 - d3 >= zero and d5 - d6 >= zero:
        return b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
    total = va + vb + vc
    return a + ab * (vb / total) + ac * (vc / total)


@wp.func
def mesh_distance(collider: Collider, q: wp.vec3d, reach: wp.float64):
    """Signed distance to a closed mesh, and the outward normal; `reach` where nothing is that near.

    Warp finds the nearest triangle and the side in float32, the distance is taken in float64.
    """
    distance = reach
    normal = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    point = wp.vec3(float(q[0]), float(q[1]), float(q[2]))
    query = wp.mesh_query_point_sign_normal(collider.mesh, point, float(reach))
    if query.result:
        a = collider.points[collider.triangles[3 * query.face]]
        b = collider.points[collider.triangles[3 * query.face + 1]]
        c = collider.points[collider.triangles[3 * query.face + 2]]
        off = q - nearest_on_triangle(q, a, b, c)
        length = wp.length(off)
        facing = wp.normalize(wp.cross(b - a, c - a))
        if length <= wp.float64(1.0e-6) * wp.length(b - a):
            distance = wp.dot(off, facing)
            normal = facing
        else:
            sign = wp.float64(1.0)
            if query.sign < 0.0:
                sign = wp.float64(-1.0)
            distance = sign * length
            normal = sign * off / length
    return distance, normal


@wp.func
def local_distance(collider: Collider, q: wp.vec3d, reach: wp.float64):
    """Signed distance at q in the collider's frame, and the outward normal there."""
    size = collider.size
    distance = q[2]
    normal = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
    if collider.kind == BOX:
        distance, normal = box_distance(q, size)
    elif collider.kind == SPHERE:
        distance, normal = ball_distance(q, size[0])
    elif collider.kind == CAPSULE:
        along = wp.clamp(q[2], -size[1], size[1])
        distance, normal = ball_distance(wp.vec3d(q[0], q[1], q[2] - along), size[0])
    elif collider.kind == CYLINDER:
        distance, normal = cylinder_distance(q, size[0], size[1])
    elif collider.kind == MESH:
        distance, normal = mesh_distance(collider, q, reach)
    return distance, normal


@wp.func
def signed_distance(collider: Collider, point: wp.vec3d):
    """Signed distance of a point in the world, m, and the outward unit normal there."""
    q = wp.transpose(collider.rotation) * (point - collider.position)
    distance, normal = local_distance(collider, q, collider.size[0])
    return distance, collider.rotation * normal


@wp.func
def inside_by(touch: Touch, i: int) -> wp.float64:
    """How deep a vertex lies in the collider when the surface it stands for touches it, m."""
    if touch.room > wp.float64(0.0):
        return wp.min(touch.offset[i], wp.float64(0.5) * touch.room)
    return touch.offset[i]


@wp.func
def normal_law(touch: Touch, i: int) -> Normal:
    law = Normal()
    law.stiffness = touch.stiffness[i]
    law.ramp = touch.ramp[i]
    law.room = wp.float64(0.0)
    if touch.room > wp.float64(0.0):
        law.room = touch.room - inside_by(touch, i)
    return law


@wp.func
def tangential_slip(collider: Collider, position: wp.vec3d, anchor: wp.vec3d, normal: wp.vec3d) -> wp.vec3d:
    """From an anchor in the collider's frame to a position in the world, in the plane across `normal`."""
    off = position - (collider.rotation * anchor + collider.position)
    return off - wp.dot(off, normal) * normal


@wp.kernel
def signed_distances(
    start: int,
    # In:
    collider: Collider,
    x: wp.array[wp.vec3d],
    # Out:
    distance_out: wp.array[wp.float64],
    normal_out: wp.array[wp.vec3d],
):
    """Signed distance of each point, m, and the outward normal there."""
    i = start + wp.tid()
    distance, normal = signed_distance(collider, x[i])
    distance_out[i] = distance
    normal_out[i] = normal


@wp.kernel
def place_anchors(
    start: int,
    # In:
    collider: Collider,
    x: wp.array[wp.vec3d],
    # Out:
    anchor_out: wp.array[wp.vec3d],
):
    """Anchors where the vertices are."""
    i = start + wp.tid()
    anchor_out[i] = wp.transpose(collider.rotation) * (x[i] - collider.position)


@wp.kernel
def friction_limits(
    start: int,
    # In:
    collider: Collider,
    touch: Touch,
    x: wp.array[wp.vec3d],
    # Out:
    limit_out: wp.array[wp.float64],
    normal_out: wp.array[wp.vec3d],
):
    """Coulomb limit mu |normal force| of each vertex at x, N, and the normal that friction acts across."""
    i = start + wp.tid()
    distance, normal = signed_distance(collider, x[i])
    depth = -distance - inside_by(touch, i)
    limit_out[i] = touch.friction[i] * normal_force(depth, normal_law(touch, i))
    normal_out[i] = normal


@wp.kernel
def contact_energy(
    start: int,
    # In:
    first: int,
    collider: Collider,
    touch: Touch,
    x: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec3d],
    limit: wp.array[wp.float64],
    lagged_normal: wp.array[wp.vec3d],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Penalty and friction of each vertex, J, written from index `first` on."""
    i = start + wp.tid()
    distance, _normal = signed_distance(collider, x[i])
    depth = -distance - inside_by(touch, i)
    energy = wp.float64(0.0)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        slip = tangential_slip(collider, x[i], anchor[i], lagged_normal[i])
        energy = normal_energy(depth, normal_law(touch, i))
        energy += friction_energy(slip, touch.stick[i], limit[i])
    energy_out[first + i] = energy


@wp.kernel
def add_contact_derivatives(
    start: int,
    # In:
    collider: Collider,
    touch: Touch,
    x: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec3d],
    limit: wp.array[wp.float64],
    lagged_normal: wp.array[wp.vec3d],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    block_out: wp.array[wp.mat33d],
):
    """Adds each vertex's gradient and semidefinite Hessian to what stands there."""
    i = start + wp.tid()
    distance, normal = signed_distance(collider, x[i])
    depth = -distance - inside_by(touch, i)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        law = normal_law(touch, i)
        across = lagged_normal[i]
        slip = tangential_slip(collider, x[i], anchor[i], across)
        gradient_out[i] += friction_gradient(slip, touch.stick[i], limit[i])
        gradient_out[i] -= normal_force(depth, law) * normal
        block_out[i] += friction_hessian(slip, across, touch.stick[i], limit[i])
        block_out[i] += normal_stiffness(depth, law) * wp.outer(normal, normal)


@wp.kernel
def drag_anchors(
    start: int,
    # In:
    collider: Collider,
    touch: Touch,
    x: wp.array[wp.vec3d],
    # Out:
    anchor_out: wp.array[wp.vec3d],
):
    """The end of a step: anchors follow sliding vertices."""
    i = start + wp.tid()
    distance, normal = signed_distance(collider, x[i])
    depth = -distance - inside_by(touch, i)
    limit = touch.friction[i] * normal_force(depth, normal_law(touch, i))
    slip = tangential_slip(collider, x[i], anchor_out[i], normal)
    dragged = friction_anchor(x[i], slip, touch.stick[i], limit)
    anchor_out[i] = wp.transpose(collider.rotation) * (dragged - collider.position)


@wp.kernel
def free_ways(
    start: int,
    # In:
    before: Collider,
    collider: Collider,
    touch: Touch,
    x: wp.array[wp.vec3d],
    direction: wp.array[wp.vec3d],
    # Out:
    share_out: wp.array[wp.float64],
):
    """Share of its way that each vertex can go before it runs out of room, in the collider's frame.

    The way begins where the collider stood `before`, and ends where it stands.
    """
    i = start + wp.tid()
    zero = wp.float64(0.0)
    one = wp.float64(1.0)
    begin = wp.transpose(before.rotation) * (x[i] - before.position)
    end = wp.transpose(collider.rotation) * (x[i] + direction[i] - collider.position)
    way = end - begin
    length = wp.length(way)
    share = one
    if length > zero:
        reach = length + touch.room
        distance, _normal = local_distance(collider, begin, reach)
        room = distance + touch.room
        kept = KEPT_ROOM * wp.max(room, zero)
        if room - kept < length:
            share = zero
            for _k in range(ADVANCES):
                share += wp.max(room - kept, zero) / length
                if share >= one:
                    break
                distance, _normal = local_distance(collider, begin + share * way, reach)
                room = distance + touch.room
                if room <= wp.float64(2.0) * kept:
                    break
    share_out[i] = wp.min(share, one)
