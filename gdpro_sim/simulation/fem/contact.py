"""Contact between bodies, and of a body with itself, as a term of the incremental potential.

A log barrier keeps every two surface elements apart (Li et al. 2020, "Incremental Potential Contact", in the
area-weighted form of Li et al. 2023, "Convergent Incremental Potential Contact"), continuous collision
detection bounds every step, and Coulomb friction (`contact_friction`) is lagged. Elements, distances and
detection are those of the IPC Toolkit (https://ipctk.xyz), which runs on the host: on the CPU it reads the
solver's own memory, on CUDA positions are copied over and back. It runs on one thread, because its sums over
several are in no fixed order.

Surfaces never touch: they keep a gap below `FemSettings.contact_gap` times the smallest body's size, about
half of it under the body's weight. Two bodies' friction coefficients combine by their geometric mean. The
barrier is too stiff near contact for explicit steps, which end in a SolverError in any but a slow touch.
"""

from __future__ import annotations

import logging
import math
from typing import Any

import ipctk
import numpy as np
import scipy.sparse as sparse
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem import contact_friction as friction
from gdpro_sim.simulation.fem.contact_surface import Piece, Surface, clearance, strayed
from gdpro_sim.simulation.fem.rest import RestShapes
from gdpro_sim.simulation.fem.term import Step, hosted
from gdpro_sim.simulation.model import Model

logger = logging.getLogger(__name__)

STANDARD_GRAVITY = 9.81

HALF_GAP_PRESSURE = 6.5
"""Pressure of the barrier at half the gap, as a multiple of its stiffness: -1.5 b'(1/2), b(s) below."""

BARRIER_PER_ELASTIC = 0.1
"""Barrier stiffness, as a multiple of elastic stiffness times gap over a vertex's area: about half the gap
closes the barrier is then three times as stiff as the elements behind it."""

STIFFEST_BARRIER = 1e4
"""The barrier's stiffness grows to at most this multiple of where it starts."""

NARROW = 0.02
"""Below this share of the gap a distance that still shrinks doubles the barrier's stiffness."""

STICK_PER_ELASTIC = 1.0
"""Friction spring stiffness of a vertex as a multiple of its own elastic stiffness; see `ground`."""

LEAST_GAP = 1e-3
"""Bodies that start nearer than this share of the gap count as touching."""

SELF_GAP = 0.25
"""A body whose own surface comes nearer to itself at rest than this share of the gap takes no part in
self-contact."""


