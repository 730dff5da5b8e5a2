"""C++ text shared by the native snippets of the splatting kernels: vectors of pixel or Gaussian lanes.

`PRELUDE` opens a snippet. It defines a float vector `F` and an int vector `I` of `LANES` lanes, 16 on a CPU
and one on a GPU, and the functions below, so that the same text works on 16 Gaussians at once on a CPU and on
one per thread on a GPU. The snippet must declare `const int lanes` before: how many lanes hold something.

    load(p, stride)        lane j from p[j stride]; lanes past the last repeat it
    store(p, stride, v)    lane j to p[j stride], where j < lanes
    add(p, stride, v)      the same, added to what is there
    load_rows(p, stride, rows)   lane j of rows[i] from p[j stride + i], i < 16
    store_rows(p, stride, rows)  the other way; leaves `rows` changed
    load3(p, out), load4(p, out)   lane j of out[i] from p[3 j + i], p[4 j + i]
    store3(p, in), store4(p, in)   the other way
    splat(x)               x in all lanes
    sqrt_(v), min_(v, w), max_(v, w), abs_(v), floor_(v), ceil_(v), log2_(v)
    to_int(v), to_float(i), bits_of(v), of_bits(i)   by value, and by bits
    select(mask, v, w)     v where the mask is set, else w
    finite(v)              mask
    total(v)               sum of all lanes that hold something
    any(mask)              whether it is set in any lane

A mask is an `I`. `log2_` is for normal positive numbers, to 1 ulp near one and 2e-7 absolute elsewhere
(atanh series on [sqrt(1/2), sqrt(2)]). All text is plain C++ that clang (CPU) and NVRTC (GPU) take.
"""

from __future__ import annotations

import platform

X86 = platform.machine().lower() in ("x86_64", "amd64")
"""Other processors have no choice of vector width, and their compilers no such flag."""

CPU_FLAGS = "-march=native" + (" -mprefer-vector-width=512" if X86 else "")
"""`cpu_compiler_flags` of modules with such snippets."""


def _shuffles(half: int) -> tuple[str, str]:
    """Lane numbers that interleave two vectors: the first's where bit `half` of the lane is clear."""
    low = [j if not j & half else 16 + j - half for j in range(16)]
    high = [j + half if not j & half else 16 + j for j in range(16)]
    return ", ".join(map(str, low)), ", ".join(map(str, high))


TRANSPOSE = "".join(
    f"""
        for (int i = 0; i < 16; ++i) {{
            if (i & {half}) continue;
            const F v = rows[i], w = rows[i + {half}];
            rows[i] = __builtin_shufflevector(v, w, {_shuffles(half)[0]});
            rows[i + {half}] = __builtin_shufflevector(v, w, {_shuffles(half)[1]});
        }}"""
    for half in (8, 4, 2, 1)
)

"""CPU text: transposes the 16 vectors F of `rows`."""


def _pick(sources: list[str], numbers: list[int]) -> str:
    """A vector whose lane j is number `numbers[j]` of the sources laid end to end, 16 numbers each."""
    picked = "(F)0.0f"
    for first in range(0, len(sources), 2):
        pair = sources[first : first + 2]
        here = [number - 16 * first if 0 <= number - 16 * first < 32 else -1 for number in numbers]
        joined = f"__builtin_shufflevector({pair[0]}, {pair[-1]}, {', '.join(map(str, here))})"
        lanes = [16 + j if here[j] >= 0 else j for j in range(16)]
        picked = (
            joined
            if first == 0
            else (f"__builtin_shufflevector({picked}, {joined}, {', '.join(map(str, lanes))})")
        )
    return picked


def _packed(n: int) -> str:
    """Text of `load{n}` and `store{n}`: lanes of n numbers each, side by side in memory."""
    loads = "".join(f"F v{m}; __builtin_memcpy(&v{m}, p + {16 * m}, 64); " for m in range(n))
    vectors = [f"v{m}" for m in range(n)]
    splits = "".join(f"out[{c}] = {_pick(vectors, [n * j + c for j in range(16)])}; " for c in range(n))
    parts = [f"in[{c}]" for c in range(n)]
    joins = "".join(
        f"const F v{m} = {_pick(parts, [16 * (f % n) + f // n for f in range(16 * m, 16 * m + 16)])}; "
        f"__builtin_memcpy(p + {16 * m}, &v{m}, 64); "
        for m in range(n)
    )
    return f"""
    auto load{n} = [&](const float* p, F* out) {{
        if (lanes == 16) {{ {loads} {splits} return; }}
        for (int i = 0; i < {n}; ++i) out[i] = load(p + i, {n});
    }};
    auto store{n} = [&](float* p, const F* in) {{
        if (lanes == 16) {{ {joins} return; }}
        for (int i = 0; i < {n}; ++i) store(p + i, {n}, in[i]);
    }};
"""


SUM_LANES = (
    "".join(
        f"""
    #define MERGE_{half}(v, w) (__builtin_shufflevector(v, w, {_shuffles(half)[0]}) \\
        + __builtin_shufflevector(v, w, {_shuffles(half)[1]}))"""
        for half in (8, 4, 2, 1)
    )
    + """
    // Lane i of the result is the sum over the lanes of s[i].
    auto sum_lanes = [](const F* s) {
        const F a0 = MERGE_8(s[0], s[8]), a1 = MERGE_8(s[1], s[9]), a2 = MERGE_8(s[2], s[10]),
            a3 = MERGE_8(s[3], s[11]), a4 = MERGE_8(s[4], s[12]), a5 = MERGE_8(s[5], s[13]),
            a6 = MERGE_8(s[6], s[14]), a7 = MERGE_8(s[7], s[15]);
        const F b0 = MERGE_4(a0, a4), b1 = MERGE_4(a1, a5), b2 = MERGE_4(a2, a6), b3 = MERGE_4(a3, a7);
        const F c0 = MERGE_2(b0, b2), c1 = MERGE_2(b1, b3);
        return MERGE_1(c0, c1);
    };
"""
)
"""CPU snippets only: `sum_lanes(s)` of an array of 16 vectors F, a transposing tree of sums."""

