"""The machine's own bound on blending: its arithmetic alone, in lane evaluations per second and core.

    python -m tests.benchmarks.vector_bound

One lane evaluation is what one pixel needs of one Gaussian: exponent, exp2, alpha, weight, four channels and
transmittance forward; the same again, the gradients and their sums backward. Both kernels do what
`gdpro_sim.kernels.compositing` does for a Gaussian and the 16 blocks of 16 pixels of a tile, on a table that
stays in the first-level cache: no lists, no tests of which block is reached, nothing skipped, no image read
or written. Every lane evaluated counts, while a renderer's pixels outside a Gaussian do not: no renderer with
this arithmetic reaches the bound, and two that use it can be compared by the fraction they reach.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import warp as wp

from gdpro_sim import device  # noqa: F401  (quiets Warp before it starts)
from gdpro_sim.kernels.compositing import ARITHMETIC
from tests.benchmarks.machine import VECTOR_FLAGS, machine

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": VECTOR_FLAGS,
    }
)

GAUSSIANS, ROW = 32, 16
"""Gaussians of a list and floats of each: 2 KB."""

_LANES = f"""
    typedef float F __attribute__((ext_vector_type(16)));
    typedef int I __attribute__((ext_vector_type(16)));
    const F column = {{0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3}};
    const F row = {{0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3}};
    const F block_x = 4.0f * column, block_y = 4.0f * row, zero = (F)0.0f;
    auto fma = [](F a, F b, F c) {{ return __builtin_elementwise_fma(a, b, c); }};
{ARITHMETIC}
    float ub[16] __attribute__((aligned(64))), vb[16] __attribute__((aligned(64)));
    F T[16], c0[16], c1[16], c2[16], c3[16];
"""

_GAUSSIAN = f"""
            const float* const r = table.data + g * {ROW};
            const float a = r[2], b = r[3], d = r[4], l = r[5];
            const float r0 = r[8], r1 = r[9], r2 = r[10], r3 = r[11];
            const F bx = block_x + r[0], by = block_y + r[1];
            *(F*)ub = fma((F)a, bx, b * by);
            *(F*)vb = d * by;
            const F u_lane = fma((F)a, column, b * row), v_lane = d * row;
"""

_STEP = """
                const F u = u_lane + ub[k], v = v_lane + vb[k];
                const F p = fma(-v, v, fma(-u, u, (F)l));
                const F raw = exp2_(p);
                const F alpha = raw < alpha_max ? raw : alpha_max;
                const F t = T[k];
                const F next = fma(-alpha, t, t);
                const I blend = (p >= cutoff) & (next > transmittance_min);
                const F w = blend ? alpha * t : zero;
                T[k] = blend ? next : t;
"""

_FORWARD = f"""
{_LANES}
    F sum = zero;
    for (int round = 0; round < rounds; ++round) {{
        for (int k = 0; k < 16; ++k) {{
            T[k] = (F)1.0f;
            c0[k] = c1[k] = c2[k] = c3[k] = zero;
        }}
        for (int g = 0; g < {GAUSSIANS}; ++g) {{
{_GAUSSIAN}
            for (int k = 0; k < 16; ++k) {{
{_STEP}
                c0[k] = fma(w, (F)r0, c0[k]);
                c1[k] = fma(w, (F)r1, c1[k]);
                c2[k] = fma(w, (F)r2, c2[k]);
                c3[k] = fma(w, (F)r3, c3[k]);
            }}
        }}
        for (int k = 0; k < 16; ++k) sum += c0[k] + c1[k] + c2[k] + c3[k] + T[k];
    }}
    float total = 0.0f;
    for (int j = 0; j < 16; ++j) total += sum[j];
    result_out.data[index] = total;
