"""Rigid obstacles of a scene as Gaussians, for pictures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gdpro_sim.asset.from_mesh import FLATNESS, MIN_BUDGET, OPACITY, bind_mesh
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians, rgb_to_sh
from gdpro_sim.meshing.repair import face_areas
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Motion, pose_at

COLOR = (0.60, 0.63, 0.67)
BUDGET = 12_000
"""Gaussians of each obstacle."""

BASE, PART, LEAST = 150_000, 10_000, 300
"""Of all parts of a base together at most; of one at most and at least."""

FINE = 2.0
"""Pixels between neighbours of a part's Gaussians, from where the camera first stands."""

BESIDE = 0.5
"""Resolution of parts that lie beside the picture, over that of those within."""

ACROSS = 600.0
"""Pixels that what is shown measures where no camera is given."""

BOX = 12
"""Faces of a part, up to which its Gaussians lie in rows."""

OVERLAP = 0.75
"""Standard deviation of a part's Gaussians in its surface, over the spacing of neighbours."""

PLATE = 1.2
"""Half the width of the square that stands for a plane, as a multiple of the size of what is shown."""

ROUND = 40
"""Sides of a circle."""

SKIRT = 0.01
"""Share of a terrain's depth that is shown at least."""

LARGE = 3.0
"""An obstacle this many times larger than what bodies need is not shown whole."""


class Obstacles:
    """Gaussians and normals of obstacles at any time, on `device`.

    low, high: corners of the box in m that is shown; a plane is drawn as a plate of about that size
    view:      one camera, where it first stands: parts of a base are drawn as finely as it sees them
    """

    def __init__(
        self,
        colliders: Sequence[Collider],
        low: np.ndarray,
        high: np.ndarray,
        device: str = "cpu",
        view: Cameras | None = None,
    ) -> None:
        low, high = np.asarray(low, float), np.asarray(high, float)
        shown = [(number, item) for number, item in enumerate(colliders) if item.visible]
        surfaces = [surface_of(item, low, high) for _, item in shown]
        parts = [k for k, (_, item) in enumerate(shown) if item.color is not None]
        placed = [
            v @ item.rotation.T + item.position for (_, item), (v, _) in zip(shown, surfaces, strict=True)
        ]
        size = float(np.linalg.norm(high - low))
        shares = _shares([(placed[k], surfaces[k][1]) for k in parts], size, view)
        budgets = dict(zip(parts, shares, strict=True))
        self._items: list[tuple[int, Collider, Gaussians, torch.Tensor]] = []
        for k, ((number, item), (_, faces)) in enumerate(zip(shown, surfaces, strict=True)):
            budget = budgets.get(k, max(BUDGET, 2 * len(faces)))
            if item.color is None or len(faces) <= BOX:
                mesh = SurfaceMesh.from_arrays(placed[k], faces, color=item.color or COLOR)
                bound = bind_mesh(mesh, budget=max(budget, MIN_BUDGET), occlusion=0.0)
            else:
                bound = _sampled(placed[k], faces, item.color, budget)
            bound = bound.to(device)
            self._items.append((number, item, bound.gaussians(), bound.normals()))

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


def _shares(
    surfaces: Sequence[tuple[np.ndarray, np.ndarray]], size: float, view: Cameras | None
) -> list[int]:
    """Gaussians of each part of a base, by what a camera sees of it; size: m, of what is shown."""
    wanted = []
    for vertices, faces in surfaces:
        resolution = ACROSS / size
        if view is not None:
            resolution = _resolution(vertices, view)
        wanted.append(float(face_areas(vertices, faces).sum()) * (resolution / FINE) ** 2)
    counts = np.clip(wanted, LEAST, PART)
    return (counts * min(1.0, BASE / max(float(counts.sum()), 1.0))).astype(int).tolist()


