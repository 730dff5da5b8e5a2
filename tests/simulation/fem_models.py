"""Small structured tet boxes and models for the FEM tests."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import FemSettings, Ground, Model


def tet_box(
    cells: tuple[int, int, int],
    size: tuple[float, float, float],
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """A box of cells, 6 tets each (Kuhn): vertices [P, 3] float64, tets [T, 4] int32, volumes > 0."""
    nx, ny, nz = cells
    axes = [np.linspace(0.0, s, n + 1) + o for n, s, o in zip(cells, size, origin, strict=True)]
    vertices = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
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


def make_model(
    vertices: np.ndarray,
    tets: np.ndarray,
    *,
    young: float = 1e6,
    poisson: float = 0.3,
    density: float = 1000.0,
    rayleigh_mass: float = 0.0,
    rayleigh_stiffness: float = 0.0,
    friction: float = 0.5,
    velocities: np.ndarray | None = None,
    pinned: np.ndarray | None = None,
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    ground: Ground | None = None,
    device: str = "cpu",
    **settings: Any,
) -> Model:
    """A model of one uniform material without bodies (they only matter to the surface)."""
    count, elements = len(vertices), len(tets)

    def each(value: float, length: int) -> np.ndarray:
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
    )


def potential_at(
    model: Model, positions: np.ndarray | None = None, h: float = 0.01, before: np.ndarray | None = None
) -> IncrementalPotential:
    """The potential of a step of h seconds from rest at `before` (default: `positions`), without terms.

    Its trial stands at `positions` (default: the model's vertices).
    """
    potential = IncrementalPotential(model, rest_shapes(model), ())
    x = np.asarray(model.vertices if positions is None else positions, np.float64)
    potential.trial.assign(x)
    state = wp.array(x if before is None else before, dtype=wp.vec3d, device=model.device)
    potential.begin(Step(h, h, state, wp.zeros_like(state), potential.base, wp.clone(state)))
    for array in (potential.base, potential.inertia):
        wp.copy(array, state)
    potential.strain_base(state, 1.0, state, 0.0)
    return potential
