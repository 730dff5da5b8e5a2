"""Music, finery and treasure."""

from __future__ import annotations

import math

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    box,
    capsule,
    cone,
    cylinder,
    ellipsoid,
    extrude,
    revolve,
    smooth_profile,
    sphere,
    torus,
    union,
)
from gdpro_sim.generation.objects.shapes import above, below, disc_x, front_view, star

DARK, CREAM, GOLD = rgb("2c2a2c"), rgb("f6eddb"), rgb("e0b040")


@noun("bell", "hand bell", "school bell", kind="things", across=0.16, material="copper")
def bell(v: Variation) -> list[Part]:
    flare = v(0.3, 0.05)
    outside = [(flare, 0.0), (flare - 0.03, 0.06), (0.2, 0.2), (0.17, 0.36), (0.1, 0.46), (0.0, 0.48)]
    inside = [(flare - 0.045, -0.02), (flare - 0.085, 0.06), (0.15, 0.2), (0.12, 0.34), (0.0, 0.4)]
    cup = revolve(smooth_profile(outside)) - revolve(smooth_profile(inside))
    clapper = capsule((0, 0, 0.42), (0, 0, 0.12), 0.025) | sphere(0.075).at(z=0.08)
    handle = revolve(
        smooth_profile([(0.045, 0.44), (0.055, 0.52), (0.085, 0.66), (0.07, 0.82), (0.055, 0.9), (0.0, 0.93)])
    )
    return [
        Part("body", cup, GOLD, "main"),
        Part("rim", torus(flare - 0.02, 0.032).at(z=0.026), rgb("c99530"), "main"),
        Part("collar", torus(0.06, 0.028).at(z=0.47), rgb("c99530"), "main"),
        Part("clapper", clapper, rgb("8a6a35")),
        Part("handle", handle, rgb("8a4f30"), "accent"),
    ]


@noun("crown", "royal crown", "tiara", kind="things", across=0.22, material="gold")
def crown(v: Variation) -> list[Part]:
    radius, count = 0.42, v.pick((6, 7, 8))
    width = 2 * math.pi * radius / count
    point = front_view(
        [
            (-0.5 * width, 0.0),
            (0.5 * width, 0.0),
            (0.5 * width, 0.18),
            (0.0, v(0.46, 0.06)),
            (-0.5 * width, 0.18),
        ],
        0.4,
    )
    ring = cylinder(radius + 0.03, 1.0) - cylinder(radius - 0.03, 3.0).at(z=-1)
    wall = ring & point.at(radius).ring(count)
    jewels = ellipsoid(0.035, 0.05, 0.06).at(radius + 0.03, 0, 0.16).ring(count)
    pearls = sphere(0.05).at(radius, 0, 0.47).ring(count)
    bands = torus(radius, 0.05).at(z=0.05) | torus(radius, 0.036).stretched(z=0.8).at(z=0.24) & below(
        0.24 + 0.04
    )
    cap = ellipsoid(radius - 0.02, radius - 0.02, 0.3).at(z=0.06).within(above(0.05), 0.01)
    return [
        Part("body", wall, rgb("e6b83f"), "main"),
        Part("bands", bands, rgb("f3d06a"), "main"),
        Part("jewels", jewels, rgb("c8323f"), "accent"),
        Part("pearls", pearls, rgb("fbf3e2")),
        Part("lining", cap, rgb("8f2f4a"), "trim"),
    ]


@noun("hourglass", "sand timer", "sandglass", kind="things", across=0.2, material="glass")
def hourglass(v: Variation) -> list[Part]:
    wide = v(0.21, 0.05)
    glass = revolve(
        smooth_profile(
            [
                (0.12, 0.08),
                (wide, 0.18),
                (0.9 * wide, 0.33),
                (0.045, 0.5),
                (0.9 * wide, 0.67),
                (wide, 0.82),
                (0.12, 0.92),
            ]
        )
    )
    pile = ellipsoid(0.3, 0.3, 0.24).at(z=0.08)
    top = box(2, 2, 0.2).at(z=0.52)
    discs = cylinder(0.31, 0.08, 0.02) | cylinder(0.31, 0.08, 0.02).at(z=0.92)
    posts = cylinder(0.032, 0.9).at(0.255, 0, 0.05).ring(4).rz(45)
    rings = union(*(sphere(0.052).at(0.255, 0, z).ring(4).rz(45) for z in (0.1, 0.5, 0.9)))
    return [
        Part(
            "glass",
            glass,
            rgb("cfe5e6"),
            "main",
            paints=(Paint("sand", pile | top, rgb("ecc777"), "accent"),),
        ),
        Part("frame", discs, rgb("8a4f30"), "trim", "grain", rgb("6b3a20")),
        Part("posts", posts | rings, rgb("9c5c38"), "trim"),
    ]


