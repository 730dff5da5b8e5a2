"""Flexes in MuJoCo: masses, a cantilever beside our FEM and beam theory, energy, bodies at rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim.simulation.verification.beams import Beam
from gdpro_sim.simulation.verification.framework import Check, absolute, at_most, problem, relative
from gdpro_sim.simulation.verification.models import make_model, tet_box
from gdpro_sim.simulation.verification.mujoco_models import DENSITY, flex, world

FRAME = 1.0 / 30.0


def _cantilever(seconds: float, young: float, **options: Any) -> float:
    """Sag of the tip of a beam held at its end, m."""
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    vertices, tets = tet_box((10, 2, 2), (1.0, 0.2, 0.2))
    held = vertices[:, 0] < 1e-9
    body = flex(vertices, tets, young, 0.3, damping=0.01, pinned=held, **options)
    solver = SolverMuJoCo(world(body, timestep=2e-3))
    for _ in range(round(seconds / FRAME)):
        solver.step(FRAME)
    tip = vertices[:, 0] > 1.0 - 1e-9
    return float((vertices[tip, 2] - solver.vertices(0)[tip, 2]).mean())


@problem(
    "cantilever",
    title="a soft beam under its own weight",
    source="a full flex: our FEM on the same mesh; a quadratic grid: Timoshenko",
)
def cantilever() -> Iterator[Check]:
    from gdpro_sim.simulation.fem import SolverFEM

    vertices, tets = tet_box((10, 2, 2), (1.0, 0.2, 0.2))
    held = vertices[:, 0] < 1e-9
    same = make_model(
        vertices, tets, young=1e7, poisson=0.3, density=DENSITY, pinned=held, integrator="quasi-static",
        volumes="element",
    )  # fmt: skip
    solver = SolverFEM(same)
    solver.step(FRAME)
    tip = vertices[:, 0] > 1.0 - 1e-9
    sag = float((vertices[tip, 2] - solver.state_dict()["positions"][tip, 2]).mean())
    yield relative("full flex, 240 tets: sag", sag, _cantilever(2.0, 1e7), 0.01, "m")
    stiff = Beam(1.0, 0.2, 1e7, 0.3, DENSITY)
    found = _cantilever(2.0, 1e7, reduction="quadratic", cells=(5, 1, 1))
    yield relative("quadratic grid of 5 x 1 x 1 cells: sag", stiff.sag(), found, 0.05, "m")


@problem(
    "mass",
    title="masses of flexes, and their fall",
    source="a quarter of each tetrahedron's mass at its vertices; g t^2 / 2",
)
def mass() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    vertices, tets = tet_box((4, 2, 3), (0.4, 0.2, 0.3), (0.1, 0.2, 1.0))
    for kind, cells in (("full", (1, 1, 1)), ("trilinear", (2, 2, 2)), ("quadratic", (1, 1, 1))):
        body = flex(vertices, tets, 1e5, 0.3, reduction=kind, cells=cells, velocity=(1.0, 0.0, 0.0))
        solver = SolverMuJoCo(world(body, timestep=2e-3))
        yield relative(f"{kind}: mass", 24.0, float(solver.mjmodel.body_mass.sum()), 1e-9, "kg")
        yield relative(f"{kind}: momentum", 24.0, solver.diagnostics().momentum[0], 1e-9, "kg m/s")
        for _ in range(15):
            solver.step(FRAME)
        fallen = float((vertices - solver.vertices(0))[:, 2].mean())
        yield relative(f"{kind}: way fallen in 0.5 s", 0.5 * 9.81 * 0.25, fallen, 0.01, "m")


@problem(
    "soft-rest",
    title="a soft block settles on the ground, without drift and without gaining energy",
    source="nothing moves; energy never rises without work",
)
def soft_rest() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    vertices, tets = tet_box((4, 4, 4), (0.2, 0.2, 0.2), (-0.1, -0.1, 0.02))
    for kind, cells in (("full", (1, 1, 1)), ("trilinear", (2, 2, 2))):
        body = flex(vertices, tets, 1e5, 0.4, damping=2e-3, reduction=kind, cells=cells)
        solver = SolverMuJoCo(world(body, ground=True, timestep=2e-3))
        energies = []
        for _ in range(60):
            solver.step(FRAME)
            found = solver.diagnostics()
            energies.append(found.kinetic_energy + found.elastic_energy + found.gravity_energy)
        begin = solver.vertices(0).mean(axis=0)
        for _ in range(30):
            solver.step(FRAME)
        drift = solver.vertices(0).mean(axis=0) - begin
        rise = float(np.diff(energies).max()) / abs(energies[0])
        yield at_most(f"{kind}: drift in a second at rest", 1e-4, float(np.linalg.norm(drift)), "m")
        yield absolute(
            f"{kind}: largest rise of the energy in a frame, of its start", 0.0, max(rise, 0.0), 0.01
        )


PROBLEMS = (mass, cantilever, soft_rest)

__all__ = ["PROBLEMS"]
