"""The solver without physics: it asks vertex sources where the bodies are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.animation.follow import SurfaceFollower
from gdpro_sim.simulation.animation.source import VertexSource
from gdpro_sim.simulation.model import Diagnostics, Model

LOOKS = 25
"""Moments at which a motion is looked at for the space it takes."""


@dataclass(frozen=True)
class AnimatedBody:
    """How one body follows a motion.

    start, end: s, the part of the motion that is shown
    speed:      seconds of the motion per second
    loop:       begin again after the end
    factor, turn, shift: from the motion's frame to the world: scale, [3, 3] rotation, [3] m
    """

    source: VertexSource
    follower: SurfaceFollower
    start: float
    end: float
    speed: float
    loop: bool
    factor: float
    turn: np.ndarray
    shift: np.ndarray

    def at(self, time: float) -> np.ndarray:
        """Surface vertices [V, 3] float32 m in the world, `time` s after the scene's start."""
        along = time * self.speed
        length = self.end - self.start
        if self.loop and along > length * (1.0 + 1e-9):
            along -= length * np.ceil(along / length * (1.0 - 1e-12) - 1.0)
        points = self.follower(self.source.vertices(self.start + min(along, length)))
        return ((self.factor * points) @ self.turn.T + self.shift).astype(np.float32)

    def bounds(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """Corners [3] m of a box around where it is at some moments of the first `duration` s."""
        seen = np.concatenate([self.at(moment) for moment in np.linspace(0.0, duration, LOOKS)])
        return seen.min(axis=0).astype(float), seen.max(axis=0).astype(float)


class SolverAnimation:
    """Bodies where their motions have them at the current time; the others stand still."""

    def __init__(self, model: Model) -> None:
        if model.animation is None:
            raise SolverError("this model has no animation")
        self.model = model
        self._animation = model.animation
        self.time = 0.0

    def reset(self) -> None:
        self.time = 0.0

    def step(self, dt: float) -> None:
        self.time += dt

    def surface_positions(self, body: int) -> np.ndarray:
        """Surface vertices of body number `body`, [V, 3] float32 m, world. Raises MeshError."""
        animated = self._animation[body]
        return self.model.bodies[body].surface if animated is None else animated.at(self.time)

    def state_dict(self) -> dict[str, np.ndarray]:
        return {"time": np.array(self.time)}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        self.time = float(state["time"])

    def diagnostics(self) -> Diagnostics:
        """The time; everything else is zero, for nothing is solved."""
        zero = (0.0, 0.0, 0.0)
        return Diagnostics(
            time=self.time,
            kinetic_energy=0.0,
            elastic_energy=0.0,
            gravity_energy=0.0,
            contact_energy=0.0,
            momentum=zero,
            angular_momentum=zero,
            contacts=0,
            max_penetration=0.0,
            min_volume_ratio=1.0,
            substeps=0,
            newton_iterations=0,
            cg_iterations=0,
            converged=True,
            residual=0.0,
        )


__all__ = ["LOOKS", "AnimatedBody", "SolverAnimation"]
