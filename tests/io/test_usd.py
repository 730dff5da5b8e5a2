"""Simulation files: exact positions, honest interruption, and what other programs see."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Usd, UsdGeom

from gdpro_sim.asset import Asset, kind
from gdpro_sim.errors import AssetError, OutputError, RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io import usd
from gdpro_sim.io.usd import BodyRecord, SimulationReader, SimulationWriter, is_simulation
from gdpro_sim.simulation.frame import BodyFrame, Frame
from gdpro_sim.simulation.model import Diagnostics
from tests.asset.sample import assert_bits, make_asset
from tests.asset.test_asset import validation_errors
from tests.conditions import posix_only

SUFFIXES = (".usdc", ".usda", ".usdz")


def figures(i: int) -> Diagnostics:
    return Diagnostics(
        time=i / 30, kinetic_energy=1 / 3, elastic_energy=2.0, gravity_energy=-0.0, contact_energy=1e-300,
        momentum=(0.1, 0.2, 0.3), angular_momentum=(1 / 3, -1.0, 0.0), contacts=i, max_penetration=1e-9,
        min_volume_ratio=0.9, substeps=2, newton_iterations=3, cg_iterations=2**40, converged=i % 2 == 0,
        residual=1e-7,
    )  # fmt: skip


def body_frame(asset: Asset, name: str, i: int) -> BodyFrame:
    """Body stretched, turned and moved by `i`."""
    angle = 0.2 * i
    turn = torch.tensor(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]],
        dtype=torch.float32,
    )
    moved = (asset.gaussians.vertices * torch.tensor([1, 1, 1 + 0.05 * i])) @ turn.T + torch.tensor(
        [0.1 * i, 0, 1.0]
    )
    return BodyFrame(name, moved.numpy(), asset.gaussians.gaussians(moved))


def make_frame(assets: dict[str, Asset], i: int) -> Frame:
    return Frame(i, i / 30, tuple(body_frame(a, n, i) for n, a in assets.items()), figures(i))


@pytest.fixture(scope="module")
def assets() -> dict[str, Asset]:
    return {"jelly": make_asset(120, 1, odd=False), "jelly!": make_asset(60, 0, 4, odd=False)}


def records(assets: dict[str, Asset]) -> list[BodyRecord]:
    return [BodyRecord(n, a.gaussians, a.vertex_colors, a.tets, a.material) for n, a in assets.items()]


def assert_gaussians(a: Gaussians, b: Gaussians, *names: str) -> None:
    for name in names or [f.name for f in fields(a)]:
        assert_bits(name, getattr(a, name).numpy(), getattr(b, name).numpy())


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_frames_come_back_exactly(tmp_path: Path, assets: dict[str, Asset], suffix: str) -> None:
    path = tmp_path / f"s{suffix}"
    frames = [make_frame(assets, i) for i in range(4)]
    with SimulationWriter(
        path, 24, records(assets), animate_sh=True, metadata={"scene": "é"}, gravity=(0, 0, -9.81), ground=0.0
    ) as writer:
        for frame in frames:
            writer.add(frame)
        assert not path.exists()
    assert os.listdir(tmp_path) == [path.name]
    assert is_simulation(path) and kind(path) == "simulation"
    reader = SimulationReader(path)
    assert (len(reader), reader.fps, reader.body_names) == (4, 24.0, ("jelly", "jelly!"))
    assert reader.metadata == {"scene": "é"} and reader.times == [f.time for f in frames]
    for wanted, found in zip(frames, reader, strict=True):
        assert (wanted.index, wanted.time, wanted.diagnostics) == (found.index, found.time, found.diagnostics)
        for a, b in zip(wanted.bodies, found.bodies, strict=True):
            assert_bits("vertices", a.vertices, b.vertices)
            assert_gaussians(a.gaussians, b.gaussians)
    for record, body in zip(records(assets), reader.bodies, strict=True):
        assert (record.name, record.material) == (body.name, body.material)
        for f in fields(record.gaussians):
            assert_bits(
                f.name, getattr(record.gaussians, f.name).numpy(), getattr(body.gaussians, f.name).numpy()
            )
        assert_bits("vertex_colors", record.vertex_colors, body.vertex_colors)
        assert record.tets is not None and body.tets is not None
        assert_bits("tets", record.tets.tets, body.tets.tets)
        assert_bits("tet vertices", record.tets.vertices, body.tets.vertices)


def test_half_precision_keeps_positions_and_rounds_the_rest(tmp_path: Path, assets: dict[str, Asset]) -> None:
    path = tmp_path / "s.usdc"
    frames = [make_frame(assets, i) for i in range(3)]
    with SimulationWriter(path, 30, records(assets), precision="half") as writer:
        for frame in frames:
            writer.add(frame)
    for wanted, found in zip(frames, SimulationReader(path), strict=True):
        for a, b in zip(wanted.bodies, found.bodies, strict=True):
            assert_gaussians(a.gaussians, b.gaussians, "means", "opacities")
            torch.testing.assert_close(b.gaussians.scales, a.gaussians.scales, rtol=2**-11, atol=3e-8)
            torch.testing.assert_close(b.gaussians.quats, a.gaussians.quats, rtol=0, atol=2**-11)


def test_without_animated_sh_the_first_frame_serves(tmp_path: Path, assets: dict[str, Asset]) -> None:
    path = tmp_path / "s.usdc"
    frames = [make_frame(assets, i) for i in range(3)]
    with SimulationWriter(path, 30, records(assets)) as writer:
        for frame in frames:
            writer.add(frame)
    for found in SimulationReader(path):
        assert_gaussians(found.bodies[0].gaussians, frames[0].bodies[0].gaussians, "sh")


@pytest.mark.parametrize("flush", [0, 1 << 40])
def test_appending_often_or_once_reads_the_same(
    tmp_path: Path, assets: dict[str, Asset], flush: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(usd, "_FLUSH_BYTES", flush)
    frames = [make_frame(assets, i) for i in range(5)]
    with SimulationWriter(tmp_path / "s.usdc", 30, records(assets)) as writer:
        for frame in frames:
            writer.add(frame)
    for wanted, found in zip(frames, SimulationReader(tmp_path / "s.usdc"), strict=True):
        assert_bits("vertices", wanted.bodies[1].vertices, found.bodies[1].vertices)


def test_the_same_frames_give_the_same_bytes(tmp_path: Path, assets: dict[str, Asset]) -> None:
    for name in ("a.usdc", "b.usdc"):
        with SimulationWriter(tmp_path / name, 30, records(assets)) as writer:
            for i in range(3):
                writer.add(make_frame(assets, i))
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()


# ---- endings ----


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt])
def test_an_interrupted_run_keeps_its_frames(
    tmp_path: Path, assets: dict[str, Asset], error: type[BaseException]
) -> None:
    path = tmp_path / "s.usdc"
    with pytest.raises(error), SimulationWriter(path, 30, records(assets)) as writer:
        writer.add(make_frame(assets, 0))
        writer.add(make_frame(assets, 1))
        raise error
    assert len(SimulationReader(path)) == 2
    assert Usd.Stage.Open(str(path)).GetEndTimeCode() == 1
    assert os.listdir(tmp_path) == ["s.usdc"]


def test_abort_and_no_frames_leave_what_was_there(tmp_path: Path, assets: dict[str, Asset]) -> None:
    path = tmp_path / "s.usdc"
    path.write_text("old")
    writer = SimulationWriter(path, 30, records(assets))
    writer.add(make_frame(assets, 0))
    writer.abort()
    writer.close()
    with SimulationWriter(path, 30, records(assets)):
        pass
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["s.usdc"]
    with pytest.raises(ValueError, match="closed"):
        writer.add(make_frame(assets, 0))


def test_a_new_file_under_an_old_name_is_read_fresh(tmp_path: Path, assets: dict[str, Asset]) -> None:
    path = tmp_path / "s.usdc"
    readers = []
    for count in (1, 3):
        with SimulationWriter(path, 30, records(assets)) as writer:
            for i in range(count):
                writer.add(make_frame(assets, i))
        readers.append(SimulationReader(path))
        assert len(readers[-1]) == count


def test_frames_that_do_not_fit_are_refused(tmp_path: Path, assets: dict[str, Asset]) -> None:
    frame = make_frame(assets, 0)
    first, second = frame.bodies
    bad = first.vertices.copy()
    bad[0, 0] = np.nan
    with SimulationWriter(tmp_path / "s.usdc", 30, records(assets)) as writer:
        for bodies, message in (
            ((first,), "has bodies"),
            ((BodyFrame(first.name, first.vertices[:3], first.gaussians), second), "vertices must be"),
            ((BodyFrame(first.name, first.vertices, second.gaussians), second), "60 Gaussians, expected 120"),
            ((BodyFrame(first.name, bad, first.gaussians), second), "not finite"),
        ):
            with pytest.raises(ValueError, match=message):
                writer.add(Frame(0, 0.0, bodies, figures(0)))
        writer.add(frame)
        with pytest.raises(ValueError, match="must increase"):
            writer.add(frame)
    assert len(SimulationReader(tmp_path / "s.usdc")) == 1


def test_requests_that_cannot_work_are_refused_at_once(tmp_path: Path, assets: dict[str, Asset]) -> None:
    bodies = records(assets)
    for path, message in (("s.mp4", "must end in"), ("absent/s.usdc", "does not exist")):
        with pytest.raises(RequestError, match=message):
            SimulationWriter(tmp_path / path, 30, bodies)
    with pytest.raises(RequestError, match="fps"):
        SimulationWriter(tmp_path / "s.usdc", 0, bodies)
    with pytest.raises(RequestError, match="unique names"):
        SimulationWriter(tmp_path / "s.usdc", 30, [bodies[0], bodies[0]])
    with pytest.raises(RequestError, match="precision"):
        SimulationWriter(tmp_path / "s.usdc", 30, bodies, precision="double")  # type: ignore[arg-type]
    assert os.listdir(tmp_path) == []


@posix_only
def test_a_full_disk_is_an_output_error(tmp_path: Path) -> None:
    """A limit on file size makes USD's own writes fail, as a full disk does: on appending and on closing."""
    path = tmp_path / "s.usdc"
    path.write_text("old")
    code = """
import resource, sys
from gdpro_sim.errors import OutputError
from gdpro_sim.io import usd
from tests.asset.sample import make_asset
from tests.io.test_usd import make_frame, records
assets = {"a": make_asset(2_000, 0, odd=False)}
frames = [make_frame(assets, i) for i in range(4)]
resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, resource.RLIM_INFINITY))
for usd._FLUSH_BYTES in (0, 1 << 40):
    try:
        with usd.SimulationWriter(sys.argv[1], 30, records(assets)) as writer:
            for frame in frames:
                writer.add(frame)
    except OutputError as error:
        print("REFUSED", error)
"""
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run([sys.executable, "-c", code, str(path)], cwd=root, capture_output=True, text=True)
    assert done.stdout.count("REFUSED cannot write") == 2, done.stdout + done.stderr
    assert path.read_text() == "old" and os.listdir(tmp_path) == ["s.usdc"]


