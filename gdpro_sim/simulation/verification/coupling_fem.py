"""Rigid bodies in MuJoCo among soft ones in FEM."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.optimize import brentq

import gdpro_sim.device as devices
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Motion
from gdpro_sim.simulation.coupled import SolverCoupled
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.mujoco_model import Joint, RigidBody
from gdpro_sim.simulation.verification import mujoco_models
from gdpro_sim.simulation.verification.coupling_models import (
    ball,
    coupled,
    drop_on_jelly,
    jelly_block,
    masses,
    momentum,
    scale_under,
    total_energy,
    total_momentum,
)
from gdpro_sim.simulation.verification.framework import Check, absolute, at_most, problem, relative

GRAVITY = 9.81

STEP = 2e-3

FREE = (0.0, 0.0, 0.0)


class Pair:
    """One rigid body and one soft one in FEM, stepped together."""

    def __init__(self, block: Model, body: RigidBody, step: float = STEP) -> None:
        self.solver = SolverCoupled(coupled(block, body, step=step))
        soft = self.solver.solvers["fem"]
        assert isinstance(soft, SolverFEM)
        self.soft, self.weights, self.body = soft, masses(block), body
        self.mass = float(self.weights.sum()) + body.mass

    def centre(self) -> np.ndarray:
        """[3] m, of the rigid body's mass."""
        centre: np.ndarray = self.solver.rigid.frames(np.array([1]))[1][0]
        return centre

    def middle(self) -> np.ndarray:
        """[3] m, of the mass of both."""
        middle: np.ndarray = (self.weights @ self.soft.positions + self.body.mass * self.centre()) / self.mass
        return middle


@problem(
    "head-on",
    title="A ball flies at a jelly block of 8 kg in free space: a light, an equal and a heavy one",
    source="momentum and angular momentum are constant, the centre of mass goes straight, energy never rises",
)
def head_on() -> Iterator[Check]:
    for density in (100.0, 8840.0, 80000.0):
        block = jelly_block((5, 5, 5), (0.2, 0.2, 0.2), gravity=FREE)
        body = ball(0.06, density, (0.02, 0.0, 0.07), velocity=(0.2, 0.0, -1.0))
        pair = Pair(block, body)
        solver = pair.solver
        before, energy, start = total_momentum(solver), total_energy(solver), pair.middle()
        speed = float(np.linalg.norm(before[:3]))
        off, turned, aside, risen, missed = 0.0, 0.0, 0.0, 0.0, 0
        for _ in range(60):
            solver.step(STEP)
            change = np.abs(total_momentum(solver) - before)
            off, turned = max(off, change[:3].max() / speed), max(turned, change[3:].max() / (0.06 * speed))
            straight = before[:3] / pair.mass * solver.time
            way = pair.middle() - start - straight
            aside = max(aside, float(np.linalg.norm(way)))
            risen = max(risen, total_energy(solver) / energy - 1.0)
            missed += not solver.diagnostics().converged
        label = f"ball of {body.mass:.3g} kg"
        yield at_most(f"{label}: momentum gained or lost, share of all", 0.01, off)
        yield at_most(f"{label}: angular momentum, share of momentum times radius", 0.01, turned)
        aside /= float(np.linalg.norm(straight))
        yield at_most(f"{label}: centre of mass off its straight way, share of it", 0.01, aside)
        yield at_most(f"{label}: energy gained, share of all", 1e-3, risen)
        yield at_most(f"{label}: steps in which the solvers did not agree", 0, missed)
        yield at_most(f"{label}: its velocity after, sent back or slowed", 0.0, -_slowed(pair), "m/s")


def _slowed(pair: Pair) -> float:
    """m/s that the ball has less downwards than at the start."""
    return float(momentum(pair.solver, "mujoco")[2] / pair.body.mass - pair.body.velocity[2])


