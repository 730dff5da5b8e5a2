"""Linear tetrahedra and the incremental potential of backward Euler.

One implicit step from (x_n, v_n) minimises over x (Martin et al. 2011, "Example-based elastic materials",
eq. 3; Li et al. 2020, "Incremental Potential Contact", eq. 1)

    E(x) = sum_i m_i / (2 dt^2) |x_i - y_i|^2 + alpha_i m_i / (2 dt) |x_i - x_n,i|^2
         + sum_e V_e Psi(F_e) + sum_e V_e D(F_e) + sum_i contact_i(x_i),     y = x_n + dt v_n + dt^2 g

Elements write their own energies, forces and Hessian blocks; vertices and matrix entries gather them in a
fixed order. F = sum_a x_a (x) grad N_a with constant gradients, the rows of the inverse rest shape matrix.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.contact import (
    friction_anchor,
    friction_energy,
    friction_gradient,
    friction_hessian,
    normal_energy,
    normal_force,
    normal_stiffness,
)
from gdpro_sim.kernels.elasticity import (
    energy_density,
    green_strain_increment,
    piola_stress,
    principal_block,
    principal_hessian,
    singular_value_decomposition,
    viscous_block,
    viscous_energy,
    viscous_stress,
)
from gdpro_sim.kernels.linalg import block_range

wp.set_module_options({"enable_backward": False})


@wp.struct
class Elements:
    """Constant element data."""

    tets: wp.array[wp.vec4i]
    inverse_rest: wp.array[wp.mat33d]  # rows are grad N_1..N_3, 1/m
    volume: wp.array[wp.float64]  # m^3, weighted by fill
    mu: wp.array[wp.float64]  # Pa
    lam: wp.array[wp.float64]  # Pa
    damping: wp.array[wp.float64]  # Rayleigh stiffness damping, s


@wp.struct
class Vertices:
    """Constant vertex data."""

    mass: wp.array[wp.float64]  # kg
    damping: wp.array[wp.float64]  # Rayleigh mass damping, 1/s
    friction: wp.array[wp.float64]
    contact_stiffness: wp.array[wp.float64]  # N/m, along the normal
    stick_stiffness: wp.array[wp.float64]  # N/m, in the tangent plane
    contact_ramp: wp.array[wp.float64]  # m
    contact_offset: wp.array[wp.float64]  # m
    fixed: wp.array[wp.int32]
    offsets: wp.array[wp.int32]  # into `corners`
    corners: wp.array[wp.int32]  # 4 * element + corner


@wp.struct
class Ground:
    enabled: wp.int32
    height: wp.float64


@wp.func
def deformation_gradient(tet: wp.vec4i, inverse_rest: wp.mat33d, x: wp.array[wp.vec3d]) -> wp.mat33d:
    x0 = x[tet[0]]
    edges = wp.matrix_from_cols(x[tet[1]] - x0, x[tet[2]] - x0, x[tet[3]] - x0)
    return edges * inverse_rest


@wp.kernel
def element_cauchy_green(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    # Out:
    cauchy_green_out: wp.array[wp.mat33d],
):
    """C = F^T F, kept from the start of a step for the strain increment of the damping."""
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], x)
    cauchy_green_out[e] = wp.transpose(F) * F


@wp.kernel
def element_volume_ratio(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    # Out:
    ratio_out: wp.array[wp.float64],
):
    e = start + wp.tid()
    ratio_out[e] = wp.determinant(deformation_gradient(elements.tets[e], elements.inverse_rest[e], x))


@wp.kernel
def element_energy(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Elastic energy plus damping potential of each element, J. inverse_dt = 0 leaves the damping out."""
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], x)
    mu = elements.mu[e]
    lam = elements.lam[e]
    density = energy_density(F, mu, lam)
    rate = elements.damping[e] * inverse_dt
    if rate > wp.float64(0.0):
        strain = green_strain_increment(F, cauchy_green[e])
        density += viscous_energy(strain, rate * mu, rate * lam)
    energy_out[e] = elements.volume[e] * density


