"""Colliders on a device, as `gdpro_sim.kernels.colliders` takes them, and whether bodies can meet them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.errors import SceneError
from gdpro_sim.kernels import colliders as kernels
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import pose_at
from gdpro_sim.simulation.model import Model

KINDS = {
    "plane": kernels.PLANE,
    "box": kernels.BOX,
    "sphere": kernels.SPHERE,
    "capsule": kernels.CAPSULE,
    "cylinder": kernels.CYLINDER,
    "mesh": kernels.MESH,
}


class ColliderShape:
    """Shape and mesh of a collider on `device`; the structs it makes live as long as it does."""

    def __init__(self, collider: Collider, device: str) -> None:
        self.collider = collider
        self._mesh: Any = None
        self._points: wp.array = wp.zeros(0, dtype=wp.vec3d, device=device)
        self._triangles: wp.array = wp.zeros(0, dtype=wp.int32, device=device)
        if collider.vertices is not None and collider.faces is not None:
            self._points = wp.array(collider.vertices, dtype=wp.vec3d, device=device)
            self._triangles = wp.array(collider.faces.ravel(), dtype=wp.int32, device=device)
            coarse: wp.array = wp.array(collider.vertices.astype(np.float32), dtype=wp.vec3, device=device)
            self._mesh = wp.Mesh(points=coarse, indices=self._triangles)

    def struct(self) -> Any:
        """A `gdpro_sim.kernels.colliders.Collider`, where the collider stands at the start."""
        struct = kernels.Collider()
        struct.kind = KINDS[self.collider.kind]
        struct.size = wp.vec3d(*self.collider.size)
        struct.position = wp.vec3d(*self.collider.position)
        struct.rotation = wp.mat33d(*self.collider.rotation.ravel())
        struct.mesh = wp.uint64(0 if self._mesh is None else self._mesh.id)
        struct.points = self._points
        struct.triangles = self._triangles
        return struct


def placed(collider: Collider, time: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation [3, 3] and position [3] m of a collider's frame where its motion has it at a time in s."""
    if collider.motion is None:
        return collider.rotation, collider.position
    turn, shift = pose_at(collider.motion, time)
    return turn @ collider.rotation, turn @ collider.position + shift


def check_not_swallowed(where: str, model: Model) -> None:
    """Raise SceneError for a collider whose middle starts inside a body of tets: it would never come out."""
    for collider in model.colliders:
        if collider.kind == "plane" or collider.heights is not None:
            continue
        rotation, middle = placed(collider, 0.0)
        if collider.vertices is not None:
            middle = rotation @ collider.vertices.mean(axis=0) + middle
        for body in model.bodies:
            corners = model.vertices[model.tets[slice(*body.tet_range)]].astype(np.float64)
            edges = (corners[:, 1:] - corners[:, :1]).transpose(0, 2, 1)
            weights = np.linalg.solve(edges, (middle - corners[:, 0])[..., None])[..., 0]
            if ((weights >= 0.0).all(axis=1) & (weights.sum(axis=1) <= 1.0)).any():
                raise SceneError(
                    f"{where}: collider {collider.name!r} starts inside body {body.name!r}; move one of them"
                )


__all__ = ["ColliderShape", "check_not_swallowed", "placed"]
