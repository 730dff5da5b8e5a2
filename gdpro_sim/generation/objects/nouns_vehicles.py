"""Vehicles, their front towards +X."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Shape,
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
from gdpro_sim.generation.objects.shapes import (
    above,
    below,
    disc_x,
    four,
    front_view,
    lobes,
    lumps,
    side_view,
    wheel,
)

TYRE, HUB, GLASS, LAMP = rgb("2c2d30"), rgb("cfd2d4"), rgb("a9cfdb"), rgb("fff3c4")


def wheels(xs: tuple[float, ...], y: float, radius: float, width: float = 0.1) -> list[Part]:
    """Tyres and hubs at +-y under x in xs, with axles between them."""
    tyre, hub = wheel(radius, width), wheel(0.58 * radius, width)
    axle = capsule((0, -y, 0), (0, y, 0), 0.3 * radius)
    return [
        Part("wheels", union(*(tyre.at(x, y, radius) for x in xs)).mirrored(1), TYRE),
        Part("hubs", union(*(hub.at(x, y + 0.14 * width, radius) for x in xs)).mirrored(1), HUB),
        Part("axles", union(*(axle.at(x, 0, radius) for x in xs)), rgb("55585c")),
    ]


def hull(length: float, width: float, height: float) -> Shape:
    """A boat's hull: its deck at z = height, its bow towards +X."""
    body = ellipsoid(0.5 * length, 0.5 * width, height).at(z=height)
    stem = ellipsoid(0.3 * length, 0.3 * width, 0.8 * height).at(0.22 * length, 0, 0.9 * height)
    return body.blend(stem, 0.1).within(below(height), 0.0).cut(below(0.08 * height), 0.02)


@noun("car", "automobile", "sedan", "hatchback", "toy car", kind="vehicles", across=4.0, material="steel")
def car(v: Variation) -> list[Part]:
    width, height, radius, low = v(0.44), v(0.2), v(0.115, 0.06), 0.09
    body = side_view(
        [
            (-0.47, low + 0.02),
            (0.47, low + 0.02),
            (0.485, low + 0.12),
            (0.45, low + 0.165),
            (0.22, low + 0.20),
            (-0.44, low + 0.21),
            (-0.48, low + 0.16),
        ],
        width,
        0.025,
    )
    top = 0.25 + height
    cabin = side_view([(-0.36, 0.28), (0.2, 0.28), (0.07, top), (-0.26, top)], 0.84 * width, 0.03)
    arches = four(wheel(radius + 0.028, 0.24).at(0.29, 0.5 * width, radius))
    side = side_view([(-0.3, 0.315), (0.135, 0.315), (0.045, top - 0.015), (-0.235, top - 0.015)], width)
    ends = side_view(
        [(0.5, 0.325), (0.1, 0.325), (0.045, top - 0.01), (0.5, top - 0.01)], 0.66 * width
    ) | side_view([(-0.6, 0.325), (-0.3, 0.325), (-0.255, top - 0.01), (-0.6, top - 0.01)], 0.66 * width)
    windows = cabin.rounded(0.008).within(side.cut(box(0.03, 1, 1).at(-0.08)) | ends)
    lamps = sphere(0.042).stretched(x=0.6).at(0.495, 0.34 * width, low + 0.115).mirrored(1)
    tail = box(0.04, 0.09, 0.045, 0.012).at(-0.495, 0.34 * width, low + 0.105).mirrored(1)
    bumper = box(0.05, 0.9 * width, 0.05, 0.02).at(0.49, 0, low + 0.012).mirrored(0)
    paint = rgb("cf4436")
    return [
        Part("body", body - arches, paint, "main"),
        Part("roof", cabin, paint, "trim", blend=0.02),
        Part("windows", windows, GLASS),
        *wheels((0.29, -0.29), 0.5 * width - 0.035, radius),
        Part("headlights", lamps, LAMP),
        Part("tail lights", tail, rgb("8f1d1d")),
        Part("bumpers", bumper, rgb("8b9096")),
    ]


