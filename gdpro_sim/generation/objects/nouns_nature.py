"""Trees, flowers and other things that grow, fall or lie about outdoors."""

from __future__ import annotations

import math

from gdpro_sim.generation.objects.nouns_food import leaf
from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Shape,
    Vec,
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
from gdpro_sim.generation.objects.shapes import above, lumps, star, wave

BARK, BARK_DARK = rgb("8a5f3a"), rgb("6d4829")
SOIL, CLAY, CLAY_DARK = rgb("5b4130"), rgb("c4744c"), rgb("a95d3a")


def flower_pot(radius: float, height: float) -> list[Part]:
    """A clay pot with soil, on z = 0."""
    body = cone(0.72 * radius, 0.95 * radius, height, 0.01)
    rim = cylinder(1.08 * radius, 0.3 * height, 0.015).at(z=0.74 * height)
    soil = cylinder(0.9 * radius, 0.05, 0.02).at(z=1.04 * height - 0.03)
    return [
        Part("pot", body | rim, CLAY, "trim", "mottled", CLAY_DARK),
        Part("soil", soil, SOIL),
    ]


@noun("tree", "oak tree", "apple tree", kind="nature", across=6.0, material="wood")
def tree(v: Variation) -> list[Part]:
    trunk = curved_tube([(0, 0, 0.02), (0.01, 0, 0.2), (-0.01, 0.01, 0.45)], [0.09, 0.065, 0.06])
    roots = capsule((0.05, 0, 0.06), (0.13, 0, 0.02), 0.045, 0.028).ring(5)
    boughs = capsule((0, 0, 0.36), (0, 0.18, 0.52), 0.042) | capsule((0, 0, 0.34), (0.06, -0.17, 0.5), 0.04)
    crown = blended(
        0.07,
        sphere(v(0.25, 0.06)).at(0, 0, 0.72),
        sphere(v(0.19, 0.08)).at(0.02, 0.21, 0.6),
        sphere(v(0.19, 0.08)).at(0.05, -0.2, 0.58),
        sphere(v(0.18, 0.08)).at(0.16, 0.03, 0.62),
        sphere(v(0.18, 0.08)).at(-0.16, 0.0, 0.62),
        sphere(v(0.15, 0.08)).at(0.0, 0.05, 0.88),
    ).bumpy(0.016, lumps(24.0, v.uniform(0, 9)))
    wood = trunk.blend(roots, 0.04).blend(boughs, 0.03).within(above(0.0), 0.01)
    return [
        Part("trunk", wood, BARK, "accent", "grain", BARK_DARK),
        Part("leaves", crown, rgb("5f9e4a"), "main", "mottled", rgb("457f38")),
    ]


@noun(
    "pine tree",
    "pine",
    "fir",
    "fir tree",
    "christmas tree",
    "spruce",
    kind="nature",
    across=6.0,
    material="wood",
)
def pine_tree(v: Variation) -> list[Part]:
    layers = []
    for i, (z, radius) in enumerate(((0.2, 0.34), (0.4, 0.27), (0.58, 0.2), (0.74, 0.14))):
        skirt = (
            cone(v(radius, 0.05), 0.03, 0.62 * radius + 0.12)
            .bumpy(0.022, wave(9 - i, 1.3 * i))
            .rounded(0.012)
        )
        layers.append(skirt.at(z=z))
    trunk = cone(0.075, 0.05, 0.3, 0.01)
    return [
        Part("trunk", trunk, BARK, "accent", "grain", BARK_DARK),
        Part("leaves", union(*layers), rgb("3f7d52"), "main", "mottled", rgb("2d6040")),
        Part(
            "star",
            extrude(star(5, 0.085, 0.036), 0.05).at(z=-0.025).ry(90).rx(90).at(0, 0, 0.99),
            rgb("f3c53e"),
        ),
    ]


