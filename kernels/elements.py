"""Linear tetrahedra: energies, forces and projected Hessian blocks, each element on its own.

F = sum_a x_a (x) grad N_a with constant gradients, the rows of the inverse rest shape matrix. Vertices and
matrix entries gather what elements wrote, in a fixed order (`gdpro_sim.kernels.fem`).

An element that yields keeps its plastic deformation F_p in its stress-free shape: `inverse_rest` is the
inverse rest shape matrix times F_p^-1, so that F above is the elastic part, F_e. F_p keeps volume.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import singular_value_decomposition
from gdpro_sim.kernels.elasticity import (
    LINEAR,
    STVK_HENCKY,
    Constants,
    energy_density,
    green_strain_increment,
    linear_energy,
    needs_stretches,
    neo_hookean_energy,
    piola_stress,
    piola_stress_in_frame,
    principal_hessian,
    viscous_energy,
    viscous_hessian,
    viscous_stress,
)
from gdpro_sim.kernels.element_lanes import (
    A_SLOT,
    F_SLOT,
    G_SLOT,
    PAIR_SLOT,
    S_SLOT,
    STRESS_SLOT,
    U_SLOT,
    V_SLOT,
    WORK,
    decompose_group,
    fetch_blocks_group,
    read_matrix,
    read_vector,
    write_derivatives_group,
    write_matrix,
)
from gdpro_sim.kernels.lanes import CPU_FLAGS
from gdpro_sim.kernels.plasticity import flow

wp.set_module_options({"enable_backward": False, "cpu_compiler_flags": CPU_FLAGS})


@wp.struct
class Elements:
    """Element data; `inverse_rest` and `plastic_strain` change where elements yield, the rest is constant."""

    tets: wp.array[wp.vec4i]
    inverse_rest: wp.array[wp.mat33d]  # rows are grad N_1..N_3 in the stress-free shape, 1/m
    volume: wp.array[wp.float64]  # m^3, weighted by fill
    law: wp.array[wp.int32]  # of `gdpro_sim.kernels.elasticity`
    mu: wp.array[wp.float64]  # Pa
    lam: wp.array[wp.float64]  # Pa
    yield_stress: wp.array[wp.float64]  # Pa, inf: elastic
    hardening: wp.array[wp.float64]  # Pa
    plastic_strain: wp.array[wp.float64]  # accumulated
    pressure: wp.array[wp.float64]  # Pa, added to dPsi/dJ; not in the energy
    damping: wp.array[wp.float64]  # Rayleigh stiffness damping, s


@wp.func
def deformation_gradient(tet: wp.vec4i, inverse_rest: wp.mat33d, x: wp.array[wp.vec3d]) -> wp.mat33d:
    x0 = x[tet[0]]
    edges = wp.matrix_from_cols(x[tet[1]] - x0, x[tet[2]] - x0, x[tet[3]] - x0)
    return edges * inverse_rest


@wp.func
def constants_of(elements: Elements, e: int) -> Constants:
    m = Constants()
    m.law = elements.law[e]
    m.mu = elements.mu[e]
    m.lam = elements.lam[e]
    m.limit = wp.float64(wp.inf)
    m.hardening = wp.float64(0.0)
    m.pressure = elements.pressure[e]
    if m.law == STVK_HENCKY:
        m.hardening = elements.hardening[e]
        m.limit = elements.yield_stress[e] + m.hardening * elements.plastic_strain[e]
    return m


@wp.kernel
def element_cauchy_green(
    start: int,
    # In:
    elements: Elements,
    a: wp.array[wp.vec3d],
    weight_a: wp.float64,
    b: wp.array[wp.vec3d],
    weight_b: wp.float64,
    # Out:
    cauchy_green_out: wp.array[wp.mat33d],
):
    """weight_a C(a) + weight_b C(b) with C = F^T F: what the damping measures its strain increment from."""
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], a)
    total = weight_a * (wp.transpose(F) * F)
    if weight_b != wp.float64(0.0):
        G = deformation_gradient(elements.tets[e], elements.inverse_rest[e], b)
        total += weight_b * (wp.transpose(G) * G)
    cauchy_green_out[e] = total


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


@wp.func
def write_corners(e: int, columns: wp.mat33d, out: wp.array[wp.vec3d]):
    """Vectors of corners 1 to 3, and that of corner 0, which makes their sum zero."""
    c1 = wp.vec3d(columns[0, 0], columns[1, 0], columns[2, 0])
    c2 = wp.vec3d(columns[0, 1], columns[1, 1], columns[2, 1])
    c3 = wp.vec3d(columns[0, 2], columns[1, 2], columns[2, 2])
    out[4 * e] = -(c1 + c2 + c3)
    out[4 * e + 1] = c1
    out[4 * e + 2] = c2
    out[4 * e + 3] = c3


@wp.func
def damping_energy(
    elements: Elements, e: int, F: wp.mat33d, cauchy_green: wp.array[wp.mat33d], inverse_dt: wp.float64
) -> wp.float64:
    """Dissipation potential over the step, J/m^3; zero without damping, and for inverse_dt = 0."""
    rate = elements.damping[e] * inverse_dt
    if rate <= wp.float64(0.0):
        return wp.float64(0.0)
    strain = green_strain_increment(F, cauchy_green[e])
    return viscous_energy(strain, rate * elements.mu[e], rate * elements.lam[e])


@wp.func
def damped(
    stress: wp.mat33d, rate: wp.float64, m: Constants, F: wp.mat33d, cauchy_green: wp.mat33d
) -> wp.mat33d:
    """`stress`, Pa, and that of `damping_energy`; `rate` is damping over the step's length."""
    if rate > wp.float64(0.0):
        return stress + viscous_stress(F, green_strain_increment(F, cauchy_green), rate * m.mu, rate * m.lam)
    return stress


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
    """Elastic energy plus damping potential of each element, J. inverse_dt = 0 leaves the damping out.

    For laws that need no singular values.
    """
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], x)
    m = Constants()
    m.law = elements.law[e]
    m.mu = elements.mu[e]
    m.lam = elements.lam[e]
    density = neo_hookean_energy(F, m)
    if m.law == LINEAR:
        density = linear_energy(F, m)
    density += damping_energy(elements, e, F, cauchy_green, inverse_dt)
    energy_out[e] = elements.volume[e] * density


