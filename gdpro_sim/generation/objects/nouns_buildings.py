"""Buildings."""

from __future__ import annotations

import math
from itertools import pairwise

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Shape,
    arc,
    box,
    capsule,
    cone,
    cylinder,
    ellipsoid,
    extrude,
    sphere,
    torus,
    tube,
    union,
)
from gdpro_sim.generation.objects.shapes import above, disc_x, four, framed, front_view, gable, star, wave

GLASS, FRAME, DOOR = rgb("9cc9dc"), rgb("fbf6ea"), rgb("5a7d5c")
ROOF, ROOF_DARK = rgb("b4503c"), rgb("8f3b2c")
STONE, STONE_DARK = rgb("b3aa9b"), rgb("91897c")


def arched(y: float, z: float, depth: float) -> Shape:
    """A door or window with a round top, on z = 0, facing X, centred."""
    top = [(a, z - 0.5 * y + b) for a, b in arc(0.5 * y, 0, 180, 9)]
    return front_view([(0.5 * y, 0.0), *top, (-0.5 * y, 0.0)], depth)


def battlements(radius: float, count: int, height: float, thick: float) -> Shape:
    """Merlons around a round tower's top, on z = 0."""
    return box(thick, 2.0 * math.pi * radius / count * 0.55, height).at(radius).ring(count)


@noun("house", "cottage", "home", kind="buildings", across=9.0, material="wood")
def house(v: Variation) -> list[Part]:
    depth, width, wall, rise = v(0.72), v(0.8), v(0.46), v(0.38)
    body = box(depth, width, wall) | gable(depth, width, rise).at(z=wall)
    pitch = rise / (0.5 * width)
    inner = gable(depth + 1.0, width + 0.84, rise + 0.42 * pitch).at(z=-0.42 * pitch)
    roof = gable(depth + 0.14, width + 0.2, rise + 0.1 * pitch).at(z=0.055 - 0.1 * pitch) - inner
    front, side, low = 0.5 * depth, 0.31 * width, 0.17
    door = box(0.06, 0.17, 0.3, 0.015).at(front)
    knob = capsule((front + 0.03, 0.05, 0.15), (front + 0.045, 0.05, 0.15), 0.018)
    wide = box(0.05, 0.17, 0.17, 0.012)
    flank = wide.rz(90).at(0.2, 0.5 * width, low).mirrored(0).mirrored(1)
    faces = (wide.at(front, side, low) | wide.at(-front, side, low)).mirrored(1)
    windows = faces | flank | box(0.05, 0.13, 0.13, 0.012).at(front, 0, wall + 0.06)
    bar = framed(0.08, 0.17, 0.17, 0.022)
    bars = (bar.at(front, side, low) | bar.at(-front, side, low)).mirrored(1)
    bars = bars | bar.rz(90).at(0.2, 0.5 * width, low).mirrored(0).mirrored(1)
    bars = bars | box(0.08, 0.02, 0.2).at(front, 0, wall + 0.03)
    spot = (-0.15 * depth, 0.24 * width)
    chimney = box(0.13, 0.13, 0.42).at(*spot, wall + 0.06) | box(0.17, 0.17, 0.05, 0.01).at(
        *spot, wall + 0.46
    )
    return [
        Part("walls", body, rgb("f0e2c4"), "main"),
        Part("base", box(depth + 0.06, width + 0.06, 0.06, 0.012), rgb("97918a")),
        Part("roof", roof.at(z=wall).rounded(0.012), ROOF, "trim", "bricks", ROOF_DARK),
        Part("door", door, DOOR),
        Part("knob", knob, rgb("d9b44a")),
        Part("windows", windows, GLASS, paints=(Paint("window frames", bars, FRAME),)),
        Part("chimney", chimney, rgb("a8614a"), "fixed", "bricks", rgb("d2b8a4")),
    ]


