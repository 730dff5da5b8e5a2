"""Implicit MPM: derivatives against differences, statics and vibration against closed forms, robustness."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_stiffness
from gdpro_sim.kernels import particles as rows
from gdpro_sim.materials import Material
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Hold
from gdpro_sim.simulation.model import Diagnostics, Ground, Model, MpmSettings, Particles
from gdpro_sim.simulation.mpm.implicit import GridNewton
from gdpro_sim.simulation.mpm.solver import SolverMPM

LAWS = ("stable_neo_hookean", "neo_hookean", "corotated", "stvk_hencky")
H = 5e-3


@pytest.fixture(autouse=True)
def threads_as_they_were() -> Iterator[None]:
    before = devices.thread_count()
    yield
    devices.set_thread_count(before)


def bar(counts: tuple[int, int, int], size: tuple[float, float, float], **material: Any) -> Particles:
    """A box of particles from the origin on, at rest."""
    material = {"young": 1e5, "poisson": 0.3, "density": 1000.0, **material}
    spacing = np.array(size) / np.array(counts)
    axes = [(np.arange(n) + 0.5) * d for n, d in zip(counts, spacing, strict=True)]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    volume = float(spacing.prod())
    return Particles(
        positions.astype(np.float32),
        np.zeros((len(positions), 3), np.float32),
        np.full(len(positions), volume, np.float32),
        np.zeros(len(positions), np.int32),
        (Material(**material),),
        volume ** (1.0 / 3.0),
    )


def solver_of(particles: Particles, settings: dict[str, Any] | None = None, **options: Any) -> SolverMPM:
    settings = {"integrator": "implicit", **(settings or {})}
    return SolverMPM(Model.without_tets(particles, mpm=MpmSettings(**settings), **options))


def total_energy(found: Diagnostics) -> float:
    return found.kinetic_energy + found.elastic_energy + found.gravity_energy


class Probe:
    """The function that a substep minimises, of a strained and moving cloud, with NumPy in and out."""

    def __init__(self, law: str, kernel: str = "quadratic", strain: float = 0.1, **material: Any) -> None:
        rng = np.random.default_rng(3)
        particles = bar((5, 6, 7), (0.25, 0.3, 0.35), model=law, **material)
        self.solver = solver_of(particles, {"kernel": kernel}, gravity=(0.0, 0.0, 0.0))
        grid, newton = self.solver.grid, self.solver._newton
        assert newton is not None
        self.grid, self.newton = grid, newton
        stretch = np.eye(3)[None] + strain * rng.normal(size=(len(grid.ids), 3, 3))
        fields = grid.particles.numpy()
        fields[rows.DEFORMATION : rows.DEFORMATION + 9, : len(stretch)] = stretch.reshape(-1, 9).T
        grid.particles.assign(fields)
        grid.scatter(0.0, 1.0, (0.0, 0.0, 0.0))
        newton._reserve()
        for array in (newton._momentum, newton._target):
            wp.copy(array, grid.values)
        self.mass = grid.values.numpy()[:, 3]
        self.rng = rng

    def vectors(self) -> np.ndarray:
        return self.rng.normal(size=(len(self.mass), 3)) * (self.mass[:, None] > 0.0)

    def _four(self, v: np.ndarray) -> np.ndarray:
        return np.column_stack([v, self.mass]).astype(np.float32)

    def evaluate(self, v: np.ndarray, exact: bool = True) -> tuple[float, np.ndarray]:
        """Energy and gradient."""
        self.grid.values.assign(self._four(v))
        energy = self.newton.energy(H)
        self.newton.linearise(H, exact=exact)
        self.newton.set_right_hand_side()
        return energy, -self.newton._right.numpy()[:, :3].astype(np.float64)

    def multiply(self, v: np.ndarray) -> np.ndarray:
        self.newton._p.assign(self._four(v))
        self.newton.multiply(self.newton._p, self.newton._q)
        return self.newton._q.numpy()[:, :3].astype(np.float64)


@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("damping", [0.0, 0.01])
def test_derivatives_are_those_of_the_energy(law: str, kernel: str, damping: float) -> None:
    probe = Probe(law, kernel, rayleigh_stiffness=damping)
    v, d = 0.2 * probe.vectors(), probe.vectors()
    t = 3e-3
    (up, gradient_up), (down, gradient_down) = (probe.evaluate(v + s * t * d) for s in (1.0, -1.0))
    _, gradient = probe.evaluate(v)
    assert math.isclose((gradient * d).sum(), (up - down) / (2.0 * t), rel_tol=1e-4)
    if damping == 0.0:  # its Hessian is Gauss's and Newton's
        change = (gradient_up - gradient_down) / (2.0 * t)
        np.testing.assert_allclose(probe.multiply(d), change, rtol=0, atol=3e-4 * np.abs(change).max())


@pytest.mark.parametrize("law", LAWS)
def test_the_hessian_is_symmetric_and_projected(law: str) -> None:
    probe = Probe(law, strain=0.25, rayleigh_stiffness=0.01)
    probe.evaluate(0.2 * probe.vectors(), exact=False)
    a, b = probe.vectors(), probe.vectors()
    assert math.isclose((a * probe.multiply(b)).sum(), (b * probe.multiply(a)).sum(), abs_tol=1e-4)
    inertia = probe.mass[:, None]
    for _ in range(20):
        d = probe.vectors()
        assert (d * (probe.multiply(d) - inertia * d)).sum() >= 0.0


@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
def test_diagonal_blocks_are_the_hessians(kernel: str) -> None:
    probe = Probe("stable_neo_hookean", kernel, strain=0.2, rayleigh_stiffness=0.01)
    probe.evaluate(0.1 * probe.vectors(), exact=False)
    diagonal, off = (a.numpy() for a in (probe.newton._diagonal, probe.newton._off_diagonal))
    for node in np.argsort(probe.mass)[[-1, -40, -200]]:
        columns = []
        for k in range(3):
            unit = np.zeros((len(probe.mass), 3))
            unit[node, k] = 1.0
            columns.append(probe.multiply(unit)[node])
        block = np.array(columns)
        expected = np.diag(diagonal[node, :3] + probe.mass[node])
        expected[np.triu_indices(3, 1)] = off[node, :3]
        expected = np.triu(expected) + np.triu(expected, 1).T
        np.testing.assert_allclose(expected, block, rtol=0, atol=1e-5 * np.abs(block).max())


@pytest.mark.parametrize("kernel", ["quadratic", "cubic"])
def test_tiles_and_single_particles_agree(kernel: str) -> None:
    devices.set_thread_count(1)
    probe = Probe("corotated", kernel)
    probe.evaluate(0.2 * probe.vectors(), exact=False)
    grid, newton = probe.grid, probe.newton
    work = newton.work.numpy().copy()
    p = probe.vectors()
    product = probe.multiply(p) - probe.mass[:, None] * p
    common = [grid.width, grid.spacing, grid.owners, grid.coords, grid.neighbors]
    values: wp.array = wp.zeros(64 * grid.count, dtype=wp.vec4)
    more: wp.array = wp.zeros(64 * grid.count, dtype=wp.vec4)

    def launch(kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        grid.launch(kernel, len(grid.ids), [*common, *inputs], outputs)

    def close(found: np.ndarray, expected: np.ndarray) -> None:
        np.testing.assert_allclose(found, expected, rtol=0, atol=3e-5 * np.abs(expected).max())

    launch(mpm_stiffness.gradient_particles, [grid.values, grid.particles], [newton.work])
    close(newton.work.numpy()[:9], work[:9])
    newton.work.assign(work)
    launch(mpm_stiffness.moment_particles, [grid.particles, newton.work], [values])
    close(values.numpy()[:, :3], newton._force.numpy()[:, :3])
    values.zero_()
    launch(mpm_stiffness.product_particles, [newton._p, grid.particles, newton.work], [values])
    close(values.numpy()[:, :3], product)
    values.zero_()
    launch(mpm_stiffness.diagonal_particles, [grid.particles, newton.work], [values, more])
    close(values.numpy()[:, :3], newton._diagonal.numpy()[:, :3])
    close(more.numpy()[:, :3], newton._off_diagonal.numpy()[:, :3])


def test_a_step_one_particle_at_a_time_is_the_same() -> None:
    """What a GPU does."""
    devices.set_thread_count(1)
    found = []
    for tiled in (True, False):
        particles = bar((6, 6, 6), (0.3, 0.3, 0.3), young=1e6)
        particles.velocities[:] = (0.5, 0.0, -1.0)
        solver = solver_of(particles, ground=Ground())
        assert solver._newton is not None
        solver._newton.tiled = tiled
        for _ in range(3):
            solver.step(1 / 60)
        assert solver.diagnostics().converged
        found.append((solver.positions, solver.velocities))
    np.testing.assert_allclose(found[1][0], found[0][0], rtol=0, atol=2e-5)
    np.testing.assert_allclose(found[1][1], found[0][1], rtol=0, atol=5e-3)


def mode(particles: Particles, length: float) -> np.ndarray:
    """First axial mode of a free bar."""
    return np.cos(math.pi * particles.positions[:, 0] / length)


def amplitudes(integrator: str, dt: float, steps: int, substeps: int = 1) -> np.ndarray:
    """Velocity in the first axial mode of a free bar, 1 at the start, after each step."""
    particles = bar((30, 3, 3), (1.0, 0.1, 0.1), poisson=0.0)
    shape = mode(particles, 1.0)
    particles.velocities[:, 0] = 0.01 * shape
    settings = {"integrator": integrator, "newton_tolerance": 1e-6, "substeps": substeps}
    solver = solver_of(particles, settings, gravity=(0.0, 0.0, 0.0))
    found = []
    for _ in range(steps):
        solver.step(dt)
        found.append(float(solver.velocities[:, 0] @ shape) / float(shape @ shape) / 0.01)
    return np.array(found)


def crossing(values: np.ndarray, dt: float) -> float:
    """First time that it is zero."""
    k = int(np.flatnonzero(values < 0.0)[0])
    return dt * (k + values[k - 1] / (values[k - 1] - values[k]))


def test_a_bar_vibrates_as_it_does_explicitly() -> None:
    """Period 2 L sqrt(rho / E) = 0.2 s, a quarter of it to the first zero of the velocity."""
    dt, steps = 5e-4, 110
    implicit, explicit = (amplitudes(integrator, dt, steps) for integrator in ("implicit", "explicit"))
    assert math.isclose(crossing(implicit, dt), crossing(explicit, dt), rel_tol=0.01)
    assert math.isclose(crossing(implicit, dt), 0.05, rel_tol=0.03)


def test_backward_euler_damps_a_mode_as_it_should() -> None:
    """Energy falls by 1 / (1 + w^2 dt^2) in each step."""
    dt = 2e-3
    values = amplitudes("implicit", dt, 55)
    frequency = math.pi / 0.1
    # At the half period the velocity is at its least: minus what damping has left.
    left = (1.0 + (frequency * dt) ** 2) ** (-0.5 * 0.1 / dt)
    assert math.isclose(-values.min(), left, rel_tol=0.02)


@pytest.mark.parametrize("law", LAWS)
def test_a_column_sags_by_its_weight(law: str) -> None:
    """Elastic energy rho^2 g^2 A L^3 / 6 E of a column on a slippery floor, as in an explicit one at rest."""
    particles = bar((5, 5, 15), (0.2, 0.2, 0.6), poisson=0.0, model=law, young=2e5, rayleigh_mass=8.0)
    ground = Ground(boundary="slip")
    solver = solver_of(particles, ground=ground)
    for _ in range(25):
        solver.step(1 / 20)
    found = solver.diagnostics()
    assert found.converged and found.kinetic_energy < 1e-6
    theory = (1000.0 * 9.81) ** 2 * 0.04 * 0.6**3 / (6.0 * 2e5)
    assert math.isclose(found.elastic_energy, theory, rel_tol=0.1)
    if law != "stable_neo_hookean":
        return
    explicit = solver_of(particles, {"integrator": "explicit"}, ground=ground)
    for _ in range(40):
        explicit.step(1 / 20)
    assert math.isclose(found.elastic_energy, explicit.diagnostics().elastic_energy, rel_tol=0.02)
    np.testing.assert_allclose(solver.positions, explicit.positions, rtol=0, atol=1e-3)


def test_a_stiff_bar_takes_few_substeps() -> None:
    particles = bar((20, 6, 6), (0.6, 0.18, 0.18), young=1e9)
    particles.velocities[:, 2] = np.cos(2.0 * math.pi * particles.positions[:, 0] / 0.6)
    solver = solver_of(particles, gravity=(0.0, 0.0, 0.0))
    first = before = total_energy(solver.diagnostics())
    for _ in range(10):
        solver.step(1 / 60)
        found = solver.diagnostics()
        assert found.converged and found.substeps <= 4
        assert total_energy(found) <= before + 1e-8 * first
        before = total_energy(found)
    assert np.isfinite(solver.positions).all()
    assert found.min_volume_ratio > 0.99


def test_energy_never_rises_and_nothing_turns_inside_out() -> None:
    particles = bar((8, 8, 8), (0.4, 0.4, 0.4), young=1e5)
    particles.velocities[:] = -6.0 * (particles.positions - 0.2) / 0.2  # crushed from all sides
    solver = solver_of(particles, gravity=(0.0, 0.0, 0.0))
    before = total_energy(solver.diagnostics())
    for _ in range(12):
        solver.step(1 / 60)
        found = solver.diagnostics()
        assert found.converged and found.min_volume_ratio > 0.0
        assert total_energy(found) <= before * (1.0 + 1e-5)
        before = total_energy(found)


def test_momentum_stays() -> None:
    rng = np.random.default_rng(0)
    particles = bar((8, 8, 8), (0.4, 0.4, 0.4), young=1e7)
    particles.velocities[:] = np.array([1.0, 2.0, 3.0]) + rng.normal(size=(512, 3))
    solver = solver_of(particles, gravity=(0.0, 0.0, 0.0))
    before = np.array(solver.diagnostics().momentum)
    for _ in range(5):
        solver.step(1 / 60)
    after = solver.diagnostics()
    assert after.converged
    np.testing.assert_allclose(after.momentum, before, rtol=3e-6)


@pytest.mark.parametrize("transfer", ["apic", "pic", "flip"])
def test_free_fall(transfer: str) -> None:
    particles = bar((6, 6, 6), (0.3, 0.3, 0.3), young=1e8)
    solver = solver_of(particles, {"transfer": transfer})
    for _ in range(6):
        solver.step(1 / 60)
    np.testing.assert_allclose(solver.velocities, np.tile([0.0, 0.0, -0.981], (216, 1)), atol=2e-4)
    assert solver.diagnostics().converged


def test_the_same_bytes_for_any_number_of_threads() -> None:
    found = []
    for threads in (1, 2, 8):
        devices.set_thread_count(threads)
        particles = bar((9, 9, 9), (0.45, 0.45, 0.45), young=1e6)
        particles.velocities[:] = (1.0, 0.0, -2.0)
        solver = solver_of(particles, ground=Ground())
        for _ in range(2):
            solver.step(1 / 60)
        found.append(solver.state_dict())
    for other in found[1:]:
        for name, value in found[0].items():
            assert value.tobytes() == other[name].tobytes(), name


def test_a_saved_state_goes_on_to_the_same_bytes() -> None:
    particles = bar((8, 8, 8), (0.4, 0.4, 0.4), young=1e6)
    particles.velocities[:] = (1.0, 0.0, -2.0)
    solver = solver_of(particles, ground=Ground())
    solver.step(1 / 60)
    saved = solver.state_dict()
    solver.step(1 / 60)
    expected = solver.state_dict()
    solver.load_state_dict(saved)
    solver.step(1 / 60)
    for name, value in solver.state_dict().items():
        assert value.tobytes() == expected[name].tobytes(), name


@pytest.mark.parametrize("young", [1e5, 1e8])
def test_a_block_comes_to_rest_on_the_floor(young: float) -> None:
    particles = bar((6, 6, 6), (0.3, 0.3, 0.3), young=young)
    particles.positions[:, 2] += 0.02
    solver = solver_of(particles, ground=Ground())
    for _ in range(40):
        solver.step(1 / 60)
        assert solver.diagnostics().converged
    found = solver.diagnostics()
    assert found.kinetic_energy < 1e-3
    sag = 1000.0 * 9.81 * 0.3**2 / (2.0 * young)
    assert abs(solver.positions[:, 2].mean() - (0.15 - 0.5 * sag)) < 0.2 * sag + 2e-3


@pytest.mark.parametrize("degrees", [10.0, 30.0])
def test_a_block_slides_where_friction_lets_it(degrees: float) -> None:
    """x = g (sin a - mu cos a) t^2 / 2 past the angle of friction, nothing below."""
    angle, mu, time = math.radians(degrees), 0.3, 0.4
    particles = bar((8, 6, 4), (0.4, 0.3, 0.2), young=1e7, friction=mu)
    gravity = (9.81 * math.sin(angle), 0.0, -9.81 * math.cos(angle))
    solver = solver_of(particles, gravity=gravity, ground=Ground())
    start = solver.positions[:, 0].mean()
    for _ in range(24):
        solver.step(1 / 60)
        assert solver.diagnostics().converged
    expected = max(0.0, 0.5 * 9.81 * (math.sin(angle) - mu * math.cos(angle)) * time**2)
    # Backward Euler with v first: the sum over steps is longer by half a step.
    assert abs(solver.positions[:, 0].mean() - start - expected) < 0.05 * expected + 1e-3


def test_a_held_cantilever_droops_as_it_does_explicitly() -> None:
    particles = bar((16, 4, 4), (0.8, 0.2, 0.2), young=1e6, rayleigh_mass=8.0)
    held = np.flatnonzero(particles.positions[:, 0] < 0.1).astype(np.int32)
    tip = particles.positions[:, 0] > 0.75
    found = []
    for integrator, steps in (("implicit", 30), ("explicit", 50)):
        solver = solver_of(particles, {"integrator": integrator}, holds=(Hold(held, None),))
        for _ in range(steps):
            solver.step(1 / 20)
        assert solver.diagnostics().converged
        np.testing.assert_allclose(solver.positions[held], particles.positions[held], rtol=0, atol=1e-6)
        found.append(float((particles.positions[tip, 2] - solver.positions[tip, 2]).mean()))
    assert math.isclose(found[0], found[1], rel_tol=0.06)
    assert found[0] > 0.05


def test_what_cannot_be_done_is_said() -> None:
    metal = bar((4, 4, 4), (0.2, 0.2, 0.2), model="stvk_hencky", yield_stress=1e3)
    with pytest.raises(SolverError, match="implicit integrator is for elastic materials"):
        solver_of(metal)
    particles = bar((4, 4, 4), (0.2, 0.2, 0.2))
    ball = Collider("ball", "sphere", (0.1, 0.1, 0.1), position=np.array([0.0, 0.0, 1.0]), mass=1.0)
    with pytest.raises(SolverError, match="rigid bodies"):
        solver_of(particles, colliders=(ball,))


def test_too_few_iterations_are_reported() -> None:
    particles = bar((5, 5, 5), (0.25, 0.25, 0.25), young=1e6)
    particles.velocities[:, 0] = np.sin(20.0 * particles.positions[:, 0])
    solver = solver_of(particles, {"cg_iterations": 1, "newton_iterations": 2}, gravity=(0.0, 0.0, 0.0))
    solver.step(1 / 60)
    found = solver.diagnostics()
    assert not found.converged and found.residual > 0.0
    assert isinstance(solver._newton, GridNewton)
