"""Matter for the MPM benchmarks."""

from __future__ import annotations

import dataclasses

import numpy as np

from gdpro_sim.materials import Material
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.verification.mpm_models import Points, jittered, lattice, make_model

MATERIALS = {
    "neo-Hookean": Material(model="neo_hookean", young=1e6, poisson=0.3, density=1000.0),
    "corotated": Material(model="corotated", young=1e6, poisson=0.3, density=1000.0),
    "von Mises": Material(
        model="stvk_hencky", young=1e6, poisson=0.3, density=1000.0, yield_stress=5e3, hardening=1e4
    ),
    "sand": Material(model="drucker_prager", young=1e6, poisson=0.3, density=1600.0, friction_angle=35.0),
    "snow": Material(model="snow", young=1.4e5, poisson=0.2, density=400.0),
    "fluid": Material(model="fluid", young=3e6, poisson=0.0, bulk_modulus=1e6, density=1000.0),
    "viscoplastic": Material(
        model="herschel_bulkley",
        young=1e6,
        poisson=0.3,
        density=1000.0,
        yield_stress=1e3,
        viscosity=50.0,
        flow_index=0.5,
    ),
    "damage": Material(
        model="neo_hookean",
        young=1e6,
        poisson=0.3,
        density=1000.0,
        tensile_strength=5e3,
        fracture_energy=100.0,
    ),
}
"""What flows or tears begins to within a few substeps of `moving_cube`."""


def moving_cube(
    count: int, *materials: Material, kernel: str = "quadratic", floor: bool = True, device: str = "cpu"
) -> Model:
    """About `count` particles, 8 a cell, in a cube of 0.5 m that is pressed together along z and turns.

    Several materials alternate from one particle to the next. The cube stands on a floor, or flies.
    """
    edge = max(2, round(count ** (1.0 / 3.0)))
    points = jittered(lattice((0.5, 0.5, 0.5), (edge,) * 3), 0.125 / edge)
    x, y, z = (points.positions - points.positions.mean(axis=0)).T
    model = make_model(
        points,
        materials,
        dx=1.0 / edge,
        velocities=np.stack([4.0 * x, 4.0 * y - 2.0 * z, 2.0 * y - 8.0 * z], axis=1),
        matter=np.arange(len(points)) % len(materials),
        ground=Ground() if floor else None,
        kernel=kernel,
    )
    return dataclasses.replace(model, device=device)


__all__ = ["MATERIALS", "Points", "moving_cube"]
