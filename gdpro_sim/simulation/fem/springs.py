"""Springs and attachments as a term of the incremental potential."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from gdpro_sim.kernels import springs as kernels
from gdpro_sim.simulation.conditions import Springs
from gdpro_sim.simulation.fem.force_term import (
    ForceTerm,
    ever_free,
    grouped,
    integers,
    stable_frequency,
    vectors,
)
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model


class SpringForces(ForceTerm):
    """Every spring of a model. Implements `gdpro_sim.simulation.fem.term.Term`."""

    def __init__(self, model: Model, rest: RestShapes, springs: Springs) -> None:
        self._size = len(model.vertices)
        owner, vertex, share = _shares(springs)
        touched, slots = np.unique(vertex, return_inverse=True)
        super().__init__(model, touched)
        self.energies = len(springs.stiffness)
        device = model.device
        self._springs = kernels.Springs()
        self._springs.corners = wp.array(
            np.ascontiguousarray(springs.corners.reshape(-1, 4), np.int32), dtype=wp.vec4i, device=device
        )
        self._springs.weights = wp.array(
            np.ascontiguousarray(springs.weights.reshape(-1, 4), np.float64), dtype=wp.vec4d, device=device
        )
        self._springs.anchor = vectors(springs.anchors.reshape(-1, 3), device)
        self._springs.stiffness = reals(springs.stiffness, device)
        self._springs.rest_length = reals(springs.rest_length, device)
        self._springs.damping = reals(springs.damping, device)
        offsets, order = grouped(slots, len(touched))
        self._offsets = integers(offsets, device)
        self._owner = integers(owner[order], device)
        self._share = reals(share[order], device)
        self._gradient = wp.zeros(self.energies, dtype=wp.vec3d, device=device)
        self._hessian = wp.zeros(self.energies, dtype=wp.mat33d, device=device)
        self._energies = wp.zeros(self.energies, dtype=wp.float64, device=device)
        self._base = wp.zeros(self._size, dtype=wp.vec3d, device=device)
        self._inverse_h = 0.0
        self._couple(owner, vertex, share)
        self.frequency = _frequency(model, rest, springs, owner, vertex, share)

    def begin(self, step: Step) -> None:
        self._base, self._inverse_h = step.base, 1.0 / step.h

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        inputs = [first, self._springs, x, self._base, self._inverse_h]
        self.launch(kernels.spring_energy, self.energies, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        inputs = [self._springs, x, self._base, self._inverse_h]
        self.launch(kernels.spring_derivatives, self.energies, inputs, [self._gradient, self._hessian])
        inputs = [self.vertices, self._offsets, self._owner, self._share, self._gradient, self._hessian]
        self.launch(kernels.gather_springs, self.count, inputs, [gradient, block])
        if not len(self._columns):
            return None
        blocks = self._product[:, None, None] * self._hessian.numpy()[self._pair_owner]
        data = np.add.reduceat(blocks, self._first, axis=0)
        size = 3 * self._size
        return sparse.bsr_matrix((data, self._columns, self._rows), shape=(size, size))

    def stored(self, x: wp.array) -> float:
        self.launch(kernels.spring_energy, self.energies, [0, self._springs, x, x, 0.0], [self._energies])
        return float(self._energies.numpy().sum())

    def _couple(self, owner: np.ndarray, vertex: np.ndarray, share: np.ndarray) -> None:
        """Block rows over the pairs of vertices that one spring joins, and what adds into each block."""
        starts = np.flatnonzero(np.diff(owner, prepend=-1))
        width = np.diff(starts, append=len(owner))[owner] if len(owner) else np.zeros(0, int)
        first = np.repeat(np.arange(len(owner)), width)
        second = np.arange(len(first)) - np.repeat(np.cumsum(width) - width, width) + starts[owner[first]]
        apart = first != second
        first, second = first[apart], second[apart]
        order = np.lexsort((owner[first], vertex[second], vertex[first]))
        first, second = first[order], second[order]
        self._pair_owner = owner[first]
        self._product = share[first] * share[second]
        keys, self._first = np.unique(vertex[first] * self._size + vertex[second], return_index=True)
        self._columns = (keys % self._size).astype(np.int32)
        counts = np.bincount(keys // self._size, minlength=self._size)
        self._rows = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def _shares(springs: Springs) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """d(span)/d(vertex) of every vertex of every spring, ascending: spring [n], vertex [n], share [n]."""
    count = len(springs.stiffness)
    signed = springs.weights.astype(np.float64) * np.array([-1.0, 1.0])[None, :, None]
    table = sparse.coo_matrix(
        (signed.reshape(-1), (np.repeat(np.arange(count), 8), springs.corners.reshape(-1))),
        shape=(count, int(springs.corners.max(initial=0)) + 1),
    ).tocsr()
    table.sum_duplicates()
    table.eliminate_zeros()
    table.sort_indices()
    owner = np.repeat(np.arange(count), np.diff(table.indptr))
    return owner, table.indices.astype(np.int64), table.data


def _frequency(
    model: Model,
    rest: RestShapes,
    springs: Springs,
    owner: np.ndarray,
    vertex: np.ndarray,
    share: np.ndarray,
) -> float:
    """From the row sums of the stiffness matrix (Gershgorin)."""
    reach = np.bincount(owner, weights=np.abs(share), minlength=len(springs.stiffness))
    size = len(model.vertices)
    stiffness, damping = (
        np.bincount(vertex, weights=(values * reach)[owner] * np.abs(share), minlength=size)
        for values in (springs.stiffness, springs.damping)
    )
    return stable_frequency(stiffness, damping, ever_free(model), rest)


__all__ = ["SpringForces"]
