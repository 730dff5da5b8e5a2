"""Signed-distance shapes: primitives and the operations that compose them.

A `Shape` maps points [3, N] float32 (one row per axis, so that each row is contiguous) to distances [N],
negative inside. Formulas for exact and bounding distances follow Quilez, "Distance functions" (2D and 3D),
and the polynomial smooth minimum of the same author. Boxes, cylinders, cones and extrusions stand on z = 0
around the vertical axis; spheres, ellipsoids and tori are centred at the origin. Angles are in degrees.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

Field = Callable[[np.ndarray], np.ndarray]
Vec = tuple[float, float, float]
Point2 = tuple[float, float]

_F = np.float32


@dataclass(frozen=True)
class Shape:
    """A solid. distance: points [3, N] to signed distances [N]; low, high: a box that holds it."""

    distance: Field
    low: Vec
    high: Vec

    def box_distance(self, p: np.ndarray) -> np.ndarray:
        """Distance [N] to the box around the shape, 0 inside it: never more than to the shape itself."""
        out = np.zeros(p.shape[1], _F)
        for row, low, high in zip(p, self.low, self.high, strict=True):
            outside = np.maximum(np.maximum(_F(low) - row, row - _F(high)), _F(0))
            out += outside * outside
        return np.sqrt(out)

    def at(self, x: float = 0.0, y: float = 0.0, z: float = 0.0) -> Shape:
        """Moved by (x, y, z)."""
        shift = np.asarray([[x], [y], [z]], _F)
        low, high = _box(np.asarray([self.low, self.high]) + np.asarray([x, y, z]))
        return Shape(lambda p: self.distance(p - shift), low, high)

    def rx(self, degrees: float) -> Shape:
        """Turned about the X axis, Y towards Z."""
        return self._turned(1, 2, degrees)

    def ry(self, degrees: float) -> Shape:
        """Turned about the Y axis, Z towards X."""
        return self._turned(2, 0, degrees)

    def rz(self, degrees: float) -> Shape:
        """Turned about the Z axis, X towards Y."""
        return self._turned(0, 1, degrees)

    def _turned(self, a: int, b: int, degrees: float) -> Shape:
        c, s = _F(math.cos(math.radians(degrees))), _F(math.sin(math.radians(degrees)))

        def distance(p: np.ndarray) -> np.ndarray:
            q = p.copy()
            q[a] = c * p[a] + s * p[b]
            q[b] = c * p[b] - s * p[a]
            return self.distance(q)

        corners = self._corners()
        moved = corners.copy()
        moved[:, a] = c * corners[:, a] - s * corners[:, b]
        moved[:, b] = s * corners[:, a] + c * corners[:, b]
        return Shape(distance, *_box(moved))

    def _corners(self) -> np.ndarray:
        sides = np.asarray([self.low, self.high], float)
        return np.asarray([[sides[i, 0], sides[j, 1], sides[k, 2]] for i, j, k in np.ndindex(2, 2, 2)])

    def scaled(self, factor: float) -> Shape:
        """Enlarged about the origin."""
        f = _F(factor)
        low, high = _box(np.asarray([self.low, self.high]) * factor)
        return Shape(lambda p: self.distance(p / f) * f, low, high)

    def stretched(self, x: float = 1.0, y: float = 1.0, z: float = 1.0) -> Shape:
        """Scaled axis by axis; the distance becomes a lower bound."""
        factor, least = np.asarray([[x], [y], [z]], _F), _F(min(x, y, z))
        low, high = _box(np.asarray([self.low, self.high]) * np.asarray([x, y, z]))
        return Shape(lambda p: self.distance(p / factor) * least, low, high)

    def mirrored(self, axis: int) -> Shape:
        """Itself and its mirror image; it should lie on the positive side of `axis`."""

        def distance(p: np.ndarray) -> np.ndarray:
            q = p.copy()
            q[axis] = np.abs(p[axis])
            return self.distance(q)

        reach = max(abs(self.low[axis]), abs(self.high[axis]))
        low, high = list(self.low), list(self.high)
        low[axis], high[axis] = -reach, reach
        return Shape(distance, *_box(np.asarray([low, high])))

    def ring(self, count: int) -> Shape:
        """`count` copies around the Z axis; it should lie in one sector around +X."""
        sector = _F(2.0 * math.pi / count)

        def distance(p: np.ndarray) -> np.ndarray:
            angle = np.arctan2(p[1], p[0])
            angle -= sector * np.round(angle / sector)
            radius = np.hypot(p[0], p[1])
            return self.distance(np.stack([radius * np.cos(angle), radius * np.sin(angle), p[2]]))

        reach = float(np.hypot(*self._corners()[:, :2].T).max())
        return Shape(distance, (-reach, -reach, self.low[2]), (reach, reach, self.high[2]))

    def copies(self, places: Iterable[Vec]) -> Shape:
        """One copy at each place."""
        return union(*(self.at(*place) for place in places))

    def rounded(self, radius: float) -> Shape:
        """Grown by `radius`, edges rounded."""
        r = _F(radius)
        low, high = _box(np.asarray([self.low, self.high]) + np.asarray([[-radius], [radius]]))
        return Shape(lambda p: self.distance(p) - r, low, high)

    def shell(self, thickness: float) -> Shape:
        """A wall of `thickness` inside the surface."""
        half = _F(0.5 * thickness)
        return Shape(lambda p: np.abs(self.distance(p) + half) - half, self.low, self.high)

    def bumpy(self, amplitude: float, field: Field) -> Shape:
        """Surface moved outwards by amplitude times `field`(points) in [-1, 1]."""
        a = _F(amplitude)
        low, high = _box(np.asarray([self.low, self.high]) + np.asarray([[-amplitude], [amplitude]]))
        return Shape(lambda p: self.distance(p) - a * field(p), low, high)

    def blend(self, other: Shape, radius: float) -> Shape:
        """Smooth union over about `radius`."""
        k = float(radius)
        low, high = np.minimum(self.low, other.low), np.maximum(self.high, other.high)
        bounds = _box(np.stack([low - 0.25 * k, high + 0.25 * k]))
        return Shape(lambda p: smooth_min(self.distance(p), other.distance(p), k), *bounds)

    def cut(self, other: Shape, radius: float = 0.0) -> Shape:
        """Without `other`, the edge rounded over about `radius`."""
        if radius <= 0.0:
            return Shape(lambda p: np.maximum(self.distance(p), -other.distance(p)), self.low, self.high)
        return Shape(lambda p: -smooth_min(-self.distance(p), other.distance(p), radius), self.low, self.high)

    def within(self, other: Shape, radius: float = 0.0) -> Shape:
        """The common part, the edge rounded over about `radius`."""
        low = np.maximum(self.low, other.low)
        high = np.maximum(np.minimum(self.high, other.high), low)
        bounds = _box(np.stack([low, high]))
        if radius <= 0.0:
            return Shape(lambda p: np.maximum(self.distance(p), other.distance(p)), *bounds)
        return Shape(lambda p: -smooth_min(-self.distance(p), -other.distance(p), radius), *bounds)

    def __or__(self, other: Shape) -> Shape:
        return union(self, other)

    def __sub__(self, other: Shape) -> Shape:
        return self.cut(other)

    def __and__(self, other: Shape) -> Shape:
        return self.within(other)


def _box(points: np.ndarray) -> tuple[Vec, Vec]:
    low, high = points.min(0), points.max(0)
    return (float(low[0]), float(low[1]), float(low[2])), (float(high[0]), float(high[1]), float(high[2]))


def smooth_min(a: np.ndarray, b: np.ndarray, radius: float) -> np.ndarray:
    """Quadratic polynomial smooth minimum; equals min(a, b) where they differ by more than `radius`."""
    h = np.maximum(_F(radius) - np.abs(a - b), _F(0.0)) / _F(radius)
    return np.minimum(a, b) - h * h * _F(0.25 * radius)


def union(*shapes: Shape) -> Shape:
    """All of them together."""

    def distance(p: np.ndarray) -> np.ndarray:
        out = shapes[0].distance(p)
        for shape in shapes[1:]:
            out = np.minimum(out, shape.distance(p))
        return out

    return Shape(distance, *_box(np.asarray([s.low for s in shapes] + [s.high for s in shapes])))


def blended(radius: float, *shapes: Shape) -> Shape:
    """All of them together, smoothly."""
    out = shapes[0]
    for shape in shapes[1:]:
        out = out.blend(shape, radius)
    return out


# Primitives


def sphere(radius: float) -> Shape:
    r = _F(radius)
    return Shape(
        lambda p: np.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2]) - r,
        (-radius, -radius, -radius),
        (radius, radius, radius),
    )


def ellipsoid(x: float, y: float, z: float) -> Shape:
    """Half axes x, y, z; first-order distance."""
    r = np.asarray([[x], [y], [z]], _F)

    def distance(p: np.ndarray) -> np.ndarray:
        q = p / r
        k0 = np.sqrt((q * q).sum(0))
        q /= r
        k1 = np.sqrt((q * q).sum(0))
        return np.where(k1 > 0, k0 * (k0 - 1) / np.maximum(k1, _F(1e-9)), -r.min())

    return Shape(distance, (-x, -y, -z), (x, y, z))


def box(x: float, y: float, z: float, round: float = 0.0) -> Shape:
    """Full sizes x, y, z; stands on z = 0; edges rounded by `round`."""
    half = np.asarray([[0.5 * x - round], [0.5 * y - round], [0.5 * z - round]], _F)
    middle, r = _F(0.5 * z), _F(round)

    def distance(p: np.ndarray) -> np.ndarray:
        q = np.abs(np.stack([p[0], p[1], p[2] - middle])) - half
        outside = np.maximum(q, _F(0))
        return np.sqrt((outside * outside).sum(0)) + np.minimum(q.max(0), _F(0)) - r

    return Shape(distance, (-0.5 * x, -0.5 * y, 0.0), (0.5 * x, 0.5 * y, z))


def cylinder(radius: float, height: float, round: float = 0.0) -> Shape:
    """Upright, on z = 0."""
    inner, half, middle, r = _F(radius - round), _F(0.5 * height - round), _F(0.5 * height), _F(round)

    def distance(p: np.ndarray) -> np.ndarray:
        a = np.hypot(p[0], p[1]) - inner
        b = np.abs(p[2] - middle) - half
        return np.hypot(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(np.maximum(a, b), 0) - r

    return Shape(distance, (-radius, -radius, 0.0), (radius, radius, height))


def cone(bottom: float, top: float, height: float, round: float = 0.0) -> Shape:
    """Capped cone with the radii `bottom` at z = 0 and `top` at z = height, edges rounded."""
    if round > 0.0:
        lean = math.hypot(height, bottom - top) / height
        rise = (bottom - top) / height
        low = bottom - rise * round - lean * round
        high = top + rise * round - lean * round
        profile = [
            (0.0, round),
            (max(low, 0.0), round),
            (max(high, 0.0), height - round),
            (0.0, height - round),
        ]
        return _bounded(revolve(profile).rounded(round), max(bottom, top), 0.0, height)
    return revolve([(0.0, 0.0), (bottom, 0.0), (top, height), (0.0, height)])


def _bounded(shape: Shape, radius: float, low: float, high: float) -> Shape:
    return Shape(shape.distance, (-radius, -radius, low), (radius, radius, high))


def torus(radius: float, thickness: float) -> Shape:
    """Around the Z axis; `thickness` is the tube's radius."""
    big, small, reach = _F(radius), _F(thickness), radius + thickness
    return Shape(
        lambda p: np.hypot(np.hypot(p[0], p[1]) - big, p[2]) - small,
        (-reach, -reach, -thickness),
        (reach, reach, thickness),
    )


