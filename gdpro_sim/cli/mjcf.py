"""Models for MuJoCo: `gdpro mjcf`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from gdpro_sim.cli.common import AsJson, Debug, Quiet, app, check_choice, progress, setup, show

FORMS = ("auto", "rigid", "full", "trilinear", "quadratic")


@app.command()
def mjcf(
    source: Annotated[str, typer.Argument(help="Asset, scene file, or name of a shipped scene.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder to write.")],
    form: Annotated[
        str, typer.Option("--form", help="Of every body: auto, rigid, full, trilinear or quadratic.")
    ] = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write a folder that plain MuJoCo loads: model.xml, its files, and the same compiled, model.mjb.

    A scene for another solver is taken as one for MuJoCo where MuJoCo has all it asks for, a coupled one with
    its `solver.mujoco`.
    """
    setup(quiet, debug)
    check_choice("--form", form, FORMS)
    from gdpro_sim.files import prepare_folder
    from gdpro_sim.simulation.compile import check_files, check_supported, compile_scene, load_assets
    from gdpro_sim.simulation.mujoco.export import export_mjcf
    from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo
    from gdpro_sim.simulation.mujoco_options import MujocoBody, MujocoOptions
    from gdpro_sim.simulation.scene import load_scene

    scene = load_scene(source)
    if form != "auto":
        own = [(body.mujoco or MujocoBody()).model_copy(update={"form": form}) for body in scene.bodies]
        bodies = [b.model_copy(update={"mujoco": m}) for b, m in zip(scene.bodies, own, strict=True)]
        scene = scene.model_copy(update={"bodies": tuple(bodies)})
    if source.lower().endswith((".usdc", ".usda", ".usdz")) and form in ("auto", "rigid"):
        # What falls in a preview is made softer than the asset is; a model for others should not be.
        bodies = [body.model_copy(update={"material": None}) for body in scene.bodies]
        scene = scene.model_copy(update={"bodies": tuple(bodies)})
    scene = scene.model_copy(update={"solver": scene.mujoco_options or MujocoOptions()})
    check_supported(scene)
    check_files(scene)
    prepare_folder(output, "model.xml")

    with progress(quiet or json_output) as report:
        report("prepare", 0, 0)
        assets = load_assets(scene, on_progress=lambda phase: report(phase, 0, 0))
        solver = SolverMuJoCo(compile_scene(scene, assets, device="cpu"))
        summary = export_mjcf(solver, output)
    show(summary, f"MJCF of {scene.name}", json_output, quiet)