@noun("truck", "lorry", "pickup truck", "dump truck", kind="vehicles", across=6.5, material="steel")
def truck(v: Variation) -> list[Part]:
    width, radius = v(0.36), v(0.085, 0.06)
    chassis = box(0.96, 0.7 * width, 0.07, 0.02).at(0, 0, 0.1)
    cab = side_view([(0.2, 0.13), (0.47, 0.13), (0.48, 0.28), (0.43, 0.47), (0.2, 0.47)], 0.94 * width, 0.018)
    glass = union(
        box(0.14, 2, 0.12, 0.01).at(0.335, 0, 0.3),
        side_view([(0.44, 0.3), (0.8, 0.3), (0.8, 0.43), (0.44, 0.43)], 0.76 * width),
    )
    bed = box(0.62, width, 0.32, 0.012).at(-0.165, 0, 0.15) - box(0.56, width - 0.06, 0.4).at(-0.165, 0, 0.22)
    load = ellipsoid(0.28, 0.44 * width, 0.16).bumpy(0.014, lumps(34.0, v.uniform(0, 9))).at(-0.165, 0, 0.41)
    grille = box(0.03, 0.5 * width, 0.09, 0.008).at(0.495, 0, 0.17)
    lamps = disc_x(0.035, 0.04, 0.01).at(0.5, 0.36 * width, 0.2).mirrored(1)
    pipe = capsule((0.19, 0.36 * width, 0.4), (0.19, 0.36 * width, 0.58), 0.02)
    return [
        Part("cab", cab, rgb("e0a030"), "main", paints=(Paint("windows", glass, GLASS),)),
        Part("bed", bed, rgb("4f7f8c"), "accent"),
        Part("load", load, rgb("b08d60"), "fixed", "mottled", rgb("8a6c45")),
        Part("chassis", chassis, rgb("4a4d52")),
        *wheels((0.33, -0.12, -0.34), 0.5 * width - 0.04, radius, 0.085),
        Part("grille", grille, rgb("6b6f74")),
        Part("headlights", lamps, LAMP),
        Part("bumpers", box(0.05, width, 0.05, 0.015).at(0.495, 0, 0.1), rgb("8b9096")),
        Part("exhaust", pipe, rgb("8b9096")),
    ]


@noun("bus", "school bus", "coach", kind="vehicles", across=10.0, material="steel")
def bus(v: Variation) -> list[Part]:
    width, height, radius = v(0.27, 0.05), v(0.3, 0.05), 0.075
    body = box(0.98, width, height, 0.035).at(z=0.07)
    arches = four(wheel(radius + 0.018, 0.2).at(0.3, 0.5 * width, radius))
    panes = union(
        *(
            box(0.11, 2, 0.105, 0.015).at(x, 0, 0.07 + 0.52 * height)
            for x in (-0.4, -0.265, -0.13, 0.005, 0.14, 0.275)
        )
    )
    ends = box(2, 0.8 * width, 0.13, 0.015).at(0, 0, 0.07 + 0.46 * height)
    door = box(0.1, 0.1, 0.2, 0.01).at(0.41, -0.5 * width, 0.1)
    line = union(box(2, 2, 0.02).at(z=0.07 + 0.36 * height), box(2, 2, 0.014).at(z=0.07 + 0.22 * height))
    lamps = disc_x(0.028, 0.03, 0.008).at(0.49, 0.34 * width, 0.135).mirrored(1)
    roof = box(0.86, 0.8 * width, 0.05, 0.02).at(z=0.055 + height)
    return [
        Part(
            "body",
            body - arches,
            rgb("f2b632"),
            "main",
            paints=(
                Paint("stripes", line, rgb("3a3c40"), "accent"),
                Paint("windows", panes | ends, GLASS),
                Paint("door", door, rgb("7ea3b0")),
            ),
        ),
        Part("roof", roof, rgb("f7efdd"), "trim"),
        *wheels((0.3, -0.3), 0.5 * width - 0.03, radius, 0.075),
        Part("headlights", lamps, LAMP),
        Part("bumpers", box(0.04, width, 0.045, 0.014).at(0.485, 0, 0.07).mirrored(0), rgb("3a3c40")),
    ]


