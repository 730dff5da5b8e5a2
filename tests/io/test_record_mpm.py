"""Runs of particles: what is written, read back, rendered again and continued to the same bytes."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gdpro_sim.io import resume
from gdpro_sim.io.describe import describe
from gdpro_sim.io.images import read_png
from gdpro_sim.io.record import Recording, record
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.io.views import render_file

SCENE = """
bodies:
  - {asset: cube.ply, name: sand, budget: 300, position: [0, 0, 0.01], material: sand, color: tan}
  - name: jelly
    asset: cube.ply
    budget: 300
    position: [0.01, 0, 0.25]
    angular_velocity: [0, 2, 0]
    material: {preset: jelly, rayleigh_stiffness: 1.0e-4}
    pins: {side: top, fraction: 0.2, release: 0.03}
colliders:
  - {kind: box, size: [0.1, 0.1, 0.1], position: [0.3, 0, 0.05]}
  - {kind: sphere, radius: 0.04, position: [0, 0.2, 0.3], mass: 0.5, velocity: [0, -1, 0]}
fps: 100
duration: 0.06
camera: {width: 96, height: 64}
solver: {kind: mpm, particles: 600}
"""


class Stop(Exception):
    pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mpm")
    trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().export(path / "cube.ply")
    (path / "scene.yaml").write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def straight(folder: Path) -> Recording:
    return record(folder / "scene.yaml", folder / "straight", device="cpu")


def test_everything_is_written_and_read_back(straight: Recording, folder: Path) -> None:
    assert straight.particles > 400 and straight.tets == 0
    reader = SimulationReader(straight.simulation)
    sand, jelly = reader.bodies
    assert len(sand.gaussians) > len(jelly.gaussians), "sand has Gaussians inside"
    assert sand.tets is None and sand.material is not None and sand.material.preset == "sand"
    assert sand.vertex_colors is not None and len(sand.vertex_colors) == len(sand.gaussians.vertices)
    first, last = reader.frame(0), reader.frame(len(reader) - 1)
    assert first.bodies[0].vertices.max() == pytest.approx(0.21, abs=1e-3)
    assert last.bodies[1].vertices[:, 2].min() < first.bodies[1].vertices[:, 2].min()
    assert all(np.isfinite(body.vertices).all() for body in last.bodies)
    assert last.colliders is not None and last.colliders.shape == (2, 3, 4)
    np.testing.assert_array_equal(last.colliders[0], np.eye(3, 4))
    fallen = 0.5 * 9.81 * last.time**2
    np.testing.assert_allclose(last.colliders[1, :, 3], [0, -last.time, -fallen], rtol=0.02, atol=1e-4)
    facts = describe(straight.simulation)
    assert facts["bodies"]["sand"]["gaussians"] == len(sand.gaussians)
    again = render_file(straight.simulation, folder / "again", device="cpu")
    for path in again:
        np.testing.assert_array_equal(read_png(path), read_png(straight.frames / path.name))


def test_metrics_hold_what_the_solver_has(straight: Recording) -> None:
    rows = list(csv.DictReader(straight.metrics.open()))
    assert len(rows) == straight.frame_count == 7
    assert "cg_iterations" not in rows[0] and "converged" not in rows[0]
    assert int(rows[-1]["substeps"]) > 0 and float(rows[1]["kinetic_energy_J"]) > 0.0
    total = [
        sum(float(row[f"{part}_energy_J"]) for part in ("kinetic", "elastic", "gravity")) for row in rows
    ]
    assert max(total[4:]) <= total[4] * 1.001, "nothing but gravity does work after the release"


@pytest.mark.parametrize("kept", [resume.STATES, 0])
def test_a_stopped_run_continues_to_the_same_bytes(
    straight: Recording, folder: Path, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resume, "STATES", kept)
    output = folder / f"stopped_{kept}"

    def stop(phase: str, done: int, total: int) -> None:
        if phase == "simulate" and done == 4:
            raise Stop

    with pytest.raises(Stop):
        record(folder / "scene.yaml", output, device="cpu", on_progress=stop)
    assert len(list((output / ".resume").glob("state_*.npz"))) == (4 if kept else 2)
    second = record(folder / "scene.yaml", output, device="cpu")
    assert second.resumed_frames == 4
    # The file's own name apart, which USD does not keep.
    assert second.simulation.read_bytes() == straight.simulation.read_bytes()
    for path in sorted(straight.frames.iterdir()):
        assert (second.frames / path.name).read_bytes() == path.read_bytes(), path.name


def test_a_damaged_state_goes_back_one_frame(straight: Recording, folder: Path) -> None:
    output = folder / "damaged"

    def stop(phase: str, done: int, total: int) -> None:
        if phase == "simulate" and done == 4:
            raise Stop

    with pytest.raises(Stop):
        record(folder / "scene.yaml", output, device="cpu", on_progress=stop)
    state = output / ".resume/state_00003.npz"
    state.write_bytes(state.read_bytes()[:1000])
    second = record(folder / "scene.yaml", output, device="cpu")
    assert second.resumed_frames == 3
    assert second.simulation.read_bytes() == straight.simulation.read_bytes()
