"""Furniture and what stands about in a room."""

from __future__ import annotations

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
from gdpro_sim.generation.objects.shapes import disc_x, four, legs, lobes, side_view, star, wave

OAK, OAK_DARK = rgb("b07a45"), rgb("8d5d31")


@noun("chair", "dining chair", "kitchen chair", kind="furniture", across=0.92, material="wood")
def chair(v: Variation) -> list[Part]:
    width, depth, seat, top = v(0.46), v(0.44), v(0.46, 0.05), v(0.92, 0.05)
    x, y = 0.5 * depth - 0.035, 0.5 * width - 0.035
    posts = capsule((-x, y, seat), (-x - 0.07, y, top - 0.03), 0.026).mirrored(1)
    rise = top - seat
    slats = union(
        *(
            box(0.036, 2.0 * y, 0.085, 0.016).ry(-9).at(-x - 0.07 * s - 0.003, 0, seat + s * rise - 0.07)
            for s in (0.45, 0.72, 0.99)
        )
    )
    rungs = capsule((x + 0.01, y, 0.2), (-x - 0.01, y, 0.2), 0.016).mirrored(1)
    return [
        Part("legs", legs(x, y, seat, 0.027, 1.1) | rungs, OAK, "main", "grain", OAK_DARK),
        Part("back", posts | slats, OAK, "main", "grain", OAK_DARK),
        Part("seat", box(depth, width, 0.045, 0.02).at(z=seat - 0.02), OAK, "main", "grain", OAK_DARK),
        Part("cushion", box(0.9 * depth, 0.9 * width, 0.06, 0.028).at(z=seat + 0.01), rgb("b8503f"), "trim"),
    ]


@noun("table", "dining table", "coffee table", kind="furniture", across=1.4, material="wood")
def table(v: Variation) -> list[Part]:
    width, depth, height = 1.4, v(0.85), v(0.74, 0.04)
    x, y = 0.5 * depth - 0.1, 0.5 * width - 0.1
    leg = cone(0.034, 0.052, height - 0.03).at(x, y)
    apron = box(2 * x + 0.06, 2 * y + 0.06, 0.1) - box(2 * x - 0.03, 2 * y - 0.03, 0.3).at(z=-0.1)
    return [
        Part("top", box(depth, width, 0.055, 0.02).at(z=height - 0.055), OAK, "main", "grain", OAK_DARK),
        Part("apron", apron.at(z=height - 0.14), rgb("9a6737"), "main", "grain", rgb("7c502a")),
        Part("legs", four(leg), rgb("9a6737"), "main", "grain", rgb("7c502a")),
    ]


@noun("stool", "bar stool", kind="furniture", across=0.62, material="wood")
def stool(v: Variation) -> list[Part]:
    height, radius = v(0.6, 0.06), v(0.19, 0.06)
    spread = 0.72 * radius
    ring = torus(1.28 * spread, 0.016).at(z=0.36 * height)
    seat = cylinder(radius, 0.05, 0.022).at(z=height - 0.05)
    pad = ellipsoid(0.88 * radius, 0.88 * radius, 0.045).at(z=height)
    leg = capsule((1.48 * spread, 0, 0.024), (0.86 * spread, 0, height - 0.03), 0.024).rz(45)
    return [
        Part("legs", four(leg) | ring, OAK, "main", "grain", OAK_DARK),
        Part("seat", seat, OAK, "main", "grain", OAK_DARK),
        Part("cushion", pad, rgb("3f7f88"), "trim"),
    ]


@noun("bench", "park bench", kind="furniture", across=1.5, material="wood")
def bench(v: Variation) -> list[Part]:
    half = 0.75
    seat = union(*(box(0.11, 2 * half, 0.045, 0.015).at(x, 0, 0.43) for x in (-0.14, 0.0, 0.14)))
    back = union(
        *(box(0.045, 2 * half, 0.1, 0.015).ry(-12).at(-0.235 - 0.24 * (z - 0.55), 0, z) for z in (0.56, 0.72))
    )
    y = half - 0.2
    frame = union(
        tube([(0.2, y, 0.03), (0.17, y, 0.41), (-0.2, y, 0.41)], 0.03),
        tube([(-0.27, y, 0.03), (-0.2, y, 0.41), (-0.29, y, 0.86)], 0.03),
        tube([(0.17, y, 0.41), (0.2, y, 0.62), (-0.23, y, 0.66)], 0.025),
    )
    return [
        Part("seat", seat, OAK, "main", "grain", OAK_DARK),
        Part("back", back, OAK, "main", "grain", OAK_DARK),
        Part("legs", frame.mirrored(1), rgb("3d4145"), "accent"),
    ]


