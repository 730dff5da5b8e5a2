"""MPM beside Taichi's MLS-MPM, one thread per particle in Warp, and Newton's implicit MPM.

    python -m venv peers/taichi && peers/taichi/bin/pip install taichi==1.7.4
    python -m venv peers/newton && peers/newton/bin/pip install newton==1.8.0
    python -m tests.benchmarks.bench_mpm_peers --taichi peers/taichi/bin/python \\
        --newton peers/newton/bin/python [--short] [--particles 50000] [--tables steps column sand]

Three tables, all on the CPU in this one run.

steps: the cube of `bench_mpm`, without a floor: the same particles, grid, law and substep for all, so
particle-steps per second compare. Taichi's is a port of the usual code (`mpm_peers.py`). "one by one" is
this library with its GPU kernels in place of its transfers, one particle at a time on one thread, which is
how codes of one Warp kernel per particle (warp-mpm) run on a CPU; law and sorting stay the same. "differs"
is the rms distance of its particles from ours at the end, over the rms way they went. Programs take turns;
wall times are medians, processor times minima.

column: an elastic column, twice as tall as wide, is let go on a floor and swings about how far it sinks under
its weight, rho g L^2 / 2E (0.5 % of its height). Newton's steps and iterations are raised until that is as
near the closed form as ours, or within 2 %. Seconds are of work per simulated second. Newton's steps and our
implicit ones damp the swing away; explicit substeps keep it.

sand: a column twice as tall as wide falls and spreads on a floor; "run-out" is how much wider it has become
after a second (a third of one with --short), over its width at first, both without the last hundredth. One
thread each: Newton has no more on a CPU.
"""

from __future__ import annotations

import argparse
import json
import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim import device as devices
from gdpro_sim.materials import Material
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.mpm.solver import SolverMPM
from gdpro_sim.simulation.verification.mpm_models import jittered, lattice, make_model
from tests.benchmarks.bench_fem_peers import centre
from tests.benchmarks.machine import machine
from tests.benchmarks.mpm_models import MATERIALS, moving_cube

LAWS = ("neo-Hookean", "corotated", "sand", "fluid")
TOLERANCE = 0.02
FRAME = 1.0 / 60.0
LADDER = ((1, 250), (1, 1000), (4, 1000))
"""Newton's steps per frame and most iterations of each, to try."""

ELASTIC = {"tolerance": 1e-6, "carry_residual_strain": "unconverged"}
"""Newton's settings for elastic bodies, as in its example of a twisted beam."""


def timed(work: Callable[[], None]) -> tuple[float, float]:
    """Wall and processor seconds."""
    wall, processor = time.perf_counter(), time.process_time()
    work()
    return time.perf_counter() - wall, time.process_time() - processor


def theirs(python: str, peer: str, problem: dict[str, Any], settings: dict[str, Any]) -> dict[str, Any]:
    """What `mpm_peers.py` prints; "positions" where it leaves some."""
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / "problem.npz", Path(folder) / "out.npy"
        np.savez(path, **problem)
        script = Path(__file__).with_name("mpm_peers.py")
        command = [python, str(script), peer, str(path), json.dumps({**settings, "out": str(out)})]
        ran = subprocess.run(command, capture_output=True, text=True, check=False)
        if ran.returncode:
            raise SystemExit(f"{peer} failed:\n{ran.stderr[-2000:]}")
        found: dict[str, Any] = json.loads(ran.stdout.strip().splitlines()[-1])
        if out.exists():
            found["positions"] = np.load(out)
    return found


def problem_of(model: Model, spacing: float) -> dict[str, Any]:
    """A model, as `mpm_peers.py` reads it."""
    particles = model.particles
    assert particles is not None
    fields = {"positions": particles.positions, "velocities": particles.velocities}
    return {**fields, "volume": particles.volumes[0], "dx": spacing, "gravity": np.array(model.gravity)}


def one_by_one(solver: SolverMPM) -> None:
    """Make a solver transfer as on a GPU, particle by particle, but on a CPU: for one thread alone."""
    grid = solver.grid

    def as_elsewhere(method: Callable[..., None]) -> Callable[..., None]:
        def transfer(*inputs: Any) -> None:
            device, grid.device = grid.device, "elsewhere"  # chooses the kernels; `grid.launch` has its own
            try:
                method(*inputs)
            finally:
                grid.device = device

        return transfer

    for name in ("scatter", "gather"):
        setattr(grid, name, as_elsewhere(getattr(grid, name)))


def ours(model: Model, frame: float, repeats: int, threads: int, slow: bool) -> tuple[dict[str, Any], int]:
    """What `mpm_peers.py` prints of Taichi, and the substeps of one run."""
    devices.set_thread_count(threads)
    solver = SolverMPM(model)
    if slow:
        one_by_one(solver)
    solver.step(frame / 20)
    found: dict[str, Any] = {"wall": [], "processor": []}
    for _ in range(repeats):
        solver.reset()
        wall, processor = timed(lambda: solver.step(frame))
        found["wall"].append(wall)
        found["processor"].append(processor)
    found["positions"] = solver.positions
    return found, solver.diagnostics().substeps