def test_a_failing_rename_is_an_output_error(
    tmp_path: Path, assets: dict[str, Asset], monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with (
        pytest.raises(OutputError, match="no space left"),
        SimulationWriter(tmp_path / "s.usdc", 30, records(assets)) as writer,
    ):
        writer.add(make_frame(assets, 0))
    assert os.listdir(tmp_path) == []


# ---- what other programs see ----


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory, assets: dict[str, Asset]) -> Usd.Stage:
    path = tmp_path_factory.mktemp("sim") / "s.usdc"
    with SimulationWriter(path, 30, records(assets), gravity=(0, 0, -9.81), ground=0.0) as writer:
        for i in range(3):
            writer.add(make_frame(assets, i))
    return Usd.Stage.Open(str(path))


def test_validators_find_nothing_and_gprims_do_not_nest(stage: Usd.Stage) -> None:
    assert validation_errors(stage) == []
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim):
            assert not prim.GetParent().IsA(UsdGeom.Gprim), prim.GetPath()


def test_samples_stand_at_frame_numbers_with_defaults_beside_them(stage: Usd.Stage) -> None:
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetTimeCodesPerSecond()) == (0, 2, 30)
    for name, attributes in {
        "Mesh": ("points", "normals", "extent"),
        "Splats": ("positions", "orientations", "scales", "extent"),
        "Points": ("points", "widths", "extent", "primvars:rot", "primvars:scale"),
    }.items():
        prim = stage.GetPrimAtPath(f"/Simulation/jelly/{name}")
        for attribute in (prim.GetAttribute(a) for a in attributes):
            assert attribute.GetTimeSamples() == [0, 1, 2], attribute.GetPath()
            assert attribute.Get() == attribute.Get(0), attribute.GetPath()
    for name in ("opacities", "radiance:sphericalHarmonicsCoefficients"):
        attribute = stage.GetPrimAtPath("/Simulation/jelly/Splats").GetAttribute(name)
        assert attribute.HasAuthoredValue() and attribute.GetNumTimeSamples() == 0


