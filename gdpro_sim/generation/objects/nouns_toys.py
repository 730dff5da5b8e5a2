"""Toys, games, music and finery."""

from __future__ import annotations

import math

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    blended,
    box,
    capsule,
    cone,
    curved_tube,
    cylinder,
    ellipsoid,
    extrude,
    revolve,
    smooth_profile,
    sphere,
    torus,
    tube,
    union,
)
from gdpro_sim.generation.objects.shapes import above, below, disc_x, front_view, lobes, star, wheel

DARK, CREAM, GOLD = rgb("2c2a2c"), rgb("f6eddb"), rgb("e0b040")


@noun("rubber duck", "duck", "rubber ducky", "ducky", "toy duck", kind="toys", across=0.10, material="rubber")
def rubber_duck(v: Variation) -> list[Part]:
    r = v(0.25, 0.06)
    body = ellipsoid(0.46, 0.36, 0.29).at(z=0.26)
    tail = ellipsoid(0.17, 0.15, 0.08).ry(38).at(-0.42, 0, 0.42)
    chest = sphere(0.26).at(0.17, 0, 0.3)
    trunk = blended(0.16, body, tail, chest).within(above(0.04), 0.03)
    wing = blended(
        0.05,
        ellipsoid(0.2, 0.06, 0.14).ry(16).at(-0.06, 0.33, 0.29),
        ellipsoid(0.11, 0.045, 0.06).ry(34).at(-0.23, 0.34, 0.38),
    )
    upper = ellipsoid(0.14, 0.115, 0.045).ry(-8).at(0.2 + r + 0.02, 0, 0.695)
    lower = ellipsoid(0.11, 0.09, 0.035).ry(12).at(0.2 + r + 0.005, 0, 0.645)
    eye = (0.2 + 0.82 * r, 0.45 * r, 0.72 + 0.36 * r)
    yellow = rgb("f4c630")
    return [
        Part("body", trunk, yellow, "main"),
        Part("head", sphere(r).at(0.2, 0, 0.72), yellow, "main", blend=0.1),
        Part("wings", wing.mirrored(1), rgb("eeb41f"), "main", blend=0.02),
        Part("beak", upper.blend(lower, 0.02), rgb("e9772b"), "accent"),
        Part(
            "eyes",
            sphere(0.05).at(*eye).mirrored(1),
            DARK,
            paints=(
                Paint(
                    "glints",
                    sphere(0.02).at(eye[0] + 0.04, eye[1] + 0.008, eye[2] + 0.03).mirrored(1),
                    rgb("fbfaf4"),
                ),
            ),
        ),
    ]


@noun("teddy bear", "teddy", "bear", "plush bear", kind="toys", across=0.32, material="plush")
def teddy_bear(v: Variation) -> list[Part]:
    head = ellipsoid(0.24, 0.26, v(0.23, 0.05)).at(0.02, 0, 0.74)
    body = ellipsoid(0.23, 0.26, 0.3).at(z=0.33)
    ear = sphere(0.1).at(0.0, 0.2, 0.93).mirrored(1)
    arm = capsule((0.06, 0.2, 0.48), (0.2, 0.3, 0.3), 0.09, 0.085).mirrored(1)
    leg = capsule((0.08, 0.15, 0.13), (0.34, 0.21, 0.12), 0.115, 0.12).mirrored(1)
    muzzle = ellipsoid(0.12, 0.13, 0.1).at(0.21, 0, 0.68)
    tummy = ellipsoid(0.2, 0.18, 0.22).at(0.14, 0, 0.32)
    inner = sphere(0.062).at(0.075, 0.2, 0.935).mirrored(1)
    soles = disc_x(0.085, 0.06, 0.02).at(0.455, 0.21, 0.12).mirrored(1)
    eyes = sphere(0.033).at(0.215, 0.09, 0.79).mirrored(1)
    mouth = tube([(0.325, 0.05 * k, 0.635 + 0.03 * k * k) for k in (-1, -0.5, 0, 0.5, 1)], 0.014)
    bow = ellipsoid(0.05, 0.1, 0.065).at(0.2, 0.09, 0.54).mirrored(1) | sphere(0.045).at(0.22, 0, 0.54)
    brown, light = rgb("b07a48"), rgb("e8c998")
    return [
        Part("body", body, brown, "main", paints=(Paint("tummy", tummy, light, "accent"),)),
        Part("head", head, brown, "main", blend=0.04),
        Part("ears", ear, brown, "main", paints=(Paint("inner ears", inner, light, "accent"),), blend=0.02),
        Part("arms", arm, brown, "main", blend=0.02),
        Part("legs", leg, brown, "main", blend=0.02),
        Part("muzzle", muzzle, light, "accent"),
        Part("soles", soles, light, "accent"),
        Part("nose", ellipsoid(0.035, 0.05, 0.035).at(0.32, 0, 0.72), DARK),
        Part("eyes", eyes, DARK),
        Part("mouth", mouth, DARK),
        Part("bow", bow, rgb("c8463f")),
    ]


