"""Deformation gradients, singular values and stiffness blocks of elements side by side, float64.

A group is `LANES` elements on a CPU, one on a GPU. What belongs to the whole mesh and to no material is done
for a group at once in vectors: F and its singular value decomposition before the constitutive law, forces
and the ten 3x3 blocks after it. The law works on one element at a time between the two. What they hand each
other stands in `work`: number `slot` of lane j of a group at work[(place WORK + slot) lanes + j].

    F       9  deformation gradient, row by row
    S       3  singular values, as `gdpro_sim.kernels.decomposition.singular_value_decomposition` orders them
    U       9  left singular vectors in columns, row by row
    V       9  right ones
    G       9  gradients of the shape functions 1..3 in the frame of the right singular vectors, row by row
    A       9  Hessian over the diagonal of the rotated F, symmetric
    PAIRS   9  (F_ij, F_ij), (F_ji, F_ji), (F_ij, F_ji) of the Hessian for (i, j) = (1, 2), (0, 2), (0, 1)
    STRESS  9  first Piola-Kirchhoff stress, row by row

The Hessian of an isotropic law, over the rotated F, splits into these (Smith, de Goes & Kim 2019, "Analytic
eigensystems for isotropic distortion energies", ACM TOG 38(1)).
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import JACOBI_SWEEPS
from gdpro_sim.kernels.lanes import CPU_FLAGS

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

LANES = 8
"""Elements of a group on a CPU."""

WORK = wp.constant(66)
F_SLOT = wp.constant(0)
S_SLOT = wp.constant(9)
U_SLOT = wp.constant(12)
V_SLOT = wp.constant(21)
G_SLOT = wp.constant(30)
A_SLOT = wp.constant(39)
PAIR_SLOT = wp.constant(48)
STRESS_SLOT = wp.constant(57)


def _merge(half: int) -> tuple[str, str]:
    """Lane numbers that interleave two vectors: the first's where bit `half` of the lane is clear."""
    low = [j if not j & half else LANES + j - half for j in range(LANES)]
    high = [j + half if not j & half else LANES + j for j in range(LANES)]
    return ", ".join(map(str, low)), ", ".join(map(str, high))


_TRANSPOSE = "".join(
    f"""
        for (int i = 0; i < {LANES}; ++i) {{
            if (i & {half}) continue;
            const D v = rows[i], w = rows[i + {half}];
            rows[i] = __builtin_shufflevector(v, w, {_merge(half)[0]});
            rows[i + {half}] = __builtin_shufflevector(v, w, {_merge(half)[1]});
        }}"""
    for half in (4, 2, 1)
)