def capsule(a: Vec, b: Vec, radius: float, end: float | None = None) -> Shape:
    """A rod with round ends from a to b; its radius goes to `end`."""
    return tube([a, b], radius, end)


def tube(
    points: Sequence[Vec], radius: float | Sequence[float], end: float | None = None, *, closed: bool = False
) -> Shape:
    """A round tube along a polyline; radius: one, one and `end`, or one for each point."""
    corners = np.asarray(points, _F)
    if isinstance(radius, int | float):
        radii = np.linspace(radius, radius if end is None else end, len(corners)).astype(_F)
    else:
        radii = np.asarray(radius, _F)
    if closed:
        corners, radii = np.concatenate([corners, corners[:1]]), np.concatenate([radii, radii[:1]])

    def distance(p: np.ndarray) -> np.ndarray:
        out = np.full(p.shape[1], np.inf, _F)
        for a, b, ra, rb in zip(corners[:-1], corners[1:], radii[:-1], radii[1:], strict=True):
            x, y, z = p[0] - a[0], p[1] - a[1], p[2] - a[2]
            u = b - a
            length = _F(max(float(u @ u), 1e-12))
            t = np.clip((x * u[0] + y * u[1] + z * u[2]) / length, _F(0), _F(1))
            x -= t * u[0]
            y -= t * u[1]
            z -= t * u[2]
            np.minimum(out, np.sqrt(x * x + y * y + z * z) - (ra + (rb - ra) * t), out=out)
        return out

    low, high = (corners - radii[:, None]), (corners + radii[:, None])
    return Shape(distance, *_box(np.concatenate([low, high])))


