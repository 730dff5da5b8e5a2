"""Gaussians bound to a triangle mesh: the asset's shape, and how it follows deformed vertices.

Binding after GaussianDreamerPro (arXiv 2406.18462): a Gaussian sits at frozen barycentric weights of one
triangle; its rotation is the triangle's frame turned in its plane by a learned complex number. The moved
triangle's affine map F carries the covariance (F S F^T) and the rotation part of F turns the spherical
harmonics.
"""

from __future__ import annotations

import functools
import math
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import torch
import warp as wp
from torch.autograd.function import once_differentiable

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import SH_C0, Gaussians
from gdpro_sim.kernels.binding import bind_triangles_backward, follow_triangles, gather_corners


@dataclass(frozen=True)
class BoundGaussians:
    """N Gaussians on a triangle mesh; every tensor lives on one device.

    vertices:       [V, 3] float32 m, rest positions
    faces:          [F, 3] int32, counter-clockwise seen from outside
    face_ids:       [N] int32, the triangle each Gaussian rides
    barycentrics:   [N, 3] float32, frozen weights, rows sum to 1
    rotations:      [N, 2] float32, complex number (x, y); R = [e0, x e1 + y e2, -y e1 + x e2] after
                    normalisation, e0 the unit normal, e1 along v1 - v0, e2 = e0 x e1
    log_scales:     [N, 3] float32, log standard deviations in m: along the normal, then the two in-plane axes
    opacity_logits: [N] float32
    sh:             [N, K, 3] float32, K in {1, 4, 9, 16}
    """

    vertices: torch.Tensor
    faces: torch.Tensor
    face_ids: torch.Tensor
    barycentrics: torch.Tensor
    rotations: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor

    def __len__(self) -> int:
        return int(self.face_ids.shape[0])

    @property
    def device(self) -> torch.device:
        return self.vertices.device

    @property
    def is_loose(self) -> bool:
        """Whether no two triangles share a vertex: a cloud that had no mesh, or a body cut up."""
        return len(self.faces) > 3 and int(self.faces.unique().numel()) == self.faces.numel()

    def to(self, device: str | torch.device) -> BoundGaussians:
        """The same Gaussians with every tensor on `device`."""
        return replace(self, **{f.name: getattr(self, f.name).to(device) for f in fields(self)})

    def scaled(self, factor: float) -> BoundGaussians:
        """Uniformly resized by `factor` > 0, thickness included."""
        if not (math.isfinite(factor) and factor > 0.0):
            raise AssetError(f"scale must be a finite number > 0, got {factor}")
        return replace(self, vertices=self.vertices * factor, log_scales=self.log_scales + math.log(factor))

    def gaussians(self, vertices: torch.Tensor | None = None, *, rotate_sh: bool = True) -> Gaussians:
        """Gaussians carried by `vertices` [V, 3] float32 m (default: the rest vertices).

        The rest vertices give the rest Gaussians back bit for bit; a rigid motion moves them rigidly.
        With `rotate_sh` False the colours keep their rest directions (cheaper, and exact at degree 0).
        Raises AssetError for a wrong shape or dtype. Not differentiable.
        """
        moved = self.vertices if vertices is None else vertices
        if moved.shape != self.vertices.shape or moved.dtype != torch.float32:
            raise AssetError(
                f"vertices must be float32 {list(self.vertices.shape)} like the asset's mesh, "
                f"got {moved.dtype} {list(moved.shape)}"
            )
        n = len(self)
        device = self.device
        moved = moved.detach().to(device).contiguous()
        means = torch.empty((n, 3), dtype=torch.float32, device=device)
        quats = torch.empty((n, 4), dtype=torch.float32, device=device)
        scales = torch.empty((n, 3), dtype=torch.float32, device=device)
        degree = math.isqrt(self.sh.shape[1]) - 1 if rotate_sh else 0
        sh = torch.empty_like(self.sh) if degree > 0 else self.sh
        if n > 0:
            name = device_name(moved)
            directions, inverse = _sh_rotation_tables(degree, name)
            rest_sh = wp.from_torch(self.sh.detach().contiguous(), dtype=wp.vec3)
            with beside_torch(moved):
                launch_chunked(
                    follow_triangles,
                    n,
                    [
                        wp.from_torch(self.vertices.detach().contiguous(), dtype=wp.vec3),
                        wp.from_torch(moved, dtype=wp.vec3),
                        wp.from_torch(self.faces.contiguous()),
                        wp.from_torch(self.face_ids.contiguous()),
                        wp.from_torch(self.barycentrics.contiguous(), dtype=wp.vec3),
                        wp.from_torch(self.rotations.detach().contiguous(), dtype=wp.vec2),
                        wp.from_torch(self.log_scales.detach().contiguous(), dtype=wp.vec3),
                        rest_sh,
                        directions,
                        inverse,
                        degree,
                    ],
                    [
                        wp.from_torch(means, dtype=wp.vec3),
                        wp.from_torch(quats, dtype=wp.vec4),
                        wp.from_torch(scales, dtype=wp.vec3),
                        wp.from_torch(sh, dtype=wp.vec3) if degree > 0 else rest_sh,
                    ],
                    device=name,
                    minimum=4096,
                )
        return Gaussians(means, quats, scales, torch.sigmoid(self.opacity_logits.detach()), sh.detach())

    def normals(self, vertices: torch.Tensor | None = None) -> torch.Tensor:
        """Unit normals at each Gaussian, [N, 3]; see `surface_normals`.

        Vertices that coincide at rest, along cuts of the mesh, count as one: cuts do not show while closed.
        """
        v = self.vertices if vertices is None else vertices.to(self.device)
        return surface_normals(v, self.faces, self.face_ids, self.barycentrics, self.welded)

    @functools.cached_property
    def welded(self) -> torch.Tensor | None:
        """One vertex for each, [V] int64, the same for those that coincide at rest; None where none do."""
        rows = np.ascontiguousarray(self.vertices.detach().cpu().numpy()).view(np.dtype((np.void, 12)))
        _, first, inverse = np.unique(rows.ravel(), return_index=True, return_inverse=True)
        if len(first) == len(rows):
            return None
        return torch.from_numpy(first[inverse]).to(self.device)