def _resolution(vertices: np.ndarray, view: Cameras) -> float:
    """Pixels per metre at which a camera sees a part of vertices [V, 3] m: 0 behind it, and a share of that
    beside the picture, as what lies there may come in."""
    matrix, k = view.viewmats[0].double().numpy(), view.Ks[0].double().numpy()
    points = vertices @ matrix[:3, :3].T + matrix[:3, 3]
    points = points[points[:, 2] > 0.0]
    if not len(points):
        return 0.0
    u, v = (k[axis, axis] * points[:, axis] / points[:, 2] + k[axis, 2] for axis in (0, 1))
    if u.max() < 0.0 or u.min() > view.width or v.max() < 0.0 or v.min() > view.height:
        return BESIDE * float(k[0, 0] / np.median(points[:, 2]))
    seen = (u > 0.0) & (u < view.width) & (v > 0.0) & (v < view.height)
    return float(k[0, 0] / np.median(points[seen if seen.any() else slice(None), 2]))


def _sampled(
    vertices: np.ndarray, faces: np.ndarray, color: tuple[float, float, float], budget: int
) -> BoundGaussians:
    """About `budget` round Gaussians spread evenly: triangles of machines are long slivers, and Gaussians of
    their shape would reach past every edge."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    points, ids = trimesh.sample.sample_surface(mesh, 3 * budget, seed=0)
    points, kept = trimesh.points.remove_close(points, math.sqrt(float(mesh.area) / (3.0 * budget)))
    ids = ids[kept]
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[ids], points)
    count = len(points)
    spread = OVERLAP * math.sqrt(float(mesh.area) / count)
    scales = np.log([FLATNESS * spread, spread, spread])
    return BoundGaussians(
        vertices=torch.tensor(vertices, dtype=torch.float32),
        faces=torch.tensor(faces, dtype=torch.int32),
        face_ids=torch.tensor(ids, dtype=torch.int32),
        barycentrics=torch.tensor(weights, dtype=torch.float32),
        rotations=torch.tensor([[1.0, 0.0]]).repeat(count, 1),
        log_scales=torch.tensor(scales, dtype=torch.float32).repeat(count, 1),
        opacity_logits=torch.full((count,), math.log(OPACITY / (1.0 - OPACITY))),
        sh=rgb_to_sh(torch.tensor(color, dtype=torch.float32)).repeat(count, 1, 1),
    )


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


def _outline(radius: float, half: float) -> list[tuple[float, float]]:
    """(r, z) m around a cylinder. Triangles are about as long as wide, along it three times as long: the
    Gaussians of long ones would reach past its edges, and whole fans at its ends are needles."""
    edge = 2.0 * math.pi * radius / ROUND
    rings = [radius * k for k in np.linspace(0.0, 1.0, max(round(radius / edge), 2) + 1)]
    inner = max(half - edge, 0.0)
    steps = int(np.clip(round(2.0 * inner / (3.0 * edge)), 1, 16))
    side = sorted({-half, half, *np.linspace(-inner, inner, steps + 1).tolist()})
    ends = [(r, -half) for r in rings[:-1]], [(r, half) for r in rings[-2::-1]]
    return [*ends[0], *((radius, z) for z in side), *ends[1]]


def surface_of(collider: Collider, low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] m in the collider's own frame, and faces [F, 3], outward."""
    if collider.vertices is not None and collider.faces is not None:
        vertices = collider.vertices
        if collider.heights is not None:  # it is solid far below; what is shown ends at the floor
            base, least = float(vertices[:, 2].min()), float(collider.heights.min())
            floor = min(float(low[2] - collider.position[2]), least - SKIRT * (least - base))
            vertices = np.column_stack([vertices[:, :2], np.maximum(vertices[:, 2], floor)])
        return vertices, collider.faces
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
        shape = trimesh.creation.icosphere(subdivisions=3, radius=size[0])
    elif collider.kind == "capsule":
        shape = trimesh.creation.capsule(height=2.0 * size[1], radius=size[0], count=[ROUND, ROUND])
        shape.apply_translation((0.0, 0.0, -float(shape.bounds.mean(axis=0)[2])))
    else:
        shape = trimesh.creation.revolve(_outline(size[0], size[1]), sections=ROUND)
    return np.asarray(shape.vertices), np.asarray(shape.faces, np.int32)


__all__ = ["COLOR", "Obstacles", "surface_of", "with_obstacles"]
