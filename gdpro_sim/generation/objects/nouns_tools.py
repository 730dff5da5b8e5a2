"""Tools, kitchen things and instruments; most lie on the ground or stand upright on a small stand."""

from __future__ import annotations

import math
from dataclasses import replace

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
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
from gdpro_sim.generation.objects.shapes import (
    above,
    disc_x,
    front_view,
    helix,
    lumps,
    side_view,
    wave,
    wheel,
)

STEEL, STEEL_DARK, WOOD, WOOD_DARK = rgb("b9bfc5"), rgb("9299a0"), rgb("b98350"), rgb("96643a")


@noun("hammer", "mallet", kind="tools", across=0.32, material="steel")
def hammer(v: Variation) -> list[Part]:
    long = v(0.78, 0.04)
    grip = capsule((0, 0, 0.06), (0, 0, 0.34), 0.055, 0.045).stretched(x=0.85)
    shaft = capsule((0, 0, 0.3), (0, 0, long), 0.032)
    head = box(0.12, 0.2, 0.12, 0.03).at(0, 0.0, long - 0.03)
    face = wheel(0.075, 0.1).at(0, 0.17, long + 0.03) | wheel(0.05, 0.1).at(0, 0.11, long + 0.03)
    claw = curved_tube(
        [(0, -0.06, long + 0.03), (0, -0.2, long + 0.04), (0, -0.3, long - 0.04)], [0.055, 0.045, 0.024]
    )
    slit = box(0.035, 0.2, 0.5).at(0, -0.31, long - 0.25)
    rings = union(*(torus(0.048, 0.012).at(z=z) for z in (0.12, 0.18, 0.24)))
    return [
        Part("head", (head | face | claw) - slit, STEEL, "accent", "brushed", STEEL_DARK),
        Part("handle", shaft, WOOD, "main", "grain", WOOD_DARK),
        Part("grip", grip | rings, rgb("c8403a"), "main"),
    ]


@noun("wrench", "spanner", kind="tools", across=0.24, material="steel")
def wrench(v: Variation) -> list[Part]:
    neck = box(0.055, 0.085, 0.62, 0.02).at(z=0.16)
    groove = box(0.2, 0.035, 0.4, 0.015).at(z=0.27)
    ring = disc_x(0.115, 0.075, 0.015).at(z=0.12) - disc_x(0.06, 1.0).at(z=0.12)
    jaw = disc_x(v(0.155, 0.04), 0.08, 0.015).at(z=0.83)
    mouth = box(1.0, 0.13, 0.3, 0.02).at(0, 0, 0.83)
    upright = (neck | ring | jaw) - mouth
    flat = upright.ry(90).at(-0.45, 0, 0.04)
    paint = groove.ry(90).at(-0.45, 0, 0.04)
    return [
        Part(
            "body",
            flat,
            STEEL,
            "main",
            "brushed",
            STEEL_DARK,
            paints=(Paint("groove", paint, rgb("c8403a"), "accent"),),
        )
    ]


@noun("screwdriver", kind="tools", across=0.22, material="steel")
def screwdriver(v: Variation) -> list[Part]:
    handle = revolve(
        smooth_profile(
            [(0.05, 0.0), (0.085, 0.03), (v(0.1, 0.06), 0.12), (0.07, 0.3), (0.085, 0.38), (0.05, 0.42)]
        )
    )
    handle = handle.bumpy(0.008, wave(6, 0.0))
    cap = revolve(smooth_profile([(0.0, -0.03), (0.06, -0.02), (0.075, 0.03), (0.05, 0.06)]))
    shaft = cylinder(0.03, 0.46, 0.005).at(z=0.4)
    tip = box(0.075, 0.03, 0.16, 0.008).at(z=0.84)
    lay = 90.0
    z = 0.105
    return [
        Part("handle", handle.rx(lay).at(0, 0.48, z), rgb("e0862c"), "main"),
        Part("cap", cap.rx(lay).at(0, 0.48, z), rgb("34373b"), "accent"),
        Part("shaft", (shaft | cone(0.045, 0.03, 0.08).at(z=0.4) | tip).rx(lay).at(0, 0.48, z), STEEL),
    ]


