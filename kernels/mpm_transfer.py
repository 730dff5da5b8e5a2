"""Transfers between MPM particles and grid: B-splines, affine particles in cells, stress by moving squares.

The grid's nodes lie at integer multiples of the spacing dx and stand in blocks of 4 x 4 x 4, of which only
those near matter exist. A block owns the particles whose first node was in it when they were sorted.
`neighbors[27 b + 9 (i + 1) + 3 (j + 1) + (k + 1)]` is the grid block beside block b of particles at offset
(i, j, k).

Momentum and mass at node i, with weights w of particle p (Jiang et al. 2015, "The affine particle-in-cell
method", ACM TOG 34(4); Hu et al. 2018, "A moving least squares material point method", ACM TOG 37(4), eq.
16; r_i from the particle to the node, D = dx^2 / 4 for quadratic and dx^2 / 3 for cubic splines):

    m_i = sum_p w m,   p_i = sum_p w (m v + (m C - h V tau / D) r_i)

and back: v = sum_i w v_i, C = sum_i w v_i r_i^T / D, x += h v, F += h C F.

On a CPU a block's particles meet a tile of nodes of their own, vectors of 16 numbers (4 nodes along z) at a
time: momentum goes to it without touching other blocks' nodes, and tiles are added up in one order for any
number of threads. Particles may stray one cell from their block before they have to be sorted anew. The same,
one particle at a time, stands in `gdpro_sim.kernels.mpm_particles`.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE
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
)

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

BLOCK = wp.constant(4)
"""Nodes of a block along each axis."""

STRAY = wp.constant(1)
"""Cells that a particle may lie outside its block on a CPU."""


def tile_width(width: int) -> int:
    """Nodes of a block's tile along each axis, for splines that reach `width` nodes."""
    return BLOCK - 1 + width + 2 * STRAY


def tile_nodes(width: int) -> int:
    """Numbers of four floats in a tile; one more than nodes, for vectors that reach past the last."""
    return tile_width(width) ** 3 + 1


_WEIGHTS = """
    // Weights of WIDTH nodes along each axis; `base` is the first one's number, f the way from it in cells.
    F base[3], f[3], wx[4], wy[4], wz[4];
    F* const weights[3] = {wx, wy, wz};
    for (int a = 0; a < 3; ++a) {
        const F u = row(POSITION + a) * inverse;
        F* const w = weights[a];
        if (WIDTH == 3) {
            base[a] = floor_(u - 0.5f);
            f[a] = u - base[a];
            const F l = 1.5f - f[a], m = f[a] - 1.0f, r = f[a] - 0.5f;
            w[0] = 0.5f * l * l;
            w[1] = 0.75f - m * m;
            w[2] = 0.5f * r * r;
            w[3] = splat(0.0f);
        } else {
            base[a] = floor_(u) - 1.0f;
            f[a] = u - base[a];
            const F l = 2.0f - f[a], r = f[a] - 1.0f;
            w[0] = l * l * l * (1.0f / 6.0f);
            w[3] = r * r * r * (1.0f / 6.0f);
            w[2] = (0.5f * l - 1.0f) * l * l + (2.0f / 3.0f);
            w[1] = ((1.0f - w[0]) - w[3]) - w[2];  // they sum to 1 in the mean: momentum is kept
        }
    }
    // Where they begin in the tile; a particle that strayed too far stays in it, and is reported.
    F place = splat(0.0f);
    for (int a = 0; a < 3; ++a) {
        const F local = base[a] - (float)(BLOCK * corner[a]) + (float)STRAY;
        place = place * (float)TILE + max_(min_(local, splat((float)(BLOCK - 1 + 2 * STRAY))), splat(0.0f));
    }
    int begin[16];
    for (int j = 0; j < 16; ++j) begin[j] = 4 * (int)place[j];
"""

