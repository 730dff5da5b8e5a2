"""The linear solver: coupled blocks, and what it says of systems without a minimum."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.sparse import bsr_matrix
from scipy.sparse.linalg import spsolve

from gdpro_sim.simulation.fem.potential import IncrementalPotential
from tests.reference.linear import gauss_seidel_cg
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
        six = np.random.default_rng(4).normal(size=(system.rows, 3, 6))
        system.six[:] = six
        product = system.product_six().reshape(-1, 6)
        assert np.abs(product - expected @ six.reshape(-1, 6)).max() <= 1e-12 * np.abs(product).max()
        assert system.solve(1e-11, 2000)[1:] == (True, True)
        solution = spsolve(system.matrix().tocsc(), system.right_hand_side.numpy().reshape(-1))
        error = np.abs(system.solution.numpy().reshape(-1) - solution).max()
        assert error <= 1e-8 * np.abs(solution).max()
        rest = system.right_hand_side.numpy() - system.product(system.solution.numpy())
        assert (
            np.abs(rest - system.residual.numpy()).max()
            <= 1e-8 * np.abs(system.right_hand_side.numpy()).max()
        )


@pytest.mark.parametrize("poisson", [0.3, 0.48])
def test_sweeps_take_the_steps_of_the_textbook(poisson: float) -> None:
    vertices, tets = tet_box((2, 3, 3), (0.4, 0.5, 0.5))
    pinned = vertices[:, 2] < 1e-6
    model = make_model(vertices, tets, young=1e5, poisson=poisson, pinned=pinned)
    system = (potential := potential_at(model, vertices * [1.0, 1.0, 0.95], 1 / 120, vertices)).system
    assert system.serial
    potential.linearise(potential.trial)
    system.couple(couplings(system.rows, 3))
    count = system.rows
    whole = np.stack([system.product(row.reshape(-1, 3)).ravel() for row in np.eye(3 * count)])
    free = np.repeat(~pinned, 3)
    within = whole[np.ix_(free, free)]
    loads = system.right_hand_side.numpy().reshape(-1)[free]
    # L is that of the fixed pattern: neither coupled blocks nor averaged pressure belong to it.
    system.couple(None)
    pattern = system.matrix().toarray()[np.ix_(free, free)]
    blocks = np.arange(len(pattern)) // 3
    upper = np.where(blocks[:, None] < blocks[None], pattern, 0.0)
    diagonal = np.linalg.inv(system.inverse_diagonal.numpy()[~pinned])
    system.couple(couplings(system.rows, 3))
    assert len(system._change) == (count if poisson > 0.45 else 0)
    for steps in (1, 2, 7):
        expected = gauss_seidel_cg(within, diagonal, upper, loads, steps)
        assert system.solve(1e-14, steps).iterations == steps
        found = system.solution.numpy()
        assert not found[pinned].any()
        assert np.abs(found.reshape(-1)[free] - expected).max() <= 1e-9 * np.abs(expected).max()


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
