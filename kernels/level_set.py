"""First crossings of rays with a level of the density of Gaussians, over a bounding-volume hierarchy."""

import warp as wp

wp.set_module_options({"enable_backward": False})

CUTOFF = wp.constant(3.0)
"""Standard deviations past which a Gaussian is nothing; its box ends there."""

BISECTIONS = wp.constant(8)


@wp.func
def density_at(
    bvh: wp.uint64,
    means: wp.array[wp.vec3],
    whitening: wp.array[wp.mat33],
    opacities: wp.array[float],
    point: wp.vec3,
    direction: wp.vec3,
):
    """Density, and half the least width along the ray of a Gaussian in reach: a step that leaps none."""
    density = float(0.0)
    step = float(1.0e10)
    query = wp.bvh_query_aabb(bvh, point, point)
    i = int(0)
    while wp.bvh_query_next(query, i):
        m = whitening[i] * (point - means[i])
        squared = wp.dot(m, m)
        if squared < CUTOFF * CUTOFF:
            density += opacities[i] * wp.exp(-0.5 * squared)
            step = wp.min(step, 0.5 / wp.length(whitening[i] * direction))
    return density, step


@wp.func
def next_entry(
    bvh: wp.uint64,
    means: wp.array[wp.vec3],
    whitening: wp.array[wp.mat33],
    origin: wp.vec3,
    direction: wp.vec3,
    t: float,
) -> float:
    """Smallest distance along the ray past `t` at which a Gaussian comes within reach."""
    entry = float(1.0e10)
    query = wp.bvh_query_ray(bvh, origin, direction)
    i = int(0)
    while wp.bvh_query_next(query, i):
        w = whitening[i] * direction
        m = whitening[i] * (means[i] - origin)
        curvature = wp.dot(w, w)
        peak = wp.dot(w, m) / curvature
        across = m - peak * w
        left = CUTOFF * CUTOFF - wp.dot(across, across)
        if left > 0.0:
            at = peak - wp.sqrt(left / curvature)
            if at > t:
                entry = wp.min(entry, at)
    return entry


@wp.kernel
def first_crossings(
    start: int,
    # In:
    bvh: wp.uint64,
    means: wp.array[wp.vec3],
    whitening: wp.array[wp.mat33],
    opacities: wp.array[float],
    origin: wp.vec3,
    directions: wp.array[wp.vec3],
    level: float,
    near: float,
    far: float,
    smallest: float,
    # Out:
    distances_out: wp.array[float],
    normals_out: wp.array[wp.vec3],
):
    """Distance along each ray where the density first reaches `level` (infinity for none), and minus the
    density's unit gradient there.

    whitening: W with W^T W the inverse covariance. No step is below `smallest`.
    """
    ray = start + wp.tid()
    direction = directions[ray]
    distances_out[ray] = wp.inf
    normals_out[ray] = wp.vec3()
    low = near
    t = near
    found = bool(False)
    while t < far and not found:
        density, step = density_at(bvh, means, whitening, opacities, origin + t * direction, direction)
        if density >= level:
            found = True
        else:
            low = t
            if step < 1.0e9:
                t += wp.max(step, smallest)
            else:
                t = next_entry(bvh, means, whitening, origin, direction, t) + smallest
    if found:
        high = t
        for _k in range(BISECTIONS):
            middle = 0.5 * (low + high)
            density, _step = density_at(
                bvh, means, whitening, opacities, origin + middle * direction, direction
            )
            if density >= level:
                high = middle
            else:
                low = middle
        p = origin + high * direction
        gradient = wp.vec3()
        query = wp.bvh_query_aabb(bvh, p, p)
        i = int(0)
        while wp.bvh_query_next(query, i):
            m = whitening[i] * (p - means[i])
            gradient -= opacities[i] * wp.exp(-0.5 * wp.dot(m, m)) * (wp.transpose(whitening[i]) * m)
        length = wp.length(gradient)
        if length > 0.0:
            distances_out[ray] = high
            normals_out[ray] = -gradient / length
