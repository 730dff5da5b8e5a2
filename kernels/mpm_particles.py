"""MPM transfers one particle at a time, with atomic additions: for a GPU; on a CPU for one thread alone.

See `gdpro_sim.kernels.mpm_transfer` for what they compute and how the grid is laid out.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.mpm_transfer import BLOCK, STRAY
from gdpro_sim.kernels.particles import (
    AFFINE,
    DEFORMATION,
    DEFORMATION_LOW,
    DENSITY,
    MASS,
    POSITION,
    POSITION_LOW,
    SLOPE,
    STRESS,
    TOTAL,
    VELOCITY,
    read_matrix,
    read_vector,
    write_matrix,
    write_vector,
)

wp.set_module_options({"enable_backward": False})

Weights = wp.types.matrix(shape=(3, 4), dtype=wp.float32)


@wp.func
def spline_weights(x: wp.vec3, inverse: float, width: int):
    """(first node, way to the particle from it in cells, weights [axis, node])."""
    base = wp.vec3i()
    f = wp.vec3()
    w = Weights()
    for a in range(3):
        u = x[a] * inverse
        if width == 3:
            first = wp.floor(u - 0.5)
            t = u - first
            base[a] = int(first)
            f[a] = t
            w[a, 0] = 0.5 * (1.5 - t) * (1.5 - t)
            w[a, 1] = 0.75 - (t - 1.0) * (t - 1.0)
            w[a, 2] = 0.5 * (t - 0.5) * (t - 0.5)
        else:
            first = wp.floor(u) - 1.0
            t = u - first
            base[a] = int(first)
            f[a] = t
            left = 2.0 - t
            right = t - 1.0
            w[a, 0] = left * left * left / 6.0
            w[a, 3] = right * right * right / 6.0
            w[a, 2] = (0.5 * left - 1.0) * left * left + 2.0 / 3.0
            w[a, 1] = ((1.0 - w[a, 0]) - w[a, 3]) - w[a, 2]
    return base, f, w


@wp.func
def node_index(neighbors: wp.array[int], block: int, local: wp.vec3i) -> int:
    """Number of the node `local`, counted from the first of a block of particles, in the grid's arrays."""
    beside = wp.vec3i()
    for a in range(3):
        beside[a] = 1
        if local[a] < 0:
            beside[a] = 0
        elif local[a] >= BLOCK:
            beside[a] = 2
    grid = neighbors[27 * block + 9 * beside[0] + 3 * beside[1] + beside[2]]
    return 64 * grid + 16 * (local[0] & 3) + 4 * (local[1] & 3) + (local[2] & 3)


