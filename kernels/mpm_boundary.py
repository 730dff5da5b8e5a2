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

from gdpro_sim.kernels.colliders import Collider, local_distance
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_transfer import BLOCK

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

TOUCHING = wp.constant(0.05)
"""Cells of a gap that a sticky or slippery obstacle holds closed."""

RECOVERY = wp.constant(0.5)
"""s, in which matter that an obstacle overlaps is pushed out of it. Ten times as fast makes bodies hop."""

DEEPEST = wp.constant(0.5)
"""Cells of overlap that count for how fast."""

FAR = wp.constant(1.0e30)
"""Gap of a node without matter near, m."""

LEAST_ROOM = wp.constant(0.05)
"""Share of a node's surroundings that counts as free at least."""

ALONGSIDE = wp.constant(0.7)
"""Cosine between normals of obstacles at a node from which they fill the same space."""

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


@wp.func
def add_impulse(
    mass: float,
    change: wp.vec3,
    x: wp.vec3d,
    table: wp.array2d[wp.float64],
    c: int,
    pair: int,
    impulse_out: wp.array2d[wp.float64],
):
    """What obstacle c takes from a node at x, which gives up a velocity."""
    p = wp.float64(mass) * wp.vec3d(wp.float64(change[0]), wp.float64(change[1]), wp.float64(change[2]))
    turn = wp.cross(x - row_vector(table, c, ORIGIN), p)
    for a in range(3):
        wp.atomic_add(impulse_out, pair, a, p[a])
        wp.atomic_add(impulse_out, pair, 3 + a, turn[a])


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
    left: wp.array[wp.vec4],
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
    left:     m/s of each node that the last obstacle it meets takes from it besides; empty: none
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
            x = node_position(blocks[block], n, spacing)
            last = int(-1)
            for _sweep in range(SWEEPS):
                held = v
                for j in range(first, end):
                    pair = pairs[j]
                    f = field[64 * pair + n]
                    c = owner[pair]
                    kind = int(table[c, KIND])
                    open = gap[64 * pair + n]
                    if open < FAR and kind != ABSENT:
                        normal = wp.vec3(f[0], f[1], f[2])
                        allowed = closing_speed(open, kind, h, float(spacing)) * normal
                        u = obstacle_velocity(table, c, x) - allowed
                        old = v
                        if meets(v - u, normal, open, kind, float(spacing)):
                            mu = friction_with(table, c, friction[64 * k + n])
                            v = u + left_over(v - u, normal, kind, mu)
                        if not (v == old):
                            last = pair
                            if impulse_out.shape[0] > 0:
                                add_impulse(mass, old - v, x, table, c, pair, impulse_out)
                if end - first == 1 or v == held:
                    break
            if last >= 0 and left.shape[0] > 0 and impulse_out.shape[0] > 0:
                more = left[64 * block + n]
                change = wp.vec3(more[0], more[1], more[2])
                add_impulse(mass, change, x, table, owner[last], last, impulse_out)
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


@wp.func
def free_share(distance: float, width: int) -> float:
    """Share of a spline's weight outside an even wall that its middle is `distance` cells outside of."""
    reach = 0.5 * float(width)
    x = wp.clamp(distance, -reach, reach)
    a = wp.abs(x)
    beyond = float(0.0)  # of the weight further out than a
    if width == 3:
        beyond = (1.5 - a) * (1.5 - a) * (1.5 - a) / 6.0
        if a < 0.5:
            beyond = 0.5 - 0.75 * a + a * a * a / 3.0
    else:
        beyond = (2.0 - a) * (2.0 - a) * (2.0 - a) * (2.0 - a) / 24.0
        if a < 1.0:
            beyond = 0.5 - 2.0 / 3.0 * a + a * a * a / 3.0 - a * a * a * a / 8.0
    return wp.where(x < 0.0, beyond, 1.0 - beyond)


@wp.kernel
def fill_obstacles(
    start: int,
    # In:
    width: int,
    near: wp.array[int],
    starts: wp.array[int],
    pairs: wp.array[int],
    owner: wp.array[int],
    field: wp.array[wp.vec4],
    table: wp.array2d[wp.float64],
    spacing: float,
    # Out:
    values_out: wp.array[wp.vec4],
):
    """Mass that nodes would have if what is around them went on inside obstacles.

    Divides it by the share of a node's spline outside them: matter that lies at a wall is no less dense than
    elsewhere. Obstacles that fill the same space count once.
    """
    i = start + wp.tid()
    k = i // 64
    n = i % 64
    first = starts[k]
    end = starts[k + 1]
    value = values_out[64 * near[k] + n]
    if value[3] == 0.0:
        return
    room = float(1.0)
    for j in range(first, end):
        f = field[64 * pairs[j] + n]
        if int(table[owner[pairs[j]], KIND]) != ABSENT and f[3] < 0.5 * float(width) * spacing:
            covered = bool(False)
            for o in range(first, end):
                g = field[64 * pairs[o] + n]
                closer = g[3] < f[3] or (g[3] == f[3] and o < j)
                if closer and int(table[owner[pairs[o]], KIND]) != ABSENT:
                    covered = covered or f[0] * g[0] + f[1] * g[1] + f[2] * g[2] > ALONGSIDE
            if not covered:
                room *= free_share(f[3] / spacing, width)
    mass = value[3] / wp.max(room, LEAST_ROOM)
    values_out[64 * near[k] + n] = wp.vec4(value[0], value[1], value[2], mass)
