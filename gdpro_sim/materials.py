"""Physical materials: elastic constants, density, friction and damping, with named presets.

A material is part of the asset (generation proposes one) and of the scene (the user may override it), so it
lives beside the asset, above both generation and simulation.
"""

from __future__ import annotations

import difflib
import math
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

ElasticLaw = Literal["stable_neo_hookean", "neo_hookean", "corotated", "stvk_hencky", "linear"]
"""Constitutive laws of bodies that keep their shape; `gdpro_sim.kernels.elasticity` gives their energies."""

FlowLaw = Literal["drucker_prager", "snow", "herschel_bulkley", "fluid"]
"""Constitutive laws of what flows, for MPM alone; `gdpro_sim.kernels.mpm_laws` says what they are."""

LAWS: tuple[str, ...] = get_args(ElasticLaw)
"""In the order of the numbers that the kernels know them by."""

FLOW_LAWS: tuple[str, ...] = get_args(FlowLaw)
"""Their numbers follow those of `LAWS`."""


def _values(
    young: float, poisson: float, density: float, friction: float, damping: float, **more: float | str
) -> dict[str, float | str]:
    elastic = {"young": young, "poisson": poisson, "density": density}
    return {**elastic, "friction": friction, "rayleigh_stiffness": damping, **more}


def _fluid(bulk: float, viscosity: float, density: float, damping: float = 0.0) -> dict[str, float | str]:
    """damping: s, of its volume: the bulk viscosity over the bulk modulus."""
    values: dict[str, float | str] = {"bulk_modulus": bulk, "viscosity": viscosity, "density": density}
    return {"model": "fluid", **values, "rayleigh_stiffness": damping}


def _paste(
    bulk: float, shear: float, density: float, limit: float, consistency: float, index: float
) -> dict[str, float | str]:
    """limit: yield stress in shear, Pa, as rheometers give it."""
    return {
        "model": "herschel_bulkley",
        "young": 9.0 * bulk * shear / (3.0 * bulk + shear),
        "poisson": (3.0 * bulk - 2.0 * shear) / (6.0 * bulk + 2.0 * shear),
        "density": density,
        "yield_stress": math.sqrt(3.0) * limit,
        "viscosity": consistency,
        "flow_index": index,
    }


