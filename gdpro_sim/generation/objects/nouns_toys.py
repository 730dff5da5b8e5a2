"""Toys."""

from __future__ import annotations

from gdpro_sim.generation.objects.parts import Part, Variation, noun, rgb
from gdpro_sim.generation.objects.sdf import blended, box, ellipsoid, sphere


@noun("rubber duck", "duck", "rubber ducky", "toy duck", kind="toys", across=0.10, material="rubber")
def rubber_duck(v: Variation) -> list[Part]:
    head_radius = v(0.25, 0.06)
    body = ellipsoid(0.46, 0.36, 0.29).at(z=0.26)
    tail = ellipsoid(0.16, 0.16, 0.07).ry(38).at(-0.44, 0, 0.44)
    chest = sphere(0.26).at(0.17, 0, 0.3)
    trunk = blended(0.16, body, tail, chest).within(box(2, 2, 2).at(z=0.04), 0.03)
    head = sphere(head_radius).at(0.2, 0, 0.72)
    wing = blended(
        0.06, ellipsoid(0.22, 0.07, 0.13).ry(14).at(-0.08, 0.34, 0.3), sphere(0.05).at(-0.3, 0.34, 0.4)
    )
    upper = ellipsoid(0.14, 0.115, 0.045).ry(-8).at(0.2 + head_radius + 0.02, 0, 0.695)
    lower = ellipsoid(0.11, 0.09, 0.035).ry(12).at(0.2 + head_radius + 0.005, 0, 0.645)
    eye_at = (0.2 + 0.8 * head_radius, 0.46 * head_radius, 0.72 + 0.36 * head_radius)
    white = sphere(0.055).at(*eye_at).mirrored(1)
    pupil = sphere(0.036).at(eye_at[0] + 0.032, eye_at[1] + 0.012, eye_at[2] + 0.006).mirrored(1)
    yellow = rgb("f4c630")
    return [
        Part("body", trunk, yellow, "main"),
        Part("head", head, yellow, "main", blend=0.1),
        Part("wings", wing.mirrored(1), rgb("eeb41f"), "main", blend=0.03),
        Part("beak", upper.blend(lower, 0.02), rgb("e9772b"), "accent"),
        Part("eyes", white, rgb("fbfaf4")),
        Part("pupils", pupil, rgb("26211e")),
    ]
