"""What a MuJoCo simulation does, frame by frame, as arrays: poses, velocities, joints, sensors, contacts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.simulation.conditions import Pose
from gdpro_sim.simulation.mujoco import soft
from gdpro_sim.simulation.mujoco.links import visible_geoms
from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo
from gdpro_sim.simulation.mujoco_model import RigidBody, SoftBody

BACKGROUND, FLOOR = 0, 1
"""Labels of what is no thing."""

WORLD = "world"
"""Name of what of a base does not move."""

Kind = Literal["rigid", "soft", "obstacle", "link"]


@dataclass(frozen=True)
class Thing:
    """Something of a scene that has a label of its own: a body, an obstacle, or a link of the base."""

    label: int
    name: str
    kind: Kind


class Layout:
    """Which things, joints, actuators and sensors a solver's trajectories have. The same for a whole dataset.

    things:  by ascending label, from `FLOOR` + 1; the last stands for all of a base that does not move
    posed:   those of them that have a pose: all but soft bodies and obstacles that stand still
    joints:  (name, kind, first and number of columns of `qpos`, first and number of columns of `qvel`)
    sensors: (name, first and number of columns of `sensors`)
    geom_labels, obstacle_labels: of MuJoCo's geoms, and of what `Simulation.obstacles` lists
    """

    def __init__(self, solver: SolverMuJoCo) -> None:
        model, world = solver.mjmodel, solver.world
        numbers = [0 if points is not None else model.body(name).id
                   for name, points in zip(world.names, world.points, strict=True)]  # fmt: skip
        things: list[Thing] = []
        self.body_labels: dict[int, int] = {}
        self.posed: list[tuple[Thing, int]] = []

        def add(name: str, kind: Kind, number: int) -> None:
            thing = Thing(FLOOR + 1 + len(things), name, kind)
            things.append(thing)
            if number:
                self.body_labels[number] = thing.label
                self.posed.append((thing, number))

        for body, number in zip(solver.bodies, numbers, strict=True):
            add(body.name, "rigid" if number else "soft", number)
        for collider, title in zip(solver.model.colliders, world.obstacles, strict=True):
            add(collider.name, "obstacle", model.body(title).id if title else 0)
        points = _points(solver)
        for number in range(1, model.nbody):
            if number not in self.body_labels and number not in points:
                add(model.body(number).name or f"body {number}", "link", number)
        own = solver.world.geoms
        scenery = [
            k for k in range(model.ngeom) if not model.geom_bodyid[k] and model.geom(k).name not in own
        ]
        if scenery:
            add(WORLD, "link", 0)
        self.things = tuple(things)
        self.geom_labels = _geom_labels(solver, self)
        self.joints, self.columns = _joints(solver, points)
        self.sensors = tuple(
            (model.sensor(k).name, int(model.sensor_adr[k]), int(model.sensor_dim[k]))
            for k in range(model.nsensor)
        )
        self.actuators = tuple(model.actuator(k).name for k in range(model.nu))
        self.obstacle_labels = _obstacle_labels(solver, self)


class Trajectory:
    """Arrays of one run of a solver, filled by `see` at ascending frames; SI units, world axes.

    placed: of every body: rotation and shift m from its asset's frame to the world at the start
    """

    def __init__(self, solver: SolverMuJoCo, layout: Layout, placed: Sequence[Pose]) -> None:
        self.solver, self.layout = solver, layout
        self._placed = placed
        self._numbers = {name: k for k, name in enumerate(solver.world.names)}
        self._columns: dict[str, list[np.ndarray]] = {}
        self._contacts: dict[str, list[np.ndarray]] = {}
        self.start_penetration = 0.0

    @property
    def frames(self) -> int:
        """How many were seen."""
        return len(self._columns.get("time", ()))

    def see(self) -> None:
        """Keep the state at which the solver stands as the next frame."""
        solver, model = self.solver, self.solver.mjmodel
        data = solver.forward()
        row: dict[str, np.ndarray] = {"time": np.array(solver.mjdata.time)}
        poses = [self._pose(thing, number, data) for thing, number in self.layout.posed]
        ids = [number for _, number in self.layout.posed]
        row["positions"] = np.array([shift for _, shift in poses]).reshape(-1, 3)
        row["quaternions"] = _quaternions(np.array([turn for turn, _ in poses]).reshape(-1, 3, 3))
        row["centers"] = data.xipos[ids].copy()
        motion = np.zeros((len(ids), 6))
        for k, number in enumerate(ids):
            mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_BODY, number, motion[k], 0)
        row["angular_velocities"], row["velocities"] = motion[:, :3], motion[:, 3:]
        at, moving = self.layout.columns
        row["qpos"], row["qvel"] = data.qpos[at].copy(), data.qvel[moving].copy()
        row["controls"], row["sensors"] = data.ctrl.copy(), data.sensordata.copy()
        for k, body in enumerate(solver.bodies):
            if isinstance(body, SoftBody):
                row[f"vertices.{body.name}"] = solver.vertices(k).astype(np.float32)
        self._see_contacts(data)
        for key, value in row.items():
            self._columns.setdefault(key, []).append(value)

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything seen: [T, ...], contacts [M, ...] one after the other."""
        found = {key: np.stack(rows) for key, rows in self._columns.items()}
        return {**found, **{key: np.concatenate(rows) for key, rows in self._contacts.items()}}

    def _pose(self, thing: Thing, number: int, data: Any) -> Pose:
        """Of a body's asset frame; of a link or obstacle MuJoCo's own."""
        turn = data.xmat[number].reshape(3, 3)
        if thing.kind != "rigid":
            return turn.copy(), data.xpos[number].copy()
        k = thing.label - FLOOR - 1
        body, (placed, shift) = self.solver.bodies[k], self._placed[k]
        assert isinstance(body, RigidBody)
        return turn @ placed, turn @ (shift - body.centre) + data.xpos[number]

    def _see_contacts(self, data: Any) -> None:
        model, layout, frame, contact = self.solver.mjmodel, self.layout, self.frames, data.contact
        count = data.ncon
        labels = np.zeros((count, 2), np.int32)
        forces = np.zeros((count, 6))
        flexes = list(self.solver.flexes.items())
        soft_labels = {flex: FLOOR + 1 + body for body, flex in flexes}
        for k in range(count):
            for side in range(2):
                geom, flex = int(contact.geom[k, side]), int(contact.flex[k, side])
                labels[k, side] = layout.geom_labels[geom] if geom >= 0 else soft_labels[flex]
            mujoco.mj_contactForce(model, data, k, forces[k])
        axes = contact.frame.reshape(-1, 3, 3) if count else np.zeros((0, 3, 3))
        found = {
            "contact_frames": np.full(count, frame, np.int32),
            "contact_labels": labels,
            "contact_positions": np.array(contact.pos).reshape(-1, 3),
            "contact_normals": axes[:, 0].copy(),
            "contact_distances": np.array(contact.dist).reshape(-1),
            "contact_forces": np.einsum("ci,cij->cj", forces[:, :3], axes),
        }
        if frame == 0 and count:
            self.start_penetration = max(0.0, -float(found["contact_distances"].min()))
        for key, value in found.items():
            self._contacts.setdefault(key, []).append(value)


