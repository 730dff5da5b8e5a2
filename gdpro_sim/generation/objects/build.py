"""A parametric object: distances, colours and surfaces, in metres."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.generation.objects import words as w
from gdpro_sim.generation.objects.isosurface import CHUNK, evaluate, isosurface
from gdpro_sim.generation.objects.parts import NOUNS, Paint, Part, Role
from gdpro_sim.generation.objects.patterns import WEIGHTS, Dots, spread
from gdpro_sim.generation.objects.sdf import Field, smooth_min
from gdpro_sim.generation.objects.spec import ObjectSpec, Style
from gdpro_sim.meshing.repair import face_components, signed_volume
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh

PROBE = 60
"""Cells of the surface that an object's extent is measured on."""


def color_value(words: str) -> w.Color:
    """RGB of a colour word with or without a shade: "dark blue"."""
    *shade, name = words.split(" ")
    return w.shaded(w.COLORS[name], w.SHADES[shade[0]] if shade else 0.0)


SMOOTHING = 6
"""Steps of smoothing of the coarse surface."""


@dataclass(frozen=True)
class Look:
    """How one part is coloured: a base, and a second colour where `pattern` says so."""

    base: w.Color
    second: w.Color
    pattern: str | None = None
    palette: tuple[w.Color, ...] | None = None


def look(part: Part, style: Style, explicit: Style | None, two_colored: bool) -> Look:
    """The look of a part.

    style: of the whole object; explicit: of this part, which wins; two_colored: the object has accents, which
    take the second colour.
    """
    if explicit is None:
        explicit = _inherited(part.role, style, two_colored)
    word = w.MATERIALS[explicit.material] if explicit.material else None
    base, second = part.color, part.second
    if explicit.colors:
        base, second = color_value(explicit.colors[0]), None
    elif word is not None and word.color is not None:
        base = w.shaded(word.color, -0.12) if part.role == "accent" else word.color
        second = word.second
    if len(explicit.colors) > 1:
        second = color_value(explicit.colors[1])
    pattern, palette = part.pattern, part.palette
    if explicit.pattern is not None:
        pattern, palette = explicit.pattern, None
        if len(explicit.colors) < 2:
            second = w.contrasting(base)
    elif len(explicit.colors) > 1:
        pattern = "striped"
    elif word is not None and (word.color is not None or word.texture is not None):
        pattern, palette = word.texture, None
    if second is None:
        second = w.shaded(base, -0.25 if w.luminance(base) > 0.2 else 0.2)
    return Look(base, second, pattern, palette)


def _inherited(role: Role, style: Style, two_colored: bool) -> Style:
    """What a part of `role` takes from the object's style."""
    if role == "main":
        takes_both = style.pattern is not None or not two_colored
        return replace(style, colors=style.colors if takes_both else style.colors[:1])
    if role in ("accent", "trim"):
        second = style.colors[1:] if style.pattern is None else ()
        return Style(second, style.material if role == "accent" else None, None)
    return Style()


