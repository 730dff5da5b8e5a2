"""Every problem of rigid bodies among soft ones, in the order they are run."""

from __future__ import annotations

from gdpro_sim.simulation.verification import coupling_fem, coupling_mpm

PROBLEMS = (*coupling_fem.PROBLEMS, *coupling_mpm.PROBLEMS)

__all__ = ["PROBLEMS"]
