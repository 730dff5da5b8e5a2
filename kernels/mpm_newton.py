"""Newton's method and conjugate gradients over the nodes of the MPM grid.

Vectors are `wp.vec4` per node, as the grid's values; the fourth number of `target` is the node's mass, of
others nothing. A kernel's index stands for `per` nodes: 64, a block of the grid, on a CPU and one on a GPU;
each index has a partial sum of its own, so that totals do not depend on the number of threads.

Boundaries are known by what they make of velocities alone. Let u = v* - (forces h) / m be what a node's
velocity would be without them; the solution obeys v = boundary(u). From the derivative J of `boundary` at u
follow the directions in which the node is free, the range of J with the projector Q; what it is held at in
others, (1 - Q) boundary(u); and what comes as an impulse, friction, in free ones: Q (boundary(u) - u), which
moves the target of Newton's method. `projectors` is empty where there are no boundaries.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import eigen_symmetric
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.linalg import CG_ALPHA, CG_BETA, block_range
from gdpro_sim.kernels.mpm_grid import sum_of_tiles

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

FREE = wp.constant(wp.float64(0.04))
"""Squared singular value of a boundary's derivative from which a direction counts as free."""

PROBE = wp.constant(0.01)
"""Change of a velocity that finds the derivative of a boundary, relative to the velocity."""

_PLAIN = "const Q v = sum[n];"


@wp.func_native(sum_of_tiles(3, _PLAIN))
def add_tiles_quadratic(
    block: int, sources: wp.array[int], tiles: wp.array[wp.vec4], values_out: wp.array[wp.vec4]
): ...


@wp.func_native(sum_of_tiles(4, _PLAIN))
def add_tiles_cubic(
    block: int, sources: wp.array[int], tiles: wp.array[wp.vec4], values_out: wp.array[wp.vec4]
): ...


