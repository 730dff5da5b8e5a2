"""Elastic and plastic bodies under MPM: vibration, rotation, impact, compression, and against FEM."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim.kernels import particles as rows
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.verification import models
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
    cauchy_stress,
    disc,
    field,
    join,
    lattice,
    make_model,
    mechanical_energy,
    plate,
)
from gdpro_sim.simulation.verification.probe import order

YOUNG, DENSITY = 1e6, 1000.0
SOUND = math.sqrt(YOUNG / DENSITY)
"""Of waves along a thin bar, m/s."""


PERIOD = 4.0 / SOUND
"""Of a free-fixed bar of 1 m, s."""


def _bar(cells: int, **settings: Any) -> tuple[SolverMPM, np.ndarray]:
    """A bar of 1 m, `cells` cells long, in its first axial mode, and the shape [N] of that.

    Its middle plane is held by symmetry: it is a free-fixed bar and its mirror image.
    """
    dx = 1.0 / cells
    points = lattice((2.0, dx, dx), (4 * cells, 2, 2), (-1.0, 0.0, 0.0))
    angle = 0.5 * np.pi * points.positions[:, 0]
    speed = 1e-3 * SOUND
    velocities, gradients = np.zeros((len(points), 3)), np.zeros((len(points), 3, 3))
    velocities[:, 0] = speed * np.sin(angle)
    gradients[:, 0, 0] = speed * 0.5 * np.pi * np.cos(angle)
    material = {"young": YOUNG, "poisson": 0.0, "density": DENSITY, "model": "corotated"}
    model = make_model(points, material, dx=dx, velocities=velocities, gradients=gradients, **settings)
    return SolverMPM(model), np.sin(angle)


def _bar_vibration(cells: int, kernel: str) -> tuple[float, float]:
    """(period / its value, amplitude after two periods / before)."""
    solver, mode = _bar(cells, kernel=kernel)
    times, found = [0.0], [float(mode @ solver.velocities[:, 0].astype(np.float64))]
    while solver.time < 2.02 * PERIOD:
        solver.step(PERIOD / 48)
        times.append(solver.time)
        found.append(float(mode @ solver.velocities[:, 0].astype(np.float64)))
    a, t = np.array(found), np.array(times)
    k = np.flatnonzero(np.sign(a[1:]) != np.sign(a[:-1]))
    zeros = t[k] - a[k] * (t[k + 1] - t[k]) / (a[k + 1] - a[k])
    return 2.0 * float(np.diff(zeros).mean()) / PERIOD, float(np.abs(a[t > 1.5 * PERIOD]).max() / a[0])


@problem(
    "vibration",
    title="A free-fixed bar vibrates along its axis: period, damping, convergence in grid size",
    source="4 L sqrt(rho / E); second order in space (Steffen, Kirby & Berzins 2008)",
)
def vibration() -> Iterator[Check]:
    errors = []
    for cells, bound in ((10, 5e-3), (20, 1.3e-3), (40, 4e-4)):
        period, amplitude = _bar_vibration(cells, "quadratic")
        errors.append(abs(period - 1.0))
        yield absolute(f"quadratic, {cells} cells: period / (4 L sqrt(rho / E))", 1.0, period, bound)
        yield absolute("  amplitude after two periods / before", 1.0, amplitude, 5e-3)
    yield at_least("order in grid size", 1.7, order([1 / 10, 1 / 20, 1 / 40], errors))
    period, _ = _bar_vibration(20, "cubic")
    yield absolute("cubic, 20 cells: period / (4 L sqrt(rho / E))", 1.0, period, 1.8e-3)


@problem(
    "implicit",
    title="The same bar in long implicit steps: energy lost in each",
    source="backward Euler: energy of a linear mode x 1 / (1 + w^2 dt^2) a step (Hairer & Wanner)",
)
def implicit() -> Iterator[Check]:
    tight = {"newton_tolerance": 1e-7, "cg_tolerance": 1e-6, "cfl": 10.0, "substeps": 1}
    for steps in (25, 50):
        solver, _ = _bar(10, integrator="implicit", **tight)
        begin = mechanical_energy(solver)
        for _ in range(steps // 2):
            solver.step(PERIOD / steps)
        kept = (mechanical_energy(solver) / begin) ** (1.0 / (steps // 2))
        expected = 1.0 / (1.0 + (2.0 * math.pi / steps) ** 2)
        yield relative(f"{steps} steps a period: energy lost in one", 1.0 - expected, 1.0 - kept, 3e-2)
        yield at_least("  converged", 1.0, float(solver.diagnostics().converged))


@problem(
    "rotating-disc",
    title="An elastic disc turns once: stress in its middle, growth, momentum, energy",
    source="Timoshenko & Goodier 1970, art. 32, plane stress: (3 + nu) / 8 rho w^2 R^2 in the middle",
)
def rotating_disc() -> Iterator[Check]:
    radius, poisson, young = 0.5, 0.3, 1e5
    dx = radius / 6
    rate = math.sqrt(0.02 * young / DENSITY) / radius
    points = disc(radius, dx)
    turn = np.array([[0.0, -rate, 0.0], [rate, 0.0, 0.0], [0.0, 0.0, 0.0]])
    material = {"young": young, "poisson": poisson, "density": DENSITY, "model": "stvk_hencky"}
    solver = SolverMPM(
        make_model(points, material, dx=dx, velocities=points.positions @ turn.T, gradients=turn)
    )
    r = np.hypot(*points.positions.T[:2])
    core, rim = r < 0.3 * radius, r > 0.8 * radius
    load = DENSITY * (rate * radius) ** 2
    expected = load / 8.0 * ((3.0 + poisson) - (1.0 + poisson) * (r[core] / radius) ** 2).mean()
    squares = (3.0 + poisson) - (1.0 + poisson) * (r[rim] / radius) ** 2
    growth = load / (8.0 * young) * (1.0 - poisson) * squares.mean()
    before, begin = solver.diagnostics(), mechanical_energy(solver)
    stress, grown, energies = [], [], []
    for _ in range(60):
        solver.step(2.0 * math.pi / rate / 60)
        mean = cauchy_stress(solver)[core].mean(axis=0)
        stress.append(0.5 * (mean[0, 0] + mean[1, 1]))
        away = solver.positions - solver.positions.mean(axis=0)
        grown.append((np.hypot(*away.T[:2]) / r)[rim].mean() - 1.0)
        energies.append(mechanical_energy(solver) / begin)
    # It begins unstrained and swings about where it would rest.
    yield relative("mean stress in the middle / (rho w^2 R^2)", expected / load, np.mean(stress) / load, 5e-2)
    yield relative("mean growth of the radius near the rim", growth, float(np.mean(grown)), 5e-2)
    spin = solver.diagnostics().angular_momentum[2] / before.angular_momentum[2]
    yield absolute("angular momentum after a turn / before", 1.0, spin, 1e-4)
    yield absolute("energy after a turn / before", 1.0, energies[-1], 1e-2)
    yield at_most("largest energy / before", 1.001, max(energies))


def _collision(cells: int, transfer: str) -> tuple[float, float, float, float]:
    """Of two discs that meet: energy left, largest energy, momentum lost / one's, speed after / before."""
    radius, speed = 0.2, 0.1
    dx = 2.0 * radius / cells
    one = disc(radius, dx)
    points = join(one.moved((0.3, 0.3, 0.0)), one.moved((0.7, 0.7, 0.0)))
    velocities = np.zeros((len(points), 3))
    velocities[: len(one), :2], velocities[len(one) :, :2] = speed, -speed
    material = {"young": 1e3, "poisson": 0.3, "density": DENSITY, "model": "neo_hookean"}
    solver = SolverMPM(make_model(points, material, dx=dx, velocities=velocities, transfer=transfer))
    begin, energies = mechanical_energy(solver), []
    for _ in range(28):
        solver.step(0.1)
        energies.append(mechanical_energy(solver) / begin)
    own = DENSITY * one.volumes.sum() * speed * math.sqrt(2.0)
    lost = float(np.linalg.norm(solver.diagnostics().momentum)) / own
    back = -float(solver.velocities[: len(one), :2].mean()) / speed
    return energies[-1], max(energies), lost, back


