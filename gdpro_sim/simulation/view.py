"""How a scene is looked at: its cameras, and what surrounds the bodies in pictures."""

from __future__ import annotations

import difflib
import itertools
from collections.abc import Sequence
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.simulation.options import Options, Vector, several

MAIN = "main"
"""Name of a scene's `camera`; those of `cameras` have names of their own."""

Interpolation = Literal["smooth", "linear"]
Elevation = Annotated[float, Field(ge=-89.0, le=89.0)]
FieldOfView = Annotated[float, Field(gt=1.0, lt=150.0)]
Name = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]


class CameraKeyframe(Options):
    """What a camera does at a time. What a keyframe leaves out goes from the one before to the one after."""

    time: float = Field(ge=0.0, description="s")
    eye: Vector | None = Field(default=None, description="m")
    target: Vector | None = Field(default=None, description="m")
    azimuth: float | None = Field(default=None, description="degrees from +X; 360 more is a whole turn")
    elevation: Elevation | None = Field(default=None, description="degrees")
    distance: float | None = Field(default=None, gt=0.0, description="m, from eye to target")
    fov: FieldOfView | None = Field(default=None, description="vertical field of view, degrees")

    @model_validator(mode="after")
    def _says_something(self) -> CameraKeyframe:
        if len(self.model_fields_set) < 2:
            raise ValueError("a keyframe needs one of eye, target, azimuth, elevation, distance, fov")
        return self


class Orbit(Options):
    """Turning about the vertical line through the target, on top of what else the camera does."""

    turns: float | None = Field(
        default=None, description="from `start` to `end`; negative: clockwise seen from above; default: 1"
    )
    period: float | None = Field(default=None, description="in place of turns: s for one turn, not 0")
    rate: float | None = Field(default=None, description="in place of turns: degrees/s")
    start: float = Field(default=0.0, ge=0.0, description="s")
    end: float | None = Field(default=None, gt=0.0, description="s; default: the scene's end")
    ease: bool = Field(default=False, description="start and stop gently")

    @model_validator(mode="after")
    def _one_speed(self) -> Orbit:
        if sum(value is not None for value in (self.turns, self.period, self.rate)) > 1:
            raise ValueError("give one of `turns`, `period` and `rate`")
        if self.period == 0.0:
            raise ValueError("`period` must not be 0 s")
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"must end after it starts, got {self.start:g} s to {self.end:g} s")
        return self


class Follow(Options):
    """Keeping a body in the middle of the picture."""

    body: str = Field(min_length=1, description="its name")
    smoothing: float = Field(
        default=0.15,
        ge=0.0,
        le=60.0,
        description="s it takes to answer a change of speed; 0 keeps to the body exactly",
    )
    offset: Vector = Field(default=(0.0, 0.0, 0.0), description="m, from the body's middle to the target")