@noun("palm tree", "palm", "coconut tree", kind="nature", across=6.0, material="wood")
def palm_tree(v: Variation) -> list[Part]:
    bend = v(0.14, 0.3)
    line = [(0.0, -0.12, 0.03), (0.0, -0.1, 0.25), (0.0, -0.02, 0.5), (0.0, bend - 0.02, 0.74)]
    trunk = curved_tube(line, [0.065, 0.05, 0.042, 0.04])
    rings = union(
        *(
            torus(0.056 - 0.02 * t, 0.014).at(0, -0.12 + (bend + 0.1) * t**1.7, 0.08 + 0.6 * t)
            for t in (0.0, 0.17, 0.33, 0.5, 0.66, 0.83)
        )
    )
    fronds = []
    count = 7
    for i in range(count):
        lift = 0.09 if i % 2 else 0.15
        fronds.append(
            curved_tube(
                [(0.0, 0, 0.0), (0.14, 0, lift), (0.3, 0, lift - 0.04), (0.42, 0, -0.12)],
                [0.03, 0.055, 0.05, 0.02],
            )
            .stretched(z=0.8)
            .rz(360.0 * i / count + v.uniform(-8, 8))
        )
    crown = union(*fronds).at(0, bend - 0.02, 0.76)
    nuts = sphere(0.052).at(0.06).ring(3).rz(30).at(0, bend - 0.02, 0.71)
    island = ellipsoid(0.3, 0.34, 0.07).within(above(0.0), 0.01)
    return [
        Part("trunk", trunk | rings, rgb("a37a4b"), "accent"),
        Part("leaves", crown, rgb("5aa14e"), "main"),
        Part("coconuts", nuts, rgb("6b4429")),
        Part("island", island, rgb("ecd9a4")),
    ]


@noun("cactus", "cacti", kind="nature", across=0.35, material="plant")
def cactus(v: Variation) -> list[Part]:
    high = v(0.62, 0.06)
    stem = capsule((0, 0, 0.2), (0, 0, 0.24 + high), 0.135)
    right = curved_tube([(0, 0.08, 0.42), (0, 0.25, 0.43), (0, 0.3, 0.52), (0, 0.3, v(0.66, 0.05))], 0.078)
    left = curved_tube(
        [(0, -0.08, 0.54), (0, -0.22, 0.55), (0, -0.27, 0.63), (0, -0.27, v(0.78, 0.04))], 0.07
    )
    body = blended(0.03, stem.bumpy(0.012, wave(10, 0.0)), right, left)
    petals = ellipsoid(0.07, 0.034, 0.026).ry(-35).at(0.05).ring(6)
    blossom = (petals | sphere(0.042)).at(0, 0, 0.385 + high)
    return [
        *flower_pot(0.24, 0.22),
        Part("body", body, rgb("5f9e5d"), "main", "dotted", rgb("e6edc4"), (0.085, 0.012)),
        Part("flower", blossom, rgb("ee7f9e"), "accent"),
    ]


@noun("flower", "daisy", "potted flower", kind="nature", across=0.3, material="plant")
def flower(v: Variation) -> list[Part]:
    high = v(0.72, 0.05)
    stem = curved_tube([(0, 0, 0.18), (0.01, 0.03, 0.42), (0.02, 0.0, high)], 0.03)
    leaves = leaf(0.27, 0.12, 0.026).ry(-38).rz(100).at(0, 0.02, 0.34) | leaf(0.25, 0.12, 0.026).ry(-44).rz(
        -80
    ).at(0, 0.02, 0.42)
    petals = ellipsoid(0.1, 0.075, 0.034).at(0.165).ring(9)
    head = petals.ry(58).at(0.04, 0, high + 0.02)
    center = ellipsoid(0.105, 0.105, 0.06).at(z=0.012).ry(58).at(0.04, 0, high + 0.02)
    return [
        *flower_pot(0.17, 0.2),
        Part("stem", stem, rgb("5d9a43")),
        Part("leaves", leaves, rgb("5d9a43")),
        Part("petals", head, rgb("f08aa6"), "main"),
        Part("center", center, rgb("f3c23d"), "accent", "dotted", rgb("c98a24"), (0.06, 0.012)),
    ]


