"""What particles look like: surfaces that follow them, whole or in patches that come apart.

A body that stays whole keeps its mesh: each vertex is blended from what the particles around it say. Matter
that flows or tears would stretch such a mesh across every gap. Its surface is cut into patches as wide as a
particle, each carried by one affine map, and the inside gets Gaussians of its own ("grains") that show where
it opens. PhysGaussian (Xie et al. 2024) carries Gaussians by the whole of F, which draws needles out of
matter that flows; here the map's stretch and anisotropy are bounded.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp
from scipy.spatial import cKDTree

from gdpro_sim.asset.from_splats import bind_splats
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.device import Launches
from gdpro_sim.errors import MeshError, SolverError
from gdpro_sim.gaussians import Gaussians, sh_to_rgb
from gdpro_sim.kernels.mpm_look import bound_deformations, carry_patches, carry_vertices
from gdpro_sim.meshing.fill import Filling
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.remesh import subdivide
from gdpro_sim.meshing.repair import face_normals

NEIGHBOURS = 8
"""Particles that a vertex, or a patch, is blended from."""

WHOLE_STRETCH = 8.0
"""Bound on the stretch of a surface that stays whole; past it a particle's gradient says little of its
surroundings."""

TOLERANCE = 0.75
"""How far apart two particles may take a patch before it leaves the further one, in distances between
neighbours."""

ANISOTROPY = 2.5
"""Longest over shortest stretch of a patch, at most."""

NEEDLE = 4.0
"""Longest over middle axis to which a patch may pull its Gaussians; those that are longer at rest stay so."""

PATCH_EDGE = 1.5
"""Longest edge of a triangle in a patch, in spacings."""

MOST_FACES = 1_000_000

GRAIN = 0.5
"""Standard deviation of a grain over the distance between grains: neighbours leave no gap."""

BURIED = 3.0
"""Least depth of a grain below the surface, in its standard deviations: nothing of it shows at rest."""

LEAST_GRAIN = 0.4
"""A grain that would be smaller, as a share of its full size, is left out: the surface covers its place."""

GRAIN_OPACITY = 0.95

COLOR_NEIGHBOURS = 8


class Look:
    """A surface carried by particles.

    surface:    [V, 3] float32 m, rest
    positions:  [n, 3] float32 m, rest
    patches:    [V] int32 ascending, the patch of each vertex (`unweld`), or None: the surface stays whole
    stretch:    patches: they grow to this much of their size along an axis at most, and shrink to its inverse
    anisotropy: patches: longest over shortest stretch at most, of all or of each [P], see `anisotropies`; one
                pulled longer than it is wide is cut short
    device:     where to compute; the result is the same for any number of threads

    Bit-exact at rest. Exact for affine motion, in patches within the bounds, whole up to a stretch of 8.
    """

    def __init__(
        self,
        surface: np.ndarray,
        positions: np.ndarray,
        *,
        patches: np.ndarray | None = None,
        stretch: float = 3.0,
        anisotropy: float | np.ndarray = ANISOTROPY,
        device: str = "cpu",
    ) -> None:
        if not len(positions):
            raise SolverError("a surface cannot be carried by no particle")
        most = float(np.max(anisotropy))
        if not (stretch >= 1.0 and np.min(anisotropy) >= 1.0):
            raise SolverError(f"stretch and anisotropy must be >= 1, got {stretch} and {np.min(anisotropy)}")
        self.device = device
        self._launch = Launches(device)
        self._count = len(positions)
        self._bounds = (float(stretch), most)
        if patches is None:
            self._bounds = (WHOLE_STRETCH, WHOLE_STRETCH**2)
        surface = np.ascontiguousarray(surface, np.float32)
        self._rest = self._array(positions, wp.vec3)
        self._surface = self._array(surface, wp.vec3)
        self._positions = wp.empty(self._count, dtype=wp.vec3, device=device)
        self._deformations = wp.empty(self._count, dtype=wp.mat33, device=device)
        self._gradients = wp.empty(self._count, dtype=wp.mat33, device=device)
        self._out = wp.empty(len(surface), dtype=wp.vec3, device=device)
        tree = cKDTree(np.asarray(positions, np.float64))
        self._patches: tuple[wp.array, ...] | None = None
        if patches is None:
            near, weights = _blend(tree, surface.astype(np.float64))
            self._near, self._weights = self._array(near, wp.int32), self._array(weights, wp.float32)
        else:
            count = self._attach(tree, surface.astype(np.float64), np.asarray(patches, np.int64))
            of_each = np.broadcast_to(np.asarray(anisotropy, np.float32), count)
            self._anisotropy = self._array(of_each, wp.float32)

    def surface(self, positions: np.ndarray, deformations: np.ndarray) -> np.ndarray:
        """The surface [V, 3] float32 m, with particles at `positions` [n, 3] and total deformation gradients
        `deformations` [n, 3, 3]."""
        n = self._count
        if positions.shape != (n, 3) or deformations.shape != (n, 3, 3):
            raise SolverError(
                f"a look over {n} particles got positions {positions.shape} and deformations "
                f"{deformations.shape}"
            )
        self._positions.assign(np.ascontiguousarray(positions, np.float32))
        self._deformations.assign(np.ascontiguousarray(deformations, np.float32))
        inputs = [self._deformations, *self._bounds]
        self._launch(bound_deformations, n, inputs, [self._gradients], minimum=4096)
        fixed = [self._rest, self._positions, self._gradients, self._surface]
        if self._patches is None:
            inputs = [*fixed, self._near, self._weights]
            self._launch(carry_vertices, len(self._out), inputs, [self._out])
        else:
            inputs = [*fixed, *self._patches, self._tolerance, self._bounds[0], self._anisotropy]
            self._launch(carry_patches, len(self._patches[1]), inputs, [self._out])
        return self._out.numpy().copy()

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        kind = np.int32 if dtype is wp.int32 else np.float32
        return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device=self.device)

    def _attach(self, tree: cKDTree, surface: np.ndarray, patches: np.ndarray) -> int:
        """Centre, vertices and particles of each patch; how many patches there are."""
        if len(patches) != len(surface) or (np.diff(patches) < 0).any():
            raise SolverError(f"patches must be ascending numbers of {len(surface)} vertices")
        starts = np.concatenate([[0], np.flatnonzero(np.diff(patches)) + 1, [len(patches)]])
        sizes = np.diff(starts)
        centres = np.add.reduceat(surface, starts[:-1]) / sizes[:, None]
        near, weights = _blend(tree, centres)
        # A grain lies on its particle, and needs no other.
        distance = np.linalg.norm(tree.data[near[:, 0]] - centres, axis=1)
        spread = np.sqrt(
            np.maximum.reduceat(((surface - np.repeat(centres, sizes, 0)) ** 2).sum(1), starts[:-1])
        )
        use = np.ones(near.shape, bool)
        use[distance < 1e-3 * spread, 1:] = False
        offsets = np.concatenate([[0], np.cumsum(use.sum(1))])
        self._patches = (
            self._array(starts, wp.int32),
            self._array(centres, wp.vec3),
            self._array(offsets, wp.int32),
            self._array(near[use], wp.int32),
            self._array(weights[use], wp.float32),
        )
        count = min(self._count, 20_000)
        own = tree.query(tree.data[:: max(self._count // count, 1)], k=2)[0][:, -1]
        self._tolerance = TOLERANCE * float(np.median(own)) if self._count > 1 else 1.0
        return len(centres)


def anisotropies(bound: BoundGaussians, patches: np.ndarray) -> np.ndarray:
    """[P] float32, how much longer than wide a patch may be pulled before one of its Gaussians is a needle.

    patches: [V] int32 ascending, the patch of each vertex
    """
    scales = np.sort(bound.log_scales.detach().cpu().exp().numpy(), axis=1)
    length = scales[:, 2] / np.maximum(scales[:, 1], 1e-30)
    patch = np.unique(patches, return_inverse=True)[1]
    longest = np.ones(int(patch[-1]) + 1)
    corner = bound.faces.cpu().numpy()[bound.face_ids.cpu().numpy(), 0]
    np.maximum.at(longest, patch[corner], length)
    return np.clip(NEEDLE / longest, 1.0, ANISOTROPY).astype(np.float32)


def _blend(tree: cKDTree, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The nearest particles of each point [M, K], nearest first, and weights that sum to 1.

    A weight falls to zero where the next particle would come in, so that it varies evenly along a surface.
    """
    count = min(NEIGHBOURS, tree.n)
    distance, near = tree.query(points, k=np.arange(1, min(NEIGHBOURS + 1, tree.n) + 1))
    reach = distance[:, -1:] * (1.0 + 1e-6) + 1e-30
    weights = np.maximum(1.0 - (distance[:, :count] / reach) ** 2, 0.0) ** 2 + 1e-9
    return near[:, :count], weights / weights.sum(1, keepdims=True)


