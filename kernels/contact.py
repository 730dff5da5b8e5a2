"""Ground contact: a smooth normal penalty and Coulomb friction with lagged normal force.

Normal direction: a penalty in the penetration depth d, cubic over the first `ramp` metres and quadratic
beyond, twice continuously differentiable so that Newton's method sees no jump.

Tangent plane: Coulomb friction regularised by a stiff tangential spring that starts at the vertex's anchor
(elastic-perfectly-plastic friction, Wriggers, "Computational Contact Mechanics", 2nd ed., section 5.2).
For a fixed normal force its potential is Huber's: quadratic while it sticks, linear while it slides. The
anchor follows a sliding vertex, so a sticking one does not creep.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.func
def normal_energy(depth: wp.float64, stiffness: wp.float64, ramp: wp.float64) -> wp.float64:
    """Penalty energy of one vertex at penetration `depth`, J."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    if depth < ramp:
        return stiffness * depth * depth * depth / (wp.float64(6.0) * ramp)
    d = depth - wp.float64(0.5) * ramp
    return stiffness * (wp.float64(0.5) * d * d + ramp * ramp / wp.float64(24.0))


@wp.func
def normal_force(depth: wp.float64, stiffness: wp.float64, ramp: wp.float64) -> wp.float64:
    """Size of the force that pushes the vertex out, N."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    if depth < ramp:
        return wp.float64(0.5) * stiffness * depth * depth / ramp
    return stiffness * (depth - wp.float64(0.5) * ramp)


@wp.func
def normal_stiffness(depth: wp.float64, stiffness: wp.float64, ramp: wp.float64) -> wp.float64:
    """Derivative of `normal_force` with depth, N/m."""
    if depth <= wp.float64(0.0):
        return wp.float64(0.0)
    if depth < ramp:
        return stiffness * depth / ramp
    return stiffness


@wp.func
def friction_energy(slip: wp.vec2d, stiffness: wp.float64, limit: wp.float64) -> wp.float64:
    """Huber potential of the tangential spring stretched by `slip`, with force never above `limit`, J."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return wp.float64(0.5) * stiffness * length * length
    return limit * (length - wp.float64(0.5) * limit / stiffness)


@wp.func
def friction_gradient(slip: wp.vec2d, stiffness: wp.float64, limit: wp.float64) -> wp.vec2d:
    """Gradient of `friction_energy`: minus the friction force, N."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return stiffness * slip
    return (limit / length) * slip


@wp.func
def friction_hessian(slip: wp.vec2d, stiffness: wp.float64, limit: wp.float64) -> wp.mat22d:
    """Hessian of `friction_energy`; positive semidefinite, N/m."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return wp.diag(wp.vec2d(stiffness))
    direction = slip / length
    return (limit / length) * (wp.identity(n=2, dtype=wp.float64) - wp.outer(direction, direction))


@wp.func
def friction_anchor(position: wp.vec2d, slip: wp.vec2d, stiffness: wp.float64, limit: wp.float64) -> wp.vec2d:
    """Where the spring's anchor ends up: dragged along so that the spring holds no more than `limit`."""
    length = wp.length(slip)
    if stiffness * length <= limit:
        return position - slip
    return position - (limit / (stiffness * length)) * slip
