"""3x3 block-sparse rows, block-Jacobi preconditioned conjugate gradients, and sums in a fixed order.

Every sum is taken over ranges that depend on the problem's size alone, never on the number of threads, so
results are the same bytes for any thread count. `start` (first argument) is the index of the launch's first
item, see `gdpro_sim.device.launch_chunked`.

The `cg_*` steps run one phase of a solve per launch, spread over CPU threads or a CUDA device, with every
scalar kept in device memory; `gdpro_sim.kernels.gauss_seidel` has a whole solve inside one launch.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.lanes import CPU_FLAGS

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

# Slots of the scalar array that the conjugate gradient steps share.
CG_ALPHA = wp.constant(0)
CG_BETA = wp.constant(1)
CG_RZ = wp.constant(2)
CG_RZ_START = wp.constant(3)
CG_DONE = wp.constant(4)  # 1: converged, -1: the matrix or the preconditioner is not positive definite
CG_ITERATIONS = wp.constant(5)


VECTORS = """
    typedef double D __attribute__((ext_vector_type(4)));
    auto load = [](const double* p) { D v; __builtin_memcpy(&v, p, sizeof(D)); return v; };
    auto store = [](double* p, D v) { __builtin_memcpy(p, &v, sizeof(D)); };
    // Rows 0 and 1 of a 3x3 matrix m are load(m) and load(m + 3), with a number of the next row behind them.
    auto last_row = [&](const double* m) { return __builtin_shufflevector(load(m + 5), (D)0.0, 1, 2, 3, 4); };
    auto dot = [](D v, D w) { const D m = v * w; return (m[0] + m[1]) + m[2]; };
"""
"""CPU text: vectors of 4 numbers, for 3 and a spare one."""


@wp.func_native(f"""
    const int* const columns_ = columns.data;
    const double* const values_ = (const double*)values.data;
    const double* const x_ = (const double*)x.data;
#if defined(__CUDACC__)
    double s0 = 0.0, s1 = 0.0, s2 = 0.0;
    for (int k = begin; k < end; ++k) {{
        const double* m = values_ + 9 * (size_t)k;
        const double* v = x_ + 3 * (size_t)columns_[k];
        s0 += m[0] * v[0] + m[1] * v[1] + m[2] * v[2];
        s1 += m[3] * v[0] + m[4] * v[1] + m[5] * v[2];
        s2 += m[6] * v[0] + m[7] * v[1] + m[8] * v[2];
    }}
    return wp::vec3d(s0, s1, s2);
#else
    {VECTORS}
    D s0 = (D)0.0, s1 = s0, s2 = s0;
    for (int k = begin; k < end; ++k) {{
        const double* const m = values_ + 9 * (size_t)k;
        const double* const v = x_ + 3 * (size_t)columns_[k];
        const D w = {{v[0], v[1], v[2], 0.0}};
        s0 += load(m) * w;
        s1 += load(m + 3) * w;
        s2 += last_row(m) * w;
    }}
    return wp::vec3d((s0[0] + s0[1]) + s0[2], (s1[0] + s1[1]) + s1[2], (s2[0] + s2[1]) + s2[2]);
#endif
""")
def row_product(
    begin: int,
    end: int,
    columns: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
) -> wp.vec3d:
    """Sum over k in [begin, end) of values[k] x[columns[k]]."""
    ...


@wp.func_native("""
    const double* const m_ = (const double*)values.data;
    const double* const x_ = x.data;
    double* const out = product_out.data + 24 * (size_t)row;
#if defined(__CUDACC__)
    for (int k = begin; k < end; ++k) {
        const double* const m = m_ + 9 * (size_t)k;
        const double* const v = x_ + 24 * (size_t)columns.data[k];
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 6; ++j)
                out[8 * i + j] += m[3 * i] * v[j] + m[3 * i + 1] * v[8 + j] + m[3 * i + 2] * v[16 + j];
    }
