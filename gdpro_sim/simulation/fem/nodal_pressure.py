"""Averaged nodal volumes of one model on a device: what keeps nearly incompressible tets from locking."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import launch_chunked
from gdpro_sim.kernels import nodal_pressure as kernels
from gdpro_sim.kernels.elasticity import LINEAR, NEO_HOOKEAN, STVK_HENCKY
from gdpro_sim.kernels.elements import Elements
from gdpro_sim.simulation.fem.rest import RestShapes, reals
from gdpro_sim.simulation.fem.topology import Topology
from gdpro_sim.simulation.model import Model

NEARLY_INCOMPRESSIBLE = 0.45
"""Poisson's ratio from which on elements give up part of their volumetric energy, where the model leaves it
to the solver."""

KEPT = 1.0
"""Lame's lambda that such an element keeps, in units of its mu: that of Poisson's ratio 1/4.

Measured on a cantilever of 20 x 4 x 4 cells, tip deflection over Timoshenko's: 0.78 at ratio 0.3; at 0.499
0.09 with all of lambda in the elements, 0.62, 0.67, 0.70, 0.72 where they keep 4, 2, 1, 1/2 mu.
"""


def kept_lambda(model: Model, rest: RestShapes) -> np.ndarray:
    """The part of lambda [T], Pa, that elements keep; less than all of it where volumes are averaged."""
    averaged = {
        "auto": model.poisson.astype(np.float64) >= NEARLY_INCOMPRESSIBLE - 1e-6,
        "nodal": np.ones(len(model.tets), bool),
        "element": np.zeros(len(model.tets), bool),
    }[model.fem.volumes]
    if model.law is not None:
        averaged &= model.law != int(LINEAR)
    return np.where(averaged, np.minimum(rest.lam, KEPT * rest.mu), rest.lam)


class NodalPressure:
    """Energy and derivatives of `gdpro_sim.kernels.nodal_pressure`; allocates everything once.

    forward, transposed: [N + 1] vec3d, G and its transpose on the pattern of the tangent matrix, m^2
    curvature:           [P] D, Pa/m^3
    blocks:              [P] mat33d diagonal blocks of G^T D G, for the preconditioner
    """

    def __init__(
        self,
        model: Model,
        rest: RestShapes,
        topology: Topology,
        elements: Elements,
        offsets: wp.array,
        columns: wp.array,
    ) -> None:
        device = self.device = model.device
        count, self.element_count = len(model.vertices), len(model.tets)
        self.vertex_count = count
        self._elements, self._offsets, self._columns = elements, offsets, columns
        ids = model.tets.reshape(-1)
        share = np.repeat(rest.volume / 4.0, 4)
        volume = np.bincount(ids, weights=share, minlength=count)
        excess = np.repeat(rest.lam - kept_lambda(model, rest), 4) * share
        stiffness = np.bincount(ids, weights=excess, minlength=count)
        stiffness = np.divide(stiffness, volume, out=np.zeros(count), where=volume > 0.0)

        self._nodes = kernels.Nodes()
        self._nodes.volume = reals(volume, device)
        self._nodes.stiffness = reals(stiffness, device)
        self._nodes.logarithmic = wp.array(_logarithmic(model), dtype=wp.int32, device=device)
        self._nodes.offsets = wp.array(topology.corner_offsets, dtype=wp.int32, device=device)
        self._nodes.corners = wp.array(topology.corners, dtype=wp.int32, device=device)
        self._pairs: list[wp.array] = [
            wp.array(part, dtype=wp.int32, device=device)
            for part in (topology.pair_offsets, topology.pair_blocks)
        ]
        self._mirrored: list[wp.array] = [
            wp.array(part, dtype=wp.int32, device=device) for part in (topology.upper, topology.lower)
        ]
        self._pair_count = len(topology.upper)
        self._diagonal: wp.array = wp.array(topology.diagonal, dtype=wp.int32, device=device)
        self._volumes = wp.zeros(self.element_count, dtype=wp.float64, device=device)
        self._pressure, self.curvature = (wp.zeros(count, dtype=wp.float64, device=device) for _ in range(2))
        self._slopes = wp.zeros(4 * self.element_count, dtype=wp.vec3d, device=device)
        self.forward, self.transposed = (
            # One more, because entries are read four numbers at a time.
            wp.zeros(len(topology.columns) + 1, dtype=wp.vec3d, device=device)
            for _ in range(2)
        )
        self.blocks = wp.zeros(count, dtype=wp.mat33d, device=device)

    def energy(self, x: wp.array, energies: wp.array, first: int) -> None:
        """Write the energy of each vertex, J, from index `first` on."""
        self._over(self.element_count, kernels.element_volumes, [self._elements, x], [self._volumes])
        self._over(self.vertex_count, kernels.nodal_energy, [first, self._nodes, self._volumes], [energies])

    def press(self, x: wp.array) -> None:
        """Put the pressures at x into the elements, which add them to their own stresses and Hessians."""
        self._over(self.element_count, kernels.element_volumes, [self._elements, x], [self._volumes])
        inputs = [self._nodes, self._volumes]
        self._over(self.vertex_count, kernels.nodal_pressure, inputs, [self._pressure, self.curvature])
        outputs = [self._elements.pressure, self._slopes]
        inputs = [self._elements, x, self._pressure]
        self._over(self.element_count, kernels.element_pressure, inputs, outputs)

    def linearise(self) -> None:
        """Fill G, D and the diagonal blocks where `press` was called last."""
        outputs = [self.forward, self.transposed]
        inputs = [*self._pairs, self._slopes, *self._mirrored]
        self._over(self._pair_count, kernels.gather_slopes, inputs, outputs)
        inputs = [self._nodes, self._slopes, self._diagonal]
        self._over(self.vertex_count, kernels.gather_own_slopes, inputs, outputs)
        inputs = [self._offsets, self._columns, self.transposed, self.curvature]
        self._over(self.vertex_count, kernels.own_blocks, inputs, [self.blocks])

    def _over(self, count: int, kernel: wp.Kernel, inputs: list[Any], outputs: list[Any]) -> None:
        launch_chunked(kernel, count, inputs, outputs, device=self.device, minimum=1024)


def _logarithmic(model: Model) -> np.ndarray:
    """Vertices [P] int32 all of whose elements have a law whose volumetric energy is of ln J."""
    count = len(model.vertices)
    if model.law is None:
        return np.zeros(count, np.int32)
    other = ~np.isin(model.law, [int(NEO_HOOKEAN), int(STVK_HENCKY)])
    return (np.bincount(model.tets.reshape(-1), np.repeat(other, 4), count) == 0).astype(np.int32)


__all__ = ["KEPT", "NEARLY_INCOMPRESSIBLE", "NodalPressure", "kept_lambda"]
