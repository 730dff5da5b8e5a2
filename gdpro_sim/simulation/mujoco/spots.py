"""Points that MuJoCo's bodies carry: where they are, how fast they go, and what forces on them do."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import scipy.sparse as sparse

from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco import soft
from gdpro_sim.simulation.mujoco_model import RigidBody, SoftBody


class Spots:
    """The points `ids` [n] of a model, as `MujocoWorld.firsts` counts them.

    names: of every body, as the compiled model knows them; points: of every soft body, None for a rigid one
    """

    def __init__(
        self,
        model: Model,
        compiled: mujoco.MjModel,
        names: Sequence[str],
        points: Sequence[soft.Points | None],
        ids: np.ndarray,
    ) -> None:
        assert model.mujoco is not None
        self._model = compiled
        self.count = len(ids)
        rows, bodies, weights, arms = [], [], [], []
        firsts = model.mujoco.firsts()
        for item, name, moving, first, end in zip(
            model.mujoco.bodies, names, points, firsts[:-1], firsts[1:], strict=True
        ):
            (own,) = np.nonzero((ids >= first) & (ids < end))
            if not len(own):
                continue
            if isinstance(item, RigidBody):
                rows.append(own)
                bodies.append(np.full(len(own), compiled.body(name).id))
                weights.append(np.ones(len(own)))
                arms.append(item.points[ids[own] - first] - item.centre)
                continue
            assert moving is not None
            share = _shares(item)[ids[own] - first].tocoo()
            owners = np.array([compiled.body(owner).id for owner in moving.owners])
            rows.append(own[share.row])
            bodies.append(owners[share.col])
            weights.append(share.data)
            arms.append(moving.local[share.col])
        row = np.concatenate(rows) if rows else np.zeros(0, int)
        self._bodies = np.concatenate(bodies) if rows else np.zeros(0, int)
        self._arms = np.concatenate(arms) if rows else np.zeros((0, 3))
        share = np.concatenate(weights) if rows else np.zeros(0)
        entries = np.arange(len(row))
        self._gather = sparse.csr_matrix((share, (row, entries)), shape=(self.count, len(row)))
        self._scatter = sparse.csr_matrix(
            (np.ones(len(row)), (self._bodies, entries)), shape=(compiled.nbody, len(row))
        )

    def positions(self, data: mujoco.MjData) -> np.ndarray:
        """[n, 3] m."""
        found: np.ndarray = self._gather @ (data.xpos[self._bodies] + self._turned(data))
        return found

    def velocities(self, data: mujoco.MjData) -> np.ndarray:
        """[n, 3] m/s."""
        model, b = self._model, self._bodies
        angular, carried = data.cvel[b, :3], data.cvel[b, 3:]
        at = data.xpos[b] + self._turned(data) - data.subtree_com[model.body_rootid[b]]
        found: np.ndarray = self._gather @ (carried + np.cross(angular, at))
        return found

    def wrenches(self, data: mujoco.MjData, forces: np.ndarray) -> np.ndarray:
        """[nbody, 6] N and N m about each body's centre of mass, of forces [n, 3] N on the points."""
        each = self._gather.T @ forces
        arms = data.xpos[self._bodies] + self._turned(data) - data.xipos[self._bodies]
        found: np.ndarray = self._scatter @ np.concatenate([each, np.cross(arms, each)], axis=1)
        return found

    def jacobian(self, data: mujoco.MjData) -> sparse.csr_matrix:
        """[3 n, nv]: velocities of the points by those of the joints."""
        places = data.xpos[self._bodies] + self._turned(data)
        one = np.zeros((3, self._model.nv))
        rows = []
        for body, place in zip(self._bodies.tolist(), places, strict=True):
            mujoco.mj_jac(self._model, data, one, None, place, body)
            rows.append(sparse.csr_matrix(one))
        return sparse.kron(self._gather, sparse.identity(3)) @ sparse.vstack(rows)

    def _turned(self, data: mujoco.MjData) -> np.ndarray:
        turns = data.xmat.reshape(-1, 3, 3)[self._bodies]
        arms: np.ndarray = np.einsum("eij,ej->ei", turns, self._arms)
        return arms


def _shares(body: SoftBody) -> sparse.csr_matrix:
    """[P, n] of what moves in each vertex."""
    if body.reduction == "full":
        return sparse.identity(len(body.vertices), format="csr")
    return sparse.csr_matrix(soft.grid(body)[1])


__all__ = ["Spots"]