@dataclass(frozen=True)
class ParametricObject:
    """An object in metres, base at z = 0, front +X.

    parts:   in the noun's own unit; metres = (point - offset) * scale
    looks:   one for each part
    extents: [3] m, of the box around it
    """

    spec: ObjectSpec
    seed: int
    parts: tuple[Part, ...]
    looks: tuple[Look, ...]
    paints: tuple[tuple[Paint, ...], ...]
    material: str
    scale: float
    offset: np.ndarray
    extents: np.ndarray
    probe: np.ndarray

    @property
    def size(self) -> tuple[float, float, float]:
        """Extents along X, Y and Z in metres."""
        return float(self.extents[0]), float(self.extents[1]), float(self.extents[2])

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        return {
            **self.spec.describe(),
            "kind": "parametric object of the built-in library",
            "seed": self.seed,
            "size_m": list(self.size),
            "physical_material": self.material,
            "part_names": list(dict.fromkeys(part.name for part in self.parts)),
        }

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Signed distance in metres (about; exact near plain surfaces), negative inside, at points [N, 3]."""
        return evaluate(self._field, self._own(points)) * np.float32(self.scale)

    def color_at(self, points: np.ndarray, *, detail: bool = True) -> np.ndarray:
        """sRGB-encoded colours [N, 3] float32 in [0, 1] of the surface near points [N, 3] in metres.

        A point takes the colour of the part it is nearest to; detail: with patterns and painted regions.
        """
        own = self._own(points)
        out = np.empty((len(points), 3), np.float32)
        for start in range(0, len(points), CHUNK):
            rows = slice(start, start + CHUNK)
            out[rows] = self._colors(np.ascontiguousarray(own[:, rows]), detail)
        return out

    def part_at(self, points: np.ndarray) -> np.ndarray:
        """Index into `parts` of the nearest one at points [N, 3] in metres; [N]."""
        return _nearest(self.parts, self._own(points))

    def surface(self, resolution: int, *, detail: bool = True) -> SurfaceMesh:
        """Closed coloured surface of one piece in metres, `resolution` cells across its longest side.

        detail=False is the deliberately coarse one: it knows of each node of the grid only whether it lies
        inside, and each part's plain base colour. Parts too thin for the cells are thickened a little.
        Raises `MeshError` for fewer than 8 cells.
        """
        if resolution < 8:
            raise MeshError(f"resolution must be at least 8 cells, got {resolution}")
        vertices, faces = self._closed(resolution, occupancy=not detail)
        vertices = (vertices.astype(np.float64) - self.offset) * self.scale
        vertices = vertices.astype(np.float32)
        colors = np.full((len(vertices), 4), 255, np.uint8)
        colors[:, :3] = np.round(255.0 * np.clip(self.color_at(vertices, detail=detail), 0.0, 1.0))
        return SurfaceMesh(
            vertices,
            faces,
            None,
            np.ascontiguousarray(colors[faces]),
            np.zeros(len(faces), np.int32),
            (MeshMaterial(self.spec.noun, (1.0, 1.0, 1.0, 1.0)),),
        )

    # In the noun's own unit

    def _own(self, points: np.ndarray) -> np.ndarray:
        own = np.asarray(points, np.float64) / self.scale + self.offset
        return np.ascontiguousarray(own.T, np.float32)

    def _field(self, p: np.ndarray) -> np.ndarray:
        return _combined(self.parts, p)

    def _grown(self, by: float) -> Field:
        """The field thickened by `by`, but not below the base."""
        base = np.float32(self.offset[2])
        return lambda p: np.maximum(self._field(p) - np.float32(by), base - p[2]) if by else self._field(p)

    @cached_property
    def _box(self) -> tuple[np.ndarray, np.ndarray]:
        """A box around the object, in its own unit."""
        low, high = self.probe.min(0).astype(np.float64), self.probe.max(0).astype(np.float64)
        slack = 0.5 * float((high - low).max()) / PROBE
        return low - slack, high + slack

    def _closed(self, resolution: int, *, occupancy: bool) -> tuple[np.ndarray, np.ndarray]:
        """The largest piece, thickened where cells are too coarse for it to be one piece.

        occupancy: of inside and outside alone, which gives steps, with the steps smoothed
        """
        low, high = self._box
        step = float((high - low).max()) / resolution
        best = None
        for grow in (0.0, 0.2, 0.4, 0.6):
            field = self._grown(grow * step)
            if occupancy:
                field = _sides(field, step)
            vertices, faces = isosurface(field, low, high, resolution)
            vertices, faces, whole = largest_piece(vertices, faces)
            if occupancy:
                vertices = _smoothed(vertices, faces)
            if best is None:
                best = vertices, faces
            if whole and self._holds(vertices, faces, step):
                return vertices, faces
            if signed_volume(vertices, faces) > signed_volume(*best):
                best = vertices, faces
        assert best is not None
        return best

    def _holds(self, vertices: np.ndarray, faces: np.ndarray, step: float) -> bool:
        """The surface is near the points of the probe (a third of them): nothing thin was lost."""
        from scipy.spatial import cKDTree

        if not len(faces):
            return False
        distance, _ = cKDTree(vertices).query(self.probe[::3], distance_upper_bound=2.0 * step)
        return bool(np.isfinite(distance).mean() > 0.995)

    @cached_property
    def _dots(self) -> Mapping[int, Dots]:
        """Centres of the dotted parts' dots: spread over the surface by the object's seed."""
        out = {}
        nearest = _nearest(self.parts, np.ascontiguousarray(self.probe.T, np.float32))
        generator = np.random.default_rng([self.seed, 20])
        for i, (part, style) in enumerate(zip(self.parts, self.looks, strict=True)):
            if style.pattern == "dotted":
                there = self._normal(np.ascontiguousarray(self.probe[nearest == i].T)).T
                spacing, radius = part.dots
                out[i] = Dots(spread(there, spacing, generator), radius)
        return out

    def _normal(self, p: np.ndarray) -> np.ndarray:
        """The normalised frame of `patterns`."""
        low, high = self.probe.min(0), self.probe.max(0)
        middle = np.asarray([[0.0], [0.0], [0.5 * float(low[2] + high[2])]], np.float32)
        return (p - middle) / np.float32((high - low).max())

    def _colors(self, p: np.ndarray, detail: bool) -> np.ndarray:
        nearest = _nearest(self.parts, p)
        out = np.empty((p.shape[1], 3), np.float32)
        for i in np.unique(nearest):
            rows = np.flatnonzero(nearest == i)
            style = self.looks[i]
            out[rows] = np.asarray(style.base, np.float32)
            if not detail:
                continue
            there = np.ascontiguousarray(p[:, rows])
            if style.pattern is not None:
                out[rows] = self._patterned(int(i), there)
            for paint in self.paints[i]:
                out[rows[paint.shape.distance(there) < 0]] = np.asarray(paint.color, np.float32)
        return out

    def _normals(self, field: Field, p: np.ndarray) -> np.ndarray:
        """Unit gradients [3, N] of `field` at p, by central differences over a hundredth of the object."""
        step = np.float32(0.01 * (self.probe.max(0) - self.probe.min(0)).max())
        out = np.empty_like(p)
        for axis in range(3):
            shift = np.zeros((3, 1), np.float32)
            shift[axis] = step
            out[axis] = field(p + shift) - field(p - shift)
        return out / np.maximum(np.sqrt((out * out).sum(0)), np.float32(1e-12))

    def _patterned(self, index: int, p: np.ndarray) -> np.ndarray:
        style, q = self.looks[index], self._normal(p)
        assert style.pattern is not None
        base, second = np.asarray(style.base, np.float32), np.asarray(style.second, np.float32)
        if style.pattern == "dotted":
            dots = self._dots[index]
            weight = dots(q)[:, None]
            if style.palette is not None:
                second = np.asarray(style.palette, np.float32)[dots.which(q) % len(style.palette)]
        else:
            normals = self._normals(self.parts[index].shape.distance, p)
            weight = WEIGHTS[style.pattern](q, normals, self.seed)[:, None]
        return base + (second - base) * weight.astype(np.float32)


def _sides(field: Field, step: float) -> Field:
    """A field that only says on which side of the surface a point lies."""

    def sides(p: np.ndarray) -> np.ndarray:
        return np.where(field(p) <= 0.0, -0.5 * step, 0.5 * step).astype(np.float32)

    return sides


def _smoothed(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Vertices after a few steps of Taubin's smoothing, which does not shrink (SIGGRAPH 1995)."""
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return np.asarray(trimesh.smoothing.filter_taubin(mesh, iterations=SMOOTHING).vertices, np.float32)


