"""Gaps between MPM matter and obstacles, at the nodes near both; see `gdpro_sim.kernels.mpm_boundary`."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.colliders import PLANE, Collider
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_boundary import (
    ABSENT,
    FAR,
    KIND,
    ORIGIN,
    ROTATION,
    distance_to,
    node_position,
    row_matrix,
    row_vector,
)
from gdpro_sim.kernels.mpm_transfer import BLOCK, STRAY
from gdpro_sim.kernels.particles import POSITION, read_vector

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

OUTSIDE = wp.constant(0.5)
"""Cells outside an obstacle up to which nodes meet it."""


@wp.kernel
def measure_blocks(
    start: int,
    # In:
    c: int,
    middle: wp.float64,
    shape: Collider,
    table: wp.array2d[wp.float64],
    spacing: wp.float64,
    blocks: wp.array[wp.vec3i],
    # Out:
    distance_out: wp.array[wp.float64],
):
    """Signed distance to obstacle c, m, of each block's middle, `middle` cells from its first node."""
    b = start + wp.tid()
    half = middle * spacing
    x = node_position(blocks[b], 0, spacing) + wp.vec3d(half, half, half)
    distance, _normal = distance_to(shape, table, c, x)
    distance_out[b] = distance


@wp.kernel
def measure_nodes(
    start: int,
    # In:
    c: int,
    first: int,
    shape: Collider,
    table: wp.array2d[wp.float64],
    spacing: wp.float64,
    blocks: wp.array[wp.vec3i],
    block_of_pair: wp.array[int],
    # Out:
    field_out: wp.array[wp.vec4],
):
    """(outward normal, signed distance m) at each node of the pairs of obstacle c, from pair `first` on."""
    i = start + wp.tid()
    pair = first + i // 64
    n = i % 64
    x = node_position(blocks[block_of_pair[pair]], n, spacing)
    distance, normal = distance_to(shape, table, c, x)
    field_out[64 * pair + n] = wp.vec4(float(normal[0]), float(normal[1]), float(normal[2]), float(distance))


@wp.func
def distance_between(
    x: wp.vec3,
    inverse: float,
    corner: wp.vec3i,
    tile: int,
    around: wp.array[int],
    field: wp.array[wp.vec4],
) -> float:
    """Signed distance of a point to a tile's obstacle, m, linear between nodes; FAR where those know none.

    corner: first node of the tile's block
    """
    u = inverse * x
    cell = wp.vec3i(int(wp.floor(u[0])), int(wp.floor(u[1])), int(wp.floor(u[2])))
    t = u - wp.vec3(float(cell[0]), float(cell[1]), float(cell[2]))
    first = cell - corner
    distance = float(0.0)
    for a in range(2):
        for b in range(2):
            for c in range(2):
                local = first + wp.vec3i(a, b, c)
                o = 9 * wp.clamp((local[0] >> 2) + 1, 0, 2)
                o += 3 * wp.clamp((local[1] >> 2) + 1, 0, 2) + wp.clamp((local[2] >> 2) + 1, 0, 2)
                pair = around[27 * tile + o]
                if pair < 0:
                    return FAR
                n = 16 * (local[0] & 3) + 4 * (local[1] & 3) + (local[2] & 3)
                weight = wp.abs(1.0 - float(a) - t[0]) * wp.abs(1.0 - float(b) - t[1])
                distance += weight * wp.abs(1.0 - float(c) - t[2]) * field[64 * pair + n][3]
    return distance


@wp.func
def side_of_tile(width: int) -> int:
    """Nodes along each axis that a block's particles reach, those that have strayed too."""
    return BLOCK - 1 + width + 2 * STRAY


_LOWER = """
    const float step = 1.0f / spacing, half = width == 3 ? 0.5f : 1.0f;
    int first = 0;
    for (int a = 0; a < 3; ++a) {
        int local = (int)floorf(x[a] * step - half) - corner[a] + {STRAY};
        local = local < 0 ? 0 : local > side - width ? side - width : local;
        first = first * side + local;
    }
    float* const t = tile + first;
    #define LOWER(W) for (int a = 0; a < W; ++a) for (int b = 0; b < W; ++b) for (int c = 0; c < W; ++c) { \\
        float* const node = t + (a * side + b) * side + c; *node = *node < gap ? *node : gap; }
    if (width == 3) { LOWER(3) } else { LOWER(4) }
    #undef LOWER
""".replace("{STRAY}", str(STRAY))

_PLANE = """
    const size_t N = particles.shape[1];
    const float *const X = particles.data + {POSITION} * N, *const Y = X + N, *const Z = Y + N;
    float* const tile = tiles.data + (size_t)room * q;
    int near = 0;
    for (int i = begin; i < end; ++i) {
        const float gap = normal[0] * X[i] + normal[1] * Y[i] + normal[2] * Z[i] - level;
        if (gap >= seen) continue;
        if (!near) for (int n = 0; n < room; ++n) tile[n] = 1.0e30f;
        near = 1;
        const float x[3] = {X[i], Y[i], Z[i]};
        {LOWER}
    }
    return near;
""".replace("{LOWER}", _LOWER).replace("{POSITION}", str(POSITION))


@wp.func_native(_PLANE)
def plane_gaps(
    q: int,
    begin: int,
    end: int,
    normal: wp.vec3,
    level: float,
    seen: float,
    spacing: float,
    corner: wp.vec3i,
    side: int,
    width: int,
    room: int,
    particles: wp.array2d[float],
    tiles: wp.array[float],
) -> int:
    """Gaps of particles begin .. end - 1 above a plane into tile q; returns 0 where none is seen."""
    ...