@dataclass(frozen=True)
class Unwelded:
    """Bound Gaussians on a surface in patches, with grains inside.

    gaussians:     the same Gaussians as before on triangles that share vertices within a patch only, then one
                   triangle and Gaussian for each grain
    patches:       [V] int32 ascending, the patch of each vertex
    vertex_colors: [V, 3] float32 sRGB, or None where none were given
    grains:        how many of the last triangles and Gaussians are grains
    """

    gaussians: BoundGaussians
    patches: np.ndarray
    vertex_colors: np.ndarray | None
    grains: int


def unweld(
    bound: BoundGaussians,
    filling: Filling,
    *,
    vertex_colors: np.ndarray | None = None,
    grains: int = 50_000,
) -> Unwelded:
    """Cut the surface of `bound` into patches around the particles of `filling`, and put grains inside.

    Both in one frame. Triangles longer than 1.5 spacings are split first, and their Gaussians go to the parts
    they lie on; at rest the Gaussians stay where they were. A grain is a round Gaussian at a particle, with
    the colour of the surface Gaussians around it; there are at most about `grains`, so that a body of more
    particles has larger ones. One takes about 250 bytes of memory, and 120 in each frame of a file. Raises
    MeshError for a surface that would need a million triangles.
    """
    device = bound.device
    bound = bound.to("cpu")
    parts = _refine(bound, filling.spacing, vertex_colors)
    centroids = parts.vertices[parts.faces].mean(1)
    tree = cKDTree(filling.points.astype(np.float64))
    labels = np.unique(tree.query(centroids)[1], return_inverse=True)[1]
    keys = np.repeat(labels, 3) * len(parts.vertices) + parts.faces.ravel()
    unique, corners = np.unique(keys, return_inverse=True)
    source = unique % len(parts.vertices)
    patches = (unique // len(parts.vertices)).astype(np.int32)
    vertices, faces = parts.vertices[source], corners.reshape(-1, 3)
    colors = None if parts.colors is None else parts.colors[source]
    surface = BoundGaussians(
        torch.from_numpy(vertices.astype(np.float32)),
        torch.from_numpy(faces.astype(np.int32)),
        torch.from_numpy(parts.face_ids.astype(np.int32)),
        torch.from_numpy(parts.barycentrics.astype(np.float32)),
        torch.from_numpy(parts.rotations.astype(np.float32)),
        bound.log_scales.detach(),
        bound.opacity_logits.detach(),
        bound.sh.detach(),
    )
    inside = _grains(bound, filling, grains)
    if inside is None:
        return Unwelded(surface.to(device), patches, colors, 0)
    count = len(inside)
    first = int(patches[-1]) + 1 if len(patches) else 0
    patches = np.concatenate([patches, np.repeat(np.arange(first, first + count, dtype=np.int32), 3)])
    if colors is not None:
        own = sh_to_rgb(inside.sh[:, 0]).clamp(0.0, 1.0).numpy().astype(np.float32)
        colors = np.concatenate([colors, np.repeat(own, 3, axis=0)])
    return Unwelded(_join(surface, inside).to(device), patches, colors, count)


def _join(a: BoundGaussians, b: BoundGaussians) -> BoundGaussians:
    """Both, as one."""
    return BoundGaussians(
        torch.cat([a.vertices.detach(), b.vertices]),
        torch.cat([a.faces, b.faces + len(a.vertices)]),
        torch.cat([a.face_ids, b.face_ids + len(a.faces)]),
        *(
            torch.cat([getattr(a, name), getattr(b, name)])
            for name in ("barycentrics", "rotations", "log_scales", "opacity_logits", "sh")
        ),
    )


@dataclass(frozen=True)
class _Parts:
    """A surface split into short triangles: arrays as of `BoundGaussians`, colours as of `Unwelded`."""

    vertices: np.ndarray
    faces: np.ndarray
    face_ids: np.ndarray
    barycentrics: np.ndarray
    rotations: np.ndarray
    colors: np.ndarray | None


def _refine(bound: BoundGaussians, spacing: float, colors: np.ndarray | None) -> _Parts:
    """Split long triangles; their Gaussians keep place and axes, told in the part's frame."""
    vertices, faces = bound.vertices.detach().numpy(), bound.faces.numpy()
    face_ids, rotations = bound.face_ids.numpy(), bound.rotations.detach().numpy()
    barycentrics = bound.barycentrics.numpy()
    try:
        v, f, parents, corners = subdivide(vertices, faces, PATCH_EDGE * spacing, max_faces=MOST_FACES)
    except MeshError as error:
        raise MeshError(
            f"particles {spacing:.3g} m apart would cut the surface into more than {MOST_FACES:,} triangles; "
            "use fewer particles"
        ) from error
    if colors is not None:
        mixed = np.empty((len(v), 3), np.float32)
        mixed[f] = np.einsum("fcp,fpd->fcd", corners, colors[faces[parents]])
        mixed[: len(vertices)] = colors
        colors = mixed
    order = np.argsort(parents, kind="stable")
    counts = np.bincount(parents, minlength=len(faces))
    begins = np.cumsum(counts) - counts
    whole = counts[face_ids] == 1
    part = order[begins[face_ids]]
    barycentrics, rotations = barycentrics.copy(), rotations.copy()
    rows = np.flatnonzero(~whole)
    who = np.repeat(rows, counts[face_ids[rows]])
    step = np.arange(len(who)) - np.repeat(np.cumsum(counts[face_ids[rows]]) - counts[face_ids[rows]],
                                           counts[face_ids[rows]])  # fmt: skip
    options = order[begins[face_ids[who]] + step]
    inverse = np.linalg.inv(corners.astype(np.float64))
    weights = np.einsum("np,npc->nc", bound.barycentrics.numpy()[who].astype(np.float64), inverse[options])
    best = np.lexsort((weights.min(1), who))  # the last of each Gaussian is the deepest
    part[who[best]] = options[best]
    barycentrics[who[best]] = weights[best]
    # The axis that the complex number stands for, seen from the part's first edge.
    along, across = _plane(vertices, faces[face_ids[rows]])
    axis = along * rotations[rows, :1] + across * rotations[rows, 1:]
    along, across = _plane(v, f[part[rows]])
    rotations[rows] = np.stack([(axis * along).sum(1), (axis * across).sum(1)], 1)
    return _Parts(v, f, part, barycentrics, rotations, colors)


def _plane(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Unit vectors [M, 3] along each triangle's first edge and across it, in its plane."""
    corner = vertices.astype(np.float64)[faces]
    along = corner[:, 1] - corner[:, 0]
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-300)
    normal = face_normals(vertices, faces)
    across = np.cross(normal, along)
    return along, across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)


