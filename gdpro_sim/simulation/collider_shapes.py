"""Colliders on a device, as `gdpro_sim.kernels.colliders` takes them."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.kernels import colliders as kernels
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import pose_at

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


__all__ = ["ColliderShape", "placed"]
