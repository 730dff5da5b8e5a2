"""Many MuJoCo simulations at once, frame by frame, on several threads.

Where nothing but keyframed controls is set between steps, MuJoCo's own threaded batch steps them; what needs
more (obstacles and pins that are moved, forces, callbacks) is stepped by `SolverMuJoCo`, a simulation a
thread. Both give the bytes of `SolverMuJoCo` alone, for any number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import mujoco
import numpy as np
from mujoco.batch import Batch

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo

Seen = Callable[[int, int], None]
"""Called with (simulation, frame) while that solver stands at that frame."""


def run_batch(
    solvers: Sequence[SolverMuJoCo], frames: int, dt: float, seen: Seen, *, threads: int = 1
) -> list[str | None]:
    """Run every solver from its start through `frames` frames, `dt` s apart, the first at 0 s.

    Solvers of one scene whose values differ. `seen` may be called from several threads, for different
    simulations. Returns for each why it ended early, None where it did not.
    """
    failures: list[str | None] = [None] * len(solvers)
    open_loop = [k for k, solver in enumerate(solvers) if solver.open_loop]
    for members in _groups(solvers, open_loop, dt):

        def seen_here(k: int, frame: int, members: list[int] = members) -> None:
            seen(members[k], frame)

        found = _run_together([solvers[k] for k in members], frames, dt, seen_here, threads)
        for k, failure in zip(members, found, strict=True):
            failures[k] = failure

    def run(k: int) -> None:
        failures[k] = _run_alone(solvers[k], frames, dt, lambda frame: seen(k, frame))

    with ThreadPoolExecutor(max_workers=threads) as pool:
        for future in [pool.submit(run, k) for k in range(len(solvers)) if k not in set(open_loop)]:
            future.result()
    return failures


def _run_alone(solver: SolverMuJoCo, frames: int, dt: float, seen: Callable[[int], None]) -> str | None:
    solver.reset()
    seen(0)
    for frame in range(1, frames):
        try:
            solver.step(dt)
        except SolverError as error:
            return str(error)
        seen(frame)
    return None


def _groups(solvers: Sequence[SolverMuJoCo], chosen: list[int], dt: float) -> list[list[int]]:
    """Those that one batch can hold: as many steps a frame, and the same arrays."""
    groups: list[tuple[int, Batch, list[int]]] = []
    for k in chosen:
        model, count = solvers[k].mjmodel, solvers[k].substeps(dt)
        model.opt.timestep = dt / count
        for steps, probe, members in groups:
            if steps == count and _fits(probe, model):
                members.append(k)
                break
        else:
            groups.append((count, Batch(model, 1, 1), [k]))
    return [members for _, _, members in groups]


def _fits(probe: Batch, model: mujoco.MjModel) -> bool:
    try:
        probe.set_models([model])
    except mujoco.FatalError:  # its data have another layout
        return False
    return True


def _run_together(
    solvers: list[SolverMuJoCo], frames: int, dt: float, seen: Seen, threads: int
) -> list[str | None]:
    """`run_batch` of solvers that one batch can hold."""
    failures: list[str | None] = [None] * len(solvers)
    batch = Batch(solvers[0].mjmodel, len(solvers), min(threads, len(solvers)))
    batch.set_models([solver.mjmodel for solver in solvers])
    for k, solver in enumerate(solvers):
        solver.reset()
        batch.state[k] = solver.state_dict()["mujoco"]
        seen(k, 0)
    count = solvers[0].substeps(dt)
    times, controls = batch.bind("time"), batch.bind("ctrl")
    going = list(range(len(solvers)))
    for frame in range(1, frames):
        begins = times.copy()
        told = [_told(solvers[k], controls[k], begins[k] + np.arange(count) * dt / count) for k in going]
        batch.rollout(count, np.stack(told), record=(), ids=np.array(going))
        for k in list(going):
            if times[k] == np.add.accumulate([begins[k], *[dt / count] * count])[-1]:
                controls[k] = _told(solvers[k], controls[k], begins[k : k + 1] + dt)[0]
                counted = np.array([count, 0.0, 1.0, 0.0])
                solvers[k].load_state_dict({"mujoco": batch.state[k], "count": counted})
            else:  # stopped at a warning; the solver, a frame behind, knows which are harmless
                try:
                    solvers[k].step(dt)
                except SolverError as error:
                    failures[k] = str(error)
                    going.remove(k)
                    continue
                batch.state[k] = solvers[k].state_dict()["mujoco"]
            seen(k, frame)
        if not going:
            break
    return failures


def _told(solver: SolverMuJoCo, held: np.ndarray, times: np.ndarray) -> np.ndarray:
    """What actuators are told at times [n] in s, [n, nu]: keyframes, and `held` [nu] where there are none."""
    assert solver.model.mujoco is not None
    told = np.tile(held, (len(times), 1))
    for control in solver.model.mujoco.controls:
        number = solver.mjmodel.actuator(control.actuator).id
        told[:, number] = np.interp(times, control.times, control.values)
    return told


__all__ = ["Seen", "run_batch"]