def steps(python: str, counts: list[int], names: Sequence[str], threads: list[int], short: bool) -> None:
    """Prints the table "steps"."""
    columns = [
        "particles",
        "law",
        "threads",
        "program",
        "M/s",
        "M/CPU s",
        "its time / ours, wall",
        "CPU",
        "differs",
    ]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    repeats = 2 if short else 3
    for count in counts:
        for name in names:
            material = MATERIALS[name]
            model = moving_cube(count, material, floor=False)
            assert model.particles is not None
            points = model.particles.positions
            solver = SolverMPM(model)
            spacing = solver.spacing
            frame = (4e5 if short else 1.6e6) / len(points) * 0.3 * spacing / 40.0
            solver.step(frame)
            taken = solver.diagnostics().substeps
            ends = np.concatenate([points, solver.positions]) / spacing
            low = np.floor(ends.min(axis=0)).astype(int) - 3
            size = np.ceil(ends.max(axis=0)).astype(int) + 4 - low
            way = float(np.sqrt(((solver.positions - points) ** 2).sum(axis=1).mean()))
            lam, mu = material.lame
            angle = math.sin(math.radians(material.friction_angle or 0.0))
            settings = {
                "law": material.model,
                "density": material.density,
                "lam": lam,
                "mu": mu,
                "slope": math.sqrt(2.0 / 3.0) * 2.0 * angle / (3.0 - angle),
                "h": frame / taken,
                "substeps": taken,
                "repeats": repeats,
                "low": low.tolist(),
                "size": size.tolist(),
            }
            problem = problem_of(model, spacing)
            found: dict[tuple[str, int], dict[str, Any]] = {}
            for k in threads:
                found["this library", k], substeps = ours(model, frame, repeats, k, False)
                assert substeps == taken
                found["Taichi", k] = theirs(python, "taichi", problem, {**settings, "threads": k})
            found["one by one", 1], _ = ours(model, frame, repeats, 1, True)
            end = found["this library", threads[0]]["positions"]
            work = 1e-6 * len(points) * taken
            walls = {key: float(np.median(run["wall"])) for key, run in found.items()}
            processors = {key: min(run["processor"]) for key, run in found.items()}
            for key, run in sorted(found.items(), key=lambda item: item[0][1]):
                program, k = key
                off = np.sqrt(((run["positions"] - end) ** 2).sum(axis=1).mean()) / way
                wall, processor = walls[key], processors[key]
                faster = wall / walls["this library", k], processor / processors["this library", k]
                print(
                    f"| {len(points):,} | {name} | {k} | {program} | {work / wall:.2f} "
                    f"| {work / processor:.2f} | {faster[0]:.1f} | {faster[1]:.1f} | {off:.0e} |",
                    flush=True,
                )


def standing(width: float, edge: int, material: Material, gravity: float, **settings: Any) -> Model:
    """A column on a floor, twice as tall as wide, `edge` cells across, 8 particles a cell."""
    points = lattice((width, width, 2.0 * width), (2 * edge, 2 * edge, 4 * edge))
    if material.model == "drucker_prager":
        points = jittered(points, 0.125 * width / edge)
    way = (0.0, 0.0, -gravity)
    return make_model(points, material, dx=width / edge, gravity=way, ground=Ground(), **settings)


def extent(positions: np.ndarray) -> float:
    """m, of all but the outermost hundredth on each side, along x or y."""
    return float(np.ptp(np.percentile(positions[:, :2], (1, 99), axis=0), axis=0).max())


def ours_by_frame(model: Model, top: np.ndarray, frames: int) -> tuple[dict[str, Any], int]:
    """What `mpm_peers.py` prints of Newton, and the substeps of a second."""
    solver = SolverMPM(model)
    solver.step(1e-5)
    solver.reset()
    found: dict[str, Any] = {"heights": [], "extents": [], "wall": [], "processor": []}
    substeps = 0
    for _ in range(frames):
        wall, processor = timed(lambda: solver.step(FRAME))
        found["wall"].append(wall)
        found["processor"].append(processor)
        positions = solver.positions[top]
        found["heights"].append(float(positions[:, 2].mean()))
        found["extents"].append(extent(positions))
        substeps += solver.diagnostics().substeps
    return found, round(substeps / (frames * FRAME))


def newtons(python: str, model: Model, top: np.ndarray, **settings: Any) -> dict[str, Any]:
    assert model.particles is not None and model.mpm.grid_spacing is not None
    problem = {**problem_of(model, model.mpm.grid_spacing), "top": top}
    material = model.particles.materials[0]
    common = {"density": material.density, "young": material.young, "poisson": material.poisson}
    return theirs(python, "newton", problem, {**common, **settings})


def per_second(run: dict[str, Any], frames: int) -> tuple[float, float]:
    """Wall and processor seconds per simulated second."""
    return sum(run["wall"]) / (frames * FRAME), sum(run["processor"]) / (frames * FRAME)