_PRELUDE = f"""
    // D: one double per lane; B: a mask.
#if defined(__CUDACC__)
    const int LANES = 1;
#else
    const int LANES = {LANES};
#endif
    const int first = group * LANES;
    const int lanes = count - first < LANES ? count - first : LANES;
    double* const shared = work.data + (size_t)place * ({WORK} * LANES);
#if defined(__CUDACC__)
    typedef double D;
    auto get = [&](int slot) {{ return shared[slot]; }};
    auto put = [&](int slot, D v) {{ shared[slot] = v; }};
    typedef bool B;
    auto load = [&](const double* p, int) {{ return *p; }};
    auto store_rows = [&](double* p, int, int count, D* rows) {{
        for (int i = 0; i < count; ++i) p[i] = rows[i];
    }};
    auto splat = [](double x) {{ return x; }};
    auto sqrt_ = [](D v) {{ return sqrt(v); }};
    auto abs_ = [](D v) {{ return fabs(v); }};
    auto select = [](B mask, D v, D w) {{ return mask ? v : w; }};
    auto any = [](B mask) {{ return mask; }};
#else
    typedef double D __attribute__((ext_vector_type({LANES})));
    typedef decltype(D() < D()) B;
    auto get = [&](int slot) {{ D v; __builtin_memcpy(&v, shared + slot * LANES, sizeof(D)); return v; }};
    auto put = [&](int slot, D v) {{ __builtin_memcpy(shared + slot * LANES, &v, sizeof(D)); }};
    auto load = [&](const double* p, int stride) {{
        D v;
        for (int j = 0; j < {LANES}; ++j) v[j] = p[(size_t)(j < lanes ? j : lanes - 1) * stride];
        return v;
    }};
    // Number i of lane j to p[j stride + i], i < count.
    auto store_rows = [&](double* p, int stride, int count, D* values) {{
        int first = 0;
        for (; first + {LANES} <= count; first += {LANES}) {{
            D* const rows = values + first;
            {_TRANSPOSE}
            for (int j = 0; j < lanes; ++j)
                __builtin_memcpy(p + (size_t)j * stride + first, &rows[j], sizeof(D));
        }}
        for (; first < count; ++first)
            for (int j = 0; j < lanes; ++j) p[(size_t)j * stride + first] = values[first][j];
    }};
    auto splat = [](double x) {{ return (D)x; }};
    auto sqrt_ = [](D v) {{ return __builtin_elementwise_sqrt(v); }};
    auto abs_ = [](D v) {{ return __builtin_elementwise_abs(v); }};
    auto select = [](B mask, D v, D w) {{ return mask ? v : w; }};
    auto any = [](B mask) {{ return __builtin_reduce_or(mask) != 0; }};
#endif
"""

_ROTATE = """
        // One Jacobi rotation of the plane ({p}, {q}); {k} is the third axis.
        {{
            const D d = a{q}{q} - a{p}{p}, twice = 2.0 * a{pq};
            const D size = abs_(d) + sqrt_(d * d + twice * twice);
            const D up = twice / select(size > 0.0, size, splat(1.0));
            const D t = select(d < 0.0, -up, up);
            const D c = 1.0 / sqrt_(1.0 + t * t), s = t * c;
            a{p}{p} -= t * a{pq};
            a{q}{q} += t * a{pq};
            a{pq} = splat(0.0);
            const D low = c * a{pk} - s * a{qk};
            a{qk} = s * a{pk} + c * a{qk};
            a{pk} = low;
            for (int i = 0; i < 3; ++i) {{
                const D v = c * v{p}[i] - s * v{q}[i];
                v{q}[i] = s * v{p}[i] + c * v{q}[i];
                v{p}[i] = v;
            }}
        }}
"""

_ORDER = """
    {{
        const B swap = e{p} < e{q};
        const D e = select(swap, e{q}, e{p});
        e{q} = select(swap, e{p}, e{q});
        e{p} = e;
        for (int i = 0; i < 3; ++i) {{
            const D v = select(swap, v{q}[i], v{p}[i]);
            v{q}[i] = select(swap, v{p}[i], v{q}[i]);
            v{p}[i] = v;
        }}
    }}
"""

