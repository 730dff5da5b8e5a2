"""Animals, as toys: rounded, friendly, standing."""

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
    ellipsoid,
    sphere,
    torus,
    tube,
    union,
)
from gdpro_sim.generation.objects.shapes import above, below, disc_x, four

DARK, WHITE = rgb("2c2a2c"), rgb("fbf8ef")


def eyes(x: float, y: float, z: float, radius: float, color: tuple[float, float, float] = DARK) -> Part:
    """A pair of eyes with glints, at (x, +-y, z)."""
    glint = sphere(0.42 * radius).at(x + 0.75 * radius, y + 0.2 * radius, z + 0.55 * radius).mirrored(1)
    return Part(
        "eyes", sphere(radius).at(x, y, z).mirrored(1), color, paints=(Paint("glints", glint, WHITE),)
    )


def smile(x: float, z: float, width: float, depth: float, thick: float) -> Shape:
    """A curved mouth across Y."""
    return tube([(x, 0.5 * width * k, z + depth * k * k) for k in (-1.0, -0.5, 0.0, 0.5, 1.0)], thick)


@noun("penguin", kind="animals", across=0.3, material="plush")
def penguin(v: Variation) -> list[Part]:
    body = blended(0.12, ellipsoid(0.25, 0.28, 0.34).at(z=0.38), sphere(v(0.22, 0.05)).at(0.01, 0, 0.76))
    belly = ellipsoid(0.2, 0.21, 0.28).at(0.13, 0, 0.34)
    face = (sphere(0.13).at(0.16, 0.08, 0.76)).mirrored(1)
    wing = ellipsoid(0.1, 0.045, 0.22).rx(v.uniform(18, 30)).at(0.0, 0.31, 0.4).mirrored(1)
    beak = cone(0.06, 0.012, 0.13).rounded(0.012).ry(90).stretched(z=0.75).at(0.2, 0, 0.725)
    feet = ellipsoid(0.15, 0.1, 0.05).at(0.14, 0.12, 0.045).mirrored(1)
    tail = ellipsoid(0.12, 0.09, 0.05).ry(-20).at(-0.22, 0, 0.12)
    return [
        Part(
            "body",
            body,
            rgb("3a4757"),
            "main",
            paints=(Paint("belly", belly, WHITE, "accent"), Paint("face", face, WHITE, "accent")),
        ),
        Part("wings", wing, rgb("3a4757"), "main"),
        Part("tail", tail, rgb("3a4757"), "main"),
        Part("beak", beak, rgb("f09a2e")),
        Part("feet", feet, rgb("f09a2e")),
        eyes(0.2, 0.085, 0.8, 0.034),
        Part(
            "scarf",
            torus(0.205, 0.045).at(z=0.61) | capsule((0.2, 0.1, 0.6), (0.25, 0.13, 0.42), 0.042),
            rgb("cf463d"),
            "trim",
        ),
    ]