@noun("spoon", "wooden spoon", "ladle", kind="tools", across=0.26, material="wood")
def spoon(v: Variation) -> list[Part]:
    bowl = ellipsoid(0.12, v(0.17, 0.05), 0.075).at(0, 0.33, 0.075) - ellipsoid(0.095, 0.14, 0.06).at(
        0, 0.33, 0.115
    )
    bowl = bowl.within(box(1, 1, 0.098).at(0, 0.3), 0.01)
    stem = curved_tube(
        [(0, 0.2, 0.06), (0, 0.05, 0.08), (0, -0.3, 0.055), (0, -0.48, 0.045)], [0.036, 0.03, 0.034, 0.042]
    )
    knob = sphere(0.045).at(0, -0.5, 0.045)
    band = box(1, 0.05, 1).at(0, -0.4, -0.3) | box(1, 0.02, 1).at(0, -0.34, -0.3)
    return [
        Part("bowl", bowl, rgb("c99a5f"), "main", "grain", rgb("ab7b42")),
        Part(
            "handle",
            stem | knob,
            rgb("c99a5f"),
            "main",
            "grain",
            rgb("ab7b42"),
            paints=(Paint("bands", band, rgb("b5473b"), "accent"),),
            blend=0.03,
        ),
    ]


@noun("fork", "dinner fork", kind="tools", across=0.2, material="steel")
def fork(v: Variation) -> list[Part]:
    head = box(0.19, 0.14, 0.045, 0.02).at(0, 0.18, 0.03)
    prongs = union(
        *(
            curved_tube([(x, 0.22, 0.052), (x, 0.36, 0.045), (x, v(0.48, 0.02), 0.075)], [0.022, 0.02, 0.016])
            for x in (-0.072, -0.024, 0.024, 0.072)
        )
    )
    neck = curved_tube([(0, 0.14, 0.05), (0, 0.02, 0.05), (0, -0.2, 0.04)], [0.05, 0.03, 0.034])
    handle = capsule((0, -0.18, 0.04), (0, -0.46, 0.04), 0.036, 0.05)
    return [
        Part("head", head | prongs, STEEL, "main"),
        Part("neck", neck, STEEL, "main", blend=0.03),
        Part("handle", handle, rgb("2f7f86"), "accent"),
    ]


@noun("ladder", "step ladder", "stepladder", kind="tools", across=1.8, material="wood")
def ladder(v: Variation) -> list[Part]:
    spread = v(0.24, 0.08)
    rail = capsule((spread, 0.24, 0.025), (0.03, 0.16, 0.96), 0.028).mirrored(1)
    back = capsule((-spread, 0.22, 0.025), (-0.02, 0.15, 0.95), 0.024).mirrored(1)
    steps = []
    for i in range(5):
        t = 0.16 + 0.17 * i
        x, y = spread + (0.03 - spread) * t, 0.24 - 0.08 * t
        steps.append(box(0.09, 2 * y, 0.036, 0.012).at(x - 0.015, 0, 0.025 + 0.93 * t - 0.018))
    bars = union(
        *(
            capsule(
                (-spread + spread * t, 0.22 - 0.07 * t, 0.96 * t),
                (-spread + spread * t, -0.22 + 0.07 * t, 0.96 * t),
                0.018,
            )
            for t in (0.2, 0.6)
        )
    )
    top = box(0.16, 0.36, 0.045, 0.015).at(0.01, 0, 0.95)
    return [
        Part("rails", rail | back, WOOD, "main", "grain", WOOD_DARK),
        Part("steps", union(*steps) | bars, rgb("cf9d63"), "main", "grain", rgb("ab7b42")),
        Part("top", top, rgb("c8463a"), "accent"),
    ]