@noun("treasure chest", "chest", "treasure box", kind="things", across=0.7, material="wood")
def treasure_chest(v: Variation) -> list[Part]:
    depth, width, low = v(0.5, 0.05), 0.84, 0.32
    base = box(depth, width, low, 0.015)
    lid = (
        (cylinder(0.5 * depth, width).at(z=-0.5 * width).rx(90).stretched(z=0.9))
        .within(above(0.0))
        .at(z=low + 0.02)
    )
    seam = box(depth + 0.02, width + 0.02, 0.05, 0.012).at(z=low - 0.012)
    bands = union(
        *(
            (
                box(depth + 0.05, 0.09, low, 0.015)
                | (cylinder(0.5 * depth + 0.025, 0.09).at(z=-0.045).rx(90).stretched(z=0.9))
                .within(above(0.0))
                .at(z=low + 0.02)
            ).at(0, y)
            for y in (-0.37, 0.37)
        )
    )
    lock = box(0.06, 0.14, 0.15, 0.02).at(0.5 * depth + 0.01, 0, low - 0.08)
    key = disc_x(0.022, 0.2).at(0.5 * depth, 0, low + 0.01) | box(0.2, 0.018, 0.05).at(
        0.5 * depth, 0, low - 0.05
    )
    planks = union(*(box(4, 4, 0.012).at(z=z) for z in (0.1, 0.2, 0.44, 0.52)))
    ears = torus(0.07, 0.022).rx(90).at(0, 0.5 * width + 0.012, 0.2).mirrored(1)
    return [
        Part(
            "body",
            base | lid,
            rgb("9a6234"),
            "main",
            "grain",
            rgb("7c4b25"),
            paints=(Paint("planks", planks, rgb("5f3819")),),
        ),
        Part("bands", bands | seam, rgb("d9ab3f"), "accent"),
        Part("lock", lock, rgb("e9c35a"), "accent", paints=(Paint("keyhole", key, DARK),)),
        Part("rings", ears, rgb("6d7176")),
    ]


@noun("guitar", "acoustic guitar", "ukulele", kind="things", across=1.0, material="wood")
def guitar(v: Variation) -> list[Part]:
    low, high = v(0.185, 0.04), v(0.14, 0.04)
    sides = cylinder(low, 0.1).at(0, 0, 0) | cylinder(high, 0.1).at(0.24)
    waist = box(0.26, 0.2, 0.1).at(0.12)
    plan = (
        sides.blend(waist, 0.05)
        .cut(cylinder(0.12, 1).at(0.15, 0.215, -0.5), 0.02)
        .cut(cylinder(0.12, 1).at(0.15, -0.215, -0.5), 0.02)
    )
    body = plan.within(box(2, 2, 0.1, 0.015), 0.012).at(z=-0.05).ry(-90).at(0.0, 0, 0.2)
    hole = disc_x(0.062, 0.2).at(0.05, 0, 0.36)
    rose = disc_x(0.08, 0.2).at(0.05, 0, 0.36)
    guard = disc_x(0.08, 0.2).at(0.05, -0.08, 0.29)
    neck = box(0.045, 0.06, 0.45, 0.012).at(0.045, 0, 0.42)
    frets = union(*(box(0.2, 0.2, 0.009).at(0.05, 0, z) for z in (0.5, 0.55, 0.6, 0.66, 0.72, 0.79)))
    head = box(0.04, 0.105, 0.15, 0.015).ry(-8).at(0.04, 0, 0.85)
    pegs = union(*(capsule((0.03, 0.04, z), (0.03, 0.085, z), 0.02) for z in (0.885, 0.935, 0.98))).mirrored(
        1
    )
    bridge = box(0.03, 0.15, 0.035, 0.01).at(0.055, 0, 0.16)
    strings = union(*(capsule((0.072, y, 0.17), (0.075, 0.7 * y, 0.86), 0.0065) for y in (-0.02, 0.0, 0.02)))
    return [
        Part(
            "body",
            body,
            rgb("d28a3e"),
            "main",
            "grain",
            rgb("b8722c"),
            paints=(
                Paint("guard", guard, rgb("5b3420")),
                Paint("rosette", rose, rgb("f1dba8")),
                Paint("hole", hole, rgb("33221a")),
            ),
        ),
        Part("neck", neck | strings, rgb("6b3f24"), "accent", paints=(Paint("frets", frets, rgb("d9d6cf")),)),
        Part("head", head, rgb("6b3f24"), "accent"),
        Part("pegs", pegs, rgb("f1e7d0")),
        Part("bridge", bridge, rgb("4a2a18")),
    ]