@noun("cat", "kitten", kind="animals", across=0.3, material="plush")
def cat(v: Variation) -> list[Part]:
    body = blended(0.1, ellipsoid(0.22, 0.2, 0.26).at(-0.05, 0, 0.28), sphere(0.17).at(0.06, 0, 0.4))
    head = ellipsoid(0.2, 0.24, v(0.19, 0.05)).at(0.1, 0, 0.68)
    ear = cone(0.085, 0.012, 0.15).rounded(0.014).rx(-16).at(0.08, 0.14, 0.8).mirrored(1)
    inner = sphere(0.05).at(0.15, 0.16, 0.86).mirrored(1)
    leg = capsule((0.12, 0.09, 0.35), (0.18, 0.1, 0.05), 0.065, 0.06).mirrored(1)
    hind = ellipsoid(0.15, 0.09, 0.12).at(-0.02, 0.17, 0.12).mirrored(1)
    tail = curved_tube(
        [(-0.2, 0, 0.1), (-0.36, 0.1, 0.1), (-0.38, 0.26, 0.16), (-0.3, 0.32, 0.32)],
        [0.06, 0.055, 0.052, 0.05],
    )
    stripes = union(*(torus(0.18, 0.02).ry(90).at(x, 0, 0.76) for x in (-0.02, 0.06, 0.14))).within(
        above(0.76)
    )
    back = union(*(box(0.035, 2, 2).at(x, 0, 0.3) for x in (-0.22, -0.14, -0.06)))
    muzzle = ellipsoid(0.075, 0.1, 0.065).at(0.265, 0, 0.625)
    tip = sphere(0.11).at(-0.28, 0.33, 0.36)
    orange, cream = rgb("e2944a"), rgb("f7e8cf")
    return [
        Part(
            "body",
            body,
            orange,
            "main",
            paints=(
                Paint("belly", ellipsoid(0.12, 0.13, 0.2).at(0.17, 0, 0.32), cream, "accent"),
                Paint("stripes", back, rgb("bd6d2b")),
            ),
        ),
        Part("head", head, orange, "main", paints=(Paint("stripes", stripes, rgb("bd6d2b")),)),
        Part("ears", ear, orange, "main", paints=(Paint("inner ears", inner, rgb("f3b7a8")),)),
        Part("legs", leg | hind, orange, "main"),
        Part(
            "paws",
            (
                ellipsoid(0.09, 0.065, 0.05).at(0.2, 0.1, 0.048)
                | ellipsoid(0.09, 0.06, 0.05).at(0.11, 0.19, 0.048)
            ).mirrored(1),
            cream,
            "accent",
        ),
        Part("tail", tail, orange, "main", paints=(Paint("tail tip", tip, cream, "accent"),)),
        Part("muzzle", muzzle, cream, "accent"),
        Part("nose", ellipsoid(0.025, 0.032, 0.022).at(0.335, 0, 0.655), rgb("d9707a")),
        eyes(0.262, 0.1, 0.715, 0.036),
    ]


@noun("dog", "puppy", kind="animals", across=0.34, material="plush")
def dog(v: Variation) -> list[Part]:
    body = blended(0.1, ellipsoid(0.24, 0.19, 0.2).at(-0.08, 0, 0.34), sphere(0.19).at(0.1, 0, 0.4))
    head = sphere(v(0.2, 0.05)).at(0.2, 0, 0.7)
    snout = ellipsoid(0.14, 0.12, 0.1).at(0.38, 0, 0.65)
    ear = ellipsoid(0.075, 0.045, 0.16).rx(18).at(0.16, 0.215, 0.66).mirrored(1)
    leg = four(capsule((0.18, 0.11, 0.3), (0.18, 0.12, 0.06), 0.075, 0.07)).at(-0.03)
    paws = four(ellipsoid(0.09, 0.08, 0.055).at(0.2, 0.12, 0.052)).at(-0.01)
    tail = curved_tube([(-0.28, 0, 0.42), (-0.38, 0, 0.5), (-0.42, 0, 0.62)], [0.06, 0.05, 0.04])
    patch = sphere(0.12).at(0.33, 0.12, 0.79)
    spot = sphere(0.14).at(-0.16, 0.15, 0.45)
    tongue = ellipsoid(0.05, 0.04, 0.02).ry(40).at(0.44, 0, 0.555)
    tan, brown = rgb("e9c896"), rgb("8e5a33")
    return [
        Part("body", body, tan, "main", paints=(Paint("spots", spot, brown, "accent"),)),
        Part("head", head, tan, "main", paints=(Paint("patch", patch, brown, "accent"),), blend=0.05),
        Part("snout", snout, rgb("f7ead2"), "main", blend=0.02),
        Part("ears", ear, brown, "accent"),
        Part("legs", leg, tan, "main", blend=0.03),
        Part("paws", paws, rgb("f7ead2")),
        Part("tail", tail, brown, "accent"),
        Part("nose", ellipsoid(0.04, 0.05, 0.036).at(0.5, 0, 0.69), DARK),
        Part("tongue", tongue, rgb("e3707a")),
        eyes(0.36, 0.085, 0.765, 0.032),
        Part("collar", torus(0.16, 0.034).ry(22).at(0.13, 0, 0.545), rgb("c8403a"), "trim"),
    ]


