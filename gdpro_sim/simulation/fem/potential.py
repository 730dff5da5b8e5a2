"""The incremental potential of one implicit step: its energy, gradient and projected Hessian on a device."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from gdpro_sim.device import Launches
from gdpro_sim.kernels import element_lanes, elements, fem, linalg
from gdpro_sim.kernels.elasticity import COROTATED, STVK_HENCKY
from gdpro_sim.simulation.fem.conjugate_gradient import ConjugateGradient
from gdpro_sim.simulation.fem.nodal_pressure import NodalPressure, kept_lambda
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.term import Step, Term
from gdpro_sim.simulation.fem.topology import BLOCKS_PER_ELEMENT, build_topology
from gdpro_sim.simulation.model import Model

RANGES = 128
"""Partial sums of energies and measures: fixed, so that totals do not depend on the number of threads."""

NOTHING = wp.vec3d()


class StepMeasures(NamedTuple):
    slope: float
    largest_move: float


class IncrementalPotential:
    """E(x) of `gdpro_sim.kernels.fem` for one model; allocates everything once.

    trial, start:  [P] the iterate, and where a line search starts
    inertia, base: [P] set by the integrator: where inertia and gravity alone lead; velocities are
                   (x - base) / h
    terms:         contact, forces, in a fixed order
    """

    def __init__(self, model: Model, rest: RestShapes, terms: tuple[Term, ...]) -> None:
        self.device = model.device
        self.vertex_count = len(model.vertices)
        self.element_count = len(model.tets)
        device, p, t = self.device, self.vertex_count, self.element_count
        self._launch = Launches(device)
        self.terms = terms
        self.mass = rest.mass
        self._pinned, self._massless = model.pinned, rest.mass <= 0.0
        self._release = model.release
        self.fixed = self._pinned | self._massless
        self.energy_noise = 2.0e-16 * float(np.sum(rest.volume * (rest.lam + 2.0 * rest.mu)))

        topology = build_topology(model.tets, p)
        self.system = ConjugateGradient(topology, device)

        self.elements = elements.Elements()
        self.elements.tets = wp.array(model.tets, dtype=wp.vec4i, device=device)
        self.elements.inverse_rest = wp.array(rest.inverse, dtype=wp.mat33d, device=device)
        self.elements.volume = reals(rest.volume, device)
        self.elements.law = wp.array(rest.law, dtype=wp.int32, device=device)
        self.elements.yield_stress = reals(rest.yield_stress, device)
        self.elements.hardening = reals(rest.hardening, device)
        self.elements.plastic_strain = wp.zeros(t, dtype=wp.float64, device=device)
        self.elements.pressure = wp.zeros(t, dtype=wp.float64, device=device)
        self.elements.mu = reals(rest.mu, device)
        kept = kept_lambda(model, rest)
        self.elements.lam = reals(kept, device)
        self.elements.damping = reals(model.rayleigh_stiffness, device)

        self.vertices = fem.Vertices()
        self.vertices.mass = reals(rest.mass, device)
        self.vertices.damping = reals(rest.mass_damping, device)
        self.vertices.fixed = wp.array(self.fixed.astype(np.int32), dtype=wp.int32, device=device)
        self.vertices.offsets = wp.array(topology.corner_offsets, dtype=wp.int32, device=device)
        self.vertices.corners = wp.array(topology.corners, dtype=wp.int32, device=device)

        self.trial, self.start, self.inertia, self.base, self.gradient, self._difference = (
            wp.zeros(p, dtype=wp.vec3d, device=device) for _ in range(6)
        )
        self._block = wp.zeros(p, dtype=wp.mat33d, device=device)
        self._no_blocks = wp.zeros(0, dtype=wp.mat33d, device=device)
        self._cauchy_green = wp.zeros(t, dtype=wp.mat33d, device=device)
        self.element_gradient = wp.zeros(4 * t, dtype=wp.vec3d, device=device)
        self._element_blocks = wp.zeros(BLOCKS_PER_ELEMENT * t, dtype=wp.mat33d, device=device)
        self._lanes = element_lanes.LANES if device == "cpu" else 1
        self._groups = -(-t // self._lanes)
        self._work = wp.zeros(
            self._groups * self._lanes * int(element_lanes.WORK), dtype=wp.float64, device=device
        )
        self._averaged = None
        if np.any(kept < rest.lam):
            self._averaged = NodalPressure(
                model, rest, topology, self.elements, self.system.offsets, self.system.columns
            )
            self.system.average(self._averaged.forward, self._averaged.transposed, self._averaged.curvature)
        count = t + p + sum(term.energies for term in terms) + (p if self._averaged else 0)
        self._energies = wp.zeros(count, dtype=wp.float64, device=device)
        self._sums, self._maxima = (wp.zeros(RANGES, dtype=wp.float64, device=device) for _ in range(2))
        # On the CPU these are the arrays' own memory.
        self._views = [array.numpy() for array in (self._sums, self._maxima)] if device == "cpu" else None
        self._diagonal: wp.array = wp.array(topology.diagonal, dtype=wp.int32, device=device)
        self._pairs: list[wp.array] = [
            wp.array(part, dtype=wp.int32, device=device)
            for part in (topology.pair_offsets, topology.pair_blocks)
        ]
        self._mirrored: list[wp.array] = [
            wp.array(part, dtype=wp.int32, device=device) for part in (topology.upper, topology.lower)
        ]
        self._pair_count = len(topology.upper)
        self._damped = bool(np.any(model.rayleigh_stiffness > 0.0))
        self._stretches = bool(np.isin(rest.law, [int(COROTATED), int(STVK_HENCKY)]).any())
        self._yields = bool(np.any(np.isfinite(rest.yield_stress)))
        self._inverse_h = 0.0

    def begin(self, step: Step) -> None:
        """Start a solve; then the integrator sets `inertia`, `base` and `strain_base`, and terms `step.held`.

        Fixed vertices of `inertia` are to be put where they are held after that.
        """
        self._inverse_h = 1.0 / step.h
        fixed = self._fixed_until(step.end)
        if not np.array_equal(fixed, self.fixed):
            self.fixed = fixed
            self.vertices.fixed.assign(fixed.astype(np.int32))
        for term in self.terms:
            term.begin(step)

    def lets_go(self, start: float, end: float) -> bool:
        """Whether a step from `start` to `end` s is the first after a pin's release."""
        return not np.array_equal(self._fixed_until(start), self._fixed_until(end))

    def _fixed_until(self, time: float) -> np.ndarray:
        """[P] bool: vertices without mass, and pins that are not let go before `time` s."""
        if self._release is None:
            return self.fixed
        return (self._pinned & (time <= self._release + 1e-9)) | self._massless

    def strain_base(self, a: wp.array, weight_a: float, b: wp.array, weight_b: float) -> None:
        """Measure strain rates from weight_a C(a) + weight_b C(b), C = F^T F."""
        if self._damped:
            inputs = [self.elements, a, weight_a, b, weight_b]
            self.over_elements(elements.element_cauchy_green, inputs, [self._cauchy_green])

    def lag(self, x: wp.array) -> None:
        """Take from x what the terms hold fixed for a while."""
        for term in self.terms:
            term.lag(x)

    def energy(self, x: wp.array, *, elements_unchanged: bool = False) -> float:
        """E(x) in J; infinite if an element is inverted.

        `elements_unchanged` reuses the element terms of the last call (when only lagged values changed).
        """
        if not elements_unchanged:
            self._evaluate_elements(x, self._inverse_h)
            if self._averaged is not None:
                self._averaged.energy(x, self._energies, len(self._energies) - self.vertex_count)
        first = self.element_count
        inputs = [first, self.vertices, x, self.base, self.inertia, self._inverse_h]
        self.over_vertices(fem.vertex_energy, inputs, [self._energies])
        first += self.vertex_count
        for term in self.terms:
            term.energy(x, self._energies, first)
            first += term.energies
        return self._total(self._energies)

    def _evaluate_elements(self, x: wp.array, inverse_h: float) -> None:
        """Energies of the elements at x, the first of `_energies`; inverse_h = 0 leaves damping out."""
        inputs = [self.elements, x, self._cauchy_green, inverse_h]
        if self._stretches:
            self._launch(
                elements.element_energy_by_stretches,
                self._groups,
                [self._lanes, self.element_count, *inputs],
                [self._work, self._energies],
                minimum=64,
            )
        else:
            self._launch(elements.element_energy, self.element_count, inputs, [self._energies], minimum=4096)

    def linearise(self, x: wp.array, *, exact: bool = False) -> None:
        """Fill the linear system H d = -gradient at x; elements' parts are projected unless `exact`."""
        system = self.system
        self._press(x)
        self.differentiate_elements(x, exact=exact)
        self._launch(
            linalg.gather_off_diagonal,
            self._pair_count,
            [*self._pairs, self._element_blocks, *self._mirrored],
            [system.values],
        )
        system.couple(self._add_terms(x))
        if self._averaged is not None:
            self._averaged.linearise()
        self.over_vertices(
            fem.assemble_vertices,
            [
                self.vertices,
                x,
                self.base,
                self.inertia,
                self._inverse_h,
                self.element_gradient,
                self._element_blocks,
                self.gradient,
                self._block,
                self._diagonal,
                self._no_blocks if self._averaged is None else self._averaged.blocks,
            ],
            [system.right_hand_side, system.values, system.inverse_diagonal],
        )

    def differentiate_elements(self, x: wp.array, *, exact: bool = False) -> None:
        """Gradients and Hessian blocks of the elements at x, projected unless `exact`."""
        self._launch(
            elements.element_derivatives,
            self._groups,
            [
                self._lanes,
                self.element_count,
                self.elements,
                x,
                self._cauchy_green,
                self._inverse_h,
                int(exact),
            ],
            [self._work, self.element_gradient, self._element_blocks],
            minimum=64,
        )

    def _press(self, x: wp.array) -> None:
        if self._averaged is not None:
            self._averaged.press(x)

    def forces(self, x: wp.array) -> None:
        """Gradients of elements and terms at x, without inertia, into element_gradient and gradient."""
        self._press(x)
        inputs = [self.elements, x, self._cauchy_green, self._inverse_h]
        self.over_elements(elements.element_gradient, inputs, [self.element_gradient])
        self._add_terms(x)

    def _add_terms(self, x: wp.array) -> Any:
        self.gradient.zero_()
        self._block.zero_()
        couplings = None
        for term in self.terms:
            found = term.add_derivatives(x, self.gradient, self._block)
            if found is not None:
                couplings = found if couplings is None else couplings + found
        return couplings

    def largest_acceleration(self) -> float:
        """Largest |gradient_i| / m_i, m/s^2, of the last `linearise`."""
        self._launch(
            fem.residual_measure,
            RANGES,
            [self.vertex_count, RANGES, self.system.right_hand_side, self.vertices.mass],
            [self._maxima],
        )
        return float(np.sqrt(self._measured()[1].max()))

    def step_measures(self) -> StepMeasures:
        """Slope of E along the system's solution, J, and the largest vertex move in it, m."""
        self._launch(
            fem.step_measures,
            RANGES,
            [self.vertex_count, RANGES, self.system.solution, self.system.right_hand_side],
            [self._sums, self._maxima],
        )
        sums, maxima = self._measured()
        return StepMeasures(float(sums.sum()), float(np.sqrt(maxima.max())))

    def move_trial(self, length: float) -> None:
        """trial = start + length * (the system's solution)."""
        self.combine(self.start, 1.0, self.system.solution, length, self.trial)

    def combine(
        self, a: wp.array, weight_a: float, b: wp.array, weight_b: float, out: wp.array, constant: Any = None
    ) -> None:
        """out = weight_a a + weight_b b + constant, [P] vec3d; `out` may be `a` or `b`."""
        inputs = [a, weight_a, b, weight_b, NOTHING if constant is None else constant]
        self.over_vertices(fem.combine, inputs, [out])

    def hold(self, held: wp.array, out: wp.array) -> None:
        """Put fixed vertices where they are held."""
        self.over_vertices(fem.hold, [self.vertices, held], [out])

    def largest_step(self, x: wp.array, direction: wp.array) -> float:
        """Share in [0, 1] of `direction` that x can go without passing through anything."""
        return min((term.largest_step(x, direction) for term in self.terms), default=1.0)

    def reachable(self, x: wp.array, target: wp.array) -> bool:
        """Whether the straight way from x to `target` passes through nothing."""
        self.combine(target, 1.0, x, -1.0, self._difference)
        return self.largest_step(x, self._difference) >= 1.0

    def elastic_energy(self, x: wp.array) -> float:
        """Energy stored in the elements at x, J."""
        self._evaluate_elements(x, 0.0)
        stored = float(self._energies.numpy()[: self.element_count].sum())
        if self._averaged is not None:
            self._averaged.energy(x, self._energies, len(self._energies) - self.vertex_count)
            stored += float(self._energies.numpy()[-self.vertex_count :].sum())
        return stored

    def flow(self, x: wp.array) -> None:
        """Let elements past their yield stress keep the plastic part of their deformation at x."""
        if self._yields:
            outputs = [self.elements.inverse_rest, self.elements.plastic_strain]
            self.over_elements(elements.element_flow, [self.elements, x], outputs)

    def state(self) -> dict[str, wp.array]:
        """Arrays that `flow` changes; none where nothing can yield."""
        if not self._yields:
            return {}
        return {
            "stress_free_shapes": self.elements.inverse_rest,
            "plastic_strain": self.elements.plastic_strain,
        }

    def smallest_volume_ratio(self, x: wp.array) -> float:
        """min over elements of det F at x."""
        self.over_elements(elements.element_volume_ratio, [self.elements, x], [self._energies])
        return float(self._energies.numpy()[: self.element_count].min())

    def _measured(self) -> list[np.ndarray]:
        """Partial sums and maxima of the last measure."""
        return self._views or [self._sums.numpy(), self._maxima.numpy()]

    def _total(self, terms: wp.array) -> float:
        self._launch(linalg.sum_ranges, RANGES, [len(terms), RANGES, terms], [self._sums])
        return float(self._measured()[0].sum())

    def over_vertices(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        self._launch(kernel, self.vertex_count, inputs, outputs, minimum=4096)

    def over_elements(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        self._launch(kernel, self.element_count, inputs, outputs, minimum=256)


__all__ = ["IncrementalPotential", "StepMeasures"]