@problem(
    "drop",
    title="A ball of 1.8 kg falls 0.3 m on a jelly block of 8 kg on the ground",
    source="momentum changes by the impulses of gravity and of the ground",
    slow=True,
)
def drop() -> Iterator[Check]:
    lines = list(drop_on_jelly())
    largest = max(abs(line.ball) for line in lines)
    off = max(abs(line.ball + line.jelly - line.balance) for line in lines)
    yield at_most("momentum without a cause, share of the ball's largest", 0.01, off / largest)


@problem(
    "rest",
    title="A ball comes to rest on jelly: as heavy, and of a tenth of the jelly's density",
    source="the jelly bears m g of the ball, the ground (m + M) g",
    slow=True,
)
def rest() -> Iterator[Check]:
    for density in (1000.0, 100.0):
        # Between four vertices, which hold it like a cradle.
        block = jelly_block((5, 5, 2), (0.3, 0.3, 0.15), rayleigh_mass=10.0, rayleigh_stiffness=4e-3)
        body = ball(0.06, density, (0.0, 0.0, 0.061))
        pair = Pair(scale_under(block, -0.15), body, 4e-3)
        solver = pair.solver
        pressed, missed = [], 0
        for k in range(150):
            solver.step(4e-3)
            missed += not solver.diagnostics().converged
            if k >= 110:
                pressed.append(solver.collider_impulses("fem")[:, 2])
        ground, on_ball = np.mean(pressed, axis=0)
        label = f"density {density:g}"
        yield relative(
            f"{label}: impulse on the ball in a step", body.mass * GRAVITY * 4e-3, on_ball, 0.01, "N s"
        )
        yield relative(f"{label}: on the ground", -pair.mass * GRAVITY * 4e-3, ground, 0.01, "N s")
        speed = float(np.linalg.norm(momentum(solver, "mujoco")[:3]) / body.mass)
        yield at_most(f"{label}: the ball moves still", 5e-3, speed, "m/s")
        yield at_most(f"{label}: steps in which the solvers did not agree", 0, missed)


@problem(
    "plate",
    title="A jelly falls on one side of a plate that is hinged in its middle",
    source="angular momentum about the hinge changes by the moment of the jelly's weight",
)
def plate() -> Iterator[Check]:
    block = jelly_block((4, 4, 4), (0.12, 0.12, 0.12), top=0.2)
    shift = np.array([0.15, 0.0, 0.0], np.float32)
    block = replace(block, vertices=block.vertices + shift)
    half = (0.3, 0.15, 0.015)
    body = mujoco_models.box(half, np.zeros(3), joint=Joint("hinge", axis=(0.0, 1.0, 0.0)))
    pair = Pair(block, body)
    solver = pair.solver
    inertia = body.mass * (half[0] ** 2 + half[2] ** 2) / 3.0
    weight, moment, off, largest = float(pair.weights.sum()) * GRAVITY, 0.0, 0.0, 0.0
    for _ in range(150):
        solver.step(STEP)
        centre = pair.weights @ pair.soft.positions / pair.weights.sum()
        moment += STEP * weight * centre[0]  # of backward Euler: where it is at the end
        turning = momentum(solver, "fem")[4] + inertia * float(solver.rigid.mjdata.qvel[0])
        largest = max(largest, inertia * abs(float(solver.rigid.mjdata.qvel[0])))
        off = max(off, abs(turning - moment))
    yield at_most("angular momentum without a cause, share of the plate's largest", 0.01, off / largest)
    degrees = float(np.degrees(solver.rigid.mjdata.qpos[0]))
    yield at_most("the plate turns under the jelly", -5.0, -degrees, "degrees")


