"""Sums over tiles of what each adds to a Gaussian, in parallel and yet always in the same order.

The tiles are cut into slabs, consecutive runs of tiles, one for each thread. A thread goes through its tiles
in order. What it has for a Gaussian that touches tiles of its slab alone it adds to the result at once; what
it has for any other it spills to memory of its own, and `merge_spills` adds the spills slab after slab. So
each Gaussian's sum is taken over its tiles in ascending order, whatever the slabs.
"""

import warp as wp

wp.set_module_options(
    {
        "enable_backward": False,
        "max_unroll": 0,
        "default_grid_stride": False,
        "cpu_compiler_flags": "-march=native",
    }
)

IN_SLAB = """
    auto in_slab = [&](int g) {
        const short* const r = (const short*)(rects.data + g);
        const int first_tile = (camera * tiles_y + r[1]) * tiles_x + r[0];
        const int last_tile = (camera * tiles_y + r[3] - 1) * tiles_x + r[2] - 1;
        return first_tile >= slab_begin && last_tile < slab_end;
    };
"""
"""Snippet: whether a Gaussian touches tiles of the slab alone."""


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
