"""Springs with dashpots between points of elements or of the world.

An end is p = anchor + sum_a w_a x_a over the four corners of an element (no weights: a point of the world),
d = p_b - p_a, l = |d|. With rest length L > 0 force and damping act along the spring,

    E = k/2 (l - L)^2 + c/(2 h) (l - l_base)^2,

and with L = 0 on the distance itself, E = k/2 |d|^2 + c/(2 h) |d - d_base|^2, where velocities are
(x - base) / h. A compressed spring's Hessian lacks its negative part across the spring, so it is positive
semidefinite.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Springs:
    """Two ends each: 2 s and 2 s + 1 of spring s."""

    corners: wp.array[wp.vec4i]
    weights: wp.array[wp.vec4d]
    anchor: wp.array[wp.vec3d]  # m
    stiffness: wp.array[wp.float64]  # N/m
    rest_length: wp.array[wp.float64]  # m
    damping: wp.array[wp.float64]  # N s/m


@wp.func
def end_point(springs: Springs, end: int, x: wp.array[wp.vec3d]) -> wp.vec3d:
    corners = springs.corners[end]
    weights = springs.weights[end]
    point = springs.anchor[end]
    for a in range(4):
        point += weights[a] * x[corners[a]]
    return point


@wp.func
def span(springs: Springs, s: int, x: wp.array[wp.vec3d]) -> wp.vec3d:
    """From the first to the second end, m."""
    return end_point(springs, 2 * s + 1, x) - end_point(springs, 2 * s, x)


@wp.kernel
def spring_energy(
    start: int,
    # In:
    first: int,
    springs: Springs,
    x: wp.array[wp.vec3d],
    base: wp.array[wp.vec3d],
    inverse_h: wp.float64,
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Energy of each spring, J, written from index `first` on."""
    s = start + wp.tid()
    d = span(springs, s, x)
    before = span(springs, s, base)
    rest = springs.rest_length[s]
    half = wp.float64(0.5)
    damping = springs.damping[s] * inverse_h
    if rest > wp.float64(0.0):
        stretch = wp.length(d) - rest
        rate = wp.length(d) - wp.length(before)
        energy_out[first + s] = half * (springs.stiffness[s] * stretch * stretch + damping * rate * rate)
    else:
        moved = d - before
        energy_out[first + s] = half * (springs.stiffness[s] * wp.dot(d, d) + damping * wp.dot(moved, moved))


@wp.kernel
def spring_derivatives(
    start: int,
    # In:
    springs: Springs,
    x: wp.array[wp.vec3d],
    base: wp.array[wp.vec3d],
    inverse_h: wp.float64,
    # Out:
    gradient_out: wp.array[wp.vec3d],
    hessian_out: wp.array[wp.mat33d],
):
    """Gradient, N, and semidefinite Hessian, N/m, of each spring's energy with respect to its span d."""
    s = start + wp.tid()
    d = span(springs, s, x)
    before = span(springs, s, base)
    rest = springs.rest_length[s]
    stiffness = springs.stiffness[s]
    damping = springs.damping[s] * inverse_h
    one = wp.identity(n=3, dtype=wp.float64)
    if rest > wp.float64(0.0):
        length = wp.length(d)
        tension = stiffness * (length - rest) + damping * (length - wp.length(before))
        if length > wp.float64(1.0e-12) * rest:
            n = d / length
            along = wp.outer(n, n)
            gradient_out[s] = tension * n
            across = wp.max(tension / length, wp.float64(0.0))
            hessian_out[s] = (stiffness + damping) * along + across * (one - along)
        else:  # no direction to push in
            gradient_out[s] = wp.vec3d()
            hessian_out[s] = (stiffness + damping) * one
    else:
        gradient_out[s] = stiffness * d + damping * (d - before)
        hessian_out[s] = (stiffness + damping) * one


@wp.kernel
def gather_springs(
    start: int,
    # In:
    vertices: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    springs: wp.array[wp.int32],
    shares: wp.array[wp.float64],
    spring_gradient: wp.array[wp.vec3d],
    spring_hessian: wp.array[wp.mat33d],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    block_out: wp.array[wp.mat33d],
):
    """Adds to every vertex that a spring takes hold of; `shares` is d(span)/d(vertex)."""
    slot = start + wp.tid()
    slope = wp.vec3d()
    curvature = wp.mat33d()
    for k in range(offsets[slot], offsets[slot + 1]):
        share = shares[k]
        slope += share * spring_gradient[springs[k]]
        curvature += (share * share) * spring_hessian[springs[k]]
    i = vertices[slot]
    gradient_out[i] += slope
    block_out[i] += curvature
