"""What a noun is made of: named parts, each a shape with a colour, and the registry of all nouns."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Literal, TypeVar

import numpy as np

from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.objects.sdf import Shape
from gdpro_sim.generation.objects.words import COLORS, Color, shaded

Role = Literal["main", "accent", "trim", "fixed"]
"""What a part takes from the whole object's style: main the first colour, pattern and material; accent the
second colour and the material; trim the second colour; fixed nothing. Named in the prompt, any takes all."""

T = TypeVar("T")


def color(word: str, shade: float = 0.0) -> Color:
    """A named colour, towards white (shade > 0) or black (shade < 0)."""
    return shaded(COLORS[word], shade)


def rgb(code: str) -> Color:
    """An sRGB colour written "rrggbb"."""
    return (int(code[0:2], 16) / 255.0, int(code[2:4], 16) / 255.0, int(code[4:6], 16) / 255.0)


@dataclass(frozen=True)
class Paint:
    """A named region of a part's surface with a colour of its own: where `shape` holds the point."""

    name: str
    shape: Shape
    color: Color
    role: Role = "fixed"


@dataclass(frozen=True)
class Part:
    """A named piece of an object.

    pattern, second: a pattern the part has by itself, and its second colour (None: chosen)
    dots:            spacing and radius of "dotted", in the object's largest extent
    palette:         colours of the dots, in place of `second`
    paints:          later ones cover earlier ones
    blend:           radius of the smooth union with the parts before it, in the noun's own unit
    """

    name: str
    shape: Shape
    color: Color
    role: Role = "fixed"
    pattern: str | None = None
    second: Color | None = None
    dots: tuple[float, float] = (0.14, 0.042)
    palette: tuple[Color, ...] | None = None
    paints: tuple[Paint, ...] = ()
    blend: float = 0.0


class Variation:
    """Seeded mild variation of proportions."""

    def __init__(self, seed: int, name: str) -> None:
        self.generator = np.random.default_rng(np.random.SeedSequence([seed, *name.encode()]))

    def __call__(self, value: float, spread: float = 0.08) -> float:
        """`value` times a factor drawn from [1 - spread, 1 + spread]."""
        return float(value * (1.0 + spread * (2.0 * self.generator.random() - 1.0)))

    def pick(self, options: Sequence[T]) -> T:
        """One of them."""
        return options[int(self.generator.integers(len(options)))]

    def uniform(self, low: float, high: float) -> float:
        return float(low + (high - low) * self.generator.random())


@dataclass(frozen=True)
class Noun:
    """A word of the vocabulary.

    build:    parts for a seeded variation, in any unit, Z up, front +X, axis at x = y = 0
    across:   largest extent of the usual object in metres
    material: physical preset
    """

    name: str
    kind: str
    synonyms: tuple[str, ...]
    across: float
    material: str
    build: Callable[[Variation], list[Part]]

    def parts(self, seed: int) -> list[Part]:
        return self.build(Variation(seed, self.name))

    def part_names(self) -> list[str]:
        """Names a prompt may colour, paints included, in order."""
        return list(_part_names(self))


@cache
def _part_names(noun: Noun) -> tuple[str, ...]:
    names: dict[str, None] = {}
    for part in noun.parts(0):
        names[part.name] = None
        for paint in part.paints:
            names[paint.name] = None
    return tuple(names)


NOUNS: dict[str, Noun] = {}
"""Filled by the `nouns_*` modules as the package is imported."""


def noun(
    name: str, *synonyms: str, kind: str, across: float, material: str
) -> Callable[[Callable[[Variation], list[Part]]], Callable[[Variation], list[Part]]]:
    """Register the decorated function as the noun `name`; see `Noun`."""

    def register(build: Callable[[Variation], list[Part]]) -> Callable[[Variation], list[Part]]:
        taken = {word for known in NOUNS.values() for word in (known.name, *known.synonyms)}
        for word in (name, *synonyms):
            if word in taken:
                raise GuidanceError(f"the noun {word!r} is defined twice in the built-in library")
        NOUNS[name] = Noun(name, kind, synonyms, across, material, build)
        return build

    return register


__all__ = ["NOUNS", "Noun", "Paint", "Part", "Role", "Variation", "color", "noun", "rgb"]
