"""What MuJoCo simulates, compiled: constant arrays in float64, SI units, world space.

Bodies stand in the order of `Model.bodies`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np

from gdpro_sim.simulation.callbacks import Callback
from gdpro_sim.simulation.conditions import Motion

JointKind = Literal["free", "fixed", "hinge", "slide", "ball"]
Reduction = Literal["full", "trilinear", "quadratic"]

FRAME = 4
"""Points of a rigid body before its surface: its centre, and along the world's axes at the start."""


@dataclass(frozen=True)
class Shape:
    """A convex solid around `position` [3] m from a body's centre, turned by `rotation` [3, 3].

    size:            m: box half extents; sphere radius; capsule and cylinder (along Z) radius and half length
    vertices, faces: [V, 3] m and [F, 3] int32 of a "mesh"
    """

    kind: Literal["mesh", "box", "sphere", "capsule", "cylinder"]
    size: tuple[float, ...] = ()
    position: np.ndarray = field(default_factory=lambda: np.zeros(3))
    rotation: np.ndarray = field(default_factory=lambda: np.eye(3))
    vertices: np.ndarray | None = None
    faces: np.ndarray | None = None


@dataclass(frozen=True)
class Joint:
    """How a rigid body hangs on the world.

    anchor:  [3] m, where a hinge or ball turns
    axis:    [3] of a hinge or slide
    damping: N m s/rad, of a slide N s/m
    limits:  (least, most) rad or m from the start, or None
    """

    kind: JointKind = "free"
    anchor: tuple[float, float, float] = (0.0, 0.0, 0.0)
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    damping: float = 0.0
    limits: tuple[float, float] | None = None


@dataclass(frozen=True)
class RigidBody:
    """mass in kg; centre [3] m, of mass; inertia [3, 3] kg m^2 about it, world axes; surface [V, 3] m.

    restitution: speed after over speed before an impact, of what is as bouncy or more
    motion:      takes it along, whatever it meets; its joint is "fixed" then
    """

    name: str
    shapes: tuple[Shape, ...]
    mass: float
    centre: np.ndarray
    inertia: np.ndarray
    surface: np.ndarray
    joint: Joint = Joint()
    friction: float = 0.5
    restitution: float = 0.0
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    motion: Motion | None = None

    @property
    def points(self) -> np.ndarray:
        """[FRAME + V, 3] m that forces act on: its centre, three points at its size from it, its surface."""
        size = float(np.linalg.norm(np.ptp(self.surface, axis=0))) or 1.0
        return np.concatenate([self.centre[None], self.centre + size * np.eye(3), self.surface])


@dataclass(frozen=True)
class Tie:
    """Vertices [n] int32 of a soft body that the rigid body number `body` carries."""

    vertices: np.ndarray
    body: int


@dataclass(frozen=True)
class SoftBody:
    """Tets as a flex: with every vertex free, or carried by a grid of nodes.

    vertices: [P, 3] m; tets: [T, 4] int32; masses: [P] kg
    damping:  s, Rayleigh's coefficient of stiffness
    pinned:   [P] bool, vertices that are held, or moved by `motions` (which count vertices from 0)
    cells:    of the grid along X, Y and Z; not of a full flex
    radius:   m, how far out the flex touches
    neo_hookean: stable neo-Hookean elasticity, else Saint Venant-Kirchhoff, which is all a grid of nodes has
    ties:     to rigid bodies, of a full flex; no vertex is pinned, or in two of them
    """

    name: str
    vertices: np.ndarray
    tets: np.ndarray
    masses: np.ndarray
    young: float
    poisson: float
    damping: float = 0.0
    friction: float = 0.5
    reduction: Reduction = "full"
    cells: tuple[int, int, int] = (1, 1, 1)
    pinned: np.ndarray | None = None
    motions: tuple[Motion, ...] = ()
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius: float = 1e-3
    self_contact: bool = False
    neo_hookean: bool = True
    ties: tuple[Tie, ...] = ()

    @property
    def points(self) -> np.ndarray:
        """[P, 3] m that forces act on."""
        return self.vertices

    @property
    def stable(self) -> bool:
        """Whether its elasticity is stable neo-Hookean."""
        return self.neo_hookean and self.reduction == "full"

    @property
    def centre(self) -> np.ndarray:
        """[3] m, of mass."""
        centre: np.ndarray = self.masses @ self.vertices / self.masses.sum()
        return centre


@dataclass(frozen=True)
class MujocoSettings:
    """How MuJoCo steps.

    timestep:   s at most; a `step(dt)` is cut into equal parts
    iterations: of the constraint solver at most; None: 100 of Newton's, 500 conjugate gradients
    tolerance:  at which they end
    solver:     of constraints: "cg", conjugate gradients, is quick where full flexes touch what stands or
                each other; beside rigid bodies that move it does not converge, and "newton" does, at a cost
                that grows faster than the body. "auto" chooses
    impratio:   stiffness of friction over that of contact normals: a high one creeps less
    cone:       of friction; the elliptic one is Coulomb's
    """

    timestep: float = 1e-3
    iterations: int | None = None
    tolerance: float = 1e-8
    impratio: float = 100.0
    cone: Literal["elliptic", "pyramidal"] = "elliptic"
    solver: Literal["auto", "newton", "cg"] = "auto"


@dataclass(frozen=True)
class Control:
    """What an actuator is told: values [K] at times [K] s, linear in between, held before and after."""

    actuator: str
    times: np.ndarray
    values: np.ndarray


@dataclass(frozen=True)
class MujocoWorld:
    """Everything of a `Model` that is MuJoCo's.

    base:     an MJCF file whose world the bodies join
    keyframe: of the base, that it starts from; None: its own beginning
    controls: of the base's actuators
    welds:    pairs of rigid bodies that are held to each other as they stand at the start
    callback: (time in s, MuJoCo's `MjData`) -> what actuators are told by name, or of all in their order;
              called before every step of MuJoCo, after the keyframes
    """

    bodies: tuple[RigidBody | SoftBody, ...] = ()
    settings: MujocoSettings = MujocoSettings()
    base: Path | None = None
    keyframe: str | None = None
    controls: tuple[Control, ...] = ()
    welds: tuple[tuple[int, int], ...] = ()
    callback: Callback | None = None

    def firsts(self) -> list[int]:
        """Where each body's points begin in what springs and loads of the `Model` count, and their number."""
        counts = [len(body.points) for body in self.bodies]
        return np.concatenate([[0], np.cumsum(counts)]).astype(int).tolist()


__all__ = [
    "FRAME",
    "Control",
    "Joint",
    "JointKind",
    "MujocoSettings",
    "MujocoWorld",
    "Reduction",
    "RigidBody",
    "Shape",
    "SoftBody",
    "Tie",
]
