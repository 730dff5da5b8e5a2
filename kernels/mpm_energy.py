"""Energy that MPM particles hold elastically, float64; `gdpro_sim.kernels.mpm_laws` has the stresses."""

from __future__ import annotations

import warp as wp

from gdpro_sim.kernels.decomposition import singular_value_decomposition
from gdpro_sim.kernels.elasticity import (
    COROTATED,
    NEO_HOOKEAN,
    STABLE_NEO_HOOKEAN,
    STVK_HENCKY,
    Constants,
    energy_density,
    piola_stress_in_frame,
)
from gdpro_sim.kernels.mpm_laws import FLUID, LAM, LAW, MU, SNOW, STRENGTH
from gdpro_sim.kernels.mpm_laws import C as HARDENING_OF_SNOW
from gdpro_sim.kernels.particles import DEFORMATION, DEFORMATION_LOW, INTERNAL, VOLUME, read_compensated

wp.set_module_options({"enable_backward": False})

GAMMA = wp.constant(wp.float64(7.0))
"""Of the fluid's equation of state."""


@wp.func
def fluid_energy(J: wp.float64, bulk: wp.float64) -> wp.float64:
    """Work of p = K / 7 (J^-7 - 1) from J = 1 on, J/m^3; none in the open."""
    one = wp.float64(1.0)
    if J >= one:
        return wp.float64(0.0)
    less = GAMMA - one
    return bulk / GAMMA * (wp.pow(J, -less) / less + J - GAMMA / less)


@wp.func
def intact_share(principal: wp.vec3d, damage: wp.float64) -> wp.float64:
    """Share of the energy that damage leaves: it weakens tension alone."""
    whole = wp.dot(principal, principal)
    if whole == wp.float64(0.0):
        return wp.float64(1.0)
    pulled = wp.float64(0.0)
    for i in range(3):
        t = wp.max(principal[i], wp.float64(0.0))
        pulled += t * t
    return wp.float64(1.0) - damage * pulled / whole


@wp.kernel
def elastic_energy(
    start: int,
    # In:
    matter: wp.array[wp.int32],
    table: wp.array2d[float],
    particles: wp.array2d[float],
    # Out:
    energy_out: wp.array[wp.float64],
):
    """Elastic energy of each particle, J; of a torn one about what is left."""
    i = start + wp.tid()
    row = matter[i]
    law = int(table[row, LAW])
    volume = wp.float64(particles[VOLUME, i])
    memory = wp.float64(particles[INTERNAL, i]) + wp.float64(particles[INTERNAL + 3, i])
    if law == FLUID:
        energy_out[i] = volume * fluid_energy(wp.float64(1.0) + memory, wp.float64(table[row, LAM]))
        return
    m = Constants()
    m.law = law
    if law == SNOW:
        m.law = COROTATED
    elif law != STABLE_NEO_HOOKEAN and law != NEO_HOOKEAN and law != COROTATED:
        m.law = STVK_HENCKY
    m.mu = wp.float64(table[row, MU])
    m.lam = wp.float64(table[row, LAM])
    m.limit = wp.float64(wp.inf)
    F = read_compensated(particles, DEFORMATION, DEFORMATION_LOW, i)
    U, s, V = singular_value_decomposition(F)
    density = energy_density(F, s, m)
    if law == SNOW:
        density *= wp.exp(-wp.float64(table[row, HARDENING_OF_SNOW]) * memory)
    if table[row, STRENGTH] > 0.0:
        S = wp.transpose(U) * piola_stress_in_frame(F, U, s, V, m) * V
        principal = wp.vec3d(S[0, 0] * s[0], S[1, 1] * s[1], S[2, 2] * s[2])
        density *= intact_share(principal, wp.float64(particles[INTERNAL + 2, i]))
    energy_out[i] = volume * density
