"""Fill a shape with particles: closed meshes, tets, and clouds of Gaussians without a mesh.

A pattern of points covers the shape's box, the points inside are kept, and the shape's volume is shared out
among them, so that the particles' volumes add up to it whatever their number.

Gaussians without a mesh are filled after PhysGaussian (Xie et al. 2024, section 3.5): their opacities make a
density field on a grid, and what rays meet tells the inside. It keeps one particle at each Gaussian, draws
the others at random within cells, takes the parity of one ray, and shares each cell's whole volume among the
particles in it, so that some air around the surface has mass. Here all particles are of the chosen pattern,
most of the rays decide, and the field is worn down to where the Gaussians lie.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.meshing.density import Side, solid_of
from gdpro_sim.meshing.embedding import boundary, containing_tets
from gdpro_sim.meshing.lattice import NO_VOLUME, surface_points
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import check_arrays, face_normals, validate
from gdpro_sim.meshing.tetmesh import TetMesh

Pattern = Literal["jittered", "lattice", "blue-noise"]

JITTER = 0.25
"""How far a jittered point lies off its cell's centre at most, in cells and along each axis: neighbours stay
half a spacing apart."""

TILE = 12
"""Blue noise repeats after as many spacings."""

TILE_RADIUS = 0.85
"""Least distance of blue noise, in spacings; darts thrown until no more fits would give 0.90."""

MOST_POINTS = 40_000_000
"""Points of the pattern that may cover a shape's box."""

UNCOVERED = 1.25
"""A surface further than this from all particles, in spacings, is of a part too thin for the pattern."""

APART = 0.75
"""Least distance of particles put into thin parts from each other, in spacings."""

OVERLAP_SAMPLES = 20_000


@dataclass(frozen=True)
class Filling:
    """Particles that fill a shape.

    points:  [N, 3] float32 m
    volumes: [N] float32 m^3, > 0; they add up to the shape's volume
    """

    points: np.ndarray
    volumes: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    @property
    def spacing(self) -> float:
        """m, the cube root of the mean volume."""
        return float(self.volumes.mean(dtype=np.float64) ** (1.0 / 3.0))


def fill_mesh(
    vertices: np.ndarray, faces: np.ndarray, spacing: float, *, pattern: Pattern = "jittered", seed: int = 0
) -> Filling:
    """Particles about `spacing` m apart inside a surface: vertices [V, 3] m, faces [F, 3].

    pattern: "lattice" has one particle at the centre of each cell of a lattice that fits the shape's box;
             "jittered" moves each by up to a quarter of a cell along each axis; "blue-noise" is a Poisson
             disk, with no two closer than 0.85 spacings and no direction preferred
    seed:    of the jitter and of the blue noise

    Inside is where the generalised winding number is above one half (Jacobson et al. 2013), so open and
    self-intersecting surfaces work. The volumes add up to the volume inside: by the divergence theorem where
    the surface is closed, else by counting. Parts thinner than the spacing get one layer of particles of less
    volume. Raises MeshError where the surface encloses nothing, or `spacing` asks for too many particles.
    """
    check_arrays(vertices, faces)
    v, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    report = validate(v, f)
    closed = report.boundary_edges == 0 and report.flipped_edges == 0
    if closed and report.volume < 0.0:
        f = f[:, [0, 2, 1]]
    low, high = v[f].min((0, 1)), v[f].max((0, 1))
    shape = _Inside(v, f, closed)
    points, cell = _pattern(low, high, spacing, pattern, seed)
    points = points[shape(points, 4.0 * spacing)]
    shares = np.ones(len(points))
    if closed:
        extra, thickness = _thin_parts(v, f, shape, points, spacing)
        points, shares = np.concatenate([points, extra]), np.concatenate([shares, thickness])
    if not len(points):
        raise MeshError(f"no particle lies inside at a spacing of {spacing:g} m; {NO_VOLUME}")
    volume = abs(report.volume) / shape.overlap(points, seed) if closed else cell * len(points)
    return _filling(points, shares, volume)