_GROUPS = """
#if !defined(__CUDACC__)
    typedef float Q __attribute__((ext_vector_type(4)));
    const int N = (int)particles.shape[1];
    const int corner[3] = {coords.data[block][0], coords.data[block][1], coords.data[block][2]};
    const int end = starts.data[block + 1];
    #define QUAD(v, q) __builtin_shufflevector(v, v, q, q + 1, q + 2, q + 3, q, q + 1, q + 2, q + 3, \\
        q, q + 1, q + 2, q + 3, q, q + 1, q + 2, q + 3)
    #define SPREAD(v, q) __builtin_shufflevector(v, v, q, q, q, q, q + 1, q + 1, q + 1, q + 1, \\
        q + 2, q + 2, q + 2, q + 2, q + 3, q + 3, q + 3, q + 3)
    {before}
    for (int first = starts.data[block]; first < end; first += 16) {
        const int lanes = end - first < 16 ? end - first : 16;
        {prelude}
        auto row = [&](int r) __attribute__((always_inline)) {
            const float* const p = particles.data + (size_t)r * N + first;
            F v;
            if (lanes == 16) { __builtin_memcpy(&v, p, 64); return v; }
            for (int j = 0; j < 16; ++j) v[j] = p[j < lanes ? j : lanes - 1];
            return v;
        };
        auto put = [&](int r, F v) __attribute__((always_inline)) {
            float* const p = particles.data + (size_t)r * N + first;
            if (lanes == 16) { __builtin_memcpy(p, &v, 64); return; }
            for (int j = 0; j < lanes; ++j) p[j] = v[j];
        };
        {weights}
        F W[16] = {wx[0], wx[1], wx[2], wx[3], wy[0], wy[1], wy[2], wy[3],
            wz[0], wz[1], wz[2], wz[3], wx[0], wx[0], wx[0], wx[0]};
        transpose(W);
        const F steps = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
        {each}
    }
    {after}
    #undef QUAD
    #undef SPREAD
#endif
"""

SCATTER_BEFORE = """
    float* const tile = (float*)(tiles.data + (size_t)block * TILE_NODES);
    __builtin_memset(tile, 0, TILE_NODES * 16);
"""

SCATTER_MOMENTUM = """
        const F m = row(MASS), pull = splat(-h * inverse * inverse * (WIDTH == 3 ? 4.0f : 3.0f));
        // Columns of dx (m C - h V tau / D): what one cell along each axis adds.
        F P[16];
        const int symmetric[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
        for (int a = 0; a < 3; ++a) {
            for (int i = 0; i < 3; ++i)
                P[4 + 4 * a + i] = (affine * m * row(AFFINE + 3 * i + a)
                    + pull * row(STRESS + symmetric[3 * i + a])) * spacing;
            P[4 + 4 * a + 3] = splat(0.0f);
        }
        for (int i = 0; i < 3; ++i)
            P[i] = m * row(VELOCITY + i) - f[0] * P[4 + i] - f[1] * P[8 + i] - f[2] * P[12 + i];
        P[3] = m;
"""

SCATTER_NODES = """
        transpose(P);
        for (int lane = 0; lane < lanes; ++lane) {
            const F p = P[lane], w = W[lane];
            const F wk = SPREAD(w, 8);
            F value = (QUAD(p, 0) + steps * QUAD(p, 12)) * wk;
            const F along_x = QUAD(p, 4) * wk, along_y = QUAD(p, 8) * wk;
            float* const at = tile + begin[lane];
            for (int i = 0; i < WIDTH; ++i) {
                F here = value * w[i];
                const F step = along_y * w[i];
                for (int j = 0; j < WIDTH; ++j) {
                    float* const node = at + (i * TILE + j) * TILE * 4;
                    F sum;
                    __builtin_memcpy(&sum, node, 64);
                    sum += here * w[4 + j];
                    __builtin_memcpy(node, &sum, 64);
                    here += step;
                }
                value += along_x;
            }
        }
"""