@problem(
    "colliding-discs",
    title="Two elastic discs collide and part: momentum, and nearly their energy",
    source="Sulsky, Chen & Schreyer 1994, sec. 5.1: E = 1000 Pa, nu = 0.3, rho = 1000, v = 0.1 (1, 1)",
)
def colliding_discs() -> Iterator[Check]:
    for cells, transfer, kept, rebound in ((10, "apic", 0.7, 0.8), (10, "flip", 0.75, 0.8)):
        left, largest, lost, back = _collision(cells, transfer)
        label = f"{transfer}, {cells} cells across"
        yield at_most(f"{label}: momentum of both / of one", 1e-5, lost)
        yield at_least(f"{label}: energy left", kept, left)
        yield at_most(f"{label}: largest energy / before", 1.001, largest)
        yield at_least(f"{label}: speed apart / before", rebound, back)


@problem(
    "colliding-discs-fine",
    title="The same with 20 cells across: the loss halves",
    source="Sulsky, Chen & Schreyer 1994, sec. 5.1",
    slow=True,
)
def colliding_discs_fine() -> Iterator[Check]:
    left, largest, lost, back = _collision(20, "apic")
    yield at_most("apic, 20 cells across: momentum of both / of one", 1e-5, lost)
    yield at_least("energy left", 0.85, left)
    yield at_most("largest energy / before", 1.001, largest)
    yield at_least("speed apart / before", 0.88, back)


