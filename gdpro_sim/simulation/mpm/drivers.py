"""What holds particles, moves them along, or pushes them."""

from __future__ import annotations

import math

import numpy as np
import warp as wp

from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_boundary as kernels
from gdpro_sim.kernels import mpm_drivers
from gdpro_sim.kernels.particles import POSITION
from gdpro_sim.simulation.conditions import Force, Guide, Impulse, Motion, pose_at
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mpm.grid import OFFSETS, Grid

SAMPLE = 1.0e-3
"""s between the times at which a motion is looked at for its speed."""

MOST_SAMPLES = 100
"""In a step."""


def top_speed(motion: Motion | Guide, points: np.ndarray, time: float, dt: float) -> float:
    """m/s, that a motion gives the fastest of some points from `time` to `time` + `dt` s.

    points: [n, 3] m, at the start
    """
    # What is guided goes evenly through the step that it was told of.
    count = 1 if isinstance(motion, Guide) else int(np.clip(math.ceil(dt / SAMPLE), 1, MOST_SAMPLES))
    poses = [pose_at(motion, time + dt * k / count) for k in range(count + 1)]
    places = np.stack([points @ turn.T + shift for turn, shift in poses])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=2).max()) * count / dt


class Places:
    """Where each particle of the model stands in the grid: `place` [N] int32, new after each sort."""

    def __init__(self) -> None:
        self._blocks: wp.array | None = None
        self.place: wp.array | None = None

    def follow(self, grid: Grid, name: str) -> bool:
        """Whether particles have been sorted since the last time; then `place` is new."""
        if self._blocks is grid.blocks:
            return False
        self._blocks = grid.blocks
        place = np.empty(len(grid.ids), np.int32)
        place[grid.ids.numpy()] = np.arange(len(place), dtype=np.int32)
        self.place = grid.set(f"{name}.place", place, int)
        return True


class Holds:
    """Particles that are held where they are, or moved along, see `gdpro_sim.simulation.conditions.Hold`.

    Nodes with enough held mass move with it, and so do the particles themselves, exactly.
    """

    def __init__(self, model: Model) -> None:
        self.holds = model.holds
        self._particles = np.concatenate([hold.particles for hold in self.holds]).astype(np.int32)
        hold = np.repeat(np.arange(len(self.holds)), [len(hold.particles) for hold in self.holds])
        self._hold_of = hold.astype(np.int32)
        self._moves = any(hold.motion is not None for hold in self.holds)
        device = model.device
        self._particle: wp.array = wp.array(self._particles, dtype=int, device=device)
        self._hold: wp.array = wp.array(self._hold_of, dtype=int, device=device)
        self._host = np.zeros((len(self.holds), kernels.COLUMNS))
        self._table: wp.array = wp.array(self._host, dtype=wp.float64, device=device)
        assert model.particles is not None
        start = model.particles.positions[self._particles].astype(np.float64)
        self._anchor: wp.array = wp.array(start, dtype=wp.vec3d, device=device)
        self._places = Places()
        self._known = np.zeros(0)  # which holds held when the nodes' sums were made
        self._corners = [corners(model.particles.positions[hold.particles]) for hold in self.holds]
        self._speed = 0.0

    def plan(self, time: float, dt: float) -> None:
        self._speed = max(
            (
                top_speed(hold.motion, box, time, dt)
                for hold, box in zip(self.holds, self._corners, strict=True)
                if hold.motion is not None and hold.start < time + dt and time < hold.release
            ),
            default=0.0,
        )

    def speed(self) -> float:
        return self._speed

    def begin(self, time: float, h: float) -> None:
        for row, hold in zip(self._host, self.holds, strict=True):
            rotation, shift = np.eye(3), np.zeros(3)
            if hold.motion is not None:
                rotation, shift = pose_at(hold.motion, time)
                after, end = pose_at(hold.motion, time + h)
                row[kernels.LINEAR : kernels.SPIN] = (end - shift) / h
                spin = (after @ rotation.T - np.eye(3)) / h
                row[kernels.SPIN : kernels.KIND] = spin.ravel()
            row[kernels.ORIGIN : kernels.ROTATION] = shift
            row[kernels.ROTATION : kernels.LINEAR] = rotation.ravel()
            holds = hold.start <= time < hold.release
            row[kernels.KIND] = kernels.STICKY if holds else kernels.ABSENT
        self._table.assign(self._host)
        self._summed = False

    def apply(self, grid: Grid, h: float) -> None:
        sorted_anew = self._places.follow(grid, "holds")
        if sorted_anew:
            self._list(grid)
        if not len(self._near):
            return
        holding = self._host[:, kernels.KIND].copy()
        if not self._summed and (sorted_anew or self._moves or not np.array_equal(holding, self._known)):
            inputs = [
                grid.width, grid.spacing, self._near, grid.blocks, self._starts, self._held, self._held_by,
                self._table, grid.particles,
            ]  # fmt: skip
            grid.launch(mpm_drivers.sum_held, len(self._near), inputs, [self._sums], minimum=4)
            self._known = holding
        self._summed = True
        grid.launch(
            mpm_drivers.move_held_nodes, 64 * len(self._near), [self._near, self._sums], [grid.values]
        )

    def drive(self, grid: Grid, h: float) -> None:
        grid.launch(
            mpm_drivers.move_held_particles,
            len(self._particles),
            [wp.float64(h), self._places.place, self._particle, self._hold, self._table],
            [grid.particles, self._anchor],
        )

    def state(self) -> dict[str, wp.array]:
        return {"anchors": self._anchor}

    def _list(self, grid: Grid) -> None:
        """Find the blocks of the grid that each held particle reaches before the next sort."""
        assert self._places.place is not None
        place = self._places.place.numpy()[self._particles]
        rows = grid.particles[POSITION : POSITION + 3].numpy()[:, place] / np.float32(grid.spacing)
        owner = grid.owners.numpy()[place]
        first = np.floor(rows - 0.5 if grid.width == 3 else rows - 1.0).astype(np.int64).T
        local = first - 4 * grid.coords.numpy()[owner]
        low, high = (local - 1) >> 2, (local + grid.width) >> 2
        neighbors = grid.neighbors.numpy().reshape(-1, 27)
        blocks, entries = [], []
        for o, offset in enumerate(OFFSETS):
            reached = np.flatnonzero(((low <= offset) & (offset <= high)).all(axis=1))
            blocks.append(neighbors[owner[reached], o])
            entries.append(reached)
        block, entry = np.concatenate(blocks), np.concatenate(entries)
        order = np.lexsort((place[entry], block))
        near, starts = np.unique(block[order], return_index=True)
        self._near = grid.set("holds.near", near.astype(np.int32), int)
        self._starts = grid.set("holds.starts", np.append(starts, len(block)).astype(np.int32), int)
        self._held = grid.set("holds.held", place[entry[order]], int)
        self._held_by = grid.set("holds.by", self._hold_of[entry[order]], int)
        self._sums = grid.array("holds.sums", 64 * len(near), wp.vec4)


