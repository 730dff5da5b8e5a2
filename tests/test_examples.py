"""Every example runs as a user would run it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.asset import Asset
from gdpro_sim.io.images import read_png

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def run(script: str, *arguments: str, cwd: Path) -> str:
    command = [sys.executable, str(EXAMPLES / script), *arguments]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.slow
def test_drop_mesh(tmp_path: Path) -> None:
    output = run("drop_mesh.py", cwd=tmp_path)
    assert output.count("t = ") == 16
    assert (tmp_path / "out/drop_mesh/simulation.usdc").stat().st_size > 0


def test_render_asset(tmp_path: Path) -> None:
    assert "Gaussians" in run("render_asset.py", cwd=tmp_path)
    picture = read_png(tmp_path / "out/asset.png").astype(float)
    middle = picture[200:280, 200:280].mean(axis=(0, 1))
    assert middle[1] > middle[0] > middle[2], "the bunny is green, in the middle of a white picture"
    assert np.all(picture[:5] > 250)


def test_compose_and_animate(tmp_path: Path) -> None:
    output = run("compose_and_animate.py", str(tmp_path / "out"), cwd=tmp_path)
    assert "ball_0, ball_1, ball_2, ball_3, ball_4" in output and "wrote 11 frames" in output
    assert read_png(tmp_path / "out/crawl/contact_sheet.png").std() > 10.0


def test_gsplat_import(tmp_path: Path) -> None:
    output = run("gsplat_import.py", cwd=tmp_path)
    losses = [float(line.split()[3]) for line in output.splitlines() if line.startswith("step")]
    assert len(losses) == 7 and losses[-1] < 1e-3 < 0.1 < losses[0]
    assert read_png(tmp_path / "out/gsplat_import.png").shape == (96, 96, 3)


@pytest.mark.parametrize("kind", ["gaussians", "surfels"])
def test_fit_views(tmp_path: Path, kind: str) -> None:
    arguments = "--size 32 --gaussians 300 --iterations 60".split() + ["--surfels"] * (kind == "surfels")
    lines = [line for line in run("fit_views.py", *arguments, cwd=tmp_path).splitlines() if "PSNR" in line]
    psnrs = [float(line.split("PSNR")[1].split()[0]) for line in lines]
    angles = [float(line.split("off by")[1].split()[0]) for line in lines]
    assert psnrs[-1] > psnrs[0] + 5.0 and angles[-1] < angles[0]
    assert read_png(tmp_path / "out/fit_views/held_out.png").shape == (4 * 32, 4 * 32, 3)
    assert (tmp_path / "out/fit_views/fit.ply").stat().st_size > 300 * 50


def test_read_dataset(tmp_path: Path) -> None:
    lines = run("read_dataset.py", cwd=tmp_path).splitlines()
    assert lines[0].startswith("4 rollouts of 16 frames; drawn: bodies.red.rotation")
    heights = [float(line.split("and [")[1].split("]")[0].split()[2]) for line in lines if " points " in line]
    assert len(heights) == 4 and all(0.05 < height < 0.4 for height in heights)


@pytest.mark.slow
def test_generate_by_stages(tmp_path: Path) -> None:
    small = [
        "surfels.iterations=20",
        "surfels.resolution=96",
        "refinement.iterations=8",
        "refinement.resolution=96",
    ]
    small += ["extraction.triangles=800", "surfels.initial=1500"]
    output = run(
        "generate_by_stages.py",
        "a green apple",
        *(part for s in small for part in ("--set", s)),
        cwd=tmp_path,
    )
    folder = tmp_path / "out/generate_by_stages"
    asset = Asset.load(folder / "asset.usdc")
    assert f"{len(asset.gaussians)} Gaussians" in output
    for name in ("prior", "surfels", "extraction", "refinement"):
        assert read_png(folder / f"{name}.png").std() > 10.0


def test_swing(tmp_path: Path) -> None:
    output = run("swing.py", cwd=tmp_path)
    assert "the first cube has landed" in output and "cube_2" in output
    pictures = sorted((tmp_path / "out/swing/frames").glob("*.png"))
    assert len(pictures) == 8
    assert np.abs(read_png(pictures[-1]).astype(float) - read_png(pictures[0])).max() > 50


def test_every_example_is_tested() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for script in EXAMPLES.glob("*.py"):
        assert f'"{script.name}"' in here, script