@wp.kernel
def scatter_particles(
    start: int,
    # In:
    width: int,
    h: float,
    spacing: float,
    affine: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    particles: wp.array2d[float],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """`scatter_blocks`, added to the grid itself. GPU; on a CPU for one thread alone.

    owners: [N] block of each particle
    """
    i = start + wp.tid()
    base, f, w = spline_weights(read_vector(particles, POSITION, i), 1.0 / spacing, width)
    block = owners[i]
    first = base - BLOCK * coords[block]
    pull = -h * 4.0 / (spacing * spacing)
    if width == 4:
        pull = -h * 3.0 / (spacing * spacing)
    tau = wp.mat33(
        particles[STRESS, i],
        particles[STRESS + 3, i],
        particles[STRESS + 4, i],
        particles[STRESS + 3, i],
        particles[STRESS + 1, i],
        particles[STRESS + 5, i],
        particles[STRESS + 4, i],
        particles[STRESS + 5, i],
        particles[STRESS + 2, i],
    )
    m = particles[MASS, i]
    per_cell = (affine * m * read_matrix(particles, AFFINE, i) + pull * tau) * spacing
    momentum = m * read_vector(particles, VELOCITY, i) - per_cell * f
    for a in range(width):
        for b in range(width):
            for c in range(width):
                weight = w[0, a] * w[1, b] * w[2, c]
                p = weight * (momentum + per_cell * wp.vec3(float(a), float(b), float(c)))
                node = node_index(neighbors, block, first + wp.vec3i(a, b, c))
                wp.atomic_add(values_out, node, wp.vec4(p[0], p[1], p[2], weight * m))


@wp.func
def add_compensated(more: wp.float32, high: int, low: int, i: int, particles: wp.array2d[float]):
    """Adds to a number and keeps what rounding cuts off (Kahan)."""
    before = particles[high, i]
    y = more + particles[low, i]
    after = before + y
    particles[high, i] = after
    particles[low, i] = y - (after - before)


@wp.kernel
def gather_particles(
    start: int,
    # In:
    width: int,
    h: float,
    spacing: float,
    flip: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    # Out:
    particles_out: wp.array2d[float],
    strayed_out: wp.array[int],
):
    """`gather_blocks`, one particle at a time."""
    i = start + wp.tid()
    inverse = 1.0 / spacing
    base, f, w = spline_weights(read_vector(particles_out, POSITION, i), inverse, width)
    block = owners[i]
    corner = BLOCK * coords[block]
    v = wp.vec3()
    mass = float(0.0)
    moment = wp.mat33()
    lean = wp.vec3()
    for a in range(width):
        for b in range(width):
            for c in range(width):
                value = values[node_index(neighbors, block, base - corner + wp.vec3i(a, b, c))]
                weight = w[0, a] * w[1, b] * w[2, c]
                part = weight * wp.vec3(value[0], value[1], value[2])
                v += part
                mass += weight * value[3]
                way = wp.vec3(float(a), float(b), float(c)) - f
                moment += wp.outer(part, way)
                lean += weight * value[3] * way
    scale = 4.0 * inverse
    if width == 4:
        scale = 3.0 * inverse
    C = scale * moment
    for k in range(3):
        add_compensated(h * v[k], POSITION + k, POSITION_LOW + k, i, particles_out)
    own = read_vector(particles_out, VELOCITY, i)
    write_vector(flip * own + (1.0 - flip) * v, VELOCITY, i, particles_out)
    write_matrix(C, AFFINE, i, particles_out)
    more = h * (C * read_matrix(particles_out, DEFORMATION, i))
    for k in range(9):
        add_compensated(more[k // 3, k % 3], DEFORMATION + k, DEFORMATION_LOW + k, i, particles_out)
    if particles_out.shape[0] > TOTAL:
        total = read_matrix(particles_out, TOTAL, i)
        write_matrix(total + h * (C * total), TOTAL, i, particles_out)
        per_cell = inverse * inverse * inverse
        particles_out[DENSITY, i] = mass * per_cell
        particles_out[SLOPE, i] = scale * spacing * wp.length(lean) * per_cell
    x = read_vector(particles_out, POSITION, i)
    for k in range(3):
        u = x[k] * inverse
        first = wp.floor(u) - 1.0
        if width == 3:
            first = wp.floor(u - 0.5)
        local = first - float(corner[k])
        if not (local >= float(-STRAY) and local <= float(BLOCK - 1 + STRAY)):
            strayed_out[block] = 1


@wp.kernel
def add_change_particles(
    start: int,
    # In:
    width: int,
    spacing: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    change: wp.array[wp.vec4],
    # Out:
    particles_out: wp.array2d[float],
):
    """`add_change_blocks`, one particle at a time."""
    i = start + wp.tid()
    base, _f, w = spline_weights(read_vector(particles_out, POSITION, i), 1.0 / spacing, width)
    block = owners[i]
    first = base - BLOCK * coords[block]
    v = read_vector(particles_out, VELOCITY, i)
    for a in range(width):
        for b in range(width):
            for c in range(width):
                value = change[node_index(neighbors, block, first + wp.vec3i(a, b, c))]
                v += w[0, a] * w[1, b] * w[2, c] * wp.vec3(value[0], value[1], value[2])
    write_vector(v, VELOCITY, i, particles_out)
