"""Toys and games."""

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
from gdpro_sim.generation.objects.shapes import above, disc_x, lobes, star, wheel

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
    felt = cylinder(0.3, 0.06, 0.02)
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