"""

# c0 .. c3 hold the image's gradient; R what lies behind, see `gdpro_sim.kernels.compositing_backward`.
_BACKWARD = f"""
{_LANES}
    F R[16], sums[11] = {{}};
    for (int k = 0; k < 16; ++k) c0[k] = c1[k] = c2[k] = c3[k] = (F)(0.1f * k) + 0.01f * column;
    for (int round = 0; round < rounds; ++round) {{
        for (int k = 0; k < 16; ++k) {{
            T[k] = (F)1.0f;
            R[k] = (F)0.5f;
        }}
        for (int g = 0; g < {GAUSSIANS}; ++g) {{
{_GAUSSIAN}
            F s0 = zero, s1 = zero, s2 = zero, s3 = zero, s4 = zero;
            F s5 = zero, s6 = zero, s7 = zero, s8 = zero, s9 = zero;
            for (int k = 0; k < 16; ++k) {{
{_STEP}
                const F q = fma((F)r0, c0[k], fma((F)r1, c1[k], fma((F)r2, c2[k], r3 * c3[k])));
                const F behind = fma(-w, q, R[k]);
                R[k] = behind;
                const F g_p = (blend & (raw <= alpha_max)) ? w * fma(-behind, reciprocal(next), q) : zero;
                const F g_u = g_p * u, g_v = g_p * v;
                s0 += g_p;
                s1 += g_u;
                s2 += g_v;
                s3 = fma((F)ub[k], g_u, s3);
                s4 = fma((F)vb[k], g_u, s4);
                s5 = fma((F)vb[k], g_v, s5);
                s6 = fma(w, c0[k], s6);
                s7 = fma(w, c1[k], s7);
                s8 = fma(w, c2[k], s8);
                s9 = fma(w, c3[k], s9);
            }}
            sums[0] += s0;
            sums[1] += s1;
            sums[2] += s2;
            sums[3] += s3;
            sums[4] += s4;
            sums[5] += s5;
            sums[6] += s6;
            sums[7] += s7;
            sums[8] += s8;
            sums[9] += s9;
        }}
        for (int k = 0; k < 16; ++k) sums[10] += R[k];
    }}
    F sum = zero;
    for (int i = 0; i < 11; ++i) sum += sums[i];
    float total = 0.0f;
    for (int j = 0; j < 16; ++j) total += sum[j];
    result_out.data[index] = total;
"""


@wp.func_native(_FORWARD)
def blend(index: int, rounds: int, table: wp.array2d[float], result_out: wp.array[float]): ...


@wp.func_native(_BACKWARD)
def blend_backward(index: int, rounds: int, table: wp.array2d[float], result_out: wp.array[float]): ...


@wp.kernel
def forward(start: int, rounds: int, table: wp.array2d[float], result_out: wp.array[float]):
    blend(start + wp.tid(), rounds, table, result_out)


@wp.kernel
def backward(start: int, rounds: int, table: wp.array2d[float], result_out: wp.array[float]):
    blend_backward(start + wp.tid(), rounds, table, result_out)


@dataclass(frozen=True)
class VectorBound:
    """Lane evaluations per second and core."""

    forward: float
    backward: float


def _table() -> wp.array:
    """Gaussians of 4 to 8 pixels' deviation over a tile, faint enough that no pixel stops."""
    rng = np.random.default_rng(0)
    table = np.zeros((GAUSSIANS, ROW), np.float32)
    table[:, 0:2] = rng.uniform(-12.0, -4.0, (GAUSSIANS, 2))
    table[:, 2] = rng.uniform(0.1, 0.2, GAUSSIANS)
    table[:, 3] = rng.uniform(-0.05, 0.05, GAUSSIANS)
    table[:, 4] = rng.uniform(0.1, 0.2, GAUSSIANS)
    table[:, 5] = np.log2(rng.uniform(0.02, 0.1, GAUSSIANS))
    table[:, 8:12] = rng.uniform(0.0, 1.0, (GAUSSIANS, 4))
    return wp.array(table, dtype=wp.float32, device="cpu")


def vector_bound(repeats: int = 60, rounds: int = 400) -> VectorBound:
    """Measure both on one thread: the best of `repeats` by the thread's own CPU time."""
    table, result = _table(), wp.zeros(1, dtype=wp.float32, device="cpu")
    rates = []
    for kernel in (forward, backward):
        best = float("inf")
        for _ in range(repeats + 1):
            begin = time.thread_time()
            wp.launch(kernel, dim=1, inputs=[0, rounds, table, result], device="cpu")
            best = min(best, time.thread_time() - begin)
        assert np.isfinite(result.numpy()).all()
        rates.append(rounds * GAUSSIANS * 256 / best)
    return VectorBound(*rates)


def main() -> None:
    bound = vector_bound()
    print(f"{machine()}\n")
    print(f"forward:  {bound.forward / 1e9:.2f} G lane evaluations/s per core")
    print(f"backward: {bound.backward / 1e9:.2f} G lane evaluations/s per core")


if __name__ == "__main__":
    main()


__all__ = ["VectorBound", "vector_bound"]
