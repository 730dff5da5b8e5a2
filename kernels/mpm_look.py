"""A surface carried by particles: blended where it stays whole, patch by patch where it may come apart.

Displacements are blended rather than positions, so that at rest nothing is rounded.
"""

import warp as wp

from gdpro_sim.kernels.decomposition import singular_value_decomposition

wp.set_module_options({"enable_backward": False})

IDENTITY = wp.constant(wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0))


@wp.func
def within(F: wp.mat33, stretch: float, anisotropy: float) -> bool:
    """Whether Gershgorin's circles of F^T F already tell that F keeps to the bounds; False: not known."""
    C = wp.transpose(F) * F
    low = float(1.0e30)
    high = float(0.0)
    for i in range(3):
        radius = wp.abs(C[i, (i + 1) % 3]) + wp.abs(C[i, (i + 2) % 3])
        low = wp.min(low, C[i, i] - radius)
        high = wp.max(high, C[i, i] + radius)
    inside = low * stretch * stretch >= 1.0 and high <= stretch * stretch
    return inside and high <= low * anisotropy * anisotropy and wp.determinant(F) > 0.0


@wp.func
def bounded(F: wp.mat33, stretch: float, anisotropy: float) -> wp.mat33:
    """F with singular values s0 >= s1 >= s2 in [1 / stretch, stretch] and s0 <= anisotropy * s2.

    What is pulled one way is cut short: no needles. What is pulled two ways, as matter that spreads in a thin
    layer, is thickened instead, so that it covers as much. A reflection becomes a rotation; what is not
    finite, the identity.
    """
    if within(F, stretch, anisotropy):
        return F
    size = wp.ddot(F, F)
    if not (size > 1.0e-20 and size < 1.0e20):
        return IDENTITY
    U, s, V = singular_value_decomposition(wp.mat33d(F))
    most = wp.float64(stretch)
    least = wp.float64(1.0) / most
    ratio = wp.float64(anisotropy)
    s1 = wp.clamp(s[1], least, most)
    s0 = wp.min(wp.clamp(s[0], least, most), ratio * s1)
    s2 = wp.max(wp.clamp(s[2], least, most), s0 / ratio)
    return wp.mat33(U * wp.diag(wp.vec3d(s0, s1, s2)) * wp.transpose(V))


@wp.kernel
def bound_deformations(
    start: int,
    # In:
    deformations: wp.array[wp.mat33],
    stretch: float,
    anisotropy: float,
    # Out:
    gradients_out: wp.array[wp.mat33],
):
    """Bounded F - I of each particle: the gradient of its displacement."""
    i = start + wp.tid()
    gradients_out[i] = bounded(deformations[i], stretch, anisotropy) - IDENTITY


@wp.kernel
def carry_vertices(
    start: int,
    # In:
    rest_positions: wp.array[wp.vec3],
    positions: wp.array[wp.vec3],
    gradients: wp.array[wp.mat33],
    rest_surface: wp.array[wp.vec3],
    neighbours: wp.array2d[int],
    weights: wp.array2d[float],
    # Out:
    surface_out: wp.array[wp.vec3],
):
    """X + sum of w (x_p - X_p + (F_p - I) (X - X_p)) for each vertex X."""
    i = start + wp.tid()
    X = rest_surface[i]
    d = wp.vec3()
    for k in range(neighbours.shape[1]):
        p = neighbours[i, k]
        Xp = rest_positions[p]
        d += weights[i, k] * (positions[p] - Xp + gradients[p] * (X - Xp))
    surface_out[i] = X + d


@wp.kernel
def carry_patches(
    start: int,
    # In:
    rest_positions: wp.array[wp.vec3],
    positions: wp.array[wp.vec3],
    gradients: wp.array[wp.mat33],
    rest_surface: wp.array[wp.vec3],
    vertex_offsets: wp.array[int],
    centres: wp.array[wp.vec3],
    offsets: wp.array[int],
    neighbours: wp.array[int],
    weights: wp.array[float],
    tolerance: float,
    stretch: float,
    anisotropy: wp.array[float],
    # Out:
    surface_out: wp.array[wp.vec3],
):
    """Each patch moves by one affine map: that of its nearest particle, blended with those of neighbours that
    still take its centre to within `tolerance` m of the same place."""
    i = start + wp.tid()
    c = centres[i]
    first = neighbours[offsets[i]]
    Xp = rest_positions[first]
    own = positions[first] - Xp + gradients[first] * (c - Xp)
    total = float(0.0)
    d = wp.vec3()
    A = wp.mat33()
    for k in range(offsets[i], offsets[i + 1]):
        p = neighbours[k]
        Xp = rest_positions[p]
        moved = positions[p] - Xp + gradients[p] * (c - Xp)
        off = wp.length(moved - own) / tolerance
        if off < 1.0:
            agreement = 1.0 - off * off
            w = weights[k] * agreement * agreement
            d += w * moved
            A += w * gradients[p]
            total += w
    d = d / total
    # A mean of rotations is shorter than they are: bounds hold anew.
    A = bounded(A / total + IDENTITY, stretch, anisotropy[i]) - IDENTITY
    for v in range(vertex_offsets[i], vertex_offsets[i + 1]):
        X = rest_surface[v]
        surface_out[v] = X + (d + A * (X - c))