@noun("ball", "beach ball", "toy ball", kind="toys", across=0.25, material="rubber")
def ball(v: Variation) -> list[Part]:
    tilt, turn = v.uniform(15, 30), v.uniform(0, 60)
    lean = lobes(3).rx(tilt).rz(turn)
    pole = cylinder(0.09, 3.0).at(z=-1.5).rx(tilt).rz(turn)
    return [
        Part(
            "body",
            sphere(0.5).at(z=0.5),
            rgb("d9503f"),
            "main",
            paints=(
                Paint("panels", lean.at(z=0.5), CREAM, "accent"),
                Paint("poles", pole.at(z=0.5), rgb("3f73a8")),
            ),
        ),
    ]


@noun("soccer ball", "football", kind="toys", across=0.22, material="leather")
def soccer_ball(v: Variation) -> list[Part]:
    golden = 0.5 * (1 + math.sqrt(5.0))
    corners = [(0.0, a, b * golden) for a in (-1, 1) for b in (-1, 1)]
    spots = []
    for x, y, z in corners:
        for p in ((x, y, z), (y, z, x), (z, x, y)):
            spots.append(sphere(0.165).at(*(0.5 * c / math.sqrt(1 + golden**2) for c in p)))
    turn = v.uniform(0, 90)
    patches = union(*spots).rx(18).rz(turn).at(z=0.5)
    return [
        Part(
            "body",
            sphere(0.5).at(z=0.5),
            rgb("f6f3ea"),
            "main",
            paints=(Paint("patches", patches, DARK, "accent"),),
        )
    ]


@noun("die", "dice", kind="toys", across=0.05, material="plastic")
def die(v: Variation) -> list[Part]:
    cube = box(0.9, 0.9, 0.9, v(0.13, 0.1))
    a = 0.23
    layouts = {
        1: [(0.0, 0.0)],
        2: [(-a, -a), (a, a)],
        3: [(-a, -a), (0.0, 0.0), (a, a)],
        4: [(-a, -a), (a, a), (-a, a), (a, -a)],
        5: [(-a, -a), (a, a), (-a, a), (a, -a), (0.0, 0.0)],
        6: [(-a, -a), (a, a), (-a, a), (a, -a), (-a, 0.0), (a, 0.0)],
    }
    pip = ellipsoid(0.085, 0.085, 0.06)
    faces = {n: pip.copies([(x, y, 0.455) for x, y in spots]) for n, spots in layouts.items()}
    pips = union(
        faces[5], faces[2].rx(180), faces[1].ry(90), faces[6].ry(-90), faces[3].rx(-90), faces[4].rx(90)
    ).at(z=0.45)
    body = cube.cut(pips, 0.015)
    return [
        Part(
            "body",
            body,
            rgb("c8343a"),
            "main",
            paints=(Paint("pips", pips.rounded(0.012), rgb("fbf6ea"), "accent"),),
        )
    ]