def fill_tets(tetmesh: TetMesh, spacing: float, *, pattern: Pattern = "jittered", seed: int = 0) -> Filling:
    """Particles about `spacing` m apart inside tets; options as in `fill_mesh`.

    Of the particles in a partly filled tet a share of `TetMesh.fill` is kept, by lot, and the volumes add up
    to the volume of material. Raises MeshError as `fill_mesh` does.
    """
    if not len(tetmesh.tets):
        raise MeshError("cannot fill a tet mesh without tets")
    filling = fill_mesh(tetmesh.vertices, boundary(tetmesh.tets)[0], spacing, pattern=pattern, seed=seed)
    points, shares = filling.points.astype(np.float64), filling.volumes.astype(np.float64)
    if (tetmesh.fill < 1.0).any():
        owner = containing_tets(tetmesh, points)
        chance = np.where(owner >= 0, tetmesh.fill[owner], 1.0)
        keep = np.random.default_rng((seed, 1)).random(len(points)) < chance
        if not keep.any():
            raise MeshError(f"no particle lies inside at a spacing of {spacing:g} m; use a smaller one")
        points, shares = points[keep], shares[keep]
    return _filling(points, shares, float((tetmesh.volumes() * tetmesh.fill).sum()))


def fill_splats(
    gaussians: Gaussians,
    spacing: float,
    *,
    pattern: Pattern = "jittered",
    seed: int = 0,
    threshold: float = 0.5,
    open_side: Side | None = "bottom",
) -> Filling:
    """Particles about `spacing` m apart inside a cloud of Gaussians; `pattern` and `seed` as in `fill_mesh`.

    threshold: sum of opacities, as they fall off with distance, above which a point is matter; lower closes
               larger holes between Gaussians
    open_side: where the cloud may be open, because nobody saw it: most scans have no bottom; None: nowhere

    See `gdpro_sim.meshing.density`. The volumes add up to the volume found, which is as exact as the field: a
    cell is `spacing` wide. Raises MeshError where nothing is dense enough or `spacing` asks for too much.
    """
    _check_spacing(spacing)
    solid = solid_of(gaussians, spacing, threshold=threshold, open_side=open_side, most=MOST_POINTS)
    points, cell = _pattern(solid.low, solid.high, spacing, pattern, seed)
    points = points[solid.contains(points)]
    if not len(points):
        raise MeshError(
            f"the cloud is nowhere as dense as {threshold:g}, at a spacing of {spacing:g} m; lower either"
        )
    return _filling(points, np.ones(len(points)), cell * len(points))


def fill_bound(
    bound: BoundGaussians, spacing: float, *, pattern: Pattern = "jittered", seed: int = 0
) -> Filling:
    """Particles inside the mesh of bound Gaussians; inside the cloud where no two triangles share a vertex.

    See `fill_mesh` and `fill_splats`.
    """
    faces = bound.faces.cpu().numpy()
    if bound.is_loose:
        return fill_splats(bound.to("cpu").gaussians(), spacing, pattern=pattern, seed=seed)
    return fill_mesh(bound.vertices.detach().cpu().numpy(), faces, spacing, pattern=pattern, seed=seed)


def _filling(points: np.ndarray, shares: np.ndarray, volume: float) -> Filling:
    """`volume` m^3 shared out; float32 rounding of equal shares is repaired in the sum."""
    volumes = (shares * (volume / shares.sum())).astype(np.float32)
    if not (volumes > 0.0).all():
        raise MeshError(f"a volume of {volume:g} m^3 is too small to share among {len(points):,} particles")
    return Filling(np.ascontiguousarray(points, np.float32), volumes)


def _check_spacing(spacing: float) -> None:
    if not (math.isfinite(spacing) and spacing > 0.0):
        raise MeshError(f"the spacing of particles must be a finite number > 0 m, got {spacing}")


# ---- patterns ----