class Loads:
    """Forces and impulses on particles. Those of a substep act when its particles have moved.

    Raises SolverError for loads on surfaces, which particles do not have.
    """

    def __init__(self, model: Model) -> None:
        particles = model.particles
        assert particles is not None
        density = np.array([material.density for material in particles.materials])
        mass = density[particles.matter] * particles.volumes
        self._loads: list[tuple[Force | Impulse, wp.array, wp.array]] = []
        for load in model.loads:
            if not isinstance(load, Force | Impulse):
                raise SolverError(
                    f"MPM has no {type(load).__name__.lower()} loads: particles have no surface; give forces"
                )
            values = load.forces if isinstance(load, Force) else load.impulses
            change = (values / mass[load.vertices, None]).astype(np.float32)
            self._loads.append(
                (
                    load,
                    wp.array(load.vertices.astype(np.int32), dtype=int, device=model.device),
                    wp.array(change, dtype=wp.vec3, device=model.device),
                )
            )
        self._given: wp.array = wp.zeros(len(self._loads), dtype=int, device="cpu")
        self._places = Places()
        self._time = 0.0

    def plan(self, time: float, dt: float) -> None:
        """What is pushed moves by its own speed."""

    def speed(self) -> float:
        return 0.0

    def begin(self, time: float, h: float) -> None:
        self._time = time

    def apply(self, grid: Grid, h: float) -> None:
        """Nothing happens to nodes."""

    def drive(self, grid: Grid, h: float) -> None:
        shares = [self._share(k, load, h) for k, (load, _, _) in enumerate(self._loads)]
        if not any(shares):
            return
        self._places.follow(grid, "loads")
        for share, (_, particle, change) in zip(shares, self._loads, strict=True):
            if share:
                inputs = [float(share), self._places.place, particle, change]
                grid.launch(mpm_drivers.push_particles, len(particle), inputs, [grid.particles])

    def state(self) -> dict[str, wp.array]:
        return {"given": self._given}

    def _share(self, k: int, load: Force | Impulse, h: float) -> float:
        """Seconds that a force acts in this substep; 1 for an impulse in the substep in which it falls."""
        end = self._time + h
        if isinstance(load, Force):
            return max(0.0, min(end, load.end) - max(self._time, load.start))
        given = self._given.numpy()
        if given[k] or end <= load.time:
            return 0.0
        given[k] = 1
        return 1.0


def corners(points: np.ndarray) -> np.ndarray:
    """[8, 3] of the box around points."""
    low, high = points.min(axis=0).astype(np.float64), points.max(axis=0).astype(np.float64)
    return np.stack(np.meshgrid(*zip(low, high, strict=True), indexing="ij"), axis=-1).reshape(-1, 3)


__all__ = ["Holds", "Loads", "corners", "top_speed"]