@problem(
    "bounce",
    title="A plate of 5 kg on a soft column: up and down as a mass on an elastic bar",
    source="b tan b = M / m, angular frequency b sqrt(E / density) / L (Rao, section 8.3)",
    slow=True,
)
def bounce() -> Iterator[Check]:
    young, density, edge, length = 2e4, 200.0, 0.2, 0.2
    block = jelly_block(
        (4, 4, 8), (edge, edge, length), young=young, poisson=0.0, density=density, integrator="bdf2",
    )  # fmt: skip
    foot = block.vertices[:, 2] < -length + 1e-6
    body = mujoco_models.box((0.11, 0.11, 0.02), np.array([0.0, 0.0, 0.02]))
    share = 5.0 / body.mass
    body = replace(body, mass=5.0, inertia=share * body.inertia)
    pair = Pair(replace(block, pinned=foot, ground=Ground(-length)), body)
    heights = []
    for _ in range(400):
        pair.solver.step(STEP)
        heights.append(pair.centre()[2])
    settled = np.asarray(heights) - np.mean(heights)
    crossings = np.flatnonzero((settled[:-1] < 0.0) & (settled[1:] >= 0.0))
    at = crossings - settled[crossings] / (settled[crossings + 1] - settled[crossings])
    period = STEP * float(np.diff(at).mean())
    ratio = density * edge * edge * length / body.mass
    root = brentq(lambda b: b * np.tan(b) - ratio, 1e-6, 0.5 * np.pi - 1e-6)
    expected = 2.0 * np.pi * length / (root * np.sqrt(young / density))
    yield relative("period, 768 tets", expected, period, 0.05, "s")


@problem(
    "driven",
    title="A ball too heavy to notice goes through jelly as one on keyframes does",
    source="the FEM solver alone, with a moving obstacle",
)
def driven() -> Iterator[Check]:
    block = jelly_block((5, 5, 5), (0.2, 0.2, 0.2), gravity=FREE)
    body = ball(0.06, 1e9, (0.02, 0.0, 0.065), velocity=(0.0, 0.0, -0.5))
    pair = Pair(block, body)
    motion = Motion(
        np.zeros(0, np.int32), body.centre, np.array([0.0, 1.0]),
        np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -0.5]]), np.zeros((2, 3)),
    )  # fmt: skip
    solid = pair.solver.coupling.links[0].colliders[0]
    obstacle: Collider = replace(solid, motion=motion)
    alone = SolverFEM(replace(block, colliders=(obstacle,)))
    for _ in range(50):
        pair.solver.step(STEP)
        alone.step(STEP)
    off = float(np.linalg.norm(pair.soft.positions - alone.positions, axis=1).max())
    moved = float(np.linalg.norm(alone.positions - block.vertices, axis=1).max())
    yield at_most("vertices elsewhere, share of the largest way", 1e-3, off / moved)


@problem(
    "same-bytes",
    title="An impact gives the same bytes on 1 and 2 threads, and after a restart",
    source="sums run in an order of the problem's own (DESIGN.md)",
)
def same_bytes() -> Iterator[Check]:
    body = ball(0.06, 3000.0, (0.02, 0.0, 0.065), velocity=(0.2, 0.0, -1.0), angular_velocity=(0.0, 3.0, 1.0))
    model = coupled(jelly_block((7, 7, 7), (0.2, 0.2, 0.2)), body, step=4e-3)

    def digest(solver: SolverCoupled) -> str:
        state = hashlib.sha256()
        for name, array in sorted(solver.state_dict().items()):
            state.update(name.encode() + np.ascontiguousarray(array).tobytes())
        return state.hexdigest()

    frames, before, digests = 3, devices.thread_count(), []
    try:
        for threads in (1, 2):
            devices.set_thread_count(threads)
            solver = SolverCoupled(model)
            for _ in range(frames):
                solver.step(1 / 60)
            digests.append(digest(solver))
    finally:
        devices.set_thread_count(before)
    solver = SolverCoupled(model)
    for _ in range(frames - 1):
        solver.step(1 / 60)
    kept = solver.state_dict()
    solver = SolverCoupled(model)
    solver.load_state_dict(kept)
    solver.step(1 / 60)
    yield at_most("different states over 1 and 2 threads", 1, len(set(digests)))
    yield at_most("states other than these after a restart", 0, len({digest(solver)} - set(digests)))
    change = float(momentum(solver, "mujoco")[2] / body.mass + GRAVITY * solver.time + 1.0)
    yield absolute("the ball met the jelly: its velocity changed", 0.5, change, 0.45, "m/s")


PROBLEMS = (head_on, drop, rest, plate, bounce, driven, same_bytes)

__all__ = ["PROBLEMS"]
