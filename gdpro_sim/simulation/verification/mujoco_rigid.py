"""Rigid bodies in MuJoCo: inertia, friction, restitution, a pendulum, rest, free flight, exact states."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gdpro_sim.meshing.convex import fit_primitive, mass_properties, tet_mass_properties
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.meshing.tetmesh import TetMesh
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.mujoco_model import Joint
from gdpro_sim.simulation.verification.framework import Check, absolute, at_most, problem, relative
from gdpro_sim.simulation.verification.models import tet_ball, tet_box
from gdpro_sim.simulation.verification.mujoco_models import ball, box, world

FRAME = 1.0 / 30.0


@problem(
    "inertia",
    title="mass and inertia of meshes, and the primitives that stand for them",
    source="the box: m (b^2 + c^2) / 12; Mirtich 1996; sums over tetrahedra",
)
def inertia() -> Iterator[Check]:
    sides = np.array([0.6, 0.4, 0.2])
    vertices, tets = tet_box((3, 2, 2), tuple(sides), (1.0, -2.0, 3.0))
    solid = mass_properties(vertices, boundary(tets)[0])
    volume = float(sides.prod())
    squares = sides**2
    yield relative("box: volume", volume, solid.volume, 1e-12, "m^3")
    centre = np.array([1.0, -2.0, 3.0]) + sides / 2
    yield absolute("box: centre", 0.0, float(np.abs(solid.centre - centre).max()), 1e-12, "m")
    exact = np.diag(volume * (squares.sum() - squares) / 12.0)
    yield absolute("box: inertia", 0.0, float(np.abs(solid.inertia - exact).max() / exact.max()), 1e-12)
    vertices, tets = tet_ball(8, 0.3)
    vertices = vertices * [1.0, 0.7, 1.4]
    surface = mass_properties(vertices, boundary(tets)[0])
    filled = tet_mass_properties(
        TetMesh(vertices.astype(np.float32), tets, np.ones(len(tets), np.float32), "lattice")
    )
    off = np.abs(surface.inertia - filled.inertia).max() / surface.inertia.max()
    yield absolute("ellipsoid: inertia of its surface and of its tets", 0.0, float(off), 1e-6)
    for kind, size in (("box", np.sort(sides / 2)), ("cylinder", None), ("capsule", None), ("sphere", None)):
        fit = fit_primitive(kind, solid)  # type: ignore[arg-type]
        if size is not None:
            yield absolute(
                "box fitted to a box", 0.0, float(np.abs(np.sort(fit.size) - size).max()), 1e-9, "m"
            )
        yield relative(f"{kind} fitted to a box: volume", volume, _volume(fit.kind, fit.size), 1e-9, "m^3")


def _volume(kind: str, size: tuple[float, ...]) -> float:
    if kind == "box":
        return 8.0 * float(np.prod(size))
    ends = 4.0 / 3.0 * math.pi * size[0] ** 3 if kind in ("sphere", "capsule") else 0.0
    return ends + (2.0 * math.pi * size[0] ** 2 * size[1] if len(size) > 1 else 0.0)


@problem(
    "incline",
    title="a box on a slope holds below atan(mu), and slides above it at g (sin - mu cos)",
    source="Coulomb friction, mu = 0.5: atan 0.5 = 26.565 degrees; 2 s from rest",
)
def incline() -> Iterator[Check]:
    for degrees in (26.0, 27.0, 35.0):
        angle = math.radians(degrees)
        normal = np.array([math.sin(angle), 0.0, math.cos(angle)])
        down = np.array([math.cos(angle), 0.0, -math.sin(angle)])
        turn = np.stack([down, [0.0, 1.0, 0.0], normal], axis=1)
        body = box((0.1, 0.1, 0.05), 0.05 * normal, turn, friction=0.5)
        slope = Collider("slope", "plane", rotation=turn)
        final = _run(world(body, colliders=(slope,)), 2.0)
        way = float((final - 0.05 * normal) @ down)
        exact = 2.0 * 9.81 * (math.sin(angle) - 0.5 * math.cos(angle))
        if exact <= 0.0:
            yield at_most(f"slope {degrees:g} degrees: creep", 1e-4, abs(way), "m")
        else:
            yield relative(f"slope {degrees:g} degrees: way", exact, way, 0.01, "m")


def _run(model: object, seconds: float) -> np.ndarray:
    """Where the first body's centre is after that time, [3] m."""
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    solver = SolverMuJoCo(model)  # type: ignore[arg-type]
    for _ in range(round(seconds / FRAME)):
        solver.step(FRAME)
    turn, shift = solver.pose(0)
    centre: np.ndarray = turn @ solver.bodies[0].centre + shift
    return centre


