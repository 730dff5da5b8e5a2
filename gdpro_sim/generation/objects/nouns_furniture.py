"""Furniture."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import box, capsule, union


@noun("chair", "dining chair", kind="furniture", across=0.92, material="wood")
def chair(v: Variation) -> list[Part]:
    width, depth, seat, top = v(0.46), v(0.44), v(0.46, 0.05), v(0.92, 0.05)
    x, y = 0.5 * depth - 0.035, 0.5 * width - 0.035
    legs = union(
        *(
            capsule((1.12 * i * x, 1.1 * j * y, 0.02), (i * x, j * y, seat), 0.024)
            for i in (-1, 1)
            for j in (-1, 1)
        )
    )
    posts = capsule((-x, y, seat), (-x - 0.07, y, top - 0.03), 0.024).mirrored(1)
    slats = union(
        *(
            box(0.03, 2.0 * y, 0.085, 0.014)
            .ry(-9)
            .at(-x - 0.07 * share - 0.003, 0, seat + share * (top - seat) - 0.07)
            for share in (0.45, 0.72, 0.99)
        )
    )
    wood, cushion = rgb("a9713f"), rgb("b8503f")
    return [
        Part("legs", legs, wood, "main", "grain", rgb("8b5a30")),
        Part("back", posts | slats, wood, "main", "grain", rgb("8b5a30")),
        Part("seat", box(depth, width, 0.045, 0.02).at(z=seat - 0.02), wood, "main", "grain", rgb("8b5a30")),
        Part("cushion", box(0.9 * depth, 0.9 * width, 0.055, 0.026).at(z=seat + 0.01), cushion, "accent"),
    ]
