"""Sums over tiles of what each adds to a Gaussian, in parallel and yet always in the same order.

The tiles are cut into slabs, consecutive runs of tiles, one for each thread. A thread goes through its tiles
in order. What it has for a Gaussian that touches tiles of its slab alone it adds to the result at once; what
it has for any other it spills to memory of its own, and `merge_spills` adds the spills slab after slab. So
each Gaussian's sum is taken over its tiles in ascending order, whatever the slabs.
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

IN_SLAB = """
    auto in_slab = [&](int g) {
        const short* const r = (const short*)(rects.data + g);
        const int first_tile = (camera * tiles_y + r[1]) * tiles_x + r[0];
        const int last_tile = (camera * tiles_y + r[3] - 1) * tiles_x + r[2] - 1;
        return first_tile >= slab_begin && last_tile < slab_end;
    };
"""
"""Snippet: whether a Gaussian touches tiles of the slab alone."""


@wp.func_native(f"""
{IN_SLAB}
    int spills = 0;
    for (int at = begin; at < end; ++at) spills += in_slab(ids.data[at]) ? 0 : 1;
    return spills;
""")
def spills_of(
    begin: int,
    end: int,
    ids: wp.array[int],
    rects: wp.array[vec4s],
    camera: int,
    tiles_x: int,
    tiles_y: int,
    slab_begin: int,
    slab_end: int,
) -> int: ...


@wp.kernel
def count_spills(
    start: int,
    # In:
    offsets: wp.array[int],
    stops: wp.array[int],
    ids: wp.array[int],
    rects: wp.array[vec4s],
    tiles_x: int,
    tiles_y: int,
    slab_begin: int,
    slab_end: int,
    # Out:
    counts_out: wp.array[int],
):
    """How many entries before its stop each tile of the slab may spill."""
    tile = start + wp.tid()
    camera = tile / (tiles_x * tiles_y)
    counts_out[tile] = spills_of(
        offsets[tile], stops[tile], ids, rects, camera, tiles_x, tiles_y, slab_begin, slab_end
    )


@wp.func_native("""
    for (int i = 0; i < spill_ids.shape[0]; ++i) {
        const int g = spill_ids.data[i];
        if (g < 0 || g % parts != part) continue;
        float* const sum = sums_out.data + (size_t)g * width;
        const float* const spill = spills.data + (size_t)i * width;
        for (int j = 0; j < width; ++j) sum[j] += spill[j];
    }
""")
def merge_part(
    part: int,
    parts: int,
    width: int,
    spill_ids: wp.array[int],
    spills: wp.array2d[float],
    sums_out: wp.array2d[float],
): ...


@wp.kernel
def merge_spills(
    start: int,
    # In:
    parts: int,
    spill_ids: wp.array[int],
    spills: wp.array2d[float],
    # Out:
    sums_out: wp.array2d[float],
):
    """Add the spills, in order, of the Gaussians whose number is `part` modulo `parts`."""
    merge_part(start + wp.tid(), parts, spills.shape[1], spill_ids, spills, sums_out)
