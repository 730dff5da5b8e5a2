"""FEM in motion without contact: momenta, vibrations, energy, order in time, reproducibility."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.sparse import diags
from scipy.sparse.linalg import eigsh

from gdpro_sim import device as devices
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.verification.beams import Beam
from gdpro_sim.simulation.verification.framework import Check, absolute, at_least, at_most, problem, relative
from gdpro_sim.simulation.verification.models import make_model, tet_box
from gdpro_sim.simulation.verification.probe import TIGHT, Probe, order, start, total_energy

BEAM = Beam(length=1.0, side=0.2, young=1e7, poisson=0.0, density=1000.0)
"""The cantilever of PHYSICS.md without lateral contraction: its clamp holds back nothing, as in theory."""


@problem(
    "free-fall",
    title="A block falls freely: velocity, path and momentum",
    source="v = -g t, p = m v; path of backward Euler after n steps: g dt^2 n (n + 1) / 2",
)
def free_fall() -> Iterator[Check]:
    vertices, tets = tet_box((2, 2, 2), (0.5, 0.5, 0.5), (0.0, 0.0, 10.0))
    model = make_model(vertices, tets, young=1e5)
    mass = float(Probe(model).mass.sum())
    for rule, path in (
        ("backward-euler", 9.81 * (1 / 120) ** 2 * 60 * 61 / 2),
        ("midpoint", 9.81 * 0.5**2 / 2),
        ("bdf2", None),
    ):
        solver = SolverFEM(make_model(vertices, tets, young=1e5, integrator=rule))
        for _ in range(30):
            solver.step(1 / 60)
        off = np.abs(solver.velocities - [0.0, 0.0, -9.81 * 0.5]).max()
        yield at_most(f"{rule}: velocity after 0.5 s off by, / g t", 1e-11, off / (9.81 * 0.5))
        momentum = solver.diagnostics().momentum[2]
        yield relative(f"{rule}: momentum", -mass * 9.81 * 0.5, momentum, 1e-11, "kg m/s")
        if path is not None:
            fallen = (model.vertices - solver.positions)[:, 2]
            yield relative(f"{rule}: path, mean of the vertices", path, fallen.mean(), 1e-9, "m")


@problem(
    "momenta",
    title="A free block that spins and wobbles keeps its momenta",
    source="internal forces are pairwise; midpoint keeps angular momentum too (Simo & Tarnow 1992)",
)
def momenta() -> Iterator[Check]:
    vertices, tets = tet_box((3, 3, 3), (0.4, 0.4, 0.4))
    arms = vertices - 0.2
    velocities = np.cross([0.0, 0.0, 5.0], arms) + 2.0 * arms * [1.0, -1.0, 0.5] + [1.0, -0.5, 0.25]
    for rule, angular in (("backward-euler", None), ("bdf2", None), ("midpoint", 1e-10)):
        model = make_model(
            vertices, tets, young=1e5, velocities=velocities, gravity=(0, 0, 0), integrator=rule, **TIGHT
        )
        solver = SolverFEM(model)
        before = solver.diagnostics()
        for _ in range(60):
            solver.step(1 / 60)
        after = solver.diagnostics()
        p, q = np.array(before.momentum), np.array(after.momentum)
        yield at_most(f"{rule}: change of linear momentum in 1 s", 1e-10, _change(p, q))
        spin, left = _spin(model, before, model.vertices), _spin(model, after, solver.positions)
        if angular is None:
            # Backward differences slow a spin, they never speed it up.
            yield at_most(f"{rule}: spin / spin at the start", 1.0, left[2] / spin[2])
        else:
            yield at_most(f"{rule}: change of angular momentum in 1 s", angular, _change(spin, left))


def _change(before: np.ndarray, after: np.ndarray) -> float:
    return float(np.linalg.norm(after - before) / np.linalg.norm(before))


def _spin(model: Model, diagnostics: Any, x: np.ndarray) -> np.ndarray:
    """Angular momentum about the centre of mass, kg m^2/s."""
    centre = np.average(np.asarray(x, np.float64), axis=0, weights=Probe(model).mass)
    return np.array(diagnostics.angular_momentum) - np.cross(centre, diagnostics.momentum)


def _bending_modes(cells: int, count: int) -> tuple[Model, np.ndarray, np.ndarray]:
    """Model, angular frequencies rad/s and modes [count, P, 3] of the beam's bending in the z direction.

    From the solver's own stiffness matrix and lumped masses.
    """
    vertices, tets = tet_box((5 * cells, cells, cells), (BEAM.length, BEAM.side, BEAM.side))
    pinned = vertices[:, 0] == 0.0
    model = make_model(
        vertices,
        tets,
        young=BEAM.young,
        poisson=BEAM.poisson,
        density=BEAM.density,
        pinned=pinned,
        gravity=(0, 0, 0),
    )
    probe = Probe(model)
    free = np.flatnonzero(np.repeat(~pinned, 3))
    K = probe.stiffness(vertices).tocsc()[free][:, free]
    M = diags(np.repeat(probe.mass, 3)[free]).tocsc()
    values, vectors = eigsh(K, k=4 * count, M=M, sigma=0.0, v0=np.ones(len(free)))
    flat = np.zeros((4 * count, vertices.size))
    flat[:, free] = vectors.T
    modes = flat.reshape(4 * count, -1, 3)
    # The square section bends alike in two planes (any two); twist and stretch move less across.
    across = (probe.mass[None, :, None] * modes**2).sum(axis=1)
    bending = np.flatnonzero(across[:, 1] + across[:, 2] > 0.7 * across.sum(axis=1))
    centre = modes[:, np.isclose(vertices[:, 0], BEAM.length)].mean(axis=1)
    tip = np.linalg.norm(centre, axis=1)
    bending = bending[tip[bending] > 0.3 * tip[bending].max()][: 2 * count : 2]
    return model, np.sqrt(values[bending]), modes[bending]


@problem(
    "bending-frequencies",
    title="The first three bending frequencies of the cantilever",
    source="Timoshenko beam; eigenvalues of the mesh; midpoint turns w into w' with tan(w' dt/2) = w dt/2",
)
def bending_frequencies() -> Iterator[Check]:
    cells = [3, 4, 5]
    found = []
    for across in cells:
        model, omega, modes = _bending_modes(across, 3)
        found.append(omega / (2.0 * np.pi))
        if across == 3:
            yield from _ringing(model, omega, modes)
    theory = BEAM.frequencies(3)
    for k in range(3):
        # Stiffness, the square of a frequency, grows with the square of the cells' size.
        line = np.polyfit(1.0 / np.square(cells), [f[k] ** 2 for f in found], 1)
        quantity = f"mode {k + 1}, 3, 4 and 5 cells across, extrapolated"
        yield relative(quantity, theory[k], float(np.sqrt(line[1])), 0.015, "Hz")


def _ringing(model: Model, omega: np.ndarray, modes: np.ndarray) -> Iterator[Check]:
    """Frequencies at which the solver rings when it starts with the velocities of each mode."""
    probe = Probe(model)
    for k, (w, mode) in enumerate(zip(omega, modes, strict=True)):
        dt, steps = 2.0 * np.pi / w / 40, 100
        settings: dict[str, Any] = {
            "integrator": "midpoint",
            "substeps": 1,
            "newton_tolerance": 1e-6,
            "cg_tolerance": 1e-5,
        }
        speed = mode * (1e-3 * w / np.abs(mode).max())
        rings = make_model(
            model.vertices,
            model.tets,
            young=BEAM.young,
            poisson=BEAM.poisson,
            density=BEAM.density,
            pinned=model.pinned,
            gravity=(0, 0, 0),
            **settings,
        )
        solver = start(rings, velocities=speed)
        track = []
        for _ in range(steps):
            solver.step(dt)
            moved = solver.positions - model.vertices
            track.append(float((probe.mass[:, None] * moved * mode).sum()))
        signs = np.flatnonzero(np.diff(np.sign(track)) != 0)
        crossings = [i + track[i] / (track[i] - track[i + 1]) for i in signs]
        measured = 1.0 / (2.0 * dt * float(np.mean(np.diff(crossings))))
        expected = 2.0 / dt * np.arctan(0.5 * w * dt) / (2.0 * np.pi)
        quantity = f"mode {k + 1}, {len(model.tets)} tets in motion, eigenvalue of the mesh"
        yield relative(quantity, float(expected), measured, 0.002, "Hz")


def _one_mode(rule: str) -> tuple[SolverFEM, float]:
    """One vertex of one tet swings a little along z: the solver and its angular frequency, rad/s."""
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    tets, pinned = np.array([[0, 1, 2, 3]], np.int32), np.array([True, True, True, False])
    options: dict[str, Any] = {
        "young": 1e6,
        "pinned": pinned,
        "gravity": (0, 0, 0),
        "substeps": 1,
        "integrator": rule,
    }
    tight: dict[str, Any] = {"newton_tolerance": 1e-12, "cg_tolerance": 1e-12}
    velocities = np.zeros((4, 3))
    velocities[3, 2] = 1e-3
    model = make_model(vertices, tets, velocities=velocities, **options, **tight)
    probe = Probe(model)
    return SolverFEM(model), float(np.sqrt(probe.stiffness(vertices).toarray()[11, 11] / probe.mass[3]))


@problem(
    "energy",
    title="Energy of a linear mode under each integrator, w dt = 0.3",
    source="1 / (1 + w^2 dt^2) a step; |root of (3/2 - i w dt) z^2 - 2 z + 1/2|^2; 1 (Hairer & Wanner)",
)
def energy() -> Iterator[Check]:
    turn = 0.3
    bdf2 = float(np.abs(np.roots([1.5 - 1j * turn, -2.0, 0.5])).max() ** 2)
    ratios = {}
    for rule, steps in (("backward-euler", 40), ("bdf2", 60), ("midpoint", 200)):
        solver, w = _one_mode(rule)
        energies = [total_energy(solver)]
        for _ in range(steps):
            solver.step(turn / w)
            energies.append(total_energy(solver))
        ratios[rule] = (energies[-1] / energies[steps // 2]) ** (1.0 / (steps - steps // 2))
    expected = 1.0 / (1.0 + turn**2)
    yield relative("backward Euler: energy, ratio a step", expected, ratios["backward-euler"], 1e-4)
    yield relative("BDF2: energy, ratio a step", bdf2, ratios["bdf2"], 1e-4)
    yield relative("midpoint: energy, ratio a step", 1.0, ratios["midpoint"], 1e-6)

    solver, w = _one_mode("explicit")
    energies = []
    for _ in range(600):
        solver.step(turn / w)
        energies.append(total_energy(solver))
    early, late = np.mean(energies[:300]), np.mean(energies[300:])
    yield relative("explicit: mean energy, steps 301-600 / 1-300", 1.0, float(late / early), 5e-3)


@problem(
    "no-work",
    title="A wobbling, spinning, damped block never gains energy",
    source="backward Euler decreases the incremental potential (Martin et al. 2011); dissipation is >= 0",
)
def no_work() -> Iterator[Check]:
    vertices, tets = tet_box((3, 3, 3), (0.4, 0.4, 0.4))
    arms = vertices - 0.2
    velocities = np.cross([0.0, 0.0, 5.0], arms) + 4.0 * arms * [1.0, -1.0, 0.5]
    options: dict[str, Any] = {"young": 2e4, "velocities": velocities, "gravity": (0, 0, 0)}
    for rule in ("backward-euler", "bdf2", "midpoint"):
        for damping in (0.0, 2e-3):
            solver = SolverFEM(
                make_model(vertices, tets, integrator=rule, rayleigh_stiffness=damping, **options, **TIGHT)
            )
            energies = [total_energy(solver)]
            for _ in range(60):
                solver.step(1 / 120)
                energies.append(total_energy(solver))
            label = f"{rule}, damping {damping:g} s"
            if rule == "backward-euler":
                rise = np.diff(energies).max() / energies[0]
                yield at_most(f"{label}: largest rise in a step / energy", 0.0, rise)
            rise = (max(energies) - energies[0]) / energies[0]
            yield at_most(f"{label}: largest rise above the start", 2e-2 if rule == "midpoint" else 0.0, rise)
            if damping > 0.0:
                yield at_most(f"{label}: energy left / energy", 0.9, energies[-1] / energies[0])


@problem(
    "order-dt",
    title="Order in the step length: a soft cantilever swings by a third of its length",
    source="Hairer & Wanner: 1, 2, 2; symplectic Euler 1; exact: midpoint in short steps, extrapolated",
)
def order_dt() -> Iterator[Check]:
    vertices, tets = tet_box((4, 1, 1), (1.0, 0.25, 0.25))
    duration = 0.24

    def swung(rule: str, steps: int) -> np.ndarray:
        model = make_model(
            vertices,
            tets,
            young=5e4,
            pinned=vertices[:, 0] == 0.0,
            integrator=rule,
            substeps=1,
            newton_tolerance=1e-10,
            cg_tolerance=1e-9,
            newton_iterations=60,
        )
        solver = SolverFEM(model)
        for _ in range(steps):
            solver.step(duration / steps)
        return solver.positions

    exact = (4.0 * swung("midpoint", 192) - swung("midpoint", 96)) / 3.0
    yield at_least("swing of the tip", 0.25, np.abs(exact - vertices).max(), "m")
    for rule, expected, counts in (
        ("backward-euler", 1.0, (24, 48, 96)),
        ("bdf2", 2.0, (24, 48, 96)),
        ("midpoint", 2.0, (12, 24, 48)),
        ("explicit", 1.0, (512, 1024)),
    ):
        errors = [float(np.abs(swung(rule, n) - exact).max()) for n in counts]
        quantity = f"{rule}: order, {counts[0]} to {counts[-1]} steps"
        yield absolute(quantity, expected, order([duration / n for n in counts], errors), 0.15)


@problem(
    "same-bytes",
    title="The same drop gives the same bytes again, on 1, 2 and 3 threads, and after a restart",
    source="sums run in an order of the problem's own (DESIGN.md)",
)
def same_bytes() -> Iterator[Check]:
    vertices, tets = tet_box((8, 8, 8), (0.5,) * 3, (0.0, 0.0, 0.03))
    model = make_model(
        vertices,
        tets,
        young=1e5,
        poisson=0.4,
        rayleigh_stiffness=1e-3,
        velocities=np.tile([1.0, 0.0, -3.0], (len(vertices), 1)),
        ground=Ground(),
    )

    def digest(solver: SolverFEM) -> str:
        state = hashlib.sha256()
        for name, array in sorted(solver.state_dict().items()):
            state.update(name.encode() + array.tobytes())
        return state.hexdigest()

    frames, before, digests = 4, devices.thread_count(), []
    try:
        for threads in (1, 2, 3, 1):
            devices.set_thread_count(threads)
            solver = SolverFEM(model)
            for _ in range(frames):
                solver.step(1 / 60)
            digests.append(digest(solver))
    finally:
        devices.set_thread_count(before)
    solver = SolverFEM(model)
    for frame in range(frames):
        if frame == 2:
            kept = solver.state_dict()
            solver = SolverFEM(model)
            solver.load_state_dict(kept)
        solver.step(1 / 60)
    yield at_least("vertices in contact", 1, solver.diagnostics().contacts)
    yield at_most("different states over 1, 2, 3 and 1 threads", 1, len(set(digests)))
    yield at_most("states other than these after a restart", 0, len({digest(solver)} - set(digests)))


PROBLEMS = (free_fall, momenta, bending_frequencies, energy, no_work, order_dt, same_bytes)

__all__ = ["PROBLEMS"]
