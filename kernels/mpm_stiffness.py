"""Forces and stiffness of MPM particles on the grid's nodes; see `gdpro_sim.kernels.mpm_implicit`.

The Hessian is never assembled: a product with it gathers the gradient of a vector to the particles, and
scatters what they answer, in one pass. The 3x3 blocks of its diagonal precondition.

As in `gdpro_sim.kernels.mpm_transfer`, a block's particles meet a tile of their own on a CPU, 16 at a time;
on a GPU one thread works for each particle, with atomic additions.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.mpm_implicit import GRADIENT, LEFT, MOMENT, PAIRS, RIGHT, SCALING
from gdpro_sim.kernels.mpm_particles import node_index, spline_weights
from gdpro_sim.kernels.mpm_transfer import (
    BLOCK,
    GATHER_AFFINE,
    GATHER_BEFORE,
    GATHER_EACH,
    SCATTER_BEFORE,
    SCATTER_NODES,
    snippet,
)
from gdpro_sim.kernels.particles import POSITION, read_matrix, read_vector, write_matrix

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

# ---- 16 particles at a time: CPU ----


def _over_widths(before: str, each: str) -> str:
    """`snippet` for both splines."""
    constants = ", ".join(
        f"{name} = {int(value)}"
        for name, value in {
            "GRADIENT": GRADIENT,
            "MOMENT": MOMENT,
            "LEFT": LEFT,
            "RIGHT": RIGHT,
            "SCALING": SCALING,
            "PAIRS": PAIRS,
        }.items()
    )
    each = _READ + each
    quadratic, cubic = (snippet(width, before, each) for width in (3, 4))
    return f"const int {constants};\nif (width == 3) {{\n{quadratic}\n}} else {{\n{cubic}\n}}\n"


_READ = """
        auto get = [&](int r) __attribute__((always_inline)) {
            const float* const p = work.data + (size_t)r * N + first;
            F v;
            if (lanes == 16) { __builtin_memcpy(&v, p, 64); return v; }
            for (int j = 0; j < 16; ++j) v[j] = p[j < lanes ? j : lanes - 1];
            return v;
        };
"""

_KEEP = """
        for (int i = 0; i < 9; ++i) {
            float* const p = work.data + (size_t)(GRADIENT + i) * N + first;
            if (lanes == 16) __builtin_memcpy(p, &C[i], 64);
            else for (int j = 0; j < lanes; ++j) p[j] = C[i][j];
        }
"""

_PRODUCT = """
        // C becomes U (H : U^T C B) B^T.
        {
            F U[9], B[9], X[9], Y[9];
            for (int i = 0; i < 9; ++i) {
                U[i] = get(LEFT + i);
                B[i] = get(RIGHT + i);
            }
            for (int m = 0; m < 3; ++m)
                for (int a = 0; a < 3; ++a)
                    Y[3 * m + a] = U[m] * C[a] + U[3 + m] * C[3 + a] + U[6 + m] * C[6 + a];
            for (int m = 0; m < 3; ++m)
                for (int c = 0; c < 3; ++c)
                    X[3 * m + c] = Y[3 * m] * B[c] + Y[3 * m + 1] * B[3 + c] + Y[3 * m + 2] * B[6 + c];
            const F a01 = get(SCALING + 3), a02 = get(SCALING + 4), a12 = get(SCALING + 5);
            Y[0] = get(SCALING) * X[0] + a01 * X[4] + a02 * X[8];
            Y[4] = a01 * X[0] + get(SCALING + 1) * X[4] + a12 * X[8];
            Y[8] = a02 * X[0] + a12 * X[4] + get(SCALING + 2) * X[8];
            const int upper[3] = {5, 2, 1}, lower[3] = {7, 6, 3};
            for (int k = 0; k < 3; ++k) {
                const F x = X[upper[k]], y = X[lower[k]], both = get(PAIRS + 3 * k + 2);
                Y[upper[k]] = get(PAIRS + 3 * k) * x + both * y;
                Y[lower[k]] = both * x + get(PAIRS + 3 * k + 1) * y;
            }
            for (int m = 0; m < 3; ++m)
                for (int a = 0; a < 3; ++a)
                    X[3 * m + a] = Y[3 * m] * B[3 * a] + Y[3 * m + 1] * B[3 * a + 1]
                        + Y[3 * m + 2] * B[3 * a + 2];
            for (int i = 0; i < 3; ++i)
                for (int a = 0; a < 3; ++a)
                    C[3 * i + a] = U[3 * i] * X[a] + U[3 * i + 1] * X[3 + a] + U[3 * i + 2] * X[6 + a];
        }
