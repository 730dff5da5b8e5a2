"""FEM where nothing moves: the patch test, beams, order in the mesh size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.simulation.conditions import Force, Pressure
from gdpro_sim.simulation.verification.beams import STANDARD_GRAVITY, Beam
from gdpro_sim.simulation.verification.framework import Check, absolute, at_least, at_most, problem, relative
from gdpro_sim.simulation.verification.models import make_model, tet_box, uneven_box
from gdpro_sim.simulation.verification.probe import TIGHT, Probe, order, settled, start, without_locking
from gdpro_sim.simulation.verification.reference import ReferenceFem

AFFINE = np.array([[1.2, 0.1, 0.0], [0.05, 0.9, -0.1], [0.0, 0.2, 1.1]])


@problem(
    "patch",
    title="An affine deformation is an equilibrium of any mesh",
    source="Irons & Razzaque 1972: x = A X at the boundary gives F = A everywhere, no force inside",
)
def patch() -> Iterator[Check]:
    vertices, tets, inside = uneven_box(3, 0.5)
    model = make_model(
        vertices, tets, young=1e5, pinned=~inside, gravity=(0, 0, 0), integrator="quasi-static", **TIGHT
    )
    exact = vertices @ AFFINE.T
    force = np.linalg.norm(Probe(model).forces(exact), axis=1)
    yield at_most(
        "force inside / force at the boundary, 27 uneven cells", 1e-12, force[inside].max() / force.max()
    )
    disturbed = exact.copy()
    disturbed[inside] += 0.01 * np.random.default_rng(1).normal(size=(int(inside.sum()), 3))
    found = settled(model, disturbed)
    yield at_most("solved from a disturbed start: off by", 1e-9, np.abs(found - exact).max(), "m")


def _cantilever(beam: Beam, cells: int) -> dict[str, np.ndarray]:
    """Mesh of `cells` across the section and cubes along, pins, tip vertices."""
    along = round(cells * beam.length / beam.side)
    vertices, tets = tet_box((along, cells, cells), (beam.length, beam.side, beam.side))
    pinned, tip = vertices[:, 0] == 0.0, np.isclose(vertices[:, 0], beam.length)
    return {"vertices": vertices, "tets": tets, "pinned": pinned, "tip": tip}


def _drop(beam: Beam, mesh: dict[str, np.ndarray], tip_load: float = 0.0) -> tuple[float, float]:
    """(reach, drop) of the middle of the tip, m, by the quasi-static solver.

    Under the beam's own weight, or under `tip_load` N on the tip alone.
    """
    tip = np.flatnonzero(mesh["tip"])
    loads = (Force(tip, np.tile([0.0, 0.0, -tip_load / len(tip)], (len(tip), 1))),)
    model = make_model(
        mesh["vertices"],
        mesh["tets"],
        young=beam.young,
        poisson=beam.poisson,
        density=beam.density,
        pinned=mesh["pinned"],
        gravity=(0, 0, 0) if tip_load > 0.0 else (0, 0, -STANDARD_GRAVITY),
        loads=loads if tip_load > 0.0 else (),
        integrator="quasi-static",
        newton_tolerance=1e-6,
        newton_iterations=60,
    )
    x = settled(model)[tip].mean(axis=0)
    return float(x[0]), float(beam.side / 2 - x[2])


def _reference_drop(beam: Beam, mesh: dict[str, np.ndarray], tip_load: float = 0.0) -> tuple[float, float]:
    """The same by the float64 oracle."""
    gravity = 0.0 if tip_load > 0.0 else -STANDARD_GRAVITY
    oracle = ReferenceFem(
        mesh["vertices"],
        mesh["tets"],
        beam.young,
        beam.poisson,
        beam.density,
        mesh["pinned"],
        (0.0, 0.0, gravity),
    )
    load = np.zeros_like(mesh["vertices"])
    load[mesh["tip"], 2] = -tip_load / mesh["tip"].sum()
    x = oracle.equilibrium(load)[mesh["tip"]].mean(axis=0)
    return float(x[0]), float(beam.side / 2 - x[2])


STUBBY = Beam(length=1.0, side=0.2, young=1e7, poisson=0.3, density=1000.0)
"""The cantilever of PHYSICS.md."""

SLIPPING = Beam(length=1.0, side=0.2, young=1e7, poisson=0.0, density=1000.0)
"""The same without lateral contraction: its clamp holds back nothing, as in beam theory."""

SLENDER = Beam(length=1.0, side=0.1, young=2e6, poisson=0.3, density=1000.0)
"""Sags by half of its length."""


def _extrapolated(beam: Beam, cells: list[int], bound: float, tip_load: float = 0.0) -> Iterator[Check]:
    """Sag on ever finer meshes: it grows, and its limit is that of beam theory."""
    theory = beam.tip_deflection(tip_load, beam.length) if tip_load > 0.0 else beam.sag()
    ratios = [_drop(beam, _cantilever(beam, across), tip_load)[1] / theory for across in cells]
    for across, ratio in zip(cells, ratios, strict=True):
        yield at_most(f"nu = {beam.poisson:g}: sag / theory, {across} cells across", 1.0, ratio)
    yield at_least("least growth of that from mesh to mesh", 0.0, np.diff(ratios).min())
    quantity = f"nu = {beam.poisson:g}: sag / theory, locking extrapolated away"
    yield relative(quantity, 1.0, without_locking(cells, ratios), bound)


@problem(
    "cantilever",
    title="A cantilever of 1 x 0.2 x 0.2 m, E = 1e7 Pa, sags a little under its own weight",
    source="Timoshenko: w L^4 / 8 EI + w L^2 / 2 kappa G A; float64 reference with a direct solver",
)
def cantilever() -> Iterator[Check]:
    mesh = _cantilever(STUBBY, 3)
    quantity = f"nu = 0.3: tip sag, {len(mesh['tets'])} tets, reference on the same mesh"
    yield relative(quantity, _reference_drop(STUBBY, mesh)[1], _drop(STUBBY, mesh)[1], 0.01, "m")
    yield from _extrapolated(SLIPPING, [3, 4, 6], 0.02)


@problem(
    "cantilever-fine",
    title="The same on finer meshes, also with nu = 0.3, whose clamp stiffens it by holding the width",
    source="Timoshenko, as above",
    slow=True,
)
def cantilever_fine() -> Iterator[Check]:
    yield from _extrapolated(SLIPPING, [4, 6, 8], 0.01)
    yield from _extrapolated(STUBBY, [4, 6, 8], 0.04)


@problem(
    "cantilever-tip",
    title="The same cantilever without weight, 100 N at its tip",
    source="Timoshenko: F L^3 / 3 EI + F L / kappa G A; float64 reference with a direct solver",
)
def cantilever_tip() -> Iterator[Check]:
    mesh = _cantilever(STUBBY, 3)
    expected, found = _reference_drop(STUBBY, mesh, 100.0)[1], _drop(STUBBY, mesh, 100.0)[1]
    quantity = f"nu = 0.3: tip deflection, {len(mesh['tets'])} tets, reference on the same mesh"
    yield relative(quantity, expected, found, 0.01, "m")
    yield from _extrapolated(SLIPPING, [3, 4, 6], 0.02, tip_load=100.0)


@problem(
    "pressure",
    title="A cube under pressure from all sides shrinks evenly",
    source="small strains: dV / V = -p / K, K = E / 3 (1 - 2 nu), whatever the mesh",
)
def pressure() -> Iterator[Check]:
    vertices, tets, _ = uneven_box(3, 0.5)
    for poisson in (0.0, 0.3, 0.45):
        young, amount = 1e6, 1.0
        model = make_model(
            vertices,
            tets,
            young=young,
            poisson=poisson,
            gravity=(0, 0, 0),
            loads=(Pressure(boundary(tets)[0], amount, closed=True),),
            integrator="quasi-static",
            newton_tolerance=1e-12,
            cg_tolerance=1e-8,
        )
        corners = settled(model)[tets]
        volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6.0
        expected = -amount * 3.0 * (1.0 - 2.0 * poisson) / young
        yield relative(f"nu = {poisson:g}: dV / V", expected, volume / 0.125 - 1.0, 1e-4)


@problem(
    "elastica",
    title="A cantilever of 1 x 0.1 x 0.1 m, E = 2e6 Pa, sags by half its length under its own weight",
    source="the heavy elastica EI theta'' = -w (L - s) cos theta, solved with scipy's solve_bvp (Rohde 1953)",
)
def elastica() -> Iterator[Check]:
    cells, drops, reaches = [2, 3, 4], [], []
    for across in cells:
        mesh = _cantilever(SLENDER, across)
        reach, drop = _drop(SLENDER, mesh)
        drops.append(drop)
        reaches.append(reach)
        if across == 2:
            expected = _reference_drop(SLENDER, mesh)
            at = f"{len(mesh['tets'])} tets, reference on the same mesh"
            yield relative(f"drop of the tip, {at}", expected[1], drop, 0.01, "m")
            yield relative(f"reach of the tip, {at}", expected[0], reach, 0.01, "m")
    reach, drop = SLENDER.elastica()
    at = "2, 3 and 4 cells across, locking extrapolated away"
    yield relative(f"drop of the tip, {at}", drop, without_locking(cells, drops), 0.03, "m")
    # The reach falls short by the square of the slope.
    short = without_locking(cells, list(np.sqrt(SLENDER.length - np.array(reaches)))) ** 2
    yield relative(f"reach of the tip, {at}", reach, SLENDER.length - short, 0.03, "m")


@problem(
    "torsion",
    title="A bar of 1 x 0.2 x 0.2 m twisted by 0.05 rad",
    source="Saint-Venant: T = 0.1406 G h^4 theta / L (Timoshenko & Goodier, section 109); ends cannot warp",
)
def torsion() -> Iterator[Check]:
    angle, cells, torques = 0.05, [4, 6, 8], []
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    for across in cells:
        mesh = _cantilever(STUBBY, across)
        vertices, tip = mesh["vertices"], mesh["tip"]
        model = make_model(
            vertices,
            mesh["tets"],
            young=STUBBY.young,
            poisson=STUBBY.poisson,
            pinned=mesh["pinned"] | tip,
            gravity=(0, 0, 0),
            integrator="quasi-static",
            **TIGHT,
        )
        middle = np.array([0.0, 0.1, 0.1])
        twisted = vertices - middle
        share = vertices[:, :1] / STUBBY.length
        twisted[:, 1:] += share * (twisted[:, 1:] @ turn.T - twisted[:, 1:])
        x = settled(model, twisted + middle)
        force = Probe(model).forces(x)[tip]
        torques.append(float(np.cross(x[tip] - middle, force)[:, 0].sum()))
    expected = STUBBY.torque(angle)
    for across, torque in zip(cells, torques, strict=True):
        yield at_least(f"torque / theory, {across} cells across", 1.0, torque / expected)
    yield at_most("fall of that from 6 to 8 cells", 0.0, (torques[2] - torques[1]) / expected)
    limit = 1.0 / without_locking(cells, [1.0 / torque for torque in torques])
    yield relative("torque, extrapolated", expected, limit, 0.03, "N m")


@problem(
    "static-dt",
    title="Where a damped cantilever comes to rest does not depend on the step length",
    source="equilibrium has no time in it: quasi-static solution of the same mesh",
)
def static_dt() -> Iterator[Check]:
    mesh = _cantilever(STUBBY, 2)
    options: dict[str, Any] = {
        "young": 1e6,
        "pinned": mesh["pinned"],
        "rayleigh_mass": 15.0,
        "substeps": 1,
        "newton_tolerance": 1e-8,
        "cg_tolerance": 1e-6,
    }
    vertices, tets = mesh["vertices"], mesh["tets"]
    rest = settled(make_model(vertices, tets, **{**options, "integrator": "quasi-static"}))
    yield at_least("sag of the tip", 0.1, (vertices - rest)[mesh["tip"], 2].mean(), "m")
    for dt, steps in ((1 / 60, 240), (1 / 24, 80), (0.2, 40), (2.0, 15)):
        solver = start(make_model(vertices, tets, **options))
        for _ in range(steps):
            solver.step(dt)
        yield at_most(
            f"off the quasi-static solution after {steps} steps of {dt:.3g} s",
            1e-6,
            np.abs(solver.positions - rest).max(),
            "m",
        )


@problem(
    "order-h",
    title="Displacements converge with the square of the mesh size",
    source="linear elements: O(h^2) in displacements (Strang & Fix 1973); exact: u = grad phi, phi harmonic",
)
def order_h() -> Iterator[Check]:
    # Without body force, u = grad phi with laplace phi = 0 solves linear elasticity; it is small, so that
    # the law is linear there: phi = exp(k x) sin(k y / sqrt 2) sin(k z / sqrt 2).
    k, small = 2.0, 1e-6
    c = k / np.sqrt(2.0)
    sizes, errors = [], []
    for cells in (3, 6, 12):
        vertices, tets = tet_box((cells,) * 3, (1.0,) * 3)
        vertices = vertices.astype(np.float32).astype(np.float64)
        wave, (sy, sz) = np.exp(k * vertices[:, 0]), np.sin(c * vertices[:, 1:]).T
        cy, cz = np.cos(c * vertices[:, 1:]).T
        exact = small * wave[:, None] * np.stack([k * sy * sz, c * cy * sz, c * sy * cz], axis=1)
        edge = np.any((vertices < 1e-6) | (vertices > 1.0 - 1e-6), axis=1)
        model = make_model(
            vertices,
            tets,
            pinned=edge,
            gravity=(0, 0, 0),
            integrator="quasi-static",
            newton_tolerance=1e-13,
            cg_tolerance=1e-8,
        )
        begun = vertices + np.where(edge[:, None], exact, 0.0)
        found = settled(model, begun) - vertices
        sizes.append(1.0 / cells)
        errors.append(float(np.sqrt(np.mean((found - exact)[~edge] ** 2) / np.mean(exact**2))))
    yield at_most("relative error inside, 12^3 cells", 1e-2, errors[-1])
    yield absolute("order, 3^3 to 12^3 cells", 2.0, order(sizes, errors), 0.25)


PROBLEMS = (
    patch,
    cantilever,
    cantilever_fine,
    cantilever_tip,
    pressure,
    elastica,
    torsion,
    static_dt,
    order_h,
)

__all__ = ["PROBLEMS"]
