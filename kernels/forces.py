"""Prescribed motion of vertices, and loads: forces, pressure and wind on triangles.

Pressure p pushes against outward area vectors a_t. Over a closed surface it has the potential p V(x) with
dV/dx_i = (1/3) sum_t a_t, and the second derivative of V between the ends i, j of an edge is [x_l - x_k]x / 6
with k and l opposite it in the triangles that run i -> j and j -> i. The block [[0, B], [B^T, 0]] of an edge
has the eigenvalues +-p |x_l - x_k| / 6; its negative half is left out.

Wind acts on triangles that face it, with the relative velocity u = wind - v at their corners, n the normal
that looks downwind and s = n . u (Keckeisen, Kimmerle, Thomaszewski & Wacker, "Modelling effects of wind
fields in cloth animations", WSCG 2004; drag and lift of a flat plate):

    f = rho / 2 A (C_D s u + C_L s (|u| n - s u / |u|))

The drag of any convex body is then C_D rho / 2 |u|^2 times its area as seen from upwind.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})


@wp.struct
class Triangles:
    """Surface triangles, outward; and those around each of the vertices they touch."""

    faces: wp.array[wp.vec3i]
    vertices: wp.array[wp.int32]
    offsets: wp.array[wp.int32]  # into `around`
    around: wp.array[wp.int32]  # faces, ascending


@wp.func
def area_vector(face: wp.vec3i, x: wp.array[wp.vec3d]) -> wp.vec3d:
    """Outward normal times area, m^2."""
    origin = x[face[0]]
    return wp.float64(0.5) * wp.cross(x[face[1]] - origin, x[face[2]] - origin)


@wp.func
def vertex_area(triangles: Triangles, slot: int, x: wp.array[wp.vec3d]) -> wp.vec3d:
    """A third of the area vectors around a vertex, m^2."""
    total = wp.vec3d()
    for k in range(triangles.offsets[slot], triangles.offsets[slot + 1]):
        total += area_vector(triangles.faces[triangles.around[k]], x)
    return total / wp.float64(3.0)


@wp.kernel
def move_pins(
    start: int,
    # In:
    vertices: wp.array[wp.int32],
    motions: wp.array[wp.int32],
    rest: wp.array[wp.vec3d],
    rotation: wp.array[wp.mat33d],
    translation: wp.array[wp.vec3d],
    share: wp.float64,
    x: wp.array[wp.vec3d],
    # Out:
    held_out: wp.array[wp.vec3d],
):
    """Where moving pins are held: `share` of the way from x to rotation * rest + translation."""
    k = start + wp.tid()
    i = vertices[k]
    target = rotation[motions[k]] * rest[k] + translation[motions[k]]
    if share == wp.float64(1.0):
        held_out[i] = target
    else:
        held_out[i] = x[i] + share * (target - x[i])


@wp.kernel
def load_energy(
    start: int,
    # In:
    first: int,
    vertices: wp.array[wp.int32],
    force: wp.array[wp.vec3d],
    x: wp.array[wp.vec3d],
    origin: wp.array[wp.vec3d],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Work against constant forces since `origin`, J, written from index `first` on."""
    k = start + wp.tid()
    i = vertices[k]
    energy_out[first + k] = -wp.dot(force[k], x[i] - origin[i])


@wp.kernel
def add_loads(
    start: int,
    # In:
    vertices: wp.array[wp.int32],
    force: wp.array[wp.vec3d],
    # Out:
    gradient_out: wp.array[wp.vec3d],
):
    k = start + wp.tid()
    gradient_out[vertices[k]] -= force[k]


@wp.kernel
def pressure_forces(
    start: int,
    # In:
    triangles: Triangles,
    pressure: wp.float64,
    x: wp.array[wp.vec3d],
    # Out:
    force_out: wp.array[wp.vec3d],
):
    """Force of a pressure on each vertex at x, N."""
    k = start + wp.tid()
    force_out[k] = -pressure * vertex_area(triangles, k, x)


