"""Vehicles."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import box, cylinder, sphere, union
from gdpro_sim.generation.objects.shapes import side_view, wheel


@noun("car", "automobile", "sedan", "hatchback", kind="vehicles", across=4.0, material="steel")
def car(v: Variation) -> list[Part]:
    width, height = v(0.44), v(0.2)
    wheel_radius = v(0.115, 0.06)
    low = 0.09
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
    cabin = side_view(
        [(-0.36, 0.28), (0.2, 0.28), (0.07, 0.28 + height - 0.03), (-0.26, 0.28 + height - 0.03)],
        0.84 * width,
        0.03,
    )
    arch_at = (0.29, 0.5 * width, wheel_radius)
    arches = wheel(wheel_radius + 0.028, 0.24).at(*arch_at).mirrored(0).mirrored(1)
    glass_side = side_view(
        [(-0.3, 0.315), (0.135, 0.315), (0.045, 0.275 + height - 0.04), (-0.235, 0.275 + height - 0.04)],
        0.84 * width + 0.03,
    ) - box(0.03, 1, 1).at(-0.08)
    glass_front = side_view(
        [(0.5, 0.325), (0.1, 0.325), (0.045, 0.28 + height - 0.04), (0.5, 0.28 + height - 0.04)], 0.66 * width
    )
    glass_back = side_view(
        [(-0.6, 0.325), (-0.3, 0.325), (-0.255, 0.28 + height - 0.04), (-0.6, 0.28 + height - 0.04)],
        0.66 * width,
    )
    shell = cabin.rounded(0.008)
    windows = shell.within(union(glass_side, glass_front, glass_back))
    tyres = wheel(wheel_radius, 0.1).at(0.29, 0.5 * width - 0.035, wheel_radius).mirrored(0).mirrored(1)
    hubs = wheel(0.58 * wheel_radius, 0.1).at(0.29, 0.5 * width - 0.02, wheel_radius).mirrored(0).mirrored(1)
    axles = (
        cylinder(0.035, width - 0.04).at(z=0.02 - 0.5 * width).rx(90).at(0.29, 0, wheel_radius).mirrored(0)
    )
    lamps = sphere(0.042).stretched(x=0.6).at(0.495, 0.34 * width, low + 0.115).mirrored(1)
    tail = box(0.04, 0.09, 0.045, 0.012).at(-0.495, 0.34 * width, low + 0.105).mirrored(1)
    bumper = box(0.05, 0.9 * width, 0.05, 0.02).at(0.49, 0, low + 0.012).mirrored(0)
    paint = rgb("cf4436")
    return [
        Part("body", body - arches, paint, "main"),
        Part("roof", cabin, paint, "main", blend=0.02),
        Part("windows", windows, rgb("a9cfdb")),
        Part("wheels", tyres, rgb("2c2d30")),
        Part("hubs", hubs, rgb("cfd2d4")),
        Part("headlights", lamps, rgb("fff3c4")),
        Part("tail lights", tail, rgb("8f1d1d")),
        Part("axles", axles, rgb("55585c")),
        Part("bumpers", bumper, rgb("8b9096")),
    ]