@noun("spinning top", "top toy", "toy top", kind="toys", across=0.09, material="wood")
def spinning_top(v: Variation) -> list[Part]:
    wide = v(0.42, 0.05)
    body = revolve(
        smooth_profile(
            [
                (0.035, 0.0),
                (0.06, 0.08),
                (0.25, 0.26),
                (wide, 0.42),
                (0.9 * wide, 0.52),
                (0.2, 0.62),
                (0.06, 0.68),
            ]
        )
    )
    bands = union(box(2, 2, 0.07).at(z=0.37), box(2, 2, 0.05).at(z=0.2), box(2, 2, 0.05).at(z=0.55))
    stem = cone(0.06, 0.05, 0.26, 0.01).at(z=0.64) | ellipsoid(0.085, 0.085, 0.05).at(z=0.9)
    foot = cylinder(0.1, 0.05, 0.015)
    return [
        Part("body", body, rgb("d9503f"), "main", paints=(Paint("bands", bands, rgb("f4cf6a"), "accent"),)),
        Part("stem", stem, rgb("3f73a8"), "accent"),
        Part("tip", foot, rgb("8b9096")),
    ]


@noun("robot", "toy robot", kind="toys", across=0.28, material="aluminium")
def robot(v: Variation) -> list[Part]:
    body = box(0.26, v(0.36, 0.06), 0.34, 0.04).at(z=0.24)
    head = box(0.26, v(0.32, 0.06), 0.24, 0.05).at(z=0.63)
    neck = cylinder(0.07, 0.1).at(z=0.56)
    eyes = disc_x(0.062, 0.06, 0.015).at(0.13, 0.075, 0.77).mirrored(1)
    pupils = disc_x(0.03, 0.1).at(0.13, 0.075, 0.77).mirrored(1)
    grille = box(0.03, 0.16, 0.05, 0.01).at(0.13, 0, 0.66)
    bars = union(*(box(0.2, 0.018, 0.2).at(0.13, y, 0.6) for y in (-0.05, -0.017, 0.017, 0.05)))
    antenna = capsule((0, 0, 0.85), (0, 0, 0.95), 0.019) | sphere(0.042).at(z=0.98)
    ears = capsule((0, 0.15, 0.75), (0, 0.2, 0.75), 0.045).mirrored(1)
    panel = box(0.03, 0.22, 0.17, 0.012).at(0.13, 0, 0.33)
    dial = disc_x(0.045, 0.2).at(0.13, -0.045, 0.435)
    lights = disc_x(0.02, 0.2).at(0.13, 0.04, 0.45) | disc_x(0.02, 0.2).at(0.13, 0.085, 0.45)
    line = box(0.2, 0.17, 0.025).at(0.13, 0, 0.36)
    arm = curved_tube([(0, 0.17, 0.52), (0.0, 0.28, 0.48), (0.04, 0.31, 0.34)], 0.042).mirrored(1)
    hand = (
        torus(0.05, 0.026).rx(90).cut(box(0.2, 0.2, 0.1).at(0.0, 0, -0.12)).at(0.045, 0.312, 0.27)
    ).mirrored(1)
    leg = capsule((0, 0.1, 0.28), (0, 0.1, 0.08), 0.052).mirrored(1)
    feet = box(0.24, 0.15, 0.1, 0.035).at(0.03, 0.105).mirrored(1)
    metal, joint = rgb("7fb0bd"), rgb("6d7378")
    return [
        Part("body", body, metal, "main"),
        Part("head", head, metal, "main"),
        Part("neck", neck, joint),
        Part("eyes", eyes, rgb("fdf6df"), paints=(Paint("pupils", pupils, rgb("2f3a44")),)),
        Part("mouth", grille, rgb("39434b"), paints=(Paint("teeth", bars, rgb("cfd6da")),)),
        Part("antenna", antenna, rgb("d9503f"), "accent"),
        Part("ears", ears, rgb("d9503f"), "accent"),
        Part(
            "panel",
            panel,
            rgb("f1e4c6"),
            paints=(
                Paint("dial", dial, rgb("d9503f")),
                Paint("lights", lights, rgb("5ba15c")),
                Paint("slot", line, rgb("39434b")),
            ),
        ),
        Part("arms", arm, joint),
        Part("hands", hand, rgb("d9503f"), "accent"),
        Part("legs", leg, joint),
        Part("feet", feet, rgb("d9503f"), "accent"),
    ]


