"""Scenes whose bodies are prompts, and the default scene of an asset."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from gdpro_sim.asset import Asset
from gdpro_sim.errors import SceneError
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.io import generated
from gdpro_sim.io.record import record
from gdpro_sim.materials import Material
from gdpro_sim.simulation.run import simulate
from gdpro_sim.simulation.scene import STIFFEST, check_scene, drop_scene, load_scene
from tests.generation.test_pipeline import SMALL

BODY = {"name": "apple", "prompt": "a green apple", "quality": "draft", "tets": 200, "position": [0, 0, 0.02]}
SCENE = {
    "name": "falling_apple",
    "bodies": [BODY],
    "duration": 0.1,
    "camera": {"width": 64, "height": 48},
    "solver": {"substeps": 1},
}


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any quality is a small one here."""

    def small(quality: str) -> GenerationConfig:
        return load_config(base={**SMALL, "output": {"turntable_views": 0}})

    monkeypatch.setattr(generated, "load_config", small)


def test_a_prompt_is_generated_once_and_simulated(tmp_path: Path) -> None:
    scene = check_scene(SCENE)
    first = record(scene, tmp_path)
    made = tmp_path / "generated" / "apple.usdc"
    assert Asset.load(made).provenance["prompt"] == "a green apple"
    assert first.frame_count == 4 and "generate" in first.seconds
    asset = Asset.load(first.assets[0])
    assert asset.tets is not None and asset.provenance["prompt"] == "a green apple"
    before = made.stat().st_mtime_ns
    record(scene, tmp_path, fresh=True)
    assert made.stat().st_mtime_ns == before, "the same words are not generated again"
    other = check_scene({**SCENE, "bodies": [{**BODY, "prompt": "a red apple"}]})
    again = generated.with_generated(other, tmp_path)
    assert Asset.load(made).provenance["prompt"] == "a red apple"
    assert again.bodies[0].prompt is None and Path(again.bodies[0].asset) == made


def test_plain_simulation_says_what_to_do_with_a_prompt() -> None:
    with pytest.raises(SceneError, match="generate it first"):
        next(iter(simulate(check_scene(SCENE))))


@pytest.mark.parametrize(
    "body", [{"name": "x"}, {"name": "x", "asset": "a.obj", "prompt": "a mug"}, {"prompt": ""}]
)
def test_either_asset_or_prompt(body: dict[str, str]) -> None:
    with pytest.raises(SceneError, match=r"asset|prompt"):
        check_scene({"bodies": [body]})


def test_an_asset_gets_the_default_scene(tmp_path: Path) -> None:
    scene = generated.with_generated(check_scene(SCENE), tmp_path)
    path = Path(scene.bodies[0].asset)
    drop = load_scene(path)
    assert drop == drop_scene(path)
    size = max(Asset.load(path).summary()["size"])
    assert drop.bodies[0].position[2] == pytest.approx(0.5 * size)
    assert drop.bodies[0].material is None, "soft enough as it is"
    stiff = replace(Asset.load(path), material=Material.model_validate({"preset": "steel"}))
    stiff.save(tmp_path / "stiff.usdc")
    hard = drop_scene(tmp_path / "stiff.usdc")
    assert hard.bodies[0].material is not None and hard.bodies[0].material.young == STIFFEST
    assert hard.bodies[0].material.density == 7850.0 and "taken as 1e+07 Pa" in hard.description
    with pytest.raises(SceneError, match="gdpro import"):
        drop_scene(Path(__import__("warp").__file__).parent / "examples/assets/cube.usd")
