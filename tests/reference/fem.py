"""A plain float64 finite element oracle: linear tets, stable neo-Hookean, scipy solves.

Written to be read, not to be fast. Formulas: Smith, de Goes & Kim 2018, eq. 13 without the logarithm, with
Lame-corrected constants; incremental potential of backward Euler (Martin et al. 2011, eq. 3).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import spsolve

BARRIER_J = 0.2


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(lambda, mu) in Pa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def cofactor(F: np.ndarray) -> np.ndarray:
    """d det F / dF."""
    a, b, c = F[:, 0], F[:, 1], F[:, 2]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)


def volumetric(J: float, lam: float, mu: float) -> tuple[float, float, float]:
    """U, U' and U'' of U(J) = -mu (J-1) + (lam+mu)/2 (J-1)^2 + barrier."""
    L = lam + mu
    u, du, ddu = -mu * (J - 1) + L / 2 * (J - 1) ** 2, -mu + L * (J - 1), L
    if J < BARRIER_J:
        k, c, log = 2 * L, J - BARRIER_J, np.log(J / BARRIER_J)
        u -= k * c * c * log
        du -= k * (2 * c * log + c * c / J)
        ddu -= k * (2 * log + 4 * c / J - (c / J) ** 2)
    return u, du, ddu


def energy_density(F: np.ndarray, lam: float, mu: float) -> float:
    """Psi(F), J/m^3."""
    return mu / 2 * (np.sum(F * F) - 3) + volumetric(np.linalg.det(F), lam, mu)[0]