"""

_MOMENT_NODES = f"""
        F P[16];
        const F lever = splat(inverse * (WIDTH == 3 ? 4.0f : 3.0f));
        for (int a = 0; a < 3; ++a) {{
            for (int i = 0; i < 3; ++i) P[4 + 4 * a + i] = lever * C[3 * i + a];
            P[4 + 4 * a + 3] = splat(0.0f);
        }}
        for (int i = 0; i < 3; ++i) P[i] = -f[0] * P[4 + i] - f[1] * P[8 + i] - f[2] * P[12 + i];
        P[3] = splat(0.0f);
        float* const tile = sums;
        {SCATTER_NODES}
"""
"""Sum w C r / D; the tile may be one of two."""

_SUMS = SCATTER_BEFORE.replace("const tile", "const sums").replace("memset(tile", "memset(sums")

_BLOCKS = """
        // K[6 ab + c]: numbers xx yy zz xy xz yz of the block that a node adds for r_a r_b.
        F U[9], B[9], A[9], D[9];
        const int symmetric[9] = {0, 3, 4, 3, 1, 5, 4, 5, 2};
        const int firsts[6] = {0, 1, 2, 0, 0, 1}, seconds[6] = {0, 1, 2, 1, 2, 2};
        const F lever = splat(inverse * (WIDTH == 3 ? 4.0f : 3.0f)), scale = lever * lever;
        for (int i = 0; i < 9; ++i) {
            U[i] = get(LEFT + i);
            B[i] = get(RIGHT + i);
            A[i] = get(SCALING + symmetric[i]);
        }
        // D[3 m + c]: of (F_mc, F_mc).
        for (int k = 0; k < 3; ++k) {
            const int m = k == 0 ? 1 : 0, c = k == 2 ? 1 : 2;
            D[3 * m + c] = get(PAIRS + 3 * k);
            D[3 * c + m] = get(PAIRS + 3 * k + 1);
            const F both = get(PAIRS + 3 * k + 2);
            A[3 * m + c] += both;
            A[3 * c + m] += both;
            D[4 * k] = A[4 * k];
        }
        F low[32], high[32];
        for (int i = 0; i < 32; ++i) low[i] = high[i] = splat(0.0f);
        for (int q = 0; q < 6; ++q) {
            const F* const b = B + 3 * firsts[q], * const d = B + 3 * seconds[q];
            F H[9], T[9];
            const F weight = scale * (q < 3 ? 1.0f : 2.0f);
            for (int m = 0; m < 3; ++m)
                for (int n = 0; n < 3; ++n)
                    H[3 * m + n] = m == n
                        ? D[3 * m] * b[0] * d[0] + D[3 * m + 1] * b[1] * d[1] + D[3 * m + 2] * b[2] * d[2]
                        : 0.5f * A[3 * m + n] * (b[m] * d[n] + d[m] * b[n]);
            for (int i = 0; i < 3; ++i)
                for (int n = 0; n < 3; ++n)
                    T[3 * i + n] = weight
                        * (U[3 * i] * H[n] + U[3 * i + 1] * H[3 + n] + U[3 * i + 2] * H[6 + n]);
            auto entry = [&](int m, int n) __attribute__((always_inline)) {
                return T[3 * m] * U[3 * n] + T[3 * m + 1] * U[3 * n + 1] + T[3 * m + 2] * U[3 * n + 2];
            };
            for (int i = 0; i < 3; ++i) {
                low[4 * q + i] = entry(i, i);
                high[4 * q + i] = entry(firsts[3 + i], seconds[3 + i]);
            }
        }
        for (int part = 0; part < 2; ++part) {
            F* const K = part == 0 ? low : high;
            float* const tile = part == 0 ? sums : more_sums;
            transpose(K);
            transpose(K + 16);
            for (int lane = 0; lane < lanes; ++lane) {
                const F p = K[lane], s = K[16 + lane], w = W[lane], wk = SPREAD(w, 8);
                const F z = steps - f[2][lane];
                const F square = wk * wk, along = square * z;
                const F xx = QUAD(p, 0) * square, yy = QUAD(p, 4) * square, zz = QUAD(p, 8) * along * z;
                const F xy = QUAD(p, 12) * square, xz = QUAD(s, 0) * along, yz = QUAD(s, 4) * along;
                for (int i = 0; i < WIDTH; ++i) {
                    const float x = (float)i - f[0][lane];
                    const F constant = zz + x * (xz + x * xx), linear = yz + x * xy;
                    for (int j = 0; j < WIDTH; ++j) {
                        const float y = (float)j - f[1][lane], weight = w[i] * w[4 + j];
                        float* const node = tile + begin[lane] + (i * TILE + j) * TILE * 4;
                        F sum;
                        __builtin_memcpy(&sum, node, 64);
                        sum += (constant + y * (linear + y * yy)) * (weight * weight);
                        __builtin_memcpy(node, &sum, 64);
                    }
                }
            }
        }
