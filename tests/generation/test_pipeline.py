"""A whole run on a small budget: it ends in an asset, and a run that was stopped ends in the same one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
import torch

from gdpro_sim.asset import Asset
from gdpro_sim.device import serial_torch
from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.generation import objects, pipeline
from gdpro_sim.generation.config import GenerationConfig, load_config
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.priors.procedural import ProceduralPrior
from gdpro_sim.generation.protocols import Stage, StepReport
from gdpro_sim.meshing.repair import validate

PROMPT = "a green apple"

SMALL = {
    "guidance": {"resolution": 64},
    "prior": {"resolution": 24},
    "surfels": {
        "iterations": 24,
        "initial": 1500,
        "maximum": 2500,
        "resolution": 48,
        "densify_from": 6,
        "densify_until": 18,
        "densify_every": 6,
    },
    "extraction": {"cameras": 12, "resolution": 96, "depth": 5, "triangles": 600},
    "refinement": {"iterations": 10, "resolution": 48, "per_triangle": 3},
    "output": {"checkpoint_every": 4},
}


def small(**parts: dict[str, Any]) -> GenerationConfig:
    """`SMALL` with some fields set otherwise."""
    return load_config(
        base={name: {**SMALL.get(name, {}), **parts.get(name, {})} for name in {*SMALL, *parts}}
    )


def source(config: GenerationConfig, prompt: str = PROMPT) -> pipeline.Source:
    guidance = ProceduralGuidance(objects.parse(prompt), config.guidance, 0)
    prior = ProceduralPrior(config.prior)
    return pipeline.Source("apple", prompt, guidance, lambda: prior.mesh(prompt, 0), guidance.frame)


class Memory:
    """A store that outlives the run that fills it."""

    def __init__(self) -> None:
        self.kept: dict[str, dict[str, torch.Tensor]] = {}

    def load(self, name: str) -> dict[str, torch.Tensor] | None:
        return self.kept.get(name)

    def save(self, name: str, tensors: Mapping[str, torch.Tensor]) -> None:
        self.kept[name] = {key: value.detach().clone() for key, value in tensors.items()}


class Stop(Exception):
    pass


class Stopper(pipeline.Observer):
    """Ends the run after some iterations, and notes what it sees."""

    def __init__(self, after: int) -> None:
        self.left = after
        self.seen: list[tuple[str, int]] = []
        self.done: list[str] = []

    def stepped(self, stage: Stage, report: StepReport) -> None:
        self.seen.append((stage.name, report.iteration))
        self.left -= 1
        if self.left == 0:
            raise Stop

    def finished(self, name: str, shown: Any, figures: Mapping[str, Any]) -> None:
        self.done.append(name)


@pytest.fixture(scope="module")
def whole() -> tuple[Asset, Stopper]:
    watcher = Stopper(10**6)
    config = small()
    with serial_torch():
        return pipeline.run(source(config), config, 3, observer=watcher), watcher


def tensors_of(asset: Asset) -> dict[str, torch.Tensor]:
    return dict(vars(asset.gaussians))


def test_a_run_ends_in_an_asset(whole: tuple[Asset, Stopper]) -> None:
    asset, watcher = whole
    assert watcher.done == ["prior", "surfels", "extraction", "refinement"]
    assert [name for name, _ in watcher.seen] == ["surfels"] * 24 + ["refinement"] * 10
    vertices = asset.gaussians.vertices.numpy()
    report = validate(vertices, asset.gaussians.faces.numpy())
    assert report.watertight
    assert len(asset.gaussians) == 3 * len(asset.gaussians.faces)
    assert asset.vertex_colors is not None and asset.vertex_colors.shape == vertices.shape
    assert 0.05 < np.ptp(vertices[:, 2]) < 0.12, "an apple's height in m"
    assert abs(vertices[:, 2].min()) < 0.01, "it stands on the floor"
    # red, green, blue of what is seen: green wins
    red, green, blue = asset.vertex_colors.mean(0)
    assert green > red + 0.1 and green > blue + 0.1


def test_provenance_says_how_it_was_made(whole: tuple[Asset, Stopper]) -> None:
    made = whole[0].provenance
    assert made["prompt"] == PROMPT and made["seed"] == 3
    assert "not text-to-3D" in made["guidance"]["label"]
    assert made["config"]["surfels"]["iterations"] == 24
    assert made["stages"]["refinement"]["gaussians"] == len(whole[0].gaussians)
    assert 8.0 < made["stages"]["surfels"]["psnr"] < 60.0
    assert 8.0 < made["stages"]["refinement"]["psnr"] < 60.0
    assert {"gdpro-sim", "torch", "warp-lang"} <= set(made["versions"])
    assert whole[0].material is not None


@pytest.mark.parametrize("after", [1, 9, 24, 29])
def test_a_stopped_run_ends_in_the_same_asset(whole: tuple[Asset, Stopper], after: int) -> None:
    config, store = small(), Memory()
    with serial_torch():
        with pytest.raises(Stop):
            pipeline.run(source(config), config, 3, store=store, observer=Stopper(after))
        rest = Stopper(10**6)
        asset = pipeline.run(source(config), config, 3, store=store, observer=rest)
    assert len(rest.seen) <= 34 - after + 4, "at most what came after the last checkpoint is done again"
    for name, value in tensors_of(whole[0]).items():
        assert torch.equal(value, tensors_of(asset)[name]), name
    assert asset.provenance == whole[0].provenance


def test_another_seed_gives_another_asset(whole: tuple[Asset, Stopper]) -> None:
    config = small()
    with serial_torch():
        asset = pipeline.run(source(config), config, 4)
    same = asset.gaussians.vertices.shape == whole[0].gaussians.vertices.shape
    assert not (same and torch.equal(asset.gaussians.vertices, whole[0].gaussians.vertices))


def test_height_and_material_are_the_users(whole: tuple[Asset, Stopper]) -> None:
    config = small(
        surfels={"iterations": 2}, refinement={"iterations": 1}, output={"height": 0.5, "material": "foam"}
    )
    with serial_torch():
        asset = pipeline.run(source(config), config, 3)
    z = asset.gaussians.vertices[:, 2]
    assert float(z.max() - z.min()) == pytest.approx(0.5, rel=1e-4)
    assert float(z.min()) == pytest.approx(0.0, abs=1e-5)
    assert asset.material is not None and asset.material.preset == "foam"


def test_modes_that_bind_nothing_are_refused() -> None:
    config = small(refinement={"mode": "unbound"})
    with pytest.raises(RequestError, match="gdpro ablate"):
        pipeline.run(source(config), config, 0)


def test_a_checkpoint_of_another_run_is_refused() -> None:
    config, store = small(), Memory()
    with serial_torch(), pytest.raises(Stop):
        pipeline.run(source(config), config, 3, store=store, observer=Stopper(5))
    store.kept["surfels"].pop(next(key for key in store.kept["surfels"] if key.endswith("means")))
    with pytest.raises(GuidanceError, match="does not fit this run"):
        pipeline.run(source(config), config, 3, store=store)
