"""Datasets of randomised rollouts: `gdpro rollout`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from gdpro_sim.cli.common import AsJson, Debug, Device, Quiet, Seed, app, check_exists, progress, setup, table


@app.command()
def rollout(
    scene: Annotated[str, typer.Argument(help="Scene file (.yaml) or the name of a shipped scene.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder of the dataset.")],
    count: Annotated[int, typer.Option("--count", "-n", min=1, help="Rollouts that it shall hold.")] = 100,
    seed: Seed = None,
    config: Annotated[
        Path | None,
        typer.Option("--config", help="YAML file of what to draw, in place of the scene's `randomize`."),
    ] = None,
    images: Annotated[
        str, typer.Option("--images", help="Frames to draw: none, last, all, or n for every n-th.")
    ] = "last",
    cameras: Annotated[
        int, typer.Option("--cameras", min=1, max=100, help="Views from the scene's camera.")
    ] = 1,
    channels: Annotated[
        str, typer.Option("--channels", help="Of every picture, with commas between.")
    ] = "rgb,depth,segmentation",
    width: Annotated[int | None, typer.Option("--width", min=16, max=8192)] = None,
    height: Annotated[int | None, typer.Option("--height", min=16, max=8192)] = None,
    threads: Annotated[int | None, typer.Option("--threads", min=1, help="Default: all cores.")] = None,
    device: Device = "auto",
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Replace the dataset that the folder holds.")
    ] = False,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Run the Python files that the scene names.")
    ] = False,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Run a MuJoCo scene many times with values drawn at random; write states, pictures, depth and labels.

    What is drawn stands in the scene (`randomize:`) or in a file. The same command continues a dataset that
    was stopped; a larger --count makes it longer.
    """
    setup(quiet, debug)
    if config is not None:
        check_exists(config)
    from gdpro_sim.io.dataset import rollout as run
    from gdpro_sim.simulation.scene import load_scene

    checked = load_scene(scene)
    size = {key: value for key, value in (("width", width), ("height", height)) if value is not None}
    if size:
        view = type(checked.camera).model_validate({**checked.camera.model_dump(exclude_unset=True), **size})
        checked = checked.model_copy(update={"camera": view})
    with progress(quiet) as report:
        made = run(
            checked,
            output,
            count=count,
            seed=seed,
            randomize=config,
            images=images,
            cameras=cameras,
            channels=[name for name in channels.split(",") if name],
            threads=threads,
            device=device,
            fresh=fresh,
            allow_code=allow_code,
            on_progress=report,
        )
    if json_output:
        print(json.dumps(made.to_json()))
    elif not quiet:
        rows = [
            ("dataset", str(made.output / "dataset.json")),
            ("parameters", str(made.output / "parameters.csv")),
            ("rollouts", f"{made.count}, {made.resumed} of them there before, {made.failed} failed"),
            ("size", f"{made.frames} frames each, {made.pictures:,} pictures drawn, {made.steps:,} steps"),
            ("seconds", "  ".join(f"{phase} {value:.1f}" for phase, value in made.seconds.items())),
        ]
        table(f"Rollouts of {checked.name}", rows)


__all__ = ["rollout"]
