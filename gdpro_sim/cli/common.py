"""What the commands of `gdpro` share: the application, options, progress, tables, checks."""

from __future__ import annotations

import json
import logging
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

from gdpro_sim.errors import RequestError

if TYPE_CHECKING:
    from collections.abc import Iterator

app = typer.Typer(
    name="gdpro",
    help="Physically simulatable Gaussian assets from a prompt, a mesh or photos: simulated, re-splatted.",
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
    "prior": "Prior: coarse mesh",
    "surfels": "Stage 1: surfels",
    "extraction": "Extraction: mesh",
    "refinement": "Stage 2: bound Gaussians",
    "output": "Asset",
    "simulate": "Simulating",
    "usd": "Writing USD",
    "video": "Writing video",
    "render": "Rendering",
}


def setup(quiet: bool, debug: bool) -> None:
    level = logging.DEBUG if debug else logging.ERROR if quiet else logging.WARNING
    handler = RichHandler(console=console, show_time=False, show_path=debug, markup=False)
    logging.basicConfig(level=level, format="%(message)s", handlers=[handler], force=True)
    for noisy in ("PIL", "imageio", "imageio_ffmpeg", "trimesh", "matplotlib"):
        logging.getLogger(noisy).setLevel(logging.ERROR)


@contextmanager
def progress(quiet: bool) -> Iterator[Callable[[str, int, int], None]]:
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
    shown = console.is_terminal and not quiet
    with Progress(*columns, console=console, disable=not shown, transient=True) as bars:
        tasks: dict[str, Any] = {}

        def report(phase: str, done: int, total: int) -> None:
            if phase not in tasks:
                for name, task in tasks.items():
                    if name != phase:
                        bars.update(task, visible=False)
                tasks[phase] = bars.add_task(_PHASE_NAMES.get(phase, phase), total=total or None)
            bars.update(tasks[phase], completed=done, total=total or None)

        yield report


def table(title: str, rows: list[tuple[str, str]]) -> None:
    table = Table(title=title, show_header=False, title_justify="left")
    for row in rows:
        table.add_row(*row)
    Console().print(table)


def _without_none(value: Any) -> Any:
    """Plain data without the keys that hold nothing."""
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value


def show(data: dict[str, Any], title: str, as_json: bool, quiet: bool) -> None:
    if as_json:
        print(json.dumps(data))
    elif not quiet:
        given = {key: _without_none(value) for key, value in data.items()}
        rows = ((k.replace("_", " "), v if isinstance(v, str) else json.dumps(v)) for k, v in given.items())
        table(title, list(rows))


def check_exists(path: Path) -> None:
    """Before the heavy imports: a mistyped name should be told at once."""
    if not path.exists():
        raise RequestError(f"{path}: no such file")


def check_choice(option: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise RequestError(f"{option} must be one of {', '.join(allowed)}, got {value!r}")


def check_suffix(path: Path, allowed: tuple[str, ...]) -> None:
    if path.suffix.lower() not in allowed:
        raise RequestError(f"output {path} must end in {', '.join(allowed)}")


def first_line(error: ValueError) -> str:
    errors = getattr(error, "errors", None)
    return str(errors()[0]["msg"]).removeprefix("Value error, ") if callable(errors) else str(error)