def test_bodies_of_any_name_get_prims_of_their_own(stage: Usd.Stage) -> None:
    children = [p.GetName() for p in stage.GetPrimAtPath("/Simulation").GetChildren()]
    assert children == ["jelly", "jelly_", "PhysicsScene", "Ground"]


def test_extents_hold_every_splat(stage: Usd.Stage, assets: dict[str, Asset]) -> None:
    for i in range(3):
        g = make_frame(assets, i).bodies[0].gaussians
        low, high = np.array(stage.GetPrimAtPath("/Simulation/jelly/Splats").GetAttribute("extent").Get(i))
        reach = 3 * g.scales.max(1).values[:, None]
        np.testing.assert_allclose(low, (g.means - reach).min(0).values, rtol=1e-5)
        np.testing.assert_allclose(high, (g.means + reach).max(0).values, rtol=1e-5)


def test_files_that_are_no_simulation_are_refused(tmp_path: Path) -> None:
    make_asset().save(tmp_path / "a.usdc")
    with pytest.raises(AssetError, match="not a gdpro simulation file: it holds an asset"):
        SimulationReader(tmp_path / "a.usdc")
    assert not is_simulation(tmp_path / "a.usdc")
    with pytest.raises(AssetError, match="no such file"):
        SimulationReader(tmp_path / "absent.usdc")


def test_frames_beyond_the_end_are_an_index_error(tmp_path: Path, assets: dict[str, Asset]) -> None:
    with SimulationWriter(tmp_path / "s.usdc", 30, records(assets)) as writer:
        writer.add(make_frame(assets, 0))
    with pytest.raises(IndexError, match="frames 0-0, got 1"):
        SimulationReader(tmp_path / "s.usdc").frame(1)
