"""FEM under rough handling: bad elements, extreme constants, extreme steps, long runs."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.verification.framework import Check, at_least, at_most, problem
from gdpro_sim.simulation.verification.models import make_model, tet_box
from gdpro_sim.simulation.verification.probe import start, total_energy

SIZE = 0.5


class _Watch:
    """Steps a solver and keeps the worst of what it reports."""

    def __init__(self, solver: SolverFEM) -> None:
        self.solver = solver
        self.unconverged, self.smallest_ratio, self.touched = 0, np.inf, False
        self._energy = total_energy(solver)
        d = solver.diagnostics()
        self._scale = max(d.kinetic_energy, abs(d.gravity_energy), 1e-30)
        self.rise = -np.inf

    def step(self, dt: float, steps: int) -> None:
        for _ in range(steps):
            self.solver.step(dt)
            d, energy = self.solver.diagnostics(), total_energy(self.solver)
            self.unconverged += not d.converged
            self.touched |= d.contacts > 0
            self.smallest_ratio = min(self.smallest_ratio, d.min_volume_ratio)
            self.rise = max(self.rise, (energy - self._energy) / self._scale)
            self._energy = energy

    def checks(self, label: str, rise: float = 1e-9) -> Iterator[Check]:
        yield at_most(f"{label}: steps that did not converge", 0, self.unconverged)
        yield at_least(f"{label}: smallest volume ratio", 1e-6, self.smallest_ratio)
        yield at_most(f"{label}: largest rise of energy in a step / energy", rise, self.rise)


def _dropped(cells: int = 3, height: float = 0.02, **options: Any) -> SolverFEM:
    """A cube that falls on the ground at 1 m/s, spinning a little."""
    vertices, tets = tet_box((cells,) * 3, (SIZE,) * 3, (0.0, 0.0, height))
    spin = np.cross([0.5, 1.0, 0.2], vertices - vertices.mean(axis=0))
    return SolverFEM(
        make_model(vertices, tets, velocities=spin - [0.0, 0.0, 1.0], ground=Ground(), **options)
    )


def _refusal(action: Any) -> float:
    """1 where it raises SolverError with a message, else 0."""
    try:
        action()
    except SolverError as error:
        return 1.0 if str(error) else 0.0
    return 0.0


@problem(
    "inverted",
    title="Elements inside out: refused at rest, refused or put right in motion, the state kept",
    source="det F > 0 (PHYSICS.md: inversion guard)",
)
def inverted() -> Iterator[Check]:
    vertices, tets = tet_box((2, 2, 2), (SIZE,) * 3)
    flipped = tets.copy()
    flipped[3] = flipped[3][[1, 0, 2, 3]]
    refused = _refusal(lambda: SolverFEM(make_model(vertices, flipped)))
    yield at_least("an element of negative volume at rest is refused", 1, refused)
    flat = vertices.copy()
    flat[:, 2] = 0.0
    refused = _refusal(lambda: SolverFEM(make_model(flat, tets)))
    yield at_least("elements without volume at rest are refused", 1, refused)

    middle = np.flatnonzero(np.all(np.isclose(vertices, SIZE / 2), axis=1))[0]
    pushed = vertices.copy()
    pushed[middle] += [0.0, 0.0, 0.75 * SIZE]
    solver = start(make_model(vertices, tets, gravity=(0, 0, 0)), pushed)
    ratio = solver.diagnostics().min_volume_ratio
    yield at_most("a vertex pushed out through its neighbours: smallest volume ratio", -0.1, ratio)
    before = solver.positions
    if _refusal(lambda: solver.step(1 / 60)):
        yield at_most("refused; moved by", 0.0, np.abs(solver.positions - before).max(), "m")
    else:
        for _ in range(30):
            solver.step(1 / 60)
        yield at_least("put right: volume ratio after 0.5 s", 0.1, solver.diagnostics().min_volume_ratio)


@problem(
    "degenerate",
    title="Tets of 1e-9 of their neighbours' volume among good ones",
    source="energy never rises without work; nothing inverts",
)
def degenerate() -> Iterator[Check]:
    vertices, tets = tet_box((3, 3, 3), (SIZE,) * 3)
    # A tet at the bottom gets a point just above its lowest face, z = 0, where float32 is fine.
    cut = int(np.flatnonzero((vertices[tets, 2] == 0.0).sum(axis=1) == 3)[0])
    tet = tets[cut]
    base, top = vertices[tet[vertices[tet, 2] == 0.0]].mean(axis=0), vertices[tet].max(axis=0)[2]
    point = len(vertices)
    corners = np.tile(tet, (4, 1))
    np.fill_diagonal(corners, point)
    mesh = np.concatenate([np.delete(tets, cut, axis=0), corners]).astype(np.int32)
    for ratio in (1e-3, 1e-6, 1e-9):
        points = np.vstack([vertices, base + np.array([0.0, 0.0, ratio * top])])
        fall = np.tile([0.0, 0.0, -1.0], (len(points), 1))
        watch = _Watch(SolverFEM(make_model(points, mesh, young=1e5, ground=Ground(-0.02), velocities=fall)))
        watch.step(1 / 60, 20)
        x = watch.solver.model.vertices.astype(np.float64)[mesh]
        volumes = np.linalg.det(x[:, 1:] - x[:, :1])
        label = f"volume ratio {volumes.min() / np.median(volumes):.1e}"
        yield at_least(f"{label}: touched the ground", 1, watch.touched)
        yield from watch.checks(label)


@problem(
    "stiffness-range",
    title="A cube falls on the ground, E from 1e3 to 1e11 Pa",
    source="energy never rises without work; nothing inverts",
)
def stiffness_range() -> Iterator[Check]:
    for young in (1e3, 1e5, 1e7, 1e9, 1e11):
        watch = _Watch(_dropped(young=young, rayleigh_stiffness=1e-4))
        watch.step(1 / 60, 20)
        yield at_least(f"E = {young:g} Pa: touched the ground", 1, watch.touched)
        # A stiff body's energy is a sum of terms of the size of E V: round-off of 1e-16 of that is no work.
        yield from watch.checks(f"E = {young:g} Pa", 1e-9 + 1e-18 * young)


@problem(
    "mass-ratio",
    title="Densities 1e4 apart in one body and in neighbouring elements",
    source="energy never rises without work; nothing inverts",
)
def mass_ratio() -> Iterator[Check]:
    vertices, tets = tet_box((3, 3, 3), (SIZE,) * 3)
    top = vertices[tets, 2].min(axis=1) > SIZE / 2
    mixed = 10.0 ** np.random.default_rng(0).uniform(0.0, 4.0, len(tets))
    for label, density in (
        ("1e4 on top of 1", np.where(top, 1e4, 1.0)),
        ("1 on top of 1e4", np.where(top, 1.0, 1e4)),
        ("mixed from 1 to 1e4", mixed),
    ):
        watch = _Watch(_dropped(young=1e6, density=density))
        watch.step(1 / 60, 30)
        yield from watch.checks(f"{label} kg/m^3")


@problem(
    "step-range",
    title="A cube falls on the ground in steps of 1e-4 s to 1/24 s",
    source="energy never rises without work; nothing inverts",
)
def step_range() -> Iterator[Check]:
    for dt, steps in ((1e-4, 150), (1e-3, 40), (1 / 60, 30), (1 / 24, 24)):
        for young in (1e4, 1e7):
            watch = _Watch(_dropped(young=young, height=0.01))
            watch.step(dt, steps)
            label = f"dt = {dt:.3g} s, E = {young:g} Pa"
            yield at_least(f"{label}: touched the ground", 1, watch.touched)
            yield from watch.checks(label)


@problem(
    "long-run",
    title="10,000 frames of a cube that falls and comes to rest",
    source="at rest nothing moves: no creep, no drift, energy never rises",
    slow=True,
)
def long_run() -> Iterator[Check]:
    watch = _Watch(_dropped(2, young=1e5, rayleigh_stiffness=5e-3))
    watch.step(1 / 60, 1000)
    settled, energy = watch.solver.positions, total_energy(watch.solver)
    watch.step(1 / 60, 9000)
    yield from watch.checks("10,000 frames")
    moved = np.abs(watch.solver.positions - settled).max()
    yield at_most("moved in frames 1000 to 10,000", 1e-6 * SIZE, moved, "m")
    yield at_most("energy lost meanwhile / energy", 1e-6, (energy - total_energy(watch.solver)) / abs(energy))


PROBLEMS = (inverted, degenerate, stiffness_range, mass_ratio, step_range, long_run)

__all__ = ["PROBLEMS"]
