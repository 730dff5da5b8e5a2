"""Domain randomisation: which values of a scene are drawn anew for every rollout, and from what.

A value is named by its path in the scene: `bodies.bear.position`, `bodies.*.material.density`,
`gravity.z`, `solver.controls.lift.*.value`, `camera.azimuth`. A draw depends on the seed, the number of the
rollout and the path alone: other values, threads and the number of rollouts do not change it.
"""

from __future__ import annotations

import difflib
import fnmatch
import hashlib
import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal, cast, get_args

import numpy as np
from pydantic import BaseModel, Field, ValidationError, model_validator
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.options import Number, Options

Values = Number | tuple[Number, ...]

FIXED = (
    "name", "description", "fps", "duration", "seed", "folder", "randomize", "*.name", "*.kind", "*.file",
    *(f"bodies.*.{key}" for key in (
        "asset", "prompt", "quality", "color", "texture", "budget", "up", "tets", "particles", "copies",
        "solver", "mujoco.form", "mujoco.shape", "mujoco.joint", "mujoco.concavity", "mujoco.cells",
    )),
    "camera.width", "camera.height", "solver.base", "solver.keyframe", "solver.callback",
)  # fmt: skip
"""What decides which files are made, or the shape of the dataset, stays the same."""

ANY_WAY = "any"
"""In place of a range: all orientations, none likelier than another."""


class Variation(Options):
    """A value of the scene, and what it is drawn from."""

    path: str = Field(min_length=1, description="of the value in the scene; * stands for all")
    low: Values | None = Field(default=None, description="least value")
    high: Values | None = Field(default=None, description="largest value")
    choices: tuple[Any, ...] | None = Field(
        default=None, description="in place of low and high: values to choose from"
    )
    distribution: Literal["uniform", "log_uniform", "orientation"] = Field(
        default="uniform", description="between low and high; orientation: any, of a rotation"
    )
    apply: Literal["set", "add", "scale"] = Field(
        default="set", description="whether the drawn value replaces, shifts or scales the scene's own"
    )

    @model_validator(mode="before")
    @classmethod
    def _short_forms(cls, value: Any) -> Any:
        if not isinstance(value, dict) or "of" not in value:
            return value
        given, rest = value["of"], {key: item for key, item in value.items() if key != "of"}
        if given == ANY_WAY:
            return {**rest, "distribution": "orientation"}
        if isinstance(given, list | tuple) and len(given) == 2:
            return {**rest, "low": given[0], "high": given[1]}
        if isinstance(given, dict):
            return {**rest, **given}
        raise ValueError(
            f"{value.get('path')}: give [low, high], a mapping (low, high, choices, distribution, apply) or "
            f"{ANY_WAY!r}, got {given!r}"
        )

    @model_validator(mode="after")
    def _one_kind(self) -> Variation:
        reason = self._wrong()
        if reason is not None:
            raise ValueError(f"{self.path}: {reason}")
        return self

    def _wrong(self) -> str | None:
        ranged = self.low is not None or self.high is not None
        if self.distribution == "orientation":
            if ranged or self.choices is not None or self.path.rpartition(".")[2] != "rotation":
                return f"{ANY_WAY!r} is for a `rotation`, without a range"
            return None if self.apply == "set" else f"{ANY_WAY!r} replaces the rotation: leave `apply` out"
        if self.choices is not None:
            if ranged or not self.choices or self.apply != "set":
                return "`choices` hold at least one value and stand without low, high and apply"
            return None
        if self.low is None or self.high is None:
            return "give both low and high, or choices"
        low, high = _array(self.low), _array(self.high)
        if low.shape != high.shape:
            return f"low and high must be equally long, got {_plain(low)} and {_plain(high)}"
        if (high < low).any():
            return f"the range is inverted: low {_plain(low)} lies above high {_plain(high)}"
        if self.distribution == "log_uniform" and (low <= 0.0).any():
            return f"log_uniform needs low > 0, got {_plain(low)}"
        return None

    @property
    def ends(self) -> tuple[Any, Any]:
        """Two values that differ as much as it lets them."""
        if self.choices is not None:
            return self.choices[0], self.choices[-1]
        if self.distribution == "orientation":
            return (0.0, 0.0, 0.0), (120.0, 40.0, 80.0)
        return self.low, self.high

    def drawn(self, generator: np.random.Generator) -> Any:
        """A value: a number, a tuple of numbers, or one of the choices."""
        if self.choices is not None:
            return self.choices[int(generator.integers(len(self.choices)))]
        if self.distribution == "orientation":
            way = Rotation.from_quat(generator.normal(size=4))  # of any length: a Gaussian is isotropic
            return tuple(way.as_euler("xyz", degrees=True).tolist())
        assert self.low is not None and self.high is not None
        low, high = _array(self.low), _array(self.high)
        share = generator.random(low.shape)
        if self.distribution == "log_uniform":
            value = low * (high / low) ** share
        else:
            value = low + share * (high - low)
        return _plain(np.clip(value, low, high))

    def applied(self, own: Any, value: Any) -> Any:
        """What stands in the scene in place of its `own` value."""
        if self.apply == "set":
            return value
        if not _is_numeric(own):
            raise ValueError(f"`apply: {self.apply}` needs a value in the scene, which has {own!r}")
        a, b = _array(own), _array(value)
        return _plain(a + b if self.apply == "add" else a * b)


