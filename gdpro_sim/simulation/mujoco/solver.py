"""MuJoCo behind the `Solver` protocol: rigid bodies and flexes, obstacles on keyframes, exact states."""

from __future__ import annotations

import logging
import math
import re
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.callbacks import Callback, taken
from gdpro_sim.simulation.conditions import Guide, Motion, pose_at
from gdpro_sim.simulation.model import Diagnostics, Model
from gdpro_sim.simulation.mujoco import soft
from gdpro_sim.simulation.mujoco.controls import called
from gdpro_sim.simulation.mujoco.energy import elastic_energy, volume_ratios
from gdpro_sim.simulation.mujoco.links import link_of, poses_since, visible_geoms
from gdpro_sim.simulation.mujoco.loads import Loads
from gdpro_sim.simulation.mujoco.world import World, build, compile_spec
from gdpro_sim.simulation.mujoco_model import RigidBody, SoftBody

log = logging.getLogger(__name__)

STATE = mujoco.mjtState.mjSTATE_INTEGRATION | mujoco.mjtState.mjSTATE_PLASTIC
"""What MuJoCo needs to continue to the same bytes."""

WARNINGS = {
    mujoco.mjtWarning.mjWARN_BADQPOS: "positions are not finite",
    mujoco.mjtWarning.mjWARN_BADQVEL: "velocities are not finite",
    mujoco.mjtWarning.mjWARN_BADQACC: "accelerations are not finite",
    mujoco.mjtWarning.mjWARN_CONTACTFULL: "there are too many contacts for the memory it has",
    mujoco.mjtWarning.mjWARN_CNSTRFULL: "there are too many constraints for the memory it has",
}

UNCONVERGED = mujoco.mjtWarning.mjWARN_INERTIA
"""Says that the elasticity of a flex was not solved to its tolerance, too."""

ELASTIC = 1e-4
"""Relative residual of a flex's elasticity that will do; MuJoCo warns from 1e-6 on."""

_warned = threading.local()


def _note(text: str) -> None:
    """MuJoCo would print its warnings, and write them to a file where the program runs."""
    log.debug("MuJoCo: %s", " ".join(str(text).split()))
    found = re.search(r"relative residual of ([0-9.e+-]*[0-9])", str(text))
    if found:
        _warned.residual = float(found[1])


mujoco.set_mju_user_warning(_note)


@dataclass
class _Count:
    """Of the last step."""

    substeps: int = 0
    iterations: int = 0
    converged: bool = True
    residual: float = 0.0