_DECOMPOSE = f"""
{_PRELUDE}
    const int* const corners = (const int*)(tets.data + first);
    const double* const points = (const double*)x.data;
    D X[4][3], B_[9], F[9];
    for (int a = 0; a < 4; ++a)
        for (int i = 0; i < 3; ++i) {{
#if defined(__CUDACC__)
            X[a][i] = points[3 * (size_t)corners[a] + i];
#else
            for (int j = 0; j < LANES; ++j)
                X[a][i][j] = points[3 * (size_t)corners[4 * (j < lanes ? j : lanes - 1) + a] + i];
#endif
        }}
    const double* const inverse = (const double*)(inverse_rest.data + first);
    for (int i = 0; i < 9; ++i) B_[i] = load(inverse + i, 9);
    for (int i = 0; i < 3; ++i) {{
        const D d1 = X[1][i] - X[0][i], d2 = X[2][i] - X[0][i], d3 = X[3][i] - X[0][i];
        for (int j = 0; j < 3; ++j) {{
            F[3 * i + j] = d1 * B_[j] + d2 * B_[3 + j] + d3 * B_[6 + j];
            put({F_SLOT} + 3 * i + j, F[3 * i + j]);
        }}
    }}

    // Cyclic Jacobi sweeps on F^T F until every lane's is diagonal.
    D a00 = F[0] * F[0] + F[3] * F[3] + F[6] * F[6];
    D a11 = F[1] * F[1] + F[4] * F[4] + F[7] * F[7];
    D a22 = F[2] * F[2] + F[5] * F[5] + F[8] * F[8];
    D a01 = F[0] * F[1] + F[3] * F[4] + F[6] * F[7];
    D a02 = F[0] * F[2] + F[3] * F[5] + F[6] * F[8];
    D a12 = F[1] * F[2] + F[4] * F[5] + F[7] * F[8];
    D v0[3] = {{splat(1.0), splat(0.0), splat(0.0)}};
    D v1[3] = {{splat(0.0), splat(1.0), splat(0.0)}};
    D v2[3] = {{splat(0.0), splat(0.0), splat(1.0)}};
    for (int sweep = 0; sweep < {JACOBI_SWEEPS}; ++sweep) {{
        const D off = a01 * a01 + a02 * a02 + a12 * a12;
        if (!any(off > 1.0e-24 * (a00 * a00 + a11 * a11 + a22 * a22))) break;
        {_ROTATE.format(p=0, q=1, k=2, pq="01", pk="02", qk="12")}
        {_ROTATE.format(p=0, q=2, k=1, pq="02", pk="01", qk="12")}
        {_ROTATE.format(p=1, q=2, k=0, pq="12", pk="01", qk="02")}
    }}
    D e0 = a00, e1 = a11, e2 = a22;
    {_ORDER.format(p=0, q=1)}
    {_ORDER.format(p=0, q=2)}
    {_ORDER.format(p=1, q=2)}
    v2[0] = v0[1] * v1[2] - v0[2] * v1[1];
    v2[1] = v0[2] * v1[0] - v0[0] * v1[2];
    v2[2] = v0[0] * v1[1] - v0[1] * v1[0];

    // Left vectors from F V by Gram and Schmidt, as in `singular_value_decomposition`.
    D u0[3], u1[3], u2[3];
    for (int i = 0; i < 3; ++i) u0[i] = F[3 * i] * v0[0] + F[3 * i + 1] * v0[1] + F[3 * i + 2] * v0[2];
    const D s0 = sqrt_(u0[0] * u0[0] + u0[1] * u0[1] + u0[2] * u0[2]);
    for (int i = 0; i < 3; ++i) u0[i] = u0[i] / s0;
    for (int i = 0; i < 3; ++i) u1[i] = F[3 * i] * v1[0] + F[3 * i + 1] * v1[1] + F[3 * i + 2] * v1[2];
    const D along = u1[0] * u0[0] + u1[1] * u0[1] + u1[2] * u0[2];
    for (int i = 0; i < 3; ++i) u1[i] -= along * u0[i];
    const D s1 = sqrt_(u1[0] * u1[0] + u1[1] * u1[1] + u1[2] * u1[2]);
    const B line = s1 <= 1.0e-12 * s0;
    for (int i = 0; i < 3; ++i) u1[i] = u1[i] / select(line, splat(1.0), s1);
    if (any(line)) {{
        const B steep = abs_(u0[0]) > 0.7;
        D w[3] = {{select(steep, -u0[2], splat(0.0)), select(steep, splat(0.0), u0[2]),
            select(steep, u0[0], -u0[1])}};
        const D size = sqrt_(w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
        for (int i = 0; i < 3; ++i) u1[i] = select(line, w[i] / size, u1[i]);
    }}
    u2[0] = u0[1] * u1[2] - u0[2] * u1[1];
    u2[1] = u0[2] * u1[0] - u0[0] * u1[2];
    u2[2] = u0[0] * u1[1] - u0[1] * u1[0];
    D s2 = splat(0.0);
    for (int i = 0; i < 3; ++i)
        s2 += u2[i] * (F[3 * i] * v2[0] + F[3 * i + 1] * v2[1] + F[3 * i + 2] * v2[2]);
    put({S_SLOT}, s0);
    put({S_SLOT} + 1, s1);
    put({S_SLOT} + 2, s2);
    for (int i = 0; i < 3; ++i) {{
        put({U_SLOT} + 3 * i, u0[i]);
        put({U_SLOT} + 3 * i + 1, u1[i]);
        put({U_SLOT} + 3 * i + 2, u2[i]);
        put({V_SLOT} + 3 * i, v0[i]);
        put({V_SLOT} + 3 * i + 1, v1[i]);
        put({V_SLOT} + 3 * i + 2, v2[i]);
        put({G_SLOT} + 3 * i, B_[3 * i] * v0[0] + B_[3 * i + 1] * v0[1] + B_[3 * i + 2] * v0[2]);
        put({G_SLOT} + 3 * i + 1, B_[3 * i] * v1[0] + B_[3 * i + 1] * v1[1] + B_[3 * i + 2] * v1[2]);
        put({G_SLOT} + 3 * i + 2, B_[3 * i] * v2[0] + B_[3 * i + 1] * v2[1] + B_[3 * i + 2] * v2[2]);
    }}
"""


