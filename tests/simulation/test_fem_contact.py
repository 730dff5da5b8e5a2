"""Ground contact, friction, and survival of rough handling."""

from __future__ import annotations

import numpy as np
import pytest

from gdpro_sim.materials import Material
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from tests.simulation.fem_models import make_model, tet_box

SIZE = 0.5
DIAGONAL = SIZE * 3**0.5


def box_on_ground(height: float = 0.0, cells: int = 3, **options) -> tuple[SolverFEM, np.ndarray]:
    vertices, tets = tet_box((cells,) * 3, (SIZE,) * 3, (0, 0, height))
    return SolverFEM(make_model(vertices, tets, ground=Ground(), **options)), vertices


def total_energy(solver: SolverFEM) -> float:
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


def run(solver: SolverFEM, frames: int, fps: float = 60.0) -> None:
    """Step and require what must hold in any run: finite, uninverted, converged, energy never up."""
    energy = total_energy(solver)
    scale = max(abs(energy), 1.0)
    for _ in range(frames):
        solver.step(1 / fps)
        d = solver.diagnostics()
        assert np.isfinite(solver.positions).all()
        assert d.min_volume_ratio > 0.0
        assert d.converged
        now = total_energy(solver)
        assert now <= energy + 1e-9 * scale
        energy = now


@pytest.mark.parametrize(("young", "settling"), [(1e4, 360), (1e5, 200), (1e7, 60)])
def test_comes_to_rest_and_stays(young: float, settling: int) -> None:
    solver, _ = box_on_ground(young=young, rayleigh_stiffness=2e-2, rayleigh_mass=2.0)
    run(solver, settling)
    d = solver.diagnostics()
    assert 0 < d.contacts
    assert d.max_penetration < 1e-3 * SIZE
    before = solver.positions
    run(solver, 60)
    assert np.abs(solver.positions - before).max() < 1e-4 * SIZE
    assert np.abs(solver.velocities).max() < 1e-4


def test_rest_penetration_of_presets_is_small() -> None:
    for preset in ("jelly", "rubber", "foam", "wood"):
        material = Material(preset=preset)
        solver, _ = box_on_ground(
            young=material.young,
            poisson=material.poisson,
            density=material.density,
            rayleigh_stiffness=material.rayleigh_stiffness,
        )
        run(solver, 20)
        assert solver.diagnostics().max_penetration < 1e-3 * SIZE, preset


def test_starting_slightly_below_the_ground_pushes_out_gently() -> None:
    solver, _ = box_on_ground(height=-0.002, young=1e6, rayleigh_stiffness=1e-3)
    run(solver, 60)
    d = solver.diagnostics()
    assert d.max_penetration < 1e-3 * SIZE
    assert solver.positions[:, 2].max() < SIZE + 0.05


def tilted(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))


def test_sticks_below_the_friction_angle_without_creep() -> None:
    """atan 0.5 = 26.57 degrees."""
    solver, vertices = box_on_ground(young=1e6, friction=0.5, gravity=tilted(25.0), rayleigh_stiffness=1e-2)
    run(solver, 60)
    settled = solver.positions[:, 0].mean()
    assert settled - vertices[:, 0].mean() < 0.01
    run(solver, 60)
    assert solver.positions[:, 0].mean() - settled < 1e-5


@pytest.mark.parametrize("friction", [0.0, 0.5])
def test_slides_above_the_friction_angle(friction: float) -> None:
    """a = g (sin - mu cos) at 35 degrees, backward Euler position included."""
    solver, _ = box_on_ground(young=1e7, friction=friction, gravity=tilted(35.0), rayleigh_stiffness=1e-2)
    run(solver, 30)
    start = solver.velocities[:, 0].mean()
    run(solver, 30)
    measured = (solver.velocities[:, 0].mean() - start) / 0.5
    angle = np.radians(35.0)
    expected = 9.81 * (np.sin(angle) - friction * np.cos(angle))
    assert measured == pytest.approx(expected, rel=0.02)


def test_sliding_box_stops_where_coulomb_says() -> None:
    vertices, _ = tet_box((3, 3, 3), (SIZE,) * 3)
    speed = np.tile([2.0, 0.0, 0.0], (len(vertices), 1))
    solver, _ = box_on_ground(young=1e7, friction=0.5, velocities=speed, rayleigh_stiffness=1e-2)
    run(solver, 50)
    assert np.abs(solver.velocities).max() < 1e-2
    travelled = solver.positions[:, 0].mean() - vertices[:, 0].mean()
    assert travelled == pytest.approx(2.0**2 / (2 * 0.5 * 9.81), rel=0.05)


def test_thrown_and_spinning_box_lands() -> None:
    vertices, _ = tet_box((3, 3, 3), (SIZE,) * 3, (0, 0, 0.5))
    centre = vertices - vertices.mean(axis=0)
    velocities = np.cross([3.0, 5.0, 1.0], centre) + np.array([4.0, 0.0, 1.0])
    solver, _ = box_on_ground(height=0.5, young=1e5, poisson=0.45, velocities=velocities)
    run(solver, 60)
    assert solver.diagnostics().max_penetration < 1e-2 * SIZE
    assert solver.positions[:, 0].mean() > 1.0


@pytest.mark.parametrize("fps", [60, 24])
@pytest.mark.parametrize("poisson", [0.3, 0.45, 0.49])
@pytest.mark.parametrize("young", [1e4, 1e5, 1e6, 1e7])
def test_survives_a_drop_from_one_metre(young: float, poisson: float, fps: int) -> None:
    solver, _ = box_on_ground(height=1.0, cells=2, young=young, poisson=poisson)
    run(solver, int(0.8 * fps), fps)
    d = solver.diagnostics()
    assert solver.positions[:, 2].min() < 0.5
    assert d.max_penetration < 1e-2 * SIZE


@pytest.mark.parametrize("preset", ["wood", "ceramic", "aluminium", "steel"])
def test_survives_a_drop_of_a_stiff_preset(preset: str) -> None:
    material = Material(preset=preset)
    solver, _ = box_on_ground(
        height=1.0,
        young=material.young,
        poisson=material.poisson,
        density=material.density,
        friction=material.friction,
        rayleigh_stiffness=material.rayleigh_stiffness,
    )
    run(solver, 48)
    d = solver.diagnostics()
    assert d.min_volume_ratio > 0.99
    assert d.max_penetration < 1e-3 * SIZE


def test_survives_being_crushed() -> None:
    """Thrown at the floor at 30 m/s, far more energy than the material can store."""
    vertices, _ = tet_box((3, 3, 3), (SIZE,) * 3, (0, 0, 0.1))
    velocities = np.tile([0.0, 0.0, -30.0], (len(vertices), 1))
    solver, _ = box_on_ground(height=0.1, young=1e4, poisson=0.4, velocities=velocities)
    for _ in range(30):
        solver.step(1 / 60)
        assert np.isfinite(solver.positions).all()
        assert solver.diagnostics().min_volume_ratio > 0.0
    assert solver.positions[:, 2].min() > -0.05
