"""Every example runs as a user would run it."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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
    picture = read_png(tmp_path / "asset.png").astype(float)
    middle = picture[200:280, 200:280].mean(axis=(0, 1))
    assert middle[1] > middle[0] > middle[2], "the bunny is green, in the middle of a white picture"
    assert np.all(picture[:5] > 250)


def test_every_example_is_tested() -> None:
    here = Path(__file__).read_text(encoding="utf-8")
    for script in EXAMPLES.glob("*.py"):
        assert f'"{script.name}"' in here, script