@wp.func_native(_DECOMPOSE)
def decompose_group(
    group: int,
    place: int,
    count: int,
    tets: wp.array[wp.vec4i],
    inverse_rest: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    work: wp.array[wp.float64],
):
    """F, S, U and G of one group of `count` elements at x."""
    ...


_DERIVATIVES = f"""
{_PRELUDE}
    D U[9], G[9], P[9];
    for (int i = 0; i < 9; ++i) {{
        U[i] = get({U_SLOT} + i);
        G[i] = get({G_SLOT} + i);
        P[i] = get({PAIR_SLOT} + i);
    }}
    const D A00 = get({A_SLOT}), A01 = get({A_SLOT} + 1), A02 = get({A_SLOT} + 2), A11 = get({A_SLOT} + 4),
        A12 = get({A_SLOT} + 5), A22 = get({A_SLOT} + 8);
    const D scale = load(volume.data + first, 1);

    // Block (a, b) = V U K U^T with K over the rotated shape gradients; those of corner 0 follow from the
    // others because the gradients of all four sum to zero.
    D out[90];
    D* const k11 = out + 36, *const k12 = out + 45, *const k13 = out + 54, *const k22 = out + 63,
        *const k23 = out + 72, *const k33 = out + 81;
    D* const slots[3][3] = {{{{k11, k12, k13}}, {{k12, k22, k23}}, {{k13, k23, k33}}}};
    for (int n = 0; n < 3; ++n)
        for (int m = n; m < 3; ++m) {{
            const D a0 = G[3 * n], a1 = G[3 * n + 1], a2 = G[3 * n + 2];
            const D b0 = G[3 * m], b1 = G[3 * m + 1], b2 = G[3 * m + 2];
            const D p00 = a0 * b0, p11 = a1 * b1, p22 = a2 * b2, p01 = a0 * b1, p10 = a1 * b0, p02 = a0 * b2,
                p20 = a2 * b0, p12 = a1 * b2, p21 = a2 * b1;
            const D K[9] = {{
                A00 * p00 + P[6] * p11 + P[3] * p22, A01 * p01 + P[8] * p10, A02 * p02 + P[5] * p20,
                A01 * p10 + P[8] * p01, A11 * p11 + P[7] * p00 + P[0] * p22, A12 * p12 + P[2] * p21,
                A02 * p20 + P[5] * p02, A12 * p21 + P[2] * p12, A22 * p22 + P[4] * p00 + P[1] * p11}};
            D UK[9];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    UK[3 * i + j] = scale
                        * (U[3 * i] * K[j] + U[3 * i + 1] * K[3 + j] + U[3 * i + 2] * K[6 + j]);
            D* const block = slots[n][m];
            for (int i = 0; i < 3; ++i)
                for (int j = 0; j < 3; ++j)
                    block[3 * i + j] = UK[3 * i] * U[3 * j] + UK[3 * i + 1] * U[3 * j + 1]
                        + UK[3 * i + 2] * U[3 * j + 2];
        }}
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) {{
            const int at = 3 * i + j, flipped = 3 * j + i;
            out[9 + at] = -(k11[at] + k12[flipped] + k13[flipped]);
            out[18 + at] = -(k12[at] + k22[at] + k23[flipped]);
            out[27 + at] = -(k13[at] + k23[at] + k33[at]);
            out[at] = -(out[9 + at] + out[18 + at] + out[27 + at]);
        }}
    store_rows((double*)(blocks_out.data + 10 * (size_t)first), 90, 90, out);

    // Forces V P grad N of corners 1..3, and what balances them.
    const double* const inverse = (const double*)(inverse_rest.data + first);
    D forces[12];
    for (int a = 1; a < 4; ++a) {{
        const D g0 = scale * load(inverse + 3 * a - 3, 9), g1 = scale * load(inverse + 3 * a - 2, 9),
            g2 = scale * load(inverse + 3 * a - 1, 9);
        for (int i = 0; i < 3; ++i)
            forces[3 * a + i] = get({STRESS_SLOT} + 3 * i) * g0 + get({STRESS_SLOT} + 3 * i + 1) * g1
                + get({STRESS_SLOT} + 3 * i + 2) * g2;
    }}
    for (int i = 0; i < 3; ++i) forces[i] = -(forces[3 + i] + forces[6 + i] + forces[9 + i]);
    store_rows((double*)(gradient_out.data + 4 * (size_t)first), 12, 12, forces);
"""


