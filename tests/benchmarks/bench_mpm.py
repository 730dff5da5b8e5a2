"""MPM speed: particle-steps per second of a cube pressed against a floor, over particles and materials.

    python -m tests.benchmarks.bench_mpm [--short] [--particles 10000 50000] [--materials sand snow]
                                         [--threads 1 2] [--device cpu] [--kernel quadratic]

Prints a Markdown table and the machine it was made on. A cube of 0.5 m, 8 particles a cell, APIC; "mixed" is
all materials in one cube, particle by particle, the worst order there is. Each figure is from frames of the
same number of substeps, sorting, time step control and saving of the state included, after one frame that is
not counted; thread counts take turns. "M/s" is the median by wall time, "M/CPU s" the best by the time of all
threads together, which differs less on a shared machine; "faster" is the ratio of the medians. Shares are of
wall time with the last thread count, and of "sort" with the time steps' own sorting. "B/particle" is the
growth of the process while the solver is made and run, over the particles.
"""

from __future__ import annotations

import argparse
import contextlib
import ctypes
import gc
import time
from pathlib import Path

import numpy as np
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.simulation.mpm.matter import sound_speed
from gdpro_sim.simulation.mpm.solver import SolverMPM
from tests.benchmarks.machine import machine
from tests.benchmarks.mpm_models import MATERIALS, moving_cube
from tests.benchmarks.shares import Shares

PARTS = ("P2G", "grid", "G2P", "law", "sort", "other")
WORK = {False: 1.0e7, True: 1.0e6}
"""Particle-steps of a frame, by whether the run is a short one; from 10 to 100 substeps."""


def watched(solver: SolverMPM, device: str) -> Shares:
    """Counts where the time of the solver's steps goes from now on."""
    watch = Shares(PARTS, device)
    watch.watch(solver.grid, "scatter", "P2G")
    watch.watch(solver.grid, "gather", "G2P")
    watch.watch(solver.grid, "sort", "sort")
    watch.watch(solver, "_update_stress", "law")
    for boundary in solver.boundaries:
        for name in ("begin", "apply", "drive"):
            watch.watch(boundary, name, "grid")
    return watch


class Memory:
    """Growth of the memory held since this was made, at its peak, bytes; 0 where the system does not say."""

    def __init__(self, device: str) -> None:
        gc.collect()
        self._device = device
        if device == "cpu":
            with contextlib.suppress(OSError, AttributeError):  # elsewhere than on Linux
                ctypes.CDLL(None).malloc_trim(0)
                Path("/proc/self/clear_refs").write_text("5", encoding="ascii")  # forget the last peak
        self._before = self._held("VmRSS")

    def _held(self, field: str) -> int:
        if self._device != "cpu":
            high = field == "VmHWM"
            return (wp.get_mempool_used_mem_high if high else wp.get_mempool_used_mem_current)(self._device)
        try:
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            return 1024 * next(int(line.split()[1]) for line in lines if line.startswith(field))
        except (OSError, StopIteration):
            return 0

    def peak(self) -> int:
        return self._held("VmHWM") - self._before


def measure(
    count: int, name: str, threads: list[int], device: str, kernel: str, short: bool, repeats: int
) -> str:
    """One row of the table."""
    materials = tuple(MATERIALS.values()) if name == "mixed" else (MATERIALS[name],)
    memory = Memory(device)
    model = moving_cube(count, *materials, kernel=kernel, device=device)
    assert model.particles is not None
    solver, count = SolverMPM(model), len(model.particles)
    speed = float(np.linalg.norm(model.particles.velocities, axis=1).max())
    substeps = int(np.clip(WORK[short] / count, 10, 100))
    frame = substeps * model.mpm.cfl * solver.spacing / (max(map(sound_speed, materials)) + speed)
    devices.set_thread_count(threads[-1])
    solver.step(frame)

    rates: dict[int, list[tuple[float, float]]] = {k: [] for k in threads}
    for _ in range(repeats):
        for k in threads:
            devices.set_thread_count(k)
            wall, processor = time.perf_counter(), time.process_time()
            solver.step(frame)
            wp.synchronize_device(device)
            wall, processor = time.perf_counter() - wall, time.process_time() - processor
            work = 1e-6 * count * solver._counters.substeps
            rates[k].append((work / wall, work / processor))
    taken = solver._counters.substeps
    used = memory.peak() / count
    watch = watched(solver, device)
    watch.begin()
    solver.step(frame)
    watch.end()

    medians = {k: float(np.median([wall for wall, _ in found])) for k, found in rates.items()}
    row = f"| {count:,} | {name} | {taken} |"
    for k, found in rates.items():
        row += f" {medians[k]:.2f} | {max(processor for _, processor in found):.2f} |"
    if len(threads) > 1:
        row += f" {medians[threads[-1]] / medians[threads[0]]:.2f} |"
    return f"{row}{watch.columns()} {used:.0f} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = [*MATERIALS, "mixed"]
    parser.add_argument("--short", action="store_true", help="10k and 50k particles, few substeps")
    parser.add_argument("--particles", type=int, nargs="+")
    parser.add_argument("--materials", nargs="+", choices=names, metavar="NAME", default=names)
    parser.add_argument("--threads", type=int, nargs="+", help="default: one, and all cores")
    parser.add_argument("--kernel", choices=["quadratic", "cubic"], default="quadratic")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repeats", type=int, default=3)
    options = parser.parse_args()
    device = devices.resolve_device(options.device)
    threads = sorted(set(options.threads or (1, devices.thread_count())))
    if device != "cpu":
        threads = threads[-1:]
    devices.set_thread_count(threads[-1])
    counts = options.particles or (
        [10_000, 50_000] if options.short else [10_000, 50_000, 200_000, 1_000_000]
    )

    print(f"{machine(device)}\n")
    columns = ["particles", "material", "substeps"]
    for k in threads:
        columns += [f"{k} thread{'s' * (k > 1)}: M/s", "M/CPU s"]
    columns += ["faster"] * (len(threads) > 1) + [*PARTS, "B/particle"]
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    SolverMPM(moving_cube(1000, *MATERIALS.values(), kernel=options.kernel, device=device)).step(1e-4)
    for count in counts:
        for name in options.materials:
            row = measure(count, name, threads, device, options.kernel, options.short, options.repeats)
            print(row, flush=True)


if __name__ == "__main__":
    main()
