"""From Gaussians or surfels to a closed coloured triangle mesh: oriented points, screened Poisson, remeshing.

Points come from rendered depth (default), from the level set of the Gaussians' density, or are the centres
themselves (the paper's own). Everything happens in the unit frame; the same input gives the same bytes.

Source: "GaussianDreamerPro" (arXiv 2406.18462), section 3.2; level-set points after Guedon and Lepetit,
"SuGaR" (arXiv 2311.12775); Kazhdan and Hoppe, "Screened Poisson Surface Reconstruction" (2013); Botsch and
Kobbelt, "A Remeshing Approach to Multiresolution Modeling" (2004). Poisson and remeshing are those of
gpytoolbox, in the parts that carry the MIT and MPL-2 licences (nothing of `gpytoolbox.copyleft`); both run
on one thread and give the same bytes for the same points in the same order.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gdpro_sim.cameras import Cameras
from gdpro_sim.device import beside_torch
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians, Surfels, rotation_matrices
from gdpro_sim.generation.config import ExtractionConfig
from gdpro_sim.generation.level_set import Density
from gdpro_sim.meshing.color import linear_to_srgb, srgb_to_linear
from gdpro_sim.meshing.remesh import decimate
from gdpro_sim.meshing.repair import check_arrays, clean, face_areas, face_components, validate, weld
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh
from gdpro_sim.splatting import rasterization_2dgs
from gdpro_sim.splatting.contributions import contributions
from gdpro_sim.splatting.normals import shortest_axes

logger = logging.getLogger(__name__)

REACH = 1.15
"""Radius of the ball points are taken from, in the unit frame."""

DISTANCE = 4.6
"""From the origin to the cameras."""

OPAQUE = 0.5
"""Least alpha of a pixel that gives a point."""

STEP = 6.0
"""Depth step between neighbouring pixels, in pixel footprints, past which there is an edge (80 degrees)."""

GRAZING = 0.15
"""Least cosine between a point's normal and the way to the camera."""

FEWEST = 200
"""Points that Poisson needs to say anything about a closed surface."""

SCREENING = 10.0
"""Weight of the points against the gradients in screened Poisson (the authors take 4).

Measured on a mug with walls of 0.07: volume 11 % too large with 4, 7 % with 20; more lets noise through.
"""

THINNING = 1.5
"""Size of the cubes that keep one point each, in cells of Poisson's grid."""

AGREEING = 0.5
"""A pixel's blended normal is used where it is at least this long: there the Gaussians agree on it."""


@dataclass(frozen=True)
class OrientedPoints:
    """Samples of a surface in the unit frame, all [N, 3] float64; colours sRGB-encoded in [0, 1]."""

    points: np.ndarray
    normals: np.ndarray
    colors: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: np.ndarray) -> OrientedPoints:
        return OrientedPoints(self.points[rows], self.normals[rows], self.colors[rows])


def extract(gaussians: Gaussians | Surfels, config: ExtractionConfig | None = None) -> SurfaceMesh:
    """The surface of Gaussians or surfels in the unit frame as one coloured mesh of about `config.triangles`.

    Closed, manifold and wound outward where `config.watertight`; open where nothing was seen otherwise. Per-
    corner colours are those the nearest points were seen in. Raises MeshError, with the way out, where there
    is nothing opaque, too few points, or no closed surface comes out.
    """
    config = config or ExtractionConfig()
    points = oriented_points(gaussians, config)
    vertices, faces, notes = reconstruct(points, config)
    colors = vertex_colors(vertices, faces, points, _cell(config))
    corners = np.full((len(faces), 3, 4), 255, np.uint8)
    corners[..., :3] = np.round(255.0 * colors[faces])
    return SurfaceMesh(
        vertices,
        faces,
        None,
        corners,
        np.zeros(len(faces), np.int32),
        (MeshMaterial("extracted", (1.0, 1.0, 1.0, 1.0)),),
        messages=(f"surface of {len(gaussians):,} Gaussians from {len(points):,} points", *notes),
    )