@wp.kernel
def add_tiles(
    start: int,
    # In:
    width: int,
    sources: wp.array[int],
    tiles: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """Sum of the tiles over each grid block. CPU."""
    b = start + wp.tid()
    if width == 3:
        add_tiles_quadratic(b, sources, tiles, values_out)
    else:
        add_tiles_cubic(b, sources, tiles, values_out)


@wp.func
def vector_at(values: wp.array[wp.vec4], n: int) -> wp.vec3:
    value = values[n]
    return wp.vec3(value[0], value[1], value[2])


@wp.func
def four(v: wp.vec3, last: float) -> wp.vec4:
    return wp.vec4(v[0], v[1], v[2], last)


@wp.func
def dot_wide(a: wp.vec3, b: wp.vec3) -> wp.float64:
    return (
        wp.float64(a[0]) * wp.float64(b[0])
        + wp.float64(a[1]) * wp.float64(b[1])
        + wp.float64(a[2]) * wp.float64(b[2])
    )


@wp.func
def project(projectors: wp.array[wp.mat33], n: int, v: wp.vec3) -> wp.vec3:
    """The part of v in the directions in which node n is free."""
    if projectors.shape[0] > 0:
        return projectors[n] * v
    return v


# ---- the function and its gradient ----


@wp.kernel
def inertia_energy(
    start: int,
    # In:
    per: int,
    values: wp.array[wp.vec4],
    target: wp.array[wp.vec4],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """m/2 |v - target|^2, J."""
    b = start + wp.tid()
    total = wp.float64(0.0)
    for k in range(per):
        n = per * b + k
        difference = vector_at(values, n) - vector_at(target, n)
        total += wp.float64(0.5) * wp.float64(target[n][3]) * dot_wide(difference, difference)
    energy_out[b] = total


@wp.kernel
def residual(
    start: int,
    # In:
    values: wp.array[wp.vec4],
    target: wp.array[wp.vec4],
    force: wp.array[wp.vec4],
    projectors: wp.array[wp.mat33],
    # Out:
    residual_out: wp.array[wp.vec4],
):
    """Minus the gradient in free directions, kg m/s; `force` is the particles' part of it."""
    n = start + wp.tid()
    mass = target[n][3]
    r = mass * (vector_at(target, n) - vector_at(values, n)) - vector_at(force, n)
    if mass == 0.0:
        r = wp.vec3()
    residual_out[n] = four(project(projectors, n, r), 0.0)


@wp.kernel
def invert_blocks(
    start: int,
    # In:
    target: wp.array[wp.vec4],
    diagonal: wp.array[wp.vec4],
    off_diagonal: wp.array[wp.vec4],
    projectors: wp.array[wp.mat33],
    # Out:
    inverse_out: wp.array[wp.mat33],
):
    """Inverse of mass and stiffness of each node in its free directions; zero without mass."""
    n = start + wp.tid()
    mass = target[n][3]
    inverse = wp.mat33()
    if mass > 0.0:
        d = diagonal[n]
        o = off_diagonal[n]
        # fmt: off
        K = wp.mat33(
            mass + d[0], o[0], o[1],
            o[0], mass + d[1], o[2],
            o[1], o[2], mass + d[2],
        )
        # fmt: on
        if projectors.shape[0] > 0:
            Q = projectors[n]
            held = (wp.trace(K) / 3.0) * (wp.identity(n=3, dtype=float) - Q)
            inverse = Q * wp.inverse(Q * K * Q + held) * Q
        else:
            inverse = wp.inverse(K)
        inverse = 0.5 * (inverse + wp.transpose(inverse))
    inverse_out[n] = inverse


# ---- conjugate gradients ----


@wp.kernel
def cg_reset(
    start: int,
    # In:
    per: int,
    right_hand_side: wp.array[wp.vec4],
    inverse: wp.array[wp.mat33],
    # Out:
    x_out: wp.array[wp.vec4],
    r_out: wp.array[wp.vec4],
    z_out: wp.array[wp.vec4],
    p_out: wp.array[wp.vec4],
    dots_out: wp.array[wp.float64],
):
    """x = p = 0, r = right-hand side, z = M^-1 r, and r.z."""
    b = start + wp.tid()
    total = wp.float64(0.0)
    for k in range(per):
        n = per * b + k
        r = vector_at(right_hand_side, n)
        z = inverse[n] * r
        x_out[n] = wp.vec4()
        p_out[n] = wp.vec4()
        r_out[n] = four(r, 0.0)
        z_out[n] = four(z, 0.0)
        total += dot_wide(r, z)
    dots_out[b] = total


@wp.kernel
def cg_direction(
    start: int,
    # In:
    z: wp.array[wp.vec4],
    scalars: wp.array[wp.float64],
    # Out:
    p_out: wp.array[wp.vec4],
):
    """p = z + beta p"""
    n = start + wp.tid()
    p_out[n] = z[n] + float(scalars[CG_BETA]) * p_out[n]


@wp.func
def finish_product(
    b: int,
    per: int,
    target: wp.array[wp.vec4],
    projectors: wp.array[wp.mat33],
    p: wp.array[wp.vec4],
    q_out: wp.array[wp.vec4],
) -> wp.float64:
    total = wp.float64(0.0)
    for k in range(per):
        n = per * b + k
        v = vector_at(p, n)
        q = wp.vec3()
        if target[n][3] > 0.0:
            q = project(projectors, n, target[n][3] * v + vector_at(q_out, n))
        q_out[n] = four(q, 0.0)
        total += dot_wide(v, q)
    return total


@wp.kernel
def cg_product_of_tiles(
    start: int,
    # In:
    width: int,
    sources: wp.array[int],
    tiles: wp.array[wp.vec4],
    target: wp.array[wp.vec4],
    projectors: wp.array[wp.mat33],
    p: wp.array[wp.vec4],
    # Out:
    q_out: wp.array[wp.vec4],
    dots_out: wp.array[wp.float64],
):
    """q = (mass + stiffness) p in free directions, and p.q; the particles' part stands in tiles. CPU."""
    b = start + wp.tid()
    if width == 3:
        add_tiles_quadratic(b, sources, tiles, q_out)
    else:
        add_tiles_cubic(b, sources, tiles, q_out)
    dots_out[b] = finish_product(b, 64, target, projectors, p, q_out)


@wp.kernel
def cg_product(
    start: int,
    # In:
    target: wp.array[wp.vec4],
    projectors: wp.array[wp.mat33],
    p: wp.array[wp.vec4],
    # Out:
    q_out: wp.array[wp.vec4],
    dots_out: wp.array[wp.float64],
):
    """The same where the particles' part stands in `q_out` already. GPU."""
    n = start + wp.tid()
    dots_out[n] = finish_product(n, 1, target, projectors, p, q_out)


@wp.kernel
def cg_update(
    start: int,
    # In:
    per: int,
    p: wp.array[wp.vec4],
    q: wp.array[wp.vec4],
    inverse: wp.array[wp.mat33],
    scalars: wp.array[wp.float64],
    # Out:
    x_out: wp.array[wp.vec4],
    r_out: wp.array[wp.vec4],
    z_out: wp.array[wp.vec4],
    dots_out: wp.array[wp.float64],
):
    """x += alpha p, r -= alpha q, z = M^-1 r, and r.z."""
    b = start + wp.tid()
    alpha = float(scalars[CG_ALPHA])
    total = wp.float64(0.0)
    for k in range(per):
        n = per * b + k
        x_out[n] = x_out[n] + alpha * p[n]
        r = vector_at(r_out, n) - alpha * vector_at(q, n)
        z = inverse[n] * r
        r_out[n] = four(r, 0.0)
        z_out[n] = four(z, 0.0)
        total += dot_wide(r, z)
    dots_out[b] = total


# ---- steps ----


@wp.kernel
def step_measures(
    start: int,
    # In:
    count: int,
    ranges: int,
    full: float,
    step: wp.array[wp.vec4],
    right_hand_side: wp.array[wp.vec4],
    target: wp.array[wp.vec4],
    # Out:
    slopes_out: wp.array[wp.float64],
    moves_out: wp.array[wp.float64],
):
    """Slope of E along `step`, J, and its largest square, m^2/s^2, as if a node had the mass `full`."""
    i = start + wp.tid()
    bounds = block_range(count, ranges, i)
    slope = wp.float64(0.0)
    largest = wp.float64(0.0)
    for n in range(bounds[0], bounds[1]):
        v = vector_at(step, n)
        slope -= dot_wide(v, vector_at(right_hand_side, n))
        square = wp.float64(target[n][3] / full) * dot_wide(v, v)
        # Numbers that are not finite stay.
        if not (square <= largest):
            largest = square
    slopes_out[i] = slope
    moves_out[i] = largest


@wp.kernel
def combine(
    start: int,
    # In:
    a: wp.array[wp.vec4],
    weight: float,
    b: wp.array[wp.vec4],
    # Out:
    out: wp.array[wp.vec4],
):
    """a + weight b of the vectors, with the fourth numbers of a."""
    n = start + wp.tid()
    out[n] = four(vector_at(a, n) + weight * vector_at(b, n), a[n][3])


@wp.kernel
def fill(
    start: int,
    # In:
    v: wp.vec3,
    weight: float,
    target: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """v + weight target where there is mass, with the mass; nothing elsewhere."""
    n = start + wp.tid()
    mass = target[n][3]
    values_out[n] = wp.vec4()
    if mass > 0.0:
        values_out[n] = four(v + weight * vector_at(target, n), mass)


@wp.kernel
def deficit(
    start: int,
    # In:
    count: int,
    ranges: int,
    momentum: wp.array[wp.vec4],
    values: wp.array[wp.vec4],
    # Out:
    deficit_out: wp.array[wp.vec3d],
):
    """Momentum that the nodes should have and have not, kg m/s."""
    i = start + wp.tid()
    bounds = block_range(count, ranges, i)
    total = wp.vec3d()
    for n in range(bounds[0], bounds[1]):
        missing = vector_at(momentum, n) - vector_at(values, n)
        total += wp.float64(momentum[n][3]) * wp.vec3d(
            wp.float64(missing[0]), wp.float64(missing[1]), wp.float64(missing[2])
        )
    deficit_out[i] = total


@wp.kernel
def shift(start: int, v: wp.vec3, values_out: wp.array[wp.vec4]):
    """Adds v to the velocity of nodes that have mass."""
    n = start + wp.tid()
    if values_out[n][3] > 0.0:
        values_out[n] = four(vector_at(values_out, n) + v, values_out[n][3])


# ---- boundaries ----


@wp.kernel
def unbounded(
    start: int,
    # In:
    momentum: wp.array[wp.vec4],
    force: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """Velocities that momentum and forces alone lead to: u."""
    n = start + wp.tid()
    value = momentum[n]
    values_out[n] = value
    if value[3] > 0.0:
        values_out[n] = four(vector_at(momentum, n) - vector_at(force, n) / value[3], value[3])


@wp.func
def probe_of(k: int, u: wp.vec3, bounded: wp.vec3, scale: float) -> float:
    """Change of component k of u, further into what the boundary resists."""
    size = PROBE * wp.max(wp.length(u), scale)
    if bounded[k] > u[k]:
        return -size
    return size


@wp.kernel
def probe(
    start: int,
    # In:
    k: int,
    scale: float,
    u: wp.array[wp.vec4],
    bounded: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """u with component k changed. scale: least velocity to be taken for large, m/s."""
    n = start + wp.tid()
    v = vector_at(u, n)
    v[k] = v[k] + probe_of(k, v, vector_at(bounded, n), scale)
    values_out[n] = four(v, u[n][3])


@wp.kernel
def differentiate(
    start: int,
    # In:
    k: int,
    scale: float,
    u: wp.array[wp.vec4],
    bounded: wp.array[wp.vec4],
    probed: wp.array[wp.vec4],
    # Out:
    jacobian_out: wp.array[wp.mat33],
):
    """Column k of the boundaries' derivative."""
    n = start + wp.tid()
    at = vector_at(bounded, n)
    change = (vector_at(probed, n) - at) / probe_of(k, vector_at(u, n), at, scale)
    J = jacobian_out[n]
    for i in range(3):
        J[i, k] = change[i]
    jacobian_out[n] = J


@wp.kernel
def constrain(
    start: int,
    # In:
    u: wp.array[wp.vec4],
    bounded: wp.array[wp.vec4],
    momentum: wp.array[wp.vec4],
    # Out:
    projectors_out: wp.array[wp.mat33],
    held_out: wp.array[wp.vec4],
    target_out: wp.array[wp.vec4],
):
    """Projectors from the derivatives that stand in their place, what nodes are held at, and targets."""
    n = start + wp.tid()
    J = wp.mat33d(projectors_out[n])
    values, vectors = eigen_symmetric(J * wp.transpose(J))
    Q = wp.mat33d()
    for k in range(3):
        if values[k] > FREE:
            axis = wp.vec3d(vectors[0, k], vectors[1, k], vectors[2, k])
            Q += wp.outer(axis, axis)
    if values[0] > FREE and values[1] > FREE and values[2] > FREE:
        Q = wp.identity(n=3, dtype=wp.float64)
    free = wp.mat33(Q)
    to = vector_at(bounded, n)
    projectors_out[n] = free
    held_out[n] = four(to - free * to, 0.0)
    target_out[n] = four(vector_at(momentum, n) + free * (to - vector_at(u, n)), momentum[n][3])


@wp.kernel
def hold(
    start: int,
    # In:
    count: int,
    ranges: int,
    full: float,
    projectors: wp.array[wp.mat33],
    held: wp.array[wp.vec4],
    target: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
    moves_out: wp.array[wp.float64],
):
    """Q v + held; the largest square of what that changes, as in `step_measures`."""
    i = start + wp.tid()
    bounds = block_range(count, ranges, i)
    largest = wp.float64(0.0)
    for n in range(bounds[0], bounds[1]):
        before = vector_at(values_out, n)
        after = projectors[n] * before + vector_at(held, n)
        values_out[n] = four(after, values_out[n][3])
        square = wp.float64(target[n][3] / full) * dot_wide(after - before, after - before)
        if not (square <= largest):
            largest = square
    moves_out[i] = largest
