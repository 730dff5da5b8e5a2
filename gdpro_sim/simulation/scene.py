"""Scenes: what the user wrote, in YAML or Python, checked before anything runs."""

from __future__ import annotations

import difflib
import importlib.resources
import importlib.util
import logging
import math
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, get_args

import yaml
from pydantic import BaseModel, Field, ValidationError, field_validator, model_validator
from pydantic_core.core_schema import ValidationInfo

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.callbacks import callbacks_of
from gdpro_sim.simulation.colliders import BoundaryKind, ColliderOptions, MeshCollider
from gdpro_sim.simulation.copies import expand, members
from gdpro_sim.simulation.forces import AirFlow, Attachment, Spring
from gdpro_sim.simulation.lights import LIGHTS, LightOptions, expand_lights
from gdpro_sim.simulation.mujoco_options import MujocoOptions
from gdpro_sim.simulation.options import Options, Vector, several
from gdpro_sim.simulation.randomize import Variation, parse
from gdpro_sim.simulation.scene_body import SceneBody
from gdpro_sim.simulation.solver_options import CoupledOptions, FemOptions, SolverOptions
from gdpro_sim.simulation.view import Camera, NamedCamera, Render, check_cameras

if TYPE_CHECKING:
    from gdpro_sim.asset import Asset

log = logging.getLogger(__name__)

Described = TypeVar("Described", bound=BaseModel)

STIFFEST = 1.0e7
"""Young's modulus in Pa to which `drop_scene` limits materials."""


class GroundPlane(Options):
    """The floor z = height."""

    height: float = Field(default=0.0, description="m")
    boundary: BoundaryKind = Field(
        default="separate",
        description="separate (rubs by the bodies' friction), slip or sticky. MPM; FEM knows only separate",
    )


