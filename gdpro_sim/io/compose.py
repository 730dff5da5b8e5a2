"""Compositions as people write them: assets, meshes and prompts with their places, in YAML or Python."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field, field_validator, model_validator

from gdpro_sim.asset import Asset, ComposedPart, compose, import_mesh, kind
from gdpro_sim.errors import SceneError
from gdpro_sim.io.generated import with_generated
from gdpro_sim.materials import Material
from gdpro_sim.simulation.options import Options, Vector, several
from gdpro_sim.simulation.scene import Scene, checked, read_mapping
from gdpro_sim.simulation.scene_body import SceneBody


class PartOptions(Options):
    """One part of a composition."""

    name: str | None = Field(default=None, min_length=1, description="default: from the file")
    asset: str = Field(default="", description="asset or mesh file, as in a scene")
    prompt: str | None = Field(default=None, min_length=1, description="in place of `asset`")
    quality: Literal["draft", "default", "high"] = Field(default="default", description="of a prompt")
    color: str | None = Field(default=None, description="colour of a mesh")
    texture: str | None = Field(default=None, description="texture image of a mesh")
    budget: int = Field(default=50_000, ge=100, le=5_000_000, description="Gaussians to aim for on a mesh")
    up: Literal["auto", "y", "z"] = Field(default="auto", description="up axis of a mesh file")
    size: float | None = Field(default=None, gt=0.0, description="longest side of the bounding box, m")
    scale: float = Field(default=1.0, gt=0.0, description="uniform scale, where size is not given")
    anchor: Literal["bottom", "center", "origin"] = Field(
        default="origin", description="which point of the turned part `position` places"
    )
    position: Vector = Field(default=(0.0, 0.0, 0.0), description="m")
    rotation: Vector = Field(default=(0.0, 0.0, 0.0), description="degrees about X, then Y, then Z")
    material: Material | None = Field(default=None, description="default: the asset's")
    license: str | None = Field(default=None, min_length=1, description="default: the asset's")

    @model_validator(mode="after")
    def _one_source(self) -> PartOptions:
        if bool(self.asset) == (self.prompt is not None):
            raise ValueError("give either `asset` (a file) or `prompt` (words), one of the two")
        if self.size is not None and "scale" in self.model_fields_set:
            raise ValueError("give either `size` or `scale`, one of the two")
        return self


class Composition(Options):
    """Several assets to be made into one."""

    name: str = Field(default="composition", min_length=1)
    description: str = ""
    parts: tuple[PartOptions, ...] = Field(min_length=1)
    glue: bool = Field(
        default=True, description="fill the union with tets, so that what overlaps is one body"
    )
    tets: int = Field(default=6_000, ge=0, le=500_000, description="of the union to aim for; 0 for none")
    seed: int = Field(default=0, ge=0)
    folder: Path = Field(default_factory=Path.cwd, exclude=True)

    @field_validator("parts", mode="before")
    @classmethod
    def _several(cls, value: Any) -> Any:
        return several(value)


def load_composition(file: str | Path) -> Composition:
    """Read a composition from YAML; paths in it start at its folder. Raises SceneError."""
    path = Path(file).expanduser()
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise SceneError(f"{path}: a composition is a .yaml file; assets and meshes go into its `parts`")
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read as text: {error}") from None
    data = read_mapping(text, str(path), "a composition is a mapping with at least `parts:`")
    if "folder" in data:
        raise SceneError(f"{path}: unknown key `folder`; paths are relative to the file")
    return checked(Composition, {"name": path.stem, **data, "folder": path.resolve().parent}, str(path))


def compose_parts(
    composition: Composition,
    output: str | Path,
    *,
    device: str = "auto",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> Asset:
    """Load, import or generate the parts and compose them.

    What prompts generate is kept in the folder `output`, and used again by the next call. Raises SceneError,
    AssetError, MeshError, GuidanceError.
    """
    report = on_progress or (lambda phase, done, total: None)
    bodies = []
    for number, part in enumerate(composition.parts):
        own = part.model_dump(include={"asset", "prompt", "quality", "color", "texture", "budget", "up"})
        bodies.append(SceneBody.model_validate({**own, "name": f"part_{number}"}))
    scene = Scene(name=composition.name, bodies=tuple(bodies), folder=composition.folder)
    if any(part.prompt is not None for part in composition.parts):
        scene = with_generated(scene, output, device=device, on_progress=report)
    parts = []
    for number, (part, body) in enumerate(zip(composition.parts, scene.bodies, strict=True)):
        asset = _loaded(f"{composition.name}: parts[{number}]", scene, body, part, composition.seed, report)
        parts.append(
            ComposedPart(
                asset, part.position, part.rotation, part.scale, part.size, part.anchor,
                part.name or (Path(part.asset).stem if part.asset else part.prompt),
            )
        )  # fmt: skip
    return compose(
        parts,
        name=composition.name,
        glue=composition.glue,
        target_tets=composition.tets,
        on_progress=lambda phase: report(phase, 0, 0),
    )


def _loaded(
    where: str,
    scene: Scene,
    body: SceneBody,
    part: PartOptions,
    seed: int,
    report: Callable[[str, int, int], None],
) -> Asset:
    path = scene.resolve(body.asset)
    if not path.exists():
        raise SceneError(f"{where}.asset: {path}: no such file")
    if kind(path) == "asset":
        ignored = [key for key in ("color", "texture") if getattr(part, key) is not None]
        if ignored:
            raise SceneError(
                f"{where}.{ignored[0]}: applies to a mesh, but {path.name} is an asset; remove it"
            )
        asset = Asset.load(path)
    else:
        asset = import_mesh(
            path,
            budget=part.budget,
            color=part.color,
            texture=None if part.texture is None else scene.resolve(part.texture),
            up=part.up,
            tets=False,
            seed=seed,
            on_progress=lambda phase: report(phase, 0, 0),
        )
    if part.material is not None:
        asset = replace(asset, material=part.material, group_materials={})
    if part.license is not None:
        asset = replace(asset, provenance={**asset.provenance, "license": part.license})
    return asset


__all__ = ["Composition", "PartOptions", "compose_parts", "load_composition"]
