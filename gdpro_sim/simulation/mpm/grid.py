"""The sparse grid of the MPM, and the particles sorted into its blocks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import Launches
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_grid, mpm_particles, mpm_transfer
from gdpro_sim.kernels.particles import POSITION, SPEED

OFFSETS = np.stack(np.meshgrid(*[[-1, 0, 1]] * 3, indexing="ij"), axis=-1).reshape(27, 3)
"""Of the blocks beside a block, in the order of `gdpro_sim.kernels.mpm_transfer`."""

LINE = 16
"""Floats of a line of a CPU's cache."""


def _row_length(count: int) -> int:
    """Floats from one row to the next for `count` particles.

    27 lines of the cache past a multiple of 64 of them: all numbers of some neighbouring particles then lie
    in different places of the cache, and none is taken for one that was just written (lines 4 KiB apart are,
    until their addresses are known in full).
    """
    lines = -(-count // LINE)
    return LINE * (lines + (27 - lines) % 64)


FARTHEST = 1 << 21
"""Cells from the origin at which float32 tells no eighth of a cell apart any more."""

FEW_BLOCKS = 48
"""Blocks of particles worth a range of their own among threads."""

WIDTHS = {"quadratic": 3, "cubic": 4}


class Grid:
    """Nodes at integer multiples of `spacing` near the particles, in `count` blocks of 4 x 4 x 4.

    values: [64 count] (velocity m/s, mass kg) of each node; no mass, no velocity
    blocks: [count] node n of block g is number 4 blocks[g] + (n / 16, n / 4 % 4, n % 4)
    size:   m, extent of what the particles' blocks bound

    Particle arrays belong to it because it sorts them: `particles` [rows, >= N] float32, see
    `gdpro_sim.kernels.particles`, `matter` and `ids` [N] int32. Rows are padded with zeros: were they a power
    of two apart, all numbers of a particle would share one place in the cache.
    """

    def __init__(
        self,
        particles: np.ndarray,
        matter: np.ndarray,
        *,
        spacing: float,
        kernel: str,
        max_cells: int,
        device: str,
    ) -> None:
        self.device, self.spacing, self.max_cells = device, spacing, max_cells
        self.width = WIDTHS[kernel]
        self.launch = Launches(device)
        count = particles.shape[1]
        shape = (len(particles), _row_length(count))
        self.particles, self._particles = (wp.zeros(shape, dtype=float, device=device) for _ in range(2))
        ids = np.arange(count, dtype=np.int32)
        self.matter: wp.array = wp.array(matter, dtype=int, device=device)
        self.ids: wp.array = wp.array(ids, dtype=int, device=device)
        self._keys: wp.array = wp.zeros(count, dtype=int, device=device)
        self.owners: wp.array = wp.zeros(count, dtype=int, device=device)
        self.count = self.occupied = 0
        self._seen: tuple[np.ndarray, np.ndarray] | None = None
        self.put(particles)
        self._room: dict[str, wp.array] = {}
        self.change: wp.array | None = None

    def array(self, name: str, count: int, dtype: Any) -> wp.array:
        """An array of `count`, from memory that grows by halves and is kept."""
        held = self._room.get(name)
        if held is None or len(held) < count:
            held = self._room[name] = wp.zeros(count + count // 2, dtype=dtype, device=self.device)
        return held[:count]

    def set(self, name: str, values: np.ndarray, dtype: Any) -> wp.array:
        array = self.array(name, len(values), dtype)
        array.assign(values)
        return array

    def put(self, particles: np.ndarray) -> None:
        """Give all particles their numbers, [rows, N] in the order of `ids`."""
        padded = np.zeros(self.particles.shape, np.float32)
        padded[:, : particles.shape[1]] = particles
        self.particles.assign(padded)

    def sort(self) -> None:
        """Put the particles in order of their blocks, and make the blocks of nodes that they reach.

        Raises SolverError where they are nowhere (NaN) or too far apart for `max_cells`.
        """
        count = len(self.ids)
        rows = self.particles[POSITION : POSITION + 3].numpy()[:, :count]
        low, high = rows.min(axis=1), rows.max(axis=1)
        if not (np.isfinite(low).all() and np.isfinite(high).all()):
            raise SolverError("particles have positions that are no numbers")
        if max(abs(low).max(), abs(high).max()) > FARTHEST * self.spacing:
            raise SolverError(
                f"particles lie {max(abs(low).max(), abs(high).max()):.3g} m from the origin, more than "
                f"{FARTHEST:,} cells of {self.spacing:.3g} m: positions in float32 are too coarse there"
            )
        reach = mpm_transfer.BLOCK * self.spacing
        first = np.floor(low / reach).astype(np.int64) - 2
        size = np.floor(high / reach).astype(np.int64) + 3 - first
        cells = int(np.prod(size.astype(object))) * mpm_transfer.BLOCK**3
        if cells > self.max_cells:
            extent = " x ".join(f"{x:.3g}" for x in high - low)
            raise SolverError(
                f"particles {extent} m apart would need a grid of {cells:,} cells of {self.spacing:.3g} m "
                f"(at most {self.max_cells:,}): make cells larger, or walls (`domain`) to keep them together"
            )
        self.launch(
            mpm_grid.block_of_particles,
            count,
            [self.width, 1.0 / self.spacing, wp.vec3i(*first.tolist()), wp.vec3i(*size.tolist())],
            [self.particles, self._keys],
        )
        keys = self._keys.numpy()
        table = np.zeros(int(np.prod(size)), np.int32)
        present = np.zeros(len(table), bool)
        present[keys] = True
        occupied = np.flatnonzero(present)
        table[occupied] = np.arange(len(occupied), dtype=np.int32)
        owners = table[keys]
        # Numbers of 16 bits are sorted by counting.
        order = np.argsort(owners.astype(np.uint16) if len(occupied) < 1 << 16 else owners, kind="stable")
        self._permute(order.astype(np.int32))
        self.owners.assign(owners[order])
        starts = np.zeros(len(occupied) + 1, np.int32)
        np.cumsum(np.bincount(owners, minlength=len(occupied)), out=starts[1:])
        self._link(np.stack(np.unravel_index(occupied, tuple(size)), axis=1), first, size, starts)

    def _permute(self, order: np.ndarray) -> None:
        """Take the particles in this order."""
        if np.array_equal(order, np.arange(len(order), dtype=order.dtype)):
            return
        numbers = self.set("order", order, int)
        if self.device == "cpu":
            self.launch(
                mpm_grid.permute_rows,
                len(self.particles),
                [numbers, self.particles],
                [self._particles],
                minimum=4,
            )
        else:
            self.launch(mpm_grid.permute_particles, len(order), [numbers, self.particles], [self._particles])
        self.particles, self._particles = self._particles, self.particles
        self.matter.assign(self.matter.numpy()[order])
        self.ids.assign(self.ids.numpy()[order])

    def _link(self, coords: np.ndarray, first: np.ndarray, size: np.ndarray, starts: np.ndarray) -> None:
        """Make the blocks of nodes around blocks of particles at `coords` [B, 3], counted from `first`."""
        beside = coords[:, None, :] + OFFSETS[None]
        flat = np.ravel_multi_index(tuple(np.moveaxis(beside, 2, 0)), tuple(size))
        present = np.zeros(int(np.prod(size)), bool)
        present[flat] = True
        nodes = np.flatnonzero(present)
        table = np.zeros(len(present), np.int32)
        table[nodes] = np.arange(len(nodes), dtype=np.int32)
        neighbors = table[flat].astype(np.int32)
        # Seen from a block of nodes, the particles at offset o see it at the opposite one.
        sources = np.full((len(nodes), 27), -1, np.int32)
        sources[neighbors[:, ::-1], np.arange(27)[None]] = np.arange(len(coords), dtype=np.int32)[:, None]
        self.occupied, self.count = len(coords), len(nodes)
        self.starts = self.set("starts", starts, int)
        self.coords = self.set("coords", (coords + first).astype(np.int32), wp.vec3i)
        self.neighbors = self.set("neighbors", neighbors.ravel(), int)
        self.sources = self.set("sources", sources.ravel(), int)
        corners = np.stack(np.unravel_index(nodes, tuple(size)), axis=1) + first
        self.blocks = self.set("blocks", corners.astype(np.int32), wp.vec3i)
        self.launch.serial = self.occupied < 2 * FEW_BLOCKS
        self.values = self.array("values", 64 * self.count, wp.vec4)
        self.strayed = self.array("strayed", self.occupied, int)
        if self.device == "cpu":
            self.tiles = self.array("tiles", self.occupied * mpm_transfer.tile_nodes(self.width), wp.vec4)
        self.strayed.zero_()
        self._seen = None

    def scatter(self, h: float, affine: float, change: Sequence[float]) -> None:
        """Particles to nodes: velocities after `h` seconds of stress, plus `change` m/s.

        affine: share of the velocity gradient that goes along
        """
        common = [self.width, float(h), self.spacing, float(affine)]
        gravity = wp.vec3(*change)
        if self.device == "cpu":
            self.launch(
                mpm_transfer.scatter_blocks,
                self.occupied,
                [*common, self.starts, self.coords, self.particles],
                [self.tiles],
                minimum=FEW_BLOCKS,
            )
            self.launch(
                mpm_grid.sum_tiles,
                self.count,
                [self.width, gravity, self.sources, self.tiles],
                [self.values],
                minimum=4 * FEW_BLOCKS,
            )
            return
        self.values.zero_()
        self.launch(
            mpm_particles.scatter_particles,
            len(self.ids),
            [*common, self.owners, self.coords, self.neighbors, self.particles],
            [self.values],
        )
        self.launch(mpm_grid.momentum_to_velocity, 64 * self.count, [gravity], [self.values])

    def keep(self) -> None:
        """Keep the nodes' velocities, for `give_change`."""
        self.change = self.array("change", 64 * self.count, wp.vec4)
        wp.copy(self.change, self.values)

    def give_change(self) -> None:
        """Add to the particles' velocities what has changed at the nodes since `keep`."""
        assert self.change is not None
        self.launch(mpm_grid.change_of_velocity, 64 * self.count, [self.values], [self.change])
        common = [self.width, self.spacing]
        if self.device == "cpu":
            self.launch(
                mpm_transfer.add_change_blocks,
                self.occupied,
                [*common, self.starts, self.coords, self.neighbors, self.change],
                [self.particles],
                minimum=FEW_BLOCKS,
            )
        else:
            self.launch(
                mpm_particles.add_change_particles,
                len(self.ids),
                [*common, self.owners, self.coords, self.neighbors, self.change],
                [self.particles],
            )

    def gather(self, h: float, flip: float) -> None:
        """Nodes to particles, which move by `h` seconds."""
        common = [self.width, float(h), self.spacing, float(flip)]
        if self.device == "cpu":
            self.launch(
                mpm_transfer.gather_blocks,
                self.occupied,
                [*common, self.starts, self.coords, self.neighbors, self.values],
                [self.particles, self.strayed],
                minimum=FEW_BLOCKS,
            )
        else:
            self.launch(
                mpm_particles.gather_particles,
                len(self.ids),
                [*common, self.owners, self.coords, self.neighbors, self.values],
                [self.particles, self.strayed],
            )

    def has_strayed(self) -> bool:
        """Whether a particle lies too far from its block to go on without `sort`."""
        return bool(self._views()[0].any())

    def fastest(self) -> float:
        """Largest SPEED of the particles, m/s; NaN where one is no number."""
        return float(self._views()[1].max())

    def _views(self) -> tuple[np.ndarray, np.ndarray]:
        """`strayed` and the row SPEED: on the CPU the arrays' own memory, taken once after each `sort`."""
        if self._seen is None or self.device != "cpu":
            self._seen = (self.strayed.numpy(), self.particles[SPEED].numpy()[: len(self.ids)])
        return self._seen

    def rows(self, first: int, count: int) -> np.ndarray:
        """[N, count] numbers of each particle from row `first` on, in the model's order."""
        found = np.empty((len(self.ids), count), np.float32)
        found[self.ids.numpy()] = self.particles[first : first + count].numpy()[:, : len(found)].T
        return found

    @property
    def inertia(self) -> float:
        """m^2: D of `gdpro_sim.kernels.mpm_transfer`, what a velocity gradient's momentum has for a lever."""
        return self.spacing**2 / (4.0 if self.width == 3 else 3.0)


__all__ = ["Grid"]
