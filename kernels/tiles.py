"""Lists of the Gaussians that touch each 16 x 16 pixel tile, front to back.

The Gaussians come sorted by depth; only tiles remain to be told apart, so entries are never sorted by depth.
On CPUs a counting sort: `count_tiles`, `scan_tiles`, `fill_tiles`, over ranges of Gaussians ("parts") whose
counts are kept apart, so parts run in parallel and the lists do not depend on how many there are. On GPUs
`expand_tiles` writes (tile, Gaussian) pairs in depth order, a stable radix sort by tile groups them, and
`find_tiles` finds where each group begins. Both give the same lists.

Tiles are numbered row by row, camera after camera.
"""

import warp as wp

from gdpro_sim.kernels.projection import vec4s

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native",
    }
)


@wp.func
def area(rect: vec4s) -> int:
    return (int(rect[2]) - int(rect[0])) * (int(rect[3]) - int(rect[1]))


@wp.func
def first_tile(rect: vec4s, camera: int, tiles_x: int, tiles_y: int) -> int:
    return (camera * tiles_y + int(rect[1])) * tiles_x + int(rect[0])


@wp.kernel
def count_tiles(
    start: int,
    # In:
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    parts: int,
    tiles_x: int,
    tiles_y: int,
    # Out:
    counts_out: wp.array2d[int],
):
    """Part p of the Gaussians: how many touch each tile. `counts_out` [parts, tiles] starts at zero."""
    part = start + wp.tid()
    begin = int(wp.int64(order.shape[1] / 2) * wp.int64(part) / wp.int64(parts))
    end = int(wp.int64(order.shape[1] / 2) * wp.int64(part + 1) / wp.int64(parts))
    for camera in range(order.shape[0]):
        for i in range(begin, end):
            g = order[camera, i]
            rect = rects[g]
            tile = first_tile(rect, camera, tiles_x, tiles_y)
            right = tile + int(rect[2]) - int(rect[0])
            for _j in range(area(rect)):
                counts_out[part, tile] = counts_out[part, tile] + 1
                tile += 1
                if tile == right:
                    tile += tiles_x - (int(rect[2]) - int(rect[0]))
                    right += tiles_x


@wp.kernel
def scan_tiles(
    start: int,
    # Out:
    counts_out: wp.array2d[int],
    offsets_out: wp.array[int],
    total_out: wp.array[wp.int64],
):
    """Turn counts into where each (tile, part) begins; `offsets_out` [tiles + 1]. One index does it all."""
    sum = wp.int64(0)
    for tile in range(counts_out.shape[1]):
        offsets_out[tile] = int(sum)
        for part in range(counts_out.shape[0]):
            here = counts_out[part, tile]
            counts_out[part, tile] = int(sum)
            sum += wp.int64(here)
    offsets_out[counts_out.shape[1]] = int(sum)
    total_out[start + wp.tid()] = sum


@wp.kernel
def fill_tiles(
    start: int,
    # In:
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    parts: int,
    tiles_x: int,
    tiles_y: int,
    # Out:
    next_out: wp.array2d[int],
    ids_out: wp.array[int],
):
    """Part p of the Gaussians: write each into the lists of its tiles, from `next_out` [parts, tiles] on."""
    part = start + wp.tid()
    begin = int(wp.int64(order.shape[1] / 2) * wp.int64(part) / wp.int64(parts))
    end = int(wp.int64(order.shape[1] / 2) * wp.int64(part + 1) / wp.int64(parts))
    for camera in range(order.shape[0]):
        for i in range(begin, end):
            g = order[camera, i]
            rect = rects[g]
            tile = first_tile(rect, camera, tiles_x, tiles_y)
            right = tile + int(rect[2]) - int(rect[0])
            for _j in range(area(rect)):
                at = next_out[part, tile]
                ids_out[at] = g
                next_out[part, tile] = at + 1
                tile += 1
                if tile == right:
                    tile += tiles_x - (int(rect[2]) - int(rect[0]))
                    right += tiles_x


@wp.kernel
def count_expansion(
    start: int,
    # In:
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    count: int,
    # Out:
    counts_out: wp.array[int],
):
    """How many tiles the i-th Gaussian in depth order touches."""
    i = start + wp.tid()
    camera = i / count
    counts_out[i] = area(rects[order[camera, i - camera * count]])


@wp.kernel
def expand_tiles(
    start: int,
    # In:
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    count: int,
    begins: wp.array[int],
    tiles_x: int,
    tiles_y: int,
    # Out:
    tiles_out: wp.array[int],
    ids_out: wp.array[int],
):
    """Write (tile, Gaussian) for each tile of the i-th Gaussian in depth order, from `begins[i]` on."""
    i = start + wp.tid()
    camera = i / count
    g = order[camera, i - camera * count]
    rect = rects[g]
    at = begins[i]
    for y in range(int(rect[1]), int(rect[3])):
        row = (camera * tiles_y + y) * tiles_x
        for x in range(int(rect[0]), int(rect[2])):
            tiles_out[at] = row + x
            ids_out[at] = g
            at += 1


@wp.kernel
def find_tiles(
    start: int,
    # In:
    tiles: wp.array[int],
    entries: int,
    # Out:
    offsets_out: wp.array[int],
):
    """Where each tile's group begins in the sorted `tiles`; index runs over entries + 1 boundaries."""
    i = start + wp.tid()
    before = wp.int32(-1)
    if i > 0:
        before = tiles[i - 1]
    here = offsets_out.shape[0] - 1
    if i < entries:
        here = tiles[i]
    for tile in range(before + 1, here + 1):
        offsets_out[tile] = i
