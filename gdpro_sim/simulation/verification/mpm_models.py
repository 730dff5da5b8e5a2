"""Particles in boxes and discs, and models of them for the MPM problems.

Problems in a plane are one cell thick, two particles deep: between smooth walls of a `domain` one cell apart
strain is plane, without walls stress is.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.device import launch_chunked
from gdpro_sim.kernels import mpm_laws
from gdpro_sim.kernels import particles as rows
from gdpro_sim.materials import Material
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.conditions import Hold, Motion
from gdpro_sim.simulation.model import Ground, Model, MpmSettings, Particles
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.mpm.matter import Matter

Triple = tuple[float, float, float]


@dataclass(frozen=True)
class Points:
    """Particles before they are of any matter: positions [N, 3] float64 m, volumes [N] m^3."""

    positions: np.ndarray
    volumes: np.ndarray

    def __len__(self) -> int:
        return len(self.positions)

    def where(self, kept: np.ndarray) -> Points:
        """Those of a mask [N]."""
        return Points(self.positions[kept], self.volumes[kept])

    def moved(self, way: Sequence[float]) -> Points:
        return Points(self.positions + np.asarray(way), self.volumes)


def lattice(size: Triple, counts: tuple[int, int, int], origin: Triple = (0.0, 0.0, 0.0)) -> Points:
    """A box of `size` m at `origin`, `counts` particles along each axis in the middles of equal cells."""
    axes = [(np.arange(n) + 0.5) * s / n + o for s, n, o in zip(size, counts, origin, strict=True)]
    positions = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    return Points(positions, np.full(len(positions), float(np.prod(size)) / len(positions)))


def box(size: Triple, spacing: float, origin: Triple = (0.0, 0.0, 0.0)) -> Points:
    """The same, particles as near `spacing` m apart as fits."""
    x, y, z = (max(1, round(s / spacing)) for s in size)
    return lattice(size, (x, y, z), origin)


def sheet(width: float, height: float, dx: float) -> Points:
    """A rectangle from the origin along x and z that fills 0 < y < `dx`, 8 particles a cell."""
    return box((width, dx, height), 0.5 * dx)


def disc(radius: float, dx: float, layers: int = 2) -> Points:
    """A disc of one cell's thickness around the origin, in the plane of x and y; its volume is exact."""
    n = round(4.0 * radius / dx)
    square = lattice((2 * radius, 2 * radius, dx), (n, n, layers), (-radius, -radius, -dx / 2))
    found = square.where(np.hypot(*square.positions.T[:2]) <= radius)
    return Points(found.positions, np.full(len(found), np.pi * radius**2 * dx / len(found)))


def join(*parts: Points) -> Points:
    return Points(
        np.concatenate([part.positions for part in parts]), np.concatenate([part.volumes for part in parts])
    )


def jittered(points: Points, amount: float, seed: int = 0) -> Points:
    """Every particle off its place by up to `amount` m along each axis."""
    off = np.random.default_rng(seed).uniform(-amount, amount, points.positions.shape)
    return Points(points.positions + off, points.volumes)


def make_model(
    points: Points,
    material: Material | dict[str, Any] | Sequence[Material],
    *,
    dx: float,
    velocities: np.ndarray | None = None,
    gradients: np.ndarray | None = None,
    matter: np.ndarray | None = None,
    gravity: Triple = (0.0, 0.0, 0.0),
    ground: Ground | None = None,
    colliders: tuple[Collider, ...] = (),
    holds: tuple[Hold, ...] = (),
    **settings: Any,
) -> Model:
    """A model of particles without bodies (they only matter to the surface); no gravity unless it is given.

    material: one for all, or several and `matter` [N] says which; gradients: of the velocities, [3, 3] or
    [N, 3, 3] 1/s; `settings` are those of `MpmSettings`
    """
    if isinstance(material, dict):
        material = Material(**material)
    materials = (material,) if isinstance(material, Material) else tuple(material)
    count = len(points)
    particles = Particles(
        points.positions.astype(np.float32),
        np.zeros((count, 3), np.float32) if velocities is None else velocities.astype(np.float32),
        points.volumes.astype(np.float32),
        np.zeros(count, np.int32) if matter is None else matter.astype(np.int32),
        materials,
        float(np.cbrt(points.volumes.mean())),
        None if gradients is None else np.broadcast_to(gradients, (count, 3, 3)).astype(np.float32),
    )
    return Model.without_tets(
        particles,
        gravity=gravity,
        ground=ground,
        colliders=colliders,
        holds=holds,
        mpm=MpmSettings(grid_spacing=dx, **settings),
    )


def between_walls(dx: float, left: float = -1e3, right: float = 1e3) -> tuple[Triple, Triple]:
    """The `domain` that keeps a `sheet` plane, open above and below; m."""
    return (left, 0.0, -1e3), (right, dx, 1e3)


