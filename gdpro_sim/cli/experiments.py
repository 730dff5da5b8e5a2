"""Commands that compare: ablate, study, tally."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from gdpro_sim.cli.common import AsJson, Debug, Device, Quiet, app, progress, setup, show
from gdpro_sim.errors import RequestError


@app.command()
def ablate(
    prompts: Annotated[list[str], typer.Argument(help="Prompts of the built-in vocabulary.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for table, sheet and records.")],
    rows: Annotated[
        str,
        typer.Option(
            "--rows",
            help="Of prior, surfels, gaussians, bound, frozen, unbound, textured-mesh, no-prior; commas.",
        ),
    ] = "bound,frozen,unbound,textured-mesh,surfels,gaussians,no-prior",
    seeds: Annotated[str, typer.Option("--seeds", help="Whole numbers, commas.")] = "0",
    jitters: Annotated[
        str, typer.Option("--jitters", help="How indeterminate the guidance is: unit lengths, commas.")
    ] = "0",
    quality: Annotated[str, typer.Option("--quality", help="draft, default, high or paper.")] = "draft",
    config: Annotated[Path | None, typer.Option("--config", help="YAML over the preset's values.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="PART.FIELD=VALUE: surfels.iterations=500")
    ] = None,
    views: Annotated[int, typer.Option("--views", min=2, max=200, help="Held-out views judged.")] = 16,
    device: Device = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Compare ways through the pipeline over prompts and seeds: one table (CSV, Markdown), one contact sheet.

    Figures are against the built-in prior's own object. What is done is kept: the same command goes on.
    """
    setup(quiet, debug)
    from gdpro_sim.generation.config import load_config
    from gdpro_sim.io.ablation import ablate as run

    with progress(quiet) as report:
        result = run(
            prompts,
            output,
            rows=_listed(rows, "--rows", str),
            seeds=_listed(seeds, "--seeds", int),
            jitters=_listed(jitters, "--jitters", float),
            config=load_config(quality, config, settings or ()),
            views=views,
            device=device,
            on_progress=lambda row, done, total, figures: report(row, done, total),
        )
    if json_output:
        print(json.dumps(result.records))
    elif not quiet:
        files = {"table": result.markdown, "csv": result.csv, "contact sheet": result.contact_sheet}
        found = {**{key: str(path) for key, path in files.items()}, "cases": len(result.records)}
        show(found, "Ablation", False, False)


def _listed(text: str, option: str, kind: type) -> list[Any]:
    try:
        return [kind(item.strip()) for item in text.split(",") if item.strip()]
    except ValueError:
        raise RequestError(f"{option} {text!r}: give {kind.__name__} values with commas between") from None


@app.command()
def study(
    folders: Annotated[list[Path], typer.Argument(help="Folders of runs or pictures, one a method.")],
    output: Annotated[Path, typer.Option("--output", "-o", help="New folder for page and key.")],
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of order and sides.")] = 0,
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Write a blinded page on which people say which of several results they prefer.

    Send OUTPUT/page to people, keep OUTPUT/key.json, and count what they send back with `gdpro tally`.
    """
    setup(quiet, debug)
    from gdpro_sim.io.study import write_study

    made = write_study(folders, output, seed)
    found = {"page": str(made.page), "key": str(made.key), "questions": made.questions}
    show(found, "Study", json_output, quiet)


@app.command()
def tally(
    key: Annotated[Path, typer.Argument(help="key.json of the study.")],
    answers: Annotated[list[Path], typer.Argument(help="JSON files that people saved.")],
    json_output: AsJson = False,
    debug: Debug = False,
) -> None:
    """Count a study's answers by method, with 95 % intervals."""
    setup(False, debug)
    from dataclasses import asdict

    from gdpro_sim.io.study import tally as count

    result = count(key, answers)
    print(json.dumps(asdict(result)) if json_output else result.text())
