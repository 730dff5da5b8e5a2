"""Commands that put assets together and set them in motion: compose, animate."""

from __future__ import annotations

import shlex
import time
from pathlib import Path
from typing import Annotated, Any

import typer

from gdpro_sim.cli.common import (
    AsJson,
    Color,
    Debug,
    Device,
    Quiet,
    app,
    check_choice,
    check_exists,
    check_suffix,
    progress,
    setup,
    show,
)
from gdpro_sim.errors import RequestError

VECTORS = ("position", "rotation")


@app.command()
def compose(
    output: Annotated[Path, typer.Option("--output", "-o", help="Asset to write: .usdc, .usda or .usdz.")],
    composition: Annotated[
        Path | None, typer.Argument(help="Composition: YAML with `parts:`. Or give --part several times.")
    ] = None,
    parts: Annotated[
        list[str] | None,
        typer.Option(
            "--part",
            help='"FILE KEY=VALUE ...", keys as in YAML: "hat.usdc position=0,0,0.4 size=0.2".',
        ),
    ] = None,
    name: Annotated[str | None, typer.Option("--name", help="Of the asset.")] = None,
    glue: Annotated[
        bool | None,
        typer.Option("--glue/--no-glue", help="Fill the union with tets, or keep each part's own."),
    ] = None,
    tets: Annotated[
        int | None, typer.Option("--tets", min=0, max=500_000, help="Of the union to aim for; 0 for none.")
    ] = None,
    device: Device = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Make one asset of several: each turned, resized and placed, overlapping ones glued.

    What prompts generate is kept in a folder beside the output.
    """
    setup(quiet, debug)
    check_suffix(output, (".usdc", ".usda", ".usdz"))
    if (composition is None) == (not parts):
        raise RequestError(
            "give either a composition file or --part, several times; see gdpro compose --help"
        )
    from gdpro_sim.files import check_writable
    from gdpro_sim.io.compose import Composition, compose_parts, load_composition
    from gdpro_sim.simulation.scene import checked

    given = {"name": name, "glue": glue, "tets": tets}
    own = {key: value for key, value in given.items() if value is not None}
    if composition is not None:
        asked = load_composition(composition).model_copy(update=own)
    else:
        asked = checked(
            Composition,
            {"name": output.stem, "parts": [_part(text) for text in parts or ()], **own},
            "--part",
        )
    check_writable(output)
    begin = time.perf_counter()
    with progress(quiet) as report:
        asset = compose_parts(asked, output.with_suffix(""), device=device, on_progress=report)
        asset.save(output)
    summary = {"asset": str(output), **asset.summary(), "seconds": round(time.perf_counter() - begin, 2)}
    if not json_output:
        summary["licenses"] = summary.pop("provenance")["licenses"]
    show(summary, f"Asset {output}", json_output, quiet)


@app.command()
def animate(
    asset: Annotated[Path, typer.Argument(help="Asset or mesh; or the motion itself, whose mesh is taken.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    motion: Annotated[
        Path | None,
        typer.Option("--motion", "-m", help="glTF, USD or .npz, or folder of numbered meshes."),
    ] = None,
    fps: Annotated[
        int | None,
        typer.Option("--fps", min=1, max=1000, help="Frames per second; default: the motion's, or 30."),
    ] = None,
    start: Annotated[float | None, typer.Option("--start", help="Begin there in the motion, s.")] = None,
    end: Annotated[float | None, typer.Option("--end", help="End there in the motion, s.")] = None,
    loop: Annotated[int, typer.Option("--loop", min=1, max=10_000, help="How many times.")] = 1,
    speed: Annotated[float, typer.Option("--speed", help="Seconds of the motion per second.")] = 1.0,
    clip: Annotated[
        str | None, typer.Option("--clip", help="Name or number of a glTF file's animation.")
    ] = None,
    up: Annotated[str, typer.Option("--up", help="Up axis of the motion: auto, y or z.")] = "auto",
    scale: Annotated[
        float | None, typer.Option("--scale", help="Multiply the motion's lengths, e.g. 0.01 for cm.")
    ] = None,
    budget: Annotated[
        int, typer.Option("--budget", min=100, max=5_000_000, help="Gaussians to aim for on a mesh.")
    ] = 50_000,
    color: Color = None,
    texture: Annotated[Path | None, typer.Option("--texture", help="Texture image of the mesh.")] = None,
    tolerance: Annotated[
        float | None, typer.Option("--tolerance", help="Asset off the motion, share of its size: 0.02.")
    ] = None,
    width: Annotated[int, typer.Option("--width", min=16, max=8192, help="Even.")] = 960,
    height: Annotated[int, typer.Option("--height", min=16, max=8192, help="Even.")] = 720,
    device: Device = "auto",
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start again instead of continuing a stopped run.")
    ] = False,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Let a skeleton, blend shapes or a mesh sequence move an asset, without physics.

    Writes what `gdpro simulate` writes: time-sampled USD, pictures, video, contact sheet.
    """
    setup(quiet, debug)
    check_exists(asset)
    check_choice("--up", up, ("auto", "y", "z"))
    if motion is not None:
        check_exists(motion)
    from gdpro_sim.io.animate import animate as run

    with progress(quiet) as report:
        recording = run(
            asset,
            output,
            motion=motion,
            fps=fps,
            start=start,
            end=end,
            loop=loop,
            speed=speed,
            clip=clip,
            up=up,
            scale=scale,
            budget=budget,
            color=color,
            texture=texture,
            tolerance=tolerance,
            camera={"width": width, "height": height},
            device=device,
            fresh=fresh,
            on_progress=report,
        )
    found = recording.to_json()
    if not json_output:
        keys = ("assets", "simulation", "video", "contact_sheet", "frames", "frame_count", "gaussians")
        found = {key: found[key] for key in keys}
    show(found, f"Animation of {asset.name}", json_output, quiet)


def _part(text: str) -> dict[str, Any]:
    """One --part as plain data. Raises RequestError."""
    try:
        words = shlex.split(text)
    except ValueError as error:
        raise RequestError(f"--part {text!r}: {error}") from None
    found: dict[str, Any] = {}
    for number, word in enumerate(words):
        key, equals, value = word.partition("=")
        if not equals:
            if number:
                raise RequestError(f"--part {text!r}: {word!r} must be KEY=VALUE, like size=0.2")
            found["asset"] = str(Path(word).expanduser())
        elif key in VECTORS:
            found[key] = value.split(",")
        else:
            found[key] = value
    return found