"""

_MORE_SUMS = _SUMS + _SUMS.replace("sums", "more_sums").replace("tiles.data", "more_tiles.data")


@wp.func_native(_over_widths(GATHER_BEFORE, GATHER_EACH + GATHER_AFFINE + _KEEP))
def gather_gradients(
    width: int,
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    work: wp.array2d[float],
): ...


@wp.func_native(
    _over_widths(_SUMS, "F C[9];\nfor (int i = 0; i < 9; ++i) C[i] = get(MOMENT + i);\n" + _MOMENT_NODES)
)
def scatter_moments(
    width: int,
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    tiles: wp.array[wp.vec4],
): ...


@wp.func_native(
    _over_widths(
        _SUMS + GATHER_BEFORE, GATHER_EACH + GATHER_AFFINE + _PRODUCT + "{\n" + _MOMENT_NODES + "\n}\n"
    )
)
def multiply(
    width: int,
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    tiles: wp.array[wp.vec4],
): ...


@wp.func_native(_over_widths(_MORE_SUMS, _BLOCKS))
def scatter_blocks_of_nodes(
    width: int,
    block: int,
    inverse: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    tiles: wp.array[wp.vec4],
    more_tiles: wp.array[wp.vec4],
): ...


@wp.kernel
def gradient_blocks(
    start: int,
    # In:
    width: int,
    spacing: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    # Out:
    work_out: wp.array2d[float],
):
    """Velocity gradients of one block's particles. CPU."""
    gather_gradients(
        width, start + wp.tid(), 1.0 / spacing, starts, coords, neighbors, values, particles, work_out
    )


@wp.kernel
def moment_blocks(
    start: int,
    # In:
    width: int,
    spacing: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    tiles_out: wp.array[wp.vec4],
):
    """Gradient of the particles' energy into the tile of one block. CPU."""
    scatter_moments(width, start + wp.tid(), 1.0 / spacing, starts, coords, particles, work, tiles_out)


