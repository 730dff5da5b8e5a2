"""Volume changes averaged over the elements around each vertex, so that nearly incompressible tets do not
lock.

Linear tets carry one volume ratio each; there are five times as many of them as vertices, and asking every
one to keep its volume leaves too few motions. Here the stiff part of the volumetric energy sees the ratio of
nodal volumes (Bonet & Burton 1998, "A simple average nodal pressure tetrahedral element for incompressible
and nearly incompressible dynamic explicit applications", Comm. Num. Meth. Eng. 14):

    E(x) = sum_n V_n k_n f(v_n / V_n),   v_n = 1/4 sum_{e at n} V_e det F_e,   V_n = 1/4 sum_{e at n} V_e

with f(J) = (J - 1)^2 / 2, or (ln J)^2 / 2 where the law's own volumetric energy is logarithmic. k_n is the
part of lambda taken from the elements, which keep the rest: without it modes of zero energy appear (Puso &
Solberg 2006, "A stabilized nodally integrated tetrahedral", Int. J. Num. Meth. Eng. 67).

With p_n = k_n f'(v_n / V_n) the force is that of a pressure p_e, the mean of p_n over the element's corners.
Its derivative has two parts: p_e d2J_e, which the elements take into their own projected Hessians, and

    G^T D G,  G_ni = dv_n / dx_i = 1/4 sum_{e at n and i} V_e cof F_e grad N_i,
              D_n = k_n f''(v_n / V_n) / V_n

with f'' taken as positive: semidefinite, and applied factor by factor, since its own pattern is far denser.
"""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.elasticity import determinant_gradient
from gdpro_sim.kernels.elements import Elements, deformation_gradient, write_corners

wp.set_module_options({"enable_backward": False})


@wp.struct
class Nodes:
    """Constant data of the averaged volumes."""

    volume: wp.array[wp.float64]  # V_n, m^3
    stiffness: wp.array[wp.float64]  # k_n, Pa; 0 where elements keep all of lambda
    logarithmic: wp.array[wp.int32]
    offsets: wp.array[wp.int32]  # into `corners`
    corners: wp.array[wp.int32]  # 4 * element + corner


@wp.func
def nodal_volume(nodes: Nodes, n: int, volumes: wp.array[wp.float64]) -> wp.float64:
    total = wp.float64(0.0)
    for k in range(nodes.offsets[n], nodes.offsets[n + 1]):
        total += volumes[nodes.corners[k] >> 2]
    return wp.float64(0.25) * total


@wp.kernel
def element_volumes(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    # Out:
    volume_out: wp.array[wp.float64],
):
    """Deformed volume V_e det F_e of each element, m^3."""
    e = start + wp.tid()
    F = deformation_gradient(elements.tets[e], elements.inverse_rest[e], x)
    volume_out[e] = elements.volume[e] * wp.determinant(F)