@noun("bookshelf", "bookcase", "shelf", kind="furniture", across=1.6, material="wood")
def bookshelf(v: Variation) -> list[Part]:
    width, depth, height = v(0.8), 0.3, 1.6
    case = box(depth, width, height, 0.01)
    board = 0.045
    shelf_count = 4
    bay = (height - 0.1 - board) / shelf_count
    for i in range(shelf_count):
        room = box(depth, width - 2 * board, bay - board).at(0.055, 0, 0.1 + i * bay)
        case = case - room
    books: list[list[tuple[float, float, float, float]]] = [[], [], [], []]
    for i in range(shelf_count):
        y = -0.5 * width + board
        end = 0.5 * width - board - v.uniform(0.02, 0.2)
        count = 0
        while y < end - 0.07:
            thick = v.uniform(0.05, 0.085)
            tall = v.uniform(0.7, 0.93) * (bay - board)
            books[(count + i) % 4].append((y + 0.5 * thick, 0.1 + i * bay, thick, tall))
            y, count = y + thick, count + 1
    names = ("c0473c", "3f6f9f", "e0b04c", "5b8f5e")
    rows = [
        Part(
            "books",
            union(
                *(
                    box(v.uniform(0.19, 0.22), t + 0.004, h + 0.012, 0.008).at(-0.005, y, z - 0.01)
                    for y, z, t, h in some
                )
            ),
            rgb(name),
            "trim" if i == 0 else "fixed",
        )
        for i, (name, some) in enumerate(zip(names, books, strict=True))
    ]
    return [Part("case", case, OAK, "main", "grain", OAK_DARK), *rows]


@noun("bed", "double bed", kind="furniture", across=2.1, material="wood")
def bed(v: Variation) -> list[Part]:
    width = v(1.5, 0.06)
    frame = box(2.05, width, 0.2, 0.03).at(z=0.14)
    feet = four(cylinder(0.06, 0.2).at(0.93, 0.5 * width - 0.12))
    head = side_view([(-1.05, 0.1), (-0.97, 0.1), (-0.97, 1.0), (-1.05, 1.0)], width, 0.0) | cylinder(
        0.06, width
    ).at(z=-0.5 * width).rx(90).at(-1.01, 0, 1.0)
    foot = box(0.08, width, 0.42, 0.03).at(1.01, 0, 0.1)
    mattress = box(1.92, 0.94 * width, 0.24, 0.08).at(z=0.28)
    blanket = box(1.3, 0.97 * width, 0.26, 0.09).at(0.33, 0, 0.285)
    fold = box(0.16, 0.975 * width, 0.27, 0.08).at(-0.3, 0, 0.285)
    pillow = ellipsoid(0.22, 0.3, 0.11).at(-0.7, 0.23 * width, 0.56).mirrored(1)
    return [
        Part("frame", frame | feet | head | foot, OAK, "main", "grain", OAK_DARK),
        Part("mattress", mattress, rgb("f4efe4")),
        Part("blanket", blanket, rgb("5f86b3"), "trim"),
        Part("sheet", fold, rgb("f4efe4")),
        Part("pillows", pillow, rgb("fbf8ef")),
    ]