def _grains(bound: BoundGaussians, filling: Filling, most: int) -> BoundGaussians | None:
    """Round Gaussians at particles below the surface, bound; None where there is room for none."""
    points = filling.points.astype(np.float64)
    spacing = filling.spacing
    chosen = _thinned(points, spacing, most)
    spacing *= max(len(points) / max(len(chosen), 1), 1.0) ** (1.0 / 3.0)
    index = SurfaceIndex(bound.vertices.detach().numpy(), bound.faces.numpy())
    face, weights = index.closest(points[chosen])
    corner = bound.vertices.detach().numpy().astype(np.float64)[bound.faces.numpy()[face]]
    depth = np.linalg.norm(np.einsum("nc,ncd->nd", weights, corner) - points[chosen], axis=1)
    sigma = np.minimum(GRAIN * spacing, depth / BURIED)
    keep = sigma >= LEAST_GRAIN * GRAIN * spacing
    if not keep.any():
        return None
    chosen, sigma = chosen[keep], sigma[keep]
    normals = face_normals(bound.vertices.detach().numpy(), bound.faces.numpy())[face[keep]]
    sh = torch.zeros((len(chosen), bound.sh.shape[1], 3))
    sh[:, 0] = colors_around(bound, points[chosen], spacing)
    return bind_splats(
        Gaussians(
            torch.from_numpy(filling.points[chosen]),
            torch.from_numpy(_facing(normals).astype(np.float32)),
            torch.from_numpy(np.repeat(sigma[:, None], 3, 1).astype(np.float32)),
            torch.full((len(chosen),), GRAIN_OPACITY),
            sh,
        )
    )