@noun("rabbit", "bunny", "hare", kind="animals", across=0.32, material="plush")
def rabbit(v: Variation) -> list[Part]:
    body = ellipsoid(0.23, 0.2, 0.23).at(-0.06, 0, 0.25)
    head = ellipsoid(0.18, 0.18, 0.165).at(0.12, 0, 0.53)
    tall = v(0.17, 0.08)
    ear = ellipsoid(0.04, 0.062, tall).rx(-12).at(0.06, 0.1, 0.66 + 0.85 * tall).mirrored(1)
    inner = ellipsoid(0.06, 0.036, 0.72 * tall).rx(-12).at(0.1, 0.105, 0.66 + 0.85 * tall).mirrored(1)
    feet = ellipsoid(0.15, 0.07, 0.06).at(0.1, 0.13, 0.055).mirrored(1)
    arms = capsule((0.1, 0.1, 0.34), (0.2, 0.07, 0.18), 0.055).mirrored(1)
    cheeks = ellipsoid(0.07, 0.085, 0.06).at(0.245, 0.045, 0.485).mirrored(1)
    teeth = box(0.04, 0.05, 0.06, 0.012).at(0.29, 0, 0.41)
    gray, white = rgb("cbb8a8"), rgb("f8f1e6")
    return [
        Part(
            "body",
            body,
            gray,
            "main",
            paints=(Paint("belly", ellipsoid(0.16, 0.13, 0.17).at(0.08, 0, 0.24), white, "accent"),),
        ),
        Part("head", head, gray, "main", blend=0.06),
        Part("ears", ear, gray, "main", paints=(Paint("inner ears", inner, rgb("f0b3b0"), "accent"),)),
        Part("feet", feet, gray, "main"),
        Part("arms", arms, gray, "main"),
        Part("cheeks", cheeks, white, "accent"),
        Part("teeth", teeth, rgb("fffdf6")),
        Part("nose", ellipsoid(0.026, 0.034, 0.024).at(0.315, 0, 0.525), rgb("e0808a")),
        Part("tail", sphere(0.09).at(-0.29, 0, 0.2), white, "accent"),
        eyes(0.255, 0.105, 0.575, 0.034),
    ]


@noun("pig", "piggy bank", "piglet", "piggy", kind="animals", across=0.24, material="ceramic")
def pig(v: Variation) -> list[Part]:
    body = ellipsoid(0.38, v(0.3, 0.05), 0.29).at(z=0.39)
    head = sphere(0.22).at(0.3, 0, 0.46)
    snout = disc_x(0.1, 0.16, 0.035).at(0.5, 0, 0.43)
    nostrils = ellipsoid(0.05, 0.022, 0.032).at(0.58, 0.036, 0.435).mirrored(1)
    ear = ellipsoid(0.045, 0.09, 0.11).rx(-26).ry(18).at(0.3, 0.16, 0.66).mirrored(1)
    leg = four(cone(0.085, 0.1, 0.24, 0.02).at(0.2, 0.15))
    hoof = four(cone(0.084, 0.088, 0.06, 0.01).at(0.2, 0.15))
    tail = curved_tube(
        [
            (-0.36, 0, 0.45),
            (-0.44, 0.03, 0.47),
            (-0.46, -0.04, 0.53),
            (-0.42, -0.04, 0.57),
            (-0.41, 0.03, 0.55),
        ],
        0.026,
    )
    slot = box(0.2, 0.035, 0.2).at(-0.04, 0, 0.6)
    pink, rose = rgb("f2a9b2"), rgb("dd7f90")
    return [
        Part("body", body, pink, "main", paints=(Paint("slot", slot, rgb("7a4450")),)),
        Part("head", head, pink, "main", blend=0.06),
        Part("snout", snout, rose, "accent", paints=(Paint("nostrils", nostrils, rgb("8f4a58")),)),
        Part("ears", ear, rose, "accent"),
        Part("legs", leg, pink, "main"),
        Part("hooves", hoof.rounded(0.004).at(z=0.004), rose, "accent"),
        Part("tail", tail, rose, "accent"),
        eyes(0.46, 0.095, 0.555, 0.03),
    ]


