"""Functions of time that move obstacles and pins, written in Python beside a scene or given to it.

A scene file only names its functions: they are loaded, and their file is run, where the caller allows it.
"""

from __future__ import annotations

import difflib
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FunctionType, ModuleType
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import BaseModel, Field
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SceneError, SolverError
from gdpro_sim.simulation.options import Options

if TYPE_CHECKING:
    from gdpro_sim.simulation.scene import Scene

ALLOW = "gdpro simulate … --allow-code, in Python allow_code=True"


class Callback(Options):
    """A function that Python computes: its file and name, and the function once it is loaded."""

    callback: str = Field(description="FILE.py:FUNCTION, the file relative to the scene file")
    function: Callable[..., Any] | None = Field(default=None, exclude=True, repr=False)

    @staticmethod
    def of(function: Callable[..., Any]) -> Callback:
        """Of a function that Python has already."""
        code = getattr(function, "__code__", None)
        name = getattr(function, "__qualname__", type(function).__name__)
        return Callback(callback=f"{code.co_filename if code else '<python>'}:{name}", function=function)

    @property
    def file(self) -> str:
        """Reference to the file it stands in."""
        return self.callback.rpartition(":")[0]

    @property
    def name(self) -> str:
        """As messages name it: file and function."""
        return f"{Path(self.file).name}:{self.callback.rpartition(':')[2]}"


def taken(value: Any) -> Any:
    """For validators of fields that take a callback: Python may give the function itself."""
    return Callback.of(value) if callable(value) and not isinstance(value, type) else value


def raised(callback: Callback, time: float, error: Exception) -> SolverError:
    """What to raise where a callback raised: it names callback, time, and the line."""
    frames = traceback.extract_tb(error.__traceback__)
    # The last line of the file itself says more than one deep inside a library.
    own = [frame for frame in frames if Path(frame.filename).name == Path(callback.file).name]
    place = (own or frames)[-1]
    return SolverError(
        f"callback {callback.name} at {time:.6g} s raised {type(error).__name__}: {error} "
        f"({Path(place.filename).name}, line {place.lineno})"
    )


class Scripted:
    """A callback's translation [3] m and rotation since `start`, at a time in s; before that none.

    The callback takes a time in s and gives a translation in m and a rotation vector in degrees. It must
    depend on the time alone: solvers ask for any time, more than once, and not in order. Calling this raises
    SolverError, naming callback, time and line, where the callback raises or gives anything else.
    """

    def __init__(self, callback: Callback, start: float = 0.0) -> None:
        if callback.function is None:
            raise SceneError(f"{callback.callback} is Python code that was not loaded: {ALLOW}")
        self._callback, self._function, self._start = callback, callback.function, start
        self._origin: tuple[np.ndarray, Rotation] | None = None

    def __call__(self, time: float) -> tuple[np.ndarray, Rotation]:
        if self._origin is None:
            self._origin = self._value(self._start)
        shift, turn = self._value(max(time, self._start))
        return shift - self._origin[0], turn * self._origin[1].inv()

    def _value(self, time: float) -> tuple[np.ndarray, Rotation]:
        try:
            given = self._function(float(time))
        except Exception as error:
            raise raised(self._callback, time, error) from error
        try:
            values = np.asarray(given, np.float64)
        except (TypeError, ValueError):
            values = np.zeros(0)
        if values.shape != (2, 3) or not np.isfinite(values).all():
            raise SolverError(
                f"callback {self._callback.name} at {time:.6g} s gave {_short(given)}; it must give a "
                "translation (m) and a rotation vector (degrees), each three finite numbers"
                f"{self._defined()}"
            )
        return values[0], Rotation.from_rotvec(values[1], degrees=True)

    def _defined(self) -> str:
        code = getattr(self._function, "__code__", None)
        return f" ({Path(code.co_filename).name}, line {code.co_firstlineno})" if code else ""


def callbacks_of(value: Any) -> Iterator[Callback]:
    """Every callback in a scene or a part of it."""
    if isinstance(value, Callback):
        yield value
    elif isinstance(value, BaseModel):
        for name in type(value).model_fields:
            yield from callbacks_of(getattr(value, name))
    elif isinstance(value, tuple) and value and not isinstance(value[0], float | int):
        for item in value:
            yield from callbacks_of(item)


def with_code(scene: Scene, allow: bool) -> Scene:
    """The scene with the functions of all its callbacks; each Python file is run once.

    Raises SceneError where there is one to load and `allow` is False, or for a file or function that cannot
    be had.
    """
    if all(callback.function is not None for callback in callbacks_of(scene)):
        return scene
    modules: dict[Path, ModuleType] = {}

    def load(where: str, callback: Callback) -> Callback:
        file, name = callback.file, callback.callback.rpartition(":")[2]
        if not file.endswith(".py") or not name.isidentifier():
            raise SceneError(f"{where}.callback: must be FILE.py:FUNCTION, got {callback.callback!r}")
        path = scene.resolve(file)
        if not path.is_file():
            raise SceneError(f"{where}.callback: {path}: no such file")
        if not allow:
            raise SceneError(f"{where}: {path} is Python code, which only runs where you allow it: {ALLOW}")
        if path not in modules:
            modules[path] = _run(where, path)
        return callback.model_copy(update={"function": _function(where, path, modules[path], name)})

    def visit(place: str, value: Any) -> Any:
        if isinstance(value, Callback):
            return value if value.function is not None else load(f"{scene.name}: {place}", value)
        if isinstance(value, BaseModel):
            names = type(value).model_fields
            new = {name: visit(f"{place}.{name}".lstrip("."), getattr(value, name)) for name in names}
            new = {name: item for name, item in new.items() if item is not getattr(value, name)}
            return value.model_copy(update=new) if new else value
        if isinstance(value, tuple):
            items = tuple(visit(f"{place}[{k}]", item) for k, item in enumerate(value))
            return value if all(a is b for a, b in zip(items, value, strict=True)) else items
        return value

    checked: Scene = visit("", scene)
    return checked


def _function(where: str, path: Path, module: ModuleType, name: str) -> Callable[..., Any]:
    if not hasattr(module, name):
        known = [key for key, value in vars(module).items() if isinstance(value, FunctionType)]
        near = difflib.get_close_matches(name, known, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else f"; functions: {', '.join(known) or 'none'}"
        raise SceneError(f"{where}.callback: {path} has no {name!r}{hint}")
    function = getattr(module, name)
    if not callable(function):
        raise SceneError(f"{where}.callback: {name} in {path} is {_short(function)}, which is no function")
    return function  # type: ignore[no-any-return]


def _run(where: str, path: Path) -> ModuleType:
    try:
        source = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{where}: {path}: cannot be read: {error}") from None
    module = ModuleType(path.stem)
    module.__file__ = str(path)
    try:
        exec(compile(source, str(path), "exec"), module.__dict__)
    except (Exception, SystemExit) as error:
        line = error.lineno if isinstance(error, SyntaxError) else None
        for frame in traceback.extract_tb(error.__traceback__):
            line = frame.lineno if frame.filename == str(path) else line
        raise SceneError(f"{where}: {path}, line {line}: {type(error).__name__}: {error}") from error
    return module


def _short(value: Any) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


__all__ = ["ALLOW", "Callback", "Scripted", "callbacks_of", "raised", "taken", "with_code"]
