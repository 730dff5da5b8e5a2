"""Images of 3D Gaussians: project, bin into tiles, composite."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch

from gdpro_sim.device import beside_torch
from gdpro_sim.splatting.batches import batched
from gdpro_sim.splatting.checks import (
    INDEX_LIMIT,
    check_choice,
    check_colors,
    check_count,
    check_gsplat_arguments,
    check_number,
    check_size,
    check_tensor,
)
from gdpro_sim.splatting.compositing import Blending, blend, composite, weigh
from gdpro_sim.splatting.normals import shortest_axes
from gdpro_sim.splatting.projection import Projection, View, project
from gdpro_sim.splatting.tiles import TileLists, count_and_fill, empty_lists, expand_and_sort

RENDER_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")
RASTERIZE_MODES = ("classic", "antialiased")
METHODS = ("auto", "tile", "pixel")


@dataclass(frozen=True)
class RasterOptions:
    """Rarely needed settings of `rasterization`.

    method:           "tile" (CPU only: vectorised over a tile), "pixel" (one index per pixel, what a GPU
                      runs; on a CPU slow, for comparison) or "auto", the one made for the device
    max_tile_entries: most (tile, Gaussian) pairs to make; more raise RequestError before memory is taken
                      (4 bytes each on a CPU, 16 on a GPU)
    normals:          also blend normals, into `meta["normals"]`
    """

    method: str = "auto"
    max_tile_entries: int = INDEX_LIMIT
    normals: bool = False

    def __post_init__(self) -> None:
        check_choice("RasterOptions.method", self.method, METHODS)
        entries = self.max_tile_entries
        if isinstance(entries, bool) or not isinstance(entries, int) or not 0 <= entries <= INDEX_LIMIT:
            raise ValueError(
                "RasterOptions.max_tile_entries must be a whole number "
                f"from 0 to {INDEX_LIMIT}, got {entries!r}"
            )


@batched
def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    options: RasterOptions | None = None,
    **gsplat: Any,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Render N 3D Gaussians into C cameras, with gsplat's names and conventions.

    All tensors are float32 on one device, CPU or CUDA, which decides where the work is done; memory is shared
    with Warp, not copied. On a CPU images and gradients are the same to the bit for any number of threads.
    Gradients flow to means, quats, scales, opacities, colors, backgrounds, viewmats (upper three rows), Ks;
    there is none where alpha is limited to 0.99, a colour to 0, or a Gaussian is not drawn.

    means      [N, 3] metres
    quats      [N, 4] wxyz, any length but zero
    scales     [N, 3] metres, standard deviations along the rotated axes
    opacities  [N] in [0, 1]
    colors     [N, K, 3] spherical-harmonics coefficients, K >= (sh_degree + 1)^2, where `sh_degree` (0-3) is
               given: colour = max(0, SH(direction) + 0.5). Else [N, D] or [C, N, D] features of any D >= 1,
               blended as they are. Not used in modes "D" and "ED"
    viewmats   [C, 4, 4] rigid, world to camera, OpenCV axes (+z forward, +y down)
    Ks         [C, 3, 3] pixels; pixel centres lie at +0.5
    width, height  image size in pixels
    near_plane, far_plane  metres along z; Gaussians whose centre lies outside are not drawn
    radius_clip  pixels; Gaussians whose box has both half extents at most this are not drawn
    eps2d      pixels^2 added to the diagonal of 2D covariances
    backgrounds  [C, D] colour behind everything; never added to depth
    render_mode  "RGB" (colours or features), "D" (sum of weight times depth), "ED" (that over alpha: expected
               depth), "RGB+D", "RGB+ED" (depth as last channel). Depth is z of centres, in metres
    absgrad    gsplat's: backward leaves the sum over pixels of absolute gradients at means2d, in pixels, in
               `meta["means2d"].absgrad` [C, N, 2] (with more than 4 channels, of sums over 4 at a time)
    rasterize_mode  "classic", or "antialiased": opacity times sqrt(det covariance / det blurred covariance)
    gsplat     gsplat's other arguments, with the values that mean what is done here: packed=False,
               tile_size=16, sparse_grad=False, distributed=False, camera_model="pinhole", any channel_chunk

    Returns colours [C, H, W, D], alphas [C, H, W, 1] and a dict with
        width, height, tile_size, tile_width, tile_height, n_cameras  numbers
        means2d [C, N, 2], depths [C, N], opacities [C, N], radii [C, N, 2] (pixels; zero where not drawn)
        camera_ids, gaussian_ids  None, as in gsplat where nothing is packed
        isect_offsets [C, tile_height, tile_width], flatten_ids [E]  tile lists: Gaussian c N + n, by depth
        transmittance [C, H, W]                                      what reaches the background
        normals [C, H, W, 3], with RasterOptions(normals=True)       sum of weight times shortest axis, in
                                                                     world space, towards the camera
        projection, tile_lists, composite, weigh                     the stages' own results
    means2d, depths, opacities and normals carry gradients; `means2d.retain_grad()` works as with gsplat.

    All tensors may have the same leading axes: scenes, drawn one after the other. Images have them too, and
    `meta["batches"]` lists each scene's own `meta`.

    A Gaussian is not drawn where its parameters or colour hold NaN or infinity, or its quaternion is zero.
    Raises ValueError where an argument is malformed, and RequestError where counts do not fit 32-bit indices.

    Source: Kerbl et al., "3D Gaussian Splatting for Real-Time Radiance Field Rendering" (2023); projection
    from Zwicker et al., "EWA Splatting" (2002); antialiasing from Yu et al., "Mip-Splatting" (2024), eq. 9.
    """
    options = RasterOptions() if options is None else options
    check_gsplat_arguments("rasterization", gsplat)
    means = check_tensor("means", means, ("N", 3))
    count = len(means)
    quats = check_tensor("quats", quats, (count, 4), means)
    scales = check_tensor("scales", scales, (count, 3), means)
    opacities = check_tensor("opacities", opacities, (count,), means)
    viewmats = check_tensor("viewmats", viewmats, ("C", 4, 4), means)
    cameras = len(viewmats)
    view = View(
        viewmats,
        check_tensor("Ks", Ks, (cameras, 3, 3), means),
        check_size("width", width),
        check_size("height", height),
        check_number("near_plane", near_plane, 0.0),
        check_number("far_plane", far_plane, 0.0),
        check_number("radius_clip", radius_clip, 0.0),
        check_number("eps2d", eps2d, 0.0),
        check_choice("rasterize_mode", rasterize_mode, RASTERIZE_MODES) == "antialiased",
    )
    check_choice("render_mode", render_mode, RENDER_MODES)
    with_colors = render_mode.startswith("RGB")
    with_depth = render_mode != "RGB"
    colors = check_colors(colors, sh_degree, cameras, count, means)
    features = 0 if not with_colors else 3 if sh_degree is not None else colors.shape[-1]
    channels = features + with_depth
    background = means.new_zeros((cameras, channels))
    if backgrounds is not None:
        width_ = features or (3 if sh_degree is not None else colors.shape[-1])
        backgrounds = check_tensor("backgrounds", backgrounds, (cameras, width_), means)
        background = torch.cat([backgrounds[:, :features], background[:, features:]], dim=1)
    divided = channels - 1 if render_mode.endswith("ED") else -1

    columns, rows = view.tiles
    check_count("Gaussians", count, INDEX_LIMIT // 2)
    check_count("Gaussians times cameras", cameras * count)
    check_count("image values (cameras x height x width x channels)", cameras * height * width * channels)
    check_count("image columns or rows", max(width, height), 16 * 32767)
    check_count("pixels of all tiles", cameras * rows * columns * 256)

    tile = options.method == "tile" or (options.method == "auto" and means.device.type == "cpu")
    if tile and means.device.type != "cpu":
        raise ValueError(
            f'RasterOptions.method "tile" runs on the CPU only; the tensors are on {means.device}'
        )

    drawn, degree = (colors, sh_degree) if with_colors else (means.new_empty((count, 0)), None)
    flat = drawn if degree is not None else drawn.flatten(0, -2)
    gaussians = (means, quats, scales, opacities)
    with beside_torch(means):
        projection, lists = _project_and_bin(
            gaussians, flat, degree, view, options.max_tile_entries, tile=tile
        )
        result = composite(projection, lists, flat, background, divided, view, tile=tile, absgrad=absgrad)
        meta: dict[str, Any] = {
            "width": width,
            "height": height,
            "tile_size": 16,
            "tile_width": columns,
            "tile_height": rows,
            "n_cameras": cameras,
            "means2d": projection.means2d,
            "depths": projection.depths,
            "opacities": projection.opacities,
            "radii": projection.radii.view(cameras, count, 2),
            "camera_ids": None,
            "gaussian_ids": None,
            "isect_offsets": lists.offsets[:-1].view(cameras, rows, columns),
            "flatten_ids": lists.ids,
            "transmittance": result.transmittance,
            "projection": projection,
            "tile_lists": lists,
            "composite": result,
            "weigh": partial(weigh, projection, lists, result, view, tile),
        }
        if options.normals:
            axes = torch.nn.functional.pad(shortest_axes(means, quats, scales, viewmats), (0, 1)).flatten(
                0, 1
            )
            nothing, blending = means.new_zeros((cameras, 3)), Blending(view, 3, -1, tile, absgrad)
            meta["normals"] = blend(projection, lists, axes, nothing, blending).image
        return result.image, result.alphas, meta


def _project_and_bin(
    gaussians: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    colors: torch.Tensor,
    degree: int | None,
    view: View,
    limit: int,
    *,
    tile: bool,
) -> tuple[Projection, TileLists]:
    """The first two stages over checked arguments; `colors` [N, K, 3], or [N or C N, F] with F >= 0."""
    projection = project(gaussians, colors, degree, view)
    if len(projection.records) == 0:
        return projection, empty_lists(projection.cameras, view, projection.records.device)
    lists = (count_and_fill if tile else expand_and_sort)(projection, view, limit)
    return replace(projection, order=None), lists


__all__ = ["RasterOptions", "rasterization"]
