"""`gdpro ablate`: the paper's ablations over prompts and seeds as one table and one contact sheet.

The output folder holds `records/` (one JSON and one PNG per case, written as soon as it is done, so that a
run that was stopped goes on with the next), `ablation.csv` (every record), `ablation.md` (means and standard
deviations over prompts and seeds) and `ablation.png`.
"""

from __future__ import annotations

import csv
import hashlib
import io
import json
import logging
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

import gdpro_sim
from gdpro_sim.device import resolve_device, serial_torch
from gdpro_sim.errors import RequestError
from gdpro_sim.files import atomic_write, prepare_folder, remove_stale
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.ablation import ROWS, Case, Outcome, Subject, cases, run_ablation
from gdpro_sim.generation.cameras import ring
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.generation.evaluation import render
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.guidance.views import MeshGuidance, RenderedGuidance
from gdpro_sim.generation.renders import Renders
from gdpro_sim.io.images import read_png, write_contact_sheet, write_png
from gdpro_sim.io.sources import Inputs, open_source
from gdpro_sim.meshing.surface import SurfaceMesh

logger = logging.getLogger(__name__)

RECORD_FORMAT = 1
"""Raise it when records of an earlier version must not be mixed with new ones."""

PICTURE = 256
"""Pixels across a picture of the contact sheet."""

COLUMNS: dict[str, tuple[str, int]] = {
    "psnr": ("PSNR (dB)", 2),
    "ssim": ("SSIM", 3),
    "chamfer": ("Chamfer (unit sphere)", 4),
    "f_score": ("F@1 %", 3),
    "normal_error": ("normal error (deg)", 1),
    "sharpness": ("edge sharpness", 3),
    "strays": ("visible strays", 4),
    "inconsistency": ("view inconsistency", 4),
    "gaussians": ("Gaussians", 0),
    "seconds": ("seconds, this stage", 1),
    "seconds_all": ("seconds, all", 1),
}
"""Titles of the table's columns, and their decimals."""

Progress = Callable[[str, int, int, dict[str, Any]], None]
"""Called with (row, done, total, figures): iterations of the stage that is running."""


@dataclass(frozen=True)
class Ablation:
    """Where the results lie, and the records, one flat dictionary per case."""

    csv: Path
    markdown: Path
    contact_sheet: Path
    records: list[dict[str, Any]]
    resumed: int


@serial_torch()
def ablate(
    prompts: Sequence[str],
    output: str | Path,
    *,
    rows: Sequence[str] = ROWS,
    seeds: Sequence[int] = (0,),
    jitters: Sequence[float] = (0.0,),
    config: GenerationConfig | None = None,
    views: int = 16,
    resolution: int = 192,
    device: str = "auto",
    on_progress: Progress | None = None,
) -> Ablation:
    """Run every row for every prompt, seed and jitter, and write the table and the contact sheet.

    prompts: of the built-in vocabulary, or paths of mesh files (then with guidance.kind views, prior mesh)
    jitters: of the guidance's target, unit-frame lengths; several sweep how indeterminate guidance is
    views, resolution: of the held-out pictures that are judged

    Cases already recorded in `output` are not run again. Raises RequestError (also GuidanceError, MeshError)
    for a wrong request or a folder that holds another ablation's records, OutputError for a full disk.
    """
    name = resolve_device(device)
    config = config or load_config("default")
    wanted = cases(prompts, seeds, rows, jitters)
    folder = prepare_folder(output, "ablation.csv")
    kept = _Records(prepare_folder(folder / "records", "x.json"), _settings(config, views, resolution))
    missing = [case for case in wanted if kept.load(case) is None]
    resumed = len(wanted) - len(missing)
    if resumed:
        logger.info("%d of %d cases are there already", resumed, len(wanted))

    def opened(prompt: str, settings: GenerationConfig, seed: int) -> Subject:
        subject = _subject(prompt, settings, seed, name)
        if not kept.reference(prompt, seed).exists():
            write_png(kept.reference(prompt, seed), _picture(subject.reference.render(ring(1, PICTURE))))
        return subject

    report = on_progress or (lambda row, done, total, figures: None)
    for outcome in run_ablation(
        missing, config, opened, views=views, resolution=resolution,
        on_step=lambda row, stage, step: report(
            row, step.iteration, stage.iterations, {"loss": step.loss, "psnr": step.psnr}
        ),
    ):  # fmt: skip
        kept.save(outcome)
    records = [record for case in wanted if (record := kept.load(case)) is not None]
    table = folder / "ablation.csv"
    with atomic_write(table) as temporary:
        temporary.write_text(to_csv(records), encoding="utf-8")
    text = folder / "ablation.md"
    with atomic_write(text) as temporary:
        temporary.write_text(to_markdown(records, config), encoding="utf-8")
    sheet = folder / "ablation.png"
    _contact_sheet(sheet, wanted, kept)
    return Ablation(table, text, sheet, records, resumed)