def oriented_points(gaussians: Gaussians | Surfels, config: ExtractionConfig) -> OrientedPoints:
    """Points, outward normals and colours of what cameras on a sphere see, evenly thinned.

    Raises MeshError where nothing is opaque or too little is left.
    """
    if not len(gaussians):
        raise MeshError("nothing opaque is seen: there are no Gaussians")
    gather = {"rendered-depth": _depth_points, "level-set": _level_points, "centres": _centre_points}
    with beside_torch(gaussians.means):
        found = gather[config.points](gaussians, config)
    inside = np.isfinite(found.points).all(1) & np.isfinite(found.normals).all(1)
    inside &= np.linalg.norm(found.points, axis=1) < REACH
    found = found[inside]
    if not len(found):
        strongest = float(gaussians.opacities.max())
        raise MeshError(
            f"nothing opaque is seen: {len(gaussians)} Gaussians, largest opacity {strongest:.2g}; "
            "optimise longer, or lower extraction.level where points are taken from the level set"
        )
    thinned = _without_strays(_thinned(found, THINNING * _cell(config)), THINNING * _cell(config), config)
    if len(thinned) < FEWEST:
        raise MeshError(
            f"only {len(thinned)} surface points were found, {FEWEST} are needed; raise extraction.cameras "
            f"({config.cameras}) or extraction.resolution ({config.resolution}), or optimise longer"
        )
    logger.info("%d surface points, %d after thinning", len(found), len(thinned))
    return thinned


def reconstruct(
    points: OrientedPoints, config: ExtractionConfig
) -> tuple[np.ndarray, np.ndarray, tuple[str, ...]]:
    """Vertices [V, 3] float32 and faces [F, 3] int32 of the points' surface, and what was left out of it.

    Raises MeshError where Poisson finds no surface, or none that is closed.
    """
    vertices, faces = _poisson(points, config)
    tree, cell = cKDTree(points.points), _cell(config)
    notes: list[str] = []
    if not config.watertight:
        faces = faces[_supported(vertices, tree, cell, config.trim)[faces].all(1)]
        if not len(faces):
            raise MeshError(f"trimming left no surface; lower extraction.trim ({config.trim})")
    faces, dropped = _components(vertices, faces, tree, cell, config.keep)
    if dropped:
        notes.append(f"{dropped} separate pieces were left out")
    vertices, faces = weld(vertices, faces)
    vertices, faces = _remeshed(vertices, faces, config)
    report = validate(vertices, faces)
    if config.watertight and not report.watertight:
        raise MeshError(
            f"the extracted surface is not closed ({report.boundary_edges} open and "
            f"{report.non_manifold_edges} non-manifold edges); raise extraction.triangles "
            f"({config.triangles}) or lower extraction.depth ({config.depth})"
        )
    logger.info(
        "%d faces, %d pieces, volume %.4f in the unit frame", len(faces), report.components, report.volume
    )
    return vertices, faces, tuple(notes)


def vertex_colors(vertices: np.ndarray, faces: np.ndarray, points: OrientedPoints, cell: float) -> np.ndarray:
    """Colours [V, 3] in [0, 1], sRGB-encoded: means in linear light over the 8 nearest points.

    A point counts less the further it is, and not at all where it faces the other way, unless all do.
    """
    normals = _vertex_normals(vertices, faces)
    distance, index = cKDTree(points.points).query(vertices, k=8)
    weights = np.exp(-0.5 * (distance / (distance[:, :1] + 0.5 * cell)) ** 2)
    facing = np.clip(np.einsum("vkc,vc->vk", points.normals[index], normals), 0.0, None)
    alike = facing.sum(1) > 0.1
    weights[alike] *= facing[alike] + 1e-6
    linear = srgb_to_linear(points.colors[index])
    return linear_to_srgb(np.einsum("vk,vkc->vc", weights, linear) / weights.sum(1)[:, None])


# Points


@dataclass(frozen=True)
class _View:
    """What one camera of `index` sees: rgb, normals [H, W, 3], depth, alpha [H, W], and its own matrices."""

    index: int
    rgb: torch.Tensor
    alpha: torch.Tensor
    depth: torch.Tensor
    normals: torch.Tensor
    meta: dict[str, object]


