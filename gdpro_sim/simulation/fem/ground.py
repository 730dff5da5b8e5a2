"""The floor as a term of the incremental potential: a penalty and lagged Coulomb friction at every vertex."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import Launches
from gdpro_sim.kernels import ground as kernels
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model

CONTACT_PER_ELASTIC = 3.0
"""Ground stiffness of a vertex as a multiple of its own elastic stiffness."""

STICK_PER_ELASTIC = 1.0
"""Friction spring stiffness of a vertex as a multiple of its own elastic stiffness. Stiffer makes the
stick-slip kink sharper and Newton zigzag across it (ten times the iterations on a soft body, measured), and
buys only a smaller elastic give before slipping; at 1 that give is that of one more layer of elements."""

CONTACT_SAG = 1e-3
"""Penetration, as a fraction of the body's size, at which one vertex would carry the whole body's weight."""

CONTACT_RAMP = 1e-4
"""Depth over which the ground penalty turns from cubic to quadratic, as a fraction of the body's size."""

STANDARD_GRAVITY = 9.81


class GroundContact:
    """The half-space under `model.ground`. Implements `gdpro_sim.simulation.fem.term.Term`."""

    def __init__(self, model: Model, rest: RestShapes) -> None:
        assert model.ground is not None
        self.device = model.device
        self._launch = Launches(model.device)
        self.energies = len(model.vertices)
        stiffness, stick, ramp = _scales(model, rest)
        carried = rest.mass > 0.0
        self.frequency = float(np.sqrt(((stiffness + stick)[carried] / rest.mass[carried]).max(initial=0.0)))
        self._height = model.ground.height
        self._offset = model.contact_offset.astype(np.float64)
        self.ground = kernels.Ground()
        self.ground.height = model.ground.height
        self.ground.friction = reals(model.friction, self.device)
        self.ground.stiffness = reals(stiffness, self.device)
        self.ground.stick = reals(stick, self.device)
        self.ground.ramp = reals(ramp, self.device)
        self.ground.offset = reals(model.contact_offset, self.device)
        self._anchor = wp.zeros(self.energies, dtype=wp.vec2d, device=self.device)
        self._anchor.assign(np.ascontiguousarray(model.vertices[:, :2], np.float64))
        self._limit = wp.zeros(self.energies, dtype=wp.float64, device=self.device)
        self._terms = wp.zeros(self.energies, dtype=wp.float64, device=self.device)

    def begin(self, step: Step) -> None:
        """Nothing of the ground depends on the step."""

    def lag(self, x: wp.array) -> None:
        """Take the Coulomb limits from the normal forces at x; they stay until the next call."""
        self._over_vertices(kernels.friction_limits, [self.ground, x], [self._limit])

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        inputs = [first, self.ground, x, self._anchor, self._limit]
        self._over_vertices(kernels.ground_energy, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        inputs = [self.ground, x, self._anchor, self._limit]
        self._over_vertices(kernels.add_ground_derivatives, inputs, [gradient, block])
        return None

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        """The penalty pushes back from any depth."""
        return 1.0

    def finish(self, x: wp.array) -> None:
        """Drag the friction anchors along."""
        self._over_vertices(kernels.drag_anchors, [self.ground, x], [self._anchor])

    def stored(self, x: wp.array) -> float:
        self.lag(x)
        self.energy(x, self._terms, 0)
        return float(self._terms.numpy().sum())

    def state(self) -> dict[str, wp.array]:
        return {"anchors": self._anchor}

    def report(self, x: wp.array) -> dict[str, float]:
        depth = self._height - self._offset - x.numpy()[:, 2]
        return {
            "contacts": float(np.count_nonzero(depth > 0.0)),
            "penetration": float(max(0.0, depth.max(initial=0.0))),
        }

    def _over_vertices(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        self._launch(kernel, self.energies, inputs, outputs, minimum=4096)


def _scales(model: Model, rest: RestShapes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ground stiffness N/m, friction spring stiffness N/m and ramp depth m of each vertex.

    The ground stiffness follows the vertex's own elastic stiffness (so that a stiff body indents the ground
    no more than itself) and its body's weight (so that a soft one does not sink).
    """
    count = len(model.vertices)
    stiffness = CONTACT_PER_ELASTIC * rest.stiffness
    ramp = np.zeros(count)
    ranges = [body.vertex_range for body in model.bodies] or [(0, count)]
    for begin, end in ranges:
        size = float(np.linalg.norm(np.ptp(model.vertices[begin:end].astype(np.float64), axis=0)))
        weight = STANDARD_GRAVITY * float(rest.mass[begin:end].sum())
        stiffness[begin:end] += weight / (CONTACT_SAG * size)
        ramp[begin:end] = CONTACT_RAMP * size
    return model.fem.contact_stiffness * stiffness, STICK_PER_ELASTIC * rest.stiffness, ramp


__all__ = ["GroundContact"]
