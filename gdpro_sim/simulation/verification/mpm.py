"""Every problem of the MPM solver, in the order they are run."""

from __future__ import annotations

from gdpro_sim.simulation.verification import mpm_flows, mpm_grains, mpm_materials, mpm_motion, mpm_solids

PROBLEMS = (
    *mpm_materials.PROBLEMS,
    *mpm_motion.PROBLEMS,
    *mpm_solids.PROBLEMS,
    *mpm_flows.PROBLEMS,
    *mpm_grains.PROBLEMS,
)

__all__ = ["PROBLEMS"]
