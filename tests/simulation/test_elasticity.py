"""Energy, stress and projected Hessian of the element kernels against the float64 oracle."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import warp as wp

from gdpro_sim.kernels import elements
from tests.reference import fem as reference
from tests.simulation.fem_models import make_model, potential_at

TET = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.05], [0.0, 0.25, 0.0], [0.05, 0.1, 0.2]], dtype=np.float32)
# Exact in float32, which is what a model stores.
YOUNG, POISSON, DAMPING = 1e5, 0.375, 0.0078125


def random_gradients(count: int, seed: int = 0) -> np.ndarray:
    """Deformation gradients with positive determinant: near rest, stretched, crushed into the barrier."""
    rng = np.random.default_rng(seed)
    out = []
    while len(out) < count:
        u, _, vt = np.linalg.svd(rng.normal(size=(3, 3)))
        s = rng.choice([0.02, 0.2, 0.7, 1.0, 1.3, 3.0], size=3) * rng.uniform(0.9, 1.1, size=3)
        F = u @ np.diag(s) @ vt
        if np.linalg.det(F) > 0:
            out.append(F)
    return np.array(out)


class Batch:
    """One element per deformation gradient, no mass, no contact."""

    def __init__(self, gradients: np.ndarray, rayleigh_stiffness: float = 0.0) -> None:
        count = len(gradients)
        vertices = np.tile(TET, (count, 1))
        tets = np.arange(4 * count, dtype=np.int32).reshape(-1, 4)
        model = make_model(
            vertices, tets, young=YOUNG, poisson=POISSON, rayleigh_stiffness=rayleigh_stiffness
        )
        self.potential = potential_at(model)
        self.rest = vertices.reshape(-1, 4, 3).astype(np.float64)
        self.x = np.einsum("eij,eaj->eai", gradients, self.rest)
        self.oracle = reference.ReferenceFem(
            TET, np.array([[0, 1, 2, 3]]), YOUNG, POISSON, 1000.0, np.zeros(4, bool)
        )

    def energies(self, x: np.ndarray, inverse_dt: float = 0.0) -> np.ndarray:
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p.over_elements(
            elements.element_energy, [p.elements, array, p._cauchy_green, inverse_dt], [p._energies]
        )
        return p._energies.numpy()[: len(x)].copy()

    def derivatives(self, x: np.ndarray, inverse_dt: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Gradient [T, 4, 3] and Hessian [T, 12, 12]."""
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p.over_elements(
            elements.element_derivatives,
            [p.elements, array, p._cauchy_green, inverse_dt],
            [p.element_gradient, p._element_blocks],
        )
        blocks = p._element_blocks.numpy().reshape(-1, 10, 3, 3)
        full = np.zeros((len(x), 4, 3, 4, 3))
        for slot, (a, b) in enumerate(itertools.combinations_with_replacement(range(4), 2)):
            full[:, a, :, b, :] = blocks[:, slot]
            full[:, b, :, a, :] = np.swapaxes(blocks[:, slot], 1, 2)
        return p.element_gradient.numpy().reshape(-1, 4, 3).copy(), full.reshape(-1, 12, 12)

    def set_previous(self, x: np.ndarray) -> None:
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p.over_elements(
            elements.element_cauchy_green, [p.elements, array, 1.0, array, 0.0], [p._cauchy_green]
        )


def test_energy_and_gradient_match_the_reference() -> None:
    batch = Batch(random_gradients(200))
    energies, (gradients, _) = batch.energies(batch.x), batch.derivatives(batch.x)
    for e, x in enumerate(batch.x):
        scale = max(1.0, abs(batch.oracle.elastic_energy(x)))
        assert energies[e] == pytest.approx(batch.oracle.elastic_energy(x), abs=1e-9 * scale)
        expected = batch.oracle.elastic_gradient(x)
        assert np.abs(gradients[e] - expected).max() <= 1e-9 * np.abs(expected).max()


def test_gradient_is_the_finite_difference_of_the_energy() -> None:
    batch = Batch(random_gradients(50, seed=1))
    gradients, _ = batch.derivatives(batch.x)
    h = 1e-7
    for a in range(4):
        for i in range(3):
            plus, minus = batch.x.copy(), batch.x.copy()
            plus[:, a, i] += h
            minus[:, a, i] -= h
            slope = (batch.energies(plus) - batch.energies(minus)) / (2 * h)
            assert slope == pytest.approx(gradients[:, a, i], rel=1e-4, abs=1e-4 * np.abs(gradients).max())


def test_hessian_is_the_eigenvalue_projection() -> None:
    batch = Batch(random_gradients(200, seed=2))
    _, hessians = batch.derivatives(batch.x)
    for H, x in zip(hessians, batch.x, strict=True):
        expected = batch.oracle.elastic_hessian(x, projected=True).toarray()
        assert np.abs(H - expected).max() <= 1e-8 * np.abs(expected).max()
        assert np.linalg.eigvalsh(H).min() >= -1e-10 * np.abs(H).max()


