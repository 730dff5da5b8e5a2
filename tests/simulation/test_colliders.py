"""Rigid obstacles: signed distances, contact that holds, friction that sticks, and nothing that tunnels."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
import warp as wp
from pydantic import TypeAdapter, ValidationError
from scipy.spatial.transform import Rotation

from gdpro_sim import device as devices
from gdpro_sim.errors import MeshError, SolverError
from gdpro_sim.kernels import colliders as kernels
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.simulation.colliders import Collider, ColliderOptions, compile_collider, mesh_collider
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.fem.colliders import ColliderContact, RigidBody
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model
from tests.simulation.fem_models import make_model, tet_box

POSE: dict[str, Any] = {"position": (0.3, -0.2, 0.1), "rotation": (20.0, -35.0, 50.0)}
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane", "normal": (0.2, -0.3, 0.9), **POSE},
    "box": {"kind": "box", "size": (0.6, 0.3, 0.2), **POSE},
    "sphere": {"kind": "sphere", "radius": 0.25, **POSE},
    "capsule": {"kind": "capsule", "radius": 0.1, "length": 0.4, **POSE},
    "cylinder": {"kind": "cylinder", "radius": 0.2, "length": 0.3, **POSE},
}


def shape(**options: Any) -> Collider:
    return compile_collider(TypeAdapter(ColliderOptions).validate_python(options))


def box_mesh(size: tuple[float, float, float], **common: Any) -> Collider:
    vertices, tets = tet_box((2, 2, 2), size, tuple(-0.5 * s for s in size))
    faces, _ = boundary(tets)
    used, faces = np.unique(faces, return_inverse=True)
    return mesh_collider(vertices[used], faces.reshape(-1, 3).astype(np.int32), **common)


def placed(collider: Collider, reach: float | None = None) -> RigidBody:
    if reach is not None and collider.kind == "mesh":
        collider = dataclasses.replace(collider, size=(reach, 0.0, 0.0))
    return RigidBody(collider, "cpu")


def distances(collider: Collider, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = wp.array(points, dtype=wp.vec3d, device="cpu")
    distance = wp.zeros(len(points), dtype=wp.float64, device="cpu")
    normal = wp.zeros(len(points), dtype=wp.vec3d, device="cpu")
    body = placed(collider, 10.0)
    inputs = [0, body.now, x]
    wp.launch(kernels.signed_distances, len(points), inputs, [distance, normal], device="cpu")
    return distance.numpy().copy(), normal.numpy().copy()


def cloud(collider: Collider, count: int = 400, spread: float = 0.5) -> np.ndarray:
    return collider.position + np.random.default_rng(0).uniform(-spread, spread, size=(count, 3))


# -- Signed distances


@pytest.mark.parametrize("name", [*SHAPES, "mesh"])
def test_normal_is_the_derivative_of_the_distance(name: str) -> None:
    collider = box_mesh((0.6, 0.3, 0.2)) if name == "mesh" else shape(**SHAPES[name])
    points = cloud(collider)
    h = 1e-6
    d, normal = distances(collider, points)
    assert np.abs(np.linalg.norm(normal, axis=1) - 1.0).max() < 1e-12
    measured = np.stack(
        [
            (distances(collider, points + h * e)[0] - distances(collider, points - h * e)[0]) / (2 * h)
            for e in np.eye(3)
        ],
        axis=1,
    )
    off = np.linalg.norm(measured - normal, axis=1)
    assert np.quantile(off, 0.98) < 1e-5  # the rest lie on edges inside, where the normal turns
    other = cloud(collider)[::-1]
    change = np.abs(d - distances(collider, other)[0])
    assert (change <= np.linalg.norm(points - other, axis=1) * (1.0 + 1e-9) + 1e-12).all()


def test_known_distances() -> None:
    d = {
        name: distances(shape(**{**options, "position": (0, 0, 0), "rotation": (0, 0, 0)}), np.eye(3))[0]
        for name, options in SHAPES.items()
        if name != "plane"
    }
    assert d["box"] == pytest.approx([0.7, 0.85, 0.9])
    assert d["sphere"] == pytest.approx([0.75] * 3)
    assert d["capsule"] == pytest.approx([0.9, 0.9, 0.7])
    assert d["cylinder"] == pytest.approx([0.8, 0.8, 0.85])
    tilted = shape(kind="plane", normal=(3.0, 0.0, 4.0), position=(1.0, 0.0, 0.0))
    assert distances(tilted, np.array([[2.0, 5.0, 1.0]]))[0] == pytest.approx(0.6 + 0.8)


def test_a_mesh_has_the_distance_of_the_box_it_is() -> None:
    size = (0.6, 0.3, 0.2)
    points = cloud(shape(kind="box", size=size))
    expected, normals = distances(shape(kind="box", size=size), points)
    found, found_normals = distances(box_mesh(size), points)
    assert np.abs(found - expected).max() < 1e-8
    clear = np.abs(expected) > 1e-3
    agree = np.einsum("pi,pi->p", normals, found_normals)[clear]
    assert np.quantile(agree, 0.02) > 1.0 - 1e-9


def test_motion_moves_and_turns() -> None:
    options = {**SHAPES["box"], "position": (0.0, 0.0, 0.0), "rotation": (0.0, 0.0, 0.0)}
    keys = [{"time": 1.0, "translation": (1.0, 0.0, 0.0), "rotation": (0.0, 0.0, 90.0)}]
    body = placed(shape(**options, motion=keys, pivot=(0.0, 0.0, 0.0)))
    body.place(0.0, 0.5)
    assert np.allclose(np.array(body.now.position), [0.5, 0.0, 0.0])
    expected = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    assert np.allclose(np.array(body.now.rotation).reshape(3, 3), expected)
    assert np.allclose(np.array(body.before.position), 0.0)


# -- Contact


def touching(collider: Collider, friction: float = 0.5) -> tuple[ColliderContact, np.ndarray]:
    """A contact term in the middle of a solve, and positions up to its room deep."""
    points = cloud(collider, 4000, 0.4)
    d, normal = distances(collider, points)
    room = collider.room or 0.05
    near = points[np.abs(d) < 0.1 * room + 0.01][:200]
    d, normal = distances(collider, near)
    depth = np.random.default_rng(1).uniform(0.02, 0.85, len(near)) * room
    near = near - (d + depth)[:, None] * normal
    near = near[np.abs(distances(collider, near)[0] + depth) < 1e-6]
    vertices, tets = tet_box((6, 6, 3), (0.5, 0.5, 0.2), (5.0, 5.0, 5.0))
    model = make_model(vertices, tets, friction=friction)
    contact = ColliderContact(model, rest_shapes(model), collider)
    count = len(model.vertices)
    x = np.tile(near, (count // len(near) + 1, 1))[:count]
    start = wp.array(x, dtype=wp.vec3d, device="cpu")
    zero = wp.zeros_like(start)
    contact.begin(Step(0.01, 0.01, start, zero, zero, zero, 0.0, 0.01))
    inputs = [0, contact.body.now, start]
    wp.launch(kernels.place_anchors, count, inputs, [contact._anchor], device="cpu")
    contact.lag(start)
    return contact, x + 1e-3 * np.random.default_rng(2).normal(size=x.shape)


def energies(contact: ColliderContact, x: np.ndarray) -> np.ndarray:
    out = wp.zeros(len(x), dtype=wp.float64, device="cpu")
    contact.energy(wp.array(x, dtype=wp.vec3d, device="cpu"), out, 0)
    return out.numpy().copy()


def derivatives(contact: ColliderContact, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    gradient = wp.zeros(len(x), dtype=wp.vec3d, device="cpu")
    block = wp.zeros(len(x), dtype=wp.mat33d, device="cpu")
    contact.add_derivatives(wp.array(x, dtype=wp.vec3d, device="cpu"), gradient, block)
    return gradient.numpy().copy(), block.numpy().copy()


@pytest.mark.parametrize("name", [*SHAPES, "mesh"])
def test_gradient_is_the_derivative_of_the_energy(name: str) -> None:
    collider = box_mesh((0.6, 0.3, 0.2)) if name == "mesh" else shape(**SHAPES[name])
    contact, x = touching(collider)
    energy = energies(contact, x)
    fine = np.isfinite(energy) & (energy > 0.0)
    assert fine.mean() > 0.5
    gradient, block = derivatives(contact, x)
    h = 1e-7
    for e in np.eye(3):
        change = (energies(contact, x + h * e) - energies(contact, x - h * e)) / (2 * h)
        off = np.abs(change - gradient @ e)[fine] / np.linalg.norm(gradient[fine], axis=1)
        assert np.quantile(off, 0.95) < 1e-4
    assert np.linalg.eigvalsh(block[fine]).min() >= -1e-9 * np.abs(block[fine]).max()


@pytest.mark.parametrize("name", ["plane", "box"])
def test_hessian_is_the_derivative_of_the_gradient_on_flat_faces(name: str) -> None:
    contact, x = touching(shape(**SHAPES[name]))
    fine = np.isfinite(energies(contact, x))
    _, block = derivatives(contact, x)
    h = 1e-7
    for e in np.eye(3):
        change = (derivatives(contact, x + h * e)[0] - derivatives(contact, x - h * e)[0]) / (2 * h)
        off = np.linalg.norm(change - block @ e, axis=1)[fine] / np.abs(block[fine]).max(axis=(1, 2))
        assert np.quantile(off, 0.95) < 1e-4


# -- Known answers


def drop(colliders: list[Collider], height: float, speed: float, **options: Any) -> SolverFEM:
    vertices, tets = tet_box((3, 3, 3), (0.1,) * 3, (-0.05, -0.05, height))
    velocities = np.tile([0.0, 0.0, -speed], (len(vertices), 1))
    model = make_model(vertices, tets, velocities=velocities, **options)
    return SolverFEM(dataclasses.replace(model, colliders=tuple(colliders)))


@pytest.mark.parametrize(
    "collider",
    [
        shape(kind="box", size=(1.0, 1.0, 0.002)),
        shape(kind="box", size=(1.0, 1.0, 0.02), rotation=(10.0, 0.0, 0.0)),
        shape(kind="sphere", radius=0.2, position=(0.0, 0.0, -0.2)),
        shape(kind="capsule", radius=0.15, length=0.5, rotation=(0.0, 90.0, 0.0), position=(0, 0, -0.15)),
        shape(kind="cylinder", radius=0.3, length=0.01),
        box_mesh((1.0, 1.0, 0.01)),
        shape(kind="heightfield", size=(1.0, 1.0), heights=[[0.0, 0.02, 0.0], [0.02, 0.0, 0.02], [0, 0, 0]]),
    ],
    ids=lambda collider: collider.kind,
)
def test_nothing_tunnels_at_ten_metres_a_second(collider: Collider) -> None:
    solver = drop([collider], 0.1, 10.0, young=1e6, gravity=(0.0, 0.0, 0.0))
    for _ in range(8):
        solver.step(1 / 60)
        d = solver.diagnostics()
        assert d.converged
        assert d.max_penetration < collider.room
        below = solver.positions[:, 2] < collider.position[2] - 0.1
        assert not below.any()
    assert solver.diagnostics().momentum[2] > 0.0


@pytest.mark.parametrize(
    "collider",
    [
        shape(kind="box", size=(1.0, 1.0, 0.05), position=(0.0, 0.0, -0.025)),
        box_mesh((1.0, 1.0, 0.05), position=np.array([0.0, 0.0, -0.025])),
        shape(kind="heightfield", size=(1.0, 1.0), heights=[[0.0, 0.0], [0.0, 0.0]]),
    ],
    ids=lambda collider: collider.kind,
)
def test_comes_to_rest_on_it(collider: Collider) -> None:
    solver = drop([collider], 0.01, 0.0, young=1e5, rayleigh_stiffness=1e-2, rayleigh_mass=2.0)
    for _ in range(60):
        solver.step(1 / 60)
    d = solver.diagnostics()
    assert 0 < d.contacts and d.max_penetration < 1e-4
    assert np.abs(solver.velocities).max() < 1e-3
    weight = 1000.0 * 0.1**3 * 9.81
    contact = next(term for term in solver.terms if isinstance(term, ColliderContact))
    gradient, _ = derivatives(contact, solver.positions)
    assert -gradient[:, 2].sum() == pytest.approx(weight, rel=1e-2)


def on_an_incline(degrees: float, **collider: Any) -> tuple[SolverFEM, np.ndarray]:
    """A 0.2 m cube lying on a turned collider, and the way down."""
    turn = Rotation.from_euler("y", degrees, degrees=True)
    vertices, tets = tet_box((2, 2, 2), (0.2,) * 3, (-0.1, -0.1, 0.0))
    model = make_model(turn.apply(vertices), tets, young=1e6, rayleigh_stiffness=1e-2)
    obstacle = shape(rotation=(0.0, degrees, 0.0), **collider)
    return SolverFEM(dataclasses.replace(model, colliders=(obstacle,))), turn.apply([1.0, 0.0, 0.0])


INCLINES: list[dict[str, Any]] = [
    {"kind": "plane"},
    {"kind": "box", "size": (8.0, 1.0, 1.0), "position": (0.0, 0.0, 0.0)},
]


@pytest.mark.parametrize("collider", INCLINES, ids=lambda c: c["kind"])
def test_sticks_below_the_friction_angle_without_creep(collider: dict[str, Any]) -> None:
    if collider["kind"] == "box":
        collider = {**collider, "position": Rotation.from_euler("y", 20, degrees=True).apply([0, 0, -0.5])}
    solver, down = on_an_incline(20.0, **collider)
    for _ in range(30):
        solver.step(1 / 60)
    settled = solver.positions.mean(axis=0) @ down
    for _ in range(120):
        solver.step(1 / 60)
    assert abs(solver.positions.mean(axis=0) @ down - settled) < 1e-4


@pytest.mark.parametrize("collider", INCLINES, ids=lambda c: c["kind"])
def test_slides_above_the_friction_angle(collider: dict[str, Any]) -> None:
    if collider["kind"] == "box":
        collider = {**collider, "position": Rotation.from_euler("y", 35, degrees=True).apply([0, 0, -0.5])}
    solver, down = on_an_incline(35.0, **collider)
    start = solver.positions.mean(axis=0) @ down
    for _ in range(60):
        solver.step(1 / 60)
    angle = np.radians(35.0)
    expected = 0.5 * 9.81 * (np.sin(angle) - 0.5 * np.cos(angle))
    assert solver.positions.mean(axis=0) @ down - start == pytest.approx(expected, rel=0.02)


def test_friction_of_body_and_collider_combine_by_the_geometric_mean() -> None:
    """tan 20 degrees = 0.364: sqrt(0.5 * 0.2) = 0.316 slides."""
    solver, down = on_an_incline(20.0, kind="plane", friction=0.2)
    start = solver.positions.mean(axis=0) @ down
    for _ in range(60):
        solver.step(1 / 60)
    angle = np.radians(20.0)
    expected = 0.5 * 9.81 * (np.sin(angle) - np.sqrt(0.1) * np.cos(angle))
    assert solver.positions.mean(axis=0) @ down - start == pytest.approx(expected, rel=0.05)


def test_a_belt_carries_what_lies_on_it() -> None:
    belt = shape(
        kind="box",
        size=(9.0, 1.0, 0.1),
        position=(0.0, 0.0, -0.05),
        motion=[{"time": 10.0, "translation": (10.0, 0.0, 0.0)}],
    )
    solver = drop([belt], 0.0, 0.0, young=1e6, friction=0.5, rayleigh_stiffness=1e-2)
    for k in range(45):
        solver.step(1 / 60)
        if k == 5:  # it slips until it is as fast: v = mu g t
            assert solver.velocities[:, 0].mean() == pytest.approx(0.5 * 9.81 * 0.1, rel=0.05)
    assert solver.velocities[:, 0].mean() == pytest.approx(1.0, rel=1e-2)


def test_a_fast_thin_wall_does_not_pass_through_a_body() -> None:
    wall = shape(
        kind="box",
        size=(0.04, 1.0, 1.0),
        position=(-0.3, 0.0, 0.0),
        motion=[{"time": 0.1, "translation": (1.0, 0.0, 0.0)}],
    )
    solver = drop([wall], -0.05, 0.0, young=1e6, gravity=(0.0, 0.0, 0.0))
    for _ in range(6):
        solver.step(1 / 60)
    assert solver.positions[:, 0].min() > -0.3 + 10.0 * 0.1
    assert solver.diagnostics().momentum[0] > 5.0 * 1000.0 * 0.1**3


def test_rolls_and_rests_between_two_colliders() -> None:
    """A V of two planes holds a cube up with both sides."""
    sides = [shape(kind="plane", normal=(s, 0.0, 1.0), friction=0.0) for s in (1.0, -1.0)]
    vertices, tets = tet_box((2, 2, 2), (0.1,) * 3, (-0.05, -0.05, -0.05))
    turned = Rotation.from_euler("y", 45, degrees=True).apply(vertices) + np.array([0.0, 0.0, 0.08])
    model = make_model(turned, tets, young=1e6, rayleigh_stiffness=1e-2, rayleigh_mass=2.0)
    solver = SolverFEM(dataclasses.replace(model, colliders=tuple(sides)))
    for _ in range(60):
        solver.step(1 / 60)
    assert solver.positions[:, 2].min() == pytest.approx(0.0, abs=2e-3)
    assert np.abs(solver.velocities).max() < 1e-2
    forces = [
        derivatives(term, solver.positions)[0].sum(axis=0)
        for term in solver.terms
        if isinstance(term, ColliderContact)
    ]
    assert -(forces[0] + forces[1])[2] == pytest.approx(9.81, rel=2e-2)
    assert forces[0][0] == pytest.approx(-forces[1][0], rel=2e-2)


# -- Reproducible


def tumbling() -> Model:
    vertices, tets = tet_box((8, 8, 8), (0.2,) * 3, (-0.1, -0.1, 0.05))
    colliders = (
        shape(kind="sphere", radius=0.1, position=(0.05, 0.0, -0.1)),
        box_mesh((1.0, 1.0, 0.1), position=np.array([0.0, 0.0, -0.2])),
        shape(
            kind="box",
            size=(0.1,) * 3,
            position=(-0.3, 0, 0),
            motion=[{"time": 1.0, "translation": (0.5, 0, 0)}],
        ),
    )
    velocities = np.tile([0.0, 0.0, -3.0], (len(vertices), 1))
    model = make_model(vertices, tets, young=1e5, velocities=velocities)
    return dataclasses.replace(model, colliders=colliders)


@pytest.fixture
def restore_threads() -> Iterator[None]:
    count = devices.thread_count()
    yield
    devices.set_thread_count(count)


def test_thread_count_and_restart_do_not_change_a_byte(restore_threads: None) -> None:
    results = []
    for threads in (1, 2, 8):
        devices.set_thread_count(threads)
        solver, contacts = SolverFEM(tumbling()), 0
        for k in range(6):
            if k == 3 and threads == 2:
                state = solver.state_dict()
                solver = SolverFEM(tumbling())
                solver.load_state_dict(state)
            solver.step(1 / 60)
            contacts += solver.diagnostics().contacts
        assert contacts > 0
        results.append({name: value.tobytes() for name, value in solver.state_dict().items()})
    assert results[0] == results[1] == results[2]


# -- Bad input


def test_a_body_that_starts_inside_is_refused_by_name() -> None:
    table = shape(kind="box", name="table", size=(1.0, 1.0, 0.1), position=(0.0, 0.0, 0.05))
    with pytest.raises(SolverError, match="inside collider 'table'"):
        drop([table], 0.0, 0.0)


def test_an_open_mesh_is_refused() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    with pytest.raises(MeshError, match="not closed"):
        mesh_collider(vertices, np.array([[0, 1, 2]], np.int32))
    collider = box_mesh((1.0, 1.0, 1.0))
    assert collider.vertices is not None and collider.faces is not None
    with pytest.raises(MeshError, match="volume -1"):
        mesh_collider(collider.vertices, collider.faces[:, ::-1])


@pytest.mark.parametrize(
    "options",
    [
        {"kind": "ball", "radius": 1.0},
        {"kind": "box", "size": (1.0, 0.0, 1.0)},
        {"kind": "sphere", "radius": -1.0},
        {"kind": "sphere", "radius": float("nan")},
        {"kind": "plane", "normal": (0.0, 0.0, 0.0)},
        {"kind": "sphere", "radius": 1.0, "friction": -0.1},
        {"kind": "heightfield", "size": (1.0, 1.0), "heights": [[0.0, 0.0], [0.0]]},
        {"kind": "sphere", "radius": 1.0, "motion": [{"time": 1.0}, {"time": 1.0}]},
    ],
)
def test_wrong_options_are_refused(options: dict[str, Any]) -> None:
    with pytest.raises(ValidationError):
        shape(**options)
