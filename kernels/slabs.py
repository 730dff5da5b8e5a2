"""Sums over tiles of what each adds to a Gaussian, in parallel and yet always in the same order.

The tiles are cut into slabs, consecutive runs of tiles, one for each thread. A thread goes through its tiles
in order. What it has for a Gaussian that touches tiles of its slab alone it adds to the result at once; what
it has for any other it spills to memory of its own, and `merge_spills` adds the spills slab after slab. So
each Gaussian's sum is taken over its tiles in ascending order, whatever the slabs.
"""

import warp as wp

from gdpro_sim.kernels.projection import TILE

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native",
    }
)

SLAB_ROWS = f"""
    // Gaussians within these rows of pixels touch tiles of the slab alone; a pixel to spare for rounding.
    const int slab_row = (slab_begin + tiles_x - 1) / tiles_x - camera * tiles_y;
    const int slab_row_end = slab_end / tiles_x - camera * tiles_y;
    const float slab_top = slab_row <= 0 ? -1.0e30f : (float)({TILE} * slab_row + 1);
    const float slab_bottom = slab_row_end >= tiles_y ? 1.0e30f : (float)({TILE} * slab_row_end - 1);
"""
"""Snippet, after LOCATE_TILE of `gdpro_sim.kernels.compositing`: slab_begin, slab_end -> top and bottom."""


@wp.func_native("""
    const int gaussians = sums_out.shape[0];
    const int begin = (int)((long long)gaussians * part / parts),
        end = (int)((long long)gaussians * (part + 1) / parts);
    for (int tile = 0; tile + 1 < offsets.shape[0]; ++tile) {
        for (int i = offsets.data[tile]; i < offsets.data[tile + 1]; ++i) {
            const int g = spill_ids.data[i];
            if (g < 0) break;
            if (g < begin || g >= end) continue;
            float* const sum = sums_out.data + (size_t)g * width;
            const float* const spill = spills.data + (size_t)i * width;
            for (int j = 0; j < width; j += 8) {
                for (int k = j; k < j + 8; ++k) sum[k] += spill[k];
            }
        }
    }
""")
def merge_part(
    part: int,
    parts: int,
    width: int,
    offsets: wp.array[int],
    spill_ids: wp.array[int],
    spills: wp.array2d[float],
    sums_out: wp.array2d[float],
): ...


@wp.kernel
def merge_spills(
    start: int,
    # In:
    parts: int,
    offsets: wp.array[int],
    spill_ids: wp.array[int],
    spills: wp.array2d[float],
    # Out:
    sums_out: wp.array2d[float],
):
    """Add the spills, in order, of one of `parts` ranges of Gaussians; rows hold 8, 16, 24 .. numbers.

    Those of tile t lie from offsets[t] on, with their Gaussians in `spill_ids`, and end before the first -1.
    """
    merge_part(start + wp.tid(), parts, spills.shape[1], offsets, spill_ids, spills, sums_out)


CLEARED = 1 << 14
"""Numbers that one index of `clear` sets to zero."""


@wp.func_native(f"""
    const size_t begin = (size_t)index * {CLEARED}, size = (size_t)sums_out.shape[0] * sums_out.shape[1];
    const size_t end = begin + {CLEARED} < size ? begin + {CLEARED} : size;
    for (size_t i = begin; i < end; ++i) sums_out.data[i] = 0.0f;
""")
def clear_run(index: int, sums_out: wp.array2d[float]): ...


@wp.kernel
def clear(start: int, sums_out: wp.array2d[float]):
    """Set sums to zero, `CLEARED` for each index."""
    clear_run(start + wp.tid(), sums_out)


@wp.kernel
def balance(
    start: int,
    # In:
    begins: wp.array[int],
    ends: wp.array[int],
    tile_work: int,
    # Out:
    bounds_out: wp.array[int],
):
    """Bounds of runs of tiles with about equal work: entries begins[t] .. ends[t] - 1, and `tile_work`.

    One index does it all.
    """
    tiles, runs = ends.shape[0], bounds_out.shape[0] - 1
    total = wp.int64(0)
    for tile in range(tiles):
        total += wp.int64(ends[tile] - begins[tile] + tile_work)
    run = int(0)
    done = wp.int64(0)
    for tile in range(tiles):
        while run < runs and done * wp.int64(runs) >= total * wp.int64(run):
            bounds_out[run] = tile
            run += 1
        done += wp.int64(ends[tile] - begins[tile] + tile_work)
    for later in range(run, runs + 1):
        bounds_out[start + wp.tid() + later] = tiles
