"""Settings of MuJoCo and of its bodies, as a scene describes them. SI units, degrees for angles."""

from __future__ import annotations

import itertools
from typing import Annotated, Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.simulation.callbacks import Callback, taken
from gdpro_sim.simulation.mujoco_model import JointKind, MujocoSettings
from gdpro_sim.simulation.options import Number, Options, Vector, several

SOFT = MujocoSettings(timestep=2e-3, tolerance=1e-6, impratio=1.0)
"""With soft bodies, whose contacts take conjugate gradients many iterations."""

Cells = Annotated[int, Field(ge=1, le=16)]


class ControlKey(Options):
    """What an actuator of the base is told at a time."""

    time: float = Field(ge=0.0, description="s")
    value: float = Field(description="in the actuator's own unit; linear in between")


class MujocoOptions(Options):
    """Settings of MuJoCo."""

    kind: Literal["mujoco"] = "mujoco"
    timestep: float | None = Field(
        default=None, gt=0.0, le=0.05,
        description="s, at most; default: 0.001, or 0.002 with soft bodies",
    )  # fmt: skip
    constraints: Literal["auto", "newton", "cg"] = Field(
        default=MujocoSettings.solver,
        description="how contacts and joints are solved: Newton's method, conjugate gradients (quicker for "
        "large full flexes, but slow to converge beside rigid bodies that move), or as the bodies are",
    )
    iterations: int | None = Field(
        default=None, ge=1, le=10_000,
        description="of the constraint solver, at most; default: 100 of Newton's method, 500 of conjugate "
        "gradients",
    )  # fmt: skip
    tolerance: float | None = Field(
        default=None, gt=0.0, lt=1.0, description="at which they end; default: 1e-8, or 1e-6 with soft bodies"
    )
    impratio: float | None = Field(
        default=None, gt=0.0,
        description="stiffness of friction over that of contact normals: a high one creeps less, and takes "
        "longer; default: 100, or 1 with soft bodies",
    )  # fmt: skip
    cone: Literal["elliptic", "pyramidal"] = Field(default=MujocoSettings.cone, description="of friction")
    base: str | None = Field(
        default=None, min_length=1,
        description="MJCF file whose world the bodies join, relative to the scene file",
    )  # fmt: skip
    keyframe: str | None = Field(default=None, description="of the base, that it starts from")
    controls: dict[str, tuple[ControlKey, ...]] = Field(
        default={}, description="of the base's actuators by name: keyframes in order of time"
    )
    controller: Callback | None = Field(
        default=None,
        description="function (time in s, MuJoCo's data) of what the base's actuators are told: a dictionary "
        "by name, or an array of all, or None; asked before every step, after the keyframes",
    )

    @field_validator("controller", mode="before")
    @classmethod
    def _function(cls, value: Any) -> Any:
        return taken(value)

    @field_validator("controls", mode="before")
    @classmethod
    def _listed(cls, value: Any) -> Any:
        return {name: several(keys) for name, keys in value.items()} if isinstance(value, dict) else value

    @field_validator("controls")
    @classmethod
    def _in_order(cls, value: dict[str, tuple[ControlKey, ...]]) -> dict[str, tuple[ControlKey, ...]]:
        for name, keys in value.items():
            if not keys:
                raise ValueError(f"{name}: must hold at least one keyframe")
            for before, after in itertools.pairwise(keys):
                if after.time <= before.time:
                    raise ValueError(
                        f"{name}: keyframes must be in order of time, got {before.time:g} s, {after.time:g} s"
                    )
        return value

    @model_validator(mode="after")
    def _of_a_base(self) -> MujocoOptions:
        for key in ("keyframe", "controls", "controller"):
            if getattr(self, key) and self.base is None:
                raise ValueError(f"`{key}` belongs to a `base`, which is not given")
        return self

    def settings(self, soft: bool) -> MujocoSettings:
        """For the compiled model."""
        best = SOFT if soft else MujocoSettings()
        return MujocoSettings(
            self.timestep or best.timestep,
            self.iterations,
            self.tolerance or best.tolerance,
            self.impratio or best.impratio,
            self.cone,
            self.constraints,
        )