@wp.func_native(_DERIVATIVES)
def write_derivatives_group(
    group: int,
    place: int,
    count: int,
    inverse_rest: wp.array[wp.mat33d],
    volume: wp.array[wp.float64],
    work: wp.array[wp.float64],
    gradient_out: wp.array[wp.vec3d],
    blocks_out: wp.array[wp.mat33d],
):
    """Gradient (4 vectors) and Hessian (10 blocks, a <= b, row by row) of each element of one group.

    From STRESS, and from U, G, A and PAIRS.
    """
    ...


@wp.func_native(f"""
#if !defined(__CUDACC__)
    const int first = group * {LANES}, lanes = count - first < {LANES} ? count - first : {LANES};
    const char* const begin = (const char*)(blocks.data + 10 * (size_t)first);
    for (int i = 0; i < lanes * 720; i += 64) __builtin_prefetch(begin + i, 1);
#endif
""")
def fetch_blocks_group(group: int, count: int, blocks: wp.array[wp.mat33d]):
    """Fetch the memory that a group's blocks are to be written to, while they are computed."""
    ...


@wp.func
def read_vector(work: wp.array[wp.float64], at: int, lanes: int, slot: int) -> wp.vec3d:
    """Numbers slot .. slot + 2 of an element; `at` is the place of its number 0."""
    k = at + slot * lanes
    return wp.vec3d(work[k], work[k + lanes], work[k + 2 * lanes])


@wp.func
def read_matrix(work: wp.array[wp.float64], at: int, lanes: int, slot: int) -> wp.mat33d:
    """Numbers slot .. slot + 8, row by row."""
    return wp.matrix_from_rows(
        read_vector(work, at, lanes, slot),
        read_vector(work, at, lanes, slot + 3),
        read_vector(work, at, lanes, slot + 6),
    )


@wp.func
def write_matrix(m: wp.mat33d, at: int, lanes: int, slot: int, work: wp.array[wp.float64]):
    """The other way."""
    for i in range(3):
        for j in range(3):
            work[at + (slot + 3 * i + j) * lanes] = m[i, j]
