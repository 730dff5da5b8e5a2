"""The `gdpro` command."""

from __future__ import annotations

import json
import logging
import signal
import sys
import time
import traceback
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.logging import RichHandler
from rich.progress import (  # fmt: skip
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.table import Table
from typer.exceptions import TyperException

import gdpro_sim
from gdpro_sim.errors import GdproError, RequestError

if TYPE_CHECKING:
    from collections.abc import Iterator

app = typer.Typer(
    name="gdpro",
    help="Physically simulatable Gaussian assets: import a mesh, drop it, re-splat it, open it as USD.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
console = Console(stderr=True)

Device = Annotated[str, typer.Option("--device", help="auto, cpu, cuda or cuda:N.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress, no summary; errors only.")]
Debug = Annotated[bool, typer.Option("--debug", help="Log details, and show the traceback of an error.")]
AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON on standard output.")]
Seed = Annotated[int | None, typer.Option("--seed", min=0, help="Seed of every random draw.")]
Color = Annotated[str | None, typer.Option("--color", help="Colour of the mesh: #rrggbb or a CSS name.")]

_PHASE_NAMES = {
    "prepare": "Preparing assets",
    "simulate": "Simulating",
    "usd": "Writing USD",
    "video": "Writing video",
    "render": "Rendering",
}


def _setup(quiet: bool, debug: bool) -> None:
    level = logging.DEBUG if debug else logging.ERROR if quiet else logging.WARNING
    handler = RichHandler(console=console, show_time=False, show_path=debug, markup=False)
    logging.basicConfig(level=level, format="%(message)s", handlers=[handler], force=True)
    for noisy in ("PIL", "imageio", "imageio_ffmpeg", "trimesh", "matplotlib"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


@contextmanager
def _progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
    """A bar with elapsed time and time left; phases whose length is not known get a spinner."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=28),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console, disable=quiet, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def report(phase: str, done: int, total: int) -> None:
            if phase not in tasks:
                for name, task in tasks.items():
                    if name != phase:
                        bars.update(task, visible=False)
                tasks[phase] = bars.add_task(_PHASE_NAMES.get(phase, phase), total=total or None)
            bars.update(tasks[phase], completed=done, total=total or None)

        yield report


def _table(title: str, rows: list[tuple[str, str]]) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


@app.command("import")
def import_command(
    mesh: Annotated[Path, typer.Argument(help="Mesh file: OBJ, PLY, STL, glTF/GLB, OFF, DAE, USD …")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Asset to write: .usdc, .usda or .usdz.")],
    budget: Annotated[
        int, typer.Option("--budget", min=100, max=5_000_000, help="Gaussians to aim for.")
    ] = 50_000,
    color: Color = None,
    texture: Annotated[Path | None, typer.Option("--texture", help="Texture image of the mesh.")] = None,
    up: Annotated[str, typer.Option("--up", help="Up axis of the file: auto, y or z.")] = "auto",
    scale: Annotated[
        float | None, typer.Option("--scale", help="Multiply lengths, e.g. 0.001 for mm.")
    ] = None,
    material: Annotated[
        str | None, typer.Option("--material", help="Material preset stored in the asset.")
    ] = None,
    tets: Annotated[
        int, typer.Option("--tets", min=0, max=500_000, help="Tetrahedra to aim for, roughly; 0 for none.")
    ] = 6_000,
    seed: Seed = None,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Turn a mesh into a Gaussian asset: bound Gaussians, tetrahedra, one USD file."""
    _setup(quiet, debug)
    _check_exists(mesh)
    _check_choice("--up", up, ("auto", "y", "z"))
    _check_suffix(output, (".usdc", ".usda", ".usdz"))
    from gdpro_sim.asset import import_mesh
    from gdpro_sim.files import check_writable
    from gdpro_sim.materials import Material

    check_writable(output)
    chosen = None
    if material is not None:
        try:
            chosen = Material.model_validate(material)
        except ValueError as error:
            raise RequestError(f"--material: {_first_line(error)}") from None
    begin = time.perf_counter()
    with _progress(quiet) as report:
        asset = import_mesh(
            mesh,
            budget=budget,
            color=color,
            texture=texture,
            up=up,
            scale=scale,
            material=chosen,
            tets=tets > 0,
            target_tets=tets or 6_000,
            seed=seed or 0,
            on_progress=lambda phase: report(phase, 0, 0),
        )
        asset.save(output)
    summary = {"asset": str(output), **asset.summary(), "seconds": round(time.perf_counter() - begin, 2)}
    _show(summary, f"Asset {output}", json_output, quiet)


@app.command()
def simulate(
    scene: Annotated[str, typer.Argument(help="Scene file (.yaml) or the name of a shipped scene.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the results.")],
    device: Device = "auto",
    seed: Seed = None,
    fresh: Annotated[
        bool, typer.Option("--fresh", help="Start again instead of continuing a stopped run.")
    ] = False,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Simulate a scene and write asset, time-sampled USD, video, contact sheet and metrics.

    A run that was stopped continues where it was when the same command is given again.
    """
    _setup(quiet, debug)
    from gdpro_sim.simulation.scene import load_scene

    checked = load_scene(scene)
    if seed is not None:
        checked = checked.model_copy(update={"seed": seed})
    from gdpro_sim.io.record import record

    with _progress(quiet) as report:
        recording = record(checked, output, device=device, fresh=fresh, on_progress=report)
    if json_output:
        print(json.dumps(recording.to_json()))
    elif not quiet:
        rows = [("asset", str(path)) for path in recording.assets]
        rows += [
            ("simulation", str(recording.simulation)),
            ("video", str(recording.video)),
            ("contact sheet", str(recording.contact_sheet)),
            ("metrics", str(recording.metrics)),
            (
                "frames",
                f"{recording.frames}  ({recording.frame_count}, {recording.resumed_frames} of them resumed)",
            ),
            ("size", f"{recording.gaussians:,} Gaussians, {recording.tets:,} tetrahedra"),
            ("seconds", "  ".join(f"{phase} {value:.1f}" for phase, value in recording.seconds.items())),
        ]
        _table(f"Simulation of {checked.name}", rows)


@app.command()
def render(
    file: Annotated[Path, typer.Argument(help="Asset or simulation (.usdc, .usda, .usdz).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the pictures.")],
    frames: Annotated[
        int, typer.Option("--frames", min=1, max=10_000, help="Views of an asset's turntable.")
    ] = 24,
    width: Annotated[int | None, typer.Option("--width", min=16, max=8192)] = None,
    height: Annotated[int | None, typer.Option("--height", min=16, max=8192)] = None,
    azimuth: Annotated[float | None, typer.Option("--azimuth", help="Degrees from +X.")] = None,
    elevation: Annotated[
        float | None, typer.Option("--elevation", min=-89.0, max=89.0, help="Degrees.")
    ] = None,
    fov: Annotated[float | None, typer.Option("--fov", min=1.0, max=150.0, help="Vertical, degrees.")] = None,
    shading: Annotated[str, typer.Option("--shading", help="studio or none.")] = "studio",
    background: Annotated[str, typer.Option("--background", help="studio, white or black.")] = "studio",
    device: Device = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Render an asset as a turntable, or every frame of a simulation, to PNG pictures.

    A simulation is seen through its scene's camera, unless the options say otherwise.
    """
    _setup(quiet, debug)
    _check_choice("--shading", shading, ("studio", "none"))
    _check_choice("--background", background, ("studio", "white", "black"))
    _check_exists(file)
    view = {"azimuth": azimuth, "elevation": elevation, "fov": fov, "width": width, "height": height}
    from gdpro_sim.io.views import render_file

    with _progress(quiet) as report:
        pictures = render_file(
            file,
            output,
            views=frames,
            camera={key: value for key, value in view.items() if value is not None},
            shading=shading,
            background=background,
            device=device,
            on_progress=report,
        )
    _show({"frames": str(output), "count": len(pictures)}, f"Pictures of {file.name}", json_output, quiet)


@app.command()
def export(
    file: Annotated[Path, typer.Argument(help="Asset or simulation (.usdc, .usda, .usdz).")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Gaussian splats to write: .ply.")],
    frame: Annotated[int, typer.Option("--frame", min=0, help="Frame of a simulation.")] = 0,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write the Gaussians as a 3DGS PLY, the file that splat viewers read."""
    _setup(quiet, debug)
    _check_exists(file)
    _check_suffix(output, (".ply",))
    from gdpro_sim.io.ply import write_ply
    from gdpro_sim.io.views import gaussians_of

    gaussians = gaussians_of(file, frame)
    write_ply(output, gaussians)
    _show({"ply": str(output), "gaussians": len(gaussians)}, f"Gaussians of {file.name}", json_output, quiet)


@app.command()
def info(
    file: Annotated[Path, typer.Argument(help="Asset, simulation or mesh file.")],
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Say what a file holds; with --quiet, only whether it can be read."""
    _setup(quiet, debug)
    _check_exists(file)
    from gdpro_sim.io.describe import describe

    _show(describe(file), str(file), json_output, quiet)


@app.command()
def scenes(json_output: AsJson = False, quiet: Quiet = False, debug: Debug = False) -> None:
    """List the scenes shipped with the package; with --quiet, their names alone."""
    _setup(quiet, debug)
    from gdpro_sim.simulation.scene import load_scene, scene_names

    listing = {name: load_scene(name).description for name in scene_names()}
    if json_output:
        print(json.dumps(listing))
    elif quiet:
        print("\n".join(listing))
    else:
        _table("Shipped scenes", list(listing.items()))


@app.callback(invoke_without_command=True)
def _root(
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        print(gdpro_sim.__version__)
        raise typer.Exit


def _show(data: dict[str, Any], title: str, as_json: bool, quiet: bool) -> None:
    if as_json:
        print(json.dumps(data))
    elif not quiet:
        rows = ((k.replace("_", " "), v if isinstance(v, str) else json.dumps(v)) for k, v in data.items())
        _table(title, list(rows))


def _check_exists(path: Path) -> None:
    """Before the heavy imports: a mistyped name should be told at once."""
    if not path.exists():
        raise RequestError(f"{path}: no such file")


def _check_choice(option: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise RequestError(f"{option} must be one of {', '.join(allowed)}, got {value!r}")


def _check_suffix(path: Path, allowed: tuple[str, ...]) -> None:
    if path.suffix.lower() not in allowed:
        raise RequestError(f"output {path} must end in {', '.join(allowed)}")


def _first_line(error: ValueError) -> str:
    errors = getattr(error, "errors", None)
    return str(errors()[0]["msg"]).removeprefix("Value error, ") if callable(errors) else str(error)


class _Terminated(BaseException):
    """SIGTERM: end like Ctrl-C, so that files are closed and workers stopped."""


def _terminate(*_: object) -> None:
    raise _Terminated


def main() -> None:
    """Entry point: one line per error; exits with 0, 1 (failed run), 2 (wrong request), 130 (Ctrl-C), 143."""
    debug = "--debug" in sys.argv
    signal.signal(signal.SIGTERM, _terminate)
    try:
        code = app(standalone_mode=False) or 0
        if code == 130:  # typer turns Ctrl-C into this exit code
            raise KeyboardInterrupt
        sys.exit(code)
    except TyperException as error:
        if not error.format_message():  # the help text was printed instead
            sys.exit(2)
        context = getattr(error, "ctx", None)
        command = context.command_path if context else "gdpro"
        print(f"gdpro: {error.format_message()} (see `{command} --help`)", file=sys.stderr)
        sys.exit(2)
    except GdproError as error:
        if debug:
            traceback.print_exc()
        for line in str(error).splitlines():
            print(f"gdpro: {line}", file=sys.stderr)
        sys.exit(error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        kept = "; finished frames are kept, the same command continues" if "simulate" in sys.argv else ""
        print(f"gdpro: interrupted{kept}", file=sys.stderr)
        sys.exit(130)
    except _Terminated:
        sys.exit(143)
    except MemoryError:
        print("gdpro: out of memory; lower --budget or the number of tetrahedra", file=sys.stderr)
        sys.exit(1)
    except BrokenPipeError:
        sys.exit(1)
    except Exception as error:
        if debug:
            traceback.print_exc()
        print(f"gdpro: {type(error).__name__}: {error} (run again with --debug for details)", file=sys.stderr)
        sys.exit(1)


if __name__ == "__main__":
    main()
