"""The ground as a term of the incremental potential: penalty and Coulomb friction at every vertex."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.contact import (
    friction_anchor,
    friction_energy,
    friction_gradient,
    friction_hessian,
    normal_energy,
    normal_force,
    normal_stiffness,
)

wp.set_module_options({"enable_backward": False})


@wp.struct
class Ground:
    """A floor and how each vertex meets it."""

    height: wp.float64  # m
    friction: wp.array[wp.float64]
    stiffness: wp.array[wp.float64]  # N/m, along the normal
    stick: wp.array[wp.float64]  # N/m, in the tangent plane
    ramp: wp.array[wp.float64]  # m
    offset: wp.array[wp.float64]  # m


@wp.func
def penetration(ground: Ground, i: int, position: wp.vec3d) -> wp.float64:
    """Depth below the ground, m, of the surface `offset` inside a vertex."""
    return ground.height - ground.offset[i] - position[2]


@wp.func
def coulomb_limit(ground: Ground, i: int, depth: wp.float64) -> wp.float64:
    return ground.friction[i] * normal_force(depth, ground.stiffness[i], ground.ramp[i])


@wp.func
def tangential_slip(position: wp.vec3d, anchor: wp.vec2d) -> wp.vec2d:
    return wp.vec2d(position[0], position[1]) - anchor


@wp.kernel
def friction_limits(
    start: int,
    # In:
    ground: Ground,
    x: wp.array[wp.vec3d],
    # Out:
    limit_out: wp.array[wp.float64],
):
    """Coulomb limit mu |normal force| of each vertex at x, held fixed while one Newton step is taken, N."""
    i = start + wp.tid()
    limit_out[i] = coulomb_limit(ground, i, penetration(ground, i, x[i]))


@wp.kernel
def ground_energy(
    start: int,
    # In:
    first: int,
    ground: Ground,
    x: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec2d],
    limit: wp.array[wp.float64],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Penalty and friction of each vertex, J, written from index `first` on."""
    i = start + wp.tid()
    position = x[i]
    depth = penetration(ground, i, position)
    energy = wp.float64(0.0)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        energy = normal_energy(depth, ground.stiffness[i], ground.ramp[i])
        energy += friction_energy(tangential_slip(position, anchor[i]), ground.stick[i], limit[i])
    energy_out[first + i] = energy


@wp.kernel
def add_ground_derivatives(
    start: int,
    # In:
    ground: Ground,
    x: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec2d],
    limit: wp.array[wp.float64],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    block_out: wp.array[wp.mat33d],
):
    """Adds each vertex's gradient and semidefinite Hessian to what stands there."""
    i = start + wp.tid()
    position = x[i]
    depth = penetration(ground, i, position)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        stiffness = ground.stiffness[i]
        ramp = ground.ramp[i]
        slip = tangential_slip(position, anchor[i])
        tangential = friction_gradient(slip, ground.stick[i], limit[i])
        curvature = friction_hessian(slip, ground.stick[i], limit[i])
        gradient_out[i] += wp.vec3d(tangential[0], tangential[1], -normal_force(depth, stiffness, ramp))
        zero = wp.float64(0.0)
        # fmt: off
        block_out[i] += wp.mat33d(
            curvature[0, 0], curvature[0, 1], zero,
            curvature[1, 0], curvature[1, 1], zero,
            zero, zero, normal_stiffness(depth, stiffness, ramp),
        )
        # fmt: on


@wp.kernel
def drag_anchors(
    start: int,
    # In:
    ground: Ground,
    x: wp.array[wp.vec3d],
    # Out:
    anchor_out: wp.array[wp.vec2d],
):
    """The end of a step: anchors follow sliding vertices."""
    i = start + wp.tid()
    position = x[i]
    limit = coulomb_limit(ground, i, penetration(ground, i, position))
    slip = tangential_slip(position, anchor_out[i])
    anchor_out[i] = friction_anchor(wp.vec2d(position[0], position[1]), slip, ground.stick[i], limit)
