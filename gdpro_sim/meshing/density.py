"""The matter in a cloud of Gaussians: an opacity field on a grid, and what its rays say is inside.

After PhysGaussian (Xie et al. 2024, section 3.5): a cell is matter where it is dense, and where dense cells
surround it and an axis ray leaves through an odd number of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy import ndimage

from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians, rotation_matrices

Side = Literal["left", "right", "front", "back", "bottom", "top"]
"""-X, +X, -Y, +Y, -Z, +Z."""

SIDES: tuple[Side, ...] = ("left", "right", "front", "back", "bottom", "top")

REACH = 2.5
"""Standard deviations after which a Gaussian ends."""

BLUR = 0.5
"""Standard deviation in cells that the field is smoothed with, so that no flat Gaussian falls between two
cells' centres."""

WIDEST = 32
"""Cells that a Gaussian may reach in each direction; a wider one is background, and left out."""

CHUNK = 4_000_000

MARGIN = 2


@dataclass(frozen=True)
class Solid:
    """Matter on a grid.

    origin: [3] m, lower corner of cell (0, 0, 0)
    cell:   m, a cell's edge
    depth:  [X, Y, Z] m that each cell's centre lies inside of the surface, below zero outside
    """

    origin: np.ndarray
    cell: float
    depth: np.ndarray

    @property
    def low(self) -> np.ndarray:
        """Lower corner of a box around the matter, m."""
        return self.origin + np.argwhere(self.depth > -self.cell).min(0) * self.cell

    @property
    def high(self) -> np.ndarray:
        return self.origin + (np.argwhere(self.depth > -self.cell).max(0) + 1) * self.cell

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Whether each point [N, 3] m is matter; bool [N]."""
        return _sample(self.depth, (points - self.origin) / self.cell) > 0.0


def solid_of(
    gaussians: Gaussians, cell: float, *, threshold: float, open_side: Side | None, most: int
) -> Solid:
    """The matter in a cloud on cells `cell` m wide.

    threshold: opacity sum above which a cell is dense
    open_side: the side that rays may leave by without meeting a dense cell, or None
    most:      cells past which MeshError is raised; so it is where no cell is dense enough
    """
    if open_side is not None and open_side not in SIDES:
        raise MeshError(f"open_side must be one of {', '.join(SIDES)} or None, got {open_side!r}")
    if not threshold > 0.0:
        raise MeshError(f"threshold must be > 0, got {threshold}")
    means, covariances, opacities = _visible(gaussians, cell)
    origin = means.min(0) - (MARGIN + REACH * BLUR) * cell
    shape = np.ceil((means.max(0) - origin) / cell).astype(np.int64) + MARGIN + int(REACH)
    if float(np.prod(shape.astype(np.float64))) > most:
        raise MeshError(
            f"cells of {cell:g} m are too many for a cloud {np.ptp(means, axis=0).max():g} m wide "
            f"({int(np.prod(shape)):,}); use a larger spacing"
        )
    field = _density((means - origin) / cell, covariances / cell**2, opacities, tuple(shape))
    dense = field > threshold
    if not dense.any():
        raise MeshError(
            f"the cloud is nowhere as dense as {threshold:g} (its most is {float(field.max()):.3g}); lower it"
        )
    matter = dense | _enclosed(dense, open_side)
    return Solid(origin, cell, _worn(matter, dense, (means - origin) / cell) * cell)


def _visible(gaussians: Gaussians, cell: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3] m, covariances [N, 3, 3] m^2 and opacities [N] of Gaussians that count, float64."""
    axes = rotation_matrices(gaussians.quats.detach().cpu()).double().numpy()
    scales = gaussians.scales.detach().cpu().double().numpy()
    means = gaussians.means.detach().cpu().double().numpy()
    opacities = gaussians.opacities.detach().cpu().double().numpy()
    use = np.isfinite(means).all(1) & np.isfinite(scales).all(1) & (opacities >= 1.0 / 255.0)
    use &= REACH * scales.max(1, initial=0.0) <= WIDEST * cell
    if not use.any():
        raise MeshError(f"no Gaussian of the cloud is visible and smaller than {WIDEST * cell:g} m")
    means, scales, axes, opacities = means[use], scales[use], axes[use], opacities[use]
    return means, np.einsum("nij,nj,nkj->nik", axes, scales**2, axes), opacities


