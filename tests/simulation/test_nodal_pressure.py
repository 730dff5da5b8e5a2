"""Averaged nodal volumes: their energy, its derivatives, and what they are for."""

from __future__ import annotations

import numpy as np
import pytest

from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.model import Model
from tests.simulation.fem_models import make_model, potential_at, tet_box

STILL = 1e9  # a step so long that inertia is nothing


def block(poisson: float = 0.484375, volumes: str = "auto") -> Model:
    vertices, tets = tet_box((3, 2, 2), (0.6, 0.4, 0.4))
    return make_model(vertices, tets, young=1e5, poisson=poisson, gravity=(0, 0, 0), volumes=volumes)


def energy(potential: IncrementalPotential, x: np.ndarray) -> float:
    potential.trial.assign(x)
    return potential.energy(potential.trial)


def dense(potential: IncrementalPotential) -> np.ndarray:
    """The matrix that conjugate gradients multiply by, column by column."""
    count = 3 * len(potential.mass)
    columns = [potential.system.product(np.eye(count)[k].reshape(-1, 3)).ravel() for k in range(count)]
    return np.stack(columns, 1)


def test_energy_is_that_of_averaged_volume_ratios() -> None:
    model = block()
    x = model.vertices + 0.02 * np.random.default_rng(0).normal(size=model.vertices.shape)
    whole = energy(potential_at(model, x, STILL), x)
    corners = x[model.tets]
    volume = np.linalg.det(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)) / 6.0
    corners = model.vertices.astype(np.float64)[model.tets]
    rest = np.linalg.det(np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)) / 6.0
    ids, count = model.tets.ravel(), len(x)
    v, V = (np.bincount(ids, np.repeat(a / 4.0, 4), count) for a in (volume, rest))
    mu = 1e5 / (2.0 * 1.484375)
    lam = 1e5 * 0.484375 / (1.484375 * 0.03125)
    nodal = float((V * 0.5 * (lam - mu) * (v / V - 1.0) ** 2).sum())
    softer = make_model(  # lambda = mu: Poisson's ratio 1/4
        model.vertices, model.tets, young=2.5 * mu, poisson=0.25, gravity=(0, 0, 0)
    )
    assert whole == pytest.approx(nodal + energy(potential_at(softer, x, STILL), x), rel=1e-6)


def test_where_volume_changes_evenly_nothing_differs() -> None:
    x = block().vertices.astype(np.float64) @ np.diag([1.1, 0.9, 1.05])
    averaged, own = (energy(potential_at(block(volumes=v), x, STILL), x) for v in ("nodal", "element"))
    assert averaged == pytest.approx(own, rel=1e-6)
    assert energy(potential_at(block(0.4375), x, STILL), x) == energy(
        potential_at(block(0.4375, "element"), x, STILL), x
    ), "below 0.45 elements keep their own volumes"


def test_gradient_is_the_derivative_of_the_energy() -> None:
    model = block()
    rng = np.random.default_rng(1)
    x = model.vertices + 0.01 * rng.normal(size=model.vertices.shape)
    potential = potential_at(model, x, STILL)
    potential.linearise(potential.trial)
    force = potential.system.right_hand_side.numpy().copy()
    step = 1e-6
    for _ in range(8):
        d = rng.normal(size=x.shape)
        slope = (energy(potential, x + step * d) - energy(potential, x - step * d)) / (2.0 * step)
        assert slope == pytest.approx(-float((force * d).sum()), rel=1e-6)


def test_hessian_is_exact_at_rest_and_semidefinite_everywhere() -> None:
    model = block()
    rest = model.vertices.astype(np.float64)
    potential = potential_at(model, rest, STILL)
    potential.linearise(potential.trial)
    matrix = dense(potential)
    step, rng = 1e-6, np.random.default_rng(2)
    for _ in range(4):
        d = rng.normal(size=rest.shape)
        forces = []
        for sign in (1.0, -1.0):
            potential.trial.assign(rest + sign * step * d)
            potential.linearise(potential.trial)
            forces.append(potential.system.right_hand_side.numpy().ravel().copy())
        expected = (forces[1] - forces[0]) / (2.0 * step)
        assert np.abs(matrix @ d.ravel() - expected).max() <= 1e-5 * np.abs(expected).max()
    potential.trial.assign(rest + 0.03 * rng.normal(size=rest.shape))
    potential.linearise(potential.trial)
    matrix = dense(potential)
    values = np.linalg.eigvalsh(matrix)
    assert np.abs(matrix - matrix.T).max() <= 1e-12 * np.abs(matrix).max()
    assert values.min() >= -1e-12 * values.max()


def test_both_forms_of_conjugate_gradients_solve_with_it() -> None:
    model = block()
    x = model.vertices * np.array([1.1, 1.0, 0.9])
    for serial in (True, False):
        potential = potential_at(model, x, 1 / 120, model.vertices)
        potential.system.serial = serial
        potential.linearise(potential.trial)
        assert potential.system.solve(1e-10, 2000).converged
        expected = np.linalg.solve(dense(potential), potential.system.right_hand_side.numpy().ravel())
        found = potential.system.solution.numpy().ravel()
        assert np.abs(found - expected).max() <= 1e-7 * np.abs(expected).max()


@pytest.mark.parametrize(("volumes", "least", "most"), [("auto", 0.65, 0.85), ("element", 0.05, 0.2)])
def test_nearly_incompressible_cantilevers_do_not_lock(volumes: str, least: float, most: float) -> None:
    """Tip deflection at Poisson's ratio 0.499 over that at 0.3 on the same mesh; theory: 1."""
    vertices, tets = tet_box((10, 2, 2), (1.0, 0.2, 0.2))
    tips = []
    for poisson in (0.3, 0.499):
        model = make_model(
            vertices, tets, young=1e7, poisson=poisson, pinned=vertices[:, 0] < 1e-9, gravity=(0, 0, -0.1),
            integrator="quasi-static", newton_tolerance=1e-6, cg_tolerance=1e-6, volumes=volumes,
        )  # fmt: skip
        solver = SolverFEM(model)
        solver.step(1.0)
        assert solver.diagnostics().converged
        tips.append(float((vertices - solver.positions)[vertices[:, 0] > 1.0 - 1e-9, 2].mean()))
    assert least < tips[1] / tips[0] < most