#else
    typedef double D __attribute__((ext_vector_type(8)));
    D sums[3];
    __builtin_memcpy(sums, out, sizeof(sums));
    for (int k = begin; k < end; ++k) {
        const double* const m = m_ + 9 * (size_t)k;
        D v[3];
        __builtin_memcpy(v, x_ + 24 * (size_t)columns.data[k], sizeof(v));
        for (int i = 0; i < 3; ++i)
            sums[i] += v[0] * (D)m[3 * i] + v[1] * (D)m[3 * i + 1] + v[2] * (D)m[3 * i + 2];
    }
    __builtin_memcpy(out, sums, sizeof(sums));
#endif
""")
def add_row_product_six(
    row: int,
    begin: int,
    end: int,
    columns: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    x: wp.array[wp.float64],
    product_out: wp.array[wp.float64],
):
    """Add the sum over k in [begin, end) of values[k] x[columns[k]] to row `row`; see `product_six`."""
    ...


@wp.kernel
def product_six(
    start: int,
    # In:
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    extra_offsets: wp.array[wp.int32],
    extra_columns: wp.array[wp.int32],
    extra_values: wp.array[wp.mat33d],
    x: wp.array[wp.float64],
    # Out:
    product_out: wp.array[wp.float64],
):
    """A times six vectors at once, of which each vertex has 3 rows of 6 numbers and 2 spare ones."""
    i = start + wp.tid()
    for k in range(24):
        product_out[24 * i + k] = wp.float64(0.0)
    add_row_product_six(i, offsets[i], offsets[i + 1], columns, values, x, product_out)
    begin = extra_offsets[i]
    add_row_product_six(i, begin, extra_offsets[i + 1], extra_columns, extra_values, x, product_out)


@wp.func
def block_range(count: int, blocks: int, block: int) -> wp.vec2i:
    """The `block`-th of `blocks` contiguous ranges that cover `range(count)`."""
    size = (count + blocks - 1) // blocks
    begin = wp.min(block * size, count)
    return wp.vec2i(begin, wp.min(begin + size, count))


@wp.kernel
def sum_ranges(
    start: int,
    # In:
    count: int,
    ranges: int,
    terms: wp.array[wp.float64],
    # Out:
    sums_out: wp.array[wp.float64],
):
    """sums_out[i] = sum of `terms` over the i-th of `ranges` contiguous ranges."""
    i = start + wp.tid()
    bounds = block_range(count, ranges, i)
    total = wp.float64(0.0)
    for k in range(bounds[0], bounds[1]):
        total += terms[k]
    sums_out[i] = total


@wp.func_native("""
    // Blocks lie far apart: those of the next pairs are fetched while these are added.
    const double* const blocks_ = (const double*)blocks.data;
    const int* const codes = contributions.data;
    const int last = contributions.shape[0] - 1;
    double sum[9] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    for (int k = begin; k < end; ++k) {
#if !defined(__CUDACC__)
        const double* const next = blocks_ + 9 * (size_t)(codes[k + 16 < last ? k + 16 : last] >> 1);
        __builtin_prefetch(next);
        __builtin_prefetch(next + 8);
#endif
        const double* const m = blocks_ + 9 * (size_t)(codes[k] >> 1);
        if (codes[k] & 1) {
            for (int i = 0; i < 9; ++i) sum[i] += m[3 * (i % 3) + i / 3];
        } else {
            for (int i = 0; i < 9; ++i) sum[i] += m[i];
        }
    }
    return wp::mat33d(sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], sum[6], sum[7], sum[8]);
