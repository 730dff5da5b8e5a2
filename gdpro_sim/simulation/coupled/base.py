"""Bodies of a user's MJCF as obstacles for soft ones."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import trimesh

from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.simulation.colliders import Collider, mesh_collider, shape_collider
from gdpro_sim.simulation.model import Link, Model
from gdpro_sim.simulation.mujoco import SolverMuJoCo
from gdpro_sim.simulation.mujoco_model import MujocoWorld

OURS = 1
"""The bit of `contype` and `conaffinity` that bodies of scenes have."""

ROUND = 3
"""Subdivisions of an icosahedron that stands for an ellipsoid."""


def base_links(rigid: Model) -> tuple[tuple[Link, ...], tuple[Collider, ...]]:
    """Links of MuJoCo's base that move, and the solids of those that stand, where the base starts.

    Geoms that touch bodies of scenes count. Raises SceneError for one that soft bodies cannot meet.
    """
    world = rigid.mujoco
    if world is None or world.base is None:
        return (), ()
    alone = MujocoWorld((), world.settings, base=world.base, keyframe=world.keyframe)
    solver = SolverMuJoCo(replace(rigid, bodies=(), ground=None, colliders=(), mujoco=alone))
    model, data = solver.mjmodel, solver.mjdata
    mujoco.mj_kinematics(model, data)
    links: dict[int, list[Collider]] = {}
    still: list[Collider] = []
    for geom in range(model.ngeom):
        if not (model.geom_contype[geom] | model.geom_conaffinity[geom]) & OURS:
            continue
        body = int(model.geom_bodyid[geom])
        collider = _solid(model, data, geom)
        if model.body_weldid[body] == 0:
            still.append(collider)
        else:
            links.setdefault(body, []).append(collider)
    return tuple(Link(body, of_base=True, colliders=tuple(made)) for body, made in links.items()), tuple(
        still
    )


def _solid(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Collider:
    size = [float(x) for x in model.geom_size[geom]]
    body = model.body(model.geom_bodyid[geom]).name
    name = model.geom(geom).name or f"{body or 'world'}[{geom - model.body_geomadr[model.geom_bodyid[geom]]}]"
    common: dict[str, Any] = {
        "name": name,
        "position": data.geom_xpos[geom].copy(),
        "rotation": data.geom_xmat[geom].reshape(3, 3).copy(),
        "friction": float(model.geom_friction[geom, 0]),
        "visible": False,
    }
    kind = mujoco.mjtGeom(model.geom_type[geom])
    shapes: dict[Any, Callable[[], Collider]] = {
        mujoco.mjtGeom.mjGEOM_PLANE: lambda: Collider(kind="plane", **common),
        mujoco.mjtGeom.mjGEOM_BOX: lambda: shape_collider("box", tuple(size), **common),
        mujoco.mjtGeom.mjGEOM_SPHERE: lambda: shape_collider("sphere", (size[0],), **common),
        mujoco.mjtGeom.mjGEOM_CAPSULE: lambda: shape_collider("capsule", (size[0], size[1]), **common),
        mujoco.mjtGeom.mjGEOM_CYLINDER: lambda: shape_collider("cylinder", (size[0], size[1]), **common),
        mujoco.mjtGeom.mjGEOM_ELLIPSOID: lambda: _ellipsoid(np.array(size), common),
        mujoco.mjtGeom.mjGEOM_MESH: lambda: _hull(model, int(model.geom_dataid[geom]), common),
    }
    if kind not in shapes:
        shape = kind.name.removeprefix("mjGEOM_").lower()
        raise SceneError(
            f"the base's geom {name!r}: soft bodies cannot meet a {shape}; let it touch nothing (contype and "
            "conaffinity 0), or make it of boxes or meshes"
        )
    try:
        return shapes[kind]()
    except MeshError as error:
        raise SceneError(f"the base's geom {name!r}: {error}") from None


def _ellipsoid(size: np.ndarray, common: dict[str, Any]) -> Collider:
    ball = trimesh.creation.icosphere(subdivisions=ROUND)
    return mesh_collider(np.asarray(ball.vertices) * size, np.asarray(ball.faces), **common)


def _hull(model: mujoco.MjModel, mesh: int, common: dict[str, Any]) -> Collider:
    """MuJoCo's meshes touch as their convex hulls."""
    begin, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    points = model.mesh_vert[begin : begin + count].astype(np.float64)
    hull = trimesh.convex.convex_hull(points)
    return mesh_collider(np.asarray(hull.vertices), np.asarray(hull.faces), **common)


__all__ = ["base_links"]