PRESETS: dict[str, dict[str, float | str]] = {
    # ---- soft ----
    # Gelatin dessert, 9 parts of water to one of gelatin; and ballistic gelatin, 4 to 1. Compression gives
    # 277 kPa at 2:1 and 4.3 kPa at 20:1, a power law in between (Bonavia 2025, arXiv 2512.20502).
    "jelly": _values(2.0e4, 0.45, 1050.0, 0.5, 2.0e-3),
    "gelatin": _values(8.0e4, 0.45, 1060.0, 0.5, 2.0e-3),
    # Soft natural rubber, Shore A 30: 1.1 MPa by Gent 1958, Rubber Chem. Technol. 31; shear modulus 0.5 MPa
    # by MatWeb, "Natural Rubber, Vulcanized".
    "rubber": _values(1.0e6, 0.47, 1100.0, 0.8, 5.0e-4),
    # Platinum silicone Ecoflex 00-30 (Smooth-On data sheet: 100 % modulus 69 kPa, specific gravity 1.07).
    "silicone": _values(1.0e5, 0.47, 1070.0, 0.7, 1.0e-3),
    # Flexible polyurethane foam; order of magnitude (Gibson & Ashby 1997, Cellular Solids, ch. 5). Poisson's
    # ratio falls from 0.5 to 0 in compression (Widdle, Bajaj & Davies 2008, Int. J. Eng. Sci. 46).
    "foam": _values(5.0e4, 0.30, 60.0, 0.6, 4.0e-3),
    # Passive skeletal muscle; order of magnitude: 3 mu of an Ogden fit to rat muscle in compression (Bosboom
    # et al. 2001, J. Biomech. 34). Methods differ widely (McKee et al. 2011, Tissue Eng. B 17).
    "muscle": _values(4.7e4, 0.47, 1060.0, 0.5, 2.0e-3),
    # Cloth over polyester filling: as a very light soft foam; chosen.
    "plush": _values(2.0e4, 0.25, 50.0, 0.7, 5.0e-3),
    # ---- that keeps its dents ----
    # Plasticine flows at about 0.1 MPa at room temperature; orders of magnitude.
    "plasticine": _values(2.0e6, 0.45, 1800.0, 0.7, 1.0e-4, yield_stress=1.0e5),
    # ---- wood, paper, leather ----
    # Douglas fir (interior south) along the grain at 12 % moisture, taken as isotropic: 10.3 GPa, specific
    # gravity 0.46, Poisson ratios 0.29 and 0.45 (Wood Handbook, USDA FPL-GTR-282, ch. 5).
    "wood": _values(1.03e10, 0.37, 515.0, 0.4, 1.0e-5),
    # Middle of the ranges of Ashby, Materials Selection in Mechanical Design, appendix A.
    "leather": _values(3.0e8, 0.40, 930.0, 0.6, 1.0e-4),
    "paper": _values(5.0e9, 0.30, 670.0, 0.5, 5.0e-5),
    # ---- metals: hardening is the chord from yield to the true ultimate stress at the elongation given ----
    # Aluminium 6061-T6: 68.9 GPa, 276 MPa, ultimate 310 MPa at 12 % (Aluminum Association, typical; MatWeb).
    "aluminium": _values(6.89e10, 0.33, 2700.0, 0.35, 1.0e-5, yield_stress=2.76e8, hardening=6.3e8),
    # Structural steel S235 (EN 1993-1-1, 3.2): 210 GPa, 235 MPa, ultimate 360 MPa; 26 % (EN 10025-2).
    "steel": _values(2.1e11, 0.30, 7850.0, 0.35, 1.0e-5, yield_stress=2.35e8, hardening=9.5e8),
    # Tough-pitch copper, annealed strip: 117 GPa, 54 MPa, ultimate 224 MPa at 56 % (Smithells Metals
    # Reference Book, 8th ed., table 22.7); density from the IEC standard of 1913.
    "copper": _values(1.17e11, 0.34, 8890.0, 0.35, 1.0e-5, yield_stress=5.4e7, hardening=6.6e8),
    # Gold, cold worked by 60 %: 205 MPa, ultimate 220 MPa at 4 %; silver, annealed, whose yield stress is not
    # given (Callister, Materials Science and Engineering, appendix B).
    "gold": _values(7.7e10, 0.42, 19320.0, 0.35, 1.0e-5, yield_stress=2.05e8, hardening=6.1e8),
    "silver": _values(7.4e10, 0.37, 10490.0, 0.35, 1.0e-5),
    # ---- plastic, glass, stone ----
    # ABS: 2 to 2.9 GPa, Poisson ratio 0.39 to 0.42, yields at 30 to 44 MPa (Granta MaterialUniverse); flows
    # without hardening.
    "plastic": _values(2.4e9, 0.41, 1050.0, 0.35, 2.0e-5, yield_stress=3.7e7),
    # Soda-lime glass; stoneware (Callister, appendix B).
    "glass": _values(6.9e10, 0.23, 2500.0, 0.4, 1.0e-5),
    "ceramic": _values(7.0e10, 0.22, 2400.0, 0.4, 1.0e-5),
    # Middle of the ranges of Ashby, appendix A.
    "brick": _values(2.0e10, 0.20, 2000.0, 0.6, 1.0e-5),
    # Granite and limestone lie at 50 to 70 GPa (Goodman, Introduction to Rock Mechanics, 2nd ed., table 6.1).
    "stone": _values(5.0e10, 0.25, 2650.0, 0.6, 1.0e-5),
    # Concrete C30/37 (EN 1992-1-1, table 3.1; EN 1991-1-1 for its weight).
    "concrete": _values(3.3e10, 0.20, 2400.0, 0.6, 1.0e-5),
    # Polycrystalline ice, some 9.5 GPa (Schulson & Duval 2009, Creep and Fracture of Ice, ch. 4); snow: order
    # of magnitude.
    "ice": _values(9.5e9, 0.33, 917.0, 0.05, 1.0e-5),
    "snow": _values(1.0e7, 0.25, 300.0, 0.3, 5.0e-4),
    # ---- food and plants; orders of magnitude ----
    # Apple flesh, 2 to 6 MPa (Mohsenin, Physical Properties of Plant and Animal Materials, 2nd ed.).
    "fruit": _values(4.0e6, 0.30, 840.0, 0.5, 3.0e-4),
    # Turgid soft plant tissue (parenchyma, 1 to 10 MPa: Niklas, Plant Biomechanics, 1992).
    "plant": _values(8.0e6, 0.30, 950.0, 0.5, 3.0e-4),
    # Bread and cake crumb, an open foam of the order of 10 kPa (Scanlon & Zghal 2001, Food Res. Int. 34).
    "bread": _values(1.5e4, 0.25, 250.0, 0.6, 4.0e-3),
    # Semi-hard cheese such as Gouda, some 0.3 MPa in slow compression.
    "cheese": _values(3.0e5, 0.45, 1080.0, 0.5, 1.0e-3),
    # Solid chocolate and paraffin wax at room temperature, some 0.2 GPa each.
    "chocolate": _values(2.0e8, 0.35, 1300.0, 0.4, 1.0e-4),
    "wax": _values(2.0e8, 0.40, 900.0, 0.3, 1.0e-4),
    # ---- that flows or tears: for MPM. Volume is softer than in nature, or substeps would be too short ----
    # White bread crumb in tension: modulus 11 kPa, strength 1 kPa, toughness 4.1 J/m^2 (Scanlon, Sapirstein &
    # Fahloul 2000, J. Cereal Sci. 32).
    "tearing_bread": _values(
        1.1e4, 0.25, 250.0, 0.6, 2.0e-3, model="neo_hookean", tensile_strength=1.0e3, fracture_energy=4.1
    ),
    # Dry quartz sand, loose: 30 to 35 degrees, 1.6 t/m^3 (orders of magnitude). As soft as in Klar et al.
    # 2016; sand in the ground is a hundred times stiffer.
    "sand": _values(3.5e5, 0.30, 1600.0, 0.6, 0.0, model="drucker_prager", friction_angle=33.0),
    # Water between the grains: a cohesion of about 1 kPa (Mitarai & Nori 2006, "Wet granular materials",
    # Adv. Phys. 55: tensile strengths of that order).
    "wet_sand": _values(
        3.5e5, 0.30, 1800.0, 0.6, 0.0, model="drucker_prager", friction_angle=33.0, cohesion=1.0e3
    ),
    # Stomakhin et al. 2013, ACM TOG 32(4), table 2: "typical".
    "fresh_snow": _values(1.4e5, 0.20, 400.0, 0.3, 0.0, model="snow"),
    # Water at 20 C, but for its bulk modulus (2.2 GPa): sound at 22 m/s serves flows up to 2 m/s.
    "water": _fluid(5.0e5, 1.0e-3, 998.0),
    # Honey of 16 to 17 % water: 19 Pa s at 21 C, 7 Pa s at 25 C (Krell 1996, "Value-added products from
    # beekeeping", FAO Agricultural Services Bulletin 124, ch. 2). Bulk viscosity: ten times that in shear,
    # chosen; liquids have one to a few times as much (Dukhin & Goetz 2009, J. Chem. Phys. 130). Without, its
    # soft volume would rebound from an impact, and burst it into crumbs.
    "honey": _fluid(5.0e5, 1.0e1, 1420.0, 2.0e-4),
    # Orders of magnitude: yield stress and fall of viscosity with rate of commercial toothpastes.
    "toothpaste": _paste(2.0e5, 2.0e3, 1300.0, 1.5e2, 5.0e1, 0.5),
    # Dry soap foams: shear modulus 240 Pa and yield strain of some tenth at bubbles of 30 um, index near 0.4
    # (Gillette foam: Gopal & Durian 2003, PRL 91; Denkov et al. 2008, PRL 100); orders of magnitude.
    "shaving_foam": _paste(2.0e4, 2.4e2, 80.0, 3.0e1, 1.0e1, 0.4),
    "whipped_cream": _paste(5.0e4, 5.0e2, 400.0, 5.0e1, 2.0e1, 0.4),
    # Mudflow of silt and clay, 40 % of volume: orders of magnitude of O'Brien & Julien 1988, J. Hydraul. Eng.
    # 114, who fit Bingham's law.
    "mud": _paste(3.0e5, 5.0e3, 1660.0, 1.0e2, 1.0e1, 1.0),
    # Hard wheat flour dough in shear: 1387 Pa s^n, n = 0.38 (J. Food Eng. 103 (2011) 294, capillary
    # rheometer); modulus and yield stress are orders of magnitude.
    "dough": _paste(5.0e5, 1.0e4, 1200.0, 5.0e2, 1.387e3, 0.38),
}
"""Named presets. Sources stand beside each; friction is against a dry floor, damping is chosen."""