@noun("sofa", "couch", "settee", kind="furniture", across=2.0, material="foam")
def sofa(v: Variation) -> list[Part]:
    width, depth = 2.0, v(0.85, 0.05)
    base = box(depth, width - 0.1, 0.28, 0.06).at(z=0.1)
    back = box(0.26, width - 0.1, 0.7, 0.1).ry(-8).at(-0.5 * depth + 0.14, 0, 0.12)
    arm = (
        box(depth, 0.24, 0.46, 0.08).at(0, 0, 0.1)
        | cylinder(0.13, depth, 0.05).at(z=-0.5 * depth).ry(90).at(0, 0, 0.56)
    ).at(0, 0.5 * width - 0.12)
    seat = box(0.66, 0.79, 0.2, 0.075).at(0.08, 0.4, 0.36).mirrored(1)
    rest = box(0.2, 0.78, 0.44, 0.085).ry(-10).at(-0.22, 0.4, 0.52).mirrored(1)
    pillow = box(0.13, 0.38, 0.38, 0.062).rx(12).ry(-14).at(0.06, 0.6, 0.55)
    blue = rgb("4f7c8c")
    return [
        Part("body", base | back, blue, "main"),
        Part("arms", arm.mirrored(1), blue, "main"),
        Part("cushions", seat | rest, rgb("5f8d9c"), "main"),
        Part("pillow", pillow, rgb("e0a84c"), "trim"),
        Part("legs", four(cone(0.03, 0.045, 0.14).at(0.5 * depth - 0.1, 0.5 * width - 0.14)), rgb("6e4a2c")),
    ]


@noun("armchair", "easy chair", "recliner", kind="furniture", across=0.95, material="foam")
def armchair(v: Variation) -> list[Part]:
    width = v(0.9, 0.05)
    base = box(0.76, width - 0.1, 0.26, 0.06).at(z=0.12)
    back = box(0.24, width - 0.08, 0.78, 0.11).ry(-9).at(-0.28, 0, 0.14)
    arm = blended(0.06, box(0.74, 0.2, 0.4, 0.08).at(z=0.12), disc_x(0.12, 0.74, 0.05).at(z=0.54)).at(
        0.02, 0.5 * width - 0.1
    )
    seat = box(0.58, width - 0.36, 0.19, 0.08).at(0.09, 0, 0.34)
    buttons = union(
        *(sphere(0.026).at(-0.205 - 0.16 * (z - 0.6), y, z) for z in (0.66, 0.8) for y in (-0.16, 0.0, 0.16))
    )
    red = rgb("b0524a")
    return [
        Part("body", base | back, red, "main"),
        Part("arms", arm.mirrored(1), red, "main"),
        Part("cushion", seat, rgb("c0665c"), "main"),
        Part("buttons", buttons, rgb("e9d3a8"), "accent"),
        Part("legs", four(cone(0.026, 0.04, 0.16).at(0.3, 0.5 * width - 0.12)), rgb("6e4a2c"), "accent"),
    ]


@noun("lamp", "table lamp", "desk lamp", kind="furniture", across=0.5, material="ceramic")
def lamp(v: Variation) -> list[Part]:
    belly = v(0.17, 0.15)
    base = revolve(
        smooth_profile(
            [(0.11, 0.03), (0.13, 0.06), (belly, 0.2), (0.8 * belly, 0.34), (0.05, 0.48), (0.04, 0.6)]
        )
    )
    shade = cone(0.31, 0.17, 0.36) - cone(0.275, 0.13, 0.4).at(z=-0.08)
    bulb = sphere(0.09).at(z=0.72) | cylinder(0.035, 0.2).at(z=0.55)
    spider = (
        box(0.5, 0.035, 0.035).at(z=0.9) | box(0.035, 0.5, 0.035).at(z=0.9) | cylinder(0.028, 0.35).at(z=0.6)
    )
    return [
        Part("base", base, rgb("2f7f86"), "accent"),
        Part("foot", cylinder(0.14, 0.05, 0.018), rgb("c9a24b")),
        Part("shade", shade.at(z=0.62), rgb("f2e2bd"), "main"),
        Part("trim", torus(0.292, 0.021).at(z=0.63) | torus(0.152, 0.021).at(z=0.97), rgb("c9a24b")),
        Part("bulb", bulb, rgb("fff1b8")),
        Part("frame", spider.within(cone(0.3, 0.16, 0.36).at(z=0.62)), rgb("c9a24b")),
    ]


