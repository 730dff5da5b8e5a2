"""Parts of a base, a robot arm say, in simulation files: meshes that move as a whole.

/Simulation/Base/<part>   Xform: where it has moved since the start, per frame
    Mesh                  its surface at the start, in world space
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Tf, Usd, UsdGeom, Vt

from gdpro_sim.asset import prims
from gdpro_sim.io.obstacles import COLOR, surface_of
from gdpro_sim.meshing.color import srgb_to_linear
from gdpro_sim.simulation.colliders import Collider

BASE = "Base"


def define_links(stage: Usd.Stage, root: Sdf.Path, links: Sequence[Collider]) -> list[Any]:
    """Author every part where it is at the start; returns what `set_links` moves."""
    if not links:
        return []
    base = root.AppendChild(BASE)
    UsdGeom.Xform.Define(stage, base)
    ops = []
    for number, link in enumerate(links):
        path = base.AppendChild(f"{Tf.MakeValidIdentifier(link.name)}_{number}")
        ops.append(UsdGeom.Xform.Define(stage, path).AddTransformOp())
        vertices, faces = surface_of(link, np.full(3, -1.0), np.ones(3))
        placed = (vertices @ link.rotation.T + link.position).astype(np.float32)
        mesh = UsdGeom.Mesh.Define(stage, path.AppendChild("Mesh"))
        mesh.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(placed)))
        mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
        mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).ravel()))
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        extent = np.stack([placed.min(axis=0), placed.max(axis=0)])
        mesh.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(extent))
        linear = srgb_to_linear(np.asarray([link.color or COLOR], np.float64))
        mesh.CreateDisplayColorAttr(prims.vec3f(linear))
        prim = mesh.GetPrim()
        prim.CreateAttribute("gdpro:name", prims.T.String, True).Set(link.name)
        prim.CreateAttribute("gdpro:color", prims.T.Float3, True).Set(
            Gf.Vec3f(*(float(x) for x in link.color or COLOR))
        )
    return ops


def set_links(ops: Sequence[Any], poses: np.ndarray, code: Usd.TimeCode) -> None:
    """Where parts are in a frame: [L, 3, 4] rotations and shifts m since the start."""
    for op, pose in zip(ops, poses, strict=True):
        matrix = np.eye(4)
        matrix[:3] = pose
        op.Set(Gf.Matrix4d(*matrix.T.ravel().tolist()), code)


def read_links(stage: Usd.Stage, root: Sdf.Path) -> tuple[Collider, ...]:
    """The parts as they are at the start, in the order of their poses."""
    base = stage.GetPrimAtPath(root.AppendChild(BASE))
    found = []
    for part in base.GetChildren() if base else ():
        mesh = stage.GetPrimAtPath(part.GetPath().AppendChild("Mesh"))
        points = prims.read(mesh, "points", np.float32, (-1, 3))
        faces = prims.read(mesh, "faceVertexIndices", np.int32, (-1,)).reshape(-1, 3)
        r, g, b = (float(x) for x in mesh.GetAttribute("gdpro:color").Get())
        name = str(mesh.GetAttribute("gdpro:name").Get())
        found.append(Collider(name, "mesh", vertices=points.astype(np.float64), faces=faces, color=(r, g, b)))
    return tuple(found)


__all__ = ["BASE", "define_links", "read_links", "set_links"]
