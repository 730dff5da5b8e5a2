"""Copies of a body: how many and where, as a scene describes them, and the bodies they become.

Each copy is a body of its own, `duck_0`, `duck_1` and so on; the asset is made once for all of them. The name
they come from, `duck`, stands for all of them where a scene names bodies.
"""

from __future__ import annotations

import warnings
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import torch
from pydantic import Field, field_validator, model_validator
from scipy.spatial.transform import Rotation

from gdpro_sim.gaussians import rgb_to_sh, sh_to_rgb
from gdpro_sim.simulation.options import Options, Vector, color_of, several

if TYPE_CHECKING:
    from gdpro_sim.asset import Asset
    from gdpro_sim.simulation.scene_body import SceneBody

MOST = 10_000

PLAIN = 0.01
"""Vertices whose colours differ by less, of 1, have one plain colour."""

Count = Annotated[int, Field(ge=1, le=MOST)]


class CopyPose(Options):
    """Where one copy stands, in place of the body's own values."""

    position: Vector = Field(description="m")
    rotation: Vector | None = Field(default=None, description="degrees about X, then Y, then Z")
    velocity: Vector | None = Field(default=None, description="m/s")
    angular_velocity: Vector | None = Field(default=None, description="rad/s about the copy's centre")


class Jitter(Options):
    """What is added at random, evenly spread up to the given values to both sides; drawn from `seed`."""

    position: Vector = Field(default=(0.0, 0.0, 0.0), description="m along X, Y and Z")
    rotation: Vector = Field(default=(0.0, 0.0, 0.0), description="degrees about X, then Y, then Z")

    @field_validator("position", "rotation", mode="before")
    @classmethod
    def _alike(cls, value: Any) -> Any:
        return (value, value, value) if isinstance(value, int | float) else value

    @field_validator("position", "rotation")
    @classmethod
    def _outwards(cls, value: Vector) -> Vector:
        if min(value) < 0.0:
            raise ValueError(f"must not be negative, got {list(value)}")
        return value