def piola(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """dPsi/dF."""
    return mu * F + volumetric(np.linalg.det(F), lam, mu)[1] * cofactor(F)


def hessian(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """d2Psi/dF2, [9, 9] over F flattened row by row."""
    _, du, ddu = volumetric(np.linalg.det(F), lam, mu)
    g = cofactor(F).reshape(9)
    H = mu * np.eye(9) + ddu * np.outer(g, g)
    epsilon = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        epsilon[i, j, k], epsilon[i, k, j] = 1.0, -1.0
    # d2 det / dF_ij dF_kl = epsilon_ikm epsilon_jln F_mn
    H += du * np.einsum("ikm,jln,mn->ijkl", epsilon, epsilon, F).reshape(9, 9)
    return H


def project(H: np.ndarray) -> np.ndarray:
    """Nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh((H + H.T) / 2)
    return (vectors * np.maximum(values, 0.0)) @ vectors.T


@dataclass
class ReferenceFem:
    """One material on one mesh. vertices [P, 3] m, tets [T, 4], pinned [P] bool."""

    vertices: np.ndarray
    tets: np.ndarray
    young: float
    poisson: float
    density: float
    pinned: np.ndarray
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81)

    def __post_init__(self) -> None:
        self.lam, self.mu = lame(self.young, self.poisson)
        x = np.asarray(self.vertices, dtype=np.float64)
        shape = np.swapaxes(x[self.tets[:, 1:]] - x[self.tets[:, :1]], 1, 2)
        inverse = np.linalg.inv(shape)
        self.volume = np.linalg.det(shape) / 6
        self.gradients = np.concatenate([-inverse.sum(axis=1, keepdims=True), inverse], axis=1)  # [T, 4, 3]
        share = np.repeat(self.density * self.volume / 4, 4)
        self.mass = np.bincount(self.tets.reshape(-1), weights=share, minlength=len(x))

    def deformation_gradients(self, x: np.ndarray) -> np.ndarray:
        """[T, 3, 3]"""
        return np.einsum("eai,eaj->eij", x[self.tets], self.gradients)

    def elastic_energy(self, x: np.ndarray) -> float:
        """J"""
        densities = [energy_density(F, self.lam, self.mu) for F in self.deformation_gradients(x)]
        return float(np.dot(self.volume, densities))

    def elastic_gradient(self, x: np.ndarray) -> np.ndarray:
        """[P, 3] N"""
        out = np.zeros_like(x)
        for tet, F, g, volume in self._elements(x):
            np.add.at(out, tet, volume * g @ piola(F, self.lam, self.mu).T)
        return out

    def elastic_hessian(self, x: np.ndarray, *, projected: bool) -> csc_matrix:
        """[3P, 3P] N/m"""
        rows, columns, values = [], [], []
        for tet, F, g, volume in self._elements(x):
            H = hessian(F, self.lam, self.mu)
            if projected:
                H = project(H)
            block = volume * np.einsum("aj,ijkl,bl->aibk", g, H.reshape(3, 3, 3, 3), g).reshape(12, 12)
            ids = (3 * tet[:, None] + np.arange(3)).reshape(-1)
            rows.append(np.repeat(ids, 12))
            columns.append(np.tile(ids, 12))
            values.append(block.reshape(-1))
        n = 3 * len(x)
        parts = (np.concatenate(rows), np.concatenate(columns))
        return coo_matrix((np.concatenate(values), parts), shape=(n, n)).tocsc()

    def equilibrium(self, load: np.ndarray | None = None, iterations: int = 50) -> np.ndarray:
        """Static positions under gravity plus `load` [P, 3] N."""
        force = self.mass[:, None] * np.asarray(self.gravity) + (0.0 if load is None else load)
        return self._minimise(self.vertices.astype(np.float64), None, None, force, iterations)

    def step(self, x: np.ndarray, v: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """One backward Euler step; returns (x, v)."""
        y = x + dt * v + dt * dt * np.asarray(self.gravity)
        new = self._minimise(x, y, dt, np.zeros_like(x), 50)
        return new, (new - x) / dt

    def _minimise(
        self, x: np.ndarray, y: np.ndarray | None, dt: float | None, force: np.ndarray, iterations: int
    ) -> np.ndarray:
        free = np.flatnonzero(np.repeat(~self.pinned, 3))
        inertia = np.repeat(self.mass, 3) / dt**2 if dt else np.zeros(3 * len(x))
        target = x if y is None else y

        def energy(z: np.ndarray) -> float:
            if np.any(np.linalg.det(self.deformation_gradients(z)) <= 0):
                return np.inf
            kinetic = 0.5 * np.sum(inertia * (z - target).reshape(-1)[...] ** 2)
            return self.elastic_energy(z) + kinetic - float(np.sum(force * z))

        for _ in range(iterations):
            gradient = self.elastic_gradient(x).reshape(-1) + inertia * (x - target).reshape(-1)
            gradient = (gradient - force.reshape(-1))[free]
            H = self.elastic_hessian(x, projected=True)
            H.setdiag(H.diagonal() + inertia)
            move = np.zeros(3 * len(x))
            move[free] = spsolve(H[free][:, free], -gradient)
            if np.abs(move).max() < 1e-12:
                break
            length, start = 1.0, energy(x)
            while energy(x + length * move.reshape(-1, 3)) > start and length > 1e-6:
                length /= 2
            x = x + length * move.reshape(-1, 3)
        return x

    def _elements(self, x: np.ndarray):
        return zip(self.tets, self.deformation_gradients(x), self.gradients, self.volume, strict=True)


def uniaxial_lateral(stretch: float, young: float, poisson: float) -> tuple[float, float]:
    """(lateral stretch, axial first Piola stress) of a bar stretched freely: P_22 = 0 by bisection."""
    lam, mu = lame(young, poisson)

    def lateral_stress(s: float) -> float:
        return piola(np.diag([stretch, s, s]), lam, mu)[1, 1]

    low, high = 0.5, 2.0
    for _ in range(100):
        middle = (low + high) / 2
        if lateral_stress(middle) < 0:
            low = middle
        else:
            high = middle
    return low, piola(np.diag([stretch, low, low]), lam, mu)[0, 0]