@noun("drum", "toy drum", kind="toys", across=0.34, material="wood")
def drum(v: Variation) -> list[Part]:
    radius, height = v(0.42, 0.04), v(0.5, 0.08)
    hoops = torus(radius, 0.038).at(z=0.06) | torus(radius, 0.038).at(z=height)
    ropes = []
    count = 9
    for i in range(count):
        a, b, c = (2 * math.pi * (i + s) / count for s in (0.0, 0.5, 1.0))
        r = radius + 0.008
        low, high = (r * math.cos(b), r * math.sin(b), 0.09), height - 0.03
        ropes.append(
            tube(
                [(r * math.cos(a), r * math.sin(a), high), low, (r * math.cos(c), r * math.sin(c), high)],
                0.017,
            )
        )
    rod = capsule((0.0, -0.32, height + 0.05), (0.05, 0.42, height + 0.055), 0.021)
    sticks = rod.rz(18) | rod.rz(-24).at(z=0.004)
    knobs = sphere(0.045).at(0.05, 0.42, height + 0.06)
    knobs = knobs.rz(18) | knobs.rz(-24)
    return [
        Part("body", cylinder(radius, height).at(z=0.03), rgb("c8403a"), "main"),
        Part("skin", cylinder(radius - 0.01, 0.05, 0.015).at(z=height - 0.01), rgb("f6ecd6")),
        Part("hoops", hoops, rgb("e3b552"), "accent"),
        Part("ropes", union(*ropes), rgb("f6ecd6")),
        Part("sticks", sticks | knobs, rgb("b98350")),
    ]


@noun("chess pawn", "pawn", "chess piece", kind="toys", across=0.06, material="wood")
def chess_pawn(v: Variation) -> list[Part]:
    base = revolve(
        smooth_profile(
            [(0.26, 0.0), (0.28, 0.06), (0.2, 0.12), (0.21, 0.17), (0.13, 0.28), (0.095, 0.52), (0.12, 0.62)]
        )
    )
    collar = ellipsoid(0.19, 0.19, 0.045).at(z=0.64)
    felt = cylinder(0.265, 0.05, 0.02)
    return [
        Part("body", base, rgb("e8d2a6"), "main"),
        Part("collar", collar, rgb("e8d2a6"), "main"),
        Part("head", sphere(v(0.17, 0.05)).at(z=0.8), rgb("e8d2a6"), "main", blend=0.02),
        Part("base", felt, rgb("4f7a58"), "accent"),
    ]


@noun("chess king", "king", kind="toys", across=0.095, material="wood")
def chess_king(v: Variation) -> list[Part]:
    base = revolve(
        smooth_profile(
            [(0.2, 0.0), (0.21, 0.04), (0.15, 0.09), (0.15, 0.13), (0.09, 0.24), (0.07, 0.45), (0.1, 0.56)]
        )
    )
    head = cone(0.085, 0.135, 0.2, 0.015).at(z=0.58) | ellipsoid(0.13, 0.13, 0.06).at(z=0.78)
    collars = ellipsoid(0.145, 0.145, 0.032).at(z=0.575) | ellipsoid(0.115, 0.115, 0.026).at(z=0.53)
    cross = box(0.045, 0.045, v(0.16, 0.1), 0.01).at(z=0.82) | box(0.045, 0.13, 0.045, 0.01).at(z=0.88)
    return [
        Part("body", base, rgb("6a4028"), "main"),
        Part("collar", collars, rgb("6a4028"), "main"),
        Part("head", head, rgb("6a4028"), "main", blend=0.02),
        Part("cross", cross, GOLD, "accent"),
        Part("base", cylinder(0.2, 0.035, 0.012), rgb("4f7a58"), "accent"),
    ]


@noun("bell", "hand bell", "school bell", kind="toys", across=0.16, material="copper")
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


@noun("crown", "royal crown", "tiara", kind="toys", across=0.22, material="gold")
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


