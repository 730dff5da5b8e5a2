"""Every problem of the FEM solver, in the order they are run."""

from __future__ import annotations

from gdpro_sim.simulation.verification import (
    fem_contact,
    fem_dynamics,
    fem_materials,
    fem_robustness,
    fem_statics,
)

PROBLEMS = (
    *fem_materials.PROBLEMS,
    *fem_statics.PROBLEMS,
    *fem_dynamics.PROBLEMS,
    *fem_contact.PROBLEMS,
    *fem_robustness.PROBLEMS,
)

__all__ = ["PROBLEMS"]