def revolve(profile: Sequence[Point2]) -> Shape:
    """A closed (radius, z) polygon turned about the Z axis; radii >= 0, edges along the axis allowed."""
    flat = polygon_distance(profile)
    # Edges on the axis are no surface: the polygon goes on, mirrored, beyond it.
    if any(r <= 1e-9 for r, _ in profile):
        flat = polygon_distance(_across_axis(profile))
    radius = max(r for r, _ in profile)
    low, high = min(z for _, z in profile), max(z for _, z in profile)
    return Shape(lambda p: flat(np.hypot(p[0], p[1]), p[2]), (-radius, -radius, low), (radius, radius, high))


def _across_axis(profile: Sequence[Point2]) -> list[Point2]:
    """The polygon with its part on the axis pushed to negative radii, out of the way."""
    reach = 2.0 * max(r for r, _ in profile) + 2.0 * (max(z for _, z in profile) - min(z for _, z in profile))
    out: list[Point2] = []
    count = len(profile)
    for i, (r, z) in enumerate(profile):
        before, after = profile[i - 1][0] <= 1e-9, profile[(i + 1) % count][0] <= 1e-9
        if r > 1e-9:
            out.append((r, z))
        elif after and not before:
            out += [(0.0, z), (-reach, z)]
        elif before and not after:
            out += [(-reach, z), (0.0, z)]
        elif not before and not after:
            out.append((0.0, z))
    return out


