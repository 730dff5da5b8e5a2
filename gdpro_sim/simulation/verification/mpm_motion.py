"""MPM without contact: mass, momenta, transfers, substeps, reproducibility."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim import device as devices
from gdpro_sim.kernels import particles as rows
from gdpro_sim.simulation.model import Diagnostics, Ground
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.verification.framework import (
    Check,
    absolute,
    at_least,
    at_most,
    problem,
    relative,
)
from gdpro_sim.simulation.verification.mpm_models import (
    box,
    field,
    jittered,
    make_model,
    mechanical_energy,
    spinning,
)

KERNELS = ("quadratic", "cubic")
JELLY: dict[str, Any] = {"young": 1e5, "poisson": 0.3, "density": 1000.0}
NOTHING: dict[str, Any] = {"young": 1e-6, "poisson": 0.0, "density": 1000.0}
"""So soft that its stress moves nothing."""

TURN = np.array([[0.0, -5.0, 0.0], [5.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
"""Velocity gradient of a rigid turn about z at 5 rad/s."""


@problem(
    "mass",
    title="The grid holds the particles' mass, wherever they lie between its nodes",
    source="B-splines sum to one (Steffen, Kirby & Berzins 2008)",
)
def mass() -> Iterator[Check]:
    points = jittered(box((0.6, 0.5, 0.4), 0.025, (-0.3, -0.31, 7.9)), 0.0125)
    for kernel in KERNELS:
        solver = SolverMPM(make_model(points, JELLY, dx=0.05, kernel=kernel))
        total, kept = field(solver, rows.MASS).sum(), []
        yield relative(f"{kernel}: particles", 1000.0 * 0.6 * 0.5 * 0.4, total, 1e-6, "kg")
        for _ in range(3):
            solver.step(1e-3)
            kept.append(solver.grid.values.numpy()[:, 3].sum(dtype=np.float64))
        yield relative(f"{kernel}: nodes", total, kept[-1], 1e-6, "kg")


@problem(
    "free-fall",
    title="A block falls freely: velocity, path and momentum; it stays as it was",
    source="v = -g t; path of symplectic Euler in n substeps: g t^2 (1 + 1 / n) / 2",
)
def free_fall() -> Iterator[Check]:
    points = box((0.4, 0.4, 0.4), 0.05, (0.0, 0.0, 3.0))
    for kernel, transfer in (("quadratic", "apic"), ("cubic", "apic"), ("quadratic", "flip")):
        model = make_model(points, JELLY, dx=0.1, gravity=(0.0, 0.0, -9.81), kernel=kernel, transfer=transfer)
        solver, label, duration, substeps = SolverMPM(model), f"{kernel}, {transfer}", 0.5, 0
        for _ in range(30):
            solver.step(duration / 30)
            substeps += solver.diagnostics().substeps
        off = np.abs(solver.velocities - [0.0, 0.0, -9.81 * duration]).max()
        yield at_most(f"{label}: velocity off by, / g t", 2e-5, off / (9.81 * duration))
        momentum = solver.diagnostics().momentum[2]
        yield relative(f"{label}: momentum", -64.0 * 9.81 * duration, momentum, 1e-5, "kg m/s")
        fallen = (points.positions - solver.positions)[:, 2]
        path = 0.5 * 9.81 * duration**2
        low, high = fallen.min() / path - 1.0, fallen.max() / path - 1.0
        # Substeps shorten as it speeds up.
        yield at_least(f"{label}: shortest path / (g t^2 / 2) - 1", -1e-5, low)
        yield at_most(f"{label}: longest, with 2 / substeps of it", 2.0 / substeps, high)
        yield at_most(f"{label}: strain", 1e-4, np.abs(solver.deformations - np.eye(3)).max())


@problem(
    "patch",
    title="An affine velocity field goes to the grid and back unchanged; strains follow it",
    source="Jiang et al. 2015, sec. 5.3; F = 1 + h C",
)
def patch() -> Iterator[Check]:
    points = jittered(box((0.5, 0.4, 0.3), 0.04, (-0.2, 0.1, -0.3)), 0.02)
    gradient = np.array([[0.3, -2.0, 0.5], [1.5, 0.2, -0.7], [-0.4, 0.9, -0.6]])
    velocities = points.positions @ gradient.T + [0.4, -0.3, 0.2]
    for kernel in KERNELS:
        solver = SolverMPM(
            make_model(points, NOTHING, dx=0.08, velocities=velocities, gradients=gradient, kernel=kernel)
        )
        solver.step(1e-3)
        C = field(solver, rows.AFFINE, 9).reshape(-1, 3, 3)
        F = solver.deformations.astype(np.float64)
        yield at_least(f"{kernel}: one substep", -1.0, -solver.diagnostics().substeps)
        yield at_most(
            f"{kernel}: velocities off by", 3e-6, np.abs(solver.velocities - velocities).max(), "m/s"
        )
        yield at_most(f"{kernel}: gradients off by", 2e-5, np.abs(C - gradient).max(), "1/s")
        yield at_most(f"{kernel}: F off by", 2e-7, np.abs(F - np.eye(3) - 1e-3 * gradient).max())


def _change(before: Any, after: Any) -> float:
    p, q = np.asarray(before), np.asarray(after)
    return float(np.linalg.norm(q - p) / np.linalg.norm(p))


def _thousand(solver: SolverMPM) -> tuple[Diagnostics, Diagnostics, list[float]]:
    """Diagnostics before and after 1000 substeps and more, mechanical energy after each step, J."""
    before, energies, substeps = solver.diagnostics(), [mechanical_energy(solver)], 0
    while substeps < 1000:
        solver.step(1 / 60)
        substeps += solver.diagnostics().substeps
        energies.append(mechanical_energy(solver))
    return before, solver.diagnostics(), energies


@problem(
    "momenta",
    title="A block that spins and flies: linear and angular momentum over 1000 substeps, affine part counted",
    source="Jiang et al. 2015, supplement: APIC keeps both; here to float32 round-off",
)
def momenta() -> Iterator[Check]:
    points = jittered(box((0.4, 0.4, 0.4), 0.05, (0.3, -0.2, 0.1)), 0.01)
    velocities = spinning(points, (0.0, 0.0, 5.0)) + np.array([1.0, -0.5, 0.25])
    for kernel, bound in (("quadratic", 1e-5), ("cubic", 1e-4)):
        solver = SolverMPM(
            make_model(points, JELLY, dx=0.1, velocities=velocities, gradients=TURN, kernel=kernel)
        )
        before, after, energies = _thousand(solver)
        yield at_most(f"{kernel}: change of momentum", bound, _change(before.momentum, after.momentum))
        change = _change(before.angular_momentum, after.angular_momentum)
        yield at_most(f"{kernel}: change of angular momentum", bound, change)
        yield relative(f"{kernel}: energy left", 1.0, energies[-1] / energies[0], 5e-3)


@problem(
    "transfers",
    title="A spinning block and a wobbling one under APIC, PIC and FLIP",
    source="rigid turn under PIC: x I / (I + 2 M D) a substep, as the grid counts D; Fei et al. 2021",
)
def transfers() -> Iterator[Check]:
    points = box((0.5, 0.5, 0.5), 0.05)
    turning = spinning(points, (0.0, 0.0, 5.0))
    arms = points.positions - 0.25
    for transfer in ("apic", "flip", "pic"):
        gradients = None if transfer == "pic" else TURN
        solver = SolverMPM(
            make_model(points, JELLY, dx=0.1, velocities=turning, gradients=gradients, transfer=transfer)
        )
        spin, steps = _spin(solver), 0
        while steps < 20:
            solver.step(1e-3)
            steps += solver.diagnostics().substeps
        kept = _spin(solver) / spin
        if transfer == "pic":
            moment = 2.0 * float(np.var(points.positions[:, 0]))
            expected = math.log1p(2.0 * solver.grid.inertia / moment)
            yield relative("pic: log of the spin lost in a substep", expected, -math.log(kept) / steps, 0.15)
        else:
            yield absolute(f"{transfer}: spin left after {steps} substeps", 1.0, kept, 1e-2)
    left = {}
    for transfer in ("apic", "flip", "pic"):
        wobble = 3.0 * np.sin(2 * np.pi * arms[:, [2, 0, 1]])
        solver = SolverMPM(make_model(points, JELLY, dx=0.1, velocities=wobble, transfer=transfer))
        solver.step(1e-4)
        begin = mechanical_energy(solver)
        for _ in range(6):
            solver.step(1 / 60)
        left[transfer] = mechanical_energy(solver) / begin
    yield at_most("wobble: energy kept by PIC / by APIC", 0.9, left["pic"] / left["apic"])
    yield at_least("wobble: energy kept by FLIP / by APIC", 1.0, left["flip"] / left["apic"])
    yield at_most("wobble: energy kept by FLIP", 1.0, left["flip"])


def _spin(solver: SolverMPM) -> float:
    """Angular momentum about z and the centre of mass, kg m^2/s; velocity gradients count."""
    d, mass = solver.diagnostics(), field(solver, rows.MASS)[:, 0]
    centre = np.average(solver.positions, axis=0, weights=mass)
    return float((np.array(d.angular_momentum) - np.cross(centre, d.momentum))[2])


@problem(
    "no-work",
    title="A wobbling, spinning block never gains energy",
    source="APIC dissipates, elastic forces derive from an energy; symplectic Euler swings by O(h)",
)
def no_work() -> Iterator[Check]:
    points = box((0.4, 0.4, 0.4), 0.05)
    arms = points.positions - 0.2
    velocities = spinning(points, (0.0, 0.0, 5.0)) + 4.0 * arms * [1.0, -1.0, 0.5]
    gradient = TURN + np.diag([4.0, -4.0, 2.0])
    for law, cfl in (
        ("stable_neo_hookean", 0.3),
        ("stable_neo_hookean", 0.075),
        ("neo_hookean", 0.3),
        ("corotated", 0.3),
        ("stvk_hencky", 0.3),
    ):
        material = {**JELLY, "young": 2e4, "model": law}
        solver = SolverMPM(
            make_model(points, material, dx=0.1, velocities=velocities, gradients=gradient, cfl=cfl)
        )
        energies = [mechanical_energy(solver)]
        for _ in range(60):
            solver.step(1 / 120)
            energies.append(mechanical_energy(solver))
        label = f"{law}, cfl {cfl:g}"
        highest = max(energies) / energies[0] - 1.0
        yield at_most(f"{label}: largest rise above the start", 0.1 * cfl, highest)
        late, early = np.mean(energies[30:]), np.mean(energies[:30])
        yield at_most(f"{label}: mean energy, second half / first", 1.0, float(late / early))


@problem(
    "substeps",
    title="A step of any length is cut to what sound and particles allow",
    source="Courant, Friedrichs & Lewy 1928: h <= cfl dx / (c + |v|), c^2 = (lambda + 2 mu) / rho",
)
def substeps() -> Iterator[Check]:
    points = box((0.4, 0.4, 0.4), 0.05)
    for young, speed, cfl in ((1e5, 0.0, 0.3), (4e5, 0.0, 0.3), (1e5, 20.0, 0.3), (1e5, 0.0, 0.15)):
        velocities = np.tile([speed, 0.0, 0.0], (len(points), 1))
        material = {**JELLY, "young": young}
        solver = SolverMPM(make_model(points, material, dx=0.1, velocities=velocities, cfl=cfl))
        solver.step(1 / 24)
        sound = math.sqrt(young * 0.7 / (1.3 * 0.4) / 1000.0)
        expected = math.ceil((sound + speed) / (24 * cfl * 0.1))
        quantity = f"substeps in 1/24 s, E = {young:.0e} Pa, v = {speed:g} m/s, cfl {cfl:g}"
        yield absolute(quantity, expected, solver.diagnostics().substeps, 1.0)
    arms = points.positions - 0.2
    ends = []
    for dt in (1 / 10, 1 / 1000):
        solver = SolverMPM(make_model(points, JELLY, dx=0.1, velocities=4.0 * arms * [1.0, -1.0, 0.5]))
        begin = mechanical_energy(solver)
        for _ in range(round(0.2 / dt)):
            solver.step(dt)
        ends.append(solver.positions)
        quantity = f"energy left in steps of {dt:g} s"
        yield at_most(quantity, 1.0, mechanical_energy(solver) / begin)
    off = np.abs(ends[0] - ends[1]).max() / 0.4
    yield at_most("places after 0.2 s in steps of 0.1 s and 0.001 s differ by, / size", 1e-2, off)


@problem(
    "same-bytes",
    title="The same drop gives the same bytes again, on 1, 2 and 8 threads, and after a restart",
    source="sums run in an order of the problem's own (DESIGN.md)",
)
def same_bytes() -> Iterator[Check]:
    points = jittered(box((0.5, 0.5, 0.5), 0.03, (0.0, 0.0, 0.02)), 0.01)
    velocities = np.tile([1.0, 0.0, -3.0], (len(points), 1))
    material = {"young": 1e5, "poisson": 0.4, "density": 1000.0, "yield_stress": 5e3}
    for kernel, transfer in (("quadratic", "apic"), ("cubic", "flip")):
        model = make_model(
            points,
            material,
            dx=0.06,
            velocities=velocities,
            gravity=(0.0, 0.0, -9.81),
            ground=Ground(),
            kernel=kernel,
            transfer=transfer,
        )
        frames, before, digests = 4, devices.thread_count(), []
        try:
            for threads in (1, 2, 8, 1):
                devices.set_thread_count(threads)
                solver = SolverMPM(model)
                for _ in range(frames):
                    solver.step(1 / 120)
                digests.append(_digest(solver))
        finally:
            devices.set_thread_count(before)
        solver = SolverMPM(model)
        for frame in range(frames):
            if frame == 2:
                kept = solver.state_dict()
                solver = SolverMPM(model)
                solver.load_state_dict(kept)
            solver.step(1 / 120)
        label = f"{kernel}, {transfer}"
        lowest = float(solver.positions[:, 2].min())
        yield at_least(f"{label}: lowest particle, the ground holds it", -0.06, lowest, "m")
        yield at_most(f"{label}: different states over 1, 2, 8 and 1 threads", 1, len(set(digests)))
        others = len({_digest(solver)} - set(digests))
        yield at_most(f"{label}: states other than these after a restart", 0, others)


def _digest(solver: SolverMPM) -> str:
    state = hashlib.sha256()
    for name, array in sorted(solver.state_dict().items()):
        state.update(name.encode() + array.tobytes())
    return state.hexdigest()


PROBLEMS = (mass, free_fall, patch, momenta, transfers, no_work, substeps, same_bytes)

__all__ = ["PROBLEMS"]