def _cell(config: ExtractionConfig) -> float:
    """Size of an octree cell of Poisson's grid at its depth, in the unit frame."""
    return 2.0 * REACH / 2**config.depth


def _cameras(config: ExtractionConfig, size: int | None = None) -> Cameras:
    """Cameras on a spiral over a sphere, evenly in polar angle, each seeing the ball of radius REACH.

    So the poles get more of them than by area: it is from there that hollow things show their insides.
    """
    polar = math.pi * np.arange(config.cameras) / (config.cameras - 1)
    turn = math.pi * (1.0 + math.sqrt(5.0)) * np.arange(config.cameras)
    eyes = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], 1)
    size = size or config.resolution
    return Cameras.look_at(
        DISTANCE * eyes,
        [0.0, 0.0, 0.0],
        vertical_fov=2.0 * math.asin(REACH / DISTANCE),
        width=size,
        height=size,
    )


def _looks(gaussians: Gaussians | Surfels, cameras: Cameras) -> Iterator[_View]:
    """One view after the other, so that memory does not grow with their number."""
    device = gaussians.means.device
    near, far = DISTANCE - 1.5 * REACH, DISTANCE + 1.5 * REACH
    for index in range(len(cameras)):
        view, k = (m[index : index + 1].to(device) for m in (cameras.viewmats, cameras.Ks))
        eye = cameras.positions[index].to(device)
        g = gaussians if isinstance(gaussians, Surfels) else discs_towards(gaussians, eye)
        with torch.no_grad():
            image, alpha, normals, _, _, median, meta = rasterization_2dgs(
                g.means, g.quats, g.scales, g.opacities, g.sh, view, k, cameras.width, cameras.height,
                near_plane=near, far_plane=far, sh_degree=g.sh_degree,
            )  # fmt: skip
        a = alpha[0, ..., 0]
        weight = a.clamp_min(1e-6)[..., None]
        rgb = (image[0, ..., :3] / weight).clamp(0.0, 1.0)
        yield _View(index, rgb, a, median[0, ..., 0], normals[0] / weight, meta)


def discs_towards(gaussians: Gaussians, eye: torch.Tensor) -> Surfels:
    """The disc that shows each 3D Gaussian as it is seen from `eye` [3], and lies where rays find it densest.

    With covariance S and viewing direction d the ray's densest points lie in the plane through the mean
    with the normal S^-1 d; the covariance S - d d^T / (d^T S^-1 d) lies in that plane, and looks as S does
    along d. Depth is then exact, where a blend of the depths of centres is drawn towards the camera on
    slanted surfaces.

    Source: Zhang et al., "RaDe-GS: Rasterizing Depth in Gaussian Splatting" (arXiv 2406.01467), section 4.
    """
    means = gaussians.means.detach().double()
    scales = gaussians.scales.detach().double()
    scales = scales.clamp_min(1e-12).maximum(1e-4 * scales.amax(1, keepdim=True))
    axes = rotation_matrices(gaussians.quats.detach().double())
    direction = torch.nn.functional.normalize(means - eye.double(), dim=1)
    local = torch.einsum("nji,nj->ni", axes, direction)
    across = local / scales**2
    normal = torch.nn.functional.normalize(torch.einsum("nij,nj->ni", axes, across), dim=1)
    least = torch.nn.functional.one_hot(normal.abs().argmin(1), 3).double()
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, least), dim=1)
    second = torch.linalg.cross(normal, first)
    u, v = (torch.einsum("nij,ni->nj", axes, a) * scales for a in (first, second))
    reach = (local * across).sum(1)
    a, b = (first * direction).sum(1), (second * direction).sum(1)
    uu, vv, uv = (
        (u * u).sum(1) - a * a / reach,
        (v * v).sum(1) - b * b / reach,
        (u * v).sum(1) - a * b / reach,
    )
    angle = 0.5 * torch.atan2(2.0 * uv, uu - vv)
    mean, half = 0.5 * (uu + vv), torch.hypot(0.5 * (uu - vv), uv)
    cosine, sine = torch.cos(angle)[:, None], torch.sin(angle)[:, None]
    major, minor = cosine * first + sine * second, cosine * second - sine * first
    frames = torch.stack([major, minor, normal], 2).cpu().numpy()
    finite = np.isfinite(frames).all((1, 2))
    quats = np.zeros((len(means), 4))  # a zero quaternion is not drawn
    quats[finite] = Rotation.from_matrix(frames[finite]).as_quat()[:, [3, 0, 1, 2]]
    deviations = torch.stack([mean + half, (mean - half).clamp_min(1e-16)], 1).sqrt()
    return Surfels(
        gaussians.means.detach(),
        torch.from_numpy(quats).to(gaussians.means),
        deviations.float(),
        gaussians.opacities.detach(),
        gaussians.sh.detach(),
    )