@problem(
    "bounce",
    title="a ball dropped on the ground comes back with its restitution",
    source="speed after = e times speed before; the mean of nine heights",
)
def bounce() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    for wanted, bound in ((0.5, 0.05), (0.8, 0.02), (1.0, 0.01)):
        found = []
        for height in np.linspace(1.0, 1.004, 9):
            solver = SolverMuJoCo(world(ball(0.1, height, restitution=wanted), ground=True))
            before = math.sqrt(2.0 * 9.81 * (height - 0.1))
            data = solver.mjdata
            while data.time < 2.0 and not (data.qvel[2] > 0.0 and data.qpos[2] > 0.1):
                solver.step(1e-3)
            found.append(math.sqrt(data.qvel[2] ** 2 + 2.0 * 9.81 * (data.qpos[2] - 0.1)) / before)
        yield relative(f"e = {wanted:g}: restitution", wanted, float(np.mean(found)), bound)


@problem(
    "pendulum",
    title="a rod on a hinge swings with the period of a compound pendulum",
    source="2 pi sqrt(I / m g d) (1 + a^2 / 16 + 11 a^4 / 3072) for an amplitude a",
)
def pendulum() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    rod = box((0.5, 0.02, 0.03), np.zeros(3), joint=Joint("hinge", (-0.5, 0.0, 0.0), (0.0, 1.0, 0.0)))
    for degrees in (5.0, 60.0):
        solver = SolverMuJoCo(world(rod))
        data, a = solver.mjdata, math.radians(degrees)
        data.qpos[0] = math.pi / 2 - a
        times: list[float] = []
        before = -1.0
        while len(times) < 3 and data.time < 20.0:
            solver.step(1e-3)
            angle = float(data.qpos[0]) - math.pi / 2
            if before < 0.0 <= angle:
                times.append(data.time - 1e-3 * angle / (angle - before))
            before = angle
        inertia_ = rod.inertia[1, 1] + rod.mass * 0.25
        exact = 2.0 * math.pi * math.sqrt(inertia_ / (rod.mass * 9.81 * 0.5))
        exact *= 1.0 + a**2 / 16.0 + 11.0 * a**4 / 3072.0 + 173.0 * a**6 / 737280.0
        yield relative(f"{degrees:g} degrees: period", exact, float(np.diff(times).mean()), 1e-4, "s")


@problem(
    "rest",
    title="a box at rest stays where it is, and a stack of two stands",
    source="nothing moves; 10 s and 3 s",
)
def rest() -> Iterator[Check]:
    start = np.array([0.0, 0.0, 0.05])
    moved = _run(world(box((0.1, 0.1, 0.05), start), ground=True), 10.0) - start
    yield at_most("drift on the ground in 10 s", 1e-6, float(np.hypot(*moved[:2])), "m")
    yield at_most("sinking in 10 s", 1e-4, abs(float(moved[2])), "m")
    from dataclasses import replace

    upper = replace(box((0.05, 0.05, 0.05), np.array([0.02, 0.0, 0.15])), name="upper", friction=0.8)
    moved = _run(world(upper, box((0.1, 0.1, 0.05), start), ground=True), 3.0) - upper.centre
    yield at_most("stack: drift of the upper box in 3 s", 1e-4, float(np.linalg.norm(moved)), "m")


@problem(
    "flight",
    title="momentum and energy of a tumbling box in flight, and a state continued to the same bytes",
    source="conservation; parabola; bytes compared",
)
def flight() -> Iterator[Check]:
    from gdpro_sim.simulation.mujoco import SolverMuJoCo

    body = box((0.3, 0.2, 0.1), np.zeros(3), velocity=(1.0, 2.0, 3.0), angular_velocity=(0.1, 6.0, 0.1))
    solver = SolverMuJoCo(world(body, gravity=(0.0, 0.0, 0.0)))
    first = solver.diagnostics()
    for _ in range(30):
        solver.step(FRAME)
    kept = solver.state_dict()
    for _ in range(30):
        solver.step(FRAME)
    last, end = solver.diagnostics(), solver.state_dict()
    yield relative("kinetic energy after 2 s", first.kinetic_energy, last.kinetic_energy, 1e-3, "J")
    off = np.linalg.norm(np.subtract(last.momentum, first.momentum)) / np.linalg.norm(first.momentum)
    yield absolute("linear momentum", 0.0, float(off), 1e-9)
    off = np.linalg.norm(np.subtract(last.angular_momentum, first.angular_momentum))
    off /= np.linalg.norm(first.angular_momentum)
    yield absolute("angular momentum", 0.0, float(off), 2e-3)
    again = SolverMuJoCo(world(body, gravity=(0.0, 0.0, 0.0)))
    again.load_state_dict(kept)
    for _ in range(30):
        again.step(FRAME)
    same = all(np.array_equal(end[key], again.state_dict()[key]) for key in end)
    yield absolute("continued from its middle: other bytes", 0.0, float(not same), 0.0)
    falling = _run(world(body), 1.0)
    exact = np.array([1.0, 2.0, 3.0 - 0.5 * 9.81])
    yield absolute("free fall for 1 s", 0.0, float(np.linalg.norm(falling - exact)), 0.01, "m")


PROBLEMS = (inertia, incline, bounce, pendulum, rest, flight)

__all__ = ["PROBLEMS"]
