"""Pictures of an opaque triangle mesh by a z-buffer: on a CPU several times as fast as casting rays.

The samples are those that rays would go through; `shade` colours them as `raycast` does. One index draws all
faces into one band of one view, in order, so that the result does not depend on the number of threads.
"""

import warp as wp

from gdpro_sim.kernels.raycast import Sample, Surface, color_at, put

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

FLAT = wp.constant(1.0e-12)


@wp.kernel
def project_vertices(
    start: int,
    # In:
    vertices: wp.array[wp.vec3],
    eyes: wp.array[wp.vec3],
    rotations: wp.array[wp.mat33],
    ks: wp.array[wp.mat33],
    rays: int,
    # Out:
    projected_out: wp.array[wp.vec3],
):
    """Vertices of each view in samples across and down (their centres at +0.5), and one over z."""
    i = start + wp.tid()
    view = i // vertices.shape[0]
    local = rotations[view] * (vertices[i - view * vertices.shape[0]] - eyes[view])
    p = ks[view] * local
    inverse = 1.0 / local[2]
    projected_out[i] = wp.vec3(p[0] * inverse * float(rays), p[1] * inverse * float(rays), inverse)


@wp.func
def cross(a: wp.vec3, b: wp.vec3, x: float, y: float) -> float:
    """Twice the signed area of the screen triangle a, b, (x, y)."""
    return (b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])


@wp.kernel
def draw_faces(
    start: int,
    # In:
    projected: wp.array[wp.vec3],
    faces: wp.array[int],
    vertices: int,
    columns: int,
    rows: int,
    bands: int,
    # Out:
    nearest_out: wp.array[float],
    face_out: wp.array[int],
):
    """The nearest face at each sample of a band and one over its z; what is there must say -1 and 0."""
    i = start + wp.tid()
    view = i // bands
    first = rows * (i % bands) // bands
    last = rows * (i % bands + 1) // bands - 1
    base = view * vertices
    for f in range(faces.shape[0] // 3):
        a = projected[base + faces[3 * f]]
        b = projected[base + faces[3 * f + 1]]
        c = projected[base + faces[3 * f + 2]]
        # Truncation is as good as ceil(low - 0.5) and floor(high - 0.5) here, and cheaper: a sample too many
        # is turned down below, and one on the very edge belongs to the neighbour.
        left = wp.max(int(wp.min(a[0], wp.min(b[0], c[0])) + 0.5), 0)
        right = wp.min(int(wp.max(a[0], wp.max(b[0], c[0])) - 0.5), columns - 1)
        if left > right:
            continue
        top = wp.max(int(wp.min(a[1], wp.min(b[1], c[1])) + 0.5), first)
        bottom = wp.min(int(wp.max(a[1], wp.max(b[1], c[1])) - 0.5), last)
        if top > bottom:
            continue
        area = cross(a, b, c[0], c[1])
        if wp.abs(area) < FLAT:
            continue
        share = 1.0 / area
        for row in range(top, bottom + 1):
            y = float(row) + 0.5
            for column in range(left, right + 1):
                x = float(column) + 0.5
                u = cross(b, c, x, y) * share
                v = cross(c, a, x, y) * share
                w = 1.0 - u - v
                if u >= 0.0 and v >= 0.0 and w >= 0.0:
                    near = u * a[2] + v * b[2] + w * c[2]
                    j = (view * rows + row) * columns + column
                    if near > nearest_out[j]:
                        nearest_out[j] = near
                        face_out[j] = f


@wp.kernel
def shade(
    start: int,
    # In:
    surface: Surface,
    projected: wp.array[wp.vec3],
    faces: wp.array[int],
    vertices: int,
    inverse_ks: wp.array[wp.mat33],
    width: int,
    height: int,
    rays: int,
    nearest: wp.array[float],
    face: wp.array[int],
    # Out:
    rgb_out: wp.array[wp.vec3],
    alpha_out: wp.array[float],
    depth_out: wp.array[float],
    normal_out: wp.array[wp.vec3],
):
    """Means over each pixel's rays x rays samples, as `raycast.draw_surface` gives them."""
    i = start + wp.tid()
    view = i // (width * height)
    row = (i // width) % height
    column = i % width
    inverse = inverse_ks[view]
    patch = wp.abs(inverse[0, 0] * inverse[1, 1]) / float(rays * rays)
    with_normals = surface.corner_normals.shape[0] > 0
    sample = Sample()
    for k in range(rays * rays):
        x = column * rays + k % rays
        y = row * rays + k // rays
        j = (view * height * rays + y) * width * rays + x
        f = face[j]
        if f >= 0:
            a = projected[view * vertices + faces[3 * f]]
            b = projected[view * vertices + faces[3 * f + 1]]
            c = projected[view * vertices + faces[3 * f + 2]]
            area = cross(a, b, c[0], c[1])
            z = 1.0 / nearest[j]
            # Weights on the face, not on the screen.
            u = cross(b, c, float(x) + 0.5, float(y) + 0.5) / area * a[2] * z
            v = cross(c, a, float(x) + 0.5, float(y) + 0.5) / area * b[2] * z
            color = color_at(surface, f, u, v, patch * z * z)
            sample.rgb += wp.vec3(color[0], color[1], color[2])
            sample.alpha += 1.0
            sample.depth += z
            if with_normals:
                n = (
                    surface.corner_normals[3 * f] * u
                    + surface.corner_normals[3 * f + 1] * v
                    + surface.corner_normals[3 * f + 2] * (1.0 - u - v)
                )
                # Seen from outside, corners run clockwise on the screen, where y is down.
                if area > 0.0:
                    n = -n
                sample.normal += wp.normalize(n)
    put(i, sample, rays, rgb_out, alpha_out, depth_out, normal_out, with_normals)
