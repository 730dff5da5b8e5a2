"""Stiff bodies move as rigid bodies do, at the default (loose) tolerance of the conjugate gradients."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from tests.simulation.fem_models import make_model, tet_box

STEEL = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0}


@pytest.mark.parametrize("young", [1e9, 2.1e11])
def test_a_stiff_cube_falls_over_onto_its_face(young: float) -> None:
    vertices, tets = tet_box((3, 3, 3), (0.2, 0.2, 0.2), (-0.1, -0.1, -0.1))
    turned = Rotation.from_euler("xyz", [20, 30, 0], degrees=True).apply(vertices)
    turned[:, 2] += 0.05 - turned[:, 2].min()
    model = make_model(turned, tets, **{**STEEL, "young": young}, friction=0.35, ground=Ground())
    solver = SolverFEM(model)
    flat = 7850.0 * 0.2**3 * 9.81 * 0.1
    assert solver.diagnostics().gravity_energy > 1.5 * flat
    for _ in range(60):
        solver.step(1 / 60)
        assert solver.diagnostics().converged
    assert solver.diagnostics().gravity_energy == pytest.approx(flat, rel=0.01)
    assert solver.diagnostics().kinetic_energy < 1e-6


def test_a_stiff_body_in_flight_falls_and_spins() -> None:
    vertices, tets = tet_box((4, 2, 2), (0.2, 0.1, 0.1), (-0.1, -0.05, 5.0))
    centre = np.array([0.0, 0.0, 5.05])
    velocities = np.cross([0.0, 0.0, 6.0], vertices - centre)
    results = []
    for tolerance in (1e-2, 1e-9):
        model = make_model(vertices, tets, **STEEL, velocities=velocities, cg_tolerance=tolerance)
        solver = SolverFEM(model)
        for _ in range(10):
            solver.step(1 / 60)
        results.append(solver.diagnostics())
    loose, tight = results
    assert loose.converged
    mass = 7850.0 * 0.2 * 0.1 * 0.1
    assert loose.momentum[2] == pytest.approx(-mass * 9.81 * 10 / 60, rel=1e-5)
    # Newton stops at 1 mm/s, and the corners move at 0.6 m/s.
    assert loose.angular_momentum[2] == pytest.approx(tight.angular_momentum[2], rel=5e-3)
    start = SolverFEM(model).diagnostics().angular_momentum[2]
    assert 0.9 * start < loose.angular_momentum[2] < start  # backward Euler damps a spin of 0.05 rad a step
