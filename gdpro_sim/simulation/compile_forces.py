"""Pins, springs, attachments and loads of a scene -> the boundary conditions and loads of its `Model`."""

from __future__ import annotations

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from gdpro_sim.errors import SceneError
from gdpro_sim.meshing.embedding import boundary, embed_surface
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.tetmesh import TetMesh
from gdpro_sim.simulation.callbacks import Callback
from gdpro_sim.simulation.conditions import FOREVER, Force, Impulse, Load, Motion, Pressure, Springs, Wind
from gdpro_sim.simulation.copies import members
from gdpro_sim.simulation.forces import Attachment, Pin, Spring, SpringEnd
from gdpro_sim.simulation.model import Body, Model
from gdpro_sim.simulation.painting import painted_points
from gdpro_sim.simulation.placement import Placement
from gdpro_sim.simulation.regions import Region
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

END_OUTSIDE = 0.05
"""A spring's end may lie this much outside its body, as a fraction of the body's size."""

TIE_DISTANCE = 0.02
"""Attachments reach this far where nothing else is said, as a fraction of the first body's size."""

TIE_PER_ELASTIC = 10.0
"""Stiffness of a tie as a multiple of that with which a vertex's own elements hold it."""


def apply_conditions(scene: Scene, model: Model) -> Model:
    """`model`, placed and without any, with the pins, springs and loads of its scene.

    Raises SceneError for what selects nothing or contradicts itself.
    """
    placed = [Tets(scene, body, model) for body in model.bodies]
    by_name = {body.name: body for body in placed}
    pinned = np.zeros(len(model.vertices), bool)
    release = np.full(len(model.vertices), FOREVER)
    motions: list[Motion] = []
    loads: list[Load] = []
    for body, item in zip(scene.bodies, placed, strict=True):
        motions += _pins(body, item, pinned, release)
        if body.forces or body.impulses:
            loads += compile_pushes(body, item, _masses(item, model))
        loads += compile_pressures(body, item)
    loads += compile_winds(scene, by_name)
    springs = [compile_spring(scene, k, spring, by_name) for k, spring in enumerate(scene.springs)]
    for _, ties, a, b, ids in tied(scene, by_name):
        if ties.stiffness is None:
            # Imported here: it brings the solver's kernels, which most scenes need not wait for yet.
            from gdpro_sim.simulation.fem.rest import rest_shapes

            stiffness = TIE_PER_ELASTIC * rest_shapes(model).stiffness[a.first + ids]
        else:
            stiffness = np.full(len(ids), ties.stiffness / len(ids))
        springs.append(compile_ties(ties, a, b, ids, stiffness))
    return replace(
        model,
        pinned=pinned,
        release=release if np.isfinite(release).any() else None,
        motions=tuple(motions),
        springs=joined(springs) if springs else None,
        loads=tuple(loads),
    )


class Placed:
    """One body's points where they stand at the start: vertices, or particles.

    where:  how messages name it
    first:  number of its first point in the model
    points: [n, 3] float64 m
    kind:   "vertex", "particle", or "point" of a rigid body's surface
    placement: of its asset; None: its regions are where it stands, and none is painted
    """

    def __init__(
        self,
        scene: Scene,
        name: str,
        points: np.ndarray,
        first: int,
        kind: str = "vertex",
        placement: Placement | None = None,
    ) -> None:
        self.name, self.where = name, f"{scene.name}: bodies[{name}]"
        self.points, self.first, self.kind = points.astype(np.float64), first, kind
        self.placement = placement

    @property
    def size(self) -> float:
        return float(np.linalg.norm(np.ptp(self.points, axis=0)))

    def select(self, region: Region, key: str) -> np.ndarray:
        """Points in a region, counted from the body's first. Raises SceneError where there are none."""
        if region.vertices is not None and self.kind != "vertex":
            raise SceneError(
                f"{self.where}.{key}.vertices: counts vertices of tets, which a body of {self.kind}s has "
                "not; give a box, a sphere or a side"
            )
        if region.painted is not None or region.group is not None:
            return self._painted(region, key)
        points = self.points if self.placement is None else self.placement.as_written(self.points)
        try:
            ids = np.flatnonzero(region.select(points))
        except IndexError as error:
            raise SceneError(
                f"{self.where}.{key}.vertices: no vertex {error}; the body has {len(self.points)}, from 0"
            ) from None
        if not len(ids):
            raise SceneError(
                f"{self.where}.{key}: the {region.describe()} holds no {self.kind}; {self.span()}"
            )
        return ids

    def _painted(self, region: Region, key: str) -> np.ndarray:
        """Points under the painted part of the surface."""
        if self.placement is None:
            raise SceneError(f"{self.where}.{key}: this body has no surface to paint; give a box or a sphere")
        chosen = self.placement.painted(f"{self.where}.{key}", region)
        return painted_points(self.points, self.placement, chosen, region.depth)

    def motion(self, pin: Pin, held: np.ndarray, vertices: np.ndarray) -> Motion:
        """Of a pin that holds points `held` of the body, for `vertices` of the model."""
        motion = pin.compiled(self.points[held].mean(axis=0), vertices, start=pin.start)
        if pin.pivot is None or self.placement is None:
            return motion
        return replace(motion, pivot=self.placement.from_written(motion.pivot))

    def span(self) -> str:
        points = self.points if self.placement is None else self.placement.as_written(self.points)
        low, high = (np.round(corner, 3).tolist() for corner in (points.min(0), points.max(0)))
        return f"the body spans {low} to {high} m"


