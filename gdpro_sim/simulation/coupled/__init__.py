"""Rigid bodies in MuJoCo that meet soft ones in FEM and MPM, two ways."""

from gdpro_sim.simulation.coupled.solver import SolverCoupled

__all__ = ["SolverCoupled"]
