"""FEM speed: milliseconds per frame of a 0.5 m box dropped 0.3 m, over mesh size and Young's modulus.

    python -m tests.benchmarks.bench_fem [--frames 60] [--threads N] [--device cpu] [--cells 9 15]

Prints a Markdown table and the machine it was made on. 60 frames/s, density 1000, poisson 0.4, friction 0.5,
no damping, default solver settings. The first step (compilation) is not counted.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from tests.benchmarks.machine import machine
from tests.simulation.fem_models import make_model, tet_box


def measure(cells: int, young: float, frames: int, device: str) -> str:
    """One row of the table."""
    vertices, tets = tet_box((cells,) * 3, (0.5,) * 3, (0.0, 0.0, 0.3))
    solver = SolverFEM(make_model(vertices, tets, young=young, poisson=0.4, ground=Ground(), device=device))
    solver.step(1 / 60)
    solver.reset()
    times, newton, cg, substeps, unconverged = [], 0, 0, 0, 0
    for _ in range(frames):
        begin = time.perf_counter()
        solver.step(1 / 60)
        wp.synchronize_device(device)
        times.append(1e3 * (time.perf_counter() - begin))
        d = solver.diagnostics()
        newton += d.newton_iterations
        cg += d.cg_iterations
        substeps += d.substeps
        unconverged += not d.converged
    return (
        f"| {len(tets):,} | {young:.0e} | {np.mean(times):.0f} | {np.median(times):.0f} | {max(times):.0f} "
        f"| {substeps / frames:.2f} | {newton / frames:.1f} | {cg / max(newton, 1):.0f} | {unconverged} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument(
        "--cells", type=int, nargs="+", default=[9, 15], help="cells along an edge; 6 n^3 tets"
    )
    parser.add_argument("--young", type=float, nargs="+", default=[1e4, 1e5, 1e6, 1e7])
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    if options.threads:
        devices.set_thread_count(options.threads)
    device = devices.resolve_device(options.device)

    print(f"{machine(device)}\n")
    print(
        "| tets | E, Pa | ms/frame mean | median | worst "
        "| substeps | Newton/frame | CG/Newton | unconverged |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for cells in options.cells:
        for young in options.young:
            print(measure(cells, young, options.frames, device), flush=True)


if __name__ == "__main__":
    main()
