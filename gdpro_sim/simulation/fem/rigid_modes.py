"""The rigid part of a Newton step, solved exactly.

Conjugate gradients reduce the stiff part of the residual first. In a stiff body a loose tolerance is reached
before the six rigid motions, whose stiffness is only m / dt^2 and what the ground adds, have moved at all:
the step is then tiny, looks converged, and the body hangs in the air. One Galerkin correction per Newton step
on the space Z of every free piece's rigid motions, c = (Z^T A Z)^-1 Z^T (b - A d), d <- d + Z c, puts them
back (two-level correction; Tang, Nabben, Vuik & Erlangga, J. Sci. Comput. 39 (2009), eq. 2.4). It lowers the
quadratic model, so d stays a descent direction.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from gdpro_sim.simulation.fem.conjugate_gradient import ConjugateGradient


class RigidModes:
    """Corrects solutions of one `ConjugateGradient` system.

    tets:  [T, 4]; pieces are its connected components
    mass:  [P] kg
    fixed: [P] bool; a piece with a fixed vertex has no rigid motion
    """

    def __init__(self, tets: np.ndarray, mass: np.ndarray, fixed: np.ndarray) -> None:
        count = len(mass)
        rows, columns = tets[:, [0, 1, 2]].ravel(), tets[:, [1, 2, 3]].ravel()
        graph = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
        pieces, labels = connected_components(graph, directed=False)
        held = np.bincount(labels, weights=fixed | (mass <= 0.0), minlength=pieces) > 0
        self._mass = mass
        self._pieces = [np.flatnonzero(labels == k) for k in np.flatnonzero(~held)]

    def correct(self, system: ConjugateGradient, x: np.ndarray, negligible: float) -> None:
        """Add the missing rigid motions to `system.solution`.

        x: [P, 3] m, where the system was linearised. Nothing is done while the accelerations that the
        residual force and torque of every piece could cause stay below `negligible` m/s^2.
        """
        residual = system.residual.numpy()
        modes = [self._modes(x, piece) for piece in self._pieces]
        loads = [np.einsum("nki,ni->k", z, residual[p]) for z, p in zip(modes, self._pieces, strict=True)]
        # Columns of a mode set have unit length in the mass norm: the load is a generalised acceleration.
        largest = max(
            (
                np.linalg.norm(load) / np.sqrt(self._mass[p].sum())
                for load, p in zip(loads, self._pieces, strict=True)
            ),
            default=0.0,
        )
        if largest <= negligible:
            return
        basis = np.zeros((len(x), 3, 6))
        for z, piece in zip(modes, self._pieces, strict=True):
            basis[piece] = np.swapaxes(z, 1, 2)
        product = (system.matrix() @ basis.reshape(-1, 6)).reshape(len(x), 3, 6)
        solution = system.solution.numpy()
        for z, piece, load in zip(modes, self._pieces, loads, strict=True):
            stiffness = np.einsum("nki,nil->kl", z, product[piece])
            amounts = np.linalg.lstsq(0.5 * (stiffness + stiffness.T), load, rcond=1e-14)[0]
            solution[piece] += np.einsum("nki,k->ni", z, amounts)
        if system.device != "cpu":  # on the CPU `solution` is the array itself
            system.solution.assign(solution)

    def _modes(self, x: np.ndarray, piece: np.ndarray) -> np.ndarray:
        """Three translations and three rotations of a piece [n, 6, 3], of unit length in the mass norm."""
        mass, points = self._mass[piece], x[piece]
        arms = points - (mass[:, None] * points).sum(0) / mass.sum()
        modes = np.zeros((len(piece), 6, 3))
        modes[:, (0, 1, 2), (0, 1, 2)] = 1.0
        for k in range(3):
            modes[:, 3 + k] = np.cross(np.eye(3)[k], arms)
        return modes / np.sqrt(np.einsum("n,nki,nki->k", mass, modes, modes))[None, :, None]


__all__ = ["RigidModes"]