def colors_around(bound: BoundGaussians, points: np.ndarray, spacing: float) -> torch.Tensor:
    """Harmonics of degree 0, [n, 3] float32, of the Gaussians nearest to `points` [n, 3] m, mixed.

    They count by opacity and by the inverse square of their distance, down to a thousandth of `spacing`.
    """
    splats = bound.to("cpu").gaussians()
    near = min(COLOR_NEIGHBOURS, len(splats))
    distance, who = cKDTree(splats.means.double().numpy()).query(points, k=np.arange(1, near + 1))
    mix = splats.opacities.double().numpy()[who] / np.maximum(distance, 1e-3 * spacing) ** 2
    mixed = np.einsum("nk,nkc->nc", mix / mix.sum(1, keepdims=True), splats.sh[:, 0].double().numpy()[who])
    return torch.from_numpy(mixed.astype(np.float32))


def _thinned(points: np.ndarray, spacing: float, most: int) -> np.ndarray:
    """Numbers of at most about `most` points, evenly spread: the one nearest to the centre of each cell."""
    if len(points) <= most:
        return np.arange(len(points))
    cell = spacing * (len(points) / max(most, 1)) ** (1.0 / 3.0)
    where = np.floor(points / cell)
    off = np.linalg.norm(points / cell - where - 0.5, axis=1)
    order = np.lexsort((off, *where.T))
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(where[order], axis=0) != 0).any(1)
    return np.sort(order[first])


def _facing(normals: np.ndarray) -> np.ndarray:
    """Quaternions [N, 4] wxyz that turn the first axis to `normals` [N, 3]; any where that has no length."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    n = np.where(length > 0.0, normals / np.maximum(length, 1e-300), (1.0, 0.0, 0.0))
    quats = np.stack([1.0 + n[:, 0], np.zeros(len(n)), -n[:, 2], n[:, 1]], 1)
    quats[n[:, 0] < -1.0 + 1e-9] = (0.0, 0.0, 1.0, 0.0)
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


__all__ = ["Look", "Unwelded", "anisotropies", "colors_around", "unweld"]