@noun("sunflower", kind="nature", across=1.2, material="plant")
def sunflower(v: Variation) -> list[Part]:
    stem = curved_tube([(0, 0, 0.02), (0.0, 0.02, 0.4), (0.0, 0.0, 0.76)], [0.034, 0.03, 0.032])
    leaves = leaf(0.3, 0.19, 0.024).ry(-28).rz(95).at(0, 0.02, 0.3) | leaf(0.28, 0.18, 0.024).ry(-32).rz(
        -85
    ).at(0, 0.01, 0.42)
    ring = ellipsoid(0.1, 0.05, 0.028).at(0.2).ring(14) | ellipsoid(0.085, 0.045, 0.026).at(0.19).ring(14).rz(
        13
    ).at(z=-0.02)
    tilt = v.uniform(62, 74)
    place = (0.03, 0.0, 0.8)
    return [
        Part("stem", stem, rgb("5d9a43")),
        Part("leaves", leaves, rgb("5d9a43")),
        Part("petals", ring.ry(tilt).at(*place), rgb("f5c02f"), "main"),
        Part(
            "center",
            ellipsoid(0.14, 0.14, 0.055).ry(tilt).at(*place),
            rgb("5b3a22"),
            "accent",
            "dotted",
            rgb("8a5d33"),
            (0.045, 0.012),
        ),
        Part("ground", ellipsoid(0.17, 0.17, 0.07).within(above(0.0), 0.01), SOIL),
    ]


@noun("tulip", kind="nature", across=0.35, material="plant")
def tulip(v: Variation) -> list[Part]:
    stem = curved_tube([(0, 0, 0.16), (0, 0.015, 0.45), (0, 0, 0.7)], 0.028)
    blade = (
        curved_tube([(0.03, 0, 0.16), (0.12, 0, 0.36), (0.16, 0, 0.56)], [0.04, 0.052, 0.014]).ring(3).rz(40)
    )
    bud = revolve(
        smooth_profile([(0.0, 0.64), (0.1, 0.67), (v(0.155, 0.06), 0.78), (0.12, 0.92), (0.05, 0.96)])
    )
    petal = ellipsoid(0.06, 0.1, 0.175).ry(7).at(0.095, 0, 0.83).ring(3)
    inner = ellipsoid(0.055, 0.09, 0.17).ry(5).at(0.085, 0, 0.85).ring(3).rz(60)
    return [
        *flower_pot(0.16, 0.19),
        Part("stem", stem, rgb("5d9a43")),
        Part("leaves", blade, rgb("6aa452")),
        Part("petals", bud | petal, rgb("d8434f"), "main"),
        Part("inner petals", inner, rgb("e8606a"), "main"),
    ]


@noun("rock", "boulder", "pebble", kind="nature", across=0.5, material="stone")
def rock(v: Variation) -> list[Part]:
    body = ellipsoid(v(0.42), v(0.5), v(0.36))
    for _ in range(7):
        a, b = v.uniform(0, 360), v.uniform(-25, 60)
        body = body.within(box(4, 4, 4).at(z=-4 + v(0.34, 0.1)).ry(90 - b).rz(a), 0.05)
    body = body.bumpy(0.012, lumps(13.0, v.uniform(0, 9))).at(z=0.22).within(above(0.0), 0.02)
    small = (
        ellipsoid(0.15, 0.17, 0.12)
        .bumpy(0.012, lumps(13.0, v.uniform(0, 9)))
        .at(0.28, 0.27, 0.08)
        .within(above(0.0), 0.02)
    )
    moss = ellipsoid(0.24, 0.3, 0.2).bumpy(0.04, lumps(20.0, 1.0)).at(-0.05, -0.05, 0.56)
    return [
        Part(
            "body",
            body,
            rgb("948f87"),
            "main",
            "mottled",
            rgb("6f6b65"),
            paints=(Paint("moss", moss, rgb("7f9a55"), "accent"),),
        ),
        Part("pebble", small, rgb("a8a299"), "main", "mottled", rgb("837e77")),
    ]