GATHER_BEFORE = """
    float tile[TILE_NODES * 4 + 16];
    for (int i = 0; i < TILE; ++i)
        for (int j = 0; j < TILE; ++j) {
            float* to = tile + (i * TILE + j) * TILE * 4;
            const int bi = i < STRAY ? 0 : i < STRAY + BLOCK ? 1 : 2;
            const int bj = j < STRAY ? 0 : j < STRAY + BLOCK ? 1 : 2;
            const int ni = (i - STRAY) & (BLOCK - 1), nj = (j - STRAY) & (BLOCK - 1);
            const int* const beside = neighbors.data + 27 * (size_t)block + 9 * bi + 3 * bj;
            const size_t line = 16 * ni + 4 * nj;
            __builtin_memcpy(to, values.data + 64 * (size_t)beside[0] + line + (BLOCK - STRAY), 16 * STRAY);
            __builtin_memcpy(to + 4 * STRAY, values.data + 64 * (size_t)beside[1] + line, 16 * BLOCK);
            __builtin_memcpy(to + 4 * (STRAY + BLOCK), values.data + 64 * (size_t)beside[2] + line,
                16 * (TILE - STRAY - BLOCK));
        }
    for (int i = 0; i < 20; ++i) tile[TILE * TILE * TILE * 4 + i] = 0.0f;
    int strayed = 0;
"""

GATHER_EACH = """
        F R[16];
        for (int lane = lanes; lane < 16; ++lane) R[lane] = splat(0.0f);
        for (int lane = 0; lane < lanes; ++lane) {
            const F wk = SPREAD(W[lane], 8);
            const float* const w = (const float*)&W[lane];
            const float* const at = tile + begin[lane];
            F sum = splat(0.0f), along_x = splat(0.0f), along_y = splat(0.0f);
            for (int i = 0; i < WIDTH; ++i) {
                F line = splat(0.0f), weighted = splat(0.0f);
                for (int j = 0; j < WIDTH; ++j) {
                    F node;
                    __builtin_memcpy(&node, at + (i * TILE + j) * TILE * 4, 64);
                    node *= w[4 + j];
                    line += node;
                    if (j == 1) weighted = node;
                    if (j > 1) weighted += (float)j * node;
                }
                line *= w[i];
                sum += line;
                along_y += weighted * w[i];
                if (i == 1) along_x = line;
                if (i > 1) along_x += (float)i * line;
            }
            sum *= wk;
            along_x *= wk;
            along_y *= wk;
            const F along_z = sum * steps;
            // Sums over the four nodes along z of each, side by side.
            const F s = __builtin_shufflevector(sum, along_x, 0, 1, 2, 3, 16, 17, 18, 19,
                    8, 9, 10, 11, 24, 25, 26, 27)
                + __builtin_shufflevector(sum, along_x, 4, 5, 6, 7, 20, 21, 22, 23,
                    12, 13, 14, 15, 28, 29, 30, 31);
            const F t = __builtin_shufflevector(along_y, along_z, 0, 1, 2, 3, 16, 17, 18, 19,
                    8, 9, 10, 11, 24, 25, 26, 27)
                + __builtin_shufflevector(along_y, along_z, 4, 5, 6, 7, 20, 21, 22, 23,
                    12, 13, 14, 15, 28, 29, 30, 31);
            R[lane] = __builtin_shufflevector(s, t, 0, 1, 2, 3, 4, 5, 6, 7, 16, 17, 18, 19, 20, 21, 22, 23)
                + __builtin_shufflevector(s, t, 8, 9, 10, 11, 12, 13, 14, 15, 24, 25, 26, 27, 28, 29, 30, 31);
        }
        transpose(R);
"""

GATHER_AFFINE = """
        // Rows 0..2: sum w v; 4 + 4 a + i: sum w (node along axis a) v_i.
        const F scale = splat(inverse * (WIDTH == 3 ? 4.0f : 3.0f));
        F C[9];
        for (int i = 0; i < 3; ++i)
            for (int a = 0; a < 3; ++a) C[3 * i + a] = (R[4 + 4 * a + i] - f[a] * R[i]) * scale;
"""

