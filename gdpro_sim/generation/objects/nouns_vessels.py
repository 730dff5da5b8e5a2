"""Vessels."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    Point2,
    Shape,
    cone,
    curved_tube,
    revolve,
    smooth_curve,
    smooth_profile,
    torus,
)


def hollow(outline: list[Point2], wall: float, floor: float, per_span: int = 4) -> Shape:
    """An open vessel: the solid under a smooth (radius, z) outline, hollowed from above."""
    line = smooth_curve(outline, per_span)
    outer = [(0.0, float(line[0, 1]))] + [(float(r), float(z)) for r, z in line] + [(0.0, float(line[-1, 1]))]
    bottom, top = float(line[0, 1]) + floor, float(line[-1, 1])
    inner = [(max(float(r) - wall, 0.3 * float(r)), float(z)) for r, z in line if z > bottom]
    first, last = inner[0][0], inner[-1][0]
    well = [(0.0, bottom), (0.7 * first, bottom + 0.003), *inner, (last, top + 1.0), (0.0, top + 1.0)]
    return revolve(outer) - revolve(well)


def loop_handle(x: float, low: float, high: float, reach: float, thickness: float) -> Shape:
    """A bent handle in the XZ plane that starts and ends at radius x; turn it to the side."""
    mid = 0.5 * (low + high)
    return curved_tube(
        [
            (x, 0, high),
            (x + 0.7 * reach, 0, high + 0.02),
            (x + reach, 0, mid + 0.12 * (high - low)),
            (x + 0.75 * reach, 0, low + 0.12 * (high - low)),
            (x - 0.01, 0, low),
        ],
        thickness,
    )


@noun("mug", "coffee mug", "tea mug", kind="vessels", across=0.125, material="ceramic")
def mug(v: Variation) -> list[Part]:
    height, radius = v(1.0), v(0.42)
    wall = 0.06
    body = cone(0.96 * radius, radius, height, 0.03)
    cavity = cone(0.96 * radius - wall, radius - wall, height, 0.02).at(z=0.07)
    rim = torus(radius - 0.5 * wall, 0.5 * wall + 0.004).at(z=height - 0.5 * wall)
    handle = loop_handle(radius - 0.02, 0.2 * height, 0.78 * height, v(0.32), v(0.052)).rz(90)
    return [
        Part("body", body - cavity, rgb("5f8fb8"), "main"),
        Part("rim", rim, rgb("f2ead8"), "accent"),
        Part("handle", handle - cavity, rgb("5f8fb8"), "main"),
    ]


@noun("vase", "flower vase", kind="vessels", across=0.30, material="ceramic")
def vase(v: Variation) -> list[Part]:
    height, belly, neck = 1.0, v(0.32, 0.15), v(0.15, 0.15)
    foot, lip = v(0.19), v(0.21)
    outline: list[Point2] = [
        (foot, 0.0),
        (0.8 * belly, 0.14),
        (belly, 0.38),
        (0.75 * belly, 0.62),
        (neck, 0.8),
        (0.5 * (neck + lip), 0.93),
        (lip, height),
    ]
    return [
        Part("body", hollow(outline, 0.045, 0.06), rgb("3f7f88"), "main"),
        Part("rim", torus(lip - 0.01, 0.03).at(z=height - 0.01), rgb("e9dcc0"), "accent"),
        Part(
            "foot",
            revolve(smooth_profile([(foot + 0.02, 0.0), (foot + 0.025, 0.025), (foot, 0.05)])),
            rgb("e9dcc0"),
            "accent",
        ),
    ]
