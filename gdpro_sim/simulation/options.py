"""What every part of a scene description shares."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.load import parse_color

Number = Annotated[float, Field(allow_inf_nan=False)]
Vector = tuple[Number, Number, Number]


class Options(BaseModel):
    """A part of a scene description: unknown keys, infinity and NaN are refused; constant."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def several(value: Any) -> Any:
    """For validators of lists: one entry may stand without its list."""
    return [value] if isinstance(value, dict | Options) else value


def color_of(name: str) -> tuple[float, float, float]:
    """sRGB in [0, 1] of "#rrggbb" or a CSS name. Raises ValueError."""
    try:
        return parse_color(name)
    except MeshError as error:
        raise ValueError(str(error)) from None


__all__ = ["Number", "Options", "Vector", "color_of", "several"]
