"""Fruit and vegetables."""

from __future__ import annotations

import math

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Shape,
    blended,
    box,
    capsule,
    cone,
    curved_tube,
    cylinder,
    ellipsoid,
    revolve,
    smooth_profile,
    sphere,
    torus,
    union,
)
from gdpro_sim.generation.objects.shapes import wave

STEM, LEAF = rgb("6b4a2f"), rgb("5d9a43")


def leaf(length: float, width: float, thickness: float) -> Shape:
    """A leaf that points along +X from the origin."""
    return ellipsoid(0.5 * length, 0.5 * width, thickness).at(0.48 * length)


def tuft(count: int, length: float, width: float, lift: float, thickness: float = 0.03) -> Shape:
    """Leaves around the Z axis, `lift` degrees above the horizontal."""
    return leaf(length, width, thickness).ry(-lift).ring(count)


@noun("apple", kind="fruit and vegetables", across=0.085, material="fruit")
def apple(v: Variation) -> list[Part]:
    width = v(0.5, 0.06)
    body = revolve(
        smooth_profile(
            [
                (0.0, 0.07),
                (0.12, 0.02),
                (0.24, 0.03),
                (0.86 * width, 0.24),
                (width, 0.52),
                (0.88 * width, 0.78),
                (0.28, 0.90),
                (0.12, 0.87),
                (0.0, 0.77),
            ]
        )
    )
    lean = v.uniform(0.03, 0.09)
    stem = curved_tube([(0, 0, 0.74), (0.01, 0, 0.9), (lean, 0, 1.06)], [0.026, 0.024, 0.034])
    green = leaf(0.36, 0.18, 0.03).ry(-20).rz(v.uniform(40, 80)).at(0.0, 0.0, 0.95)
    return [
        Part("body", body, rgb("c63a32"), "main", "streaks", rgb("edb957")),
        Part("stem", stem, STEM),
        Part("leaf", green, LEAF),
    ]


@noun("pear", kind="fruit and vegetables", across=0.11, material="fruit")
def pear(v: Variation) -> list[Part]:
    neck = v(0.19, 0.1)
    body = revolve(
        smooth_profile(
            [
                (0.0, 0.05),
                (0.1, 0.015),
                (0.25, 0.05),
                (0.385, 0.27),
                (0.33, 0.5),
                (neck + 0.02, 0.72),
                (neck - 0.03, 0.88),
                (0.06, 0.95),
                (0.0, 0.93),
            ]
        )
    )
    stem = curved_tube([(0, 0, 0.9), (0.01, 0, 1.0), (0.06, 0, 1.11)], [0.024, 0.022, 0.032])
    green = leaf(0.28, 0.15, 0.026).ry(-15).rz(v.uniform(40, 80)).at(0, 0, 0.98)
    return [
        Part("body", body, rgb("c6c94f"), "main", "streaks", rgb("e1a04a")),
        Part("stem", stem, STEM),
        Part("leaf", green, LEAF),
    ]


@noun("orange", "tangerine", "clementine", kind="fruit and vegetables", across=0.08, material="fruit")
def orange(v: Variation) -> list[Part]:
    body = ellipsoid(0.5, 0.5, v(0.465, 0.04)).at(z=0.46).within(box(2, 2, 2).at(z=0.015), 0.02)
    green = leaf(0.4, 0.2, 0.03).ry(-14).rz(v.uniform(30, 80)).at(0, 0, 0.92)
    return [
        Part("body", body, rgb("f08c2b"), "main", "mottled", rgb("e57b1d")),
        Part("stem", capsule((0, 0, 0.88), (0, 0, 0.96), 0.04), rgb("6f7f3a")),
        Part("leaf", green, LEAF),
    ]


@noun("lemon", kind="fruit and vegetables", across=0.085, material="fruit")
def lemon(v: Variation) -> list[Part]:
    radius = v(0.32, 0.05)
    body = (
        revolve(
            smooth_profile(
                [
                    (0.0, 0.0),
                    (0.05, 0.03),
                    (0.1, 0.09),
                    (0.26, 0.22),
                    (radius, 0.5),
                    (0.26, 0.78),
                    (0.1, 0.91),
                    (0.05, 0.98),
                    (0.0, 1.0),
                ]
            )
        )
        .at(z=-0.5)
        .rx(90)
        .at(z=radius)
    )
    green = leaf(0.34, 0.17, 0.026).ry(-30).rz(20).at(0, 0.44, radius)
    return [
        Part("body", body, rgb("f4d53c"), "main", "mottled", rgb("e9c52c")),
        Part("leaf", green, LEAF),
        Part("stem", capsule((0, 0.46, radius), (0, 0.52, radius + 0.01), 0.035), rgb("6f7f3a")),
    ]