@noun("desk", "writing desk", kind="furniture", across=1.3, material="wood")
def desk(v: Variation) -> list[Part]:
    depth = v(0.62)
    top = box(depth, 1.3, 0.05, 0.018).at(z=0.7)
    cabinet = box(depth - 0.06, 0.4, 0.66, 0.01).at(0, 0.42, 0.06)
    faces = union(*(box(0.04, 0.35, 0.18, 0.012).at(0.5 * depth - 0.03, 0.42, z) for z in (0.1, 0.3, 0.5)))
    knobs = union(*(sphere(0.026).at(0.5 * depth + 0.008, 0.42, z) for z in (0.19, 0.39, 0.59)))
    leg = cone(0.025, 0.04, 0.72)
    feet = union(leg.at(0.5 * depth - 0.06, -0.58), leg.at(0.06 - 0.5 * depth, -0.58))
    corner = four(cylinder(0.03, 0.1).at(0.5 * depth - 0.08, 0.15)).at(0, 0.42)
    return [
        Part("top", top, OAK, "main", "grain", OAK_DARK),
        Part("cabinet", cabinet, OAK, "main", "grain", OAK_DARK),
        Part("drawers", faces, rgb("c7935a"), "accent", "grain", rgb("a87542")),
        Part("knobs", knobs, rgb("d8b24a")),
        Part("legs", feet | corner, rgb("8d5d31"), "main", "grain", rgb("74491f")),
    ]


@noun(
    "dresser",
    "chest of drawers",
    "drawers",
    "cabinet",
    "nightstand",
    kind="furniture",
    across=1.0,
    material="wood",
)
def dresser(v: Variation) -> list[Part]:
    width, depth = v(0.9, 0.06), 0.45
    body = box(depth, width, 0.82, 0.015).at(z=0.13)
    top = box(depth + 0.06, width + 0.06, 0.05, 0.02).at(z=0.94)
    rows = (0.18, 0.43, 0.68)
    faces = union(
        *(box(0.05, 0.46 * width, 0.22, 0.015).at(0.5 * depth, 0.24 * width, z) for z in rows)
    ).mirrored(1)
    knobs = union(*(sphere(0.028).at(0.5 * depth + 0.04, 0.24 * width, z + 0.11) for z in rows)).mirrored(1)
    blue = rgb("7fa6a8")
    return [
        Part("body", body, blue, "main"),
        Part("top", top, OAK, "accent", "grain", OAK_DARK),
        Part("drawers", faces, rgb("93b8b8"), "main"),
        Part("knobs", knobs, rgb("d8b24a")),
        Part(
            "legs", four(cone(0.026, 0.045, 0.16).at(0.5 * depth - 0.07, 0.5 * width - 0.08)), OAK, "accent"
        ),
    ]


@noun("wardrobe", "closet", "armoire", kind="furniture", across=2.0, material="wood")
def wardrobe(v: Variation) -> list[Part]:
    width, depth = v(1.15, 0.06), 0.58
    body = box(depth, width, 1.8, 0.02).at(z=0.1)
    crown = box(depth + 0.1, width + 0.1, 0.09, 0.03).at(z=1.88)
    plinth = box(depth + 0.04, width + 0.04, 0.14, 0.02)
    door = box(0.06, 0.46 * width, 1.6, 0.02).at(0.5 * depth, 0.245 * width, 0.2).mirrored(1)
    panels = box(0.1, 0.32 * width, 0.62, 0.02).at(0.5 * depth + 0.01, 0.245 * width, 0.3)
    panels = (panels | panels.at(z=0.78)).mirrored(1)
    handles = capsule((0.5 * depth + 0.055, 0.07, 0.92), (0.5 * depth + 0.055, 0.07, 1.12), 0.026).mirrored(1)
    return [
        Part("body", body, OAK, "main", "grain", OAK_DARK),
        Part("top", crown | plinth, rgb("8d5d31"), "main", "grain", rgb("74491f")),
        Part("doors", door, rgb("bd8750"), "accent", "grain", rgb("9d6b39")),
        Part("panels", panels, rgb("a8723e"), "main", "grain", rgb("8d5d31")),
        Part("handles", handles, rgb("d8b24a")),
    ]