_GATHER_MOVE = """
        // Compensated sums: what is cut off goes along.
        auto add_to = [&](int high, int low, F more) __attribute__((always_inline)) {
            const F before = row(high), y = more + row(low), after = before + y;
            put(high, after);
            put(low, y - (after - before));
            return after;
        };
        I out = (I)0;
        for (int a = 0; a < 3; ++a) {
            const F x = add_to(POSITION + a, POSITION_LOW + a, h * R[a]);
            const F u = x * inverse;
            const F local = (WIDTH == 3 ? floor_(u - 0.5f) : floor_(u) - 1.0f) - (float)(BLOCK * corner[a]);
            // A position that is no number strays too.
            out |= ~((local >= (float)-STRAY) & (local <= (float)(BLOCK - 1 + STRAY)));
        }
        for (int j = 0; j < lanes; ++j) strayed |= out[j];
        if (flip > 0.0f) {
            for (int i = 0; i < 3; ++i) put(VELOCITY + i, flip * row(VELOCITY + i) + (1.0f - flip) * R[i]);
        } else {
            for (int i = 0; i < 3; ++i) put(VELOCITY + i, R[i]);
        }
        for (int i = 0; i < 9; ++i) put(AFFINE + i, C[i]);
        for (int j = 0; j < 3; ++j) {
            const F a0 = row(DEFORMATION + j), a1 = row(DEFORMATION + 3 + j), a2 = row(DEFORMATION + 6 + j);
            for (int i = 0; i < 3; ++i)
                add_to(DEFORMATION + 3 * i + j, DEFORMATION_LOW + 3 * i + j,
                    h * (C[3 * i] * a0 + C[3 * i + 1] * a1 + C[3 * i + 2] * a2));
        }
        if (particles.shape[0] > TOTAL) {
            for (int j = 0; j < 3; ++j) {
                const F a0 = row(TOTAL + j), a1 = row(TOTAL + 3 + j), a2 = row(TOTAL + 6 + j);
                for (int i = 0; i < 3; ++i)
                    put(TOTAL + 3 * i + j, row(TOTAL + 3 * i + j)
                        + h * (C[3 * i] * a0 + C[3 * i + 1] * a1 + C[3 * i + 2] * a2));
            }
            const F per_cell = splat(inverse * inverse * inverse);
            put(DENSITY, R[3] * per_cell);
            F square = splat(0.0f);
            for (int a = 0; a < 3; ++a) {
                const F slope = (R[4 + 4 * a + 3] - f[a] * R[3]) * (WIDTH == 3 ? 4.0f : 3.0f);
                square += slope * slope;
            }
            put(SLOPE, sqrt_(square) * per_cell);
        }
"""

_GATHER_CHANGE = """
        for (int i = 0; i < 3; ++i) put(VELOCITY + i, row(VELOCITY + i) + R[i]);
"""


def snippet(width: int, before: str, each: str, after: str = "") -> str:
    """Text over one block's particles, 16 at a time: `before` them all, for `each` group, and `after`."""
    numbers = {
        "WIDTH": width,
        "TILE": tile_width(width),
        "TILE_NODES": tile_nodes(width),
        "BLOCK": BLOCK,
        "STRAY": STRAY,
        "POSITION": POSITION,
        "POSITION_LOW": POSITION_LOW,
        "VELOCITY": VELOCITY,
        "AFFINE": AFFINE,
        "DEFORMATION": DEFORMATION,
        "DEFORMATION_LOW": DEFORMATION_LOW,
        "STRESS": STRESS,
        "MASS": MASS,
        "TOTAL": TOTAL,
        "DENSITY": DENSITY,
        "SLOPE": SLOPE,
    }
    text = _GROUPS
    parts = {"before": before, "prelude": PRELUDE, "weights": _WEIGHTS, "each": each, "after": after}
    for name, part in parts.items():
        text = text.replace("{" + name + "}", part)
    constants = ", ".join(f"{name} = {value}" for name, value in numbers.items())
    return text.replace(
        "#if !defined(__CUDACC__)\n", f"#if !defined(__CUDACC__)\n    const int {constants};\n", 1
    )