@noun("top hat", "hat", "magician hat", kind="things", across=0.34, material="plush")
def top_hat(v: Variation) -> list[Part]:
    high = v(0.52, 0.06)
    crown_ = revolve(smooth_profile([(0.28, 0.02), (0.255, 0.1), (0.25, 0.3), (0.29, high)])).rounded(0.005)
    brim = torus(0.36, 0.1).stretched(z=0.36).at(z=0.06) | cylinder(0.4, 0.055, 0.02).at(z=0.01)
    band = cylinder(0.285, 0.11, 0.02).at(z=0.07)
    feather = ellipsoid(0.024, 0.07, 0.2).rx(-18).at(0.12, 0.27, 0.28)
    return [
        Part("body", crown_, rgb("2f3138"), "main"),
        Part("brim", brim, rgb("2f3138"), "main"),
        Part("band", band, rgb("b8323f"), "accent"),
        Part("feather", feather, rgb("f3e9d0"), "trim"),
    ]


@noun("boot", "rain boot", "shoe", "wellington", kind="things", across=0.32, material="rubber")
def boot(v: Variation) -> list[Part]:
    high = v(0.78, 0.05)
    leg = cone(0.19, 0.215, high - 0.12, 0.02).at(-0.12, 0, 0.12)
    foot = capsule((-0.12, 0, 0.19), (0.26, 0, 0.16), 0.175, 0.165)
    whole = leg.blend(foot, 0.1).within(above(0.05), 0.03) - cylinder(0.165, 1.0).at(-0.12, 0, 0.4)
    sole = (
        union(capsule((-0.12, 0, 0.06), (0.27, 0, 0.06), 0.2))
        .within(below(0.09), 0.02)
        .within(above(0.0), 0.01)
    )
    heel = box(0.2, 0.34, 0.1, 0.02).at(-0.2)
    cuff = torus(0.195, 0.034).at(-0.12, 0, high - 0.01)
    toe = sphere(0.2).at(0.36, 0, 0.13)
    return [
        Part("body", whole, rgb("e3b12e"), "main", paints=(Paint("toe", toe, rgb("d19a1f"), "accent"),)),
        Part("sole", sole | heel, rgb("6b4a2f"), "accent"),
        Part("cuff", cuff, rgb("c98f1d"), "accent"),
    ]


@noun("book", "magic book", "spell book", kind="things", across=0.26, material="paper")
def book(v: Variation) -> list[Part]:
    thick = v(0.2, 0.12)
    covers = box(0.7, 0.92, 0.045, 0.012) | box(0.7, 0.92, 0.045, 0.012).at(z=thick)
    spine = (
        cylinder(0.5 * thick + 0.022, 0.92, 0.01)
        .at(z=-0.46)
        .rx(90)
        .at(-0.3, 0, 0.5 * thick + 0.022)
        .within(box(0.16, 2, 1).at(-0.37))
    )
    pages = box(0.64, 0.86, thick, 0.0).at(-0.005, 0, 0.022)
    lines = union(*(box(2, 2, 0.009).at(z=0.05 + 0.034 * i) for i in range(6)))
    emblem = extrude(star(6, 0.2, 0.1), 0.1).at(z=thick)
    frame = (box(0.58, 0.8, 0.5) - box(0.53, 0.75, 1.0).at(z=-0.2)).at(z=thick + 0.03)
    ribs = union(*(box(0.4, 0.05, 1).at(-0.42, y) for y in (-0.3, -0.1, 0.1, 0.3)))
    mark = box(0.1, 0.07, 0.035, 0.008).at(0.36, 0.2, 0.06)
    return [
        Part(
            "cover",
            covers,
            rgb("8a3244"),
            "main",
            paints=(
                Paint("frame", frame, GOLD, "accent"),
                Paint("emblem", emblem & above(thick + 0.02), GOLD, "accent"),
            ),
        ),
        Part(
            "spine",
            spine | box(0.05, 0.92, thick + 0.04, 0.012).at(-0.335),
            rgb("8a3244"),
            "main",
            paints=(Paint("ribs", ribs, GOLD, "accent"),),
        ),
        Part("pages", pages, rgb("f3e6c6"), paints=(Paint("lines", lines, rgb("dcc9a0")),)),
        Part("bookmark", mark, rgb("3f73a8")),
    ]
