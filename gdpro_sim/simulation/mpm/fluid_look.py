"""What fluids look like: Gaussians on the surface of their particles, made anew in every frame.

A fluid forgets what it was: a surface carried along from the start would be torn to flakes. Every particle
has one flat, round Gaussian instead. Those at the surface lie on it, which is where smoothed normals and
heights of the particles around have it; those of thin films lie in the film, and are as wide as it takes to
close it; those inside do not show. Colours are carried along.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import warp as wp

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.device import Launches
from gdpro_sim.errors import SolverError
from gdpro_sim.gaussians import sh_to_rgb
from gdpro_sim.kernels import mpm_fluid_look as kernels
from gdpro_sim.meshing.fill import Filling
from gdpro_sim.simulation.mpm.look import colors_around

RADIUS = 3.2
"""Neighbours that tell the surface lie this near, in spacings: nearer ones show the particles' own noise."""

NORMAL_SWEEPS = 2

HEIGHT_SWEEPS = 3

THICKNESS = 0.15
"""Standard deviation of a disk across the surface, in spacings."""

OPACITY = 0.97

CELLS = 64
"""Cells of the hash grid along each axis; a larger fluid wraps around."""


class FluidLook:
    """One triangle for each of `count` particles that lie `spacing` m apart in the fluid at rest.

    The result is the same for any number of threads.
    """

    def __init__(self, count: int, spacing: float, *, device: str = "cpu") -> None:
        if count < 1 or not spacing > 0.0:
            raise SolverError(f"a fluid has particles, some way apart; got {count}, {spacing} m apart")
        self.spacing, self.device = float(spacing), device
        self._count, self._radius = count, RADIUS * float(spacing)
        self._launch = Launches(device)
        self._grid = wp.HashGrid(CELLS, CELLS, CELLS, device=device)
        self._positions, self._disks, self._moved, self._normals, self._turned = (
            wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(5)
        )
        self._surface, self._film, self._sizes = (
            wp.zeros(count, dtype=float, device=device) for _ in range(3)
        )
        self._vertices: wp.array = wp.zeros(3 * count, dtype=wp.vec3, device=device)

    def surface(self, positions: np.ndarray) -> np.ndarray:
        """Corners [3 n, 3] float32 m of equilateral triangles, with particles at `positions` [n, 3] m.

        A triangle is two standard deviations of its Gaussian wide, and faces outward.
        """
        if positions.shape != (self._count, 3):
            raise SolverError(f"a look over {self._count} particles got positions {positions.shape}")
        self._positions.assign(np.ascontiguousarray(positions, np.float32))
        self._grid.build(self._positions, self._radius)
        around = [self._grid.id, self._positions, self._radius]
        found = [self._normals, self._surface, self._film, self._sizes]
        self._run(kernels.find_surface, [*around, self.spacing], found)
        for _ in range(NORMAL_SWEEPS):
            inputs = [*around, self._surface, self._film, self._normals]
            self._run(kernels.smooth_normals, inputs, [self._turned])
            self._normals, self._turned = self._turned, self._normals
        inputs = [self._positions, self.spacing, self._surface, self._normals]
        self._run(kernels.raise_disks, inputs, [self._disks])
        for _ in range(HEIGHT_SWEEPS):
            inputs = [*around, self.spacing, self._surface, self._normals, self._disks]
            self._run(kernels.smooth_heights, inputs, [self._moved])
            self._disks, self._moved = self._moved, self._disks
        self._run(kernels.draw_disks, [self._disks, self._normals, self._sizes], [self._vertices])
        return self._vertices.numpy().copy()

    def _run(self, kernel: wp.Kernel, inputs: list[object], outputs: list[wp.array]) -> None:
        self._launch(kernel, self._count, inputs, outputs, minimum=512)


@dataclass(frozen=True)
class Fluid:
    """A body as a fluid looks.

    gaussians:     one for each particle, on a triangle of its own
    vertex_colors: [3 n, 3] float32 sRGB
    """

    gaussians: BoundGaussians
    vertex_colors: np.ndarray


def fluid(bound: BoundGaussians, filling: Filling) -> Fluid:
    """`bound`, seen as the particles of `filling` show it; both in one frame.

    A particle has the colour of the Gaussians of `bound` around it.
    """
    n = len(filling)
    look = FluidLook(n, filling.spacing)
    vertices = torch.from_numpy(look.surface(filling.points))
    corners = vertices.view(n, 3, 3)
    sigma = 0.5 * (corners[:, 1] - corners[:, 0]).norm(dim=1)
    thickness = torch.full_like(sigma, THICKNESS * filling.spacing)
    sh = colors_around(bound, filling.points, filling.spacing)
    ids = torch.arange(3 * n, dtype=torch.int32)
    gaussians = BoundGaussians(
        vertices=vertices,
        faces=ids.view(n, 3),
        face_ids=ids[:n],
        barycentrics=torch.full((n, 3), 1.0 / 3.0),
        rotations=torch.tensor([1.0, 0.0]).repeat(n, 1),
        log_scales=torch.stack([thickness, sigma, sigma], 1).log(),
        opacity_logits=torch.logit(torch.full((n,), OPACITY)),
        sh=sh[:, None],
    )
    rgb = sh_to_rgb(sh).clamp(0.0, 1.0).numpy().astype(np.float32)
    return Fluid(gaussians, np.repeat(rgb, 3, axis=0))


__all__ = ["Fluid", "FluidLook", "fluid"]
