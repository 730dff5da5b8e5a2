"""Backward Euler on the MPM grid: projected Newton with conjugate gradients that assemble no matrix."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import linalg, mpm_implicit, mpm_newton, mpm_stiffness
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mpm.boundaries import Boundary, Obstacles
from gdpro_sim.simulation.mpm.grid import Grid
from gdpro_sim.simulation.mpm.matter import Matter, flows

RANGES = 128
"""Partial sums of energies and measures: fixed, so that totals do not depend on the number of threads."""

CUDA_CHECK_EVERY = 16
"""On CUDA the host looks at the residual only so often; steps past convergence change nothing."""

ARMIJO = 1e-4
MAX_HALVINGS = 20

ROUNDING = 2.0**-23
"""Of float32, relative."""

SETTLED = 4.0
"""Multiple of `newton_tolerance` that does where boundaries are about: friction settles slowly."""


FOLLOWED = 12
"""Iterations that follow the boundaries; the next ones keep what is in the way, and friction, as they are."""


class Outcome(NamedTuple):
    """residual: m/s, of the last Newton step, as if nodes had a full cell's mass
    lagging:  whether it has converged but for boundaries, which still changed by `residual`
    """

    converged: bool
    finite: bool
    residual: float
    newton_iterations: int
    cg_iterations: int
    lagging: bool = False


class GridNewton:
    """Finds the grid's velocities at the end of a substep; see `gdpro_sim.kernels.mpm_implicit`.

    tiled: whether particles meet the grid in tiles, as on a CPU, or one by one

    Memory grows with the grid and is kept. Raises SolverError for materials that flow or tear, and for
    colliders with a mass.
    """

    def __init__(
        self,
        grid: Grid,
        model: Model,
        matter: Matter,
        boundaries: tuple[Boundary, ...],
    ) -> None:
        check(model)
        assert model.particles is not None
        particles, settings = model.particles, model.mpm
        self.grid, self.boundaries, self.settings = grid, boundaries, settings
        self.table = matter.table
        self._guided = [b for b in boundaries if isinstance(b, Obstacles) and b.guided]
        self._iterations = 0
        volumes = particles.volumes.astype(np.float64)
        moduli = np.array([lam + 2.0 * mu for lam, mu in (m.lame for m in matter.materials)])
        densities = np.array([material.density for material in matter.materials])
        self._stiffness = float(volumes @ moduli[particles.matter])
        self._mass = float(volumes @ densities[particles.matter])
        self._full = float(densities[particles.matter].max()) * grid.spacing**3
        device, stride = grid.device, grid.particles.shape[1]
        self.tiled = device == "cpu"
        self._values: wp.array | None = None
        self.work = wp.zeros((int(mpm_implicit.WORK), stride), dtype=float, device=device)
        self._energies = wp.zeros(len(particles), dtype=wp.float64, device=device)
        self._sums, self._more_sums = (wp.zeros(RANGES, dtype=wp.float64, device=device) for _ in range(2))
        self._deficits = wp.zeros(RANGES, dtype=wp.vec3d, device=device)
        self._scalars = wp.zeros(8, dtype=wp.float64, device=device)
        self._tolerance = wp.full(1, settings.cg_tolerance, dtype=wp.float64, device=device)
        self._projectors = wp.zeros(0, dtype=wp.mat33, device=device)

    def _reserve(self) -> None:
        """Arrays over the nodes, after the grid has changed."""
        grid = self.grid
        if self._values is grid.values:
            return
        self._values = grid.values
        nodes = 64 * grid.count

        def vector(name: str) -> wp.array:
            return grid.array(f"implicit.{name}", nodes, wp.vec4)

        self._momentum, self._target, self._start = map(vector, ("momentum", "target", "start"))
        self._force, self._right, self._step = map(vector, ("force", "right", "step"))
        self._diagonal, self._off_diagonal = map(vector, ("diagonal", "off_diagonal"))
        self._residual, self._z, self._p, self._q = map(vector, ("residual", "z", "p", "q"))
        if self.boundaries:
            self._projectors = grid.array("implicit.projectors", nodes, wp.mat33)
            self._unbounded, self._bounded, self._held = map(vector, ("unbounded", "bounded", "held"))
        self._inverse = grid.array("implicit.inverse", nodes, wp.mat33)
        self._per = 64 if self.tiled else 1
        self._indices = nodes // self._per
        self._dots = grid.array("implicit.dots", self._indices, wp.float64)
        if self.tiled:
            self._more_tiles = grid.array("implicit.more_tiles", len(grid.tiles), wp.vec4)
        self._transfer = [grid.width, grid.spacing]

    def solve(self, h: float, change: Sequence[float], affine: float) -> Outcome:
        """Leave the velocities after `h` seconds in the grid's values.

        change: m/s, what gravity adds; affine: as in `Grid.scatter`
        """
        grid, settings = self.grid, self.settings
        grid.scatter(0.0, affine, change)
        self._reserve()
        wp.copy(self._momentum, grid.values)
        wp.copy(self._target, grid.values)
        speed = self._measure(self._momentum)[1]
        scale = max(speed, math.hypot(*change), 1e-6)
        energy = self._choose_start(h, change, scale)
        tolerance = settings.newton_tolerance * (SETTLED if self.boundaries else 1.0)
        self._iterations, residual, lag, done, settled = 0, math.inf, 0.0, 0, False
        while done < settings.newton_iterations and math.isfinite(energy):
            self.linearise(h)
            jump = 0.0
            if self.boundaries and done < FOLLOWED:
                jump = self._meet_boundaries(h, scale)
                if settled and jump <= tolerance:
                    return Outcome(True, True, max(residual, jump), done, self._iterations)
                energy = self.energy(h)
                if not math.isfinite(energy):
                    break
                if jump > 0.0:
                    self.linearise(h)
            self.set_right_hand_side()
            solved = self.solve_linear()
            slope, move = self._measure(self._step)
            done += 1
            residual = max(jump, move)
            lag = residual if done == FOLLOWED else lag
            if not math.isfinite(slope + move):
                energy = math.inf
                break
            length, energy = self._line_search(h, energy, slope, self._noise(h, energy, speed))
            # Rounding may keep the energy of a very short step from falling: it counts as taken.
            settled = solved and residual <= tolerance
            if settled and not self.boundaries:
                self._balance()
                return Outcome(True, True, residual, done, self._iterations)
            if settled and done > FOLLOWED:
                residual = max(lag, residual)
                return Outcome(residual <= tolerance, True, residual, done, self._iterations, lagging=True)
            if length == 0.0 and not settled:
                break
        return Outcome(False, math.isfinite(energy), residual, done, self._iterations)

    def account(self, h: float) -> None:
        """Let guided obstacles count what they took from the velocities that `solve` has left.

        That is what they take from velocities without boundaries. Where the solution is not quite what
        boundaries make of those, they take the difference too, so that no momentum is lost.
        """
        values, found = self.grid.values, self._start
        for obstacles in self._guided:
            wp.copy(found, values)
            self.energy(h)
            self.linearise(h)
            self._over_nodes(mpm_newton.unbounded, [self._momentum, self._force], [self._unbounded])
            wp.copy(values, self._unbounded)
            self._apply(h)
            self._over_nodes(mpm_newton.combine, [values, -1.0, found], [self._step])
            wp.copy(values, self._unbounded)
            obstacles.meet(self.grid, h, self._step)
            wp.copy(values, found)

    def _balance(self) -> None:
        """Give all nodes the velocity that conjugate gradients, which stop early, have left out."""
        self.grid.launch(
            mpm_newton.deficit,
            RANGES,
            [64 * self.grid.count, RANGES, self._momentum, self.grid.values],
            [self._deficits],
            minimum=8,
        )
        left = self._deficits.numpy().sum(axis=0) / self._mass
        self._over_nodes(mpm_newton.shift, [wp.vec3(*left)], [self.grid.values])

    def _noise(self, h: float, energy: float, speed: float) -> float:
        """J that rounding of the velocities may make of an energy."""
        strain = 4.0 * h / self.grid.spacing * ROUNDING * speed
        elastic = strain * math.sqrt(self._stiffness)
        inertial = ROUNDING * speed * math.sqrt(self._mass)
        return elastic**2 + 2.0 * math.sqrt(abs(energy)) * (elastic + inertial)

    def _choose_start(self, h: float, change: Sequence[float], scale: float) -> float:
        """Put the guess of lowest energy into the grid: coasting, falling, or all as one; its energy."""
        if self.boundaries:
            # What is in the way of a body at rest shows in the forces that hold it up.
            self._projectors.fill_(wp.mat33(*np.eye(3).ravel()))
            self._held.zero_()
            if math.isfinite(self._guess(h, wp.vec3(*(-x for x in change)), 1.0)):
                self.linearise(h)
                self._meet_boundaries(h, scale)
        guesses = [(wp.vec3(*(-x for x in change)), 1.0)]
        if any(change):
            guesses.append((wp.vec3(), 1.0))
        energies = [self._guess(h, *guess) for guess in guesses]
        best = int(np.argmin(energies))
        if not math.isfinite(energies[best]):
            values = self._momentum.numpy().astype(np.float64)
            mean = (values[:, 3:] * values[:, :3]).sum(0) / values[:, 3].sum()
            return self._guess(h, wp.vec3(*mean), 0.0)
        if best < len(guesses) - 1:
            return self._guess(h, *guesses[best])
        return energies[best]

    def _guess(self, h: float, v: wp.vec3, weight: float) -> float:
        self._over_nodes(mpm_newton.fill, [v, weight, self._momentum], [self.grid.values])
        if self.boundaries:
            self._hold()
        energy = self.energy(h)
        return energy if math.isfinite(energy) else math.inf

    # ---- the function and its derivatives at the grid's values ----

    def energy(self, h: float) -> float:
        """E in J; infinite where a particle is turned inside out. Leaves velocity gradients in `work`."""
        grid = self.grid
        if self.tiled:
            self._over_blocks(
                mpm_stiffness.gradient_blocks,
                [grid.starts, grid.coords, grid.neighbors, grid.values, grid.particles],
                [self.work],
            )
        else:
            self._over_particles(mpm_stiffness.gradient_particles, [grid.values, grid.particles], [self.work])
        grid.launch(
            mpm_implicit.trial_energy,
            len(grid.ids),
            [float(h), grid.matter, self.table, grid.particles, self.work],
            [self._energies],
        )
        self._reduce(mpm_newton.inertia_energy, [grid.values, self._target], [self._dots])
        return self._total(self._energies) + self._total(self._dots)

    def linearise(self, h: float, *, exact: bool = False) -> None:
        """Forces and stiffness at the velocity gradients that `energy` has left; projected unless `exact`."""
        grid = self.grid
        grid.launch(
            mpm_implicit.linearise,
            len(grid.ids),
            [float(h), int(exact), grid.matter, self.table, grid.particles],
            [self.work],
            minimum=256,
        )
        if self.tiled:
            common = [grid.starts, grid.coords, grid.particles, self.work]
            self._over_blocks(mpm_stiffness.moment_blocks, common, [grid.tiles])
            self._add_tiles(grid.tiles, self._force)
            self._over_blocks(mpm_stiffness.diagonal_blocks, common, [grid.tiles, self._more_tiles])
            self._add_tiles(grid.tiles, self._diagonal)
            self._add_tiles(self._more_tiles, self._off_diagonal)
            return
        for array in (self._force, self._diagonal, self._off_diagonal):
            array.zero_()
        common = [grid.particles, self.work]
        self._over_particles(mpm_stiffness.moment_particles, common, [self._force])
        self._over_particles(mpm_stiffness.diagonal_particles, common, [self._diagonal, self._off_diagonal])

    def set_right_hand_side(self) -> None:
        """Minus the gradient, and the preconditioner, from what `linearise` has left."""
        self._over_nodes(
            mpm_newton.residual,
            [self.grid.values, self._target, self._force, self._projectors],
            [self._right],
        )
        self._over_nodes(
            mpm_newton.invert_blocks,
            [self._target, self._diagonal, self._off_diagonal, self._projectors],
            [self._inverse],
        )

    def multiply(self, p: wp.array, q: wp.array) -> None:
        """q = Hessian of E times p, in free directions."""
        grid = self.grid
        if self.tiled:
            self._over_blocks(
                mpm_stiffness.product_blocks,
                [grid.starts, grid.coords, grid.neighbors, p, grid.particles, self.work],
                [grid.tiles],
            )
            grid.launch(
                mpm_newton.cg_product_of_tiles,
                grid.count,
                [grid.width, grid.sources, grid.tiles, self._target, self._projectors, p],
                [q, self._dots],
                minimum=64,
            )
            return
        q.zero_()
        self._over_particles(mpm_stiffness.product_particles, [p, grid.particles, self.work], [q])
        self._over_nodes(mpm_newton.cg_product, [self._target, self._projectors, p], [q, self._dots])

    def solve_linear(self) -> bool:
        """`_step` = Hessian^-1 `_right`; whether it has converged.

        Preconditioned conjugate gradients, Saad 2003, "Iterative Methods for Sparse Linear Systems",
        algorithm 9.1.
        """
        self._reduce(
            mpm_newton.cg_reset,
            [self._right, self._inverse],
            [self._step, self._residual, self._z, self._p, self._dots],
        )
        self._scalar(linalg.cg_begin)
        check_every = 1 if self.tiled else CUDA_CHECK_EVERY
        for iteration in range(self.settings.cg_iterations):
            if iteration % check_every == 0 and self._scalars.numpy()[linalg.CG_DONE] != 0.0:
                break
            self._over_nodes(mpm_newton.cg_direction, [self._z, self._scalars], [self._p])
            self.multiply(self._p, self._q)
            self._scalar(linalg.cg_set_alpha)
            self._reduce(
                mpm_newton.cg_update,
                [self._p, self._q, self._inverse, self._scalars],
                [self._step, self._residual, self._z, self._dots],
            )
            self._scalar(linalg.cg_set_beta)
        scalars = self._scalars.numpy()
        self._iterations += int(scalars[linalg.CG_ITERATIONS])
        return bool(scalars[linalg.CG_DONE] > 0.0)

    def _line_search(self, h: float, energy: float, slope: float, noise: float) -> tuple[float, float]:
        """Halve the step until the energy falls enough: (length, energy there); (0, energy) if it never does.

        Particles turned inside out have infinite energy, so no accepted step inverts one.
        """
        values = self.grid.values
        wp.copy(self._start, values)
        length = 1.0
        for _ in range(MAX_HALVINGS):
            self._over_nodes(mpm_newton.combine, [self._start, length, self._step], [values])
            trial = self.energy(h)
            if trial <= energy + ARMIJO * length * slope + noise:
                return length, trial
            length *= 0.5
        wp.copy(values, self._start)
        return 0.0, energy

    # ---- boundaries ----

    def _meet_boundaries(self, h: float, scale: float) -> float:
        """Free directions, targets, and held velocities, from forces as they are.

        Returns by how much that moved a node, m/s.
        """
        grid, u = self.grid, self._unbounded
        self._over_nodes(mpm_newton.unbounded, [self._momentum, self._force], [u])
        values = self._start
        wp.copy(values, grid.values)
        wp.copy(grid.values, u)
        self._apply(h)
        wp.copy(self._bounded, grid.values)
        self._over_nodes(mpm_newton.combine, [u, -1.0, self._bounded], [self._step])
        if self._measure(self._step)[1] == 0.0:
            # Nothing is in the way.
            self._projectors.fill_(wp.mat33(*np.eye(3).ravel()))
            wp.copy(self._target, self._momentum)
            wp.copy(grid.values, values)
            return 0.0
        for k in range(3):
            self._over_nodes(mpm_newton.probe, [k, scale, u, self._bounded], [grid.values])
            self._apply(h)
            inputs = [k, scale, u, self._bounded, grid.values]
            self._over_nodes(mpm_newton.differentiate, inputs, [self._projectors])
        self._over_nodes(
            mpm_newton.constrain,
            [u, self._bounded, self._momentum],
            [self._projectors, self._held, self._target],
        )
        wp.copy(grid.values, values)
        return self._hold()

    def _hold(self) -> float:
        """Give nodes the velocities that they are held at; by how much that changed one, m/s."""
        grid = self.grid
        grid.launch(
            mpm_newton.hold,
            RANGES,
            [64 * grid.count, RANGES, self._full, self._projectors, self._held, self._target],
            [grid.values, self._more_sums],
            minimum=8,
        )
        return math.sqrt(float(self._more_sums.numpy().max()))

    def _apply(self, h: float) -> None:
        for boundary in self.boundaries:
            boundary.apply(self.grid, h)

    # ---- launches ----

    def _over_blocks(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        grid = self.grid
        grid.launch(kernel, grid.occupied, [*self._transfer, *inputs], outputs, minimum=4)

    def _over_particles(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        grid = self.grid
        common = [*self._transfer, grid.owners, grid.coords, grid.neighbors]
        grid.launch(kernel, len(grid.ids), [*common, *inputs], outputs)

    def _over_nodes(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        self.grid.launch(kernel, 64 * self.grid.count, inputs, outputs, minimum=4096)

    def _reduce(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        """A kernel with partial sums."""
        minimum = 64 if self.tiled else 4096
        self.grid.launch(kernel, self._indices, [self._per, *inputs], outputs, minimum=minimum)

    def _add_tiles(self, tiles: wp.array, out: wp.array) -> None:
        grid = self.grid
        grid.launch(mpm_newton.add_tiles, grid.count, [grid.width, grid.sources, tiles], [out], minimum=64)

    def _scalar(self, kernel: wp.Kernel) -> None:
        """One of the scalar steps of conjugate gradients, over the partial sums of the phase before it."""
        launch, dots, count = self.grid.launch, self._dots, self._indices
        if not self.tiled:
            launch(linalg.sum_ranges, RANGES, [count, RANGES, dots], [self._sums])
            dots, count = self._sums, RANGES
        launch(kernel, 1, [count, dots, self._tolerance], [self._scalars])

    def _total(self, terms: wp.array) -> float:
        self.grid.launch(linalg.sum_ranges, RANGES, [len(terms), RANGES, terms], [self._sums], minimum=64)
        return float(self._sums.numpy().sum())

    def _measure(self, step: wp.array) -> tuple[float, float]:
        """Slope of E along a step, J, and the largest velocity in it, m/s."""
        self.grid.launch(
            mpm_newton.step_measures,
            RANGES,
            [64 * self.grid.count, RANGES, self._full, step, self._right, self._target],
            [self._sums, self._more_sums],
            minimum=8,
        )
        return float(self._sums.numpy().sum()), math.sqrt(float(self._more_sums.numpy().max()))


def check(model: Model) -> None:
    """Raise SolverError for what the implicit integrator cannot simulate."""
    assert model.particles is not None
    for material in model.particles.materials:
        if flows(material):
            raise SolverError(
                f'the implicit integrator is for elastic materials, and one with the law "{material.model}" '
                'flows, yields or tears here: use integrator "explicit"'
            )
    for collider in model.colliders:
        if collider.mass is not None:
            raise SolverError(
                f"the implicit integrator does not move rigid bodies, and collider {collider.name!r} has a "
                'mass: use integrator "explicit", or set its mass to null'
            )


__all__ = ["GridNewton", "Outcome", "check"]
