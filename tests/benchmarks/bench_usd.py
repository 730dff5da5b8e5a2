"""Time and size of simulation files, as a Markdown table.

    python -m tests.benchmarks.bench_usd [--frames 30] [--folder DIR]

Bodies are spheres with a quarter as many vertices as Gaussians (SH degree 0) that stretch and turn. Write is
the mean over all frames with flushing, closing and fsync included; read is the mean over all frames.
"""

from __future__ import annotations

import argparse
import math
import resource
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import torch

from gdpro_sim.asset import Asset
from gdpro_sim.io.usd import BodyRecord, SimulationReader, SimulationWriter
from gdpro_sim.simulation.frame import BodyFrame, Frame
from gdpro_sim.simulation.model import Diagnostics
from tests.asset.sample import make_bound
from tests.benchmarks.machine import machine

STILL = Diagnostics(
    0.0, 0.0, 0.0, 0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0, 0.0, 1.0, 2, 3, 30, True, 1e-6
)  # fmt: skip


def run(count: int, precision: str, frames: int, folder: Path) -> str:
    """One row of the table."""
    bound = make_bound(count, 0, rings=max(3, round(math.sqrt(count / 8))))
    angle = torch.tensor(0.1)
    turn = torch.tensor([[angle.cos(), -angle.sin(), 0], [angle.sin(), angle.cos(), 0], [0, 0, 1]])
    path = folder / "bench.usdc"
    add = 0.0
    vertices = bound.vertices
    writer = SimulationWriter(path, 30, [BodyRecord("ball", bound)], precision=precision)  # type: ignore[arg-type]
    for i in range(frames):
        vertices = (vertices * torch.tensor([1.0, 1.0, 1.01])) @ turn.T
        body = BodyFrame("ball", vertices.numpy(), bound.gaussians(vertices))
        frame = Frame(i, i / 30, (body,), replace(STILL, time=i / 30))
        begin = time.perf_counter()
        writer.add(frame)
        add += time.perf_counter() - begin
    begin = time.perf_counter()
    writer.close()
    add += time.perf_counter() - begin
    reader = SimulationReader(path)
    begin = time.perf_counter()
    for i in range(frames):
        reader.frame(i)
    read = time.perf_counter() - begin
    size = path.stat().st_size / frames
    return (
        f"| {count:,} | {len(bound.vertices):,} | {precision} | {1e3 * add / frames:.1f} "
        f"| {1e3 * read / frames:.1f} | {size / 1e6:.2f} | {size / count:.1f} |"
    )


def run_asset(count: int, folder: Path) -> str:
    """One row of the asset table."""
    asset = Asset("ball", make_bound(count, 3, rings=max(3, round(math.sqrt(count / 8)))))
    row = f"| {count:,} |"
    for suffix in (".usdc", ".usdz", ".usda"):
        path = folder / f"asset{suffix}"
        begin = time.perf_counter()
        asset.save(path)
        saved = time.perf_counter()
        Asset.load(path)
        loaded = time.perf_counter()
        size = path.stat().st_size / 1e6
        row += f" {1e3 * (saved - begin):.0f} / {1e3 * (loaded - saved):.0f} ms, {size:.1f} MB |"
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=30)
    parser.add_argument("--folder", type=Path, help="where to write (default: the system's temporary folder)")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=arguments.folder) as name:
        folder = Path(name)
        run(1_000, "float", 2, folder)  # load kernels
        print(f"{machine()}; {arguments.frames} frames\n")
        print("| Gaussians | vertices | precision | write ms/frame | read ms/frame | MB/frame | B/Gaussian |")
        print("|---|---|---|---|---|---|---|")
        for count in (10_000, 50_000, 200_000):
            for precision in ("float", "half"):
                print(run(count, precision, arguments.frames, folder), flush=True)
        print("\n| Asset, SH degree 3 | .usdc save / load | .usdz | .usda |\n|---|---|---|---|")
        for count in (10_000, 50_000):
            print(run_asset(count, folder), flush=True)
    print(f"\nPeak memory of this process: {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3:.0f} MB")


if __name__ == "__main__":
    main()
