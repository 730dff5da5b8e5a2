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
"""Snippet, after LOCATE_TILE of `gdpro_sim.kernels.compositing`: slab_begin, slab_end -> slab_top, slab_bottom.
"""


@wp.func_native("""
    for (int tile = 0; tile + 1 < offsets.shape[0]; ++tile) {
        for (int i = offsets.data[tile]; i < offsets.data[tile + 1]; ++i) {
            const int g = spill_ids.data[i];
            if (g < 0) break;
            if (g % parts != part) continue;
            float* const sum = sums_out.data + (size_t)g * width;
            const float* const spill = spills.data + (size_t)i * width;
            for (int j = 0; j < width; ++j) sum[j] += spill[j];
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
    """Add the spills, in order, of the Gaussians whose number is `part` modulo `parts`.

    Those of tile t lie from offsets[t] on, with their Gaussians in `spill_ids`, and end before the first -1.
    """
    merge_part(start + wp.tid(), parts, spills.shape[1], offsets, spill_ids, spills, sums_out)
