"""The material point method in time: explicit substeps as short as sound asks for, or implicit ones."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_energy, mpm_laws
from gdpro_sim.kernels import particles as rows
from gdpro_sim.simulation.model import Diagnostics, Model, Particles
from gdpro_sim.simulation.mpm.boundaries import SEEN, Obstacles, boundaries
from gdpro_sim.simulation.mpm.grid import Grid
from gdpro_sim.simulation.mpm.implicit import GridNewton
from gdpro_sim.simulation.mpm.matter import Matter


@dataclass
class _Counters:
    substeps: int = 0
    sorts: int = 0
    newton_iterations: int = 0
    cg_iterations: int = 0
    converged: bool = True
    residual: float = 0.0


HALVINGS = 5
"""Times that an implicit substep which fails is halved."""


class SolverMPM:
    """MLS-MPM for a compiled `Model`, explicit or implicit; implements `gdpro_sim.simulation.model.Solver`.

    Particles and grid are float32; positions and deformations keep what rounding cuts off, so that slow
    motion and small strains are not lost in short substeps. On the CPU results are the same bytes for any
    number of threads.

    Raises SolverError for a model without particles, or with particles without volume.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        particles = _checked(model)
        settings = model.mpm
        self.spacing = settings.grid_spacing or 2.0 * particles.spacing
        self.matter = Matter(particles.materials, model.device)
        kept = rows.ROWS if self.matter.flows else rows.TOTAL
        self._initial = _fields(particles, self.matter, kept)
        self.grid = Grid(
            self._initial,
            particles.matter,
            spacing=self.spacing,
            kernel=settings.kernel,
            max_cells=settings.max_cells,
            device=model.device,
        )
        self._rest = particles.positions
        self._looks: dict[int, Any] = {}
        self.boundaries = boundaries(model)
        self._obstacles = next((b for b in self.boundaries if isinstance(b, Obstacles)), None)
        self._affine = 0.0 if settings.transfer == "pic" else 1.0
        self._flip = settings.flip_ratio if settings.transfer == "flip" else 0.0
        self._newton = None
        self._viscous_step = self.matter.largest_step(self.spacing)
        if settings.integrator == "implicit":
            self._newton = GridNewton(self.grid, model, self.matter, self.boundaries)
        self._time = 0.0
        self._counters = _Counters()
        self._others = {
            f"boundaries.{k}.{name}": array
            for k, boundary in enumerate(self.boundaries)
            for name, array in boundary.state().items()
        }
        self._others_initial = {name: array.numpy().copy() for name, array in self._others.items()}
        self._saved = [wp.clone(array) for array in self._changing()]
        self.reset()

    @property
    def time(self) -> float:
        """Simulated time, s."""
        return self._time

    @property
    def positions(self) -> np.ndarray:
        """[N, 3] float64 m, in the model's order."""
        return self.grid.rows(rows.POSITION, 3).astype(np.float64) + self.grid.rows(rows.POSITION_LOW, 3)

    @property
    def velocities(self) -> np.ndarray:
        """[N, 3] float32 m/s, in the model's order."""
        return self.grid.rows(rows.VELOCITY, 3)

    @property
    def deformations(self) -> np.ndarray:
        """[N, 3, 3] float32 deformation gradients since the start, in the model's order."""
        row = rows.TOTAL if self.matter.flows else rows.DEFORMATION
        return self.grid.rows(row, 9).reshape(-1, 3, 3)

    def reset(self) -> None:
        """Back to the model's initial state."""
        grid, count = self.grid, len(self._initial[0])
        grid.put(self._initial)
        particles = self.model.particles
        assert particles is not None
        grid.matter.assign(particles.matter)
        grid.ids.assign(np.arange(count, dtype=np.int32))
        for name, array in self._others.items():
            array.assign(self._others_initial[name])
        self._time = 0.0
        self._counters = _Counters()
        grid.sort()
        self._update_stress(0.0)

    def step(self, dt: float) -> None:
        """Advance by `dt` seconds in substeps that follow the fastest particle.

        Raises SolverError, leaving the state as it was, where that takes more than `max_substeps`, or
        particles are lost.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise SolverError(f"step length must be a finite number > 0 s, got {dt}")
        before, time = self._counters, self._time
        self._copy(self._changing(), self._saved)
        try:
            self._advance(dt)
        except BaseException:  # Ctrl-C too: half a step is no state to continue from
            self._copy(self._saved, self._changing())
            self._counters, self._time = before, time
            self.grid.sort()
            raise

    def _changing(self) -> list[wp.array]:
        """Arrays that a step changes."""
        return [self.grid.particles, self.grid.matter, self.grid.ids, *self._others.values()]

    @staticmethod
    def _copy(source: list[wp.array], target: list[wp.array]) -> None:
        for a, b in zip(source, target, strict=True):
            wp.copy(b, a)

    def _advance(self, dt: float) -> None:
        begin, done, settings = self._time, 0.0, self.model.mpm
        self._counters = _Counters()
        for boundary in self.boundaries:
            boundary.plan(begin, dt)
        self.grid.sort()
        while done < dt:
            left = dt - done
            longest = self._largest_step() if self._newton is None else self._longest_implicit(dt)
            count = max(1, math.ceil(left / longest - 1e-9))
            if self._counters.substeps + count > settings.max_substeps:
                way = "soften the material, make cells larger, or use the implicit integrator"
                if self._driven() > self.grid.fastest():
                    way = "slow down what colliders and pins do, or make cells larger"
                elif self._newton is not None:
                    way = "make cells larger"
                raise SolverError(
                    f"{settings.integrator} substeps of {left / count:.3g} s would be needed "
                    f"{self._counters.substeps + count:,} times in the step of {dt:.3g} s from t = "
                    f"{begin:.6g} s on (at most "
                    f"{settings.max_substeps:,}): {way}"
                )
            h = left / count
            taken = self._substep(h)
            done = dt if count == 1 and taken == h else done + taken
            self._time = begin + done
            self._counters.substeps += 1

    def _largest_step(self) -> float:
        """Longest stable substep, s."""
        fastest = self.grid.fastest()
        if not math.isfinite(fastest):
            raise SolverError(
                f"particles are lost at t = {self._time:.6g} s: their speed is no number; use a smaller "
                "`cfl`, or check velocities and material constants"
            )
        own = self.model.mpm.cfl * self.spacing / max(fastest, 1e-30)
        return min(own, self._viscous_step, self._longest_unseen(fastest))

    def _longest_unseen(self, speed: float) -> float:
        """Longest substep in which what boundaries move comes upon no matter of that speed unseen, s."""
        driven = self._driven()
        if driven == 0.0:
            return math.inf
        return SEEN[self.model.mpm.integrator] * self.spacing / (driven + speed)

    def _driven(self) -> float:
        """Speed of the fastest thing that boundaries move, m/s."""
        return max((boundary.speed() for boundary in self.boundaries), default=0.0)

    def _longest_implicit(self, dt: float) -> float:
        """Longest implicit substep, s: in it nothing moves or falls by more than `cfl` cells."""
        velocities = self.grid.particles[rows.VELOCITY : rows.VELOCITY + 3].numpy()
        speed = math.sqrt(float((velocities**2).sum(axis=0).max()))
        if not math.isfinite(speed):
            raise SolverError(f"particles are lost at t = {self._time:.6g} s: their speed is no number")
        way, settings = self.model.mpm.cfl * self.spacing, self.model.mpm
        root = math.sqrt(speed**2 + 4.0 * way * math.hypot(*self.model.gravity))
        longest = 2.0 * way / max(speed + root, 1e-30)
        return min(longest, dt / settings.substeps, self._longest_unseen(speed))

    def _substep(self, h: float) -> float:
        """Advance by a substep of `h` seconds, or less where an implicit one fails; its length."""
        grid = self.grid
        if grid.has_strayed():
            grid.sort()
            self._counters.sorts += 1
        if self._flip > 0.0:
            grid.scatter(0.0, self._affine, (0.0, 0.0, 0.0))
            grid.keep()
        if self._newton is None:
            for boundary in self.boundaries:
                boundary.begin(self._time, h)
            grid.scatter(h, self._affine, [h * g for g in self.model.gravity])
            for boundary in self.boundaries:
                boundary.apply(grid, h)
        else:
            h = self._solve(self._newton, h)
        if self._flip > 0.0:
            grid.give_change()
        if self._obstacles is not None:
            self._obstacles.fill(grid)
        grid.gather(h, self._flip)
        for boundary in self.boundaries:
            boundary.drive(grid, h)
        self._update_stress(h)
        return h

    def _solve(self, newton: GridNewton, h: float) -> float:
        """Put the velocities at the end of an implicit substep into the grid; the substep's length."""
        counters = self._counters
        for halving in range(HALVINGS + 1):
            for boundary in self.boundaries:
                boundary.begin(self._time, h)
            outcome = newton.solve(h, [h * g for g in self.model.gravity], self._affine)
            counters.newton_iterations += outcome.newton_iterations
            counters.cg_iterations += outcome.cg_iterations
            if outcome.converged or outcome.lagging or halving == HALVINGS:
                break
            h *= 0.5
        if not outcome.finite:
            raise SolverError(
                f"no implicit substep of {h:.3g} s is possible at t = {self._time:.6g} s: raise the "
                "substeps, or check velocities and material constants"
            )
        newton.account(h)
        counters.converged &= outcome.converged
        counters.residual = max(counters.residual, outcome.residual)
        return h

    def _update_stress(self, h: float) -> None:
        """The materials' answer to the particles' deformation: stress, what has flowed, speed of sound."""
        grid = self.grid
        grid.launch(
            mpm_laws.update_stress,
            mpm_laws.groups(len(grid.ids), grid.device),
            [float(h), grid.matter, self.matter.table],
            [grid.particles],
            minimum=512,
        )

    def surface_positions(self, body: int) -> np.ndarray:
        """Deformed surface vertices of body number `body`, [V, 3] float32 m, world."""
        from gdpro_sim.simulation.mpm.fluid_look import FluidLook  # both compile kernels
        from gdpro_sim.simulation.mpm.look import Look, anisotropies

        item = self.model.bodies[body]
        begin, end = item.particle_range
        positions = self.positions[begin:end].astype(np.float32)
        look = self._looks.get(body)
        if look is None and item.spacing is not None:
            look = FluidLook(end - begin, item.spacing, device=self.model.device)
        elif look is None and item.patches is not None:
            most = anisotropies(item.gaussians, item.patches)
            look = Look(
                item.surface,
                self._rest[begin:end],
                patches=item.patches,
                anisotropy=most,
                device=self.model.device,
            )
        elif look is None:
            look = Look(item.surface, self._rest[begin:end], device=self.model.device)
        self._looks[body] = look
        if isinstance(look, FluidLook):
            return look.surface(positions)
        return look.surface(positions, self.deformations[begin:end])

    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything needed to continue to the same bytes, after whole steps."""
        grid = self.grid
        return {
            "time": np.array(self._time),
            "particles": grid.particles.numpy()[:, : len(grid.ids)].copy(),
            "matter": grid.matter.numpy().copy(),
            "ids": grid.ids.numpy().copy(),
            **{name: array.numpy().copy() for name, array in self._others.items()},
        }

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Continue from a `state_dict`. Raises SolverError for one of another model."""
        grid = self.grid
        expected = self.state_dict()
        for name, value in expected.items():
            if name not in state or state[name].shape != value.shape:
                raise SolverError(f"the state has no fitting {name!r}: it belongs to another model")
        grid.put(state["particles"])
        grid.matter.assign(state["matter"])
        grid.ids.assign(state["ids"])
        for name, array in self._others.items():
            array.assign(state[name])
        self._time = float(state["time"])
        grid.sort()

    def collider_impulses(self) -> np.ndarray:
        """[C, 6] N s and N m s about the world's origin that matter gave each of `Model.colliders`.

        In the last step, summed over its substeps; 0 before any, and for those that are not guided (whose
        motion is no `gdpro_sim.simulation.conditions.Guide`).
        """
        if self._obstacles is None:
            return np.zeros((len(self.model.colliders), 6))
        return self._obstacles.impulses()

    def diagnostics(self) -> Diagnostics:
        """Figures of the last step (of the initial state before any)."""
        grid = self.grid
        mass = grid.rows(rows.MASS, 1).astype(np.float64)
        x, v = self.positions, self.velocities.astype(np.float64)
        C = self._affine * grid.rows(rows.AFFINE, 9).reshape(-1, 3, 3).astype(np.float64)
        inertia = grid.inertia
        kinetic = 0.5 * float((mass[:, 0] * ((v**2).sum(1) + inertia * (C**2).sum((1, 2)))).sum())
        spin = np.stack([C[:, 2, 1] - C[:, 1, 2], C[:, 0, 2] - C[:, 2, 0], C[:, 1, 0] - C[:, 0, 1]], axis=1)
        momentum = (mass * v).sum(0)
        angular = (mass * (np.cross(x, v) + inertia * spin)).sum(0)
        gravity = np.asarray(self.model.gravity, np.float64)
        height = -float((mass * x).sum(0) @ gravity)
        if self._obstacles is not None:
            bodies = self._obstacles.bodies  # free rigid ones
            kinetic += bodies.kinetic_energy
            momentum, angular = momentum + bodies.momentum, angular + bodies.angular_momentum
            height -= float(bodies.mass @ bodies.positions @ gravity)
        volume = np.linalg.det(self.deformations.astype(np.float64))
        return Diagnostics(
            time=self._time,
            kinetic_energy=kinetic,
            elastic_energy=self._elastic_energy(),
            gravity_energy=height,
            contact_energy=0.0,
            momentum=(float(momentum[0]), float(momentum[1]), float(momentum[2])),
            angular_momentum=(float(angular[0]), float(angular[1]), float(angular[2])),
            contacts=0,
            max_penetration=0.0,
            min_volume_ratio=float(volume.min()),
            substeps=self._counters.substeps,
            newton_iterations=self._counters.newton_iterations,
            cg_iterations=self._counters.cg_iterations,
            converged=self._counters.converged,
            residual=self._counters.residual,
        )

    def _elastic_energy(self) -> float:
        grid = self.grid
        energy: wp.array = wp.zeros(len(grid.ids), dtype=wp.float64, device=grid.device)
        grid.launch(
            mpm_energy.elastic_energy,
            len(grid.ids),
            [grid.matter, self.matter.table, grid.particles],
            [energy],
        )
        return float(energy.numpy().sum())


