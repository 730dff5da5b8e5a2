"""What materials ask of a step and of the solver: viscous bounds, tables, matter that tears."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from gdpro_sim.errors import SolverError
from gdpro_sim.materials import PRESETS, Material
from gdpro_sim.simulation.model import Model, MpmSettings, Particles
from gdpro_sim.simulation.mpm.matter import Matter, flows, largest_step, sound_speed
from gdpro_sim.simulation.mpm.solver import SolverMPM

BASE = {"young": 1.0e5, "poisson": 0.3, "density": 1000.0}


def test_steps_of_viscous_materials_are_bounded() -> None:
    assert largest_step(Material(model="neo_hookean", **BASE), 0.1) == math.inf
    honey = Material.model_validate("honey")
    bulk_viscosity = honey.rayleigh_stiffness * honey.lame[0]
    expected = 0.25 * 1e-4 * honey.density / (4 / 3 * honey.viscosity + 3 * bulk_viscosity)
    assert largest_step(honey, 0.01) == pytest.approx(expected)
    jelly = Material.model_validate("jelly")
    lam, mu = jelly.lame
    expected = 0.25 * 1e-4 * jelly.density / (jelly.rayleigh_stiffness * (3 * lam + 2 * mu))
    assert largest_step(jelly, 0.01) == pytest.approx(expected)
    assert Matter((honey, jelly), "cpu").largest_step(0.01) == pytest.approx(
        min(largest_step(honey, 0.01), expected)
    )


def test_matter_of_presets() -> None:
    assert {name for name in PRESETS if flows(Material.model_validate(name))} >= {
        "sand", "wet_sand", "fresh_snow", "water", "honey", "toothpaste", "shaving_foam", "mud", "dough",
        "tearing_bread", "plasticine", "steel",
    }  # fmt: skip
    assert not flows(Material.model_validate("jelly"))
    matter = Matter(tuple(Material.model_validate(name) for name in PRESETS), "cpu")
    assert np.isfinite(matter.table.numpy()).all() and matter.flows
    assert not Matter.internal(np.zeros(5, np.int32)).any()


def test_linear_elasticity_is_refused() -> None:
    with pytest.raises(SolverError, match='"linear" means nothing for bodies that turn'):
        Matter((Material(model="linear", **BASE),), "cpu")


def block(
    material: Material,
    size: tuple[float, float, float],
    dx: float,
    velocities: Callable[[np.ndarray], np.ndarray],
) -> SolverMPM:
    """Eight particles to a cell, without gravity; `velocities` of places."""
    spacing = dx / 2
    axes = [np.arange(spacing / 2, length, spacing) for length in size]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3).astype(np.float32)
    n = len(points)
    cloud = Particles(
        positions=points,
        velocities=velocities(points).astype(np.float32),
        volumes=np.full(n, spacing**3, np.float32),
        matter=np.zeros(n, np.int32),
        materials=(material,),
        spacing=spacing,
    )
    return SolverMPM(Model.without_tets(cloud, gravity=(0.0, 0.0, 0.0), mpm=MpmSettings(grid_spacing=dx)))


@pytest.mark.parametrize(("speed", "tears"), [(1.5, True), (0.3, False)])
def test_bread_pulled_apart_tears_in_two(speed: float, tears: bool) -> None:
    bread = Material.model_validate("tearing_bread")
    solver = block(bread, (0.4, 0.1, 0.1), 0.025, lambda x: np.outer(x[:, 0] - 0.2, [1, 0, 0]) * speed / 0.2)
    solver.step(0.3)
    x = np.sort(solver.positions[:, 0])
    gap = np.diff(x)
    if tears:
        # Two halves and nothing between them.
        assert gap.max() > 0.1 and abs(np.argmax(gap) + 1 - len(x) / 2) < 0.1 * len(x)
    else:
        assert gap.max() < 0.014 and np.ptp(x) < 0.42


@pytest.mark.parametrize(
    "material",
    [
        Material(model="fluid", bulk_modulus=1e4, viscosity=300.0, density=1e3),
        Material(young=1e4, poisson=0.3, density=1e3, rayleigh_stiffness=0.3),
    ],
)
def test_steps_of_viscous_matter_are_stable(material: Material) -> None:
    """Where viscosity, not sound, bounds the substep, random motion dies away."""
    random = np.random.default_rng(0)
    solver = block(material, (0.3, 0.3, 0.3), 0.05, lambda x: 0.1 * random.standard_normal(x.shape))
    solver.step(0.02)
    first = solver.diagnostics().kinetic_energy
    assert solver.matter.largest_step(0.05) < 0.3 * 0.05 / sound_speed(material)
    for _ in range(4):
        solver.step(0.02)
    assert solver.diagnostics().kinetic_energy <= 1.01 * first


def test_a_lone_particle_of_damped_matter_falls_as_it_is() -> None:
    """Without neighbours it swells in all directions at once, which is stiffer than waves are."""
    jelly = Material.model_validate("jelly")
    x = np.array([[0.011, 0.023, 0.5], [0.3, 0.2, 0.6]], np.float32)
    material = np.zeros(2, np.int32)
    matter = Particles(x, np.zeros_like(x), np.full(2, 2.8e-7, np.float32), material, (jelly,), 6.6e-3)
    solver = SolverMPM(Model.without_tets(matter))
    solver.step(0.1)
    assert solver.diagnostics().elastic_energy < 1e-12
    assert np.abs(np.linalg.det(solver.deformations) - 1.0).max() < 1e-5