def extrude(outline: Sequence[Point2], height: float, round: float = 0.0) -> Shape:
    """A closed (x, y) polygon made `height` tall; edges rounded outwards by `round` but not upwards."""
    flat = polygon_distance(outline)
    half, middle, r = _F(0.5 * height - round), _F(0.5 * height), _F(round)

    def distance(p: np.ndarray) -> np.ndarray:
        a = flat(p[0], p[1])
        b = np.abs(p[2] - middle) - half
        return np.hypot(np.maximum(a, 0), np.maximum(b, 0)) + np.minimum(np.maximum(a, b), 0) - r

    xs, ys = [x for x, _ in outline], [y for _, y in outline]
    return Shape(
        distance, (min(xs) - round, min(ys) - round, 0.0), (max(xs) + round, max(ys) + round, height)
    )


def polygon_distance(corners: Sequence[Point2]) -> Callable[[np.ndarray, np.ndarray], np.ndarray]:
    """Exact signed distance to a simple closed polygon, either winding (Quilez, 2D polygon)."""
    c = np.asarray(corners, _F)

    def distance(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        squared = np.full(x.shape, np.inf, _F)
        inside = np.zeros(x.shape, bool)
        for (ax, ay), (bx, by) in zip(c, np.roll(c, -1, 0), strict=True):
            ex, ey = bx - ax, by - ay
            wx, wy = x - ax, y - ay
            t = np.clip((wx * ex + wy * ey) / max(ex * ex + ey * ey, _F(1e-12)), _F(0), _F(1))
            dx, dy = wx - t * ex, wy - t * ey
            np.minimum(squared, dx * dx + dy * dy, out=squared)
            crosses = (y >= ay) != (y >= by)
            left = (ex * wy > ey * wx) == (by > ay)
            inside ^= crosses & left
        root = np.sqrt(squared)
        return np.where(inside, -root, root)

    return distance


# Curves


def smooth_curve(
    points: Sequence[Sequence[float]] | np.ndarray, per_span: int = 5, *, closed: bool = False
) -> np.ndarray:
    """The Catmull-Rom curve through points [K, D], `per_span` segments between two of them."""
    p = np.asarray(points, float)
    if closed:
        padded = np.concatenate([p[-1:], p, p[:2]])
    else:
        padded = np.concatenate([2 * p[:1] - p[1:2], p, 2 * p[-1:] - p[-2:-1]])
    t = np.arange(per_span)[:, None] / per_span
    spans = []
    for a, b, c, d in zip(padded[:-3], padded[1:-2], padded[2:-1], padded[3:], strict=True):
        spans.append(
            0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        )
    if not closed:
        spans.append(p[-1:])
    return np.concatenate(spans)


def curved_tube(
    points: Sequence[Vec], radius: float | Sequence[float], end: float | None = None, *, per_span: int = 5
) -> Shape:
    """A round tube along the smooth curve through `points`; radii as in `tube`, for the given points."""
    if isinstance(radius, int | float):
        radii = np.linspace(radius, radius if end is None else end, len(points))
    else:
        radii = np.asarray(radius, float)
    both = smooth_curve(np.column_stack([np.asarray(points, float), radii]), per_span)
    return tube([(float(x), float(y), float(z)) for x, y, z in both[:, :3]], [float(r) for r in both[:, 3]])


def smooth_profile(points: Sequence[Point2], per_span: int = 4) -> list[Point2]:
    """A (radius, z) line through `points` for `revolve`, closed along the axis; radii kept >= 0."""
    line = [(max(float(r), 0.0), float(z)) for r, z in smooth_curve(points, per_span)]
    return [(0.0, line[0][1]), *line, (0.0, line[-1][1])]


def arc(radius: float, start: float, stop: float, count: int = 12) -> list[Point2]:
    """Points (x, y) of a circular arc, from `start` to `stop` degrees, both included."""
    angles = np.radians(np.linspace(start, stop, count))
    return [(radius * math.cos(a), radius * math.sin(a)) for a in angles]


__all__ = [
    "Field",
    "Point2",
    "Shape",
    "Vec",
    "arc",
    "blended",
    "box",
    "capsule",
    "cone",
    "curved_tube",
    "cylinder",
    "ellipsoid",
    "extrude",
    "polygon_distance",
    "revolve",
    "smooth_curve",
    "smooth_min",
    "smooth_profile",
    "sphere",
    "torus",
    "tube",
    "union",
]
