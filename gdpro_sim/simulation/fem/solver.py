"""Finite elements in time: implicit steps by projected Newton on the potential, or explicit ones."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import fem
from gdpro_sim.simulation.fem.colliders import collider_contacts
from gdpro_sim.simulation.fem.conjugate_gradient import SolveReport
from gdpro_sim.simulation.fem.contact import body_contact
from gdpro_sim.simulation.fem.forces import force_terms
from gdpro_sim.simulation.fem.integrators import ImplicitStep, State
from gdpro_sim.simulation.fem.potential import IncrementalPotential, StepMeasures
from gdpro_sim.simulation.fem.rest import rest_shapes
from gdpro_sim.simulation.fem.rigid_modes import RigidModes
from gdpro_sim.simulation.fem.term import Step, Term
from gdpro_sim.simulation.model import Diagnostics, Model

logger = logging.getLogger(__name__)

ARMIJO = 1e-4
"""Share of the predicted decrease a step must keep (Nocedal & Wright, 2nd ed., eq. 3.4)."""

STRAIGHT = 0.7
"""A full step that lowers the energy by more than this share of what its slope promises is lengthened; at the
minimum of a parabola it is 1/2."""

LONGEST = 8.0
"""A full step is lengthened by at most this factor."""

MAX_HALVINGS = 30
"""Line search halvings before a Newton iteration is given up."""

MAX_SPLITS = 4
"""A substep that fails is halved at most this many times."""

MAX_BLOCKED = 16
"""The same, where nothing that the solve could start from is possible: moving pins push into something that
rests, or an element would turn inside out. Once that moves along, it is a start that is."""

LAGGED = 10
"""Newton iterations that take friction limits and contact candidates anew; the later ones keep them, so that
they descend on one fixed energy."""

NEGLIGIBLE = 0.01
"""A residual that inertia alone would undo within this share of the tolerance counts as solved."""

LAST = 0.1
"""Of that, what rigid motions may keep in an iteration that may be the last: it is what momentum lacks."""

RELAXATIONS = 60
"""Pseudo-steps of a quasi-static step before it counts as not converged."""

SLOWING = 4.0
"""Each pseudo-step of a quasi-static step is this much longer than the one before."""

EXPLICIT_SAFETY = 0.9
"""Explicit steps are this share of the longest stable one, 2 / (largest frequency)."""

MAX_EXPLICIT = 100_000
"""Explicit substeps per step past which the solver refuses."""


@dataclass
class _Counters:
    substeps: int = 0
    newton_iterations: int = 0
    cg_iterations: int = 0
    converged: bool = True
    residual: float = 0.0


@dataclass(frozen=True)
class _Outcome:
    """How the Newton iteration of one substep ended."""

    converged: bool
    finite: bool
    residual: float


class SolverFEM:
    """Linear-tet FEM for a compiled `Model`; implements `gdpro_sim.simulation.model.Solver`.

    Elements with lumped mass and Rayleigh damping, fixed vertices, and terms: forces, contact with colliders
    and between bodies. Positions and all solver arithmetic are float64: steps are accepted by comparing
    energies of nearly equal states, and the stress of a stiff body is a small difference of large numbers.
    On the CPU results are the same bytes for any number of threads.

    Raises SolverError when an element has no volume at rest, or two bodies overlap at the start.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        rest = rest_shapes(model)
        contacts = collider_contacts(model, rest)
        self._obstacles = contacts[len(contacts) - len(model.colliders) :]
        self._guided = [obstacle for obstacle in self._obstacles if obstacle.guided]
        self.terms: tuple[Term, ...] = (
            *force_terms(model, rest),
            *contacts,
            *body_contact(model, rest),
        )
        self._potential = IncrementalPotential(model, rest, self.terms)
        self._rigid_fixed = self._potential.fixed
        self._rigid = RigidModes(model.tets, self._potential.mass, self._rigid_fixed)
        self._rest = model.vertices.astype(np.float64)
        self._gravity = wp.vec3d(*model.gravity)
        # Symplectic Euler with damping b w^2: W^2 = b w^2 W + w^2 (criterion of Jury).
        damped = float(np.max(model.rayleigh_stiffness, initial=0.0)) * rest.frequency**2
        damped += float(np.max(model.rayleigh_mass, initial=0.0))
        elastic = 0.5 * (damped + math.hypot(damped, 2.0 * rest.frequency))
        frequency = math.hypot(elastic, *(term.frequency for term in self.terms))
        self._explicit_dt = 2.0 * EXPLICIT_SAFETY / max(frequency, 1e-30)
        count = len(model.vertices)
        self._state = State(count, model.device)
        self._coasting, self._resting, self._held = (
            wp.zeros(count, dtype=wp.vec3d, device=model.device) for _ in range(3)
        )
        self._changing = self._state.arrays() | self._potential.state()
        for k, term in enumerate(self.terms):
            self._changing.update({f"terms.{k}.{name}": array for name, array in term.state().items()})
        self._saved = {name: wp.clone(array) for name, array in self._changing.items()}
        self._initial = {name: array.numpy().copy() for name, array in self._changing.items()}
        velocities = model.velocities.astype(np.float64)
        velocities[self._potential.fixed] = 0.0
        self._initial |= {"positions": self._rest, "velocities": velocities}
        self._time = 0.0
        self._counters = _Counters()
        self.reset()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._time

    @property
    def positions(self) -> np.ndarray:
        """[P, 3] float64 m, a copy."""
        return self._state.x.numpy().copy()

    @property
    def velocities(self) -> np.ndarray:
        """[P, 3] float64 m/s, a copy."""
        return self._state.v.numpy().copy()

    def reset(self) -> None:
        """Back to the model's initial state."""
        self._assign(self._initial)
        self._time = 0.0
        self._counters = _Counters()
        self._stand()

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds in `FemSettings.substeps` implicit steps, halving those that fail.

        A quasi-static step goes to where forces balance at its end; an explicit one takes as many substeps
        as are stable. Raises SolverError, leaving the state as it was, if a substep has no finite solution.
        A substep that stays unconverged at its shortest is accepted (it never raises the energy) and
        reported by `diagnostics().converged`.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise SolverError(f"step length must be a finite number > 0 s, got {dt}")
        for name, array in self._changing.items():
            wp.copy(self._saved[name], array)
        before, time, impulses = self._counters, self._time, [item.impulse for item in self._guided]
        self._counters = _Counters()
        for item in self._guided:
            item.impulse = np.zeros(6)
        try:
            self._advance_all(dt)
        except BaseException:  # Ctrl-C too: half a step is no state to continue from
            for name, array in self._changing.items():
                wp.copy(array, self._saved[name])
            self._counters, self._time = before, time
            for item, impulse in zip(self._guided, impulses, strict=True):
                item.impulse = impulse
            raise
        self._time = time + dt
        if not self._counters.converged:
            logger.warning(
                "FEM step to t = %.6g s did not converge: Newton still moves %.3g m/s (tolerance %.3g)",
                self._time,
                self._counters.residual,
                self.model.fem.newton_tolerance,
            )

    def _advance_all(self, dt: float) -> None:
        settings = self.model.fem
        if settings.integrator == "explicit":
            self._explicit(dt)
        elif settings.integrator == "quasi-static":
            self._relax(dt)
        else:
            for _ in range(settings.substeps):
                self._advance(dt / settings.substeps, settings.integrator, 0)

    def _advance(self, dt: float, rule: Literal["backward-euler", "bdf2", "midpoint"], splits: int) -> None:
        if rule == "midpoint" and self._touching(self._state.x):
            rule = "backward-euler"
        step, outcome = self._minimise(dt, rule)
        if not outcome.converged and splits < (MAX_SPLITS if outcome.finite else MAX_BLOCKED):
            logger.debug("substep of %.3g s failed (%s): halved", dt, outcome)
            self._advance(dt / 2.0, rule, splits + 1)
            self._advance(dt / 2.0, rule, splits + 1)
            return
        if not outcome.finite:
            raise SolverError(
                f"no finite solution for a substep of {dt:.3g} s at t = {self._time:.6g} s: raise the "
                "substeps, or check velocities and material constants"
            )
        if rule != "midpoint":  # which touches nothing
            self._take_impulses(self._potential.trial, dt)
        if (rule == "midpoint" and self._touching(self._potential.trial)) or not step.finish():
            logger.debug("midpoint step of %.3g s meets something: backward Euler instead", dt)
            self._advance(dt, "backward-euler", splits)
            return
        self._time += dt
        counters = self._counters
        counters.substeps += 1
        counters.converged &= outcome.converged
        counters.residual = max(counters.residual, outcome.residual)

    def _take_impulses(self, x: wp.array, dt: float) -> None:
        for item in self._guided:
            item.take_impulse(x, dt)

    def _touching(self, x: wp.array) -> bool:
        return any(term.report(x).get("contacts", 0.0) > 0.0 for term in self.terms)

    def _relax(self, dt: float) -> None:
        """Where forces balance at the end of the step: backward Euler from rest, in ever longer steps.

        Converged once a pseudo-step a thousand times dt long moves nothing by newton_tolerance * dt.
        """
        state, counters, settings = self._state, self._counters, self.model.fem
        self._time += dt
        pseudo, longest = dt, 1e3 * dt
        for _ in range(RELAXATIONS):
            state.v.zero_()
            state.dt_before.zero_()
            before = state.x.numpy().copy()
            step, outcome = self._minimise(pseudo, "backward-euler", time=self._time - pseudo)
            counters.substeps += 1
            if outcome.finite and outcome.converged:
                step.finish()
                moved = float(np.linalg.norm(state.x.numpy() - before, axis=1).max(initial=0.0))
                counters.residual = moved / dt
                if pseudo >= longest and moved <= settings.newton_tolerance * dt:
                    state.v.zero_()
                    return
                pseudo = min(SLOWING * pseudo, longest)
            else:
                pseudo *= 0.25
        state.v.zero_()
        counters.converged = False

    def _explicit(self, dt: float) -> None:
        """Symplectic Euler, v then x, in substeps short enough for the stiffest element."""
        p, state = self._potential, self._state
        count = max(self.model.fem.substeps, math.ceil(dt / self._explicit_dt))
        if count > MAX_EXPLICIT:
            raise SolverError(
                f"explicit steps of {self._explicit_dt:.3g} s would be needed {count:,} times in a step of "
                f"{dt:.3g} s (at most {MAX_EXPLICIT:,}); use an implicit integrator"
            )
        h = dt / count
        for _ in range(count):
            end = self._time + h
            step = Step(end, h, state.x, state.v, p.base, self._held, self._time, end)
            wp.copy(self._held, state.x)
            p.combine(state.x, 1.0, state.v, -h, p.base)
            p.begin(step)
            # Strain rates over the step before: C now less C then, over its length.
            known = float(state.dt_before.numpy()[0]) > 0.0
            p.strain_base(state.x_before if known else state.x, 1.0, state.x, 0.0)
            p.lag(state.x)
            p.forces(state.x)
            self._take_impulses(state.x, h)
            wp.copy(state.x_before, state.x)
            p.over_vertices(
                fem.kick, [p.vertices, p.element_gradient, p.gradient, self._gravity, h], [state.v]
            )
            p.combine(state.x, 1.0, state.v, h, p.trial)
            p.hold(self._held, p.trial)
            if p.terms and not p.reachable(state.x, p.trial):
                raise SolverError(
                    f"an explicit step of {h:.3g} s at t = {self._time:.6g} s would pass through something; "
                    "use an implicit integrator, or raise the substeps"
                )
            p.combine(p.trial, 1.0 / h, state.x, -1.0 / h, p.base)
            p.hold(p.base, state.v)
            wp.copy(state.x, p.trial)
            state.dt_before.fill_(h)
            for term in p.terms:
                term.finish(state.x)
            p.flow(state.x)
            self._time += h
        if not math.isfinite(p.elastic_energy(state.x)):
            raise SolverError(
                f"an element turned inside out in explicit steps of {h:.3g} s to t = {self._time:.6g} s; use "
                "an implicit integrator, or raise the substeps"
            )
        self._counters.substeps += count

    def _minimise(
        self, dt: float, rule: Literal["backward-euler", "bdf2", "midpoint"], *, time: float | None = None
    ) -> tuple[ImplicitStep, _Outcome]:
        """Projected Newton on the incremental potential; leaves the result in the potential's trial."""
        when = self._time if time is None else time
        settled = time is not None
        step = ImplicitStep(
            rule, self._potential, self._state, self._held, when, dt, self._gravity, settled=settled
        )
        step.begin(self._coasting, self._resting)
        if self._rigid_fixed is not self._potential.fixed:  # pins let go
            self._rigid_fixed = self._potential.fixed
            self._rigid = RigidModes(self.model.tets, self._potential.mass, self._rigid_fixed)
        return step, self._newton(step.step.h)

    def _newton(self, h: float) -> _Outcome:
        potential, settings = self._potential, self.model.fem
        tolerance = settings.newton_tolerance * h
        energy = self._choose_start()
        if not math.isfinite(energy):
            return _Outcome(converged=False, finite=False, residual=math.inf)
        residual, exact = math.inf, True
        for iteration in range(settings.newton_iterations):
            wp.copy(potential.start, potential.trial)
            # Lagged values follow the iterate, then stay, so that the late iterations descend on one fixed
            # energy.
            if iteration <= LAGGED:
                potential.lag(potential.start)
                energy = potential.energy(potential.start, elements_unchanged=True)
            potential.linearise(potential.start, exact=exact)
            acceleration = potential.largest_acceleration()
            if not (math.isfinite(energy) and math.isfinite(acceleration)):
                return _Outcome(converged=False, finite=False, residual=residual)
            if acceleration * h * h <= NEGLIGIBLE * tolerance:
                return _Outcome(converged=True, finite=True, residual=acceleration * h)

            report, (slope, largest_move) = self._solve()
            if exact and not (report.definite and slope < 0.0):
                # No minimum of the quadratic model: for the rest of this step, elements are projected.
                exact = False
                potential.linearise(potential.start)
                report, (slope, largest_move) = self._solve()
            negligible = NEGLIGIBLE * max(tolerance, 0.1 * largest_move) / (h * h)
            if largest_move <= tolerance:
                negligible *= LAST
            if self._rigid.correct(potential.system, potential.start.numpy(), negligible):
                slope, largest_move = potential.step_measures()
            self._counters.newton_iterations += 1
            residual = largest_move / h
            if not (math.isfinite(slope) and math.isfinite(largest_move)):
                return _Outcome(converged=False, finite=False, residual=residual)

            length, energy = self._line_search(energy, slope)
            if length == 0.0:
                if not exact:
                    return _Outcome(converged=False, finite=True, residual=residual)
                exact = False
                continue
            if report.converged and length == 1.0 and largest_move <= tolerance:
                return _Outcome(converged=True, finite=True, residual=residual)
        return _Outcome(converged=False, finite=True, residual=residual)

    def _solve(self) -> tuple[SolveReport, StepMeasures]:
        """Solve the linear system as it stands."""
        settings, potential = self.model.fem, self._potential
        report = potential.system.solve(settings.cg_tolerance, settings.cg_iterations)
        self._counters.cg_iterations += report.iterations
        return report, potential.step_measures()

    def _choose_start(self) -> float:
        """Put the lowest guess that can be reached into the trial: resting, coasting, falling; where none of
        them can, since pins push into what rests on them, everything carried along.

        Returns its energy; infinity where none can be reached or has a finite one.
        """
        potential, x = self._potential, self._state.x
        potential.lag(x)
        best, lowest = None, math.inf
        guesses = (self._resting, self._coasting, potential.inertia)
        last = None
        for guess in guesses:
            if potential.reachable(x, guess):
                energy = potential.energy(guess)
                last = guess
                if energy < lowest:
                    best, lowest = guess, energy
        if best is None and potential.fixed.any():
            ways = (self._held.numpy() - x.numpy())[potential.fixed]
            carried = self._resting
            potential.combine(x, 1.0, x, 0.0, carried, wp.vec3d(*ways.mean(axis=0)))
            potential.hold(self._held, carried)
            if potential.reachable(x, carried):
                best, last, lowest = carried, carried, potential.energy(carried)
        if best is None:
            return math.inf
        wp.copy(potential.trial, best)
        return lowest if best is last else potential.energy(potential.trial)

    def _line_search(self, energy: float, slope: float) -> tuple[float, float]:
        """Halve the step until the energy falls enough: (length, energy there); (0, energy) if it never does.

        It starts no longer than the way is free. An inverted element has infinite energy, so no accepted step
        inverts one.
        """
        potential = self._potential
        noise = potential.energy_noise + 1e-14 * abs(energy)
        length = potential.largest_step(potential.start, potential.system.solution)
        for _ in range(MAX_HALVINGS):
            potential.move_trial(length)
            trial = potential.energy(potential.trial)
            if trial <= energy + ARMIJO * length * slope + noise:
                if length == 1.0 and energy - trial > STRAIGHT * -slope + noise:
                    trial = self._go_on(energy, slope, trial)
                return length, trial
            length *= 0.5
        wp.copy(potential.trial, potential.start)
        return 0.0, energy

    def _go_on(self, energy: float, slope: float, trial: float) -> float:
        """Lengthen a full step along which the energy fell almost as on a straight line; its energy there.

        Projected Hessians are stiffer than the energy where contact or compression takes stiffness away:
        their steps are too short, and Newton would close in on the minimum by a fixed factor only.
        """
        potential = self._potential
        curvature = trial - energy - slope
        longer = LONGEST if curvature <= 0.0 else min(-0.5 * slope / curvature, LONGEST)
        solution = potential.system.solution
        potential.combine(solution, longer, solution, 0.0, solution)
        share = potential.largest_step(potential.start, solution)
        if longer * share > 1.0:
            potential.move_trial(share)
            farther = potential.energy(potential.trial)
            if farther < trial:
                return farther
        potential.move_trial(1.0 / longer)
        return potential.energy(potential.trial)

    def collider_impulses(self) -> np.ndarray:
        """[C, 6] N s and N m s about the world's origin that bodies gave each of `Model.colliders`.

        In the last step, summed over its substeps; 0 before any, in a quasi-static step, which has no
        duration, and for those that are not guided (whose motion is no
        `gdpro_sim.simulation.conditions.Guide`). With BDF2 it is the change of 3/2 p_n - 1/2 p_(n-1), whose
        sum over steps is that of momentum.
        """
        return np.array([item.impulse for item in self._obstacles]).reshape(-1, 6)

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of body number `body`, [V, 3] float32 m, world.

        Rest surface plus interpolated displacement, so that it is exact at rest.
        """
        item = self.model.bodies[body]
        assert item.embedding is not None
        begin, end = item.tet_range
        ids = self.model.tets[begin:end][item.embedding.tet_ids]
        displacement = self._state.x.numpy() - self._rest
        moved = np.einsum("va,vai->vi", item.embedding.weights.astype(np.float64), displacement[ids])
        return (item.surface + moved).astype(np.float32)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes: float64 arrays, safe for `np.savez`."""
        c = self._counters
        counters = [c.substeps, c.newton_iterations, c.cg_iterations, c.converged, c.residual]
        return {
            "time": np.array(self._time, dtype=np.float64),
            "counters": np.array(counters, dtype=np.float64),
            **{name: array.numpy().copy() for name, array in self._changing.items()},
        }

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict` of the same model. Raises SolverError where it does not fit."""
        shapes = {name: array.shape for name, array in self._initial.items()}
        for name, shape in {"time": (), "counters": (5,), **shapes}.items():
            if name not in state:
                needed = ", ".join(["time", "counters", *shapes])
                raise SolverError(f"the saved FEM state has no {name!r}; it must hold {needed}")
            if state[name].shape != shape:
                raise SolverError(
                    f"the saved FEM state's {name!r} has shape {state[name].shape}, this model "
                    f"needs {shape}: it was saved from another scene"
                )
        self._assign({name: state[name] for name in shapes})
        self._time = float(state["time"])
        substeps, newton, cg, converged, residual = state["counters"].tolist()
        self._counters = _Counters(int(substeps), int(newton), int(cg), bool(converged), residual)
        self._stand()

    def _stand(self) -> None:
        """Put colliders where they are now, given nothing yet."""
        for item in self._obstacles:
            item.body.place(self._time, self._time)
            item.impulse = np.zeros(6)

    def diagnostics(self) -> Diagnostics:
        """Figures of the last step (of the initial state before any)."""
        potential = self._potential
        x, v = self.positions, self.velocities
        mass = potential.mass[:, None]
        momentum = (mass * v).sum(axis=0)
        angular = (mass * np.cross(x, v)).sum(axis=0)
        reports = [term.report(self._state.x) for term in self.terms]
        stored: dict[bool, list[float]] = {True: [], False: []}
        for term, report in zip(self.terms, reports, strict=True):
            stored["contacts" in report].append(term.stored(self._state.x))
        c = self._counters
        return Diagnostics(
            time=self._time,
            kinetic_energy=float(0.5 * (mass * v * v).sum()),
            elastic_energy=potential.elastic_energy(self._state.x),
            gravity_energy=float(-(mass * x).sum(axis=0) @ np.asarray(self.model.gravity, dtype=np.float64)),
            contact_energy=sum(stored[True]),
            momentum=(float(momentum[0]), float(momentum[1]), float(momentum[2])),
            angular_momentum=(float(angular[0]), float(angular[1]), float(angular[2])),
            contacts=int(sum(report.get("contacts", 0.0) for report in reports)),
            max_penetration=max((report.get("penetration", 0.0) for report in reports), default=0.0),
            min_volume_ratio=potential.smallest_volume_ratio(self._state.x),
            substeps=c.substeps,
            newton_iterations=c.newton_iterations,
            cg_iterations=c.cg_iterations,
            converged=c.converged,
            residual=c.residual,
            force_energy=sum(stored[False]),
        )

    def _assign(self, values: dict[str, np.ndarray]) -> None:
        for name, array in self._changing.items():
            array.assign(np.ascontiguousarray(values[name], dtype=np.float64))


__all__ = ["SolverFEM"]