@wp.kernel
def element_energy_by_stretches(
    start: int,
    # In:
    lanes: int,
    count: int,
    elements: Elements,
    x: wp.array[wp.vec3d],
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    # Work:
    work_out: wp.array[wp.float64],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """`element_energy` for every law; where an element yields, what the flow dissipates is in it too.

    The index is a group, as in `element_derivatives`.
    """
    group = start + wp.tid()
    place = wp.where(lanes == 1, group, start)
    decompose_group(group, place, count, elements.tets, elements.inverse_rest, x, work_out)
    for e in range(group * lanes, wp.min(count, (group + 1) * lanes)):
        at = place * WORK * lanes + e - group * lanes
        F = read_matrix(work_out, at, lanes, F_SLOT)
        s = read_vector(work_out, at, lanes, S_SLOT)
        m = constants_of(elements, e)
        density = energy_density(F, s, m)
        density += damping_energy(elements, e, F, cauchy_green, inverse_dt)
        energy_out[e] = elements.volume[e] * density


@wp.kernel
def element_gradient(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    # Out:
    gradient_out: wp.array[wp.vec3d],
):
    """Gradient (4 vectors) of each element."""
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], x)
    m = constants_of(elements, e)
    P = damped(piola_stress(F, m), elements.damping[e] * inverse_dt, m, F, cauchy_green[e])
    forces = (elements.volume[e] * P) * wp.transpose(elements.inverse_rest[e])
    write_corners(e, forces, gradient_out)