class Faced(Placed, ABC):
    """A body with a surface: faces [f, 3], outward, from its own first point."""

    faces: np.ndarray

    @abstractmethod
    def carried(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Corners [n, 4] int32 of the model and weights [n, 4] that carry points [n, 3] m along."""

    def place(self, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Where corners [4] of the model with weights [4] carry a point at the start, [3] m."""
        placed: np.ndarray = weights @ self.points[corners - self.first]
        return placed


class Tets(Faced):
    """A body of tets [t, 4], from its own first vertex."""

    def __init__(self, scene: Scene, body: Body, model: Model) -> None:
        first, end = body.vertex_range
        super().__init__(scene, body.name, model.vertices[first:end], first, placement=body.placement)
        self.tets = model.tets[slice(*body.tet_range)] - np.int32(first)
        self.faces, _ = boundary(self.tets)

    def carried(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Those of elements."""
        fill = np.ones(len(self.tets), np.float32)
        mesh = TetMesh(self.points.astype(np.float32), self.tets.astype(np.int32), fill, "tetwild")
        found = embed_surface(mesh, points)
        return (self.tets[found.tet_ids] + self.first).astype(np.int32), found.weights.astype(np.float64)


def chosen_pins(body: SceneBody, item: Placed) -> list[np.ndarray]:
    """What each pin of a body holds. Raises SceneError for nothing, and for pins at odds with each other."""
    chosen = [item.select(pin, f"pins[{k}]") for k, pin in enumerate(body.pins)]
    for (i, a), (j, b) in itertools.combinations(enumerate(body.pins), 2):
        apart = (a.release or FOREVER) <= b.start or (b.release or FOREVER) <= a.start
        if apart or _agree(a, chosen[i], b, chosen[j]):
            continue
        both = np.intersect1d(chosen[i], chosen[j])
        if len(both):
            raise SceneError(
                f"{item.where}: pins[{i}] and pins[{j}] both hold {item.kind} {both[0]} at "
                f"{np.round(item.points[both[0]], 3).tolist()} m, but differ in motion or release; let "
                "their regions not overlap, or give both the same"
            )
    return chosen


def _pins(body: SceneBody, item: Tets, pinned: np.ndarray, release: np.ndarray) -> Iterator[Motion]:
    """Marks pinned vertices and their release times; yields what moves."""
    owned = np.zeros(len(item.points), bool)
    for k, (pin, held) in enumerate(zip(body.pins, chosen_pins(body, item), strict=True)):
        if pin.start > 0.0:
            raise SceneError(f"{item.where}.pins[{k}].start: belongs to MPM (`solver: {{kind: mpm}}`)")
        ids = held[~owned[held]]
        owned[ids] = True
        pinned[item.first + ids] = True
        if pin.release is not None:
            release[item.first + ids] = pin.release
        if pin.motion and len(ids):
            yield item.motion(pin, held, item.first + ids)


def _agree(a: Pin, a_ids: np.ndarray, b: Pin, b_ids: np.ndarray) -> bool:
    if (a.motion, a.pivot, a.start, a.release) != (b.motion, b.pivot, b.start, b.release):
        return False
    turning = isinstance(a.motion, Callback) or any(any(key.rotation) for key in a.motion)
    turns = a.pivot is None and turning
    return not turns or np.array_equal(a_ids, b_ids)


def compile_pushes(body: SceneBody, item: Placed, mass: np.ndarray) -> Iterator[Load]:
    """Forces and impulses, shared as the points share the `mass` [n] kg."""
    for k, force in enumerate(body.forces):
        ids = item.select(force, f"forces[{k}]")
        each = np.outer(mass[ids] / mass[ids].sum(), force.force)
        end = FOREVER if force.end is None else force.end
        yield Force((item.first + ids).astype(np.int32), each, force.start, end)
    for k, push in enumerate(body.impulses):
        ids = item.select(push, f"impulses[{k}]")
        change = push.velocity
        if push.impulse is not None:
            change = tuple(part / mass[ids].sum() for part in push.impulse)
        each = np.outer(mass[ids], np.asarray(change))
        yield Impulse((item.first + ids).astype(np.int32), each, push.time)


def compile_pressures(body: SceneBody, item: Faced) -> Iterator[Load]:
    for k, load in enumerate(body.pressures):
        inside = np.zeros(len(item.points), bool)
        inside[item.select(load, f"pressures[{k}]")] = True
        faces = item.faces[inside[item.faces].all(axis=1)]
        if not len(faces):
            raise SceneError(
                f"{item.where}.pressures[{k}]: the {load.describe()} holds no whole triangle of the surface; "
                f"{item.span()}"
            )
        end = FOREVER if load.end is None else load.end
        closed = len(faces) == len(item.faces)
        yield Pressure(faces + item.first, load.pressure, closed, load.start, end)


def _masses(item: Tets, model: Model) -> np.ndarray:
    """[n] kg of the body's vertices, a quarter of each element's."""
    (ids,) = [body.tet_range for body in model.bodies if body.name == item.name]
    corners = item.points[item.tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    mass = volume * model.fill[slice(*ids)] * model.density[slice(*ids)]
    return np.bincount(item.tets.reshape(-1), weights=np.repeat(mass / 4.0, 4), minlength=len(item.points))


def compile_winds(scene: Scene, bodies: Mapping[str, Faced]) -> Iterator[Load]:
    """Air on the surfaces of bodies."""
    named = members(scene.bodies)
    for air in scene.wind:
        names = bodies if air.bodies is None else [name for given in air.bodies for name in named[given]]
        chosen = [bodies[name] for name in dict.fromkeys(names)]
        faces = np.concatenate([body.faces + body.first for body in chosen])
        end = FOREVER if air.end is None else air.end
        yield Wind(faces, air.velocity, air.density, air.drag, air.lift, air.start, end)


def compile_spring(scene: Scene, k: int, spring: Spring, bodies: Mapping[str, Faced]) -> Springs:
    """One spring, or one for each copy. Raises SceneError for an end away from its body.

    What is written for the first copy holds for all: the same point of each, and the world's moved along.
    """
    where, named = f"{scene.name}: springs[{k}]", members(scene.bodies)
    groups = [[None] if end.body is None else named[end.body] for end in spring.ends]
    count = max(len(group) for group in groups)
    if any(len(group) not in (1, count) for group in groups):
        names = " and ".join(repr(end.body) for end in spring.ends)
        raise SceneError(f"{where}: {names} are not equally many, so copies cannot be joined one to one")
    ends: list[list[_End]] = []
    for e, (end, group) in enumerate(zip(spring.ends, groups, strict=True)):
        first = _end(f"{where}.ends[{e}]", end, None if group[0] is None else bodies[group[0]])
        ends.append([first])
        for name in group[1:]:
            first_body, body = bodies[str(group[0])], bodies[str(name)]
            corners = first.corners + np.int32(body.first - first_body.first)
            ends[e].append(_End(corners, first.weights, np.zeros(3), body.place(corners, first.weights)))
    for one, other in (ends, ends[::-1]):
        for copy in other[len(one) :]:
            shift = copy.place - other[0].place if not one[0].weights.any() else np.zeros(3)
            one.append(replace(one[0], anchor=one[0].anchor + shift, place=one[0].place + shift))
    a, b = (np.array([end.place for end in one]) for one in ends)
    length = np.linalg.norm(a - b, axis=1) if spring.rest_length is None else spring.rest_length
    corners, weights, anchors = (
        np.stack([np.stack([getattr(end, part) for end in one]) for one in ends], axis=1)
        for part in ("corners", "weights", "anchor")
    )
    each = [np.full(count, value) for value in (spring.stiffness, length, spring.damping)]
    return Springs(corners, weights, anchors, *each)


@dataclass(frozen=True)
class _End:
    """Corners [4], weights [4], anchor [3] m, and where it is at the start [3] m."""

    corners: np.ndarray
    weights: np.ndarray
    anchor: np.ndarray
    place: np.ndarray


def _end(where: str, end: SpringEnd, body: Faced | None) -> _End:
    if body is None:
        point = np.asarray(end.point)
        return _End(np.zeros(4, np.int32), np.zeros(4), point, point)
    if end.vertex is not None:
        if end.vertex >= len(body.points):
            raise SceneError(
                f"{where}.vertex: no vertex {end.vertex}; {body.name!r} has {len(body.points)}, from 0"
            )
        corners, weights = np.full(4, body.first + end.vertex), np.array([1.0, 0.0, 0.0, 0.0])
        return _End(corners.astype(np.int32), weights, np.zeros(3), body.points[end.vertex])
    point = np.asarray(end.point)
    away = float(distance_outside(point[None], body.points, body.faces)[0])
    if away > END_OUTSIDE * body.size:
        raise SceneError(f"{where}.point: lies {away:.3g} m outside {body.name!r}; {body.span()}")
    corners, weights = body.carried(point[None])
    return _End(corners[0], weights[0], np.zeros(3), point)


Tied = tuple[int, Attachment, Faced, Faced, np.ndarray]


def tied(scene: Scene, bodies: Mapping[str, Faced]) -> Iterator[Tied]:
    """Attachments by number, the bodies each ties, and the tied points of the first body, from its first.

    They lie on its surface. One that names copies ties all pairs that are near enough. Raises SceneError for
    one that ties none.
    """
    named = members(scene.bodies)
    for k, ties in enumerate(scene.attachments):
        first, second = (named[name] for name in ties.bodies)
        pairs = [(bodies[a], bodies[b]) for a in first for b in second if a != b]
        found: list[Tied] = []
        for a, b in pairs:
            if len(pairs) > 1 and _gap(a, b) > _reach(ties, a):
                continue
            try:
                found.append((k, ties, a, b, _tied(scene, k, ties, a, b)))
            except SceneError:
                if len(pairs) == 1:
                    raise
        if not found:
            raise SceneError(
                f"{scene.name}: attachments[{k}]: no copies of {ties.bodies[0]!r} and {ties.bodies[1]!r} are "
                f"near enough to tie; move them together, or raise `distance`"
            )
        yield from found


def _reach(ties: Attachment, a: Faced) -> float:
    return TIE_DISTANCE * a.size if ties.distance is None else ties.distance


def _gap(a: Faced, b: Faced) -> float:
    """Between the boxes of two bodies, m."""
    apart = np.maximum(a.points.min(0) - b.points.max(0), b.points.min(0) - a.points.max(0))
    return float(np.linalg.norm(np.maximum(apart, 0.0)))


def _tied(scene: Scene, k: int, ties: Attachment, a: Faced, b: Faced) -> np.ndarray:
    where = f"{scene.name}: attachments[{k}]"
    ids = np.unique(a.faces)
    if ties.chosen:
        ids = np.intersect1d(ids, a.select(ties, f"attachments[{k}]"))
    away = distance_outside(a.points[ids], b.points, b.faces)
    reach = _reach(ties, a)
    if not (away <= reach).any():
        nearest = f"; the nearest is {away.min():.3g} m away" if len(ids) else ""
        raise SceneError(
            f"{where}: no chosen vertex on the surface of {a.name!r} lies within {reach:.3g} m of {b.name!r}"
            f"{nearest}; move the bodies together, or raise `distance`"
        )
    return ids[away <= reach]


def compile_ties(ties: Attachment, a: Faced, b: Faced, ids: np.ndarray, stiffness: np.ndarray) -> Springs:
    """Springs without length of `stiffness` [n] N/m from points of `a` to where `b` carries them."""
    count = len(ids)
    corners, weights = np.zeros((count, 2, 4), np.int32), np.zeros((count, 2, 4))
    corners[:, 0] = (a.first + ids)[:, None]
    weights[:, 0, 0] = 1.0
    corners[:, 1], weights[:, 1] = b.carried(a.points[ids])
    return Springs(
        corners,
        weights,
        np.zeros((count, 2, 3)),
        stiffness,
        np.zeros(count),
        np.full(count, ties.damping / count),
    )


def joined(parts: list[Springs]) -> Springs:
    """Several as one, in their order."""
    return Springs(
        *(
            np.concatenate([getattr(part, key) for part in parts])
            for key in ("corners", "weights", "anchors", "stiffness", "rest_length", "damping")
        )
    )


def distance_outside(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """How far each of `points` [n, 3] lies outside a closed surface, float64 [n] m; zero inside."""
    index = SurfaceIndex(vertices, faces, winding=True)
    face, weights = index.closest(points)
    nearest = np.einsum("pc,pci->pi", weights.astype(np.float64), vertices[faces[face]])
    return np.where(index.inside(points), 0.0, np.linalg.norm(points - nearest, axis=1))


__all__ = [
    "Faced",
    "Placed",
    "apply_conditions",
    "chosen_pins",
    "compile_pressures",
    "compile_pushes",
    "compile_spring",
    "compile_ties",
    "compile_winds",
    "distance_outside",
    "joined",
    "tied",
]