@problem(
    "bounce",
    title="A bar falls flat on smooth ground and bounces: contact time, stress, speed",
    source="St Venant: stress rho c v, contact 2 L / c, rebound at v (Timoshenko & Goodier 1970, art. 161)",
)
def bounce() -> Iterator[Check]:
    for cells, kept in ((10, 0.85), (20, 0.92)):
        length, dx, speed = 1.0, 1.0 / cells, 0.01 * SOUND
        points = lattice((dx, dx, length), (2, 2, 2 * cells), (0.0, 0.0, 0.2 * dx))
        velocities = np.tile([0.0, 0.0, -speed], (len(points), 1))
        material = {
            "young": YOUNG,
            "poisson": 0.0,
            "density": DENSITY,
            "friction": 0.0,
            "model": "corotated",
        }
        solver = SolverMPM(make_model(points, material, dx=dx, velocities=velocities, ground=Ground()))
        contact, fall = 2.0 * length / SOUND, 0.2 * dx / speed
        t, p, low = [], [], []
        for _ in range(48):
            solver.step((fall + 1.4 * contact) / 48)
            t.append((solver.time - fall) / contact)
            p.append(solver.diagnostics().momentum[2] / (DENSITY * length * dx * dx * speed))
            low.append(solver.positions[:, 2].min() / dx)
        times, momentum = np.array(t), np.array(p)
        between = (momentum > -0.7) & (momentum < 0.4)
        slope, start = np.polyfit(times[between], momentum[between], 1)
        yield relative(f"{cells} cells: force / (rho c v A)", 1.0, slope / 2.0, 3e-2)
        yield absolute("  turns back after, of a contact time", 0.5, -start / slope, 2.5e-2)
        yield at_least("  speed after / before", kept, momentum[-1])
        yield at_most("  speed after / before", 1.0 + 1e-3, momentum[-1])
        yield absolute("  lowest particle, of half a spacing", 1.0, min(low) / 0.25, 5e-2)


@problem(
    "compression",
    title="A block between smooth plates is pressed past its yield stress",
    source="log strain = tau / E + (tau - limit) / H (Simo & Hughes 1998, sec. 1.2)",
)
def compression() -> Iterator[Check]:
    side, cells, speed = 0.4, 8, 0.5
    limit, hardening, dx = 2e4, 5e4, side / cells
    material = {
        "young": YOUNG,
        "poisson": 0.3,
        "density": DENSITY,
        "yield_stress": limit,
        "hardening": hardening,
        "friction": 0.0,
    }
    press = plate(side, up=False, speed=-speed, friction=0.0)
    model = make_model(box((side,) * 3, 0.5 * dx), material, dx=dx, ground=Ground(), colliders=(press,))
    solver = SolverMPM(model)
    shares, across, ratio = [], [], []
    for step in range(60):
        solver.step(0.002)
        if step < 24:
            continue
        stress = cauchy_stress(solver).mean(axis=0)
        strain = -math.log(1.0 - speed * solver.time / side)
        expected = YOUNG * (limit + hardening * strain) / (YOUNG + hardening)
        volume = np.linalg.det(solver.deformations.astype(np.float64)).mean()
        shares.append(-stress[2, 2] * volume / expected)
        across.append(stress[0, 0] / limit)
        ratio.append(volume)
    yield relative(
        "axial stress / that of flow, mean from 6 to 16 % strain", 1.0, float(np.mean(shares)), 2e-2
    )
    yield absolute("stress across / limit", 0.0, float(np.mean(across)), 2e-2)
    squeezed = 1.0 - (1.0 - 2.0 * 0.3) * limit * 1.2 / YOUNG
    yield absolute("volume / before: flow keeps it", squeezed, float(np.mean(ratio)), 3e-3)
    yielded = field(solver, rows.INTERNAL)[:, 0].min()
    yield at_least("least plastic strain", 0.08, yielded)