@noun("train", "locomotive", "steam train", "steam engine", kind="vehicles", across=9.0, material="steel")
def train(v: Variation) -> list[Part]:
    radius = v(0.125, 0.06)
    axis = 0.17 + radius
    boiler = disc_x(radius, 0.5, 0.02).at(0.17, 0, axis)
    bands = union(*(disc_x(radius + 0.012, 0.03).at(x, 0, axis) for x in (0.06, 0.2, 0.34)))
    smoke = disc_x(radius + 0.02, 0.07, 0.015).at(0.43, 0, axis)
    cab = box(0.24, 0.32, 0.36, 0.015).at(-0.2, 0, 0.16)
    openings = box(0.12, 2, 0.12, 0.02).at(-0.2, 0, 0.34) | box(2, 0.1, 0.1, 0.02).at(
        -0.2, 0.085, 0.36
    ).mirrored(1)
    roof = box(0.34, 0.4, 0.045, 0.02).at(-0.2, 0, 0.52)
    frame = box(0.82, 0.24, 0.07, 0.015).at(0.06, 0, 0.12)
    stack = cone(0.038, 0.042, 0.16).at(0.36, 0, axis + radius - 0.03) | cone(0.045, 0.082, 0.08, 0.012).at(
        0.36, 0, axis + radius + 0.11
    )
    dome = capsule((0.13, 0, axis + radius - 0.02), (0.13, 0, axis + radius + 0.035), 0.05)
    lamp = disc_x(0.045, 0.05, 0.012).at(0.48, 0, axis + 0.05)
    plow = front_view([(-0.16, 0.05), (0.16, 0.05), (0.1, 0.16), (-0.1, 0.16)], 0.05, 0.008).at(0.48)
    rod = capsule((-0.22, 0.16, 0.1), (0.3, 0.16, 0.1), 0.022).mirrored(1)
    return [
        Part("boiler", boiler, rgb("2f6f5e"), "main"),
        Part("bands", bands, rgb("d9b34a"), "trim"),
        Part("smokebox", smoke, rgb("34373b")),
        Part("cab", cab, rgb("c8463a"), "accent", paints=(Paint("windows", openings, GLASS),)),
        Part("roof", roof, rgb("34373b")),
        Part("chassis", frame, rgb("34373b")),
        Part("chimney", stack, rgb("34373b")),
        Part("dome", dome, rgb("d9b34a"), "trim"),
        Part("headlights", lamp, LAMP),
        Part("plow", plow, rgb("c8463a"), "accent"),
        *wheels((0.3, 0.13), 0.135, 0.085, 0.06),
        *wheels((-0.2,), 0.135, 0.125, 0.06),
        Part("rods", rod, rgb("b9bec2")),
    ]


@noun("boat", "rowboat", "fishing boat", "ship", "tugboat", kind="vehicles", across=5.0, material="wood")
def boat(v: Variation) -> list[Part]:
    deep = v(0.22, 0.06)
    shell = hull(1.0, 0.42, deep)
    room = hull(0.88, 0.34, 0.6 * deep).at(z=0.45 * deep)
    cabin = box(0.24, 0.22, 0.22, 0.03).at(-0.12, 0, 0.5 * deep)
    panes = box(0.1, 2, 0.07, 0.015).at(-0.12, 0, 0.5 * deep + 0.11) | box(2, 0.12, 0.07, 0.015).at(
        -0.12, 0, 0.5 * deep + 0.11
    )
    top = box(0.3, 0.28, 0.04, 0.018).at(-0.12, 0, 0.5 * deep + 0.21)
    funnel = cylinder(0.05, 0.15, 0.01).at(-0.16, 0, 0.5 * deep + 0.22)
    band = box(0.2, 0.2, 0.045).at(-0.16, 0, 0.5 * deep + 0.3)
    stripe = box(4, 4, 0.05).at(z=0.62 * deep)
    rings = torus(0.05, 0.02).rx(90).at(0.12, 0.205, 0.72 * deep).mirrored(1)
    mast = capsule((0.16, 0, 0.5 * deep), (0.16, 0, deep + 0.26), 0.018)
    flag = side_view([(0.16, deep + 0.27), (0.16, deep + 0.17), (0.03, deep + 0.22)], 0.024)
    return [
        Part(
            "hull",
            shell - room,
            rgb("b5463b"),
            "main",
            paints=(Paint("stripe", stripe, rgb("f6efe2"), "accent"),),
        ),
        Part("deck", hull(0.92, 0.37, 0.55 * deep).at(z=0.02).within(above(0.35 * deep)), rgb("c99a5c")),
        Part("cabin", cabin, rgb("f6efe2"), "trim", paints=(Paint("windows", panes, rgb("6fa8bf")),)),
        Part("roof", top, rgb("3f6f8f")),
        Part("chimney", funnel, rgb("e0a030"), paints=(Paint("chimney band", band, rgb("34373b")),)),
        Part("life rings", rings, rgb("f3f0e8")),
        Part("mast", mast, rgb("8d5d31")),
        Part("flag", flag, rgb("e0a030")),
    ]