def column_row(head: str, run: dict[str, Any], every: int, rest: float, exact: float, own: float) -> float:
    """Prints a row; how far the column sinks over how far it should."""
    sinks = (rest - centre(run["heights"][every - 1 :: every])) / exact
    wall, processor = per_second(run, len(run["heights"]) // every)
    print(
        f"{head} | {sinks:.3f} | {wall:.2f} | {processor:.2f} | {processor / (own or processor):.1f} |",
        flush=True,
    )
    return sinks


def column(python: str, edge: int, youngs: list[float], frames: int) -> None:
    """Prints the table "column"."""
    columns = [
        "particles",
        "E, Pa",
        "solver",
        "steps a second",
        "sinks / exact",
        "wall s",
        "CPU s",
        "CPU / ours",
    ]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    width = 0.2
    for young in youngs:
        material = Material(model="neo_hookean", young=young, poisson=0.0, density=1000.0, friction=0.0)
        height = 2.0 * width
        gravity = 0.005 * 2.0 * young / (material.density * height)
        models = {
            f"this library, {integrator}": standing(width, edge, material, gravity, integrator=integrator)
            for integrator in ("explicit", "implicit")
        }
        model = models["this library, explicit"]
        assert model.particles is not None
        z = model.particles.positions[:, 2]
        top = z > z.max() - 1e-6
        rest = float(z[top].mean())
        exact = material.density * gravity / young * rest * (height - 0.5 * rest)
        own = 0.0

        head, error = f"| {len(z):,} | {young:.0e}", TOLERANCE
        for name, model in models.items():
            run, substeps = ours_by_frame(model, top, frames)
            sinks = column_row(f"{head} | {name} | {substeps:,}", run, 1, rest, exact, own)
            if not own:
                own, error = per_second(run, frames)[1], max(error, abs(sinks - 1.0))
        for every, iterations in LADDER:
            settings = {"dt": FRAME / every, "steps": frames * every, "iterations": iterations}
            run = newtons(python, model, top, friction=None, ground=0.0, config=ELASTIC, **settings)
            steps = f"{60 * every} of {iterations} iterations at most"
            sinks = column_row(f"{head} | Newton | {steps}", run, every, rest, exact, own)
            if abs(sinks - 1.0) <= error:
                break


def sand(python: str, edge: int, frames: int) -> None:
    """Prints the table "sand"."""
    columns = ["particles", "solver", "steps a second", "run-out", "wall s", "CPU s", "CPU / ours"]
    print(f"| {' | '.join(columns)} |\n{'|---' * len(columns)}|")
    width, material = 0.2, MATERIALS["sand"]
    model = standing(width, edge, material, 9.81)
    assert model.particles is not None and material.friction_angle is not None
    count, rest = len(model.particles), extent(model.particles.positions)
    everything = np.ones(count, bool)
    run, substeps = ours_by_frame(model, everything, frames)
    own = per_second(run, frames)[1]
    friction = math.tan(math.radians(material.friction_angle))
    settings = {"dt": FRAME, "steps": frames, "iterations": 250, "config": {}}
    peer = newtons(python, model, everything, friction=friction, ground=material.friction, **settings)
    for name, steps, found in (("this library", f"{substeps:,}", run), ("Newton", "60", peer)):
        wall, processor = per_second(found, frames)
        print(
            f"| {count:,} | {name} | {steps} | {found['extents'][-1] / rest - 1.0:.2f} | {wall:.2f} "
            f"| {processor:.2f} | {processor / own:.1f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--taichi", help="Python of a virtual environment with Taichi; for the table steps")
    parser.add_argument("--newton", help="the same with Newton; for the tables column and sand")
    parser.add_argument("--short", action="store_true", help="fewer substeps, smaller columns")
    parser.add_argument("--tables", nargs="+", choices=["steps", "column", "sand"])
    parser.add_argument("--particles", type=int, nargs="+", help="of the table steps")
    parser.add_argument("--materials", nargs="+", choices=LAWS, metavar="NAME")
    parser.add_argument("--young", type=float, nargs="+", help="Pa, of the table column")
    options = parser.parse_args()
    tables = options.tables or ["steps"] * bool(options.taichi) + ["column", "sand"] * bool(options.newton)
    if not tables:
        parser.error("which peers? Give --taichi, --newton or both")
    for table, needed in (("steps", "taichi"), ("column", "newton"), ("sand", "newton")):
        if table in tables and getattr(options, needed) is None:
            parser.error(f"the table {table} needs --{needed}")
    short, cores = options.short, devices.thread_count()
    print(machine())
    for table in tables:
        print(f"\n{table}\n")
        devices.set_thread_count(1)
        if table == "steps":
            counts = options.particles or [50_000]
            names = options.materials or LAWS[:: 2 if short else 1]
            steps(options.taichi, counts, names, sorted({1, cores}), short)
        elif table == "column":
            youngs = options.young or ([1e5] if short else [1e5, 1e6])
            column(options.newton, 4 if short else 6, youngs, 20)
        else:
            sand(options.newton, 4 if short else 8, 20 if short else 60)


if __name__ == "__main__":
    main()