@wp.kernel
def product_blocks(
    start: int,
    # In:
    width: int,
    spacing: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    tiles_out: wp.array[wp.vec4],
):
    """Hessian of the particles' energy times `values`, into the tile of one block. CPU."""
    multiply(
        width,
        start + wp.tid(),
        1.0 / spacing,
        starts,
        coords,
        neighbors,
        values,
        particles,
        work,
        tiles_out,
    )


@wp.kernel
def diagonal_blocks(
    start: int,
    # In:
    width: int,
    spacing: float,
    starts: wp.array[int],
    coords: wp.array[wp.vec3i],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    tiles_out: wp.array[wp.vec4],
    more_tiles_out: wp.array[wp.vec4],
):
    """Blocks of the Hessian's diagonal, (xx yy zz) and (xy xz yz), into the tiles of one block. CPU."""
    scatter_blocks_of_nodes(
        width,
        start + wp.tid(),
        1.0 / spacing,
        starts,
        coords,
        particles,
        work,
        tiles_out,
        more_tiles_out,
    )


# ---- one particle at a time: GPU ----


@wp.func
def gradient_at(
    i: int,
    width: int,
    inverse: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
) -> wp.mat33:
    """Velocity gradient of particle i."""
    base, f, w = spline_weights(read_vector(particles, POSITION, i), inverse, width)
    block = owners[i]
    first = base - BLOCK * coords[block]
    moment = wp.mat33()
    for a in range(width):
        for b in range(width):
            for c in range(width):
                value = values[node_index(neighbors, block, first + wp.vec3i(a, b, c))]
                part = w[0, a] * w[1, b] * w[2, c] * wp.vec3(value[0], value[1], value[2])
                moment += wp.outer(part, wp.vec3(float(a), float(b), float(c)) - f)
    return lever(width, inverse) * moment


@wp.func
def lever(width: int, inverse: float) -> float:
    """dx / D"""
    if width == 4:
        return 3.0 * inverse
    return 4.0 * inverse


@wp.func
def scatter_at(
    i: int,
    width: int,
    inverse: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    particles: wp.array2d[float],
    G: wp.mat33,
    values_out: wp.array[wp.vec4],
):
    """Adds w G r / D to the nodes of particle i."""
    base, f, w = spline_weights(read_vector(particles, POSITION, i), inverse, width)
    block = owners[i]
    first = base - BLOCK * coords[block]
    per_cell = lever(width, inverse) * G
    for a in range(width):
        for b in range(width):
            for c in range(width):
                weight = w[0, a] * w[1, b] * w[2, c]
                p = weight * (per_cell * (wp.vec3(float(a), float(b), float(c)) - f))
                node = node_index(neighbors, block, first + wp.vec3i(a, b, c))
                wp.atomic_add(values_out, node, wp.vec4(p[0], p[1], p[2], 0.0))


@wp.kernel
def gradient_particles(
    start: int,
    # In:
    width: int,
    spacing: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    # Out:
    work_out: wp.array2d[float],
):
    """`gradient_blocks`, one particle at a time."""
    i = start + wp.tid()
    C = gradient_at(i, width, 1.0 / spacing, owners, coords, neighbors, values, particles)
    write_matrix(C, GRADIENT, i, work_out)