@noun("fish", "goldfish", "toy fish", kind="animals", across=0.2, material="rubber")
def fish(v: Variation) -> list[Part]:
    body = ellipsoid(0.15, 0.34, v(0.22, 0.06)).at(0, 0.06, 0.4)
    tail = blended(
        0.03,
        ellipsoid(0.035, 0.17, 0.075).rx(38).at(0, -0.36, 0.5),
        ellipsoid(0.035, 0.17, 0.075).rx(-38).at(0, -0.36, 0.3),
        capsule((0, -0.38, 0.4), (0, -0.15, 0.4), 0.06, 0.09),
    )
    top = ellipsoid(0.035, 0.17, 0.12).rx(-12).at(0, 0.0, 0.6)
    low = ellipsoid(0.035, 0.09, 0.08).rx(20).at(0, 0.02, 0.2)
    side = ellipsoid(0.035, 0.1, 0.06).rz(-30).rx(25).at(0.16, 0.0, 0.36).mirrored(0)
    bands = union(*(box(2, 0.07, 2).at(0, y, -0.5) for y in (0.1, -0.08)))
    base = blended(
        0.03,
        ellipsoid(0.17, 0.17, 0.06).within(above(0.0), 0.01),
        capsule((0, 0.03, 0.03), (0, 0.03, 0.2), 0.04),
    )
    ball = sphere(0.06).at(0.11, 0.26, 0.45).mirrored(0)
    pupil = sphere(0.036).at(0.148, 0.275, 0.455).mirrored(0)
    lips = torus(0.045, 0.026).rx(90).at(0, 0.4, 0.37)
    return [
        Part("body", body, rgb("f0862f"), "main", paints=(Paint("bands", bands, WHITE, "accent"),)),
        Part("tail", tail, rgb("f7b04a"), "main"),
        Part("fins", union(top, low, side), rgb("f7b04a"), "main"),
        Part("lips", lips, rgb("e06a4a")),
        Part("eyes", ball, WHITE, paints=(Paint("pupils", pupil, DARK),)),
        Part("stand", base, rgb("5fa8b8"), "trim"),
    ]


@noun("whale", "blue whale", "toy whale", kind="animals", across=0.3, material="rubber")
def whale(v: Variation) -> list[Part]:
    body = blended(
        0.12,
        ellipsoid(0.28, 0.25, v(0.23, 0.05)).at(0.14, 0, 0.24),
        curved_tube([(0.0, 0, 0.22), (-0.25, 0, 0.2), (-0.42, 0, 0.36)], [0.2, 0.12, 0.06]),
    )
    body = body.within(above(0.015), 0.02)
    fluke = ellipsoid(0.08, 0.15, 0.035).rz(28).rx(14).at(-0.45, 0.11, 0.43).mirrored(1)
    fins = ellipsoid(0.085, 0.15, 0.035).rz(-32).rx(-20).at(0.12, 0.3, 0.13).mirrored(1)
    belly = below(0.15)
    spout = blended(
        0.03,
        capsule((0.12, 0, 0.44), (0.12, 0, 0.58), 0.035, 0.03),
        curved_tube([(0.12, 0, 0.55), (0.12, 0.07, 0.64), (0.12, 0.14, 0.6)], [0.034, 0.04, 0.05]),
        curved_tube([(0.12, 0, 0.55), (0.12, -0.07, 0.64), (0.12, -0.14, 0.6)], [0.034, 0.04, 0.05]),
    )
    blue = rgb("4b86b4")
    return [
        Part("body", body, blue, "main", paints=(Paint("belly", belly, rgb("e6eef2"), "accent"),)),
        Part("tail", fluke, blue, "main", blend=0.03),
        Part("fins", fins, blue, "main", blend=0.02),
        Part("spout", spout, rgb("a9dbe6")),
        Part("mouth", smile(0.41, 0.17, 0.14, 0.02, 0.013), rgb("2f4a60")),
        eyes(0.33, 0.165, 0.26, 0.03),
    ]


