"""Bodies against each other and themselves: nothing passes through, momentum stays, friction holds."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

import ipctk
import numpy as np
import pytest
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.contact import BodyContact
from gdpro_sim.simulation.fem.contact_surface import Surface, strayed
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Ground, Model
from tests.simulation.fem_models import make_model, tet_box

SIZE = 0.3


def join(*boxes: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, tets and the number of the box that each vertex belongs to."""
    first = np.cumsum([0, *(len(v) for v, _ in boxes)])
    vertices = np.concatenate([v for v, _ in boxes])
    tets = np.concatenate([t + k for (_, t), k in zip(boxes, first, strict=False)])
    return vertices, tets, np.repeat(np.arange(len(boxes)), np.diff(first))


def cube(low: tuple[float, float, float], cells: int = 2) -> tuple[np.ndarray, np.ndarray]:
    return tet_box((cells,) * 3, (SIZE,) * 3, low)


def contact_of(solver: SolverFEM) -> BodyContact:
    return next(term for term in solver.terms if isinstance(term, BodyContact))


def intersects(model: Model, positions: np.ndarray) -> bool:
    surface = Surface(model)
    return bool(ipctk.has_intersections(surface.mesh(), surface.positions(positions)))


def total_energy(solver: SolverFEM) -> float:
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy + d.gravity_energy + d.contact_energy


def run(solver: SolverFEM, frames: int, fps: float = 60.0) -> None:
    """Step and require what must hold in any run: converged, nothing passes through, energy never up."""
    energy = total_energy(solver)
    scale = max(abs(energy), 1.0)
    for _ in range(frames):
        solver.step(1 / fps)
        assert solver.diagnostics().converged
        now = total_energy(solver)
        assert now <= energy + 1e-6 * scale
        energy = now
        assert not intersects(solver.model, solver.positions)


# -- Derivatives


def in_contact(friction: float = 0.5, seed: int = 0) -> tuple[BodyContact, np.ndarray, np.ndarray]:
    """A contact term in the middle of a solve, [P, 3] positions within the gap, and those it started from."""
    rng = np.random.default_rng(seed)
    vertices, tets, owner = join(cube((0, 0, 0)), cube((0.07, 0.04, SIZE + 0.01)))
    model = make_model(vertices, tets, friction=friction)
    rest = rest_shapes(model)
    contact = BodyContact(model, rest)
    start = model.vertices.astype(np.float64)
    start += 0.05 * contact.gap * rng.normal(size=start.shape)
    start[owner == 1, 2] -= 0.01 - 0.6 * contact.gap
    moved = start + 0.02 * contact.gap * rng.normal(size=start.shape)
    x = wp.array(start, dtype=wp.vec3d, device="cpu")
    zero = wp.zeros_like(x)
    contact.begin(Step(0.01, 0.01, x, zero, zero, zero, 0.0, 0.01))
    contact.lag(x)
    return contact, moved, start


