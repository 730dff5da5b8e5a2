"""Rigid bodies beside soft ones, small enough to compute by hand."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.compile_coupled import rigid_links
from gdpro_sim.simulation.conditions import Guide
from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.model import Coupling, Model, PartName
from gdpro_sim.simulation.mujoco_model import MujocoSettings, MujocoWorld, RigidBody
from gdpro_sim.simulation.verification import mujoco_models
from gdpro_sim.simulation.verification.models import make_model, tet_box

JELLY: dict[str, Any] = {"young": 2e4, "poisson": 0.4, "substeps": 1, "newton_tolerance": 1e-4}


def coupled(soft: Model, *bodies: RigidBody, timestep: float = 1e-3, **options: Any) -> Model:
    """Rigid bodies among soft ones, a model of FEM or MPM: they share its ground, gravity and obstacles.

    Its guided obstacles are for the soft ones alone. `options` are those of `Coupling`.
    """
    shared = tuple(item for item in soft.colliders if not isinstance(item.motion, Guide))
    empty = make_model(
        np.zeros((0, 3)), np.zeros((0, 4), np.int32), ground=soft.ground, gravity=soft.gravity,
        colliders=shared,
    )  # fmt: skip
    rigid = replace(empty, mujoco=MujocoWorld(bodies, MujocoSettings(timestep=timestep)))
    links, still = rigid_links(rigid)
    part: PartName = "fem" if soft.particles is None else "mpm"
    parts = {part: replace(soft, colliders=(*soft.colliders, *still)), "mujoco": rigid}
    return replace(soft, mujoco=rigid.mujoco, coupling=Coupling(parts, (), links, **options))


def ball(radius: float, density: float, centre: tuple[float, float, float], **options: Any) -> RigidBody:
    """A solid ball; `options` are fields of `RigidBody`."""
    made = mujoco_models.ball(radius, 0.0, **options)
    share, at = density / mujoco_models.DENSITY, np.asarray(centre, float)
    return replace(made, mass=share * made.mass, inertia=share * made.inertia, centre=at, surface=at[None])


def jelly_block(
    cells: tuple[int, int, int], size: tuple[float, float, float], top: float = 0.0, **options: Any
) -> Model:
    """A block of jelly in FEM that ends at z = `top` m, above it the z axis; `options` as of `make_model`."""
    origin = (-0.5 * size[0], -0.5 * size[1], top - size[2])
    return make_model(*tet_box(cells, size, origin), **{**JELLY, **options})


def scale_under(model: Model, height: float) -> Model:
    """A floor z = `height` under soft bodies that tells what it is given."""
    floor = replace(Collider.floor(height), motion=Guide(np.zeros(3)))
    return replace(model, colliders=(*model.colliders, floor))


def momentum(solver: SolverCoupled, part: PartName) -> np.ndarray:
    """[6] kg m/s and kg m^2/s about the world's origin of the bodies of a part."""
    found = solver.solvers[part].diagnostics()
    return np.array([*found.momentum, *found.angular_momentum])


def total_momentum(solver: SolverCoupled) -> np.ndarray:
    """[6] of all bodies."""
    return np.sum([momentum(solver, part) for part in solver.solvers], axis=0)


def total_energy(solver: SolverCoupled) -> float:
    """Kinetic, elastic, of gravity and of contact, J."""
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


@dataclass(frozen=True)
class Line:
    """Vertical momenta of a ball on a jelly at a time in s, kg m/s, and vertical impulses until then, N s."""

    time: float
    ball: float
    jelly: float
    ground: float
    weight: float

    @property
    def balance(self) -> float:
        """What momentum should be: what it was, and the impulses."""
        return self.ground + self.weight


def drop_on_jelly(
    density: float = 2000.0, *, height: float = 0.3, duration: float = 0.6, step: float = Coupling.step
) -> Iterator[Line]:
    """Momenta after every step of a ball of radius 0.06 m dropped on a jelly block of 8 kg at rest."""
    model = scale_under(jelly_block((5, 5, 5), (0.2, 0.2, 0.2)), -0.2)
    body = ball(0.06, density, (0.01, 0.0, 0.06 + height))
    solver = SolverCoupled(coupled(model, body, step=step))
    mass = body.mass + float(masses(model).sum())
    ground = 0.0
    for _ in range(round(duration / step)):
        solver.step(step)
        ground -= float(solver.collider_impulses("fem")[0, 2])
        yield Line(
            solver.time,
            float(momentum(solver, "mujoco")[2]),
            float(momentum(solver, "fem")[2]),
            ground,
            float(model.gravity[2]) * mass * solver.time,
        )


def masses(model: Model) -> np.ndarray:
    """[P] kg of the vertices of soft bodies in FEM."""
    corners = model.vertices[model.tets].astype(np.float64)
    mass = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0 * model.density * model.fill
    return np.bincount(model.tets.ravel(), weights=np.repeat(mass / 4.0, 4), minlength=len(model.vertices))


__all__ = [
    "JELLY",
    "Line",
    "ball",
    "coupled",
    "drop_on_jelly",
    "jelly_block",
    "masses",
    "momentum",
    "scale_under",
    "total_energy",
    "total_momentum",
]