class BodyContact:
    """All bodies' surfaces against each other. Implements `gdpro_sim.simulation.fem.term.Term`.

    Vertices that are fixed push others and never move. Raises SolverError where two bodies overlap or touch
    at the start.
    """

    energies = 1

    def __init__(self, model: Model, rest: RestShapes) -> None:
        ipctk.set_num_threads(1)
        self.device = model.device
        self.surface = Surface(model)
        surface, settings = self.surface, model.fem
        self._vertex_count = len(model.vertices)
        self._size = min(piece.size for piece in surface.pieces)
        self._mesh = surface.mesh()
        self._cross = ipctk.make_vertex_patches_filter(surface.owner)
        gap = settings.contact_gap * self._size
        self.gap = self._initial_gap(gap)
        self._own = self._self_pieces(gap) if settings.self_contact else []
        labels = surface.owner.copy()
        for piece, _ in self._own:  # every vertex a patch of its own
            begin, end = piece.vertices
            labels[begin:end] = len(surface.pieces) + np.arange(begin, end)
        self._everything = ipctk.make_vertex_patches_filter(labels)
        self._friction = model.friction[surface.ids].astype(np.float64)
        areas = np.array([self._vertex_area(piece) for piece in surface.pieces])
        self._stick = STICK_PER_ELASTIC * rest.stiffness[surface.ids] / areas[surface.owner]
        self._base_stiffness = settings.contact_stiffness * self._scale(rest)
        self.frequency = self._frequency(rest)
        # On the host whatever the device: they are used there.
        self._stiffness = wp.full(1, self._base_stiffness, dtype=wp.float64, device="cpu")
        self._reference: wp.array = wp.array(surface.rest, dtype=wp.vec3d, device="cpu")
        self._clearance: wp.array = wp.array(self._rest_clearances(), dtype=wp.float64, device="cpu")
        self._ccd = ipctk.AdditiveCCD()
        self._barrier = ipctk.BarrierPotential(self.gap, self._base_stiffness, True)
        self._share = wp.zeros(len(surface.ids), dtype=wp.vec3d, device="cpu")
        self._stencils: friction.Stencils | None = None
        self._start = surface.rest
        self._before = math.inf
        self._forget()

    @property
    def needed(self) -> bool:
        """Whether there are two bodies, or one that can touch itself."""
        return len(self.surface.pieces) > 1 or bool(self._own)

    # -- Term

    def begin(self, step: Step) -> None:
        """Nothing found in an earlier solve counts, so that a restart continues to the same bytes."""
        self._forget()
        self._start = self.surface.positions(hosted(step.x))
        self._certify(self._start)
        self._before = math.inf
        if self._collisions(self._start).empty():
            self._stiffen(self._base_stiffness)
        else:
            self._stiffen(float(self._stiffness.numpy()[0]))

    def lag(self, x: wp.array) -> None:
        """Take friction's limits and directions from x; stiffen the barrier where a gap is closing."""
        positions = self.surface.positions(hosted(x))
        collisions = self._collisions(positions)
        if not collisions.empty():
            least = math.sqrt(collisions.compute_minimum_distance(self._mesh, positions))
            if least < min(NARROW * self.gap, self._before):
                highest = STIFFEST_BARRIER * self._base_stiffness
                self._stiffen(min(2.0 * float(self._stiffness.numpy()[0]), highest))
            self._before = least
        self._stencils = self._gather(positions)

    def _gather(self, positions: np.ndarray) -> friction.Stencils | None:
        """Friction of the contacts at `positions`."""
        collisions, mu = self._collisions(positions), self._friction
        if collisions.empty() or not mu.any():
            return None
        tangential = ipctk.TangentialCollisions()
        tangential.build(self._mesh, positions, collisions, self._barrier, mu, mu, geometric_mean)
        if tangential.empty():
            return None
        edges, faces = self.surface.edges, self.surface.faces
        return friction.gather(tangential, positions, edges, faces, self._stick, self._share.numpy())

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        positions = self.surface.positions(hosted(x))
        collisions = self._collisions(positions)
        total = 0.0 if collisions.empty() else self._barrier(collisions, self._mesh, positions)
        if self._stencils is not None:
            total += friction.energy(self._stencils, positions - self._start)
        energies[first : first + 1].fill_(total)

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        positions = self.surface.positions(hosted(x))
        collisions = self._collisions(positions)
        slope = np.zeros((len(positions), 3))
        curvature = None
        if not collisions.empty():
            clamp = ipctk.PSDProjectionMethod.CLAMP
            slope += self._barrier.gradient(collisions, self._mesh, positions).reshape(-1, 3)
            columns = self._barrier.hessian(collisions, self._mesh, positions, clamp)
            # Symmetric: compressed columns are compressed rows.
            parts = (columns.data, columns.indices, columns.indptr)
            curvature = sparse.csr_matrix(parts, columns.shape).tobsr((3, 3))
        if self._stencils is not None:
            moved = positions - self._start
            slope += friction.gradient(self._stencils, moved)
            sliding = friction.hessian(self._stencils, moved)
            curvature = sliding if curvature is None else curvature + sliding
        if curvature is None:
            return None
        diagonal, off = self._split(curvature)
        for array, part in ((gradient, slope), (block, diagonal)):
            values = hosted(array)
            values[self.surface.ids] += part
            if self.device != "cpu":
                array.assign(values)
        return off

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        """Share of `direction` that no two surfaces pass through each other on."""
        begin = self.surface.positions(hosted(x))
        end = begin + self.surface.positions(hosted(direction))
        if not np.isfinite(end).all():
            return 0.0
        candidates = self._cover(begin, end)
        if candidates is None or candidates.empty():
            return 1.0
        return float(candidates.compute_collision_free_stepsize(self._mesh, begin, end, 0.0, self._ccd))

    def finish(self, x: wp.array) -> None:
        """Keep what the friction springs hold."""
        positions = self.surface.positions(hosted(x))
        stencils = self._gather(positions)
        share = self._share.numpy()
        share[:] = 0.0 if stencils is None else friction.shares(stencils, positions - self._start)

    def stored(self, x: wp.array) -> float:
        positions = self.surface.positions(hosted(x))
        collisions = self._collisions(positions)
        total = 0.0 if collisions.empty() else float(self._barrier(collisions, self._mesh, positions))
        stencils = self._gather(positions)
        return total if stencils is None else total + friction.energy(stencils, np.zeros_like(positions))

    def state(self) -> dict[str, wp.array]:
        return {
            "friction": self._share,
            "stiffness": self._stiffness,
            "reference": self._reference,
            "clearance": self._clearance,
        }

    def report(self, x: wp.array) -> dict[str, float]:
        return {"contacts": float(len(self._collisions(self.surface.positions(hosted(x)))))}

    # -- What is near what

    def _forget(self) -> None:
        self._path: tuple[np.ndarray, np.ndarray] | None = None
        self._candidates: ipctk.Candidates | None = None
        self._at: np.ndarray | None = None
        self._active = ipctk.NormalCollisions()

    def _collisions(self, positions: np.ndarray) -> ipctk.NormalCollisions:
        """Pairs of elements nearer than the gap."""
        if self._at is not None and np.array_equal(self._at, positions):
            return self._active
        candidates = self._candidates if self._covers(positions) else self._cover(positions, positions)
        self._active = ipctk.NormalCollisions()
        self._active.use_area_weighting = True
        if candidates is not None:
            self._active.build(candidates, self._mesh, positions, self.gap)
        self._at = positions
        return self._active

    def _covers(self, positions: np.ndarray) -> bool:
        """Whether the candidates were gathered over a way that leads through `positions`."""
        if self._path is None:
            return False
        begin, end = self._path
        way, off = end - begin, positions - begin
        length = float((way * way).sum())
        share = float((way * off).sum()) / length if length > 0.0 else 0.0
        return -1e-9 <= share <= 1.0 + 1e-9 and bool(np.abs(off - share * way).max() <= 1e-3 * self.gap)

    def _cover(self, begin: np.ndarray, end: np.ndarray) -> ipctk.Candidates | None:
        """Candidates of all collisions on the straight way between; None where there can be none."""
        apart = self._apart_from_itself(begin, end)
        self._path, self._candidates = (begin, end), None
        if apart and not self.surface.near(begin, end, margin=1.1 * self.gap):
            return None
        self._mesh.can_collide = self._cross if apart else self._everything
        self._candidates = ipctk.Candidates()
        self._candidates.build(self._mesh, begin, end, 0.55 * self.gap)
        return self._candidates

    def _apart_from_itself(self, *positions: np.ndarray) -> bool:
        """Whether no body can touch itself on the way between two positions: it hardly changed shape since
        its `clearance` was taken."""
        reference, clearances = self._reference.numpy(), self._clearance.numpy()
        for k, (piece, _) in enumerate(self._own):
            part = slice(*piece.vertices)
            free = clearances[k] - 1.1 * self.gap
            if free <= 0.0 or 2.0 * strayed(reference[part], *(x[part] for x in positions)) >= free:
                return False
        return True

    def _certify(self, positions: np.ndarray) -> None:
        """Take anew the clearances of the bodies that changed shape by half of what they allow."""
        reference, clearances = self._reference.numpy(), self._clearance.numpy()
        for k, (piece, mesh) in enumerate(self._own):
            part = slice(*piece.vertices)
            if 4.0 * strayed(reference[part], positions[part]) >= clearances[k] - 1.1 * self.gap:
                reference[part] = positions[part]
                clearances[k] = clearance(mesh, np.asfortranarray(positions[part]), piece.edge)

    # -- Set-up

    def _initial_gap(self, gap: float) -> float:
        """The gap, or a little less than the bodies' distance at the start, so that nothing is pushed."""
        self.surface.check_apart()
        self._mesh.can_collide = self._cross
        distance = clearance(self._mesh, self.surface.rest, gap)
        if distance < LEAST_GAP * gap:
            raise SolverError(f"{self._nearest(gap)} touch at the start; move them {gap:.2g} m apart")
        return min(gap, 0.9 * distance) if distance < gap else gap

    def _nearest(self, gap: float) -> str:
        """Names of the two bodies that touch."""
        names, count = [piece.name for piece in self.surface.pieces], len(self.surface.pieces)
        for i, j in self.surface.near(self.surface.rest, margin=gap):
            labels = np.where(self.surface.owner == j, np.int32(1), np.int32(0))
            outside = (self.surface.owner != i) & (self.surface.owner != j)
            labels[outside] = 0
            self._mesh.can_collide = ipctk.make_vertex_patches_filter(labels)
            if clearance(self._mesh, self.surface.rest, gap) < LEAST_GAP * gap:
                return f"bodies {names[i]!r} and {names[j]!r}"
        return f"two of the {count} bodies"

    def _self_pieces(self, gap: float) -> list[tuple[Piece, ipctk.CollisionMesh]]:
        found = []
        for piece in self.surface.pieces:
            mesh = self.surface.piece_mesh(piece)
            at_rest = mesh.rest_positions
            if clearance(mesh, at_rest, gap) < SELF_GAP * gap or ipctk.has_intersections(mesh, at_rest):
                logger.info("%s: its surface touches itself at rest; it may pass through itself", piece.name)
            else:
                found.append((piece, mesh))
        for _, mesh in found:
            self.gap = min(self.gap, 0.9 * clearance(mesh, mesh.rest_positions, 2.0 * gap))
        return found

    def _rest_clearances(self) -> np.ndarray:
        return np.array([clearance(mesh, mesh.rest_positions, piece.edge) for piece, mesh in self._own])

    def _scale(self, rest: RestShapes) -> float:
        """Barrier stiffness, Pa: half the gap carries the heaviest body on one vertex's area, and is a few
        times as stiff as the stiffest body's elements."""
        weights = STANDARD_GRAVITY * np.bincount(self.surface.body, weights=rest.mass)
        stiffness = 0.0
        for piece, weight in zip(self.surface.pieces, weights, strict=True):
            area = self._vertex_area(piece)
            begin, end = piece.vertices
            elastic = float(np.median(rest.stiffness[self.surface.ids[begin:end]]))
            carrying = float(weight) / (HALF_GAP_PRESSURE * area)
            stiffness = max(stiffness, carrying, BARRIER_PER_ELASTIC * elastic * self.gap / area)
        return stiffness

    def _frequency(self, rest: RestShapes) -> float:
        """With the gap closed to a tenth: the barrier's second derivative there is about 300."""
        largest = 0.0
        for piece in self.surface.pieces:
            begin, end = piece.vertices
            mass = rest.mass[self.surface.ids[begin:end]]
            stiffness = 300.0 * self._base_stiffness * self._vertex_area(piece) / self.gap
            largest = max(largest, stiffness / float(mass[mass > 0.0].min(initial=math.inf)))
        return math.sqrt(largest)

    def _vertex_area(self, piece: Piece) -> float:
        """Mean surface area of a vertex, m^2."""
        begin, end = piece.vertices
        a, b, c = self.surface.rest[begin:end][piece.faces].swapaxes(0, 1)
        return 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()) / (end - begin)

    # -- Matrices

    def _stiffen(self, stiffness: float) -> None:
        self._stiffness.fill_(stiffness)
        self._barrier = ipctk.BarrierPotential(self.gap, stiffness, True)

    def _split(self, curvature: Any) -> tuple[np.ndarray, Any]:
        """Diagonal blocks [S, 3, 3] of a matrix over the surface, and the rest over all vertices."""
        count = len(self.surface.ids)
        blocks = curvature.tobsr((3, 3))
        blocks.sort_indices()
        row = np.repeat(np.arange(count), np.diff(blocks.indptr))
        on = blocks.indices == row
        diagonal = np.zeros((count, 3, 3))
        diagonal[row[on]] = blocks.data[on]
        per_row = np.zeros(self._vertex_count + 1, np.int64)
        per_row[self.surface.ids + 1] = np.bincount(row[~on], minlength=count)
        order = np.argsort(self.surface.ids[row[~on]], kind="stable")
        columns = self.surface.ids[blocks.indices[~on]][order]
        parts = (blocks.data[~on][order], columns, np.cumsum(per_row))
        size = 3 * self._vertex_count
        off = sparse.bsr_matrix(parts, shape=(size, size))
        off.sort_indices()
        return diagonal, off


def body_contact(model: Model, rest: RestShapes) -> tuple[BodyContact, ...]:
    """The contact term of a model; empty where nothing is there to touch."""
    if not model.fem.body_contact or not len(model.tets):
        return ()
    contact = BodyContact(model, rest)
    return (contact,) if contact.needed else ()


def geometric_mean(a: float, b: float) -> float:
    return math.sqrt(a * b)


__all__ = ["BodyContact", "body_contact"]