def _pattern(
    low: np.ndarray, high: np.ndarray, spacing: float, pattern: Pattern, seed: int
) -> tuple[np.ndarray, float]:
    """Points [M, 3] that cover the box, and the volume m^3 that each stands for."""
    _check_spacing(spacing)
    if pattern not in get_args(Pattern):
        raise MeshError(f"pattern must be one of {', '.join(get_args(Pattern))}, got {pattern!r}")
    size = np.maximum(high - low, 1e-30)
    wanted = float(np.maximum(size / spacing, 1.0).prod())
    if wanted > MOST_POINTS:
        raise MeshError(
            f"a spacing of {spacing:g} m puts {wanted:,.0f} points into the box around the shape, more than "
            f"{MOST_POINTS:,}; use at least {spacing * (wanted / MOST_POINTS) ** (1 / 3):.3g} m"
        )
    if pattern == "blue-noise":
        tile = blue_noise_tile(seed)
        copies = np.ceil(size / (TILE * spacing)).astype(np.int64)
        origins = _grid(copies)
        points = ((origins[:, None] * TILE + tile) * spacing).reshape(-1, 3)
        points = points[(points <= size).all(1)]
        return low + points, spacing**3
    counts = np.maximum(np.round(size / spacing), 1).astype(np.int64)
    cell = size / counts
    points = _grid(counts) + 0.5
    if pattern == "jittered":
        points += np.random.default_rng(seed).uniform(-JITTER, JITTER, points.shape)
    return low + points * cell, float(cell.prod())


def _grid(counts: np.ndarray) -> np.ndarray:
    """Integer points [M, 3] float64 of a box of `counts` [3] cells, the last axis running fastest."""
    axes = np.meshgrid(*(np.arange(n, dtype=np.float64) for n in counts), indexing="ij")
    return np.stack(axes, -1).reshape(-1, 3)


@functools.lru_cache(maxsize=4)
def blue_noise_tile(seed: int) -> np.ndarray:
    """TILE^3 points [TILE^3, 3] in [0, TILE)^3, none closer than TILE_RADIUS to another or to its periodic
    copies: darts thrown at random (Cook 1986), many at a time."""
    rng = np.random.default_rng(seed)
    wanted = TILE**3
    points = np.zeros((0, 3))
    while len(points) < wanted:
        darts = rng.random((8 * wanted, 3)) * TILE
        if len(points):
            distance, _ = cKDTree(points, boxsize=TILE).query(darts, distance_upper_bound=TILE_RADIUS)
            darts = darts[distance > TILE_RADIUS]
        points = np.concatenate([points, darts[_spread(darts, TILE_RADIUS, boxsize=TILE)]])
    points = points[:wanted]
    points.flags.writeable = False
    return points


def _spread(points: np.ndarray, radius: float, boxsize: float | None = None) -> np.ndarray:
    """Mask [N] of points taken in order, but for those within `radius` of one taken before."""
    keep = np.ones(len(points), bool)
    if len(points):
        pairs = cKDTree(points, boxsize=boxsize).query_pairs(radius, output_type="ndarray")
        pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
        for first, second in pairs.tolist():
            if keep[first]:
                keep[second] = False
    return keep


# ---- meshes ----


