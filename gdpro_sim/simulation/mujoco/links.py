"""What a user's MJCF looks like: the geoms of its bodies, for pictures and files."""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np
import trimesh

from gdpro_sim.simulation.colliders import Collider

GROUPS = 3
"""Geoms of the first groups are shown, as MuJoCo's viewer does; later ones are for contact."""

ROUND = 3
"""Subdivisions of an icosahedron that stands for an ellipsoid."""

KINDS = {
    mujoco.mjtGeom.mjGEOM_PLANE: "plane",
    mujoco.mjtGeom.mjGEOM_BOX: "box",
    mujoco.mjtGeom.mjGEOM_SPHERE: "sphere",
    mujoco.mjtGeom.mjGEOM_CAPSULE: "capsule",
    mujoco.mjtGeom.mjGEOM_CYLINDER: "cylinder",
}


def visible_geoms(model: mujoco.MjModel, ours: Collection[str], floor: bool) -> np.ndarray:
    """Numbers of the geoms that are shown and not `ours`; `floor`: whether endless planes are."""
    chosen = []
    for k in range(model.ngeom):
        kind = mujoco.mjtGeom(model.geom_type[k])
        drawn = kind in KINDS or kind in (mujoco.mjtGeom.mjGEOM_ELLIPSOID, mujoco.mjtGeom.mjGEOM_MESH)
        shown = model.geom_group[k] < GROUPS and model.geom(k).name not in ours and _rgba(model, k)[3] > 0.0
        if drawn and shown and (floor or kind != mujoco.mjtGeom.mjGEOM_PLANE):
            chosen.append(k)
    return np.array(chosen, int)


def link_of(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> Collider:
    """One geom where `data` has it."""
    kind = mujoco.mjtGeom(model.geom_type[geom])
    body = int(model.geom_bodyid[geom])
    number = geom - int(model.body_geomadr[body])
    common: dict[str, Any] = {
        "name": model.geom(geom).name or f"{model.body(body).name or f'body{body}'}_geom{number}",
        "position": data.geom_xpos[geom].copy(),
        "rotation": data.geom_xmat[geom].reshape(3, 3).copy(),
        "color": tuple(float(x) for x in _rgba(model, geom)[:3]),
    }
    if kind in KINDS:
        a, b, c = (float(x) for x in model.geom_size[geom])
        return Collider(kind=KINDS[kind], size=(a, b, c), **common)  # type: ignore[arg-type]
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        ball = trimesh.creation.icosphere(subdivisions=ROUND)
        vertices, faces = np.asarray(ball.vertices) * model.geom_size[geom], np.asarray(ball.faces, np.int32)
    else:
        mesh = int(model.geom_dataid[geom])
        first, begin = model.mesh_vertadr[mesh], model.mesh_faceadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]].astype(np.float64)
        faces = model.mesh_face[begin : begin + model.mesh_facenum[mesh]].astype(np.int32)
    return Collider(kind="mesh", vertices=vertices, faces=faces, **common)


def poses_since(data: mujoco.MjData, geoms: np.ndarray, start: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """[G, 3, 4] rotation and shift m of geoms since a start, rotations [G, 3, 3] and positions [G, 3] m."""
    turns, positions = start
    turn = data.geom_xmat[geoms].reshape(-1, 3, 3) @ np.swapaxes(turns, 1, 2)
    shift = data.geom_xpos[geoms] - np.einsum("gij,gj->gi", turn, positions)
    return np.concatenate([turn, shift[:, :, None]], axis=2)


def _rgba(model: mujoco.MjModel, geom: int) -> np.ndarray:
    """[4] sRGB of its material where it has one, times the mean of its texture."""
    material = int(model.geom_matid[geom])
    if material < 0:
        return model.geom_rgba[geom].astype(float)
    color = model.mat_rgba[material].astype(float)
    texture = int(model.mat_texid[material, int(mujoco.mjtTextureRole.mjTEXROLE_RGB)])
    if texture >= 0:
        size, channels = (
            int(model.tex_height[texture]) * int(model.tex_width[texture]),
            int(model.tex_nchannel[texture]),
        )
        begin = int(model.tex_adr[texture])
        texels = model.tex_data[begin : begin + size * channels].reshape(-1, channels)
        color[:3] *= texels[:, :3].mean(axis=0) / 255.0
    return color


__all__ = ["link_of", "poses_since", "visible_geoms"]
