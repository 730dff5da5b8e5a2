"""Pictures to compare with: of a mesh, of Gaussians, and depth as an image.

Colours are plain sRGB-encoded albedo: no light is put on them.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import warp as wp

from gdpro_sim.binding import face_normals, vertex_normals
from gdpro_sim.cameras import Cameras
from gdpro_sim.device import beside_torch, launch_chunked, resolve_device, thread_count
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.protocols import ImageKind
from gdpro_sim.kernels import rasterize, raycast
from gdpro_sim.meshing.color import SurfaceColors, Texture
from gdpro_sim.meshing.repair import face_areas
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.splatting import rasterization

FLOOR = 0.1
"""Disparity of the farthest point of the object: above the 0 of nothing."""

CLEAR = 0.05
"""Least distance of a camera from the sphere around a mesh that is drawn by a z-buffer."""

SMOOTH = 0.8
"""Cosine between a face's and a vertex's normal above which the edge between them is drawn round."""


@dataclass(frozen=True)
class Renders:
    """What C cameras see.

    rgb:     [C, H, W, 3] in [0, 1], colour times opacity: over black
    alphas:  [C, H, W, 1] in [0, 1]
    depths:  [C, H, W, 1] mean z of what is seen, weighted by opacity; 0 where nothing is
    normals: [C, H, W, 3] unit, in the world, towards the camera, zero where nothing is; None: not drawn
    """

    cameras: Cameras
    rgb: torch.Tensor
    alphas: torch.Tensor
    depths: torch.Tensor
    normals: torch.Tensor | None = None

    def over(self, backgrounds: torch.Tensor) -> torch.Tensor:
        """The pictures over plain backgrounds [C, 3]; [C, H, W, 3]."""
        return self.rgb + (1.0 - self.alphas) * backgrounds.to(self.rgb)[:, None, None]

    def image(self, kind: ImageKind, backgrounds: torch.Tensor) -> torch.Tensor:
        """Colours over `backgrounds` [C, 3], or disparity (over black always); [C, H, W, 3]."""
        if kind == "rgb":
            return self.over(backgrounds)
        return disparity(self.depths, self.alphas, self.cameras)


def disparity(depths: torch.Tensor, alphas: torch.Tensor, cameras: Cameras) -> torch.Tensor:
    """Depth as a grey picture [C, H, W, 3]: 1 at the near end of the unit sphere, 0.1 at the far one.

    alphas (0.1 + 0.9 (far - z) / (far - near)), the fraction clamped to [0, 1], with near and far one unit
    before and behind the origin's distance; 0 where nothing is. depths, alphas: [C, H, W, 1]; depths are
    expected z, not times alpha. Differentiable in both.
    """
    distance = torch.linalg.norm(cameras.positions.to(depths), dim=1)[:, None, None, None]
    share = ((distance + 1.0 - depths) / 2.0).clamp(0.0, 1.0)
    return (alphas * (FLOOR + (1.0 - FLOOR) * share)).expand(*depths.shape[:-1], 3)


class MeshRenderer:
    """Draws a coloured mesh from any camera; made once, drawn often.

    mesh: in the unit frame. Both sides of a face show; where a colour's or a cutout texture's alpha is below
    1, what lies behind shows through. device: "auto", "cpu" or a CUDA device; pictures lie there.

    On a CPU an opaque mesh goes through a z-buffer, unless a camera is within the sphere around it; else rays
    are cast. Both take the same samples.
    """

    def __init__(self, mesh: SurfaceMesh, *, device: str = "cpu", normals: bool = False) -> None:
        self.device = resolve_device(device)
        self._mesh = wp.Mesh(
            points=wp.array(mesh.vertices, dtype=wp.vec3, device=self.device),
            indices=wp.array(mesh.faces.ravel(), dtype=wp.int32, device=self.device),
        )
        self._normals = normals
        colors = _plain_colors(mesh)
        surface = raycast.Surface()
        surface.mesh = self._mesh.id
        surface.corner_colors = self._array(colors, wp.vec4)
        surface.corner_normals = self._array(
            corner_normals(mesh).reshape(-1, 3) if normals else np.zeros((0, 3)), wp.vec3
        )
        self._add_textures(surface, mesh)
        self._surface = surface
        cutout = any(m.cutout and m.texture is not None for m in mesh.materials)
        self._opaque = bool((colors[:, 3] == 1.0).all()) and not (cutout and mesh.uv is not None)
        self._reach = float(np.linalg.norm(mesh.vertices, axis=1).max())
        wp.synchronize_device(self.device)  # pictures may be drawn on another stream

    def render(self, cameras: Cameras, rays: int = 2) -> Renders:
        """Pictures from C cameras, each pixel the mean of `rays` x `rays` samples."""
        count, width, height = len(cameras), cameras.width, cameras.height
        on = torch.device(self.device)

        def empty(*channels: int) -> torch.Tensor:
            return torch.empty((count, height, width, *channels), dtype=torch.float32, device=on)

        rgb, alphas, depths = empty(3), empty(1), empty(1)
        normals = empty(3) if self._normals else None
        outputs = [
            wp.from_torch(rgb.view(-1, 3), dtype=wp.vec3),
            wp.from_torch(alphas.view(-1)),
            wp.from_torch(depths.view(-1)),
            None if normals is None else wp.from_torch(normals.view(-1, 3), dtype=wp.vec3),
        ]
        outside = float(cameras.positions.norm(dim=1).min()) > self._reach + CLEAR
        with beside_torch(rgb):
            if self.device == "cpu" and self._opaque and outside:
                self._rasterize(cameras, rays, outputs)
            else:
                self._cast(cameras, rays, outputs)
        if normals is not None:
            normals = torch.nn.functional.normalize(normals, dim=-1)
        return Renders(cameras, rgb, alphas, depths, normals)

    def _cast(self, cameras: Cameras, rays: int, outputs: list[Any]) -> None:
        width, height = cameras.width, cameras.height
        eyes, rotations, _, inverses = self._views(cameras)
        launch_chunked(
            raycast.draw_surface,
            len(cameras) * height * width,
            [self._surface, eyes, rotations, inverses, width, height, rays],
            outputs,
            device=self.device,
            minimum=512,
        )

    def _rasterize(self, cameras: Cameras, rays: int, outputs: list[Any]) -> None:
        count, width, height = len(cameras), cameras.width, cameras.height
        vertices, faces = self._mesh.points, self._mesh.indices
        samples = count * height * width * rays * rays
        projected = wp.empty(count * len(vertices), dtype=wp.vec3, device=self.device)
        nearest = wp.zeros(samples, dtype=wp.float32, device=self.device)
        face = wp.full(samples, -1, dtype=wp.int32, device=self.device)
        eyes, rotations, ks, inverses = self._views(cameras)
        bands = -(-thread_count() // count)
        for kernel, size, minimum, inputs, written in (
            (
                rasterize.project_vertices,
                len(projected),
                8192,
                [vertices, eyes, rotations, ks, rays],
                [projected],
            ),
            (
                rasterize.draw_faces,
                count * bands,
                1,
                [projected, faces, len(vertices), width * rays, height * rays, bands],
                [nearest, face],
            ),
            (
                rasterize.shade,
                count * height * width,
                2048,
                [
                    self._surface,
                    projected,
                    faces,
                    len(vertices),
                    inverses,
                    width,
                    height,
                    rays,
                    nearest,
                    face,
                ],
                outputs,
            ),
        ):
            launch_chunked(kernel, size, inputs, written, device=self.device, minimum=minimum)

    def _views(self, cameras: Cameras) -> tuple[Any, Any, Any, Any]:
        """Eyes, rotations, intrinsics and their inverses as Warp arrays."""
        ks = cameras.Ks.double().cpu().numpy()
        return (
            self._array(cameras.positions.cpu().numpy(), wp.vec3),
            self._array(cameras.viewmats[:, :3, :3].cpu().numpy(), wp.mat33),
            self._array(ks, wp.mat33),
            self._array(np.linalg.inv(ks), wp.mat33),
        )

    def _array(self, values: np.ndarray, dtype: Any) -> Any:
        kind = {wp.int32: np.int32, wp.vec3i: np.int32, wp.vec4ub: np.uint8}.get(dtype, np.float32)
        return wp.array(np.ascontiguousarray(values, kind), dtype=dtype, device=self.device)

    def _add_textures(self, surface: Any, mesh: SurfaceMesh) -> None:
        """Every texture's mip levels one after the other, and where each face finds its own."""
        images: dict[int, tuple[int, int]] = {}  # first level and how many, by the texture's identity
        levels: list[tuple[int, int, int]] = []
        texels: list[np.ndarray] = []
        materials = []
        for material in mesh.materials:
            first, count = -1, 0
            if material.texture is not None and mesh.uv is not None:
                key = id(material.texture)
                if key not in images:
                    pyramid = Texture(material.texture).levels()
                    images[key] = len(levels), len(pyramid)
                    for image in pyramid:
                        levels.append((sum(len(t) for t in texels), image.shape[1], image.shape[0]))
                        texels.append(image.reshape(-1, 4))
                first, count = images[key]
            materials.append((first, count, int(material.cutout)))
        if not texels or mesh.uv is None:
            return
        per_face = np.asarray(materials, np.int32)[mesh.material_ids]
        sizes = np.asarray(
            [levels[first][1] * levels[first][2] if first >= 0 else 0 for first, *_ in materials]
        )
        edges = mesh.uv[:, 1:].astype(np.float64) - mesh.uv[:, :1]
        uv_area = 0.5 * np.abs(edges[:, 0, 0] * edges[:, 1, 1] - edges[:, 0, 1] * edges[:, 1, 0])
        area = np.maximum(face_areas(mesh.vertices, mesh.faces), 1e-30)
        surface.first_levels = self._array(per_face[:, 0], wp.int32)
        surface.level_counts = self._array(per_face[:, 1], wp.int32)
        surface.cutouts = self._array(per_face[:, 2], wp.int32)
        surface.densities = self._array(uv_area * sizes[mesh.material_ids] / area, wp.float32)
        surface.uvs = self._array(mesh.uv.reshape(-1, 2), wp.vec2)
        surface.levels = self._array(np.asarray(levels), wp.vec3i)
        surface.texels = self._array(np.concatenate(texels), wp.vec4ub)


