"""Parametric objects: closed, in one piece, standing, coloured, and the same for the same seed."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from gdpro_sim.errors import GuidanceError, MeshError
from gdpro_sim.generation.objects import NOUNS, ParametricObject, build, parse
from gdpro_sim.generation.objects import words as w
from gdpro_sim.generation.objects.build import color_value, largest_piece
from gdpro_sim.generation.objects.parts import noun as register
from gdpro_sim.materials import PRESETS
from gdpro_sim.meshing.repair import validate
from gdpro_sim.meshing.surface import SurfaceMesh

CELLS = 40


@cache
def made(prompt: str, seed: int = 0) -> ParametricObject:
    return build(parse(prompt), seed)


def check(surface: SurfaceMesh, name: str) -> None:
    report = validate(surface.vertices, surface.faces)
    assert report.watertight and report.components == 1 and report.volume > 0.0, (name, report)
    assert report.degenerate_faces == 0, name


@pytest.mark.parametrize("name", NOUNS)
def test_every_noun_is_a_closed_standing_object_with_colours(name: str) -> None:
    thing = made(name)
    surface = thing.surface(CELLS)
    check(surface, name)
    across = max(thing.size)
    assert across == pytest.approx(NOUNS[name].across) and 0.01 < across < 200.0
    assert surface.vertices[:, 2].min() == pytest.approx(0.0, abs=0.015 * across)
    assert np.ptp(surface.vertices, axis=0) == pytest.approx(thing.size, abs=0.06 * across)
    assert thing.material in PRESETS
    assert surface.colors is not None and len(np.unique(surface.colors.reshape(-1, 4), axis=0)) > 1
    colors = thing.color_at(surface.vertices)
    assert colors.dtype == np.float32 and 0.0 <= colors.min() and colors.max() <= 1.0


@pytest.mark.slow
@pytest.mark.parametrize("name", NOUNS)
def test_every_variation_is_closed_and_nothing_hangs_in_the_air(name: str) -> None:
    for seed in (1, 2):
        thing = build(parse(name), seed)
        surface = thing.surface(96)
        check(surface, name)
        if seed == 1:
            volume = validate(surface.vertices, surface.faces).volume
            assert volume == pytest.approx(validate(*mesh_of(thing, 64)).volume, rel=0.12), name


def mesh_of(thing: ParametricObject, cells: int) -> tuple[np.ndarray, np.ndarray]:
    surface = thing.surface(cells)
    return surface.vertices, surface.faces


@pytest.mark.parametrize("name", ["mug", "pear", "house", "teddy bear"])
def test_seeds_vary_and_repeat_to_the_bit(name: str) -> None:
    first, again, other = (build(parse(f"a dotted {name}"), seed).surface(CELLS) for seed in (3, 3, 4))
    assert np.array_equal(first.vertices, again.vertices) and np.array_equal(first.faces, again.faces)
    assert first.colors is not None and again.colors is not None
    assert np.array_equal(first.colors, again.colors)
    assert first.vertices.shape != other.vertices.shape or not np.array_equal(first.vertices, other.vertices)


@pytest.mark.parametrize("size", w.SIZES)
def test_size_words_scale(size: str) -> None:
    assert max(made(f"a {size} apple").size) == pytest.approx(w.SIZES[size] * max(made("apple").size))


def colors_of(prompt: str, part: str, *, detail: bool = False) -> np.ndarray:
    """Mean colour of a part over the surface."""
    thing = made(prompt)
    points = thing.surface(CELLS).vertices
    index = [i for i, p in enumerate(thing.parts) if p.name == part]
    there = np.isin(thing.part_at(points), index)
    assert there.any(), part
    return thing.color_at(points[there], detail=detail)


@pytest.mark.parametrize(
    ("prompt", "part", "color"),
    [
        ("a red mug with a blue handle", "body", "red"),
        ("a red mug with a blue handle", "handle", "blue"),
        ("a red and yellow mug", "rim", "yellow"),
        ("a light green mug", "handle", "light green"),
        ("a house with a purple roof", "roof", "purple"),
        ("a teal house", "walls", "teal"),
    ],
)
def test_prompts_colour_what_they_name(prompt: str, part: str, color: str) -> None:
    assert np.allclose(colors_of(prompt, part), color_value(color), atol=1e-6)


def test_a_colour_for_the_whole_leaves_other_parts_alone() -> None:
    assert np.allclose(colors_of("a blue apple", "leaf"), colors_of("apple", "leaf")[0])
    assert np.allclose(colors_of("a wooden house", "roof"), colors_of("house", "roof")[0])


def test_painted_regions_take_a_prompts_colour() -> None:
    colors = colors_of("a teddy bear with a green tummy", "body", detail=True)
    green = np.abs(colors - color_value("green")).max(1) < 1e-5
    assert 0.02 < green.mean() < 0.7


@pytest.mark.parametrize("material", w.MATERIALS)
def test_materials_change_the_physical_preset(material: str) -> None:
    word = w.MATERIALS[material]
    assert word.preset in PRESETS
    thing = made(f"a {material} mug")
    assert thing.material == word.preset
    if word.color is not None:
        assert np.allclose(colors_of(f"a {material} mug", "body"), word.color, atol=1e-6)


@pytest.mark.parametrize("pattern", w.PATTERNS)
def test_patterns_show_both_colours_and_not_in_the_coarse_one(pattern: str) -> None:
    prompt = f"a blue and yellow {pattern} vase"
    colors = colors_of(prompt, "body", detail=True)
    blue, yellow = np.asarray(color_value("blue")), np.asarray(color_value("yellow"))
    share = ((colors - blue) @ (yellow - blue)) / ((yellow - blue) @ (yellow - blue))
    assert share.min() < 0.2 and share.max() > 0.7 and 0.05 < share.mean() < 0.95
    assert np.allclose(colors_of(prompt, "body"), blue, atol=1e-6)


def test_colours_do_not_depend_on_the_mesh() -> None:
    thing = made("a blue and white dotted vase")
    points = thing.surface(CELLS).vertices
    thing.surface(64)
    half = thing.color_at(points[::2])
    assert np.array_equal(thing.color_at(points)[::2], half)


def test_distance_is_zero_on_the_surface_and_signed() -> None:
    thing = made("mug")
    surface = thing.surface(96)
    assert np.abs(thing.distance(surface.vertices)).max() < 0.5 * max(thing.size) / 96
    inside = surface.vertices.astype(np.float64).mean(0)
    assert thing.distance(np.asarray([[1.0, 1.0, 1.0]]))[0] > 1.0
    assert thing.distance(inside[None])[0] > 0.0  # the mug is empty
    assert thing.distance(np.asarray([[0.0, 0.0, 0.03 * thing.size[2]]]))[0] < 0.0  # its floor is not


def test_fine_surfaces_converge() -> None:
    volumes = [validate(*mesh_of(made("teapot"), cells)).volume for cells in (48, 96, 192)]
    assert (
        abs(volumes[2] - volumes[1]) < 0.01 * volumes[2] and abs(volumes[1] - volumes[0]) < 0.03 * volumes[2]
    )


def test_describe_tells_what_was_made() -> None:
    told = made("a big red mug with a blue handle", 5).describe()
    assert told["noun"] == "mug" and told["seed"] == 5 and told["physical_material"] == "ceramic"
    assert told["part_names"] == ["body", "rim", "handle"] and len(told["size_m"]) == 3


def test_too_coarse_is_refused() -> None:
    with pytest.raises(MeshError, match="at least 8 cells, got 4"):
        made("mug").surface(4)


def test_a_noun_defined_twice_is_refused() -> None:
    with pytest.raises(GuidanceError, match="'mug' is defined twice"):
        register("mug", kind="vessels", across=0.1, material="ceramic")(NOUNS["mug"].build)


def test_largest_piece_fills_hollows_and_drops_crumbs() -> None:
    from tests.meshing.shapes import cube, joined, sphere

    outer, small = sphere(2), sphere(1, radius=0.05)
    hollow = (0.5 * outer[0], outer[1][:, ::-1])
    v, f, whole = largest_piece(*joined(outer, hollow, (small[0] + 3.0, small[1])))
    assert whole and len(f) == len(outer[1])
    v, f, whole = largest_piece(*joined((outer[0] + 5.0, outer[1]), cube()))
    assert not whole and np.array_equal(v, outer[0] + 5.0)
