"""Closed forms and small boundary value problems of beam theory: a horizontal cantilever of square section.

Sources: Timoshenko & Gere, "Mechanics of Materials"; Cowper 1966, J. Appl. Mech. 33 (shear coefficient);
Timoshenko & Goodier, "Theory of Elasticity", 3rd ed., section 109 (torsion); Bisshopp & Drucker 1945,
Quart. Appl. Math. 3, and Rohde 1953, ibid. 11 (the elastica under a tip load and its own weight).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.integrate import solve_bvp
from scipy.linalg import eigh

STANDARD_GRAVITY = 9.81


@dataclass(frozen=True)
class Beam:
    """Lengths in m, Young's modulus in Pa, density in kg/m^3; clamped at 0, free at `length`."""

    length: float
    side: float
    young: float
    poisson: float
    density: float

    @property
    def bending(self) -> float:
        """EI, N m^2."""
        return self.young * self.side**4 / 12.0

    @property
    def shear(self) -> float:
        """kappa G A, N, with Cowper's kappa = 10 (1 + nu) / (12 + 11 nu) of a rectangle."""
        kappa = 10.0 * (1.0 + self.poisson) / (12.0 + 11.0 * self.poisson)
        return kappa * self.rigidity * self.side**2

    @property
    def rigidity(self) -> float:
        """G, Pa."""
        return self.young / (2.0 * (1.0 + self.poisson))

    @property
    def weight(self) -> float:
        """N/m"""
        return self.density * STANDARD_GRAVITY * self.side**2

    def sag(self) -> float:
        """Timoshenko's deflection of the tip under the beam's own weight, m."""
        w, L = self.weight, self.length
        return w * L**4 / (8.0 * self.bending) + w * L**2 / (2.0 * self.shear)

    def tip_deflection(self, force: float, at: float) -> float:
        """Timoshenko's deflection of the tip under `force` N at distance `at` m from the clamp, m."""
        bent = force * at**2 * (3.0 * self.length - at) / (6.0 * self.bending)
        return bent + force * at / self.shear

    def torque(self, angle: float) -> float:
        """Saint-Venant's torque of the section turned by `angle` rad over the length, N m."""
        return 0.140577 * self.rigidity * self.side**4 * angle / self.length

    def frequencies(self, count: int, elements: int = 400) -> np.ndarray:
        """Lowest bending frequencies with shear and rotary inertia (Timoshenko 1921), Hz.

        Two-node elements with the shear strain at their middle, which do not lock.
        """
        ell = self.length / elements
        n = 2 * (elements + 1)  # deflection and rotation of every node
        K, M = np.zeros((n, n)), np.zeros((n, n))
        shear = np.array([-1.0 / ell, -0.5, 1.0 / ell, -0.5])
        curvature = np.array([0.0, -1.0 / ell, 0.0, 1.0 / ell])
        stiffness = ell * self.shear * np.outer(shear, shear)
        stiffness += ell * self.bending * np.outer(curvature, curvature)
        area, inertia = self.side**2, self.side**4 / 12.0
        consistent = np.array([[2.0, 1.0], [1.0, 2.0]]) * self.density * ell / 6.0
        mass = np.kron(consistent, np.diag([area, inertia]))
        for e in range(elements):
            ids = slice(2 * e, 2 * e + 4)
            K[ids, ids] += stiffness
            M[ids, ids] += mass
        values = eigh(K[2:, 2:], M[2:, 2:], eigvals_only=True, subset_by_index=[0, count - 1])
        return np.sqrt(values) / (2.0 * np.pi)

    def elastica(self, force: float = 0.0, *, heavy: bool = True) -> tuple[float, float]:
        """Tip (reach, drop) m of the inextensible beam under `force` N down at the tip and its own weight.

        EI theta'' = -(force + w (L - s)) cos theta, theta(0) = 0, theta'(L) = 0; theta points down.
        """
        w, L = self.weight if heavy else 0.0, self.length

        def rates(s: np.ndarray, y: np.ndarray) -> np.ndarray:
            pull = -(force + w * (L - s)) * np.cos(y[0]) / self.bending
            return np.vstack([y[1], pull, np.cos(y[0]), np.sin(y[0])])

        def ends(a: np.ndarray, b: np.ndarray) -> np.ndarray:
            return np.array([a[0], b[1], a[2], a[3]])

        s = np.linspace(0.0, L, 101)
        guess = np.vstack([s / L, (1.0 - s / L) / L, s, 0.0 * s])
        found = solve_bvp(rates, ends, s, guess, tol=1e-8, max_nodes=20000)
        if not found.success:
            raise RuntimeError(f"the elastica's boundary value problem: {found.message}")
        return float(found.y[2, -1]), float(found.y[3, -1])


__all__ = ["STANDARD_GRAVITY", "Beam"]
