"""Bodies of a scene: where they come from, how they stand, what they are made of, what acts on them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.materials import Material
from gdpro_sim.simulation.animation_options import BodyAnimation
from gdpro_sim.simulation.copies import Copied, Copies
from gdpro_sim.simulation.forces import ConstantForce, Pin, Push, SurfacePressure
from gdpro_sim.simulation.mujoco_options import MujocoBody
from gdpro_sim.simulation.options import Options, Vector, color_of, several
from gdpro_sim.simulation.regions import Region


class Part(Region):
    """Part of a body that is made of something else."""

    material: Material = Field(description="preset name or values")


class SceneBody(Options):
    """One body, soft or rigid; or several copies of one."""

    name: str = Field(
        default="", pattern=r"^([A-Za-z_][A-Za-z0-9_]*)?$", description="unique; default: from the file"
    )
    asset: str = Field(
        default="",
        description="asset (.usdc, .usda, .usdz) or mesh file, relative to the scene file; "
        "`package:NAME/PATH` is a file inside an installed Python package",
    )
    prompt: str | None = Field(
        default=None, min_length=1, description="in place of `asset`: words to generate one from"
    )
    quality: Literal["draft", "default", "high"] = Field(
        default="default", description="of what a prompt generates"
    )
    color: str | None = Field(default=None, description="colour of a mesh, #rrggbb or a CSS name")
    texture: str | None = Field(
        default=None, description="texture image of a mesh, relative to the scene file"
    )
    masks: dict[str, str] = Field(
        default_factory=dict,
        description="of a mesh: images over its UV map, by name, relative to the scene file; what they paint "
        "white is a vertex `group`",
    )
    budget: int = Field(
        default=50_000, ge=100, le=5_000_000, description="Gaussians to aim for when a mesh is bound"
    )
    up: Literal["auto", "y", "z"] = Field(default="auto", description="up axis of a mesh file")
    tets: int = Field(
        default=6_000, ge=50, le=500_000, description="tetrahedra to aim for, where none are cached; roughly"
    )
    particles: int | None = Field(
        default=None, ge=1, le=20_000_000, description="of MPM to aim for; default: the solver's, by volume"
    )
    size: float | None = Field(default=None, gt=0.0, description="longest side of the bounding box, m")
    scale: float = Field(default=1.0, gt=0.0, description="uniform scale, where size is not given")
    anchor: Literal["bottom", "center", "origin"] = Field(
        default="bottom", description="which point of the turned body `position` places"
    )
    position: Vector = Field(default=(0.0, 0.0, 0.0), description="m")
    rotation: Vector = Field(default=(0.0, 0.0, 0.0), description="degrees about X, then Y, then Z")
    velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="m/s")
    angular_velocity: Vector = Field(default=(0.0, 0.0, 0.0), description="rad/s about the body's centre")
    copies: Copies | None = Field(
        default=None, description="several of it; where bodies are named, its name stands for all of them"
    )
    material: Material | None = Field(
        default=None, description="preset name or values; default: the asset's, else jelly"
    )
    parts: tuple[Part, ...] = Field(
        default=(), description="parts of another material, MPM; the last that holds a particle counts"
    )
    pins: tuple[Pin, ...] = Field(
        default=(), description="parts held in place, or moved along keyframes; one holds all of a rigid body"
    )
    forces: tuple[ConstantForce, ...] = Field(default=(), description="constant forces on parts of it")
    impulses: tuple[Push, ...] = Field(default=(), description="pushes at a time")
    pressures: tuple[SurfacePressure, ...] = Field(default=(), description="on parts of its surface")

    solver: Literal["auto", "fem", "mpm", "mujoco"] = Field(
        default="auto",
        description="in a coupled scene; auto: mpm for what flows or tears, mujoco for what has a `mujoco` "
        "entry or a Young's modulus of 1e8 Pa or more, else fem",
    )
    mujoco: MujocoBody | None = Field(default=None, description="what it is to the MuJoCo solver")
    animation: BodyAnimation | None = Field(
        default=None, description="the motion it follows, where the solver is `animation`"
    )

    copied: Copied | None = Field(default=None, description="set by `copies`")

    @field_validator("color")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        if value is not None:
            color_of(value)
        return value

    @field_validator("parts", "pins", "forces", "impulses", "pressures", mode="before")
    @classmethod
    def _several(cls, value: Any) -> Any:
        return () if value is None else several(value)

    @model_validator(mode="before")
    @classmethod
    def _name_from_file(cls, value: Any) -> Any:
        if isinstance(value, dict) and not value.get("name"):
            source = value.get("asset") or value.get("prompt")
            if not isinstance(source, str):
                return value
            stem = Path(source).stem if value.get("asset") else source.strip()
            safe = "".join(ch if ch.isascii() and ch.isalnum() else "_" for ch in stem)
            value = {**value, "name": safe if safe[:1].isalpha() else f"body_{safe}"}
        return value

    @property
    def source(self) -> str:
        """What its asset is named by: copies share one."""
        return self.name if self.copied is None else self.copied.group

    @model_validator(mode="after")
    def _one_source(self) -> SceneBody:
        if bool(self.asset) == (self.prompt is not None):
            raise ValueError("give either `asset` (a file) or `prompt` (words), one of the two")
        return self


__all__ = ["Part", "SceneBody"]
