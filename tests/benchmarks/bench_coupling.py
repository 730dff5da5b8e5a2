"""Momentum of a ball that falls on jelly, and how often solvers step until they agree.

    python -m tests.benchmarks.bench_coupling [--tables momentum rounds] [--json FILE]

momentum: a rigid ball of 1.8 kg (MuJoCo) falls 0.3 m on a jelly block of 8 kg at rest on the ground (FEM).
Vertical momenta of both, the impulses of the ground and of gravity until then, and what of the momentum has
no cause, as a share of the ball's largest.

rounds: balls of several densities fly at the block in free space, with several steps of the coupling.
"rounds" are how often the soft body was stepped in a step of the coupling, on average over the steps in
contact and at most; "momentum" is the largest change of the whole's momentum over all of it, "kept" the
energy after the impact over that before (implicit steps of the soft body damp), "seconds" of processor.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np

from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.verification.coupling_models import (
    ball,
    coupled,
    drop_on_jelly,
    jelly_block,
    total_energy,
    total_momentum,
)
from tests.benchmarks.machine import machine

DENSITIES = (20.0, 100.0, 1000.0, 8000.0)

STEPS = (0.001, 0.002, 0.004, 0.008)

DURATION = 0.16

SHOWN = 24
"""Lines of the table of momenta."""


def momentum_table() -> list[dict[str, float]]:
    lines = list(drop_on_jelly())
    largest = max(abs(line.ball) for line in lines)
    rows = [
        {
            "time": line.time, "ball": line.ball, "jelly": line.jelly, "ground": line.ground,
            "gravity": line.weight,
            "error_percent": 100.0 * (line.ball + line.jelly - line.balance) / largest,
        }
        for line in lines
    ]  # fmt: skip
    worst = max(abs(row["error_percent"]) for row in rows)
    print("| t, s | ball, kg m/s | jelly | sum | ground, N s | gravity | without a cause, % |")
    print("|---|---|---|---|---|---|---|")
    for row in rows[:: max(1, len(rows) // SHOWN)]:
        print(
            f"| {row['time']:.3f} | {row['ball']:.4f} | {row['jelly']:.4f} | "
            f"{row['ball'] + row['jelly']:.4f} | {row['ground']:.4f} | {row['gravity']:.4f} | "
            f"{row['error_percent']:.1e} |"
        )
    print(f"\nat most {worst:.1e} % of the ball's largest momentum, over {len(rows)} steps\n")
    return rows


def rounds_table() -> list[dict[str, float]]:
    print("| density | step, ms | rounds, mean | at most | not agreed | momentum | kept | seconds |")
    print("|---|---|---|---|---|---|---|---|")
    rows = []
    for density in DENSITIES:
        for step in STEPS:
            row = _flight(density, step)
            rows.append(row)
            print(
                f"| {density:g} | {1e3 * step:g} | {row['rounds_mean']:.2f} | {row['rounds_most']:.0f} | "
                f"{row['not_agreed']:.0f} | {row['momentum']:.1e} | {row['kept']:.2f} | "
                f"{row['seconds']:.1f} |",
                flush=True,
            )
    return rows


def _flight(density: float, step: float) -> dict[str, float]:
    block = jelly_block((5, 5, 5), (0.2, 0.2, 0.2), gravity=(0.0, 0.0, 0.0))
    solver = SolverCoupled(
        coupled(block, ball(0.06, density, (0.02, 0.0, 0.07), velocity=(0.2, 0.0, -1.0)), step=step)
    )
    before, energy = total_momentum(solver)[:3], total_energy(solver)
    rounds, missed, off = [], 0, 0.0
    begin = time.process_time()
    for _ in range(round(DURATION / step)):
        solver.step(step)
        if solver.diagnostics().contacts:
            rounds.append(solver.rounds)
        missed += not solver.diagnostics().converged
        change = total_momentum(solver)[:3] - before
        off = max(off, float(np.abs(change).max() / np.linalg.norm(before)))
    return {
        "density": density,
        "step": step,
        "rounds_mean": float(np.mean(rounds)),
        "rounds_most": float(max(rounds)),
        "not_agreed": float(missed),
        "momentum": off,
        "kept": total_energy(solver) / energy,
        "seconds": time.process_time() - begin,
    }


TABLES = {"momentum": momentum_table, "rounds": rounds_table}


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--tables", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    results = {name: TABLES[name]() for name in options.tables}
    if options.json is not None:
        options.json.write_text(json.dumps({"machine": machine(), **results}, indent=1))


if __name__ == "__main__":
    main()
