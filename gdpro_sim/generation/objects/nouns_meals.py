"""Sweets, bread and dishes."""

from __future__ import annotations

import math

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, color, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Shape,
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
from gdpro_sim.generation.objects.shapes import above, lumps, wave

SPRINKLES = tuple(color(name, 0.15) for name in ("yellow", "turquoise", "white", "lime", "coral"))


def dripping(shape: Shape, z: float, depth: float, count: int, phase: float) -> Shape:
    """The part of `shape` above a wavy line at about z: icing."""
    return shape.within(above(0.0).bumpy(depth, wave(count, phase)).at(z=z), 0.03)


@noun("donut", "doughnut", kind="meals and sweets", across=0.10, material="bread")
def donut(v: Variation) -> list[Part]:
    thick = v(0.2, 0.1)
    icing = dripping(torus(0.32, thick + 0.025).stretched(z=0.86), 0.02, 0.045, 7, v.uniform(0, 6.28))
    return [
        Part("dough", torus(0.32, thick).stretched(z=0.86), rgb("c98f4f")),
        Part("icing", icing, rgb("e78aa8"), "main", "dotted", None, (0.085, 0.02), SPRINKLES),
    ]


@noun("cake", "birthday cake", "layer cake", kind="meals and sweets", across=0.26, material="bread")
def cake(v: Variation) -> list[Part]:
    phase = v.uniform(0, 6.28)
    low, high = cylinder(0.42, 0.3, 0.04).at(z=0.06), cylinder(0.27, 0.26, 0.04).at(z=0.34)
    icing = dripping(cylinder(0.44, 0.3, 0.05).at(z=0.085), 0.3, 0.05, 9, phase) | dripping(
        cylinder(0.29, 0.26, 0.05).at(z=0.365), 0.54, 0.045, 7, phase
    )
    pearls = sphere(0.042).at(0.29, 0, 0.385).ring(14) | sphere(0.045).at(0.43, 0, 0.085).ring(18)
    sticks = cylinder(0.026, 0.17).at(0.13, 0, 0.6).ring(5)
    flames = ellipsoid(0.03, 0.03, 0.05).at(0.13, 0, 0.81).ring(5)
    berry = sphere(0.062).at(z=0.66)
    return [
        Part("plate", cylinder(0.52, 0.045, 0.02).at(z=0.02) | cylinder(0.3, 0.04, 0.015), rgb("dfe7ea")),
        Part("sponge", low | high, rgb("f0c98d"), "main"),
        Part("icing", icing, rgb("f7eee4"), "accent"),
        Part("pearls", pearls, rgb("e58aa6")),
        Part("candles", sticks, rgb("6fb3c9")),
        Part("flames", flames, rgb("f6a93b")),
        Part("cherry", berry, rgb("c42f3a")),
    ]


@noun("cupcake", "muffin", kind="meals and sweets", across=0.09, material="bread")
def cupcake(v: Variation) -> list[Part]:
    wrapper = cone(0.26, 0.36, 0.4, 0.02).bumpy(0.012, wave(22, 0.0))
    swirl = []
    for z, radius in ((0.44, 0.3), (0.56, 0.235), (0.67, 0.16)):
        swirl.append(torus(radius, 0.105).at(z=z))
    body = ellipsoid(0.32, 0.32, 0.25).at(z=0.47)
    tip = cone(0.13, 0.03, 0.2, 0.025).at(z=0.7)
    cream = blended(0.05, body, *swirl, tip).bumpy(0.012, wave(9, 0.0))
    return [
        Part("wrapper", wrapper, rgb("6fb0c0"), "accent", "flutes", rgb("5595a6")),
        Part("cream", cream, rgb("f2b3c4"), "main", "dotted", None, (0.12, 0.02), SPRINKLES),
        Part("cherry", sphere(v(0.1, 0.06)).at(z=0.93), rgb("c42f3a")),
        Part("stem", curved_tube([(0, 0, 1.0), (0.01, 0, 1.08), (0.07, 0, 1.14)], 0.022), rgb("6d8a3d")),
    ]


