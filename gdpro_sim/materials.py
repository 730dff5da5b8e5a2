"""Physical materials: elastic constants, density, friction and damping, with named presets.

A material is part of the asset (generation proposes one) and of the scene (the user may override it), so it
lives beside the asset, above both generation and simulation.
"""

from __future__ import annotations

import difflib
import math
from typing import Any, Literal, get_args

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

Law = Literal["stable_neo_hookean", "neo_hookean", "corotated", "stvk_hencky", "linear"]
"""Constitutive laws; `gdpro_sim.kernels.elasticity` gives their energies."""

LAWS: tuple[str, ...] = get_args(Law)
"""In the order of the numbers that the kernels know them by."""

PRESETS: dict[str, dict[str, float]] = {
    # Gelatin dessert: E 1-30 kPa over concentration (Markidou et al. 2005, Med. Eng. Phys. 27).
    "jelly": {
        "young": 2.0e4,
        "poisson": 0.45,
        "density": 1050.0,
        "friction": 0.5,
        "rayleigh_stiffness": 2.0e-3,
    },
    # Soft natural rubber, Shore A about 30 (Gent's relation gives E about 1 MPa).
    "rubber": {
        "young": 1.0e6,
        "poisson": 0.47,
        "density": 1100.0,
        "friction": 0.8,
        "rayleigh_stiffness": 5.0e-4,
    },
    # Platinum silicone, Shore 00-30 (Ecoflex 00-30 data sheet: 100 % modulus 69 kPa).
    "silicone": {
        "young": 1.0e5,
        "poisson": 0.47,
        "density": 1070.0,
        "friction": 0.7,
        "rayleigh_stiffness": 1.0e-3,
    },
    # Flexible polyurethane foam (Ashby & Gibson, Cellular Solids, 2nd ed., table 5.1).
    "foam": {"young": 5.0e4, "poisson": 0.30, "density": 60.0, "friction": 0.6, "rayleigh_stiffness": 4.0e-3},
    # Passive skeletal muscle, small strain (Collinsworth et al. 2002, Am. J. Physiol. Cell 283).
    "muscle": {
        "young": 3.0e4,
        "poisson": 0.47,
        "density": 1060.0,
        "friction": 0.5,
        "rayleigh_stiffness": 2.0e-3,
    },
    # Pine along the grain, taken as isotropic (Wood Handbook, USDA FPL-GTR-282, table 5-3).
    "wood": {
        "young": 1.0e10,
        "poisson": 0.35,
        "density": 500.0,
        "friction": 0.4,
        "rayleigh_stiffness": 1.0e-5,
    },
    # Stoneware ceramic (Callister, Materials Science and Engineering, appendix B).
    "ceramic": {
        "young": 7.0e10,
        "poisson": 0.22,
        "density": 2400.0,
        "friction": 0.4,
        "rayleigh_stiffness": 1.0e-5,
    },
    # Aluminium 6061 (Callister, appendix B).
    "aluminium": {
        "young": 6.9e10,
        "poisson": 0.33,
        "density": 2700.0,
        "friction": 0.35,
        "rayleigh_stiffness": 1.0e-5,
    },
    # Structural steel (EN 1993-1-1, 3.2.6).
    "steel": {
        "young": 2.1e11,
        "poisson": 0.30,
        "density": 7850.0,
        "friction": 0.35,
        "rayleigh_stiffness": 1.0e-5,
    },
    # Gold, silver and copper C11000 (Callister, appendix B).
    "gold": {
        "young": 7.7e10,
        "poisson": 0.42,
        "density": 19320.0,
        "friction": 0.35,
        "rayleigh_stiffness": 1e-5,
    },
    "silver": {
        "young": 7.4e10,
        "poisson": 0.37,
        "density": 10490.0,
        "friction": 0.35,
        "rayleigh_stiffness": 1e-5,
    },
    "copper": {
        "young": 1.15e11,
        "poisson": 0.33,
        "density": 8890.0,
        "friction": 0.35,
        "rayleigh_stiffness": 1e-5,
    },
    # Soda-lime glass (Callister, appendix B).
    "glass": {
        "young": 6.9e10,
        "poisson": 0.23,
        "density": 2500.0,
        "friction": 0.4,
        "rayleigh_stiffness": 1e-5,
    },
    # ABS (Ashby, Materials Selection in Mechanical Design, appendix: 1.1 to 2.9 GPa).
    "plastic": {
        "young": 2.0e9,
        "poisson": 0.39,
        "density": 1050.0,
        "friction": 0.35,
        "rayleigh_stiffness": 2e-5,
    },
    # Leather, cardboard and paper, brick (same appendix; middle of the ranges).
    "leather": {
        "young": 3.0e8,
        "poisson": 0.40,
        "density": 930.0,
        "friction": 0.6,
        "rayleigh_stiffness": 1e-4,
    },
    "paper": {"young": 5.0e9, "poisson": 0.30, "density": 670.0, "friction": 0.5, "rayleigh_stiffness": 5e-5},
    "brick": {
        "young": 2.0e10,
        "poisson": 0.20,
        "density": 2000.0,
        "friction": 0.6,
        "rayleigh_stiffness": 1e-5,
    },
    # Granite and limestone lie at 50 to 70 GPa (Goodman, Introduction to Rock Mechanics, 2nd ed., table 6.1).
    "stone": {
        "young": 5.0e10,
        "poisson": 0.25,
        "density": 2650.0,
        "friction": 0.6,
        "rayleigh_stiffness": 1e-5,
    },
    # Concrete C30/37 (EN 1992-1-1, table 3.1; EN 1991-1-1 for its weight).
    "concrete": {
        "young": 3.3e10,
        "poisson": 0.20,
        "density": 2400.0,
        "friction": 0.6,
        "rayleigh_stiffness": 1e-5,
    },
    # Ice at -10 C and seasonal snow (Petrovic 2003, J. Mater. Sci. 38; snow: an order of magnitude).
    "ice": {"young": 9.5e9, "poisson": 0.33, "density": 917.0, "friction": 0.05, "rayleigh_stiffness": 1e-5},
    "snow": {"young": 1.0e7, "poisson": 0.25, "density": 300.0, "friction": 0.3, "rayleigh_stiffness": 5e-4},
    # Apple flesh, 2 to 6 MPa (Mohsenin, Physical Properties of Plant and Animal Materials, 2nd ed.).
    "fruit": {"young": 4.0e6, "poisson": 0.30, "density": 840.0, "friction": 0.5, "rayleigh_stiffness": 3e-4},
    # Turgid soft plant tissue (parenchyma, 1 to 10 MPa: Niklas, Plant Biomechanics, 1992).
    "plant": {"young": 8.0e6, "poisson": 0.30, "density": 950.0, "friction": 0.5, "rayleigh_stiffness": 3e-4},
    # Bread and cake crumb, an open foam of the order of 10 kPa (Scanlon & Zghal 2001, Food Res. Int. 34).
    "bread": {"young": 1.5e4, "poisson": 0.25, "density": 250.0, "friction": 0.6, "rayleigh_stiffness": 4e-3},
    # Semi-hard cheese such as Gouda, some 0.3 MPa in slow compression; order of magnitude.
    "cheese": {
        "young": 3.0e5,
        "poisson": 0.45,
        "density": 1080.0,
        "friction": 0.5,
        "rayleigh_stiffness": 1e-3,
    },
    # Solid chocolate and paraffin wax at room temperature, some 0.2 GPa each; orders of magnitude.
    "chocolate": {
        "young": 2.0e8,
        "poisson": 0.35,
        "density": 1300.0,
        "friction": 0.4,
        "rayleigh_stiffness": 1e-4,
    },
    "wax": {"young": 2.0e8, "poisson": 0.40, "density": 900.0, "friction": 0.3, "rayleigh_stiffness": 1e-4},
    # Cloth over polyester filling: as a very light soft foam; chosen.
    "plush": {"young": 2.0e4, "poisson": 0.25, "density": 50.0, "friction": 0.7, "rayleigh_stiffness": 5e-3},
}
"""Named presets. Sources stand beside each; friction is against a dry floor, damping is chosen."""


