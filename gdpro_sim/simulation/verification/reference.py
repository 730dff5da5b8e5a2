"""A plain float64 finite element oracle: linear tets, stable neo-Hookean, scipy's direct solver.

It shares no code with the solver. Formulas: Smith, de Goes & Kim 2018, "Stable Neo-Hookean Flesh Simulation",
eq. 13 without the logarithm, with Lame-corrected constants; incremental potential of backward Euler (Martin
et al. 2011, eq. 3). Functions of F take [..., 3, 3].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

BARRIER_J = 0.2


def lame(young: float, poisson: float) -> tuple[float, float]:
    """(lambda, mu) in Pa."""
    return young * poisson / ((1 + poisson) * (1 - 2 * poisson)), young / (2 * (1 + poisson))


def cofactor(F: np.ndarray) -> np.ndarray:
    """d det F / dF."""
    a, b, c = F[..., 0, :], F[..., 1, :], F[..., 2, :]
    return np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=-2)


def volumetric(J: Any, lam: float, mu: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """U, U' and U'' of U(J) = -mu (J-1) + (lam+mu)/2 (J-1)^2 + barrier, for J > 0."""
    J = np.asarray(J, np.float64)
    L = lam + mu
    u, du, ddu = -mu * (J - 1) + L / 2 * (J - 1) ** 2, -mu + L * (J - 1), L + 0.0 * J
    k, c = 2 * L, np.minimum(J - BARRIER_J, 0.0)  # no barrier where c = 0
    log = np.log(np.minimum(J / BARRIER_J, 1.0))
    u = u - k * c * c * log
    du = du - k * (2 * c * log + c * c / J)
    ddu = ddu - k * (2 * log + 4 * c / J - (c / J) ** 2)
    return u, du, ddu


def energy_density(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """Psi(F), J/m^3."""
    return mu / 2 * (np.sum(F * F, axis=(-2, -1)) - 3) + volumetric(np.linalg.det(F), lam, mu)[0]


def piola(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """dPsi/dF."""
    return mu * F + volumetric(np.linalg.det(F), lam, mu)[1][..., None, None] * cofactor(F)


def hessian(F: np.ndarray, lam: float, mu: float) -> np.ndarray:
    """d2Psi/dF2, [..., 9, 9] over F flattened row by row."""
    _, du, ddu = (value[..., None, None] for value in volumetric(np.linalg.det(F), lam, mu))
    g = cofactor(F).reshape(*F.shape[:-2], 9)
    epsilon = np.zeros((3, 3, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        epsilon[i, j, k], epsilon[i, k, j] = 1.0, -1.0
    # d2 det / dF_ij dF_kl = epsilon_ikm epsilon_jln F_mn
    second = np.einsum("ikm,jln,...mn->...ijkl", epsilon, epsilon, F).reshape(*F.shape[:-2], 9, 9)
    outer: np.ndarray = g[..., :, None] * g[..., None, :]
    return mu * np.eye(9) + ddu * outer + du * second


def project(H: np.ndarray) -> np.ndarray:
    """Nearest positive semidefinite matrix."""
    values, vectors = np.linalg.eigh((H + np.swapaxes(H, -1, -2)) / 2)
    scaled: np.ndarray = vectors * np.maximum(values, 0.0)[..., None, :]
    return scaled @ np.swapaxes(vectors, -1, -2)


@dataclass
class ReferenceFem:
    """One material on one mesh. vertices [P, 3] m, tets [T, 4], pinned [P] bool, density one or [T]."""

    vertices: np.ndarray
    tets: np.ndarray
    young: float
    poisson: float
    density: float | np.ndarray
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
        """J; infinite where an element is inverted."""
        F = self.deformation_gradients(x)
        if np.any(np.linalg.det(F) <= 0.0):
            return float("inf")
        return float(self.volume @ energy_density(F, self.lam, self.mu))

    def elastic_gradient(self, x: np.ndarray) -> np.ndarray:
        """[P, 3] N"""
        P = piola(self.deformation_gradients(x), self.lam, self.mu)
        out = np.zeros_like(x)
        np.add.at(out, self.tets, np.einsum("e,eaj,eij->eai", self.volume, self.gradients, P))
        return out

    def elastic_hessian(self, x: np.ndarray, *, projected: bool) -> Any:
        """[3P, 3P] N/m, csc_matrix"""
        H = hessian(self.deformation_gradients(x), self.lam, self.mu)
        if projected:
            H = project(H)
        H = H.reshape(-1, 3, 3, 3, 3)
        g = self.gradients
        blocks = np.einsum("e,eaj,eijkl,ebl->eaibk", self.volume, g, H, g, optimize=True)
        ids = (3 * self.tets[:, :, None] + np.arange(3)).reshape(-1, 12)
        rows, columns = np.repeat(ids, 12, axis=1), np.tile(ids, (1, 12))
        n = 3 * len(x)
        parts = (rows.reshape(-1), columns.reshape(-1))
        return coo_matrix((blocks.reshape(-1), parts), shape=(n, n)).tocsc()

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
            kinetic = 0.5 * np.sum(inertia * (z - target).reshape(-1) ** 2)
            return self.elastic_energy(z) + float(kinetic) - float(np.sum(force * z))

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


__all__ = [
    "BARRIER_J",
    "ReferenceFem",
    "cofactor",
    "energy_density",
    "hessian",
    "lame",
    "piola",
    "project",
    "volumetric",
]
