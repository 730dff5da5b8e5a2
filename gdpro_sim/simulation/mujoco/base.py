"""A user's own MJCF, whose world the bodies of a scene join."""

from __future__ import annotations

import re
from pathlib import Path

import mujoco
import numpy as np

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.mujoco_model import MujocoWorld


def read_base(world: MujocoWorld) -> tuple[mujoco.MjSpec, tuple[np.ndarray, np.ndarray, np.ndarray] | None]:
    """The spec of the base, without its keyframes, and the state of the one it starts from.

    Raises SceneError with MuJoCo's own message, the file and the line.
    """
    if world.base is None:
        spec = mujoco.MjSpec()
        spec.modelname = "gdpro"
        return spec, None
    if not world.base.is_file():
        raise SceneError(f"{world.base}: no such file")
    try:
        spec = mujoco.MjSpec.from_file(str(world.base))
        alone = spec.copy().compile()
    except (ValueError, mujoco.FatalError) as error:
        message = " ".join(str(error).split())
        place = _place(world.base, message)
        raise SceneError(f"{world.base}: MuJoCo cannot compile it: {message}{place}") from None
    names = [key.name for key in spec.keys]
    for key in list(spec.keys):  # they would have to name the joints of our bodies, too
        spec.delete(key)
    _check_known(f"{world.base}: keyframe", [world.keyframe] if world.keyframe else [], names)
    actuators = [item.name for item in spec.actuators]
    _check_known(f"{world.base}: actuator", [item.actuator for item in world.controls], actuators)
    if world.keyframe is None:
        return spec, None
    k = names.index(world.keyframe)
    return spec, (alone.key_qpos[k].copy(), alone.key_qvel[k].copy(), alone.key_ctrl[k].copy())


def _check_known(what: str, wanted: list[str], names: list[str]) -> None:
    for name in wanted:
        if name not in names:
            known = ", ".join(repr(item) for item in names if item) or "none with a name"
            raise SceneError(f"{what} {name!r}: there is none; there are: {known}")


def _place(path: Path, message: str) -> str:
    """Where a message of MuJoCo's that tells no line is about, as far as what it quotes shows it."""
    if re.search(r"[Ll]ine(?: number=| )[1-9]", message):
        return ""
    quoted = re.findall(r"'([^']+)'", message)
    for file in _included(path, []):
        for number, line in enumerate(file.read_text(encoding="utf-8", errors="replace").splitlines(), 1):
            if any(word in line for word in quoted):
                return f" ({file}, line {number})"
    return ""


def _included(path: Path, seen: list[Path]) -> list[Path]:
    """A file and all that it includes."""
    if path in seen or not path.is_file():
        return seen
    seen.append(path)
    text = path.read_text(encoding="utf-8", errors="replace")
    for name in re.findall(r"<include\s+file\s*=\s*[\"']([^\"']+)", text):
        _included(path.parent / name, seen)
    return seen


__all__ = ["read_base"]
