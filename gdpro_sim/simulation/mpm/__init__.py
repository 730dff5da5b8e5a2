"""Material point method: particles carry the matter, a grid moves them."""

from gdpro_sim.simulation.mpm.solver import SolverMPM

__all__ = ["SolverMPM"]