def _density(
    means: np.ndarray, covariances: np.ndarray, opacities: np.ndarray, shape: tuple[int, ...]
) -> np.ndarray:
    """Sum of o exp(-m^2 / 2) at the cells' centres, m the Mahalanobis distance; lengths in cells."""
    covariances = covariances + BLUR**2 * np.eye(3)
    inverse = np.linalg.inv(covariances)
    reach = REACH * np.sqrt(np.einsum("nii->ni", covariances))
    limit = np.asarray(shape) - 1
    first = np.clip(np.ceil(means - reach - 0.5).astype(np.int64), 0, limit)
    last = np.clip(np.floor(means + reach - 0.5).astype(np.int64), 0, limit)
    span = np.maximum(last - first + 1, 0)
    counts = span.prod(1)
    field = np.zeros(int(np.prod(shape)))
    ends = np.cumsum(counts)
    begin = 0
    while begin < len(means):
        done = ends[begin - 1] if begin else 0
        end = max(int(np.searchsorted(ends, done + CHUNK, side="right")), begin + 1)
        who = np.repeat(np.arange(begin, end), counts[begin:end])
        local = np.arange(len(who)) - np.repeat(ends[begin:end] - counts[begin:end] - done, counts[begin:end])
        plane = span[who, 1] * span[who, 2]
        index = first[who] + np.stack([local // plane, local // span[who, 2] % span[who, 1],
                                       local % span[who, 2]], 1)  # fmt: skip
        off = index + 0.5 - means[who]
        squared = np.einsum("ni,nij,nj->n", off, inverse[who], off)
        value = np.where(squared <= REACH**2, opacities[who] * np.exp(-0.5 * squared), 0.0)
        field += np.bincount(np.ravel_multi_index(tuple(index.T), shape), value, len(field))
        begin = end
    return field.reshape(shape)


def _enclosed(dense: np.ndarray, open_side: Side | None) -> np.ndarray:
    """Cells that dense ones surround: rays along the axes meet one, and most leave through an odd number."""
    surrounded = np.ones(dense.shape, bool)
    odd = np.zeros(dense.shape, np.int8)
    rays = 0
    for number, side in enumerate(SIDES):
        if side == open_side:
            continue
        axis, upwards = number // 2, number % 2 == 1
        # From the ray's far end inwards: walls entered so far.
        line = np.flip(dense, axis) if upwards else dense
        before = np.roll(line, 1, axis)
        np.moveaxis(before, axis, 0)[0] = False
        walls = np.cumsum(line & ~before, axis=axis, dtype=np.int32)
        walls = np.flip(walls, axis) if upwards else walls
        surrounded &= walls > 0
        odd += (walls % 2).astype(np.int8)
        rays += 1
    return surrounded & (2 * odd > rays) & ~dense


def _worn(matter: np.ndarray, dense: np.ndarray, means: np.ndarray) -> np.ndarray:
    """Signed depth in cells with the blur's thickness taken off: as deep as half of the Gaussians lie.

    Where that would leave nothing, in parts a cell or two thick, cells that hold a Gaussian stay.
    """
    depth = ndimage.distance_transform_edt(matter) - ndimage.distance_transform_edt(~matter)
    depth -= 0.5 * np.sign(depth)
    at = _sample(depth, means)
    shell = at[(at > 0.0) & (at < 2.5)]
    wear = float(np.median(shell)) if len(shell) else 0.0
    worn = depth - wear
    # What the worn body, grown again, does not cover.
    thin = matter & (ndimage.distance_transform_edt(worn <= 0.0) <= 0.0)
    thin &= ndimage.distance_transform_edt(~(worn > 0.0)) > wear + 1.0
    cells = np.floor(means).astype(np.int64)
    holds = np.zeros(matter.shape, bool)
    holds[tuple(np.clip(cells, 0, np.asarray(matter.shape) - 1).T)] = True
    worn[thin & holds & dense] = 0.5
    return worn


def _sample(values: np.ndarray, where: np.ndarray) -> np.ndarray:
    """Trilinear values at `where` [N, 3] in cells from the corner of the first."""
    return ndimage.map_coordinates(values, where.T - 0.5, order=1, mode="nearest")


__all__ = ["SIDES", "Side", "Solid", "solid_of"]
