"""The ground and other rigid obstacles as a term of the incremental potential.

Every vertex has a penalty and lagged Coulomb friction against every obstacle. Where an obstacle is thin the
penalty turns into a barrier halfway through it, and steps end before a vertex could come out on the other
side, so nothing tunnels at any speed. A moving obstacle is met in its own frame; one that goes through more
than half its own thickness within the shortest substep, into something at rest, is a SolverError. Contact is
that of vertices: an edge or a corner of an obstacle smaller than the body's triangles can poke through
between them.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import launch_chunked
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import colliders as kernels
from gdpro_sim.simulation.collider_shapes import ColliderShape, placed
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import FOREVER, Guide
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.term import Step, hosted
from gdpro_sim.simulation.model import Model

CONTACT_PER_ELASTIC = 3.0
"""Contact stiffness of a vertex as a multiple of its own elastic stiffness."""

STICK_PER_ELASTIC = 1.0
"""Friction spring stiffness of a vertex as a multiple of its own elastic stiffness. Stiffer makes the
stick-slip kink sharper and Newton zigzag across it (ten times the iterations on a soft body, measured), and
buys only a smaller elastic give before slipping; at 1 that give is that of one more layer of elements."""

CONTACT_SAG = 1e-3
"""Penetration, as a fraction of the body's size, at which one vertex would carry the whole body's weight."""

CONTACT_RAMP = 1e-4
"""Depth over which the penalty turns from cubic to quadratic, as a fraction of the body's size."""

STANDARD_GRAVITY = 9.81


class RigidBody:
    """A collider's data on the device: where it stood when the step began, and where it stands.

    before, now: `gdpro_sim.kernels.colliders.Collider`
    """

    def __init__(self, collider: Collider, device: str) -> None:
        self.collider = collider
        self._shape = ColliderShape(collider, device)
        self.before, self.now = self._shape.struct(), self._shape.struct()
        self.place(0.0, 0.0)

    def place(self, start: float, time: float) -> None:
        """Stand `before` where it is at `start`, and `now` where it is at `time`, s."""
        for struct, when in ((self.before, start), (self.now, time)):
            rotation, position = placed(self.collider, when)
            struct.rotation = wp.mat33d(*rotation.ravel())
            struct.position = wp.vec3d(*position)


