"""Vessels."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Point2,
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
from gdpro_sim.generation.objects.shapes import bail, below, hollow, loop_handle, wave, well


@noun("mug", "coffee mug", "tea mug", kind="vessels", across=0.125, material="ceramic")
def mug(v: Variation) -> list[Part]:
    height, radius = v(1.0), v(0.42)
    wall = 0.06
    body = cone(0.96 * radius, radius, height, 0.03)
    cavity = cone(0.96 * radius - wall, radius - wall, height, 0.02).at(z=0.07)
    rim = torus(radius - 0.5 * wall, 0.5 * wall + 0.004).at(z=height - 0.5 * wall)
    handle = loop_handle(radius - 0.02, 0.22 * height, 0.78 * height, v(0.32), v(0.058)).rz(90)
    return [
        Part("body", body - cavity, rgb("5f8fb8"), "main"),
        Part("rim", rim, rgb("f2ead8"), "accent"),
        Part("handle", handle - cavity, rgb("5f8fb8"), "main"),
    ]


@noun("cup", "teacup", "tea cup", "cup and saucer", kind="vessels", across=0.15, material="ceramic")
def cup(v: Variation) -> list[Part]:
    radius, height = v(0.32, 0.06), v(0.42)
    outline: list[Point2] = [(0.16, 0.0), (0.19, 0.05), (0.78 * radius, 0.18), (radius, height)]
    cavity = revolve(well(outline, 0.035, 0.05)).at(z=0.07)
    saucer = revolve([(0.0, 0.0), (0.26, 0.0), (0.5, 0.09), (0.5, 0.125), (0.24, 0.05), (0.0, 0.05)])
    saucer = saucer.rounded(0.012).at(z=0.012)
    handle = loop_handle(0.86 * radius, 0.2, 0.9 * height + 0.03, 0.17, 0.032).rz(90)
    tea = cylinder(0.9 * radius, 0.8 * height).at(z=0.06).within(cavity.rounded(0.01))
    return [
        Part("saucer", saucer, rgb("f1ece0"), "main"),
        Part("cup", hollow(outline, 0.035, 0.05).at(z=0.07), rgb("f1ece0"), "main"),
        Part("handle", handle - cavity, rgb("c99a4a"), "accent"),
        Part("rim", torus(radius - 0.016, 0.022).at(z=height + 0.07), rgb("c99a4a"), "accent"),
        Part("saucer rim", torus(0.495, 0.024).at(z=0.118), rgb("c99a4a"), "accent"),
        Part("tea", tea, rgb("9c5a2b")),
    ]


@noun("bowl", "salad bowl", "soup bowl", kind="vessels", across=0.18, material="ceramic")
def bowl(v: Variation) -> list[Part]:
    height = v(0.44)
    outline: list[Point2] = [(0.2, 0.02), (0.3, 0.09), (0.44, 0.25), (0.5, height)]
    foot = revolve([(0.14, 0.0), (0.22, 0.0), (0.21, 0.06), (0.14, 0.06)])
    band = revolve([(0.3, 0.27), (0.6, 0.27), (0.6, 0.33), (0.3, 0.33)])
    paints = (Paint("band", band, rgb("f3ead7"), "accent"),)
    return [
        Part("body", hollow(outline, 0.045, 0.06), rgb("cf7a4a"), "main", paints=paints),
        Part("rim", torus(0.478, 0.028).at(z=height), rgb("f3ead7"), "accent"),
        Part("foot", foot | cylinder(0.2, 0.05).at(z=0.03), rgb("f3ead7"), "accent"),
    ]


@noun("vase", "flower vase", kind="vessels", across=0.30, material="ceramic")
def vase(v: Variation) -> list[Part]:
    belly, neck = v(0.32, 0.15), v(0.15, 0.15)
    foot, lip = v(0.19), v(0.21)
    outline: list[Point2] = [
        (foot, 0.0),
        (0.8 * belly, 0.14),
        (belly, 0.38),
        (0.75 * belly, 0.62),
        (neck, 0.8),
        (0.5 * (neck + lip), 0.93),
        (lip, 1.0),
    ]
    ring = revolve([(foot - 0.03, 0.0), (foot + 0.03, 0.0), (foot + 0.035, 0.045), (foot - 0.03, 0.05)])
    band = revolve([(0.0, 0.6), (0.5, 0.6), (0.5, 0.645), (0.0, 0.645)])
    low_band = revolve([(0.0, 0.15), (0.5, 0.15), (0.5, 0.195), (0.0, 0.195)])
    paints = (Paint("bands", band | low_band, rgb("e9dcc0"), "accent"),)
    return [
        Part("body", hollow(outline, 0.045, 0.06), rgb("3f7f88"), "main", paints=paints),
        Part("rim", torus(lip - 0.015, 0.032).at(z=0.99), rgb("e9dcc0"), "accent"),
        Part("foot", ring.rounded(0.008).at(z=0.008), rgb("e9dcc0"), "accent"),
    ]


@noun("teapot", "tea pot", "kettle", kind="vessels", across=0.24, material="ceramic")
def teapot(v: Variation) -> list[Part]:
    radius = v(0.36, 0.05)
    body = revolve(
        smooth_profile(
            [(0.2, 0.0), (0.27, 0.03), (radius, 0.22), (0.92 * radius, 0.4), (0.2, 0.53), (0.12, 0.545)]
        )
    )
    spout = curved_tube(
        [(0, 0.26, 0.16), (0, 0.42, 0.2), (0, 0.5, 0.36), (0, 0.58, 0.5), (0, 0.62, 0.53)],
        [0.11, 0.08, 0.055, 0.047, 0.05],
    )
    mouth = capsule((0, 0.6, 0.53), (0, 0.67, 0.6), 0.026)
    handle = curved_tube(
        [(0, -0.28, 0.45), (0, -0.45, 0.47), (0, -0.56, 0.36), (0, -0.5, 0.2), (0, -0.3, 0.13)], 0.042
    )
    lid = revolve(smooth_profile([(0.215, 0.51), (0.2, 0.545), (0.1, 0.58), (0.0, 0.59)]))
    band = revolve([(0.0, 0.2), (0.5, 0.2), (0.5, 0.245), (0.0, 0.245)])
    blue, cream = rgb("4f7fae"), rgb("f2ead8")
    return [
        Part("body", body, cream, "main", paints=(Paint("band", band, blue, "accent"),)),
        Part("spout", spout - mouth, cream, "main", blend=0.05),
        Part("handle", handle, blue, "accent"),
        Part("lid", lid | torus(0.205, 0.024).at(z=0.522), blue, "accent"),
        Part("knob", sphere(0.052).at(z=0.63) | cylinder(0.025, 0.1).at(z=0.55), cream, "main"),
        Part("foot", torus(0.19, 0.028).at(z=0.026), blue, "accent"),
    ]


@noun("bottle", "wine bottle", "glass bottle", kind="vessels", across=0.30, material="glass")
def bottle(v: Variation) -> list[Part]:
    radius, shoulder = v(0.15, 0.06), v(0.56, 0.04)
    glass = revolve(
        smooth_profile(
            [
                (radius - 0.02, 0.0),
                (radius, 0.02),
                (radius, 0.2),
                (radius, shoulder),
                (0.062, shoulder + 0.2),
                (0.056, 0.92),
            ],
            5,
        )
    )
    label = revolve([(0.0, 0.16), (0.5, 0.16), (0.5, 0.44), (0.0, 0.44)])
    stripe = revolve([(0.0, 0.39), (0.5, 0.39), (0.5, 0.415), (0.0, 0.415)])
    crest = sphere(0.06).at(radius, 0, 0.28)
    paints = (
        Paint("label", label, rgb("f1e6cb")),
        Paint("label stripe", stripe, rgb("a23b35"), "accent"),
        Paint("crest", crest, rgb("a23b35"), "accent"),
    )
    neck = revolve([(0.0, 0.8), (0.075, 0.8), (0.072, 0.93), (0.0, 0.93)])
    return [
        Part("body", glass, rgb("3f7a4f"), "main", paints=paints),
        Part("neck", neck.rounded(0.004), rgb("a23b35"), "accent"),
        Part("lip", torus(0.058, 0.022).at(z=0.925), rgb("3f7a4f"), "main"),
        Part("cork", cone(0.046, 0.052, 0.08, 0.01).at(z=0.92), rgb("c99c66")),
    ]


@noun("jug", "pitcher", "milk jug", "carafe", kind="vessels", across=0.24, material="ceramic")
def jug(v: Variation) -> list[Part]:
    belly = v(0.34, 0.08)
    outline: list[Point2] = [(0.24, 0.0), (belly, 0.25), (0.8 * belly, 0.55), (0.19, 0.78), (0.235, 0.98)]
    beak = ellipsoid(0.1, 0.16, 0.13).at(0, 0.19, 0.93).within(below(0.98), 0.03)
    lip_cut = ellipsoid(0.066, 0.13, 0.14).at(0, 0.185, 0.99)
    cavity = revolve(well(outline, 0.045, 0.06))
    handle = curved_tube(
        [(0, -0.2, 0.9), (0, -0.38, 0.93), (0, -0.5, 0.72), (0, -0.46, 0.45), (0, -0.27, 0.32)], 0.05
    )
    glaze = box(4, 4, 2).bumpy(0.03, wave(5, v.uniform(0, 6))).at(z=0.5)
    body = hollow(outline, 0.045, 0.06).blend(beak - cavity, 0.03) - lip_cut
    return [
        Part("body", body, rgb("e9ddc4"), "main", paints=(Paint("glaze", glaze, rgb("4b7fa3"), "accent"),)),
        Part("handle", handle - cavity, rgb("4b7fa3"), "accent"),
        Part("foot", torus(0.225, 0.03).at(z=0.028), rgb("c9b48e")),
    ]


@noun("plate", "dinner plate", "dish", kind="vessels", across=0.26, material="ceramic")
def plate(v: Variation) -> list[Part]:
    rise = v(0.08, 0.15)
    body = revolve([(0.0, 0.0), (0.27, 0.0), (0.5, rise), (0.5, rise + 0.025), (0.28, 0.04), (0.0, 0.04)])
    center = cylinder(0.2, 1.0)
    ring = cylinder(0.43, 1.0) - cylinder(0.4, 1.0)
    return [
        Part(
            "body",
            body.rounded(0.012).at(z=0.012),
            rgb("f3efe4"),
            "main",
            paints=(Paint("ring", ring, rgb("3f73a8"), "accent"), Paint("center", center, rgb("e3ecf0"))),
        ),
        Part("rim", torus(0.497, 0.022).at(z=rise + 0.026), rgb("3f73a8"), "accent"),
    ]


@noun("bucket", "pail", kind="vessels", across=0.36, material="steel")
def bucket(v: Variation) -> list[Part]:
    top, bottom, height = v(0.36), v(0.26), v(0.62)
    body = cone(bottom, top, height) - cone(bottom - 0.035, top - 0.03, height).at(z=0.045)
    bands = union(
        torus(bottom + 0.01, 0.024).at(z=0.024),
        torus(bottom + 0.5 * (top - bottom), 0.02).at(z=0.5 * height),
    )
    ears = capsule((0, top, height - 0.07), (0, top + 0.03, height - 0.07), 0.045).mirrored(1)
    grip = capsule((0, -0.1, height + 0.31), (0, 0.1, height + 0.31), 0.042)
    grey = rgb("9fb0ba")
    return [
        Part("body", body, grey, "main", "brushed", rgb("83949f")),
        Part("bands", bands, rgb("7c8d98"), "accent"),
        Part("rim", torus(top - 0.01, 0.028).at(z=height - 0.01), rgb("7c8d98"), "accent"),
        Part("ears", ears, rgb("6a7a85")),
        Part("handle", bail(top + 0.03, height - 0.07, 0.38, 0.024), rgb("6a7a85")),
        Part("grip", grip, rgb("a5713f")),
    ]


@noun("pot", "cooking pot", "saucepan", "stock pot", kind="vessels", across=0.32, material="steel")
def pot(v: Variation) -> list[Part]:
    radius, height = v(0.35, 0.05), v(0.38)
    body = cylinder(radius, height, 0.05)
    lid = (
        ellipsoid(radius + 0.02, radius + 0.02, 0.12)
        .at(z=height)
        .within(box(2, 2, 1).at(z=height - 0.01), 0.02)
    )
    ears = curved_tube(
        [
            (-0.1, radius - 0.02, height - 0.1),
            (-0.09, radius + 0.1, height - 0.09),
            (0.09, radius + 0.1, height - 0.09),
            (0.1, radius - 0.02, height - 0.1),
        ],
        0.03,
    ).mirrored(1)
    return [
        Part("body", body, rgb("c5463a"), "main"),
        Part("lid", lid, rgb("c5463a"), "main"),
        Part("rim", torus(radius - 0.005, 0.026).at(z=height), rgb("d9d6cf"), "accent"),
        Part("handles", ears, rgb("3b3a3c"), "accent"),
        Part(
            "knob",
            blended(
                0.03,
                ellipsoid(0.075, 0.075, 0.04).at(z=height + 0.18),
                cylinder(0.035, 0.1).at(z=height + 0.08),
            ),
            rgb("3b3a3c"),
            "accent",
        ),
    ]


@noun("frying pan", "pan", "skillet", kind="vessels", across=0.46, material="steel")
def frying_pan(v: Variation) -> list[Part]:
    radius = v(0.3, 0.05)
    outline: list[Point2] = [(radius - 0.07, 0.0), (radius - 0.02, 0.03), (radius, 0.1)]
    handle = curved_tube(
        [(0, radius - 0.02, 0.07), (0, radius + 0.16, 0.11), (0, 0.72, 0.14)], [0.026, 0.032, 0.04]
    )
    white = blended(
        0.06,
        ellipsoid(0.13, 0.14, 0.035),
        ellipsoid(0.09, 0.08, 0.03).at(0.09, -0.08),
        ellipsoid(0.08, 0.08, 0.03).at(-0.08, 0.09),
    ).at(z=0.048)
    return [
        Part("body", hollow(outline, 0.028, 0.03), rgb("3a3c40"), "main"),
        Part("rim", torus(radius - 0.012, 0.018).at(z=0.1), rgb("55585d"), "main"),
        Part("handle", handle, rgb("9c5f33"), "accent"),
        Part("egg white", white, rgb("f8f5ea")),
        Part("yolk", ellipsoid(0.062, 0.062, 0.05).at(z=0.065), rgb("f3b32c")),
    ]


@noun("wine glass", "goblet", "glass", kind="vessels", across=0.20, material="glass")
def wine_glass(v: Variation) -> list[Part]:
    belly = v(0.21, 0.06)
    outline: list[Point2] = [
        (0.03, 0.5),
        (0.15, 0.54),
        (belly, 0.68),
        (0.93 * belly, 0.85),
        (0.8 * belly, 1.0),
    ]
    stem = revolve(
        smooth_profile([(0.23, 0.0), (0.225, 0.025), (0.07, 0.05), (0.028, 0.14), (0.026, 0.4), (0.06, 0.52)])
    )
    wine = revolve([(0.0, 0.53), (0.4, 0.53), (0.4, 0.8), (0.0, 0.8)]).within(
        revolve(well(outline, 0.02, 0.03))
    )
    clear = rgb("cfe3e6")
    return [
        Part("bowl", hollow(outline, 0.032, 0.04), clear, "main"),
        Part("stem", stem, clear, "main"),
        Part("rim", torus(0.8 * belly - 0.014, 0.019).at(z=0.995), rgb("e6f1f2"), "main"),
        Part("wine", wine, rgb("8e1f36"), "trim"),
    ]


@noun("jar", "honey jar", "jam jar", "cookie jar", kind="vessels", across=0.14, material="glass")
def jar(v: Variation) -> list[Part]:
    radius = v(0.33, 0.06)
    body = revolve(
        smooth_profile(
            [
                (radius - 0.06, 0.0),
                (radius, 0.07),
                (radius, 0.4),
                (radius - 0.01, 0.6),
                (0.24, 0.74),
                (0.23, 0.8),
            ]
        )
    )
    label = box(0.5, 0.36, 0.26, 0.04).at(radius, 0, 0.22)
    paints = (
        Paint("label", label, rgb("f7eed6")),
        Paint("emblem", sphere(0.085).at(radius, 0, 0.35), rgb("d8862c")),
    )
    lid = cylinder(0.27, 0.15, 0.03).at(z=0.78)
    return [
        Part("body", body, rgb("e2a33a"), "main", paints=paints),
        Part("lid", lid, rgb("b5473b"), "accent", "checkered", rgb("f5ead8")),
        Part("ring", torus(0.262, 0.024).at(z=0.8), rgb("d9c48e")),
    ]


@noun("barrel", "keg", "cask", kind="vessels", across=0.9, material="wood")
def barrel(v: Variation) -> list[Part]:
    belly = v(0.38, 0.05)
    end = 0.78 * belly
    body = revolve(
        smooth_profile(
            [
                (end, 0.0),
                (0.5 * (end + belly) + 0.02, 0.25),
                (belly, 0.5),
                (0.5 * (end + belly) + 0.02, 0.75),
                (end, 1.0),
            ]
        )
    )
    body = body.bumpy(0.006, wave(18, 0.0)) - cylinder(end - 0.05, 0.1).at(z=0.955)
    hoops = union(
        *(
            torus(r, 0.021).stretched(z=1.7).at(z=z)
            for r, z in ((end + 0.02, 0.05), (belly - 0.02, 0.3), (belly - 0.02, 0.7), (end + 0.02, 0.95))
        )
    )
    plug = capsule((belly - 0.02, 0, 0.5), (belly + 0.025, 0, 0.5), 0.04)
    return [
        Part("body", body, rgb("a8703c"), "main", "grain", rgb("865429")),
        Part("hoops", hoops, rgb("5b5f63"), "accent"),
        Part("plug", plug, rgb("d4ac74")),
    ]


@noun("watering can", kind="vessels", across=0.36, material="aluminium")
def watering_can(v: Variation) -> list[Part]:
    radius, height = v(0.24, 0.05), v(0.42)
    body = cone(radius, 0.92 * radius, height, 0.03)
    cover = ellipsoid(0.92 * radius, 0.92 * radius, 0.1).at(z=height - 0.02) - box(0.6, 0.5, 0.4).at(
        0, 0.16, height + 0.0
    )
    spout = curved_tube([(0, 0.18, 0.1), (0, 0.36, 0.2), (0, 0.56, 0.52)], [0.06, 0.042, 0.036])
    rose = cone(0.035, 0.1, 0.1, 0.01).rx(-36).at(0, 0.55, 0.5)
    handle = curved_tube(
        [
            (0, 0.1, height),
            (0, 0.02, height + 0.2),
            (0, -0.22, height + 0.16),
            (0, -0.36, 0.3),
            (0, -0.2, 0.14),
        ],
        0.034,
    )
    green = rgb("5f9a6c")
    return [
        Part("body", body | cover, green, "main"),
        Part("spout", spout, green, "main", blend=0.03),
        Part("rose", rose, rgb("d9b45a"), "accent"),
        Part("handle", handle, rgb("d9b45a"), "accent"),
        Part(
            "bands",
            torus(radius, 0.02).at(z=0.03) | torus(0.925 * radius, 0.02).at(z=height - 0.03),
            rgb("d9b45a"),
            "accent",
        ),
    ]


@noun("basket", "wicker basket", "picnic basket", kind="vessels", across=0.4, material="wood")
def basket(v: Variation) -> list[Part]:
    height = v(0.36)
    body = cone(0.3, 0.38, height).bumpy(0.012, wave(22, 0.0)).stretched(y=1.25)
    rim = torus(0.37, 0.032).stretched(y=1.25).at(z=height)
    cloth = ellipsoid(0.36, 0.45, 0.11).at(z=height - 0.03).bumpy(0.015, wave(5, v.uniform(0, 6)))
    return [
        Part("body", body, rgb("c0924f"), "main", "weave", rgb("94682f")),
        Part("rim", rim, rgb("9d6d33"), "main"),
        Part("handle", bail(0.45, height - 0.03, 0.4, 0.032), rgb("9d6d33"), "main"),
        Part("cloth", cloth, rgb("c8463f"), "trim", "checkered", rgb("f6efe2")),
    ]
