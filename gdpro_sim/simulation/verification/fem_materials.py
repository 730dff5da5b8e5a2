"""Materials of the FEM solver: closed forms of every law, plastic flow, nearly incompressible bodies."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.optimize import brentq

from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.verification.beams import Beam
from gdpro_sim.simulation.verification.closed_forms import lame, plastic_uniaxial, simple_shear, uniaxial
from gdpro_sim.simulation.verification.framework import Check, absolute, at_least, problem, relative
from gdpro_sim.simulation.verification.models import make_model, tet_box, uneven_box
from gdpro_sim.simulation.verification.probe import TIGHT, Probe, settled

POISSON = float(np.float32(0.3))
"""As a model stores it."""

YOUNG = 1e5


class _Bar:
    """A block of 1 m^3 that is stretched along x and free to narrow: its faces carry no force."""

    def __init__(self, **material: float | str) -> None:
        self.vertices, tets = tet_box((2, 2, 2), (1.0, 1.0, 1.0))
        self._probe = Probe(make_model(self.vertices, tets, young=YOUNG, poisson=0.3, **material))  # type: ignore[arg-type]
        self._right, self._back = self.vertices[:, 0] == 1.0, self.vertices[:, 1] == 1.0

    def stretched(self, stretch: float) -> tuple[float, float]:
        """(lateral stretch, axial first Piola stress, Pa)."""

        def forces(lateral: float) -> np.ndarray:
            return self._probe.forces(self.vertices * [stretch, lateral, lateral])

        found = brentq(lambda s: float(forces(s)[self._back, 1].sum()), 0.5, 1.5, xtol=1e-14)
        return found, float(forces(found)[self._right, 0].sum())


@problem(
    "uniaxial",
    title="A bar stretched freely under every law: lateral stretch and nominal stress",
    source="P22 = 0 in closed form, see verification.closed_forms (Smith et al. 2018; Sifakis & Barbic 2012)",
)
def uniaxial_stretch() -> Iterator[Check]:
    for law in LAWS:
        bar = _Bar(law=law)
        for stretch in (0.7, 1.1, 2.0):
            lateral, stress = bar.stretched(stretch)
            expected, pulled = uniaxial(law, stretch, YOUNG, POISSON)
            yield absolute(f"{law}: lateral stretch at {stretch:g}", expected, lateral, 1e-9)
            yield absolute(f"{law}: P11 / E at {stretch:g}", pulled / YOUNG, stress / YOUNG, 1e-9)


@problem(
    "shear",
    title="Simple shear under every law: Cauchy stress from the reactions of a solved block",
    source="closed forms, see verification.closed_forms; neo-Hookean: s12 = mu g, s11 = mu g^2 (Ogden 1984)",
)
def shear() -> Iterator[Check]:
    mu = lame(YOUNG, POISSON)[1]
    vertices, tets, inside = uneven_box(3, 1.0)
    for law in LAWS:
        model = make_model(
            vertices,
            tets,
            young=YOUNG,
            law=law,
            pinned=~inside,
            gravity=(0, 0, 0),
            integrator="quasi-static",
            **TIGHT,
        )
        probe = Probe(model)
        for amount in (0.1, 1.0):
            F = np.array([[1.0, amount, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
            # The virial: the integral of the first Piola stress over the block of 1 m^3.
            stress = probe.forces(settled(model, vertices @ F.T)).T @ vertices
            if law != "linear":
                stress = stress @ F.T
            expected = simple_shear(law, amount, mu)
            for name, at in (("s12", (0, 1)), ("s22", (1, 1))):
                quantity = f"{law}: {name} / mu at {amount:g}"
                yield absolute(quantity, expected[at] / mu, stress[at] / mu, 1e-8)


@problem(
    "plasticity",
    title="A Hencky bar stretched past its yield stress: von Mises flow with linear hardening",
    source="log strain = tau / E + (tau - limit) / H, isochoric flow (Simo & Hughes 1998, sec. 1.2)",
)
def plasticity() -> Iterator[Check]:
    limit, hardening = 2e3, 1e4
    bar = _Bar(law="stvk_hencky", yield_stress=limit, hardening=hardening)
    for stretch in (1.05, 1.2, 1.5):
        lateral, stress = bar.stretched(stretch)
        expected, pulled = plastic_uniaxial(stretch, YOUNG, POISSON, limit, hardening)
        yield absolute(f"lateral stretch at {stretch:g}", expected, lateral, 1e-9)
        yield absolute(f"P11 / limit at {stretch:g}", pulled / limit, stress / limit, 1e-8)


@problem(
    "locking",
    title="A cantilever of 1 x 0.2 x 0.2 m bends alike whether it is compressible or not",
    source="Timoshenko: sag(nu = 0.499) / sag(nu = 0.3); averaged nodal volumes (Bonet & Burton 1998)",
)
def locking() -> Iterator[Check]:
    vertices, tets = tet_box((20, 4, 4), (1.0, 0.2, 0.2))
    tip = np.isclose(vertices[:, 0], 1.0)

    def sag(poisson: float, volumes: str) -> float:
        model = make_model(
            vertices,
            tets,
            young=1e7,
            poisson=poisson,
            pinned=vertices[:, 0] == 0.0,
            integrator="quasi-static",
            newton_tolerance=1e-6,
            volumes=volumes,
        )
        return float((vertices - settled(model))[tip, 2].mean())

    theory = Beam(1.0, 0.2, 1e7, 0.499, 1000.0).sag() / Beam(1.0, 0.2, 1e7, 0.3, 1000.0).sag()
    compressible, own = sag(0.3, "auto"), sag(0.499, "element")
    quantity = f"sag at 0.499 / at 0.3, {len(tets)} tets, averaged volumes"
    yield relative(quantity, theory, sag(0.499, "auto") / compressible, 0.15)
    yield at_least("what averaging is for: ratio without it falls short by", 0.3, theory - own / compressible)


PROBLEMS = (uniaxial_stretch, shear, plasticity, locking)

__all__ = ["PROBLEMS"]
