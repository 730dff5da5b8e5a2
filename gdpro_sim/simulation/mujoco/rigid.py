"""Rigid bodies and obstacles as MuJoCo bodies."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.simulation.mujoco.contacts import DEFAULT, reference, set_contact
from gdpro_sim.simulation.mujoco_model import RigidBody, Shape

GEOMS = {
    "box": mujoco.mjtGeom.mjGEOM_BOX,
    "sphere": mujoco.mjtGeom.mjGEOM_SPHERE,
    "capsule": mujoco.mjtGeom.mjGEOM_CAPSULE,
    "cylinder": mujoco.mjtGeom.mjGEOM_CYLINDER,
}

JOINTS = {
    "free": mujoco.mjtJoint.mjJNT_FREE,
    "hinge": mujoco.mjtJoint.mjJNT_HINGE,
    "slide": mujoco.mjtJoint.mjJNT_SLIDE,
    "ball": mujoco.mjtJoint.mjJNT_BALL,
}

HEAVY = 1e6
"""A driven body weighs so many times what it meets: contact does not turn it from its way."""

COLOR = (0.7, 0.7, 0.7, 1.0)


def quaternion(rotation: np.ndarray) -> list[float]:
    """(w, x, y, z) of a rotation [3, 3]."""
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    return [w, x, y, z]


def add_rigid(
    spec: mujoco.MjSpec, body: RigidBody, name: str, timestep: float, weight: float
) -> tuple[Any, list[Any]]:
    """The body, its frame at its centre of mass along the world's axes at the start, and its geoms.

    weight: kg that it meets, should it be driven
    """
    solref = reference(body.restitution, timestep)
    if body.motion is not None:
        size = float(np.linalg.norm(np.ptp(body.surface, axis=0)))
        added = add_driven(spec, name, weight, max(size, 0.1))
        added.pos = body.centre.tolist()
        return added, add_shapes(spec, added, body.shapes, name, body.friction, solref)
    added = spec.worldbody.add_body(name=name, pos=body.centre.tolist())
    set_mass(added, body.mass, body.inertia)
    joint = body.joint
    if joint.kind != "fixed":
        item = added.add_joint(DEFAULT, name=name, type=JOINTS[joint.kind])
        if joint.kind == "free":
            item.align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
        else:
            item.axis = list(joint.axis)
            item.pos = (np.asarray(joint.anchor) - body.centre).tolist()
            item.damping = [joint.damping, 0.0, 0.0]
            turns = joint.kind == "hinge"
            degrees = turns and bool(spec.compiler.degree)
            if joint.limits is not None:
                item.limited = mujoco.mjtLimited.mjLIMITED_TRUE
                item.range = [float(np.degrees(x)) if degrees else x for x in joint.limits]
    return added, add_shapes(spec, added, body.shapes, name, body.friction, solref)


def add_driven(spec: mujoco.MjSpec, name: str, mass: float, size: float = 1.0) -> Any:
    """A body of `size` m at the origin that is put on its way before every step; contact knows its speed.

    It moves freely within a step, and weighs so much more than the `mass` in kg it meets that it hardly does.
    """
    added = spec.worldbody.add_body(name=name, gravcomp=1.0)
    set_mass(added, HEAVY * mass, HEAVY * mass * size * size * np.eye(3))
    item = added.add_joint(DEFAULT, name=name, type=mujoco.mjtJoint.mjJNT_FREE)
    item.align = mujoco.mjtAlignFree.mjALIGNFREE_FALSE
    return added


def set_mass(added: Any, mass: float, inertia: np.ndarray, centre: np.ndarray | None = None) -> None:
    """Mass in kg at the body's origin, or `centre` [3] m, and inertia [3, 3] kg m^2 about it."""
    added.explicitinertial = True
    added.mass, added.ipos = mass, [0.0, 0.0, 0.0] if centre is None else centre.tolist()
    moments, axes = np.linalg.eigh(0.5 * (inertia + inertia.T))
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    added.inertia, added.iquat = moments.tolist(), quaternion(axes)


def load_mass(added: Any, body: RigidBody, points: np.ndarray, masses: np.ndarray) -> None:
    """Weigh the body with point masses [n] kg at [n, 3] m that it carries."""
    total = body.mass + masses.sum()
    arms = points - body.centre
    centre = masses @ arms / total
    whole = np.concatenate([[-centre], arms - centre])
    squares = np.concatenate([[body.mass], masses])[:, None, None] * (
        (whole**2).sum(axis=1)[:, None, None] * np.eye(3) - whole[:, :, None] * whole[:, None, :]
    )
    set_mass(added, float(total), body.inertia + squares.sum(axis=0), centre)


def add_shapes(
    spec: mujoco.MjSpec,
    added: Any,
    shapes: tuple[Shape, ...],
    name: str,
    friction: float,
    solref: tuple[float, float],
) -> list[Any]:
    """The geoms of a body; "mesh" shapes become assets of the spec."""
    geoms = []
    for k, shape in enumerate(shapes):
        title = f"{name}_{k}" if len(shapes) > 1 else name
        geom = added.add_geom(DEFAULT, name=title)
        geom.pos, geom.quat = shape.position.tolist(), quaternion(shape.rotation)
        if shape.kind == "mesh":
            assert shape.vertices is not None and shape.faces is not None
            mesh = spec.add_mesh(DEFAULT, name=title)
            mesh.uservert = np.asarray(shape.vertices, np.float64).ravel().tolist()
            mesh.userface = np.asarray(shape.faces).ravel().tolist()
            geom.type, geom.meshname = mujoco.mjtGeom.mjGEOM_MESH, title
        else:
            geom.type = GEOMS[shape.kind]
            geom.size = [*shape.size, 0.0, 0.0][:3]
        geom.mass, geom.group, geom.rgba = 0.0, 0, list(COLOR)
        set_contact(geom, friction, solref)
        geoms.append(geom)
    return geoms


__all__ = ["add_driven", "add_rigid", "add_shapes", "load_mass", "quaternion", "set_mass"]
