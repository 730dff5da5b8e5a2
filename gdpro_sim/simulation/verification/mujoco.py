"""Every problem of rigid bodies and flexes in MuJoCo, in the order they are run."""

from __future__ import annotations

from gdpro_sim.simulation.verification import mujoco_forces, mujoco_rigid, mujoco_soft

PROBLEMS = (*mujoco_rigid.PROBLEMS, *mujoco_forces.PROBLEMS, *mujoco_soft.PROBLEMS)

__all__ = ["PROBLEMS"]