class ColliderContact:
    """All vertices against one collider. Implements `gdpro_sim.simulation.fem.term.Term`.

    Raises SolverError for a body that starts too deep inside.
    """

    def __init__(self, model: Model, rest: RestShapes, collider: Collider) -> None:
        self.device = model.device
        self.energies = len(model.vertices)
        self.body = RigidBody(collider, self.device)
        stiffness, stick, ramp = _scales(model, rest)
        carried = rest.mass > 0.0
        self.frequency = float(np.sqrt(((stiffness + stick)[carried] / rest.mass[carried]).max(initial=0.0)))
        friction = model.friction.astype(np.float64)
        if collider.friction is not None:
            friction = np.sqrt(friction * collider.friction)
        self.touch = kernels.Touch()
        self.touch.friction = reals(friction, self.device)
        self.touch.stiffness = reals(stiffness, self.device)
        self.touch.stick = reals(stick, self.device)
        self.touch.ramp = reals(ramp, self.device)
        self.touch.offset = reals(model.contact_offset, self.device)
        self.touch.room = collider.room
        self._inside = model.contact_offset.astype(np.float64)
        if collider.room > 0.0:
            self._inside = np.minimum(self._inside, 0.5 * collider.room)
        self._anchor, self._normal = (
            wp.zeros(self.energies, dtype=wp.vec3d, device=self.device) for _ in range(2)
        )
        self._limit, self._terms, self._distance, self._share = (
            wp.zeros(self.energies, dtype=wp.float64, device=self.device) for _ in range(4)
        )
        self._start: wp.array | None = None
        # Of one that is guided: forces on the vertices, and what they gave it in the step under way.
        self._forces, self._blocks = (
            wp.zeros(self.energies if self.guided else 0, dtype=dtype, device=self.device)
            for dtype in (wp.vec3d, wp.mat33d)
        )
        self.impulse = np.zeros(6)
        x: wp.array = wp.array(model.vertices.astype(np.float64), dtype=wp.vec3d, device=self.device)
        self._over_vertices(kernels.place_anchors, [self.body.now, x], [self._anchor])
        self._check_outside(model, x)

    @property
    def guided(self) -> bool:
        """Whether another solver moves it, and wants to know what it is given."""
        return isinstance(self.body.collider.motion, Guide)

    def begin(self, step: Step) -> None:
        self._start = step.x
        if self.body.collider.motion is not None:
            self.body.place(step.start, step.time)

    def lag(self, x: wp.array) -> None:
        """Take the Coulomb limits from the normal forces at x; they stay until the next call."""
        inputs = [self.body.now, self.touch, x]
        self._over_vertices(kernels.friction_limits, inputs, [self._limit, self._normal])

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        inputs = [first, self.body.now, self.touch, x, self._anchor, self._limit, self._normal]
        self._over_vertices(kernels.contact_energy, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        inputs = [self.body.now, self.touch, x, self._anchor, self._limit, self._normal]
        self._over_vertices(kernels.add_contact_derivatives, inputs, [gradient, block])
        return None

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        """Share of `direction` on which every vertex keeps a tenth of its room; 1 where room has no end.

        From the start of the step the collider moves too.
        """
        if self.body.collider.room <= 0.0:
            return 1.0
        before = self.body.before if x is self._start else self.body.now
        inputs = [before, self.body.now, self.touch, x, direction]
        self._over_vertices(kernels.free_ways, inputs, [self._share])
        return float(self._share.numpy().min(initial=1.0))

    def finish(self, x: wp.array) -> None:
        """Drag the friction anchors along."""
        self._over_vertices(kernels.drag_anchors, [self.body.now, self.touch, x], [self._anchor])

    def take_impulse(self, x: wp.array, duration: float) -> None:
        """Add what the vertices at x, whose forces act for `duration` s, give a guided collider."""
        self._forces.zero_()
        self._blocks.zero_()
        self.add_derivatives(x, self._forces, self._blocks)
        forces = hosted(self._forces)  # of the collider on its surroundings: the gradient's sign
        acting = np.flatnonzero(forces.any(axis=1))
        given, points = forces[acting], hosted(x)[acting]
        self.impulse = self.impulse + duration * np.append(given.sum(0), np.cross(points, given).sum(0))

    def stored(self, x: wp.array) -> float:
        self.lag(x)
        self.energy(x, self._terms, 0)
        return float(self._terms.numpy().sum())

    def state(self) -> dict[str, wp.array]:
        return {"anchors": self._anchor}

    def report(self, x: wp.array) -> dict[str, float]:
        depth = self._depth(x)
        return {
            "contacts": float(np.count_nonzero(depth > 0.0)),
            "penetration": float(max(0.0, depth.max(initial=0.0))),
        }

    def _depth(self, x: wp.array) -> np.ndarray:
        """How deep the surface that each vertex stands for lies in the collider, m, negative outside."""
        outputs = [self._distance, self._normal]
        self._over_vertices(kernels.signed_distances, [self.body.now, x], outputs)
        depth: np.ndarray = -self._distance.numpy() - self._inside
        return depth

    def _check_outside(self, model: Model, x: wp.array) -> None:
        """A vertex past half the room starts where it does not know its way out."""
        room = self.body.collider.room
        if room <= 0.0:
            return
        depth = self._depth(x)
        deepest = int(np.argmax(depth))
        if depth[deepest] + self._inside[deepest] > 0.5 * room:
            names = [b.name for b in model.bodies if b.vertex_range[0] <= deepest < b.vertex_range[1]]
            body = f"body {names[0]!r}" if names else f"vertex {deepest}"
            raise SolverError(
                f"{body} starts {depth[deepest]:.3g} m inside collider {self.body.collider.name!r}; move one "
                "of them"
            )

    def _over_vertices(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_chunked(kernel, self.energies, inputs, outputs, device=self.device, minimum=4096)


def collider_contacts(model: Model, rest: RestShapes) -> tuple[ColliderContact, ...]:
    """Terms of the ground and every collider of a model.

    Raises SolverError for what only MPM knows.
    """
    if model.ground is not None and model.ground.boundary != "separate":
        raise SolverError('FEM\'s ground knows no `boundary` but "separate"; leave it out, or use MPM')
    for collider in model.colliders:
        for key, usual in (("boundary", "separate"), ("mass", None), ("start", 0.0), ("end", FOREVER)):
            if getattr(collider, key) != usual:
                raise SolverError(
                    f"collider {collider.name!r}: FEM has no `{key}` of colliders; leave it out, or use MPM"
                )
    floor = () if model.ground is None else (Collider.floor(model.ground.height),)
    return tuple(ColliderContact(model, rest, collider) for collider in (*floor, *model.colliders))


def _scales(model: Model, rest: RestShapes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Contact stiffness N/m, friction spring stiffness N/m and ramp depth m of each vertex.

    The contact stiffness follows the vertex's own elastic stiffness (so that a stiff body indents what it
    meets no more than itself) and its body's weight (so that a soft one does not sink).
    """
    count = len(model.vertices)
    stiffness = CONTACT_PER_ELASTIC * rest.stiffness
    ramp = np.zeros(count)
    ranges = [body.vertex_range for body in model.bodies] or [(0, count)]
    for begin, end in ranges:
        size = float(np.linalg.norm(np.ptp(model.vertices[begin:end].astype(np.float64), axis=0)))
        weight = STANDARD_GRAVITY * float(rest.mass[begin:end].sum())
        stiffness[begin:end] += weight / (CONTACT_SAG * size)
        ramp[begin:end] = CONTACT_RAMP * size
    return model.fem.contact_stiffness * stiffness, STICK_PER_ELASTIC * rest.stiffness, ramp


__all__ = ["ColliderContact", "RigidBody", "collider_contacts"]
