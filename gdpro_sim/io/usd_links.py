"""Obstacles and parts of a base, a robot arm say, in simulation files: meshes that move as a whole.

/Simulation/Base/<part>            Xform: where it has moved since the start, per frame
    Mesh                           its surface at the start, in world space
/Simulation/Obstacles/<collider>   the same of a scene's colliders, but of planes and what is not visible
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from gdpro_sim.asset import prims
from gdpro_sim.io.obstacles import COLOR, surface_of
from gdpro_sim.meshing.color import srgb_to_linear
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import pose_at
from gdpro_sim.simulation.frame import Frame

BASE, OBSTACLES = "Base", "Obstacles"

NUMBER = "gdpro:number"


def define_links(stage: Usd.Stage, root: Sdf.Path, links: Sequence[Collider]) -> list[Any]:
    """Author every part where it is at the start; returns what `set_links` moves."""
    return [
        UsdGeom.Xform(part).AddTransformOp()
        for part in _define(stage, root.AppendChild(BASE), dict(enumerate(links)))
    ]


def define_obstacles(stage: Usd.Stage, root: Sdf.Path, colliders: Sequence[Collider]) -> dict[int, Any]:
    """The same for colliders that have an end and are visible; what `set_obstacles` moves, by number."""
    shown = {
        number: collider
        for number, collider in enumerate(colliders)
        if collider.visible and collider.kind != "plane"
    }
    parts = _define(stage, root.AppendChild(OBSTACLES), shown)
    moved = {
        number: part
        for (number, collider), part in zip(shown.items(), parts, strict=True)
        if collider.motion is not None or collider.mass is not None
    }
    return {number: UsdGeom.Xform(part).AddTransformOp() for number, part in moved.items()}


def set_links(ops: Sequence[Any], poses: np.ndarray, code: Usd.TimeCode) -> None:
    """Where parts are in a frame: [L, 3, 4] rotations and shifts m since the start."""
    for op, pose in zip(ops, poses, strict=True):
        _set(op, pose, code)


def set_obstacles(
    ops: Mapping[int, Any], colliders: Sequence[Collider], frame: Frame, code: Usd.TimeCode
) -> None:
    """Where colliders are in a frame, which knows it of those that no keyframes move."""
    for number, op in ops.items():
        motion = colliders[number].motion
        if frame.colliders is not None:
            _set(op, frame.colliders[number], code)
        elif motion is not None:
            _set(op, np.column_stack(pose_at(motion, frame.time)), code)


def read_links(stage: Usd.Stage, root: Sdf.Path) -> tuple[Collider, ...]:
    """The parts of a base as they are at the start, in the order of their poses."""
    return tuple(_read(stage, root.AppendChild(BASE)).values())


def read_obstacles(stage: Usd.Stage, root: Sdf.Path) -> dict[int, Collider]:
    """The surfaces of colliders as they are at the start, by number."""
    return _read(stage, root.AppendChild(OBSTACLES))


def _define(stage: Usd.Stage, group: Sdf.Path, colliders: Mapping[int, Collider]) -> list[Usd.Prim]:
    """One Xform with a mesh for each, by its number."""
    if not colliders:
        return []
    UsdGeom.Xform.Define(stage, group)
    parts = []
    for number, collider in colliders.items():
        path = group.AppendChild(f"{Tf.MakeValidIdentifier(collider.name)}_{number}")
        parts.append(UsdGeom.Xform.Define(stage, path).GetPrim())
        vertices, faces = surface_of(collider, np.full(3, -1.0), np.ones(3))
        placed = (vertices @ collider.rotation.T + collider.position).astype(np.float32)
        mesh = UsdGeom.Mesh.Define(stage, path.AppendChild("Mesh"))
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(placed)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        extent = np.stack([placed.min(axis=0), placed.max(axis=0)])
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        linear = srgb_to_linear(np.asarray([collider.color or COLOR], np.float64))
        mesh.CreateDisplayColorAttr(prims.vec3f(linear))
        prim = mesh.GetPrim()
        prim.CreateAttribute("gdpro:name", prims.T.String, True).Set(collider.name)
        prim.CreateAttribute(NUMBER, prims.T.Int, True).Set(number)
        if collider.color is not None:
            prim.CreateAttribute("gdpro:color", prims.T.Float3, True).Set(
                Gf.Vec3f(*(float(x) for x in collider.color))
            )
    return parts


def _set(op: Any, pose: np.ndarray, code: Usd.TimeCode) -> None:
    matrix = np.eye(4)
    matrix[:3] = pose
    op.Set(Gf.Matrix4d(*matrix.T.ravel().tolist()), code)


def _read(stage: Usd.Stage, group: Sdf.Path) -> dict[int, Collider]:
    prim = stage.GetPrimAtPath(group)
    found = {}
    for part in prim.GetChildren() if prim else ():
        mesh = stage.GetPrimAtPath(part.GetPath().AppendChild("Mesh"))
        points = prims.read(mesh, "points", np.float32, (-1, 3))
        faces = prims.read(mesh, "faceVertexIndices", np.int32, (-1,)).reshape(-1, 3)
        color = mesh.GetAttribute("gdpro:color").Get()
        found[int(mesh.GetAttribute(NUMBER).Get())] = Collider(
            str(mesh.GetAttribute("gdpro:name").Get()),
            "mesh",
            vertices=points.astype(np.float64),
            faces=faces,
            color=None if color is None else (float(color[0]), float(color[1]), float(color[2])),
        )
    return found


__all__ = [
    "BASE",
    "OBSTACLES",
    "define_links",
    "define_obstacles",
    "read_links",
    "read_obstacles",
    "set_links",
    "set_obstacles",
]