@wp.func_native(
    """
    float* const tile = tiles.data + (size_t)room * q;
    if (!near) for (int n = 0; n < room; ++n) tile[n] = 1.0e30f;
"""
    + _LOWER
)
def lower_tile(
    q: int,
    near: int,
    x: wp.vec3,
    gap: float,
    spacing: float,
    corner: wp.vec3i,
    side: int,
    width: int,
    room: int,
    tiles: wp.array[float],
):
    """Notes the gap of a particle at x at the nodes that it reaches; the tile is new where none is near."""
    ...


@wp.kernel
def find_gaps(
    start: int,
    # In:
    width: int,
    spacing: float,
    radius: float,
    seen: float,
    owner: wp.array[int],
    block: wp.array[int],
    around: wp.array[int],
    shape: wp.array[int],
    table: wp.array2d[wp.float64],
    field: wp.array[wp.vec4],
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    # Out:
    seen_out: wp.array[int],
    tiles_out: wp.array[float],
):
    """Smallest gap between an obstacle and the particles of a block, at each node that these reach, m.

    radius: m, of a particle; seen: m, gaps wider than that do not count
    owner:  [Q] obstacle of each tile; block: [Q] its block of particles
    around: [27 Q] the pair of each block of nodes beside it; -1 where it is too far away
    shape:  [C] kind of each obstacle's shape
    seen_out: [Q] 0 where there is no gap narrow enough, and the tile is not written
    """
    q = start + wp.tid()
    c = owner[q]
    b = block[q]
    side = side_of_tile(width)
    room = side * side * side
    corner = BLOCK * coords[b]
    near = int(0)
    if int(table[c, KIND]) != ABSENT:
        if shape[c] == PLANE:
            rotation = row_matrix(table, c, ROTATION)
            up = wp.vec3d(rotation[0, 2], rotation[1, 2], rotation[2, 2])
            normal = wp.vec3(float(up[0]), float(up[1]), float(up[2]))
            level = float(wp.dot(up, row_vector(table, c, ORIGIN))) + radius
            near = plane_gaps(
                q,
                starts[b],
                starts[b + 1],
                normal,
                level,
                seen,
                spacing,
                corner,
                side,
                width,
                room,
                particles,
                tiles_out,
            )
        else:
            for i in range(starts[b], starts[b + 1]):
                x = read_vector(particles, POSITION, i)
                gap = distance_between(x, 1.0 / spacing, corner, q, around, field) - radius
                if gap < seen:
                    lower_tile(q, near, x, gap, spacing, corner, side, width, room, tiles_out)
                    near = 1
    seen_out[q] = near


_GATHER = """
    const int room = side * side * side;
    float* const gap = gaps.data + 64 * (size_t)pair;
    const float* const node_field = (const float*)(field.data + 64 * (size_t)pair);
    int met = 0;
    for (int n = 0; n < 64; ++n) gap[n] = 1.0e30f;
    for (int o = 0; o < 27; ++o) {
        const int q = tile.data[27 * (size_t)pair + o];
        if (q < 0 || !seen.data[q]) continue;
        // Node n of this block is number n + shift of the tile, where it has as many.
        int low[3], high[3], shift[3];
        const int offset[3] = {o / 9 - 1, o / 3 % 3 - 1, o % 3 - 1};
        for (int a = 0; a < 3; ++a) {
            shift[a] = {STRAY} - {BLOCK} * offset[a];
            low[a] = shift[a] < 0 ? -shift[a] : 0;
            high[a] = side - shift[a] < {BLOCK} ? side - shift[a] : {BLOCK};
        }
        for (int i = low[0]; i < high[0]; ++i)
            for (int j = low[1]; j < high[1]; ++j) {
                const float* const line = tiles.data + (size_t)room * q
                    + ((i + shift[0]) * side + j + shift[1]) * side + shift[2];
                for (int k = low[2]; k < high[2]; ++k) {
                    const float g = line[k];
                    float* const node = gap + 16 * i + 4 * j + k;
                    *node = *node < g ? *node : g;
                }
            }
        met = 1;
    }
    if (met) {
        met = 0;
        for (int n = 0; n < 64; ++n) {
            if (node_field[4 * n + 3] > reach) gap[n] = 1.0e30f;
            met |= gap[n] < 1.0e30f;
        }
    }
    return met;
""".replace("{STRAY}", str(STRAY)).replace("{BLOCK}", str(BLOCK))


@wp.func_native(_GATHER)
def gather_pair(
    pair: int,
    side: int,
    reach: float,
    tile: wp.array[int],
    seen: wp.array[int],
    tiles: wp.array[float],
    field: wp.array[wp.vec4],
    gaps: wp.array[float],
) -> int:
    """Gaps of one pair; returns 0 where there are none."""
    ...


@wp.kernel
def gather_gaps(
    start: int,
    # In:
    width: int,
    spacing: float,
    tile: wp.array[int],
    seen: wp.array[int],
    tiles: wp.array[float],
    field: wp.array[wp.vec4],
    # Out:
    met_out: wp.array[int],
    gap_out: wp.array[float],
):
    """The smallest of all tiles at each node of each pair, m; FAR where no matter or obstacle is near.

    tile:    [27 P] of the block of particles at each offset, in the order of `Grid.sources`; -1 for none
    met_out: [P] 0 where all are FAR
    """
    pair = start + wp.tid()
    side = side_of_tile(width)
    met_out[pair] = gather_pair(pair, side, OUTSIDE * spacing, tile, seen, tiles, field, gap_out)