class Scene(Options):
    """A whole simulation: bodies, world, time, camera and solver. SI units, Z up."""

    name: str = Field(default="scene", min_length=1)
    description: str = ""
    seed: int = Field(default=0, ge=0, description="of every random draw")
    bodies: tuple[SceneBody, ...] = Field(
        min_length=1, description="one or several; of one with `copies` all of them"
    )
    ground: GroundPlane | None = Field(default_factory=GroundPlane, description="null for no floor")
    gravity: Vector = Field(default=(0.0, 0.0, -9.81), description="m/s^2")
    fps: int = Field(default=30, ge=1, le=1000, description="frames per second")
    duration: float = Field(default=3.0, gt=0.0, le=3600.0, description="s")
    camera: Camera = Field(default_factory=Camera)
    cameras: tuple[NamedCamera, ...] = Field(default=(), description="more cameras; one or several")
    lights: tuple[LightOptions, ...] = Field(
        default=(), description=f"one or several, or names of sets: {', '.join(LIGHTS)}; default: studio"
    )
    render: Render = Field(default_factory=Render)
    solver: SolverOptions = Field(
        default_factory=FemOptions,
        description="FEM, `kind: mpm`, `kind: mujoco`, `kind: coupled`: each body by its own, or "
        "`kind: animation`: no physics, bodies follow motions",
    )
    colliders: tuple[ColliderOptions, ...] = Field(
        default=(), description="rigid obstacles, at rest or moving; one or several"
    )
    wind: tuple[AirFlow, ...] = Field(default=(), description="air that drags and lifts; one or several")
    springs: tuple[Spring, ...] = Field(default=(), description="between bodies, or a body and the world")
    attachments: tuple[Attachment, ...] = Field(
        default=(), description="bodies tied together where they meet"
    )
    randomize: tuple[Variation, ...] = Field(
        default=(),
        description="what `gdpro rollout` draws anew for every rollout: a mapping of paths to ranges",
    )
    folder: Path = Field(
        default_factory=Path.cwd, exclude=True, description="where relative paths start; set by load_scene"
    )

    @field_validator("bodies", mode="before")
    @classmethod
    def _some_bodies(cls, value: Any) -> Any:
        return several(value)

    @field_validator("bodies")
    @classmethod
    def _with_copies(cls, value: tuple[SceneBody, ...], info: ValidationInfo) -> tuple[SceneBody, ...]:
        return expand(value, info.data.get("seed", 0))

    @field_validator("colliders", "wind", "springs", "attachments", mode="before")
    @classmethod
    def _several(cls, value: Any) -> Any:
        return () if value is None else several(value)

    @field_validator("cameras", mode="before")
    @classmethod
    def _some_cameras(cls, value: Any) -> Any:
        return () if value is None else several(value)

    @field_validator("lights", mode="before")
    @classmethod
    def _sets_of_lights(cls, value: Any) -> Any:
        return () if value is None else expand_lights(value)

    @model_validator(mode="after")
    def _cameras_fit(self) -> Scene:
        check_cameras(self.camera, self.cameras, [body.name for body in self.bodies], self.duration)
        return self

    @field_validator("randomize", mode="before")
    @classmethod
    def _variations(cls, value: Any) -> Any:
        return parse(value)

    @field_validator("solver", mode="before")
    @classmethod
    def _fem_unless_said(cls, value: Any) -> Any:
        return {"kind": "fem", **value} if isinstance(value, dict) else value

    @model_validator(mode="after")
    def _names_known(self) -> Scene:
        used = [
            *((f"springs[{k}].ends[{e}].body", end.body)
              for k, spring in enumerate(self.springs) for e, end in enumerate(spring.ends)),
            *((f"attachments[{k}].bodies", name)
              for k, ties in enumerate(self.attachments) for name in ties.bodies),
            *((f"wind[{k}].bodies", name) for k, air in enumerate(self.wind) for name in air.bodies or ()),
        ]  # fmt: skip
        names = list(members(self.bodies))
        for place, name in used:
            if name is not None and name not in names:
                near = difflib.get_close_matches(name, names, n=1)
                hint = f" (did you mean {near[0]!r}?)" if near else ""
                raise ValueError(f"{place}: there is no body {name!r}{hint}; bodies: {', '.join(names)}")
        return self

    @model_validator(mode="after")
    def _pushed_in_time(self) -> Scene:
        kind, coupled = self.solver.kind, isinstance(self.solver, CoupledOptions)
        for body in self.bodies:
            where = f"bodies[{body.name}]"
            if not coupled and body.solver not in ("auto", kind):
                raise ValueError(
                    f"{where}.solver: {body.solver!r} in a scene whose solver is {kind}; for a solver each, "
                    "write `solver: {kind: coupled}` in the scene"
                )
            if body.mujoco is not None and (
                body.solver in ("fem", "mpm") if coupled else self.mujoco_options is None
            ):
                raise ValueError(
                    f"{where}.mujoco: belongs to `solver: {{kind: mujoco}}`, but the "
                    f"{'body' if coupled else 'scene'}'s solver is {body.solver if coupled else kind}"
                )
            if body.animation is not None and kind != "animation":
                raise ValueError(
                    f"{where}.animation: belongs to `solver: {{kind: animation}}`, but the scene's solver is "
                    f"{kind}"
                )
        if isinstance(self.solver, FemOptions) and self.solver.integrator == "quasi-static":
            for body in self.bodies:
                if body.impulses:
                    raise ValueError(
                        f"bodies[{body.name}].impulses: have no effect without inertia (quasi-static); give "
                        "`forces`"
                    )
        return self

    @property
    def frame_count(self) -> int:
        """Frames of the simulation, the initial one included."""
        return max(1, round(self.duration * self.fps)) + 1

    @property
    def mujoco_options(self) -> MujocoOptions | None:
        """Settings of MuJoCo, where it takes part."""
        solver = self.solver.mujoco if isinstance(self.solver, CoupledOptions) else self.solver
        return solver if isinstance(solver, MujocoOptions) else None

    @property
    def files(self) -> list[str]:
        """References to every file the scene reads, as they are written in it."""
        named = [
            reference
            for body in self.bodies
            for reference in (body.asset, body.texture, *body.masks.values())
        ]
        named += [body.animation.file for body in self.bodies if body.animation is not None]
        named += [collider.file for collider in self.colliders if isinstance(collider, MeshCollider)]
        if self.mujoco_options is not None:
            named.append(self.mujoco_options.base)
        named += [callback.file for callback in callbacks_of(self)]
        return [reference for reference in dict.fromkeys(named) if reference]

    def resolve(self, reference: str) -> Path:
        """Absolute path of an asset reference. Raises SceneError for an unknown `package:`."""
        if reference.startswith("package:"):
            package, _, inside = reference.removeprefix("package:").partition("/")
            try:
                named = all(part.isidentifier() for part in package.split("."))
                spec = importlib.util.find_spec(package) if named else None
            except (ImportError, ValueError):
                spec = None
            if spec is None or not spec.submodule_search_locations:
                raise SceneError(f"{self.name}: asset {reference!r}: no installed Python package {package!r}")
            return Path(next(iter(spec.submodule_search_locations))) / inside
        path = Path(reference).expanduser()
        return path if path.is_absolute() else self.folder / path


def scene_names() -> list[str]:
    """Names of the scenes shipped with the package."""
    folder = importlib.resources.files("gdpro_sim.scenes")
    return sorted(Path(entry.name).stem for entry in folder.iterdir() if entry.name.endswith(".yaml"))