@noun("sailboat", "sailing boat", "yacht", "toy boat", kind="vehicles", across=7.0, material="wood")
def sailboat(v: Variation) -> list[Part]:
    deep, tall = v(0.15, 0.06), v(0.84, 0.05)
    shell = hull(0.9, 0.3, deep)
    stripe = box(4, 4, 0.035).at(z=0.6 * deep)
    main = side_view([(-0.02, deep + 0.11), (-0.4, deep + 0.11), (-0.02, deep + tall - 0.04)], 0.028, 0.006)
    jib = side_view([(0.06, deep + 0.09), (0.38, deep + 0.04), (0.06, deep + tall - 0.16)], 0.028, 0.006)
    mast = capsule((0.02, 0, 0.5 * deep), (0.02, 0, deep + tall), 0.021)
    boom = capsule((0.02, 0, deep + 0.1), (-0.42, 0, deep + 0.1), 0.017)
    stay = capsule((0.05, 0, deep + tall - 0.14), (0.4, 0, deep + 0.01), 0.013) | capsule(
        (0.04, 0, deep + 0.08), (0.38, 0, deep + 0.03), 0.014
    )
    bands = union(*(box(4, 4, 0.07).at(z=deep + z) for z in (0.2, 0.38, 0.56)))
    pennant = side_view(
        [(0.02, deep + tall + 0.005), (0.02, deep + tall - 0.055), (-0.11, deep + tall - 0.025)], 0.024
    )
    return [
        Part(
            "hull", shell, rgb("3f6f9f"), "main", paints=(Paint("stripe", stripe, rgb("f6efe2"), "accent"),)
        ),
        Part("deck", hull(0.86, 0.27, deep).at(z=0.012).within(above(deep - 0.01)), rgb("cfa064")),
        Part(
            "sails",
            main | jib,
            rgb("fbf6ea"),
            "accent",
            paints=(Paint("bands", bands & box(0.6, 1, 3).at(-0.3), rgb("d5584a")),),
        ),
        Part("mast", mast | boom | stay, rgb("8d5d31")),
        Part("flag", pennant, rgb("d5584a")),
    ]


@noun("rocket", "spaceship", "space rocket", "toy rocket", kind="vehicles", across=12.0, material="aluminium")
def rocket(v: Variation) -> list[Part]:
    wide = v(0.17, 0.06)
    body = revolve(
        smooth_profile(
            [
                (0.1, 0.16),
                (0.14, 0.2),
                (wide, 0.42),
                (0.92 * wide, 0.66),
                (0.11, 0.84),
                (0.03, 0.98),
                (0.0, 1.0),
            ]
        )
    )
    nose, belt = above(0.77), union(box(2, 2, 0.035).at(z=0.7), box(2, 2, 0.03).at(z=0.28))
    port = disc_x(0.062, 0.05, 0.012).at(0.97 * wide, 0, 0.56)
    ring = torus(0.068, 0.02).rx(90).rz(90).at(0.99 * wide, 0, 0.56)
    fin = (
        side_view([(0.1, 0.36), (0.24, 0.24), (0.3, 0.02), (0.26, 0.02), (0.1, 0.2)], 0.045, 0.008)
        .ring(4)
        .rz(45)
    )
    bell = cone(0.11, 0.08, 0.1, 0.01).at(z=0.09)
    fire = revolve(smooth_profile([(0.0, 0.0), (0.035, 0.02), (0.075, 0.08), (0.06, 0.12)]))
    return [
        Part(
            "body",
            body,
            rgb("f3efe6"),
            "main",
            paints=(Paint("nose", nose, rgb("d5463a"), "accent"), Paint("bands", belt, rgb("5d6f86"))),
        ),
        Part("fins", fin, rgb("d5463a"), "accent"),
        Part("window", port, rgb("7cc3dc")),
        Part("ring", ring, rgb("5d6f86")),
        Part("engine", bell, rgb("5d6168")),
        Part("flame", fire, rgb("f5a52e")),
    ]


