"""The ablation without Gaussians: a mesh whose vertices carry colours, drawn by casting rays."""

from __future__ import annotations

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.generation.distillation import Shot
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.surface import SurfaceMesh

RAYS = 2
"""Rays across and down a pixel."""


class TexturedMesh:
    """Draws a mesh that stays, in vertex colours that learn.

    `start`: [V, 3] the mesh's own colours at its vertices (the mean over a vertex's corners), on `device`.
    """

    def __init__(self, mesh: SurfaceMesh, device: torch.device) -> None:
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
        width, height, device = cameras.width, cameras.height, colors.device
        across = (np.arange(width * RAYS) + 0.5) / RAYS
        down = (np.arange(height * RAYS) + 0.5) / RAYS
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
            images.append(_reduced(image, height, width))
            z, alpha = _reduced(torch.from_numpy(values).to(device), height, width).split(1, dim=2)
            depths.append(z / alpha.clamp(min=1e-6))
            alphas.append(alpha)
        return Shot(cameras, torch.stack(images), torch.stack(depths), torch.stack(alphas))


def _reduced(rays: torch.Tensor, height: int, width: int) -> torch.Tensor:
    """Mean over each pixel's rays: [H R W R, D] -> [H, W, D]."""
    return rays.view(height, RAYS, width, RAYS, -1).mean((1, 3))


__all__ = ["RAYS", "TexturedMesh"]
