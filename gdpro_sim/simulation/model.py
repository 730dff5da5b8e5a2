"""Compiled scenes: `Model` is constant, `State` changes, `Solver` turns one state into the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.meshing.tetmesh import Embedding
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Load, Motion, Springs


@dataclass(frozen=True)
class Body:
    """One deformable body inside a `Model`, in world space.

    name:           unique within the scene
    gaussians:      bound Gaussians at the body's own size, in the asset's frame
    surface:        [V, 3] float32 m, rest surface vertices placed in the world
    embedding:      surface vertices in this body's tets (tet ids count from the body's first tet)
    vertex_range:   (begin, end) into Model.vertices
    tet_range:      (begin, end) into Model.tets
    """

    name: str
    gaussians: BoundGaussians
    surface: np.ndarray
    embedding: Embedding
    vertex_range: tuple[int, int]
    tet_range: tuple[int, int]


@dataclass(frozen=True)
class Ground:
    """A floor: the half-space z >= height is free; friction belongs to the bodies."""

    height: float = 0.0


Integrator = Literal["backward-euler", "bdf2", "midpoint", "quasi-static", "explicit"]


@dataclass(frozen=True)
class FemSettings:
    """How the FEM solver steps.

    integrator:        "backward-euler" damps motion a little and is never unstable; "bdf2" and "midpoint"
                       damp far less (midpoint where nothing touches, else it is backward Euler);
                       "quasi-static" goes to where forces balance, without inertia;
                       "explicit" is symplectic Euler in as many substeps as stability needs
    substeps:          implicit steps per `step(dt)`; a substep that fails is halved by the solver
    newton_iterations: most projected-Newton iterations in one substep before it counts as failed
    newton_tolerance:  stop when a full Newton step moves no vertex by more than this times dt, m/s
    cg_iterations:     most inner conjugate gradient iterations per Newton iteration
    cg_tolerance:      relative (preconditioned) residual of the inner conjugate gradients
    volumes:           "nodal" averages volume changes over the elements around each vertex, which keeps
                       nearly incompressible bodies from locking; "element" does not; "auto" averages where
                       Poisson's ratio is 0.45 or more. The linear law never does
    contact_stiffness: multiple of the ground penalty stiffness that the solver derives from each body's
                       own elasticity and weight
    contact_gap:       distance that contact between bodies keeps, as a fraction of the smallest body's size
    body_contact:      whether bodies collide with each other
    self_contact:      whether bodies collide with themselves; needs body_contact
    """

    integrator: Integrator = "backward-euler"
    substeps: int = 2
    newton_iterations: int = 60
    newton_tolerance: float = 1e-3
    cg_iterations: int = 2000
    cg_tolerance: float = 1e-2
    volumes: Literal["auto", "nodal", "element"] = "auto"
    contact_stiffness: float = 1.0
    contact_gap: float = 1e-3
    body_contact: bool = True
    self_contact: bool = False


@dataclass(frozen=True)
class Model:
    """A compiled scene: everything constant. Arrays are float32 / int32 NumPy, SI units, world space.

    vertices:    [P, 3] undeformed positions of all bodies' tet vertices
    velocities:  [P, 3] initial velocities
    tets:        [T, 4] positive volumes
    fill:        [T] fraction of material in each element
    young, poisson, density, rayleigh_mass, rayleigh_stiffness: [T]
    friction:    [P] Coulomb coefficient of each vertex against the ground
    contact_offset: [P] m, how far each vertex lies outside the surface at rest (a lattice overlaps it);
                 it touches the ground that much later
    pinned:      [P] bool, vertices that are held where they are, or where `motions` take them
    release:     [P] s, when a pinned vertex is let go, inf for never; None: none is
    motions, springs, loads: see `gdpro_sim.simulation.conditions`
    law:         [T] int32 constitutive law, a number of `gdpro_sim.materials.LAWS`; None: stable neo-Hookean
    yield_stress, hardening: [T] Pa, of elements with the law "stvk_hencky"; inf does not yield; None: none do
    """

    bodies: tuple[Body, ...]
    vertices: np.ndarray
    velocities: np.ndarray
    tets: np.ndarray
    fill: np.ndarray
    young: np.ndarray
    poisson: np.ndarray
    density: np.ndarray
    rayleigh_mass: np.ndarray
    rayleigh_stiffness: np.ndarray
    friction: np.ndarray
    contact_offset: np.ndarray
    pinned: np.ndarray
    gravity: tuple[float, float, float]
    ground: Ground | None
    fem: FemSettings
    device: str = "cpu"
    law: np.ndarray | None = None
    yield_stress: np.ndarray | None = None
    hardening: np.ndarray | None = None
    release: np.ndarray | None = None
    motions: tuple[Motion, ...] = ()
    springs: Springs | None = None
    loads: tuple[Load, ...] = ()
    colliders: tuple[Collider, ...] = ()


@dataclass(frozen=True)
class Diagnostics:
    """What a solver reports about its last `step`. Energies in J, momentum in kg m/s, SI throughout.

    force_energy: held by springs, and by pressure on closed surfaces
    """

    time: float
    kinetic_energy: float
    elastic_energy: float
    gravity_energy: float
    contact_energy: float
    momentum: tuple[float, float, float]
    angular_momentum: tuple[float, float, float]
    contacts: int
    max_penetration: float
    min_volume_ratio: float
    substeps: int
    newton_iterations: int
    cg_iterations: int
    converged: bool
    residual: float
    force_energy: float = 0.0


@runtime_checkable
class Solver(Protocol):
    """State -> State. `step` advances by `dt` seconds, choosing its own substeps."""

    def reset(self) -> None:
        """Back to the model's initial state."""

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds. Raises SolverError, leaving the state as it was, if it cannot."""

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of body number `body`, [V, 3] float32 m, world."""

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes."""

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict`."""

    def diagnostics(self) -> Diagnostics:
        """Figures of the last step (of the initial state before any)."""


__all__ = ["Body", "Diagnostics", "FemSettings", "Ground", "Integrator", "Model", "Solver"]
