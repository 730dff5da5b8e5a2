"""MuJoCo: rigid bodies and flexes."""

from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo

__all__ = ["SolverMuJoCo"]
