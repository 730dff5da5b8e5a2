"""Energy, stress and projected Hessian of the element kernels against textbook forms and known answers."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import elasticity
from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.verification.closed_forms import simple_shear, uniaxial
from tests.reference import elasticity as reference
from tests.simulation.element_batch import (
    DAMPING,
    LAM,
    MU,
    POISSON,
    SPECIAL,
    YOUNG,
    Batch,
    random_gradients,
    random_rotation,
    with_stretches,
)
from tests.simulation.fem_models import make_model, tet_box

NONLINEAR = [law for law in LAWS if law != "linear"]
every_law = pytest.mark.parametrize("law", LAWS)
nonlinear = pytest.mark.parametrize("law", NONLINEAR)


def stress_of(law: str) -> Callable[[np.ndarray], np.ndarray]:
    return lambda F: reference.piola(law, F, LAM, MU)


def test_laws_have_the_numbers_of_the_kernels() -> None:
    assert [getattr(elasticity, law.upper()) for law in LAWS] == list(range(len(LAWS)))


@every_law
def test_energy_and_stress_match_the_textbook(law: str) -> None:
    gradients = np.concatenate([random_gradients(100), with_stretches(SPECIAL)])
    batch = Batch(gradients, law)
    energies, stresses, forces = batch.energies(batch.x), batch.stresses(), batch.gradient(batch.x)
    for e, F in enumerate(gradients):
        energy = batch.volume * reference.energy_density(law, F, LAM, MU)
        assert energies[e] == pytest.approx(energy, rel=1e-9, abs=1e-12 * YOUNG * batch.volume)
        expected = reference.piola(law, F, LAM, MU)
        assert np.abs(stresses[e] - expected).max() <= 1e-9 * np.abs(expected).max() + 1e-10 * YOUNG
        alone = np.einsum("ai,aj->ij", forces[e], batch.rest[e]) / batch.volume
        assert np.abs(alone - stresses[e]).max() <= 1e-10 * np.abs(expected).max() + 1e-12 * YOUNG


@every_law
def test_gradient_is_the_finite_difference_of_the_energy(law: str) -> None:
    batch = Batch(np.concatenate([random_gradients(50, seed=1), with_stretches(SPECIAL[:6])]), law)
    gradients, _ = batch.derivatives(batch.x)
    h = 1e-7
    for a in range(4):
        for i in range(3):
            plus, minus = batch.x.copy(), batch.x.copy()
            plus[:, a, i] += h
            minus[:, a, i] -= h
            slope = (batch.energies(plus) - batch.energies(minus)) / (2 * h)
            assert slope == pytest.approx(gradients[:, a, i], rel=1e-4, abs=1e-4 * np.abs(gradients).max())


@every_law
def test_hessian_is_the_projected_derivative_of_the_stress(law: str) -> None:
    gradients = np.concatenate([random_gradients(100, seed=2), with_stretches(SPECIAL)])
    batch = Batch(gradients, law)
    _, hessians = batch.derivatives(batch.x)
    _, unprojected = batch.derivatives(batch.x, exact=True)
    for H, H_exact, F in zip(hessians, unprojected, gradients, strict=True):
        exact = reference.hessian(stress_of(law), F)
        expected = batch.expected_hessian(reference.project(exact))
        scale = np.abs(batch.expected_hessian(exact)).max()
        assert np.abs(H - expected).max() <= 1e-7 * scale
        assert np.abs(H_exact - batch.expected_hessian(exact)).max() <= 1e-7 * scale
        assert np.linalg.eigvalsh(H).min() >= -1e-10 * np.abs(H).max()


@every_law
def test_hessian_is_exact_where_it_is_positive_semidefinite(law: str) -> None:
    stretched = np.concatenate([random_gradients(300, seed=3), with_stretches([(1.2, 1.1, 1.0)] * 10)])
    pairs = [(F, reference.hessian(stress_of(law), F)) for F in stretched]
    convex = [(F, H) for F, H in pairs if np.linalg.eigvalsh(H).min() >= -1e-9 * np.abs(H).max()]
    assert len(convex) >= 10
    batch = Batch(np.array([F for F, _ in convex]), law)
    _, hessians = batch.derivatives(batch.x)
    for H, (_, exact) in zip(hessians, convex, strict=True):
        expected = batch.expected_hessian(exact)
        assert np.abs(H - expected).max() <= 1e-7 * np.abs(expected).max()


@every_law
def test_small_strains_are_linear_elastic(law: str) -> None:
    batch = Batch(np.eye(3)[None], law)
    _, (hessian,) = batch.derivatives(batch.x)
    expected = batch.expected_hessian(reference.hessian(stress_of("linear"), np.eye(3)))
    assert np.abs(hessian - expected).max() <= 1e-8 * np.abs(expected).max()


@nonlinear
def test_rest_is_stress_free_and_rotation_costs_nothing(law: str) -> None:
    turned = random_rotation(np.random.default_rng(7))
    batch = Batch(np.array([np.eye(3), turned]), law)
    gradients, hessians = batch.derivatives(batch.x)
    assert np.abs(gradients).max() <= 1e-9 * YOUNG * 0.3**2
    assert np.abs(batch.energies(batch.x)).max() <= 1e-12 * YOUNG
    # Infinitesimal rotations of the deformed element lie in the null space: rotation is not stiff.
    spin = np.cross(np.array([0.2, -0.5, 1.0]), batch.x).reshape(2, 12)
    assert np.abs(np.einsum("eij,ej->ei", hessians, spin)).max() <= 1e-8 * np.abs(hessians).max()


@nonlinear
def test_frames_do_not_matter(law: str) -> None:
    """Psi(R F Q) = Psi(F) and P(R F Q) = R P(F) Q: objective and isotropic."""
    rng = np.random.default_rng(5)
    gradients = random_gradients(40, seed=6)
    R, Q = random_rotation(rng), random_rotation(rng)
    plain, turned = Batch(gradients, law), Batch(R @ gradients @ Q, law)
    a, b = plain.energies(plain.x), turned.energies(turned.x)
    assert b == pytest.approx(a, rel=1e-9, abs=1e-12 * YOUNG * plain.volume)
    for P, S in zip(plain.stresses(), turned.stresses(), strict=True):
        assert np.abs(S - R @ P @ Q).max() <= 1e-9 * np.abs(P).max() + 1e-10 * YOUNG


@nonlinear
def test_inverted_element_has_infinite_energy(law: str) -> None:
    gradients = [np.diag([1.0, 1.0, -0.1]), np.diag([-1.0, -1.0, -1.0]), np.zeros((3, 3)), np.diag([1, 1, 0])]
    batch = Batch(np.array(gradients), law)
    assert np.all(np.isinf(batch.energies(batch.x)))


def test_linear_elasticity_knows_no_inversion() -> None:
    batch = Batch(np.array([np.diag([1.0, 1.0, -0.5]), np.zeros((3, 3))]), "linear")
    expected = [(MU + LAM / 2) * 1.5**2, 3 * MU + LAM / 2 * 9]
    assert batch.energies(batch.x) == pytest.approx(batch.volume * np.array(expected))


@every_law
def test_damping_is_a_potential_that_ignores_rigid_motion(law: str) -> None:
    gradients = np.eye(3) + 0.2 * np.random.default_rng(4).normal(size=(20, 3, 3))
    batch = Batch(gradients, law, rayleigh_stiffness=DAMPING)
    turned = np.einsum("ij,eaj->eai", random_rotation(np.random.default_rng(1)), batch.x) + 0.3
    batch.set_previous(batch.x)
    undamped = batch.energies(turned)
    assert batch.energies(turned, inverse_dt=128.0) == pytest.approx(undamped, rel=1e-9)

    batch.set_previous(batch.rest)
    forces, hessians = batch.derivatives(batch.x, inverse_dt=128.0)
    h = 1e-7
    for a in range(4):
        for i in range(3):
            plus, minus = batch.x.copy(), batch.x.copy()
            plus[:, a, i] += h
            minus[:, a, i] -= h
            slope = (batch.energies(plus, 128.0) - batch.energies(minus, 128.0)) / (2 * h)
            assert slope == pytest.approx(forces[:, a, i], rel=1e-4, abs=1e-5 * np.abs(forces).max())
    assert all(np.linalg.eigvalsh(H).min() >= -1e-10 * np.abs(H).max() for H in hessians)


@nonlinear
def test_damping_hessian_is_that_of_the_damping_force(law: str) -> None:
    """Measured from where the element is, damping has no geometric part: its Gauss-Newton form is exact."""
    gradients = with_stretches([(1.1, 1.0, 0.9), (1.3, 0.8, 1.0)])
    batch = Batch(gradients, law, rayleigh_stiffness=DAMPING)
    batch.set_previous(batch.x)
    _, elastic = batch.derivatives(batch.x)
    _, both = batch.derivatives(batch.x, inverse_dt=128.0)
    h = 1e-6
    for a in range(4):
        for i in range(3):
            moved = [batch.x.copy(), batch.x.copy()]
            moved[0][:, a, i] += h
            moved[1][:, a, i] -= h
            damping = [batch.derivatives(x, 128.0)[0] - batch.derivatives(x)[0] for x in moved]
            column = (damping[0] - damping[1]).reshape(-1, 12) / (2 * h)
            assert np.abs((both - elastic)[:, :, 3 * a + i] - column).max() <= 1e-6 * np.abs(both).max()


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
def test_uniaxial_stretch_of_the_default_law_is_known(stretch: float, lateral: float, stress: float) -> None:
    """Lateral stretch and P_11 / E of a freely contracting bar, poisson 0.3."""
    assert uniaxial("stable_neo_hookean", stretch, 1.0, 0.3) == pytest.approx((lateral, stress), abs=1e-4)


@every_law
@pytest.mark.parametrize("stretch", [0.6, 0.9, 0.999, 1.001, 1.1, 1.5, 2.0])
def test_uniaxial_stretch(law: str, stretch: float) -> None:
    s, stress = uniaxial(law, stretch, YOUNG, POISSON)
    (P,) = Batch(np.diag([stretch, s, s])[None], law).stresses()
    assert np.abs(P - np.diag([stress, 0.0, 0.0])).max() <= 1e-10 * YOUNG


@every_law
@pytest.mark.parametrize("shear", [-0.5, 1e-3, 0.2, 1.0, 3.0])
def test_simple_shear(law: str, shear: float) -> None:
    F = np.eye(3)
    F[0, 1] = shear
    (P,) = Batch(F[None], law).stresses()
    stress = P if law == "linear" else P @ F.T
    expected = simple_shear(law, shear, MU)
    assert np.abs(stress - expected).max() <= 1e-10 * YOUNG * max(1.0, shear**2)


@every_law
def test_elements_of_one_mesh_may_have_laws_of_their_own(law: str) -> None:
    """A block of two laws, squeezed: the solver settles, and each element's energy is its own law's."""
    vertices, tets = tet_box((2, 1, 1), (0.2, 0.1, 0.1))
    laws = np.where(np.arange(len(tets)) % 2 == 0, LAWS.index(law), 0).astype(np.int32)
    model = make_model(
        vertices,
        tets,
        young=YOUNG,
        poisson=POISSON,
        pinned=vertices[:, 0] == 0.0,
        velocities=np.where(vertices[:, :1] > 0.15, [-1.0, 0.3, 0.0], 0.0),
    )
    model = dataclasses.replace(model, law=laws)
    solver = SolverFEM(model)
    for _ in range(3):
        solver.step(1 / 60)
    assert solver.diagnostics().converged
    edges = np.swapaxes(solver.positions[tets[:, 1:]] - solver.positions[tets[:, :1]], 1, 2)
    gradients = edges @ rest_shapes(model).inverse
    energies = [reference.energy_density(LAWS[k], F, LAM, MU) for k, F in zip(laws, gradients, strict=True)]
    volume = 0.2 * 0.1 * 0.1 / len(tets)
    assert solver.diagnostics().elastic_energy == pytest.approx(volume * sum(energies), rel=1e-5)


def test_bad_laws_are_named() -> None:
    vertices, tets = tet_box((1, 1, 1), (1, 1, 1))
    model = make_model(vertices, tets)
    laws = np.zeros(len(tets), np.int32)
    laws[2] = 7
    with pytest.raises(SolverError, match=r"element 2 has law 7.*below 5"):
        SolverFEM(dataclasses.replace(model, law=laws))
    with pytest.raises(SolverError, match=r"element 0 .*only the law"):
        SolverFEM(dataclasses.replace(model, yield_stress=np.full(len(tets), 1e5)))


@nonlinear
def test_pressure_from_outside_enters_stress_and_hessian(law: str) -> None:
    """P + p cof F, and its projected derivative: as if p J belonged to the energy."""
    pressure = -0.3 * MU
    gradients = np.concatenate([random_gradients(30, seed=8), with_stretches(SPECIAL[:7])])
    batch = Batch(gradients, law)
    batch.potential.elements.pressure.fill_(pressure)

    def stress(F: np.ndarray) -> np.ndarray:
        return reference.piola(law, F, LAM, MU) + pressure * np.linalg.det(F) * np.linalg.inv(F).T

    _, hessians = batch.derivatives(batch.x)
    for P, H, F in zip(batch.stresses(), hessians, gradients, strict=True):
        assert np.abs(P - stress(F)).max() <= 1e-9 * np.abs(stress(F)).max()
        exact = reference.hessian(stress, F)
        expected = batch.expected_hessian(reference.project(exact))
        assert np.abs(H - expected).max() <= 1e-7 * np.abs(batch.expected_hessian(exact)).max()


@nonlinear
def test_cube_thrown_at_the_ground_survives_with_every_law(law: str) -> None:
    """20 m/s into the floor while it spins: crushed, never inverted, never gaining energy."""
    vertices, tets = tet_box((3, 3, 3), (0.5, 0.5, 0.5), (0.0, 0.0, 0.05))
    thrown = np.array([1.0, 0.0, -20.0]) + np.cross([2.0, 3.0, 1.0], vertices - vertices.mean(axis=0))
    model = make_model(vertices, tets, young=YOUNG, poisson=0.4, velocities=thrown, ground=Ground(0.0))
    solver = SolverFEM(dataclasses.replace(model, law=np.full(len(tets), LAWS.index(law), np.int32)))
    energies, crushed = [], 1.0
    for _ in range(20):
        solver.step(1 / 60)
        d = solver.diagnostics()
        assert d.converged and d.min_volume_ratio > 0.0
        energies.append(d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy)
        crushed = min(crushed, d.min_volume_ratio)
    assert crushed < 0.7
    assert np.diff(energies).max() <= 1e-9 * energies[0]
