"""The incremental potential of one implicit step: its energy, gradient and projected Hessian on a device."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import warp as wp

from gdpro_sim.device import launch_chunked
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import fem, linalg
from gdpro_sim.simulation.fem.conjugate_gradient import ConjugateGradient
from gdpro_sim.simulation.fem.topology import BLOCKS_PER_ELEMENT, build_topology
from gdpro_sim.simulation.model import Model

RANGES = 128
"""Partial sums of energies and measures: fixed, so that totals do not depend on the number of threads."""

CONTACT_PER_ELASTIC = 3.0
"""Ground stiffness of a vertex as a multiple of its own elastic stiffness."""

STICK_PER_ELASTIC = 1.0
"""Friction spring stiffness of a vertex as a multiple of its own elastic stiffness. Stiffer makes the
stick-slip kink sharper and Newton zigzag across it (ten times the iterations on a soft body, measured), and
buys only a smaller elastic give before slipping; at 1 that give is that of one more layer of elements."""

CONTACT_SAG = 1e-3
"""Penetration, as a fraction of the body's size, at which one vertex would carry the whole body's weight."""

CONTACT_RAMP = 1e-4
"""Depth over which the ground penalty turns from cubic to quadratic, as a fraction of the body's size."""

STANDARD_GRAVITY = 9.81


class StepMeasures(NamedTuple):
    slope: float
    largest_move: float


