"""Vertices and the incremental potential of one implicit step.

Every implicit integrator solves for x by minimising (Martin et al. 2011, "Example-based elastic materials",
eq. 3; Li et al. 2020, "Incremental Potential Contact", eq. 1)

    E(x) = sum_i m_i / (2 h^2) |x_i - y_i|^2 + alpha_i m_i / (2 h) |x_i - b_i|^2
         + sum_e V_e Psi(F_e) + sum_e V_e D(F_e) + terms(x)

with its own step h, target y (where inertia and gravity alone lead) and base b (velocities are (x - b) / h);
see `gdpro_sim.simulation.fem.integrators`. Elements are those of `gdpro_sim.kernels.elements`, terms are
contact and forces. Everything is gathered in a fixed order.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.linalg import block_range

wp.set_module_options({"enable_backward": False})


@wp.struct
class Vertices:
    """Constant vertex data."""

    mass: wp.array[wp.float64]  # kg
    damping: wp.array[wp.float64]  # Rayleigh mass damping, 1/s
    fixed: wp.array[wp.int32]
    offsets: wp.array[wp.int32]  # into `corners`
    corners: wp.array[wp.int32]  # 4 * element + corner


@wp.func_native("""
    // Block (c, c) is at place 0, 4, 7 or 9 of an element's 10. They lie far apart: those of the next
    // vertices are fetched while these are added.
    const double* const blocks_ = (const double*)blocks.data;
    const int* const codes = corners.data;
    const int last = corners.shape[0] - 1;
    auto block_of = [&](int k) {
        const int c = codes[k] & 3;
        return blocks_ + 9 * (size_t)(10 * (codes[k] >> 2) + c * (9 - c) / 2);
    };
    double sum[9] = {0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
    for (int k = begin; k < end; ++k) {
#if !defined(__CUDACC__)
        const double* const next = block_of(k + 16 < last ? k + 16 : last);
        __builtin_prefetch(next);
        __builtin_prefetch(next + 8);
#endif
        const double* const m = block_of(k);
        for (int i = 0; i < 9; ++i) sum[i] += m[i];
    }
    return wp::mat33d(sum[0], sum[1], sum[2], sum[3], sum[4], sum[5], sum[6], sum[7], sum[8]);
""")
def sum_diagonal_blocks(
    begin: int,
    end: int,
    corners: wp.array[wp.int32],
    blocks: wp.array[wp.mat33d],
) -> wp.mat33d:
    """Sum over k in [begin, end) of an element's block of corners[k] with itself."""
    ...


@wp.kernel
def combine(
    start: int,
    # In:
    a: wp.array[wp.vec3d],
    weight_a: wp.float64,
    b: wp.array[wp.vec3d],
    weight_b: wp.float64,
    constant: wp.vec3d,
    # Out:
    out: wp.array[wp.vec3d],
):
    """weight_a a + weight_b b + constant; `out` may be `a` or `b`."""
    i = start + wp.tid()
    out[i] = weight_a * a[i] + weight_b * b[i] + constant


@wp.kernel
def hold(
    start: int,
    # In:
    vertices: Vertices,
    held: wp.array[wp.vec3d],
    # Out:
    out: wp.array[wp.vec3d],
):
    """Puts fixed vertices where they are held."""
    i = start + wp.tid()
    if vertices.fixed[i] != 0:
        out[i] = held[i]


@wp.kernel
def vertex_energy(
    start: int,
    # In:
    first: int,
    vertices: Vertices,
    x: wp.array[wp.vec3d],
    base: wp.array[wp.vec3d],
    inertia: wp.array[wp.vec3d],
    inverse_dt: wp.float64,
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Inertia and mass damping of each vertex, J, written from index `first` on."""
    i = start + wp.tid()
    position = x[i]
    off = position - inertia[i]
    moved = position - base[i]
    half = wp.float64(0.5) * vertices.mass[i] * inverse_dt
    energy_out[first + i] = half * (
        inverse_dt * wp.dot(off, off) + vertices.damping[i] * wp.dot(moved, moved)
    )


@wp.kernel
def assemble_vertices(
    start: int,
    # In:
    vertices: Vertices,
    x: wp.array[wp.vec3d],
    base: wp.array[wp.vec3d],
    inertia: wp.array[wp.vec3d],
    inverse_dt: wp.float64,
    element_gradient: wp.array[wp.vec3d],
    element_blocks: wp.array[wp.mat33d],
    gradient: wp.array[wp.vec3d],
    block: wp.array[wp.mat33d],
    diagonal: wp.array[wp.int32],
    factored: wp.array[wp.mat33d],
    # Out:
    force_out: wp.array[wp.vec3d],
    values_out: wp.array[wp.mat33d],
    inverse_diagonal_out: wp.array[wp.mat33d],
):
    """Negative gradient, diagonal block and its inverse of each vertex; terms stand in `gradient`, `block`.

    `factored` are diagonal blocks of what is applied factor by factor: only the inverse has them.

    A fixed vertex gets no force and a zero inverse, which keeps conjugate gradients from ever moving it.
    """
    i = start + wp.tid()
    slope = gradient[i]
    begin = vertices.offsets[i]
    end = vertices.offsets[i + 1]
    curvature = block[i] + sum_diagonal_blocks(begin, end, vertices.corners, element_blocks)
    for k in range(begin, end):
        slope += element_gradient[vertices.corners[k]]
    position = x[i]
    inertial = vertices.mass[i] * inverse_dt * inverse_dt
    damping = vertices.mass[i] * inverse_dt * vertices.damping[i]
    slope += inertial * (position - inertia[i]) + damping * (position - base[i])
    curvature += wp.diag(wp.vec3d(inertial + damping))
    values_out[diagonal[i]] = curvature
    if vertices.fixed[i] != 0:
        force_out[i] = wp.vec3d()
        inverse_diagonal_out[i] = wp.mat33d()
    else:
        force_out[i] = -slope
        if factored.shape[0] > 0:
            curvature += factored[i]
        inverse_diagonal_out[i] = wp.inverse(curvature)


@wp.kernel
def kick(
    start: int,
    # In:
    vertices: Vertices,
    element_gradient: wp.array[wp.vec3d],
    gradient: wp.array[wp.vec3d],
    gravity: wp.vec3d,
    dt: wp.float64,
    # Out:
    v_out: wp.array[wp.vec3d],
):
    """Explicit step of the velocities: v += dt (g - gradient / m - damping v); fixed vertices keep theirs."""
    i = start + wp.tid()
    if vertices.fixed[i] == 0:
        slope = gradient[i]
        for k in range(vertices.offsets[i], vertices.offsets[i + 1]):
            slope += element_gradient[vertices.corners[k]]
        v = v_out[i]
        v_out[i] = v + dt * (gravity - slope / vertices.mass[i] - vertices.damping[i] * v)


@wp.kernel
def step_measures(
    start: int,
    # In:
    rows: int,
    ranges: int,
    direction: wp.array[wp.vec3d],
    force: wp.array[wp.vec3d],
    # Out:
    slope_out: wp.array[wp.float64],
    largest_out: wp.array[wp.float64],
):
    """Per range of vertices: gradient . direction, and the largest move squared."""
    r = start + wp.tid()
    bounds = block_range(rows, ranges, r)
    slope = wp.float64(0.0)
    largest = wp.float64(0.0)
    for i in range(bounds[0], bounds[1]):
        d = direction[i]
        slope -= wp.dot(force[i], d)
        largest = wp.max(largest, wp.dot(d, d))
    slope_out[r] = slope
    largest_out[r] = largest


@wp.kernel
def residual_measure(
    start: int,
    # In:
    rows: int,
    ranges: int,
    force: wp.array[wp.vec3d],
    mass: wp.array[wp.float64],
    # Out:
    largest_out: wp.array[wp.float64],
):
    """Per range of vertices: the largest (|force| / mass)^2, m^2/s^4."""
    r = start + wp.tid()
    bounds = block_range(rows, ranges, r)
    largest = wp.float64(0.0)
    for i in range(bounds[0], bounds[1]):
        if mass[i] > wp.float64(0.0):
            acceleration = force[i] / mass[i]
            largest = wp.max(largest, wp.dot(acceleration, acceleration))
    largest_out[r] = largest