def derivatives(contact: BodyContact, positions: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    x = wp.array(positions, dtype=wp.vec3d, device="cpu")
    energies = wp.zeros(1, dtype=wp.float64, device="cpu")
    gradient = wp.zeros(len(positions), dtype=wp.vec3d, device="cpu")
    block = wp.zeros(len(positions), dtype=wp.mat33d, device="cpu")
    contact.energy(x, energies, 0)
    off = contact.add_derivatives(x, gradient, block)
    hessian = np.zeros((3 * len(positions),) * 2) if off is None else off.toarray()
    assert np.all(hessian.reshape(len(positions), 3, -1, 3).diagonal(axis1=0, axis2=2) == 0.0)
    for i, part in enumerate(block.numpy()):
        hessian[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] += part
    return float(energies.numpy()[0]), gradient.numpy().reshape(-1).copy(), hessian


@pytest.mark.parametrize("friction", [0.0, 0.5, 1e-3])
def test_gradient_is_the_derivative_of_the_energy(friction: float) -> None:
    contact, x, _ = in_contact(friction)
    energy, gradient, hessian = derivatives(contact, x)
    assert energy > 0.0
    h = 1e-4 * contact.gap
    rng = np.random.default_rng(1)
    for _ in range(5):
        d = rng.normal(size=x.shape)
        up, down = (derivatives(contact, x + s * h * d)[0] for s in (1.0, -1.0))
        assert (up - down) / (2.0 * h) == pytest.approx(gradient @ d.reshape(-1), rel=1e-5, abs=1e-9)
    assert np.abs(hessian - hessian.T).max() <= 1e-9 * np.abs(hessian).max()
    values = np.linalg.eigvalsh(hessian)
    assert values[0] >= -1e-9 * values[-1]


def test_hessian_of_friction_is_the_derivative_of_its_gradient() -> None:
    with_friction, x, _ = in_contact(0.5)
    without, _, _ = in_contact(0.0)

    def friction_only(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        _, g, k = derivatives(with_friction, positions)
        _, g0, k0 = derivatives(without, positions)
        return g - g0, k - k0

    _, hessian = friction_only(x)
    h = 1e-5 * with_friction.gap
    d = np.random.default_rng(2).normal(size=x.shape)
    change = (friction_only(x + h * d)[0] - friction_only(x - h * d)[0]) / (2.0 * h)
    expected = hessian @ d.reshape(-1)
    assert np.abs(change - expected).max() <= 1e-4 * np.abs(expected).max()


def test_forces_between_bodies_cancel() -> None:
    contact, x, _ = in_contact()
    _, gradient, _ = derivatives(contact, x)
    forces = gradient.reshape(-1, 3)
    assert np.abs(forces.sum(axis=0)).max() <= 1e-12 * np.abs(forces).sum()


# -- Known answers


def test_a_stack_rests_and_carries_its_weight() -> None:
    vertices, tets, owner = join(cube((0, 0, 0.001)), cube((0.02, 0.03, SIZE + 0.003)))
    model = make_model(vertices, tets, young=1e6, ground=Ground(), rayleigh_stiffness=2e-2, rayleigh_mass=5.0)
    solver = SolverFEM(model)
    run(solver, 90)
    assert np.abs(solver.velocities).max() < 1e-3
    contact = contact_of(solver)
    _, gradient, _ = derivatives(contact, solver.positions)
    weight = 1000.0 * SIZE**3 * 9.81
    assert -gradient.reshape(-1, 3)[owner == 1, 2].sum() == pytest.approx(weight, rel=1e-2)
    top, bottom = solver.positions[owner == 0, 2].max(), solver.positions[owner == 1, 2].min()
    assert -5e-3 < bottom - top < contact.gap  # the lower face sags under the upper box
    assert solver.diagnostics().contacts > 0


def test_a_collision_conserves_momentum() -> None:
    vertices, tets, owner = join(cube((0, 0, 0)), cube((SIZE + 0.05, 0.04, 0.03)))
    velocities = np.where(owner[:, None] == 0, [2.0, 0.1, 0.0], [-1.0, 0.0, 0.2])
    model = make_model(
        vertices,
        tets,
        young=1e5,
        velocities=velocities,
        gravity=(0.0, 0.0, 0.0),
        newton_tolerance=1e-7,
        newton_iterations=60,
        cg_tolerance=1e-8,
    )
    solver = SolverFEM(model)
    before = np.array(solver.diagnostics().momentum)
    speeds = []
    for _ in range(20):
        solver.step(1 / 60)
        assert not intersects(model, solver.positions)
        mass = rest_shapes(model).mass
        speeds.append(
            [np.average(solver.velocities[owner == k, 0], weights=mass[owner == k]) for k in (0, 1)]
        )
    after = np.array(solver.diagnostics().momentum)
    assert np.abs(after - before).max() <= 1e-6 * np.abs(before).max()
    assert speeds[0][0] > speeds[0][1]  # they met
    assert speeds[-1][0] <= speeds[-1][1] + 0.02  # and parted, or stay together


@pytest.mark.parametrize("thickness", [0.02, 0.002])
def test_a_fast_body_does_not_pass_a_thin_plate(thickness: float) -> None:
    plate = tet_box((4, 4, 1), (0.6, 0.6, thickness), (-0.3, -0.3, 0.0))
    ball = tet_box((2, 2, 2), (0.1,) * 3, (-0.04, -0.06, 0.06))
    vertices, tets, owner = join(plate, ball)
    velocities = np.where(owner[:, None] == 1, [0.0, 0.0, -10.0], 0.0)
    pinned = (owner == 0) & (np.abs(vertices[:, :2]).max(axis=1) > 0.29)
    model = make_model(vertices, tets, young=1e7, density=1000.0, velocities=velocities, pinned=pinned)
    solver = SolverFEM(model)
    for _ in range(12):
        solver.step(1 / 60)
        assert not intersects(model, solver.positions)
        assert np.array_equal(solver.positions[pinned], model.vertices[pinned].astype(np.float64))
    x = solver.positions
    middle = np.abs(x[owner == 0][:, :2]).max(axis=1) < 0.2
    assert x[owner == 1, 2].mean() > x[owner == 0][middle, 2].min()


def tilted(degrees: float) -> tuple[float, float, float]:
    angle = np.radians(degrees)
    return (9.81 * np.sin(angle), 0.0, -9.81 * np.cos(angle))


def on_a_slab(degrees: float, friction: tuple[float, float]) -> tuple[SolverFEM, np.ndarray]:
    """A cube on a pinned slab, gravity tilted; friction coefficients of slab and cube.

    The slab's face has no edge but a diagonal: an edge that slides over one exactly parallel to it feels a
    bump, because the barrier counts both sides' distances.
    """
    slab = tet_box((1, 1, 1), (3.0, 2.0, 0.1), (-0.5, -0.3, -0.1))
    block = tet_box((2, 2, 2), (0.2,) * 3, (-0.1, -0.11, 1.5e-4))
    vertices, tets, owner = join(slab, block)
    model = make_model(
        vertices, tets, young=1e6, gravity=tilted(degrees), pinned=owner == 0, rayleigh_stiffness=1e-2
    )
    coefficients = np.where(owner == 0, *friction).astype(np.float32)
    return SolverFEM(dataclasses.replace(model, friction=coefficients)), owner == 1


def test_sticks_below_the_friction_angle_without_creep() -> None:
    solver, body = on_a_slab(20.0, (0.25, 1.0))  # geometric mean 0.5: 26.57 degrees
    run(solver, 30)
    settled = solver.positions[body, 0].mean()
    run(solver, 120)
    assert abs(solver.positions[body, 0].mean() - settled) < 1e-4


def test_slides_above_the_friction_angle() -> None:
    solver, body = on_a_slab(35.0, (0.5, 0.5))
    run(solver, 20)
    start, speed = solver.positions[body, 0].mean(), solver.velocities[body, 0].mean()
    run(solver, 30)
    angle = np.radians(35.0)
    acceleration = 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
    travelled = solver.positions[body, 0].mean() - start
    assert travelled == pytest.approx(speed * 0.5 + 0.5 * acceleration * 0.25, rel=0.02)


@pytest.mark.parametrize("integrator", ["bdf2", "midpoint"])
def test_other_integrators_keep_bodies_apart(integrator: str) -> None:
    vertices, tets, owner = join(cube((0, 0, 0.001)), cube((0.05, 0.04, SIZE + 0.01)))
    velocities = np.where(owner[:, None] == 1, [0.0, 0.0, -2.0], 0.0)
    model = make_model(
        vertices, tets, young=1e5, velocities=velocities, ground=Ground(), integrator=integrator
    )
    solver = SolverFEM(model)
    for _ in range(6):
        solver.step(1 / 60)
        assert solver.diagnostics().converged
        assert not intersects(model, solver.positions)
    assert len(contact_of(solver)._active) > 0


def test_a_heavy_body_on_a_light_one() -> None:
    """Mass ratio 1e4."""
    vertices, tets, owner = join(cube((0, 0, 0.001)), cube((0.02, 0.01, SIZE + 0.01)))
    model = make_model(vertices, tets, young=1e7, ground=Ground(), rayleigh_stiffness=1e-3)
    density = np.where(owner[tets[:, 0]] == 0, 10.0, 1e5).astype(np.float32)
    solver = SolverFEM(dataclasses.replace(model, density=density))
    for _ in range(30):
        solver.step(1 / 60)
        assert not intersects(model, solver.positions)
    assert solver.positions[owner == 1, 2].min() > 0.1


# -- Self-contact


def hairpin() -> tuple[np.ndarray, np.ndarray]:
    """A strip folded into a U that lies on its side: two arms 0.6 m long, 0.12 m apart."""
    parts = [
        tet_box((6, 1, 1), (0.6, 0.1, 0.04), (0.1, 0.0, 0.0)),
        tet_box((1, 1, 5), (0.1, 0.1, 0.2), (0.0, 0.0, 0.0)),
        tet_box((6, 1, 1), (0.6, 0.1, 0.04), (0.1, 0.0, 0.16)),
    ]
    vertices, tets, _ = join(*parts)
    keys = np.round(vertices / 1e-6).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    return vertices[first], inverse.reshape(-1)[tets].astype(np.int32)


@pytest.mark.parametrize("self_contact", [True, False])
def test_a_folded_strip_does_not_pass_through_itself(self_contact: bool) -> None:
    vertices, tets = hairpin()
    free = vertices[:, 2] > 0.15
    velocities = np.where(free[:, None], [0.0, 0.0, -8.0], 0.0) * np.clip(vertices[:, :1] / 0.4, 0.0, 1.0)
    model = make_model(
        vertices,
        tets,
        young=1e5,
        poisson=0.4,
        velocities=velocities,
        gravity=(0.0, 0.0, 0.0),
        pinned=vertices[:, 2] < 1e-6,
        rayleigh_stiffness=1e-3,
        self_contact=self_contact,
    )
    solver = SolverFEM(model)
    met = False
    for _ in range(30):
        solver.step(1 / 60)
        met |= intersects(model, solver.positions)
    assert met != self_contact


def test_straying_does_not_see_rigid_motion() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(3)
    rest = rng.normal(size=(50, 3))
    turned = Rotation.from_euler("xyz", [0.4, -1.2, 2.0]).apply(rest) + np.array([1.0, 2.0, 3.0])
    assert strayed(rest, turned, turned + 5.0) < 1e-12
    bent = turned.copy()
    bent[7] += [0.0, 0.1, 0.0]
    assert 0.08 < strayed(rest, turned, bent) < 0.11


# -- Reproducible


def clash(threads: int) -> SolverFEM:
    devices.set_thread_count(threads)
    vertices, tets, owner = join(cube((0, 0, 0.02), 4), cube((0.1, 0.05, SIZE + 0.05), 4))
    velocities = np.where(owner[:, None] == 1, [0.5, 0.0, -3.0], 0.0)
    model = make_model(vertices, tets, young=1e5, velocities=velocities, ground=Ground(), self_contact=True)
    return SolverFEM(model)


@pytest.fixture
def restore_threads() -> Iterator[None]:
    count = devices.thread_count()
    yield
    devices.set_thread_count(count)


def state_bytes(solver: SolverFEM) -> dict[str, bytes]:
    return {name: value.tobytes() for name, value in solver.state_dict().items()}


def test_thread_count_does_not_change_a_byte(restore_threads: None) -> None:
    results = []
    for threads in (1, 2, 8):
        solver = clash(threads)
        for _ in range(5):
            solver.step(1 / 60)
        assert solver.diagnostics().contacts > 0
        results.append(state_bytes(solver))
    assert results[0] == results[1] == results[2]


def test_restart_continues_to_the_same_bytes(restore_threads: None) -> None:
    first = clash(2)
    for _ in range(3):
        first.step(1 / 60)
    state = first.state_dict()
    second = clash(2)
    second.load_state_dict(state)
    for solver in (first, second):
        for _ in range(3):
            solver.step(1 / 60)
    assert state_bytes(first) == state_bytes(second)
    first.reset()
    assert state_bytes(first) == state_bytes(clash(2))


# -- Bad input


@pytest.mark.parametrize(
    ("shift", "said"), [((0.1, 0.1, 0.2), "overlap"), ((0.0, 0.0, SIZE), "touch|overlap")]
)
def test_bodies_that_start_in_each_other_are_refused_by_name(
    shift: tuple[float, float, float], said: str
) -> None:
    vertices, tets, _ = join(cube((0, 0, 0)), cube(shift))
    with pytest.raises(SolverError, match=rf"'part 0' and 'part 1' ({said})"):
        SolverFEM(make_model(vertices, tets))
    SolverFEM(make_model(vertices, tets, body_contact=False))


def test_a_body_inside_another_is_refused() -> None:
    vertices, tets, _ = join(cube((0, 0, 0)), tet_box((1, 1, 1), (0.05,) * 3, (0.1, 0.1, 0.1)))
    with pytest.raises(SolverError, match="overlap"):
        SolverFEM(make_model(vertices, tets))


def test_bodies_that_start_within_the_gap_are_not_pushed() -> None:
    vertices, tets, _ = join(cube((0, 0, 0)), cube((0.0, 0.0, SIZE + 1e-5)))
    solver = SolverFEM(make_model(vertices, tets, gravity=(0.0, 0.0, 0.0)))
    for _ in range(5):
        solver.step(1 / 60)
    assert np.abs(solver.velocities).max() < 1e-6