Variations = tuple[Variation, ...]


def parse(value: Any) -> Any:
    """For validators: variations from a mapping of paths, nested or with dots, to ranges."""
    if not isinstance(value, dict):
        return () if value is None else value
    return [{"path": path, "of": given} for path, given in _flattened(value, "")]


OWN_KEYS = set(Variation.model_fields) - {"path"}


def _flattened(value: dict[Any, Any], path: str) -> Iterator[tuple[str, Any]]:
    for key, item in value.items():
        here = f"{path}.{key}" if path else str(key)
        if isinstance(item, dict) and item and not set(item) & OWN_KEYS:
            yield from _flattened(item, here)
        else:
            yield here, item


def expand(scene: BaseModel, variations: Sequence[Variation]) -> Variations:
    """The variations with one for every value that a pattern names, in the scene's order.

    Raises SceneError for a path that leads nowhere, or to what cannot be drawn, and for one given twice.
    """
    found: list[Variation] = []
    for item in variations:
        for path in _paths(scene, item.path.split("."), "", item.path):
            if any(other.path == path for other in found):
                raise SceneError(f"randomize: {path}: is given twice ({item.path} and another)")
            found.append(item.model_copy(update={"path": path}))
    return tuple(found)


def draw(
    scene: BaseModel, variations: Sequence[Variation], seed: int, index: int, camera: int = 0
) -> tuple[Any, dict[str, Any]]:
    """The scene of rollout `index` as its camera `camera` sees it, and the values that were put into it.

    `variations` are those of `expand`. The camera has its own draws of `camera.*`; all others are the same.
    Raises SceneError for a value that the scene refuses.
    """
    values: dict[str, Any] = {}
    for item in variations:
        key = f"{item.path}#{camera}" if camera and item.path.startswith("camera.") else item.path
        words = np.frombuffer(hashlib.sha256(key.encode()).digest()[:16], np.uint32)
        sequence = np.random.SeedSequence(seed, spawn_key=(index, *words.tolist()))
        scene, values[item.path] = put(scene, item, item.drawn(np.random.default_rng(sequence)))
    return scene, values