class _Inside:
    """Which points lie inside a surface: one query for all points of a cell that the surface does not
    reach."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, closed: bool) -> None:
        self._corners = vertices[faces]
        self._closed = closed
        self.index = SurfaceIndex(vertices, faces, winding=True)

    def __call__(self, points: np.ndarray, cell: float) -> np.ndarray:
        """points [N, 3] m; cells are `cell` m wide, then half as wide. bool [N]."""
        out = np.zeros(len(points), bool)
        rest = np.arange(len(points))
        # Across the hole of an open surface the winding number changes where there is no surface near.
        for size in (cell, 0.5 * cell) if self._closed else ():
            where = np.floor(points[rest] / size).astype(np.int64)
            base = where.min(0) if len(where) else 0
            shape = (where - base).max(0) + 1 if len(where) else (1, 1, 1)
            keys = np.ravel_multi_index(tuple((where - base).T), tuple(shape))
            cells, member = np.unique(keys, return_inverse=True)
            centres = (np.stack(np.unravel_index(cells, tuple(shape)), 1) + base + 0.5) * size
            clear = self.distance(centres) > 0.5001 * math.sqrt(3.0) * size
            sign = np.zeros(len(cells), bool)
            sign[clear] = self.index.inside(centres[clear])
            known = clear[member]
            out[rest[known]] = sign[member[known]]
            rest = rest[~known]
        out[rest] = self.index.inside(points[rest])
        return out

    def distance(self, points: np.ndarray) -> np.ndarray:
        """m from each point to the surface, [N]."""
        face, weights = self.index.closest(points)
        return np.linalg.norm(np.einsum("nc,ncd->nd", weights, self._corners[face]) - points, axis=1)

    def overlap(self, points: np.ndarray, seed: int) -> float:
        """Mean winding number at the particles: 1 but for a surface that overlaps itself."""
        some = points
        if len(points) > OVERLAP_SAMPLES:
            some = points[np.random.default_rng((seed, 2)).choice(len(points), OVERLAP_SAMPLES, False)]
        total, level = 1.0, 1.5
        while len(some):
            deeper = self.index.inside(some, level)
            total += float(deeper.sum()) / min(len(points), OVERLAP_SAMPLES)
            some, level = some[deeper], level + 1.0
        return total


def _thin_parts(
    v: np.ndarray,
    f: np.ndarray,
    inside: _Inside,
    points: np.ndarray,
    spacing: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Particles [K, 3] for parts that the pattern missed, halfway to the opposite wall or half a spacing deep
    where that is further off, and the thickness there in spacings, at most 1."""
    samples, owners = surface_points(v, f, spacing)
    if len(points):
        distance, _ = cKDTree(points).query(samples, distance_upper_bound=UNCOVERED * spacing)
        missed = np.flatnonzero(~np.isfinite(distance))
        samples, owners = samples[missed], owners[missed]
    if not len(samples):
        return np.zeros((0, 3)), np.zeros(0)
    normals = face_normals(v, f)[owners]
    length = np.linalg.norm(normals, axis=1)
    samples, normals = samples[length > 0.0], normals[length > 0.0] / length[length > 0.0, None]
    start = samples - normals * (1e-5 * float(np.linalg.norm(np.ptp(v[f].reshape(-1, 3), axis=0))))
    hit, weights = inside.index.first_hit(start, -normals)
    found = hit >= 0
    ends = np.einsum("nc,ncd->nd", weights[found], v[f[hit[found]]])
    depth = np.linalg.norm(ends - samples[found], axis=1)
    middle = samples[found] - normals[found] * np.minimum(0.5 * depth, 0.5 * spacing)[:, None]
    # One candidate for each cell, the one nearest its centre; then none too close to another.
    cell = np.floor(middle / spacing)
    off = np.linalg.norm(middle - (cell + 0.5) * spacing, axis=1)
    order = np.lexsort((off, *cell.T))
    fresh = np.ones(len(order), bool)
    fresh[1:] = (np.diff(cell[order], axis=0) != 0).any(1)
    chosen = order[fresh]
    chosen = chosen[inside(middle[chosen], spacing)]
    # Not those near an edge, deep under one wall but at another: walls opposite each other have better ones.
    room = inside.distance(middle[chosen])
    chosen = chosen[room > 0.125 * np.minimum(depth[chosen], spacing)]
    chosen = chosen[_spread(middle[chosen], APART * spacing)]
    return middle[chosen], np.minimum(2.0 * inside.distance(middle[chosen]) / spacing, 1.0)


__all__ = ["Filling", "Pattern", "blue_noise_tile", "fill_bound", "fill_mesh", "fill_splats", "fill_tets"]
