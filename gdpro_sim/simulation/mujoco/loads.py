"""Springs, forces, impulses, wind and pressure as wrenches on MuJoCo's bodies, before every one of its steps.

Springs and wind are those of `gdpro_sim.kernels.springs` and `gdpro_sim.kernels.forces`. They are taken at
the start of a step (explicitly), so the steps are as short as the stiffest spring asks for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
import scipy.sparse as sparse

from gdpro_sim.simulation.conditions import Force, Impulse, Load, Pressure, Springs, Wind
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco.soft import Points
from gdpro_sim.simulation.mujoco.spots import Spots
from gdpro_sim.simulation.mujoco.wind import RigidWind, blown
from gdpro_sim.simulation.mujoco_model import RigidBody

PHASE = 0.5
"""A step turns the fastest spring by at most so many rad: its period is then right to one percent."""

INSTANT = 1e-9
"""s; an impulse acts in the step that holds its time plus this: steps end on frame times up to rounding."""


class Loads:
    """Everything of a model that pulls and pushes its bodies in MuJoCo.

    longest: s, of a step that all springs bear; inf where there are none
    """

    def __init__(
        self,
        model: Model,
        compiled: mujoco.MjModel,
        names: Sequence[str],
        points: Sequence[Points | None],
        timestep: float,
    ) -> None:
        self._model = compiled
        self._winds, self._loads = _split(model, compiled, names)
        used = [_vertices(load).ravel() for load in self._loads]
        if model.springs is not None:
            used.append(model.springs.corners.ravel())
        ids = np.unique(np.concatenate(used)) if used else np.zeros(0, np.int64)
        self._spots = Spots(model, compiled, names, points, ids)
        self._slots = [np.searchsorted(ids, _vertices(load)) for load in self._loads]
        self._springs = model.springs
        self.longest = math.inf
        if model.springs is not None:
            self._ends = _ends(model.springs, ids)
            self._springs, self.longest = _bearable(
                compiled, self._spots, self._ends, model.springs, timestep
            )

    def __bool__(self) -> bool:
        return self._spots.count + len(self._winds) > 0

    def wrenches(self, data: mujoco.MjData, time: float, h: float) -> np.ndarray:
        """[nbody, 6] N and N m about centres of mass, for a step of `h` s from `time` on.

        data: with the positions and velocities of bodies (`mj_kinematics`, `mj_comPos`, `mj_comVel`)
        """
        x, v = self._spots.positions(data), self._spots.velocities(data)
        forces = np.zeros_like(x)
        for load, slots in zip(self._loads, self._slots, strict=True):
            share = _share(load, time, h)
            if share > 0.0:
                forces += share * _forces(load, slots, x, v)
        if self._springs is not None:
            forces += self._pull(self._springs, x, v)
        found = self._spots.wrenches(data, forces)
        for wind in self._winds:
            share = _share(wind.wind, time, h)
            if share > 0.0:
                found[wind.number] += share * wind.wrench(self._model, data)
        return found

    def stored(self, data: mujoco.MjData) -> float:
        """J in springs."""
        if self._springs is None:
            return 0.0
        apart = self._ends @ self._spots.positions(data) + np.diff(self._springs.anchors, axis=1)[:, 0]
        stretch = np.linalg.norm(apart, axis=1) - self._springs.rest_length
        return 0.5 * float(self._springs.stiffness @ stretch**2)

    def _pull(self, springs: Springs, x: np.ndarray, v: np.ndarray) -> np.ndarray:
        """[n, 3] N."""
        apart = self._ends @ x + np.diff(springs.anchors, axis=1)[:, 0]
        rate = self._ends @ v
        length = np.linalg.norm(apart, axis=1, keepdims=True)
        toward = apart / np.where(length > 0.0, length, 1.0)
        rest = springs.rest_length[:, None]
        along = np.where(rest > 0.0, toward * (toward * rate).sum(axis=1, keepdims=True), rate)
        tension = springs.stiffness[:, None] * (apart - rest * toward) + springs.damping[:, None] * along
        pulled: np.ndarray = -(self._ends.T @ tension)
        return pulled


def _split(
    model: Model, compiled: mujoco.MjModel, names: Sequence[str]
) -> tuple[list[RigidWind], list[Load]]:
    """Wind on rigid bodies, and all other loads."""
    assert model.mujoco is not None
    firsts = model.mujoco.firsts()
    winds: list[RigidWind] = []
    others: list[Load] = []
    for load in model.loads:
        if not isinstance(load, Wind):
            others.append(load)
            continue
        left = np.ones(len(load.faces), bool)
        for body, name, first, end in zip(model.mujoco.bodies, names, firsts[:-1], firsts[1:], strict=True):
            own = (load.faces[:, 0] >= first) & (load.faces[:, 0] < end)
            if isinstance(body, RigidBody) and own.any():
                winds.append(RigidWind(load, body, compiled.body(name).id, load.faces[own] - first))
                left &= ~own
        if left.any():
            others.append(replace(load, faces=load.faces[left]))
    return winds, others


def _vertices(load: Load) -> np.ndarray:
    return load.vertices if isinstance(load, Force | Impulse) else load.faces


def _share(load: Load, time: float, h: float) -> float:
    """Of a step that a load acts; of impulses by time."""
    if isinstance(load, Impulse):
        return 1.0 / h if time <= load.time + INSTANT < time + h else 0.0
    overlap = min(load.end, time + h) - max(load.start, time)
    return min(1.0, max(0.0, overlap / h))


def _forces(load: Load, slots: np.ndarray, x: np.ndarray, v: np.ndarray) -> np.ndarray:
    """[n, 3] N at positions and velocities [n, 3]; N s of an impulse."""
    if isinstance(load, Force | Impulse):
        found = np.zeros_like(x)
        np.add.at(found, slots, load.forces if isinstance(load, Force) else load.impulses)
        return found
    a, b, c = (x[slots[:, k]] for k in range(3))
    area = np.cross(b - a, c - a) / 2.0
    if isinstance(load, Pressure):
        each = -load.pressure * area
    else:
        each = blown(load, area, np.asarray(load.velocity) - v[slots].mean(axis=1))
    found = np.zeros_like(x)
    for k in range(3):
        for axis in range(3):
            found[:, axis] += np.bincount(slots[:, k], each[:, axis] / 3.0, minlength=len(x))
    return found


def _ends(springs: Springs, ids: np.ndarray) -> sparse.csr_matrix:
    """[S, n]: from the first to the second end, of positions of the points `ids`."""
    count = len(springs.stiffness)
    signed = springs.weights * np.array([-1.0, 1.0])[None, :, None]
    slots = np.clip(np.searchsorted(ids, springs.corners), 0, len(ids) - 1)
    rows = np.broadcast_to(np.arange(count)[:, None, None], slots.shape)
    return sparse.csr_matrix((signed.ravel(), (rows.ravel(), slots.ravel())), shape=(count, len(ids)))


def _bearable(
    compiled: mujoco.MjModel, spots: Spots, ends: sparse.csr_matrix, springs: Springs, timestep: float
) -> tuple[Springs, float]:
    """The springs with stiffnesses for those that say none, and the longest step in s that all bear.

    A = J M^-1 J^T, of the springs' spans, says how a pull at one moves another; K A has the squares of the
    angular frequencies. Rows of |A| bound them.
    """
    data = mujoco.MjData(compiled)
    mujoco.mj_forward(compiled, data)
    count, nv = len(springs.stiffness), compiled.nv
    if nv == 0:
        return springs, math.inf
    jacobian = (sparse.kron(ends, sparse.identity(3)) @ spots.jacobian(data)).toarray()
    solved = np.zeros_like(jacobian)
    mujoco.mj_solveM(compiled, data, solved, jacobian)
    moved = (jacobian @ solved.T).reshape(count, 3, count, 3).transpose(0, 2, 1, 3)
    reach = np.linalg.norm(moved, ord=2, axis=(2, 3)).sum(axis=1)
    reach = np.maximum(reach, 1e-300)
    stiffest = PHASE**2 / (timestep**2 * reach)
    open_ = np.isinf(springs.stiffness)
    stiffness = np.where(open_, stiffest, springs.stiffness)
    damping = np.where(open_, 2.0 * stiffness * timestep, springs.damping)
    rate = float((damping[~open_] * reach[~open_]).max(initial=0.0))
    frequency = math.sqrt(float((stiffness[~open_] * reach[~open_]).max(initial=0.0)))
    longest = min(PHASE / frequency if frequency else math.inf, PHASE / rate if rate else math.inf)
    return replace(springs, stiffness=stiffness, damping=damping), longest


__all__ = ["Loads"]
