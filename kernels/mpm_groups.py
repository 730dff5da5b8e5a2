"""MPM particles in groups: 16 side by side on a CPU, one on a GPU; and gradients that have degenerated."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels import particles as rows
from gdpro_sim.kernels.decomposition import singular_value_decomposition
from gdpro_sim.kernels.lanes import CPU_FLAGS, PRELUDE
from gdpro_sim.kernels.particles import DEFORMATION, DEFORMATION_LOW, read_compensated, write_compensated

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})

LANES = 16
"""Particles of a group on a CPU."""

FLAT = wp.constant(wp.float64(0.05))
"""Singular values of a recovered deformation gradient are at least this."""

_ROWS = "".join(
    f"    const int {name} = {int(getattr(rows, name))};\n"
    for name in (
        "VELOCITY", "AFFINE", "DEFORMATION", "DEFORMATION_LOW", "STRESS", "VOLUME", "SPEED", "INTERNAL",
        "DENSITY", "SLOPE",
    )
)  # fmt: skip

GROUP = f"""
{_ROWS}
    const int count = (int)matter.shape[0];
#if defined(__CUDACC__)
    const int first = group, lanes = 1;
#else
    const int first = group * {LANES}, lanes = count - first < {LANES} ? count - first : {LANES};
#endif
    {PRELUDE}
#if defined(__CUDACC__)
    typedef double D;
    auto wide = [](F v) {{ return (double)v; }};
    auto narrow = [](D v) {{ return (float)v; }};
    auto row = [&](int r) {{ return particles.data[(size_t)r * particles.shape[1] + first]; }};
    auto put = [&](int r, F v) {{ particles.data[(size_t)r * particles.shape[1] + first] = v; }};
#else
    typedef double D __attribute__((ext_vector_type({LANES})));
    auto wide = [](F v) {{ return __builtin_convertvector(v, D); }};
    auto narrow = [](D v) {{ return __builtin_convertvector(v, F); }};
    auto row = [&](int r) {{
        const float* const p = particles.data + (size_t)r * particles.shape[1] + first;
        F v;
        if (lanes == {LANES}) {{ __builtin_memcpy(&v, p, sizeof(F)); return v; }}
        for (int j = 0; j < {LANES}; ++j) v[j] = p[j < lanes ? j : lanes - 1];
        return v;
    }};
    auto put = [&](int r, F v) {{
        float* const p = particles.data + (size_t)r * particles.shape[1] + first;
        if (lanes == {LANES}) {{ __builtin_memcpy(p, &v, sizeof(F)); return; }}
        for (int j = 0; j < lanes; ++j) p[j] = v[j];
    }};
#endif
"""
"""Opens a snippet: rows of a group's particles, and double vectors D."""

_DEGENERATE = f"""
{GROUP}
    F f[9];
    for (int i = 0; i < 9; ++i) f[i] = row(DEFORMATION + i);
    const F J = f[0] * (f[4] * f[8] - f[5] * f[7]) - f[1] * (f[3] * f[8] - f[5] * f[6])
        + f[2] * (f[3] * f[7] - f[4] * f[6]);
    const I flat = J < 0.01f;
    if (!any(flat)) return 0;
#if defined(__CUDACC__)
    return 1;
#else
    int mask = 0;
    for (int j = 0; j < lanes; ++j) if (flat[j]) mask |= 1 << j;
    return mask;
#endif
"""


@wp.func_native(_DEGENERATE)
def degenerate_lanes(group: int, matter: wp.array[wp.int32], particles: wp.array2d[float]) -> int:
    """Bit j is set where the deformation gradient of a group's particle j has J < 0.01."""
    ...


@wp.func_native(f"""
#if defined(__CUDACC__)
    return group;
#else
    return group * {LANES};
#endif
""")
def first_of_group(group: int) -> int:
    """Number of a group's first particle."""
    ...


@wp.func
def recover(i: int, particles: wp.array2d[float]):
    """Raise the singular values of a particle's deformation gradient to `FLAT`."""
    F = read_compensated(particles, DEFORMATION, DEFORMATION_LOW, i)
    G = FLAT * wp.identity(n=3, dtype=wp.float64)
    if wp.ddot(F, F) > wp.float64(1.0e-12):
        U, s, V = singular_value_decomposition(F)
        G = (
            U
            * wp.diag(wp.vec3d(wp.max(s[0], FLAT), wp.max(s[1], FLAT), wp.max(s[2], FLAT)))
            * wp.transpose(V)
        )
    write_compensated(G, DEFORMATION, DEFORMATION_LOW, i, particles)
