"""The implicit solver against known answers: no contact here."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.topology import build_topology
from gdpro_sim.simulation.model import Body, Ground, Solver
from tests.reference.fem import ReferenceFem
from tests.simulation.fem_models import make_model, potential_at, tet_box

TIGHT = {"newton_tolerance": 1e-8, "cg_tolerance": 1e-8}


def total_energy(solver: SolverFEM) -> float:
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


def test_satisfies_the_solver_protocol() -> None:
    assert isinstance(SolverFEM(make_model(*tet_box((1, 1, 1), (1, 1, 1)))), Solver)


def test_assembled_matrix_matches_the_reference() -> None:
    vertices, tets = tet_box((2, 2, 2), (0.5, 0.4, 0.3))
    model = make_model(vertices, tets, young=1e5, poisson=0.375)
    x = model.vertices + 0.02 * np.random.default_rng(0).normal(size=vertices.shape)
    potential = potential_at(model, x, 0.01)
    potential.linearise(potential.trial)
    oracle = ReferenceFem(model.vertices, tets, 1e5, 0.375, 1000.0, model.pinned)
    expected = oracle.elastic_hessian(x, projected=True).toarray()
    expected += np.diag(np.repeat(oracle.mass, 3) / 0.01**2)
    assert np.abs(potential.system.matrix().toarray() - expected).max() <= 1e-9 * np.abs(expected).max()


def test_topology_lists_every_pair_once() -> None:
    _, tets = tet_box((2, 1, 1), (1, 1, 1))
    topology = build_topology(tets, 12)
    pairs = {(i, j) for tet in tets.tolist() for i in tet for j in tet}
    rows = np.repeat(np.arange(12), np.diff(topology.offsets))
    assert list(zip(rows.tolist(), topology.columns.tolist(), strict=True)) == sorted(pairs)
    assert np.array_equal(topology.columns[topology.diagonal], np.arange(12))
    assert np.array_equal(topology.columns[topology.upper], rows[topology.lower])


def test_patch_affine_deformation_has_no_interior_force() -> None:
    vertices, tets = tet_box((3, 3, 3), (0.5, 0.5, 0.5))
    # Move interior vertices so that the elements differ.
    inside = np.all((vertices > 1e-9) & (vertices < 0.5 - 1e-9), axis=1)
    vertices[inside] += 0.02 * np.random.default_rng(0).normal(size=(int(inside.sum()), 3))
    model = make_model(vertices, tets, young=1e5, gravity=(0, 0, 0))
    A = np.array([[1.2, 0.1, 0.0], [0.05, 0.9, -0.1], [0.0, 0.2, 1.1]])
    potential = potential_at(model, model.vertices.astype(np.float64) @ A.T, 1.0)
    potential.linearise(potential.trial)
    force = np.linalg.norm(potential.system.right_hand_side.numpy(), axis=1)
    assert inside.sum() == 8
    assert force[inside].max() <= 1e-5 * force[~inside].max()


def test_free_fall_is_exact() -> None:
    vertices, tets = tet_box((2, 2, 2), (0.5, 0.5, 0.5), (0, 0, 10.0))
    solver = SolverFEM(make_model(vertices, tets, young=1e5))
    mass = 1000.0 * 0.5**3
    for _ in range(30):
        solver.step(1 / 60)
    v = solver.velocities
    assert np.abs(v - [0, 0, -9.81 * 0.5]).max() <= 1e-5 * 9.81 * 0.5
    assert solver.diagnostics().momentum == pytest.approx((0, 0, -mass * 9.81 * 0.5), rel=1e-5, abs=1e-3)
    # Backward Euler: x = -g dt^2 n (n + 1) / 2 after n steps.
    fallen = 9.81 * (1 / 120) ** 2 * 60 * 61 / 2
    assert np.abs(solver.positions - (vertices.astype(np.float32) - [0, 0, fallen])).max() < 1e-5
    assert solver.diagnostics().converged


def test_steps_match_the_reference() -> None:
    vertices, tets = tet_box((3, 1, 1), (0.6, 0.2, 0.2))
    pinned = vertices[:, 0] == 0.0
    velocities = np.where(pinned[:, None], 0.0, [0.3, 0.5, 0.0])
    model = make_model(
        vertices, tets, young=2e4, poisson=0.375, pinned=pinned, velocities=velocities, substeps=1, **TIGHT
    )
    solver = SolverFEM(model)
    oracle = ReferenceFem(model.vertices, tets, 2e4, 0.375, 1000.0, pinned)
    x, v = model.vertices.astype(np.float64), model.velocities.astype(np.float64)
    for _ in range(5):
        solver.step(1 / 60)
        x, v = oracle.step(x, v, 1 / 60)
    assert np.abs(x - vertices).max() > 0.04
    assert np.abs(solver.positions - x).max() < 1e-6


def test_cantilever_sags_like_the_reference_on_the_same_mesh() -> None:
    vertices, tets = tet_box((10, 2, 2), (1.0, 0.2, 0.2))
    pinned = vertices[:, 0] == 0.0
    model = make_model(vertices, tets, young=1e7, poisson=0.3, pinned=pinned, substeps=1)
    oracle = ReferenceFem(model.vertices, tets, 1e7, float(np.float32(0.3)), 1000.0, pinned)
    tip = np.isclose(vertices[:, 0], 1.0)
    expected = (vertices - oracle.equilibrium())[tip, 2].mean()
    # Linear tets lock: 0.0251 m on the measured 200-tet mesh against 0.0383 m in theory.
    assert 0.015 < expected < 0.038
    solver = SolverFEM(model)
    for _ in range(60):
        solver.step(0.1)
    sag = (vertices - solver.positions)[tip, 2].mean()
    assert sag == pytest.approx(expected, rel=0.01)


def test_first_bending_mode_of_a_cantilever() -> None:
    """Released along the mode's shape, it rings at the frequency of the reference's matrices."""
    from scipy.sparse import diags
    from scipy.sparse.linalg import eigsh

    vertices, tets = tet_box((10, 2, 2), (1.0, 0.2, 0.2))
    pinned = vertices[:, 0] == 0.0
    free = np.flatnonzero(np.repeat(~pinned, 3))
    oracle = ReferenceFem(vertices, tets, 1e7, 0.3, 1000.0, pinned)
    K = oracle.elastic_hessian(vertices, projected=False)[free][:, free]
    M = diags(np.repeat(oracle.mass, 3)[free]).tocsc()
    values, modes = eigsh(K, k=1, M=M, sigma=0.0)
    frequency = float(np.sqrt(values[0])) / (2 * np.pi)
    # Theory says 3.231 Hz; linear tets lock, so a coarse mesh rings higher.
    assert 3.231 < frequency < 4.5

    mode = np.zeros(vertices.size)
    mode[free] = modes[:, 0] * (0.1 / np.abs(modes[:, 0]).max())
    velocities = mode.reshape(-1, 3)
    model = make_model(
        vertices, tets, young=1e7, pinned=pinned, velocities=velocities, gravity=(0, 0, 0), substeps=1
    )
    solver = SolverFEM(model)
    dt, track = 0.004, []
    for _ in range(100):
        solver.step(dt)
        track.append(float(np.sum((solver.positions - vertices) * velocities)))
    signs = np.flatnonzero(np.diff(np.sign(track)) != 0)
    crossings = [i + track[i] / (track[i] - track[i + 1]) for i in signs]
    measured = 1.0 / (2.0 * dt * float(np.mean(np.diff(crossings))))
    assert measured == pytest.approx(frequency, rel=0.02)


def test_backward_euler_damping_of_a_linear_mode() -> None:
    """The energy of a linear mode falls by 1 / (1 + w^2 dt^2) per step."""
    tet_vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]])
    tets = np.array([[0, 1, 2, 3]], dtype=np.int32)
    pinned = np.array([True, True, True, False])
    model = make_model(
        tet_vertices,
        tets,
        young=1e6,
        pinned=pinned,
        velocities=np.array([[0, 0, 0], [0, 0, 0], [0, 0, 0], [0, 0, 1e-3]]),
        gravity=(0, 0, 0),
        substeps=1,
        newton_tolerance=1e-10,
        cg_tolerance=1e-10,
    )
    solver = SolverFEM(model)
    oracle = ReferenceFem(tet_vertices, tets, 1e6, 0.3, 1000.0, pinned)
    stiffness = oracle.elastic_hessian(tet_vertices, projected=False).toarray()[11, 11]
    omega = np.sqrt(stiffness / oracle.mass[3])
    dt = 0.3 / omega
    energies = [total_energy(solver)]
    for _ in range(10):
        solver.step(dt)
        energies.append(total_energy(solver))
    ratio = np.array(energies[1:]) / energies[:-1]
    assert ratio == pytest.approx(1.0 / (1.0 + 0.3**2), rel=0.02)


def test_energy_never_rises_and_momentum_is_conserved_without_forces() -> None:
    vertices, tets = tet_box((3, 3, 3), (0.4, 0.4, 0.4))
    centre = vertices - 0.2
    spin = np.cross([0.0, 0.0, 5.0], centre) + np.array([1.0, -0.5, 0.25])
    wobble = 2.0 * centre * [1.0, -1.0, 0.5]
    solver = SolverFEM(
        make_model(
            vertices, tets, young=1e5, velocities=spin + wobble, gravity=(0, 0, 0), rayleigh_stiffness=1e-3
        )
    )
    start, energy = np.array(solver.diagnostics().momentum), total_energy(solver)
    for _ in range(60):
        solver.step(1 / 60)
        now = total_energy(solver)
        assert now <= energy
        energy = now
    d = solver.diagnostics()
    assert np.abs(np.array(d.momentum) - start).max() <= 1e-5 * np.abs(start).max()
    centre_of_mass = np.average(solver.positions, axis=0, weights=solver._potential.mass)
    spin_left = np.array(d.angular_momentum) - np.cross(centre_of_mass, d.momentum)
    assert 0.0 < spin_left[2] < 1000.0 * 0.4**5 / 6 * 5.0 * 1.1
    assert d.min_volume_ratio > 0.5


def test_rayleigh_mass_damping_slows_a_free_body_exactly() -> None:
    vertices, tets = tet_box((1, 1, 1), (0.3, 0.3, 0.3))
    velocities = np.tile([2.0, 0.0, 0.0], (len(vertices), 1))
    model = make_model(
        vertices, tets, velocities=velocities, gravity=(0, 0, 0), rayleigh_mass=3.0, substeps=1, **TIGHT
    )
    solver = SolverFEM(model)
    for _ in range(10):
        solver.step(0.01)
    assert solver.velocities[:, 0] == pytest.approx(2.0 / 1.03**10, rel=1e-6)


def test_stiffness_damping_keeps_angular_momentum_better_than_energy() -> None:
    """Damping acts on strain rate alone: a damped spinning body loses no more spin than an undamped one."""
    vertices, tets = tet_box((2, 2, 2), (0.4, 0.4, 0.4))
    velocities = np.cross([0.0, 0.0, 3.0], vertices - 0.2)
    spins = []
    for damping in (0.0, 2e-3):
        model = make_model(
            vertices, tets, young=1e5, velocities=velocities, gravity=(0, 0, 0), rayleigh_stiffness=damping
        )
        solver = SolverFEM(model)
        for _ in range(30):
            solver.step(1 / 60)
        spins.append(solver.diagnostics().angular_momentum[2])
    assert spins[1] == pytest.approx(spins[0], rel=0.01)


def test_pinned_vertices_never_move() -> None:
    vertices, tets = tet_box((3, 1, 1), (0.6, 0.2, 0.2))
    pinned = vertices[:, 0] == 0.0
    velocities = -np.ones_like(vertices)
    solver = SolverFEM(make_model(vertices, tets, young=1e4, pinned=pinned, velocities=velocities))
    for _ in range(10):
        solver.step(1 / 60)
    assert np.array_equal(solver.positions[pinned], vertices.astype(np.float32)[pinned].astype(np.float64))
    assert np.all(solver.velocities[pinned] == 0.0)
    assert solver.positions[~pinned, 2].min() < -0.02


def test_fill_scales_mass_and_stiffness() -> None:
    vertices, tets = tet_box((4, 1, 1), (0.6, 0.2, 0.2))
    pinned = vertices[:, 0] == 0.0
    model = make_model(vertices, tets, young=1e5, pinned=pinned, **TIGHT)
    half = dataclasses.replace(model, fill=np.full(len(tets), 0.5, np.float32))
    full_solver, half_solver = SolverFEM(model), SolverFEM(half)
    for solver in (full_solver, half_solver):
        for _ in range(5):
            solver.step(1 / 60)
    # Half the mass and half the stiffness move alike.
    assert np.abs(full_solver.positions - half_solver.positions).max() < 1e-7
    assert half_solver.diagnostics().kinetic_energy == pytest.approx(
        full_solver.diagnostics().kinetic_energy / 2, rel=1e-5
    )


def test_unused_vertices_stay_and_do_no_harm() -> None:
    vertices, tets = tet_box((1, 1, 1), (0.3, 0.3, 0.3), (0, 0, 1))
    vertices = np.vstack([vertices, [[9.0, 9.0, 9.0]]])
    solver = SolverFEM(make_model(vertices, tets, ground=Ground()))
    solver.step(1 / 60)
    assert np.array_equal(solver.positions[-1], [9.0, 9.0, 9.0])
    assert np.isfinite(solver.positions).all()


def test_surface_follows_the_embedding_and_is_exact_at_rest() -> None:
    from gdpro_sim.meshing.tetmesh import Embedding

    vertices, tets = tet_box((1, 1, 1), (0.3, 0.3, 0.3), (0, 0, 1))
    rng = np.random.default_rng(0)
    embedding = Embedding(
        tet_ids=rng.integers(0, len(tets), 20).astype(np.int32),
        weights=rng.dirichlet(np.ones(4), 20).astype(np.float32),
    )
    surface = np.einsum("va,vai->vi", embedding.weights, vertices[tets[embedding.tet_ids]]).astype(np.float32)
    model = make_model(vertices, tets)
    body = Body("box", None, surface, embedding, (0, len(vertices)), (0, len(tets)))  # type: ignore[arg-type]
    solver = SolverFEM(dataclasses.replace(model, bodies=(body,)))
    assert np.array_equal(solver.surface_positions(0), surface)
    for _ in range(6):
        solver.step(1 / 60)
    fallen = solver.positions[0, 2] - vertices[0, 2]
    assert solver.surface_positions(0) == pytest.approx(surface + np.array([0, 0, fallen]), abs=1e-6)
    assert solver.surface_positions(0).dtype == np.float32


def test_bad_input_is_refused() -> None:
    vertices, tets = tet_box((1, 1, 1), (1, 1, 1))
    flipped = tets.copy()
    flipped[3] = flipped[3][[1, 0, 2, 3]]
    with pytest.raises(SolverError, match="element 3 has volume -"):
        SolverFEM(make_model(vertices, flipped))
    solver = SolverFEM(make_model(vertices, tets))
    for dt in (0.0, -1.0, float("nan")):
        with pytest.raises(SolverError, match="step length"):
            solver.step(dt)


def test_a_failed_step_leaves_the_state_as_it_was() -> None:
    vertices, tets = tet_box((1, 1, 1), (1, 1, 1))
    solver = SolverFEM(make_model(vertices, tets))
    solver.step(1 / 60)
    broken = solver.state_dict()
    broken["velocities"][0, 0] = np.nan
    solver.load_state_dict(broken)
    with pytest.raises(SolverError, match="no finite solution"):
        solver.step(1 / 60)
    after = solver.state_dict()
    for name, value in broken.items():
        assert value.tobytes() == after[name].tobytes(), name