@wp.kernel
def element_derivatives(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    # Out:
    gradient_out: wp.array[wp.vec3d],
    blocks_out: wp.array[wp.mat33d],
):
    """Gradient (4 vectors) and projected Hessian (10 blocks, a <= b, row by row) of each element.

    Shape gradients sum to zero, so the blocks of corner 0 follow from the six of corners 1 to 3.
    """
    e = start + wp.tid()
    inverse_rest = elements.inverse_rest[e]
    F = deformation_gradient(elements.tets[e], inverse_rest, x)
    volume = elements.volume[e]
    mu = elements.mu[e]
    lam = elements.lam[e]
    rate = elements.damping[e] * inverse_dt

    P = piola_stress(F, mu, lam)
    if rate > wp.float64(0.0):
        P += viscous_stress(F, green_strain_increment(F, cauchy_green[e]), rate * mu, rate * lam)
    forces = (volume * P) * wp.transpose(inverse_rest)
    f1 = wp.vec3d(forces[0, 0], forces[1, 0], forces[2, 0])
    f2 = wp.vec3d(forces[0, 1], forces[1, 1], forces[2, 1])
    f3 = wp.vec3d(forces[0, 2], forces[1, 2], forces[2, 2])
    gradient_out[4 * e] = -(f1 + f2 + f3)
    gradient_out[4 * e + 1] = f1
    gradient_out[4 * e + 2] = f2
    gradient_out[4 * e + 3] = f3

    U, s, V = singular_value_decomposition(F)
    A, pairs = principal_hessian(s, mu, lam)
    rotated = inverse_rest * V
    g1 = wp.vec3d(rotated[0, 0], rotated[0, 1], rotated[0, 2])
    g2 = wp.vec3d(rotated[1, 0], rotated[1, 1], rotated[1, 2])
    g3 = wp.vec3d(rotated[2, 0], rotated[2, 1], rotated[2, 2])
    k11 = principal_block(A, pairs, g1, g1)
    k12 = principal_block(A, pairs, g1, g2)
    k13 = principal_block(A, pairs, g1, g3)
    k22 = principal_block(A, pairs, g2, g2)
    k23 = principal_block(A, pairs, g2, g3)
    k33 = principal_block(A, pairs, g3, g3)
    if rate > wp.float64(0.0):
        k11 += viscous_block(s, g1, g1, rate * mu, rate * lam)
        k12 += viscous_block(s, g1, g2, rate * mu, rate * lam)
        k13 += viscous_block(s, g1, g3, rate * mu, rate * lam)
        k22 += viscous_block(s, g2, g2, rate * mu, rate * lam)
        k23 += viscous_block(s, g2, g3, rate * mu, rate * lam)
        k33 += viscous_block(s, g3, g3, rate * mu, rate * lam)
    W = volume * U
    Ut = wp.transpose(U)
    k11 = W * k11 * Ut
    k12 = W * k12 * Ut
    k13 = W * k13 * Ut
    k22 = W * k22 * Ut
    k23 = W * k23 * Ut
    k33 = W * k33 * Ut
    k01 = -(k11 + wp.transpose(k12) + wp.transpose(k13))
    k02 = -(k12 + k22 + wp.transpose(k23))
    k03 = -(k13 + k23 + k33)
    b = 10 * e
    blocks_out[b] = -(k01 + k02 + k03)
    blocks_out[b + 1] = k01
    blocks_out[b + 2] = k02
    blocks_out[b + 3] = k03
    blocks_out[b + 4] = k11
    blocks_out[b + 5] = k12
    blocks_out[b + 6] = k13
    blocks_out[b + 7] = k22
    blocks_out[b + 8] = k23
    blocks_out[b + 9] = k33


@wp.func
def diagonal_slot(corner: int) -> int:
    """Place of block (corner, corner) among an element's 10 blocks: 0, 4, 7, 9."""
    return corner * (9 - corner) // 2


