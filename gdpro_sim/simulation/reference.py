"""A reference of everything a scene may say, as Markdown, made from the descriptions of its options."""

from __future__ import annotations

import types
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

from gdpro_sim.materials import PRESETS, Material
from gdpro_sim.simulation.scene import Scene

HEAD = """\
# Scenes: every key

Printed by `gdpro scenes --reference`. A scene is a YAML file for `gdpro simulate`, or in Python a
`gdpro_sim.Scene` made of the same keys (`check_scene({...})`, or `Scene(bodies=[SceneBody(...)], ...)`) for
`gdpro_sim.simulate` and `gdpro_sim.record`. SI units, Z up; degrees for angles, rad/s for spins; times are
simulated seconds. Paths are relative to the scene file, or `package:NAME/PATH` inside an installed Python
package. A list of one may be written without its dash.

From Python, `motion` takes a function, and the loop over the frames may look at everything and stop:

```python
def swing(time):  # s -> translation in m, rotation vector in degrees
    return (0, 0, 0), (0, 30 * math.sin(4 * time), 0)


for frame in gdpro_sim.simulate(scene):
    if frame.diagnostics.contacts:
        break
```

In YAML that is `motion: {callback: "moves.py:swing"}`, and as it runs Python code, `gdpro simulate` wants
`--allow-code` (`allow_code=True` in Python).
"""

HIDDEN = {"folder", "copied"}
"""Set by the program, not by whoever writes a scene."""


def reference() -> str:
    """The whole reference: a table of each option and what it holds, from the scene downwards."""
    order = _reached(Scene)
    parts = [HEAD]
    for model in order:
        parts.append(f"\n## {_title(model)}\n\n{_summary(model)}\n")
        parts.append("| key | what | default | |\n|---|---|---|---|")
        for name, field in model.model_fields.items():
            if name not in HIDDEN and not field.exclude:
                parts.append(_row(name, field))
    presets = ", ".join(f"`{name}`" for name in PRESETS)
    parts.append(
        f"\n## Material presets\n\nA material is one of these names, or values over one: {presets}.\n"
    )
    return "\n".join(parts)


def _reached(start: type[BaseModel]) -> list[type[BaseModel]]:
    """Models by how they are met, breadth first."""
    order, index = [start], 0
    while index < len(order):
        for name, field in order[index].model_fields.items():
            if name not in HIDDEN and not field.exclude:
                order += [m for m in _models(field.annotation) if m not in order]
        index += 1
    return order


def _models(annotation: Any) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in _models(inner)]


def _title(model: type[BaseModel]) -> str:
    return "Material" if model is Material else model.__name__


def _summary(model: type[BaseModel]) -> str:
    text = " ".join((model.__doc__ or "").split("\n\n")[0].split())
    return _escaped(text)


def _row(name: str, field: FieldInfo) -> str:
    what = _escaped(_type(field.annotation, field.metadata))
    text = _escaped(" ".join((field.description or "").split()))
    return f"| `{name}` | {what} | {_escaped(_default(field))} | {text} |"


def _type(annotation: Any, metadata: list[Any] | tuple[Any, ...] = ()) -> str:
    limits = _limits(metadata)
    origin, inner = get_origin(annotation), get_args(annotation)
    if origin is Annotated:
        return _type(inner[0], inner[1:])
    if annotation is type(None):
        return "null"
    if origin is Literal:
        return ", ".join(str(value) for value in inner)
    if origin in (Union, types.UnionType):
        shown = [_type(item) for item in inner if item is not type(None)]
        return " or ".join(dict.fromkeys(shown)) + limits
    if origin is tuple and len(inner) == 2 and inner[1] is Ellipsis:
        return f"list of {_type(inner[0])}"
    if origin is tuple:
        parts = [_type(item) for item in inner]
        return f"{len(parts)} x {parts[0]}" if len(set(parts)) == 1 else f"[{', '.join(parts)}]"
    if origin is dict:
        return f"{_type(inner[0])}: {_type(inner[1])}"
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return f"[{_title(annotation)}](#{_title(annotation).lower()})"
    names = {float: "number", int: "whole number", str: "text", bool: "true, false"}
    return names.get(annotation, str(getattr(annotation, "__name__", annotation))) + limits


def _limits(metadata: list[Any] | tuple[Any, ...]) -> str:
    signs = {"gt": "> ", "ge": ">= ", "lt": "< ", "le": "<= "}
    found = [
        f"{sign}{getattr(item, key):g}"
        for item in _flat(metadata)
        for key, sign in signs.items()
        if getattr(item, key, None) is not None
    ]
    return f" {', '.join(found)}" if found else ""


def _flat(metadata: list[Any] | tuple[Any, ...]) -> list[Any]:
    """Limits themselves, out of a `Field(...)` where they stand in one."""
    return [
        inner for item in metadata for inner in (item.metadata if isinstance(item, FieldInfo) else [item])
    ]


def _default(field: FieldInfo) -> str:
    if field.is_required():
        return "required"
    value = field.default
    if value is PydanticUndefined or value is None or value == "" or value == ():
        return ""
    if isinstance(value, BaseModel):
        return ""
    if isinstance(value, tuple):
        return "[" + ", ".join(f"{x:g}" if isinstance(x, float) else str(x) for x in value) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def _escaped(text: str) -> str:
    return text.replace("|", "\\|")


__all__ = ["reference"]
