"""FEM speed: milliseconds per frame of a soft body dropped 0.3 m, over mesh size and Young's modulus.

    python -m tests.benchmarks.bench_fem [--frames 60] [--threads N] [--device cpu] [--cells 9 15] [--shares]
        [--shape bunny] [--integrator bdf2] [--substeps 1]

Prints a Markdown table and the machine it was made on. A box of 0.5 m, or the bunny of warp-lang's examples,
0.5 m long, in about as many tets by fTetWild. 60 frames/s, density 1000, poisson 0.4, friction 0.5, no
damping, default solver settings but for the two options. The first step (compilation) is not counted.
"CPU" is the time of all threads together: on a shared machine it differs less from run to run than wall time.
`--shares` says where the wall time of a frame goes.
"""

from __future__ import annotations

import argparse
import functools
import time
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.tetrahedralize import tetrahedralize
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import FemSettings, Ground
from tests.benchmarks.machine import machine
from tests.benchmarks.shares import Shares
from tests.simulation.fem_models import make_model, tet_box

PARTS = ("assembly", "solve", "energy", "contact", "other")


def watched(solver: SolverFEM, device: str) -> Shares:
    """Counts where the time of the solver's steps goes from now on."""
    watch, potential = Shares(PARTS, device), solver._potential
    watch.watch(potential, "linearise", "assembly")
    watch.watch(potential.system, "solve", "solve")
    watch.watch(solver._rigid, "correct", "solve")
    watch.watch(potential, "energy", "energy")
    for term in solver.terms:
        for name in ("lag", "energy", "add_derivatives", "largest_step", "finish"):
            watch.watch(term, name, "contact")
    return watch


@functools.cache
def shape_of(name: str, cells: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and tets of a box of cells^3 cells, or of the bunny in about as many tets."""
    if name == "box":
        return tet_box((cells,) * 3, (0.5,) * 3, (0.0, 0.0, 0.3))
    mesh = load_mesh(Path(wp.__file__).parent / "examples/assets/bunny.usd")
    vertices = mesh.vertices * (0.5 / np.ptp(mesh.vertices, axis=0).max())
    found = tetrahedralize(vertices, mesh.faces, target_tets=6 * cells**3, time_limit=600.0, method="tetwild")
    lowest = np.array([0.0, 0.0, found.vertices[:, 2].min() - 0.3], np.float32)
    return found.vertices - lowest, found.tets


def measure(
    shape: tuple[np.ndarray, np.ndarray],
    young: float,
    frames: int,
    device: str,
    shares: bool,
    **settings: Any,
) -> str:
    """One row of the table."""
    vertices, tets = shape
    material: dict[str, Any] = {"young": young, "poisson": 0.4, "ground": Ground()}
    solver = SolverFEM(make_model(vertices, tets, **material, device=device, **settings))
    solver.step(1 / 60)
    solver.reset()
    watch = watched(solver, device) if shares else None
    times, newton, cg, substeps, unconverged = [], 0, 0, 0, 0
    processor = time.process_time()
    for _ in range(frames):
        begin = time.perf_counter()
        if watch:
            watch.begin()
        solver.step(1 / 60)
        wp.synchronize_device(device)
        times.append(1e3 * (time.perf_counter() - begin))
        if watch:
            watch.end()
        c = solver._counters
        newton += c.newton_iterations
        cg += c.cg_iterations
        substeps += c.substeps
        unconverged += not c.converged
    processor = 1e3 * (time.process_time() - processor) / frames
    row = (
        f"| {len(tets):,} | {young:.0e} | {np.mean(times):.1f} | {np.median(times):.1f} | {max(times):.0f} "
        f"| {processor:.1f} | {substeps / frames:.2f} | {newton / frames:.1f} | {cg / max(newton, 1):.0f} "
        f"| {unconverged} |"
    )
    if watch:
        row += watch.columns()
    return row


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument(
        "--cells", type=int, nargs="+", default=[9, 15], help="cells along an edge; 6 n^3 tets"
    )
    parser.add_argument("--young", type=float, nargs="+", default=[1e4, 1e5, 1e6, 1e7])
    parser.add_argument("--shape", choices=("box", "bunny"), default="box")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--integrator", default=FemSettings.integrator)
    parser.add_argument("--substeps", type=int, default=FemSettings.substeps)
    parser.add_argument("--shares", action="store_true", help="add where the time goes")
    options = parser.parse_args()
    if options.threads:
        devices.set_thread_count(options.threads)
    device = devices.resolve_device(options.device)

    settings = {"integrator": options.integrator, "substeps": options.substeps}
    print(f"{machine(device)}\n")
    columns = ["tets", "E, Pa", "ms/frame mean", "median", "worst", "CPU", "substeps", "Newton/frame"]
    columns += ["CG/Newton", "unconverged", *(PARTS if options.shares else ())]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for cells in options.cells:
        for young in options.young:
            shape = shape_of(options.shape, cells)
            row = measure(shape, young, options.frames, device, options.shares, **settings)
            print(row, flush=True)


if __name__ == "__main__":
    main()
