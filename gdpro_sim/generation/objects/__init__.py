"""Parametric objects and the vocabulary that names them.

`parse` understands a caption of one object, `build` makes it: a signed-distance solid of named, coloured
parts.

    build(parse("a red mug with a blue handle"), seed=0).surface(192)
"""

from gdpro_sim.generation.objects import (  # noqa: F401  (each fills NOUNS)
    nouns_animals,
    nouns_buildings,
    nouns_food,
    nouns_furniture,
    nouns_meals,
    nouns_nature,
    nouns_things,
    nouns_tools,
    nouns_toys,
    nouns_vehicles,
    nouns_vessels,
)
from gdpro_sim.generation.objects.build import ParametricObject, build
from gdpro_sim.generation.objects.grammar import parse, vocabulary
from gdpro_sim.generation.objects.parts import NOUNS
from gdpro_sim.generation.objects.spec import ObjectSpec, Style

__all__ = ["NOUNS", "ObjectSpec", "ParametricObject", "Style", "build", "parse", "vocabulary"]
