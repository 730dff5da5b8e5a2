"""The scene splatting is timed on, and how many (pixel, Gaussian) pairs its image blends."""

from __future__ import annotations

import math
from typing import Any

import torch
import warp as wp

from gdpro_sim.cameras import Cameras
from gdpro_sim.device import device_name, launch_chunked
from gdpro_sim.gaussians import rgb_to_sh
from gdpro_sim.kernels.compositing import ALPHA_MAX, LN2, TRANSMITTANCE_MIN
from gdpro_sim.kernels.projection import FACTOR, LOG2_CUTOFF, LOG2_OPACITY, MEAN, TILE
from gdpro_sim.splatting.arrays import array

wp.set_module_options({"enable_backward": False, "max_unroll": 0})


def bumpy_sphere(count: int, degree: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Gaussians on a sphere of radius about 1 m, coloured by direction."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    x, y, z = normal.unbind(1)
    radius = 1.0 + 0.08 * torch.sin(5 * x) * torch.sin(6 * y) * torch.sin(4 * z + 1)
    scale = math.sqrt(4 * math.pi / count) * torch.exp(0.3 * torch.randn(count, 2, generator=g))
    sh = 0.1 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    sh[:, 0] = rgb_to_sh(0.5 + 0.5 * normal)
    return {
        "means": normal * radius[:, None],
        # The rotation that turns +z into the normal, not normalised.
        "quats": torch.stack([1 + z, -y, x, torch.zeros_like(x)], 1),
        "scales": torch.cat([scale, 0.3 * scale[:, :1]], 1),
        "opacities": torch.sigmoid(0.8 + 1.5 * torch.randn(count, generator=g)),
        "colors": sh,
    }


def front_camera(size: int) -> Cameras:
    """A camera 3.2 m away whose frame the sphere fills."""
    return Cameras.look_at(
        [[0.0, -3.2, 0.6]], [0.0, 0.0, 0.0], vertical_fov=2 * math.asin(1.05 / 3.25), width=size, height=size
    )


@wp.func
def log2_alpha(records: wp.array2d[float], i: int, px: float, py: float) -> float:
    """Base-2 logarithm of a Gaussian's alpha at a pixel position, before the 0.99 limit."""
    dx = px - records[i, MEAN]
    dy = py - records[i, MEAN + 1]
    u = records[i, FACTOR] * dx + records[i, FACTOR + 1] * dy
    v = records[i, FACTOR + 2] * dy
    return records[i, LOG2_OPACITY] - u * u - v * v


@wp.kernel
def count_pairs(
    start: int,
    # In:
    records: wp.array2d[float],
    offsets: wp.array[int],
    ids: wp.array[int],
    width: int,
    height: int,
    # Out:
    counts_out: wp.array[int],
):
    """How many Gaussians a pixel blends: `gdpro_sim.kernels.compositing` without the blending."""
    i = start + wp.tid()
    tile = i / (TILE * TILE)
    in_tile = i - tile * (TILE * TILE)
    tiles_x = (width + TILE - 1) / TILE
    x = tile % tiles_x * TILE + in_tile % TILE
    y = tile / tiles_x * TILE + in_tile / TILE
    count = wp.int32(0)
    transmittance = wp.float32(1.0)
    if x < width and y < height:
        for at in range(offsets[tile], offsets[tile + 1]):
            power = log2_alpha(records, ids[at], float(x) + 0.5, float(y) + 0.5)
            if power >= LOG2_CUTOFF:
                transmittance *= 1.0 - wp.min(wp.exp(LN2 * power), ALPHA_MAX)
                if transmittance <= TRANSMITTANCE_MIN:
                    break
                count += 1
    counts_out[i] = count


def blended_pairs(meta: dict[str, Any]) -> int:
    """Pairs of a pixel and a Gaussian with a weight above zero in the image of one camera.

    meta: what `rasterization` returned; counted in float32, once, pixel by pixel.
    """
    lists, records = meta["tile_lists"], meta["projection"].records
    pixels = (len(lists.offsets) - 1) * int(TILE) ** 2
    counts = torch.empty(pixels, dtype=torch.int32, device=records.device)
    inputs = [
        array(records, wp.float32),
        array(lists.offsets, wp.int32),
        array(lists.ids, wp.int32),
        meta["width"],
        meta["height"],
    ]
    launch_chunked(count_pairs, pixels, inputs, [array(counts, wp.int32)], device=device_name(records))
    return int(counts.sum())


__all__ = ["blended_pairs", "bumpy_sphere", "front_camera"]