@noun("mushroom", "toadstool", kind="nature", across=0.12, material="fruit")
def mushroom(v: Variation) -> list[Part]:
    width = v(0.46, 0.06)
    stalk = revolve(smooth_profile([(0.17, 0.0), (0.18, 0.05), (0.13, 0.25), (0.12, 0.5)]))
    ring = torus(0.145, 0.035).stretched(z=0.8).bumpy(0.012, wave(8, 0.0)).at(z=0.38)
    cap = revolve(
        smooth_profile(
            [(0.1, 0.5), (0.3, 0.47), (width, 0.5), (0.93 * width, 0.64), (0.25, 0.84), (0.0, 0.89)]
        )
    )
    gills = cone(0.3, 0.36, 0.08).at(z=0.44)
    baby = [
        capsule((0.12, 0.26, 0.03), (0.12, 0.28, 0.16), 0.055, 0.045),
        ellipsoid(0.14, 0.14, 0.1).at(0.12, 0.28, 0.2).within(above(0.17), 0.02),
    ]
    ground = ellipsoid(0.34, 0.42, 0.07).at(0.04, 0.06).within(above(0.0), 0.01)
    return [
        Part("stalk", stalk | baby[0], rgb("f2e8d2"), "accent"),
        Part("ring", ring, rgb("f8f1e0"), "accent"),
        Part("gills", gills, rgb("e8d8b8"), "fixed", "flutes", rgb("cdb98f")),
        Part("cap", cap, rgb("cc3b34"), "main", "dotted", rgb("faf3e4"), (0.19, 0.06)),
        Part("small cap", baby[1], rgb("cc3b34"), "main", "dotted", rgb("faf3e4"), (0.12, 0.03)),
        Part("ground", ground, rgb("7c9a52")),
    ]


@noun("snowman", kind="nature", across=1.6, material="snow")
def snowman(v: Variation) -> list[Part]:
    low, mid, top = v(0.26, 0.04), v(0.19, 0.04), v(0.14, 0.04)
    z1 = low - 0.03
    z2 = z1 + low + 0.55 * mid
    z3 = z2 + mid + 0.55 * top
    body = sphere(low).at(z=z1).within(above(0.0), 0.03) | sphere(mid).at(z=z2)
    coal = union(
        *(sphere(0.026).at(mid * math.cos(a) - 0.002, 0, z2 + mid * math.sin(a)) for a in (-0.35, 0.05, 0.45))
    )
    eyes = sphere(0.024).at(0.88 * top, 0.36 * top, z3 + 0.32 * top).mirrored(1)
    smile = union(
        *(
            sphere(0.015).at(0.86 * top, 0.1 * top * k, z3 - 0.42 * top + 0.022 * top * k * k)
            for k in (-4, -2, 0, 2, 4)
        )
    )
    nose = capsule((0.8 * top, 0, z3), (1.85 * top, 0, z3 - 0.01), 0.036, 0.013)
    scarf = torus(0.78 * top, 0.042).at(z=z3 - 0.82 * top)
    tail = capsule((0.7 * top, 0.06, z3 - 0.85 * top), (mid + 0.02, 0.1, z2 + 0.01), 0.036)
    brim = cylinder(1.05 * top, 0.035, 0.012).at(z=z3 + 0.74 * top)
    hat = cylinder(0.72 * top, 0.19, 0.015).at(z=z3 + 0.74 * top)
    band = cylinder(0.76 * top, 0.05, 0.01).at(z=z3 + 0.76 * top + 0.03)
    arm = curved_tube(
        [(0, mid - 0.03, z2 + 0.04), (0.02, mid + 0.12, z2 + 0.1), (0.03, mid + 0.24, z2 + 0.2)], 0.021
    )
    twig = capsule((0.025, mid + 0.15, z2 + 0.125), (0.03, mid + 0.25, z2 + 0.1), 0.018)
    snow, dark = rgb("f4f6f7"), rgb("2c2d31")
    return [
        Part("body", body, snow, "main"),
        Part("head", sphere(top).at(z=z3), snow, "main"),
        Part("buttons", coal | eyes | smile, dark),
        Part("nose", nose, rgb("ee8230")),
        Part("scarf", scarf | tail, rgb("c8403a"), "accent"),
        Part("hat", brim | hat, rgb("34363c")),
        Part("hat band", band, rgb("c8403a"), "accent"),
        Part("arms", (arm | twig).mirrored(1), rgb("7a5433")),
    ]


