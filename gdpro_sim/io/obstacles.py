"""Rigid obstacles of a scene as Gaussians, for pictures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import trimesh

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Motion, pose_at

COLOR = (0.60, 0.63, 0.67)
BUDGET = 12_000
"""Gaussians of each obstacle."""

PART = 4_000
"""Of each part of a base, which has many."""

PLATE = 1.2
"""Half the width of the square that stands for a plane, as a multiple of the size of what is shown."""

LARGE = 3.0
"""An obstacle this many times larger than what bodies need is not shown whole."""


class Obstacles:
    """Gaussians and normals of obstacles at any time, on `device`.

    low, high: corners of the box in m that is shown; a plane is drawn as a plate of about that size
    """

    def __init__(
        self, colliders: Sequence[Collider], low: np.ndarray, high: np.ndarray, device: str = "cpu"
    ) -> None:
        low, high = np.asarray(low, float), np.asarray(high, float)
        self._items: list[tuple[int, Collider, BoundGaussians]] = []
        for number, collider in enumerate(colliders):
            if not collider.visible:
                continue
            vertices, faces = surface_of(collider, low, high)
            placed = vertices @ collider.rotation.T + collider.position
            mesh = SurfaceMesh.from_arrays(placed, faces, color=collider.color or COLOR)
            budget = BUDGET if collider.color is None else PART
            bound = bind_mesh(mesh, budget=max(budget, 2 * len(faces)), occlusion=0.0).to(device)
            self._items.append((number, collider, bound))

    @property
    def counts(self) -> list[tuple[int, int]]:
        """(number of an obstacle, its Gaussians) of those that are shown, in the order of `added_to`."""
        return [(number, len(bound)) for number, _, bound in self._items]

    def added_to(
        self, gaussians: Gaussians, normals: torch.Tensor, time: float, poses: np.ndarray | None = None
    ) -> tuple[Gaussians, torch.Tensor]:
        """`gaussians` and their normals [N, 3], joined with those of the obstacles at a time in s.

        poses: `gdpro_sim.simulation.frame.Frame.colliders`, where some move freely
        """
        parts, facing = [gaussians], [normals]
        for number, collider, bound in self._items:
            vertices = bound.vertices
            pose = None
            if poses is not None:
                pose = poses[number, :, :3], poses[number, :, 3]
            elif collider.motion is not None:
                pose = pose_at(collider.motion, time)
            if pose is not None:
                rotation, shift = (torch.tensor(part).to(vertices) for part in pose)
                vertices = vertices @ rotation.T + shift
            parts.append(bound.gaussians(vertices))
            facing.append(bound.normals(vertices))
        if len(parts) == 1:
            return gaussians, normals
        return Gaussians.concatenate(parts), torch.cat(facing)


def with_obstacles(
    colliders: Sequence[Collider], low: np.ndarray, high: np.ndarray, duration: float = 0.0
) -> tuple[np.ndarray, np.ndarray]:
    """The box `low`..`high` in m, grown to show obstacles wherever they move in `duration` s, unless they are
    far larger."""
    size = float(np.linalg.norm(high - low))
    boxes = [(low, high)]
    for collider in colliders:
        if collider.kind == "plane" or not collider.visible:
            continue
        points = surface_of(collider, low, high)[0] @ collider.rotation.T + collider.position
        if np.linalg.norm(np.ptp(points, axis=0)) > LARGE * size:
            continue
        for time in collider.motion.sampled(duration) if isinstance(collider.motion, Motion) else (0.0,):
            moved = points
            if collider.motion is not None:
                rotation, shift = pose_at(collider.motion, time)
                moved = points @ rotation.T + shift
            boxes.append((moved.min(axis=0), moved.max(axis=0)))
    return np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)


def surface_of(collider: Collider, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] m in the collider's own frame, and faces [F, 3], outward."""
    if collider.vertices is not None and collider.faces is not None:
        return collider.vertices, collider.faces
    if collider.kind == "plane":
        half = PLATE * float(np.linalg.norm(high - low))
        thick = 0.01 * half
        middle = (0.5 * (low + high) - collider.position) @ collider.rotation
        plate = trimesh.creation.box((2.0 * half, 2.0 * half, thick))
        plate.apply_translation((middle[0], middle[1], -0.5 * thick))
        return np.asarray(plate.vertices), np.asarray(plate.faces, np.int32)
    size = collider.size
    if collider.kind == "box":
        shape = trimesh.creation.box(2.0 * np.asarray(size))
    elif collider.kind == "sphere":
        shape = trimesh.creation.icosphere(subdivisions=4, radius=size[0])
    elif collider.kind == "capsule":
        shape = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[48, 48])
        shape.apply_translation((0.0, 0.0, -float(shape.bounds.mean(axis=0)[2])))
    else:
        shape = trimesh.creation.cylinder(radius=size[0], height=2.0 * size[1], sections=48)
        # The fans of its ends are needles.
        corners, faces = trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, 0.25 * size[0])
        return np.asarray(corners), np.asarray(faces, np.int32)
    return np.asarray(shape.vertices), np.asarray(shape.faces, np.int32)


__all__ = ["COLOR", "Obstacles", "surface_of", "with_obstacles"]