def plate(height: float, *, up: bool, speed: float = 0.0, **options: Any) -> Collider:
    """Solid below z = `height` (`up`) or above it; moves along z at `speed` m/s."""
    motion = None
    if speed:
        path = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 1e3 * speed]])
        motion = Motion(np.zeros(0, np.int32), np.zeros(3), np.array([0.0, 1e3]), path, np.zeros((2, 3)))
    turn = np.eye(3) if up else np.diag([1.0, -1.0, -1.0])
    place = np.array([0.0, 0.0, height])
    return Collider("plate", "plane", position=place, rotation=turn, motion=motion, **options)


def spinning(points: Points, rate: Triple) -> np.ndarray:
    """Velocities [N, 3] m/s of a rigid turn about the centre at `rate` rad/s."""
    centre = np.average(points.positions, axis=0, weights=points.volumes)
    return np.cross(rate, points.positions - centre)


def mechanical_energy(solver: SolverMPM) -> float:
    """Kinetic and elastic, J."""
    d = solver.diagnostics()
    return d.kinetic_energy + d.elastic_energy


def total_energy(solver: SolverMPM) -> float:
    """The same and that of gravity, J."""
    return mechanical_energy(solver) + solver.diagnostics().gravity_energy


def field(solver: SolverMPM, row: int, count: int = 1) -> np.ndarray:
    """[N, count] float64 numbers of the particles in the model's order; see `gdpro_sim.kernels.particles`."""
    return solver.grid.rows(row, count).astype(np.float64)


def cauchy_stress(solver: SolverMPM) -> np.ndarray:
    """[N, 3, 3] Pa."""
    xx, yy, zz, xy, xz, yz = field(solver, rows.STRESS, 6).T
    tau = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)
    volume = field(solver, rows.VOLUME)[:, 0] * np.linalg.det(solver.deformations.astype(np.float64))
    return tau / volume[:, None, None]


class Element:
    """One particle of a material that is strained as we please, without a grid; float64 in, laws in float32.

    F: [3, 3] elastic deformation gradient; volume: m^3 at rest
    """

    def __init__(self, material: Material | dict[str, Any], volume: float = 1.0) -> None:
        if isinstance(material, dict):
            material = Material(**material)
        self.material, self.volume = material, volume
        self._matter = Matter((material,), "cpu")
        self._kind: wp.array = wp.zeros(1, dtype=int, device="cpu")
        fields = np.zeros((rows.ROWS, 1), np.float32)
        fields[rows.VOLUME], fields[rows.MASS] = volume, volume * material.density
        fields[rows.INTERNAL : rows.INTERNAL + 4] = self._matter.internal(np.zeros(1, np.int32))
        self._fields: wp.array = wp.array(fields, dtype=float, device="cpu")
        self._set(np.eye(3), np.zeros((3, 3)), 0.0)

    def _set(self, F: np.ndarray, gradient: np.ndarray, h: float) -> None:
        fields = self._fields.numpy()
        high = F.reshape(9).astype(np.float32)
        fields[rows.DEFORMATION : rows.DEFORMATION + 9, 0] = high
        fields[rows.DEFORMATION_LOW : rows.DEFORMATION_LOW + 9, 0] = F.reshape(9) - high
        fields[rows.AFFINE : rows.AFFINE + 9, 0] = gradient.reshape(9)
        launch_chunked(
            mpm_laws.update_stress,
            mpm_laws.groups(1, "cpu"),
            [h, self._kind, self._matter.table],
            [self._fields],
            device="cpu",
        )

    def _numbers(self, row: int, count: int) -> np.ndarray:
        return self._fields.numpy()[row : row + count, 0].astype(np.float64)

    @property
    def F(self) -> np.ndarray:
        low = self._numbers(rows.DEFORMATION_LOW, 9)
        return (self._numbers(rows.DEFORMATION, 9) + low).reshape(3, 3)

    @property
    def internal(self) -> np.ndarray:
        """[4], see `gdpro_sim.kernels.mpm_laws`."""
        return self._numbers(rows.INTERNAL, 4)

    @property
    def kirchhoff(self) -> np.ndarray:
        """[3, 3] Pa."""
        xx, yy, zz, xy, xz, yz = self._numbers(rows.STRESS, 6) / self.volume
        return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])

    def deform(self, F: np.ndarray) -> np.ndarray:
        """Kirchhoff stress, Pa, at an elastic deformation gradient [3, 3]."""
        self._set(np.asarray(F, np.float64), np.zeros((3, 3)), 0.0)
        return self.kirchhoff

    def flow(self, gradient: np.ndarray, h: float, count: int = 1) -> np.ndarray:
        """Kirchhoff stress, Pa, after `count` substeps of h seconds with a velocity gradient [3, 3] 1/s."""
        move = np.eye(3) + h * gradient
        for _ in range(count):
            self._set(move @ self.F, gradient, h)
        return self.kirchhoff
