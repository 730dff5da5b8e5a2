"""Von Mises plasticity: the condensed potential, what stays after a step, and known answers."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest
import warp as wp
from scipy.optimize import brentq

from gdpro_sim.errors import SolverError
from gdpro_sim.materials import LAWS, PRESETS, Material
from gdpro_sim.simulation.conditions import Force
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.model import Ground, Model
from tests.reference import elasticity as reference
from tests.simulation.element_batch import LAM, MU, YOUNG, Batch, random_rotation, with_stretches
from tests.simulation.fem_models import make_model, tet_box

YIELD, HARDENING = 2e4, 1e5
BAR_YOUNG = 1e6
HENCKY = LAWS.index("stvk_hencky")

STRETCHES = [
    (1.0, 1.0, 1.0),
    (1.05, 1.0, 0.98),  # elastic
    (1.5, 1.5, 1.5),  # pressure alone does not make it flow
    (1.3, 1.0, 0.9),
    (1.3, 1.3, 0.6),
    (1.3, 1.3 - 1e-9, 0.6),
    (3.0, 0.5, 0.5),
    (1.0, 0.2, 0.1),
    (0.3, 0.2, 0.2 + 1e-7),
]


def plastic_batch(gradients: np.ndarray, hardening: float = HARDENING) -> Batch:
    return Batch(gradients, "stvk_hencky", yield_stress=YIELD, hardening=hardening)


def equivalent_stress(P: np.ndarray, F: np.ndarray) -> float:
    """Von Mises equivalent of the Kirchhoff stress P F^T."""
    tau = P @ F.T
    deviator = tau - np.trace(tau) / 3 * np.eye(3)
    return math.sqrt(1.5 * np.sum(deviator**2))


@pytest.mark.parametrize("hardening", [0.0, HARDENING])
def test_potential_is_the_least_energy_over_plastic_flow(hardening: float) -> None:
    gradients = with_stretches(STRETCHES)
    batch = plastic_batch(gradients, hardening)
    for energy, F in zip(batch.energies(batch.x), gradients, strict=True):
        expected = batch.volume * reference.plastic_energy(F, LAM, MU, YIELD, hardening)
        assert energy == pytest.approx(expected, rel=1e-8, abs=1e-10 * YOUNG * batch.volume)


@pytest.mark.parametrize("hardening", [0.0, HARDENING])
def test_gradient_is_the_finite_difference_of_the_potential(hardening: float) -> None:
    batch = plastic_batch(with_stretches(STRETCHES), hardening)
    gradients, _ = batch.derivatives(batch.x)
    h = 1e-7
    for a in range(4):
        for i in range(3):
            plus, minus = batch.x.copy(), batch.x.copy()
            plus[:, a, i] += h
            minus[:, a, i] -= h
            slope = (batch.energies(plus) - batch.energies(minus)) / (2 * h)
            assert slope == pytest.approx(gradients[:, a, i], rel=1e-4, abs=1e-5 * np.abs(gradients).max())


@pytest.mark.parametrize("hardening", [0.0, HARDENING])
def test_hessian_is_the_projected_derivative_of_the_gradient(hardening: float) -> None:
    """The projection acts on dP/dF of an element: seen through its shape gradients, which are the same."""
    gradients = with_stretches(STRETCHES)
    batch = plastic_batch(gradients, hardening)
    _, hessians = batch.derivatives(batch.x)

    def stresses(moved: np.ndarray) -> np.ndarray:
        forces, _ = batch.derivatives(batch.positions(moved))
        return np.einsum("eai,eaj->eij", forces, batch.rest) / batch.volume

    exact = np.zeros((len(gradients), 9, 9))
    for k in range(9):
        d = np.zeros(9)
        d[k] = 1e-6
        d = d.reshape(3, 3)
        exact[:, :, k] = (stresses(gradients + d) - stresses(gradients - d)).reshape(-1, 9) / 2e-6
    _, unprojected = batch.derivatives(batch.x, exact=True)
    for H, H_exact, derivative in zip(hessians, unprojected, exact, strict=True):
        expected, whole = (
            batch.expected_hessian(reference.project(derivative)),
            batch.expected_hessian(derivative),
        )
        assert np.abs(H - expected).max() <= 1e-6 * np.abs(whole).max()
        assert np.abs(H_exact - whole).max() <= 1e-6 * np.abs(whole).max()


def test_flow_keeps_volume_and_forces_and_ends_on_the_yield_surface() -> None:
    gradients = with_stretches(STRETCHES)
    batch = plastic_batch(gradients)
    p = batch.potential
    before, _ = batch.derivatives(batch.x)
    p.flow(wp.array(batch.x.reshape(-1, 3), dtype=wp.vec3d, device="cpu"))
    after, _ = batch.derivatives(batch.x)
    assert np.abs(after - before).max() <= 1e-9 * np.abs(before).max()
    assert p._yields and set(p.state()) == {"stress_free_shapes", "plastic_strain"}

    strain = p.elements.plastic_strain.numpy()
    flowed = strain > 0.0
    assert flowed.tolist() == [False] * 3 + [True] * 6
    edges = np.swapaxes(batch.rest[:, 1:] - batch.rest[:, :1], 1, 2)
    plastic_inverse = edges @ p.elements.inverse_rest.numpy()
    assert np.linalg.det(plastic_inverse) == pytest.approx(1.0, abs=1e-12)
    elastic = gradients @ plastic_inverse
    for F_e, F, P, grown in zip(elastic, gradients, batch.stresses(), strain, strict=True):
        stress = equivalent_stress(P, F)
        if grown > 0.0:
            assert stress == pytest.approx(YIELD + HARDENING * grown, rel=1e-9)
        # The stress is the elastic law's, of what is left: tau = P F^T for any F_p.
        tau = reference.piola("stvk_hencky", F_e, LAM, MU) @ F_e.T
        assert np.abs(tau - P @ F.T).max() <= 1e-9 * YOUNG
    # A second look changes nothing.
    p.flow(wp.array(batch.x.reshape(-1, 3), dtype=wp.vec3d, device="cpu"))
    assert p.elements.plastic_strain.numpy() == pytest.approx(strain, abs=1e-12)


def test_rotation_after_flow_costs_nothing() -> None:
    batch = plastic_batch(with_stretches([(1.4, 1.0, 0.8)]))
    p = batch.potential
    p.flow(wp.array(batch.x.reshape(-1, 3), dtype=wp.vec3d, device="cpu"))
    turned = batch.x @ random_rotation(np.random.default_rng(0)).T
    assert batch.energies(turned) == pytest.approx(batch.energies(batch.x), rel=1e-10)


def bar(*loads: Force, **options: object) -> tuple[Model, np.ndarray]:
    """A bar along x without pins or gravity, to be pulled at both ends; and its rest positions."""
    vertices, tets = tet_box((3, 2, 2), (0.3, 0.1, 0.1))
    settings = {"integrator": "quasi-static", "newton_tolerance": 1e-9, "cg_tolerance": 1e-8}
    model = make_model(
        vertices, tets, young=BAR_YOUNG, poisson=0.375, gravity=(0, 0, 0), **{**settings, **options}
    )
    count = len(tets)
    model = dataclasses.replace(
        model,
        law=np.full(count, HENCKY, np.int32),
        yield_stress=np.full(count, YIELD),
        hardening=np.full(count, HARDENING),
        loads=loads,
    )
    return model, model.vertices.astype(np.float64)


def pull(traction: float, start: float, end: float) -> Force:
    """Dead tractions, Pa of undeformed area, on both ends of `bar`, as nodal forces that stress it evenly."""
    model, rest = bar()
    shapes = rest_shapes(model)
    gradients = np.concatenate([-shapes.inverse.sum(axis=1, keepdims=True), shapes.inverse], axis=1)
    forces = np.zeros_like(rest)
    np.add.at(forces[:, 0], model.tets, shapes.volume[:, None] * traction * gradients[:, :, 0])
    return Force(np.arange(len(rest), dtype=np.int32), forces, start, end)


def pulled(traction: float) -> tuple[float, float, float]:
    """(stretch, lateral stretch, plastic strain) of a bar under a dead traction beyond its yield stress.

    The Kirchhoff stress traction * stretch is sigma_y + H p, the strain log(stretch) is stress / E + p.
    """

    def excess(stretch: float) -> float:
        tau = traction * stretch
        return tau - (YIELD + HARDENING * (math.log(stretch) - tau / BAR_YOUNG))

    stretch = brentq(excess, 1.01, 2.0, xtol=1e-14)
    plastic = math.log(stretch) - traction * stretch / BAR_YOUNG
    return stretch, math.exp(-0.375 * traction * stretch / BAR_YOUNG - plastic / 2), plastic


def test_bar_pulled_beyond_its_yield_stress_stays_longer() -> None:
    """Uniaxial tension: stress sigma_y + H p under load, exp(p) long afterwards, no volume lost."""
    traction = 1.5 * YIELD
    stretch, lateral, plastic = pulled(traction)
    assert 0.1 < plastic < 0.5
    model, rest = bar(pull(traction, 0.0, 1.5), pull(0.5 * YIELD, 2.5, 3.5))
    solver = SolverFEM(model)

    def shape() -> np.ndarray:
        x = solver.positions - solver.positions.mean(axis=0)
        fit, *_ = np.linalg.lstsq(rest - rest.mean(axis=0), x, rcond=None)
        assert np.abs((rest - rest.mean(axis=0)) @ fit - x).max() < 1e-6  # the same strain everywhere
        return np.linalg.svd(fit, compute_uv=False)

    def strain() -> np.ndarray:
        return solver.state_dict()["plastic_strain"]

    solver.step(1.0)
    assert solver.diagnostics().converged
    assert shape() == pytest.approx([stretch, lateral, lateral], abs=1e-5)
    assert strain() == pytest.approx(plastic, abs=1e-5)

    solver.step(1.0)  # let go
    assert shape() == pytest.approx([math.exp(plastic)] + 2 * [math.exp(-plastic / 2)], abs=1e-5)
    assert solver.diagnostics().min_volume_ratio == pytest.approx(1.0, abs=2e-6)
    assert solver.diagnostics().elastic_energy < 1e-6 * YIELD * 0.3 * 0.1 * 0.1

    solver.step(1.0)  # pulled again, but by less
    assert strain() == pytest.approx(plastic, abs=1e-5)
    tau = brentq(lambda t: t - 0.5 * YIELD * math.exp(t / BAR_YOUNG + plastic), 0.0, YIELD)
    assert shape()[0] == pytest.approx(math.exp(tau / BAR_YOUNG + plastic), abs=1e-5)


@pytest.mark.parametrize("steps", [1, 5])
def test_loading_in_steps_ends_where_one_step_does(steps: int) -> None:
    """Proportional loading: the return mapping is exact for any step."""
    traction = 1.5 * YIELD
    loads = [pull(traction / steps, float(k), math.inf) for k in range(steps)]
    model, _ = bar(*loads)
    solver = SolverFEM(model)
    for _ in range(steps):
        solver.step(1.0)
    _, _, plastic = pulled(traction)
    assert solver.state_dict()["plastic_strain"] == pytest.approx(plastic, abs=1e-5)


@pytest.mark.parametrize("integrator", ["backward-euler", "bdf2", "midpoint", "explicit"])
def test_thrown_bar_stays_bent_and_loses_energy(integrator: str) -> None:
    """Pinned at one end and thrown sideways: it ends bent, having lost energy to the flow alone."""
    model, rest = bar(integrator=integrator, substeps=2, newton_tolerance=1e-6)
    pinned = rest[:, 0] == 0.0
    velocities = np.where(pinned[:, None], 0.0, [0.0, 0.0, 5.0]) * (rest[:, :1] / 0.3)
    model = dataclasses.replace(model, pinned=pinned, velocities=velocities.astype(np.float32))
    solver = SolverFEM(model)
    energies = []
    for _ in range(30):
        solver.step(0.005)
        d = solver.diagnostics()
        assert d.converged
        energies.append(d.kinetic_energy + d.elastic_energy)
    strain = solver.state_dict()["plastic_strain"]
    assert 0.05 < strain.max() < 2.0
    assert energies[-1] < 0.7 * energies[0]
    slack = 0.02 if integrator in ("midpoint", "explicit") else 1e-9
    assert np.diff(energies).max() <= slack * energies[0]


def test_plasticine_thrown_at_the_ground_stays_flat() -> None:
    material = Material.model_validate("plasticine")
    assert material.yield_stress is not None
    vertices, tets = tet_box((4, 4, 4), (0.2, 0.2, 0.2))
    model = make_model(
        vertices,
        tets,
        young=material.young,
        poisson=material.poisson,
        density=material.density,
        rayleigh_stiffness=material.rayleigh_stiffness,
        velocities=np.tile([0.0, 0.0, -15.0], (len(vertices), 1)),
        ground=Ground(0.0),
    )
    count = len(tets)
    solver = SolverFEM(
        dataclasses.replace(
            model,
            law=np.full(count, material.law, np.int32),
            yield_stress=np.full(count, material.yield_stress),
        )
    )
    for _ in range(40):
        solver.step(1 / 300)
        assert solver.diagnostics().converged
    width, depth, height = np.ptp(solver.positions, axis=0)
    assert height < 0.85 * 0.2 and min(width, depth) > 1.1 * 0.2
    assert solver.diagnostics().kinetic_energy < 0.01 * (0.5 * material.density * 0.2**3 * 15.0**2)
    edges = solver.positions[tets[:, 1:]] - solver.positions[tets[:, :1]]
    assert np.linalg.det(edges).sum() / 6.0 == pytest.approx(0.2**3, rel=0.02)


def test_plastic_state_is_saved_restored_and_reset() -> None:
    model, _ = bar(pull(1.5 * YIELD, 0.0, 0.05), integrator="backward-euler")
    solver, other = SolverFEM(model), SolverFEM(model)
    for _ in range(3):
        solver.step(0.01)
    saved = solver.state_dict()
    assert saved["plastic_strain"].max() > 0.0
    other.load_state_dict(saved)
    for _ in range(3):
        solver.step(0.01)
        other.step(0.01)
    for name, value in solver.state_dict().items():
        assert value.tobytes() == other.state_dict()[name].tobytes(), name

    other.reset()
    fresh = SolverFEM(model).state_dict()
    for name, value in other.state_dict().items():
        assert value.tobytes() == fresh[name].tobytes(), name


def test_nothing_is_saved_where_nothing_yields() -> None:
    solver = SolverFEM(make_model(*tet_box((1, 1, 1), (1, 1, 1))))
    assert "plastic_strain" not in solver.state_dict()


def test_bad_constants_are_named() -> None:
    model, _ = bar()
    count = len(model.tets)
    for change, message in (
        ({"yield_stress": np.zeros(count)}, "yield stress must be > 0"),
        ({"hardening": np.full(count, -1.0)}, "hardening must be finite and >= 0"),
        ({"law": np.zeros(count, np.int32)}, 'only the law "stvk_hencky" can yield'),
    ):
        with pytest.raises(SolverError, match=message):
            SolverFEM(dataclasses.replace(model, **change))


def test_material_with_a_yield_stress_takes_hencky_s_law() -> None:
    plastic = {"young": 1e6, "poisson": 0.3, "density": 1000.0, "yield_stress": 1e4, "hardening": 1e3}
    material = Material.model_validate(plastic)
    assert material.model == "stvk_hencky" and material.law == HENCKY
    assert Material.model_validate_json(material.model_dump_json()) == material
    with pytest.raises(ValueError, match="needs the law"):
        Material.model_validate({**plastic, "model": "corotated"})
    for bad in (0.0, -1.0, math.inf, math.nan):
        with pytest.raises(ValueError):
            Material.model_validate({**plastic, "yield_stress": bad})


@pytest.mark.parametrize(
    "name", [name for name, values in PRESETS.items() if "yield_stress" in values and "model" not in values]
)
def test_presets_that_yield_do_so_at_small_strain(name: str) -> None:
    material = Material.model_validate(name)
    assert material.model == "stvk_hencky" and material.yield_stress is not None
    assert 1e-4 < material.yield_stress / material.young < 0.1
    assert material.hardening < 0.1 * material.young
    assert Material.model_validate({"preset": name, "yield_stress": None}).yield_stress is None
