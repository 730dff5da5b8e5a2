"""What acts on the grid's velocities: floors, walls, obstacles, drivers."""

from __future__ import annotations

from typing import Protocol

import warp as wp

from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mpm.grid import Grid


class Boundary(Protocol):
    """Changes velocities of nodes, or of particles, in every substep."""

    def begin(self, time: float, h: float) -> None:
        """A substep from `time` to `time` + `h` s begins."""

    def apply(self, grid: Grid, h: float) -> None:
        """Change the velocities of `grid.values`, in place."""

    def drive(self, grid: Grid, h: float) -> None:
        """Change `grid.particles` after they have moved, in place."""

    def state(self) -> dict[str, wp.array]:
        """Arrays that change, to be saved with the solver's."""


def boundaries(model: Model) -> tuple[Boundary, ...]:
    """All of a model's."""
    return ()


__all__ = ["Boundary", "boundaries"]
