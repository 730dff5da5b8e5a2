"""Shapes that several nouns share."""

from __future__ import annotations

import math

import numpy as np

from gdpro_sim.generation.objects.sdf import (
    Field,
    Point2,
    Shape,
    Vec,
    box,
    capsule,
    curved_tube,
    cylinder,
    extrude,
    revolve,
    smooth_curve,
    union,
)


def above(z: float) -> Shape:
    """Everything higher than z (within 20 units), to cut with."""
    return box(40.0, 40.0, 20.0).at(z=z)


def below(z: float) -> Shape:
    """Everything lower than z (within 20 units), to cut with."""
    return box(40.0, 40.0, 20.0).at(z=z - 20.0)


def hollow(outline: list[Point2], wall: float, floor: float, per_span: int = 4) -> Shape:
    """An open vessel: the solid under a smooth (radius, z) outline from z = 0, hollowed from above."""
    line = smooth_curve(outline, per_span)
    outer = [(0.0, float(line[0, 1]))] + [(float(r), float(z)) for r, z in line] + [(0.0, float(line[-1, 1]))]
    return revolve(outer) - revolve(well(outline, wall, floor, per_span))


def well(outline: list[Point2], wall: float, floor: float, per_span: int = 4) -> list[Point2]:
    """Profile of the room inside `hollow`, open to far above; also to cut handles and spouts with."""
    line = smooth_curve(outline, per_span)
    bottom, top = float(line[0, 1]) + floor, float(line[-1, 1])
    inner = [(max(float(r) - wall, 0.3 * float(r)), float(z)) for r, z in line if z > bottom + 0.002]
    first, last = inner[0][0], inner[-1][0]
    return [(0.0, bottom), (0.8 * first, bottom), *inner, (last, top + 0.5), (0.0, top + 0.5)]


def loop_handle(x: float, low: float, high: float, reach: float, thickness: float) -> Shape:
    """A bent handle in the XZ plane that starts and ends at radius x; turn it to the side."""
    span = high - low
    return curved_tube(
        [
            (x - 0.01, 0, high),
            (x + 0.65 * reach, 0, high + 0.02 * span),
            (x + reach, 0, low + 0.62 * span),
            (x + 0.72 * reach, 0, low + 0.16 * span),
            (x - 0.01, 0, low),
        ],
        thickness,
    )


def bail(radius: float, z: float, rise: float, thickness: float) -> Shape:
    """A bucket's handle: an arch over the Y direction."""
    points: list[Vec] = []
    for angle in np.radians(np.linspace(0, 180, 13)):
        points.append((0.0, radius * math.cos(angle), z + rise * math.sin(angle)))
    return curved_tube(points, thickness, per_span=1)


def side_view(outline: list[Point2], width: float, round: float = 0.0) -> Shape:
    """A solid from its outline (x, z) seen from the side, `width` across Y."""
    return extrude(outline, width, round).at(z=-0.5 * width).rx(90)


def front_view(outline: list[Point2], depth: float, round: float = 0.0) -> Shape:
    """A solid from its outline (y, z) seen from the front, `depth` along X."""
    return extrude(outline, depth, round).at(z=-0.5 * depth).rx(90).rz(90)


def gable(x: float, y: float, rise: float) -> Shape:
    """A triangular prism on z = 0, its ridge along X."""
    return front_view([(-0.5 * y, 0.0), (0.5 * y, 0.0), (0.0, rise)], x)


def wheel(radius: float, width: float) -> Shape:
    """A disc with its axle along Y, centred."""
    return cylinder(radius, width, 0.25 * width).at(z=-0.5 * width).rx(90)


def disc_x(radius: float, depth: float, round: float = 0.0) -> Shape:
    """A disc with its axis along X, centred."""
    return cylinder(radius, depth, round).at(z=-0.5 * depth).ry(90)


def four(shape: Shape) -> Shape:
    """A shape at x > 0, y > 0 and its images in all four corners."""
    return shape.mirrored(0).mirrored(1)


def legs(x: float, y: float, height: float, radius: float, splay: float = 1.0) -> Shape:
    """Four round legs under (+-x, +-y, height), their feet `splay` times farther out."""
    return four(capsule((splay * x, splay * y, radius), (x, y, height), radius))


def star(points: int, outer: float, inner: float, turn: float = 90.0) -> list[Point2]:
    """Outline of a star, its first tip at `turn` degrees."""
    out = []
    for i in range(2 * points):
        angle = math.radians(turn + 180.0 * i / points)
        radius = outer if i % 2 == 0 else inner
        out.append((radius * math.cos(angle), radius * math.sin(angle)))
    return out


def wave(count: int, phase: float) -> Field:
    """A wave of `count` periods around the Z axis, for dripping edges and ribs."""
    return lambda p: np.sin(count * np.arctan2(p[1], p[0]) + np.float32(phase))


def lumps(frequency: float, phase: float) -> Field:
    """Regular soft lumps, for scoops, bark and rock."""
    f = np.float32(frequency)
    return lambda p: (
        np.sin(f * p[0] + np.float32(phase))
        * np.sin(np.float32(1.13) * f * p[1] + np.float32(2 * phase))
        * np.sin(np.float32(0.91) * f * p[2] + np.float32(3 * phase))
    )


def lobes(count: int, phase: float = 0.0) -> Shape:
    """Every other one of 2 `count` sectors around the Z axis; no distance, only a sign: for paint."""
    field = wave(count, phase)
    return Shape(lambda p: -field(p), (-20.0, -20.0, -20.0), (20.0, 20.0, 20.0))


def helix(radius: float, start: float, rise: float, turns: float, per_turn: int = 14) -> list[Vec]:
    """Points of a helix around the Z axis from z = start; the rise is over all turns."""
    count = int(per_turn * turns) + 1
    out: list[Vec] = []
    for t in np.linspace(0.0, 1.0, count):
        angle = 2 * math.pi * turns * t
        out.append((radius * math.cos(angle), radius * math.sin(angle), start + rise * float(t)))
    return out


def framed(depth: float, y: float, z: float, bar: float) -> Shape:
    """A cross of bars over a window in a wall that faces X: centre bars over width y and height z."""
    return union(box(depth, bar, z), box(depth, y, bar).at(z=0.5 * (z - bar)))


__all__ = [
    "above",
    "bail",
    "below",
    "disc_x",
    "four",
    "framed",
    "front_view",
    "gable",
    "helix",
    "hollow",
    "legs",
    "lobes",
    "loop_handle",
    "lumps",
    "side_view",
    "star",
    "wave",
    "well",
    "wheel",
]