""")
def sum_blocks(
    begin: int,
    end: int,
    contributions: wp.array[wp.int32],
    blocks: wp.array[wp.mat33d],
) -> wp.mat33d:
    """Sum over k in [begin, end) of blocks[contributions[k] >> 1], transposed where the lowest bit is set."""
    ...


@wp.kernel
def gather_off_diagonal(
    start: int,
    # In:
    offsets: wp.array[wp.int32],
    contributions: wp.array[wp.int32],
    element_blocks: wp.array[wp.mat33d],
    upper: wp.array[wp.int32],
    lower: wp.array[wp.int32],
    # Out:
    values_out: wp.array[wp.mat33d],
):
    """Sum the element blocks of one off-diagonal pair into its two mirrored places.

    A contribution is 2 * (index of the element block) + (1 if it enters transposed).
    """
    i = start + wp.tid()
    total = sum_blocks(offsets[i], offsets[i + 1], contributions, element_blocks)
    values_out[upper[i]] = total
    values_out[lower[i]] = wp.transpose(total)


@wp.func
def cg_reset_row(
    i: int,
    right_hand_side: wp.array[wp.vec3d],
    inverse_diagonal: wp.array[wp.mat33d],
    x_out: wp.array[wp.vec3d],
    r_out: wp.array[wp.vec3d],
    z_out: wp.array[wp.vec3d],
    p_out: wp.array[wp.vec3d],
) -> wp.float64:
    r = right_hand_side[i]
    z = inverse_diagonal[i] * r
    x_out[i] = wp.vec3d()
    r_out[i] = r
    z_out[i] = z
    p_out[i] = wp.vec3d()
    return wp.dot(r, z)


@wp.func
def cg_update_row(
    i: int,
    alpha: wp.float64,
    p: wp.array[wp.vec3d],
    q: wp.array[wp.vec3d],
    inverse_diagonal: wp.array[wp.mat33d],
    x_out: wp.array[wp.vec3d],
    r_out: wp.array[wp.vec3d],
    z_out: wp.array[wp.vec3d],
) -> wp.float64:
    x_out[i] = x_out[i] + alpha * p[i]
    r = r_out[i] - alpha * q[i]
    z = inverse_diagonal[i] * r
    r_out[i] = r
    z_out[i] = z
    return wp.dot(r, z)


@wp.kernel
def cg_reset(
    start: int,
    # In:
    rows: int,
    blocks: int,
    right_hand_side: wp.array[wp.vec3d],
    inverse_diagonal: wp.array[wp.mat33d],
    # Out:
    x_out: wp.array[wp.vec3d],
    r_out: wp.array[wp.vec3d],
    z_out: wp.array[wp.vec3d],
    p_out: wp.array[wp.vec3d],
    dots_out: wp.array[wp.float64],
):
    block = start + wp.tid()
    bounds = block_range(rows, blocks, block)
    total = wp.float64(0.0)
    for i in range(bounds[0], bounds[1]):
        total += cg_reset_row(i, right_hand_side, inverse_diagonal, x_out, r_out, z_out, p_out)
    dots_out[block] = total


@wp.kernel
def cg_direction(
    start: int,
    # In:
    rows: int,
    blocks: int,
    z: wp.array[wp.vec3d],
    scalars: wp.array[wp.float64],
    # Out:
    p_out: wp.array[wp.vec3d],
):
    """p = z + beta p"""
    bounds = block_range(rows, blocks, start + wp.tid())
    beta = scalars[CG_BETA]
    for i in range(bounds[0], bounds[1]):
        p_out[i] = z[i] + beta * p_out[i]


@wp.kernel
def cg_change(
    start: int,
    # In:
    rows: int,
    blocks: int,
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    forward: wp.array[wp.vec3d],
    curvature: wp.array[wp.float64],
    p: wp.array[wp.vec3d],
    # Out:
    change_out: wp.array[wp.float64],
):
    """D G p"""
    bounds = block_range(rows, blocks, start + wp.tid())
    for i in range(bounds[0], bounds[1]):
        total = wp.float64(0.0)
        for k in range(offsets[i], offsets[i + 1]):
            total += wp.dot(forward[k], p[columns[k]])
        change_out[i] = curvature[i] * total


@wp.kernel
def cg_product(
    start: int,
    # In:
    rows: int,
    blocks: int,
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    values: wp.array[wp.mat33d],
    extra_offsets: wp.array[wp.int32],
    extra_columns: wp.array[wp.int32],
    extra_values: wp.array[wp.mat33d],
    transposed: wp.array[wp.vec3d],
    change: wp.array[wp.float64],
    p: wp.array[wp.vec3d],
    # Out:
    q_out: wp.array[wp.vec3d],
    dots_out: wp.array[wp.float64],
):
    """q = A p, and p.q per block of rows. `change` is that of `cg_change`, or empty."""
    block = start + wp.tid()
    bounds = block_range(rows, blocks, block)
    total = wp.float64(0.0)
    for i in range(bounds[0], bounds[1]):
        q = row_product(offsets[i], offsets[i + 1], columns, values, p)
        q += row_product(extra_offsets[i], extra_offsets[i + 1], extra_columns, extra_values, p)
        if change.shape[0] > 0:
            for k in range(offsets[i], offsets[i + 1]):
                q += change[columns[k]] * transposed[k]
        q_out[i] = q
        total += wp.dot(p[i], q)
    dots_out[block] = total


@wp.kernel
def cg_update(
    start: int,
    # In:
    rows: int,
    blocks: int,
    p: wp.array[wp.vec3d],
    q: wp.array[wp.vec3d],
    inverse_diagonal: wp.array[wp.mat33d],
    scalars: wp.array[wp.float64],
    # Out:
    x_out: wp.array[wp.vec3d],
    r_out: wp.array[wp.vec3d],
    z_out: wp.array[wp.vec3d],
    dots_out: wp.array[wp.float64],
):
    """x += alpha p, r -= alpha q, z = M^-1 r, and r.z per block of rows."""
    block = start + wp.tid()
    bounds = block_range(rows, blocks, block)
    alpha = scalars[CG_ALPHA]
    total = wp.float64(0.0)
    for i in range(bounds[0], bounds[1]):
        total += cg_update_row(i, alpha, p, q, inverse_diagonal, x_out, r_out, z_out)
    dots_out[block] = total


@wp.kernel
def cg_begin(
    _start: int,
    # In:
    count: int,
    dots: wp.array[wp.float64],
    _tolerance: wp.array[wp.float64],
    # Out:
    scalars_out: wp.array[wp.float64],
):
    total = wp.float64(0.0)
    for k in range(count):
        total += dots[k]
    scalars_out[CG_ALPHA] = wp.float64(0.0)
    scalars_out[CG_BETA] = wp.float64(0.0)
    scalars_out[CG_RZ] = total
    scalars_out[CG_RZ_START] = total
    scalars_out[CG_ITERATIONS] = wp.float64(0.0)
    scalars_out[CG_DONE] = wp.float64(0.0)
    if total == wp.float64(0.0):
        scalars_out[CG_DONE] = wp.float64(1.0)
    elif not (total > wp.float64(0.0)):
        scalars_out[CG_DONE] = wp.float64(-1.0)


@wp.kernel
def cg_set_alpha(
    _start: int,
    # In:
    count: int,
    dots: wp.array[wp.float64],
    _tolerance: wp.array[wp.float64],
    # Out:
    scalars_out: wp.array[wp.float64],
):
    """alpha = r.z / p.q; zero once done, so that steps taken past the end change nothing."""
    total = wp.float64(0.0)
    for k in range(count):
        total += dots[k]
    alpha = wp.float64(0.0)
    if scalars_out[CG_DONE] == wp.float64(0.0):
        if total > wp.float64(0.0):
            alpha = scalars_out[CG_RZ] / total
        else:
            scalars_out[CG_DONE] = wp.float64(-1.0)
    scalars_out[CG_ALPHA] = alpha


@wp.kernel
def cg_set_beta(
    _start: int,
    # In:
    count: int,
    dots: wp.array[wp.float64],
    tolerance: wp.array[wp.float64],
    # Out:
    scalars_out: wp.array[wp.float64],
):
    """beta = r.z / previous r.z; marks the solve done when r.z has fallen by tolerance^2."""
    total = wp.float64(0.0)
    for k in range(count):
        total += dots[k]
    if scalars_out[CG_DONE] == wp.float64(0.0):
        scalars_out[CG_BETA] = total / scalars_out[CG_RZ]
        scalars_out[CG_RZ] = total
        scalars_out[CG_ITERATIONS] = scalars_out[CG_ITERATIONS] + wp.float64(1.0)
        if not (total >= wp.float64(0.0)):
            scalars_out[CG_DONE] = wp.float64(-1.0)
        elif total <= scalars_out[CG_RZ_START] * tolerance[0] * tolerance[0]:
            scalars_out[CG_DONE] = wp.float64(1.0)
