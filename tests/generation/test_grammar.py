"""Captions: what they mean, what is refused and how the refusal helps."""

from __future__ import annotations

import json

import pytest

from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.objects import NOUNS, ObjectSpec, Style, parse, vocabulary
from gdpro_sim.generation.objects import words as w
from gdpro_sim.generation.objects.grammar import singular


def test_the_readme_prompt() -> None:
    spec = parse("a red mug with a blue handle")
    assert (spec.noun, spec.style, dict(spec.parts)) == ("mug", Style(("red",)), {"handle": Style(("blue",))})


@pytest.mark.parametrize(
    ("prompt", "noun", "style"),
    [
        ("mug", "mug", Style()),
        ("A Mug.", "mug", Style()),
        ("mugs", "mug", Style()),
        ("one coffee mug", "mug", Style()),
        ("a dark green vase", "vase", Style(("dark green",))),
        ("a pale-blue, striped vase", "vase", Style(("pale blue",), None, "striped")),
        ("a red and white striped mug", "mug", Style(("red", "white"), None, "striped")),
        ("a striped red and white mug", "mug", Style(("red", "white"), None, "striped")),
        ("a gray polka-dot teapot", "teapot", Style(("grey",), None, "dotted")),
        ("a wooden chair", "chair", Style((), "wood")),
        ("a chair made of oak", "chair", Style((), "wood")),
        ("a chair made out of steel", "chair", Style((), "metal")),
        ("a mug in navy", "mug", Style(("navy",))),
        ("a mug with white stripes", "mug", Style(("blue", "white"), None, "striped")),
        ("a green mug with yellow polka dots", "mug", Style(("green", "yellow"), None, "dotted")),
        ("a checkered porcelain bowl", "bowl", Style((), "ceramic", "checkered")),
        ("an orange", "orange", Style()),
        ("an orange orange", "orange", Style(("orange",))),
        ("an orange mug", "mug", Style(("orange",))),
        ("a glass bottle", "bottle", Style()),
        ("a glass vase", "vase", Style((), "glass")),
        ("a wine glass", "wine glass", Style()),
        ("an ice cream cone", "ice cream cone", Style()),
        ("a rubber duck", "rubber duck", Style()),
        ("a pink duck", "rubber duck", Style(("pink",))),
        ("dice", "die", Style()),
        ("a loaf of bread", "bread", Style()),
        ("a black and yellow car", "car", Style(("black", "yellow"))),
    ],
)
def test_captions(prompt: str, noun: str, style: Style) -> None:
    spec = parse(prompt)
    assert (spec.noun, spec.style, dict(spec.parts), spec.unknown) == (noun, style, {}, ())


@pytest.mark.parametrize(
    ("prompt", "parts"),
    [
        ("a house with a green roof", {"roof": Style(("green",))}),
        (
            "a house with a light blue roof and a white door",
            {"roof": Style(("light blue",)), "door": Style(("white",))},
        ),
        (
            "a house with white walls, a red roof, a blue door",
            {"walls": Style(("white",)), "roof": Style(("red",)), "door": Style(("blue",))},
        ),
        ("a mug with a red and white striped handle", {"handle": Style(("red", "white"), None, "striped")}),
        ("a chair with metal legs", {"legs": Style((), "metal")}),
        ("a table with a black leg", {"legs": Style(("black",))}),
        ("a house with a chimney", {}),
        ("a cake with a green cherry", {"cherry": Style(("green",))}),
    ],
)
def test_parts(prompt: str, parts: dict[str, Style]) -> None:
    assert dict(parse(prompt).parts) == parts


@pytest.mark.parametrize("size", [*w.SIZES, *w.SIZE_SYNONYMS])
def test_sizes(size: str) -> None:
    assert parse(f"a {size} red apple").size == w.SIZE_SYNONYMS.get(size, size)


def test_phrases_about_the_picture_are_skipped_and_listed() -> None:
    spec = parse("A DSLR photo of a beautiful red mug, 8K, studio lighting, highly detailed")
    assert spec.noun == "mug" and spec.style.colors == ("red",)
    assert spec.ignored == ("a dslr photo of", "beautiful", "8k", "studio lighting", "highly detailed")


@pytest.mark.parametrize("prompt", ["", "   ", "\n"])
def test_an_empty_prompt_is_refused(prompt: str) -> None:
    with pytest.raises(GuidanceError, match="prompt is empty"):
        parse(prompt)