class Copies(Options):
    """Several of one body: give one of `count`, `grid` and `poses`."""

    count: Count | None = Field(
        default=None, description="so many in a row: the first at the body's position, each `spacing` further"
    )
    grid: tuple[Count, Count, Count] | None = Field(
        default=None,
        description="so many along X, Y and Z: the middle of the lowest layer at the body's position",
    )
    poses: tuple[CopyPose, ...] | None = Field(
        default=None, min_length=1, max_length=MOST, description="where each stands"
    )
    spacing: Vector | None = Field(
        default=None,
        description="m from each to the next along X, Y, Z; one number: along X in a row, all ways in a grid",
    )
    jitter: Jitter | None = Field(default=None, description="moved and turned at random")
    colors: tuple[str, ...] = Field(
        default=(),
        description="of the copies in turn, #rrggbb or CSS names: what has one plain colour takes them, the "
        "colours of other assets and textures are multiplied by them",
    )

    @model_validator(mode="before")
    @classmethod
    def _shorthands(cls, value: Any) -> Any:
        if isinstance(value, int) and not isinstance(value, bool):
            return {"count": value}
        if isinstance(value, dict):
            value = dict(value)
            spacing = value.get("spacing")
            if isinstance(spacing, int | float):
                row = "grid" not in value
                value["spacing"] = (spacing, 0.0, 0.0) if row else (spacing, spacing, spacing)
            for key in ("poses", "colors"):
                if isinstance(value.get(key), str):
                    value[key] = (value[key],)
                elif key in value:
                    value[key] = several(value[key])
        return value

    @field_validator("colors")
    @classmethod
    def _known(cls, value: tuple[str, ...]) -> tuple[str, ...]:
        for color in value:
            color_of(color)
        return value

    @model_validator(mode="after")
    def _one_way(self) -> Copies:
        given = [key for key in ("count", "grid", "poses") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of count, grid and poses, got {' and '.join(given) or 'none'}")
        if self.poses is not None:
            if self.spacing is not None:
                raise ValueError("`spacing` belongs to `count` or `grid`")
            return self
        steps = np.array([1, 1, 1] if self.grid is None else self.grid) - 1
        if self.grid is not None and int(np.prod(steps + 1)) > MOST:
            raise ValueError(f"a grid may hold {MOST:,} at most, got {int(np.prod(steps + 1)):,}")
        spacing = np.zeros(3) if self.spacing is None else np.asarray(self.spacing)
        if self.count is not None and self.count > 1 and not spacing.any():
            raise ValueError("`count` needs a `spacing` other than 0, or all would stand in one place")
        if ((steps > 0) & (spacing == 0.0)).any():
            axis = "XYZ"[int(np.flatnonzero((steps > 0) & (spacing == 0.0))[0])]
            raise ValueError(f"`grid` needs a `spacing` other than 0 along {axis}")
        return self

    def offsets(self) -> np.ndarray:
        """[n, 3] m of a row or a grid from the body's position; along X first, Z last."""
        spacing = np.zeros(3) if self.spacing is None else np.asarray(self.spacing)
        if self.grid is None:
            return np.arange(self.count or 0)[:, None] * spacing
        x, y, z = (np.arange(n, dtype=float) for n in self.grid)
        steps = np.stack(np.meshgrid(z, y, x, indexing="ij")[::-1], axis=-1).reshape(-1, 3)
        steps[:, :2] -= 0.5 * (np.asarray(self.grid[:2]) - 1)
        return steps * spacing


class Copied(Options):
    """What a copy is a copy of; `copies` make it.

    position, rotation: of the body as it is written: its regions are chosen there
    """

    group: str
    number: int
    position: Vector
    rotation: Vector
    color: str | None = None


def expand(bodies: tuple[SceneBody, ...], seed: int) -> tuple[SceneBody, ...]:
    """The bodies with all their copies in place of those that have `copies`.

    Raises ValueError, listing them, for names that other bodies have.
    """
    seen: set[str] = set()
    for body in bodies:
        if body.name in seen:
            raise ValueError(f"two bodies are named {body.name!r}; give each a `name` of its own")
        seen.add(body.name)
    out: list[SceneBody] = []
    clashes: list[str] = []
    for body in bodies:
        made = [body] if body.copies is None else _copies(body, body.copies, seed)
        clashes += [copy.name for copy in made if copy is not body and copy.name in seen]
        out += made
    if clashes:
        raise ValueError(f"copies would be named like other bodies: {', '.join(clashes)}; rename those")
    return tuple(out)


def _copies(body: SceneBody, copies: Copies, seed: int) -> list[SceneBody]:
    if copies.poses is not None:
        changes = [pose.model_dump(exclude_none=True) for pose in copies.poses]
    else:
        changes = [{"position": np.asarray(body.position) + offset} for offset in copies.offsets()]
    dice = np.random.default_rng([seed, *body.name.encode()])
    made = []
    for number, change in enumerate(changes):
        if copies.jitter is not None:
            change = {"rotation": body.rotation, **change}
            shift, angles = dice.uniform(-1.0, 1.0, (2, 3)) * (copies.jitter.position, copies.jitter.rotation)
            turn = Rotation.from_euler("xyz", angles, degrees=True)
            turned = turn * Rotation.from_euler("xyz", change["rotation"], degrees=True)
            change["position"] = np.asarray(change["position"]) + shift
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of a lost axis: any angles that give the rotation will do
                change["rotation"] = turned.as_euler("xyz", degrees=True)
        color = copies.colors[number % len(copies.colors)] if copies.colors else None
        copied = Copied(
            group=body.name, number=number, position=body.position, rotation=body.rotation, color=color
        )
        three = {key: tuple(float(x) for x in value) for key, value in change.items()}
        update = {**three, "name": f"{body.name}_{number}", "copies": None, "copied": copied}
        made.append(body.model_copy(update=update))
    return made


def colored(asset: Asset, color: str) -> Asset:
    """The asset in another colour: one of a plain colour takes it, the colours of others are multiplied."""
    vertex_colors, tint = asset.vertex_colors, np.asarray(color_of(color))
    if vertex_colors is not None and float(np.ptp(vertex_colors, axis=0).max()) < PLAIN:
        tint = tint / np.maximum(vertex_colors.mean(axis=0), PLAIN)
    factor = torch.tensor(tint, dtype=torch.float32, device=asset.gaussians.device)
    sh = asset.gaussians.sh * factor
    sh[:, 0] = rgb_to_sh(sh_to_rgb(asset.gaussians.sh[:, 0]) * factor)
    if vertex_colors is not None:
        vertex_colors = np.clip(vertex_colors * tint, 0.0, 1.0).astype(np.float32)
    return replace(asset, gaussians=replace(asset.gaussians, sh=sh), vertex_colors=vertex_colors)


def members(bodies: tuple[SceneBody, ...]) -> dict[str, list[str]]:
    """Names of bodies, by each name that a scene may use for them: their own, or that of all copies."""
    named: dict[str, list[str]] = {body.name: [body.name] for body in bodies}
    for body in bodies:
        if body.copied is not None:
            named.setdefault(body.copied.group, []).append(body.name)
    return named


__all__ = ["Copied", "Copies", "CopyPose", "Jitter", "colored", "expand", "members"]
