"""Rigid bodies in MuJoCo among soft ones in MPM."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from gdpro_sim.materials import Material
from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.mpm.boundaries import Obstacles
from gdpro_sim.simulation.verification.coupling_models import (
    ball,
    coupled,
    momentum,
    total_energy,
    total_momentum,
)
from gdpro_sim.simulation.verification.framework import Check, at_most, problem, relative
from gdpro_sim.simulation.verification.mpm_models import box, make_model

GRAVITY = 9.81

STEP = 2e-3

CELL = 0.025

JELLY = Material(young=2e4, poisson=0.3, density=1000.0)


@problem(
    "head-on-particles",
    title="A ball flies at a block of jelly particles in free space: a light, an equal and a heavy one",
    source="momentum is constant, energy never rises",
    slow=True,
)
def head_on() -> Iterator[Check]:
    points = box((0.2, 0.2, 0.2), 0.5 * CELL, (-0.1, -0.1, -0.2))
    for density in (100.0, 8840.0, 80000.0):
        model = make_model(points, JELLY, dx=CELL)
        body = ball(0.06, density, (0.02, 0.0, 0.085), velocity=(0.2, 0.0, -1.0))
        solver = SolverCoupled(coupled(model, body, step=STEP))
        before, energy = total_momentum(solver), total_energy(solver)
        speed = float(np.linalg.norm(before[:3]))
        off, turned, risen, missed = 0.0, 0.0, 0.0, 0
        for _ in range(60):
            solver.step(STEP)
            change = np.abs(total_momentum(solver) - before)
            off, turned = max(off, change[:3].max() / speed), max(turned, change[3:].max() / (0.06 * speed))
            risen = max(risen, total_energy(solver) / energy - 1.0)
            missed += not solver.diagnostics().converged
        label = f"ball of {body.mass:.3g} kg"
        yield at_most(f"{label}: momentum gained or lost, share of all", 0.01, off)
        yield at_most(f"{label}: angular momentum, share of momentum times radius", 0.01, turned)
        yield at_most(f"{label}: energy gained, share of all", 1e-3, risen)
        yield at_most(f"{label}: steps in which the solvers did not agree", 0, missed)
        after = float(momentum(solver, "mujoco")[2] / body.mass)
        yield at_most(f"{label}: it is sent back or slowed: speed down", 0.99, -after, "m/s")


@problem(
    "one-solver",
    title="A ball among particles, moved by MuJoCo or by MPM itself",
    source="MPM's own free rigid obstacles, which it solves with the grid",
)
def one_solver() -> Iterator[Check]:
    points = box((0.2, 0.2, 0.2), CELL, (-0.1, -0.1, -0.2))
    model = make_model(points, JELLY, dx=2.0 * CELL)
    body = ball(0.06, 8840.0, (0.02, 0.0, 0.11), velocity=(0.2, 0.0, -1.0))
    together = SolverCoupled(coupled(model, body, step=2e-3))
    solid = together.coupling.links[0].colliders[0]
    free = replace(solid, mass=body.mass, velocity=body.velocity)
    alone = SolverMPM(replace(model, colliders=(free,)))
    obstacles = next(item for item in alone.boundaries if isinstance(item, Obstacles))
    off, most = 0.0, 0.0
    for _ in range(60):
        together.step(2e-3)
        alone.step(2e-3)
        own = obstacles.bodies.velocities[0]
        change = own - np.asarray(body.velocity)
        off = max(off, float(np.linalg.norm(momentum(together, "mujoco")[:3] / body.mass - own)))
        most = max(most, float(np.linalg.norm(change)))
    yield at_most("velocities of the ball apart, share of their change", 0.03, off / most)


@problem(
    "rest-on-sand",
    title="A ball of 1.8 kg comes to rest on sand in a box",
    source="the sand bears m g",
    slow=True,
)
def rest_on_sand() -> Iterator[Check]:
    points = box((0.3, 0.3, 0.1), 0.5 * CELL, (-0.15, -0.15, 0.0))
    model = make_model(
        points, Material.model_validate("sand"), dx=CELL, gravity=(0.0, 0.0, -GRAVITY), ground=Ground(),
        domain=((-0.15, -0.15, -0.1), (0.15, 0.15, 1.0)),
    )  # fmt: skip
    body = ball(0.06, 2000.0, (0.0, 0.0, 0.165))
    solver = SolverCoupled(coupled(model, body, step=4e-3))
    pressed, missed = [], 0
    for k in range(200):
        solver.step(4e-3)
        missed += not solver.diagnostics().converged
        if k >= 150:
            pressed.append(solver.collider_impulses("mpm")[-1, 2])
    falling = GRAVITY * 4e-3  # m/s in a step
    yield relative("impulse on the ball in a step", falling * body.mass, float(np.mean(pressed)), 0.01, "N s")
    speed = float(np.linalg.norm(momentum(solver, "mujoco")[:3]) / body.mass)
    yield at_most("the ball moves still", 5e-3, speed, "m/s")
    yield at_most("steps in which the solvers did not agree", 0, missed)


PROBLEMS = (head_on, one_solver, rest_on_sand)

__all__ = ["PROBLEMS"]