@wp.func
def penetration(ground: Ground, offset: wp.float64, position: wp.vec3d) -> wp.float64:
    """Depth below the ground, m, of the surface `offset` inside a vertex; zero without ground."""
    if ground.enabled == 0:
        return wp.float64(0.0)
    return ground.height - offset - position[2]


@wp.func
def tangential_slip(position: wp.vec3d, anchor: wp.vec2d) -> wp.vec2d:
    return wp.vec2d(position[0], position[1]) - anchor


@wp.kernel
def predict(
    start: int,
    # In:
    vertices: Vertices,
    x: wp.array[wp.vec3d],
    v: wp.array[wp.vec3d],
    gravity: wp.vec3d,
    dt: wp.float64,
    # Out:
    inertia_out: wp.array[wp.vec3d],
    coasting_out: wp.array[wp.vec3d],
):
    """y = x + dt v + dt^2 g, where inertia alone would take each vertex, and x + dt v."""
    i = start + wp.tid()
    position = x[i]
    if vertices.fixed[i] != 0:
        inertia_out[i] = position
        coasting_out[i] = position
    else:
        coasting = position + dt * v[i]
        coasting_out[i] = coasting
        inertia_out[i] = coasting + (dt * dt) * gravity


@wp.kernel
def friction_limits(
    start: int,
    # In:
    vertices: Vertices,
    ground: Ground,
    x: wp.array[wp.vec3d],
    # Out:
    limit_out: wp.array[wp.float64],
):
    """Coulomb limit mu |normal force| of each vertex at x, held fixed while one Newton step is taken, N."""
    i = start + wp.tid()
    force = normal_force(
        penetration(ground, vertices.contact_offset[i], x[i]),
        vertices.contact_stiffness[i],
        vertices.contact_ramp[i],
    )
    limit_out[i] = vertices.friction[i] * force


@wp.kernel
def vertex_energy(
    start: int,
    # In:
    first: int,
    vertices: Vertices,
    ground: Ground,
    x: wp.array[wp.vec3d],
    x_previous: wp.array[wp.vec3d],
    inertia: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec2d],
    limit: wp.array[wp.float64],
    inverse_dt: wp.float64,
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Inertia, mass damping and contact terms of each vertex, J, written from index `first` on."""
    i = start + wp.tid()
    position = x[i]
    mass = vertices.mass[i]
    off = position - inertia[i]
    moved = position - x_previous[i]
    half = wp.float64(0.5) * mass * inverse_dt
    energy = half * inverse_dt * wp.dot(off, off) + half * vertices.damping[i] * wp.dot(moved, moved)
    depth = penetration(ground, vertices.contact_offset[i], position)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        stiffness = vertices.contact_stiffness[i]
        energy += normal_energy(depth, stiffness, vertices.contact_ramp[i])
        slip = tangential_slip(position, anchor[i])
        energy += friction_energy(slip, vertices.stick_stiffness[i], limit[i])
    energy_out[first + i] = energy


@wp.kernel
def contact_energy(
    start: int,
    # In:
    vertices: Vertices,
    ground: Ground,
    x: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec2d],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Energy stored in the ground penalty and the friction springs of each vertex, J."""
    i = start + wp.tid()
    position = x[i]
    depth = penetration(ground, vertices.contact_offset[i], position)
    energy = wp.float64(0.0)
    if depth > wp.float64(0.0):
        stiffness = vertices.contact_stiffness[i]
        ramp = vertices.contact_ramp[i]
        limit = vertices.friction[i] * normal_force(depth, stiffness, ramp)
        energy = normal_energy(depth, stiffness, ramp)
        slip = tangential_slip(position, anchor[i])
        energy += friction_energy(slip, vertices.stick_stiffness[i], limit)
    energy_out[i] = energy


