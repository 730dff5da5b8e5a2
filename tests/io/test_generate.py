"""Runs in a folder: what they leave, that they can be killed, and what is refused."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

import gdpro_sim
from gdpro_sim.asset import Asset
from gdpro_sim.errors import GdproError, GuidanceError, RequestError
from gdpro_sim.generation.config import load_config
from gdpro_sim.io.generate import Request, generate_run
from gdpro_sim.io.images import read_png
from gdpro_sim.io.sources import Inputs
from tests.conditions import posix_only
from tests.generation.test_pipeline import SMALL

PROMPT = "a green apple"


def request(prompt: str = PROMPT, seed: int = 0, **output: Any) -> Request:
    base = {**SMALL, "output": {**SMALL["output"], "turntable_views": 3, "picture_size": 48, **output}}
    return Request(Inputs(prompt=prompt), load_config(base=base), seed)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Asset]:
    folder = tmp_path_factory.mktemp("generate") / "run"
    return folder, generate_run(request(), folder).asset


def test_the_folder_holds_pictures_states_and_figures(run: tuple[Path, Asset]) -> None:
    folder, _ = run
    assert {p.name for p in folder.iterdir()} == {
        "run.json", "log.jsonl", "timing.json",
        *(f"{name}.{kind}" for name in ("prior", "surfels", "extraction", "refinement")
          for kind in ("png", "safetensors")),
    }  # fmt: skip
    rows = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    assert [(r["stage"], r["iteration"]) for r in rows] == [
        *(("surfels", i + 1) for i in range(24)), *(("refinement", i + 1) for i in range(10))
    ]  # fmt: skip
    assert all(r["psnr"] is None or 5.0 < r["psnr"] < 60.0 for r in rows)
    assert any(r["psnr"] is not None for r in rows)
    timing = json.loads((folder / "timing.json").read_text())
    assert {"render", "guidance", "backward", "optimizer"} <= set(timing["parts"]["surfels"])
    picture = read_png(folder / "refinement.png")
    assert picture.std() > 5.0, "something is on it"


def test_the_same_request_goes_on_and_gives_the_same_asset(run: tuple[Path, Asset], tmp_path: Path) -> None:
    folder, asset = run
    seen: list[str] = []

    def note(part: str, done: int, total: int, figures: Mapping[str, Any]) -> None:
        seen.append(part)

    again = generate_run(request(), folder, on_progress=note).asset
    assert "surfels" not in seen and "refinement" not in seen, "nothing was left to do"
    asset.save(tmp_path / "a.usdc")
    again.save(tmp_path / "b.usdc")
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()
    assert Request.read(folder) == request()


def test_another_request_is_refused_or_replaces(run: tuple[Path, Asset], tmp_path: Path) -> None:
    folder, _ = run
    with pytest.raises(RequestError, match=r"another run \(its seed differ"):
        generate_run(request(seed=1), folder)
    few = {
        "surfels": {**SMALL["surfels"], "iterations": 2},
        "refinement": {"iterations": 1, "resolution": 32},
    }
    first = Request(
        Inputs(prompt="a red mug"), load_config(base={**SMALL, **few, "output": {"turntable_views": 0}})
    )
    second = Request(Inputs(prompt=PROMPT), first.config)
    generate_run(first, tmp_path / "run")
    made = generate_run(second, tmp_path / "run", anew=True).asset
    assert made.provenance["prompt"] == PROMPT


def test_a_damaged_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        generate_run(request(turntable_views=0), tmp_path, on_progress=interrupt_at("surfels", 9))
    file = tmp_path / "surfels.safetensors"
    file.write_bytes(file.read_bytes()[:100])
    with pytest.raises(GuidanceError, match=r"surfels\.safetensors: damaged checkpoint"):
        generate_run(request(turntable_views=0), tmp_path)


def interrupt_at(stage: str, iteration: int) -> Any:
    def stop(part: str, done: int, total: int, figures: Mapping[str, Any]) -> None:
        if part == stage and done == iteration:
            raise KeyboardInterrupt

    return stop


def test_an_interrupted_run_goes_on_to_the_same_bytes(run: tuple[Path, Asset], tmp_path: Path) -> None:
    folder = tmp_path / "run"
    for stage, iteration in (("surfels", 3), ("surfels", 18), ("refinement", 6)):
        with pytest.raises(KeyboardInterrupt):
            generate_run(request(), folder, on_progress=interrupt_at(stage, iteration))
    generate_run(request(), folder).asset.save(tmp_path / "a.usdc")
    run[1].save(tmp_path / "b.usdc")
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()
    assert (folder / "log.jsonl").read_text() == (run[0] / "log.jsonl").read_text()


def test_a_folder_without_a_run(tmp_path: Path) -> None:
    with pytest.raises(RequestError, match=r"no run\.json"):
        Request.read(tmp_path)
    (tmp_path / "run.json").write_text('{"format": 999}')
    with pytest.raises(RequestError, match="another version"):
        Request.read(tmp_path)
    (tmp_path / "run.json").write_text("{")
    with pytest.raises(RequestError, match="cannot be read"):
        Request.read(tmp_path)


def test_nothing_and_too_much_to_start_from() -> None:
    with pytest.raises(RequestError, match="nothing to generate from"):
        Inputs(prompt="  ")
    with pytest.raises(RequestError, match="mesh and splat"):
        Inputs(mesh="a.obj", splat="b.ply")


def test_from_python_without_a_folder() -> None:
    config = request().config
    few = config.model_copy(
        update={
            "surfels": config.surfels.model_copy(update={"iterations": 2}),
            "refinement": config.refinement.model_copy(update={"iterations": 1}),
        }
    )
    asset = gdpro_sim.generate("a red mug with a blue handle", config=few, seed=1)
    assert isinstance(asset, Asset) and asset.name == "red_mug_with_blue_handle"
    assert asset.provenance["read_as"]["parts"]["handle"]["colors"] == ["blue"]
    with pytest.raises(GdproError, match="quantum"):
        gdpro_sim.generate("a quantum mug", config=few)


SCRIPT = """
import os, signal, sys
from pathlib import Path
from tests.io.test_generate import request
from gdpro_sim.io.generate import generate_run
folder, out, stage, iteration = sys.argv[1:]
def kill(part, done, total, figures):
    if part == stage and done == int(iteration):
        os.kill(os.getpid(), signal.SIGKILL)