@noun("tower", "watchtower", kind="buildings", across=18.0, material="stone")
def tower(v: Variation) -> list[Part]:
    radius = v(0.16, 0.08)
    shaft = cone(1.2 * radius, radius, 0.68)
    head = cylinder(1.3 * radius, 0.13, 0.012).at(z=0.64)
    roof = cone(1.5 * radius, 0.0, 0.34).rounded(0.01).at(z=0.77)
    slits = arched(0.06, 0.12, 0.5).at(0.1, 0, 0.34) | arched(0.06, 0.12, 0.5).at(0.1, 0, 0.52)
    ports = arched(0.05, 0.075, 0.1).at(1.3 * radius, 0, 0.67).ring(8)
    door = arched(0.12, 0.17, 0.05).at(1.19 * radius, 0, 0.0)
    flag = tube([(0, 0, 1.05), (0, 0, 1.21)], 0.022)
    pennant = front_view([(0.0, 1.22), (0.0, 1.12), (0.15, 1.17)], 0.04)
    return [
        Part(
            "walls",
            shaft,
            STONE,
            "main",
            "bricks",
            STONE_DARK,
            paints=(Paint("windows", slits, rgb("3c4350")),),
        ),
        Part(
            "battlements",
            head | battlements(1.22 * radius, 8, 0.06, 0.05).at(z=0.75),
            rgb("c2b9a9"),
            "main",
            paints=(Paint("windows", ports, rgb("3c4350")),),
        ),
        Part("roof", roof, rgb("47688f"), "trim", "bricks", rgb("375274")),
        Part("door", door, rgb("7a4d2b")),
        Part("pole", flag, rgb("8a6a3d")),
        Part("flag", pennant, rgb("c8403a")),
    ]


@noun("castle", "fortress", kind="buildings", across=30.0, material="stone")
def castle(v: Variation) -> list[Part]:
    half, radius, high = 0.34, v(0.105, 0.06), v(0.42, 0.06)
    wall = 0.26
    walls = box(2 * half, 2 * half, wall) - box(2 * half - 0.16, 2 * half - 0.16, 1.0).at(z=wall - 0.06)
    teeth = union(
        *(
            box(0.055, 0.055, 0.055).at(half - 0.03, y, wall - 0.005)
            for y in (-0.19, -0.095, 0.0, 0.095, 0.19)
        )
    )
    teeth = union(teeth, teeth.rz(90), teeth.rz(180), teeth.rz(270))
    corner = cylinder(radius, high) | cylinder(1.14 * radius, 0.06, 0.008).at(z=high - 0.05)
    roofs = four(cone(1.3 * radius, 0.0, 0.22).rounded(0.008).at(half, half, high + 0.015))
    keep = box(0.3, 0.3, 0.5) | box(0.34, 0.34, 0.06, 0.008).at(z=0.46)
    keep_teeth = union(*(box(0.06, 0.06, 0.06).at(0.14, y, 0.51) for y in (-0.14, 0.0, 0.14)))
    keep = union(keep, keep_teeth, keep_teeth.rz(90), keep_teeth.rz(180), keep_teeth.rz(270))
    gate_tower = box(0.12, 0.28, 0.32).at(half)
    gate = arched(0.14, 0.2, 0.06).at(half + 0.06)
    grid = union(*(box(0.2, 0.014, 0.3).at(half + 0.06, y) for y in (-0.045, 0.0, 0.045)))
    grid = grid | union(*(box(0.2, 0.3, 0.014).at(half + 0.06, 0, z) for z in (0.05, 0.1, 0.15)))
    eyes = arched(0.035, 0.07, 1.0).at(0.3, half, 0.28).mirrored(1) | arched(0.045, 0.09, 1.0).at(
        0.2, 0.06, 0.36
    ).mirrored(1)
    pole = capsule((0, 0, 0.5), (0, 0, 0.72), 0.015)
    banner = front_view([(0.0, 0.73), (0.0, 0.62), (0.16, 0.675)], 0.03)
    dark = rgb("3c4350")
    return [
        Part("walls", walls | teeth | gate_tower, STONE, "main", "bricks", STONE_DARK),
        Part(
            "towers",
            four(corner.at(half, half)),
            rgb("c2b9a9"),
            "main",
            "bricks",
            rgb("a0978a"),
            paints=(Paint("windows", eyes, dark),),
        ),
        Part(
            "keep",
            keep,
            rgb("bdb4a5"),
            "main",
            "bricks",
            rgb("9b9285"),
            paints=(Paint("windows", eyes, dark),),
        ),
        Part("roofs", roofs, rgb("47688f"), "trim", "bricks", rgb("375274")),
        Part("gate", gate, rgb("7a4d2b"), paints=(Paint("bars", grid, rgb("553218")),)),
        Part("pole", pole, rgb("8a6a3d")),
        Part("flag", banner, rgb("c8403a")),
    ]


