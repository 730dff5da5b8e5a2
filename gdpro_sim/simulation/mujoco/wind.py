"""Wind on triangles: the formula of `gdpro_sim.kernels.forces`, at their centres."""

from __future__ import annotations

import mujoco
import numpy as np

from gdpro_sim.simulation.conditions import Wind
from gdpro_sim.simulation.mujoco_model import FRAME, RigidBody


def blown(wind: Wind, area: np.ndarray, u: np.ndarray) -> np.ndarray:
    """[F, 3] N on triangles with outward areas [F, 3] m^2, past which air goes at [F, 3] m/s."""
    flux = np.maximum(-np.einsum("fi,fi->f", area, u), 0.0)[:, None]
    force = wind.drag * flux * u
    if wind.lift:
        size = np.sqrt(np.einsum("fi,fi->f", area, area))[:, None]
        speed = np.sqrt(np.einsum("fi,fi->f", u, u))[:, None]
        n = -area / np.where(size > 0.0, size, 1.0)
        toward = u / np.where(speed > 0.0, speed, 1.0)
        s = flux / np.where(size > 0.0, size, 1.0)
        force += wind.lift * flux * (speed * n - s * toward)
    blown_: np.ndarray = 0.5 * wind.density * force
    return blown_


class RigidWind:
    """Wind on a rigid body, number `number` of the compiled model: triangles [F, 3] of its points."""

    def __init__(self, wind: Wind, body: RigidBody, number: int, faces: np.ndarray) -> None:
        self.wind, self.number = wind, number
        corners = body.surface[faces - FRAME] - body.centre
        self._area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
        self._centre = corners.mean(axis=1)

    def wrench(self, model: mujoco.MjModel, data: mujoco.MjData) -> np.ndarray:
        """[6] N and N m about the centre of mass."""
        k = self.number
        turn = data.xmat[k].reshape(3, 3)
        spin = data.cvel[k, :3]
        velocity = data.cvel[k, 3:] + np.cross(spin, data.xpos[k] - data.subtree_com[model.body_rootid[k]])
        x, y, z = turn.T @ spin
        along = turn.T @ (np.asarray(self.wind.velocity) - velocity)
        u = along - self._centre @ np.array([[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]])
        force = blown(self.wind, self._area, u)
        total = turn @ force.sum(axis=0)
        a, b = self._centre, force
        twist = np.array(
            [
                a[:, 1] @ b[:, 2] - a[:, 2] @ b[:, 1],
                a[:, 2] @ b[:, 0] - a[:, 0] @ b[:, 2],
                a[:, 0] @ b[:, 1] - a[:, 1] @ b[:, 0],
            ]
        )
        lever = data.xpos[k] - data.xipos[k]
        return np.concatenate([total, turn @ twist + np.cross(lever, total)])


__all__ = ["RigidWind", "blown"]
