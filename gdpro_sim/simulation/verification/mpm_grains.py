"""Sand under MPM, and friction: columns that collapse, slopes that stand or slide, a block on an incline."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.verification.framework import (
    Check,
    at_least,
    at_most,
    problem,
    relative,
)
from gdpro_sim.simulation.verification.mpm_models import (
    Points,
    between_walls,
    box,
    make_model,
    sheet,
    total_energy,
)

GRAVITY = 9.81


def _plane_angle(triaxial: float) -> float:
    """Friction angle, degrees, that sand of that angle in triaxial compression has in plane strain.

    Where it flows without change of volume the middle stress is the mean of the others, so that
    sin = 2 sqrt(3) sin / (3 - sin).
    """
    sine = math.sin(math.radians(triaxial))
    return math.degrees(math.asin(2.0 * math.sqrt(3.0) * sine / (3.0 - sine)))


ANGLE = 22.0
"""Of the sand here in triaxial compression, degrees; 29.6 in plane strain."""


def _sand(points: Points, dx: float) -> SolverMPM:
    """On a rough floor, against a smooth wall on the left, between smooth walls."""
    material = {
        "model": "drucker_prager",
        "young": 1e5,
        "poisson": 0.3,
        "density": 1500.0,
        "friction_angle": ANGLE,
    }
    return SolverMPM(
        make_model(
            points,
            material,
            dx=dx,
            gravity=(0.0, 0.0, -GRAVITY),
            ground=Ground(boundary="sticky"),
            domain=between_walls(dx, 0.0),
        )
    )


def _column(aspect: float) -> tuple[float, float, float, float]:
    """(run-out, height at the wall, both / width; fastest particle m/s; largest rise of energy / energy)."""
    width, cells = 0.1, 8
    dx = width / cells
    solver = _sand(sheet(width, aspect * width, dx), dx)
    energies = [total_energy(solver)]
    for _ in range(10):
        solver.step((3.3 * math.sqrt(aspect * width / GRAVITY) + 0.1) / 10)
        energies.append(total_energy(solver))
    x = solver.positions
    # A grain or two run ahead of the rest.
    front = float(np.quantile(x[:, 0], 0.995)) + 0.25 * dx
    height = float(x[x[:, 0] < dx, 2].max()) + 0.25 * dx
    rise = float(np.diff(energies).max() / energies[0])
    return front / width - 1.0, height / width, float(np.abs(solver.velocities).max()), rise


def _collapse(aspects: tuple[float, ...]) -> Iterator[Check]:
    for aspect in aspects:
        run_out, height, fastest, rise = _column(aspect)
        expected = 1.2 * aspect if aspect < 3.0 else 1.9 * aspect ** (2.0 / 3.0)
        yield relative(f"a = {aspect:g}: run-out / width", expected, run_out, 0.4)
        expected = aspect if aspect < 1.15 else aspect**0.4
        yield relative("  height / width", expected, height, 0.2 if aspect < 3.0 else 0.45)
        yield at_most("  fastest particle at the end / that of the fall", 0.1, fastest / math.sqrt(aspect))
        yield at_most("  largest rise of energy / energy", 1e-3, rise)


@problem(
    "sand-columns",
    title="Columns of sand collapse on a rough floor: how far, and what height stands",
    source="Lajeunesse et al. 2005; Lube et al. 2005: 1.2 a, 1.9 a^2/3 past 3; height a^0.4",
)
def sand_columns() -> Iterator[Check]:
    yield from _collapse((1.0, 2.0))


@problem(
    "sand-columns-tall",
    title="The same, four and eight times as high as wide",
    source="Lajeunesse et al. 2005; Lube et al. 2005: 1.9 a^2/3; height a^0.4",
    slow=True,
)
def sand_columns_tall() -> Iterator[Check]:
    yield from _collapse((4.0, 8.0))


def _slope(angle: float, cells: int) -> tuple[float, float]:
    """(mean way of a particle / base, slope in the end in degrees) of a heap that begins with a slope."""
    base = 0.2
    dx, height = base / cells, base * math.tan(math.radians(angle))
    points = sheet(base, height, dx)
    points = points.where(points.positions[:, 2] < height * (1.0 - points.positions[:, 0] / base))
    solver = _sand(points, dx)
    solver.step(0.6)
    x = solver.positions
    moved = float(np.linalg.norm(x - points.positions, axis=1).mean()) / base
    column = (x[:, 0] / dx).astype(int)
    tops = np.array([x[column == k, 2].max(initial=0.0) for k in range(column.max() + 1)])
    places = (np.arange(len(tops)) + 0.5) * dx
    flank = (tops > 0.15 * tops.max()) & (tops < 0.85 * tops.max())
    return moved, math.degrees(math.atan(-np.polyfit(places[flank], tops[flank], 1)[0]))


@problem(
    "repose",
    title="A heap less steep than its angle of friction stands, a steeper one slides until it is less steep",
    source="Mohr & Coulomb; in plane strain sin = 2 sqrt(3) sin / (3 - sin) of triaxial sin: 29.6 for 22",
)
def repose() -> Iterator[Check]:
    limit = _plane_angle(ANGLE)
    for angle in (20.0, 26.0):
        moved, left = _slope(angle, 12)
        yield at_most(f"from {angle:g} degrees: mean way / base", 1e-2, moved)
        yield relative("  slope in the end", angle, left, 0.08, "degrees")
    moved, left = _slope(42.0, 12)
    yield at_least("from 42 degrees: mean way / base", 5e-2, moved)
    yield at_most("  slope in the end", limit, left, "degrees")
    yield at_least("  slope in the end", 0.6 * limit, left, "degrees")


@problem(
    "incline",
    title="A block on an incline sticks below the angle of friction and slides above it",
    source="Coulomb: tan = mu; x = g (sin - mu cos) t^2 / 2",
)
def incline() -> Iterator[Check]:
    friction, duration, dx = 0.5, 0.4, 0.05
    points = box((0.2, 0.2, 0.1), 0.5 * dx)
    material = {
        "young": 1e6,
        "poisson": 0.3,
        "density": 1000.0,
        "friction": friction,
        "rayleigh_stiffness": 1e-3,
    }
    for angle in (26.0, 30.0, 35.0):
        sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
        gravity = (GRAVITY * sine, 0.0, -GRAVITY * cosine)
        solver = SolverMPM(make_model(points, material, dx=dx, gravity=gravity, ground=Ground()))
        solver.step(duration)
        way = float((solver.positions - points.positions)[:, 0].mean())
        if angle < math.degrees(math.atan(friction)):
            yield at_most(f"{angle:g} degrees: way in {duration:g} s", 2e-3, way, "m")
            speed = float(np.abs(solver.velocities.mean(axis=0)).max())
            yield at_most("  speed then", 1e-3, speed, "m/s")
        else:
            expected = 0.5 * GRAVITY * (sine - friction * cosine) * duration**2
            bound = 3e-2 if angle > 30.0 else 8e-2
            yield relative(f"{angle:g} degrees: way in {duration:g} s", expected, way, bound, "m")


PROBLEMS = (sand_columns, sand_columns_tall, repose, incline)

__all__ = ["PROBLEMS"]