_REPORT = "strayed_out.data[block] = strayed;"
_MOVE = GATHER_EACH + GATHER_AFFINE + _GATHER_MOVE
_CHANGE = GATHER_EACH + _GATHER_CHANGE


@wp.func_native(snippet(3, SCATTER_BEFORE, SCATTER_MOMENTUM + SCATTER_NODES))
def scatter_quadratic(
    block: int,
    h: float,
    spacing: float,
    inverse: float,
    affine: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    tiles: wp.array[wp.vec4],
):
    """Momentum and mass of one block's particles into its tile."""
    ...


@wp.func_native(snippet(4, SCATTER_BEFORE, SCATTER_MOMENTUM + SCATTER_NODES))
def scatter_cubic(
    block: int,
    h: float,
    spacing: float,
    inverse: float,
    affine: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    tiles: wp.array[wp.vec4],
):
    """The same with cubic splines."""
    ...


@wp.kernel
def scatter_blocks(
    start: int,
    # In:
    width: int,
    h: float,
    spacing: float,
    affine: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    # Out:
    tiles_out: wp.array[wp.vec4],
):
    """Momentum and mass of each block's particles into its tile. CPU.

    width:  nodes that a spline reaches: 3 quadratic, 4 cubic
    affine: share of the velocity gradient that goes along; 0 is PIC
    starts: [B + 1] first particle of each block; coords: [B] its first node over 4
    """
    b = start + wp.tid()
    if width == 3:
        scatter_quadratic(b, h, spacing, 1.0 / spacing, affine, starts, coords, particles, tiles_out)
    else:
        scatter_cubic(b, h, spacing, 1.0 / spacing, affine, starts, coords, particles, tiles_out)


@wp.func_native(snippet(3, GATHER_BEFORE, _MOVE, _REPORT))
def gather_quadratic(
    block: int,
    h: float,
    inverse: float,
    flip: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    strayed_out: wp.array[int],
):
    """Velocity, its gradient, position and deformation of one block's particles."""
    ...


@wp.func_native(snippet(4, GATHER_BEFORE, _MOVE, _REPORT))
def gather_cubic(
    block: int,
    h: float,
    inverse: float,
    flip: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    strayed_out: wp.array[int],
):
    """The same with cubic splines."""
    ...


@wp.kernel
def gather_blocks(
    start: int,
    # In:
    width: int,
    h: float,
    spacing: float,
    flip: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    # Out:
    particles_out: wp.array2d[float],
    strayed_out: wp.array[int],
):
    """The grid's velocities back to each block's particles, which move by them. CPU.

    flip:        share of the particle's own velocity, which has been given the grid's change
    strayed_out: [B] not 0 where a particle is too far from its block now, or nowhere
    """
    b = start + wp.tid()
    if width == 3:
        gather_quadratic(
            b, h, 1.0 / spacing, flip, starts, coords, neighbors, values, particles_out, strayed_out
        )
    else:
        gather_cubic(b, h, 1.0 / spacing, flip, starts, coords, neighbors, values, particles_out, strayed_out)


@wp.func_native(snippet(3, GATHER_BEFORE, _CHANGE))
def add_change_quadratic(
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
):
    """Adds what the grid's velocities changed by to those of one block's particles."""
    ...


@wp.func_native(snippet(4, GATHER_BEFORE, _CHANGE))
def add_change_cubic(
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
):
    """The same with cubic splines."""
    ...


@wp.kernel
def add_change_blocks(
    start: int,
    # In:
    width: int,
    spacing: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    change: wp.array[wp.vec4],
    # Out:
    particles_out: wp.array2d[float],
):
    """FLIP: adds the change of the grid's velocities to the particles' own. CPU."""
    b = start + wp.tid()
    if width == 3:
        add_change_quadratic(b, 1.0 / spacing, starts, coords, neighbors, change, particles_out)
    else:
        add_change_cubic(b, 1.0 / spacing, starts, coords, neighbors, change, particles_out)
