"""The ablation without Gaussians: a mesh whose vertices carry colours, drawn by casting rays."""

from __future__ import annotations

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.generation.distillation import Shot
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.surface import SurfaceMesh


class TexturedMesh:
    """Draws a mesh that stays, in vertex colours that learn; each pixel the mean of `rays` x `rays` rays.

    `start`: [V, 3] the mesh's own colours at its vertices (the mean over a vertex's corners), on `device`.
    """

    def __init__(self, mesh: SurfaceMesh, device: torch.device, rays: int) -> None:
        self._rays = rays
        self._index = SurfaceIndex(mesh.vertices, mesh.faces)
        self._vertices = mesh.vertices
        self._faces = mesh.faces
        self._corners = torch.from_numpy(mesh.faces.astype(np.int64)).to(device)
        count, faces = len(mesh.vertices), len(mesh.faces)
        corners = np.tile(np.eye(3, dtype=np.float32), (faces, 1))
        rgb = SurfaceColors(mesh).at(np.repeat(np.arange(faces), 3), corners)[:, :3]
        flat = mesh.faces.ravel()
        sums = np.stack([np.bincount(flat, rgb[:, k], count) for k in range(3)], 1)
        mean = sums / np.maximum(np.bincount(flat, minlength=count), 1)[:, None]
        self.start = torch.from_numpy(mean.astype(np.float32)).to(device)

    def render(self, colors: torch.Tensor, cameras: Cameras, backgrounds: torch.Tensor) -> Shot:
        """Images over `backgrounds` [C, 3]; gradients reach `colors` [V, 3] alone."""
        width, height, device, count = cameras.width, cameras.height, colors.device, self._rays
        across = (np.arange(width * count) + 0.5) / count
        down = (np.arange(height * count) + 0.5) / count
        pixels = np.stack([*np.meshgrid(across, down), np.ones((len(down), len(across)))], -1).reshape(-1, 3)
        images, depths, alphas = [], [], []
        for c, eye in enumerate(cameras.positions.cpu().double().numpy()):
            rotation = cameras.viewmats[c, :3, :3].cpu().double().numpy()
            inverse = np.linalg.inv(cameras.Ks[c].cpu().double().numpy())
            # Directions with z = 1 in the camera: a hit's distance along them is its depth.
            rays = pixels @ inverse.T @ rotation
            face, weight = self._index.first_hit(np.broadcast_to(eye, rays.shape), rays)
            hit = np.flatnonzero(face >= 0)
            points = np.einsum("nc,ncd->nd", weight[hit], self._vertices[self._faces[face[hit]]])
            values = np.zeros((len(rays), 2), np.float32)
            values[hit, 0] = (points - eye) @ rotation[2]
            values[hit, 1] = 1.0
            corner_colors = colors[self._corners[torch.from_numpy(face[hit]).long().to(device)]]
            shown = (corner_colors * torch.from_numpy(weight[hit]).to(device)[:, :, None]).sum(1)
            at = torch.from_numpy(hit).to(device)
            image = backgrounds[c].expand(len(rays), 3).index_copy(0, at, shown)
            images.append(_mean(image, height, width, count))
            z, alpha = _mean(torch.from_numpy(values).to(device), height, width, count).split(1, dim=2)
            depths.append(z / alpha.clamp(min=1e-6))
            alphas.append(alpha)
        return Shot(cameras, torch.stack(images), torch.stack(depths), torch.stack(alphas))


def _mean(rays: torch.Tensor, height: int, width: int, count: int) -> torch.Tensor:
    """Mean over each pixel's rays: [H count W count, D] -> [H, W, D]."""
    return rays.view(height, count, width, count, -1).mean((1, 3))


__all__ = ["TexturedMesh"]