@noun("banana", kind="fruit and vegetables", across=0.19, material="fruit")
def banana(v: Variation) -> list[Part]:
    bend = v(1.35, 0.1)
    points, radii = [], []
    for i in range(9):
        t = i / 8
        angle = (t - 0.5) * bend
        points.append((0.0, 0.75 * math.sin(angle), 0.75 * (1 - math.cos(angle)) + 0.12))
        radii.append((0.045, 0.075, 0.1, 0.115, 0.12, 0.115, 0.1, 0.07, 0.036)[i])
    peel = curved_tube(points, radii, per_span=2)
    (_, y0, z0), (_, y1, z1) = points[0], points[-1]
    tip = sphere(0.045).at(0, y0 - 0.012, z0 + 0.01)
    stem = capsule((0, y1 - 0.01, z1), (0, y1 + 0.06, z1 + 0.1), 0.034, 0.04)
    return [
        Part("peel", peel, rgb("f5d344"), "main", "gradient", rgb("e8c63c")),
        Part("stem", stem, rgb("8f7a38")),
        Part("tip", tip, rgb("4f3f2b")),
    ]


@noun("strawberry", kind="fruit and vegetables", across=0.05, material="fruit")
def strawberry(v: Variation) -> list[Part]:
    width = v(0.42, 0.06)
    body = revolve(
        smooth_profile(
            [(0.0, 0.0), (0.1, 0.03), (0.27, 0.25), (width, 0.6), (0.36, 0.84), (0.18, 0.92), (0.0, 0.9)]
        )
    )
    crown = tuft(6, 0.36, 0.17, -14, 0.034).at(z=0.93)
    stem = curved_tube([(0, 0, 0.88), (0, 0.01, 1.02), (0.04, 0.02, 1.12)], 0.034)
    return [
        Part("body", body, rgb("d63a3a"), "main", "dotted", rgb("f4d889"), (0.11, 0.021)),
        Part("leaves", crown, LEAF),
        Part("stem", stem, rgb("6b9a4b")),
    ]


@noun("watermelon", "watermelon slice", "melon", kind="fruit and vegetables", across=0.30, material="fruit")
def watermelon(v: Variation) -> list[Part]:
    ball = sphere(0.5)
    half = ball.within(box(2, 2, 2).at(z=-2.0), 0.02)
    tilt = v.uniform(24, 34)
    rind = half.ry(90 - tilt).at(z=0.5)
    cut = box(2, 2, 2).at(z=-0.008).ry(90 - tilt).at(z=0.5)
    seeds = union(
        *(
            ellipsoid(0.034, 0.022, 0.03).at(r * math.cos(a), r * math.sin(a), 0.0)
            for r, count, turn in ((0.17, 5, 0.2), (0.31, 9, 0.0))
            for a in (turn + 2 * math.pi * i / count for i in range(count))
        )
    )
    seeds = seeds.ry(90 - tilt).at(z=0.5)
    flesh = sphere(0.43).at(z=0.5).within(cut.rounded(0.004))
    white = sphere(0.458).at(z=0.5).within(cut.rounded(0.004))
    return [
        Part(
            "rind",
            rind,
            rgb("3f8f4a"),
            "main",
            "melon",
            rgb("235f34"),
            paints=(
                Paint("pith", white, rgb("e6efc4")),
                Paint("flesh", flesh, rgb("e2504f"), "trim"),
                Paint("seeds", seeds, rgb("2b211d")),
            ),
        )
    ]