@noun("lighthouse", kind="buildings", across=24.0, material="concrete")
def lighthouse(v: Variation) -> list[Part]:
    foot, head = v(0.165, 0.06), v(0.105, 0.06)
    rock = ellipsoid(0.3, 0.3, 0.13).bumpy(0.03, wave(5, v.uniform(0, 6))).within(above(0.0), 0.01)
    shaft = cone(foot, head, 0.66).at(z=0.08)
    bands = union(*(box(2, 2, 0.105).at(z=z) for z in (0.19, 0.4, 0.61)))
    openings = union(*(arched(0.05, 0.08, 0.5).at(0.2, 0, z) for z in (0.33, 0.54)))
    gallery = cylinder(head + 0.065, 0.035, 0.012).at(z=0.73)
    rail = torus(head + 0.05, 0.013).at(z=0.815) | capsule(
        (head + 0.05, 0, 0.75), (head + 0.05, 0, 0.815), 0.012
    ).ring(10)
    lantern = cylinder(0.072, 0.16).at(z=0.75)
    frame = box(0.16, 0.014, 0.2).at(z=0.74)
    frame = union(frame, frame.rz(45), frame.rz(90), frame.rz(135)).within(cylinder(0.08, 2.0)) | torus(
        0.074, 0.014
    ).at(z=0.9)
    dome = ellipsoid(0.1, 0.1, 0.09).within(above(0.0), 0.01).at(z=0.9)
    ball = sphere(0.026).at(z=1.0)
    return [
        Part(
            "walls",
            shaft,
            rgb("f5f0e4"),
            "main",
            paints=(
                Paint("stripes", bands, rgb("cf4339"), "accent"),
                Paint("windows", openings, rgb("39506b")),
            ),
        ),
        Part("rock", rock, rgb("8d8a82"), "fixed", "mottled", rgb("6f6d68")),
        Part("door", arched(0.09, 0.13, 0.06).at(foot - 0.01, 0, 0.1), rgb("39506b")),
        Part("gallery", gallery | rail, rgb("3d4650")),
        Part("lantern", lantern, rgb("ffe9a3"), paints=(Paint("frame", frame, rgb("3d4650")),)),
        Part("roof", dome | ball, rgb("cf4339"), "trim"),
    ]


@noun("windmill", kind="buildings", across=12.0, material="stone")
def windmill(v: Variation) -> list[Part]:
    foot, head = v(0.21, 0.05), v(0.14, 0.05)
    body = cone(foot, head, 0.58)
    cap = ellipsoid(head + 0.035, head + 0.035, 0.15).within(above(0.0), 0.02).at(z=0.56)
    hub = capsule((0.1, 0, 0.62), (0.25, 0, 0.62), 0.036)
    spar = box(0.026, 0.026, 0.44).at(0.225)
    sail = box(0.024, 0.115, 0.32).at(0.225, 0.07, 0.1)
    slats = union(*(box(0.1, 0.2, 0.016).at(0.225, 0.07, z) for z in (0.16, 0.23, 0.3, 0.37))) | box(
        0.1, 0.016, 1
    ).at(0.225, 0.07)
    turn = v.uniform(15, 40)
    arms = union(*(spar.rx(turn + 90 * i) for i in range(4))).at(z=0.62)
    sails = union(*(sail.rx(turn + 90 * i) for i in range(4))).at(z=0.62)
    lattice = union(*(slats.rx(turn + 90 * i) for i in range(4))).at(z=0.62)
    openings = union(*(arched(0.065, 0.09, 1.0).at(0.5, 0, z) for z in (0.24, 0.42)))
    return [
        Part("walls", body, rgb("efe5cf"), "main", paints=(Paint("windows", openings, rgb("46627e")),)),
        Part("base", cylinder(foot + 0.03, 0.05, 0.012), rgb("97918a")),
        Part("roof", cap, rgb("a5533d"), "trim"),
        Part("door", arched(0.11, 0.16, 0.06).at(foot - 0.012), rgb("5a7d5c")),
        Part("hub", hub, rgb("6b4a2f")),
        Part("arms", arms, rgb("6b4a2f")),
        Part("sails", sails, rgb("fbf6ea"), "accent", paints=(Paint("slats", lattice, rgb("b98d58")),)),
    ]