def _points(solver: SolverMuJoCo) -> set[int]:
    """Bodies that are points of soft ones, or move their pins."""
    names = [own for points in solver.world.points if points is not None for own in points.names if own]
    for body, name in zip(solver.bodies, solver.world.names, strict=True):
        if isinstance(body, SoftBody):
            names += [soft.pin_name(name, k) for k in range(len(body.motions))]
    return {int(solver.mjmodel.body(name).id) for name in names}


def _geom_labels(solver: SolverMuJoCo, layout: Layout) -> np.ndarray:
    """[ngeom]: of the thing that a geom belongs to, `FLOOR` of the ground."""
    model, own = solver.mjmodel, solver.world.geoms
    labels = np.array([layout.body_labels.get(int(k), layout.things[-1].label) for k in model.geom_bodyid])
    for k in np.flatnonzero(model.geom_bodyid == 0).tolist():
        if model.geom(k).name in own:
            labels[k] = FLOOR
    obstacles = (thing for thing in layout.things if thing.kind == "obstacle")
    for thing, names in zip(obstacles, solver.world.obstacle_geoms, strict=True):
        for name in names:
            labels[model.geom(name).id] = thing.label
    return labels.astype(np.int32)


def _obstacle_labels(solver: SolverMuJoCo, layout: Layout) -> tuple[int, ...]:
    """Of what `Simulation.obstacles` lists: colliders, then visible geoms of the base."""
    labels = [thing.label for thing in layout.things if thing.kind == "obstacle"]
    if solver.links:
        shown = visible_geoms(solver.mjmodel, solver.world.geoms, floor=solver.model.ground is None)
        labels += layout.geom_labels[shown].tolist()
    return tuple(labels)


def _joints(
    solver: SolverMuJoCo, points: set[int]
) -> tuple[tuple[tuple[str, str, int, int, int, int], ...], tuple[np.ndarray, np.ndarray]]:
    """Joints of all but points of soft bodies, and their columns in MuJoCo's qpos and qvel."""
    model = solver.mjmodel
    sizes = {"free": (7, 6), "ball": (4, 3), "slide": (1, 1), "hinge": (1, 1)}
    joints: list[tuple[str, str, int, int, int, int]] = []
    at: list[int] = []
    moving: list[int] = []
    for k in range(model.njnt):
        if int(model.jnt_bodyid[k]) in points:
            continue
        kind = mujoco.mjtJoint(model.jnt_type[k]).name.removeprefix("mjJNT_").lower()
        wide, free = sizes[kind]
        joints.append((model.joint(k).name, kind, len(at), wide, len(moving), free))
        at += range(model.jnt_qposadr[k], model.jnt_qposadr[k] + wide)
        moving += range(model.jnt_dofadr[k], model.jnt_dofadr[k] + free)
    return tuple(joints), (np.array(at, np.int64), np.array(moving, np.int64))


def _quaternions(turns: np.ndarray) -> np.ndarray:
    """wxyz [n, 4], w >= 0, of rotations [n, 3, 3]."""
    if not len(turns):
        return np.zeros((0, 4))
    x, y, z, w = Rotation.from_matrix(turns).as_quat(canonical=True).T
    return np.stack([w, x, y, z], axis=1)


__all__ = ["BACKGROUND", "FLOOR", "Layout", "Thing", "Trajectory"]
