"""Speed of randomised rollouts: MuJoCo steps and pictures per second.

    python -m tests.benchmarks.bench_rollout [--rollouts 64] [--duration 1.0] [--threads 1 2] [--pictures 8]

Prints Markdown tables and the machine they were made on. A wooden bear of 16 convex pieces falls, turned at
random, at 1 ms a step. "alone" steps the solvers one after the other, "rollouts" are `run_batch`, and "plain"
is `mujoco.rollout` of the same models and starts, which keeps the state of every step in place of looking at
every frame. All take turns, three times; figures are medians of wall time, and "faster" is the ratio to
"alone" in the same run. Pictures are 256 x 256 with 15,000 Gaussians under studio lights.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout as plain

from gdpro_sim.io.dataset import rollout
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.mujoco.batch import run_batch
from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo
from gdpro_sim.simulation.randomize import draw, expand
from gdpro_sim.simulation.scene import Scene, check_scene
from tests.benchmarks.machine import machine

TURNS = 3


def scene_of(duration: float) -> Scene:
    return check_scene({
        "name": "drops", "duration": duration, "solver": {"kind": "mujoco"},
        "camera": {"width": 256, "height": 256},
        "bodies": [{
            "name": "bear", "asset": "package:warp/examples/assets/bear.usd", "color": "#b5793c",
            "size": 0.2, "position": [0, 0, 0.2], "budget": 15_000, "material": "wood",
            "mujoco": {"form": "rigid"},
        }],
        "randomize": {"bodies.bear": {"rotation": "any", "material.friction": [0.2, 0.8]}},
    })  # fmt: skip


def seconds(work: Callable[[], object]) -> float:
    begin = time.perf_counter()
    work()
    return time.perf_counter() - begin


def bench_steps(scene: Scene, count: int, threads: list[int]) -> None:
    assets = load_assets(scene)
    variations = expand(scene, scene.randomize)
    scenes = [draw(scene, variations, 0, k)[0] for k in range(count)]
    begin = time.perf_counter()
    solvers = [SolverMuJoCo(compile_scene(one, assets)) for one in scenes]
    print(f"compiled {count} models in {time.perf_counter() - begin:.2f} s\n")
    frames, dt = scene.frame_count, 1.0 / scene.fps
    steps = count * (frames - 1) * solvers[0].substeps(dt)
    kind = mujoco.mjtState.mjSTATE_FULLPHYSICS
    starts = np.zeros((count, mujoco.mj_stateSize(solvers[0].mjmodel, kind)))
    for start, solver in zip(starts, solvers, strict=True):
        mujoco.mj_getState(solver.mjmodel, solver.mjdata, start, kind)

    def alone() -> None:
        for solver in solvers:
            solver.reset()
            for _ in range(frames - 1):
                solver.step(dt)

    def batched(number: int) -> None:
        run_batch(solvers, frames, dt, lambda k, frame: None, threads=number)

    def plainly(number: int) -> None:
        data = [mujoco.MjData(solvers[0].mjmodel) for _ in range(number)]
        plain.rollout([s.mjmodel for s in solvers], data, starts, nstep=steps // count)

    works: dict[str, Callable[[], object]] = {"alone": alone}
    for number in threads:
        works[f"rollouts, {number} threads"] = lambda number=number: batched(number)  # type: ignore[misc]
        works[f"plain, {number} threads"] = lambda number=number: plainly(number)  # type: ignore[misc]
    found: dict[str, list[float]] = {name: [] for name in works}
    for _ in range(TURNS):
        for name, work in works.items():
            found[name].append(seconds(work))
    print(f"{steps:,} steps of {count} rollouts\n\n| | steps/s | faster |\n|---|---|---|")
    for name, times in found.items():
        ratio = statistics.median(a / b for a, b in zip(found["alone"], times, strict=True))
        print(f"| {name} | {steps / statistics.median(times):,.0f} | {ratio:.2f} |")


def bench_pictures(scene: Scene, count: int, threads: list[int]) -> None:
    print("\n| channels | threads | pictures/s |\n|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for channels in (["rgb"], ["rgb", "depth", "segmentation"], ["depth", "segmentation"]):
            for number in threads:
                name = Path(folder) / f"{'_'.join(channels)}_{number}"
                made = rollout(scene, name, count=count, channels=channels, threads=number)
                print(f"| {', '.join(channels)} | {number} | {count / made.seconds['draw']:.2f} |")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--rollouts", type=int, default=64)
    parser.add_argument("--duration", type=float, default=1.0, help="s of each rollout")
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--pictures", type=int, default=8)
    given = parser.parse_args()
    print(f"{machine()}\n")
    scene = scene_of(given.duration)
    bench_steps(scene, given.rollouts, given.threads)
    bench_pictures(scene, given.pictures, given.threads)


if __name__ == "__main__":
    main()