@noun("barn", "farmhouse", "stable", kind="buildings", across=14.0, material="wood")
def barn(v: Variation) -> list[Part]:
    depth, width, wall = v(0.95), v(0.66), v(0.33)
    knee, ridge = wall + 0.2, wall + 0.33
    half = 0.5 * width
    outline = [
        (-half, 0.0),
        (half, 0.0),
        (half, wall),
        (0.62 * half, knee),
        (0.0, ridge),
        (-0.62 * half, knee),
        (-half, wall),
    ]
    body = front_view(outline, depth)
    side = [(half + 0.05, wall - 0.05), (0.62 * half, knee), (0.0, ridge)]
    roof = union(*(_slab(a, b, depth + 0.12) for a, b in pairwise(side))).mirrored(1)
    planks = Paint(
        "planks",
        union(*(box(4, 0.008, 2).at(0, y) for y in (-0.24, -0.16, -0.08, 0.0, 0.08, 0.16, 0.24))),
        rgb("8c2f28"),
    )
    front = 0.5 * depth
    door = box(0.05, 0.3, 0.27, 0.01).at(front)
    cross = union(
        tube([(front, -0.14, 0.01), (front, 0.0, 0.26)], 0.03),
        tube([(front, 0.14, 0.01), (front, 0.0, 0.26)], 0.03),
        tube([(front, -0.14, 0.26), (front, 0.0, 0.01)], 0.03),
        tube([(front, 0.14, 0.26), (front, 0.0, 0.01)], 0.03),
        box(0.2, 0.02, 1).at(front),
        box(0.2, 0.4, 0.03).at(front, 0, 0.25),
    )
    loft = box(0.05, 0.15, 0.13, 0.01).at(front, 0, wall + 0.05)
    loft_cross = tube([(front, -0.07, wall + 0.06), (front, 0.07, wall + 0.17)], 0.018) | tube(
        [(front, 0.07, wall + 0.06), (front, -0.07, wall + 0.17)], 0.018
    )
    white = rgb("f6efe2")
    return [
        Part("walls", body, rgb("b23c33"), "main", paints=(planks,)),
        Part("roof", roof, rgb("6b6f74"), "trim"),
        Part("door", door, rgb("c75a4e"), paints=(Paint("door frame", cross, white, "accent"),)),
        Part("loft", loft, rgb("c75a4e"), paints=(Paint("loft frame", loft_cross, white, "accent"),)),
        Part("base", box(depth + 0.03, width + 0.03, 0.04, 0.01), rgb("97918a")),
    ]


def _slab(a: tuple[float, float], b: tuple[float, float], depth: float) -> Shape:
    """A roof board along X over the line from a to b, (y, z)."""
    middle = (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]))
    length = math.hypot(b[0] - a[0], b[1] - a[1])
    tilt = math.degrees(math.atan2(b[1] - a[1], b[0] - a[0]))
    board = box(depth, length + 0.1, 0.05, 0.014).at(z=-0.026).rx(tilt + 180)
    return board.at(0, middle[0], middle[1] + 0.018)