@noun("pineapple", kind="fruit and vegetables", across=0.30, material="fruit")
def pineapple(v: Variation) -> list[Part]:
    radius = v(0.21, 0.06)
    body = revolve(
        smooth_profile(
            [(0.08, 0.0), (0.16, 0.03), (radius, 0.24), (0.95 * radius, 0.42), (0.12, 0.57), (0.0, 0.59)]
        )
    )
    crown = union(
        tuft(7, 0.24, 0.085, 34, 0.022).at(z=0.56),
        tuft(6, 0.28, 0.08, 56, 0.022).rz(20).at(z=0.57),
        tuft(4, 0.33, 0.08, 76, 0.022).rz(45).at(z=0.58),
        capsule((0, 0, 0.55), (0, 0, 0.9), 0.05, 0.02),
    )
    return [
        Part("body", body, rgb("dd9c36"), "main", "diamonds", rgb("a9641f")),
        Part("leaves", crown, rgb("4f8f4c"), "accent"),
    ]


@noun("carrot", kind="fruit and vegetables", across=0.22, material="fruit")
def carrot(v: Variation) -> list[Part]:
    thick = v(0.13, 0.06)
    ridges = union(
        *(torus(thick * (1.0 - 0.75 * t) - 0.004, 0.012).at(z=0.72 * (1 - t)) for t in (0.12, 0.3, 0.5, 0.68))
    )
    root = revolve(
        smooth_profile(
            [(0.0, 0.0), (0.03, 0.05), (0.6 * thick, 0.3), (thick, 0.62), (0.8 * thick, 0.71), (0.0, 0.73)]
        )
    )
    top = union(
        curved_tube([(0, 0, 0.7), (0.02, 0.02, 0.85), (0.1, 0.08, 1.0)], [0.02, 0.022, 0.045]),
        curved_tube([(0, 0, 0.7), (0, -0.03, 0.86), (0.02, -0.12, 1.02)], [0.02, 0.022, 0.048]),
        curved_tube([(0, 0, 0.7), (-0.02, 0.01, 0.88), (-0.09, 0.03, 1.05)], [0.02, 0.022, 0.045]),
        curved_tube([(0, 0, 0.7), (0, 0.0, 0.9), (0.01, 0.0, 1.1)], [0.02, 0.022, 0.05]),
    )
    return [
        Part("root", root.blend(ridges, 0.012), rgb("ee8230"), "main"),
        Part("leaves", top, rgb("5a9d49"), "accent"),
    ]


@noun("tomato", kind="fruit and vegetables", across=0.075, material="fruit")
def tomato(v: Variation) -> list[Part]:
    body = ellipsoid(0.5, 0.5, v(0.41, 0.05)).bumpy(0.014, wave(6, v.uniform(0, 6)))
    body = (
        body.cut(ellipsoid(0.16, 0.16, 0.07).at(z=0.42), 0.08)
        .at(z=0.4)
        .within(box(2, 2, 2).at(z=0.012), 0.02)
    )
    crown = tuft(5, 0.3, 0.11, 3, 0.034).at(z=0.79)
    return [
        Part("body", body, rgb("d6402f"), "main"),
        Part("leaves", crown, rgb("4f8f3f")),
        Part("stem", curved_tube([(0, 0, 0.72), (0, 0, 0.84), (0.05, 0, 0.93)], 0.036), rgb("4f8f3f")),
    ]


@noun("pumpkin", "squash", "gourd", kind="fruit and vegetables", across=0.32, material="fruit")
def pumpkin(v: Variation) -> list[Part]:
    count = v.pick((8, 9, 10))
    lobe = ellipsoid(0.25, 0.17, v(0.34, 0.05)).at(0.26)
    body = (
        (lobe.ring(count) | cylinder(0.3, 0.4).at(z=-0.2)).at(z=0.345).within(box(2, 2, 2).at(z=0.03), 0.03)
    )
    stem = curved_tube(
        [(0, 0, 0.58), (0, 0, 0.72), (0.04, 0.03, 0.8), (0.11, 0.05, 0.83)], [0.08, 0.055, 0.05, 0.06]
    )
    vine = leaf(0.26, 0.22, 0.03).ry(-8).rz(-60).at(0.0, -0.02, 0.68)
    return [
        Part("body", body, rgb("e58428"), "main", "ribs", rgb("c4651a")),
        Part("stem", stem, rgb("7a7a3c")),
        Part("leaf", vine, LEAF),
    ]


