"""Rigid obstacles of a scene as Gaussians, for pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.meshing.repair import face_areas
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Motion, pose_at

COLOR = (0.60, 0.63, 0.67)
BUDGET = 12_000
"""Gaussians of each obstacle."""

BASE = 30_000
"""Of all parts of a base together, which are many and small; shared by their widths."""

LEAST = 600
"""Of each part at least."""

SIMPLE = 1000
"""A part of no more faces is drawn with all of them: decimated, flat ones would turn into needles."""

PLATE = 1.2
"""Half the width of the square that stands for a plane, as a multiple of the size of what is shown."""

ROUND, SMALL = 40, 20
"""Sides of a circle, and of one that is part of a base."""

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
        shown = [(number, item) for number, item in enumerate(colliders) if item.visible]
        surfaces = [surface_of(item, low, high) for _, item in shown]
        budgets = _budgets([item for _, item in shown], surfaces)
        self._items: list[tuple[int, Collider, Gaussians, torch.Tensor]] = []
        for (number, collider), (vertices, faces), budget in zip(shown, surfaces, budgets, strict=True):
            placed = vertices @ collider.rotation.T + collider.position
            mesh = SurfaceMesh.from_arrays(placed, faces, color=collider.color or COLOR)
            bound = _bind(mesh, budget).to(device)
            self._items.append((number, collider, bound.gaussians(), bound.normals()))

    @property
    def counts(self) -> list[tuple[int, int]]:
        """(number of an obstacle, its Gaussians) of those that are shown, in the order of `added_to`."""
        return [(number, len(own)) for number, _, own, _ in self._items]

    def added_to(
        self, gaussians: Gaussians, normals: torch.Tensor, time: float, poses: np.ndarray | None = None
    ) -> tuple[Gaussians, torch.Tensor]:
        """`gaussians` and their normals [N, 3], joined with those of the obstacles at a time in s.

        poses: `gdpro_sim.simulation.frame.Frame.colliders`, where some move freely
        """
        parts, facing = [gaussians], [normals]
        for number, collider, own, outward in self._items:
            pose = None
            if poses is not None:
                pose = poses[number, :, :3], poses[number, :, 3]
            elif collider.motion is not None:
                pose = pose_at(collider.motion, time)
            if pose is not None:
                own, outward = _moved(own, outward, *pose)
            parts.append(own)
            facing.append(outward)
        if len(parts) == 1:
            return gaussians, normals
        return Gaussians.concatenate(parts), torch.cat(facing)


def _budgets(colliders: Sequence[Collider], surfaces: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[int]:
    """Gaussians of each obstacle; parts of a base, which have colours, share theirs."""
    widths = np.array([
        0.0 if item.color is None else math.sqrt(float(face_areas(*surface).sum()))
        for item, surface in zip(colliders, surfaces, strict=True)
    ])  # fmt: skip
    shares = BASE * widths / max(float(widths.sum()), 1e-30)
    return [
        max(BUDGET, 2 * len(faces))
        if item.color is None
        else max(LEAST, int(share), 4 * len(faces) if len(faces) <= SIMPLE else 0)
        for item, (_, faces), share in zip(colliders, surfaces, shares, strict=True)
    ]


def _bind(mesh: SurfaceMesh, budget: int) -> BoundGaussians:
    """As many as asked for, or as its mesh needs that cannot be decimated so far."""
    try:
        return bind_mesh(mesh, budget=budget, occlusion=0.0)
    except MeshError:
        return bind_mesh(mesh, budget=max(budget, 2 * len(mesh.faces)), occlusion=0.0)


def _moved(
    gaussians: Gaussians, normals: torch.Tensor, rotation: np.ndarray, shift: np.ndarray
) -> tuple[Gaussians, torch.Tensor]:
    """Both, turned by a rotation [3, 3] and shifted by [3] m; colours do not depend on the way they face."""
    turn, way = (torch.tensor(part).to(normals) for part in (rotation, shift))
    x, y, z, w = Rotation.from_matrix(rotation).as_quat().tolist()
    product = torch.tensor([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]]).to(normals)
    moved = replace(gaussians, means=gaussians.means @ turn.T + way, quats=gaussians.quats @ product.T)
    return moved, normals @ turn.T


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


def _outline(radius: float, half: float, sides: int) -> list[tuple[float, float]]:
    """(r, z) m around a cylinder. Triangles are about as long as wide, along it three times as long: the
    Gaussians of long ones would reach past its edges, and whole fans at its ends are needles."""
    edge = 2.0 * math.pi * radius / sides
    rings = [radius * k for k in np.linspace(0.0, 1.0, max(round(radius / edge), 2) + 1)]
    inner = max(half - edge, 0.0)
    steps = int(np.clip(round(2.0 * inner / (3.0 * edge)), 1, 16))
    side = sorted({-half, half, *np.linspace(-inner, inner, steps + 1).tolist()})
    ends = [(r, -half) for r in rings[:-1]], [(r, half) for r in rings[-2::-1]]
    return [*ends[0], *((radius, z) for z in side), *ends[1]]


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
    size, sides = collider.size, ROUND if collider.color is None else SMALL
    if collider.kind == "box":
        shape = trimesh.creation.box(2.0 * np.asarray(size))
    elif collider.kind == "sphere":
        shape = trimesh.creation.icosphere(subdivisions=round(math.log2(sides / 5.0)), radius=size[0])
    elif collider.kind == "capsule":
        shape = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[sides, sides])
        shape.apply_translation((0.0, 0.0, -float(shape.bounds.mean(axis=0)[2])))
    else:
        shape = trimesh.creation.revolve(_outline(size[0], size[1], sides), sections=sides)
    return np.asarray(shape.vertices), np.asarray(shape.faces, np.int32)


__all__ = ["COLOR", "Obstacles", "surface_of", "with_obstacles"]
