"""A small asset with every part, and awkward floats in each array."""

from __future__ import annotations

from dataclasses import fields

import numpy as np
import torch

from gdpro_sim.asset import Asset
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.materials import Material
from gdpro_sim.meshing.tetmesh import Embedding, TetMesh

ODD = np.array([-0.0, 1e-45, 1e-40, 1.1754942e-38, 1 / 3, 16777217.0], np.float32)
"""Negative zero, denormals, and values that short decimals cannot hold."""


def sphere(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """A closed, outward triangle mesh of radius 1: vertices [V, 3] float32 and faces [F, 3] int32."""
    columns = 2 * rings
    theta = np.linspace(0, np.pi, rings + 1)[1:-1]
    phi = np.arange(columns) * (2 * np.pi / columns)
    t, p = np.meshgrid(theta, phi, indexing="ij")
    body = np.stack([np.sin(t) * np.cos(p), np.sin(t) * np.sin(p), np.cos(t)], -1).reshape(-1, 3)
    vertices = np.concatenate([[[0, 0, 1]], body, [[0, 0, -1]]]).astype(np.float32)
    last = len(vertices) - 1
    faces = []
    for j in range(columns):
        k = (j + 1) % columns
        faces.append((0, 1 + j, 1 + k))
        for i in range(rings - 2):
            a, b = 1 + i * columns, 1 + (i + 1) * columns
            faces += [(a + j, b + j, b + k), (a + j, b + k, a + k)]
        base = 1 + (rings - 2) * columns
        faces.append((base + j, last, base + k))
    return vertices, np.array(faces, np.int32)


def make_bound(count: int = 200, degree: int = 1, rings: int = 6, seed: int = 0) -> BoundGaussians:
    """`count` Gaussians on a unit sphere."""
    rng = np.random.default_rng(seed)
    vertices, faces = sphere(rings)
    k = (degree + 1) ** 2
    return BoundGaussians(
        torch.from_numpy(vertices),
        torch.from_numpy(faces),
        torch.from_numpy(rng.integers(0, len(faces), count).astype(np.int32)),
        torch.from_numpy(rng.dirichlet([1, 1, 1], count).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(count, 2)).astype(np.float32)),
        torch.from_numpy(rng.normal(-4, 0.3, (count, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=count).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(count, k, 3)).astype(np.float32)),
    )


def make_asset(count: int = 200, degree: int = 1, rings: int = 6, *, odd: bool = True) -> Asset:
    """An asset with colours, two tets, an embedding, a material and provenance."""
    rng = np.random.default_rng(1)
    bound = make_bound(count, degree, rings)
    vertex_count = len(bound.vertices)
    points = np.array([[-4, -4, -4], [4, -4, -4], [-4, 4, -4], [-4, -4, 4], [4, 4, 4]], np.float32)
    tets = np.array([[0, 1, 2, 3], [1, 2, 3, 4]], np.int32)
    weights = rng.dirichlet([1, 1, 1, 1], vertex_count).astype(np.float32)
    colors = rng.random((vertex_count, 3)).astype(np.float32)
    if odd:
        bound.sh.view(-1)[: len(ODD)] = torch.from_numpy(ODD)
        bound.opacity_logits[: len(ODD)] = torch.from_numpy(ODD)
        bound.vertices[0, :2] = torch.from_numpy(ODD[:2])
        bound.barycentrics[0] = torch.tensor([-0.0, 1e-45, 1.0])
        weights[0] = [-0.25, -0.0, 1e-40, 1.25]
        colors[0] = [-0.0, 1e-45, 1 / 3]
        points[0, 0] = np.float32(-4.1)
    return Asset(
        name='jelly "bunny" – é\n',
        gaussians=bound,
        vertex_colors=colors,
        tets=TetMesh(points, tets, np.array([1.0, 1 / 3], np.float32), "lattice"),
        embedding=Embedding(rng.integers(0, 2, vertex_count).astype(np.int32), weights),
        material=Material(young=12345.678901234567, poisson=0.1 + 0.2, density=1000 / 3),
        provenance={"source": "a.obj", "list": [1, 2.5, None, True], "é": {"x": 1e-300}, "text": 'a\n"b"\\'},
    )


def assert_same(a: Asset, b: Asset) -> None:
    """Every part equal, arrays bit for bit."""
    assert (a.name, a.material, a.provenance) == (b.name, b.material, b.provenance)
    for f in fields(a.gaussians):
        assert_bits(f.name, getattr(a.gaussians, f.name).numpy(), getattr(b.gaussians, f.name).numpy())
    assert_bits("vertex_colors", a.vertex_colors, b.vertex_colors)
    assert (a.tets is None) == (b.tets is None)
    if a.tets is not None and b.tets is not None and a.embedding is not None and b.embedding is not None:
        assert a.tets.method == b.tets.method
        for name in ("vertices", "tets", "fill"):
            assert_bits(name, getattr(a.tets, name), getattr(b.tets, name))
        for name in ("tet_ids", "weights"):
            assert_bits(name, getattr(a.embedding, name), getattr(b.embedding, name))


def assert_bits(name: str, x: np.ndarray | None, y: np.ndarray | None) -> None:
    assert (x is None) == (y is None), name
    if x is not None and y is not None:
        assert (x.dtype, x.shape) == (y.dtype, y.shape), name
        assert x.tobytes() == y.tobytes(), name