@noun("shovel", "spade", "garden shovel", kind="tools", across=1.0, material="steel")
def shovel(v: Variation) -> list[Part]:
    blade = ellipsoid(0.03, v(0.13, 0.06), 0.19).at(0, 0, 0.19) | box(0.055, 0.22, 0.16, 0.024).at(0, 0, 0.2)
    socket = cone(0.045, 0.034, 0.16, 0.008).at(z=0.34)
    shaft = capsule((0, 0, 0.4), (0, 0, 0.86), 0.026)
    grip = tube(
        [(0, 0, 0.84), (0, 0.09, 0.9), (0, 0.09, 0.98), (0, -0.09, 0.98), (0, -0.09, 0.9), (0, 0, 0.84)],
        0.024,
    )
    lean = 14.0
    return [
        Part("blade", (blade | socket).ry(-lean), rgb("7f8a94"), "accent", "brushed", rgb("69737c")),
        Part("shaft", shaft.ry(-lean), WOOD, "main", "grain", WOOD_DARK),
        Part("handle", grip.ry(-lean), rgb("c8463a"), "main"),
        Part("ground", ellipsoid(0.2, 0.22, 0.09).within(above(0.0), 0.01).at(-0.03), rgb("6b4a33")),
    ]


@noun("axe", "hatchet", kind="tools", across=0.5, material="steel")
def axe(v: Variation) -> list[Part]:
    shaft = curved_tube(
        [(0, 0.03, 0.04), (0, -0.01, 0.25), (0, 0.02, 0.55), (0, 0.0, 0.96)], [0.05, 0.036, 0.034, 0.034]
    )
    reach = v(0.33, 0.06)
    head = front_view(
        [
            (-0.09, 0.8),
            (-0.09, 0.9),
            (0.06, 0.9),
            (reach - 0.03, 1.0),
            (reach, 0.86),
            (reach - 0.03, 0.68),
            (0.06, 0.8),
        ],
        0.075,
        0.008,
    )
    edge = sphere(0.5).at(0, reach - 0.57, 0.84)
    edge_paint = box(1, 1, 1).at(0, 0.5 + reach - 0.2, 0.4) - edge
    wrap = union(*(torus(0.046, 0.016).at(0, 0.01, z) for z in (0.12, 0.15, 0.18, 0.21)))
    return [
        Part("head", head, rgb("c8463a"), "accent", paints=(Paint("blade", edge_paint, rgb("d3d8dc")),)),
        Part("handle", shaft, WOOD, "main", "grain", WOOD_DARK),
        Part("wrap", wrap, rgb("3d3a3a")),
    ]


@noun("pencil", "crayon", kind="tools", across=0.18, material="wood")
def pencil(v: Variation) -> list[Part]:
    r = v(0.075, 0.06)
    hexagon = [(r * math.cos(math.pi * k / 3), r * math.sin(math.pi * k / 3)) for k in range(6)]
    shaft = extrude(hexagon, 0.62).at(z=0.18)
    wood = cone(r, 0.024, 0.2).at(z=0.78)
    lead = cone(0.034, 0.014, 0.08, 0.008).at(z=0.92)
    band = cylinder(r + 0.008, 0.08, 0.01).at(z=0.11)
    rubber = cylinder(r - 0.004, 0.13, 0.02)
    scallop = cone(1.2 * r, 0.03, 0.2).at(z=0.76)
    parts = [
        Part("body", shaft, rgb("f2b632"), "main"),
        Part("tip", wood & scallop, rgb("ecd0a0")),
        Part("lead", lead, rgb("3a3a3e"), "accent"),
        Part("band", band, rgb("b9bfc5")),
        Part("eraser", rubber, rgb("ec8fa0")),
    ]
    return [replace(part, shape=part.shape.rx(90).at(0, 0.5, 0.87 * r)) for part in parts]