@noun("igloo", kind="buildings", across=3.2, material="snow")
def igloo(v: Variation) -> list[Part]:
    radius = v(0.4, 0.04)
    dome = ellipsoid(radius, radius, 0.92 * radius).within(above(0.0), 0.0)
    tunnel = (disc_x(0.19, 0.44).at(0.4, 0, 0.06)).within(above(0.0), 0.0)
    mouth = disc_x(0.125, 0.9).at(0.75, 0, 0.06)
    rows = union(*(box(4, 4, 0.014).at(z=z) for z in (0.09, 0.18, 0.26, 0.325)))
    seam = box(4, 0.014, 0.09)
    seams = []
    for i, z in enumerate((0.0, 0.09, 0.18, 0.26)):
        seams += [seam.rz(30.0 * k + 15.0 * (i % 2)).at(z=z) for k in range(6)]
    blocks = Paint("blocks", rows | union(*seams), rgb("b4cfdf"))
    arch = torus(0.165, 0.03).rx(90).rz(90).at(0.615, 0, 0.06).within(above(0.0), 0.0)
    return [
        Part("dome", dome - mouth.at(x=0.08), rgb("eef4f7"), "main", paints=(blocks,)),
        Part("tunnel", tunnel - mouth, rgb("e2edf3"), "main", paints=(Paint("blocks", rows, rgb("b4cfdf")),)),
        Part("arch", arch, rgb("cfe1ec"), "accent"),
        Part("ground", cylinder(0.62, 0.04, 0.015).stretched(x=1.05).at(0.08, 0, -0.02), rgb("f7fafb")),
    ]


@noun("tent", "camping tent", kind="buildings", across=2.4, material="plush")
def tent(v: Variation) -> list[Part]:
    width, rise, depth = v(0.8, 0.05), v(0.6, 0.06), 0.86
    body = gable(depth, width, rise)
    room = gable(0.5, 0.62 * width, 0.72 * rise).at(0.36)
    flap = front_view(
        [(0.0, 0.72 * rise), (0.31 * width, 0.0), (0.43 * width, 0.0), (0.1, 0.68 * rise)], 0.045
    )
    flap = flap.at(0.5 * depth).mirrored(1)
    poles = capsule((0.5 * depth, 0.04, rise - 0.05), (0.5 * depth, -0.03, rise + 0.09), 0.02) | capsule(
        (0.5 * depth, -0.04, rise - 0.05), (0.5 * depth, 0.03, rise + 0.09), 0.02
    )
    stripe = union(*(box(0.1, 4, 4).at(x, 0, -1) for x in (-0.28, 0.0, 0.28)))
    return [
        Part(
            "canvas",
            body.rounded(0.012).at(z=0.012) - room.at(z=0.03),
            rgb("e08a3c"),
            "main",
            paints=(Paint("stripes", stripe, rgb("f5e8cf"), "accent"),),
        ),
        Part("flaps", flap.at(z=0.01), rgb("c56f28"), "main"),
        Part("ground", box(depth + 0.14, width + 0.12, 0.045, 0.015), rgb("7c9a5b")),
        Part("poles", poles.mirrored(0), rgb("8a5a33")),
    ]


@noun("church", "chapel", kind="buildings", across=18.0, material="stone")
def church(v: Variation) -> list[Part]:
    width, wall, rise = v(0.34, 0.05), v(0.26, 0.05), 0.2
    nave = (box(0.6, width, wall) | gable(0.6, width, rise).at(z=wall)).at(-0.12)
    roof = union(_slab((0.5 * width + 0.04, wall - 0.03), (0.0, wall + rise), 0.66)).mirrored(1).at(-0.12)
    steeple = box(0.2, 0.2, 0.56).at(0.24)
    spire = _pyramid(0.29, 0.34).at(0.24, 0, 0.55)
    cross = box(0.03, 0.03, 0.16).at(0.24, 0, 0.86) | box(0.03, 0.1, 0.03).at(0.24, 0, 0.94)
    front = 0.34
    lights = arched(0.06, 0.14, 1.0).rz(90)
    sides = union(*(lights.at(x, 0, 0.08) for x in (-0.32, -0.17, -0.02))) & box(2, 2, 2).at(z=0)
    bell = arched(0.08, 0.12, 1.0).at(0.24, 0, 0.4) | arched(0.08, 0.12, 1.0).rz(90).at(0.24, 0, 0.4)
    rose = disc_x(0.045, 0.06).at(front, 0, 0.29)
    blue = rgb("4d6fa3")
    return [
        Part("walls", nave, rgb("efe6d4"), "main", paints=(Paint("windows", sides, blue),)),
        Part("tower", steeple, rgb("f4ecdc"), "main", paints=(Paint("windows", bell | rose, blue),)),
        Part("roof", roof, rgb("7a4f46"), "trim", "bricks", rgb("613c35")),
        Part("spire", spire, rgb("5d6f7d"), "trim"),
        Part("cross", cross, rgb("d9b34a")),
        Part("door", arched(0.1, 0.17, 0.05).at(front), rgb("7a4d2b")),
        Part(
            "base",
            box(0.68, width + 0.06, 0.04, 0.01).at(-0.1) | box(0.28, 0.28, 0.04, 0.01).at(0.24),
            rgb("97918a"),
        ),
    ]