def put(scene: Any, variation: Variation, value: Any) -> tuple[Any, Any]:
    """The scene with a drawn value applied, and what stands there now. Raises SceneError."""
    tokens = variation.path.split(".")
    try:
        placed = variation.applied(value_at(scene, tokens), value)
        return _with(scene, tokens, placed), placed
    except ValidationError as error:
        first = error.errors()[0]
        text = str(first["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")
        raise SceneError(f"randomize: {variation.path}: {text}, got {first.get('input')!r}") from None
    except ValueError as error:
        raise SceneError(f"randomize: {variation.path}: {error}") from None


def value_at(item: Any, tokens: Sequence[str]) -> Any:
    """What stands at a path."""
    for token in tokens:
        item = _child(item, token)
    return item


def _with(item: Any, tokens: Sequence[str], value: Any) -> Any:
    """A copy of `item`, checked anew, with another value at a path."""
    if not tokens:
        return value
    token = tokens[0]
    changed = _with(_child(item, token), tokens[1:], value)
    if isinstance(item, BaseModel):
        given = {key: getattr(item, key) for key in item.model_fields_set | _always(item)}
        return type(item).model_validate({**given, token: changed})
    if isinstance(item, dict):
        return {**item, token: changed}
    number = _number(item, token)
    return tuple(changed if k == number else old for k, old in enumerate(item))


def _always(item: BaseModel) -> set[str]:
    """Fields that a copy must be given even where they were not: those that differ from call to call."""
    return {"folder"} & set(type(item).model_fields)


def _child(item: Any, token: str) -> Any:
    if isinstance(item, BaseModel):
        value = getattr(item, token)
        return _default(item, token) if value is None else value
    return item[token] if isinstance(item, dict) else item[_number(item, token)]


def _default(item: BaseModel, token: str) -> Any:
    """What stands for a value that was not given, where a value of it is asked for."""
    for kind in _kinds(type(item).model_fields[token].annotation):
        if isinstance(kind, type) and issubclass(kind, BaseModel):
            try:
                return kind()
            except ValidationError:
                return cast(Any, kind).model_validate("jelly") if kind.__name__ == "Material" else None
    return None


def _kinds(annotation: Any) -> list[Any]:
    inner = get_args(annotation)
    return [annotation] if not inner else [kind for part in inner for kind in _kinds(part)]


def _number(items: Sequence[Any], token: str) -> int:
    """Which of several a token names: by its `name`, its number, or x, y, z of a vector."""
    for k, item in enumerate(items):
        if getattr(item, "name", None) == token:
            return k
    if _is_numeric(items) and token in "xyz":
        return "xyz".index(token)
    return int(token)


def _paths(item: Any, tokens: list[str], here: str, whole: str) -> Iterator[str]:
    """The paths that a pattern names below `item`."""
    if not tokens:
        if isinstance(item, dict) or (isinstance(item, tuple) and not _is_numeric(item)):
            raise SceneError(f"randomize: {whole}: holds several values; name one of them, or all with `.*`")
        if any(fnmatch.fnmatchcase(here, one) or fnmatch.fnmatchcase(here, f"{one}.*") for one in FIXED):
            raise SceneError(f"randomize: {whole}: stays the same in all rollouts of a dataset")
        yield here
        return
    token, rest = tokens[0], tokens[1:]
    names = _names(item)
    matching = [name for name in names if fnmatch.fnmatchcase(name, token)]
    if not matching:
        raise SceneError(_unknown(item, token, names, here, whole))
    for name in matching:
        yield from _paths(_child(item, name), rest, f"{here}.{name}" if here else name, whole)


def _names(item: Any) -> list[str]:
    if isinstance(item, BaseModel):
        return list(type(item).model_fields)
    if isinstance(item, dict):
        return [str(key) for key in item]
    if isinstance(item, tuple):
        if len(item) <= 3 and item and _is_numeric(item):
            return list("xyz"[: len(item)])
        named = [getattr(part, "name", "") for part in item]
        unique = all(named) and len(set(named)) == len(named)
        return [str(name) for name in named] if unique else [str(k) for k in range(len(item))]
    return []


def _unknown(item: Any, token: str, names: list[str], here: str, whole: str) -> str:
    place = here or "the scene"
    if item is None or not names:
        return f"randomize: {whole}: {place} has nothing inside"
    inner = [
        f"{name}.{token}"
        for name in names
        if isinstance(item, BaseModel) and token in _names(_child(item, name))
    ]
    near = inner or difflib.get_close_matches(token, names, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    return f"randomize: {whole}: {place} has no {token!r}{hint}; there are: {', '.join(names)}"


def _is_numeric(value: Any) -> bool:
    if isinstance(value, tuple | list):
        return bool(value) and all(_is_numeric(part) for part in value)
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _array(value: Any) -> np.ndarray:
    return np.asarray(value, np.float64)


def _plain(value: np.ndarray) -> Any:
    return float(value) if value.ndim == 0 else tuple(value.tolist())


__all__ = ["Variation", "Variations", "draw", "expand", "parse", "put", "value_at"]
