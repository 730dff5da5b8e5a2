"""Materials of the MPM solver, one particle at a time: closed forms, flow, friction, fracture."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from gdpro_sim.simulation.verification.closed_forms import lame, simple_shear, uniaxial
from gdpro_sim.simulation.verification.framework import Check, absolute, at_most, problem, relative
from gdpro_sim.simulation.verification.mpm_models import Element

ELASTIC = ("stable_neo_hookean", "neo_hookean", "corotated", "stvk_hencky")
YOUNG, POISSON = 1e5, 0.3
SHEARING = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])


def _hencky(h: float, count: int) -> float:
    """Logarithmic strain after `count` substeps of h seconds at a rate of -1/s."""
    return count * math.log1p(-h)


@problem(
    "uniaxial",
    title="A particle stretched freely under every elastic law: stress along and across",
    source="P22 = 0 in closed form, see verification.closed_forms (Smith et al. 2018; Sifakis & Barbic 2012)",
)
def uniaxial_stretch() -> Iterator[Check]:
    for law in ELASTIC:
        element = Element({"young": YOUNG, "poisson": POISSON, "density": 1000.0, "model": law})
        for stretch in (0.7, 1.1, 2.0):
            lateral, pulled = uniaxial(law, stretch, YOUNG, POISSON)
            tau = element.deform(np.diag([stretch, lateral, lateral]))
            found = tau[0, 0] / stretch / YOUNG
            yield absolute(f"{law}: P11 / E at {stretch:g}", pulled / YOUNG, found, 1e-6)
            yield absolute(f"{law}: stress across / E at {stretch:g}", 0.0, tau[1, 1] / YOUNG, 1e-6)
        small = element.deform(np.diag([1.0 + 1e-5, 1.0 - POISSON * 1e-5, 1.0 - POISSON * 1e-5]))
        yield relative(
            f"{law}: stress / (E strain) at a strain of 1e-5", 1.0, small[0, 0] / YOUNG / 1e-5, 1e-4
        )


@problem(
    "shear",
    title="Simple shear under every elastic law",
    source="closed forms, see verification.closed_forms; neo-Hookean: s12 = mu g, s11 = mu g^2 (Ogden 1984)",
)
def shear() -> Iterator[Check]:
    mu = lame(YOUNG, POISSON)[1]
    for law in ELASTIC:
        element = Element({"young": YOUNG, "poisson": POISSON, "density": 1000.0, "model": law})
        for amount in (0.1, 1.0):
            expected = simple_shear(law, amount, mu)
            stress = element.deform(np.eye(3) + amount * SHEARING)
            for name, at in (("s12", (0, 1)), ("s11", (0, 0)), ("s22", (1, 1))):
                quantity = f"{law}: {name} / mu at {amount:g}"
                yield absolute(quantity, expected[at] / mu, stress[at] / mu, 2e-6)


@problem(
    "plasticity",
    title="Von Mises flow: squeezed without room aside, and sheared",
    source="2 mu (e - 3/2 p) = limit + H p, radial return (Simo & Hughes 1998, sec. 3.3); limit / sqrt(3)",
)
def plasticity() -> Iterator[Check]:
    limit, hardening, h = 2e3, 1e4, 1e-3
    lam, mu = lame(YOUNG, POISSON)
    material = {"young": YOUNG, "poisson": POISSON, "density": 1000.0, "yield_stress": limit}
    element = Element({**material, "hardening": hardening})
    for turn in (1, 2, 3):
        tau = element.flow(np.diag([-1.0, 0.0, 0.0]), h, 50)
        strain = _hencky(h, 50 * turn)
        flow = (2.0 * mu * abs(strain) - limit) / (3.0 * mu + hardening)
        difference = (limit + hardening * flow) / limit
        quantity = f"stress difference / limit at a log strain of {strain:.3f}"
        yield relative(quantity, difference, (tau[1, 1] - tau[0, 0]) / limit, 1e-5)
        yield relative(
            "  its mean / limit", (lam + 2 / 3 * mu) * strain / limit, np.trace(tau) / 3 / limit, 1e-5
        )
        yield relative("  plastic strain", flow, element.internal[0], 1e-4)
    tau = Element(material).flow(SHEARING, h, 400)
    yield relative("shear stress / limit at a shear of 0.4", 1.0 / math.sqrt(3.0), tau[0, 1] / limit, 2e-3)


@problem(
    "friction-cone",
    title="Sand squeezed and sheared: friction, cohesion, and nothing in the open",
    source="Drucker & Prager 1952 through triaxial compression: q = 6 sin / (3 - sin) p; Klar et al. 2016",
)
def friction_cone() -> Iterator[Check]:
    for angle in (20.0, 35.0):
        sine = math.sin(math.radians(angle))
        slope = 6.0 * sine / (3.0 - sine)
        material = {
            "model": "drucker_prager",
            "young": YOUNG,
            "poisson": POISSON,
            "density": 1500.0,
            "friction_angle": angle,
        }
        element = Element(material)
        tau = element.flow(-np.eye(3), 1e-3, 10)
        pressure = -np.trace(tau) / 3.0
        tau = element.flow(SHEARING, 1e-3, 300)
        held = -np.trace(tau) / 3.0
        q = math.sqrt(1.5 * float(((tau + held * np.eye(3)) ** 2).sum()))
        yield relative(f"{angle:g} degrees: q / p", slope, q / held, 1e-5)
        yield relative("  pressure under shear / before: no volume is gained", 1.0, held / pressure, 1e-5)
        tau = element.flow(np.eye(3), 1e-3, 40)
        yield at_most("  largest stress in the open", 0.0, np.abs(tau).max(), "Pa")
        tau = element.flow(-np.eye(3), 1e-3, 25)
        yield at_most("  pressure before the volume gained is given back", 0.0, np.abs(tau).max(), "Pa")
        wet = Element({**material, "cohesion": 500.0})
        tau = wet.flow(SHEARING, 1e-3, 300)
        # Of Mohr and Coulomb, on the cone's compressive meridian.
        strength = 6.0 * 500.0 * math.cos(math.radians(angle)) / (math.sqrt(3.0) * (3.0 - sine))
        yield relative("  wet, 500 Pa: shear strength without pressure", strength, tau[0, 1], 1e-3, "Pa")


@problem(
    "viscoplastic",
    title="Paste sheared steadily: stress at three flow indices and two rates",
    source="Herschel & Bulkley 1926: stress = yield + k rate^n",
)
def viscoplastic() -> Iterator[Check]:
    for index in (0.5, 1.0, 1.5):
        for rate, h in ((0.1, 1e-2), (10.0, 1e-4)):
            material = {
                "model": "herschel_bulkley",
                "young": YOUNG,
                "poisson": POISSON,
                "density": 1000.0,
                "yield_stress": 100.0 * math.sqrt(3.0),
                "viscosity": 20.0,
                "flow_index": index,
            }
            tau = Element(material).flow(rate * SHEARING, h, 500 if rate < 1.0 else 2000)
            quantity = f"n = {index:g}: shear stress at {rate:g} / s"
            yield relative(quantity, 100.0 + 20.0 * rate**index, tau[0, 1], 3e-3, "Pa")


@problem(
    "fluid",
    title="A fluid squeezed, sheared and drawn apart",
    source="p = K / 7 (J^-7 - 1) (Monaghan 1994); Newton: stress = viscosity * rate",
)
def fluid() -> Iterator[Check]:
    element = Element({"model": "fluid", "bulk_modulus": YOUNG, "density": 1000.0, "viscosity": 2.0})
    tau = element.flow(-np.eye(3), 1e-3, 10)
    J = math.exp(3.0 * _hencky(1e-3, 10))
    expected = YOUNG / 7.0 * (J**-7 - 1.0)
    # The stress of the squeezing itself is viscous: 2 mu (D - tr D / 3) is nothing here.
    yield relative("pressure / K", expected / YOUNG, -tau[0, 0] / J / YOUNG, 1e-5)
    tau = element.flow(5.0 * SHEARING, 1e-3)
    yield relative("shear stress at 5 / s", 10.0, tau[0, 1] / J, 1e-4, "Pa")
    tau = element.flow(np.eye(3), 1e-3, 30)
    yield absolute("pressure in the open", 0.0, np.trace(tau) / 3.0, 1e-3, "Pa")


@problem(
    "snow",
    title="Snow packed past its critical compression",
    source="Stomakhin et al. 2013, eq. 1-2: s = 1 - theta_c, Lame parameters x exp(xi (1 - J_p))",
)
def snow() -> Iterator[Check]:
    lam, mu = lame(1.4e5, 0.2)
    element = Element({"model": "snow", "young": 1.4e5, "poisson": 0.2, "density": 400.0})
    s = 1.0 - element.material.critical_compression
    for turn in (1, 2):
        tau = element.flow(-np.eye(3), 1e-3, 60)
        packed = math.exp(3.0 * _hencky(1e-3, 60 * turn)) / s**3
        stress = math.exp(10.0 * (1.0 - packed)) * (2.0 * mu * s * (s - 1.0) + lam * s**3 * (s**3 - 1.0))
        yield relative(f"pressure at J_p = {packed:.3f}", -stress, -tau[0, 0], 1e-4, "Pa")
        yield absolute("  J_p", packed, element.internal[0] + 1.0, 1e-4)


@problem(
    "tearing",
    title="A particle pulled until it tears: largest stress, and energy spent",
    source="Bazant & Oh 1983: the fracture energy is spent over a band, here of two particles",
)
def tearing() -> Iterator[Check]:
    strength, energy, size = 1e4, 5.0, 1e-2
    material = {
        "young": 1e6,
        "poisson": 0.0,
        "density": 1000.0,
        "model": "stvk_hencky",
        "tensile_strength": strength,
        "fracture_energy": energy,
    }
    element = Element(material, size**3)
    work, peak, length = 0.0, 0.0, 1.0
    for _ in range(4000):
        tau = element.flow(np.diag([1.0, 0.0, 0.0]), 1e-4)[0, 0]
        work += tau / length * 1e-4 * length
        length *= 1.0 + 1e-4
        peak = max(peak, tau / length)
    yield relative("largest stress / strength", 1.0, peak / strength, 2e-2)
    yield relative("work over two particles' length / fracture energy", 1.0, 2.0 * size * work / energy, 0.15)
    yield relative("damage", 1.0, element.internal[2], 1e-3)


PROBLEMS = (uniaxial_stretch, shear, plasticity, friction_cone, viscoplastic, fluid, snow, tearing)

__all__ = ["PROBLEMS"]