@noun("hourglass", "sand timer", "sandglass", kind="toys", across=0.2, material="glass")
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


@noun("dumbbell", "weight", "barbell", kind="toys", across=0.3, material="steel")
def dumbbell(v: Variation) -> list[Part]:
    radius = v(0.17, 0.05)
    hexagon = [
        (radius * math.cos(math.pi * (k + 0.5) / 3), radius * math.sin(math.pi * (k + 0.5) / 3))
        for k in range(6)
    ]
    head = extrude(hexagon, 0.2, 0.02).at(z=-0.1).rx(90).at(0, 0.36, 0.87 * radius + 0.02).mirrored(1)
    z = 0.87 * radius + 0.02
    caps = wheel(0.085, 0.04).at(0, 0.46, z).mirrored(1)
    grip = capsule((0, -0.25, z), (0, 0.25, z), 0.05).blend(ellipsoid(0.06, 0.14, 0.06).at(z=z), 0.04)
    collar = wheel(0.08, 0.05).at(0, 0.25, z).mirrored(1)
    return [
        Part("weights", head, rgb("3f4650"), "main"),
        Part("caps", caps, rgb("d9503f"), "accent"),
        Part("bar", grip, rgb("b9bec2")),
        Part("collars", collar, rgb("8b9096")),
    ]


@noun("toy block", "block", "alphabet block", "building block", kind="toys", across=0.06, material="wood")
def toy_block(v: Variation) -> list[Part]:
    cube = box(0.9, 0.9, 0.9, 0.06)
    hollow = box(0.66, 0.66, 0.06).at(z=0.88)
    sides = [hollow.at(z=-0.45)]
    faces = union(sides[0], sides[0].rx(90), sides[0].rx(-90), sides[0].ry(90), sides[0].ry(-90)).at(z=0.45)
    sign = star(5, 0.26, 0.11)
    letter = extrude(sign, 0.2).at(z=-0.1).ry(90).rx(90).at(0.45, 0, 0.45)
    heart = disc_x(0.22, 0.2).at(0.45, 0, 0.45).rz(90)
    moon = cylinder(0.25, 0.3).at(z=0.75) - cylinder(0.22, 0.3).at(0.09, 0.09, 0.75)
    return [
        Part(
            "body",
            cube.cut(faces, 0.01),
            rgb("e8c78f"),
            "main",
            paints=(
                Paint("panels", faces.rounded(0.012), rgb("f7e9c8"), "accent"),
                Paint("star", letter, rgb("d9503f")),
                Paint("circle", heart, rgb("3f73a8")),
                Paint("moon", moon, rgb("4f8f5a")),
            ),
        ),
    ]


@noun("treasure chest", "chest", "treasure box", kind="toys", across=0.7, material="wood")
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


@noun("guitar", "acoustic guitar", "ukulele", kind="toys", across=1.0, material="wood")
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


@noun("top hat", "hat", "magician hat", kind="toys", across=0.34, material="plush")
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


@noun("boot", "rain boot", "shoe", "wellington", kind="toys", across=0.32, material="rubber")
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


@noun("book", "magic book", "spell book", kind="toys", across=0.26, material="paper")
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


@noun("bowling pin", "pin", "skittle", kind="toys", across=0.38, material="wood")
def bowling_pin(v: Variation) -> list[Part]:
    belly = v(0.165, 0.05)
    body = revolve(
        smooth_profile(
            [
                (0.09, 0.0),
                (0.11, 0.05),
                (belly, 0.32),
                (0.12, 0.56),
                (0.068, 0.72),
                (0.09, 0.88),
                (0.05, 0.98),
                (0.0, 1.0),
            ]
        )
    )
    bands = union(box(2, 2, 0.035).at(z=0.665), box(2, 2, 0.035).at(z=0.735))
    return [
        Part("body", body, rgb("f6f1e6"), "main", paints=(Paint("bands", bands, rgb("cf3f39"), "accent"),)),
        Part("base", cylinder(0.1, 0.04, 0.012), rgb("8b6a48")),
    ]
