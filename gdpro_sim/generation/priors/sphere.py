"""No prior at all: a grey ball, to see what a prior is worth."""

from __future__ import annotations

from typing import Any

import numpy as np

from gdpro_sim.generation.protocols import CoarseMesh, UnitFrame
from gdpro_sim.meshing.surface import SurfaceMesh

RADIUS = 0.5
"""Of the ball, in the unit frame."""

GREY = (0.5, 0.5, 0.5)


class SpherePrior:
    """A ball half as large as the object's bounding sphere, around its centre.

    frame: the guidance's, so that the ball lies where the object will be; it knows no size of its own
    """

    def __init__(self, frame: UnitFrame = UnitFrame((0.0, 0.0, 0.0), 1.0)) -> None:  # noqa: B008 (frozen)
        self.frame = frame

    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """The ball, whatever is asked for."""
        import trimesh

        ball = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
        vertices = self.frame.to_metres(np.asarray(ball.vertices))
        surface = SurfaceMesh.from_arrays(vertices, np.asarray(ball.faces), color=GREY)
        return CoarseMesh(surface, None, self.describe())

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        return {"kind": "sphere", "label": "no prior: a grey ball", "radius": RADIUS, "metric": False}


__all__ = ["SpherePrior"]
