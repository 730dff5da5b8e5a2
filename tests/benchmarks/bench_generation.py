"""What each stage of generation adds, and what it costs: twelve prompts, judged against the built-in prior's
own object, then dropped.

python -m tests.benchmarks.bench_generation [--quality draft] [--only N] [--no-drop] [-o out/bench_generation]

Writes fidelity.md, cost.md and sheet.png (one row a prompt: prior, stage 1, mesh, stage 2, after the fall)
and prints both tables. A prompt whose results lie in the folder already is not run again.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.device import serial_torch
from gdpro_sim.files import atomic_write, prepare_folder
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation import objects, pipeline
from gdpro_sim.generation.config import load_config
from gdpro_sim.generation.evaluation import evaluate
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.priors.procedural import ProceduralPrior
from gdpro_sim.generation.protocols import Stage, StepReport
from gdpro_sim.io.images import read_png, write_contact_sheet, write_png
from gdpro_sim.io.record import record
from gdpro_sim.io.turntable import turntable
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.simulation.scene import drop_scene
from tests.benchmarks.machine import machine

PROMPTS = (
    "a red mug with a blue handle",
    "a yellow rubber duck with an orange beak",
    "a cupcake",
    "a brick house",
    "a blue and white striped vase",
    "a wooden chair",
    "a burger",
    "a green cactus",
    "a pineapple",
    "a red toy car",
    "a snowman",
    "a teapot with white dots",
)
COLUMNS = ("psnr", "chamfer", "normal_error", "sharpness")
PARTS = ("render", "guidance", "backward", "optimizer", "other")


class Judge(pipeline.Observer):
    """Judges what each stage leaves, and adds up where its time goes; judging is not in the time."""

    def __init__(self, guidance: ProceduralGuidance, views: int) -> None:
        self.guidance, self.views = guidance, views
        self.figures: dict[str, dict[str, float | None]] = {}
        self.pictures: dict[str, np.ndarray] = {}
        self.parts: dict[str, dict[str, float]] = {}
        self.steps: dict[str, int] = {}
        self.seconds: dict[str, float] = {}
        self._part, self._begin = "prior", time.perf_counter()

    def phase(self, name: str) -> None:
        self._enter(name)

    def stepped(self, stage: Stage, report: StepReport) -> None:
        self._enter(stage.name)
        self.steps[stage.name] = stage.iteration
        parts = self.parts.setdefault(stage.name, dict.fromkeys(PARTS, 0.0))
        for part, value in report.seconds.items():
            parts[part] += value

    def finished(
        self, name: str, shown: SurfaceMesh | Gaussians | BoundGaussians, figures: Mapping[str, Any]
    ) -> None:
        self._enter("judging")
        surface = None
        seen: Any = shown
        if isinstance(shown, BoundGaussians):
            seen = shown.gaussians()
            surface = SurfaceMesh.from_arrays(shown.vertices.numpy(), shown.faces.numpy())
        judged = evaluate(
            seen,
            self.guidance.renderers[0],
            surface=surface,
            truth=self.guidance.surfaces[0],
            views=self.views,
        )
        self.figures[name] = judged.to_json()
        self.pictures[name] = turntable(shown, 1, 256)[0]

    def _enter(self, part: str) -> None:
        now = time.perf_counter()
        self.seconds[self._part] = self.seconds.get(self._part, 0.0) + now - self._begin
        self._part, self._begin = part, now


@serial_torch()
def generate(prompt: str, quality: str, folder: Path, views: int) -> dict[str, Any]:
    """One prompt through the pipeline: figures by stage, seconds, and the asset on the disk."""
    config = load_config(quality)
    begin = time.perf_counter()
    guidance = ProceduralGuidance(objects.parse(prompt), config.guidance, 0)
    prepared = time.perf_counter() - begin
    prior = ProceduralPrior(config.prior)
    source = pipeline.Source("asset", prompt, guidance, lambda: prior.mesh(prompt, 0), guidance.frame)
    judge = Judge(guidance, views)
    asset = pipeline.run(source, config, 0, observer=judge)
    judge.phase("end")
    asset.save(folder / "asset.usdc")
    for name, picture in judge.pictures.items():
        write_png(folder / f"{name}.png", picture)
    return {
        "prompt": prompt,
        "figures": judge.figures,
        "parts": judge.parts,
        "steps": judge.steps,
        "seconds": {**judge.seconds, "prepare": prepared},
        "gaussians": len(asset.gaussians),
        "faces": len(asset.gaussians.faces),
    }


def drop(folder: Path) -> dict[str, Any]:
    """The default scene of an asset: whether it holds, and where its lowest point ends over its size."""
    scene = drop_scene(folder / "asset.usdc")
    small = scene.camera.model_copy(update={"width": 256, "height": 256})
    recording = record(scene.model_copy(update={"camera": small}), folder / "drop")
    last = sorted((folder / "drop/frames").glob("*.png"))[-1]
    write_png(folder / "drop.png", read_png(last))
    return {"tets": recording.tets, "frames": recording.frame_count, "solve": recording.seconds["solve"]}


def one(prompt: str, options: argparse.Namespace) -> dict[str, Any]:
    folder = prepare_folder(Path(options.out) / "_".join(prompt.split()), "result.json")
    kept = folder / "result.json"
    found: dict[str, Any] = json.loads(kept.read_text()) if kept.exists() else {}
    if found.get("quality") != options.quality:
        found = {**generate(prompt, options.quality, folder, options.views), "quality": options.quality}
    if not options.no_drop and "drop" not in found:
        found["drop"] = drop(folder)
    with atomic_write(kept) as temporary:
        temporary.write_text(json.dumps(found), encoding="utf-8")
    return found


def fidelity(rows: list[dict[str, Any]]) -> str:
    """Prior, stage 1 and stage 2 by column; the last line counts prompts that each stage improves."""
    lines = [
        "| prompt | PSNR dB: prior → 1 → 2 | Chamfer ‰: prior → 1 → 2 | normals off °: prior → 1 → 2 "
        "| sharpness: prior → 1 → 2 | tets, after the fall |",
        "|---|---|---|---|---|---|",
    ]
    better = {name: [0, 0] for name in COLUMNS}
    for row in rows:
        f = row["figures"]
        cells = []
        for name in COLUMNS:
            # stage 1 has no mesh of its own: its geometry is that of the surface taken from it
            stage = "extraction" if name in ("chamfer", "normal_error") else "surfels"
            values = [f["prior"][name], f[stage][name], f["refinement"][name]]
            up = 1.0 if name in ("psnr", "sharpness") else -1.0
            for k in range(2):
                better[name][k] += up * (values[k + 1] - values[k]) > 0.0
            scale, digits = {"psnr": (1, 1), "chamfer": (1e3, 1), "normal_error": (1, 1)}.get(name, (1, 2))
            cells.append(" → ".join(f"{v * scale:.{digits}f}" for v in values))
        dropped = f"{row['drop']['tets']:,}, {row['drop']['frames']} frames" if "drop" in row else "-"
        lines.append(f"| {row['prompt']} | {' | '.join(cells)} | {dropped} |")
    counts = [f"{better[n][0]} and {better[n][1]} of {len(rows)}" for n in COLUMNS]
    lines.append(f"| *improved by 1 and by 2* | {' | '.join(counts)} | |")
    return "\n".join(lines)


def cost(rows: list[dict[str, Any]]) -> str:
    """Seconds by part, iterations per second, and shares of an iteration."""

    def span(values: list[float], digits: int = 1) -> str:
        return f"{np.median(values):.{digits}f} ({min(values):.{digits}f}-{max(values):.{digits}f})"

    lines = [
        "| part | seconds | iterations/s | " + " | ".join(PARTS) + " |",
        "|---|---|---|" + "---|" * len(PARTS),
    ]
    for part in ("prepare", "prior", "surfels", "extraction", "refinement", "output"):
        seconds = [row["seconds"].get(part, 0.0) for row in rows]
        cells = [part, span(seconds), ""] + [""] * len(PARTS)
        if part in rows[0]["parts"]:
            cells[2] = span([row["steps"][part] / row["seconds"][part] for row in rows])
            for k, name in enumerate(PARTS):
                shares = [row["parts"][part][name] / sum(row["parts"][part].values()) for row in rows]
                cells[3 + k] = f"{100.0 * np.median(shares):.0f} %"
        lines.append(f"| {' | '.join(cells)} |")
    whole = [sum(v for k, v in row["seconds"].items() if k != "judging") for row in rows]
    lines.append(f"| all | {span(whole)} | " + " | ".join([""] * (1 + len(PARTS))) + " |")
    return "\n".join(lines)


def sheet(rows: list[dict[str, Any]], options: argparse.Namespace) -> None:
    columns = ["prior", "surfels", "extraction", "refinement"] + ["drop"] * (not options.no_drop)
    pictures, labels = [], []
    for row in rows:
        folder = Path(options.out) / "_".join(row["prompt"].split())
        for name in columns:
            pictures.append(read_png(folder / f"{name}.png"))
            labels.append(row["prompt"] if name == "prior" else "")
    write_contact_sheet(
        Path(options.out) / "sheet.png", pictures, labels, columns=len(columns), width=256 * len(columns)
    )


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quality", default="default")
    parser.add_argument("--only", type=int, default=len(PROMPTS), help="the first so many prompts")
    parser.add_argument("--views", type=int, default=8, help="held-out views")
    parser.add_argument("--no-drop", action="store_true")
    parser.add_argument("-o", "--out", default="out/bench_generation")
    options = parser.parse_args()
    torch.manual_seed(0)
    rows = []
    for prompt in PROMPTS[: options.only]:
        rows.append(one(prompt, options))
        f = rows[-1]["figures"]
        print(prompt, *(f"{name} {f[name]['psnr']:.1f} dB" for name in f), flush=True)
    for name, text in (("fidelity", fidelity(rows)), ("cost", cost(rows))):
        with atomic_write(Path(options.out) / f"{name}.md") as temporary:
            temporary.write_text(text + "\n", encoding="utf-8")
        print(f"\n{text}")
    sheet(rows, options)
    print(f"\n{options.quality}; {machine()}")


if __name__ == "__main__":
    main()
