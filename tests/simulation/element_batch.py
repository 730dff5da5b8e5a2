"""Single elements by the batch, deformed as a test says: their energies, forces and Hessians."""

from __future__ import annotations

import dataclasses
import itertools
import math

import numpy as np
import warp as wp

from gdpro_sim.kernels import elements
from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.verification.closed_forms import lame
from tests.simulation.fem_models import make_model, potential_at

TET = np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.05], [0.0, 0.25, 0.0], [0.05, 0.1, 0.2]], dtype=np.float32)
# Exact in float32, which is what a model stores.
YOUNG, POISSON, DAMPING = 1e5, 0.375, 0.0078125
LAM, MU = lame(YOUNG, POISSON)


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))


def with_stretches(stretches: list[tuple[float, float, float]], seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return np.array([random_rotation(rng) @ np.diag(s) @ random_rotation(rng) for s in stretches])


def random_gradients(count: int, seed: int = 0) -> np.ndarray:
    """Deformation gradients with positive determinant: near rest, stretched, crushed into the barrier."""
    rng = np.random.default_rng(seed)
    sizes = rng.choice([0.02, 0.2, 0.7, 1.0, 1.3, 3.0], size=(count, 3)) * rng.uniform(0.9, 1.1, (count, 3))
    return with_stretches([tuple(s) for s in sizes], seed)


SPECIAL = [
    (1.0, 1.0, 1.0),
    (1.0 + 1e-9, 1.0, 1.0 - 1e-9),  # nearly equal
    (1.5, 1.5, 1.5),
    (2.0, 2.0, 0.5),
    (2.0, 2.0 - 1e-12, 0.5),
    (0.5, 0.5 + 1e-7, 3.0),
    (1.0, 1.0, 0.01),  # flat
    (1.0, 1e-3, 1e-3),  # a line
    (1e-2, 1e-2, 1e-2),  # a point
    (10.0, 0.3, 0.3),
]


class Batch:
    """One element per deformation gradient, no mass, no contact."""

    def __init__(
        self,
        gradients: np.ndarray,
        law: str = "stable_neo_hookean",
        *,
        rayleigh_stiffness: float = 0.0,
        yield_stress: float = math.inf,
        hardening: float = 0.0,
    ) -> None:
        count = len(gradients)
        vertices = np.tile(TET, (count, 1))
        tets = np.arange(4 * count, dtype=np.int32).reshape(-1, 4)
        model = make_model(
            vertices, tets, young=YOUNG, poisson=POISSON, rayleigh_stiffness=rayleigh_stiffness
        )
        model = dataclasses.replace(
            model,
            law=np.full(count, LAWS.index(law), np.int32),
            yield_stress=np.full(count, yield_stress),
            hardening=np.full(count, hardening),
        )
        self.potential = potential_at(model)
        self.rest = vertices.reshape(-1, 4, 3).astype(np.float64)
        self.x = self.positions(gradients)
        edges = (TET[1:] - TET[:1]).astype(np.float64)
        self.volume = float(np.linalg.det(edges)) / 6.0
        inverse = np.linalg.inv(edges.T)
        self.shape = np.concatenate([-inverse.sum(axis=0, keepdims=True), inverse])  # grad N_a, [4, 3]

    def positions(self, gradients: np.ndarray) -> np.ndarray:
        return np.einsum("eij,eaj->eai", gradients, self.rest)

    def energies(self, x: np.ndarray, inverse_dt: float = 0.0) -> np.ndarray:
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p._evaluate_elements(array, inverse_dt)
        return p._energies.numpy()[: len(x)].copy()

    def derivatives(
        self, x: np.ndarray, inverse_dt: float = 0.0, *, exact: bool = False
    ) -> tuple[np.ndarray, np.ndarray]:
        """Gradient [T, 4, 3] and Hessian [T, 12, 12], projected unless `exact`."""
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p._inverse_h = inverse_dt
        p.differentiate_elements(array, exact=exact)
        blocks = p._element_blocks.numpy().reshape(-1, 10, 3, 3)
        full = np.zeros((len(x), 4, 3, 4, 3))
        for slot, (a, b) in enumerate(itertools.combinations_with_replacement(range(4), 2)):
            full[:, a, :, b, :] = blocks[:, slot]
            full[:, b, :, a, :] = np.swapaxes(blocks[:, slot], 1, 2)
        return p.element_gradient.numpy().reshape(-1, 4, 3).copy(), full.reshape(-1, 12, 12)

    def gradient(self, x: np.ndarray) -> np.ndarray:
        """Gradient [T, 4, 3] from the kernel that computes nothing else."""
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p.over_elements(
            elements.element_gradient, [p.elements, array, p._cauchy_green, 0.0], [p.element_gradient]
        )
        return p.element_gradient.numpy().reshape(-1, 4, 3).copy()

    def stresses(self) -> np.ndarray:
        """First Piola stresses [T, 3, 3] from nodal forces: sum_a f_a (x) X_a = V P."""
        gradients, _ = self.derivatives(self.x)
        return np.einsum("eai,eaj->eij", gradients, self.rest) / self.volume

    def expected_hessian(self, H: np.ndarray) -> np.ndarray:
        """[12, 12] of an element from dP/dF [9, 9]."""
        g = self.shape
        return self.volume * np.einsum("aj,ijkl,bl->aibk", g, H.reshape(3, 3, 3, 3), g).reshape(12, 12)

    def set_previous(self, x: np.ndarray) -> None:
        p = self.potential
        array = wp.array(x.reshape(-1, 3), dtype=wp.vec3d, device="cpu")
        p.over_elements(
            elements.element_cauchy_green, [p.elements, array, 1.0, array, 0.0], [p._cauchy_green]
        )
