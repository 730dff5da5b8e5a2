"""Disks on the surface that particles of a fluid stand for, made anew from their places alone.

Normals come from where the neighbours are: away from their mean at a surface (Mueller et al. 2003 take the
gradient of a smoothed density, which points the same way), across the plane that they lie in where they make
a film. Heights above the tangent planes are averaged, a moving least squares projection of order zero
(Alexa et al. 2003), so that what is drawn is smoother than the particles are.
"""

import warp as wp

wp.set_module_options({"enable_backward": False})

CLOSE = wp.constant(2.2)
"""Distance within which neighbours count for how dense particles lie, in spacings."""

SURFACE_STARTS = wp.constant(0.17)
"""Distance in spacings from a particle to its neighbours' mean below which it is inside."""

SURFACE_ENDS = wp.constant(0.49)
"""Distance at which it is wholly on the surface: in a half space, that of the outermost particles."""

FILM = wp.constant(0.8)
"""Weight of a film's normal beside that of a surface."""

DENSE = wp.constant(4.5)
"""Sum of weights around a particle on a flat surface; where there is less, disks are larger to cover it."""

WIDEST = wp.constant(1.7)

LONE = wp.constant(0.65)
"""Size of a drop of one particle, on the same scale."""

DISK = wp.constant(0.6)
"""Standard deviation of a disk on a flat surface, in spacings."""

OUT = wp.constant(0.5)
"""How far the surface lies outside the middles of its particles, in spacings."""

STRAY = wp.constant(1.5)
"""Height above a tangent plane, in spacings, from which on a neighbour is not of the same surface."""

TIP = wp.constant(0.57735026919)
"""Corners of an equilateral triangle two wide: (-1, -TIP), (1, -TIP), (0, 2 TIP)."""


@wp.func
def bump(squared: float, radius: float) -> float:
    """(1 - r^2 / h^2)^3, a weight that ends at the radius h."""
    left = wp.max(1.0 - squared / (radius * radius), 0.0)
    return left * left * left


