"""Elements eight at a time: decompositions in lanes, and groups that are not full."""

from __future__ import annotations

import numpy as np
import pytest

from gdpro_sim.kernels import element_lanes as lanes
from tests.simulation.fem_models import make_model, potential_at

TET = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def decomposed(gradients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """F, U, s and V of at most one group of elements."""
    count = len(gradients)
    tets = np.arange(4 * count, dtype=np.int32).reshape(-1, 4)
    model = make_model(np.tile(TET, (count, 1)), tets)
    potential = potential_at(model, np.einsum("eij,aj->eai", gradients, TET).reshape(-1, 3))
    potential.differentiate_elements(potential.trial)
    work = potential._work.numpy()[: int(lanes.WORK) * lanes.LANES].reshape(-1, lanes.LANES)[:, :count].T

    def matrix(slot: int) -> np.ndarray:
        return work[:, slot : slot + 9].reshape(-1, 3, 3)

    values = work[:, lanes.S_SLOT : lanes.S_SLOT + 3]
    return matrix(lanes.F_SLOT), matrix(lanes.U_SLOT), values, matrix(lanes.V_SLOT)


def turned(stretches: list[list[float]], seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    turns = np.linalg.qr(rng.normal(size=(2, len(stretches), 3, 3)))[0]
    turns *= np.sign(np.linalg.det(turns))[..., None, None]
    return np.einsum("eij,ej,ekj->eik", turns[0], np.array(stretches), turns[1])


@pytest.mark.parametrize(
    "stretches",
    [
        [[1.0, 1.0, 1.0]],
        [[3.0, 1.0, 0.2], [1.0, 1.0, 1.0], [1.0 + 1e-9, 1.0, 1.0 - 1e-9], [2.0, 2.0, 0.5], [2.0, 0.5, 0.5]],
        [[1e3, 1.0, 1e-3], [1e-4, 1e-4, 1e-4], [1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [2.0, 1.0, -0.5]]
        + [[1] * 3] * 3,
    ],
)
def test_decompositions_are_exact(stretches: list[list[float]]) -> None:
    gradients = turned(stretches, len(stretches))
    F, U, s, V = decomposed(gradients)
    assert np.abs(F - gradients).max() <= 1e-12 * np.abs(gradients).max()
    for rotation in (U, V):
        assert np.abs(np.einsum("eji,ejk->eik", rotation, rotation) - np.eye(3)).max() <= 1e-9
        assert np.linalg.det(rotation) == pytest.approx(1.0, abs=1e-9)
    rebuilt = np.einsum("eij,ej,ekj->eik", U, s, V)
    size = np.abs(gradients).max(axis=(1, 2), keepdims=True)
    assert np.all(np.abs(rebuilt - F) <= 1e-9 * size)
    # Descending; the smallest carries the sign of det F.
    assert np.abs(np.abs(s) - np.linalg.svd(F, compute_uv=False)).max() <= 1e-9 * np.abs(s).max()
    assert np.all(s[:, :2] >= 0.0)


def test_a_group_that_is_not_full_gives_what_a_full_one_gives() -> None:
    gradients = turned([[1.2, 1.0, 0.7]] * 8, 3)
    whole = decomposed(gradients)
    for count in (1, 3, 7):
        for part, full in zip(decomposed(gradients[:count]), whole, strict=True):
            assert np.abs(part - full[:count]).max() <= 1e-12