@noun("eggplant", "aubergine", kind="fruit and vegetables", across=0.22, material="fruit")
def eggplant(v: Variation) -> list[Part]:
    wide = v(0.24, 0.06)
    body = curved_tube(
        [(0, -0.25, 0.24), (0, -0.02, 0.22), (0, 0.22, 0.23), (0, 0.4, 0.3)],
        [wide - 0.005, wide - 0.02, 0.16, 0.11],
    )
    cap = ellipsoid(0.135, 0.135, 0.1) | tuft(5, 0.2, 0.11, -48, 0.03).at(z=0.04)
    cap = cap.rx(-52).at(0, 0.42, 0.33)
    stem = capsule((0, 0.46, 0.36), (0, 0.58, 0.46), 0.036, 0.044)
    return [
        Part("body", body, rgb("5b2f6b"), "main"),
        Part("cap", cap, rgb("5f8f45"), "accent"),
        Part("stem", stem, rgb("5f8f45"), "accent"),
    ]


@noun("corn", "corn cob", "ear of corn", "maize", kind="fruit and vegetables", across=0.24, material="fruit")
def corn(v: Variation) -> list[Part]:
    radius = v(0.14, 0.06)
    cob = revolve(smooth_profile([(0.1, 0.08), (radius, 0.25), (radius, 0.6), (0.09, 0.88), (0.0, 0.97)]))
    rows = []
    for i in range(11):
        z = 0.2 + 0.066 * i
        r = radius - 0.012 - max(0.0, i - 6) * 0.016
        rows.append(ellipsoid(0.04, 0.034, 0.034).at(r, 0, z).ring(12).rz(15.0 * (i % 2)))
    husk = ellipsoid(0.05, 0.15, 0.34).at(radius + 0.035, 0, 0.26).ry(8).ring(3).within(box(2, 2, 2), 0.0)
    return [
        Part("kernels", cob | union(*rows), rgb("f3c838"), "main"),
        Part("husk", husk, rgb("7fae4d"), "accent"),
        Part("base", cone(0.1, 0.13, 0.14, 0.02), rgb("8fb65a"), "accent"),
    ]


@noun("avocado", "avocado half", kind="fruit and vegetables", across=0.12, material="fruit")
def avocado(v: Variation) -> list[Part]:
    wide = v(0.34, 0.05)
    outline = [(0.0, 0.0), (0.16, 0.02), (wide, 0.26), (0.29, 0.52), (0.17, 0.8), (0.1, 0.93), (0.0, 0.97)]
    whole = revolve(smooth_profile(outline))
    inner = revolve(smooth_profile(outline)).rounded(-0.035)
    front = box(2, 2, 2).at(1.0, 0, 0)
    half = whole.cut(front, 0.015)
    near = box(1, 2, 2).at(0.49, 0, 0)
    paints = (
        Paint("rim", inner.rounded(0.016).within(near), rgb("b6c65a")),
        Paint("flesh", inner.rounded(-0.01).within(near), rgb("e8e39a"), "accent"),
    )
    half = half.ry(-16).at(z=0.03)
    turned = tuple(Paint(p.name, p.shape.ry(-16).at(z=0.03), p.color, p.role) for p in paints)
    pit = sphere(0.15).at(0.0, 0, 0.3).ry(-16).at(z=0.03)
    rest = box(0.3, 0.34, 0.05, 0.02).at(-0.1)
    return [
        Part("skin", half | rest, rgb("4a5c2f"), "main", "mottled", rgb("3a4a26"), paints=turned),
        Part("pit", pit, rgb("8a5530")),
    ]


@noun("cherries", "cherry", kind="fruit and vegetables", across=0.06, material="fruit")
def cherries(v: Variation) -> list[Part]:
    drop = v(0.25, 0.04)
    fruit = sphere(drop).at(0, -0.26, drop - 0.01) | sphere(0.94 * drop).at(0.08, 0.25, 0.94 * drop - 0.01)
    top = (0.0, 0.06, 1.0)
    stems = union(
        curved_tube([(0, -0.25, 0.42), (0, -0.2, 0.7), top], [0.03, 0.025, 0.035]),
        curved_tube([(0.08, 0.24, 0.4), (0.07, 0.22, 0.7), top], [0.03, 0.025, 0.035]),
    )
    green = leaf(0.42, 0.2, 0.034).ry(12).rz(110).at(0.0, 0.06, 0.99)
    join = capsule((0, -0.1, 0.15), (0.04, 0.1, 0.15), 0.06)
    return [
        Part("fruit", blended(0.03, fruit, join), rgb("b3202f"), "main"),
        Part("stems", stems, rgb("6d8a3d")),
        Part("leaf", green, LEAF),
    ]
