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


_EACH = """
    const int cameras = order.shape[0], count = rects.shape[0] / cameras;
    const int begin = (int)((long long)count * part / parts),
        end = (int)((long long)count * (part + 1) / parts);
    int* const counts = counts_out.data + (size_t)part * counts_out.shape[1];
    const short* const rect = (const short*)rects.data;
    for (int camera = 0; camera < cameras; ++camera) {
        const int* const sorted = order.data + (size_t)camera * order.shape[1];
        for (int i = begin; i < end; ++i) {
#if !defined(__CUDACC__)
            if (i + 16 < end) __builtin_prefetch(rect + 4 * (size_t)sorted[i + 16]);
#endif
            const int g = sorted[i];
            const short* const r = rect + 4 * (size_t)g;
            const int x_begin = r[0], y_begin = r[1], x_end = r[2], y_end = r[3];
            for (int y = y_begin; y < y_end; ++y) {
                const int row = (camera * tiles_y + y) * tiles_x;
                for (int x = x_begin; x < x_end; ++x) {
                    {here}
                }
            }
        }
    }
"""


@wp.func_native(_EACH.replace("{here}", "++counts[row + x];"))
def count_part(
    part: int,
    parts: int,
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    tiles_x: int,
    tiles_y: int,
    counts_out: wp.array2d[int],
): ...


@wp.func_native(_EACH.replace("{here}", "ids_out.data[counts[row + x]++] = g;"))
def fill_part(
    part: int,
    parts: int,
    order: wp.array2d[int],
    rects: wp.array[vec4s],
    tiles_x: int,
    tiles_y: int,
    counts_out: wp.array2d[int],
    ids_out: wp.array[int],
): ...


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
    count_part(start + wp.tid(), parts, order, rects, tiles_x, tiles_y, counts_out)


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
    fill_part(start + wp.tid(), parts, order, rects, tiles_x, tiles_y, next_out, ids_out)


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
