"""Settings of animation without physics, as a scene describes them."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from gdpro_sim.simulation.options import Options


class AnimationOptions(Options):
    """No physics: bodies follow their `animation`, or stand still."""

    kind: Literal["animation"] = "animation"


class BodyAnimation(Options):
    """The motion that a body follows."""

    file: str = Field(
        default="",
        description="glTF, USD or .npz file, or folder of numbered meshes; default: the body's asset",
    )
    clip: str | None = Field(default=None, description="name or number of a glTF file's animation")
    fps: float | None = Field(default=None, gt=0.0, description="frames per second of numbered meshes")
    start: float | None = Field(default=None, description="s, moment of the motion that it begins with")
    end: float | None = Field(default=None, description="s, moment of the motion that it ends with")
    speed: float = Field(default=1.0, gt=0.0, description="seconds of the motion per second")
    loop: bool = Field(default=False, description="begin again after the end, else stand still there")
    up: Literal["auto", "y", "z"] = Field(default="auto", description="up axis of the motion's file")
    scale: float | None = Field(default=None, gt=0.0, description="multiplies the motion's lengths")
    tolerance: float = Field(
        default=0.02,
        gt=0.0,
        description="how far an asset's surface may lie off the motion's, as a share of the motion's size",
    )

    @model_validator(mode="after")
    def _ordered(self) -> BodyAnimation:
        if self.start is not None and self.end is not None and self.end <= self.start:
            raise ValueError(f"end must lie after start {self.start:g} s, got {self.end:g} s")
        return self


__all__ = ["AnimationOptions", "BodyAnimation"]
