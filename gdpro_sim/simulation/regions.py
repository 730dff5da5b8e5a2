"""Parts of a body, chosen by a box, a sphere, a side or vertex ids, where the body stands at the start."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, field_validator, model_validator

from gdpro_sim.simulation.options import Options, Vector, color_of

SLACK = 1e-6
"""How much of the body's extent vertices may lie outside a region: coordinates are rounded."""

SIDES: dict[str, tuple[int, bool]] = {
    "left": (0, False),
    "right": (0, True),
    "front": (1, False),
    "back": (1, True),
    "bottom": (2, False),
    "top": (2, True),
}
"""Axis of each side, and whether it lies at the upper end: a viewer looks along +Y, X points right."""


class Region(Options):
    """Part of a body where it stands at the start: give one of box, sphere, side, group, painted, vertices.

    For copies it is written where their body stands without them, and means the same part of each.
    """

    minimum: Vector | None = Field(default=None, description="lower corner of a box, m; default: no limit")
    maximum: Vector | None = Field(default=None, description="upper corner of a box, m; default: no limit")
    center: Vector | None = Field(default=None, description="centre of a sphere, m")
    radius: float | None = Field(default=None, gt=0.0, description="radius of the sphere, m")
    side: Literal["bottom", "top", "left", "right", "front", "back"] | None = Field(
        default=None, description="left/right are -X/+X, front/back -Y/+Y, bottom/top -Z/+Z of the body"
    )
    fraction: float | None = Field(
        default=None, gt=0.0, le=1.0, description="of the body's extent that a side reaches in; default 0.05"
    )
    vertices: tuple[Annotated[int, Field(ge=0)], ...] | None = Field(
        default=None, min_length=1, description="ids of the body's tet vertices, from 0"
    )

    group: str | None = Field(
        default=None, min_length=1, description="name of a vertex group of the asset, `gdpro info` lists them"
    )
    painted: str | None = Field(
        default=None, description="colour of the asset's vertices, #rrggbb or a CSS name, which is chosen"
    )
    tolerance: float | None = Field(
        default=None, gt=0.0, le=1.0,
        description="how far red, green and blue may be off a painted colour, of 1; default 0.15",
    )  # fmt: skip
    depth: float | None = Field(
        default=None, gt=0.0,
        description="m, how far below the surface a group or a painted part reaches; default: the outermost "
        "vertices or particles",
    )  # fmt: skip

    @field_validator("painted")
    @classmethod
    def _a_color(cls, value: str | None) -> str | None:
        if value is not None:
            color_of(value)
        return value

    @field_validator("maximum")
    @classmethod
    def _ordered(cls, value: Any, info: Any) -> Any:
        low = info.data.get("minimum")
        if value is not None and low is not None and any(b < a for a, b in zip(low, value, strict=True)):
            raise ValueError(f"must not lie below minimum {list(low)}, got {list(value)}")
        return value

    @model_validator(mode="after")
    def _one_kind(self) -> Region:
        if (self.center is None) != (self.radius is None):
            raise ValueError("a sphere needs both `center` and `radius`")
        if self.fraction is not None and self.side is None:
            raise ValueError("`fraction` belongs to a `side`")
        if self.tolerance is not None and self.painted is None:
            raise ValueError("`tolerance` belongs to a `painted` colour")
        if self.depth is not None and self.painted is None and self.group is None:
            raise ValueError("`depth` belongs to a `group` or a `painted` colour")
        if len(self._kinds()) > 1:
            raise ValueError(
                "give one of box, sphere, side, group, painted and vertices, got "
                f"{' and '.join(self._kinds())}"
            )
        return self

    def _kinds(self) -> list[str]:
        given = {
            "a box": self.minimum is not None or self.maximum is not None,
            "a sphere": self.center is not None,
            "a side": self.side is not None,
            "a group": self.group is not None,
            "a painted colour": self.painted is not None,
            "vertices": self.vertices is not None,
        }
        return [kind for kind, present in given.items() if present]

    @property
    def chosen(self) -> bool:
        """Whether anything is given; if not, the region is the whole body."""
        return bool(self._kinds())

    def describe(self) -> str:
        """In words, for messages."""
        if self.side is not None:
            return f"{self.side} side"
        if self.center is not None:
            return f"sphere of {self.radius:g} m at {list(self.center)}"
        if self.group is not None:
            return f"group {self.group!r}"
        if self.painted is not None:
            return f"part painted {self.painted}"
        if self.vertices is not None:
            return "list of vertices"
        return "box" if self.chosen else "whole body"

    def select(self, points: np.ndarray) -> np.ndarray:
        """[n] bool: which of `points` [n, 3] m lie inside a region that is neither a group nor painted.

        Raises IndexError with the id where an explicit vertex is none of them.
        """
        slack = SLACK * float(np.ptp(points, axis=0).max())
        if self.side is not None:
            axis, upper = SIDES[self.side]
            along = points[:, axis]
            low, high = float(along.min()), float(along.max())
            depth = (0.05 if self.fraction is None else self.fraction) * (high - low)
            return along >= high - depth - slack if upper else along <= low + depth + slack
        if self.center is not None and self.radius is not None:
            return np.linalg.norm(points - np.asarray(self.center), axis=1) <= self.radius + slack
        inside = np.zeros(len(points), bool)
        if self.vertices is not None:
            if max(self.vertices) >= len(points):
                raise IndexError(max(self.vertices))
            inside[list(self.vertices)] = True
            return inside
        inside[:] = True
        if self.minimum is not None:
            inside &= np.all(points >= np.asarray(self.minimum) - slack, axis=1)
        if self.maximum is not None:
            inside &= np.all(points <= np.asarray(self.maximum) + slack, axis=1)
        return inside


__all__ = ["SIDES", "Region"]