@noun("airplane", "plane", "aeroplane", "jet", kind="vehicles", across=12.0, material="aluminium")
def airplane(v: Variation) -> list[Part]:
    wide = v(0.1, 0.06)
    body = curved_tube(
        [(-0.46, 0, 0.24), (-0.25, 0, 0.2), (0.1, 0, 0.18), (0.32, 0, 0.18), (0.42, 0, 0.17)],
        [0.035, 0.075, wide, wide - 0.008, 0.07],
    )
    wing = box(0.2, 1.0, 0.035, 0.015).at(0.08, 0, 0.12)
    taper = union(box(0.1, 0.12, 0.1)).at(0.2, 0.5, 0.08).mirrored(1)
    tail = box(0.12, 0.36, 0.03, 0.013).at(-0.41, 0, 0.25)
    fin = side_view([(-0.48, 0.25), (-0.32, 0.25), (-0.4, 0.42), (-0.48, 0.42)], 0.03, 0.01)
    panes = union(
        *(sphere(0.024).at(x, wide - 0.01, 0.21) for x in (-0.2, -0.11, -0.02, 0.07, 0.16))
    ).mirrored(1)
    shield = ellipsoid(0.1, 0.085, 0.065).at(0.27, 0, 0.245)
    spinner = capsule((0.45, 0, 0.17), (0.52, 0, 0.17), 0.036, 0.018)
    turn = v.uniform(10, 80)
    blade = ellipsoid(0.014, 0.03, 0.14).at(0.5, 0, 0.1)
    blades = union(*(blade.rx(turn + 120 * i) for i in range(3))).at(z=0.17)
    gear = capsule((0.1, 0.13, 0.12), (0.12, 0.15, 0.045), 0.017).mirrored(1) | capsule(
        (-0.42, 0, 0.22), (-0.43, 0, 0.16), 0.015
    )
    tyres = (wheel(0.045, 0.035).at(0.12, 0.155, 0.045)).mirrored(1) | wheel(0.024, 0.026).at(-0.43, 0, 0.14)
    tips = box(2, 0.12, 2).at(0, 0.46, -1).mirrored(1)
    return [
        Part("body", body, rgb("d5483c"), "main", paints=(Paint("windows", panes, rgb("a9d3e0")),)),
        Part(
            "wings", wing - taper, rgb("f3ead6"), "accent", paints=(Paint("wing tips", tips, rgb("d5483c")),)
        ),
        Part("tail", tail | fin, rgb("f3ead6"), "accent"),
        Part("cockpit", shield, rgb("a9d3e0")),
        Part("propeller", blades | spinner, rgb("3d4046")),
        Part("gear", gear, rgb("8b9096")),
        Part("wheels", tyres, TYRE),
    ]


@noun("helicopter", "chopper", kind="vehicles", across=9.0, material="aluminium")
def helicopter(v: Variation) -> list[Part]:
    size = v(0.19, 0.05)
    cabin = ellipsoid(0.26, size - 0.01, size).at(0.16, 0, 0.29)
    boom = capsule((0.0, 0, 0.32), (-0.44, 0, 0.36), 0.085, 0.035)
    glass = ellipsoid(0.15, 0.22, 0.13).at(0.36, 0, 0.37)
    door = box(0.12, 2, 0.13, 0.02).at(0.06, 0, 0.26)
    fin = side_view([(-0.49, 0.34), (-0.4, 0.34), (-0.44, 0.51), (-0.5, 0.51)], 0.032, 0.008)
    mast = cylinder(0.028, 0.14).at(0.12, 0, 0.44)
    turn = v.uniform(20, 60)
    blades = union(*(box(0.82, 0.06, 0.028, 0.01).rz(turn + 90 * i).at(0.12, 0, 0.555) for i in range(2)))
    small = union(
        *(box(0.024, 0.028, 0.2, 0.008).at(z=-0.1).ry(90 * i + 40).at(-0.46, 0.035, 0.42) for i in range(2))
    )
    skid = capsule((-0.06, 0.15, 0.03), (0.34, 0.15, 0.03), 0.02) | capsule(
        (0.34, 0.15, 0.03), (0.4, 0.15, 0.07), 0.02
    )
    struts = capsule((0.04, 0.15, 0.03), (0.06, 0.09, 0.17), 0.017) | capsule(
        (0.26, 0.15, 0.03), (0.24, 0.09, 0.17), 0.017
    )
    return [
        Part(
            "body",
            cabin.blend(boom, 0.08),
            rgb("4f8f6f"),
            "main",
            paints=(Paint("door", door, rgb("427a5e")), Paint("windows", glass, GLASS)),
        ),
        Part("tail", fin, rgb("efd9a0"), "accent"),
        Part("rotor", blades | mast | sphere(0.04).at(0.12, 0, 0.57), rgb("3d4046")),
        Part("tail rotor", small | capsule((-0.46, 0, 0.42), (-0.46, 0.05, 0.42), 0.024), rgb("3d4046")),
        Part("skids", (skid | struts).mirrored(1), rgb("8b9096")),
    ]


