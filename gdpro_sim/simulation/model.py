"""Compiled scenes: `Model` is constant, `State` changes, `Solver` turns one state into the next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Protocol, runtime_checkable

import numpy as np

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.materials import Material
from gdpro_sim.meshing.tetmesh import Embedding
from gdpro_sim.simulation.colliders import BoundaryKind, Collider
from gdpro_sim.simulation.conditions import Hold, Load, Motion, Springs
from gdpro_sim.simulation.mujoco_model import MujocoWorld

if TYPE_CHECKING:
    from gdpro_sim.simulation.animation.solver import AnimatedBody
    from gdpro_sim.simulation.placement import Placement


@dataclass(frozen=True)
class Body:
    """One deformable body inside a `Model`, in world space.

    name:           unique within the scene
    gaussians:      bound Gaussians at the body's own size, in the asset's frame
    surface:        [V, 3] float32 m, rest surface vertices placed in the world
    embedding:      surface vertices in this body's tets (tet ids count from the body's first tet); None for a
                    body of particles
    vertex_range:   (begin, end) into Model.vertices
    tet_range:      (begin, end) into Model.tets
    particle_range: (begin, end) into Model.particles
    patches:        [V] int32, ascending: the patch each surface vertex belongs to, where the surface may come
                    apart (`gdpro_sim.simulation.mpm.look.unweld`); None: it stays whole
    vertex_colors:  [V, 3] float32 sRGB of a surface that is not the asset's; None: the asset's
    spacing:        m, between the particles of a fluid, whose surface is made of them in every frame
                    (`gdpro_sim.simulation.mpm.fluid_look`); None: it is carried along
    placement:      of its asset in the world, where a scene placed it
    """

    name: str
    gaussians: BoundGaussians
    surface: np.ndarray
    embedding: Embedding | None
    vertex_range: tuple[int, int] = (0, 0)
    tet_range: tuple[int, int] = (0, 0)
    particle_range: tuple[int, int] = (0, 0)
    patches: np.ndarray | None = None
    vertex_colors: np.ndarray | None = None
    spacing: float | None = None
    placement: Placement | None = None


@dataclass(frozen=True)
class Ground:
    """A floor: the half-space z >= height is free; friction belongs to the bodies.

    boundary: what matter does that touches it (MPM)
    """

    height: float = 0.0
    boundary: BoundaryKind = "separate"


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
class Particles:
    """Material points of every MPM body, body after body. World space, SI units.

    positions:  [N, 3] float32 m
    velocities: [N, 3] float32 m/s
    volumes:    [N] float32 m^3 at rest, > 0
    matter:     [N] int32, number of the particle's material in `materials`
    materials:  what the particles are made of; as many as there are different ones
    spacing:    m, distance between neighbours: the cube root of a particle's volume
    gradients:  [N, 3, 3] float32 1/s, velocity gradients: of a body that spins, the matrix of w x; None: zero
    """

    positions: np.ndarray
    velocities: np.ndarray
    volumes: np.ndarray
    matter: np.ndarray
    materials: tuple[Material, ...]
    spacing: float
    gradients: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.positions)


@dataclass(frozen=True)
class MpmSettings:
    """How the MPM solver steps.

    integrator:    "explicit" takes as many substeps as sound and particle speeds ask for; "implicit" is
                   backward Euler on the grid, for stiff elastic bodies
    grid_spacing:  m, edge of a cell; None: twice the particles' spacing, which makes 8 of them a cell
    kernel:        B-splines between particles and grid; "cubic" is smoother, and dearer
    transfer:      "apic" keeps angular momentum; "pic" damps rotation and shear; "flip" keeps the particles'
                   own velocities, and their noise, by `flip_ratio`
    flip_ratio:    share of FLIP in "flip", the rest is APIC
    cfl:           a substep is at most this many cells long for what moves at particle plus sound speed
    max_substeps:  substeps per `step(dt)` past which the solver refuses
    domain:        (low, high) corners of a closed box, m, that particles cannot leave; None: no walls
    max_cells:     cells of the grid's bounding box past which the solver refuses

    "implicit" alone, for which `cfl` bounds what moves at particle speed:

    substeps:          substeps per `step(dt)` at least; one that fails is halved by the solver
    newton_iterations: most projected-Newton iterations in one substep before it counts as failed
    newton_tolerance:  m/s; stop when a full Newton step changes no node's velocity by more, lighter nodes
                       counting by the root of their mass
    cg_iterations:     most inner conjugate gradient iterations per Newton iteration
    cg_tolerance:      relative (preconditioned) residual of the inner conjugate gradients
    """

    integrator: Literal["explicit", "implicit"] = "explicit"
    grid_spacing: float | None = None
    kernel: Literal["quadratic", "cubic"] = "quadratic"
    transfer: Literal["apic", "pic", "flip"] = "apic"
    flip_ratio: float = 0.95
    cfl: float = 0.3
    max_substeps: int = 20_000
    domain: tuple[tuple[float, float, float], tuple[float, float, float]] | None = None
    max_cells: int = 1 << 31
    substeps: int = 2
    newton_iterations: int = 60
    newton_tolerance: float = 1e-3
    cg_iterations: int = 2000
    cg_tolerance: float = 1e-2


PartName = Literal["fem", "mpm", "mujoco"]


@dataclass(frozen=True)
class Link:
    """A rigid body that soft ones meet.

    body:      number in `MujocoWorld.bodies`; of one of the base, its number in the base's own MuJoCo model
    colliders: its solid where it starts, without a motion
    """

    body: int
    of_base: bool
    colliders: tuple[Collider, ...]


@dataclass(frozen=True)
class Coupling:
    """Several solvers in one scene: rigid bodies in MuJoCo, soft ones in FEM and MPM.

    parts:      the model of each solver; "mujoco" is always there, the others where they have bodies
    places:     of each of `Model.bodies`: its solver, and its number there
    links:      rigid bodies that move, which the parts do not hold as colliders
    step:       s at most, after which the solvers agree anew
    iterations: at most, of one step, until they agree; else it is halved
    tolerance:  m/s, by which a rigid body may move otherwise than soft ones were told
    """

    parts: dict[PartName, Model]
    places: tuple[tuple[PartName, int], ...]
    links: tuple[Link, ...] = ()
    step: float = 2e-3
    iterations: int = 10
    tolerance: float = 2e-3


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
    motions, springs, loads, holds: see `gdpro_sim.simulation.conditions`
    law:         [T] int32 constitutive law, a number of `gdpro_sim.materials.LAWS`; None: stable neo-Hookean
    yield_stress, hardening: [T] Pa, of elements with the law "stvk_hencky"; inf does not yield; None: none do
    particles:   material points of the bodies that MPM simulates; None: FEM simulates tets
    mujoco:      rigid and soft bodies that MuJoCo simulates, in the order of `bodies`; None: others simulate
    animation:   how each of `bodies` follows a motion, None for one that stands still; None: others simulate
    coupling:    several solvers' models, whose arrays stand here, too; None: one solver simulates all
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
    particles: Particles | None = None
    holds: tuple[Hold, ...] = ()
    mpm: MpmSettings = MpmSettings()
    mujoco: MujocoWorld | None = None
    animation: tuple[AnimatedBody | None, ...] | None = None
    coupling: Coupling | None = None

    @staticmethod
    def without_tets(
        particles: Particles | None = None,
        *,
        bodies: tuple[Body, ...] = (),
        gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
        ground: Ground | None = None,
        mpm: MpmSettings | None = None,
        colliders: tuple[Collider, ...] = (),
        holds: tuple[Hold, ...] = (),
        loads: tuple[Load, ...] = (),
        device: str = "cpu",
    ) -> Model:
        """A model of particles, or of nothing that deforms by tets."""
        none = np.zeros(0, np.float32)
        return Model(
            bodies=bodies,
            vertices=np.zeros((0, 3), np.float32),
            velocities=np.zeros((0, 3), np.float32),
            tets=np.zeros((0, 4), np.int32),
            fill=none,
            young=none,
            poisson=none,
            density=none,
            rayleigh_mass=none,
            rayleigh_stiffness=none,
            friction=none,
            contact_offset=none,
            pinned=np.zeros(0, bool),
            gravity=gravity,
            ground=ground,
            fem=FemSettings(),
            device=device,
            loads=loads,
            colliders=colliders,
            particles=particles,
            holds=holds,
            mpm=mpm or MpmSettings(),
        )


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


__all__ = [
    "Body",
    "Coupling",
    "Diagnostics",
    "FemSettings",
    "Ground",
    "Integrator",
    "Link",
    "Model",
    "MpmSettings",
    "PartName",
    "Particles",
    "Solver",
]
