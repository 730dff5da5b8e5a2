"""Pictures of a coloured triangle mesh by casting rays, several for each pixel.

Stored colours are sRGB-encoded and are interpolated and averaged as they are stored; a texture times a corner
colour is a product in linear light (glTF 2.0, section 3.9.2).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 4})

LAYERS = wp.constant(16)
"""See-through faces looked through along one ray."""

LIFT = wp.constant(1.0e-4)
"""How far behind a see-through face its ray goes on, in the mesh's unit."""

OPAQUE = wp.constant(0.999)


@wp.struct
class Surface:
    """A mesh and how it is coloured.

    corner_colors:  [3F] RGBA; base colour times corner colour, of faces without a texture
    corner_normals: [3F] unit, or [0] where none are asked for
    uvs:            [3F], v up; [0] where nothing is textured
    first_levels:   [F] index of a face's texture in `levels`, -1 for none; [0] where nothing is textured
    densities:      [F] texels per unit area of the face, at full size
    levels:         (first texel, width, height) of each mip level, a texture's levels one after the other
    level_counts:   [F] mip levels of a face's texture
    cutouts:        [F] 1 where the texture's alpha is opacity
    texels:         RGBA
    """

    mesh: wp.uint64
    corner_colors: wp.array[wp.vec4]
    corner_normals: wp.array[wp.vec3]
    uvs: wp.array[wp.vec2]
    first_levels: wp.array[int]
    densities: wp.array[float]
    levels: wp.array[wp.vec3i]
    level_counts: wp.array[int]
    cutouts: wp.array[int]
    texels: wp.array[wp.vec4ub]


@wp.func
def decode(value: float) -> float:
    """sRGB to linear light (IEC 61966-2-1)."""
    if value <= 0.04045:
        return value / 12.92
    return wp.pow((value + 0.055) / 1.055, 2.4)


@wp.func
def encode(value: float) -> float:
    if value <= 0.0031308:
        return value * 12.92
    return 1.055 * wp.pow(value, 1.0 / 2.4) - 0.055


@wp.func
def times(a: wp.vec4, b: wp.vec4) -> wp.vec4:
    """Product of two encoded colours; of their opacities."""
    if b[0] == 1.0 and b[1] == 1.0 and b[2] == 1.0:
        return wp.vec4(a[0], a[1], a[2], a[3] * b[3])
    return wp.vec4(
        encode(decode(a[0]) * decode(b[0])),
        encode(decode(a[1]) * decode(b[1])),
        encode(decode(a[2]) * decode(b[2])),
        a[3] * b[3],
    )


@wp.func
def wrap(i: int, n: int) -> int:
    r = i % n
    if r < 0:
        r += n
    return r


@wp.func
def texel(surface: Surface, level: wp.vec3i, x: int, y: int) -> wp.vec4:
    c = surface.texels[level[0] + wrap(y, level[2]) * level[1] + wrap(x, level[1])]
    return wp.vec4(float(c[0]), float(c[1]), float(c[2]), float(c[3])) / 255.0


@wp.func
def bilinear(surface: Surface, level: wp.vec3i, uv: wp.vec2) -> wp.vec4:
    """Colour between four texels of a level, wrapped around."""
    x = uv[0] * float(level[1]) - 0.5
    y = (1.0 - uv[1]) * float(level[2]) - 0.5
    x0 = int(wp.floor(x))
    y0 = int(wp.floor(y))
    fx = x - float(x0)
    fy = y - float(y0)
    top = texel(surface, level, x0, y0) * (1.0 - fx) + texel(surface, level, x0 + 1, y0) * fx
    bottom = texel(surface, level, x0, y0 + 1) * (1.0 - fx) + texel(surface, level, x0 + 1, y0 + 1) * fx
    return top * (1.0 - fy) + bottom * fy


@wp.func
def color_at(surface: Surface, face: int, u: float, v: float, area: float) -> wp.vec4:
    """Colour and opacity at barycentric coordinates (u, v, 1 - u - v); `area` is what a ray stands for."""
    w = 1.0 - u - v
    corners = surface.corner_colors
    color = corners[3 * face] * u + corners[3 * face + 1] * v + corners[3 * face + 2] * w
    if surface.first_levels.shape[0] == 0:
        return color
    first = surface.first_levels[face]
    if first < 0:
        return color
    uv = surface.uvs[3 * face] * u + surface.uvs[3 * face + 1] * v + surface.uvs[3 * face + 2] * w
    last = surface.level_counts[face] - 1
    lod = 0.5 * wp.log2(wp.max(surface.densities[face] * area, 1.0))
    low = wp.min(int(lod), last)
    image = bilinear(surface, surface.levels[first + low], uv)
    share = lod - float(low)
    if low < last and share > 0.0:
        image = image * (1.0 - share) + bilinear(surface, surface.levels[first + low + 1], uv) * share
    if surface.cutouts[face] == 0:
        image = wp.vec4(image[0], image[1], image[2], 1.0)
    return times(image, color)


