"""Small coloured meshes in the unit frame, and settings small enough for tests."""

from __future__ import annotations

import numpy as np
import trimesh

from gdpro_sim.generation.config import GenerationConfig
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh


def ball(subdivisions: int = 2, radius: float = 0.8, *, stretch: float = 1.0) -> SurfaceMesh:
    """A sphere, `stretch` times as tall, whose colour goes from red below to green above, blue in front."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = np.asarray(mesh.vertices) * [1.0, 1.0, stretch]
    return painted(vertices, np.asarray(mesh.faces))


def painted(vertices: np.ndarray, faces: np.ndarray) -> SurfaceMesh:
    """A mesh coloured by where its vertices are."""
    v = np.ascontiguousarray(vertices, np.float32)
    f = np.ascontiguousarray(faces, np.int32)
    up = 0.5 + 0.4 * v[:, 2] / np.abs(v[:, 2]).max()
    rgba = np.stack([1.0 - up, up, 0.5 + 0.3 * np.sign(v[:, 0]), np.ones_like(up)], 1)
    colors = (rgba[f] * 255.0).astype(np.uint8)
    return SurfaceMesh(v, f, None, colors, np.zeros(len(f), np.int32), (MeshMaterial("paint", (1.0,) * 4),))


def small(**parts: dict[str, object]) -> GenerationConfig:
    """The default configuration at few pixels and iterations; `parts` override single fields."""
    base: dict[str, dict[str, object]] = {
        "surfels": {"iterations": 8, "resolution": 32, "supersample": 1, "initial": 200, "maximum": 300},
        "refinement": {"iterations": 8, "resolution": 32, "supersample": 1, "per_triangle": 3},
    }
    merged = {name: {**base.get(name, {}), **parts.get(name, {})} for name in {*base, *parts}}
    return GenerationConfig.model_validate(merged)
