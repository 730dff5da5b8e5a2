"""Rigid bodies beside soft ones, small enough to compute by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from gdpro_sim.simulation.compile_coupled import rigid_links
from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.model import Coupling, Model, PartName
from gdpro_sim.simulation.mujoco_model import MujocoSettings, MujocoWorld, RigidBody
from gdpro_sim.simulation.verification.models import make_model


def coupled(soft: Model, *bodies: RigidBody, timestep: float = 1e-3, **options: Any) -> Model:
    """Rigid bodies among soft ones, a model of FEM or MPM: they share its ground, gravity and obstacles.

    options: those of `Coupling`
    """
    empty = make_model(
        np.zeros((0, 3)), np.zeros((0, 4), np.int32), ground=soft.ground, gravity=soft.gravity,
        colliders=soft.colliders,
    )  # fmt: skip
    rigid = replace(empty, mujoco=MujocoWorld(bodies, MujocoSettings(timestep=timestep)))
    links, still = rigid_links(rigid)
    part: PartName = "fem" if soft.particles is None else "mpm"
    parts = {part: replace(soft, colliders=(*soft.colliders, *still)), "mujoco": rigid}
    return replace(soft, mujoco=rigid.mujoco, coupling=Coupling(parts, (), links, **options))


class Ledger:
    """Momenta of the parts of a coupled model, and what the whole has of energy."""

    def __init__(self, solver: SolverCoupled) -> None:
        self.solver = solver

    def momentum(self, part: PartName) -> np.ndarray:
        """[6] kg m/s and kg m^2/s about the world's origin."""
        found = self.solver.solvers[part].diagnostics()
        return np.array([*found.momentum, *found.angular_momentum])

    def total(self) -> np.ndarray:
        """[6] of all parts."""
        return np.sum([self.momentum(part) for part in self.solver.solvers], axis=0)

    def energy(self) -> float:
        """J, of all parts: kinetic, elastic, of gravity and of contact."""
        d = self.solver.diagnostics()
        return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


__all__ = ["Ledger", "coupled"]