@noun("clock", "alarm clock", kind="furniture", across=0.16, material="steel")
def clock(v: Variation) -> list[Part]:
    radius = v(0.36, 0.04)
    body = disc_x(radius, 0.26, 0.05).at(z=0.45)
    face = disc_x(radius - 0.06, 0.05).at(0.125, 0, 0.45)
    ticks = box(0.2, 0.035, 0.07).at(0.12, 0, radius - 0.15)
    marks = union(*(ticks.rx(30.0 * i) for i in range(12))).at(z=0.45)
    hands = capsule((0.16, 0, 0.45), (0.16, 0.13, 0.56), 0.022) | capsule(
        (0.16, 0, 0.45), (0.16, -0.06, 0.65), 0.019
    )
    bell = (
        (ellipsoid(0.15, 0.15, 0.12).within(box(2, 2, 1)) | sphere(0.035).at(z=0.13))
        .rx(-34)
        .at(0, 0.21, 0.76)
        .mirrored(1)
    )
    feet = capsule((0, 0.2, 0.2), (0, 0.3, 0.04), 0.04).mirrored(1)
    posts = capsule((0, 0.12, 0.65), (0, 0.21, 0.8), 0.035).mirrored(1)
    strike = capsule((0, 0, 0.78), (0, 0, 0.93), 0.025) | sphere(0.05).at(z=0.93)
    red = rgb("c5463a")
    return [
        Part("body", body, red, "main"),
        Part("face", face, rgb("faf5e8"), paints=(Paint("numbers", marks, rgb("3a3a3c")),)),
        Part("hands", hands | sphere(0.04).at(0.16, 0, 0.45), rgb("2b2b2d")),
        Part("bells", bell, rgb("d9b34e"), "accent"),
        Part("hammer", strike | posts, rgb("d9b34e"), "accent"),
        Part("feet", feet, rgb("d9b34e"), "accent"),
    ]


@noun("candle", "candlestick", "candle holder", kind="furniture", across=0.22, material="wax")
def candle(v: Variation) -> list[Part]:
    height = v(0.56)
    dish = (
        revolve([(0.0, 0.0), (0.22, 0.0), (0.3, 0.08), (0.27, 0.1), (0.2, 0.045), (0.0, 0.045)])
        .rounded(0.012)
        .at(z=0.012)
    )
    loop = torus(0.085, 0.026).rx(90).rz(90).at(0, 0.34, 0.12)
    cup = cylinder(0.125, 0.14, 0.02).at(z=0.03)
    wax = cylinder(0.095, height, 0.02).at(z=0.12)
    drips = union(
        capsule((0.092, 0.02, 0.08 + height), (0.1, 0.02, v.uniform(0.3, 0.5) * height + 0.12), 0.026, 0.034),
        capsule((-0.05, 0.08, 0.08 + height), (-0.055, 0.088, 0.6 * height + 0.12), 0.026, 0.032),
        capsule((0.03, -0.092, 0.08 + height), (0.032, -0.096, 0.45 * height + 0.12), 0.024, 0.034),
    )
    flame = revolve(smooth_profile([(0.0, 0.0), (0.05, 0.04), (0.056, 0.09), (0.025, 0.16), (0.0, 0.22)])).at(
        z=0.17 + height
    )
    wick = capsule((0, 0, height + 0.1), (0, 0, height + 0.2), 0.018)
    glow = sphere(0.05).at(z=0.24 + height)
    return [
        Part("holder", dish | cup | loop, rgb("c99b45"), "accent"),
        Part("wax", wax.blend(drips, 0.02), rgb("f1e6cf"), "main"),
        Part("wick", wick, rgb("4a3b30")),
        Part("flame", flame, rgb("f29a33"), paints=(Paint("glow", glow, rgb("ffd766")),)),
    ]


