"""Milliseconds per frame of the whole pipeline: solve, re-splat, render, write; as a Markdown table.

    python -m tests.benchmarks.bench_pipeline [--scene NAME] [--duration S] [--device DEVICE]

Runs a shipped scene through `record` at 10k, 50k and 200k Gaussians and averages metrics.csv over all frames.
The solve does not depend on the number of Gaussians (the tetrahedra are the same size): its spread is noise.
"""

from __future__ import annotations

import argparse
import csv
import tempfile
from pathlib import Path

from gdpro_sim.io.record import PHASES, record
from gdpro_sim.simulation.scene import load_scene
from tests.benchmarks.machine import machine


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scene", default="jelly_bunny")
    parser.add_argument("--duration", type=float, default=1.0)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    scene = load_scene(options.scene)
    print(f"{scene.name}, {options.duration:g} s at {scene.fps} frames/s, "
          f"{scene.camera.width}x{scene.camera.height}; {machine(options.device)}\n")  # fmt: skip
    print("| Gaussians | tetrahedra | " + " | ".join(f"{phase} ms" for phase in PHASES) + " | sum ms |")
    print("|---|---|" + "---|" * (len(PHASES) + 1))
    for budget in (10_000, 50_000, 200_000):
        bodies = tuple(body.model_copy(update={"budget": budget}) for body in scene.bodies)
        sized = scene.model_copy(update={"bodies": bodies, "duration": options.duration})
        with tempfile.TemporaryDirectory() as folder:
            recording = record(sized, folder, device=options.device)
            with open(Path(folder) / "metrics.csv", newline="", encoding="utf-8") as file:
                rows = list(csv.DictReader(file))[1:]  # the first frame loads the kernels
        means = [sum(float(row[f"ms_{phase}"]) for row in rows) / len(rows) for phase in PHASES]
        cells = [
            f"{recording.gaussians:,}",
            f"{recording.tets:,}",
            *(f"{m:.0f}" for m in means),
            f"{sum(means):.0f}",
        ]
        print("| " + " | ".join(cells) + " |", flush=True)


if __name__ == "__main__":
    main()
