"""Light that reaches points, read from one splatted alpha and depth image per light."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 4})


@wp.func
def light_reaching(
    alpha: wp.array3d[float],
    depth: wp.array3d[float],
    light: int,
    u: float,
    v: float,
    z: float,
    bias: float,
    softness: float,
) -> float:
    """Share of a light in [0, 1] at pixel (u, v) and depth z, bilinear; all of it outside the image."""
    height = alpha.shape[1]
    width = alpha.shape[2]
    x = u - 0.5
    y = v - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    a = float(0.0)
    d = float(0.0)
    for dy in range(2):
        for dx in range(2):
            column = x0 + dx
            row = y0 + dy
            if column >= 0 and row >= 0 and column < width and row < height:
                weight = (1.0 - wp.abs(x - float(column))) * (1.0 - wp.abs(y - float(row)))
                a += weight * alpha[light, row, column]
                d += weight * depth[light, row, column]
    if a <= 1e-6:
        return 1.0
    return 1.0 - a * wp.clamp((z - d / a - bias) / softness, 0.0, 1.0)


@wp.kernel
def gather_light(
    start: int,
    # In:
    points: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    alpha: wp.array3d[float],
    depth: wp.array3d[float],
    viewmats: wp.array[wp.mat44],
    focal: float,
    directions: wp.array[wp.vec3],
    weights: wp.array[float],
    first: wp.array[int],
    bias: float,
    softness: float,
    # Out:
    light_out: wp.array2d[float],
    seen_out: wp.array2d[float],
):
    """Per point and group of lights: what arrives of their light (with the cosine), and how visible they are.

    Group g holds the lights from first[g] up to first[g + 1].
    """
    i = start + wp.tid()
    p = points[i]
    n = normals[i]
    middle_u = 0.5 * float(alpha.shape[2])
    middle_v = 0.5 * float(alpha.shape[1])
    for group in range(first.shape[0] - 1):
        arriving = float(0.0)
        seen = float(0.0)
        count = float(first[group + 1] - first[group])
        for light in range(first[group], first[group + 1]):
            cosine = wp.dot(n, directions[light])
            if cosine <= 0.0:
                continue
            q = wp.transform_point(viewmats[light], p)
            share = float(1.0)
            if q[2] > 0.0:
                u = focal * q[0] / q[2] + middle_u
                v = focal * q[1] / q[2] + middle_v
                share = light_reaching(alpha, depth, light, u, v, q[2], bias, softness)
            arriving += weights[light] * cosine * share
            seen += share / count
        light_out[i, group] = arriving
        seen_out[i, group] = seen
