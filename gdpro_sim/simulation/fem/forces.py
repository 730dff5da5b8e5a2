"""Forces of a model as terms of the potential: moving pins, constant loads and impulses; and all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.kernels import forces as kernels
from gdpro_sim.simulation.conditions import Force, Impulse, Pressure, Wind, pose_at
from gdpro_sim.simulation.fem.force_term import ForceTerm, integers, share_of_step, vectors
from gdpro_sim.simulation.fem.rest import RestShapes
from gdpro_sim.simulation.fem.springs import SpringForces
from gdpro_sim.simulation.fem.surface_loads import PressureLoad, WindLoad
from gdpro_sim.simulation.fem.term import Step, Term
from gdpro_sim.simulation.model import Model

INSTANT = 1e-9
"""s; an impulse acts in the step that holds its time plus this: steps end on frame times up to rounding."""


def force_terms(model: Model, rest: RestShapes) -> tuple[Term, ...]:
    """What moves and loads the vertices of a model, in a fixed order; nothing where there is nothing."""
    terms: list[Term] = []
    if model.motions:
        terms.append(PinMotion(model))
    if model.springs is not None:
        terms.append(SpringForces(model, rest, model.springs))
    constant = tuple(load for load in model.loads if isinstance(load, Force | Impulse))
    if constant:
        terms.append(ConstantLoads(model, constant))
    for load in model.loads:
        if isinstance(load, Pressure):
            terms.append(PressureLoad(model, rest, load))
        elif isinstance(load, Wind):
            terms.append(WindLoad(model, rest, load))
    return tuple(terms)


class PinMotion(ForceTerm):
    """Moves pinned vertices along their keyframes. Implements `gdpro_sim.simulation.fem.term.Term`."""

    def __init__(self, model: Model) -> None:
        motions = model.motions
        ids = np.concatenate([motion.vertices for motion in motions])
        super().__init__(model, ids)
        self._motions = motions
        counts = [len(motion.vertices) for motion in motions]
        self._motion = integers(np.repeat(np.arange(len(motions)), counts), model.device)
        self._rest = vectors(model.vertices.astype(np.float64)[ids], model.device)
        self._rotation = wp.zeros(len(motions), dtype=wp.mat33d, device=model.device)
        self._translation = wp.zeros(len(motions), dtype=wp.vec3d, device=model.device)

    def begin(self, step: Step) -> None:
        """The midpoint rule solves for the middle of the straight way to where a pin is at the end."""
        poses = [pose_at(motion, step.end) for motion in self._motions]
        self._rotation.assign(np.stack([rotation for rotation, _ in poses]))
        self._translation.assign(np.stack([translation for _, translation in poses]))
        share = 1.0
        if step.end > step.start:
            share = (step.time - step.start) / (step.end - step.start)
        inputs = [self.vertices, self._motion, self._rest, self._rotation, self._translation, share, step.x]
        self.launch(kernels.move_pins, self.count, inputs, [step.held])


class ConstantLoads(ForceTerm):
    """Forces and impulses that depend on time alone. Implements `gdpro_sim.simulation.fem.term.Term`."""

    def __init__(self, model: Model, loads: tuple[Force | Impulse, ...]) -> None:
        ids, slots = np.unique(np.concatenate([load.vertices for load in loads]), return_inverse=True)
        super().__init__(model, ids)
        self.energies = self.count
        self._loads = loads
        self._slots = np.split(slots, np.cumsum([len(load.vertices) for load in loads])[:-1])
        self._force = wp.zeros(self.count, dtype=wp.vec3d, device=model.device)
        self._shares: list[float] = []
        self._before = wp.zeros(len(model.vertices), dtype=wp.vec3d, device=model.device)

    def begin(self, step: Step) -> None:
        self._before = step.x
        shares = [_share(load, step) for load in self._loads]
        if shares == self._shares:
            return
        self._shares = shares
        total = np.zeros((self.count, 3))
        for load, slots, share in zip(self._loads, self._slots, shares, strict=True):
            if share > 0.0:
                np.add.at(total, slots, share * (load.forces if isinstance(load, Force) else load.impulses))
        self._force.assign(total)

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        inputs = [first, self.vertices, self._force, x, self._before]
        self.launch(kernels.load_energy, self.count, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        self.launch(kernels.add_loads, self.count, [self.vertices, self._force], [gradient])
        return None


def _share(load: Force | Impulse, step: Step) -> float:
    """What a load is multiplied with in a step: impulses with 1/s."""
    if isinstance(load, Force):
        return share_of_step(step, load.start, load.end)
    if step.start <= load.time + INSTANT < step.end:
        return 1.0 / (step.end - step.start)
    return 0.0


__all__ = ["ConstantLoads", "PinMotion", "force_terms"]
