"""Materials: what their laws need and refuse, presets, and what FEM cannot simulate."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from gdpro_sim.errors import SolverError
from gdpro_sim.materials import FLOW_LAWS, LAWS, PRESETS, Material
from gdpro_sim.simulation.fem import SolverFEM
from tests.simulation.fem_models import make_model, tet_box

BASE = {"young": 1e5, "poisson": 0.3, "density": 1e3}


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_materials_and_keep_through_json(name: str) -> None:
    material = Material.model_validate(name)
    assert Material.model_validate_json(material.model_dump_json()) == material
    lam, mu = material.lame
    assert lam >= 0 and mu >= 0 and 0.5 < math.sqrt((lam + 2 * mu) / material.density) < 1e4


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"model": "drucker_prager"}, "'drucker_prager' needs friction_angle > 0"),
        ({"model": "herschel_bulkley", "yield_stress": 10.0}, "'herschel_bulkley' needs viscosity > 0"),
        ({"model": "herschel_bulkley", "viscosity": 1.0}, "'herschel_bulkley' needs yield_stress > 0"),
        ({"model": "fluid"}, "'fluid' needs bulk_modulus > 0"),
        ({"model": "fluid", "bulk_modulus": 1e5}, "leave young and poisson out"),
        ({"viscosity": 1.0}, "viscosity means nothing for the law 'stable_neo_hookean'"),
        ({"cohesion": 1.0}, "it is for drucker_prager: leave it out"),
        ({"model": "snow", "hardening": 1.0}, "hardening means nothing for the law 'snow'"),
        ({"model": "snow", "yield_stress": 1.0}, "a material with a yield stress needs"),
        ({"model": "snow", "tensile_strength": 1.0}, "tensile_strength means nothing for the law 'snow'"),
        ({"model": "linear", "tensile_strength": 1.0}, 'the law "linear" is for FEM'),
        ({"fracture_energy": 1.0}, "fracture_energy needs a tensile_strength"),
        ({"tensile_strength": math.inf}, "must be finite"),
        ({"model": "drucker_prager", "friction_angle": 90.0}, "less than 90"),
        ({"model": "sandy"}, "drucker_prager"),
        ({"poisson": 0.5}, "less than 0.5"),
        ({"young": 0.0}, "greater than 0"),
    ],
)
def test_wrong_materials_are_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message.replace("(", r"\(")):
        Material.model_validate({**BASE, **wrong})


def test_a_fluid_is_given_by_its_bulk_modulus() -> None:
    water = Material.model_validate({"preset": "water", "bulk_modulus": 1e6})
    assert water.lame == (1e6, 0.0)
    assert water.young / (3 * (1 - 2 * water.poisson)) == pytest.approx(1e6)


def test_presets_lose_what_another_law_has_no_use_for() -> None:
    assert Material.model_validate({"preset": "sand", "model": "corotated"}).friction_angle is None
    whole = Material.model_validate({"preset": "tearing_bread", "tensile_strength": None})
    assert whole.fracture_energy is None and whole.mpm_only() is None
    assert Material.model_validate({"preset": "steel", "yield_stress": None}).yield_stress is None


def test_numbers_of_laws() -> None:
    for number, law in enumerate((*LAWS, *FLOW_LAWS)):
        assert Material.model_construct(model=law).law == number


def test_fem_refuses_what_flows_or_tears() -> None:
    reasons = {name: Material.model_validate(name).mpm_only() for name in PRESETS}
    assert {name for name, reason in reasons.items() if reason} == {
        "tearing_bread", "sand", "wet_sand", "fresh_snow", "water", "honey", "toothpaste", "shaving_foam",
        "whipped_cream", "mud", "dough",
    }  # fmt: skip
    assert all("\n" not in reason and '"mpm"' in reason for reason in reasons.values() if reason)
    model = make_model(*tet_box((1, 1, 1), (1.0, 1.0, 1.0)))
    sand = np.full(len(model.tets), Material.model_validate("sand").law, np.int32)
    with pytest.raises(SolverError, match="what flows, MPM alone can simulate"):
        SolverFEM(dataclasses.replace(model, law=sand))
