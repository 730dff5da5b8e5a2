"""FEM on the ground: pressing, sliding, bouncing."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim.simulation.colliders import PlaneCollider, compile_collider
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.verification.framework import Check, at_least, at_most, problem, relative
from gdpro_sim.simulation.verification.models import make_model, tet_ball, tet_box
from gdpro_sim.simulation.verification.probe import Probe, settled, total_energy

GRAVITY = 9.81

FRICTION = 0.5


@problem(
    "hertz",
    title="An elastic ball of radius 0.1 m pressed on the ground by its own weight",
    source="Hertz: F = 4/3 E* sqrt(R) d^1.5, a = sqrt(R d), E* = E / (1 - nu^2) (Johnson, section 4.2)",
)
def hertz() -> Iterator[Check]:
    radius, young, poisson, cells = 0.1, 1e5, 0.3, 10
    modulus = young / (1.0 - poisson**2)
    vertices, tets = tet_ball(cells, radius, grading=2.5)
    for share in (0.02, 0.03):
        depth = share * radius
        force = 4.0 / 3.0 * modulus * np.sqrt(radius) * depth**1.5
        options: dict[str, Any] = {"young": young, "poisson": poisson, "friction": 0.0}
        bare = Probe(make_model(vertices, tets, density=1.0, **options))
        density = force / GRAVITY / float(bare.mass.sum())
        model = make_model(
            vertices,
            tets,
            density=density,
            ground=Ground(-radius),
            integrator="quasi-static",
            newton_tolerance=1e-5,
            newton_iterations=60,
            **options,
        )
        x = settled(model)
        probe = Probe(model)
        # What elements and weight leave over is what the ground pushes with: all of it near the lowest point.
        push = probe.forces(x)[:, 2] + GRAVITY * probe.mass
        push[vertices[:, 2] > -0.9 * radius] = 0.0
        yield relative(f"force on the ground, d = {share:g} R", force, push.sum(), 1e-3, "N")
        centre = float(np.average(x[:, 2], weights=probe.mass))
        yield relative(f"indentation, {len(tets)} tets", depth, -centre, 0.1, "m")
        # The second moment of Hertz's pressure is 2/5 a^2.
        outward = (x[:, :2] ** 2).sum(axis=1)
        half_width = float(np.sqrt(2.5 * (push * outward).sum() / push.sum()))
        yield relative(
            f"half-width of the contact, {len(tets)} tets", np.sqrt(radius * depth), half_width, 0.1, "m"
        )


@problem(
    "incline",
    title="A block on an incline, friction 0.5: it holds below atan mu = 26.57 degrees and slides above",
    source="Coulomb: rest, or a = g (sin - mu cos); flat ground with gravity tilted, and a tilted plane",
)
def incline() -> Iterator[Check]:
    limit = np.degrees(np.arctan(FRICTION))
    for degrees, tilted in ((limit - 1.0, "gravity"), (limit - 1.0, "plane")):
        solver, down = _on_incline(np.radians(degrees), tilted)
        before = solver.positions.mean(axis=0)
        for _ in range(60):
            solver.step(1 / 60)
        creep = float((solver.positions.mean(axis=0) - before) @ down)
        yield at_most(f"{degrees:.2f} degrees, {tilted} tilted: creep in 1 s once settled", 1e-5, creep, "m")
    for degrees, tilted in ((limit + 1.0, "gravity"), (limit + 1.0, "plane"), (35.0, "gravity")):
        angle = np.radians(degrees)
        solver, down = _on_incline(angle, tilted)
        before = solver.velocities.mean(axis=0)
        for _ in range(60):
            solver.step(1 / 60)
        expected = GRAVITY * (np.sin(angle) - FRICTION * np.cos(angle))
        gained = float((solver.velocities.mean(axis=0) - before) @ down)
        quantity = f"{degrees:.2f} degrees, {tilted} tilted: acceleration"
        yield relative(quantity, expected, gained / 1.0, 0.02, "m/s^2")


def _on_incline(angle: float, tilted: str) -> tuple[SolverFEM, np.ndarray]:
    """A block after a second on a plane that slopes down along x at `angle` rad, and the way down, [3].

    tilted: "plane", or "gravity" for a flat floor
    """
    vertices, tets = tet_box((2, 2, 2), (0.5,) * 3)
    cos, sin = float(np.cos(angle)), float(np.sin(angle))
    options: dict[str, Any] = {"gravity": (GRAVITY * sin, 0.0, -GRAVITY * cos), "ground": Ground()}
    down = np.array([1.0, 0.0, 0.0])
    if tilted == "plane":
        turn = np.array([[cos, 0.0, sin], [0.0, 1.0, 0.0], [-sin, 0.0, cos]])
        vertices, down = vertices @ turn.T, turn @ down
        options = {"colliders": (compile_collider(PlaneCollider(kind="plane", normal=(sin, 0.0, cos))),)}
    model = make_model(vertices, tets, young=1e6, friction=FRICTION, rayleigh_stiffness=1e-2, **options)
    solver = SolverFEM(model)
    for _ in range(60):
        solver.step(1 / 60)
    return solver, down


@problem(
    "thrown",
    title="A box thrown at the ground at 4 m/s, spinning, under each integrator: no energy from nowhere",
    source="backward Euler never gains; midpoint keeps its own (small ripples); BDF2 stays below its start",
)
def thrown() -> Iterator[Check]:
    vertices, tets = tet_box((3, 3, 3), (0.5,) * 3, (0.0, 0.0, 0.05))
    velocities = np.cross([2.0, 3.0, 1.0], vertices - vertices.mean(axis=0)) + np.array([1.0, 0.0, -4.0])
    for rule, step_bound in (("backward-euler", 1e-9), ("midpoint", 1e-4), ("bdf2", None)):
        for young, poisson in ((1e4, 0.3), (1e6, 0.49)):
            options: dict[str, Any] = {"young": young, "poisson": poisson, "integrator": rule}
            solver = SolverFEM(make_model(vertices, tets, velocities=velocities, ground=Ground(), **options))
            energies, touched, unconverged = [total_energy(solver)], False, 0
            for _ in range(40):
                solver.step(1 / 60)
                energies.append(total_energy(solver))
                touched |= solver.diagnostics().contacts > 0
                unconverged += not solver.diagnostics().converged
            label = f"{rule}, E = {young:g} Pa, nu = {poisson:g}"
            yield at_least(f"{label}: touched the ground", 1, touched)
            yield at_most(f"{label}: steps that did not converge", 0, unconverged)
            if step_bound is None:
                rise = max(energies) - energies[0]
                yield at_most(f"{label}: rise above the start / energy", 1e-6, rise / energies[0])
            else:
                rise = float(np.diff(energies).max())
                quantity = f"{label}: largest rise in a step / energy"
                yield at_most(quantity, step_bound, rise / energies[0])


@problem(
    "restitution",
    title="A ball falls by 0.5 m and bounces: the more damping, the lower",
    source="stiffness damping takes energy from every deformation; without any, waves in the ball keep some",
)
def restitution() -> Iterator[Check]:
    radius, fall = 0.1, 0.5
    vertices, tets = tet_ball(6, radius)
    before = None
    for damping in (0.0, 1e-3, 3e-3, 1e-2):
        model = make_model(
            vertices,
            tets,
            young=5e5,
            rayleigh_stiffness=damping,
            velocities=np.tile([0.0, 0.0, -np.sqrt(2.0 * GRAVITY * fall)], (len(vertices), 1)),
            ground=Ground(-radius - 1e-3),
            integrator="bdf2",
            substeps=8,
        )
        solver, mass = SolverFEM(model), Probe(model).mass
        touched = False
        for _ in range(120):
            solver.step(1 / 240)
            contacts = solver.diagnostics().contacts
            touched |= contacts > 0
            if touched and contacts == 0:
                break
        speed = float(np.average(solver.velocities[:, 2], weights=mass))
        ratio = speed / np.sqrt(2.0 * GRAVITY * fall)
        if before is None:
            yield at_least("restitution, no damping", 0.8, ratio)
            yield at_most("restitution, no damping", 1.0, ratio)
        else:
            yield at_most(f"change of the restitution with damping {damping:g} s", -0.02, ratio - before)
        before = ratio
    yield at_least("restitution at the largest damping", 0.0, ratio)


def _pair(gap: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Two boxes of unlike meshes, one above the other: vertices, tets, which vertices are the upper's [P]."""
    lower, tets = tet_box((3, 3, 3), (0.3, 0.3, 0.3))
    upper, more = tet_box((2, 2, 2), (0.2, 0.2, 0.2), (0.05, 0.05, 0.3 + gap))
    vertices = np.vstack([lower, upper])
    return (
        vertices,
        np.vstack([tets, more + len(lower)]).astype(np.int32),
        np.arange(len(vertices)) >= len(lower),
    )


