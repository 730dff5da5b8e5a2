"""`gdpro generate` and `gdpro vocabulary` as a user meets them."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
import trimesh

from gdpro_sim.asset import Asset
from gdpro_sim.cli import main
from tests.generation import tiny_pipeline
from tests.test_cli import gdpro

SMALL = [
    "guidance.resolution=64", "prior.resolution=24", "surfels.iterations=30", "surfels.initial=800",
    "surfels.resolution=64", "extraction.cameras=12", "extraction.resolution=96", "extraction.depth=5",
    "extraction.triangles=500", "refinement.iterations=3", "refinement.resolution=64",
    "refinement.per_triangle=3", "output.turntable_views=0",
]  # fmt: skip
SETTINGS = [part for setting in SMALL for part in ("--set", setting)]


def test_a_prompt_becomes_an_asset(tmp_path: Path) -> None:
    done = gdpro("generate", "a red mug", "-o", "mug.usdc", "--run", "run", "--json", *SETTINGS, cwd=tmp_path)
    summary = json.loads(done.stdout)
    assert summary["provenance"]["read_as"]["noun"] == "mug"
    assert {"surfels", "refinement"} <= set(summary["parts"])
    first = (tmp_path / "mug.usdc").read_bytes()
    gdpro("generate", "--resume", "run", "-o", "again.usdc", "--quiet", cwd=tmp_path)
    assert (tmp_path / "again.usdc").read_bytes() == first
    shown = gdpro("info", "mug.usdc", "--json", cwd=tmp_path)
    assert json.loads(shown.stdout)["provenance"]["prompt"] == "a red mug"


def test_progress_names_every_stage(tmp_path: Path) -> None:
    done = gdpro("generate", "a red mug", "-o", "mug.usdc", *SETTINGS, cwd=tmp_path)
    for words in ("Prior", "Stage 1", "30/30", "Extraction", "Stage 2", "3/3", "dB"):
        assert words in done.stderr, words
    assert "not text-to-3D" in " ".join(done.stdout.replace("│", " ").split())


def test_a_mesh_becomes_an_asset(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=3, radius=0.2).export(tmp_path / "ball.obj")
    gdpro(
        "generate", "--from-mesh", "ball.obj", "-o", "ball.usdc", "--color", "#2060c0", "--material", "foam",
        *SETTINGS, cwd=tmp_path,
    )  # fmt: skip
    asset = Asset.load(tmp_path / "ball.usdc")
    assert asset.summary()["size"] == pytest.approx([0.4] * 3, rel=0.15)
    assert asset.material is not None and asset.material.preset == "foam"
    assert asset.vertex_colors is not None
    assert asset.vertex_colors.mean(0) == pytest.approx([0.125, 0.376, 0.753], abs=0.1)


@pytest.mark.slow
def test_a_diffusion_model_guides(tmp_path: Path) -> None:
    """The whole path of a user with weights, on a tiny random model: a real run of a real pipeline."""
    tiny_pipeline.stable_diffusion(tmp_path / "model")
    arguments = [
        "generate", "an old wooden chest", "-o", "chest.usdc", "--guidance", "diffusers", "--model", "model",
        "--prior", "sphere", *SETTINGS, "--set", "surfels.iterations=2", "--set", "refinement.iterations=1",
    ]  # fmt: skip
    gdpro(*arguments, cwd=tmp_path)
    made = Asset.load(tmp_path / "chest.usdc").provenance
    assert made["guidance"]["kind"] == "diffusers" and made["prompt"] == "an old wooden chest"
    assert "not text-to-3D" not in json.dumps(made["guidance"])
    slow = gdpro(*arguments, "--set", "surfels.iterations=50000", cwd=tmp_path, ok=False)
    assert slow.returncode == 2 and "--yes" in slow.stderr and "on this CPU would take about" in slow.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (
            ["a quantum mug", "-o", "x.usdc"],
            ["quantum", "gdpro vocabulary", "--guidance diffusers --model DIR"],
        ),
        (["a mug and a chair", "-o", "x.usdc"], ["several objects"]),
        (["", "-o", "x.usdc"], ["nothing to generate from"]),
        (["a mug"], ["-o"]),
        (["a mug", "-o", "x.png"], [".usdc"]),
        (["a mug", "-o", "none/x.usdc"], ["none"]),
        (["a mug", "-o", "x.usdc", "--quality", "best"], ["draft, default, high, paper"]),
        (["a mug", "-o", "x.usdc", "--set", "surfels.iteration=3"], ["did you mean 'iterations'"]),
        (["a mug", "-o", "x.usdc", "--guidance", "magic"], ["guidance.kind"]),
        (["a mug", "-o", "x.usdc", "--guidance", "views"], ["--from-mesh"]),
        (["a mug", "-o", "x.usdc", "--prior", "mesh"], ["--prior-model"]),
        (["a mug", "-o", "x.usdc", "--guidance", "diffusers"], ["--model"]),
        (["a mug", "-o", "x.usdc", "--guidance", "diffusers", "--model", "none"], ["none"]),
        (["a mug", "-o", "x.usdc", "--prior", "shap-e", "--prior-model", "none"], ["none"]),
        (["--from-mesh", "none.obj", "-o", "x.usdc"], ["none.obj", "no such file"]),
        (["--from-images", ".", "-o", "x.usdc"], ["transforms.json"]),
        (["--from-mesh", "ball.obj", "--from-splat", "ball.obj", "-o", "x.usdc"], ["mesh and splat"]),
        (["--resume", ".", "-o", "x.usdc"], ["no run.json"]),
        (["a mug", "--resume", ".", "-o", "x.usdc"], ["--resume takes no prompt"]),
    ],
)
def test_wrong_requests(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: list[str],
    words: list[str],
) -> None:
    trimesh.creation.icosphere(subdivisions=1).export(tmp_path / "ball.obj")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["gdpro", "generate", *arguments])
    with pytest.raises(SystemExit) as caught:
        main()
    said = capsys.readouterr().err
    lines = [line for line in said.splitlines() if line.startswith("gdpro:")]
    assert caught.value.code == 2, said
    assert len(lines) == 1
    for word in words:
        assert word in lines[0]
    assert not (tmp_path / "x.usdc").exists()


def test_vocabulary(tmp_path: Path) -> None:
    words = json.loads(gdpro("vocabulary", "--json", cwd=tmp_path).stdout)
    assert len(words["colours"]) >= 25 and len(words["materials"]) >= 12 and len(words["patterns"]) >= 8
    assert "mug" in gdpro("vocabulary", "--quiet", cwd=tmp_path).stdout.splitlines()
