"""What a user's callback tells actuators."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.callbacks import Callback, raised


def called(callback: Callback, model: mujoco.MjModel, data: mujoco.MjData) -> dict[int, float]:
    """Values by number of the actuator.

    Raises SolverError where the callback raises, or tells what is no actuator, or no number.
    """
    time = float(data.time)
    assert callback.function is not None
    try:
        told = callback.function(time, data)
    except Exception as error:
        raise raised(callback, time, error) from error
    where = f"callback {callback.name} at {time:.6g} s"
    if told is None:
        return {}
    names = [model.actuator(k).name for k in range(model.nu)]
    if isinstance(told, Mapping):
        return {_number(where, names, name): _value(where, name, value) for name, value in told.items()}
    values = np.asarray(told)
    if values.dtype.kind not in "fiub" or values.shape != (model.nu,):
        raise SolverError(
            f"{where} must give values by actuator, or an array of {model.nu} numbers, or None; got "
            f"{type(told).__name__}{list(values.shape) if values.shape else ''}"
        )
    return {k: _value(where, names[k], value) for k, value in enumerate(values)}


def _number(where: str, names: list[str], name: Any) -> int:
    if name not in names:
        near = difflib.get_close_matches(str(name), names, n=1)
        hint = f" (did you mean {near[0]!r}?)" if near else ""
        known = ", ".join(repr(item) for item in names if item) or "none with a name"
        raise SolverError(f"{where}: there is no actuator {name!r}{hint}; there are: {known}")
    return names.index(name)


def _value(where: str, name: str, value: Any) -> float:
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = np.nan
    if not np.isfinite(number):
        told = value.item() if isinstance(value, np.generic) else value
        raise SolverError(f"{where}: actuator {name!r} is told {told!r}, which is no finite number")
    return number


__all__ = ["called"]
