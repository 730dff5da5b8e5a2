"""Looking into the FEM solver: forces and stiffness at given positions, states to start from, energies."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model

TIGHT: dict[str, Any] = {"newton_tolerance": 1e-9, "cg_tolerance": 1e-8, "newton_iterations": 60}
"""Settings that leave nothing of an answer to the solver's tolerances."""


class Probe:
    """The solver's own elements on a model, without contact, inertia or damping."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self._potential = IncrementalPotential(model, rest_shapes(model), ())
        self.mass = self._potential.mass
        self._x = wp.zeros(len(model.vertices), dtype=wp.vec3d, device=model.device)

    def forces(self, x: np.ndarray) -> np.ndarray:
        """What holds every vertex at x [P, 3] m against the elements, [P, 3] N."""
        self._x.assign(np.ascontiguousarray(x, np.float64))
        self._potential.forces(self._x)
        corners = self._potential.element_gradient.numpy().reshape(-1, 4, 3)
        total = np.zeros((len(self.model.vertices), 3))
        np.add.at(total, self.model.tets, corners)
        return total

    def stiffness(self, x: np.ndarray) -> Any:
        """The projected stiffness matrix at x [P, 3] m, scipy BSR [3P, 3P] N/m."""
        self._x.assign(np.ascontiguousarray(x, np.float64))
        p = self._potential
        still = wp.zeros_like(self._x)
        p.begin(Step(0.0, 1e30, self._x, still, p.base, still))
        p.linearise(self._x)
        return p.system.matrix().copy()


def start(
    model: Model, positions: np.ndarray | None = None, velocities: np.ndarray | None = None
) -> SolverFEM:
    """A solver that starts at `positions` and `velocities`, [P, 3] float64; pins hold where they stand."""
    solver = SolverFEM(model)
    state = solver.state_dict()
    if positions is not None:
        state["positions"] = np.asarray(positions, np.float64)
    if velocities is not None:
        state["velocities"] = np.asarray(velocities, np.float64)
    solver.load_state_dict(state)
    return solver


def settled(model: Model, positions: np.ndarray | None = None, dt: float = 0.1) -> np.ndarray:
    """Where forces balance, [P, 3] m. Raises SolverError where the quasi-static solve does not converge."""
    solver = start(model, positions)
    solver.step(dt)
    diagnostics = solver.diagnostics()
    if not diagnostics.converged:
        raise SolverError(f"the quasi-static solve still moves {diagnostics.residual:.3g} m/s")
    return solver.positions


def total_energy(solver: SolverFEM) -> float:
    """Kinetic, elastic, of gravity and of contact, J."""
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


def order(steps: list[float], errors: list[float]) -> float:
    """Exponent p of errors ~ steps^p, by least squares over all."""
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def without_locking(cells: list[int], values: list[float]) -> float:
    """Limit of compliances (sags, angles ...) of bent meshes with `cells` across the section.

    Parasitic shear of linear tets adds a stiffness in proportion to the square of their size (Hughes, "The
    Finite Element Method", section 4.7), so 1 / value is a line over 1 / cells^2; by least squares.
    """
    return float(1.0 / np.polyfit(1.0 / np.square(cells), 1.0 / np.asarray(values), 1)[1])


__all__ = ["TIGHT", "Probe", "order", "settled", "start", "total_energy", "without_locking"]
