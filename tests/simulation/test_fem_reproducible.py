"""Same bytes again: any thread count, any form of the linear solver, after a restart; and CUDA builds."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import colliders, elasticity, fem, linalg
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.conjugate_gradient import ConjugateGradient
from gdpro_sim.simulation.model import Ground, Model
from tests.simulation.fem_models import make_model, potential_at, tet_box


def drop_model(cells: int = 4, device: str = "cpu", young: float = 1e5) -> Model:
    vertices, tets = tet_box((cells,) * 3, (0.5,) * 3, (0, 0, 0.05))
    velocities = np.tile([1.0, 0.0, -3.0], (len(vertices), 1))
    return make_model(
        vertices,
        tets,
        young=young,
        poisson=0.4,
        rayleigh_stiffness=1e-3,
        velocities=velocities,
        ground=Ground(),
        device=device,
    )


def state_bytes(solver: SolverFEM) -> dict[str, bytes]:
    return {name: value.tobytes() for name, value in solver.state_dict().items()}


@pytest.fixture
def restore_threads() -> Iterator[None]:
    count = devices.thread_count()
    yield
    devices.set_thread_count(count)


@pytest.mark.parametrize("serial", [True, False])
def test_thread_count_does_not_change_a_byte(serial: bool, restore_threads: None) -> None:
    results = []
    for threads in (1, 2, 3):
        devices.set_thread_count(threads)
        solver = SolverFEM(drop_model(6))
        solver._potential.system.serial = serial
        for _ in range(4):
            solver.step(1 / 60)
        results.append(state_bytes(solver))
    assert results[0] == results[1] == results[2]


def test_both_forms_of_conjugate_gradients_agree_with_scipy() -> None:
    from scipy.sparse.linalg import spsolve

    model = drop_model()
    solutions = []
    for serial in (True, False):
        potential = potential_at(model, model.vertices * np.array([1.1, 1.0, 0.9]), 1 / 120, model.vertices)
        system: ConjugateGradient = potential.system
        system.serial = serial
        potential.linearise(potential.trial)
        report = system.solve(1e-10, 1000)
        assert report.converged and 5 < report.iterations < 200
        solutions.append(system.solution.numpy().copy())
        expected = spsolve(system.matrix().tocsc(), system.right_hand_side.numpy().reshape(-1))
        assert np.abs(solutions[-1].reshape(-1) - expected).max() <= 1e-7 * np.abs(expected).max()
    assert np.abs(solutions[0] - solutions[1]).max() <= 1e-9 * np.abs(solutions[0]).max()


def test_iteration_cap_is_reported() -> None:
    rest = drop_model().vertices
    potential = potential_at(drop_model(), rest * np.array([1.1, 1.0, 0.9]), 1 / 120, rest)
    potential.linearise(potential.trial)
    for serial in (True, False):
        potential.system.serial = serial
        report = potential.system.solve(1e-10, 3)
        assert report == (3, False, True)


def test_unconverged_steps_say_so(caplog: pytest.LogCaptureFixture) -> None:
    import dataclasses

    model = drop_model()
    starved = dataclasses.replace(model, fem=dataclasses.replace(model.fem, newton_iterations=1))
    solver = SolverFEM(starved)
    for _ in range(4):
        solver.step(1 / 60)
        if not solver.diagnostics().converged:
            break
    d = solver.diagnostics()
    assert not d.converged and d.substeps > 2
    assert d.residual > model.fem.newton_tolerance
    assert "did not converge" in caplog.text
    assert np.isfinite(solver.positions).all()


def test_restart_continues_to_the_same_bytes(tmp_path: Path) -> None:
    first = SolverFEM(drop_model())
    for _ in range(6):
        first.step(1 / 60)
    np.savez(tmp_path / "state.npz", **first.state_dict())
    saved_diagnostics = first.diagnostics()
    for _ in range(6):
        first.step(1 / 60)

    second = SolverFEM(drop_model())
    with np.load(tmp_path / "state.npz", allow_pickle=False) as archive:
        second.load_state_dict(dict(archive))
    assert second.diagnostics() == saved_diagnostics
    for _ in range(6):
        second.step(1 / 60)
    assert state_bytes(first) == state_bytes(second)
    assert first.diagnostics() == second.diagnostics()


def test_reset_starts_over_to_the_same_bytes() -> None:
    solver = SolverFEM(drop_model())
    before = state_bytes(solver)
    for _ in range(5):
        solver.step(1 / 60)
    after = state_bytes(solver)
    solver.reset()
    assert state_bytes(solver) == before
    for _ in range(5):
        solver.step(1 / 60)
    assert state_bytes(solver) == after


def test_foreign_states_are_refused() -> None:
    solver = SolverFEM(drop_model())
    state = SolverFEM(drop_model(3)).state_dict()
    with pytest.raises(SolverError, match="another scene"):
        solver.load_state_dict(state)
    state = solver.state_dict()
    del state["terms.0.anchors"]
    with pytest.raises(SolverError, match=r"terms\.0\.anchors"):
        solver.load_state_dict(state)


def test_steps_allocate_no_device_arrays(monkeypatch: pytest.MonkeyPatch) -> None:
    solver = SolverFEM(drop_model())
    solver.step(1 / 60)

    def refuse(*_args: object, **_options: object) -> None:
        raise AssertionError("a step allocated a Warp array")

    for name in ("zeros", "empty", "clone", "zeros_like", "empty_like"):
        monkeypatch.setattr(wp, name, refuse)
    for _ in range(5):
        solver.step(1 / 60)


def test_no_module_builds_backward_kernels() -> None:
    for module in (linalg, elasticity, colliders, fem):
        assert wp.get_module_options(module)["enable_backward"] is False


@pytest.mark.cuda
def test_cuda_agrees_with_the_cpu() -> None:
    if not wp.get_cuda_devices():
        pytest.skip("no CUDA device here")
    results = []
    for device in ("cpu", "cuda:0"):
        solver = SolverFEM(drop_model(device=device))
        for _ in range(30):
            solver.step(1 / 60)
            assert solver.diagnostics().converged
        results.append(solver.positions)
    # Not bytes: sums are taken in another order. Newton's tolerance bounds the drift over these frames.
    assert np.abs(results[0] - results[1]).max() < 2e-3


@pytest.mark.cuda
def test_cuda_is_deterministic() -> None:
    if not wp.get_cuda_devices():
        pytest.skip("no CUDA device here")
    results = []
    for _ in range(2):
        solver = SolverFEM(drop_model(6, device="cuda:0"))
        for _ in range(10):
            solver.step(1 / 60)
        results.append(state_bytes(solver))
    assert results[0] == results[1]