@wp.kernel
def moment_particles(
    start: int,
    # In:
    width: int,
    spacing: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """`moment_blocks`, added to the grid itself."""
    i = start + wp.tid()
    G = read_matrix(work, MOMENT, i)
    scatter_at(i, width, 1.0 / spacing, owners, coords, neighbors, particles, G, values_out)


@wp.func
def answer(X: wp.mat33, i: int, work: wp.array2d[float]) -> wp.mat33:
    """Change of stress, times volume, under the change X of the deformation gradient, both rotated."""
    a01 = work[SCALING + 3, i]
    a02 = work[SCALING + 4, i]
    a12 = work[SCALING + 5, i]
    pairs = read_matrix(work, PAIRS, i)
    # fmt: off
    return wp.mat33(
        work[SCALING, i] * X[0, 0] + a01 * X[1, 1] + a02 * X[2, 2],
        pairs[2, 0] * X[0, 1] + pairs[2, 2] * X[1, 0],
        pairs[1, 0] * X[0, 2] + pairs[1, 2] * X[2, 0],
        pairs[2, 2] * X[0, 1] + pairs[2, 1] * X[1, 0],
        a01 * X[0, 0] + work[SCALING + 1, i] * X[1, 1] + a12 * X[2, 2],
        pairs[0, 0] * X[1, 2] + pairs[0, 2] * X[2, 1],
        pairs[1, 2] * X[0, 2] + pairs[1, 1] * X[2, 0],
        pairs[0, 2] * X[1, 2] + pairs[0, 1] * X[2, 1],
        a02 * X[0, 0] + a12 * X[1, 1] + work[SCALING + 2, i] * X[2, 2],
    )
    # fmt: on


@wp.kernel
def product_particles(
    start: int,
    # In:
    width: int,
    spacing: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    values: wp.array[wp.vec4],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    values_out: wp.array[wp.vec4],
):
    """`product_blocks`, added to the grid itself."""
    i = start + wp.tid()
    inverse = 1.0 / spacing
    C = gradient_at(i, width, inverse, owners, coords, neighbors, values, particles)
    U = read_matrix(work, LEFT, i)
    B = read_matrix(work, RIGHT, i)
    G = U * answer(wp.transpose(U) * C * B, i, work) * wp.transpose(B)
    scatter_at(i, width, inverse, owners, coords, neighbors, particles, G, values_out)


@wp.func
def block_of_node(q: wp.vec3, U: wp.mat33, i: int, work: wp.array2d[float]) -> wp.mat33:
    """What particle i adds to the diagonal block of a node at B^T r = q."""
    K = wp.mat33()
    for k in range(3):
        K[k, k] = work[SCALING + k, i] * q[k] * q[k]
    for k in range(3):
        m = wp.where(k == 0, 1, 0)
        c = wp.where(k == 2, 1, 2)
        K[m, m] = K[m, m] + work[PAIRS + 3 * k, i] * q[c] * q[c]
        K[c, c] = K[c, c] + work[PAIRS + 3 * k + 1, i] * q[m] * q[m]
        off = (work[SCALING + 5 - k, i] + work[PAIRS + 3 * k + 2, i]) * q[m] * q[c]
        K[m, c] = off
        K[c, m] = off
    return U * K * wp.transpose(U)


@wp.kernel
def diagonal_particles(
    start: int,
    # In:
    width: int,
    spacing: float,
    owners: wp.array[int],
    coords: wp.array[wp.vec3i],
    neighbors: wp.array[int],
    particles: wp.array2d[float],
    work: wp.array2d[float],
    # Out:
    values_out: wp.array[wp.vec4],
    more_out: wp.array[wp.vec4],
):
    """`diagonal_blocks`, added to the grid itself."""
    i = start + wp.tid()
    inverse = 1.0 / spacing
    base, f, w = spline_weights(read_vector(particles, POSITION, i), inverse, width)
    block = owners[i]
    first = base - BLOCK * coords[block]
    U = read_matrix(work, LEFT, i)
    turned = lever(width, inverse) * wp.transpose(read_matrix(work, RIGHT, i))
    for a in range(width):
        for b in range(width):
            for c in range(width):
                weight = w[0, a] * w[1, b] * w[2, c]
                q = turned * (wp.vec3(float(a), float(b), float(c)) - f)
                K = (weight * weight) * block_of_node(q, U, i, work)
                node = node_index(neighbors, block, first + wp.vec3i(a, b, c))
                wp.atomic_add(values_out, node, wp.vec4(K[0, 0], K[1, 1], K[2, 2], 0.0))
                wp.atomic_add(more_out, node, wp.vec4(K[0, 1], K[0, 2], K[1, 2], 0.0))
