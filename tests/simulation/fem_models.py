"""Models for the FEM tests: those of the verification problems, and the potential of one step."""

from __future__ import annotations

import numpy as np
import warp as wp

from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.verification.models import make_model, tet_box


def potential_at(
    model: Model, positions: np.ndarray | None = None, h: float = 0.01, before: np.ndarray | None = None
) -> IncrementalPotential:
    """The potential of a step of h seconds from rest at `before` (default: `positions`), without terms.

    Its trial stands at `positions` (default: the model's vertices).
    """
    potential = IncrementalPotential(model, rest_shapes(model), ())
    x = np.asarray(model.vertices if positions is None else positions, np.float64)
    potential.trial.assign(x)
    state = wp.array(x if before is None else before, dtype=wp.vec3d, device=model.device)
    potential.begin(Step(h, h, state, wp.zeros_like(state), potential.base, wp.clone(state)))
    for array in (potential.base, potential.inertia):
        wp.copy(array, state)
    potential.strain_base(state, 1.0, state, 0.0)
    return potential


__all__ = ["make_model", "potential_at", "tet_box"]
