"""The default prior: coarse, closed and plain, for every noun."""

from __future__ import annotations

import json

import numpy as np
import pytest

from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import PriorConfig
from gdpro_sim.generation.objects import NOUNS, build, parse
from gdpro_sim.generation.priors.procedural import ProceduralPrior
from gdpro_sim.meshing.repair import validate


@pytest.mark.parametrize("name", NOUNS)
def test_the_coarse_mesh_of_every_noun_is_closed_and_in_one_piece(name: str) -> None:
    mesh = ProceduralPrior(PriorConfig()).mesh(name, 0)
    report = validate(mesh.surface.vertices, mesh.surface.faces)
    assert report.watertight and report.components == 1 and report.volume > 0.0, report
    assert report.faces < 20_000
    across = NOUNS[name].across
    assert np.ptp(mesh.surface.vertices, axis=0).max() == pytest.approx(across, rel=0.1)
    assert mesh.material == NOUNS[name].material


def test_it_is_coarse_in_shape_and_colour() -> None:
    prompt, config = "a blue and white dotted teapot", PriorConfig()
    coarse, fine = ProceduralPrior(config).mesh(prompt, 2).surface, build(parse(prompt), 2).surface(96)
    assert len(coarse.faces) < 0.2 * len(fine.faces)
    assert coarse.colors is not None and fine.colors is not None
    plain = np.unique(coarse.colors.reshape(-1, 4), axis=0)
    assert len(plain) <= 4 < len(np.unique(fine.colors.reshape(-1, 4), axis=0))


def test_resolution_comes_from_the_config() -> None:
    few, many = (
        len(ProceduralPrior(PriorConfig(resolution=n)).mesh("pear", 0).surface.faces) for n in (16, 32)
    )
    assert 3.0 < many / few < 5.0


def test_thin_parts_survive() -> None:
    """A stem of less than a cell is thickened rather than lost."""
    fine = build(parse("wine glass"), 0)
    mesh = ProceduralPrior(PriorConfig(resolution=20)).mesh("wine glass", 0).surface
    assert np.ptp(mesh.vertices[:, 2]) == pytest.approx(fine.size[2], rel=0.1)


def test_the_same_seed_repeats_to_the_bit() -> None:
    prior = ProceduralPrior(PriorConfig())
    one, two, other = (prior.mesh("a rubber duck", seed).surface for seed in (7, 7, 8))
    assert np.array_equal(one.vertices, two.vertices) and np.array_equal(one.faces, two.faces)
    assert one.vertices.shape != other.vertices.shape or not np.array_equal(one.vertices, other.vertices)


def test_unknown_words_follow_the_switch() -> None:
    with pytest.raises(GuidanceError, match="sparkling"):
        ProceduralPrior(PriorConfig()).mesh("a sparkling mug", 0)
    mesh = ProceduralPrior(PriorConfig(), ignore_unknown=True).mesh("a sparkling mug", 0)
    assert mesh.description["object"]["unknown"] == ["sparkling"]


def test_it_says_honestly_what_it_is() -> None:
    told = ProceduralPrior(PriorConfig()).mesh("a red mug", 3).description
    assert "not open text-to-3D" in json.loads(json.dumps(told))["label"]
    assert told["object"]["caption"] == "a red mug" and told["object"]["seed"] == 3