def _depth_points(gaussians: Gaussians | Surfels, config: ExtractionConfig) -> OrientedPoints:
    """Pixels carried back to where their depth lies; edges, where depth mixes two surfaces, left out."""
    cameras = _cameras(config)
    parts = []
    for look in _looks(gaussians, cameras):
        view = cameras.viewmats[look.index].to(look.depth)
        k = cameras.Ks[look.index].to(look.depth)
        opaque = look.alpha > OPAQUE
        footprint = look.depth / k[1, 1]
        keep = opaque & (_steps(look.depth, opaque) < STEP * footprint)
        rays = _rays(cameras, look.index).to(look.depth)
        points = (look.depth[..., None] * rays - view[:3, 3]) @ view[:3, :3]
        length = torch.linalg.vector_norm(look.normals, dim=-1)
        normals = look.normals / length.clamp_min(1e-12)[..., None]
        towards = -torch.nn.functional.normalize(rays @ view[:3, :3], dim=-1)
        keep &= (length > AGREEING) & ((normals * towards).sum(-1) > GRAZING)
        parts.append(_rows(points[keep], normals[keep], look.rgb[keep]))
    return _joined(parts)


def _level_points(gaussians: Gaussians | Surfels, config: ExtractionConfig) -> OrientedPoints:
    """Where rays from the cameras first meet the density `config.level`; normals against its gradient."""
    cameras, density = _cameras(config, config.resolution // 2), Density(gaussians)
    parts = []
    for look in _looks(gaussians, cameras):
        view = cameras.viewmats[look.index].to(look.depth)
        seen = look.alpha > 0.5 * OPAQUE
        rays = torch.nn.functional.normalize(_rays(cameras, look.index).to(look.depth)[seen], dim=-1)
        directions = rays @ view[:3, :3]
        origin = cameras.positions[look.index].to(look.depth)
        distance, normals = density.first_crossings(
            origin, directions, level=config.level, near=DISTANCE - REACH, far=DISTANCE + REACH
        )
        hit = torch.isfinite(distance) & (-(normals * directions).sum(-1) > GRAZING)
        points = origin + distance[hit, None] * directions[hit]
        parts.append(_rows(points, normals[hit], look.rgb[seen][hit]))
    return _joined(parts)


def _centre_points(gaussians: Gaussians | Surfels, config: ExtractionConfig) -> OrientedPoints:
    """Centres of Gaussians that are seen, their normals turned towards where they are seen from."""
    cameras = _cameras(config)
    count = len(gaussians)
    weight = torch.zeros(count, dtype=torch.float64)
    normal = torch.zeros((count, 3), dtype=torch.float64)
    color = torch.zeros((count, 3), dtype=torch.float64)
    quats, scales = gaussians.quats, gaussians.scales
    if isinstance(gaussians, Surfels):  # the third axis is the thin one
        scales = torch.nn.functional.pad(scales, (0, 1))
    for look in _looks(gaussians, cameras):
        seen = contributions(look.meta)[0].double().cpu()
        shown = contributions(look.meta, look.rgb[None].contiguous())[0].double().cpu()
        view = cameras.viewmats[look.index : look.index + 1].to(quats)
        axes = shortest_axes(gaussians.means, quats, scales, view)[0].double().cpu()
        weight += seen
        normal += seen[:, None] * axes
        color += shown
    opaque = gaussians.opacities.detach().double().cpu() > 0.1
    keep = opaque & (weight > 0.5) & (torch.linalg.vector_norm(normal, dim=1) > 1e-9)
    normals = torch.nn.functional.normalize(normal[keep], dim=1)
    return _rows(gaussians.means.detach().cpu()[keep], normals, color[keep] / weight[keep, None])


def _rays(cameras: Cameras, index: int) -> torch.Tensor:
    """Camera-space directions (x, y, 1) through the middle of the pixels of one camera, [H, W, 3]."""
    k = cameras.Ks[index]
    y, x = torch.meshgrid(
        torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5, indexing="ij"
    )
    return torch.stack([(x - k[0, 2]) / k[0, 0], (y - k[1, 2]) / k[1, 1], torch.ones_like(x)], -1)


def _steps(depth: torch.Tensor, opaque: torch.Tensor) -> torch.Tensor:
    """Largest step [H, W] from a pixel's depth to that of its four neighbours, where both are opaque."""
    out = torch.zeros_like(depth)
    across = (depth[:, 1:] - depth[:, :-1]).abs() * (opaque[:, 1:] & opaque[:, :-1])
    along = (depth[1:] - depth[:-1]).abs() * (opaque[1:] & opaque[:-1])
    out[:, 1:] = torch.maximum(out[:, 1:], across)
    out[:, :-1] = torch.maximum(out[:, :-1], across)
    out[1:] = torch.maximum(out[1:], along)
    out[:-1] = torch.maximum(out[:-1], along)
    return out


def _rows(points: torch.Tensor, normals: torch.Tensor, colors: torch.Tensor) -> OrientedPoints:
    return OrientedPoints(*(t.detach().double().cpu().numpy() for t in (points, normals, colors)))


def _joined(parts: list[OrientedPoints]) -> OrientedPoints:
    return OrientedPoints(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("points", "normals", "colors"))
    )


