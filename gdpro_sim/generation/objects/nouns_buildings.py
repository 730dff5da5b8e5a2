"""Buildings."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Paint, Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import box, capsule, union
from gdpro_sim.generation.objects.shapes import gable


@noun("house", "cottage", "home", kind="buildings", across=9.0, material="wood")
def house(v: Variation) -> list[Part]:
    depth, width, wall, rise = v(0.72), v(0.8), v(0.46), v(0.38)
    body = box(depth, width, wall) | gable(depth, width, rise).at(z=wall)
    pitch = rise / (0.5 * width)
    inner = gable(depth + 1.0, width + 0.84, rise + 0.42 * pitch).at(z=-0.42 * pitch)
    roof = gable(depth + 0.14, width + 0.2, rise + 0.1 * pitch).at(z=0.055 - 0.1 * pitch) - inner
    roof = roof.at(z=wall).rounded(0.012)
    front = 0.5 * depth
    door = box(0.06, 0.17, 0.3, 0.015).at(front)
    knob = capsule((front + 0.03, 0.05, 0.15), (front + 0.045, 0.05, 0.15), 0.016)
    side = 0.31 * width
    front_windows = box(0.05, 0.17, 0.17, 0.012).at(front, side, 0.17).mirrored(1)
    side_windows = box(0.18, 0.05, 0.17, 0.012).at(0.2, 0.5 * width, 0.17).mirrored(0).mirrored(1)
    back_windows = box(0.05, 0.17, 0.17, 0.012).at(-front, side, 0.17).mirrored(1)
    attic = box(0.05, 0.13, 0.13, 0.012).at(front, 0, wall + 0.06)
    windows = union(front_windows, side_windows, back_windows, attic)
    bars = union(
        box(0.07, 0.02, 0.17).at(front, side, 0.17).mirrored(1),
        box(0.07, 0.17, 0.02).at(front, side, 0.245).mirrored(1),
        box(0.07, 0.02, 0.17).at(-front, side, 0.17).mirrored(1),
        box(0.07, 0.17, 0.02).at(-front, side, 0.245).mirrored(1),
        box(0.02, 0.07, 0.17).at(0.2, 0.5 * width, 0.17).mirrored(0).mirrored(1),
        box(0.18, 0.07, 0.02).at(0.2, 0.5 * width, 0.245).mirrored(0).mirrored(1),
        box(0.07, 0.02, 0.13).at(front, 0, wall + 0.06),
    )
    chimney = box(0.13, 0.13, 0.42).at(-0.15 * depth, 0.24 * width, wall + 0.06)
    cap = box(0.17, 0.17, 0.05, 0.01).at(-0.15 * depth, 0.24 * width, wall + 0.46)
    return [
        Part("walls", body, rgb("f0e2c4"), "main"),
        Part("base", box(depth + 0.06, width + 0.06, 0.06, 0.012), rgb("97918a")),
        Part("roof", roof, rgb("b4503c"), "accent", "bricks", rgb("8f3b2c")),
        Part("door", door, rgb("5a7d5c")),
        Part("knob", knob, rgb("d9b44a")),
        Part("windows", windows, rgb("9cc9dc"), paints=(Paint("window frames", bars, rgb("fbf6ea")),)),
        Part("chimney", chimney | cap, rgb("a8614a"), "fixed", "bricks", rgb("d2b8a4")),
    ]