@wp.kernel
def volume_energy(
    start: int,
    # In:
    first: int,
    triangles: Triangles,
    rest: wp.array[wp.float64],
    pressure: wp.float64,
    origin: wp.vec3d,
    x: wp.array[wp.vec3d],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Pressure times each triangle's part of the enclosed volume, less `rest`, J, from index `first` on."""
    t = start + wp.tid()
    face = triangles.faces[t]
    part = wp.dot(x[face[0]] - origin, wp.cross(x[face[1]] - origin, x[face[2]] - origin)) / wp.float64(6.0)
    energy_out[first + t] = pressure * (part - rest[t])


@wp.kernel
def edge_blocks(
    start: int,
    # In:
    offsets: wp.array[wp.int32],
    opposite: wp.array[wp.int32],
    signs: wp.array[wp.float64],
    pressure: wp.float64,
    x: wp.array[wp.vec3d],
    # Out:
    across_out: wp.array[wp.mat33d],
    along_out: wp.array[wp.mat33d],
):
    """Semidefinite part of p d2V/dx_i dx_j of each edge: block (i, j), and the one on both diagonals, N/m."""
    e = start + wp.tid()
    d = wp.vec3d()
    for k in range(offsets[e], offsets[e + 1]):
        d += signs[k] * x[opposite[k]]
    scale = pressure / wp.float64(12.0)
    across_out[e] = scale * wp.skew(d)
    length = wp.length(d)
    block = wp.mat33d()
    if length > wp.float64(0.0):
        n = d / length
        block = (wp.abs(scale) * length) * (wp.identity(n=3, dtype=wp.float64) - wp.outer(n, n))
    along_out[e] = block


@wp.kernel
def add_pressure(
    start: int,
    # In:
    triangles: Triangles,
    pressure: wp.float64,
    edge_offsets: wp.array[wp.int32],
    edges: wp.array[wp.int32],
    along: wp.array[wp.mat33d],
    x: wp.array[wp.vec3d],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    block_out: wp.array[wp.mat33d],
):
    k = start + wp.tid()
    block = wp.mat33d()
    for e in range(edge_offsets[k], edge_offsets[k + 1]):
        block += along[edges[e]]
    i = triangles.vertices[k]
    gradient_out[i] += pressure * vertex_area(triangles, k, x)
    block_out[i] += block


@wp.struct
class Air:
    velocity: wp.vec3d  # m/s
    half_density: wp.float64  # rho / 2, kg/m^3
    drag: wp.float64
    lift: wp.float64


@wp.kernel
def wind_forces(
    start: int,
    # In:
    triangles: Triangles,
    air: Air,
    share: wp.float64,
    x: wp.array[wp.vec3d],
    base: wp.array[wp.vec3d],
    inverse_h: wp.float64,
    # Out:
    force_out: wp.array[wp.vec3d],
    drag_out: wp.array[wp.mat33d],
    position_out: wp.array[wp.vec3d],
):
    """Force of the air on each vertex at x, N; a symmetric semidefinite stand-in for its falling with the
    vertex's velocity, N s/m; and x itself."""
    k = start + wp.tid()
    i = triangles.vertices[k]
    u = air.velocity - inverse_h * (x[i] - base[i])
    speed = wp.length(u)
    force = wp.vec3d()
    slope = wp.mat33d()
    if speed > wp.float64(0.0):
        toward = u / speed
        one = wp.identity(n=3, dtype=wp.float64)
        for f in range(triangles.offsets[k], triangles.offsets[k + 1]):
            a = -area_vector(triangles.faces[triangles.around[f]], x) / wp.float64(3.0)
            area = wp.length(a)
            flux = wp.dot(a, u)  # A s
            if flux > wp.float64(0.0):
                n = a / area
                s = flux / area
                force += flux * (air.drag * u + air.lift * (speed * n - s * toward))
                slope += (air.drag * flux) * (one + wp.outer(toward, toward))
                across = speed - s * s / speed
                slope += (air.lift * area * across) * wp.outer(n, n)
    force_out[k] = (share * air.half_density) * force
    drag_out[k] = (share * air.half_density) * slope
    position_out[k] = x[i]


@wp.kernel
def lagged_energy(
    start: int,
    # In:
    first: int,
    vertices: wp.array[wp.int32],
    force: wp.array[wp.vec3d],
    drag: wp.array[wp.mat33d],
    position: wp.array[wp.vec3d],
    inverse_h: wp.float64,
    x: wp.array[wp.vec3d],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Work against a force that falls with velocity, from where it was taken, J, from index `first` on."""
    k = start + wp.tid()
    moved = x[vertices[k]] - position[k]
    energy_out[first + k] = -wp.dot(force[k], moved) + wp.float64(0.5) * inverse_h * wp.dot(
        moved, drag[k] * moved
    )


@wp.kernel
def add_lagged(
    start: int,
    # In:
    vertices: wp.array[wp.int32],
    force: wp.array[wp.vec3d],
    drag: wp.array[wp.mat33d],
    position: wp.array[wp.vec3d],
    inverse_h: wp.float64,
    x: wp.array[wp.vec3d],
    # Out:
    gradient_out: wp.array[wp.vec3d],
    block_out: wp.array[wp.mat33d],
):
    k = start + wp.tid()
    i = vertices[k]
    slope = inverse_h * drag[k]
    gradient_out[i] += slope * (x[i] - position[k]) - force[k]
    block_out[i] += slope