class Material(BaseModel):
    """An isotropic hyperelastic material, stable neo-Hookean (Smith, de Goes & Kim 2018) unless it says else.

    With a yield stress it is elastic-plastic: von Mises with linear isotropic hardening, in logarithmic
    strain, which takes the law "stvk_hencky".
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    preset: str | None = Field(default=None, description="name of the preset the values started from")
    model: Law = Field(
        default="stable_neo_hookean",
        description='constitutive law; with a yield stress "stvk_hencky"; "linear" is for small strains and '
        "rotations",
    )
    young: float = Field(gt=0.0, description="Young's modulus, Pa")
    poisson: float = Field(ge=0.0, lt=0.5, description="Poisson's ratio")
    density: float = Field(gt=0.0, description="kg/m^3")
    friction: float = Field(default=0.5, ge=0.0, description="Coulomb coefficient against the ground")
    rayleigh_mass: float = Field(default=0.0, ge=0.0, description="Rayleigh damping on mass, 1/s")
    rayleigh_stiffness: float = Field(default=0.0, ge=0.0, description="Rayleigh damping on stiffness, s")
    yield_stress: float | None = Field(
        default=None, gt=0.0, description="von Mises stress at which it starts to flow, Pa; default: never"
    )
    hardening: float = Field(default=0.0, ge=0.0, description="yield stress gained per plastic strain, Pa")

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
            value = {**PRESETS[name], **value}
        if isinstance(value, dict) and value.get("yield_stress") is not None:
            value = {"model": "stvk_hencky", **value}
        return value

    @field_validator(
        "young", "density", "friction", "rayleigh_mass", "rayleigh_stiffness", "yield_stress", "hardening"
    )
    @classmethod
    def _finite(cls, value: float | None) -> float | None:
        if value is not None and not math.isfinite(value):
            raise ValueError(f"must be finite, got {value}")
        return value

    @model_validator(mode="after")
    def _plastic_law(self) -> Material:
        if self.yield_stress is not None and self.model != "stvk_hencky":
            raise ValueError(
                f'a material with a yield stress needs the law "stvk_hencky", got {self.model!r}; leave '
                "model out, or set yield_stress to null"
            )
        return self

    @property
    def law(self) -> int:
        """Number of the constitutive law in the kernels."""
        return LAWS.index(self.model)

    @property
    def lame(self) -> tuple[float, float]:
        """Lame parameters (lambda, mu) in Pa."""
        lam = self.young * self.poisson / ((1.0 + self.poisson) * (1.0 - 2.0 * self.poisson))
        return lam, self.young / (2.0 * (1.0 + self.poisson))


__all__ = ["LAWS", "PRESETS", "Law", "Material"]
