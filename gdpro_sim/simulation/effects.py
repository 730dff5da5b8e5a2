"""Whether what is drawn at random changes anything."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset
from gdpro_sim.errors import GdproError, SceneError
from gdpro_sim.simulation.compile import compile_scene
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.randomize import Variation, put
from gdpro_sim.simulation.scene import Scene

LOOKS = ("camera", "cameras", "lights", "render")
"""Parts of a scene that pictures show and the solver does not know."""


def check_effects(
    scene: Scene, variations: Sequence[Variation], assets: dict[str, Asset], pictures: bool
) -> None:
    """Compile the scene at both ends of every variation.

    Raises SceneError for a variation that changes nothing there, or has an end that the scene refuses.
    """
    for item in variations:
        where, looks = f"randomize: {item.path}", item.path.split(".")[0] in LOOKS
        ends: list[Model] = []
        for end in item.ends:
            try:
                changed, _ = put(scene, item, end)
                if not looks:
                    ends.append(compile_scene(changed, assets))
            except GdproError as error:
                text = str(error).removeprefix(f"{where}: ")
                raise SceneError(f"{where}: at {_shown(end)}: {text}") from None
        if looks and not pictures:
            raise SceneError(f"{where}: has no effect without images; give --images, or leave it out")
        if looks and _unseen(scene, item.path):
            raise SceneError(f"{where}: has no effect where `eye` is given; draw `eye`, or leave it out")
        if ends and item.ends[0] != item.ends[1] and _same(_constants(ends[0]), _constants(ends[1])):
            raise SceneError(f"{where}: has no effect on this scene, which is the same at both ends")


def _unseen(scene: Scene, path: str) -> bool:
    """Whether a camera's angle is drawn whose eye is given."""
    tokens = path.split(".")
    if tokens[0] == "camera":
        camera: Any = scene.camera
    elif tokens[0] == "cameras":
        camera = next(c for k, c in enumerate(scene.cameras) if tokens[1] in (c.name, str(k)))
    else:
        return False
    return camera.eye is not None and tokens[-1] in ("azimuth", "elevation", "distance")


def _constants(model: Model) -> list[Any]:
    """What of a model decides what happens."""
    own = {item.name: getattr(model, item.name) for item in fields(model)}
    surfaces = [body.surface for body in own.pop("bodies")]
    return [surfaces, own]


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
    if type(a) is not type(b):
        return False
    if is_dataclass(a) and not isinstance(a, type):
        return all(_same(getattr(a, item.name), getattr(b, item.name)) for item in fields(a))
    if isinstance(a, Mapping):
        return a.keys() == b.keys() and all(_same(a[key], b[key]) for key in a)
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(_same(x, y) for x, y in zip(a, b, strict=True))
    return bool(a == b)


def _shown(value: Any) -> str:
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{part:g}" for part in value) + "]"
    return f"{value:g}" if isinstance(value, float) else repr(value)


__all__ = ["LOOKS", "check_effects"]