@noun("paintbrush", "paint brush", "brush", kind="tools", across=0.24, material="wood")
def paintbrush(v: Variation) -> list[Part]:
    handle = box(0.08, 0.13, 0.4, 0.035).blend(box(0.085, 0.26, 0.12, 0.03).at(z=0.34), 0.12)
    hole = capsule((-1, 0, 0.07), (1, 0, 0.07), 0.026)
    ferrule = box(0.1, 0.31, 0.16, 0.012).at(z=0.44)
    lines = box(1, 1, 0.012).at(z=0.48) | box(1, 1, 0.012).at(z=0.54)
    bristle = box(0.09, v(0.3, 0.03), 0.36, 0.025).at(z=0.58)
    tint = above(0.0).bumpy(0.02, lumps(30.0, 1.0)).at(z=0.8)
    return [
        Part("handle", handle - hole, rgb("c8463a"), "main"),
        Part("ferrule", ferrule, STEEL, paints=(Paint("lines", lines, STEEL_DARK),)),
        Part("bristles", bristle, rgb("e9d3a0"), paints=(Paint("paint", tint, rgb("3f86b8"), "accent"),)),
    ]


@noun("broom", kind="tools", across=1.3, material="wood")
def broom(v: Variation) -> list[Part]:
    straw = (
        revolve([(0.0, 0.0), (0.19, 0.0), (v(0.13, 0.06), 0.22), (0.06, 0.34), (0.0, 0.34)])
        .rounded(0.012)
        .at(z=0.012)
    )
    straw = straw.bumpy(0.012, wave(17, 0.0)).stretched(x=0.6)
    ties = torus(0.125, 0.018).stretched(x=0.65).at(z=0.24) | torus(0.08, 0.018).stretched(x=0.75).at(z=0.31)
    return [
        Part("bristles", straw, rgb("e2bb62"), "accent", "flutes", rgb("c4973e")),
        Part("ties", ties, rgb("c8463a")),
        Part("handle", capsule((0, 0, 0.3), (0, 0, 1.0), 0.026), WOOD, "main", "grain", WOOD_DARK),
        Part("tip", capsule((0, 0, 0.93), (0, 0, 1.0), 0.032), rgb("c8463a")),
    ]


@noun("key", "skeleton key", kind="tools", across=0.08, material="copper")
def key(v: Variation) -> list[Part]:
    loop = union(
        *(
            torus(0.095, 0.042).at(0.13 * math.cos(a), 0.13 * math.sin(a))
            for a in (math.pi / 2, math.pi * 7 / 6, math.pi * 11 / 6)
        )
    )
    bow = loop.rz(90).at(0, -0.3, 0.05)
    shaft = capsule((0, -0.18, 0.05), (0, 0.48, 0.05), 0.044)
    rings = union(*(wheel(0.066, 0.035).at(0, y, 0.05) for y in (-0.12, -0.07, 0.24)))
    bits = box(0.19, 0.07, 0.06, 0.01).at(0.1, 0.44, 0.02) | box(v(0.15, 0.1), 0.06, 0.06, 0.01).at(
        0.08, 0.33, 0.02
    )
    return [
        Part("bow", bow | sphere(0.06).at(0, -0.3, 0.05), rgb("dcae49"), "main"),
        Part("shaft", shaft | bits, rgb("dcae49"), "main"),
        Part("collar", rings, rgb("b98a2c"), "accent"),
    ]


@noun("magnifying glass", "magnifier", "loupe", kind="tools", across=0.22, material="steel")
def magnifying_glass(v: Variation) -> list[Part]:
    radius = v(0.26, 0.05)
    rim = torus(radius, 0.042).ry(90).at(0, 0, 0.68)
    lens = ellipsoid(0.055, radius, radius).at(z=0.68)
    neck = capsule((0, 0, 0.36), (0, 0, 0.45), 0.036)
    handle = revolve(smooth_profile([(0.035, 0.1), (0.055, 0.14), (0.06, 0.26), (0.045, 0.38)]))
    glint = tube([(0.055, 0.11, 0.82), (0.055, 0.03, 0.86)], 0.026)
    base = cylinder(0.19, 0.06, 0.02) | cone(0.09, 0.05, 0.1, 0.01).at(z=0.04)
    return [
        Part("rim", rim, rgb("d9ab3f"), "accent"),
        Part("lens", lens, rgb("c5e3ea"), paints=(Paint("glint", glint, rgb("f7fcfd")),)),
        Part("handle", handle | neck, rgb("6b3a24"), "main"),
        Part("stand", base, rgb("d9ab3f"), "accent"),
    ]


