"""Pressure and wind on boundary triangles as terms of the incremental potential."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy.sparse as sparse
import warp as wp

from gdpro_sim.kernels import forces as kernels
from gdpro_sim.simulation.conditions import Pressure, Wind
from gdpro_sim.simulation.fem.force_term import (
    ForceTerm,
    ever_free,
    grouped,
    integers,
    share_of_step,
    stable_frequency,
)
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.term import Step
from gdpro_sim.simulation.model import Model

FASTEST = 30.0
"""Speed in m/s against the air that explicit steps are prepared for, besides the wind's own."""


class PressureLoad(ForceTerm):
    """A follower pressure. Implements `gdpro_sim.simulation.fem.term.Term`.

    On triangles that enclose a volume it has a potential, p V. On a part of a surface it has none: there its
    forces stay while one Newton step is taken, and follow the iterates.
    """

    def __init__(self, model: Model, rest: RestShapes, load: Pressure) -> None:
        super().__init__(model, np.unique(load.faces))
        self._load = load
        self._triangles = _triangles(model, load.faces)
        self.energies = len(load.faces) if load.closed else self.count
        self._edges = _Edges(load.faces, len(model.vertices), model.device)
        self._force = wp.zeros(self.count, dtype=wp.vec3d, device=model.device)
        points = model.vertices.astype(np.float64)
        middle = points[np.unique(load.faces)].mean(axis=0)
        self._origin = wp.vec3d(*middle)
        corners = points[load.faces] - middle
        self._rest = reals(np.linalg.det(corners) / 6.0, model.device)
        self._energies = wp.zeros(self.energies, dtype=wp.float64, device=model.device)
        self._pressure = 0.0
        self._before = wp.zeros(len(points), dtype=wp.vec3d, device=model.device)
        stiffness = abs(load.pressure) * self._edges.lengths(points) / 6.0
        self.frequency = stable_frequency(stiffness, np.zeros_like(stiffness), ever_free(model), rest)

    def begin(self, step: Step) -> None:
        self._pressure = share_of_step(step, self._load.start, self._load.end) * self._load.pressure
        self._before = step.x

    def lag(self, x: wp.array) -> None:
        if not self._load.closed:
            self.launch(
                kernels.pressure_forces, self.count, [self._triangles, self._pressure, x], [self._force]
            )

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        if self._load.closed:
            inputs = [first, self._triangles, self._rest, self._pressure, self._origin, x]
            self.launch(kernels.volume_energy, self.energies, inputs, [energies])
        else:
            inputs = [first, self.vertices, self._force, x, self._before]
            self.launch(kernels.load_energy, self.count, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        if not self._load.closed:
            self.launch(kernels.add_loads, self.count, [self.vertices, self._force], [gradient])
            return None
        if self._pressure == 0.0:
            return None
        e = self._edges
        inputs = [e.offsets, e.opposite, e.signs, self._pressure, x]
        self.launch(kernels.edge_blocks, e.count, inputs, [e.across, e.along])
        inputs = [self._triangles, self._pressure, e.vertex_offsets, e.vertex_edges, e.along, x]
        self.launch(kernels.add_pressure, self.count, inputs, [gradient, block])
        return e.blocks()

    def stored(self, x: wp.array) -> float:
        """Pressure times the volume gained since the start, where it is closed."""
        if not self._load.closed:
            return 0.0
        self.energy(x, self._energies, 0)
        return float(self._energies.numpy().sum())


class WindLoad(ForceTerm):
    """Drag and lift of moving air. Implements `gdpro_sim.simulation.fem.term.Term`.

    The force at the last lagged iterate, and a semidefinite stand-in for how it falls with velocity: at the
    solution the force is that of the solution.
    """

    def __init__(self, model: Model, rest: RestShapes, load: Wind) -> None:
        super().__init__(model, np.unique(load.faces))
        self._load = load
        self._triangles = _triangles(model, load.faces)
        self.energies = self.count
        self._air = kernels.Air()
        self._air.velocity = wp.vec3d(*load.velocity)
        self._air.half_density = 0.5 * load.density
        self._air.drag, self._air.lift = load.drag, load.lift
        self._force, self._position = (
            wp.zeros(self.count, dtype=wp.vec3d, device=model.device) for _ in range(2)
        )
        self._drag = wp.zeros(self.count, dtype=wp.mat33d, device=model.device)
        self._base = wp.zeros(len(model.vertices), dtype=wp.vec3d, device=model.device)
        self._inverse_h = self._share = 0.0
        self.frequency = self._bound(model, rest)

    def begin(self, step: Step) -> None:
        self._share = share_of_step(step, self._load.start, self._load.end)
        # No velocities where forces are to balance.
        self._inverse_h = 1.0 / step.h if step.end > step.start else 0.0
        self._base = step.base

    def lag(self, x: wp.array) -> None:
        inputs = [self._triangles, self._air, self._share, x, self._base, self._inverse_h]
        self.launch(kernels.wind_forces, self.count, inputs, [self._force, self._drag, self._position])

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        inputs = [first, self.vertices, self._force, self._drag, self._position, self._inverse_h, x]
        self.launch(kernels.lagged_energy, self.count, inputs, [energies])

    def add_derivatives(self, x: wp.array, gradient: wp.array, block: wp.array) -> Any:
        inputs = [self.vertices, self._force, self._drag, self._position, self._inverse_h, x]
        self.launch(kernels.add_lagged, self.count, inputs, [gradient, block])
        return None

    def _bound(self, model: Model, rest: RestShapes) -> float:
        load = self._load
        corners = model.vertices.astype(np.float64)[load.faces]
        area = 0.5 * np.linalg.norm(
            np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
        )
        speed = float(np.linalg.norm(load.velocity)) + FASTEST
        size = len(model.vertices)
        areas = np.bincount(load.faces.reshape(-1), weights=np.repeat(area / 3.0, 3), minlength=size)
        damping = load.density * (load.drag + load.lift) * speed * areas
        return stable_frequency(np.zeros(size), damping, ever_free(model), rest)


class _Edges:
    """Edges of triangles, and the vertices opposite each: what a potential p V couples."""

    def __init__(self, faces: np.ndarray, size: int, device: str) -> None:
        self._size = size
        tail = faces.reshape(-1).astype(np.int64)
        head = faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
        opposite = faces[:, [2, 0, 1]].reshape(-1)
        low, high = np.minimum(tail, head), np.maximum(tail, head)
        keys, edge = np.unique(low * size + high, return_inverse=True)
        self.count = len(keys)
        self._low, self._high = keys // size, keys % size
        offsets, order = grouped(edge, self.count)
        self._opposite, self._order_edge = opposite[order], edge[order]
        self._signs = np.where(tail < head, -1.0, 1.0)[order]
        self.offsets = integers(offsets, device)
        self.opposite = integers(self._opposite, device)
        self.signs = reals(self._signs, device)
        self.across, self.along = (wp.zeros(self.count, dtype=wp.mat33d, device=device) for _ in range(2))
        ends = np.concatenate([self._low, self._high])
        _, slots = np.unique(ends, return_inverse=True)
        vertex_offsets, vertex_edges = grouped(slots, int(slots.max(initial=-1)) + 1)
        self.vertex_offsets = integers(vertex_offsets, device)
        self.vertex_edges = integers(vertex_edges % self.count, device)

        rows, columns = ends, np.concatenate([self._high, self._low])
        order = np.lexsort((columns, rows))
        self._from = order % self.count
        self._turn = np.where(order < self.count, 1.0, -1.0)[:, None, None]
        self._columns = columns[order].astype(np.int32)
        self._rows = np.concatenate([[0], np.cumsum(np.bincount(rows, minlength=size))]).astype(np.int32)

    def blocks(self) -> Any:
        """The off-diagonal blocks: antisymmetric, so (j, i) is minus (i, j)."""
        data = self._turn * self.across.numpy()[self._from]
        return sparse.bsr_matrix((data, self._columns, self._rows), shape=(3 * self._size, 3 * self._size))

    def lengths(self, points: np.ndarray) -> np.ndarray:
        """[P] m: around each vertex, the sum of distances between the vertices opposite its edges."""
        across = np.zeros((self.count, 3))
        np.add.at(across, self._order_edge, self._signs[:, None] * points[self._opposite])
        length = np.tile(np.linalg.norm(across, axis=1), 2)
        return np.bincount(np.concatenate([self._low, self._high]), weights=length, minlength=self._size)


def _triangles(model: Model, faces: np.ndarray) -> Any:
    touched, slots = np.unique(faces, return_inverse=True)
    offsets, items = grouped(slots.reshape(-1), len(touched))
    triangles = kernels.Triangles()
    triangles.faces = wp.array(np.ascontiguousarray(faces, np.int32), dtype=wp.vec3i, device=model.device)
    triangles.vertices = integers(touched, model.device)
    triangles.offsets = integers(offsets, model.device)
    triangles.around = integers(items // 3, model.device)
    return triangles


__all__ = ["PressureLoad", "WindLoad"]
