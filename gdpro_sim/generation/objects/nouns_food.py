"""Food."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Part, Variation, color, noun, rgb
from gdpro_sim.generation.objects.sdf import (
    box,
    curved_tube,
    ellipsoid,
    revolve,
    smooth_profile,
    torus,
)
from gdpro_sim.generation.objects.shapes import wave


@noun("apple", kind="food", across=0.085, material="fruit")
def apple(v: Variation) -> list[Part]:
    width = v(0.5, 0.06)
    body = revolve(
        smooth_profile(
            [
                (0.0, 0.07),
                (0.12, 0.02),
                (0.24, 0.03),
                (0.86 * width, 0.24),
                (width, 0.52),
                (0.88 * width, 0.78),
                (0.28, 0.90),
                (0.12, 0.87),
                (0.0, 0.77),
            ]
        )
    )
    lean = v.uniform(0.03, 0.09)
    stem = curved_tube([(0, 0, 0.74), (0.01, 0, 0.9), (lean, 0, 1.06)], [0.026, 0.024, 0.034])
    leaf = ellipsoid(0.17, 0.085, 0.028).ry(-22).at(0.17, 0.0, 0.03).rz(v.uniform(40, 80)).at(z=0.97)
    return [
        Part("body", body, rgb("c63a32"), "main", "streaks", rgb("edb957")),
        Part("stem", stem, rgb("6b4a2f")),
        Part("leaf", leaf, rgb("5d9a43")),
    ]


@noun("donut", "doughnut", kind="food", across=0.10, material="bread")
def donut(v: Variation) -> list[Part]:
    thick = v(0.2, 0.1)
    ring = torus(0.32, thick).stretched(z=0.86)
    edge = box(2.0, 2.0, 1.0).bumpy(0.045, wave(7, v.uniform(0, 6.28))).at(z=0.02)
    icing = torus(0.32, thick + 0.025).stretched(z=0.86).within(edge, 0.04)
    sprinkles = tuple(color(name, 0.15) for name in ("yellow", "turquoise", "white", "lime", "orange"))
    return [
        Part("dough", ring, rgb("c98f4f")),
        Part("icing", icing, rgb("e78aa8"), "main", "dotted", None, (0.085, 0.02), sprinkles),
    ]
