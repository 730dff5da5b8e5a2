"""Structured tet meshes and models of one uniform material."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Load
from gdpro_sim.simulation.model import FemSettings, Ground, Model


def tet_box(
    cells: tuple[int, int, int],
    size: tuple[float, float, float],
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """A box of cells, 6 tets each (Kuhn): vertices [P, 3] float64, tets [T, 4] int32, volumes > 0."""
    axes = [np.linspace(0.0, s, n + 1) + o for n, s, o in zip(cells, size, origin, strict=True)]
    return tet_grid(*axes)


def tet_grid(x: np.ndarray, y: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The box of cells between rising coordinates x, y and z; see `tet_box`."""
    nx, ny, nz = (len(axis) - 1 for axis in (x, y, z))
    vertices = np.stack(np.meshgrid(x, y, z, indexing="ij"), axis=-1).reshape(-1, 3)
    i, j, k = (a.reshape(-1) for a in np.meshgrid(range(nx), range(ny), range(nz), indexing="ij"))
    stride = np.array([(ny + 1) * (nz + 1), nz + 1, 1])
    base = i * stride[0] + j * stride[1] + k
    tets = []
    for path in itertools.permutations(range(3)):
        corners = [base]
        for axis in path:
            corners.append(corners[-1] + stride[axis])
        if np.linalg.det(np.eye(3)[list(path)]) < 0.0:
            corners[2], corners[3] = corners[3], corners[2]
        tets.append(np.stack(corners, axis=1))
    return vertices, np.concatenate(tets).astype(np.int32)


def uneven_box(cells: int, size: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A cube, see `tet_box`: vertices, tets, and which vertices lie inside [P] bool.

    Those are moved, so that no two elements are alike; vertices are exact in float32.
    """
    vertices, tets = tet_box((cells,) * 3, (size,) * 3)
    inside = np.all((vertices > 1e-9) & (vertices < size - 1e-9), axis=1)
    vertices[inside] += 0.04 * size / cells * np.random.default_rng(0).normal(size=(int(inside.sum()), 3))
    return vertices.astype(np.float32).astype(np.float64), tets, inside


def tet_ball(cells: int, radius: float, grading: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A ball around the origin: the cube of `cells`^3 cells, smoothly rounded, see `tet_box`.

    grading: 0 for even cells; larger ones crowd them around the lowest point, (0, 0, -radius)
    """
    even = np.linspace(-1.0, 1.0, cells + 1)
    sideways, upward = even, even
    if grading > 0.0:
        sideways = np.sinh(grading * even) / np.sinh(grading)
        upward = 2.0 * np.expm1(0.5 * grading * (even + 1.0)) / np.expm1(grading) - 1.0
    cube, tets = tet_grid(sideways, sideways, upward)
    squares = cube**2
    a, b = squares[:, [1, 2, 0]], squares[:, [2, 0, 1]]
    return radius * cube * np.sqrt(1.0 - a / 2.0 - b / 2.0 + a * b / 3.0), tets


def make_model(
    vertices: np.ndarray,
    tets: np.ndarray,
    *,
    young: float = 1e6,
    poisson: float = 0.3,
    density: float | np.ndarray = 1000.0,
    rayleigh_mass: float = 0.0,
    rayleigh_stiffness: float = 0.0,
    friction: float = 0.5,
    velocities: np.ndarray | None = None,
    pinned: np.ndarray | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    ground: Ground | None = None,
    law: str | None = None,
    yield_stress: float | None = None,
    hardening: float = 0.0,
    loads: tuple[Load, ...] = (),
    colliders: tuple[Collider, ...] = (),
    device: str = "cpu",
    **settings: Any,
) -> Model:
    """A model of one uniform material without bodies (they only matter to the surface).

    density: kg/m^3, one for all elements or [T]; law: a name of `gdpro_sim.materials.LAWS`; `settings` are
    those of `FemSettings`
    """
    count, elements = len(vertices), len(tets)

    def each(value: float | np.ndarray, length: int) -> np.ndarray:
        return np.full(length, value, dtype=np.float32)

    return Model(
        bodies=(),
        vertices=vertices.astype(np.float32),
        velocities=np.zeros((count, 3), np.float32) if velocities is None else velocities.astype(np.float32),
        tets=tets.astype(np.int32),
        fill=each(1.0, elements),
        young=each(young, elements),
        poisson=each(poisson, elements),
        density=each(density, elements),
        rayleigh_mass=each(rayleigh_mass, elements),
        rayleigh_stiffness=each(rayleigh_stiffness, elements),
        friction=each(friction, count),
        contact_offset=each(0.0, count),
        pinned=np.zeros(count, bool) if pinned is None else pinned,
        gravity=gravity,
        ground=ground,
        fem=FemSettings(**settings),
        device=device,
        law=None if law is None else np.full(elements, LAWS.index(law), np.int32),
        yield_stress=None if yield_stress is None else each(yield_stress, elements),
        hardening=None if yield_stress is None else each(hardening, elements),
        loads=loads,
        colliders=colliders,
    )


__all__ = ["make_model", "tet_ball", "tet_box", "tet_grid", "uneven_box"]
