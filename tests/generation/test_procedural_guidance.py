"""The default guidance draws the object its prompt names, and says that this is all it does."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch

from gdpro_sim.generation.cameras import ring, view_batch
from gdpro_sim.generation.config import GuidanceConfig, ScoreConfig
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.ism import ScoreDistillation
from gdpro_sim.generation.objects import build, parse
from gdpro_sim.generation.protocols import step_generator

PROMPT = "a red mug with a blue handle"
COARSE = GuidanceConfig(resolution=64)


@pytest.fixture(scope="module")
def guidance() -> ProceduralGuidance:
    return ProceduralGuidance(parse(PROMPT), COARSE, seed=3)


def test_the_object_fills_the_unit_frame(guidance: ProceduralGuidance) -> None:
    (surface,) = guidance.surfaces
    assert np.linalg.norm(surface.vertices, axis=1).max() == pytest.approx(1.0, abs=1e-5)
    metres = build(parse(PROMPT), 3).surface(64).vertices
    assert np.abs(guidance.frame.to_metres(surface.vertices) - metres).max() < 1e-6


def test_targets_show_what_the_prompt_says(guidance: ProceduralGuidance) -> None:
    target = guidance.targets(view_batch(ring(4, 48), torch.zeros(4, 3)))[0]
    red = (target[..., 0] > 0.5) & (target[..., 2] < 0.4)
    blue = (target[..., 2] > 0.5) & (target[..., 0] < 0.4)
    assert (red.sum((1, 2)) > 200).all()
    assert int(blue.sum((1, 2)).max()) > 30


def test_the_same_seed_gives_the_same_pictures(guidance: ProceduralGuidance) -> None:
    views = view_batch(ring(2, 32))
    again = ProceduralGuidance(parse(PROMPT), COARSE, seed=3)
    other = ProceduralGuidance(parse(PROMPT), COARSE, seed=4)
    assert torch.equal(guidance.targets(views), again.targets(views))
    assert not torch.equal(guidance.targets(views), other.targets(views))


def test_instances_follow_each_other_s_seed(guidance: ProceduralGuidance) -> None:
    three = ProceduralGuidance(parse(PROMPT), GuidanceConfig(resolution=64, instances=3), seed=3)
    views = view_batch(ring(2, 32))
    targets = three.targets(views)
    assert targets.shape == (3, 2, 32, 32, 3)
    assert float((targets[0] - targets[1]).abs().max()) > 0.1
    reach = [float(np.linalg.norm(s.vertices, axis=1).max()) for s in three.surfaces]
    assert max(reach) == pytest.approx(1.0, abs=1e-5)
    assert [one["seed"] for one in three.describe()["instances"]] == [3, 4, 5]


def test_ism_pulls_a_picture_straight_to_the_target(guidance: ProceduralGuidance) -> None:
    views = guidance.views(view_batch(ring(2, 32)), torch.Generator())
    score = ScoreDistillation(guidance, ScoreConfig(shared_noise=0.0))
    images = torch.full((2, 32, 32, 3), 0.5)
    result = score.gradient(images, views, 2000, step_generator(0, "test", 0))
    away = images - guidance.targets(views)[0]
    both = torch.stack([result.gradient.flatten(), away.flatten()])
    assert float(torch.corrcoef(both)[0, 1]) > 0.5


def test_the_description_is_json_and_honest(guidance: ProceduralGuidance) -> None:
    said = json.loads(json.dumps(guidance.describe()))
    assert said["kind"] == "procedural"
    assert "not text-to-3D" in said["label"]
    assert said["instances"][0]["noun"] == "mug"
