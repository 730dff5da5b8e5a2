"""Vertex contact: a smooth normal penalty and Coulomb friction with lagged normal force.

Normal direction: a penalty in the penetration depth d, cubic over the first `ramp` metres and quadratic
beyond. Where there is only so much `room` behind the surface (half a plate's thickness), a barrier on the
second half of it keeps the vertex from ever coming out on the other side. Both are twice continuously
differentiable so that Newton's method sees no jump.

Tangent plane: Coulomb friction regularised by a stiff tangential spring that starts at the vertex's anchor
(elastic-perfectly-plastic friction, Wriggers, "Computational Contact Mechanics", 2nd ed., section 5.2).
For a fixed normal force its potential is Huber's: quadratic while it sticks, linear while it slides. The
anchor follows a sliding vertex, so a sticking one does not creep.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Normal:
    """The normal law of one vertex. room: m, 0 for endless."""

    stiffness: wp.float64  # N/m
    ramp: wp.float64  # m
    room: wp.float64  # m


@wp.func
def normal_energy(depth: wp.float64, law: Normal) -> wp.float64:
    """Energy of one vertex at penetration `depth`, J; infinite where there is no room left."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    if depth < law.ramp:
        energy = law.stiffness * depth * depth * depth / (wp.float64(6.0) * law.ramp)
    else:
        d = depth - wp.float64(0.5) * law.ramp
        energy = law.stiffness * (wp.float64(0.5) * d * d + law.ramp * law.ramp / wp.float64(24.0))
    half = wp.float64(0.5) * law.room
    if half > wp.float64(0.0) and depth > half:
        s = (depth - half) / half
        if s >= wp.float64(1.0):
            return wp.float64(wp.inf)
        energy -= law.stiffness * half * half * s * s * wp.log(wp.float64(1.0) - s)
    return energy


@wp.func
def normal_force(depth: wp.float64, law: Normal) -> wp.float64:
    """Size of the force that pushes the vertex out, N."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    if depth < law.ramp:
        force = wp.float64(0.5) * law.stiffness * depth * depth / law.ramp
    else:
        force = law.stiffness * (depth - wp.float64(0.5) * law.ramp)
    half = wp.float64(0.5) * law.room
    if half > wp.float64(0.0) and depth > half:
        s = (depth - half) / half
        left = wp.float64(1.0) - s
        force += law.stiffness * half * s * (s / left - wp.float64(2.0) * wp.log(left))
    return force


@wp.func
def normal_stiffness(depth: wp.float64, law: Normal) -> wp.float64:
    """Derivative of `normal_force` with depth, N/m."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    stiffness = law.stiffness
    if depth < law.ramp:
        stiffness *= depth / law.ramp
    half = wp.float64(0.5) * law.room
    if half > wp.float64(0.0) and depth > half:
        s = (depth - half) / half
        left = wp.float64(1.0) - s
        share = s / left
        curvature = share * (wp.float64(4.0) + share) - wp.float64(2.0) * wp.log(left)
        stiffness += law.stiffness * curvature
    return stiffness


@wp.func
def friction_energy(slip: wp.vec3d, stiffness: wp.float64, limit: wp.float64) -> wp.float64:
    """Huber potential of the tangential spring stretched by `slip`, with force never above `limit`, J."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return wp.float64(0.5) * stiffness * length * length
    return limit * (length - wp.float64(0.5) * limit / stiffness)


@wp.func
def friction_gradient(slip: wp.vec3d, stiffness: wp.float64, limit: wp.float64) -> wp.vec3d:
    """Gradient of `friction_energy`: minus the friction force, N."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return stiffness * slip
    return (limit / length) * slip


@wp.func
def friction_hessian(slip: wp.vec3d, normal: wp.vec3d, stiffness: wp.float64, limit: wp.float64) -> wp.mat33d:
    """Hessian of `friction_energy` in the plane across `normal`; positive semidefinite, N/m."""
    plane = wp.identity(n=3, dtype=wp.float64) - wp.outer(normal, normal)
    length = wp.length(slip)
    if stiffness * length <= limit:
        return stiffness * plane
    direction = slip / length
    return (limit / length) * (plane - wp.outer(direction, direction))


@wp.func
def friction_anchor(position: wp.vec3d, slip: wp.vec3d, stiffness: wp.float64, limit: wp.float64) -> wp.vec3d:
    """Where the spring's anchor ends up: dragged along so that the spring holds no more than `limit`."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return position - slip
    return position - (limit / (stiffness * length)) * slip