generate_run(request(turntable_views=0), Path(folder), on_progress=kill).asset.save(out)
"""


@posix_only
@pytest.mark.slow
def test_a_killed_run_goes_on_to_the_same_bytes(tmp_path: Path) -> None:
    def start(name: str, stage: str = "", iteration: int = 0) -> int:
        out = tmp_path / f"{name}.usdc"
        command = [sys.executable, "-c", SCRIPT, str(tmp_path / name), str(out), stage, str(iteration)]
        root = Path(__file__).resolve().parents[2]
        return subprocess.run(command, cwd=root, timeout=300, check=False).returncode

    assert start("killed", "surfels", 17) == -signal.SIGKILL
    assert start("killed", "refinement", 7) == -signal.SIGKILL
    assert not (tmp_path / "killed.usdc").exists()
    assert start("killed") == 0 and start("whole") == 0
    assert (tmp_path / "killed.usdc").read_bytes() == (tmp_path / "whole.usdc").read_bytes()


LIMITED = """
import resource, sys
from pathlib import Path
from tests.io.test_generate import request
from gdpro_sim.errors import OutputError
from gdpro_sim.io.generate import generate_run
def limit(part, done, total, figures):
    if part == "surfels" and done == 10:
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
import signal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
try:
    generate_run(request(turntable_views=0), Path(sys.argv[1]), on_progress=limit)
except OutputError as error:
    print(error)
"""


@posix_only
@pytest.mark.slow
def test_a_full_disk_stops_with_the_last_checkpoint_intact(run: tuple[Path, Asset], tmp_path: Path) -> None:
    root = Path(__file__).resolve().parents[2]
    folder = tmp_path / "run"
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(folder)],
        cwd=root, capture_output=True, text=True, timeout=300,
        env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert "no space left on the disk" in done.stdout, done.stderr
    assert not list(folder.glob(".*.tmp*")), "nothing half-written stays"
    asset = generate_run(request(turntable_views=0), folder).asset
    asset.save(tmp_path / "a.usdc")
    reference = generate_run(request(turntable_views=0)).asset
    reference.save(tmp_path / "b.usdc")
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()
