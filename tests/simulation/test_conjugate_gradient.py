"""The linear solver: coupled blocks, and what it says of systems without a minimum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import bsr_matrix
from scipy.sparse.linalg import spsolve

from gdpro_sim.simulation.fem.potential import IncrementalPotential
from tests.simulation.fem_models import make_model, potential_at, tet_box

both_forms = pytest.mark.parametrize("serial", [True, False])


def box_potential(squeeze: float, h: float, serial: bool) -> IncrementalPotential:
    vertices, tets = tet_box((3, 3, 3), (0.5,) * 3)
    model = make_model(vertices, tets, young=1e5, poisson=0.3)
    potential = potential_at(model, vertices * np.array([1.0, 1.0, squeeze]), h, vertices)
    potential.system.serial = serial
    return potential


def couplings(count: int, seed: int) -> bsr_matrix:
    """Symmetric off-diagonal blocks between vertices that share no element."""
    rng = np.random.default_rng(seed)
    pairs = [(i, count - 1 - i) for i in range(8)]
    blocks = 50.0 * rng.normal(size=(len(pairs), 3, 3))
    dense = np.zeros((count, count, 3, 3))
    for (i, j), block in zip(pairs, blocks, strict=True):
        dense[i, j], dense[j, i] = block, block.T
    full = bsr_matrix(dense.transpose(0, 2, 1, 3).reshape(3 * count, -1), blocksize=(3, 3))
    full.sort_indices()
    return full


@both_forms
def test_coupled_blocks_are_part_of_the_matrix(serial: bool) -> None:
    potential = box_potential(0.95, 1 / 120, serial)
    system = potential.system
    potential.linearise(potential.trial)
    alone = system.matrix().toarray()
    extra = couplings(system.rows, 2)
    for blocks, expected in ((extra, alone + extra.toarray()), (None, alone)):
        system.couple(blocks)
        assert np.array_equal(system.matrix().toarray(), expected)
        assert system.solve(1e-11, 2000)[1:] == (True, True)
        solution = spsolve(system.matrix().tocsc(), system.right_hand_side.numpy().reshape(-1))
        error = np.abs(system.solution.numpy().reshape(-1) - solution).max()
        assert error <= 1e-8 * np.abs(solution).max()
        rest = system.right_hand_side.numpy() - system.product(system.solution.numpy())
        assert (
            np.abs(rest - system.residual.numpy()).max()
            <= 1e-8 * np.abs(system.right_hand_side.numpy()).max()
        )


@both_forms
def test_a_system_without_a_minimum_is_reported(serial: bool) -> None:
    potential = box_potential(0.5, 10.0, serial)
    potential.linearise(potential.trial, exact=True)
    assert np.linalg.eigvalsh(potential.system.matrix().toarray()).min() < 0.0
    report = potential.system.solve(1e-8, 2000)
    assert not report.definite and not report.converged and report.iterations < 2000

    potential.linearise(potential.trial)
    report = potential.system.solve(1e-8, 2000)
    assert report.definite and report.converged


@both_forms
def test_no_load_needs_no_iteration(serial: bool) -> None:
    potential = box_potential(1.0, 1 / 120, serial)
    potential.linearise(potential.trial)
    potential.system.right_hand_side.zero_()
    assert potential.system.solve(1e-8, 100) == (0, True, True)
    assert not potential.system.solution.numpy().any()
