"""The MPM grid: tiles added up, momentum into velocity, and where particles belong."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_transfer import BLOCK, STRAY, tile_nodes, tile_width
from gdpro_sim.kernels.particles import POSITION

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


def sum_of_tiles(width: int, each: str) -> str:
    """Text that sums the tiles over one grid block, and writes what `each` makes, `v`, of `sum[n]`."""
    return f"""
#if !defined(__CUDACC__)
    typedef float Q __attribute__((ext_vector_type(4)));
    const int TILE = {tile_width(width)}, NODES = {tile_nodes(width)};
    Q sum[64];
    for (int n = 0; n < 64; ++n) sum[n] = (Q)0.0f;
    for (int o = 0; o < 27; ++o) {{
        const int source = sources.data[27 * (size_t)block + o];
        if (source < 0) continue;
        // Node n of this block is number n - 4 offset + {STRAY} of the tile, where it has as many.
        int low[3], high[3], shift[3];
        const int offset[3] = {{o / 9 - 1, o / 3 % 3 - 1, o % 3 - 1}};
        for (int a = 0; a < 3; ++a) {{
            shift[a] = {STRAY} - {BLOCK} * offset[a];
            low[a] = shift[a] < 0 ? -shift[a] : 0;
            high[a] = TILE - shift[a] < {BLOCK} ? TILE - shift[a] : {BLOCK};
        }}
        const float* const tile = (const float*)(tiles.data + (size_t)source * NODES);
        for (int i = low[0]; i < high[0]; ++i)
            for (int j = low[1]; j < high[1]; ++j) {{
                const float* const line
                    = tile + 4 * (((i + shift[0]) * TILE + j + shift[1]) * TILE + shift[2]);
                for (int k = low[2]; k < high[2]; ++k) {{
                    Q node;
                    __builtin_memcpy(&node, line + 4 * k, 16);
                    sum[16 * i + 4 * j + k] += node;
                }}
            }}
    }}
    float* const out = (float*)(values_out.data + 64 * (size_t)block);
    for (int n = 0; n < 64; ++n) {{
        {each}
        __builtin_memcpy(out + 4 * n, &v, 16);
    }}
#endif
"""


_VELOCITY = """
        const float mass = sum[n][3];
        Q v = (Q)0.0f;
        if (mass > 0.0f) {
            v = sum[n] / mass;
            v[0] += change[0];
            v[1] += change[1];
            v[2] += change[2];
            v[3] = mass;
        }
"""


@wp.func_native(sum_of_tiles(3, _VELOCITY))
def sum_tiles_quadratic(
    block: int,
    change: wp.vec3,
    sources: wp.array[int],
    tiles: wp.array[wp.vec4],
    values_out: wp.array[wp.vec4],
):
    """Velocity and mass of one grid block."""
    ...


@wp.func_native(sum_of_tiles(4, _VELOCITY))
def sum_tiles_cubic(
    block: int,
    change: wp.vec3,
    sources: wp.array[int],
    tiles: wp.array[wp.vec4],
    values_out: wp.array[wp.vec4],
):
    """Velocity and mass of one grid block."""
    ...


@wp.kernel
def sum_tiles(
    start: int,
    # In:
    width: int,
    change: wp.vec3,
    sources: wp.array[int],
    tiles: wp.array[wp.vec4],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """Velocity, m/s, and mass, kg, of the 64 nodes of each grid block; 0 where there is no mass. CPU.

    change:  m/s, what gravity adds
    sources: [27 G] the block of particles at each offset, in the order of `neighbors`; -1 where there is none
    """
    b = start + wp.tid()
    if width == 3:
        sum_tiles_quadratic(b, change, sources, tiles, values_out)
    else:
        sum_tiles_cubic(b, change, sources, tiles, values_out)


@wp.kernel
def momentum_to_velocity(start: int, change: wp.vec3, values_out: wp.array[wp.vec4]):
    """The same of sums that stand in the grid already, node by node. GPU."""
    n = start + wp.tid()
    value = values_out[n]
    if value[3] > 0.0:
        v = wp.vec3(value[0], value[1], value[2]) / value[3] + change
        values_out[n] = wp.vec4(v[0], v[1], v[2], value[3])


@wp.kernel
def change_of_velocity(
    start: int,
    # In:
    values: wp.array[wp.vec4],
    # Out:
    change_out: wp.array[wp.vec4],
):
    """What forces and boundaries did to each node's velocity; `change_out` holds what it was before."""
    n = start + wp.tid()
    change_out[n] = values[n] - change_out[n]


@wp.kernel
def block_of_particles(
    start: int,
    # In:
    width: int,
    inverse: float,
    low: wp.vec3i,
    size: wp.vec3i,
    particles: wp.array2d[float],
    # Out:
    block_out: wp.array[int],
):
    """Number of the block that each particle's first node is in, in a box of `size` blocks from `low` on."""
    i = start + wp.tid()
    number = int(0)
    for a in range(3):
        u = particles[POSITION + a, i] * inverse
        first = wp.floor(u) - 1.0
        if width == 3:
            first = wp.floor(u - 0.5)
        number = number * size[a] + wp.clamp((int(first) >> 2) - low[a], 0, size[a] - 1)
    block_out[i] = number


@wp.func_native("""
#if !defined(__CUDACC__)
    const int count = (int)order.shape[0];
    const int* const __restrict from = order.data;
    const float* const __restrict in = particles.data + (size_t)row * particles.shape[1];
    float* const __restrict out = particles_out.data + (size_t)row * particles.shape[1];
    for (int i = 0; i < count; ++i) out[i] = in[from[i]];
#endif
""")
def permute_row(
    row: int, order: wp.array[int], particles: wp.array2d[float], particles_out: wp.array2d[float]
):
    """One row with number order[i] at place i."""
    ...


@wp.kernel
def permute_rows(
    start: int,
    # In:
    order: wp.array[int],
    particles: wp.array2d[float],
    # Out:
    particles_out: wp.array2d[float],
):
    """Each row with number order[i] at place i. CPU."""
    permute_row(start + wp.tid(), order, particles, particles_out)


@wp.kernel
def permute_particles(
    start: int,
    # In:
    order: wp.array[int],
    particles: wp.array2d[float],
    # Out:
    particles_out: wp.array2d[float],
):
    """The same, one particle at a time. GPU."""
    i = start + wp.tid()
    for r in range(particles.shape[0]):
        particles_out[r, i] = particles[r, order[i]]