SOFT: dict[str, Any] = {"young": 2e4, "poisson": 0.3, "density": DENSITY}
SIDE, DURATION, FRAMES = 0.4, 0.2, 40


def _swung_fem(cells: int, rate: np.ndarray) -> np.ndarray:
    """[FRAMES, 3, 3] m^2: second moments of a cube's mass over its mass, about its centre, under FEM."""
    vertices, tets = models.tet_box((cells,) * 3, (SIDE,) * 3)
    velocities = (vertices - SIDE / 2) @ rate.T
    solver = SolverFEM(
        models.make_model(
            vertices, tets, gravity=(0, 0, 0), velocities=velocities, integrator="explicit", **SOFT
        )
    )
    found = []
    for _ in range(FRAMES):
        solver.step(DURATION / FRAMES)
        corners = np.asarray(solver.positions, np.float64)[tets]
        corners -= corners.mean(axis=(0, 1))  # elements of one volume
        sums = corners.sum(axis=1)
        moments = np.einsum("tai,taj->ij", corners, corners) + sums.T @ sums
        found.append(moments / 20.0 / len(tets))
    return np.array(found)


def _swung_mpm(cells: int, rate: np.ndarray) -> np.ndarray:
    """The same under MPM; particles are parallelepipeds."""
    dx = SIDE / cells
    points = box((SIDE,) * 3, 0.5 * dx)
    velocities = (points.positions - SIDE / 2) @ rate.T
    solver = SolverMPM(make_model(points, SOFT, dx=dx, velocities=velocities, gradients=rate))
    found = []
    for _ in range(FRAMES):
        solver.step(DURATION / FRAMES)
        away = solver.positions - solver.positions.mean(axis=0)
        F = solver.deformations.astype(np.float64)
        own = (0.5 * dx) ** 2 / 12.0 * np.einsum("nij,nkj->ik", F, F)
        found.append((away.T @ away + own) / len(points))
    return np.array(found)


@problem(
    "against-fem",
    title="The same soft cube, stretched and sheared, under FEM and MPM",
    source="the FEM solver, explicit, 8 x 8 x 8 x 6 tets; stated tolerance: 7 % of the largest change",
)
def against_fem() -> Iterator[Check]:
    rate = np.array([[3.0, 2.0, 0.0], [0.0, -3.0, 0.0], [0.0, 0.0, 1.5]])
    fem = _swung_fem(8, rate)
    swing = np.abs(fem - SIDE**2 / 12.0 * np.eye(3)).max()
    yield at_least("largest change of the moments / moments", 0.2, swing / (SIDE**2 / 12.0))
    errors = []
    for cells in (6, 8):
        errors.append(float(np.abs(_swung_mpm(cells, rate) - fem).max() / swing))
    yield at_most("6 cells: moments differ over 0.2 s by, / largest change", 0.12, errors[0])
    yield at_most("8 cells: moments differ over 0.2 s by, / largest change", 0.07, errors[1])
    yield at_most("difference at 8 cells / at 6", 0.8, errors[1] / errors[0])


PROBLEMS = (
    vibration,
    implicit,
    rotating_disc,
    colliding_discs,
    colliding_discs_fine,
    bounce,
    compression,
    against_fem,
)

__all__ = ["PROBLEMS"]
