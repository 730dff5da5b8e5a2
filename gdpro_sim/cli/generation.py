"""Commands that make assets from prompts, meshes, photos and splat clouds: generate, vocabulary."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.progress import (
    BarColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeRemainingColumn,
)

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
    console,
    setup,
    show,
    table,
)
from gdpro_sim.errors import RequestError

PARTS = {
    "prepare": "Preparing",
    "prior": "Prior: coarse mesh",
    "surfels": "Stage 1: surfels",
    "extraction": "Extraction: mesh",
    "refinement": "Stage 2: bound Gaussians",
    "output": "Asset",
}


@contextmanager
def live(quiet: bool) -> Iterator[Callable[[str, int, int, Mapping[str, Any]], None]]:
    """One bar a part, with iterations, loss, PSNR where there is one, Gaussians and time left."""
    columns = (
        SpinnerColumn(),
        TextColumn("{task.description}"),
        BarColumn(bar_width=10),
        TextColumn("{task.fields[figures]}"),
        TimeRemainingColumn(compact=True, elapsed_when_finished=True),
    )
    with Progress(*columns, console=console, disable=quiet) as bars:
        tasks: dict[str, Any] = {}

        def close() -> None:
            """A part of unknown length is done when the next begins."""
            for task in tasks.values():
                if bars.tasks[task].total is None:
                    bars.update(task, total=1, completed=1)

        def report(part: str, done: int, total: int, figures: Mapping[str, Any]) -> None:
            if part not in tasks:
                close()
                tasks[part] = bars.add_task(PARTS.get(part, part), total=total or None, figures="")
            bars.update(
                tasks[part], completed=done, total=total or None, figures=_figures(done, total, figures)
            )

        try:
            yield report
        except BaseException:
            for task in tasks.values():  # what did not finish would stand between the user and the error
                bars.update(task, visible=bars.tasks[task].finished)
            raise
        close()


def _figures(done: int, total: int, figures: Mapping[str, Any]) -> str:
    if not figures:
        return ""
    psnr = figures.get("psnr")
    shown = [f"{done}/{total}", f"loss {figures['loss']:.3g}"]
    if psnr is not None:
        shown.append(f"{psnr:.1f} dB")
    return " ".join([*shown, f"{figures['gaussians']:,}"])


@app.command()
def generate(
    prompt: Annotated[str, typer.Argument(help="What to make; `gdpro vocabulary` lists the words.")] = "",
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Asset to write: .usdc, .usda or .usdz.")
    ] = None,
    from_mesh: Annotated[Path | None, typer.Option("--from-mesh", help="A mesh file.")] = None,
    from_images: Annotated[
        Path | None, typer.Option("--from-images", help="Folder of photos: transforms.json or COLMAP.")
    ] = None,
    from_splat: Annotated[
        Path | None, typer.Option("--from-splat", help="A splat cloud: .ply (3DGS) or .splat.")
    ] = None,
    quality: Annotated[str, typer.Option("--quality", help="draft, default, high or paper.")] = "default",
    guidance: Annotated[
        str | None, typer.Option("--guidance", help="procedural (built in), views or diffusers.")
    ] = None,
    model: Annotated[str | None, typer.Option("--model", help="Diffusion model: folder or hub id.")] = None,
    prior: Annotated[
        str | None, typer.Option("--prior", help="procedural, mesh, shap-e, hull or sphere.")
    ] = None,
    prior_model: Annotated[
        str | None, typer.Option("--prior-model", help="Shap-E: folder or hub id; mesh prior: its file.")
    ] = None,
    prior_prompt: Annotated[
        str | None, typer.Option("--prior-prompt", help="Short prompt for the prior, where it differs.")
    ] = None,
    run: Annotated[
        Path | None, typer.Option("--run", help="Folder for checkpoints and pictures of every stage.")
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", help="Continue the run kept in this folder."),
    ] = None,
    config: Annotated[Path | None, typer.Option("--config", help="YAML over the preset's values.")] = None,
    settings: Annotated[
        list[str] | None, typer.Option("--set", help="PART.FIELD=VALUE: surfels.iterations=500")
    ] = None,
    height: Annotated[float | None, typer.Option("--height", min=1e-4, help="Height in m.")] = None,
    material: Annotated[str | None, typer.Option("--material", help="Physical preset of the asset.")] = None,
    color: Color = None,
    up: Annotated[
        str, typer.Option("--up", help="Up axis of the input: auto, y, z; photos and splats also x, -x ...")
    ] = "auto",
    background: Annotated[
        str | None, typer.Option("--background", help="white or black: colour key of photos without alpha.")
    ] = None,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of every random draw.")] = 0,
    ignore_unknown: Annotated[
        bool, typer.Option("--ignore-unknown", help="Leave out words the vocabulary lacks.")
    ] = False,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Start even if it takes days.")] = False,
    device: Device = "auto",
    json_output: AsJson = False,
    quiet: Quiet = False,
    debug: Debug = False,
) -> None:
    """Make a Gaussian asset from a prompt, a mesh, photos or a splat cloud.

    The built-in guidance fits a parametric object through the whole pipeline: no weights, no network, and no
    open text-to-3D; that needs `--guidance diffusers --model DIR`. A run with --run can be stopped at any
    moment and continued by the same command, or by --resume.
    """
    setup(quiet, debug)
    if output is None:
        raise RequestError("give the asset to write: -o NAME.usdc")
    check_suffix(output, (".usdc", ".usda", ".usdz"))
    axes = ("auto", "y", "z") if from_mesh is not None else ("auto", "x", "y", "z", "-x", "-y", "-z")
    check_choice("--up", up, axes)
    for path in (from_mesh, from_images, from_splat, config):
        if path is not None:
            check_exists(path)
    from gdpro_sim.files import check_writable
    from gdpro_sim.generation.config import load_config
    from gdpro_sim.io.generate import Request, generate_run
    from gdpro_sim.io.sources import Inputs

    check_writable(output)
    if resume is not None:
        if prompt or from_mesh or from_images or from_splat or config or settings:
            raise RequestError("--resume takes no prompt, input or configuration: the run keeps its own")
        request = Request.read(resume)
    else:
        if background is not None:
            check_choice("--background", background, ("white", "black"))
        base: dict[str, dict[str, Any]] = {"guidance": {}, "prior": {}, "output": {}}
        if from_mesh or from_images or from_splat:
            base["guidance"]["kind"] = "views"
            base["prior"]["kind"] = "hull" if from_images else "mesh"
        if from_splat:  # real scenes are finer than a single object of the vocabulary
            base["extraction"] = {"depth": 9, "triangles": 12_000}
            base["refinement"] = {"per_triangle": 6}
        for part, name, value in (
            ("guidance", "kind", guidance),
            ("guidance", "model", model),
            ("prior", "kind", prior),
            ("prior", "file" if prior == "mesh" else "model", prior_model),
            ("prior", "prompt", prior_prompt),
            ("output", "height", height),
            ("output", "material", material),
        ):
            if value is not None:
                base[part][name] = value
        inputs = Inputs(
            prompt=prompt,
            mesh=_absolute(from_mesh),
            images=_absolute(from_images),
            splat=_absolute(from_splat),
            background=background,
            color=color,
            up=up,
            ignore_unknown=ignore_unknown,
        )
        request = Request(inputs.pinned(), load_config(quality, config, settings or (), base), seed)
    folder = run if resume is None else resume
    begin = time.perf_counter()
    with live(quiet) as report:
        result = generate_run(request, folder, device=device, accept_slow=yes, on_progress=report)
        result.asset.save(output)
    summary = {
        "asset": str(output),
        **result.asset.summary(),
        "seconds": round(time.perf_counter() - begin, 2),
        "parts": result.seconds,
    }
    if json_output:
        print(json.dumps(summary))
    elif not quiet:
        made = result.asset.provenance
        rows = [
            ("asset", str(output)),
            ("guidance", str(made["guidance"].get("label", made["guidance"].get("kind", "")))),
            ("size", " x ".join(f"{x:.3g}" for x in summary["size"]) + " m"),
            ("Gaussians", f"{summary['gaussians']:,} on {summary['faces']:,} triangles"),
            ("seconds", "  ".join(f"{part} {value:.1f}" for part, value in result.seconds.items())),
        ]
        psnr = [made["stages"].get(name, {}).get("psnr") for name in ("surfels", "refinement")]
        if psnr[1] is not None:
            against = "built-in prior" if made["guidance"].get("kind") == "procedural" else "input"
            first = "" if psnr[0] is None else f"{psnr[0]:.1f} dB after stage 1, "
            rows.insert(2, (f"fidelity to the {against}", f"{first}{psnr[1]:.1f} dB after stage 2"))
        if folder is not None:
            rows.append(("run", str(folder)))
        table(f"Asset {output}", rows)


def _absolute(path: Path | None) -> str | None:
    return None if path is None else str(path.resolve())


@app.command()
def vocabulary(json_output: AsJson = False, quiet: Quiet = False, debug: Debug = False) -> None:
    """List the words that the built-in generator knows; with --quiet, the nouns alone."""
    setup(quiet, debug)
    from gdpro_sim.generation import objects

    words = objects.vocabulary()
    if json_output:
        print(json.dumps(words))
    elif quiet:
        print("\n".join(sorted(objects.NOUNS)))
    else:
        show({kind: ", ".join(listed) for kind, listed in words.items()}, "Vocabulary", False, False)