class GaussianRenderer:
    """Draws 3D Gaussians given in the unit frame, as references: no gradient."""

    def __init__(self, gaussians: Gaussians) -> None:
        self.gaussians = gaussians

    @torch.no_grad()
    def render(self, cameras: Cameras, rays: int = 2) -> Renders:
        """Pictures from C cameras, each pixel the mean of `rays` x `rays` finer ones.

        Finer ones are blurred less by the splatting's least width of a Gaussian. Colours are clamped to what
        their opacity allows.
        """
        g = self.gaussians
        finer = torch.tensor([rays, rays, 1.0])[:, None] * cameras.Ks.cpu()
        image, alphas, _ = rasterization(
            g.means,
            g.quats,
            g.scales,
            g.opacities,
            g.sh,
            cameras.viewmats.to(g.means),
            finer.to(g.means),
            cameras.width * rays,
            cameras.height * rays,
            sh_degree=g.sh_degree,
            render_mode="RGB+ED",
        )

        def mean(value: torch.Tensor) -> torch.Tensor:
            return torch.nn.functional.avg_pool2d(value.permute(0, 3, 1, 2), rays).permute(0, 2, 3, 1)

        opacity = mean(alphas)
        depths = mean(torch.where(alphas > 0.0, image[..., 3:] * alphas, 0.0)) / opacity.clamp_min(1e-12)
        return Renders(cameras, mean(torch.minimum(image[..., :3], alphas)).contiguous(), opacity, depths)


def corner_normals(mesh: SurfaceMesh) -> np.ndarray:
    """Unit normals of each face's corners [F, 3, 3]: the vertices', the face's own along sharp edges."""
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    flat = face_normals(vertices, faces)[:, None]
    smooth = vertex_normals(vertices, faces)[faces.long()]
    return torch.where((smooth * flat).sum(2, keepdim=True) > SMOOTH, smooth, flat).numpy()


def _plain_colors(mesh: SurfaceMesh) -> np.ndarray:
    """Base colour times corner colour at every corner, textures left out; [3F, 4]."""
    bare = replace(mesh, materials=tuple(replace(m, texture=None) for m in mesh.materials))
    faces = np.repeat(np.arange(len(mesh.faces)), 3)
    return SurfaceColors(bare).at(faces, np.tile(np.eye(3, dtype=np.float32), (len(mesh.faces), 1)))


__all__ = ["GaussianRenderer", "MeshRenderer", "Renders", "corner_normals", "disparity"]