@noun("umbrella", "parasol", kind="furniture", across=1.0, material="plush")
def umbrella(v: Variation) -> list[Part]:
    radius = 0.5
    dome = ellipsoid(radius, radius, 0.34).at(z=0.58)
    canopy = (dome - ellipsoid(radius - 0.035, radius - 0.035, 0.3).at(z=0.58)).within(
        box(2, 2, 1).at(z=0.6).bumpy(0.028, wave(8, 0.0))
    )
    sectors = Paint("panels", lobes(4), rgb("f6efe0"), "accent")
    crook = curved_tube(
        [(0, 0, 0.25), (0, 0, 0.1), (0, 0.045, 0.035), (0, 0.1, 0.06), (0, 0.115, 0.13)], 0.026
    )
    ribs = capsule((0.02, 0, 0.72), (0.3, 0, 0.84), 0.014).ring(8)
    return [
        Part("canopy", canopy, rgb("c8463f"), "main", paints=(sectors,)),
        Part("shaft", capsule((0, 0, 0.22), (0, 0, 0.95), 0.019) | ribs, rgb("6d6f73")),
        Part("tip", capsule((0, 0, 0.9), (0, 0, 0.98), 0.026, 0.016), rgb("8a5a33")),
        Part("handle", crook, rgb("8a5a33")),
    ]


@noun("gift", "gift box", "present", kind="furniture", across=0.25, material="paper")
def gift(v: Variation) -> list[Part]:
    height = v(0.62)
    paper = box(0.76, 0.76, height, 0.02)
    lid = box(0.84, 0.84, 0.18, 0.025).at(z=height - 0.02)
    band = box(0.86, 0.14, height + 0.17, 0.01) | box(0.14, 0.86, height + 0.17, 0.01)
    band = band.rounded(0.008).at(z=0.008)
    loop = (
        torus(0.12, 0.045)
        .stretched(x=1.25)
        .rx(90)
        .rz(90)
        .at(0, 0.15, 0.1)
        .rx(12)
        .mirrored(1)
        .at(z=height + 0.16)
    )
    tail = capsule((0.02, 0.03, 0.03), (0.24, 0.16, 0.03), 0.042).mirrored(1).at(z=height + 0.15)
    red = rgb("d9534a")
    return [
        Part("box", paper, rgb("4d8f8a"), "main"),
        Part("lid", lid, rgb("4d8f8a"), "main"),
        Part("ribbon", band, red, "accent"),
        Part("bow", loop | tail | sphere(0.085).at(z=height + 0.22), red, "accent"),
    ]


@noun("trophy", "trophy cup", kind="furniture", across=0.36, material="gold")
def trophy(v: Variation) -> list[Part]:
    cup = revolve(smooth_profile([(0.05, 0.38), (0.16, 0.46), (0.23, 0.6), (0.26, 0.84)]))
    cup = cup - revolve(smooth_profile([(0.0, 0.52), (0.12, 0.54), (0.19, 0.64), (0.215, 0.88)]))
    stem = revolve(
        smooth_profile([(0.17, 0.16), (0.15, 0.2), (0.05, 0.25), (0.06, 0.32), (0.045, 0.36), (0.07, 0.4)])
    )
    ears = curved_tube(
        [(0, 0.22, 0.78), (0, 0.38, 0.8), (0, 0.4, 0.64), (0, 0.27, 0.54), (0, 0.16, 0.5)], 0.028
    ).mirrored(1)
    base = box(0.36, 0.36, 0.16, 0.025)
    badge = extrude(star(5, 0.09, 0.038), 0.05).at(z=-0.025).ry(90).rx(90).at(0.235, 0, 0.68)
    plate = box(0.05, 0.22, 0.08, 0.01).at(0.17, 0, 0.045)
    gold = rgb("e0b040")
    return [
        Part("cup", cup, gold, "main"),
        Part("rim", torus(0.24, 0.028).at(z=0.845), rgb("efc75e"), "main"),
        Part("stem", stem, gold, "main"),
        Part("handles", ears, rgb("efc75e"), "main"),
        Part("star", badge, rgb("fff0bd")),
        Part("base", base, rgb("5a3d2a"), "accent"),
        Part("plate", plate, rgb("efc75e")),
    ]