@wp.struct
class Sample:
    """Sums over rays: colour times opacity, opacity, z times opacity, normal times opacity."""

    rgb: wp.vec3
    alpha: float
    depth: float
    normal: wp.vec3


@wp.struct
class View:
    """One camera: inverse_k takes pixels to camera axes at depth 1, to_world those axes to the world's."""

    eye: wp.vec3
    to_world: wp.mat33
    inverse_k: wp.mat33


@wp.func
def put(
    i: int,
    sample: Sample,
    rays: int,
    rgb_out: wp.array[wp.vec3],
    alpha_out: wp.array[float],
    depth_out: wp.array[float],
    normal_out: wp.array[wp.vec3],
    with_normals: bool,
):
    """Write a pixel's means."""
    share = 1.0 / float(rays * rays)
    rgb_out[i] = sample.rgb * share
    alpha_out[i] = sample.alpha * share
    depth_out[i] = 0.0
    if sample.alpha > 0.0:
        depth_out[i] = sample.depth / sample.alpha
    if with_normals:
        normal_out[i] = sample.normal


@wp.func
def view_of(
    camera: int, eyes: wp.array[wp.vec3], rotations: wp.array[wp.mat33], inverse_ks: wp.array[wp.mat33]
) -> View:
    view = View()
    view.eye = eyes[camera]
    view.to_world = wp.transpose(rotations[camera])
    view.inverse_k = inverse_ks[camera]
    return view


@wp.func
def cast(surface: Surface, view: View, x: float, y: float, patch: float, sample: Sample) -> Sample:
    """Add what a ray through pixel coordinates (x, y) sees; `patch` is its area at depth 1."""
    direction = view.to_world * (view.inverse_k * wp.vec3(x, y, 1.0))  # one unit of depth long
    begin = float(0.0)
    left = float(1.0)
    for _layer in range(LAYERS):
        hit = wp.mesh_query_ray(surface.mesh, view.eye + direction * begin, direction, 1.0e10)
        if not hit.result:
            break
        z = begin + hit.t
        color = color_at(surface, hit.face, hit.u, hit.v, patch * z * z)
        weight = left * color[3]
        sample.rgb += wp.vec3(color[0], color[1], color[2]) * weight
        sample.alpha += weight
        sample.depth += weight * z
        if surface.corner_normals.shape[0] > 0:
            n = (
                surface.corner_normals[3 * hit.face] * hit.u
                + surface.corner_normals[3 * hit.face + 1] * hit.v
                + surface.corner_normals[3 * hit.face + 2] * (1.0 - hit.u - hit.v)
            )
            n = wp.normalize(n)
            # The face, not the interpolated normal, says which side is seen.
            if wp.dot(hit.normal, direction) > 0.0:
                n = -n
            sample.normal += n * weight
        if color[3] >= OPAQUE:
            break
        left *= 1.0 - color[3]
        begin = z + LIFT
    return sample


@wp.kernel
def draw_surface(
    start: int,
    # In:
    surface: Surface,
    eyes: wp.array[wp.vec3],
    rotations: wp.array[wp.mat33],
    inverse_ks: wp.array[wp.mat33],
    width: int,
    height: int,
    rays: int,
    # Out:
    rgb_out: wp.array[wp.vec3],
    alpha_out: wp.array[float],
    depth_out: wp.array[float],
    normal_out: wp.array[wp.vec3],
):
    """Mean of rays x rays rays of a pixel: colour times opacity, opacity, mean z of what is seen, normals.

    `rotations` are world to camera. Normals are summed times opacity and look towards the camera; they are
    left out where the surface has none.
    """
    i = start + wp.tid()
    view = view_of(i // (width * height), eyes, rotations, inverse_ks)
    patch = wp.abs(view.inverse_k[0, 0] * view.inverse_k[1, 1]) / float(rays * rays)
    sample = Sample()
    for k in range(rays * rays):
        x = float(i % width) + (float(k % rays) + 0.5) / float(rays)
        y = float((i // width) % height) + (float(k // rays) + 0.5) / float(rays)
        sample = cast(surface, view, x, y, patch, sample)
    put(i, sample, rays, rgb_out, alpha_out, depth_out, normal_out, surface.corner_normals.shape[0] > 0)
