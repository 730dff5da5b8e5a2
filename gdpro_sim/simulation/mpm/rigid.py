"""Rigid bodies among particles: what matter gives them, gravity, and planes that they rest on.

Their motion is semi-implicit Euler: velocities first, then positions by the new velocities; angular momentum
is what is kept. They meet planes, the ground and the walls of the domain (points of their surface, without
bounce), but neither other obstacles nor each other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import warp as wp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import SolverError
from gdpro_sim.simulation.colliders import Collider

FRICTION = 0.5
"""Coulomb coefficient of a body and a plane that neither say one."""

SWEEPS = 30
"""Most times that the points of a body that touch planes are gone through in a substep."""

SETTLED = 1e-10
"""Share of the largest impulse; smaller changes in one sweep are enough."""

RIM = 8
"""Points around each end of a cylinder that meet planes."""

POSITION, ROTATION, VELOCITY, MOMENT = slice(0, 3), slice(3, 12), slice(12, 15), slice(15, 18)

Plane = tuple[np.ndarray, np.ndarray, np.ndarray, float | None]
"""Point [3] m, normal [3], velocity [3] m/s, Coulomb coefficient."""


class RigidBodies:
    """Colliders with a mass, their frames' origins at their centres of mass.

    state: [B, 18] float64, on the CPU: centre m, rotation row by row, velocity m/s, angular momentum about
           the centre kg m^2/s
    """

    def __init__(self, colliders: list[Collider], gravity: tuple[float, float, float]) -> None:
        self._gravity = np.asarray(gravity)
        self.mass = np.array([c.mass or 0.0 for c in colliders])
        self._inertia = [_inertia(c) for c in colliders]
        self._friction = [c.friction for c in colliders]
        self._points = [_points(c) for c in colliders]
        self.state: wp.array = wp.zeros((len(colliders), 18), dtype=wp.float64, device="cpu")
        for c, row in zip(colliders, self._rows, strict=True):
            row[POSITION], row[ROTATION], row[VELOCITY] = c.position, c.rotation.ravel(), c.velocity
        for k, c in enumerate(colliders):
            self._rows[k, MOMENT] = self.inertia(k) @ np.asarray(c.angular_velocity)
        self._start = self._rows.copy()
        self._twist = np.zeros((len(colliders), 6))

    @property
    def _rows(self) -> np.ndarray:
        rows: np.ndarray = self.state.numpy()
        return rows

    @property
    def positions(self) -> np.ndarray:
        """[B, 3] m, of the centres of mass."""
        return self._rows[:, POSITION].copy()

    @property
    def velocities(self) -> np.ndarray:
        """[B, 3] m/s, of the centres of mass."""
        return self._rows[:, VELOCITY].copy()

    @property
    def angular_velocities(self) -> np.ndarray:
        """[B, 3] rad/s."""
        return np.array([self._spin(k) for k in range(len(self.mass))]).reshape(-1, 3)

    @property
    def momentum(self) -> np.ndarray:
        """[3] kg m/s, of all."""
        found: np.ndarray = self.mass @ self._rows[:, VELOCITY]
        return found

    @property
    def angular_momentum(self) -> np.ndarray:
        """[3] kg m^2/s about the world's origin, of all."""
        rows = self._rows
        orbit = np.cross(rows[:, POSITION], self.mass[:, None] * rows[:, VELOCITY])
        found: np.ndarray = (orbit + rows[:, MOMENT]).sum(axis=0)
        return found

    @property
    def kinetic_energy(self) -> float:
        """J, of all."""
        rows = self._rows
        turning = sum(float(rows[k, MOMENT] @ self._spin(k)) for k in range(len(rows)))
        return 0.5 * (float(self.mass @ (rows[:, VELOCITY] ** 2).sum(axis=1)) + turning)

    def inertia(self, k: int) -> np.ndarray:
        """[3, 3] kg m^2 about the centre of mass, in the world."""
        turn = self._rows[k, ROTATION].reshape(3, 3)
        found: np.ndarray = turn @ self._inertia[k] @ turn.T
        return found

    def pose(self, k: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and translation since the start: x = R X + t of what started at X."""
        now, start = self._rows[k], self._start[k]
        turn = now[ROTATION].reshape(3, 3) @ start[ROTATION].reshape(3, 3).T
        return turn, now[POSITION] - turn @ start[POSITION]

    def frame(self, k: int) -> np.ndarray:
        """[12] position and rotation."""
        return self._rows[k, :12].copy()

    def motion(self, k: int) -> np.ndarray:
        """[12] velocity, and the matrix that takes a lever to the velocity it adds: after matter is met."""
        return np.concatenate([self._twist[k, :3], _cross_matrix(self._twist[k, 3:]).ravel()])

    def begin(self, h: float) -> None:
        """A substep of `h` s begins: gravity acts."""
        rows = self._rows
        rows[:, VELOCITY] += h * self._gravity
        for k in range(len(rows)):
            self._twist[k, :3], self._twist[k, 3:] = rows[k, VELOCITY], self._spin(k)

    def guess(self, k: int, matrix: np.ndarray, given: np.ndarray) -> bool:
        """Newton's next velocity where matter gives `given` - `matrix` (u, w); whether it has changed."""
        own = np.zeros((6, 6))
        own[:3, :3], own[3:, 3:] = self.mass[k] * np.eye(3), self.inertia(k)
        row = self._rows[k]
        before = np.concatenate([self.mass[k] * row[VELOCITY], row[MOMENT]])
        twist = np.linalg.solve(own + matrix, before + given)
        moved = bool(np.abs(twist - self._twist[k]).max() > 1e-9 * (1e-6 + np.abs(twist).max()))
        self._twist[k] = twist
        return moved

    def take(self, k: int, impulse: np.ndarray) -> None:
        """Take [6] impulse N s and angular impulse N m s."""
        row = self._rows[k]
        row[VELOCITY] += impulse[:3] / self.mass[k]
        row[MOMENT] += impulse[3:]

    def move(self, h: float, planes: list[Plane]) -> None:
        """Meet planes, and move by `h` s."""
        rows = self._rows
        for k in range(len(rows)):
            touching = self._touching(k, h, planes)
            if touching:
                self._rest_on(k, h, touching)
            row = rows[k]
            row[POSITION] += h * row[VELOCITY]
            turned = Rotation.from_rotvec(h * self._spin(k)).as_matrix() @ row[ROTATION].reshape(3, 3)
            row[ROTATION] = _orthonormal(turned).ravel()
            self._lift(k, h, planes)

    def _spin(self, k: int) -> np.ndarray:
        return np.linalg.solve(self.inertia(k), self._rows[k, MOMENT])

    def _levers(self, k: int, normal: np.ndarray) -> np.ndarray:
        """[n, 3] from the centre to the points that may touch a plane first."""
        points, radius = self._points[k]
        levers: np.ndarray = points @ self._rows[k, ROTATION].reshape(3, 3).T - radius * normal
        return levers

    def _touching(self, k: int, h: float, planes: list[Plane]) -> list[tuple[Plane, np.ndarray, float]]:
        """Points that would be in a plane after `h` s: the plane, the lever, the gap in m."""
        row, spin, found = self._rows[k], self._spin(k), []
        for plane in planes:
            point, normal, velocity, _ = plane
            levers = self._levers(k, normal)
            gaps = (levers + row[POSITION] - point) @ normal
            speeds = (row[VELOCITY] + np.cross(spin, levers) - velocity) @ normal
            for i in np.flatnonzero(gaps + h * np.minimum(speeds, 0.0) <= 0.0):
                found.append((plane, levers[i], max(0.0, float(gaps[i]))))
        return found

    def _rest_on(self, k: int, h: float, touching: list[tuple[Plane, np.ndarray, float]]) -> None:
        """Impulses at points, one after the other (projected Gauss-Seidel): none pulls, all rub."""
        row, mass = self._rows[k], self.mass[k]
        inverse = np.linalg.inv(self.inertia(k))
        pressed, rubbed = np.zeros(len(touching)), np.zeros((len(touching), 3))
        answers = []
        for (_point, normal, _velocity, _friction), lever, _gap in touching:
            arm = _cross_matrix(lever)
            answer = np.eye(3) / mass - arm @ inverse @ arm  # velocity of the point for an impulse
            answers.append((arm, normal @ answer @ normal, np.trace(answer) / 3.0))
        for _ in range(SWEEPS):
            changed = 0.0
            for i, ((_point, normal, velocity, friction), _lever, gap) in enumerate(touching):
                arm, soft, softest = answers[i]
                slip = row[VELOCITY] - arm @ (inverse @ row[MOMENT]) - velocity
                press = max(0.0, pressed[i] - (slip @ normal + gap / h) / soft)
                change = (press - pressed[i]) * normal
                changed = max(changed, abs(press - pressed[i]))
                pressed[i] = press
                row[VELOCITY] += change / mass
                row[MOMENT] += arm @ change
                slip = row[VELOCITY] - arm @ (inverse @ row[MOMENT]) - velocity
                across = slip - (slip @ normal) * normal
                rub = rubbed[i] - across / softest
                limit = _coefficient(self._friction[k], friction) * press
                rub *= min(1.0, limit / max(float(np.linalg.norm(rub)), 1e-300))
                change = rub - rubbed[i]
                changed = max(changed, float(np.abs(change).max()))
                rubbed[i] = rub
                row[VELOCITY] += change / mass
                row[MOMENT] += arm @ change
            if changed <= SETTLED * pressed.max():
                break

    def _lift(self, k: int, h: float, planes: list[Plane]) -> None:
        """Out of planes that rounding or turning has brought it into."""
        for point, normal, velocity, _ in planes:
            gap = float(((self._levers(k, normal) + self._rows[k, POSITION] - point) @ normal).min())
            depth = h * float(velocity @ normal) - gap
            if depth > 0.0:
                self._rows[k, POSITION] += depth * normal


def recentred(collider: Collider) -> Collider:
    """With its frame's origin at its centre of mass."""
    if collider.vertices is None or collider.faces is None:
        return collider
    _, centre, _ = _volume_moments(collider.vertices, collider.faces)
    return replace(
        collider,
        vertices=collider.vertices - centre,
        position=collider.position + collider.rotation @ centre,
    )


def _inertia(collider: Collider) -> np.ndarray:
    """[3, 3] kg m^2 of a solid of one density about its centre of mass, in its frame."""
    mass, (a, b, c) = collider.mass or 0.0, collider.size
    if collider.kind == "box":
        return mass / 3.0 * np.diag([b * b + c * c, a * a + c * c, a * a + b * b])
    if collider.kind == "sphere":
        return 0.4 * mass * a * a * np.eye(3)
    if collider.kind == "cylinder":
        side = mass * (a * a / 4.0 + b * b / 3.0)
        return np.diag([side, side, 0.5 * mass * a * a])
    if collider.kind == "capsule":
        rod, ball = 2.0 * b, 4.0 / 3.0 * a
        m_rod, m_ball = mass * rod / (rod + ball), mass * ball / (rod + ball)
        # Two half balls, whose centres of mass lie 3/8 a beyond the rod's ends.
        ends = m_ball * (0.4 * a * a + b * b + 0.75 * a * b)
        side = m_rod * (a * a / 4.0 + b * b / 3.0) + ends
        return np.diag([side, side, 0.5 * m_rod * a * a + 0.4 * m_ball * a * a])
    if collider.vertices is None or collider.faces is None:
        raise SolverError(f"collider {collider.name!r}: a {collider.kind} has no end and cannot have a mass")
    volume, _, second = _volume_moments(collider.vertices, collider.faces)
    return mass / volume * (np.trace(second) * np.eye(3) - second)


def _volume_moments(vertices: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, centre and second moment (integral of x x^T) about the origin of what a mesh encloses."""
    corners = vertices[faces]
    volumes = np.linalg.det(corners) / 6.0  # of tetrahedra to the origin
    sums = corners.sum(axis=1)
    centre = (volumes[:, None] * sums).sum(axis=0) / (4.0 * volumes.sum())
    squares = np.einsum("fci,fcj->fij", corners, corners) + np.einsum("fi,fj->fij", sums, sums)
    return float(volumes.sum()), centre, (volumes[:, None, None] / 20.0 * squares).sum(axis=0)


def _points(collider: Collider) -> tuple[np.ndarray, float]:
    """Balls that stand for the surface where it meets planes: middles [n, 3] m and their radius."""
    a, b, _ = collider.size
    if collider.kind == "sphere":
        return np.zeros((1, 3)), a
    if collider.kind == "capsule":
        return np.array([[0.0, 0.0, -b], [0.0, 0.0, b]]), a
    if collider.kind == "box":
        signs = np.stack(np.meshgrid(*[[-1.0, 1.0]] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
        return signs * np.asarray(collider.size), 0.0
    if collider.kind == "cylinder":
        angles = 2.0 * np.pi * np.arange(RIM) / RIM
        rim = np.stack([a * np.cos(angles), a * np.sin(angles), np.full(RIM, b)], axis=1)
        return np.concatenate([rim, rim * [1.0, 1.0, -1.0]]), 0.0
    assert collider.vertices is not None
    return collider.vertices[ConvexHull(collider.vertices).vertices], 0.0


def _coefficient(a: float | None, b: float | None) -> float:
    if a is None or b is None:
        known = a if b is None else b
        return FRICTION if known is None else known
    return float(np.sqrt(a * b))


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _orthonormal(matrix: np.ndarray) -> np.ndarray:
    """The rotation near a matrix that is almost one."""
    found: np.ndarray = 1.5 * matrix - 0.5 * matrix @ matrix.T @ matrix
    return found


__all__ = ["RigidBodies", "recentred"]