@noun("light bulb", "lightbulb", "bulb", kind="tools", across=0.12, material="glass")
def light_bulb(v: Variation) -> list[Part]:
    bulb = revolve(
        smooth_profile(
            [(0.125, 0.3), (0.15, 0.38), (v(0.29, 0.04), 0.62), (0.24, 0.84), (0.1, 0.95), (0.0, 0.97)]
        )
    )
    thread = tube(helix(0.128, 0.12, 0.17, 3.0), 0.025)
    screw = cylinder(0.125, 0.21, 0.01).at(z=0.1)
    tip = cone(0.06, 0.12, 0.08, 0.01).at(z=0.03) | cylinder(0.075, 0.05, 0.015)
    glow = sphere(0.16).at(0.14, 0, 0.72)
    return [
        Part("bulb", bulb, rgb("fbe59a"), "main", paints=(Paint("glow", glow, rgb("fff6d0")),)),
        Part("screw", screw | thread, rgb("b9bfc5"), "accent"),
        Part("tip", tip, rgb("4a4d52")),
    ]


@noun("lantern", "camping lantern", "oil lamp", kind="tools", across=0.32, material="steel")
def lantern(v: Variation) -> list[Part]:
    base = cylinder(0.2, 0.06, 0.015) | cone(0.19, 0.14, 0.1, 0.01).at(z=0.05)
    glass = ellipsoid(v(0.17, 0.04), 0.17, 0.22).at(z=0.36).within(box(1, 1, 0.36).at(z=0.16), 0.01)
    cap = (
        cone(0.17, 0.08, 0.1, 0.01).at(z=0.5)
        | cylinder(0.07, 0.07, 0.012).at(z=0.58)
        | ellipsoid(0.11, 0.11, 0.03).at(z=0.66)
    )
    wires = (
        curved_tube([(0.165, 0, 0.1), (0.215, 0, 0.3), (0.2, 0, 0.42), (0.14, 0, 0.54)], 0.018).ring(4).rz(45)
    )
    ring = torus(0.2, 0.02).at(z=0.35)
    bail_ = curved_tube(
        [
            (0, 0.14, 0.54),
            (0, 0.19, 0.7),
            (0, 0.1, 0.86),
            (0, 0, 0.9),
            (0, -0.1, 0.86),
            (0, -0.19, 0.7),
            (0, -0.14, 0.54),
        ],
        0.02,
    )
    light = ellipsoid(0.3, 0.09, 0.13).at(0.1, 0, 0.32) | ellipsoid(0.09, 0.3, 0.13).at(0, 0.0, 0.32)
    return [
        Part("base", base, rgb("3f6f66"), "main"),
        Part("glass", glass, rgb("fbe7b0"), paints=(Paint("flame", light, rgb("f6b23c")),)),
        Part("top", cap, rgb("3f6f66"), "main"),
        Part("wires", wires | ring, rgb("2f4f4a"), "accent"),
        Part("handle", bail_, rgb("2f4f4a"), "accent"),
    ]


@noun("anvil", kind="tools", across=0.6, material="steel")
def anvil(v: Variation) -> list[Part]:
    base = side_view(
        [
            (-0.26, 0.0),
            (0.26, 0.0),
            (0.2, 0.1),
            (0.1, 0.16),
            (0.1, 0.26),
            (-0.1, 0.26),
            (-0.1, 0.16),
            (-0.2, 0.1),
        ],
        0.26,
        0.01,
    ).rz(90)
    top = box(0.26, 0.5, 0.15, 0.02).at(0, -0.06, 0.25)
    horn = capsule((0, 0.14, 0.33), (0, v(0.42, 0.04), 0.36), 0.075, 0.026)
    stump = cylinder(0.3, 0.2, 0.02).bumpy(0.012, wave(11, 0.0)).at(z=-0.19)
    return [
        Part("body", base | top, rgb("545a63"), "main", "brushed", rgb("464b53")),
        Part("horn", horn, rgb("545a63"), "main", blend=0.05),
        Part("stump", stump, rgb("9a6b40"), "accent", "grain", rgb("7a5029")),
    ]