@noun("turtle", "tortoise", kind="animals", across=0.26, material="rubber")
def turtle(v: Variation) -> list[Part]:
    shell = ellipsoid(0.34, 0.31, v(0.26, 0.06)).at(z=0.14).within(above(0.12), 0.03)
    rim = torus(0.31, 0.045).stretched(x=1.06, z=0.9).at(z=0.14)
    belly = ellipsoid(0.3, 0.27, 0.08).at(z=0.11)
    tiles = [sphere(0.1).at(0, 0, 0.4)]
    for i in range(6):
        a = math.pi * (i + 0.5) / 3
        tiles.append(sphere(0.09).at(0.21 * math.cos(a), 0.19 * math.sin(a), 0.32))
    head = blended(0.05, sphere(0.12).at(0.46, 0, 0.3), capsule((0.28, 0, 0.16), (0.42, 0, 0.25), 0.075))
    legs = four(capsule((0.2, 0.2, 0.12), (0.27, 0.27, 0.055), 0.075, 0.07))
    tail = cone(0.05, 0.012, 0.12).rounded(0.01).ry(-100).at(-0.3, 0, 0.12)
    skin = rgb("9cc069")
    return [
        Part(
            "shell",
            shell,
            rgb("5f8a4a"),
            "main",
            paints=(Paint("tiles", union(*tiles), rgb("86a85a"), "accent"),),
        ),
        Part("rim", rim, rgb("c9b070"), "accent"),
        Part("belly", belly, rgb("e6d9a0")),
        Part("head", head, skin),
        Part("legs", legs.within(above(0.0), 0.01), skin),
        Part("tail", tail, skin),
        Part("mouth", smile(0.575, 0.27, 0.09, 0.015, 0.012), rgb("4a5f33")),
        eyes(0.535, 0.07, 0.345, 0.028),
    ]


@noun("owl", kind="animals", across=0.26, material="plush")
def owl(v: Variation) -> list[Part]:
    body = blended(
        0.12, ellipsoid(0.25, 0.28, 0.33).at(z=0.36), ellipsoid(0.24, 0.27, v(0.22, 0.05)).at(0.0, 0, 0.68)
    )
    ear = cone(0.08, 0.012, 0.17).rounded(0.012).rx(-24).at(0.02, 0.17, 0.8).mirrored(1)
    belly = ellipsoid(0.2, 0.2, 0.25).at(0.15, 0, 0.32)
    face = disc_x(0.125, 0.6).at(0.2, 0.105, 0.7).mirrored(1)
    white = disc_x(0.092, 0.06, 0.02).at(0.215, 0.1, 0.7).mirrored(1)
    pupil = sphere(0.05).at(0.25, 0.095, 0.7).mirrored(1)
    wing = ellipsoid(0.13, 0.055, 0.24).rx(10).at(-0.01, 0.27, 0.4).mirrored(1)
    beak = cone(0.045, 0.01, 0.1).rounded(0.01).ry(125).at(0.24, 0, 0.64)
    feet = union(*(ellipsoid(0.09, 0.035, 0.035).rz(a).at(0.16, 0.1, 0.035) for a in (-22, 22))).mirrored(1)
    brown = rgb("8c6a4a")
    return [
        Part(
            "body",
            body,
            brown,
            "main",
            paints=(
                Paint("belly", belly, rgb("e5cfa6"), "accent"),
                Paint("face", face, rgb("e5cfa6"), "accent"),
            ),
        ),
        Part("ears", ear, brown, "main", blend=0.02),
        Part("wings", wing, rgb("6f5238"), "main"),
        Part("eyes", white, WHITE, paints=(Paint("pupils", pupil, DARK),)),
        Part("beak", beak, rgb("eda338")),
        Part("feet", feet, rgb("eda338")),
        Part(
            "log",
            capsule((0.02, -0.38, 0.05), (0.02, 0.38, 0.05), 0.065),
            rgb("7a5433"),
            "trim",
            "grain",
            rgb("5d3d22"),
        ),
    ]


