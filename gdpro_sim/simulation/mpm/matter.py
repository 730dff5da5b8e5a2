"""What MPM particles are made of: materials as rows of a table on the device, and what they ask of a step."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_laws
from gdpro_sim.materials import Material

NEVER = 1.0e30
"""Yield stress of what does not yield, Pa."""

OPENING = 0.02
"""Log of the volume gained over which wet sand loses its cohesion."""

VISCOUS_STEP = 0.25
"""Substep times kinematic viscosity over the squared grid spacing, at most.

Symplectic Euler with forces of velocity at the step's begin is stable while h^2 w^2 + 2 h d < 4 for a mode of
frequency w and damping rate d; a grid's largest d is 4 nu / dx^2.
"""


def flows(material: Material) -> bool:
    """Whether the elastic deformation gradient is not the whole deformation of a particle of it."""
    return material.mpm_only() is not None or material.yield_stress is not None


def sound_speed(material: Material) -> float:
    """Of pressure waves in matter at rest, m/s."""
    lam, mu = material.lame
    return math.sqrt((lam + 2.0 * mu) / material.density)


def largest_step(material: Material, spacing: float) -> float:
    """Longest substep that explicit viscosity is stable with on a grid of that spacing, s; inf: any.

    A particle without neighbours feels all three directions at once where it swells: its volume answers with
    3 lambda + 2 mu, more than the lambda + 2 mu of waves. The yielding of "herschel_bulkley" is implicit, and
    asks for none.
    """
    lam, mu = material.lame
    viscosity = material.rayleigh_stiffness * (3.0 * lam + 2.0 * mu)
    if material.model == "fluid":
        viscosity += 4.0 / 3.0 * material.viscosity
    if viscosity == 0.0:
        return math.inf
    return VISCOUS_STEP * spacing**2 * material.density / viscosity


class Matter:
    """The materials of a model's particles, on a device.

    materials: as `Particles.materials`
    table:     [materials, COLUMNS] float32 constants for `gdpro_sim.kernels.mpm_laws`
    flows:     whether any of them does, see `flows`

    Raises SolverError for materials that MPM cannot simulate.
    """

    def __init__(self, materials: tuple[Material, ...], device: str) -> None:
        for material in materials:
            if material.model == "linear":
                raise SolverError(
                    'the law "linear" means nothing for bodies that turn, and MPM bodies may: choose '
                    '"stable_neo_hookean", or the FEM solver'
                )
        self.materials = materials
        self.flows = any(flows(material) for material in materials)
        rows = np.zeros((max(len(materials), 1), int(mpm_laws.COLUMNS)), np.float32)
        for row, material in zip(rows, materials, strict=False):
            row[:] = _constants(material)
        self.table: wp.array = wp.array(rows, dtype=wp.float32, device=device)

    def largest_step(self, spacing: float) -> float:
        """That of all materials, see `largest_step`."""
        return min((largest_step(material, spacing) for material in self.materials), default=math.inf)

    @staticmethod
    def internal(matter: np.ndarray) -> np.ndarray:
        """[4, N] float32 rows INTERNAL of particles to which nothing has happened yet."""
        return np.zeros((4, len(matter)), np.float32)


def _constants(material: Material) -> np.ndarray:
    """A row of the table."""
    lam, mu = material.lame
    row = np.zeros(int(mpm_laws.COLUMNS))
    row[int(mpm_laws.LAW)] = material.law
    row[int(mpm_laws.MU)] = mu
    row[int(mpm_laws.LAM)] = lam
    row[int(mpm_laws.LIGHTNESS)] = 1.0 / material.density
    row[int(mpm_laws.DAMPING)] = material.rayleigh_stiffness
    row[int(mpm_laws.DRAG)] = material.rayleigh_mass
    row[int(mpm_laws.YIELD)] = NEVER if material.yield_stress is None else material.yield_stress
    row[int(mpm_laws.HARDENING)] = material.hardening
    if material.tensile_strength is not None:
        energy = material.fracture_energy or 0.0
        row[int(mpm_laws.STRENGTH)] = material.tensile_strength
        row[int(mpm_laws.BAND)] = energy * material.young / material.tensile_strength**2
    if material.model == "drucker_prager":
        assert material.friction_angle is not None
        angle = math.radians(material.friction_angle)
        tension = material.cohesion / math.tan(angle)  # of the cone's tip, Pa
        row[int(mpm_laws.A)] = math.sqrt(2.0 / 3.0) * 2.0 * math.sin(angle) / (3.0 - math.sin(angle))
        row[int(mpm_laws.B)] = tension / (lam + 2.0 / 3.0 * mu)
        row[int(mpm_laws.C)] = OPENING
    elif material.model == "snow":
        row[int(mpm_laws.A)] = material.critical_compression
        row[int(mpm_laws.B)] = material.critical_stretch
        row[int(mpm_laws.C)] = material.snow_hardening
    elif material.model == "herschel_bulkley":
        row[int(mpm_laws.A)] = math.log(material.viscosity)
        row[int(mpm_laws.B)] = material.flow_index
    elif material.model == "fluid":
        row[int(mpm_laws.A)] = material.viscosity
    return row


__all__ = ["Matter", "flows", "largest_step", "sound_speed"]