@wp.func
def write_law(
    e: int,
    at: int,
    lanes: int,
    elements: Elements,
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    exact: int,
    work_out: wp.array[wp.float64],
):
    """Stress of element e, and its Hessian in the frame of the singular vectors, projected unless `exact`."""
    m = constants_of(elements, e)
    m.exact = exact
    rate = elements.damping[e] * inverse_dt
    F = read_matrix(work_out, at, lanes, F_SLOT)
    s = read_vector(work_out, at, lanes, S_SLOT)
    U = wp.mat33d()
    V = wp.mat33d()
    if needs_stretches(m.law):
        U = read_matrix(work_out, at, lanes, U_SLOT)
        V = read_matrix(work_out, at, lanes, V_SLOT)
    stress = damped(piola_stress_in_frame(F, U, s, V, m), rate, m, F, cauchy_green[e])
    write_matrix(stress, at, lanes, STRESS_SLOT, work_out)
    A, halves = principal_hessian(s, m)
    pairs = wp.matrix_from_rows(
        wp.vec3d(halves[0, 0], halves[0, 0], halves[0, 1]),
        wp.vec3d(halves[1, 0], halves[1, 0], halves[1, 1]),
        wp.vec3d(halves[2, 0], halves[2, 0], halves[2, 1]),
    )
    if m.law == LINEAR:
        s = wp.vec3d(wp.float64(1.0))  # strains are small
        write_matrix(wp.identity(n=3, dtype=wp.float64), at, lanes, U_SLOT, work_out)
        write_matrix(elements.inverse_rest[e], at, lanes, G_SLOT, work_out)
    if rate > wp.float64(0.0):
        viscous, viscous_pairs = viscous_hessian(s, rate * m.mu, rate * m.lam)
        A += viscous
        pairs += viscous_pairs
    write_matrix(A, at, lanes, A_SLOT, work_out)
    write_matrix(pairs, at, lanes, PAIR_SLOT, work_out)


@wp.kernel
def element_derivatives(
    start: int,
    # In:
    lanes: int,
    count: int,
    elements: Elements,
    x: wp.array[wp.vec3d],
    cauchy_green: wp.array[wp.mat33d],
    inverse_dt: wp.float64,
    exact: int,
    # Work:
    work_out: wp.array[wp.float64],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    blocks_out: wp.array[wp.mat33d],
):
    """Gradient (4 vectors) and Hessian (10 blocks, a <= b, row by row) of each element.

    Hessians are projected unless `exact`. The index is a group of `lanes` of the `count` elements, see
    `gdpro_sim.kernels.element_lanes`.
    """
    group = start + wp.tid()
    # A CPU launch goes through its groups one after the other: they can share the first one's work.
    place = wp.where(lanes == 1, group, start)
    fetch_blocks_group(group, count, blocks_out)
    decompose_group(group, place, count, elements.tets, elements.inverse_rest, x, work_out)
    for e in range(group * lanes, wp.min(count, (group + 1) * lanes)):
        at = place * WORK * lanes + e - group * lanes
        write_law(e, at, lanes, elements, cauchy_green, inverse_dt, exact, work_out)
    write_derivatives_group(
        group, place, count, elements.inverse_rest, elements.volume, work_out, gradient_out, blocks_out
    )


@wp.kernel
def element_flow(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    # Out:
    inverse_rest_out: wp.array[wp.mat33d],
    plastic_strain_out: wp.array[wp.float64],
):
    """Moves stress-free shapes to where the stresses at x lie within the yield stress; both outs in place."""
    e = start + wp.tid()
    m = constants_of(elements, e)
    if m.limit < wp.float64(wp.inf):
        inverse_rest = elements.inverse_rest[e]
        F = deformation_gradient(elements.tets[e], inverse_rest, x)
        _U, s, V = singular_value_decomposition(F)
        G, growth = flow(s, V, m.mu, m.limit, m.hardening)
        if growth > wp.float64(0.0):
            inverse_rest_out[e] = inverse_rest * G
            plastic_strain_out[e] = elements.plastic_strain[e] + growth