@pytest.mark.parametrize(
    "prompt",
    [
        "two mugs",
        "3 apples",
        "a mug and a vase",
        "an apple on a table",
        "a pair of boots",
        "a car with a spoon",
        "several red balls",
    ],
)
def test_several_objects_are_refused_with_a_way_out(prompt: str) -> None:
    with pytest.raises(GuidanceError, match=r"several objects.*compose"):
        parse(prompt)


def test_unknown_words_come_with_the_nearest_ones_and_the_way_out() -> None:
    with pytest.raises(GuidanceError) as error:
        parse("a sparkling moug")
    text = str(error.value)
    assert "'moug'" in text and "mug" in text.split("'moug'")[-1] and "'sparkling'" in text
    assert "`gdpro vocabulary`" in text
    assert 'gdpro generate "a sparkling moug" --guidance diffusers --model DIR' in text
    assert error.value.exit_code == 2 and "\n" not in text


def test_ignore_unknown_goes_on_and_records() -> None:
    spec = parse("a sparkling red mug with a gloopy blue handle", ignore_unknown=True)
    assert spec.unknown == ("sparkling", "gloopy")
    assert spec.style == Style(("red",)) and dict(spec.parts) == {"handle": Style(("blue",))}


def test_ignore_unknown_still_needs_an_object() -> None:
    with pytest.raises(GuidanceError, match="unicorn"):
        parse("a red unicorn", ignore_unknown=True)
    with pytest.raises(GuidanceError, match="names no object"):
        parse("a red and blue")


@pytest.mark.parametrize(
    ("prompt", "message"),
    [
        ("a mug with green wheels", "no wheels; its parts are body, rim, handle"),
        ("a mug with a lid", "no lid; its parts are body, rim, handle"),
        ("a mug with red", "'red' stands before no part"),
        ("a wooden metal mug", "two materials"),
        ("a plaid striped mug", "two patterns"),
        ("a tiny huge mug", "two sizes"),
        ("a red, white and blue mug", "three colours"),
    ],
)
def test_contradictions_name_what_is_wrong(prompt: str, message: str) -> None:
    with pytest.raises(GuidanceError, match=message):
        parse(prompt)


def test_every_noun_and_synonym_is_read_as_itself() -> None:
    for noun in NOUNS.values():
        for word in (noun.name, *noun.synonyms):
            assert parse(f"a photo of a {word}").noun == noun.name, word


def test_every_part_of_every_noun_can_be_coloured() -> None:
    for noun in NOUNS.values():
        for part in noun.part_names():
            spec = parse(f"a {noun.name} with a purple {part}")
            assert dict(spec.parts) == {part: Style(("purple",))}, (noun.name, part)


def test_a_caption_says_the_same_again() -> None:
    materials, patterns, colors = list(w.MATERIALS), list(w.PATTERNS), list(w.COLORS)
    for i, noun in enumerate(NOUNS.values()):
        style = Style(
            (colors[i % len(colors)], "dark teal"), materials[i % len(materials)], patterns[i % len(patterns)]
        )
        part = noun.part_names()[-1]
        spec = ObjectSpec("", noun.name, "big", style, {part: Style(("light pink",))})
        again = parse(spec.caption())
        assert (again.noun, again.size, again.style, dict(again.parts)) == (
            noun.name,
            "big",
            style,
            dict(spec.parts),
        )


def test_describe_is_json_and_its_caption_parses_back() -> None:
    spec = parse("a DSLR photo of a small red ceramic mug with a gold rim, blurgh", ignore_unknown=True)
    told = json.loads(json.dumps(spec.describe()))
    assert told["ignored"] == ["a dslr photo of"] and told["unknown"] == ["blurgh"]
    assert parse(told["caption"]).style == spec.style and told["noun"] == "mug" and told["size"] == "small"


def test_the_vocabulary_lists_every_kind_and_is_as_large_as_promised() -> None:
    listed = vocabulary()
    nouns = [entry for kind in {n.kind for n in NOUNS.values()} for entry in listed[kind]]
    assert len(nouns) == len(NOUNS) >= 64
    assert len(listed["colours"]) >= 25 and len(listed["materials"]) >= 12 and len(listed["patterns"]) >= 8
    assert any(entry.startswith("mug (") for entry in listed["vessels"])


@pytest.mark.parametrize(
    ("plural", "one"),
    [
        ("mugs", "mug"),
        ("dice", "die"),
        ("cherries", "cherry"),
        ("boxes", "box"),
        ("loaves", "loaf"),
        ("glass", "glass"),
        ("cactus", "cactus"),
        ("wine glasses", "wine glass"),
        ("benches", "bench"),
    ],
)
def test_singular(plural: str, one: str) -> None:
    assert singular(plural) == one