class MujocoBody(Options):
    """What a body is to MuJoCo."""

    form: Literal["auto", "rigid", "full", "trilinear", "quadratic"] = Field(
        default="auto",
        description="rigid; or soft: full moves every vertex of the tets, trilinear and quadratic move the "
        "nodes of a grid of `cells`; auto: rigid from a Young's modulus of 1e8 Pa on, else full",
    )
    shape: Literal["pieces", "hull", "box", "sphere", "capsule", "cylinder"] = Field(
        default="pieces", description="that a rigid body collides with: convex pieces, or one solid"
    )
    concavity: float = Field(
        default=0.1, ge=0.01, le=1.0, description="left in a convex piece, as a share of the body's size"
    )
    joint: JointKind = Field(default="free", description="of a rigid body")
    anchor: Vector | None = Field(
        default=None, description="m, where a hinge or ball turns; default: the body's centre of mass"
    )
    axis: Vector | None = Field(default=None, description="of a hinge or slide, which need it")
    joint_damping: float = Field(default=0.0, ge=0.0, description="N m s/rad, of a slide N s/m")
    limits: tuple[Number, Number] | None = Field(
        default=None, description="of a hinge (degrees) or slide (m), from the start"
    )
    restitution: float | None = Field(
        default=None, ge=0.0, le=1.0,
        description="speed after over speed before an impact, of a rigid body; default: by material",
    )  # fmt: skip
    cells: tuple[Cells, Cells, Cells] | None = Field(
        default=None, description="of the grid along X, Y and Z; default: 4 along the longest side"
    )
    self_contact: bool = Field(default=False, description="whether a soft body collides with itself")

    @field_validator("axis")
    @classmethod
    def _some_way(cls, value: Vector | None) -> Vector | None:
        if value is not None and not any(value):
            raise ValueError("must not be zero")
        return value

    @field_validator("limits")
    @classmethod
    def _ordered(cls, value: Any) -> Any:
        if value is not None and value[1] <= value[0]:
            raise ValueError(f"the upper limit must lie above the lower {value[0]:g}, got {value[1]:g}")
        if value is not None and not value[0] <= 0.0 <= value[1]:
            raise ValueError(
                f"a body starts at 0, which must lie within its limits, got {value[0]:g} to {value[1]:g}"
            )
        return value

    @model_validator(mode="after")
    def _belongs(self) -> MujocoBody:
        given, fields = self.model_fields_set, type(self).model_fields
        if given == set(fields):  # a recorded scene, which is read again with every default written out
            given = {key for key in given if getattr(self, key) != fields[key].default}
        rigid = {"shape", "concavity", "joint", "anchor", "axis", "joint_damping", "limits", "restitution"}
        if self.form in ("full", "trilinear", "quadratic") and given & rigid:
            raise ValueError(f"`{min(given & rigid)}` belongs to a rigid body; this one is {self.form}")
        if self.form == "rigid" and given & {"cells", "self_contact"}:
            raise ValueError(f"`{min(given & {'cells', 'self_contact'})}` belongs to a soft body")
        if "cells" in given and self.form not in ("trilinear", "quadratic"):
            raise ValueError(f"`cells` belongs to the forms trilinear and quadratic; this one is {self.form}")
        if self.joint in ("hinge", "slide") and self.axis is None:
            raise ValueError(f"a {self.joint} needs an `axis`, such as [0, 0, 1]")
        needed = {
            "anchor": ("hinge", "ball"), "axis": ("hinge", "slide"), "limits": ("hinge", "slide"),
            "joint_damping": ("hinge", "slide", "ball"),
        }  # fmt: skip
        for key, kinds in needed.items():
            if key in given and self.joint not in kinds:
                raise ValueError(f"`{key}` belongs to a joint {' or '.join(kinds)}; this one is {self.joint}")
        return self


__all__ = ["ControlKey", "MujocoBody", "MujocoOptions"]
