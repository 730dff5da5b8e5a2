"""Conjugate gradients preconditioned by a symmetric block Gauss-Seidel sweep, on one CPU thread.

With A = L + D + L^T by 3x3 blocks, M = (D + L) D^-1 (D + L)^T. In the variables of the sweep a step of
conjugate gradients takes one backward and one forward substitution and no product with A (Eisenstat 1981,
"Efficient implementation of a class of preconditioned conjugate gradient methods", SIAM J. Sci. Stat. Comput.
2(1)): about what a step with a block Jacobi preconditioner costs, and two to three times fewer of them. What
is in A and not in L + D + L^T (`extra`, G^T C G) comes in between the two substitutions; D, the blocks of
`inverse_diagonal`, may then be A's diagonal with theirs.

    r' = (D + L)^-1 r     z = D r'     p the direction in these variables, t = (D + L)^-T p that of x
    A t = (D + L) q       q = t + y    y = (D + L)^-1 s,   s = A t - (D + L) t

D q = a + s' with a = D t = p - L^T t and s' = D y, the right-hand side once its row's turn has come.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.linalg import CG_DONE, CG_ITERATIONS, CG_RZ, CG_RZ_START, VECTORS

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

WORK = 28
"""Numbers per row of `work`."""

_SOLVE = f"""
#if !defined(__CUDACC__)
    {VECTORS}
    const double* const entries = (const double*)values.data;
    const double* const extra = (const double*)extra_values.data;
    const double* const inverse = (const double*)inverse_diagonal.data;
    const double* const b = (const double*)right_hand_side.data;
    double* const solution = (double*)x_out.data;
    double* const residual = (double*)r_out.data;
    const size_t size = 4 * (size_t)rows;
    double* const r = work.data;
    double* const z = r + size;
    double* const p = z + size;
    double* const t = p + size;
    double* const q = t + size;
    double* const s = q + size;
    double* const x = s + size;
    double* const scalars = scalars_out.data;
    const bool averaged = curvature.shape[0] > 0;
    const double* const forward_ = (const double*)forward.data;

    auto multiply = [&](const double* m, D v) {{
        // The rows of a symmetric matrix are its columns.
        D found = load(m) * (D)v[0];
        found += load(m + 3) * (D)v[1];
        found += last_row(m) * (D)v[2];
        found[3] = 0.0;
        return found;
    }};
    auto free = [&](int i) {{ return inverse[9 * (size_t)i] != 0.0; }};
    // Takes L v_i from the rows of `to` below row i.
    auto push = [&](int i, D v, double* to) {{
        const D v0 = (D)v[0], v1 = (D)v[1], v2 = (D)v[2];
        int k = diagonal.data[i];
        const double* m = entries + 9 * (size_t)k;
        const int end = offsets.data[i + 1];
        for (++k; k < end; ++k) {{
            m += 9;
            double* const other = to + 4 * (size_t)columns.data[k];
            D found = load(other);
            found -= load(m) * v0;
            found -= load(m + 3) * v1;
            found -= last_row(m) * v2;
            store(other, found);
        }}
    }};
    // Row i of a product, blocks begin .. end - 1.
    auto pull = [&](const double* m, const int* column, int begin, int end, const double* from) {{
        D s0 = (D)0.0, s1 = s0, s2 = s0;
        for (int k = begin; k < end; ++k) {{
            const D w = load(from + 4 * (size_t)column[k]);
            const double* const block = m + 9 * (size_t)k;
            s0 += load(block) * w;
            s1 += load(block + 3) * w;
            s2 += last_row(block) * w;
        }}
        const D found = {{(s0[0] + s0[1]) + s0[2], (s1[0] + s1[1]) + s1[2], (s2[0] + s2[1]) + s2[2], 0.0}};
        return found;
    }};

    double rz = 0.0;
    for (int i = 0; i < rows; ++i) {{
        const D v = {{b[3 * (size_t)i], b[3 * (size_t)i + 1], b[3 * (size_t)i + 2], 0.0}};
        store(z + 4 * (size_t)i, v);
        store(p + 4 * (size_t)i, (D)0.0);
        store(x + 4 * (size_t)i, (D)0.0);
    }}
    for (int i = 0; i < rows; ++i) {{
        const D v = load(z + 4 * (size_t)i), found = multiply(inverse + 9 * (size_t)i, v);
        store(r + 4 * (size_t)i, found);
        push(i, found, z);
        rz += dot(v, found);
    }}
    scalars[{CG_RZ_START}] = rz;
    const double target = rz * tolerance * tolerance;
    double beta = 0.0;
    int iteration = 0;
    bool done = rz == 0.0, definite = rz >= 0.0;
    while (!done && definite && iteration < max_iterations) {{
        for (int i = rows - 1; i >= 0; --i) {{
            const size_t at = 4 * (size_t)i;
            const D ahead = pull(entries, columns.data, diagonal.data[i] + 1, offsets.data[i + 1], t);
            const D direction = free(i) ? load(z + at) + beta * load(p + at) : (D)0.0;
            const D a = free(i) ? direction - ahead : (D)0.0;
            const D found = multiply(inverse + 9 * (size_t)i, a);
            store(p + at, direction);
            store(q + at, a);
            store(t + at, found);
            // A t - (D + L) t of this row, where D is A's own diagonal: L^T t.
            store(s + at, averaged
                ? ahead - a + multiply(entries + 9 * (size_t)diagonal.data[i], found) : ahead);
        }}
        if (coupled) for (int i = 0; i < rows; ++i) {{
            const size_t at = 4 * (size_t)i;
            store(s + at, load(s + at)
                + pull(extra, extra_columns.data, extra_offsets.data[i], extra_offsets.data[i + 1], t));
        }}
        if (averaged) for (int i = 0; i < rows; ++i) {{
            // s += G^T C G t, each row of G read once; spare numbers of s collect what is never used.
            D total = (D)0.0;
            const int begin = offsets.data[i], end = offsets.data[i + 1];
            for (int k = begin; k < end; ++k)
                total += load(forward_ + 3 * (size_t)k) * load(t + 4 * (size_t)columns.data[k]);
            const D change = (D)(curvature.data[i] * ((total[0] + total[1]) + total[2]));
            for (int k = begin; k < end; ++k) {{
                double* const to = s + 4 * (size_t)columns.data[k];
                store(to, load(to) + change * load(forward_ + 3 * (size_t)k));
            }}
        }}
        double pq = 0.0;
        for (int i = 0; i < rows; ++i) {{
            const size_t at = 4 * (size_t)i;
            const D right = load(s + at), y = multiply(inverse + 9 * (size_t)i, right);
            push(i, y, s);
            const D moved = load(t + at) + y;
            store(s + at, load(q + at) + right);
            store(q + at, moved);
            pq += dot(load(p + at), moved);
        }}
        definite = pq > 0.0;
        if (!definite) break;
        const double alpha = rz / pq;
        const double previous = rz;
        rz = 0.0;
        for (int i = 0; i < rows; ++i) {{
            const size_t at = 4 * (size_t)i;
            const D left = load(r + at) - alpha * load(q + at), scaled = load(z + at) - alpha * load(s + at);
            store(x + at, load(x + at) + alpha * load(t + at));
            store(r + at, left);
            store(z + at, scaled);
            rz += dot(left, scaled);
        }}
        beta = rz / previous;
        ++iteration;
        definite = rz >= 0.0;
        done = definite && rz <= target;
    }}
    // r = (D + L) r'
    for (int i = rows - 1; i >= 0; --i) push(i, -load(r + 4 * (size_t)i), z);
    for (int i = 0; i < rows; ++i)
        for (int j = 0; j < 3; ++j) {{
            solution[3 * (size_t)i + j] = x[4 * (size_t)i + j];
            residual[3 * (size_t)i + j] = z[4 * (size_t)i + j];
        }}
    scalars[{CG_RZ}] = rz;
    scalars[{CG_ITERATIONS}] = iteration;
    scalars[{CG_DONE}] = done ? 1.0 : definite ? 0.0 : -1.0;
