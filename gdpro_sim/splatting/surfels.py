"""Images of surfels (flat Gaussians on discs): project, bin into tiles, composite."""

from __future__ import annotations

from dataclasses import replace
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
from gdpro_sim.splatting.depth import depth_to_normals
from gdpro_sim.splatting.projection import View
from gdpro_sim.splatting.rasterization import RENDER_MODES, RasterOptions
from gdpro_sim.splatting.surfel_compositing import SurfelBlending, composite_surfels, weigh_surfels
from gdpro_sim.splatting.surfel_projection import SurfelProjection, project_surfels
from gdpro_sim.splatting.tiles import TileLists, count_and_fill, empty_lists, expand_and_sort

DEPTH_MODES = ("expected", "median")


@batched
def rasterization_2dgs(
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
    distloss: bool = False,
    depth_mode: str = "expected",
    options: RasterOptions | None = None,
    **gsplat: Any,
) -> tuple[
    torch.Tensor,
    torch.Tensor,
    torch.Tensor,
    torch.Tensor | None,
    torch.Tensor,
    torch.Tensor,
    dict[str, Any],
]:
    """Render N surfels into C cameras, with gsplat's names and conventions.

    Arguments are those of `gdpro_sim.splatting.rasterization`, and so are devices, gradients and their
    reproducibility, and what is not drawn. Different are

    scales      [N, 3] or [N, 2] metres, standard deviations along the first two rotated axes; the third is
                not used. The third axis is the normal
    eps2d       not used, nor is it by gsplat: surfels have a low-pass of their own
    distloss    gsplat's: asks for a mode with depth. The distortion is returned, with gradients, all the same
    depth_mode  "expected" or "median": the depth that normals are taken from

    Returns
        colours [C, H, W, D]             as `rasterization`
        alphas [C, H, W, 1]
        normals [C, H, W, 3]             sum of weight times world-space normal, turned towards the camera
        normals_from_depth [C, H, W, 3]  in modes "RGB+D" and "RGB+ED", else None: world-space normals of the
                                         expected or median depth image, times alpha without its gradient
        distortion [C, H, W, 1]          sum over pairs of surfels j before i of 2 w_i w_j (z_i - z_j)
        median depths [C, H, W, 1]       z of the last surfel before which more than half passes; 0 for none
        meta                             as `rasterization`, and normals [C, N, 3] of the surfels

    The depth z of a surfel is that of the point where the pixel's ray meets its plane (gsplat blends the z of
    its centre). A surfel is drawn as the larger of its disc, exp(-(u^2 + v^2) / 2) at the hit, and a low-pass
    of the screen, exp(-d^2) at d pixels from `meta["means2d"]`, the middle of the ellipse that its one-sigma
    circle projects to (the projected centre, where that circle reaches behind the camera). Where the low-pass
    is larger, z is the centre's. `means2d.grad` and `means2d.absgrad` are the gradients of shifting a
    surfel's whole picture by pixels; the same tensor is in `meta["gradient_2dgs"]`, as with gsplat.

    Raises ValueError where an argument is malformed, and RequestError where counts do not fit 32-bit indices.

    Source: Huang et al., "2D Gaussian Splatting for Geometrically Accurate Radiance Fields" (2024), eq. 4-19.
    """
    options = RasterOptions() if options is None else options
    check_gsplat_arguments("rasterization_2dgs", gsplat)
    means = check_tensor("means", means, ("N", 3))
    count = len(means)
    quats = check_tensor("quats", quats, (count, 4), means)
    two = isinstance(scales, torch.Tensor) and scales.ndim == 2 and scales.shape[1] == 2
    scales = check_tensor("scales", scales, (count, 2 if two else 3), means)
    opacities = check_tensor("opacities", opacities, (count,), means)
    viewmats = check_tensor("viewmats", viewmats, ("C", 4, 4), means)
    cameras = len(viewmats)
    check_number("eps2d", eps2d, 0.0)
    view = View(
        viewmats,
        check_tensor("Ks", Ks, (cameras, 3, 3), means),
        check_size("width", width),
        check_size("height", height),
        check_number("near_plane", near_plane, 0.0),
        check_number("far_plane", far_plane, 0.0),
        check_number("radius_clip", radius_clip, 0.0),
        0.0,
        False,
    )
    check_choice("render_mode", render_mode, RENDER_MODES)
    check_choice("depth_mode", depth_mode, DEPTH_MODES)
    if distloss and render_mode == "RGB":
        raise ValueError("distloss=True needs a render_mode with depth (D, ED, RGB+D or RGB+ED), got 'RGB'")
    with_colors = render_mode.startswith("RGB")
    with_depth = render_mode != "RGB"
    divided = render_mode.endswith("ED")
    colors = check_colors(colors, sh_degree, cameras, count, means)
    given = 3 if sh_degree is not None else colors.shape[-1]
    features = given if with_colors else 0
    background = means.new_zeros((cameras, features))
    if backgrounds is not None:
        background = check_tensor("backgrounds", backgrounds, (cameras, given), means)[:, :features]

    columns, rows = view.tiles
    channels = features + with_depth
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
    with beside_torch(means):
        projection, lists = _project_and_bin(
            (means, quats, scales, opacities), flat, degree, view, options.max_tile_entries, tile=tile
        )
        result = composite_surfels(
            projection,
            lists,
            flat,
            background,
            view,
            depth=with_depth,
            divided=divided,
            tile=tile,
            absgrad=absgrad,
        )
    normals_from_depth = None
    if with_colors and with_depth:
        depth = result.medians
        if depth_mode == "expected":
            depth = result.image[..., -1:]
            if not divided:
                depth = depth / result.alphas.clamp(min=1e-10)
        normals_from_depth = depth_to_normals(depth, viewmats, view.Ks, result.alphas)

    blending = SurfelBlending(view, 3, False, False, False, tile, False)

    def weigh(values: torch.Tensor) -> torch.Tensor:
        return weigh_surfels(projection, lists, result, blending, values)

    meta = {
        "width": width,
        "height": height,
        "tile_size": 16,
        "tile_width": columns,
        "tile_height": rows,
        "n_cameras": cameras,
        "means2d": projection.means2d,
        "gradient_2dgs": projection.means2d,
        "depths": projection.depths,
        "normals": projection.normals,
        "opacities": opacities.expand(cameras, count),
        "radii": projection.radii.view(cameras, count, 2),
        "camera_ids": None,
        "gaussian_ids": None,
        "isect_offsets": lists.offsets[:-1].view(cameras, rows, columns),
        "flatten_ids": lists.ids,
        "transmittance": result.transmittance,
        "projection": projection,
        "tile_lists": lists,
        "composite": result,
        "weigh": weigh,
    }
    return (
        result.image,
        result.alphas,
        result.normals,
        normals_from_depth,
        result.distortion,
        result.medians,
        meta,
    )


def _project_and_bin(
    surfels: tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor],
    colors: torch.Tensor,
    degree: int | None,
    view: View,
    limit: int,
    *,
    tile: bool,
) -> tuple[SurfelProjection, TileLists]:
    """The first two stages over checked arguments; `colors` [N, K, 3], or [N or C N, F] with F >= 0."""
    projection = project_surfels(surfels, colors, degree, view)
    if len(projection.records) == 0:
        return projection, empty_lists(projection.cameras, view, projection.records.device)
    lists = (count_and_fill if tile else expand_and_sort)(projection, view, limit)
    return replace(projection, order=None), lists


__all__ = ["DEPTH_MODES", "rasterization_2dgs"]
