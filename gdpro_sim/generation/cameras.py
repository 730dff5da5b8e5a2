"""Where generation looks from: random training views, turntables, and fixed views to judge by.

All in the unit frame: the object fills the unit sphere at the origin, Z up, its front towards +X.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.generation.config import CameraConfig
from gdpro_sim.generation.protocols import ImageKind, ViewBatch

Background = Literal["mixed", "white", "black", "random"]
"""What is behind the object: one of the three for all views, or a third of the views each."""

DISTANCE = 5.0
"""From the origin to the cameras of `ring` and `held_out`."""

FOV = 2.0 * math.asin(1.05 / DISTANCE)
"""Their field of view, vertical and horizontal, rad: the unit sphere and 5 % around it."""

POLAR = (30.0, 150.0)
"""Polar angles of `held_out`, degrees from +Z."""


class CameraSchedule:
    """Random cameras around the object whose ranges move from the config's first values to its late ones.

    Polar angles are even over the sphere's area; a batch's azimuths are spread around it.
    """

    def __init__(self, config: CameraConfig, resolution: int) -> None:
        self.config = config
        self.resolution = resolution

    def sample(
        self,
        iteration: int,
        iterations: int,
        batch: int,
        generator: torch.Generator,
        background: Background = "mixed",
    ) -> ViewBatch:
        """The views of one iteration: `batch` square cameras; every draw comes from `generator`."""
        c = self.config
        moved = c.tighten * iterations
        share = min(1.0, iteration / moved) if moved > 0.0 else 1.0

        def uniform(low: float, high: float) -> np.ndarray:
            return low + (high - low) * torch.rand(batch, generator=generator, dtype=torch.float64).numpy()

        def ranged(first: tuple[float, float], last: tuple[float, float]) -> np.ndarray:
            return uniform(*((1.0 - share) * a + share * b for a, b in zip(first, last, strict=True)))

        def normal(deviation: float) -> np.ndarray:
            return deviation * torch.randn(batch, 3, generator=generator, dtype=torch.float64).numpy()

        polar = np.arccos(uniform(*(math.cos(math.radians(angle)) for angle in c.polar)))
        azimuth = 2.0 * math.pi * (uniform(0.0, 1.0) + np.arange(batch)) / batch
        azimuth += 2.0 * math.pi * float(torch.rand(1, generator=generator, dtype=torch.float64))
        radius = ranged(c.radius, c.radius_late)
        fov = ranged(c.fov, c.fov_late)
        eyes = radius[:, None] * _directions(azimuth, polar) + normal(c.jitter_centre)
        targets = normal(c.jitter_target)
        ups = np.array([0.0, 0.0, 1.0]) + normal(c.jitter_up)
        size = self.resolution
        singles = [
            Cameras.look_at(eyes[i], targets[i], vertical_fov=fov[i], width=size, height=size, up=ups[i])
            for i in range(batch)
        ]
        cameras = Cameras(
            torch.cat([one.viewmats for one in singles]), torch.cat([one.Ks for one in singles]), size, size
        )
        return view_batch(cameras, _backgrounds(batch, generator, background))


def view_batch(
    cameras: Cameras, backgrounds: torch.Tensor | None = None, kind: ImageKind = "rgb"
) -> ViewBatch:
    """Views from `cameras` with their angles, over `backgrounds` [C, 3], white where None."""
    eyes = cameras.positions.double()
    if backgrounds is None:
        backgrounds = torch.ones(len(cameras), 3)
    azimuths = torch.atan2(eyes[:, 1], eyes[:, 0])
    elevations = torch.atan2(eyes[:, 2], torch.linalg.norm(eyes[:, :2], dim=1))
    return ViewBatch(cameras, backgrounds, azimuths.float(), elevations.float(), kind)


def ring(count: int, resolution: int, *, elevation: float = 15.0, azimuth: float = 30.0) -> Cameras:
    """A turntable: `count` cameras around the object, the first at `azimuth`; angles in degrees."""
    turn = math.radians(azimuth) + 2.0 * math.pi * np.arange(count) / count
    polar = np.full(count, math.radians(90.0 - elevation))
    return _around(_directions(turn, polar), resolution)


def held_out(count: int, resolution: int, *, polar: tuple[float, float] = POLAR) -> Cameras:
    """`count` fixed cameras spread evenly (a Fibonacci lattice) over polar angles `polar`, degrees."""
    i = np.arange(count) + 0.5
    top, bottom = (math.cos(math.radians(angle)) for angle in polar)
    golden = math.pi * (1.0 + math.sqrt(5.0)) * i
    return _around(_directions(golden, np.arccos(top + (bottom - top) * i / count)), resolution)


def _around(directions: np.ndarray, resolution: int) -> Cameras:
    return Cameras.look_at(
        DISTANCE * directions, (0.0, 0.0, 0.0), vertical_fov=FOV, width=resolution, height=resolution
    )


def _directions(azimuth: np.ndarray, polar: np.ndarray) -> np.ndarray:
    """Unit vectors [C, 3]."""
    return np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=1)


def _backgrounds(batch: int, generator: torch.Generator, background: Background) -> torch.Tensor:
    """Colours [batch, 3]; as many numbers are drawn whatever `background` is."""
    colors = torch.rand(batch, 3, generator=generator)
    which = torch.randint(3, (batch,), generator=generator)
    if background != "mixed":
        which = torch.full((batch,), ("white", "black", "random").index(background))
    colors[which == 0] = 1.0
    colors[which == 1] = 0.0
    return colors


__all__ = ["DISTANCE", "FOV", "POLAR", "Background", "CameraSchedule", "held_out", "ring", "view_batch"]