@problem(
    "collision",
    title="Two boxes collide in free space, at 2 m/s and at 10 m/s with 60 frames a second",
    source="contact forces are pairwise and take energy away at most; nothing passes through",
)
def collision() -> Iterator[Check]:
    vertices, tets, upper = _pair(0.05)
    for speed in (2.0, 10.0):
        velocities = np.where(upper[:, None], [0.0, 0.0, -speed], 0.0)
        model = make_model(
            vertices, tets, young=1e5, velocities=velocities, gravity=(0, 0, 0), newton_tolerance=1e-6
        )
        mass = Probe(model).mass
        solver = SolverFEM(model)
        before = solver.diagnostics()
        rise, energy, touched, unconverged = -np.inf, total_energy(solver), False, 0
        start_energy = energy
        for _ in range(24):
            solver.step(1 / 60)
            d, now = solver.diagnostics(), total_energy(solver)
            rise, energy = max(rise, now - energy), now
            touched |= d.contacts > 0
            unconverged += not d.converged
        change = np.subtract(d.momentum, before.momentum)
        x, v = solver.positions, solver.velocities
        label = f"{speed:g} m/s"
        yield at_least(f"{label}: they touched", 1, touched)
        yield at_most(f"{label}: steps that did not converge", 0, unconverged)
        size = float(np.linalg.norm(before.momentum))
        yield at_most(f"{label}: change of momentum / momentum", 1e-6, float(np.linalg.norm(change)) / size)
        spun = np.subtract(d.angular_momentum, before.angular_momentum)
        yield at_most(
            f"{label}: change of angular momentum / (m v 0.3 m)",
            0.05,
            float(np.linalg.norm(spun)) / size / 0.3,
        )
        yield at_most(f"{label}: largest rise of energy / energy", 1e-9, rise / start_energy)
        apart = np.average(x[upper, 2], weights=mass[upper]) - np.average(x[~upper, 2], weights=mass[~upper])
        yield at_least(f"{label}: centres at the end stay apart by", 0.15, apart, "m")
        parting = np.average(v[upper, 2], weights=mass[upper]) - np.average(
            v[~upper, 2], weights=mass[~upper]
        )
        yield at_least(f"{label}: speed of parting / speed of approach", 0.0, parting / speed)