class IncrementalPotential:
    """E(x) of `gdpro_sim.kernels.fem` for one model; allocates everything once.

    x, v, anchor:  [P] state at the start of the step: positions m, velocities m/s, friction anchors m
    trial:         [P] the iterate
    inertia:       [P] where inertia and gravity alone would take each vertex; coasting: without gravity
    """

    def __init__(self, model: Model) -> None:
        self.device = model.device
        self.vertex_count = len(model.vertices)
        self.element_count = len(model.tets)
        device, p, t = self.device, self.vertex_count, self.element_count

        rest = _rest_shapes(model)
        self.mass = rest.mass
        self.fixed = model.pinned | (rest.mass <= 0.0)
        self.energy_noise = 2.0e-16 * float(np.sum(rest.volume * (rest.lam + 2.0 * rest.mu)))

        topology = build_topology(model.tets, p)
        self.system = ConjugateGradient(topology, device)

        self.elements = fem.Elements()
        self.elements.tets = wp.array(model.tets, dtype=wp.vec4i, device=device)
        self.elements.inverse_rest = wp.array(rest.inverse, dtype=wp.mat33d, device=device)
        self.elements.volume = _reals(rest.volume, device)
        self.elements.mu = _reals(rest.mu, device)
        self.elements.lam = _reals(rest.lam, device)
        self.elements.damping = _reals(model.rayleigh_stiffness, device)

        stiffness, stick, ramp = _contact_scales(model, rest)
        self.vertices = fem.Vertices()
        self.vertices.mass = _reals(rest.mass, device)
        self.vertices.damping = _reals(rest.mass_damping, device)
        self.vertices.friction = _reals(model.friction, device)
        self.vertices.contact_stiffness = _reals(stiffness, device)
        self.vertices.stick_stiffness = _reals(stick, device)
        self.vertices.contact_ramp = _reals(ramp, device)
        self.vertices.contact_offset = _reals(model.contact_offset, device)
        self.vertices.fixed = wp.array(self.fixed.astype(np.int32), dtype=wp.int32, device=device)
        self.vertices.offsets = wp.array(topology.corner_offsets, dtype=wp.int32, device=device)
        self.vertices.corners = wp.array(topology.corners, dtype=wp.int32, device=device)

        self.ground = fem.Ground()
        self.ground.enabled = int(model.ground is not None)
        self.ground.height = model.ground.height if model.ground is not None else 0.0
        self.gravity = wp.vec3d(*model.gravity)

        self.x, self.v, self.trial, self.base, self.inertia, self.coasting = (
            wp.zeros(p, dtype=wp.vec3d, device=device) for _ in range(6)
        )
        self.anchor = wp.zeros(p, dtype=wp.vec2d, device=device)
        self._limit = wp.zeros(p, dtype=wp.float64, device=device)
        self._cauchy_green = wp.zeros(t, dtype=wp.mat33d, device=device)
        self._element_gradient = wp.zeros(4 * t, dtype=wp.vec3d, device=device)
        self._element_blocks = wp.zeros(BLOCKS_PER_ELEMENT * t, dtype=wp.mat33d, device=device)
        self._terms = wp.zeros(t + p, dtype=wp.float64, device=device)
        self._sums, self._maxima = (wp.zeros(RANGES, dtype=wp.float64, device=device) for _ in range(2))
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
        self._inverse_dt = 0.0

    def begin(self, dt: float) -> None:
        """Start a step of `dt` seconds from (x, v, anchor)."""
        self._inverse_dt = 1.0 / dt
        self._over_vertices(
            fem.predict,
            [self.vertices, self.x, self.v, self.gravity, dt],
            [self.inertia, self.coasting],
        )
        if self._damped:
            self._over_elements(fem.element_cauchy_green, [self.elements, self.x], [self._cauchy_green])

    def update_friction(self, x: wp.array) -> None:
        """Take the Coulomb limits from the normal forces at x; they stay until the next call."""
        self._over_vertices(fem.friction_limits, [self.vertices, self.ground, x], [self._limit])

    def energy(self, x: wp.array, *, elements_unchanged: bool = False) -> float:
        """E(x) in J; infinite if an element is inverted.

        `elements_unchanged` reuses the element terms of the last call (when only friction limits changed).
        """
        if not elements_unchanged:
            self._over_elements(
                fem.element_energy,
                [self.elements, x, self._cauchy_green, self._inverse_dt],
                [self._terms],
            )
        self._over_vertices(
            fem.vertex_energy,
            [
                self.element_count,
                self.vertices,
                self.ground,
                x,
                self.x,
                self.inertia,
                self.anchor,
                self._limit,
                self._inverse_dt,
            ],
            [self._terms],
        )
        return self._total(self._terms)

    def linearise(self, x: wp.array) -> None:
        """Fill the linear system H d = -gradient at x."""
        system = self.system
        self._over_elements(
            fem.element_derivatives,
            [self.elements, x, self._cauchy_green, self._inverse_dt],
            [self._element_gradient, self._element_blocks],
        )
        launch_chunked(
            linalg.gather_off_diagonal,
            self._pair_count,
            [*self._pairs, self._element_blocks, *self._mirrored],
            [system.values],
            device=self.device,
        )
        self._over_vertices(
            fem.assemble_vertices,
            [
                self.vertices,
                self.ground,
                x,
                self.x,
                self.inertia,
                self.anchor,
                self._limit,
                self._inverse_dt,
                self._element_gradient,
                self._element_blocks,
                self._diagonal,
            ],
            [system.right_hand_side, system.values, system.inverse_diagonal],
        )

    def largest_acceleration(self) -> float:
        """Largest |gradient_i| / m_i, m/s^2, of the last `linearise`."""
        launch_chunked(
            fem.residual_measure,
            RANGES,
            [self.vertex_count, RANGES, self.system.right_hand_side, self.vertices.mass],
            [self._maxima],
            device=self.device,
        )
        return float(np.sqrt(self._maxima.numpy().max()))

    def step_measures(self) -> StepMeasures:
        """Slope of E along the system's solution, J, and the largest vertex move in it, m."""
        launch_chunked(
            fem.step_measures,
            RANGES,
            [self.vertex_count, RANGES, self.system.solution, self.system.right_hand_side],
            [self._sums, self._maxima],
            device=self.device,
        )
        return StepMeasures(float(self._sums.numpy().sum()), float(np.sqrt(self._maxima.numpy().max())))

    def move_trial(self, length: float) -> None:
        """trial = base + length * (the system's solution)."""
        self._over_vertices(fem.move, [self.base, self.system.solution, length], [self.trial])

    def accept(self) -> None:
        """Make the trial the state: new velocities, positions and friction anchors."""
        self._over_vertices(
            fem.finish,
            [self.vertices, self.ground, self.trial, self._inverse_dt],
            [self.x, self.v, self.anchor],
        )

    def elastic_energy(self) -> float:
        """Energy stored in the elements at x, J."""
        self._over_elements(
            fem.element_energy,
            [self.elements, self.x, self._cauchy_green, 0.0],
            [self._terms],
        )
        return float(self._terms.numpy()[: self.element_count].sum())

    def contact_energy(self) -> float:
        """Energy stored in the ground penalty and friction springs at x, J."""
        self._over_vertices(
            fem.contact_energy, [self.vertices, self.ground, self.x, self.anchor], [self._terms]
        )
        return float(self._terms.numpy()[: self.vertex_count].sum())

    def smallest_volume_ratio(self) -> float:
        """min over elements of det F at x."""
        self._over_elements(fem.element_volume_ratio, [self.elements, self.x], [self._terms])
        return float(self._terms.numpy()[: self.element_count].min())

    def _total(self, terms: wp.array) -> float:
        launch_chunked(
            linalg.sum_ranges, RANGES, [len(terms), RANGES, terms], [self._sums], device=self.device
        )
        return float(self._sums.numpy().sum())

    def _over_vertices(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_chunked(kernel, self.vertex_count, inputs, outputs, device=self.device, minimum=4096)

    def _over_elements(self, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_chunked(kernel, self.element_count, inputs, outputs, device=self.device, minimum=256)


class _RestShapes(NamedTuple):
    inverse: np.ndarray
    volume: np.ndarray
    mu: np.ndarray
    lam: np.ndarray
    mass: np.ndarray
    mass_damping: np.ndarray


def _rest_shapes(model: Model) -> _RestShapes:
    corners = model.vertices.astype(np.float64)[model.tets]
    shape = np.swapaxes(corners[:, 1:] - corners[:, :1], 1, 2)
    full_volume = np.linalg.det(shape) / 6.0
    bad = np.flatnonzero(~(full_volume > 0.0))
    if len(bad):
        raise SolverError(
            f"element {bad[0]} has volume {full_volume[bad[0]]:.3g} m^3 at rest ({len(bad)} such elements); "
            "every tet must have positive volume: repair or re-tetrahedralize the mesh"
        )
    volume = full_volume * model.fill
    young, poisson = model.young.astype(np.float64), model.poisson.astype(np.float64)
    mu = young / (2.0 * (1.0 + poisson))
    lam = young * poisson / ((1.0 + poisson) * (1.0 - 2.0 * poisson))

    share = np.repeat(model.density.astype(np.float64) * volume / 4.0, 4)
    ids, count = model.tets.reshape(-1), len(model.vertices)
    mass = np.bincount(ids, weights=share, minlength=count)
    damped = np.bincount(ids, weights=share * np.repeat(model.rayleigh_mass, 4), minlength=count)
    mass_damping = np.divide(damped, mass, out=np.zeros(count), where=mass > 0.0)
    return _RestShapes(np.linalg.inv(shape), volume, mu, lam, mass, mass_damping)


def _contact_scales(model: Model, rest: _RestShapes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Ground stiffness N/m, friction spring stiffness N/m and ramp depth m of each vertex.

    The ground stiffness follows the vertex's own elastic stiffness (so that a stiff body indents the ground
    no more than itself) and its body's weight (so that a soft one does not sink).
    """
    first = -rest.inverse.sum(axis=1, keepdims=True)
    gradients = np.concatenate([first, rest.inverse], axis=1)
    modulus = rest.volume * (rest.lam + 2.0 * rest.mu)
    per_corner = modulus[:, None] * np.einsum("eai,eai->ea", gradients, gradients)
    count = len(model.vertices)
    elastic = np.bincount(model.tets.reshape(-1), weights=per_corner.reshape(-1), minlength=count)

    stiffness = CONTACT_PER_ELASTIC * elastic
    ramp = np.zeros(count)
    ranges = [body.vertex_range for body in model.bodies] or [(0, count)]
    for begin, end in ranges:
        size = float(np.linalg.norm(np.ptp(model.vertices[begin:end].astype(np.float64), axis=0)))
        weight = STANDARD_GRAVITY * float(rest.mass[begin:end].sum())
        stiffness[begin:end] += weight / (CONTACT_SAG * size)
        ramp[begin:end] = CONTACT_RAMP * size
    return model.fem.contact_stiffness * stiffness, STICK_PER_ELASTIC * elastic, ramp


def _reals(values: np.ndarray, device: str) -> wp.array:
    return wp.array(np.ascontiguousarray(values, dtype=np.float64), dtype=wp.float64, device=device)


__all__ = ["IncrementalPotential", "StepMeasures"]
