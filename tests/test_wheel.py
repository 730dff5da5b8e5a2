"""The wheel works away from the checkout: build, install in a clean environment, simulate a shipped scene."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]

pytestmark = [pytest.mark.wheel, pytest.mark.slow, pytest.mark.timeout(1800)]


def run(*command: str | Path, cwd: Path) -> str:
    done = subprocess.run([str(c) for c in command], cwd=cwd, capture_output=True, text=True)
    assert done.returncode == 0, f"{command}\n{done.stdout}\n{done.stderr}"
    return done.stdout


def test_wheel_and_sdist_install_and_simulate(tmp_path: Path) -> None:
    source = tmp_path / "source"
    run("git", "clone", "--quiet", ROOT, source, cwd=tmp_path)
    for name in run("git", "ls-files", "--modified", "--others", "--exclude-standard", cwd=ROOT).split():
        if (ROOT / name).is_file():  # the working tree as it is, not only what is committed
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    built = tmp_path / "built"
    run(
        sys.executable, "-m", "build", "--outdir", built, source, cwd=tmp_path
    )  # the wheel is made from the sdist
    (wheel,) = built.glob("*.whl")
    assert list(built.glob("*.tar.gz"))

    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    run(sys.executable, "-m", "venv", "env", cwd=elsewhere)
    python = elsewhere / "env/bin/python"
    run(python, "-m", "pip", "install", "--quiet", "-c", ROOT / "constraints.txt", wheel, cwd=elsewhere)
    where = run(
        python,
        "-c",
        "import gdpro_sim, gdpro_sim.kernels as k; print(gdpro_sim.__file__, k.__file__)",
        cwd=elsewhere,
    )
    assert str(ROOT) not in where
    gdpro = elsewhere / "env/bin/gdpro"
    assert "jelly_bunny" in run(gdpro, "scenes", cwd=elsewhere)
    run(gdpro, "simulate", "soft_block", "-o", "out", cwd=elsewhere)
    for name in ("asset.usdc", "simulation.usdc", "preview.mp4", "contact_sheet.png", "metrics.csv"):
        assert (elsewhere / "out" / name).stat().st_size > 0, name
