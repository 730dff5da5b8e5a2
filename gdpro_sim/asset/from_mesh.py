"""Bound Gaussians on an imported mesh: how many, where, how wide and of what colour.

Nothing is learned after an import, so the start is made to be good as it is: the triangles carry an even
density of Gaussians, each as wide as its share of its triangle, and each takes the colour of its own patch of
the surface.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import torch

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import rgb_to_sh
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.remesh import decimate, subdivide
from gdpro_sim.meshing.repair import face_areas, face_normals
from gdpro_sim.meshing.surface import SurfaceMesh

logger = logging.getLogger(__name__)

MIN_BUDGET = 100
COVERAGE = 0.6
"""In-plane standard deviation over the spacing of neighbours: no holes, and no more blur than that needs."""

FLATNESS = 0.2
"""Standard deviation along the normal over the smaller one in the plane."""

OPACITY = 0.95
"""GaussianDreamerPro starts at 0.7 and learns; an import stays as it starts, and must not let the far side
through."""

SLIVER = 0.12
"""Least area over the squared longest edge that counts, 0.43 for an equilateral triangle."""

DENSE, DECIMATED = 0.3, 0.2
"""A mesh of more than DENSE * budget faces is decimated to DECIMATED * budget."""

COARSE_EDGE = 1.5
"""Longest edge over that of an equilateral triangle with its share of the area, at budget / 6 triangles."""

PATCH_SAMPLES = 16


def barycentric_table(count: int) -> np.ndarray:
    """Frozen barycentric weights of `count` Gaussians in one triangle, float64 [count, 3].

    count 1, 3, 4 and 6 after SuGaR and GaussianDreamerPro; k (k + 1) / 2 in general from
    a = (i + 1/3) / k, b = (j + 1/3) / k, j < k - i. Rows sum to 1, lie inside, and average to the centroid.
    Raises `MeshError` for any other count.
    """
    if count == 1:
        return np.full((1, 3), 1.0 / 3.0)
    if count == 3:
        return _permutations(0.5)
    if count == 4:
        return np.concatenate([np.full((1, 3), 1.0 / 3.0), _permutations(2.0 / 3.0)])
    if count == 6:
        return np.concatenate([_permutations(2.0 / 3.0), _permutations(1.0 / 6.0)])
    return _rows_table(count)


def _rows_table(count: int) -> np.ndarray:
    k = round((math.sqrt(8.0 * count + 1.0) - 1.0) / 2.0) if count > 0 else 0
    if k < 1 or k * (k + 1) // 2 != count:
        raise MeshError(f"Gaussians per triangle must be 4 or k (k + 1) / 2 = 1, 3, 6, 10, ..., got {count}")
    rows = [((i + 1 / 3) / k, (j + 1 / 3) / k) for i in range(k) for j in range(k - i)]
    ab = np.asarray(rows)
    return np.concatenate([ab, 1.0 - ab.sum(1, keepdims=True)], axis=1)


def _permutations(first: float) -> np.ndarray:
    rest = 0.5 * (1.0 - first)
    return np.full((3, 3), rest) + (first - rest) * np.eye(3)


def even_table(count: int) -> np.ndarray:
    """Barycentric weights that lie as evenly across neighbouring triangles as within one, float64 [count, 3].

    k^2 (1, 4, 9, ...): the centroids of the k^2 parts of the triangle; k (k + 1) / 2: the general formula of
    `barycentric_table`, for 3 and 6 too, whose own tables crowd towards the middle (on a tiling of
    equilateral triangles they leave an alpha of 0.81 and 0.83 in the worst place, these 0.94, at 0.6 spacings
    and opacity 0.95).
    """
    k = math.isqrt(max(count, 0))
    if count >= 1 and k * k == count:
        up = [(i + 1 / 3, j + 1 / 3) for i in range(k) for j in range(k - i)]
        down = [(i + 2 / 3, j + 2 / 3) for i in range(k - 1) for j in range(k - 1 - i)]
        ab = np.asarray(up + down) / k
        return np.concatenate([ab, 1.0 - ab.sum(1, keepdims=True)], axis=1)
    return _rows_table(count)


EVEN_COUNTS = np.asarray([1, 3, 4, 6, 9, 10, 15, 16, 21, 25])
"""Gaussians a triangle of an imported mesh may carry."""


def counts_per_face(areas: np.ndarray, budget: int, seed: int = 0) -> np.ndarray:
    """Gaussians of each triangle, int64 [F], so that they total about `budget` and lie evenly.

    Each triangle takes the allowed count below or above its share, at random so that the mean is the share.
    """
    counts = EVEN_COUNTS
    dice = np.random.default_rng(seed).random(len(areas))

    def assign(density: float) -> np.ndarray:
        share = np.clip(areas * density, counts[0], counts[-1])
        above = np.clip(np.searchsorted(counts, share, side="left"), 1, len(counts) - 1)
        low, high = counts[above - 1], counts[above]
        return np.where(dice < (share - low) / (high - low), high, low)

    lower = upper = budget / float(areas.sum())
    while assign(upper).sum() < budget and assign(upper).sum() < counts[-1] * len(areas):
        upper *= 1.5
    while assign(lower).sum() > budget and assign(lower).sum() > len(areas):
        lower /= 1.5
    for _ in range(40):
        middle = 0.5 * (lower + upper)
        if assign(middle).sum() > budget:
            upper = middle
        else:
            lower = middle
    return assign(lower)


@dataclass(frozen=True)
class _Surface:
    """The triangles Gaussians ride on, and how their points are found on the original surface."""

    vertices: np.ndarray
    faces: np.ndarray
    parents: np.ndarray | None  # of a subdivided mesh: original face and corners in it
    corners: np.ndarray | None


def bind_mesh(
    mesh: SurfaceMesh, *, budget: int = 50_000, seed: int = 0, occlusion: float = 0.35
) -> BoundGaussians:
    """Bind about `budget` Gaussians to a mesh: within 15 % of it where the mesh allows, never above 1.2
    times.

    A dense mesh is decimated and a coarse one subdivided first, so `vertices` and `faces` of the result need
    not be the mesh's. Colours are sampled on the mesh as given. SH degree 0. The same arguments give the same
    bytes. Splats carry no light, so a mesh of one plain colour would be a silhouette elsewhere: `occlusion`
    (0 for none) is how much of the light its hollows lose.
    Raises `MeshError` for a budget below 100, or one too small for a mesh that cannot be decimated
    enough.
    """
    if budget < MIN_BUDGET:
        raise MeshError(f"Gaussian budget must be >= {MIN_BUDGET}, got {budget}")
    if not 0.0 <= occlusion <= 1.0:
        raise MeshError(f"occlusion must lie in 0..1, got {occlusion}")
    surface = _triangles(mesh, budget)
    v, f = surface.vertices.astype(np.float64), surface.faces
    if len(f) > 1.2 * budget:
        raise MeshError(
            f"{mesh.source or 'mesh'}: {len(f):,} faces remain after decimation, but each needs a Gaussian "
            f"of the budget of {budget:,}; raise the budget to {len(f):,} or join the mesh's loose pieces"
        )
    areas = face_areas(v, f)
    # A sliver takes as many as a broader triangle of its length: a few long Gaussians would show as spikes.
    longest = np.linalg.norm(v[f] - v[f[:, [1, 2, 0]]], axis=2).max(1)
    per_face = counts_per_face(np.maximum(areas, SLIVER * longest**2), budget, seed)
    face_ids = np.repeat(np.arange(len(f), dtype=np.int32), per_face)
    tables = {int(n): even_table(int(n)) for n in np.unique(per_face)}
    weights = np.empty((len(face_ids), 3))
    first = np.cumsum(per_face) - per_face
    for n, table in tables.items():
        rows = np.flatnonzero(per_face == n)
        weights[first[rows, None] + np.arange(n)] = table
    rotations, log_scales = _covariances(v[f], areas / per_face)
    rgba = _patch_colors(
        mesh, surface, face_ids, weights, per_face[face_ids], areas[face_ids] / per_face[face_ids]
    )
    if occlusion > 0.0 and _plain(mesh):
        light = _vertex_openness(v, f)
        rgba[:, :3] *= 1.0 - occlusion * (1.0 - np.einsum("nc,nc->n", weights, light[f[face_ids]])[:, None])
    opacity = np.clip(OPACITY * rgba[:, 3], 0.005, OPACITY)
    return BoundGaussians(
        vertices=torch.from_numpy(np.ascontiguousarray(surface.vertices, np.float32)),
        faces=torch.from_numpy(np.ascontiguousarray(f, np.int32)),
        face_ids=torch.from_numpy(face_ids),
        barycentrics=torch.from_numpy(weights.astype(np.float32)),
        rotations=torch.from_numpy(rotations[face_ids].astype(np.float32)),
        log_scales=torch.from_numpy(log_scales[face_ids].astype(np.float32)),
        opacity_logits=torch.from_numpy(np.log(opacity / (1.0 - opacity)).astype(np.float32)),
        sh=rgb_to_sh(torch.from_numpy(np.ascontiguousarray(rgba[:, None, :3], np.float32))),
    )


def vertex_colors(mesh: SurfaceMesh, bound: BoundGaussians) -> np.ndarray:
    """sRGB colours in [0, 1] of the bound mesh's vertices, float32 [V, 3], sampled on `mesh`.

    USD's displayColor is linear light: convert with `gdpro_sim.meshing.color.srgb_to_linear` there.
    """
    vertices, faces = bound.vertices.cpu().numpy(), bound.faces.cpu().numpy()
    areas = face_areas(vertices, faces)
    normals = _unit(_vertex_sums(face_normals(vertices, faces), faces, len(vertices)))
    patch = _vertex_sums(areas[:, None] / 3.0, faces, len(vertices))[:, 0]
    where, barycentric = SurfaceIndex(mesh.vertices, mesh.faces).closest(
        vertices, normals, reach=0.05 * mesh.diagonal
    )
    return SurfaceColors(mesh).at(where, barycentric, patch)[:, :3]


def _triangles(mesh: SurfaceMesh, budget: int) -> _Surface:
    """Decimate a dense mesh, subdivide a coarse one, leave the rest alone."""
    vertices, faces = mesh.vertices, mesh.faces
    decimated = len(faces) > DENSE * budget
    if decimated:
        vertices, faces = decimate(vertices, faces, max(4, int(DECIMATED * budget)))
    area = float(face_areas(vertices, faces).sum())
    edge = COARSE_EDGE * math.sqrt(4.0 / math.sqrt(3.0) * area / (budget / 6.0))
    v, f, parents, corners = _coarse(vertices, faces, edge, int(DENSE * budget))
    if len(f) != len(mesh.faces):
        logger.info(
            "%s: %d faces became %d to carry %d Gaussians", mesh.source, len(mesh.faces), len(f), budget
        )
    return _Surface(v, f, None if decimated else parents, None if decimated else corners)


def _coarse(
    vertices: np.ndarray, faces: np.ndarray, edge: float, limit: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Subdivide to `edge`, or to the shortest longer one that stays within `limit` faces."""
    for _ in range(24):
        try:
            return subdivide(vertices, faces, edge, max_faces=max(limit, len(faces)))
        except MeshError:
            edge *= 1.3
    raise MeshError(f"a mesh of {len(faces)} faces cannot be subdivided within {limit} faces")


