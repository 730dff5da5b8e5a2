"""Implicit finite elements on linear tetrahedra."""

from gdpro_sim.simulation.fem.solver import SolverFEM

__all__ = ["SolverFEM"]
