"""A scene as a folder that plain MuJoCo loads: `model.xml` and the files it names, and `model.mjb`."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path
from typing import Any

import mujoco

from gdpro_sim.errors import OutputError
from gdpro_sim.files import atomic_write, prepare_folder
from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo
from gdpro_sim.simulation.mujoco_model import SoftBody

log = logging.getLogger(__name__)

XML, BINARY, KEYFRAME = "model.xml", "model.mjb", "start"


def export_mjcf(solver: SolverMuJoCo, folder: str | Path) -> dict[str, Any]:
    """Write the solver's initial state and model; returns what was written, as JSON values.

    model.xml: MJCF with a keyframe "start" that holds positions and velocities; files of a base beside it
    model.mjb: the same compiled, for MuJoCo of the same version: MJCF rounds to six digits, and cannot say
               that a full flex is stable neo-Hookean (it is Saint Venant-Kirchhoff there)

    Raises RequestError or OutputError where the folder cannot be written.
    """
    target = prepare_folder(folder, XML)
    solver.reset()
    spec, data = solver.world.spec, solver.mjdata
    files = _take_along(spec, target)
    key = spec.add_key(name=KEYFRAME, qpos=data.qpos.tolist(), qvel=data.qvel.tolist())
    try:
        if len(data.ctrl):
            key.ctrl = data.ctrl.tolist()
        compiled = spec.compile()
        laws = [flex.elastic3d for flex in spec.flexes]
        for flex in spec.flexes:
            flex.elastic3d = 0
        spec.compile()
        text = spec.to_xml()
        for flex, law in zip(spec.flexes, laws, strict=True):
            flex.elastic3d = law
    finally:
        spec.delete(key)
    with atomic_write(target / XML) as temporary:
        temporary.write_text(text, encoding="utf-8")
    with atomic_write(target / BINARY) as temporary:
        mujoco.mj_saveModel(compiled, str(temporary), None)
    soft = [body.name for body in solver.bodies if isinstance(body, SoftBody) and body.stable]
    if soft:
        log.warning(
            "%s: MJCF cannot say stable neo-Hookean: in %s the soft bodies (%s) are Saint Venant-Kirchhoff, "
            "in %s they are as simulated", target, XML, ", ".join(soft), BINARY,
        )  # fmt: skip
    return {
        "folder": str(target),
        "files": [XML, BINARY, *files],
        "bodies": compiled.nbody - 1,
        "geoms": compiled.ngeom,
        "flexes": compiled.nflex,
        "degrees_of_freedom": compiled.nv,
        "mass_kg": float(f"{compiled.body_mass[solver.counted].sum():.9g}"),
        "renamed": dict(solver.renamed),
    }


def _take_along(spec: mujoco.MjSpec, target: Path) -> list[str]:
    """Copy the files of a base's meshes, height fields and textures beside the model; their new paths."""
    home = Path(spec.modelfiledir or ".")
    copied: dict[Path, str] = {}
    for kind, folder in (("meshes", spec.meshdir), ("hfields", spec.meshdir), ("textures", spec.texturedir)):
        for item in getattr(spec, kind):
            if not item.file:
                continue
            source = (home / (folder or "") / item.file).resolve()
            if source not in copied:
                name = f"assets/{len(copied)}_{source.name}"
                try:
                    (target / "assets").mkdir(exist_ok=True)
                    shutil.copyfile(source, target / name)
                except OSError as error:
                    raise OutputError(f"{source}: cannot be copied to {target / name}: {error}") from error
                copied[source] = name
            item.file = copied[source]
    if copied:
        spec.meshdir = spec.texturedir = ""
        spec.modelfiledir = str(target)
    return list(copied.values())


__all__ = ["BINARY", "KEYFRAME", "XML", "export_mjcf"]
