"""What stands in the way of the MPM grid: obstacles and held particles change velocities of nodes.

A node in or beside an obstacle, up to half a cell outside, has a velocity v, the obstacle there u, the
outward normal is n. The matter at the node is a gap away from the obstacle: that of the nearest particle
which the node's spline reaches, less the particle's radius. Of the relative velocity
r = v - u + s n, where s = gap / h is the speed at which the gap would close within the substep of length h
(or, where they overlap, a slow speed that takes matter out), is left

    sticky    0 where it touches or closes
    slip      r - (r.n) n where it touches or closes
    separate  r where the gap stays open, else the tangential part t = r - (r.n) n, shortened by Coulomb
              friction: t max(0, 1 + mu r.n / |t|)

(Stomakhin et al. 2013, "A material point method for snow simulation", ACM TOG 32(4), section 8). The gap
makes matter touch where the obstacle is, rather than at the first node inside it. A node in several obstacles
meets one after the other, again until nothing changes.

Obstacles stand in a table [C, COLUMNS] of float64, one row each:

    ORIGIN   3  m, of its frame in the world, when the substep begins
    ROTATION 9  of its frame, row by row
    LINEAR   3  m/s: a point x moves with LINEAR + SPIN (x - ORIGIN)
    SPIN     9  1/s, row by row
    KIND     1  ABSENT, STICKY, SLIP or SEPARATE
    FRICTION 1  Coulomb coefficient, combined with matter's by the geometric mean; < 0: matter's alone

Pairs are obstacles and blocks of nodes near them, tiles are obstacles and blocks of particles near them.
Those of one obstacle stand one after another.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.colliders import PLANE, Collider, local_distance
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_transfer import BLOCK, STRAY
from gdpro_sim.kernels.particles import POSITION, read_vector

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

ORIGIN = wp.constant(0)
ROTATION = wp.constant(3)
LINEAR = wp.constant(12)
SPIN = wp.constant(15)
KIND = wp.constant(24)
FRICTION = wp.constant(25)
COLUMNS = wp.constant(26)

ABSENT = wp.constant(-1)
STICKY = wp.constant(0)
SLIP = wp.constant(1)
SEPARATE = wp.constant(2)

SWEEPS = wp.constant(4)
"""Times that a node meets the obstacles it is in."""

OUTSIDE = wp.constant(0.5)
"""Cells outside an obstacle up to which nodes meet it."""

TOUCHING = wp.constant(0.05)
"""Cells of a gap that a sticky or slippery obstacle holds closed."""

RECOVERY = wp.constant(0.5)
"""s, in which matter that an obstacle overlaps is pushed out of it. Ten times as fast makes bodies hop."""

DEEPEST = wp.constant(0.5)
"""Cells of overlap that count for how fast."""

FAR = wp.constant(1.0e30)
"""Gap of a node without matter near, m."""

SUMS = wp.constant(42)
"""Numbers of `sum_coupling`: a matrix 6 x 6, row by row, and a vector."""


@wp.func
def row_vector(table: wp.array2d[wp.float64], c: int, column: int) -> wp.vec3d:
    return wp.vec3d(table[c, column], table[c, column + 1], table[c, column + 2])


@wp.func
def row_matrix(table: wp.array2d[wp.float64], c: int, column: int) -> wp.mat33d:
    return wp.matrix_from_rows(
        row_vector(table, c, column), row_vector(table, c, column + 3), row_vector(table, c, column + 6)
    )


@wp.func
def node_position(block: wp.vec3i, n: int, spacing: wp.float64) -> wp.vec3d:
    """m, of node n of 64."""
    return spacing * wp.vec3d(
        wp.float64(BLOCK * block[0] + (n >> 4)),
        wp.float64(BLOCK * block[1] + ((n >> 2) & 3)),
        wp.float64(BLOCK * block[2] + (n & 3)),
    )


@wp.func
def obstacle_velocity(table: wp.array2d[wp.float64], c: int, x: wp.vec3d) -> wp.vec3:
    """m/s, of obstacle c at a point x."""
    u = row_vector(table, c, LINEAR) + row_matrix(table, c, SPIN) * (x - row_vector(table, c, ORIGIN))
    return wp.vec3(float(u[0]), float(u[1]), float(u[2]))


@wp.func
def distance_to(collider: Collider, table: wp.array2d[wp.float64], c: int, x: wp.vec3d):
    """Signed distance of a point x to obstacle c, m, and the outward normal."""
    rotation = row_matrix(table, c, ROTATION)
    q = wp.transpose(rotation) * (x - row_vector(table, c, ORIGIN))
    distance, normal = local_distance(collider, q, collider.size[0])
    return distance, rotation * normal


@wp.func
def closing_speed(gap: float, kind: int, h: float, spacing: float) -> float:
    """m/s at which matter a gap away may come nearer; negative where it has to leave."""
    speed = gap / h
    if gap < 0.0:
        speed = wp.max(gap, -DEEPEST * spacing) / RECOVERY
        if kind == STICKY:
            speed = 0.0
    return speed


@wp.func
def meets(r: wp.vec3, normal: wp.vec3, gap: float, kind: int, spacing: float) -> bool:
    """Whether matter a gap away touches an obstacle, or would before the substep ends."""
    closes = wp.dot(r, normal) < 0.0
    return closes or (kind != SEPARATE and gap <= TOUCHING * spacing)


@wp.func
def left_over(r: wp.vec3, normal: wp.vec3, kind: int, mu: float) -> wp.vec3:
    """What is left of a relative velocity of matter that meets an obstacle."""
    along = wp.dot(r, normal)
    across = r - along * normal
    left = wp.vec3()
    if kind == SLIP:
        left = across
    elif kind == SEPARATE:
        speed = wp.length(across)
        limit = -mu * along
        if speed > limit:
            left = across * (1.0 - limit / speed)
    return left


@wp.func
def friction_with(table: wp.array2d[wp.float64], c: int, of_matter: float) -> float:
    own = float(table[c, FRICTION])
    mu = of_matter
    if own >= 0.0:
        mu = wp.sqrt(own * of_matter)
    return mu


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


@wp.kernel
def meet_obstacles(
    start: int,
    # In:
    count: int,
    near: wp.array[int],
    starts: wp.array[int],
    pairs: wp.array[int],
    owner: wp.array[int],
    field: wp.array[wp.vec4],
    met: wp.array[int],
    gap: wp.array[float],
    friction: wp.array[float],
    table: wp.array2d[wp.float64],
    h: float,
    spacing: wp.float64,
    blocks: wp.array[wp.vec3i],
    # Out:
    values_out: wp.array[wp.vec4],
    impulse_out: wp.array2d[wp.float64],
):
    """Velocities of `count` nodes after they have met what they are in, and what that took from them.

    count:    64 on a CPU, where a block's sums belong to one thread; 1 on a GPU
    near:     [K] blocks near obstacles; starts: [K + 1] and pairs: theirs
    owner:    [P] obstacle of each pair; field, gap: [64 P] and met: [P] see
              `measure_nodes` and `gather_gaps`
    friction: [64 K] Coulomb coefficient of the matter at each node
    impulse_out: [P, 6] linear, N s, and angular, N m s about the obstacle's origin; none where it has no rows
    """
    i = (start + wp.tid()) * count
    k = i // 64
    block = near[k]
    first = starts[k]
    end = starts[k + 1]
    met_one = bool(False)
    for j in range(first, end):
        met_one = met_one or met[pairs[j]] != 0
    if not met_one:
        return
    for n in range(i % 64, i % 64 + count):
        value = values_out[64 * block + n]
        mass = value[3]
        if mass > 0.0:
            v = wp.vec3(value[0], value[1], value[2])
            before = v
            for _sweep in range(SWEEPS):
                held = v
                for j in range(first, end):
                    pair = pairs[j]
                    f = field[64 * pair + n]
                    c = owner[pair]
                    kind = int(table[c, KIND])
                    open = gap[64 * pair + n]
                    if open < FAR and kind != ABSENT:
                        x = node_position(blocks[block], n, spacing)
                        normal = wp.vec3(f[0], f[1], f[2])
                        allowed = closing_speed(open, kind, h, float(spacing)) * normal
                        u = obstacle_velocity(table, c, x) - allowed
                        old = v
                        if meets(v - u, normal, open, kind, float(spacing)):
                            mu = friction_with(table, c, friction[64 * k + n])
                            v = u + left_over(v - u, normal, kind, mu)
                        if impulse_out.shape[0] > 0 and not (v == old):
                            change = old - v
                            m = wp.float64(mass)
                            p = m * wp.vec3d(
                                wp.float64(change[0]), wp.float64(change[1]), wp.float64(change[2])
                            )
                            turn = wp.cross(x - row_vector(table, c, ORIGIN), p)
                            for a in range(3):
                                wp.atomic_add(impulse_out, pair, a, p[a])
                                wp.atomic_add(impulse_out, pair, 3 + a, turn[a])
                if end - first == 1 or v == held:
                    break
            if not (v == before):
                values_out[64 * block + n] = wp.vec4(v[0], v[1], v[2], mass)


@wp.kernel
def sum_coupling(
    start: int,
    # In:
    count: int,
    c: int,
    first: int,
    near_of_block: wp.array[int],
    block_of_pair: wp.array[int],
    field: wp.array[wp.vec4],
    met: wp.array[int],
    gap: wp.array[float],
    friction: wp.array[float],
    table: wp.array2d[wp.float64],
    h: float,
    spacing: wp.float64,
    blocks: wp.array[wp.vec3i],
    values: wp.array[wp.vec4],
    # Out:
    sums_out: wp.array2d[wp.float64],
):
    """What the nodes of each pair of obstacle c would give it, linear in its velocity around the table's.

    A node of mass m at a lever r gives the impulse m D (v + s n - u - w x r), u and w the obstacle's
    linear and angular velocity, with D = 1 where it sticks, n n^T where it slips, (n - mu t) n^T where it
    slides along the direction t, 0 where it does not touch.

    sums_out: [P', SUMS] the matrix 6 x 6 of minus (u, w), then force and moment without (u, w)
    """
    i = (start + wp.tid()) * count
    place = i // 64
    pair = first + place
    block = block_of_pair[pair]
    origin = row_vector(table, c, ORIGIN)
    kind = int(table[c, KIND])
    if met[pair] == 0:
        return
    for n in range(i % 64, i % 64 + count):
        value = values[64 * block + n]
        f = field[64 * pair + n]
        open = gap[64 * pair + n]
        if value[3] > 0.0 and open < FAR and kind != ABSENT:
            x = node_position(blocks[block], n, spacing)
            normal = wp.vec3(f[0], f[1], f[2])
            v = wp.vec3(value[0], value[1], value[2])
            v += closing_speed(open, kind, h, float(spacing)) * normal
            r = v - obstacle_velocity(table, c, x)
            along = wp.dot(r, normal)
            D = wp.mat33()
            if not meets(r, normal, open, kind, float(spacing)):
                continue
            if kind == STICKY:
                D = wp.identity(n=3, dtype=float)
            elif kind == SLIP:
                D = wp.outer(normal, normal)
            else:
                mu = friction_with(table, c, friction[64 * near_of_block[block] + n])
                across = r - along * normal
                speed = wp.length(across)
                if speed <= -mu * along:
                    D = wp.identity(n=3, dtype=float)
                else:
                    D = wp.outer(normal - (mu / speed) * across, normal)
            lever = x - origin
            m = wp.float64(value[3])
            Dm = wp.mat33d()
            for a in range(9):
                Dm[a // 3, a % 3] = m * wp.float64(D[a // 3, a % 3])
            given = Dm * wp.vec3d(wp.float64(v[0]), wp.float64(v[1]), wp.float64(v[2]))
            # w x r = -S w with S the matrix of r x.
            S = wp.skew(lever)
            DS = Dm * S
            SD = S * Dm
            SDS = S * DS
            moment = S * given
            for a in range(3):
                for b in range(3):
                    wp.atomic_add(sums_out, place, 6 * a + b, Dm[a, b])
                    wp.atomic_add(sums_out, place, 6 * a + 3 + b, -DS[a, b])
                    wp.atomic_add(sums_out, place, 6 * (3 + a) + b, SD[a, b])
                    wp.atomic_add(sums_out, place, 6 * (3 + a) + 3 + b, -SDS[a, b])
                wp.atomic_add(sums_out, place, 36 + a, given[a])
                wp.atomic_add(sums_out, place, 39 + a, moment[a])