def _covariances(corner: np.ndarray, share: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """In-plane turn [F, 2] and log scales [F, 3] of each triangle's Gaussians.

    corner [F, 3, 3] m; `share` [F] m^2, the area one Gaussian stands for. The isotropic Gaussian of an
    equilateral
    triangle goes through the affine map onto this one: C = G G^T, factored into an angle and two standard
    deviations. Neighbours on a triangular lattice of one point per `share` are sqrt(2 / sqrt(3) share) apart.
    """
    ab, ac = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    length = np.maximum(np.linalg.norm(ab, axis=1), 1e-30)
    p = np.einsum("fc,fc->f", ab, ac) / length
    q = np.linalg.norm(np.cross(ab, ac), axis=1) / length
    # Columns of the map from the equilateral triangle of unit edge: (1, 0) -> (l, 0), (1/2, sqrt(3)/2) -> (p,
    # q).
    map_xy = (2.0 * p - length) / math.sqrt(3.0)
    map_yy = 2.0 * q / math.sqrt(3.0)
    determinant = np.maximum(length * map_yy, 1e-300)
    cxx = (length**2 + map_xy**2) / determinant
    cxy = map_xy * map_yy / determinant
    cyy = map_yy**2 / determinant
    # Unit-determinant covariance: the area is put in by the spacing.
    mean, half = 0.5 * (cxx + cyy), np.hypot(0.5 * (cxx - cyy), cxy)
    major = np.sqrt(mean + half)
    angle = 0.5 * np.arctan2(2.0 * cxy, cxx - cyy)
    sigma = COVERAGE * np.sqrt(2.0 / math.sqrt(3.0) * share)
    # Slivers and crumbs: no Gaussian thinner than a tenth of the typical one, or it would alias.
    typical = float(np.median(sigma))
    wide = np.maximum(sigma * major, 0.25 * typical)
    narrow = np.maximum(sigma / major, 0.1 * typical)
    normal = FLATNESS * np.minimum(narrow, typical)
    return np.stack([np.cos(angle), np.sin(angle)], 1), np.log(np.stack([normal, wide, narrow], 1))


def _patch_colors(
    mesh: SurfaceMesh,
    surface: _Surface,
    face_ids: np.ndarray,
    weights: np.ndarray,
    per_face: np.ndarray,
    share: np.ndarray,
) -> np.ndarray:
    """Mean sRGB colour and opacity over each Gaussian's patch of its triangle; float32 [N, 4].

    Several points within the triangle, each on its own mip level, so that no colour from beyond a UV seam
    bleeds in.
    """
    colors = SurfaceColors(mesh)
    samples = PATCH_SAMPLES if colors.textured else 1
    offsets = even_table(samples) - 1.0 / 3.0
    index = SurfaceIndex(mesh.vertices, mesh.faces) if surface.parents is None else None
    normals = _unit(face_normals(surface.vertices, surface.faces))[face_ids] if index is not None else None
    # Patches the shape of the triangle around each Gaussian, pulled back inside it.
    size = 1.0 / np.sqrt(per_face)
    total = np.zeros((len(face_ids), 4), np.float64)
    vertices = surface.vertices.astype(np.float64)
    for offset in offsets:
        at = np.clip(weights + size[:, None] * offset, 0.0, None)
        at /= at.sum(1, keepdims=True)
        if index is not None:
            points = np.einsum("nc,ncd->nd", at, vertices[surface.faces[face_ids]])
            where, barycentric = index.closest(points, normals, reach=0.05 * mesh.diagonal)
        else:
            assert surface.parents is not None and surface.corners is not None
            where = surface.parents[face_ids]
            barycentric = np.einsum("nc,ncp->np", at, surface.corners[face_ids])
        total += colors.at(where, barycentric, share / samples)
    return (total / samples).astype(np.float32)


def _plain(mesh: SurfaceMesh) -> bool:
    """Neither texture nor corner colours, and one base colour."""
    textured = mesh.uv is not None and any(m.texture is not None for m in mesh.materials)
    used = {mesh.materials[i].base_color for i in np.unique(mesh.material_ids)}
    return not textured and mesh.colors is None and len(used) == 1


def _vertex_openness(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Share in [0, 1] of the surroundings that each vertex sees past what is near, [V]."""
    normals = _unit(_vertex_sums(face_normals(vertices, faces), faces, len(vertices)))
    reach = 0.3 * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    return SurfaceIndex(vertices, faces).openness(vertices, normals, reach=reach)


def _vertex_sums(values: np.ndarray, faces: np.ndarray, count: int) -> np.ndarray:
    """Sum of face values [F, C] at each vertex, [count, C]."""
    flat = faces.ravel()
    return np.stack(
        [
            np.bincount(flat, weights=np.repeat(values[:, i], 3), minlength=count)
            for i in range(values.shape[1])
        ],
        1,
    )


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-30)


__all__ = ["barycentric_table", "bind_mesh", "counts_per_face", "vertex_colors"]