@problem(
    "stack",
    title="A box rests on another of 0.01 and of 1e-4 of its density, and one of 100 times its own",
    source="the lower box carries the upper, the ground both; at rest nothing moves",
    slow=True,
)
def stack() -> Iterator[Check]:
    vertices, tets, upper = _pair(0.004)
    for ratio in (1e-2, 1e2, 1e4):
        density = np.where(upper[tets[:, 0]], ratio, 1.0) * min(1e3, 1e5 / ratio)
        model = make_model(
            vertices,
            tets,
            young=2e6,
            density=density,
            rayleigh_mass=10.0,
            rayleigh_stiffness=2e-3,
            ground=Ground(),
            newton_iterations=40,
        )
        solver = SolverFEM(model)
        unconverged = 0
        for _ in range(90):
            solver.step(1 / 60)
            unconverged += not solver.diagnostics().converged
        probe = Probe(model)
        push = probe.forces(solver.positions)[:, 2] + GRAVITY * probe.mass
        label = f"densities {ratio:g} : 1"
        yield at_most(f"{label}: steps that did not converge", 0, unconverged)
        above, both = probe.mass[upper].sum() * GRAVITY, probe.mass.sum() * GRAVITY
        lid, floor = ~upper & (vertices[:, 2] == 0.3), vertices[:, 2] == 0.0
        yield relative(f"{label}: the lower box carries", above, -push[lid].sum(), 0.01, "N")
        yield relative(f"{label}: the ground carries", both, push[floor].sum(), 0.01, "N")
        yield at_most(f"{label}: speed left", 1e-3, np.abs(solver.velocities).max(), "m/s")


PROBLEMS = (hertz, incline, thrown, restitution, collision, stack)

__all__ = ["PROBLEMS"]
