"""Time integration: what each rule asks the incremental potential, and what it makes of the answer.

Implicit rules solve M (x - y) / h^2 = forces(x), velocities (x - base) / h, with

    backward-euler  h = dt      base = x_n                     y = base + h v_n + h^2 g
    bdf2            h = 2 dt/3  base = (4 x_n - x_{n-1}) / 3   y = base + h (4 v_n - v_{n-1}) / 3 + h^2 g
    midpoint        h = dt/2    as backward Euler, to the middle of the step; then x_{n+1} = 2 x - x_n

BDF2 starts, and restarts where the step length changes or pins let go, with one step of backward Euler.
Sources: Hairer & Wanner, "Solving Ordinary Differential Equations II", 2nd ed., eq. III.1.22' (BDF2) and
IV.3 (midpoint).
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import warp as wp

from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.fem.term import Step


class State:
    """What changes from step to step, on the device.

    x, v:               [P] vec3d, m and m/s
    x_before, v_before: the same, one step of length `dt_before` ago; 0 where there is none
    """

    def __init__(self, count: int, device: str) -> None:
        self.x, self.v, self.x_before, self.v_before = (
            wp.zeros(count, dtype=wp.vec3d, device=device) for _ in range(4)
        )
        self.dt_before: wp.array = wp.zeros(1, dtype=wp.float64, device=device)

    def arrays(self) -> dict[str, wp.array]:
        return {
            "positions": self.x,
            "velocities": self.v,
            "positions_before": self.x_before,
            "velocities_before": self.v_before,
            "dt_before": self.dt_before,
        }


class ImplicitStep:
    """One step of `rule` over dt seconds from a state; the potential's trial is to become its solution."""

    def __init__(
        self,
        rule: Literal["backward-euler", "bdf2", "midpoint"],
        potential: IncrementalPotential,
        state: State,
        held: wp.array,
        time: float,
        dt: float,
        gravity: Any,
        *,
        settled: bool = False,
    ) -> None:
        """`settled`: a pseudo-step towards where forces balance at time + dt; no time passes."""
        if rule == "bdf2" and (
            abs(float(state.dt_before.numpy()[0]) - dt) > 1e-9 * dt or potential.lets_go(time, time + dt)
        ):
            rule = "backward-euler"
        self.rule, self.dt = rule, dt
        self._potential, self._state, self._gravity = potential, state, gravity
        h = {"backward-euler": dt, "bdf2": 2.0 * dt / 3.0, "midpoint": 0.5 * dt}[rule]
        reached = time + (0.5 * dt if rule == "midpoint" else dt)
        start = time + dt if settled else time
        self.step = Step(reached, h, state.x, state.v, potential.base, held, start, time + dt)

    def begin(self, coasting: wp.array, resting: wp.array) -> None:
        """Set up the potential, and two guesses beside its `inertia`: going on as before, and staying."""
        p, s, h = self._potential, self._state, self.step.h
        wp.copy(self.step.held, s.x)
        p.begin(self.step)
        if self.rule == "bdf2":
            p.combine(s.x, 4.0 / 3.0, s.x_before, -1.0 / 3.0, p.base)
            p.combine(s.v, 4.0 / 3.0, s.v_before, -1.0 / 3.0, p.inertia)
            p.combine(p.base, 1.0, p.inertia, h, p.inertia, wp.float64(h * h) * self._gravity)
            p.strain_base(s.x, 4.0 / 3.0, s.x_before, -1.0 / 3.0)
        else:
            wp.copy(p.base, s.x)
            p.combine(s.x, 1.0, s.v, h, p.inertia, wp.float64(h * h) * self._gravity)
            p.strain_base(s.x, 1.0, s.x, 0.0)
        p.combine(s.x, 1.0, s.v, 0.5 * self.dt if self.rule == "midpoint" else self.dt, coasting)
        wp.copy(resting, s.x)
        for array in (p.inertia, coasting, resting):
            p.hold(self.step.held, array)

    def finish(self) -> bool:
        """Make the trial the new state. False, and nothing done, where the midpoint rule would touch or pass
        through something, or turn an element inside out, on the second half of its way."""
        p, s, h = self._potential, self._state, self.step.h
        if self.rule == "midpoint":
            p.combine(p.trial, 2.0, s.x, -1.0, p.inertia)
            touching = any(term.report(p.inertia).get("contacts", 0.0) > 0.0 for term in p.terms)
            if touching or not p.reachable(p.trial, p.inertia):
                return False
            if not np.isfinite(p.elastic_energy(p.inertia)):
                return False
        for term in p.terms:
            term.finish(p.trial)
        wp.copy(s.x_before, s.x)
        wp.copy(s.v_before, s.v)
        s.dt_before.fill_(self.dt)
        if self.rule == "midpoint":
            p.combine(p.trial, 2.0 / h, s.x, -2.0 / h, p.base)
            p.combine(p.base, 1.0, s.v, -1.0, s.v)
            p.combine(p.inertia, 1.0 / self.dt, s.x, -1.0 / self.dt, p.base)
            p.hold(p.base, s.v)
            wp.copy(s.x, p.inertia)
        else:
            p.combine(p.trial, 1.0 / h, p.base, -1.0 / h, s.v)
            wp.copy(s.x, p.trial)
        p.flow(s.x)
        return True


__all__ = ["ImplicitStep", "State"]