class TriangleBinding:
    """Where Gaussians ride on triangles, for learning: a differentiable map from vertices to Gaussians.

    faces [F, 3] int32, face_ids [N] int32 in [0, F), barycentrics [N, 3] float32, as in `BoundGaussians`; all
    on one device. `vertex_count` is V.
    """

    def __init__(
        self, faces: torch.Tensor, face_ids: torch.Tensor, barycentrics: torch.Tensor, vertex_count: int
    ) -> None:
        self.faces, self.face_ids = faces.contiguous(), face_ids.contiguous()
        self.barycentrics = barycentrics.contiguous()
        self.vertex_count = vertex_count
        self.order, self.offsets = _groups(self.face_ids, len(faces))
        self.corners, self.corner_offsets = _groups(self.faces.view(-1), vertex_count)

    def __call__(
        self, vertices: torch.Tensor, rotations: torch.Tensor, log_scales: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Means [N, 3], unit quaternions [N, 4] and scales [N, 3] of Gaussians on `vertices` [V, 3] m.

        rotations [N, 2] and log_scales [N, 3] as in `BoundGaussians`, whose `gaussians()` gives the same
        bits. Gradients reach all three; through the frame of a triangle without area none does.
        """
        return _Bind.apply(vertices.contiguous(), rotations.contiguous(), log_scales.contiguous(), self)


class _Bind(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any,
        vertices: torch.Tensor,
        rotations: torch.Tensor,
        log_scales: torch.Tensor,
        binding: TriangleBinding,
    ) -> tuple[torch.Tensor, ...]:
        n = len(binding.face_ids)
        bound = BoundGaussians(
            vertices,
            binding.faces,
            binding.face_ids,
            binding.barycentrics,
            rotations,
            log_scales,
            opacity_logits=vertices.new_zeros(n),
            sh=vertices.new_zeros((n, 1, 3)),
        )
        at = bound.gaussians()
        ctx.save_for_backward(vertices, rotations, at.quats, at.scales)
        ctx.binding = binding
        return at.means, at.quats, at.scales

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        vertices, rotations, quats, scales = (t.detach() for t in ctx.saved_tensors)
        binding: TriangleBinding = ctx.binding
        faces, device = binding.faces, device_name(vertices)
        g_corners = vertices.new_empty((len(faces), 3, 3))
        g_vertices = torch.empty_like(vertices)
        # A Gaussian's gradients are written with its face's; every Gaussian has a face.
        g_rotations, g_log_scales = torch.empty_like(rotations), torch.empty_like(scales)
        g_means, g_quats, g_scales = (g.contiguous() for g in gradients)
        with beside_torch(vertices):
            launch_chunked(
                bind_triangles_backward,
                len(faces),
                [
                    wp.from_torch(vertices, dtype=wp.vec3),
                    wp.from_torch(faces),
                    wp.from_torch(binding.offsets),
                    wp.from_torch(binding.order),
                    wp.from_torch(binding.barycentrics, dtype=wp.vec3),
                    wp.from_torch(rotations, dtype=wp.vec2),
                    wp.from_torch(quats, dtype=wp.vec4),
                    wp.from_torch(scales, dtype=wp.vec3),
                    wp.from_torch(g_means, dtype=wp.vec3),
                    wp.from_torch(g_quats, dtype=wp.vec4),
                    wp.from_torch(g_scales, dtype=wp.vec3),
                ],
                [
                    wp.from_torch(g_corners, dtype=wp.vec3),
                    wp.from_torch(g_rotations, dtype=wp.vec2),
                    wp.from_torch(g_log_scales, dtype=wp.vec3),
                ],
                device=device,
                minimum=512,
            )
            launch_chunked(
                gather_corners,
                len(vertices),
                [
                    wp.from_torch(binding.corner_offsets),
                    wp.from_torch(binding.corners),
                    wp.from_torch(g_corners.view(-1, 3), dtype=wp.vec3),
                ],
                [wp.from_torch(g_vertices, dtype=wp.vec3)],
                device=device,
            )
        return g_vertices, g_rotations, g_log_scales, None


def _groups(owners: torch.Tensor, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Indices sorted by owner [M] int32 and where each owner's begin [count + 1] int32."""
    order = torch.argsort(owners, stable=True).int()
    sizes = torch.bincount(owners.long(), minlength=count)
    return order, torch.nn.functional.pad(sizes.cumsum(0), (1, 0)).int()


def surface_normals(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    face_ids: torch.Tensor,
    barycentrics: torch.Tensor,
    welded: torch.Tensor | None = None,
) -> torch.Tensor:
    """Unit normals [N, 3] at points of a mesh: vertex normals interpolated, face normals along sharp edges.

    A corner whose vertex normal leaves the face's by 45 degrees or more counts as sharp, by less than 25 as
    smooth; in between the two are mixed, so that nothing jumps while a body deforms. `welded` as in
    `vertex_normals`.
    """
    per_vertex, per_face = vertex_normals(vertices, faces, welded), face_normals(vertices, faces)
    corners = per_vertex[faces.long()]
    cosine = (corners * per_face[:, None]).sum(2, keepdim=True)
    smooth = ((cosine - 0.7072) / 0.2).clamp(0.0, 1.0)
    corners = (per_face[:, None] + smooth * (corners - per_face[:, None]))[face_ids.long()]
    return torch.nn.functional.normalize((corners * barycentrics[:, :, None]).sum(1), dim=1)


def face_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Unit face normals, [F, 3]; zero for a face without area."""
    corners = vertices[faces.long()]
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return torch.nn.functional.normalize(normals, dim=1, eps=1e-30)


def vertex_normals(
    vertices: torch.Tensor, faces: torch.Tensor, welded: torch.Tensor | None = None
) -> torch.Tensor:
    """Unit vertex normals [V, 3]: face normals weighted by their angle at the vertex; zero without area.

    Vertices with the same number in `welded` [V], numbers of vertices, share the faces around all of them.
    Angle weights do not depend on how a flat region is cut into triangles (Thuermer & Wuethrich, Journal of
    Graphics Tools 3(1), 1998).
    """
    corners = vertices.double()[faces.long()]
    normals = face_normals(vertices.double(), faces)
    owners = faces.long() if welded is None else welded[faces.long()]
    total = torch.zeros((3, len(vertices)), dtype=torch.float64, device=vertices.device)
    for k in range(3):
        a = torch.nn.functional.normalize(corners[:, (k + 1) % 3] - corners[:, k], dim=1, eps=1e-300)
        b = torch.nn.functional.normalize(corners[:, (k + 2) % 3] - corners[:, k], dim=1, eps=1e-300)
        angle = torch.acos((a * b).sum(1).clamp(-1.0, 1.0))
        for axis in range(3):
            # on a CPU bincount adds up faster than index_add_
            total[axis] += torch.bincount(owners[:, k], angle * normals[:, axis], len(vertices))
    unit = torch.nn.functional.normalize(total.T, dim=1, eps=1e-300).to(vertices.dtype)
    return unit if welded is None else unit[welded]


@functools.cache
def _sh_rotation_tables(degree: int, device: str) -> tuple[wp.array, wp.array]:
    """K = (degree + 1)^2 sampling directions and the inverse of the basis matrix there, [K, K]."""
    count = (degree + 1) ** 2
    generator = np.random.default_rng(7)
    best = math.inf
    for _ in range(300):
        candidate = generator.normal(size=(count, 3))
        candidate /= np.linalg.norm(candidate, axis=1, keepdims=True)
        basis = sh_basis(degree, candidate)
        condition = float(np.linalg.cond(basis))
        if condition < best:
            best, directions, inverse = condition, candidate, np.linalg.inv(basis)
    return (
        wp.array(directions.astype(np.float32), dtype=wp.vec3, device=device),
        wp.array(inverse.astype(np.float32), dtype=float, device=device),
    )


def sh_basis(degree: int, directions: np.ndarray) -> np.ndarray:
    """Real spherical harmonics up to `degree` <= 3 at unit directions [M, 3]; [M, (degree + 1)^2] float64.

    Order and signs of 3D Gaussian Splatting (Condon-Shortley phase).
    """
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    bands = [
        [np.full_like(x, SH_C0)],
        [-0.4886025119029199 * y, 0.4886025119029199 * z, -0.4886025119029199 * x],
        [
            1.0925484305920792 * x * y,
            -1.0925484305920792 * y * z,
            0.31539156525252005 * (2.0 * zz - xx - yy),
            -1.0925484305920792 * x * z,
            0.5462742152960396 * (xx - yy),
        ],
        [
            -0.5900435899266435 * y * (3.0 * xx - yy),
            2.890611442640554 * x * y * z,
            -0.4570457994644658 * y * (4.0 * zz - xx - yy),
            0.3731763325901154 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
            -0.4570457994644658 * x * (4.0 * zz - xx - yy),
            1.445305721320277 * z * (xx - yy),
            -0.5900435899266435 * x * (xx - 3.0 * yy),
        ],
    ]
    return np.stack([values for band in bands[: degree + 1] for values in band], axis=1)


__all__ = [
    "BoundGaussians",
    "TriangleBinding",
    "face_normals",
    "sh_basis",
    "surface_normals",
    "vertex_normals",
]