def _pyramid(side: float, height: float) -> Shape:
    """A square pyramid on z = 0."""
    one = front_view([(-0.5 * side, 0.0), (0.5 * side, 0.0), (0.0, height)], 2.0 * side)
    return one & one.rz(90)


@noun("pyramid", kind="buildings", across=40.0, material="stone")
def pyramid(v: Variation) -> list[Part]:
    steps = 9
    height = v(0.68, 0.06)
    courses = union(
        *(
            box(1.0 - 0.9 * i / steps, 1.0 - 0.9 * i / steps, height / steps + 0.004, 0.008).at(
                z=height * i / steps
            )
            for i in range(steps)
        )
    )
    tip = _pyramid(0.16, 0.15).at(z=height - 0.012)
    gate = arched(0.1, 0.13, 0.1).at(0.48)
    return [
        Part("body", courses, rgb("dcbf86"), "main", "bricks", rgb("bd9c62")),
        Part("tip", tip, rgb("e9bb46"), "accent"),
        Part("door", gate, rgb("6b5334")),
        Part("base", box(1.08, 1.08, 0.03, 0.01), rgb("e8d3a3")),
    ]


@noun(
    "skyscraper", "office building", "apartment building", kind="buildings", across=120.0, material="concrete"
)
def skyscraper(v: Variation) -> list[Part]:
    tiers = [(0.3, 0.0, 0.5), (0.23, 0.48, 0.26), (0.15, 0.72, 0.15)]
    walls = union(*(box(s, s, h, 0.008).at(z=z) for s, z, h in tiers))
    ledges = union(*(box(s + 0.025, s + 0.025, 0.026, 0.006).at(z=z + h - 0.02) for s, z, h in tiers))
    row = union(*(box(2, 2, 0.026).at(z=0.06 + 0.045 * i) for i in range(17)))
    columns = union(*(box(2, 0.03, 2).at(0, y) for y in (-0.12, -0.075, -0.03, 0.03, 0.075, 0.12)))
    panes = row.within(columns | columns.rz(90))
    mast = capsule((0, 0, 0.85), (0, 0, 1.0), 0.016, 0.013)
    return [
        Part(
            "walls", walls, rgb("8fa0b0"), "main", paints=(Paint("windows", panes, rgb("f5e3a8"), "accent"),)
        ),
        Part("ledges", ledges, rgb("c8ced3")),
        Part("base", box(0.36, 0.36, 0.05, 0.01), rgb("6f7780")),
        Part("door", box(0.04, 0.09, 0.08, 0.006).at(0.16, 0, 0.03), rgb("3f4a56")),
        Part("mast", mast | sphere(0.022).at(z=1.0), rgb("c8403a")),
    ]