def _checked(model: Model) -> Particles:
    particles = model.particles
    if particles is None or not len(particles):
        raise SolverError("the model has no particles")
    volumes = particles.volumes
    bad = np.flatnonzero(~(np.isfinite(volumes) & (volumes > 0.0)))
    if len(bad):
        raise SolverError(
            f"particle {bad[0]} has volume {volumes[bad[0]]:.3g} m^3 ({len(bad)} such particles); it must be "
            "> 0"
        )
    for name in ("positions", "velocities"):
        wrong = np.flatnonzero(~np.isfinite(getattr(particles, name)).all(axis=1))
        if len(wrong):
            raise SolverError(
                f"particle {wrong[0]} has {name} that are no numbers ({len(wrong)} such particles)"
            )
    return particles


def _fields(particles: Particles, matter: Matter, count: int) -> np.ndarray:
    """The particles at rest, [count, N]; see `gdpro_sim.kernels.particles`."""
    fields = np.zeros((count, len(particles)), np.float32)
    fields[rows.POSITION : rows.POSITION + 3] = particles.positions.T
    fields[rows.VELOCITY : rows.VELOCITY + 3] = particles.velocities.T
    if particles.gradients is not None:
        fields[rows.AFFINE : rows.AFFINE + 9] = particles.gradients.reshape(-1, 9).T
    for first in (rows.DEFORMATION, rows.TOTAL):
        if first < count:
            fields[[first, first + 4, first + 8]] = 1.0
    density = np.array([material.density for material in particles.materials], np.float64)
    fields[rows.VOLUME] = particles.volumes
    fields[rows.MASS] = density[particles.matter] * particles.volumes
    fields[rows.INTERNAL : rows.INTERNAL + 4] = matter.internal(particles.matter)
    return fields


__all__ = ["SolverMPM"]