def to_csv(records: Sequence[dict[str, Any]]) -> str:
    """Every record on a line, nothing rounded; empty where there is nothing to measure."""
    out = io.StringIO()
    writer = csv.DictWriter(out, list(records[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(records)
    return out.getvalue()


def to_markdown(records: Sequence[dict[str, Any]], config: GenerationConfig) -> str:
    """One table per jitter: means over prompts and seeds, with standard deviations where there are several.

    Infinite PSNRs (equal pictures) stay infinite; what a row has no value for is a dash.
    """
    prompts = sorted({r["prompt"] for r in records})
    seeds = sorted({r["seed"] for r in records})
    lines = [
        "# Ablation",
        "",
        f"{len(prompts)} prompts ({'; '.join(prompts)}), seeds {', '.join(map(str, seeds))}; "
        f"{config.surfels.iterations} iterations of stage 1, {config.refinement.iterations} of stage 2; "
        f"gdpro-sim {gdpro_sim.__version__}.",
        "",
        f"Guidance: {config.guidance.kind}. "
        + (
            "PSNR, SSIM and geometry are fidelity to the built-in prior's own object, not text-to-3D quality."
            if config.guidance.kind == "procedural"
            else "PSNR, SSIM and geometry are fidelity to what was given."
        ),
    ]
    for jitter in sorted({r["jitter"] for r in records}):
        lines += ["", f"## Jitter {jitter:g}", ""]
        lines += ["| row | n | " + " | ".join(title for title, _ in COLUMNS.values()) + " |"]
        lines += ["|---|--:|" + "--:|" * len(COLUMNS)]
        for row in ROWS:
            chosen = [r for r in records if r["row"] == row and r["jitter"] == jitter]
            if chosen:
                cells = [_cell([r[key] for r in chosen], digits) for key, (_, digits) in COLUMNS.items()]
                lines.append(f"| {row} | {len(chosen)} | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _cell(values: Sequence[float | None], digits: int) -> str:
    """Mean, and standard deviation of the sample where there are several values."""
    numbers = [float(v) for v in values if v is not None]
    if not numbers:
        return "–"
    mean = float(np.mean(numbers))
    if len(numbers) == 1 or not math.isfinite(mean):
        return f"{mean:.{digits}f}"
    return f"{mean:.{digits}f} ± {float(np.std(numbers, ddof=1)):.{digits}f}"


class _Records:
    """Finished cases in a folder; all of one ablation's settings."""

    def __init__(self, folder: Path, settings: str) -> None:
        self._folder, self._settings = folder, settings
        remove_stale(folder)

    def path(self, case: Case) -> Path:
        key = json.dumps(asdict(case), sort_keys=True)
        return self._folder / f"{case.row}-{hashlib.sha256(key.encode()).hexdigest()[:16]}.json"

    def reference(self, prompt: str, seed: int) -> Path:
        key = f"{prompt}\n{seed}"
        return self._folder / f"reference-{hashlib.sha256(key.encode()).hexdigest()[:16]}.png"

    def load(self, case: Case) -> dict[str, Any] | None:
        path = self.path(case)
        try:
            data = json.loads(path.read_text(encoding="utf-8"))
        except FileNotFoundError:
            return None
        except (OSError, ValueError) as error:
            raise RequestError(
                f"{path}: cannot be read ({error}); delete it to run that case again"
            ) from None
        if not isinstance(data, dict) or data.get("settings") != self._settings:
            raise RequestError(
                f"{path} was recorded with another configuration or version; give an empty folder"
            )
        return dict(data["record"])

    def save(self, outcome: Outcome) -> None:
        """The picture first: a record means that both are there."""
        path = self.path(outcome.case)
        write_png(path.with_suffix(".png"), picture_of(outcome.shown))
        with atomic_write(path) as temporary:
            data = {"settings": self._settings, "record": outcome.to_json()}
            temporary.write_text(json.dumps(data, indent=1), encoding="utf-8")


def _settings(config: GenerationConfig, views: int, resolution: int) -> str:
    """What a record depends on besides its case, as a hash. Jitter belongs to the case."""
    data = config.model_dump(mode="json")
    data["guidance"]["jitter"] = None
    data.pop("output")
    whole = [RECORD_FORMAT, gdpro_sim.__version__, data, views, resolution]
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()


def _subject(prompt: str, config: GenerationConfig, seed: int, device: str) -> Subject:
    """Opens a prompt or a mesh file. Raises RequestError where the guidance has no pictures to compare."""
    is_file = Path(prompt).suffix != "" and Path(prompt).is_file()
    inputs = (Inputs(mesh=prompt) if is_file else Inputs(prompt=prompt)).pinned()
    source = open_source(inputs, config, seed, device=device)
    guidance = source.guidance
    if not isinstance(guidance, RenderedGuidance):
        raise RequestError(
            f"guidance {config.guidance.kind} has no pictures to compare with: an ablation's figures need "
            "procedural, or views of a mesh"
        )
    truth = None
    if isinstance(guidance, ProceduralGuidance):
        truth = guidance.surfaces[0]
    elif isinstance(guidance, MeshGuidance) and source.prior is not None and source.frame is not None:
        from gdpro_sim.meshing.load import load_mesh

        truth = source.frame.to_unit(load_mesh(prompt))
    return Subject(source, guidance.renderers[0], truth)


def picture_of(shown: Gaussians | SurfaceMesh) -> np.ndarray:
    """One picture over white, uint8 [PICTURE, PICTURE, 3]."""
    return _picture(render(shown, ring(1, PICTURE)))


def _picture(renders: Renders) -> np.ndarray:
    image = renders.over(torch.ones(1, 3))[0].clamp(0.0, 1.0)
    return (image.cpu().numpy() * 255.0 + 0.5).astype(np.uint8)


def _contact_sheet(path: Path, wanted: Sequence[Case], kept: _Records) -> None:
    """A line per prompt, seed and jitter: the reference, then the rows."""
    pictures: list[np.ndarray] = []
    labels: list[str] = []
    rows = [row for row in ROWS if any(case.row == row for case in wanted)]
    for key in dict.fromkeys((c.prompt, c.seed, c.jitter) for c in wanted):
        prompt, seed, jitter = key
        pictures.append(read_png(kept.reference(prompt, seed)))
        labels.append(f"{prompt[:24]}, seed {seed}" + (f", jitter {jitter:g}" if jitter else ""))
        for row in rows:
            case = Case(prompt, seed, jitter, row)
            record = kept.load(case)
            assert record is not None
            pictures.append(read_png(kept.path(case).with_suffix(".png")))
            labels.append(f"{row} {record['psnr']:.1f} dB")
    columns = len(rows) + 1
    write_contact_sheet(path, pictures, labels, columns=columns, width=columns * (PICTURE + 4))


__all__ = ["Ablation", "ablate", "picture_of", "to_csv", "to_markdown"]