@wp.kernel
def assemble_vertices(
    start: int,
    # In:
    vertices: Vertices,
    ground: Ground,
    x: wp.array[wp.vec3d],
    x_previous: wp.array[wp.vec3d],
    inertia: wp.array[wp.vec3d],
    anchor: wp.array[wp.vec2d],
    limit: wp.array[wp.float64],
    inverse_dt: wp.float64,
    element_gradient: wp.array[wp.vec3d],
    element_blocks: wp.array[wp.mat33d],
    diagonal: wp.array[wp.int32],
    # Out:
    force_out: wp.array[wp.vec3d],
    values_out: wp.array[wp.mat33d],
    inverse_diagonal_out: wp.array[wp.mat33d],
):
    """Negative gradient, diagonal block and its inverse of each vertex.

    A fixed vertex gets no force and a zero inverse, which keeps conjugate gradients from ever moving it.
    """
    i = start + wp.tid()
    gradient = wp.vec3d()
    block = wp.mat33d()
    for k in range(vertices.offsets[i], vertices.offsets[i + 1]):
        code = vertices.corners[k]
        gradient += element_gradient[code]
        block += element_blocks[10 * (code >> 2) + diagonal_slot(code & 3)]

    position = x[i]
    inertial = vertices.mass[i] * inverse_dt * inverse_dt
    damping = vertices.mass[i] * inverse_dt * vertices.damping[i]
    gradient += inertial * (position - inertia[i]) + damping * (position - x_previous[i])
    block += wp.diag(wp.vec3d(inertial + damping))

    depth = penetration(ground, vertices.contact_offset[i], position)
    if depth > wp.float64(0.0) or limit[i] > wp.float64(0.0):
        stiffness = vertices.contact_stiffness[i]
        ramp = vertices.contact_ramp[i]
        stick = vertices.stick_stiffness[i]
        slip = tangential_slip(position, anchor[i])
        tangential = friction_gradient(slip, stick, limit[i])
        curvature = friction_hessian(slip, stick, limit[i])
        gradient += wp.vec3d(tangential[0], tangential[1], -normal_force(depth, stiffness, ramp))
        zero = wp.float64(0.0)
        # fmt: off
        block += wp.mat33d(
            curvature[0, 0], curvature[0, 1], zero,
            curvature[1, 0], curvature[1, 1], zero,
            zero, zero, normal_stiffness(depth, stiffness, ramp),
        )
        # fmt: on

    values_out[diagonal[i]] = block
    if vertices.fixed[i] != 0:
        force_out[i] = wp.vec3d()
        inverse_diagonal_out[i] = wp.mat33d()
    else:
        force_out[i] = -gradient
        inverse_diagonal_out[i] = wp.inverse(block)


@wp.kernel
def move(
    start: int,
    # In:
    x: wp.array[wp.vec3d],
    direction: wp.array[wp.vec3d],
    length: wp.float64,
    # Out:
    x_out: wp.array[wp.vec3d],
):
    """x_out = x + length * direction"""
    i = start + wp.tid()
    x_out[i] = x[i] + length * direction[i]


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


@wp.kernel
def finish(
    start: int,
    # In:
    vertices: Vertices,
    ground: Ground,
    x_new: wp.array[wp.vec3d],
    inverse_dt: wp.float64,
    # Out:
    x_out: wp.array[wp.vec3d],
    v_out: wp.array[wp.vec3d],
    anchor_out: wp.array[wp.vec2d],
):
    """Accept a step: v = (x_new - x) / dt, x = x_new, and drag the friction anchors along."""
    i = start + wp.tid()
    position = x_new[i]
    v_out[i] = inverse_dt * (position - x_out[i])
    x_out[i] = position
    stiffness = vertices.contact_stiffness[i]
    force = normal_force(
        penetration(ground, vertices.contact_offset[i], position), stiffness, vertices.contact_ramp[i]
    )
    limit = vertices.friction[i] * force
    slip = tangential_slip(position, anchor_out[i])
    stick = vertices.stick_stiffness[i]
    anchor_out[i] = friction_anchor(wp.vec2d(position[0], position[1]), slip, stick, limit)
