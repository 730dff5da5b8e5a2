"""One moment of a simulation, as handed to renderers and writers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdpro_sim.gaussians import Gaussians
from gdpro_sim.simulation.model import Diagnostics


@dataclass(frozen=True)
class BodyFrame:
    """One body at one moment, in world space.

    vertices:  [V, 3] float32 m, deformed surface
    gaussians: the body's Gaussians carried by those vertices
    """

    name: str
    vertices: np.ndarray
    gaussians: Gaussians


@dataclass(frozen=True)
class Frame:
    """All bodies at one moment.

    index: frame number from 0; time code of the USD samples
    time:  seconds since the start
    colliders: [C, 3, 4] float64, rotation and shift m of each of `Simulation.obstacles` since the start: the
           scene's colliders, and the parts of a base; None where all are where their keyframes have them
    """

    index: int
    time: float
    bodies: tuple[BodyFrame, ...]
    diagnostics: Diagnostics
    colliders: np.ndarray | None = None

    def gaussians(self) -> Gaussians:
        """Every body's Gaussians joined, in body order."""
        return Gaussians.concatenate([body.gaussians for body in self.bodies])


__all__ = ["BodyFrame", "Frame"]