@wp.func
def ramp(x: float) -> float:
    """0 below 0, 1 above 1, smooth in between."""
    t = wp.clamp(x, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


@wp.func
def some_normal(d: wp.vec3, other: wp.vec3) -> wp.vec3:
    """d / |d|; `other` where d has no length."""
    length = wp.length(d)
    if length > 1.0e-12:
        return d / length
    return other


@wp.kernel
def find_surface(
    start: int,
    # In:
    cells: wp.uint64,
    positions: wp.array[wp.vec3],
    radius: float,
    spacing: float,
    # Out:
    normals_out: wp.array[wp.vec3],
    surface_out: wp.array[float],
    film_out: wp.array[float],
    sizes_out: wp.array[float],
):
    """Of each particle: a normal, outward; how far it is on a surface and in a film, 0 to 1; and the size of
    its disk, m, a standard deviation."""
    i = start + wp.tid()
    x = positions[i]
    total = float(0.0)
    close = float(0.0)
    mean = wp.vec3()
    second = wp.mat33()
    for j in wp.hash_grid_query(cells, x, radius):
        d = positions[j] - x
        squared = wp.dot(d, d)
        if squared < radius * radius:
            w = bump(squared, radius)
            total += w
            close += bump(squared, CLOSE * spacing)
            mean += w * d
            second += w * wp.outer(d, d)
    mean = mean / total
    second = second / total - wp.outer(mean, mean)
    axes, squares = wp.eig3(second)
    thin = int(0)
    for k in range(1, 3):
        if squares[k] < squares[thin]:
            thin = k
    least = wp.max(squares[thin], 1.0e-6 * spacing * spacing)
    most = wp.max(wp.max(squares[0], squares[1]), squares[2])
    middle = wp.max(squares[0] + squares[1] + squares[2] - squares[thin] - most, least)
    across = wp.vec3(axes[0, thin], axes[1, thin], axes[2, thin])
    if wp.dot(across, mean) > 0.0:
        across = -across
    film = wp.clamp(wp.sqrt(middle / least) - 1.15, 0.0, 1.0)
    off = wp.length(mean) / spacing
    surface = ramp((off - SURFACE_STARTS) / (SURFACE_ENDS - SURFACE_STARTS))
    away = some_normal(-mean, across)
    normals_out[i] = some_normal(surface * away + (FILM * film + 1.0e-6) * across, away)
    surface_out[i] = surface
    film_out[i] = film
    wide = wp.clamp(wp.sqrt(DENSE / wp.max(close, 1.0e-3)), 1.0, WIDEST)
    lone = ramp((close - 1.0) / 0.8)
    sizes_out[i] = DISK * spacing * (LONE + (wide - LONE) * lone)


@wp.kernel
def smooth_normals(
    start: int,
    # In:
    cells: wp.uint64,
    positions: wp.array[wp.vec3],
    radius: float,
    surface: wp.array[float],
    film: wp.array[float],
    normals: wp.array[wp.vec3],
    # Out:
    normals_out: wp.array[wp.vec3],
):
    """Mean of the normals around; in a film those of its other side count reversed."""
    i = start + wp.tid()
    n = normals[i]
    if surface[i] == 0.0 and film[i] == 0.0:
        normals_out[i] = n
        return
    x = positions[i]
    total = wp.vec3()
    for j in wp.hash_grid_query(cells, x, radius):
        seen = wp.max(surface[j], film[j])
        if seen > 0.0:
            d = positions[j] - x
            squared = wp.dot(d, d)
            if squared < radius * radius:
                agreement = wp.dot(n, normals[j])
                if agreement < 0.0:
                    agreement = agreement * film[i] * wp.where(surface[i] < 0.5, 1.0, 0.0)
                total += bump(squared, radius) * seen * agreement * normals[j]
    normals_out[i] = some_normal(total, n)


@wp.kernel
def raise_disks(
    start: int,
    # In:
    positions: wp.array[wp.vec3],
    spacing: float,
    surface: wp.array[float],
    normals: wp.array[wp.vec3],
    # Out:
    disks_out: wp.array[wp.vec3],
):
    """From the middles of particles to the surface outside them."""
    i = start + wp.tid()
    disks_out[i] = positions[i] + OUT * spacing * surface[i] * normals[i]


@wp.kernel
def smooth_heights(
    start: int,
    # In:
    cells: wp.uint64,
    positions: wp.array[wp.vec3],
    radius: float,
    spacing: float,
    surface: wp.array[float],
    normals: wp.array[wp.vec3],
    disks: wp.array[wp.vec3],
    # Out:
    disks_out: wp.array[wp.vec3],
):
    """Move each disk along its normal to the mean height of those around that face the same way."""
    i = start + wp.tid()
    p = disks[i]
    if surface[i] == 0.0:
        disks_out[i] = p
        return
    x = positions[i]
    n = normals[i]
    total = float(0.0)
    height = float(0.0)
    for j in wp.hash_grid_query(cells, x, radius):
        if surface[j] > 0.0:
            d = positions[j] - x
            squared = wp.dot(d, d)
            if squared < radius * radius:
                agreement = wp.dot(n, normals[j])
                off = wp.dot(disks[j] - p, n)
                if agreement > 0.0 and wp.abs(off) < STRAY * spacing:
                    agreement = agreement * agreement
                    w = bump(squared, radius) * agreement * agreement * surface[j] * surface[j]
                    total += w
                    height += w * off
    disks_out[i] = p + surface[i] * height / wp.max(total, 1.0e-12) * n


@wp.kernel
def draw_disks(
    start: int,
    # In:
    disks: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    sizes: wp.array[float],
    # Out:
    vertices_out: wp.array[wp.vec3],
):
    """An equilateral triangle across each normal, two standard deviations wide."""
    i = start + wp.tid()
    n = normals[i]
    other = wp.vec3(1.0, 0.0, 0.0)
    if wp.abs(n[0]) > 0.7:
        other = wp.vec3(0.0, 1.0, 0.0)
    along = sizes[i] * wp.normalize(wp.cross(other, n))
    across = wp.cross(n, along)
    p = disks[i]
    vertices_out[3 * i] = p - along - TIP * across
    vertices_out[3 * i + 1] = p + along - TIP * across
    vertices_out[3 * i + 2] = p + 2.0 * TIP * across
