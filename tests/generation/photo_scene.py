"""Photos of a known mesh, drawn here, for tests."""

from __future__ import annotations

import math

import numpy as np

from gdpro_sim.cameras import Cameras
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.renders import MeshRenderer
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh
from tests.meshing import shapes


def ball_and_box(scale: float = 1.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> SurfaceMesh:
    """A red ball on a blue box, closed parts, within the sphere of radius 0.95 `scale` around `centre`."""
    ball, (cube, quads) = shapes.sphere(3, 0.4), shapes.cube()
    ball = (ball[0] + np.float32([0.1, 0.0, 0.35]), ball[1])
    box = ((cube - 0.5) * np.float32([0.9, 1.2, 0.5]) - np.float32([0.0, 0.0, 0.3]), quads)
    v, f = shapes.joined(ball, box)
    ids = np.repeat(np.int32([0, 1]), [len(ball[1]), len(quads)])
    materials = (MeshMaterial("ball", (0.8, 0.1, 0.1, 1.0)), MeshMaterial("box", (0.1, 0.2, 0.7, 1.0)))
    return SurfaceMesh((v * scale + np.float32(centre)).astype(np.float32), f, None, None, ids, materials)


def cameras_around(
    count: int,
    size: tuple[int, int] = (64, 48),
    *,
    scale: float = 1.0,
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0),
    fov: float = 0.6,
) -> Cameras:
    """Cameras all around at four `scale`, in two rings above and below."""
    turn = 2.0 * math.pi * np.arange(count) / count
    lift = np.where(np.arange(count) % 2, 0.6, -0.3)
    eyes = 4.0 * np.stack([np.cos(turn) * np.cos(lift), np.sin(turn) * np.cos(lift), np.sin(lift)], 1)
    middle = np.asarray(centre)
    return Cameras.look_at(middle + scale * eyes, middle, vertical_fov=fov, width=size[0], height=size[1])


def photos_of(mesh: SurfaceMesh, cameras: Cameras) -> Photos:
    """What the cameras see of a mesh in (about) the unit frame, as photos with alpha."""
    seen = MeshRenderer(mesh).render(cameras, rays=4)
    straight = seen.rgb / seen.alphas.clamp_min(1e-6)
    rgba = np.concatenate([straight.numpy(), seen.alphas.numpy()], -1)
    pictures = tuple((np.clip(p, 0.0, 1.0) * 255.0 + 0.5).astype(np.uint8) for p in rgba)
    names = tuple(f"photo_{i}.png" for i in range(len(cameras)))
    return Photos(cameras.viewmats.double().numpy(), cameras.Ks.double().numpy(), pictures, names)