class SolverMuJoCo:
    """Rigid and soft bodies in MuJoCo.

    mjmodel, mjdata: MuJoCo's own; actuators of a base may be driven through `mjdata.ctrl` between steps
    callback:        (time in s, `mjdata`) -> what actuators are told by name, or of all in their order, or
                     None; called before every step of MuJoCo, after the keyframes. What it depends on besides
                     is not part of the state
    renamed:         (our name, the name taken) of bodies whose names a base had already
    flexes:          MuJoCo's number of every soft body's flex, by number of the body
    links:           what a base looks like at the start: its visible geoms
    counted:         [nbody] bool, bodies that diagnostics count: not the obstacles that are moved
    wrenches:        [nbody, 6] N and N m about the centre of mass, world axes: they push bodies in every step
                     until they are changed, and are no part of the state

    Raises SceneError for a scene that MuJoCo cannot compile.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        assert model.mujoco is not None
        self.world: World = build(model)
        self.bodies = model.mujoco.bodies
        self.renamed = self.world.renamed
        for ours, name in self.renamed:
            log.warning("the name %r is taken; what has it here is called %r in MuJoCo", ours, name)
        self.mjmodel = compile_spec(self.world.spec, str(model.mujoco.base or "the scene"))
        self.mjdata = mujoco.MjData(self.mjmodel)
        self._view = mujoco.MjData(self.mjmodel)
        self.flexes = {
            i: mujoco.mj_name2id(self.mjmodel, mujoco.mjtObj.mjOBJ_FLEX, name)
            for i, (name, points) in enumerate(zip(self.world.names, self.world.points, strict=True))
            if points is not None
        }
        self._driven = list(self._driven_bodies())
        driven = {self.mjmodel.body(name).id for name, *_ in self._driven}
        self.counted = np.array([i not in driven for i in range(self.mjmodel.nbody)])
        self.wrenches = np.zeros((self.mjmodel.nbody, 6))
        self.callback: Callback | Callable[..., Any] | None = model.mujoco.callback
        self._timestep = model.mujoco.settings.timestep
        self._loads = Loads(model, self.mjmodel, self.world.names, self.world.points, self._timestep)
        if self._loads.longest < self._timestep:
            self._timestep = self._loads.longest
            log.info("springs ask for steps of %.2g s at most", self._timestep)
        self._count = _Count()
        self.reset()
        shown = visible_geoms(self.mjmodel, self.world.geoms, floor=model.ground is None)
        self._shown = shown if model.mujoco.base is not None else shown[:0]
        self.links = tuple(link_of(self.mjmodel, self._view, geom) for geom in self._shown.tolist())
        turns = self._view.geom_xmat[self._shown].reshape(-1, 3, 3)
        self._linked = turns.copy(), self._view.geom_xpos[self._shown].copy()

    # ---- Solver ----

    def reset(self) -> None:
        """Back to the model's initial state."""
        mujoco.mj_resetData(self.mjmodel, self.mjdata)
        if self.world.start is not None:  # the base's joints and actuators come first
            positions, velocities, controls = self.world.start
            self.mjdata.qpos[: len(positions)] = positions
            self.mjdata.qvel[: len(velocities)] = velocities
            self.mjdata.ctrl[: len(controls)] = controls
        for body, name, points in zip(self.bodies, self.world.names, self.world.points, strict=True):
            if isinstance(body, RigidBody):
                self._start_rigid(body, name)
            elif isinstance(body, SoftBody) and points is not None:
                moving = soft.velocities(body, points.positions)
                for i in (k for k, own in enumerate(points.names) if own):
                    address = self.mjmodel.body_dofadr[self.mjmodel.body(points.names[i]).id]
                    self.mjdata.qvel[address : address + 3] = moving[i]
        self._drive(0.0, 0.0)
        self._count = _Count()
        self._look()

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds, in equal parts no longer than the time step of the settings."""
        if not (math.isfinite(dt) and dt > 0.0):
            raise SolverError(f"dt must be > 0 s, got {dt}")
        count = self.substeps(dt)
        before = self._state()
        model, data = self.mjmodel, self.mjdata
        model.opt.timestep = dt / count
        result = _Count(substeps=count)
        for warning in data.warning:
            warning.number = 0
        begin = data.time
        for k in range(count):
            self._drive(begin + k * dt / count, dt / count)
            try:
                self._push(dt / count)
                self._control()
            except SolverError:
                mujoco.mj_setState(model, data, before, STATE)
                raise
            _warned.residual = 1.0  # what it is is said once, until the number of warnings is put back
            data.warning[int(UNCONVERGED)].number = 0
            mujoco.mj_step(model, data)
            if data.warning[int(UNCONVERGED)].number:
                result.residual = max(result.residual, _warned.residual)
            rounds = int(np.max(data.solver_niter)) if data.nefc else 0
            result.iterations += rounds
            result.converged &= rounds < model.opt.iterations
        result.converged &= result.residual <= ELASTIC
        self._drive(begin + dt, 0.0)
        bad = next((text for kind, text in WARNINGS.items() if data.warning[int(kind)].number), None)
        if bad is None and not (np.isfinite(data.qpos).all() and np.isfinite(data.qvel).all()):
            bad = "positions are not finite"
        if bad is not None:
            time = data.time
            mujoco.mj_setState(model, data, before, STATE)
            raise SolverError(
                f"MuJoCo failed near {time:.4g} s: {bad}; lower solver.timestep (now {dt / count:.3g} s), "
                "or soften or separate what meets"
            )
        self._count = result
        self._look()

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of a body, [V, 3] float32 m, world."""
        item = self.bodies[body]
        if isinstance(item, RigidBody):
            turn, shift = self.pose(body)
            return (item.surface @ turn.T + shift).astype(np.float32)
        embedding = self.model.bodies[body].embedding
        assert embedding is not None
        corners = self.vertices(body)[item.tets[embedding.tet_ids]]
        return np.einsum("vw,vwc->vc", embedding.weights.astype(np.float64), corners).astype(np.float32)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes: MuJoCo's integration state, float64."""
        return {"mujoco": self._state(), "count": self._counts()}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict`. Raises SolverError for one of another model."""
        size = mujoco.mj_stateSize(self.mjmodel, STATE)
        found = np.asarray(state.get("mujoco", np.zeros(0)), np.float64)
        if found.shape != (size,):
            raise SolverError(
                f"the state holds {found.size} numbers, this model has {size}: it is of another"
            )
        mujoco.mj_setState(self.mjmodel, self.mjdata, found, STATE)
        substeps, iterations, converged, residual = np.asarray(state["count"]).tolist()
        self._count = _Count(int(substeps), int(iterations), bool(converged), residual)
        self._look()

    def diagnostics(self) -> Diagnostics:
        """Energies in J, momenta about the world's origin, contacts; obstacles and pins do not count."""
        model, data = self.mjmodel, self._view
        counted = self.counted
        mass = model.body_mass[counted]
        positions, linear, angular, inertia = self._motion(counted)
        spin = np.einsum("bij,bj->bi", inertia, angular)
        kinetic = 0.5 * (mass * (linear**2).sum(1)).sum() + 0.5 * (angular * spin).sum()
        momentum = mass @ linear
        turning = (np.cross(positions, linear) * mass[:, None] + spin).sum(axis=0)
        gravity = -float(mass @ (positions @ np.asarray(self.model.gravity)))
        elastic, ratio = 0.0, 1.0
        for i in self.flexes:
            body = self.bodies[i]
            assert isinstance(body, SoftBody)
            moved = self.vertices(i)
            elastic += elastic_energy(body, moved)
            ratio = min(ratio, float(volume_ratios(body, moved).min()))
        distances = np.asarray(data.contact.dist) if data.ncon else np.zeros(1)
        return Diagnostics(
            time=float(self.mjdata.time),
            kinetic_energy=float(kinetic),
            elastic_energy=elastic,
            gravity_energy=gravity,
            contact_energy=0.0,
            momentum=_three(momentum),
            angular_momentum=_three(turning),
            contacts=int(data.ncon),
            max_penetration=max(0.0, float(-distances.min())),
            min_volume_ratio=ratio,
            substeps=self._count.substeps,
            newton_iterations=self._count.iterations,
            cg_iterations=0,
            converged=self._count.converged,
            residual=self._count.residual,
            force_energy=self._loads.stored(self._view),
        )

    # ---- more than the protocol ----

    def pose(self, body: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation [3, 3] and translation [3] m of a rigid body: x = R X + t of what started at X."""
        item = self.bodies[body]
        assert isinstance(item, RigidBody)
        number = self.mjmodel.body(self.world.names[body]).id
        turn = self._view.xmat[number].reshape(3, 3).copy()
        return turn, self._view.xpos[number] - turn @ item.centre

    def substeps(self, dt: float) -> int:
        """MuJoCo's own steps in a `step(dt)`."""
        return max(1, math.ceil(dt / self._timestep - 1e-9))

    @property
    def open_loop(self) -> bool:
        """Whether nothing but keyframes of actuators acts between steps."""
        return not (self._driven or self._loads or self.callback is not None or self.wrenches.any())

    def forward(self) -> mujoco.MjData:
        """The state as it is with forces, sensors and contacts computed; to look at."""
        mujoco.mj_forward(self.mjmodel, self._view)
        return self._view

    def link_poses(self) -> np.ndarray:
        """[L, 3, 4] rotation and shift m of every of `links` since the start."""
        return poses_since(self._view, self._shown, self._linked)

    def overlaps(self) -> list[tuple[str, str, float]]:
        """(body, part of the base, m) of bodies that are inside a base now, each where it is deepest."""
        owners = {
            self.mjmodel.body(name).id: i for i, name in enumerate(self.world.names) if i not in self.flexes
        }
        flexes = {flex: i for i, flex in self.flexes.items()}
        deepest: dict[int, tuple[str, str, float]] = {}
        for contact in self._view.contact:
            for side in (0, 1):
                geom, other = int(contact.geom[side]), int(contact.geom[1 - side])
                if geom < 0 or self.mjmodel.geom(geom).name in self.world.geoms:
                    continue
                body = owners.get(int(self.mjmodel.geom_bodyid[other]), -1) if other >= 0 else -1
                body = flexes.get(int(contact.flex[1 - side]), body)
                if body >= 0 and -contact.dist > deepest.get(body, ("", "", 0.0))[2]:
                    part = self.mjmodel.body(int(self.mjmodel.geom_bodyid[geom])).name
                    deepest[body] = self.bodies[body].name, part, -float(contact.dist)
        return list(deepest.values())

    def frames(self, numbers: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Rotations [B, 3, 3] and centres of mass [B, 3] m of MuJoCo's own bodies by their `numbers` [B]."""
        turns = self._view.xmat[numbers].reshape(-1, 3, 3)
        return turns.copy(), self._view.xipos[numbers].copy()

    def vertices(self, body: int) -> np.ndarray:
        """Positions [P, 3] float64 m of a soft body's vertices."""
        flex = self.flexes[body]
        begin, count = self.mjmodel.flex_vertadr[flex], self.mjmodel.flex_vertnum[flex]
        return soft.flex_vertices(self._view, begin, count)

    # ---- inside ----

    def _state(self) -> np.ndarray:
        state = np.zeros(mujoco.mj_stateSize(self.mjmodel, STATE))
        mujoco.mj_getState(self.mjmodel, self.mjdata, state, STATE)
        return state

    def _counts(self) -> np.ndarray:
        count = self._count
        return np.array([count.substeps, count.iterations, count.converged, count.residual], np.float64)

    def _look(self) -> None:
        """Positions, velocities and contacts of the state as it is, beside it: computing them in place would
        change what the next step starts from."""
        mujoco.mj_setState(self.mjmodel, self._view, self._state(), STATE)
        mujoco.mj_fwdPosition(self.mjmodel, self._view)
        mujoco.mj_comVel(self.mjmodel, self._view)

    def _start_rigid(self, body: RigidBody, name: str) -> None:
        kind = body.joint.kind
        if kind == "fixed":
            return
        address = int(self.mjmodel.jnt_dofadr[self.mjmodel.joint(name).id])
        axis = np.asarray(body.joint.axis) / np.linalg.norm(body.joint.axis)
        start = {
            "free": [*body.velocity, *body.angular_velocity],
            "ball": list(body.angular_velocity),
            "hinge": [float(axis @ np.asarray(body.angular_velocity))],
            "slide": [float(axis @ np.asarray(body.velocity))],
        }[kind]
        self.mjdata.qvel[address : address + len(start)] = start

    def _drive(self, time: float, h: float) -> None:
        """Put moved obstacles and pins where they are at `time`, moving as in the `h` s that follow."""
        for name, motion, rotation, position in self._driven:
            joint = self.mjmodel.joint(name)
            place, dof = int(joint.qposadr[0]), int(joint.dofadr[0])
            turn, shift = pose_at(motion, time)
            now, at = turn @ rotation, turn @ position + shift
            x, y, z, w = Rotation.from_matrix(now).as_quat()
            self.mjdata.qpos[place : place + 7] = [*at, w, x, y, z]
            if h > 0.0:
                later, moved = pose_at(motion, time + h)
                spin = Rotation.from_matrix(now.T @ later @ rotation).as_rotvec() / h
                velocity = (later @ position + moved - at) / h
                self.mjdata.qvel[dof : dof + 6] = [*velocity, *spin]
        assert self.model.mujoco is not None
        for control in self.model.mujoco.controls:
            value = np.interp(time, control.times, control.values)
            self.mjdata.actuator(control.actuator).ctrl = value

    def _push(self, h: float) -> None:
        """Set what pulls and pushes bodies in the `h` s that follow."""
        data, view = self.mjdata, self._view
        data.xfrc_applied[:] = self.wrenches
        if self._loads:
            view.qpos[:], view.qvel[:] = data.qpos, data.qvel
            mujoco.mj_kinematics(self.mjmodel, view)
            mujoco.mj_comPos(self.mjmodel, view)
            mujoco.mj_comVel(self.mjmodel, view)
            data.xfrc_applied[:] += self._loads.wrenches(view, float(data.time), h)

    def _control(self) -> None:
        """Ask the callback what actuators do. Raises SolverError where it fails."""
        if self.callback is not None:
            told = called(taken(self.callback), self.mjmodel, self.mjdata)
            for actuator, value in told.items():
                self.mjdata.ctrl[actuator] = value

    def _driven_bodies(self) -> Iterator[tuple[str, Motion | Guide, np.ndarray, np.ndarray]]:
        """(name, motion, rotation [3, 3] and position [3] m at first) of obstacles, bodies and pins moved."""
        for name, collider in zip(self.world.obstacles, self.model.colliders, strict=True):
            if collider.motion is not None:
                yield name, collider.motion, collider.rotation, collider.position
        for body, name in zip(self.bodies, self.world.names, strict=True):
            if isinstance(body, SoftBody):
                for k, motion in enumerate(body.motions):
                    yield soft.pin_name(name, k), motion, np.eye(3), np.zeros(3)
            elif body.motion is not None:
                yield name, body.motion, np.eye(3), body.centre

    def _motion(self, counted: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Centres [b, 3], their velocities [b, 3], spins [b, 3] and inertias [b, 3, 3], world axes."""
        model, data = self.mjmodel, self._view
        positions = data.xipos[counted]
        angular, carried = data.cvel[counted, :3], data.cvel[counted, 3:]
        roots = data.subtree_com[model.body_rootid[counted]]
        linear = carried + np.cross(angular, positions - roots)
        axes = data.ximat[counted].reshape(-1, 3, 3)
        inertia = np.einsum("bik,bk,bjk->bij", axes, model.body_inertia[counted], axes)
        return positions, linear, angular, inertia


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


__all__ = ["SolverMuJoCo"]