@wp.kernel
def nodal_energy(
    start: int,
    # In:
    first: int,
    nodes: Nodes,
    volumes: wp.array[wp.float64],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """V_n k_n f(v_n / V_n) of each vertex, J, written from index `first` on."""
    n = start + wp.tid()
    energy = wp.float64(0.0)
    k = nodes.stiffness[n]
    if k > wp.float64(0.0):
        J = nodal_volume(nodes, n, volumes) / nodes.volume[n]
        d = J - wp.float64(1.0)
        if nodes.logarithmic[n] != 0:
            if J > wp.float64(0.0):
                d = wp.log(J)
            else:
                d = wp.float64(wp.inf)
        energy = wp.float64(0.5) * nodes.volume[n] * k * d * d
    energy_out[first + n] = energy


@wp.kernel
def nodal_pressure(
    start: int,
    # In:
    nodes: Nodes,
    volumes: wp.array[wp.float64],
    # Out:
    pressure_out: wp.array[wp.float64],
    curvature_out: wp.array[wp.float64],
):
    """p_n, Pa, and D_n, Pa/m^3, of each vertex."""
    n = start + wp.tid()
    k = nodes.stiffness[n]
    pressure = wp.float64(0.0)
    curvature = wp.float64(0.0)
    if k > wp.float64(0.0):
        J = nodal_volume(nodes, n, volumes) / nodes.volume[n]
        pressure = k * (J - wp.float64(1.0))
        curvature = k
        if nodes.logarithmic[n] != 0:
            log = wp.log(J)
            pressure = k * log / J
            curvature = k * wp.max(wp.float64(1.0) - log, wp.float64(0.0)) / (J * J)
        curvature /= nodes.volume[n]
    pressure_out[n] = pressure
    curvature_out[n] = curvature


@wp.kernel
def element_pressure(
    start: int,
    # In:
    elements: Elements,
    x: wp.array[wp.vec3d],
    pressure: wp.array[wp.float64],
    # Out:
    pressure_out: wp.array[wp.float64],
    slopes_out: wp.array[wp.vec3d],
):
    """p_e, Pa, and V_e cof F_e grad N_a / 4, m^2, of the four corners of each element."""
    e = start + wp.tid()
    tet = elements.tets[e]
    pressure_out[e] = wp.float64(0.25) * (
        pressure[tet[0]] + pressure[tet[1]] + pressure[tet[2]] + pressure[tet[3]]
    )
    inverse_rest = elements.inverse_rest[e]
    F = deformation_gradient(tet, inverse_rest, x)
    areas = (wp.float64(0.25) * elements.volume[e] * determinant_gradient(F)) * wp.transpose(inverse_rest)
    write_corners(e, areas, slopes_out)


@wp.func
def slot_corners(slot: int) -> wp.vec2i:
    """Corners (a, b) of slot 10's row-by-row upper triangle: see `gdpro_sim.simulation.fem.topology`."""
    a = int(0)
    first = int(0)
    while slot >= first + 4 - a:
        first += 4 - a
        a += 1
    return wp.vec2i(a, a + slot - first)


@wp.kernel
def gather_slopes(
    start: int,
    # In:
    offsets: wp.array[wp.int32],
    contributions: wp.array[wp.int32],
    slopes: wp.array[wp.vec3d],
    upper: wp.array[wp.int32],
    lower: wp.array[wp.int32],
    # Out:
    rows_out: wp.array[wp.vec3d],
    columns_out: wp.array[wp.vec3d],
):
    """G at the pair (i, j), i < j, and at (j, i); `columns_out` holds G^T in the same places.

    A contribution is 2 * (10 * element + slot) + (1 if i is the slot's second corner).
    """
    pair = start + wp.tid()
    at_low = wp.vec3d()
    at_high = wp.vec3d()
    for k in range(offsets[pair], offsets[pair + 1]):
        code = contributions[k]
        block = code >> 1
        element = block / 10
        corners = slot_corners(block - 10 * element)
        low = corners[0]
        high = corners[1]
        if (code & 1) != 0:
            low = corners[1]
            high = corners[0]
        at_low += slopes[4 * element + low]
        at_high += slopes[4 * element + high]
    rows_out[upper[pair]] = at_high
    rows_out[lower[pair]] = at_low
    columns_out[upper[pair]] = at_low
    columns_out[lower[pair]] = at_high


@wp.kernel
def gather_own_slopes(
    start: int,
    # In:
    nodes: Nodes,
    slopes: wp.array[wp.vec3d],
    diagonal: wp.array[wp.int32],
    # Out:
    rows_out: wp.array[wp.vec3d],
    columns_out: wp.array[wp.vec3d],
):
    """The diagonal of G."""
    n = start + wp.tid()
    total = wp.vec3d()
    for k in range(nodes.offsets[n], nodes.offsets[n + 1]):
        total += slopes[nodes.corners[k]]
    rows_out[diagonal[n]] = total
    columns_out[diagonal[n]] = total


@wp.kernel
def own_blocks(
    start: int,
    # In:
    offsets: wp.array[wp.int32],
    columns: wp.array[wp.int32],
    transposed: wp.array[wp.vec3d],
    curvature: wp.array[wp.float64],
    # Out:
    block_out: wp.array[wp.mat33d],
):
    """Diagonal blocks of G^T D G, for the preconditioner."""
    i = start + wp.tid()
    total = wp.mat33d()
    for k in range(offsets[i], offsets[i + 1]):
        total += curvature[columns[k]] * wp.outer(transposed[k], transposed[k])
    block_out[i] = total
