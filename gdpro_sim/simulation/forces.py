"""Pins, springs, attachments and loads, as a scene describes them. SI units, degrees for angles."""

from __future__ import annotations

from pydantic import Field, model_validator

from gdpro_sim.simulation.callbacks import Callback
from gdpro_sim.simulation.motions import Moving
from gdpro_sim.simulation.options import Options, Vector
from gdpro_sim.simulation.regions import Region


class Pin(Region, Moving):
    """Parts that are held: where they start, or where their motion takes them."""

    start: float = Field(
        default=0.0, ge=0.0, description="s, when they are taken hold of, where they are by then. MPM"
    )
    release: float | None = Field(default=None, gt=0.0, description="s, when they are let go; default: never")

    @model_validator(mode="after")
    def _in_time(self) -> Pin:
        if self.release is not None and self.release <= self.start:
            raise ValueError(f"release must be after start ({self.start:g} s), got {self.release:g} s")
        keys = () if isinstance(self.motion, Callback) else self.motion
        if self.start > 0.0 and keys and keys[0].time <= self.start:
            raise ValueError(f"keyframes must be after start ({self.start:g} s), got {keys[0].time:g} s")
        return self

    @model_validator(mode="after")
    def _something(self) -> Pin:
        if not self.chosen:
            raise ValueError(
                "give a box (minimum, maximum), a sphere (center, radius), a side, group, painted colour or "
                "vertices to pin"
            )
        return self


class _Timed(Region):
    start: float = Field(default=0.0, ge=0.0, description="s, when it begins to act")
    end: float | None = Field(default=None, gt=0.0, description="s, when it stops; default: never")

    @model_validator(mode="after")
    def _forwards(self) -> _Timed:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end must be after start ({self.start:g} s), got {self.end:g} s")
        return self


class ConstantForce(_Timed):
    """A force of constant size and direction, shared by the chosen vertices as they share the mass."""

    force: Vector = Field(description="N, in all")


class Push(Region):
    """An impulse at one time, shared by the chosen vertices as they share the mass: all gain one velocity.

    What falls to pinned vertices is taken by what holds them.
    """

    impulse: Vector | None = Field(default=None, description="N s, in all")
    velocity: Vector | None = Field(default=None, description="m/s that every vertex gains, in place of it")
    time: float = Field(default=0.0, ge=0.0, description="s")

    @model_validator(mode="after")
    def _one_of(self) -> Push:
        if (self.impulse is None) == (self.velocity is None):
            raise ValueError("give either `impulse` (N s) or `velocity` (m/s), one of the two")
        return self


class SurfacePressure(_Timed):
    """Pressure on boundary triangles of the tets whose three vertices are chosen; it follows the surface.

    On the whole body it has a potential, pressure times volume.
    """

    pressure: float = Field(description="Pa; positive presses inwards, negative inflates")


class AirFlow(Options):
    """Air, still or moving: drag and lift on boundary triangles that face it, by the square of the speed."""

    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="of the air, m/s")
    density: float = Field(default=1.2, gt=0.0, description="of the air, kg/m^3; 1.2 at 20 C and sea level")
    drag: float = Field(default=1.0, ge=0.0, description="coefficient, on the area seen from upwind")
    lift: float = Field(default=0.0, ge=0.0, description="coefficient, of slanted surfaces")
    bodies: tuple[str, ...] | None = Field(
        default=None, min_length=1, description="names of the bodies it acts on; default: all"
    )
    start: float = Field(default=0.0, ge=0.0, description="s, when it begins")
    end: float | None = Field(default=None, gt=0.0, description="s, when it stops; default: never")

    @model_validator(mode="after")
    def _forwards(self) -> AirFlow:
        if self.end is not None and self.end <= self.start:
            raise ValueError(f"end must be after start ({self.start:g} s), got {self.end:g} s")
        return self


class SpringEnd(Options):
    """A point of the world, or of a body where it stands at the start."""

    body: str | None = Field(default=None, description="name; default: a fixed point of the world")
    point: Vector | None = Field(default=None, description="m; on or in the body, which carries it")
    vertex: int | None = Field(default=None, ge=0, description="id of a tet vertex, in place of point")

    @model_validator(mode="after")
    def _one_place(self) -> SpringEnd:
        if (self.point is None) == (self.vertex is None):
            raise ValueError("give either `point` (m) or `vertex` (of a body), one of the two")
        if self.vertex is not None and self.body is None:
            raise ValueError("`vertex` needs a `body`")
        return self


class Spring(Options):
    """A spring with a dashpot between two points."""

    ends: tuple[SpringEnd, SpringEnd] = Field(description="the two points, at least one on a body")
    stiffness: float = Field(gt=0.0, description="N/m")
    rest_length: float | None = Field(
        default=None, ge=0.0, description="m; default: as far as the ends are apart at the start"
    )
    damping: float = Field(default=0.0, ge=0.0, description="N s/m")

    @model_validator(mode="after")
    def _a_body(self) -> Spring:
        if all(end.body is None for end in self.ends):
            raise ValueError("one of the two ends must be on a body")
        return self


class Attachment(Region):
    """Ties vertices of one body to the nearest points of another: where they are at the start they stay.

    Springs without length pull each chosen vertex of the first body to the point that the second body's
    nearest element carries along, across the gap between them if there is one.
    """

    bodies: tuple[str, str] = Field(description="names; vertices of the first are tied to the second")
    distance: float | None = Field(
        default=None, gt=0.0,
        description="m, tie vertices no farther than this from the second body; default: a fiftieth of the "
        "first one's size",
    )  # fmt: skip
    stiffness: float | None = Field(
        default=None, gt=0.0,
        description="N/m of all ties together; default: ten times what the elements hold each vertex with",
    )  # fmt: skip
    damping: float = Field(default=0.0, ge=0.0, description="N s/m of all ties together")

    @model_validator(mode="after")
    def _apart(self) -> Attachment:
        if self.bodies[0] == self.bodies[1]:
            raise ValueError(f"an attachment ties two different bodies, got {self.bodies[0]!r} twice")
        return self


__all__ = [
    "AirFlow",
    "Attachment",
    "ConstantForce",
    "Pin",
    "Push",
    "Spring",
    "SpringEnd",
    "SurfacePressure",
]