@noun("hot air balloon", "balloon", kind="vehicles", across=18.0, material="plush")
def hot_air_balloon(v: Variation) -> list[Part]:
    wide = v(0.36, 0.04)
    bag = revolve(
        smooth_profile(
            [(0.08, 0.3), (0.16, 0.38), (wide, 0.66), (0.9 * wide, 0.86), (0.18, 1.0), (0.0, 1.03)]
        )
    )
    skirt = torus(0.1, 0.032).at(z=0.31)
    basket = box(0.17, 0.17, 0.13, 0.02) - box(0.11, 0.11, 0.2).at(z=0.05)
    rim = (box(0.2, 0.2, 0.035, 0.016) - box(0.11, 0.11, 1.0).at(z=-0.3)).at(z=0.115)
    ropes = four(capsule((0.08, 0.08, 0.12), (0.075, 0.075, 0.32), 0.015))
    band = box(2, 2, 0.06).at(z=0.62)
    return [
        Part(
            "envelope",
            bag,
            rgb("d9503f"),
            "main",
            paints=(Paint("panels", lobes(5), rgb("f4cf6a"), "accent"), Paint("band", band, rgb("3f6f8f"))),
        ),
        Part("skirt", skirt, rgb("3f6f8f")),
        Part("ropes", ropes, rgb("8a6a45")),
        Part("basket", basket, rgb("b98350"), "fixed", "weave", rgb("94682f")),
        Part("rim", rim, rgb("8a5a33")),
    ]


@noun("submarine", "sub", kind="vehicles", across=8.0, material="steel")
def submarine(v: Variation) -> list[Part]:
    radius = v(0.19, 0.05)
    body = capsule((-0.22, 0, 0.25), (0.26, 0, 0.25), radius - 0.02, radius)
    tail = capsule((-0.3, 0, 0.25), (-0.44, 0, 0.25), 0.12, 0.05)
    tower = side_view([(-0.1, 0.35), (0.16, 0.35), (0.12, 0.55), (-0.06, 0.55)], 0.16, 0.025)
    scope = curved_tube([(0.0, 0, 0.5), (0.0, 0, 0.66), (0.02, 0, 0.7), (0.08, 0, 0.7)], 0.024)
    ports = union(
        *(disc_x(0.055, 0.06, 0.012).rz(90).at(x, radius - 0.012, 0.27) for x in (-0.12, 0.06, 0.24))
    ).mirrored(1)
    rings = union(
        *(torus(0.06, 0.018).rx(90).at(x, radius + 0.004, 0.27) for x in (-0.12, 0.06, 0.24))
    ).mirrored(1)
    front = sphere(0.075).at(0.26 + radius - 0.045, 0, 0.29)
    fins = box(0.12, 0.4, 0.03, 0.012).at(-0.4, 0, 0.235) | box(0.12, 0.03, 0.36, 0.012).at(-0.4, 0, 0.07)
    blade = ellipsoid(0.018, 0.05, 0.085).at(-0.5, 0, 0.085)
    screw = union(*(blade.rx(90 * i + 45) for i in range(4))).at(z=0.25) | capsule(
        (-0.44, 0, 0.25), (-0.53, 0, 0.25), 0.032
    )
    keel = box(0.4, 0.14, 0.05, 0.02).at(0.02, 0, 0.03)
    return [
        Part("body", body.blend(tail, 0.08), rgb("f0c03a"), "main"),
        Part("tower", tower, rgb("f0c03a"), "main", blend=0.03),
        Part("periscope", scope, rgb("6d7176")),
        Part("windows", ports | front, rgb("8fcbdc")),
        Part("rings", rings, rgb("c9563c"), "accent"),
        Part("fins", fins, rgb("c9563c"), "accent"),
        Part("propeller", screw, rgb("9a7a45")),
        Part("keel", keel, rgb("c9563c"), "accent"),
    ]