class Camera(Options):
    """A camera. Anything left out is chosen so that the bodies and their fall fit the picture."""

    eye: Vector | None = Field(default=None, description="m")
    target: Vector | None = Field(default=None, description="m")
    azimuth: float = Field(default=-60.0, description="degrees from +X, where eye is not given")
    elevation: Elevation = Field(default=14.0, description="degrees, where eye is not given")
    distance: float | None = Field(
        default=None, gt=0.0, description="m, from eye to target, where eye is not given"
    )
    fov: FieldOfView = Field(default=32.0, description="vertical field of view, degrees")
    width: int = Field(default=960, ge=16, le=8192, description="pixels; even, for video")
    height: int = Field(default=720, ge=16, le=8192, description="pixels; even, for video")
    motion: tuple[CameraKeyframe, ...] = Field(
        default=(),
        description="keyframes in order of time, from the camera's own values at time 0; at rest after them",
    )
    interpolation: Interpolation = Field(
        default="smooth", description="between keyframes: smooth (Catmull-Rom, ends at rest) or linear"
    )
    orbit: Orbit | None = None
    follow: Follow | None = Field(default=None, description="a body's name, or how to follow it")

    @field_validator("motion", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return several(value)

    @field_validator("follow", mode="before")
    @classmethod
    def _body_alone(cls, value: Any) -> Any:
        return {"body": value} if isinstance(value, str) else value

    @field_validator("motion")
    @classmethod
    def _in_order(cls, value: tuple[CameraKeyframe, ...]) -> tuple[CameraKeyframe, ...]:
        check_order([key.time for key in value])
        return value

    @model_validator(mode="after")
    def _apart(self) -> Camera:
        if self.eye is not None and self.eye == self.target:
            raise ValueError(f"eye and target coincide at {list(self.eye)}")
        return self

    @model_validator(mode="after")
    def _one_description(self) -> Camera:
        by_angles = [
            name
            for name in ("azimuth", "elevation", "distance")
            if any(getattr(key, name) is not None for key in self.motion)
        ]
        if self.eye is not None and self.distance is not None:
            raise ValueError("`distance` has no effect beside `eye`; give one of them")
        if by_angles and (self.eye is not None or any(key.eye is not None for key in self.motion)):
            raise ValueError(f"`eye` and keyframes of {', '.join(by_angles)} exclude each other")
        if self.follow is not None:
            if self.target is not None or any(key.target is not None for key in self.motion):
                raise ValueError("`follow` sets the target; give `follow: {body, offset}` in place of target")
        return self

    @field_validator("width", "height")
    @classmethod
    def _even(cls, value: int) -> int:
        if value % 2:
            raise ValueError(f"must be even (H.264 video), got {value}")
        return value

    @property
    def still(self) -> bool:
        """Whether it never moves."""
        return not self.motion and self.orbit is None and self.follow is None


class NamedCamera(Camera):
    """One more camera."""

    name: Name = Field(description="of its pictures: frames_NAME/ and preview_NAME.mp4")
    preview: bool = Field(
        default=True, description="draw it during the run; else only by `gdpro render --camera NAME`"
    )


class Render(Options):
    """How the preview looks."""

    shading: Literal["studio", "none"] = Field(
        default="studio", description="lights and shadows, or raw colours"
    )
    background: str = Field(
        default="studio",
        description="studio (gradient and gridded floor), transparent (pictures have an alpha channel), or a "
        "colour: white, black, #rrggbb, a CSS name",
    )
    catch_shadows: bool = Field(
        default=False, description="a floor that is seen by its shadows alone, in front of the background"
    )
    exposure: float = Field(default=0.0, ge=-10.0, le=10.0, description="stops: 1 doubles the light")

    @field_validator("background")
    @classmethod
    def _known(cls, value: str) -> str:
        if value not in ("studio", "transparent"):
            from gdpro_sim.errors import MeshError
            from gdpro_sim.meshing.load import parse_color

            try:
                parse_color(value)
            except MeshError:
                raise ValueError(
                    f"must be studio, transparent, #rrggbb or a CSS colour name, got {value!r}"
                ) from None
        return value


def check_order(times: Sequence[float]) -> None:
    """Raise ValueError where keyframe times in s do not increase."""
    for before, after in itertools.pairwise(times):
        if after <= before:
            raise ValueError(f"keyframes must be in order of time, got {before:g} s, {after:g} s")


def check_cameras(main: Camera, more: Sequence[NamedCamera], bodies: Sequence[str], duration: float) -> None:
    """Raise ValueError where cameras share a name, follow no known body or move after `duration` s only."""
    reserved = (MAIN, "main_cam")
    seen: set[str] = set()
    for k, camera in enumerate((main, *more)):
        place = f"cameras[{k - 1}]" if isinstance(camera, NamedCamera) else "camera"
        if isinstance(camera, NamedCamera):
            if camera.name in seen or camera.name in reserved:
                taken = "`camera` is named" if camera.name in reserved else "two cameras are named"
                raise ValueError(f"{place}.name: {taken} {camera.name!r}; give it another name")
            seen.add(camera.name)
        if camera.follow is not None and camera.follow.body not in bodies:
            near = difflib.get_close_matches(camera.follow.body, bodies, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise ValueError(
                f"{place}.follow: there is no body {camera.follow.body!r}{hint}; bodies: {', '.join(bodies)}"
            )
        if camera.orbit is not None and camera.orbit.start >= duration:
            raise ValueError(
                f"{place}.orbit.start: must be before the scene's end at {duration:g} s, got "
                f"{camera.orbit.start:g} s"
            )


__all__ = [
    "MAIN",
    "Camera",
    "CameraKeyframe",
    "Follow",
    "Interpolation",
    "Name",
    "NamedCamera",
    "Orbit",
    "Render",
    "check_cameras",
    "check_order",
]
