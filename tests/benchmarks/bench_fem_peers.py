"""FEM beside Newton's VBD and MuJoCo's flex at equal accuracy: a box dropped on a floor, ms per frame.

    python -m venv peers && peers/bin/pip install newton==1.8.0 mujoco==4.0.0
    python -m tests.benchmarks.bench_fem_peers --python peers/bin/python [--cells 9] [--young 1e5 1e6 1e7]

First a cantilever of the same material and element size, swinging under its weight: a peer's iterations are
raised until where it swings about lies within 2 % of the static solution on the same mesh (our quasi-static
one). Gravity is scaled so that the tip sinks by 4 % of the length. Then the box of `bench_fem` is dropped
with those settings. All run on the CPU in this one run, one after the other, on one thread unless --threads
says otherwise (ours; the peers have one on the CPU). "CPU" is processor time; ratios are of CPU times.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim import device as devices
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from tests.benchmarks.machine import machine
from tests.simulation.fem_models import make_model, tet_box

TOLERANCE = 0.02
PEERS = {
    "newton": ("Newton VBD", 10, (10, 20, 50, 100, 200)),
    "mujoco": ("MuJoCo flex, full", 8, (50, 100, 200, 400)),
}
"""Name, substeps of 1/60 s, and iterations to try."""


def box(cells: int, young: float) -> dict[str, Any]:
    vertices, tets = tet_box((cells,) * 3, (0.5,) * 3, (0.0, 0.0, 0.3))
    everything, nothing = np.ones(len(vertices), bool), np.zeros(len(vertices), bool)
    shape = {"vertices": vertices, "tets": tets, "pinned": nothing, "tip": everything}
    return {**shape, "young": young, "poisson": 0.4, "density": 1000.0, "gravity": 9.81, "ground": True}


def beam(young: float) -> dict[str, Any]:
    length, height = 0.3, 0.1
    vertices, tets = tet_box((6, 2, 2), (length, height, height), (0.0, 0.0, 1.0))
    shape = {"vertices": vertices, "tets": tets, "pinned": vertices[:, 0] < 1e-9}
    gravity = 0.04 * length * 8.0 * young * height**2 / (12.0 * 1000.0 * length**4)
    material = {"young": young, "poisson": 0.4, "density": 1000.0}
    return {**shape, "tip": vertices[:, 0] > length - 1e-9, **material, "gravity": gravity, "ground": False}


def ours(mesh: dict[str, Any], frames: int, **settings: Any) -> dict[str, list[float]]:
    """What `fem_peers.py` prints, for our solver."""
    model = make_model(
        mesh["vertices"],
        mesh["tets"],
        young=mesh["young"],
        poisson=mesh["poisson"],
        pinned=mesh["pinned"],
        gravity=(0.0, 0.0, -mesh["gravity"]),
        ground=Ground() if mesh["ground"] else None,
        **settings,
    )
    solver = SolverFEM(model)
    solver.step(1 / 60)
    solver.reset()
    found: dict[str, list[float]] = {"heights": [], "wall": [], "processor": []}
    for _ in range(frames):
        wall, processor = time.perf_counter(), time.process_time()
        solver.step(1 / 60)
        found["processor"].append(1e3 * (time.process_time() - processor))
        found["wall"].append(1e3 * (time.perf_counter() - wall))
        found["heights"].append(float(solver.positions[mesh["tip"], 2].mean()))
        assert solver.diagnostics().converged
    return found


def theirs(python: str, peer: str, mesh: dict[str, Any], **settings: int) -> dict[str, list[float]]:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "mesh.npz"
        np.savez(path, **mesh)
        script = Path(__file__).with_name("fem_peers.py")
        command = [str(Path(python).absolute()), str(script), peer, str(path), json.dumps(settings)]
        ran = subprocess.run(command, capture_output=True, text=True, check=False, cwd=folder)
    if ran.returncode:
        raise SystemExit(f"{peer} failed:\n{ran.stderr[-2000:]}")
    return json.loads(ran.stdout.strip().splitlines()[-1])  # type: ignore[no-any-return]


def centre(heights: list[float]) -> float:
    """What a damped oscillation y[n+2] = a y[n+1] + b y[n] + c swings about, least squares."""
    y = np.asarray(heights)
    rows = np.stack([y[1:-1], y[:-2], np.ones(len(y) - 2)], axis=1)
    a, b, c = np.linalg.lstsq(rows - np.array([y[0], y[0], 0.0]), y[2:] - y[0], rcond=None)[0]
    return float(y[0] + c / (1.0 - a - b))


def equal_accuracy(
    python: str, peer: str, young: float, droop: float, frames: int
) -> tuple[int, float, bool]:
    """Iterations at which a peer's droop is right, that droop over the right one, and whether it ever is."""
    mesh, (_, substeps, ladder) = beam(young), PEERS[peer]
    rest = float(mesh["vertices"][mesh["tip"], 2].mean())
    ratio = np.inf
    for iterations in ladder:
        run = theirs(python, peer, mesh, frames=frames, substeps=substeps, iterations=iterations)
        ratio = (rest - centre(run["heights"])) / droop
        if abs(ratio - 1.0) <= TOLERANCE:
            return iterations, ratio, True
    return ladder[-1], ratio, False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--python", required=True, help="Python of a virtual environment with the peers")
    parser.add_argument("--peers", nargs="+", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--cells", type=int, default=9, help="cells along an edge of the box; 6 n^3 tets")
    parser.add_argument("--young", type=float, nargs="+", default=[1e5, 1e6, 1e7])
    parser.add_argument("--frames", type=int, default=60)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    devices.set_thread_count(options.threads)
    print(f"{machine()}\n")
    print("| tets | E, Pa | solver | substeps × iterations | droop | ms/frame mean | median | CPU | ratio |")
    print("|---" * 9 + "|")
    for young in options.young:
        mesh = box(options.cells, young)
        still = beam(young)
        rest = float(still["vertices"][still["tip"], 2].mean())
        droop = rest - ours(still, 1, integrator="quasi-static")["heights"][-1]
        swing = (rest - centre(ours(still, options.frames)["heights"])) / droop
        run = ours(mesh, options.frames)
        own = float(np.mean(run["processor"]))
        head = f"| {len(mesh['tets']):,} | {young:.0e}"

        def row(
            head: str, name: str, how: str, ratio: float, run: dict[str, list[float]], own: float
        ) -> None:
            wall, processor = run["wall"], float(np.mean(run["processor"]))
            print(
                f"{head} | {name} | {how} | {ratio:.3f} | {np.mean(wall):.0f} | {np.median(wall):.0f} "
                f"| {processor:.0f} | {processor / own:.1f} |",
                flush=True,
            )

        row(head, "this library", "2 × converged", swing, run, own)
        for peer in options.peers:
            name, substeps, _ = PEERS[peer]
            iterations, ratio, right = equal_accuracy(options.python, peer, young, droop, options.frames)
            frames = options.frames
            run = theirs(options.python, peer, mesh, frames=frames, substeps=substeps, iterations=iterations)
            how = f"{substeps} × {iterations}" + ("" if right else " (not within 2 %)")
            row(head, name, how, ratio, run, own)


if __name__ == "__main__":
    main()