def test_hessian_is_exact_where_it_is_positive_semidefinite() -> None:
    stretched = random_gradients(400, seed=3)
    lam, mu = reference.lame(YOUNG, POISSON)
    convex = np.array(
        [F for F in stretched if np.linalg.eigvalsh(reference.hessian(F, lam, mu)).min() >= 0.0]
    )
    assert len(convex) >= 10
    batch = Batch(convex)
    _, hessians = batch.derivatives(batch.x)
    for H, x in zip(hessians, batch.x, strict=True):
        expected = batch.oracle.elastic_hessian(x, projected=False).toarray()
        assert np.abs(H - expected).max() <= 1e-8 * np.abs(expected).max()


def test_rest_is_stress_free_and_rotation_costs_nothing() -> None:
    c, s = np.cos(0.7), np.sin(0.7)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    batch = Batch(np.array([np.eye(3), turned]))
    gradients, hessians = batch.derivatives(batch.x)
    assert np.abs(gradients).max() <= 1e-9 * YOUNG * 0.3**2
    assert np.abs(batch.energies(batch.x)).max() <= 1e-12 * YOUNG
    # Infinitesimal rotations of the deformed element lie in the null space: rotation is not stiff.
    spin = np.cross(np.array([0.2, -0.5, 1.0]), batch.x).reshape(2, 12)
    assert np.abs(np.einsum("eij,ej->ei", hessians, spin)).max() <= 1e-8 * np.abs(hessians).max()


def test_inverted_element_has_infinite_energy() -> None:
    batch = Batch(np.array([np.diag([1.0, 1.0, -0.1]), np.zeros((3, 3))]))
    assert np.all(np.isinf(batch.energies(batch.x)))


def test_damping_is_a_potential_that_ignores_rigid_motion() -> None:
    gradients = np.eye(3) + 0.2 * np.random.default_rng(4).normal(size=(20, 3, 3))
    batch = Batch(gradients, rayleigh_stiffness=DAMPING)
    c, s = np.cos(1.0), np.sin(1.0)
    turned = np.einsum("ij,eaj->eai", [[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], batch.x) + 0.3
    batch.set_previous(batch.x)
    undamped = batch.energies(turned)
    assert batch.energies(turned, inverse_dt=128.0) == pytest.approx(undamped, rel=1e-9)

    batch.set_previous(batch.rest)
    forces, _ = batch.derivatives(batch.x, inverse_dt=128.0)
    h = 1e-7
    for a in range(4):
        for i in range(3):
            plus, minus = batch.x.copy(), batch.x.copy()
            plus[:, a, i] += h
            minus[:, a, i] -= h
            slope = (batch.energies(plus, 128.0) - batch.energies(minus, 128.0)) / (2 * h)
            assert slope == pytest.approx(forces[:, a, i], rel=1e-4, abs=1e-5 * np.abs(forces).max())


def test_damping_hessian_at_rest_is_the_scaled_elastic_one() -> None:
    batch = Batch(np.eye(3)[None], rayleigh_stiffness=DAMPING)
    batch.set_previous(batch.rest)
    _, elastic = batch.derivatives(batch.rest)
    _, both = batch.derivatives(batch.rest, inverse_dt=128.0)
    assert np.abs(both - 2.0 * elastic).max() <= 1e-9 * np.abs(elastic).max()


@pytest.mark.parametrize(
    ("stretch", "lateral", "stress"),
    [
        (0.7, 1.0880, -0.3811),
        (0.9, 1.0304, -0.1076),
        (1.1, 0.9706, 0.0937),
        (1.5, 0.8692, 0.3832),
        (2.0, 0.7746, 0.6538),
    ],
)
def test_uniaxial_stretch(stretch: float, lateral: float, stress: float) -> None:
    """Known answers for poisson 0.3: lateral stretch and P_11 / E of a freely contracting bar."""
    s, p = reference.uniaxial_lateral(stretch, 1.0, 0.3)
    assert (s, p) == pytest.approx((lateral, stress), abs=1e-4)

    vertices, tets = TET.astype(np.float64), np.array([[0, 1, 2, 3]], dtype=np.int32)
    model = make_model(vertices, tets, young=1e5, poisson=0.3)
    potential = potential_at(model, TET.astype(np.float64) * np.array([stretch, s, s]))
    potential.forces(potential.trial)
    # First Piola stress from nodal forces: sum_a f_a (x) X_a = V P.
    forces = potential.element_gradient.numpy()
    volume = potential.elements.volume.numpy()[0]
    P = forces.T @ TET.astype(np.float64) / volume / 1e5
    assert P[0, 0] == pytest.approx(stress, abs=1e-3)
    assert np.abs(P - np.diag([P[0, 0], 0.0, 0.0])).max() < 1e-4
