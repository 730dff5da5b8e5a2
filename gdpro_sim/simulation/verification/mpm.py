"""Every problem of the MPM solver, in the order they are run."""

from __future__ import annotations

from gdpro_sim.simulation.verification import mpm_motion

PROBLEMS = (*mpm_motion.PROBLEMS,)

__all__ = ["PROBLEMS"]
