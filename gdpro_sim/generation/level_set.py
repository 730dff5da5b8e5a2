"""Where rays first meet a level of the density of a sum of Gaussians."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
import warp as wp

from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.gaussians import Gaussians, Surfels, rotation_matrices
from gdpro_sim.kernels import level_set as kernels

SURFEL_THICKNESS = 0.3
"""Standard deviation of a surfel across its plane, over the smaller one within it: a density needs one."""

SMALLEST_STEP = 2e-4
"""Along a ray, in the unit frame: thinner Gaussians may be stepped over."""


class Density:
    """Sum over Gaussians of opacity times exp(-d^2 / 2), d the Mahalanobis distance, cut off at d = 3.

    Surfels get a thickness of `SURFEL_THICKNESS` of their smaller standard deviation.
    """

    def __init__(self, gaussians: Gaussians | Surfels) -> None:
        scales = gaussians.scales.detach()
        if isinstance(gaussians, Surfels):
            scales = torch.cat([scales, SURFEL_THICKNESS * scales.amin(1, keepdim=True)], 1)
        usable = torch.isfinite(gaussians.means).all(1) & torch.isfinite(scales).all(1)
        usable &= (scales > 0.0).all(1) & (gaussians.opacities > 1e-3)
        usable &= torch.isfinite(gaussians.quats).all(1) & (gaussians.quats != 0.0).any(1)
        self.means = gaussians.means.detach()[usable].contiguous()
        self.opacities = gaussians.opacities.detach()[usable].contiguous()
        scales = scales[usable].clamp_min(SMALLEST_STEP)
        axes = rotation_matrices(gaussians.quats.detach()[usable])
        self.whitening = (axes / scales[:, None, :]).transpose(1, 2).contiguous()
        half = 3.0 * torch.linalg.vector_norm(axes * scales[:, None, :], dim=2)
        self._low, self._high = (self.means - half).contiguous(), (self.means + half).contiguous()
        self._bvh: wp.Bvh | None = None

    def first_crossings(
        self, origin: torch.Tensor, directions: torch.Tensor, *, level: float, near: float, far: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Distances [R] at which rays first reach `level`, infinity where none is, and unit normals [R, 3].

        origin [3]; unit directions [R, 3]; `near` and `far` bound the search. Normals point against the
        density's gradient, out of the object.
        """
        device = self.means.device
        distances = torch.full((len(directions),), float("inf"), device=device)
        normals = torch.zeros((len(directions), 3), device=device)
        if not len(self.means) or not len(directions):
            return distances, normals
        with beside_torch(self.means):
            if self._bvh is None:
                low: Any = wp.from_torch(self._low, dtype=wp.vec3)
                high: Any = wp.from_torch(self._high, dtype=wp.vec3)
                self._bvh = wp.Bvh(low, high)
            launch_chunked(
                kernels.first_crossings,
                len(directions),
                [
                    self._bvh.id,
                    wp.from_torch(self.means, dtype=wp.vec3),
                    wp.from_torch(self.whitening, dtype=wp.mat33),
                    wp.from_torch(self.opacities),
                    wp.vec3(*np.asarray(origin.detach().cpu(), np.float32).tolist()),
                    wp.from_torch(directions.detach().contiguous(), dtype=wp.vec3),
                    float(level),
                    float(near),
                    float(far),
                    SMALLEST_STEP,
                ],
                [wp.from_torch(distances), wp.from_torch(normals, dtype=wp.vec3)],
                device=device_name(self.means),
                minimum=256,
            )
        return distances, normals


__all__ = ["Density"]
