"""How a scene is looked at: the preview's camera and light."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.simulation.options import Options, Vector


class Camera(Options):
    """The preview's camera. Anything left out is chosen so that the bodies and their fall fit the picture."""

    eye: Vector | None = Field(default=None, description="m")
    target: Vector | None = Field(default=None, description="m")
    azimuth: float = Field(default=-60.0, description="degrees from +X, where eye is not given")
    elevation: float = Field(default=14.0, ge=-89.0, le=89.0, description="degrees, where eye is not given")
    fov: float = Field(default=32.0, gt=1.0, lt=150.0, description="vertical field of view, degrees")
    width: int = Field(default=960, ge=16, le=8192, description="pixels; even, for video")
    height: int = Field(default=720, ge=16, le=8192, description="pixels; even, for video")

    @model_validator(mode="after")
    def _apart(self) -> Camera:
        if self.eye is not None and self.eye == self.target:
            raise ValueError(f"eye and target coincide at {list(self.eye)}")
        return self

    @field_validator("width", "height")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 2:
            raise ValueError(f"must be even (H.264 video), got {value}")
        return value


class Render(Options):
    """How the preview looks."""

    shading: Literal["studio", "none"] = Field(
        default="studio", description="studio lights and shadows, or raw colours"
    )
    background: Literal["studio", "white", "black"] = "studio"


__all__ = ["Camera", "Render"]
