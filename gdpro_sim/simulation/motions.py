"""Prescribed rigid motion of pins and obstacles, as a scene describes it, and compiled."""

from __future__ import annotations

import itertools
from typing import Annotated, Any

import numpy as np
from pydantic import Discriminator, Field, Tag, field_validator, model_validator

from gdpro_sim.simulation.callbacks import Callback, Scripted, taken
from gdpro_sim.simulation.conditions import Motion
from gdpro_sim.simulation.options import Options, Vector, several


class Keyframe(Options):
    """Where something that moves is at a time."""

    time: float = Field(ge=0.0, description="s")
    translation: Vector = Field(default=(0.0, 0.0, 0.0), description="m, from where it starts")
    rotation: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="degrees about `pivot`: a rotation vector, its direction the axis, its length the angle",
    )


def _kind(value: Any) -> str:
    scripted = isinstance(value, Callback) or (isinstance(value, dict) and "callback" in value)
    return "<Callback>" if scripted else "<Keyframe>"


class Moving(Options):
    """What may be moved along keyframes, or by a function of time."""

    motion: Annotated[
        Annotated[tuple[Keyframe, ...], Tag("<Keyframe>")] | Annotated[Callback, Tag("<Callback>")],
        Discriminator(_kind),
    ] = Field(
        default=(),
        description="keyframes in order of time, linear in between; from rest at time 0, at rest after the "
        "last; between two rotations about one axis by the angle (full turns count), else the shortest way. "
        "Or a `callback`: time in s -> (translation m, rotation vector in degrees); its value at the start "
        "is taken off, as what moves starts where the scene puts it",
    )
    pivot: Vector | None = Field(
        default=None, description="m, a point of the axis of rotation; default: the middle of what moves"
    )

    @field_validator("motion", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        value = taken(value)
        return value if _kind(value) == "<Callback>" else several(value)

    @field_validator("motion")
    @classmethod
    def _in_order(cls, value: tuple[Keyframe, ...] | Callback) -> tuple[Keyframe, ...] | Callback:
        if isinstance(value, Callback):
            return value
        for before, after in itertools.pairwise(value):
            if after.time <= before.time:
                raise ValueError(
                    f"keyframes must be in order of time, got {before.time:g} s, {after.time:g} s"
                )
        first = value[0] if value else None
        if first is not None and first.time == 0.0 and (any(first.translation) or any(first.rotation)):
            raise ValueError("the keyframe at time 0 must have no translation and rotation; start it there")
        return value

    @model_validator(mode="after")
    def _turns(self) -> Moving:
        if self.pivot is not None and not self.motion:
            raise ValueError("`pivot` belongs to a `motion`")
        return self

    def shifts(self, duration: float) -> list[np.ndarray]:
        """Translations [3] m that show where it goes within `duration` s."""
        if not self.motion:
            return []
        motion = self.compiled(np.zeros(3))
        return [motion.at(time)[0] for time in motion.sampled(duration)]

    def compiled(
        self, middle: np.ndarray, vertices: np.ndarray | None = None, *, start: float = 0.0
    ) -> Motion:
        """Of `vertices` [n], about `middle` [3] m where there is no pivot, at rest until `start` s.

        There must be a motion. Raises SceneError for a callback that is not loaded.
        """
        rest = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
        function = None
        keys: list[Any] = []
        if isinstance(self.motion, Callback):
            function = Scripted(self.motion, start)
        else:
            keys = [(key.time, key.translation, key.rotation) for key in self.motion]
        if start > 0.0:
            keys.insert(0, (start, *rest))
        if not keys or keys[0][0] > 0.0:
            keys.insert(0, (0.0, *rest))
        return Motion(
            vertices=np.zeros(0, np.int32) if vertices is None else vertices.astype(np.int32),
            pivot=np.asarray(middle if self.pivot is None else self.pivot, np.float64),
            times=np.array([time for time, _, _ in keys]),
            translations=np.array([shift for _, shift, _ in keys], np.float64),
            rotations=np.radians([turn for _, _, turn in keys]),
            function=function,
        )


__all__ = ["Keyframe", "Moving"]
