"""Blocks of MPM particles for tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import TypeAdapter

from gdpro_sim.materials import Material
from gdpro_sim.simulation.colliders import Collider, ColliderOptions, compile_collider
from gdpro_sim.simulation.model import Model, Particles
from gdpro_sim.simulation.mpm import SolverMPM

GRAVITY = (0.0, 0.0, -9.81)

BALL: dict[str, Any] = {"kind": "sphere", "radius": 0.08, "mass": 2.0}


def collider(**options: Any) -> Collider:
    return compile_collider(TypeAdapter(ColliderOptions).validate_python(options))


def block(
    cells: tuple[int, int, int] = (4, 4, 4),
    *,
    size: float = 0.05,
    low: tuple[float, float, float] = (0.0, 0.0, 0.0),
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0),
    young: float = 2.0e5,
    poisson: float = 0.3,
    friction: float = 0.5,
    damping: float = 0.0,
    turn: np.ndarray | None = None,
    **model: Any,
) -> Model:
    """A block of `cells` cells of `size` m, 8 particles each, its lower corner at `low`, then turned."""
    spacing = 0.5 * size
    axes = [spacing * (np.arange(2 * n) + 0.5) for n in cells]
    x = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3) + low
    v = np.tile(velocity, (len(x), 1))
    if turn is not None:
        x, v = x @ turn.T, v @ turn.T
    material = Material(
        model="neo_hookean", young=young, poisson=poisson, density=1000.0, friction=friction,
        rayleigh_mass=damping,
    )  # fmt: skip
    particles = Particles(
        positions=x.astype(np.float32),
        velocities=v.astype(np.float32),
        volumes=np.full(len(x), spacing**3, np.float32),
        matter=np.zeros(len(x), np.int32),
        materials=(material,),
        spacing=spacing,
    )
    return Model.without_tets(particles, **model)


def run(solver: SolverMPM, seconds: float, frame: float = 1.0 / 60.0) -> SolverMPM:
    for _ in range(round(seconds / frame)):
        solver.step(frame)
    return solver