@noun("seashell", "shell", "conch", kind="nature", across=0.12, material="ceramic")
def seashell(v: Variation) -> list[Part]:
    pitch, growth = v(0.1, 0.05), 2.6
    points, radii = [], []
    for i in range(86):
        t = i / 85
        size = math.exp(-growth * t)
        angle = 2 * math.pi * 4.6 * t
        points.append(
            (0.2 * size * math.cos(angle), 0.2 * size * math.sin(angle), (4.6 * pitch + 0.42) * (1 - size))
        )
        radii.append(max(0.2 * size, 0.016))
    spire = tube(points, radii)
    core = cone(0.2, 0.02, 0.8).at(z=0.0)
    canal = revolve(smooth_profile([(0.0, -0.46), (0.05, -0.44), (0.14, -0.25), (0.2, -0.05), (0.12, 0.1)]))
    flare = ellipsoid(0.1, 0.22, 0.3).ry(12).at(0.27, 0.0, -0.08)
    mouth = ellipsoid(0.12, 0.12, 0.24).ry(14).at(0.34, 0.03, -0.08)
    whole = blended(0.04, spire, core, canal, flare).cut(mouth, 0.03)
    paint = Paint("mouth", mouth.rounded(0.02), rgb("f3b7a4"), "accent")
    turned = Paint(paint.name, paint.shape.rx(68), paint.color, paint.role)
    return [Part("shell", whole.rx(68), rgb("efc9a2"), "main", "speckled", rgb("b9744c"), paints=(turned,))]


@noun("starfish", "sea star", kind="nature", across=0.16, material="rubber")
def starfish(v: Variation) -> list[Part]:
    reach = v(0.46, 0.05)
    arm = curved_tube([(0.0, 0, 0.07), (0.22, 0, 0.075), (reach, 0, v(0.07, 0.2))], [0.16, 0.11, 0.05])
    body = blended(0.06, arm.ring(5), ellipsoid(0.2, 0.2, 0.14).at(z=0.06)).within(above(0.0), 0.02)
    ridge = sphere(0.026)
    beads = union(
        *(
            ridge.at(r, 0, z)
            for r, z in ((0.12, 0.185), (0.2, 0.178), (0.28, 0.158), (0.35, 0.135), (0.41, 0.12))
        )
    )
    eye = sphere(0.036).at(0.1, 0.06, 0.2).mirrored(1)
    return [
        Part("body", body, rgb("ea7f4f"), "main", "dotted", rgb("f8c99b"), (0.1, 0.018)),
        Part("beads", beads.ring(5), rgb("f8c99b"), "accent"),
        Part("eyes", eye, rgb("34292a")),
    ]


def _prism(radius: float, height: float) -> Shape:
    """A six-sided crystal with a pointed end, on z = 0."""
    hexagon = [(radius * math.cos(math.pi * k / 3), radius * math.sin(math.pi * k / 3)) for k in range(6)]
    column = extrude(hexagon, height)
    roof = box(4, 4, 4).at(z=-4).ry(54).at(0.87 * radius, 0, height - radius).rz(30)
    for k in range(6):
        column = column & roof.rz(60.0 * k)
    return column