@noun(
    "ice cream cone", "ice cream", "icecream", "gelato", kind="meals and sweets", across=0.18, material="ice"
)
def ice_cream_cone(v: Variation) -> list[Part]:
    biscuit = cone(0.035, 0.2, 0.58, 0.02)
    rim = cone(0.185, 0.215, 0.09, 0.02).at(z=0.52)
    scoop = v(0.235, 0.05)
    one = (sphere(scoop).bumpy(0.012, lumps(16.0, v.uniform(0, 9)))).at(z=0.72)
    skirt = torus(0.19, 0.055).bumpy(0.02, wave(7, v.uniform(0, 6))).at(z=0.62)
    two = sphere(0.8 * scoop).bumpy(0.012, lumps(16.0, v.uniform(0, 9))).at(0.01, 0.01, 0.97)
    skirt_two = torus(0.135, 0.048).bumpy(0.018, wave(6, v.uniform(0, 6))).at(0, 0, 0.89)
    wafer = capsule((0.0, 0.08, 1.0), (0.02, 0.19, 1.24), 0.03)
    base = cylinder(0.1, 0.045, 0.015)
    return [
        Part("cone", biscuit | rim | base, rgb("d9a25a"), "fixed", "diamonds", rgb("b57a36")),
        Part("scoop", one.blend(skirt, 0.04), rgb("f2a7b5"), "main"),
        Part("top scoop", two.blend(skirt_two, 0.04), rgb("f3e4bf"), "accent"),
        Part("wafer", wafer, rgb("b87a3e")),
        Part("cherry", sphere(0.065).at(0.0, -0.03, 0.97 + 0.8 * scoop + 0.03), rgb("c42f3a")),
    ]


@noun("cookie", "biscuit", "chocolate chip cookie", kind="meals and sweets", across=0.08, material="bread")
def cookie(v: Variation) -> list[Part]:
    body = cylinder(0.48, 0.15, 0.07).bumpy(0.012, wave(5, v.uniform(0, 6)))
    chips = []
    for i in range(11):
        angle, radius = 2.4 * i + v.uniform(0, 0.5), 0.12 * math.sqrt(i) + 0.02
        chips.append(
            ellipsoid(0.06, 0.05, 0.045)
            .rz(50.0 * i)
            .at(radius * math.cos(angle), radius * math.sin(angle), 0.15)
        )
    return [
        Part("dough", body, rgb("cf9a57"), "main", "mottled", rgb("bb8444")),
        Part("chips", union(*chips), rgb("4f2f20"), "accent"),
    ]


@noun("bread", "bread loaf", "loaf", "loaf of bread", kind="meals and sweets", across=0.30, material="bread")
def bread(v: Variation) -> list[Part]:
    height = v(0.36, 0.05)
    body = blended(0.08, ellipsoid(0.24, 0.5, 0.22).at(z=0.24), ellipsoid(0.26, 0.44, height - 0.2).at(z=0.2))
    body = body.within(above(0.03), 0.04)
    cuts = [ellipsoid(0.24, 0.035, 0.1).rz(28).at(0, y, height - 0.01) for y in (-0.27, -0.09, 0.09, 0.27)]
    slashes = union(*cuts)
    loaf = body.cut(slashes, 0.03)
    return [
        Part(
            "crust",
            loaf,
            rgb("b9743a"),
            "main",
            "mottled",
            rgb("a05f2a"),
            paints=(Paint("crumb", slashes.rounded(0.012), rgb("f0d8a6")),),
        ),
    ]


@noun("cheese", "cheese wedge", "wedge of cheese", kind="meals and sweets", across=0.16, material="cheese")
def cheese(v: Variation) -> list[Part]:
    height = v(0.36, 0.06)
    wedge = extrude([(-0.42, -0.42), (0.42, 0.0), (-0.42, 0.42)], height, 0.02)
    wedge = (wedge & cylinder(0.86, 1.0).at(0.42)).rz(-60)
    holes = union(
        sphere(0.1).at(0.0, -0.21, 0.25),
        sphere(0.07).at(-0.2, -0.31, 0.14),
        sphere(0.055).at(0.2, -0.1, 0.12),
        sphere(0.085).at(-0.16, 0.0, height),
        sphere(0.06).at(0.1, 0.06, height),
        sphere(0.05).at(-0.05, -0.26, 0.06),
        sphere(0.075).at(-0.1, 0.22, 0.2),
        sphere(0.055).at(-0.3, 0.2, height),
        sphere(0.08).at(-0.42, 0.05, 0.2),
    ).rz(-60)
    rind = cylinder(1.0, 1.0).at(0.42, 0, -0.2) - cylinder(0.83, 2.0).at(0.42, 0, -0.5)
    return [
        Part(
            "body",
            wedge - holes,
            rgb("f2c044"),
            "main",
            paints=(
                Paint("holes", holes.rounded(0.006), rgb("dfa52f")),
                Paint("rind", rind.rz(-60), rgb("d98f2e"), "accent"),
            ),
        ),
    ]


