"""What holds or pushes MPM particles, and the nodes around them."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_boundary import (
    ABSENT,
    KIND,
    LINEAR,
    ORIGIN,
    ROTATION,
    SPIN,
    obstacle_velocity,
    row_matrix,
    row_vector,
)
from gdpro_sim.kernels.mpm_particles import spline_weights
from gdpro_sim.kernels.mpm_transfer import BLOCK
from gdpro_sim.kernels.particles import (
    AFFINE,
    MASS,
    POSITION,
    POSITION_LOW,
    VELOCITY,
    read_vector,
    write_matrix,
    write_vector,
)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.func
def add_share(
    i: int,
    width: int,
    inverse: float,
    block: wp.vec3i,
    slot: int,
    what: wp.vec4,
    particles: wp.array2d[float],
    sums: wp.array[wp.vec4],
):
    """Adds `what` times particle i's mass, by its weights, to those of its nodes that are in a block."""
    base, _f, w = spline_weights(read_vector(particles, POSITION, i), inverse, width)
    m = particles[MASS, i]
    for a in range(width):
        p = base[0] + a - BLOCK * block[0]
        if p >= 0 and p < BLOCK:
            for b in range(width):
                q = base[1] + b - BLOCK * block[1]
                if q >= 0 and q < BLOCK:
                    for c in range(width):
                        r = base[2] + c - BLOCK * block[2]
                        if r >= 0 and r < BLOCK:
                            sums[64 * slot + 16 * p + 4 * q + r] += (w[0, a] * w[1, b] * w[2, c] * m) * what


@wp.kernel
def mix_friction(
    start: int,
    # In:
    width: int,
    spacing: float,
    usual: float,
    near: wp.array[int],
    blocks: wp.array[wp.vec3i],
    sources: wp.array[int],
    starts: wp.array[int],
    of_matter: wp.array[float],
    matter: wp.array[int],
    particles: wp.array2d[float],
    # Out:
    sums_out: wp.array[wp.vec4],
    friction_out: wp.array[float],
):
    """Mean Coulomb coefficient of the particles at each node of some blocks, by mass; `usual` where none is.

    near:      [K] those blocks; sums_out: [64 K] 0 before
    of_matter: coefficient of each material
    """
    k = start + wp.tid()
    for o in range(27):
        source = sources[27 * near[k] + o]
        if source >= 0:
            for i in range(starts[source], starts[source + 1]):
                what = wp.vec4(of_matter[matter[i]], 0.0, 0.0, 1.0)
                add_share(i, width, 1.0 / spacing, blocks[near[k]], k, what, particles, sums_out)
    for n in range(64):
        mean = usual
        if sums_out[64 * k + n][3] > 0.0:
            mean = sums_out[64 * k + n][0] / sums_out[64 * k + n][3]
        friction_out[64 * k + n] = mean


@wp.kernel
def sum_held(
    start: int,
    # In:
    width: int,
    spacing: float,
    near: wp.array[int],
    blocks: wp.array[wp.vec3i],
    starts: wp.array[int],
    held: wp.array[int],
    hold: wp.array[int],
    table: wp.array2d[wp.float64],
    particles: wp.array2d[float],
    # Out:
    sums_out: wp.array[wp.vec4],
):
    """(momentum that held particles should have, their mass) at each node of the blocks that they reach.

    near:   [K] those blocks; starts: [K + 1] and held: particles that reach each; hold: which hold each is in
    table:  one row for each hold, as for obstacles
    """
    k = start + wp.tid()
    block = blocks[near[k]]
    for n in range(64):
        sums_out[64 * k + n] = wp.vec4()
    for j in range(starts[k], starts[k + 1]):
        c = hold[j]
        if int(table[c, KIND]) != ABSENT:
            i = held[j]
            x = read_vector(particles, POSITION, i)
            u = obstacle_velocity(table, c, wp.vec3d(wp.float64(x[0]), wp.float64(x[1]), wp.float64(x[2])))
            what = wp.vec4(u[0], u[1], u[2], 1.0)
            add_share(i, width, 1.0 / spacing, block, k, what, particles, sums_out)


HELD_SHARE = wp.constant(1.0 / 6.0)
"""Share of a node's mass from which on it moves with what is held.

A half-space that is held gives so much of the mass to a node half a cell outside: nodes nearer to the held
half than to the next node move with it."""