@noun("traffic cone", "safety cone", "pylon", kind="tools", across=0.5, material="plastic")
def traffic_cone(v: Variation) -> list[Part]:
    body = cone(v(0.28, 0.04), 0.06, 0.86, 0.02).at(z=0.06)
    bands = box(2, 2, 0.14).at(z=0.32) | box(2, 2, 0.1).at(z=0.6)
    return [
        Part("body", body, rgb("ee7a2c"), "main", paints=(Paint("bands", bands, rgb("f6f2e8"), "accent"),)),
        Part("base", box(0.72, 0.72, 0.08, 0.03), rgb("e06a1f"), "main"),
    ]


@noun("mailbox", "letter box", "post box", "letterbox", kind="tools", across=1.1, material="steel")
def mailbox(v: Variation) -> list[Part]:
    long = v(0.42, 0.05)
    shell = box(long, 0.26, 0.16, 0.01).at(z=0.66) | disc_x(0.13, long).at(z=0.82)
    door = (box(0.03, 0.23, 0.14, 0.008).at(z=0.67) | disc_x(0.115, 0.03).at(z=0.815)).at(0.5 * long)
    knob = sphere(0.025).at(0.5 * long + 0.025, 0, 0.88)
    flag = box(0.035, 0.026, 0.2, 0.008).at(0.06, 0.145, 0.8) | box(0.12, 0.026, 0.08, 0.008).at(
        0.1, 0.145, 0.93
    )
    post = box(0.09, 0.09, 0.66, 0.012) | box(0.3, 0.08, 0.05, 0.01).at(z=0.62)
    ground = ellipsoid(0.2, 0.2, 0.07).within(above(0.0), 0.01)
    return [
        Part("box", shell, rgb("3f73a8"), "main"),
        Part("door", door, rgb("4f86bb"), "main"),
        Part("knob", knob, rgb("e6dfce")),
        Part("flag", flag, rgb("d5463a"), "accent"),
        Part("post", post, WOOD, "trim", "grain", WOOD_DARK),
        Part("ground", ground, rgb("7c9a5b")),
    ]


@noun("sword", "knight sword", kind="tools", across=0.9, material="steel")
def sword(v: Variation) -> list[Part]:
    blade = front_view([(-0.055, 0.2), (0.055, 0.2), (0.05, 0.72), (0.0, 0.86), (-0.05, 0.72)], 0.045, 0.006)
    ridge = box(1, 0.022, 0.5).at(0, 0, 0.2)
    guard = curved_tube(
        [(0, -0.15, 0.25), (0, -0.08, 0.2), (0, 0.08, 0.2), (0, 0.15, 0.25)], [0.034, 0.036, 0.036, 0.034]
    )
    grip = capsule((0, 0, 0.08), (0, 0, 0.2), 0.036)
    rings = union(*(torus(0.034, 0.012).at(z=z) for z in (0.09, 0.12, 0.15)))
    jewel = sphere(0.034).at(0.05, 0, 0.045)
    upright = [
        Part("blade", blade, rgb("c9d1d8"), "main", paints=(Paint("ridge", ridge, rgb("9fa9b2")),)),
        Part("guard", guard, rgb("dcae49"), "accent"),
        Part("grip", grip | rings, rgb("7a3b2c")),
        Part(
            "pommel",
            sphere(0.055).at(z=0.045),
            rgb("dcae49"),
            "accent",
            paints=(Paint("jewel", jewel, rgb("c8323f")),),
        ),
    ]
    stone = ellipsoid(0.2, 0.24, 0.22).at(z=0.08) | ellipsoid(0.16, 0.15, 0.12).at(0.1, 0.12, 0.06)
    turned = [
        replace(
            part,
            shape=part.shape.rx(180).at(z=0.96),
            paints=tuple(replace(paint, shape=paint.shape.rx(180).at(z=0.96)) for paint in part.paints),
        )
        for part in upright
    ]
    return [
        *turned,
        Part("stone", stone.within(above(0.0), 0.02), rgb("948f87"), "fixed", "mottled", rgb("76716a")),
    ]