def drop_scene(asset: str | Path) -> Scene:
    """The default scene of one asset file: it falls from half its size, a little tilted.

    A stiffer material than `STIFFEST` is taken as that stiff, and said so: no bending would be seen, and the
    solver would spend its time on vibrations that nobody sees either. Raises AssetError for a file that
    cannot be read, SceneError for one that is no asset.
    """
    from gdpro_sim.asset import Asset, kind

    path = Path(asset).expanduser().resolve()
    if kind(path) != "asset":
        raise SceneError(f"{path} is no asset; make one of it: gdpro import {path} -o {path.stem}_asset.usdc")
    loaded = Asset.load(path)
    size = max(loaded.summary()["size"])
    height = 0.5 * size
    body: dict[str, Any] = {
        "asset": str(path),
        "position": (0.0, 0.0, height),
        "rotation": (8.0, -6.0, 20.0),
    }
    description = "An asset falls on the floor."
    if loaded.material is not None and loaded.material.young > STIFFEST:
        body["material"] = {
            **loaded.material.model_dump(),
            "young": STIFFEST,
            "model": "stable_neo_hookean",
            "yield_stress": None,  # it would mean nothing beside that stiffness
            "hardening": 0.0,
        }
        description += f" Young's modulus {loaded.material.young:g} Pa is taken as {STIFFEST:g} Pa."
        log.warning("%s: %s", path.name, description.split(". ")[1])
    data = {
        "name": path.stem,
        "description": description,
        "bodies": [body],
        "solver": {"kind": "mpm"} if _for_mpm(loaded) else {"substeps": 4},
        "duration": max(1.5, round(4.0 * math.sqrt(size / 9.81), 1)),  # the fall takes a quarter of it
    }
    return check_scene(data, str(path))


def _for_mpm(asset: Asset) -> bool:
    """Whether only MPM can simulate it: it flows or tears, or it is a cloud of pieces without a mesh."""
    faces = asset.gaussians.faces
    cloud = asset.tets is None and len(faces.unique()) == faces.numel()
    return cloud or (asset.material is not None and asset.material.mpm_only() is not None)