@noun("tractor", "farm tractor", kind="vehicles", across=4.0, material="steel")
def tractor(v: Variation) -> list[Part]:
    big = v(0.24, 0.05)
    hood = box(0.44, 0.24, 0.22, 0.04).at(0.22, 0, 0.2)
    grille = box(0.03, 0.17, 0.15, 0.01).at(0.44, 0, 0.23)
    lines = union(*(box(0.2, 0.2, 0.016).at(0.44, 0, z) for z in (0.26, 0.3, 0.34)))
    floor = box(0.4, 0.26, 0.1, 0.02).at(-0.15, 0, 0.18)
    posts = four(capsule((0.11, 0.11, 0.0), (0.095, 0.105, 0.4), 0.018)).at(-0.16, 0, 0.26)
    glass = box(0.2, 0.2, 0.34, 0.01).at(-0.16, 0, 0.28)
    roof = box(0.32, 0.3, 0.045, 0.02).at(-0.16, 0, 0.64)
    fender = (
        (wheel(big + 0.045, 0.13) - wheel(big + 0.012, 0.3)).at(-0.2, 0.22, big).within(above(big + 0.05))
    )
    brace = box(0.12, 0.12, 0.05).at(-0.2, 0.15, 2 * big - 0.02)
    pipe = capsule((0.3, 0.06, 0.4), (0.3, 0.06, 0.56), 0.022)
    lugs = box(0.05, 0.14, 0.04, 0.01).at(big - 0.005)
    tread = lugs.rx(90).ring(14).rx(90).at(-0.2, 0.22, big)
    green = rgb("4f8f4a")
    return [
        Part("hood", hood, green, "main"),
        Part("grille", grille, rgb("3a3c40"), paints=(Paint("bars", lines, rgb("9aa0a4")),)),
        Part("chassis", floor, rgb("3a3c40")),
        Part("cab", glass, rgb("b9d8e0")),
        Part("posts", posts, green, "main"),
        Part("roof", roof, green, "main"),
        Part("fenders", (fender | brace).mirrored(1), green, "main"),
        Part("exhaust", pipe, rgb("6d7176")),
        Part(
            "wheels",
            (wheel(big, 0.13).at(-0.2, 0.22, big) | tread | wheel(0.125, 0.1).at(0.31, 0.19, 0.125)).mirrored(
                1
            ),
            TYRE,
        ),
        Part(
            "hubs",
            (
                wheel(0.55 * big, 0.14).at(-0.2, 0.225, big) | wheel(0.07, 0.11).at(0.31, 0.195, 0.125)
            ).mirrored(1),
            rgb("f0c03a"),
            "accent",
        ),
        Part(
            "axles",
            capsule((-0.2, -0.2, big), (-0.2, 0.2, big), 0.05)
            | capsule((0.31, -0.19, 0.125), (0.31, 0.19, 0.125), 0.04)
            | box(0.1, 0.1, 0.12).at(0.31, 0, 0.1),
            rgb("55585c"),
        ),
    ]


@noun("skateboard", kind="vehicles", across=0.8, material="wood")
def skateboard(v: Variation) -> list[Part]:
    deck = blended(
        0.05,
        box(0.62, 0.24, 0.04, 0.018).at(z=0.13),
        box(0.18, 0.23, 0.04, 0.018).ry(-24).at(0.36, 0, 0.165),
        box(0.18, 0.23, 0.04, 0.018).ry(24).at(-0.36, 0, 0.165),
    )
    grip = above(0.145)
    stripes = union(box(0.07, 2, 3).at(-0.1), box(0.07, 2, 3).at(0.1)) & above(0.15)
    trucks = (
        box(0.1, 0.09, 0.06, 0.015).at(0.24, 0, 0.085)
        | capsule((0.24, -0.12, 0.07), (0.24, 0.12, 0.07), 0.024)
    ).mirrored(0)
    rolls = four(wheel(0.062, 0.07).at(0.24, 0.11, 0.062))
    caps = four(wheel(0.03, 0.085).at(0.24, 0.11, 0.062))
    return [
        Part(
            "deck",
            deck.stretched(y=v(1.0, 0.06)),
            rgb("c98f4f"),
            "main",
            paints=(Paint("grip", grip, rgb("3f8f8a"), "accent"), Paint("stripes", stripes, rgb("f3c23d"))),
        ),
        Part("trucks", trucks, rgb("9aa0a4")),
        Part("wheels", rolls, rgb("f08c5a")),
        Part("caps", caps, rgb("f7efdd")),
    ]