@noun("pizza", "pizza slice", "slice of pizza", kind="meals and sweets", across=0.22, material="bread")
def pizza(v: Variation) -> list[Part]:
    base = extrude([(-0.42, -0.3), (0.5, 0.0), (-0.42, 0.3)], 0.07, 0.02)
    topping = extrude([(-0.4, -0.27), (0.44, 0.0), (-0.4, 0.27)], 0.09, 0.03)
    crust = capsule((-0.44, -0.31, 0.07), (-0.44, 0.31, 0.07), 0.075)
    drips = union(
        capsule((0.1, -0.13, 0.075), (0.1, -0.155, 0.03), 0.035),
        capsule((-0.15, 0.22, 0.075), (-0.15, 0.245, 0.03), 0.034),
    )
    salami = union(
        *(
            cylinder(0.085, 0.045, 0.018).at(x, y, 0.085)
            for x, y in ((-0.22, -0.11), (-0.2, 0.13), (0.06, 0.02))
        )
    )
    herbs = union(
        *(
            ellipsoid(0.06, 0.03, 0.022).rz(a).at(x, y, 0.1)
            for x, y, a in ((-0.05, -0.1, 30), (0.24, 0.01, 80), (-0.06, 0.13, -40))
        )
    )
    return [
        Part("crust", base | crust, rgb("d39a50"), "fixed", "mottled", rgb("bd7f38")),
        Part("cheese", topping | drips, rgb("f4c64f"), "main"),
        Part("salami", salami, rgb("b8402f"), "accent"),
        Part("herbs", herbs, rgb("4f8f3f")),
    ]


@noun("burger", "hamburger", "cheeseburger", kind="meals and sweets", across=0.13, material="bread")
def burger(v: Variation) -> list[Part]:
    top = ellipsoid(0.47, 0.47, v(0.3, 0.06)).within(above(0.0), 0.06).at(z=0.46)
    salad = cylinder(0.47, 0.07, 0.03).bumpy(0.035, wave(11, v.uniform(0, 6))).at(z=0.38)
    slice_ = box(0.84, 0.84, 0.055, 0.02).rz(25).at(z=0.33)
    return [
        Part("bun", cylinder(0.45, 0.17, 0.06), rgb("d9994c"), "main"),
        Part(
            "patty", cylinder(0.465, 0.17, 0.07).at(z=0.16), rgb("6d4127"), "fixed", "mottled", rgb("57321d")
        ),
        Part("cheese", slice_, rgb("f6b93b")),
        Part("tomato", cylinder(0.43, 0.06, 0.025).at(z=0.355), rgb("d2402f")),
        Part("lettuce", salad, rgb("7fb84a")),
        Part("top bun", top, rgb("d9994c"), "main", "dotted", rgb("f7ead0"), (0.14, 0.024)),
    ]


@noun("hot dog", "hotdog", kind="meals and sweets", across=0.18, material="bread")
def hot_dog(v: Variation) -> list[Part]:
    half = v(0.36, 0.04)
    bun = capsule((0.09, -half, 0.14), (0.09, half, 0.14), 0.12).mirrored(0).within(above(0.02), 0.03)
    sausage = capsule((0, -half - 0.07, 0.22), (0, half + 0.07, 0.22), 0.085)
    line = [
        (0.045 * math.sin(2.0 * math.pi * 4 * t), (2 * t - 1) * (half - 0.02), 0.305)
        for t in (i / 48 for i in range(49))
    ]
    return [
        Part("bun", bun, rgb("d9994c"), "main"),
        Part("sausage", sausage, rgb("b4512f"), "accent"),
        Part("mustard", tube(line, 0.024), rgb("f3c531")),
    ]


@noun("pie", "apple pie", kind="meals and sweets", across=0.26, material="bread")
def pie(v: Variation) -> list[Part]:
    tin = cone(0.38, 0.47, 0.16) - cone(0.33, 0.43, 0.2).at(z=0.05)
    filling = ellipsoid(0.44, 0.44, 0.12).at(z=0.11).within(above(0.04), 0.0)
    bars = union(
        *(box(0.07, 0.9, 0.4).at(x) for x in (-0.28, -0.1, 0.1, 0.28)),
        *(box(0.9, 0.07, 0.4).at(0, y) for y in (-0.28, -0.1, 0.1, 0.28)),
    )
    lattice = ellipsoid(0.45, 0.45, 0.155).at(z=0.11).within(bars, 0.02) & above(0.1)
    edge = torus(0.45, 0.05).bumpy(0.016, wave(20, 0.0)).at(z=0.17)
    return [
        Part("tin", tin, rgb("9aa3a8"), "fixed"),
        Part("filling", filling, rgb("b8402f"), "accent"),
        Part("lattice", lattice, rgb("d9a25a"), "main"),
        Part("crust", edge, rgb("cf9348"), "main"),
    ]


