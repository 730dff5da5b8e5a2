"""The lights of a scene's pictures."""

from __future__ import annotations

import difflib
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.errors import MeshError
from gdpro_sim.simulation.options import Options, Vector, several
from gdpro_sim.simulation.view import Interpolation, check_order

Elevation = Annotated[float, Field(ge=-90.0, le=90.0)]
Intensity = Annotated[float, Field(ge=0.0, le=1000.0)]


class LightKeyframe(Options):
    """What a light does at a time. What a keyframe leaves out goes from the one before to the one after."""

    time: float = Field(ge=0.0, description="s")
    azimuth: float | None = Field(default=None, description="degrees; 360 more is a whole turn")
    elevation: Elevation | None = Field(default=None, description="degrees")
    intensity: Intensity | None = None


class _Light(Options):
    """What all lights have."""

    color: str = Field(default="white", description="#rrggbb or a CSS name")
    motion: tuple[LightKeyframe, ...] = Field(
        default=(), description="keyframes in order of time, from the light's own values at time 0"
    )
    interpolation: Interpolation = Field(default="smooth", description="between keyframes: smooth or linear")

    @field_validator("color")
    @classmethod
    def _known(cls, value: str) -> str:
        from gdpro_sim.meshing.load import parse_color

        try:
            parse_color(value)
        except MeshError as error:
            raise ValueError(str(error)) from None
        return value

    @field_validator("motion", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return several(value)

    @field_validator("motion")
    @classmethod
    def _in_order(cls, value: tuple[LightKeyframe, ...]) -> tuple[LightKeyframe, ...]:
        check_order([key.time for key in value])
        return value


class DistantLight(_Light):
    """Light from far away, as of the sun or a lamp outside the picture; it casts shadows."""

    kind: Literal["distant"] = "distant"
    azimuth: float = Field(default=-48.0, description="degrees from +X, of where it stands")
    elevation: Elevation = Field(default=47.0, description="degrees, of where it stands")
    relative: bool = Field(
        default=False, description="azimuth counts from where the main camera first stands, not from +X"
    )
    direction: Vector | None = Field(
        default=None, description="in place of azimuth and elevation: the way the light goes"
    )
    intensity: Intensity = Field(
        default=0.9, description="1 shows a white surface that faces it as white, without other light"
    )
    softness: float = Field(
        default=7.0, ge=0.0, le=60.0, description="degrees, its radius in the sky; 0.27 is the sun's"
    )

    @model_validator(mode="after")
    def _one_direction(self) -> DistantLight:
        if self.direction is not None:
            if not any(self.direction):
                raise ValueError("direction must not be zero, got [0, 0, 0]")
            turned = any(key.azimuth is not None or key.elevation is not None for key in self.motion)
            fields = type(self).model_fields
            if turned or any(
                getattr(self, name) != fields[name].default for name in ("azimuth", "elevation", "relative")
            ):
                raise ValueError("give `direction`, or `azimuth` and `elevation`, not both")
        return self


class DomeLight(_Light):
    """Light from the whole sky."""

    kind: Literal["dome"] = "dome"
    intensity: Intensity = Field(
        default=0.34, description="1 shows a white floor under the open sky as white, without other light"
    )

    @model_validator(mode="after")
    def _nowhere(self) -> DomeLight:
        if any(key.azimuth is not None or key.elevation is not None for key in self.motion):
            raise ValueError("a dome is everywhere: its keyframes have an intensity alone")
        return self


LightOptions = Annotated[DistantLight | DomeLight, Field(discriminator="kind")]


def _distant(azimuth: float, elevation: float, intensity: float, **more: Any) -> dict[str, Any]:
    return {
        "kind": "distant",
        "azimuth": azimuth,
        "elevation": elevation,
        "relative": True,
        "intensity": intensity,
        **more,
    }


LIGHTS: dict[str, list[dict[str, Any]]] = {
    "studio": [_distant(-48.0, 47.0, 0.9024), {"kind": "dome", "intensity": 0.34}],
    "overcast": [
        _distant(-30.0, 75.0, 0.22, softness=30.0, color="#f2f5ff"),
        {"kind": "dome", "intensity": 0.75, "color": "#eef3ff"},
    ],
    "noon": [
        _distant(-35.0, 68.0, 0.85, softness=0.5, color="#fff6e6"),
        {"kind": "dome", "intensity": 0.26, "color": "#cfe2ff"},
    ],
    "sunset": [
        _distant(-75.0, 22.0, 1.7, softness=2.0, color="#ffc188"),
        {"kind": "dome", "intensity": 0.42, "color": "#b3bfee"},
    ],
    "moonlight": [
        _distant(-110.0, 42.0, 0.34, softness=1.0, color="#b4c8ff"),
        {"kind": "dome", "intensity": 0.07, "color": "#7f93d6"},
    ],
    "three-point": [
        _distant(-45.0, 42.0, 0.76, softness=5.0, color="#fff1de"),
        _distant(55.0, 25.0, 0.28, softness=20.0, color="#d6e4ff"),
        _distant(165.0, 38.0, 0.55, softness=4.0),
        {"kind": "dome", "intensity": 0.12},
    ],
}
"""Sets of lights by name, around a subject that the main camera sees from the front."""


def expand_lights(value: Any) -> Any:
    """For validators: names of sets stand for their lights; "studio" alone for none, which means it."""
    listed = [value] if isinstance(value, str) else several(value)
    if not isinstance(listed, list | tuple):
        return listed
    if list(listed) == ["studio"]:
        return ()
    lights: list[Any] = []
    for item in listed:
        if not isinstance(item, str):
            lights.append(item)
            continue
        if item not in LIGHTS:
            near = difflib.get_close_matches(item, LIGHTS, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise ValueError(f"there are no lights {item!r}{hint}; known: {', '.join(LIGHTS)}")
        lights += LIGHTS[item]
    return tuple(lights)


__all__ = [
    "LIGHTS",
    "DistantLight",
    "DomeLight",
    "LightKeyframe",
    "LightOptions",
    "expand_lights",
]
