"""The command line as a user meets it: exit codes, one line per error, JSON, stopped and resumed runs."""

from __future__ import annotations

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.asset import Asset
from gdpro_sim.cli import main
from gdpro_sim.errors import RequestError
from gdpro_sim.io.images import read_png
from gdpro_sim.io.ply import read_ply
from gdpro_sim.io.record import record
from gdpro_sim.io.usd import SimulationReader
from tests.conditions import posix_only

SCENE = """
bodies:
  - asset: ball.obj
    size: 0.2
    position: [0, 0, 0.05]
    budget: 1500
    tets: 150
    material: {{preset: jelly, young: 5.0e4}}
fps: 30
duration: {duration}
camera: {{width: 96, height: 64}}
"""


def gdpro(*arguments: str | Path, cwd: Path, ok: bool = True) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "gdpro_sim.cli", *map(str, arguments)]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=300)
    if ok:
        assert done.returncode == 0, done.stderr
    return done


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a mesh, a scene of it, an asset and a finished simulation."""
    path = tmp_path_factory.mktemp("cli")
    trimesh.creation.icosphere(subdivisions=2, radius=0.5).export(path / "ball.obj")
    (path / "scene.yaml").write_text(SCENE.format(duration=0.3))
    gdpro("import", "ball.obj", "-o", "ball.usdc", "--budget", "1500", "--tets", "150", cwd=path)
    done = gdpro("simulate", "scene.yaml", "-o", "run", "--json", cwd=path)
    (path / "run.json").write_text(done.stdout)
    return path


def test_simulate_writes_everything(folder: Path) -> None:
    recording = json.loads((folder / "run.json").read_text())
    assert recording["frame_count"] == 10
    for name in ("asset.usdc", "simulation.usdc", "preview.mp4", "contact_sheet.png", "metrics.csv"):
        assert (folder / "run" / name).stat().st_size > 0, name
    assert len(list((folder / "run/frames").glob("*.png"))) == 10
    assert not list((folder / "run").glob(".*")), "nothing temporary is left behind"
    rows = list(csv.DictReader((folder / "run/metrics.csv").open()))
    assert len(rows) == 10
    heights = [float(row["gravity_energy_J"]) for row in rows]
    assert heights[0] > heights[3]
    for column in ("time_s", "kinetic_energy_J", "momentum_z_kg_m_per_s", "contacts", "ms_solve"):
        assert all(np.isfinite(float(row[column])) for row in rows), column
    assert any(int(row["contacts"]) > 0 for row in rows)


def test_info_render_and_scenes(folder: Path) -> None:
    asset = json.loads(gdpro("info", "ball.usdc", "--json", cwd=folder).stdout)
    assert asset["kind"] == "asset" and asset["tets"] > 50
    simulation = json.loads(gdpro("info", "run/simulation.usdc", "--json", cwd=folder).stdout)
    assert simulation["kind"] == "simulation" and simulation["frames"] == 10
    mesh = json.loads(gdpro("info", "ball.obj", "--json", cwd=folder).stdout)
    assert mesh["kind"] == "mesh" and mesh["faces"] == 320
    size = ("--width", "64", "--height", "48")
    gdpro("render", "ball.usdc", "-o", "turn", "--frames", "3", *size, cwd=folder)
    assert len(list((folder / "turn").glob("frame_*.png"))) == 3
    gdpro("render", "run/simulation.usdc", "-o", "again", "--shading", "none", *size, cwd=folder)
    assert len(list((folder / "again").glob("frame_*.png"))) == 10
    gdpro("render", "run/simulation.usdc", "-o", "again", cwd=folder)
    for name in ("frame_00000.png", "frame_00009.png"):
        assert np.array_equal(read_png(folder / "again" / name), read_png(folder / "run/frames" / name)), name
    assert "jelly_bunny" in json.loads(gdpro("scenes", "--json", cwd=folder).stdout)


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["simulat"], "Did you mean 'simulate'"),
        (["simulate"], "Missing argument"),
        (["simulate", "scene.yaml"], "Missing option"),
        (["simulate", "nosuch", "-o", "x"], "give a .yaml file or one of"),
        (["simulate", "missing.yaml", "-o", "x"], "no such file"),
        (["simulate", "scene.yaml", "-o", "ball.obj"], "give a folder"),
        (["simulate", "scene.yaml", "-o", "ball.obj/deep"], "give a folder"),
        (["simulate", "scene.yaml", "-o", "x", "--device", "cuda:9"], "not available on this machine"),
        (["simulate", "scene.yaml", "-o", "x", "--seed", "-1"], "--seed"),
        (["import", "missing.obj", "-o", "x.usdc"], "missing.obj"),
        (["import", "scene.yaml", "-o", "x.usdc"], "scene.yaml"),
        (["import", "ball.obj", "-o", "x.txt"], "must end in .usdc"),
        (["import", "ball.obj", "-o", "nowhere/x.usdc"], "does not exist"),
        (["import", "ball.obj", "-o", "x.usdc", "--color", "nocolour"], "nocolour"),
        (["import", "ball.obj", "-o", "x.usdc", "--material", "jely"], "did you mean 'jelly'"),
        (["import", "ball.obj", "-o", "x.usdc", "--scale", "-1"], "scale"),
        (["import", "ball.obj", "-o", "x.usdc", "--up", "w"], "auto, y, z"),
        (["import", "ball.usdc", "-o", "x.usdc"], "ball.usdc"),
        (["render", "ball.obj", "-o", "x"], "gdpro import"),
        (["render", "ball.usdc", "-o", "x", "--shading", "pretty"], "studio, none"),
        (["export", "ball.usdc", "-o", "x.txt"], "must end in .ply"),
        (["export", "run/simulation.usdc", "-o", "x.ply", "--frame", "10"], "frames 0-9"),
        (["export", "ball.obj", "-o", "x.ply"], "gdpro import"),
        (["info", "missing.usdc"], "missing.usdc"),
        (["info", "scene.yaml"], "scene.yaml"),
    ],
)
def test_wrong_requests_exit_2_with_one_line(
    folder: Path,
    arguments: list[str],
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "argv", ["gdpro", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    errors = capsys.readouterr().err
    lines = errors.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith("gdpro: "), errors
    assert expected in errors
    assert not (folder / "x.usdc").exists()


def test_export_writes_what_splat_viewers_read(folder: Path) -> None:
    gdpro("export", "ball.usdc", "-o", "ball.ply", cwd=folder)
    asset = Asset.load(folder / "ball.usdc").gaussians.gaussians()
    assert torch.allclose(read_ply(folder / "ball.ply").means, asset.means)
    gdpro("export", "run/simulation.usdc", "-o", "last.ply", "--frame", "9", cwd=folder)
    frame = SimulationReader(folder / "run/simulation.usdc").frame(9)
    assert torch.equal(read_ply(folder / "last.ply").means, frame.gaussians().means)


def test_results_never_replace_what_the_scene_reads(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "ball.usdc", tmp_path / "asset.usdc")
    before = (tmp_path / "asset.usdc").read_bytes()
    (tmp_path / "scene.yaml").write_text("bodies: [{asset: asset.usdc}]\nduration: 0.1")
    with pytest.raises(RequestError, match=r"would overwrite .*asset\.usdc, which the scene reads"):
        record(tmp_path / "scene.yaml", tmp_path)
    assert (tmp_path / "asset.usdc").read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["asset.usdc", "scene.yaml"]


def test_pinned_bodies_hang_and_damaged_resume_files_are_passed_over(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "hang.yaml").write_text(
        f"bodies: [{{asset: {folder / 'ball.usdc'}, size: 0.2, position: [0, 0, 0.5], material: silicone, "
        "pins: {minimum: [-1, -1, 0.67]}}]\nduration: 0.2\ncamera: {width: 64, height: 48}"
    )
    first = record(tmp_path / "hang.yaml", tmp_path / "out")
    reader = SimulationReader(first.simulation)
    heights = [reader.frame(i).bodies[0].vertices[:, 2] for i in (0, 6)]
    assert heights[1].max() == pytest.approx(heights[0].max(), abs=1e-3), "the top is held"
    assert heights[1].min() < heights[0].min() - 1e-4, "the rest sags"

    class Stop(Exception):
        pass

    def stop(phase: str, done: int, total: int) -> None:
        if phase == "simulate" and done == 4:
            raise Stop

    with pytest.raises(Stop):
        record(tmp_path / "hang.yaml", tmp_path / "again", on_progress=stop)
    damaged = tmp_path / "again/.resume/frame_00002.npz"
    damaged.write_bytes(damaged.read_bytes()[:100])
    second = record(tmp_path / "hang.yaml", tmp_path / "again")
    assert second.resumed_frames == 2
    assert np.array_equal(SimulationReader(second.simulation).frame(6).bodies[0].vertices[:, 2], heights[1])


def test_debug_shows_the_traceback(folder: Path) -> None:
    done = gdpro("info", "missing.usdc", "--debug", cwd=folder, ok=False)
    assert done.returncode == 2 and "Traceback" in done.stderr


@pytest.mark.slow
@posix_only
@pytest.mark.parametrize("how", ["SIGINT", "SIGKILL"])
def test_a_stopped_run_continues_to_the_same_frames(folder: Path, how: str, tmp_path: Path) -> None:
    (folder / "long.yaml").write_text(SCENE.format(duration=1.5))
    output = tmp_path / "stopped"
    command = [sys.executable, "-m", "gdpro_sim.cli", "simulate", "long.yaml", "-o", str(output), "--quiet"]
    process = subprocess.Popen(
        command,
        cwd=folder,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in a background job the shell has told them to ignore Ctrl-C.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    deadline = time.monotonic() + 120
    while len(list((output / "frames").glob("frame_*.png"))) < 8 and process.poll() is None:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    os.kill(process.pid, getattr(signal, how))
    _, errors = process.communicate(timeout=60)
    assert process.returncode == (130 if how == "SIGINT" else -9)
    if how == "SIGINT":
        assert errors.strip() == "gdpro: interrupted; finished frames are kept, the same command continues"
    kept = len(list((output / ".resume").glob("frame_*.npz")))
    assert kept >= 7
    assert not (output / "preview.mp4").exists()

    done = gdpro("simulate", "long.yaml", "-o", output, "--json", cwd=folder)
    assert json.loads(done.stdout)["resumed_frames"] == kept
    assert not list(output.glob(".*"))
    straight = tmp_path / "straight"
    straight.mkdir()
    # Tets are not repeatable: the undisturbed run starts from the stopped run's asset.
    scene = SCENE.format(duration=1.5).replace("ball.obj", str(output / "asset.usdc"))
    scene = scene.replace("    budget: 1500\n", "")
    (straight / "scene.yaml").write_text(scene.replace("  - asset", "  - name: ball\n    asset"))
    gdpro("simulate", straight / "scene.yaml", "-o", straight / "out", cwd=straight)
    for name in sorted(p.name for p in (output / "frames").iterdir()):
        assert (output / "frames" / name).read_bytes() == (straight / "out/frames" / name).read_bytes(), name