def load_scene(scene: str | Path, *, seed: int | None = None) -> Scene:
    """Read a scene from a YAML path, or a shipped scene by name; an asset file gets `drop_scene`.

    seed: in place of the scene's own
    Raises SceneError naming the file, the key and what is allowed.
    """
    path = Path(scene).expanduser()
    if path.suffix.lower() in (".usdc", ".usda", ".usdz"):
        dropped = drop_scene(path)
        return dropped if seed is None else dropped.model_copy(update={"seed": seed})
    if path.suffix.lower() not in (".yaml", ".yml"):
        names = scene_names()
        if str(scene) not in names:
            near = difflib.get_close_matches(str(scene), names, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            if path.is_file():
                raise SceneError(
                    f"{path} is neither a scene (.yaml) nor an asset; if it is a mesh, make one of it: gdpro "
                    f"import {path} -o {path.stem}.usdc"
                )
            raise SceneError(
                f"no scene {str(scene)!r}{hint}; give a .yaml file or one of: {', '.join(names)}"
            )
        with importlib.resources.as_file(
            importlib.resources.files("gdpro_sim.scenes") / f"{scene}.yaml"
        ) as shipped:
            return _parse(shipped.read_text(encoding="utf-8"), f"{scene}.yaml", Path.cwd(), seed)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise SceneError(f"{path}: no such file; `gdpro scenes` lists the shipped scenes") from None
    except UnicodeDecodeError as error:
        raise SceneError(f"{path}: byte {error.start} is not UTF-8; save it as UTF-8 text") from None
    except OSError as error:
        raise SceneError(f"{path}: cannot be read as text: {error}") from None
    return _parse(text, str(path), path.resolve().parent, seed)


class _UniqueKeys(yaml.SafeLoader):
    """Safe YAML that refuses a key given twice; plain YAML keeps the last silently."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            if key.value in seen:
                raise yaml.constructor.ConstructorError(
                    None, None, f"the key {key.value!r} stands there twice", key.start_mark
                )
            seen.add(key.value)
        return super().construct_mapping(node, deep)


def read_mapping(text: str, source: str, what: str) -> dict[str, Any]:
    """The mapping that YAML `text` holds. Raises SceneError naming `source` and the line."""
    try:
        data = yaml.load(text, Loader=_UniqueKeys)
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else "unknown place"
        raise SceneError(
            f"{source}: not valid YAML at {where}: {getattr(error, 'problem', None) or error}"
        ) from None
    if not isinstance(data, dict):
        raise SceneError(f"{source}: {what}, got {type(data).__name__}")
    return data


def _parse(text: str, source: str, folder: Path, seed: int | None) -> Scene:
    data = read_mapping(text, source, "a scene is a mapping with at least `bodies:`")
    if "folder" in data:
        raise SceneError(f"{source}: unknown key `folder`; asset paths are relative to the scene file")
    if seed is not None:
        data["seed"] = seed
    return check_scene({"name": Path(source).stem, **data, "folder": folder}, source)


def check_scene(data: dict[str, Any], source: str = "scene") -> Scene:
    """Build a Scene from plain data; SceneError with one line per wrong value."""
    return checked(Scene, data, source)


def checked(kind: type[Described], data: dict[str, Any], source: str) -> Described:
    """A description of `kind` from plain data; SceneError with one line per wrong value."""
    try:
        return kind.model_validate(data)
    except ValidationError as error:
        items = error.errors()
        # A list whose only item is wrong is reported as too short as well: say the cause alone.
        items = [
            a
            for a in items
            if a["type"] != "too_short"
            or not any(len(b["loc"]) > len(a["loc"]) and b["loc"][: len(a["loc"])] == a["loc"] for b in items)
        ]
        lines = [_explain(item, source, kind) for item in items]
        raise SceneError("\n".join(dict.fromkeys(lines))) from None


_PLAIN = (
    (r", unable to parse string as .*", ""),
    (r"a valid (tuple|list)", "a list"),
    (r"a valid dictionary( or .*)?", "a mapping of keys to values"),
    (r"a valid number", "a number"),
    (r"a valid integer", "a whole number"),
    (r"a valid string", "text"),
    (r"a valid boolean", "true or false"),
)
"""What pydantic says, and what it means to somebody who writes YAML."""


def _explain(item: Any, source: str, root: type[BaseModel]) -> str:
    """One line for one pydantic error: file, path of the key, what was expected, what was given."""
    location = item["loc"]
    place, _ = _place(location, root)
    value = item.get("input")
    if item["type"] == "extra_forbidden":
        _, allowed = _place(location[:-1], root)
        near = difflib.get_close_matches(str(location[-1]), allowed, n=1)
        hint = f" (did you mean `{near[0]}`?)" if near else ""
        return f"{source}: {place}: unknown key{hint}; allowed: {', '.join(allowed)}"
    if item["type"] == "union_tag_not_found":
        return f"{source}: {place}.kind: is required"
    if item["type"] == "union_tag_invalid":
        expected, tag = item["ctx"]["expected_tags"], item["ctx"]["tag"]
        return f"{source}: {place}.kind: must be {expected}, got {tag!r}"
    if item["type"] == "missing":
        return f"{source}: {place}: is required"
    if item["type"] == "too_short":
        return f"{source}: {place}: must hold at least one item"
    message = str(item["msg"])
    message = message.removeprefix("Value error, ").replace("Input should be", "must be")
    for pattern, plain in _PLAIN:
        message = re.sub(pattern, plain, message)
    message = message[0].lower() + message[1:]
    said = "got" in message or (isinstance(value, str) and repr(value) in message)
    shown = "" if said or isinstance(value, dict | list) else f", got {value!r}"
    return f"{source}: {place}{': ' if place else ''}{message}{shown}"


def _place(location: tuple[Any, ...], root: type[BaseModel]) -> tuple[str, list[str]]:
    """A path inside `root` as the user writes it, and the field names of the model that lives there.

    The path of pydantic also names which of several kinds of thing was meant; the user wrote no such key.
    """
    models: list[type[BaseModel]] = [root]
    place = ""
    for part in location:
        if isinstance(part, int):
            place += f"[{part}]"
            continue
        if part.startswith("<"):  # the tag of a union, as in `Moving.motion`
            models = [model for model in models if model.__name__ == part.strip("<>")]
            continue
        kinds = [m for m in models if "kind" in m.model_fields and m.model_fields["kind"].default == part]
        if kinds and len(models) > 1:
            models = kinds
            continue
        place += f".{part}" if place else str(part)
        owners = [model for model in models if part in model.model_fields]
        found = _models_in(owners[0].model_fields[part].annotation) if owners else []
        models = found or models
    return place, [name for name in models[0].model_fields if name not in ("folder", "copied")]


def _models_in(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models_in(inner)]


__all__ = [
    "GroundPlane",
    "Scene",
    "check_scene",
    "checked",
    "drop_scene",
    "load_scene",
    "read_mapping",
    "scene_names",
]