def _thinned(points: OrientedPoints, size: float) -> OrientedPoints:
    """One point for each cube of `size` and each of the six ways a normal may mostly point: their mean.

    Both sides of a thin wall stay apart, and a part that many cameras saw weighs no more than others.
    """
    cube = np.floor(points.points / size).astype(np.int64) + (1 << 15)
    axis = np.abs(points.normals).argmax(1)
    way = 2 * axis + (np.take_along_axis(points.normals, axis[:, None], 1)[:, 0] < 0.0)
    key = ((cube[:, 0] << 16 | cube[:, 1]) << 16 | cube[:, 2]) * 6 + way
    _, inverse, counts = np.unique(key, return_inverse=True, return_counts=True)

    def mean(values: np.ndarray) -> np.ndarray:
        sums = [np.bincount(inverse, weights=values[:, k], minlength=len(counts)) for k in range(3)]
        return np.stack(sums, 1) / counts[:, None]

    normals = mean(points.normals)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return OrientedPoints(
        mean(points.points), normals / np.maximum(length, 1e-12), np.clip(mean(points.colors), 0.0, 1.0)
    )


def _without_strays(points: OrientedPoints, size: float, config: ExtractionConfig) -> OrientedPoints:
    """Points that have neighbours as a surface's points do: of 28 expected within 3 sizes, at least 7.

    Centres are not as dense as pixels, so they are counted by the distance to their neighbours instead.
    """
    if len(points) < FEWEST:
        return points
    tree = cKDTree(points.points)
    if config.points == "centres":
        eighth = tree.query(points.points, k=9)[0][:, 8]
        return points[eighth < 3.0 * np.median(eighth)]
    return points[tree.query_ball_point(points.points, 3.0 * size, return_length=True) > 7]


# Surface