@wp.kernel
def move_held_nodes(
    start: int,
    # In:
    near: wp.array[int],
    sums: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """Nodes with enough held mass take its velocity."""
    i = start + wp.tid()
    node = 64 * near[i // 64] + i % 64
    mass = values_out[node][3]
    held = sums[i]
    if held[3] > HELD_SHARE * mass:
        values_out[node] = wp.vec4(held[0] / held[3], held[1] / held[3], held[2] / held[3], mass)


@wp.kernel
def move_held_particles(
    start: int,
    # In:
    h: wp.float64,
    place: wp.array[int],
    particle: wp.array[int],
    hold: wp.array[int],
    table: wp.array2d[wp.float64],
    # Out:
    particles_out: wp.array2d[float],
    anchor_out: wp.array[wp.vec3d],
):
    """Held particles go where their hold takes them; of those not held yet, or no more, notes where they are.

    place:    [N] where each particle stands; particle: [H] those that some hold is for
    hold:     [H] its row of `table`: the hold's frame when the substep begins, and how it moves
    anchor_out: [H] m, where the particle was in its hold's frame when it began
    """
    j = start + wp.tid()
    i = place[particle[j]]
    c = hold[j]
    origin = row_vector(table, c, ORIGIN)
    rotation = row_matrix(table, c, ROTATION)
    linear = row_vector(table, c, LINEAR)
    spin = row_matrix(table, c, SPIN)
    if int(table[c, KIND]) == ABSENT:
        x = wp.vec3d()
        for a in range(3):
            x[a] = wp.float64(particles_out[POSITION + a, i]) + wp.float64(particles_out[POSITION_LOW + a, i])
        turned = rotation + h * (spin * rotation)
        anchor_out[j] = wp.transpose(turned) * (x - (origin + h * linear))
    else:
        off = rotation * anchor_out[j]
        v = linear + spin * off
        x = origin + off + h * v
        for a in range(3):
            high = float(x[a])
            particles_out[POSITION + a, i] = high
            particles_out[POSITION_LOW + a, i] = float(x[a] - wp.float64(high))
        write_vector(wp.vec3(float(v[0]), float(v[1]), float(v[2])), VELOCITY, i, particles_out)
        C = wp.mat33()
        for a in range(9):
            C[a // 3, a % 3] = float(spin[a // 3, a % 3])
        write_matrix(C, AFFINE, i, particles_out)


@wp.kernel
def push_particles(
    start: int,
    # In:
    share: float,
    place: wp.array[int],
    particle: wp.array[int],
    change: wp.array[wp.vec3],
    # Out:
    particles_out: wp.array2d[float],
):
    """Adds `share` of a change to the velocity of each particle of a load.

    place: [N] where each particle stands; particle: [n] the load's; change: [n] m/s
    """
    j = start + wp.tid()
    i = place[particle[j]]
    v = read_vector(particles_out, VELOCITY, i) + share * change[j]
    write_vector(v, VELOCITY, i, particles_out)


_INSIDE = """
    const size_t N = particles.shape[1];
    for (int a = 0; a < 3; ++a) {
        float *const x = particles.data + ({POSITION} + a) * N, *const low_part = x + 3 * N;
        float* const v = particles.data + ({VELOCITY} + a) * N;
        int out = 0;
        for (int i = begin; i < end; ++i) out |= (x[i] < low[a]) | (x[i] > high[a]);
        if (!out) continue;
        for (int i = begin; i < end; ++i) {
            const bool below = x[i] < low[a], above = x[i] > high[a];
            if (!below && !above) continue;
            x[i] = below ? low[a] : high[a];
            low_part[i] = 0.0f;
            if (below == (v[i] < 0.0f)) v[i] = 0.0f;
        }
    }
""".replace("{POSITION}", str(POSITION)).replace("{VELOCITY}", str(VELOCITY))


@wp.func_native(_INSIDE)
def keep_range_inside(begin: int, end: int, low: wp.vec3, high: wp.vec3, particles: wp.array2d[float]):
    """Of particles begin .. end - 1."""
    ...


@wp.kernel
def keep_inside(
    start: int,
    # In:
    count: int,
    total: int,
    low: wp.vec3,
    high: wp.vec3,
    # Out:
    particles_out: wp.array2d[float],
):
    """Particles that have left a box are set on its wall, and go no farther: `count` at a time of `total`."""
    first = (start + wp.tid()) * count
    keep_range_inside(first, wp.min(first + count, total), low, high, particles_out)
