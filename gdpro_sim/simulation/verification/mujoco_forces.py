"""Forces in MuJoCo: springs, loads, wind, height fields, bodies held to each other."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gdpro_sim.simulation.colliders import HeightfieldCollider, compile_collider
from gdpro_sim.simulation.conditions import Force, Impulse, Springs, Wind
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco_model import FRAME as FIRST
from gdpro_sim.simulation.mujoco_model import Joint, RigidBody, Tie
from gdpro_sim.simulation.verification.framework import Check, absolute, problem, relative
from gdpro_sim.simulation.verification.models import tet_ball, tet_box
from gdpro_sim.simulation.verification.mujoco_models import ball, box, flex, world

FRAME = 1.0 / 30.0


def hung(stiffness: float, damping: float = 0.0) -> Model:
    """A ball of 0.1 m on a spring of 1 m, whose length is that at the start, from a point above it."""
    corners, weights = np.zeros((1, 2, 4), np.int32), np.zeros((1, 2, 4))
    weights[0, 0, 0] = 1.0
    anchors = np.array([[[0.0, 0.0, 0.0], [0.0, 0.0, 2.0]]])
    each = [np.array([value]) for value in (stiffness, 1.0, damping)]
    return replace(world(ball(0.1, 1.0)), springs=Springs(corners, weights, anchors, *each))


@problem(
    "spring",
    title="a ball let go on a spring swings about where it would hang",
    source="2 pi sqrt(m / k), amplitude m g / k; with a dashpot the logarithmic decrement",
)
def spring() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    for damping in (0.0, 4.0):
        solver = SolverMuJoCo(hung(400.0, damping))
        mass = float(solver.mjmodel.body_mass[1])
        middle = 1.0 - mass * 9.81 / 400.0
        heights = []
        for _ in range(500):
            solver.step(4e-3)
            heights.append(float(solver.mjdata.qpos[2]) - middle)
        z = np.array(heights)
        up = np.flatnonzero((z[:-1] < 0.0) & (z[1:] >= 0.0))
        times = (up - z[up] / (z[up + 1] - z[up])) * 4e-3
        rate = damping / (2.0 * mass)
        period = 2.0 * math.pi / math.sqrt(400.0 / mass - rate**2)
        yield relative(f"{damping:g} N s/m: period", period, float(np.diff(times).mean()), 2e-3, "s")
        if damping == 0.0:
            yield relative("amplitude", mass * 9.81 / 400.0, float(np.ptp(z)) / 2.0, 2e-3, "m")
        else:
            peaks = [float(z[a:b].max()) for a, b in itertools.pairwise(up)]
            fall = math.log(peaks[0] / peaks[-1]) / (len(peaks) - 1)
            yield relative("decrement of a period", rate * period, fall, 0.01)


@problem(
    "loads",
    title="a force for half a second and an impulse beside the centre",
    source="momentum F t + J, angular momentum r x J; of a soft body, too",
)
def loads() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    still = (0.0, 0.0, 0.0)
    body = box((0.3, 0.2, 0.1), np.zeros(3))
    force = Force(np.array([0], np.int32), np.array([[10.0, 0.0, 0.0]]), 0.105, 0.605)
    arm = float(body.points[2, 1])
    push = Impulse(np.array([2], np.int32), np.array([[0.0, 0.0, 3.0]]), 0.05)
    solver = SolverMuJoCo(replace(world(body, gravity=still), loads=(force, push)))
    for _ in range(3):
        solver.step(FRAME)
    turned = solver.diagnostics().angular_momentum
    yield relative("rigid: angular momentum of the impulse", 3.0 * arm, turned[0], 1e-3, "kg m^2/s")
    for _ in range(27):
        solver.step(FRAME)
    found = solver.diagnostics().momentum
    yield relative("rigid: momentum of the force", 5.0, found[0], 1e-6, "kg m/s")
    yield relative("rigid: momentum of the impulse", 3.0, found[2], 1e-6, "kg m/s")
    vertices, tets = tet_box((3, 2, 2), (0.3, 0.2, 0.2))
    for kind in ("full", "trilinear"):
        soft = flex(vertices, tets, 1e5, 0.3, reduction=kind, cells=(2, 2, 2))
        end = np.flatnonzero(vertices[:, 0] > 0.3 - 1e-9).astype(np.int32)
        each = np.tile([4.0 / len(end), 0.0, 0.0], (len(end), 1))
        load = Force(end, each, 0.0, 0.5)
        solver = SolverMuJoCo(replace(world(soft, gravity=still, timestep=2e-3), loads=(load,)))
        for _ in range(20):
            solver.step(FRAME)
        yield relative(f"{kind}: momentum", 2.0, solver.diagnostics().momentum[0], 1e-3, "kg m/s")


@problem(
    "wind",
    title="balls fall through still air at a terminal speed",
    source="sqrt(2 m g / (rho C_D A)), A as seen from below; rigid and soft",
)
def wind() -> Iterator[Check]:
    from gdpro_sim.meshing.embedding import boundary
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    vertices, tets = tet_ball(5, 0.1)
    faces, _ = boundary(tets)
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    below = 0.5 * np.cross(b - a, c - a)[:, 2]
    area = -float(below[below < 0.0].sum())
    solid = ball(0.1, 0.0)
    light = replace(solid, mass=0.5, inertia=solid.inertia * 0.5 / solid.mass, surface=vertices)
    air = Wind(faces + FIRST, (0.0, 0.0, 0.0), 30.0, 1.0, 0.0)
    cases: list[tuple[str, Model, float]] = [("rigid", replace(world(light), loads=(air,)), 0.5)]
    soft = flex(vertices, tets, 1e6, 0.3, damping=2e-3)
    thick = Wind(faces, (0.0, 0.0, 0.0), 300.0, 1.0, 0.0)
    heavy = float(soft.masses.sum())
    cases.append(("soft", replace(world(soft, timestep=2e-3), loads=(thick,)), heavy))
    for kind, model, mass in cases:
        solver = SolverMuJoCo(model)
        for _ in range(40):
            solver.step(FRAME)
        density = 30.0 if kind == "rigid" else 300.0
        speed = math.sqrt(2.0 * mass * 9.81 / (density * area))
        yield relative(f"{kind}: speed", speed, -solver.diagnostics().momentum[2] / mass, 0.02, "m/s")


@problem(
    "terrain",
    title="bodies on height fields: a box at rest, and a ball that rolls down a slope",
    source="nothing moves; 5/7 g sin(a) t^2 / 2 of a solid ball",
)
def terrain() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    flat = HeightfieldCollider(size=(2.0, 2.0), heights=((0.1,) * 9,) * 9, position=(0.2, 0.0, 0.3))
    start = np.array([0.2, 0.0, 0.45])
    solver = SolverMuJoCo(world(box((0.1, 0.1, 0.05), start), colliders=(compile_collider(flat),)))
    for _ in range(60):
        solver.step(FRAME)
    moved = solver.surface_positions(0)[0] - start
    yield absolute("flat: height of a box after 2 s", 0.0, float(moved[2]), 1e-4, "m")
    slope = HeightfieldCollider(
        size=(6.0, 1.0), heights=(tuple(-0.5 * x for x in np.linspace(-3.0, 3.0, 13)),) * 5, friction=2.0
    )
    angle = math.atan(0.5)
    normal = np.array([math.sin(angle), 0.0, math.cos(angle)])
    centre = np.array([-2.0, 0.0, 1.0]) + 0.1 * normal
    round_ = replace(ball(0.1, 0.0, friction=2.0), centre=centre, surface=centre[None])
    solver = SolverMuJoCo(world(round_, colliders=(compile_collider(slope),)))
    for _ in range(30):
        solver.step(FRAME)
    way = float(np.linalg.norm(solver.surface_positions(0)[0] - centre))
    yield relative("slope: way of a ball in 1 s", 5.0 / 14.0 * 9.81 * math.sin(angle), way, 0.01, "m")


@problem(
    "weld",
    title="bodies held to each other move as one, and soft ones hang on rigid ones",
    source="a rod of two halves: the period of the whole; m g under a soft block",
)
def weld() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    # Two halves of a rod that swings about its end.
    joint = Joint("hinge", (-0.5, 0.0, 0.0), (0.0, 1.0, 0.0))
    halves = [
        replace(box((0.25, 0.02, 0.03), np.array([x, 0.0, 0.0])), name=f"half{x:+g}") for x in (-0.25, 0.25)
    ]
    model = world(replace(halves[0], joint=joint), halves[1])
    assert model.mujoco is not None
    solver = SolverMuJoCo(replace(model, mujoco=replace(model.mujoco, welds=((0, 1),))))
    whole = box((0.5, 0.02, 0.03), np.zeros(3), joint=joint)
    one = SolverMuJoCo(world(whole))
    for _ in range(30):
        solver.step(FRAME)
        one.step(FRAME)
    turned, alone = (float(np.arcsin(s.pose(0)[0][0, 2])) for s in (solver, one))
    yield relative("rod of two halves: angle after 1 s", alone, turned, 0.01, "rad")
    apart = solver.pose(1)[0].T @ solver.pose(0)[0]
    yield absolute("angle between the halves", 0.0, float(np.arccos(min(apart[0, 0], 1.0))), 0.01, "rad")

    vertices, tets = tet_box((2, 2, 3), (0.2, 0.2, 0.3), (-0.1, -0.1, 0.5))
    low = np.flatnonzero(vertices[:, 2] < 0.5 + 1e-9).astype(np.int32)
    held = vertices[:, 2] > 0.8 - 1e-9
    soft = flex(vertices, tets, 2e5, 0.0, damping=0.02, pinned=held, ties=(Tie(low, 1),))
    solver = SolverMuJoCo(world(soft, _weight(), timestep=2e-3))
    for _ in range(60):
        solver.step(FRAME)
    own = float(soft.masses.sum())
    load = 20.0 + 0.5 * own
    sag = 0.3 * load * 9.81 / (2e5 * 0.04)
    yield relative("block under a soft one: sag", sag, -float(solver.pose(1)[1][2]), 0.03, "m")


def _weight() -> RigidBody:
    """20 kg, 0.1 m thick, below z = 0.5 m."""
    made = box((0.1, 0.1, 0.05), np.array([0.0, 0.0, 0.45]))
    return replace(made, mass=20.0, inertia=made.inertia * 20.0 / made.mass)


PROBLEMS = (spring, loads, wind, terrain, weld)

__all__ = ["PROBLEMS", "hung"]