def _poisson(points: OrientedPoints, config: ExtractionConfig) -> tuple[np.ndarray, np.ndarray]:
    """Screened Poisson; a surface that vanishes at the boundary of its box where it must be closed."""
    import gpytoolbox

    try:
        vertices, faces = gpytoolbox.point_cloud_to_mesh(
            points.points,
            points.normals,
            psr_screening_weight=SCREENING,
            psr_depth=config.depth,
            psr_outer_boundary_type="Dirichlet" if config.watertight else "Neumann",
        )
    except RuntimeError as error:
        raise MeshError(
            f"Poisson reconstruction of {len(points)} points failed ({error}); "
            f"lower extraction.depth ({config.depth})"
        ) from error
    vertices, faces = np.asarray(vertices, np.float64), np.asarray(faces, np.int64)
    if not len(faces):
        raise MeshError(
            f"Poisson reconstruction of {len(points)} points found no surface; optimise longer, or try "
            "extraction.points level-set or rendered-depth"
        )
    check_arrays(vertices, faces, "Poisson reconstruction")
    return vertices, faces


def _supported(vertices: np.ndarray, tree: cKDTree, cell: float, trim: float) -> np.ndarray:
    """Vertices that points lie near, bool [V].

    The density of the points at a vertex is 8 over the area of the disc that holds its 8 nearest; vertices
    below the quantile `trim` of it go, except where a point lies within a cell and a half.
    """
    distance = tree.query(vertices, k=8)[0]
    density = 8.0 / (math.pi * np.maximum(distance[:, -1], 1e-12) ** 2)
    return (density >= np.quantile(density, trim)) | (distance[:, 0] < 1.5 * cell)


def _components(
    vertices: np.ndarray, faces: np.ndarray, tree: cKDTree, cell: float, keep: str
) -> tuple[np.ndarray, int]:
    """The piece with the most area near points, or all pieces most of whose area is; and how many are gone.

    The rest are bubbles that Poisson blows where it has no points.
    """
    labels = face_components(faces)
    centres = vertices[faces].mean(1)
    near = tree.query(centres, distance_upper_bound=2.0 * cell)[0] < np.inf
    area = face_areas(vertices, faces)
    count = int(labels.max()) + 1
    total = np.bincount(labels, weights=area, minlength=count)
    seen = np.bincount(labels, weights=area * near, minlength=count)
    kept = seen > 0.5 * total
    if keep == "largest" or not kept.any():
        kept = np.arange(count) == int(seen.argmax())
    if not seen.any():
        raise MeshError("the reconstructed surface lies far from every point; raise extraction.depth")
    return faces[kept[labels]], int((~kept).sum())


def _remeshed(
    vertices: np.ndarray, faces: np.ndarray, config: ExtractionConfig
) -> tuple[np.ndarray, np.ndarray]:
    """About `config.triangles` nearly equilateral faces; by quadric decimation where that opens the surface.

    An equilateral triangle of edge h has the area sqrt(3) / 4 h^2.
    """
    import gpytoolbox

    area = float(face_areas(vertices, faces).sum())
    edge = math.sqrt(4.0 * area / (math.sqrt(3.0) * config.triangles))
    whole = validate(vertices, faces)
    try:
        v, f = gpytoolbox.remesh_botsch(vertices.astype(np.float64), faces.astype(np.int32), 6, edge, True)
        v, f = clean(v.astype(np.float32), f.astype(np.int32))
        report = validate(v, f)
        if report.components == whole.components and (report.watertight or not config.watertight):
            return v, f
        logger.info("remeshing left %d open edges; decimating instead", report.boundary_edges)
    except ValueError as error:  # gpytoolbox refuses what is not manifold
        logger.info("remeshing is not possible (%s); decimating instead", error)
    return decimate(vertices, faces, config.triangles)


def _vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Unit vertex normals [V, 3], weighted by area."""
    v = vertices.astype(np.float64)
    cross = np.cross(v[faces[:, 1]] - v[faces[:, 0]], v[faces[:, 2]] - v[faces[:, 0]])
    total = np.stack(
        [np.bincount(faces.ravel(), np.repeat(cross[:, k], 3), len(vertices)) for k in range(3)], 1
    )
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)


__all__ = [
    "OrientedPoints",
    "extract",
    "oriented_points",
    "reconstruct",
    "vertex_colors",
]