def _combined(parts: tuple[Part, ...], p: np.ndarray) -> np.ndarray:
    """The union of all parts; a part is asked only where its box is nearer than what there is already."""
    out = parts[0].shape.distance(p)
    for part in parts[1:]:
        near = np.flatnonzero(part.shape.box_distance(p) <= out + np.float32(part.blend) + np.float32(1e-6))
        if len(near):
            d = part.shape.distance(np.ascontiguousarray(p[:, near]))
            before = out[near]
            out[near] = smooth_min(before, d, part.blend) if part.blend > 0.0 else np.minimum(before, d)
    return out


def _nearest(parts: tuple[Part, ...], p: np.ndarray) -> np.ndarray:
    """Index of the part with the smallest distance, the first of equals; [N]."""
    out = np.zeros(p.shape[1], np.int64)
    for start in range(0, p.shape[1], CHUNK):
        some = np.ascontiguousarray(p[:, start : start + CHUNK])
        index, least = out[start : start + CHUNK], parts[0].shape.distance(some)
        for i, part in enumerate(parts[1:], 1):
            near = np.flatnonzero(part.shape.box_distance(some) < least)
            if len(near):
                d = part.shape.distance(np.ascontiguousarray(some[:, near]))
                closer = d < least[near]
                index[near[closer]] = i
                least[near[closer]] = d[closer]
    return out