LAW_FIELDS: dict[str, tuple[str, ...]] = {
    "hardening": LAWS,
    "bulk_modulus": ("fluid",),
    "viscosity": ("fluid", "herschel_bulkley"),
    "flow_index": ("herschel_bulkley",),
    "friction_angle": ("drucker_prager",),
    "cohesion": ("drucker_prager",),
    "critical_compression": ("snow",),
    "critical_stretch": ("snow",),
    "snow_hardening": ("snow",),
    "tensile_strength": LAWS,
    "fracture_energy": LAWS,
}
"""Fields that mean something for some laws alone."""


def _kept(preset: dict[str, float | str], value: dict[str, Any]) -> dict[str, float | str]:
    """What of a preset still means something beside what the user says."""
    kept = dict(preset)
    if "model" in value:
        for name, laws in LAW_FIELDS.items():
            if value["model"] not in laws:
                kept.pop(name, None)
    if "tensile_strength" in value and value["tensile_strength"] is None:
        kept.pop("fracture_energy", None)
    return kept


class Material(BaseModel):
    """An isotropic material, stable neo-Hookean (Smith, de Goes & Kim 2018) unless it says else.

    With a yield stress it is elastic-plastic: von Mises with linear isotropic hardening, in logarithmic
    strain, which takes the law "stvk_hencky". What flows or tears, MPM alone can simulate: sand
    ("drucker_prager"), "snow", paste and foam ("herschel_bulkley"), "fluid", and all that has a tensile
    strength.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: str | None = Field(default=None, description="name of the preset the values started from")
    model: ElasticLaw | FlowLaw = Field(
        default="stable_neo_hookean",
        description='constitutive law; with a yield stress "stvk_hencky"; "linear" is for small strains and '
        'rotations, and for FEM; "drucker_prager", "snow", "herschel_bulkley" and "fluid" are for MPM',
    )
    young: float = Field(gt=0.0, description="Young's modulus, Pa; a fluid has a bulk modulus instead")
    poisson: float = Field(ge=0.0, lt=0.5, description="Poisson's ratio")
    density: float = Field(gt=0.0, description="kg/m^3")
    friction: float = Field(default=0.5, ge=0.0, description="Coulomb coefficient against the ground")
    rayleigh_mass: float = Field(default=0.0, ge=0.0, description="Rayleigh damping on mass, 1/s")
    rayleigh_stiffness: float = Field(default=0.0, ge=0.0, description="Rayleigh damping on stiffness, s")
    yield_stress: float | None = Field(
        default=None,
        gt=0.0,
        description="von Mises stress at which it starts to flow, Pa: sqrt(3) times the shear stress; "
        "default: never",
    )
    hardening: float = Field(default=0.0, ge=0.0, description="yield stress gained per plastic strain, Pa")
    tensile_strength: float | None = Field(
        default=None,
        gt=0.0,
        description="MPM: largest principal stress at which it begins to tear, Pa; default: never",
    )
    fracture_energy: float | None = Field(
        default=None,
        gt=0.0,
        description="MPM: energy that tearing takes, J/m^2; default: as little as the particles allow",
    )
    bulk_modulus: float | None = Field(
        default=None,
        gt=0.0,
        description="of a fluid, Pa; its speed of sound should be ten times that of the flow, more is slow",
    )
    viscosity: float = Field(
        default=0.0,
        ge=0.0,
        description='of a fluid in shear, Pa s; of "herschel_bulkley" the consistency k of '
        "stress = yield + k rate^n in simple shear, Pa s^n",
    )
    flow_index: float = Field(
        default=1.0, gt=0.0, description='exponent n of "herschel_bulkley"; below one it thins when sheared'
    )
    friction_angle: float | None = Field(
        default=None,
        gt=0.0,
        lt=90.0,
        description='of "drucker_prager", degrees: that of triaxial compression, near the angle of repose',
    )
    cohesion: float = Field(
        default=0.0, ge=0.0, description='of "drucker_prager", Pa: shear strength without pressure (wet sand)'
    )
    critical_compression: float = Field(
        default=2.5e-2, gt=0.0, lt=1.0, description='of "snow": strain past which it is packed for good'
    )
    critical_stretch: float = Field(
        default=7.5e-3, gt=0.0, description='of "snow": strain past which it breaks up'
    )
    snow_hardening: float = Field(
        default=10.0, ge=0.0, description='of "snow": its stiffness grows as exp(this times packed strain)'
    )

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, value: Any) -> Any:
        if isinstance(value, str):
            value = {"preset": value}
        if isinstance(value, dict) and value.get("preset") is not None:
            name = value["preset"]
            if name not in PRESETS:
                near = difflib.get_close_matches(str(name), PRESETS, n=1)
                hint = f" (did you mean {near[0]!r}?)" if near else ""
                raise ValueError(f"unknown material {name!r}{hint}; presets: {', '.join(PRESETS)}")
            value = {**_kept(PRESETS[name], value), **value}
        if isinstance(value, dict) and value.get("yield_stress") is not None:
            value = {"model": "stvk_hencky", **value}
        if isinstance(value, dict) and isinstance(value.get("bulk_modulus"), (int, float)):
            bulk = value["bulk_modulus"]  # a wrong one is told of by its own name
            value = {"young": 3.0 * bulk if bulk > 0.0 else 1.0, "poisson": 0.0, **value}
        return value

    @field_validator(
        "young", "density", "friction", "rayleigh_mass", "rayleigh_stiffness", "yield_stress", "hardening",
        "tensile_strength", "fracture_energy", "bulk_modulus", "viscosity", "flow_index", "cohesion",
        "critical_stretch", "snow_hardening",
    )  # fmt: skip
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        if value is not None and not math.isfinite(value):
            raise ValueError(f"must be finite, got {value}")
        return value

    @model_validator(mode="after")
    def _law_has_its_fields(self) -> Material:
        if self.yield_stress is not None and self.model not in ("stvk_hencky", "herschel_bulkley"):
            raise ValueError(
                f'a material with a yield stress needs the law "stvk_hencky", got {self.model!r}; leave '
                "model out, or set yield_stress to null"
            )
        for name, laws in LAW_FIELDS.items():
            if self.model not in laws and getattr(self, name) != type(self).model_fields[name].default:
                raise ValueError(
                    f"{name} means nothing for the law {self.model!r}; it is for {', '.join(laws)}: leave it "
                    "out, choose another model, or begin with no preset"
                )
        needed: dict[str, tuple[str, ...]] = {
            "drucker_prager": ("friction_angle",),
            "herschel_bulkley": ("yield_stress", "viscosity"),
            "fluid": ("bulk_modulus",),
        }
        for name in needed.get(self.model, ()):
            if not getattr(self, name):
                raise ValueError(f"the law {self.model!r} needs {name} > 0")
        if self.bulk_modulus is not None:
            if (self.young, self.poisson) != (3.0 * self.bulk_modulus, 0.0):
                raise ValueError("a fluid has a bulk_modulus: leave young and poisson out")
        if self.fracture_energy is not None and self.tensile_strength is None:
            raise ValueError("fracture_energy needs a tensile_strength")
        if self.model == "linear" and self.tensile_strength is not None:
            raise ValueError('the law "linear" is for FEM, which cannot tear: leave tensile_strength out')
        return self

    @property
    def law(self) -> int:
        """Number of the constitutive law in the kernels."""
        return (LAWS + FLOW_LAWS).index(self.model)

    @property
    def lame(self) -> tuple[float, float]:
        """Lame parameters (lambda, mu) in Pa; of a fluid (bulk modulus, 0)."""
        if self.bulk_modulus is not None:
            return self.bulk_modulus, 0.0
        lam = self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))
        return lam, self.young / (2.0 * (1.0 + self.poisson))

    def mpm_only(self) -> str | None:
        """Why FEM cannot simulate it, in one line; None where it can."""
        if self.model in FLOW_LAWS:
            return f'the law "{self.model}" flows, which FEM cannot simulate: choose the solver "mpm"'
        if self.tensile_strength is not None:
            return (
                "a material with a tensile_strength tears, which FEM cannot simulate: choose the solver "
                '"mpm", or set tensile_strength to null'
            )
        return None


__all__ = ["FLOW_LAWS", "LAWS", "PRESETS", "ElasticLaw", "FlowLaw", "Material"]
