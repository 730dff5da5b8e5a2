"""Boundary conditions and loads of a compiled scene: constant arrays, SI units, world space.

Vertex ids and triangles are those of `Model.vertices`; triangles are outward boundary triangles of the tets.
In a model of particles the ids of forces and impulses are those of its particles.
Loads act from `start` to `end` in s; a step takes the share of it that they act.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SolverError

FOREVER = math.inf

SAMPLES = 60
"""Times at which a function is looked at to see where it goes."""


@dataclass(frozen=True)
class Motion:
    """Pinned vertices that move as one rigid body: turned about `pivot`, then shifted.

    vertices:     [n] int32
    pivot:        [3] m
    times:        [K] s, ascending from 0
    translations: [K, 3] m, from where they start; linear in between
    rotations:    [K, 3] rad, rotation vectors: about one axis in between where two have one axis, which may
                  be more than a full turn, else along the shortest way; the first of both are 0
    function:     in place of the keyframes, where there is one: time in s -> translation [3] m and rotation
    """

    vertices: np.ndarray
    pivot: np.ndarray
    times: np.ndarray
    translations: np.ndarray
    rotations: np.ndarray
    function: Callable[[float], tuple[np.ndarray, Rotation]] | None = None

    def sampled(self, duration: float) -> list[float]:
        """Times in s that show where it goes within `duration` s: keyframes; many, until a function fails."""
        if self.function is None:
            return [float(time) for time in self.times]
        times: list[float] = []
        for time in np.linspace(0.0, duration, SAMPLES).tolist():
            try:
                self.function(time)
            except SolverError:  # the run will say it when it comes there
                break
            times.append(time)
        return times

    def at(self, time: float) -> tuple[np.ndarray, Rotation]:
        """Translation [3] m and rotation at a time in s."""
        if self.function is not None:
            return self.function(time)
        times = self.times
        k = int(np.clip(np.searchsorted(times, time, side="right") - 1, 0, len(times) - 1))
        shift, turn = self.translations[k], Rotation.from_rotvec(self.rotations[k])
        if k + 1 < len(times):
            share = (time - times[k]) / (times[k + 1] - times[k])
            shift = (1.0 - share) * shift + share * self.translations[k + 1]
            a, b = self.rotations[k], self.rotations[k + 1]
            if np.linalg.norm(np.cross(a, b)) <= 1e-9 * np.linalg.norm(a) * np.linalg.norm(b):
                turn = Rotation.from_rotvec((1.0 - share) * a + share * b)
            else:
                way = (Rotation.from_rotvec(b) * turn.inv()).as_rotvec()
                turn = Rotation.from_rotvec(share * way) * turn
        return shift, turn


Pose = tuple[np.ndarray, np.ndarray]
"""Rotation [3, 3] and translation [3] m: x = rotation X + translation of what started at X."""


class Guide:
    """A rigid motion that is told from step to step: another solver moves what follows it.

    Before it is told anything, and outside the time it was told of, it stands still.
    centre: [3] m at the start, of what moves; it goes straight while the rest turns about it
    """

    def __init__(self, centre: np.ndarray) -> None:
        self.centre = centre
        self._times = (0.0, 0.0)
        self._poses: tuple[Pose, Pose] = ((np.eye(3), np.zeros(3)), (np.eye(3), np.zeros(3)))

    def tell(self, start: float, end: float, before: Pose, after: Pose) -> None:
        """From `start` to `end` s it goes from one pose to another, evenly, its turn the shortest way."""
        self._times, self._poses = (start, end), (before, after)

    def pose(self, time: float) -> Pose:
        """Where it is at a time in s."""
        (start, end), ((turn, shift), (turned, shifted)) = self._times, self._poses
        share = float(np.clip((time - start) / (end - start), 0.0, 1.0)) if end > start else 1.0
        way = Rotation.from_matrix(turned @ turn.T).as_rotvec()
        now: np.ndarray = Rotation.from_rotvec(share * way).as_matrix() @ turn
        centre = (1.0 - share) * (turn @ self.centre + shift) + share * (turned @ self.centre + shifted)
        return now, centre - now @ self.centre


def pose_at(motion: Motion | Guide, time: float) -> Pose:
    """Where a motion is at a time in s."""
    if isinstance(motion, Guide):
        return motion.pose(time)
    shift, turn = motion.at(time)
    matrix = turn.as_matrix()
    return matrix, motion.pivot - matrix @ motion.pivot + shift


@dataclass(frozen=True)
class Hold:
    """Particles [n] int32 that are held where they are, or moved along, from `start` to `release` s.

    motion: where they are taken; None: nowhere
    """

    particles: np.ndarray
    motion: Motion | None = None
    start: float = 0.0
    release: float = FOREVER


@dataclass(frozen=True)
class Springs:
    """Springs with dashpots between two ends: weighted corners of an element, plus a point of the world.

    corners:     [S, 2, 4] int32
    weights:     [S, 2, 4] sum to 1; all 0 for an end that is a point of the world
    anchors:     [S, 2, 3] m; 0 for an end on a body
    stiffness:   [S] N/m
    rest_length: [S] m; 0 pulls the ends together
    damping:     [S] N s/m
    """

    corners: np.ndarray
    weights: np.ndarray
    anchors: np.ndarray
    stiffness: np.ndarray
    rest_length: np.ndarray
    damping: np.ndarray


@dataclass(frozen=True)
class Force:
    """Constant forces [n, 3] N on vertices [n]."""

    vertices: np.ndarray
    forces: np.ndarray
    start: float = 0.0
    end: float = FOREVER


@dataclass(frozen=True)
class Impulse:
    """Impulses [n, 3] N s on vertices [n], all in the step that holds `time`."""

    vertices: np.ndarray
    impulses: np.ndarray
    time: float


@dataclass(frozen=True)
class Pressure:
    """Pressure in Pa on triangles [F, 3], inward where positive; `closed` where they enclose a volume."""

    faces: np.ndarray
    pressure: float
    closed: bool
    start: float = 0.0
    end: float = FOREVER


@dataclass(frozen=True)
class Wind:
    """Air of `density` kg/m^3 that moves at `velocity` m/s, on triangles [F, 3] that face it."""

    faces: np.ndarray
    velocity: tuple[float, float, float]
    density: float
    drag: float
    lift: float
    start: float = 0.0
    end: float = FOREVER


Load = Force | Impulse | Pressure | Wind

__all__ = [
    "FOREVER",
    "Force",
    "Guide",
    "Hold",
    "Impulse",
    "Load",
    "Motion",
    "Pose",
    "Pressure",
    "Springs",
    "Wind",
    "pose_at",
]
