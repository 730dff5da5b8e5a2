"""Fluids and pastes under MPM: water at rest, a dam that breaks, flow between plates."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gdpro_sim.kernels import particles as rows
from gdpro_sim.simulation.model import Ground
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.verification.framework import (
    Check,
    absolute,
    at_least,
    at_most,
    problem,
    relative,
)
from gdpro_sim.simulation.verification.mpm_models import (
    between_walls,
    cauchy_stress,
    field,
    make_model,
    plate,
    sheet,
    total_energy,
)

GRAVITY = 9.81
DENSITY = 1000.0

# Martin & Moyce 1952, "An experimental study of the collapse of liquid columns on a rigid horizontal plane",
# Phil. Trans. A 244, tables 2 and 6, columns twice as high as wide: T = t sqrt(2 g / a), Z = front / a; and
# t sqrt(g / a), height / 2 a.
FRONT = np.array(
    [
        (0.41, 1.11), (0.84, 1.22), (1.19, 1.44), (1.43, 1.67), (1.63, 1.89), (1.83, 2.11), (1.98, 2.33),
        (2.20, 2.56), (2.32, 2.78), (2.51, 3.00), (2.65, 3.22), (2.83, 3.44), (2.98, 3.67), (3.11, 3.89),
        (3.33, 4.11),
    ]
)  # fmt: skip
HEIGHT = np.array(
    [
        (0.56, 0.94), (0.77, 0.89), (0.93, 0.83), (1.08, 0.78), (1.28, 0.72), (1.46, 0.67), (1.66, 0.61),
        (1.84, 0.56), (2.00, 0.50), (2.21, 0.44),
    ]
)  # fmt: skip


def _water(top_speed: float, sound: float = 8.0, **more: float) -> dict[str, float | str]:
    """Smooth water whose sound is that many times faster than what moves."""
    bulk = DENSITY * (sound * top_speed) ** 2
    return {"model": "fluid", "bulk_modulus": bulk, "density": DENSITY, "friction": 0.0, **more}


@problem(
    "hydrostatic",
    title="Water comes to rest in a tank: pressure over depth",
    source="p = rho g (H - z)",
)
def hydrostatic() -> Iterator[Check]:
    height, width, cells = 1.0, 0.5, 12
    dx = height / cells
    material = _water(math.sqrt(GRAVITY * height), 10.0, rayleigh_mass=60.0)
    model = make_model(
        sheet(width, height, dx),
        material,
        dx=dx,
        gravity=(0.0, 0.0, -GRAVITY),
        ground=Ground(),
        domain=between_walls(dx, 0.0, width),
    )
    solver = SolverMPM(model)
    for _ in range(4):
        solver.step(0.1)
    z = solver.positions[:, 2]
    pressure = -np.trace(cauchy_stress(solver), axis1=1, axis2=2) / 3.0
    weight = DENSITY * GRAVITY * height
    place = np.minimum((z / dx).astype(int), cells - 1)
    top = z.max() + 0.25 * dx
    yield relative("height of the surface", height, top, 1e-2, "m")
    found = np.array([pressure[place == k].mean() for k in range(cells)]) / weight
    expected = np.array([(top - z[place == k]).mean() for k in range(cells)]) / height
    off = np.abs(found - expected)
    yield at_most("cells inside: pressure off by, / rho g H", 3e-2, off[1:-1].max())
    yield at_most("cells at the floor and the surface: off by, / rho g H", 0.15, off[[0, -1]].max())
    slope = -np.polyfit(expected, found, 1)[0]
    yield relative("slope of pressure over depth / (rho g)", 1.0, -slope, 6e-2)
    yield at_most("fastest particle", 2e-2, np.abs(solver.velocities).max(), "m/s")


@problem(
    "sloshing",
    title="A column of water falls over in a tank, one cell thick, and comes to rest: its volume",
    source="conservation of volume",
)
def sloshing() -> Iterator[Check]:
    column, high, tank, dx = 0.2, 0.4, 0.4, 0.025
    model = make_model(
        sheet(column, high, dx),
        _water(math.sqrt(2.0 * GRAVITY * high), 5.0, rayleigh_mass=2.0),
        dx=dx,
        gravity=(0.0, 0.0, -GRAVITY),
        ground=Ground(),
        domain=between_walls(dx, 0.0, tank),
    )
    solver, highest = SolverMPM(model), 0.0
    for _ in range(16):
        solver.step(0.1)
        highest = max(highest, float(solver.positions[:, 2].max()))
    middle = []
    for _ in range(6):
        solver.step(0.1)
        middle.append(float(solver.positions[:, 2].mean()))
    depth = high * column / tank
    yield at_least("highest splash / depth", 1.6, highest / depth)
    volume = 2.0 * float(np.mean(middle)) / depth
    yield relative("volume, from the middle's height, mean of 0.6 s", 1.0, volume, 0.05)


def _dam(cells: int) -> tuple[np.ndarray, np.ndarray, float]:
    """(front / that of the experiment, height - that of the experiment, largest rise of energy / energy)."""
    a = 1.0
    dx = a / cells
    model = make_model(
        sheet(a, 2.0 * a, dx),
        _water(2.0 * math.sqrt(2.0 * GRAVITY * a)),
        dx=dx,
        gravity=(0.0, 0.0, -GRAVITY),
        ground=Ground(),
        domain=between_walls(dx, 0.0),
    )
    solver = SolverMPM(model)
    times, front, height, energies = [0.0], [a], [2.0 * a], [total_energy(solver)]
    while solver.time < FRONT[-1, 0] * math.sqrt(a / (2.0 * GRAVITY)):
        solver.step(0.02)
        x = solver.positions
        times.append(solver.time)
        front.append(x[:, 0].max() + 0.25 * dx)
        height.append(x[x[:, 0] < 0.1 * a, 2].max() + 0.25 * dx)
        energies.append(total_energy(solver))
    t = np.array(times)
    found = np.interp(FRONT[:, 0], t * math.sqrt(2.0 * GRAVITY / a), np.array(front) / a)
    left = np.interp(HEIGHT[:, 0], t * math.sqrt(GRAVITY / a), np.array(height) / (2.0 * a))
    return found / FRONT[:, 1], left - HEIGHT[:, 1], float(np.diff(energies).max() / energies[0])


@problem(
    "dam-break",
    title="A column of water collapses: its front and its height over time",
    source="Martin & Moyce 1952, n^2 = 2, a = b; their gate opens in no time here",
)
def dam_break() -> Iterator[Check]:
    front, height, rise = _dam(8)
    yield absolute("front / measured, mean of 15 times", 1.0, float(front.mean()), 0.15)
    yield at_most("largest front / measured", 1.2, front.max())
    yield at_least("smallest front / measured", 0.93, front.min())
    yield at_most("height / 2 a off by, to half of it, mean", 0.05, np.abs(height).mean())
    yield at_most("largest rise of energy in 0.02 s / energy", 1e-3, rise)


@problem(
    "dam-break-fine",
    title="The same with 20 cells in its width",
    source="Martin & Moyce 1952, n^2 = 2, a = b",
    slow=True,
)
def dam_break_fine() -> Iterator[Check]:
    front, height, rise = _dam(20)
    yield absolute("front / measured, mean of 15 times", 1.0, float(front.mean()), 0.15)
    yield at_most("height / 2 a off by, to half of it, mean", 0.03, np.abs(height).mean())
    yield at_most("largest rise of energy in 0.02 s / energy", 1e-3, rise)


HALF = 0.5
"""Between the plates, m: half their distance."""


class _Channel:
    """4 m of matter between plates it sticks to, pulled along by 1 m/s^2; read in its middle half metre."""

    def __init__(self, material: dict[str, float | str], cells: int) -> None:
        self.dx, self.length = 2.0 * HALF / cells, 4.0
        self.solver = SolverMPM(
            make_model(
                sheet(self.length, 2.0 * HALF, self.dx),
                {**material, "density": DENSITY},
                dx=self.dx,
                gravity=(1.0, 0.0, 0.0),
                ground=Ground(boundary="sticky"),
                colliders=(plate(2.0 * HALF, up=False, boundary="sticky"),),
                domain=between_walls(self.dx),
            )
        )

    def profile(self, duration: float) -> tuple[np.ndarray, np.ndarray]:
        """(way from the middle m, speed m/s) of the particles in the middle, after `duration` s more."""
        self.solver.step(duration)
        x = self.solver.positions
        middle = np.abs(x[:, 0] - x[:, 0].mean()) < 0.25
        return x[middle, 2] - HALF, self.solver.velocities[middle, 0].astype(np.float64)


@problem(
    "poiseuille",
    title="A viscous fluid starts to flow between plates",
    source="u = G / (2 nu) (a^2 - y^2) less its starting series (Batchelor 1967, sec. 4.3)",
)
def poiseuille() -> Iterator[Check]:
    viscosity = 1.0
    fastest = HALF**2 / (2.0 * viscosity)
    channel = _Channel(_water(fastest, 80.0, viscosity=viscosity * DENSITY), 8)
    for duration in (0.0625, 0.0625, 0.375):
        y, u = channel.profile(duration)
        time = channel.solver.time
        expected = (HALF**2 - y**2) / (2.0 * viscosity)
        for k in range(40):
            root = (k + 0.5) * math.pi / HALF
            decay = math.exp(-viscosity * root**2 * time)
            expected -= 2.0 / (viscosity * HALF) * (-1) ** k / root**3 * np.cos(root * y) * decay
        yield relative(f"t = {time:g} s: flow / that of the series", 1.0, u.mean() / expected.mean(), 6e-2)
        rms = math.sqrt(float(((u - expected) ** 2).mean())) / fastest
        yield at_most("  profile off by (rms), / largest speed", 4e-2, rms)


@problem(
    "plug-flow",
    title="A paste flows between plates: an unsheared plug amid sheared layers",
    source="tau = tau_y + k rate; a plug where rho G |y| < tau_y (Bird, Armstrong & Hassager 1987)",
)
def plug_flow() -> Iterator[Check]:
    consistency, share = 1000.0, 0.4
    shear_yield = DENSITY * share * HALF
    material: dict[str, float | str] = {
        "model": "herschel_bulkley",
        "young": 2e5,
        "poisson": 0.3,
        "yield_stress": math.sqrt(3.0) * shear_yield,
        "viscosity": consistency,
        "friction": 0.0,
    }
    channel = _Channel(material, 12)
    y, u = channel.profile(0.6)
    plug = share * HALF
    away = np.maximum(np.abs(y), plug)
    expected = DENSITY / (2.0 * consistency) * (HALF**2 - away**2)
    expected -= shear_yield / consistency * (HALF - away)
    fastest = expected.max()
    inside = np.abs(y) < 0.75 * plug
    yield relative("speed of the plug", fastest, u[inside].mean(), 0.13, "m/s")
    yield at_most("  spread of speed inside it / speed", 2e-2, np.ptp(u[inside]) / fastest)
    rms = math.sqrt(float(((u - expected) ** 2).mean())) / fastest
    yield at_most("profile off by (rms), / speed of the plug", 0.11, rms)
    sheared = field(channel.solver, rows.INTERNAL)[:, 0]
    x = channel.solver.positions
    core = (np.abs(x[:, 0] - x[:, 0].mean()) < 0.25) & (np.abs(x[:, 2] - HALF) < 0.75 * plug)
    rim = (np.abs(x[:, 0] - x[:, 0].mean()) < 0.25) & (np.abs(x[:, 2] - HALF) > 0.8 * HALF)
    yield at_most(
        "plastic strain in the plug / near the plates", 0.05, sheared[core].mean() / sheared[rim].mean()
    )


PROBLEMS = (hydrostatic, sloshing, dam_break, dam_break_fine, poiseuille, plug_flow)

__all__ = ["PROBLEMS"]