@noun("crystal", "gem", "gemstone", "quartz", kind="nature", across=0.14, material="glass")
def crystal(v: Variation) -> list[Part]:
    tall = _prism(0.17, v(0.9, 0.05))
    places: list[tuple[float, float, float, float]] = [
        (0.12, 0.62, 24, 10),
        (0.1, 0.52, 30, 95),
        (0.11, 0.58, 26, 170),
        (0.09, 0.45, 36, 235),
        (0.1, 0.55, 28, 300),
    ]
    around = union(*(_prism(r, v(h, 0.08)).ry(lean).rz(turn) for r, h, lean, turn in places))
    base = ellipsoid(0.36, 0.36, 0.12).bumpy(0.02, lumps(16.0, v.uniform(0, 9))).within(above(0.0), 0.02)
    return [
        Part(
            "crystals",
            (tall | around).within(above(0.0), 0.0),
            rgb("a78bd6"),
            "main",
            "gradient",
            rgb("dccdf2"),
        ),
        Part("base", base, rgb("77727a"), "accent", "mottled", rgb("5b575e")),
    ]


@noun("cloud", kind="nature", across=0.3, material="plush")
def cloud(v: Variation) -> list[Part]:
    puffs: list[tuple[Vec, float]] = [
        ((0.0, 0.0, 0.25), 0.25),
        ((0.02, 0.26, 0.2), 0.19),
        ((0.02, -0.25, 0.2), 0.2),
        ((0.08, 0.1, 0.17), 0.19),
        ((0.0, 0.4, 0.13), 0.13),
        ((0.0, -0.39, 0.14), 0.14),
        ((-0.08, -0.1, 0.17), 0.2),
    ]
    body = blended(0.05, *(sphere(v(r, 0.07)).at(*p) for p, r in puffs)).within(above(0.03), 0.04)
    eyes = sphere(0.026).at(0.245, 0.07, 0.21).mirrored(1)
    cheeks = sphere(0.05).at(0.24, 0.13, 0.16).mirrored(1)
    smile = tube([(0.25, 0.035 * k / 2, 0.165 + 0.012 * k * k / 4) for k in (-2, -1, 0, 1, 2)], 0.013)
    return [
        Part("body", body, rgb("eef3f8"), "main", paints=(Paint("cheeks", cheeks, rgb("f6b7bd")),)),
        Part("eyes", eyes, rgb("34363c")),
        Part("smile", smile, rgb("34363c")),
    ]


@noun("log", "tree stump", "stump", kind="nature", across=0.5, material="wood")
def log(v: Variation) -> list[Part]:
    radius = v(0.36, 0.05)
    body = cone(1.06 * radius, 0.97 * radius, 0.42, 0.02).bumpy(0.016, wave(13, v.uniform(0, 6)))
    roots = capsule((0.3, 0, 0.1), (0.48, 0, 0.03), 0.09, 0.045).ring(6).rz(v.uniform(0, 40))
    top = cylinder(0.86 * radius, 0.1).at(z=0.36)
    rings = union(*(torus(r * radius, 0.009).at(z=0.42) for r in (0.15, 0.32, 0.5, 0.68)))
    sprout = curved_tube([(0.1, 0.3, 0.3), (0.16, 0.4, 0.44), (0.16, 0.42, 0.52)], 0.026)
    leaves = leaf(0.17, 0.1, 0.024).ry(-20).rz(40).at(0.16, 0.42, 0.5) | leaf(0.17, 0.1, 0.024).ry(-20).rz(
        150
    ).at(0.16, 0.42, 0.51)
    face = top.rounded(0.03).within(above(0.405))
    bark = body.blend(roots, 0.05).within(above(0.0), 0.01)
    return [
        Part(
            "bark",
            bark,
            BARK,
            "main",
            "flutes",
            BARK_DARK,
            paints=(
                Paint("wood", face, rgb("e0bb85"), "accent"),
                Paint("rings", rings.rounded(0.002) & above(0.41), rgb("bb8d55")),
            ),
        ),
        Part("sprout", sprout, rgb("6d8a3d")),
        Part("leaves", leaves, rgb("6aa452")),
    ]
