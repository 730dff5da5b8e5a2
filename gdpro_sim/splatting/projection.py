"""First stage: Gaussians in space -> records of coloured 2D Gaussians, one for each camera and Gaussian."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
import warp as wp

from gdpro_sim.device import device_name, launch_chunked
from gdpro_sim.kernels import projection as kernels
from gdpro_sim.kernels.projection import vec4s


@dataclass(frozen=True)
class View:
    """C cameras and the image they make, checked. near, far in metres; the rest in pixels."""

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int
    near: float
    far: float
    radius_clip: float
    eps2d: float
    antialiased: bool

    @property
    def tiles(self) -> tuple[int, int]:
        """Columns and rows of tiles."""
        tile = int(kernels.TILE)
        return -(-self.width // tile), -(-self.height // tile)


@dataclass(frozen=True)
class Projection:
    """C x N projected Gaussians; M = C N, record c N + n is Gaussian n seen by camera c.

    records: [M, 16] float32, see `gdpro_sim.kernels.projection`; zeros where culled
    radii:   [M, 2] int32, half extents in pixels of the box outside which alpha < 1/255; zeros where culled
    rects:   [M, 4] int16, tiles touched: x begin, y begin, x end, y end (exclusive); zeros where culled
    order:   [C, 2 N] int32, of which order[:, :N] are record numbers in ascending depth, culled ones last
    """

    records: torch.Tensor
    radii: torch.Tensor
    rects: torch.Tensor
    order: torch.Tensor
    cameras: int
    gaussians: int

    def _field(self, first: int, width: int) -> torch.Tensor:
        return self.records.view(self.cameras, self.gaussians, kernels.RECORD)[..., first : first + width]

    @property
    def means2d(self) -> torch.Tensor:
        """[C, N, 2] pixels, a view of the records."""
        return self._field(kernels.MEAN, 2)

    @property
    def depths(self) -> torch.Tensor:
        """[C, N] camera-space z in metres, a view of the records."""
        return self._field(kernels.DEPTH, 1)[..., 0]

    @property
    def opacities(self) -> torch.Tensor:
        """[C, N] opacities, times the compensation factor where antialiased; a view of the records."""
        return self._field(kernels.OPACITY, 1)[..., 0]

    @property
    def conics(self) -> torch.Tensor:
        """[C, N, 3] upper triangle of the inverse 2D covariance, 1/pixel^2; computed on each access."""
        a, b, d = self._field(kernels.FACTOR, 3).unbind(-1)
        return torch.stack([a * a, a * b, b * b + d * d], dim=-1) / kernels.HALF_LOG2_E


def array(tensor: torch.Tensor, dtype: type) -> Any:
    """The tensor's memory as a kernel argument; trailing axes become a vector or matrix where `dtype` is one.

    It keeps the tensor alive.
    """
    return wp.from_torch(tensor, dtype=dtype, requires_grad=False, return_ctype=True)


def sort_pairs(keys: torch.Tensor, values: torch.Tensor, count: int, bits: int = 32) -> None:
    """Sort `values` [2 count] with their `keys` [2 count] by the keys' lowest `bits`; stable, in place."""
    keys_array: Any = wp.from_torch(keys)
    values_array: Any = wp.from_torch(values)
    wp.utils.radix_sort_pairs(keys_array, values_array, count, end_bit=bits)


def project(
    means: torch.Tensor, quats: torch.Tensor, scales: torch.Tensor, opacities: torch.Tensor, view: View
) -> Projection:
    """Project N >= 1 Gaussians into C >= 1 cameras and sort each camera's by depth; leaves out channels."""
    cameras, count = len(view.viewmats), len(means)
    total = cameras * count
    device = device_name(means)
    records = means.new_empty((total, int(kernels.RECORD)))
    radii = means.new_empty((total, 2), dtype=torch.int32)
    rects = means.new_empty((total, 4), dtype=torch.int16)
    keys = means.new_empty((cameras, 2 * count))
    order = means.new_empty((cameras, 2 * count), dtype=torch.int32)
    launch_chunked(
        kernels.project,
        total,
        [
            array(means, wp.vec3),
            array(quats, wp.vec4),
            array(scales, wp.vec3),
            array(opacities, wp.float32),
            array(view.viewmats, wp.mat44),
            array(view.Ks, wp.mat33),
            view.width,
            view.height,
            view.near,
            view.far,
            view.radius_clip,
            view.eps2d,
            view.antialiased,
        ],
        [
            array(records, wp.float32),
            array(radii, wp.vec2i),
            array(rects, vec4s),
            array(keys, wp.float32),
            array(order, wp.int32),
        ],
        device=device,
    )
    for camera in range(cameras):
        sort_pairs(keys[camera], order[camera], count)
    return Projection(records, radii, rects, order, cameras, count)


def shade_harmonics(
    projection: Projection, means: torch.Tensor, sh: torch.Tensor, degree: int, view: View
) -> None:
    """Set channels 0-2 from spherical harmonics [N, K, 3] and channel 3 to depth; cull where not finite."""
    launch_chunked(
        kernels.shade_harmonics,
        len(projection.records),
        [array(means, wp.vec3), array(sh, wp.vec3), degree, array(view.viewmats, wp.mat44)],
        _culled(projection),
        device=device_name(means),
    )


def shade_features(projection: Projection, features: torch.Tensor) -> None:
    """Set the first four of (features [N or C N, D], depth) as channels; cull what is not finite."""
    launch_chunked(
        kernels.shade_features,
        len(projection.records),
        [array(features, wp.float32)],
        _culled(projection),
        device=device_name(features),
    )


def pack_channels(projection: Projection, features: torch.Tensor, first: int) -> torch.Tensor:
    """Entries first .. first + 3 of (features [N or C N, D], depth), zero past the end: [M, 4]."""
    channels = features.new_empty((len(projection.records), 4))
    launch_chunked(
        kernels.pack_channels,
        len(channels),
        [
            array(features, wp.float32),
            array(projection.records, wp.float32),
            array(projection.rects, vec4s),
            first,
        ],
        [array(channels, wp.float32)],
        device=device_name(features),
    )
    return channels


def _culled(projection: Projection) -> list[Any]:
    return [
        array(projection.records, wp.float32),
        array(projection.radii, wp.vec2i),
        array(projection.rects, vec4s),
    ]


__all__ = [
    "Projection",
    "View",
    "array",
    "pack_channels",
    "project",
    "shade_features",
    "shade_harmonics",
    "sort_pairs",
]
