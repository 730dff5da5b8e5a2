"""Implicit finite elements: backward Euler by projected Newton on the incremental potential."""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.fem.potential import IncrementalPotential
from gdpro_sim.simulation.fem.rigid_modes import RigidModes
from gdpro_sim.simulation.model import Diagnostics, Model

logger = logging.getLogger(__name__)

ARMIJO = 1e-4
"""Share of the predicted decrease a step must keep (Nocedal & Wright, 2nd ed., eq. 3.4)."""

MAX_HALVINGS = 30
"""Line search halvings before a Newton iteration is given up."""

MAX_SPLITS = 4
"""A substep that fails is halved at most this many times."""

NEGLIGIBLE = 0.01
"""A residual that inertia alone would undo within this share of the tolerance counts as solved."""


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

    Stable neo-Hookean elasticity, lumped mass, Rayleigh damping, pinned vertices, and a ground with lagged
    Coulomb friction. Positions and all solver arithmetic are float64. On the CPU results are the same bytes
    for any number of threads.

    Raises SolverError when an element has no volume at rest.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self._potential = IncrementalPotential(model)
        self._rigid = RigidModes(model.tets, self._potential.mass, self._potential.fixed)
        self._rest = model.vertices.astype(np.float64)
        count = len(model.vertices)
        self._saved = [
            wp.zeros(count, dtype=kind, device=model.device) for kind in (wp.vec3d, wp.vec3d, wp.vec2d)
        ]
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
        return self._potential.x.numpy().copy()

    @property
    def velocities(self) -> np.ndarray:
        """[P, 3] float64 m/s, a copy."""
        return self._potential.v.numpy().copy()

    def reset(self) -> None:
        """Back to the model's initial state."""
        velocities = self.model.velocities.astype(np.float64)
        velocities[self._potential.fixed] = 0.0
        self._set_state(self._rest, velocities, self._rest[:, :2])
        self._time = 0.0
        self._counters = _Counters()

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds in `FemSettings.substeps` implicit steps, halving those that fail.

        Raises SolverError, leaving the state as it was, if a substep has no finite solution. A substep that
        stays unconverged at its shortest is accepted (it never raises the energy) and reported by
        `diagnostics().converged`.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise SolverError(f"step length must be a finite number > 0 s, got {dt}")
        state = self._state_arrays()
        for saved, array in zip(self._saved, state, strict=True):
            wp.copy(saved, array)
        before = self._counters
        self._counters = _Counters()
        count = self.model.fem.substeps
        try:
            for _ in range(count):
                self._advance(dt / count, 0)
        except BaseException:  # Ctrl-C too: half a step is no state to continue from
            for saved, array in zip(self._saved, state, strict=True):
                wp.copy(array, saved)
            self._counters = before
            raise
        self._time += dt
        if not self._counters.converged:
            logger.warning(
                "FEM step to t = %.6g s did not converge: Newton still moves %.3g m/s (tolerance %.3g)",
                self._time,
                self._counters.residual,
                self.model.fem.newton_tolerance,
            )

    def _advance(self, dt: float, splits: int) -> None:
        outcome = self._minimise(dt)
        if not outcome.converged and splits < MAX_SPLITS:
            logger.debug("substep of %.3g s failed (%s): halved", dt, outcome)
            self._advance(dt / 2.0, splits + 1)
            self._advance(dt / 2.0, splits + 1)
            return
        if not outcome.finite:
            raise SolverError(
                f"no finite solution for a substep of {dt:.3g} s at t = {self._time:.6g} s: raise the "
                "substeps, or check velocities and material constants"
            )
        self._potential.accept()
        counters = self._counters
        counters.substeps += 1
        counters.converged &= outcome.converged
        counters.residual = max(counters.residual, outcome.residual)

    def _minimise(self, dt: float) -> _Outcome:
        """Projected Newton on the incremental potential; leaves the result in the potential's trial."""
        potential, settings = self._potential, self.model.fem
        tolerance = settings.newton_tolerance * dt
        potential.begin(dt)
        energy = self._choose_start()
        residual = math.inf
        for iteration in range(settings.newton_iterations):
            wp.copy(potential.base, potential.trial)
            # Lagged friction: limits follow the iterate, then stay, so that the late iterations descend on
            # one fixed energy.
            if iteration <= settings.newton_iterations // 2:
                potential.update_friction(potential.base)
                energy = potential.energy(potential.base, elements_unchanged=True)
            potential.linearise(potential.base)
            acceleration = potential.largest_acceleration()
            if not (math.isfinite(energy) and math.isfinite(acceleration)):
                return _Outcome(converged=False, finite=False, residual=residual)
            if acceleration * dt * dt <= NEGLIGIBLE * tolerance:
                return _Outcome(converged=True, finite=True, residual=acceleration * dt)

            report = potential.system.solve(settings.cg_tolerance, settings.cg_iterations)
            slope, largest_move = potential.step_measures()
            negligible = NEGLIGIBLE * max(tolerance, 0.1 * largest_move) / (dt * dt)
            if self._rigid.correct(potential.system, potential.base.numpy(), negligible):
                slope, largest_move = potential.step_measures()
            self._counters.newton_iterations += 1
            self._counters.cg_iterations += report.iterations
            residual = largest_move / dt
            if not (math.isfinite(slope) and math.isfinite(largest_move)):
                return _Outcome(converged=False, finite=False, residual=residual)

            length, energy = self._line_search(energy, slope)
            if length == 0.0:
                return _Outcome(converged=False, finite=True, residual=residual)
            if report.converged and length == 1.0 and largest_move <= tolerance:
                return _Outcome(converged=True, finite=True, residual=residual)
        return _Outcome(converged=False, finite=True, residual=residual)

    def _choose_start(self) -> float:
        """Put the lowest of three guesses into the trial: resting, coasting, falling. Returns its energy."""
        potential = self._potential
        potential.update_friction(potential.x)
        guesses = (potential.x, potential.coasting, potential.inertia)
        energies = [potential.energy(guess) for guess in guesses]
        best = min(range(len(guesses)), key=energies.__getitem__)
        wp.copy(potential.trial, guesses[best])
        if best == len(guesses) - 1:
            return energies[best]
        return potential.energy(potential.trial)

    def _line_search(self, energy: float, slope: float) -> tuple[float, float]:
        """Halve the step until the energy falls enough: (length, energy there); (0, energy) if it never does.

        An inverted element has infinite energy, so no accepted step inverts one.
        """
        potential = self._potential
        noise = potential.energy_noise + 1e-14 * abs(energy)
        length = 1.0
        for _ in range(MAX_HALVINGS):
            potential.move_trial(length)
            trial = potential.energy(potential.trial)
            if trial <= energy + ARMIJO * length * slope + noise:
                return length, trial
            length *= 0.5
        wp.copy(potential.trial, potential.base)
        return 0.0, energy

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of body number `body`, [V, 3] float32 m, world.

        Rest surface plus interpolated displacement, so that it is exact at rest.
        """
        item = self.model.bodies[body]
        begin, end = item.tet_range
        ids = self.model.tets[begin:end][item.embedding.tet_ids]
        displacement = self._potential.x.numpy() - self._rest
        moved = np.einsum("va,vai->vi", item.embedding.weights.astype(np.float64), displacement[ids])
        return (item.surface + moved).astype(np.float32)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes: float64 arrays, safe for `np.savez`."""
        c = self._counters
        positions, velocities, anchors = (array.numpy().copy() for array in self._state_arrays())
        counters = [c.substeps, c.newton_iterations, c.cg_iterations, c.converged, c.residual]
        return {
            "time": np.array(self._time, dtype=np.float64),
            "positions": positions,
            "velocities": velocities,
            "anchors": anchors,
            "counters": np.array(counters, dtype=np.float64),
        }

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict` of the same model. Raises SolverError where it does not fit."""
        count = len(self._rest)
        shapes: dict[str, tuple[int, ...]] = {
            "time": (),
            "positions": (count, 3),
            "velocities": (count, 3),
            "anchors": (count, 2),
            "counters": (5,),
        }
        for name, shape in shapes.items():
            if name not in state:
                raise SolverError(f"the saved FEM state has no {name!r}; it must hold {', '.join(shapes)}")
            if state[name].shape != shape:
                raise SolverError(
                    f"the saved FEM state's {name!r} has shape {state[name].shape}, this model "
                    f"needs {shape}: it was saved from another scene"
                )
        self._set_state(state["positions"], state["velocities"], state["anchors"])
        self._time = float(state["time"])
        substeps, newton, cg, converged, residual = state["counters"].tolist()
        self._counters = _Counters(int(substeps), int(newton), int(cg), bool(converged), residual)

    def diagnostics(self) -> Diagnostics:
        """Figures of the last step (of the initial state before any)."""
        potential = self._potential
        x, v = self.positions, self.velocities
        mass = potential.mass[:, None]
        momentum = (mass * v).sum(axis=0)
        angular = (mass * np.cross(x, v)).sum(axis=0)
        ground = self.model.ground
        offset = self.model.contact_offset
        depth = ground.height - offset - x[:, 2] if ground is not None else np.zeros(len(x))
        c = self._counters
        return Diagnostics(
            time=self._time,
            kinetic_energy=float(0.5 * (mass * v * v).sum()),
            elastic_energy=potential.elastic_energy(),
            gravity_energy=float(-(mass * x).sum(axis=0) @ np.asarray(self.model.gravity, dtype=np.float64)),
            contact_energy=potential.contact_energy(),
            momentum=(float(momentum[0]), float(momentum[1]), float(momentum[2])),
            angular_momentum=(float(angular[0]), float(angular[1]), float(angular[2])),
            contacts=int(np.count_nonzero(depth > 0.0)),
            max_penetration=float(max(0.0, depth.max(initial=0.0))),
            min_volume_ratio=potential.smallest_volume_ratio(),
            substeps=c.substeps,
            newton_iterations=c.newton_iterations,
            cg_iterations=c.cg_iterations,
            converged=c.converged,
            residual=c.residual,
        )

    def _state_arrays(self) -> tuple[wp.array, wp.array, wp.array]:
        return self._potential.x, self._potential.v, self._potential.anchor

    def _set_state(self, positions: np.ndarray, velocities: np.ndarray, anchors: np.ndarray) -> None:
        for array, values in zip(self._state_arrays(), (positions, velocities, anchors), strict=True):
            array.assign(np.ascontiguousarray(values, dtype=np.float64))


__all__ = ["SolverFEM"]