@noun("pagoda", "temple", kind="buildings", across=16.0, material="wood")
def pagoda(v: Variation) -> list[Part]:
    floors = [(0.42, 0.06), (0.33, 0.3), (0.25, 0.52)]
    height = v(0.16, 0.05)
    walls = union(*(box(s, s, height + 0.06).at(z=z) for s, z in floors))
    roofs = []
    for side, z in floors:
        eave = side + 0.24
        slope = _pyramid(eave, 0.3 * eave).cut(above(0.17 * eave), 0.0).at(z=z + height)
        horns = capsule((0.46 * eave, 0.46 * eave, 0.012), (0.54 * eave, 0.54 * eave, 0.06), 0.02, 0.016)
        roofs += [slope, four(horns).at(z=z + height)]
    top = cone(0.05, 0.02, 0.16, 0.01).at(z=0.76) | sphere(0.038).at(z=0.93)
    doors = union(*(box(2, 0.4 * s, 0.12).at(0, 0, z + 0.03) for s, z in floors))
    posts = union(*(four(cylinder(0.02, height + 0.05).at(0.5 * s, 0.5 * s, z)) for s, z in floors))
    return [
        Part(
            "walls",
            walls,
            rgb("c9463b"),
            "main",
            paints=(Paint("windows", doors & above(0.3), rgb("f3dfae")),),
        ),
        Part("roofs", union(*roofs), rgb("3f6e68"), "trim"),
        Part("posts", posts, rgb("8f2f2a"), "main"),
        Part("door", box(0.03, 0.12, 0.14, 0.006).at(0.21, 0, 0.05), rgb("6b3a24")),
        Part("base", box(0.56, 0.56, 0.07, 0.012) | box(0.16, 0.2, 0.035).at(0.3), rgb("a9a296")),
        Part("finial", top, rgb("e0b040"), "accent"),
    ]


@noun("well", "water well", "wishing well", kind="buildings", across=2.4, material="stone")
def water_well(v: Variation) -> list[Part]:
    ring = cylinder(0.32, 0.3, 0.02) - cylinder(0.24, 0.6).at(z=0.16)
    water = cylinder(0.26, 0.2)
    posts = box(0.05, 0.06, 0.62).at(0, 0.3, 0.1).mirrored(1)
    roof = union(_slab((0.32, 0.66), (0.0, 0.86), 0.62)).mirrored(1).rz(90)
    ends = gable(0.05, 0.52, 0.18).rz(90).at(0, 0.3, 0.69).mirrored(1)
    axle = capsule((0, -0.34, 0.55), (0, 0.4, 0.55), 0.03)
    crank = capsule((0, 0.4, 0.55), (0, 0.4, 0.45), 0.024) | capsule((0, 0.4, 0.45), (0, 0.47, 0.45), 0.024)
    rope = capsule((0, 0, 0.55), (0, 0, 0.36), 0.02)
    pail = cone(0.06, 0.08, 0.13, 0.01).at(z=0.25)
    return [
        Part("wall", ring, STONE, "main", "bricks", STONE_DARK),
        Part("water", water, rgb("4f94b5")),
        Part("posts", posts | ends, rgb("8d5d31")),
        Part("roof", roof, ROOF, "trim", "bricks", ROOF_DARK),
        Part("crank", axle | crank, rgb("6b4a2f")),
        Part("rope", rope, rgb("d8bd85")),
        Part("bucket", pail | capsule((0, 0, 0.15), (0, 0, 0.3), 0.03), rgb("a8703c"), "accent"),
    ]


@noun("birdhouse", "bird house", kind="buildings", across=0.4, material="wood")
def birdhouse(v: Variation) -> list[Part]:
    width, wall = v(0.44, 0.05), v(0.4, 0.05)
    body = box(0.4, width, wall) | gable(0.4, width, 0.26).at(z=wall)
    roof = union(_slab((0.5 * width + 0.07, wall - 0.06), (0.0, wall + 0.27), 0.56)).mirrored(1)
    hole = disc_x(0.085, 0.3).at(0.2, 0, 0.3)
    perch = capsule((0.15, 0, 0.14), (0.31, 0, 0.14), 0.026)
    heart = extrude(star(5, 0.06, 0.03), 0.05).at(z=-0.025).ry(90).rx(90).at(0.2, 0, wall + 0.08)
    return [
        Part(
            "walls",
            body - hole,
            rgb("7fb3b0"),
            "main",
            paints=(Paint("hole", hole.rounded(0.01), rgb("3c3430")),),
        ),
        Part("roof", roof, rgb("b5523f"), "trim"),
        Part("ring", torus(0.095, 0.022).rx(90).rz(90).at(0.2, 0, 0.3), rgb("f6ead0"), "accent"),
        Part("perch", perch, rgb("8d5d31")),
        Part("star", heart, rgb("f3cd56")),
        Part("base", box(0.48, width + 0.06, 0.045, 0.012), rgb("b98350")),
    ]