CRUMB = 1e-3
"""Pieces smaller than this share of the largest one are dropped without a second try."""


def largest_piece(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
    """The connected piece of largest volume, and whether nothing but hollows and crumbs went with the others.

    A hollow inside has negative volume; without its surface it is filled.
    """
    if not len(faces):
        return vertices, faces, False
    label = face_components(faces)
    if not label.any():
        return vertices, faces, True
    volumes = np.asarray([signed_volume(vertices, faces[label == i]) for i in range(int(label.max()) + 1)])
    largest = int(volumes.argmax())
    kept = faces[label == largest]
    used, compact = np.unique(kept, return_inverse=True)
    others = np.delete(volumes, largest)
    whole = bool((others < CRUMB * volumes[largest]).all())
    return vertices[used], compact.reshape(-1, 3).astype(np.int32), whole


def build(spec: ObjectSpec, seed: int) -> ParametricObject:
    """The object of `spec`; `seed` varies its proportions mildly, the same seed gives the same object."""
    noun = NOUNS[spec.noun]
    parts = tuple(noun.parts(seed))
    low = np.min([part.shape.low for part in parts], axis=0)
    high = np.max([part.shape.high for part in parts], axis=0)
    probe, faces = isosurface(lambda p: _combined(parts, p), low, high, PROBE)
    probe, faces, _ = largest_piece(probe, faces)
    extent = np.ptp(probe.astype(np.float64), axis=0)
    across = noun.across * (w.SIZES[spec.size] if spec.size else 1.0)
    scale = across / float(extent.max())
    two_colored = any(part.role in ("accent", "trim") for part in parts) or any(
        paint.role in ("accent", "trim") for part in parts for paint in part.paints
    )
    looks = tuple(look(part, spec.style, spec.parts.get(part.name), two_colored) for part in parts)
    paints = tuple(tuple(_painted(paint, spec) for paint in part.paints) for part in parts)
    material = w.MATERIALS[spec.style.material].preset if spec.style.material else noun.material
    return ParametricObject(
        spec=spec,
        seed=seed,
        parts=parts,
        looks=looks,
        paints=paints,
        material=material,
        scale=scale,
        offset=np.asarray([0.0, 0.0, float(probe[:, 2].min())]),
        extents=extent * scale,
        probe=probe,
    )


def _painted(paint: Paint, spec: ObjectSpec) -> Paint:
    """The paint in the colour that the prompt gives it."""
    style = spec.parts.get(paint.name) or _inherited(paint.role, spec.style, True)
    if style.colors:
        return replace(paint, color=color_value(style.colors[0]))
    if style.material and (known := w.MATERIALS[style.material].color):
        return replace(paint, color=known)
    return paint


__all__ = ["Look", "ParametricObject", "build", "color_value", "largest_piece", "look"]
