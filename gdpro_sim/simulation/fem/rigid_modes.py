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
        self._pieces = [_as_slice(np.flatnonzero(labels == k)) for k in np.flatnonzero(~held)]

    def correct(self, system: ConjugateGradient, x: np.ndarray, negligible: float) -> bool:
        """Add the missing rigid motions to `system.solution`; whether there were any.

        x: [P, 3] m, where the system was linearised. Nothing is done while the accelerations that the
        residual force and torque of every piece could cause stay below `negligible` m/s^2.
        """
        residual = system.residual.numpy()
        frames = [self._frame(x, piece) for piece in self._pieces]
        if all(
            self._acceleration(residual[piece], *frame) <= negligible
            for piece, frame in zip(self._pieces, frames, strict=True)
        ):
            return False
        basis = system.six
        for piece, (_, arms, radius) in zip(self._pieces, frames, strict=True):
            basis[piece] = rigid_basis(arms / radius)
        product = system.product_six()
        solution = system.solution.numpy()
        for piece in self._pieces:
            z = basis[piece].reshape(-1, 6)
            stiffness = z.T @ product[piece].reshape(-1, 6)
            load = z.T @ residual[piece].reshape(-1)
            amounts = np.linalg.lstsq(0.5 * (stiffness + stiffness.T), load, rcond=1e-14)[0]
            solution[piece] += (z @ amounts).reshape(-1, 3)
        if system.device != "cpu":  # on the CPU `solution` is the array itself
            system.solution.assign(solution)
        return True

    def _frame(self, x: np.ndarray, piece: np.ndarray | slice) -> tuple[float, np.ndarray, float]:
        """Mass of a piece, its vertices relative to the centre of mass [n, 3], and its radius of gyration."""
        mass = self._mass[piece]
        total = float(mass.sum())
        arms = x[piece] - (mass @ x[piece]) / total
        return total, arms, max(float(np.sqrt(np.einsum("i,ij,ij", mass, arms, arms) / total)), 1e-30)

    @staticmethod
    def _acceleration(force: np.ndarray, mass: float, arms: np.ndarray, radius: float) -> float:
        """Size of the acceleration that forces [n, 3] would give a rigid piece, spin included, m/s^2."""
        products = np.einsum("ni,nj->ij", arms, force)
        turn = np.linalg.norm(products - products.T) / np.sqrt(2.0)
        return float(np.linalg.norm(force.sum(0)) + turn / radius) / mass


def _as_slice(ids: np.ndarray) -> np.ndarray | slice:
    """Ascending ids, as a slice where they are consecutive: NumPy then copies nothing."""
    first, last = int(ids[0]), int(ids[-1])
    return slice(first, last + 1) if last - first + 1 == len(ids) else ids


def rigid_basis(arms: np.ndarray) -> np.ndarray:
    """Three unit translations and three rotations e_k x arm, [n, 3, 6] for arms [n, 3]."""
    basis = np.zeros((len(arms), 3, 6))
    for k in range(3):
        i, j = (k + 1) % 3, (k + 2) % 3
        basis[:, k, k] = 1.0
        basis[:, i, 3 + k] = -arms[:, j]
        basis[:, j, 3 + k] = arms[:, i]
    return basis


__all__ = ["RigidModes"]