@noun("snail", kind="animals", across=0.16, material="rubber")
def snail(v: Variation) -> list[Part]:
    foot = curved_tube(
        [(-0.46, 0, 0.06), (-0.1, 0, 0.09), (0.24, 0, 0.1), (0.4, 0, 0.26), (0.42, 0, 0.42)],
        [0.03, 0.1, 0.11, 0.1, 0.11],
    )
    foot = foot.within(above(0.0), 0.01)
    loops = v(2.2, 0.05)
    points, radii = [], []
    for i in range(48):
        t = i / 47
        size = 1.0 - 0.86 * t
        a = 2 * math.pi * loops * t - 1.2
        points.append((0.2 * size * math.cos(a) - 0.1, 0.11 * t, 0.2 * size * math.sin(a) + 0.4))
        radii.append(0.15 * size + 0.025)
    spiral = tube(points, radii).mirrored(1)
    stalks = capsule((0.42, 0.05, 0.48), (0.5, 0.11, 0.66), 0.024).mirrored(1)
    knobs = sphere(0.045).at(0.5, 0.11, 0.68)
    pupils = sphere(0.03).at(0.535, 0.115, 0.685).mirrored(1)
    line = tube([(x + 0.0, y + r, z) for (x, y, z), r in zip(points, radii, strict=True)], 0.026).mirrored(1)
    return [
        Part("body", foot, rgb("d9c48e"), "accent"),
        Part("shell", spiral, rgb("c9704a"), "main", paints=(Paint("spiral", line, rgb("f3d49a")),)),
        Part("stalks", stalks, rgb("d9c48e"), "accent"),
        Part("eyes", knobs.mirrored(1), WHITE, paints=(Paint("pupils", pupils, DARK),)),
        Part("mouth", smile(0.525, 0.395, 0.09, 0.015, 0.012), rgb("6b4a33")),
    ]


@noun("bee", "bumblebee", kind="animals", across=0.14, material="plush")
def bee(v: Variation) -> list[Part]:
    body = ellipsoid(v(0.34, 0.05), 0.25, 0.25).at(-0.04, 0, 0.36)
    head = sphere(0.19).at(0.27, 0, 0.4)
    bands = union(*(box(0.1, 2, 2).at(x, 0, -0.5) for x in (-0.25, -0.06, 0.13)))
    wing = ellipsoid(0.12, 0.17, 0.035).rx(38).rz(-14).at(-0.02, 0.2, 0.66).mirrored(1)
    sting = cone(0.045, 0.01, 0.1).rounded(0.008).ry(-90).at(-0.36, 0, 0.35)
    feelers = curved_tube([(0.32, 0.07, 0.56), (0.37, 0.1, 0.66), (0.43, 0.12, 0.7)], 0.02).mirrored(1)
    knobs = sphere(0.036).at(0.44, 0.12, 0.7).mirrored(1)
    petals = ellipsoid(0.11, 0.07, 0.03).at(0.13).ring(7).at(-0.02, 0, 0.06)
    pole = capsule((-0.02, 0, 0.04), (-0.02, 0, 0.2), 0.06)
    return [
        Part("body", body, rgb("f4c12f"), "main", paints=(Paint("stripes", bands, rgb("3a2f2a"), "accent"),)),
        Part("head", head, rgb("f4c12f"), "main"),
        Part("wings", wing, rgb("dfeef2")),
        Part("stinger", sting, DARK),
        Part("antennae", feelers | knobs, rgb("3a2f2a")),
        Part("mouth", smile(0.452, 0.35, 0.1, 0.018, 0.013), rgb("3a2f2a")),
        eyes(0.41, 0.085, 0.44, 0.034),
        Part("flower", petals, rgb("ee8fae"), "trim"),
        Part("center", ellipsoid(0.11, 0.11, 0.05).at(-0.02, 0, 0.07) | pole, rgb("f3d05a")),
    ]