#endif
"""


@wp.func_native(_SOLVE)
def solve_rows(
    rows: int,
    max_iterations: int,
    tolerance: wp.float64,
    coupled: bool,
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    extra_offsets: wp.array[wp.int32],
    extra_columns: wp.array[wp.int32],
    extra_values: wp.array[wp.mat33d],
    forward: wp.array[wp.vec3d],
    curvature: wp.array[wp.float64],
    inverse_diagonal: wp.array[wp.mat33d],
    right_hand_side: wp.array[wp.vec3d],
    work: wp.array[wp.float64],
    r_out: wp.array[wp.vec3d],
    x_out: wp.array[wp.vec3d],
    scalars_out: wp.array[wp.float64],
): ...


@wp.kernel
def gauss_seidel_cg(
    _start: int,
    # In:
    rows: int,
    max_iterations: int,
    tolerance: wp.float64,
    coupled: bool,
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    diagonal: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    extra_offsets: wp.array[wp.int32],
    extra_columns: wp.array[wp.int32],
    extra_values: wp.array[wp.mat33d],
    forward: wp.array[wp.vec3d],
    curvature: wp.array[wp.float64],
    inverse_diagonal: wp.array[wp.mat33d],
    right_hand_side: wp.array[wp.vec3d],
    # Work:
    work: wp.array[wp.float64],
    # Out:
    r_out: wp.array[wp.vec3d],
    x_out: wp.array[wp.vec3d],
    scalars_out: wp.array[wp.float64],
):
    """Solve A x = b; launch with dim 1 on a CPU.

    Stops when r.M^-1 r has fallen by tolerance^2. `values` is symmetric as a whole, each row's columns
    ascending; `diagonal` [rows] holds the places of its diagonal; `extra` blocks count where `coupled`, and
    G^T C G (`forward`, `curvature`) where there is any. Rows whose inverse is zero stay where they are.
    """
    solve_rows(
        rows,
        max_iterations,
        tolerance,
        coupled,
        offsets,
        columns,
        diagonal,
        values,
        extra_offsets,
        extra_columns,
        extra_values,
        forward,
        curvature,
        inverse_diagonal,
        right_hand_side,
        work,
        r_out,
        x_out,
        scalars_out,
    )