@noun("egg", "easter egg", "boiled egg", kind="meals and sweets", across=0.09, material="ceramic")
def egg(v: Variation) -> list[Part]:
    wide = v(0.3, 0.05)
    shell = revolve(
        smooth_profile([(0.0, 0.0), (0.14, 0.04), (wide, 0.32), (0.25, 0.6), (0.12, 0.78), (0.0, 0.83)])
    ).at(z=0.2)
    cup = revolve(
        smooth_profile(
            [(0.2, 0.0), (0.19, 0.035), (0.09, 0.1), (0.1, 0.15), (0.24, 0.24), (0.3, 0.38), (0.27, 0.41)]
        )
    )
    band = revolve([(0.0, 0.55), (0.5, 0.55), (0.5, 0.74), (0.0, 0.74)])
    return [
        Part("shell", shell, rgb("8fc3c0"), "main", paints=(Paint("band", band, rgb("f6e7b8"), "accent"),)),
        Part("egg cup", cup, rgb("e6a04f"), "trim"),
    ]


@noun("lollipop", "candy", "sucker", kind="meals and sweets", across=0.18, material="plastic")
def lollipop(v: Variation) -> list[Part]:
    disc = cylinder(0.3, 0.13, 0.06).at(z=-0.065).ry(90).at(z=0.68)
    loops = v(2.5, 0.05)
    line = []
    for i in range(64):
        t = i / 63
        angle, radius = 2 * math.pi * loops * t, 0.02 + 0.25 * t
        line.append((0.04, radius * math.cos(angle), 0.68 + radius * math.sin(angle)))
    swirl = tube(line, 0.045)
    back = swirl.mirrored(0)
    stick = capsule((0, 0, 0.05), (0, 0, 0.5), 0.034)
    return [
        Part("candy", disc, rgb("e4546c"), "main", paints=(Paint("swirl", back, rgb("fbeee0"), "accent"),)),
        Part("stick", stick, rgb("f3ecdd")),
        Part("stand", cylinder(0.2, 0.06, 0.02), rgb("7cc0bd")),
    ]


@noun("sushi", "maki", "nigiri", kind="meals and sweets", across=0.06, material="bread")
def sushi(v: Variation) -> list[Part]:
    rice = box(0.5, 0.86, 0.34, 0.15).bumpy(0.008, lumps(16.0, v.uniform(0, 9)))
    fish = box(0.56, 0.96, 0.17, 0.08).bumpy(0.02, wave(2, 0.0)).at(z=0.29)
    band = box(0.62, 0.18, 0.5, 0.03).at(z=-0.004) & box(2, 2, 2).at(z=0.0)
    stripes = union(*(box(2, 0.045, 2).rz(24).at(0, y) for y in (-0.4, -0.24, 0.24, 0.4)))
    return [
        Part("rice", rice, rgb("f6f2e6"), "fixed", "mottled", rgb("e8e2d2")),
        Part("fish", fish, rgb("f08a55"), "main", paints=(Paint("lines", stripes, rgb("f9c9a4")),)),
        Part("seaweed", band, rgb("2f4436"), "accent"),
    ]


@noun("pretzel", kind="meals and sweets", across=0.16, material="bread")
def pretzel(v: Variation) -> list[Part]:
    thick = v(0.075, 0.08)
    half = [
        (0.0, 0.0, 0.18),
        (0.0, 0.13, 0.32),
        (0.0, 0.27, 0.5),
        (0.0, 0.4, 0.62),
        (0.0, 0.38, 0.83),
        (0.0, 0.2, 0.88),
        (0.0, 0.08, 0.72),
        (0.0, -0.05, 0.45),
        (0.02, -0.2, 0.2),
        (0.02, -0.3, 0.1),
    ]
    dough = curved_tube(half, [thick + 0.01] * 9 + [0.6 * thick], per_span=4)
    other = curved_tube(
        [(x + 0.02, -y, z) for x, y, z in half], [thick + 0.01] * 9 + [0.6 * thick], per_span=4
    )
    both = (dough | other).ry(-90).at(x=0.5, z=thick)
    return [Part("dough", both, rgb("a9662f"), "main", "dotted", rgb("fbf6e9"), (0.09, 0.018))]


@noun("chocolate bar", "bar of chocolate", kind="meals and sweets", across=0.16, material="chocolate")
def chocolate_bar(v: Variation) -> list[Part]:
    slab = box(0.48, 0.9, 0.08, 0.02)
    tile = box(0.2, 0.15, 0.13, 0.03)
    rows = tile.copies([(x, y, 0.0) for x in (-0.115, 0.115) for y in (-0.36, -0.18, 0.0, 0.18, 0.36)])
    foil = box(0.52, 0.36, 0.16, 0.025).at(0, -0.29)
    wrap = box(0.54, 0.28, 0.18, 0.025).at(0, -0.36)
    return [
        Part("bar", slab | rows, rgb("5a3420"), "main"),
        Part("foil", foil.at(z=0.0), rgb("d9d9dc")),
        Part("wrapper", wrap, rgb("b23a48"), "accent"),
    ]