@noun("elephant", "baby elephant", kind="animals", across=0.34, material="plush")
def elephant(v: Variation) -> list[Part]:
    body = ellipsoid(0.3, 0.24, 0.24).at(-0.08, 0, 0.42)
    head = sphere(v(0.21, 0.05)).at(0.25, 0, 0.56)
    ear = ellipsoid(0.035, 0.15, 0.17).rz(-22).at(0.17, 0.27, 0.58).mirrored(1)
    inner = ellipsoid(0.08, 0.1, 0.12).rz(-22).at(0.22, 0.29, 0.58).mirrored(1)
    trunk = curved_tube(
        [(0.38, 0, 0.52), (0.5, 0, 0.4), (0.52, 0, 0.24), (0.58, 0, 0.16), (0.66, 0, 0.2)],
        [0.095, 0.08, 0.062, 0.055, 0.052],
    )
    leg = four(capsule((0.2, 0.13, 0.34), (0.2, 0.14, 0.06), 0.095, 0.09)).at(-0.08).within(above(0.0), 0.01)
    toes = union(
        *(
            sphere(0.036).at(x, 0.14 + y, 0.042).mirrored(1)
            for x in (0.205, -0.195)
            for y in (-0.05, 0.0, 0.05)
        )
    )
    tusk = curved_tube(
        [(0.4, 0.1, 0.45), (0.47, 0.12, 0.4), (0.53, 0.12, 0.42)], [0.034, 0.03, 0.02]
    ).mirrored(1)
    tail = curved_tube([(-0.36, 0, 0.45), (-0.42, 0, 0.36), (-0.42, 0, 0.26)], [0.026, 0.024, 0.042])
    gray = rgb("9aa6b4")
    return [
        Part("body", body, gray, "main"),
        Part("head", head, gray, "main", blend=0.08),
        Part("trunk", trunk, gray, "main", blend=0.03),
        Part("ears", ear, gray, "main", paints=(Paint("inner ears", inner, rgb("e9b8bd"), "accent"),)),
        Part("legs", leg, gray, "main", blend=0.03),
        Part("toes", toes, rgb("f1e7d6")),
        Part("tusks", tusk, rgb("fbf6ea")),
        Part("tail", tail, gray, "main"),
        eyes(0.41, 0.125, 0.62, 0.028),
    ]


@noun("ladybug", "ladybird", "beetle", kind="animals", across=0.1, material="plastic")
def ladybug(v: Variation) -> list[Part]:
    shell = ellipsoid(0.38, 0.33, v(0.31, 0.05)).at(-0.04, 0, 0.1).within(above(0.1), 0.03)
    seam = box(0.9, 0.022, 1).at(-0.2)
    under = ellipsoid(0.34, 0.29, 0.08).at(-0.04, 0, 0.1)
    head = sphere(0.165).at(0.31, 0, 0.17)
    cheeks = sphere(0.07).at(0.42, 0.1, 0.19).mirrored(1)
    feelers = curved_tube(
        [(0.38, 0.06, 0.3), (0.44, 0.09, 0.4), (0.5, 0.12, 0.42)], [0.02, 0.02, 0.032]
    ).mirrored(1)
    legs = union(
        *(capsule((x, 0.25, 0.09), (x + 0.02, 0.37, 0.03), 0.032) for x in (-0.22, -0.03, 0.16))
    ).mirrored(1)
    return [
        Part(
            "shell",
            shell,
            rgb("d23a34"),
            "main",
            "dotted",
            rgb("2b2729"),
            (0.23, 0.062),
            paints=(Paint("seam", seam, rgb("2b2729")),),
        ),
        Part("body", under, rgb("2b2729"), "accent"),
        Part("head", head, rgb("2b2729"), "accent", paints=(Paint("cheeks", cheeks, WHITE),)),
        Part("antennae", feelers, rgb("2b2729")),
        Part("legs", legs.within(above(0.0), 0.0), rgb("2b2729")),
        Part("eyes", sphere(0.03).at(0.455, 0.085, 0.215).mirrored(1), rgb("151315")),
    ]