PRELUDE = (
    """
#if defined(__CUDACC__)
    const int LANES = 1;
    typedef float F;
    typedef int I;
    auto load = [&](const float* p, int) { return *p; };
    auto store = [&](float* p, int, F v) { *p = v; };
    auto add = [&](float* p, int, F v) { *p += v; };
    auto load_rows = [&](const float* p, int, F* rows) { for (int i = 0; i < 16; ++i) rows[i] = p[i]; };
    auto store_rows = [&](float* p, int, F* rows) { for (int i = 0; i < 16; ++i) p[i] = rows[i]; };
    auto load3 = [&](const float* p, F* out) { for (int i = 0; i < 3; ++i) out[i] = p[i]; };
    auto load4 = [&](const float* p, F* out) { for (int i = 0; i < 4; ++i) out[i] = p[i]; };
    auto store3 = [&](float* p, const F* in) { for (int i = 0; i < 3; ++i) p[i] = in[i]; };
    auto store4 = [&](float* p, const F* in) { for (int i = 0; i < 4; ++i) p[i] = in[i]; };
    auto splat = [](float x) { return x; };
    auto to_int = [](F v) { return (int)v; };
    auto to_float = [](I v) { return (float)v; };
    auto bits_of = [](F v) { return __float_as_int(v); };
    auto of_bits = [](I v) { return __int_as_float(v); };
    auto sqrt_ = [](F v) { return sqrtf(v); };
    auto min_ = [](F v, F w) { return fminf(v, w); };
    auto max_ = [](F v, F w) { return fmaxf(v, w); };
    auto abs_ = [](F v) { return fabsf(v); };
    auto floor_ = [](F v) { return floorf(v); };
    auto ceil_ = [](F v) { return ceilf(v); };
    auto select = [](I mask, F v, F w) { return mask ? v : w; };
    auto total = [](F v) { return v; };
    auto any = [](I mask) { return mask != 0; };
#else
    const int LANES = 16;
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    auto load = [&](const float* p, int stride) {
        F v;
        if (lanes == 16) {
            for (int j = 0; j < 16; ++j) v[j] = p[j * stride];
        } else {
            for (int j = 0; j < 16; ++j) v[j] = p[(j < lanes ? j : lanes - 1) * stride];
        }
        return v;
    };
    auto store = [&](float* p, int stride, F v) {
        for (int j = 0; j < 16; ++j) if (j < lanes) p[j * stride] = v[j];
    };
    auto add = [&](float* p, int stride, F v) {
        for (int j = 0; j < 16; ++j) if (j < lanes) p[j * stride] += v[j];
    };
    auto transpose = [](F* rows) {"""
    + TRANSPOSE
    + """
    };
    auto load_rows = [&](const float* p, int stride, F* rows) {
        for (int j = 0; j < 16; ++j) __builtin_memcpy(&rows[j],
            p + (j < lanes ? j : lanes - 1) * (size_t)stride, 64);
        transpose(rows);
    };
    auto store_rows = [&](float* p, int stride, F* rows) {
        transpose(rows);
        for (int j = 0; j < lanes; ++j) __builtin_memcpy(p + j * (size_t)stride, &rows[j], 64);
    };
"""
    + _packed(3)
    + _packed(4)
    + """
    auto splat = [](float x) { return (F)x; };
    auto to_int = [](F v) { return __builtin_convertvector(v, I); };
    auto to_float = [](I v) { return __builtin_convertvector(v, F); };
    auto bits_of = [](F v) { I b; __builtin_memcpy(&b, &v, 64); return b; };
    auto of_bits = [](I b) { F v; __builtin_memcpy(&v, &b, 64); return v; };
    auto sqrt_ = [](F v) { return __builtin_elementwise_sqrt(v); };
    auto min_ = [](F v, F w) { return __builtin_elementwise_min(v, w); };
    auto max_ = [](F v, F w) { return __builtin_elementwise_max(v, w); };
    auto abs_ = [](F v) { return __builtin_elementwise_abs(v); };
    auto floor_ = [](F v) { return __builtin_elementwise_floor(v); };
    auto ceil_ = [](F v) { return __builtin_elementwise_ceil(v); };
    auto select = [](I mask, F v, F w) { return mask ? v : w; };
    auto total = [&](F v) {
        float sum = 0.0f;
        for (int j = 0; j < 16; ++j) if (j < lanes) sum += v[j];
        return sum;
    };
    auto any = [&](I mask) { return __builtin_reduce_or(mask) != 0; };
#endif
    auto finite = [&](F v) { return abs_(v) <= splat(3.402823466e38f); };
    auto log2_ = [&](F v) {
        // v = 2^n m with m in [sqrt(1/2), sqrt(2)).
        const I shifted = bits_of(v) - 0x3f3504f3;
        const I n = shifted >> 23;
        const F m = of_bits((shifted & 0x007fffff) + 0x3f3504f3);
        const F t = (m - 1.0f) / (m + 1.0f);
        const F s = t * t;
        F e = s * 0.32059889f + 0.41219858f;
        e = e * s + 0.57707802f;
        e = e * s + 0.96179669f;
        e = e * s + 2.8853901f;
        return e * t + to_float(n);
    };
"""
)

__all__ = ["CPU_FLAGS", "PRELUDE", "SUM_LANES", "TRANSPOSE"]
