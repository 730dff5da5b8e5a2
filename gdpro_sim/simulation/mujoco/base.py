"""A user's own MJCF, whose world the bodies of a scene join."""

from __future__ import annotations

import logging
import math
import re
import warnings
from pathlib import Path

import mujoco
import numpy as np

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.mujoco_model import MujocoWorld

log = logging.getLogger(__name__)


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
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            spec = mujoco.MjSpec.from_file(str(world.base))
            spec.compiler.fusestatic = False
            alone = spec.compile()
        for item in said:
            log.debug("%s: %s", world.base, " ".join(str(item.message).split()))
    except (ValueError, mujoco.FatalError) as error:
        message = " ".join(str(error).split())
        place = _place(world.base, message)
        raise SceneError(f"{world.base}: MuJoCo cannot compile it: {message}{place}") from None
    _keep_masses(spec, alone)
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


def _keep_masses(spec: mujoco.MjSpec, alone: mujoco.MjModel) -> None:
    """Give every body of the base the mass it has `alone`, and put off what its compiler does to masses
    (least ones, a total, inertia from geoms): it would do it to ours."""
    for body in spec.bodies[1:]:
        if alone.body_mass[body.id] > 0.0:
            body.explicitinertial = True
            body.mass, body.ipos = float(alone.body_mass[body.id]), alone.body_ipos[body.id]
            body.iquat, body.inertia = alone.body_iquat[body.id], alone.body_inertia[body.id]
            body.fullinertia = [math.nan] * 6
    compiler = spec.compiler
    compiler.boundmass = compiler.boundinertia = 0.0
    compiler.settotalmass = -1.0
    compiler.balanceinertia = False
    compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


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
