"""Presets, files and overrides of generation's configuration, and what is said of wrong ones."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from gdpro_sim.errors import RequestError
from gdpro_sim.generation.config import PRESETS, GenerationConfig, load_config


@pytest.mark.parametrize("preset", PRESETS)
def test_presets_are_valid_and_survive_json(preset: str) -> None:
    config = load_config(preset)
    assert GenerationConfig.model_validate(config.model_dump(mode="json")) == config
    assert config.surfels.densify_until <= config.surfels.iterations


def test_paper_preset_has_the_papers_numbers() -> None:
    config = load_config("paper")
    assert (config.surfels.iterations, config.surfels.batch, config.surfels.lr_position) == (5000, 4, 1.6e-5)
    assert (config.refinement.per_triangle, config.extraction.triangles) == (55, 40_000)
    assert config.cameras.polar == (30.0, 150.0)
    assert config.score.guidance_scale == 7.5


def test_every_field_says_what_it_is() -> None:
    for name, part in GenerationConfig.model_fields.items():
        assert isinstance(part.annotation, type) and issubclass(part.annotation, BaseModel), name
        for key, field in part.annotation.model_fields.items():
            assert field.description, f"{name}.{key}"


def test_later_sources_win(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("surfels: {iterations: 11, batch: 3}\noutput: {height: 0.2}\n")
    config = load_config("draft", file, ["surfels.iterations=12"], {"output": {"height": 0.5}})
    assert config.surfels.iterations == 12
    assert config.surfels.batch == 3
    assert config.output.height == 0.5
    assert config.surfels.initial == PRESETS["draft"]["surfels"]["initial"]


@pytest.mark.parametrize(
    ("override", "words"),
    [
        ("surfels", "PART.FIELD=VALUE"),
        ("surfls.iterations=3", "did you mean 'surfels'"),
        ("surfels.iteration=3", "did you mean 'iterations'"),
        ("surfels.iterations=many", "surfels.iterations"),
        ("surfels.iterations=-1", "greater than or equal to 0"),
        ("surfels.kind=voxels", "surfels.kind"),
        ("cameras.fov=[1,2,3]", "cameras.fov"),
        ("surfels.iterations=[", "YAML"),
    ],
)
def test_wrong_overrides(override: str, words: str) -> None:
    with pytest.raises(RequestError, match="(?s)" + words.replace("(", r"\(")):
        load_config(overrides=[override])


@pytest.mark.parametrize("text", ["surfels: 3\n", "- 1\n", "surfels: {iterations: [}\n", "what: {a: 1}\n"])
def test_wrong_files(tmp_path: Path, text: str) -> None:
    file = tmp_path / "wrong.yaml"
    file.write_text(text)
    with pytest.raises(RequestError) as caught:
        load_config(file=file)
    assert "wrong.yaml" in str(caught.value) and "\n" not in str(caught.value)


def test_unknown_preset_and_missing_file(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match="draft, default, high, paper"):
        load_config("best")
    with pytest.raises(RequestError, match="cannot be read"):
        load_config(file=tmp_path / "none.yaml")
