"""Assets: checks on their parts, files that give everything back, and files that cannot be read."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pxr import Sdf, Usd, UsdGeom, UsdValidation

from gdpro_sim.asset import Asset, is_asset, kind
from gdpro_sim.errors import AssetError, OutputError, RequestError
from gdpro_sim.meshing.tetmesh import TetMesh
from tests.asset.sample import assert_bits, assert_same, make_asset, make_bound
from tests.conditions import posix_only

SUFFIXES = (".usdc", ".usda", ".usdz")


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_everything_comes_back_bit_for_bit(tmp_path: Path, suffix: str, degree: int) -> None:
    asset = make_asset(degree=degree)
    path = tmp_path / f"asset{suffix}"
    asset.save(path)
    assert_same(asset, Asset.load(path))
    assert kind(path) == "asset" and is_asset(path)
    assert os.listdir(tmp_path) == [path.name]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_an_asset_of_gaussians_alone_comes_back(tmp_path: Path, suffix: str) -> None:
    asset = Asset("bare", make_bound(50, 0))
    asset.save(tmp_path / f"a{suffix}")
    again = Asset.load(tmp_path / f"a{suffix}")
    assert_same(asset, again)
    assert again.tets is None and again.material is None and again.vertex_colors is None


def test_saving_again_replaces_the_file_and_is_read_fresh(tmp_path: Path) -> None:
    path = tmp_path / "a.usdc"
    make_asset().save(path)
    held = Usd.Stage.Open(str(path))
    other = replace(make_asset(), name="second")
    other.save(path)
    assert Asset.load(path).name == "second"
    del held


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_the_same_asset_gives_the_same_bytes(tmp_path: Path, suffix: str) -> None:
    asset = make_asset()
    asset.save(tmp_path / f"a{suffix}")
    os.utime(tmp_path / f"a{suffix}", (0, 0))
    (tmp_path / "other").mkdir()
    Asset.load(tmp_path / f"a{suffix}").save(tmp_path / "other" / f"a{suffix}")
    assert (tmp_path / f"a{suffix}").read_bytes() == (tmp_path / "other" / f"a{suffix}").read_bytes()


def test_another_process_writes_the_same_bytes(tmp_path: Path) -> None:
    make_asset().save(tmp_path / "a.usdc")
    code = "import sys; from tests.asset.sample import make_asset; make_asset().save(sys.argv[1])"
    root = Path(__file__).resolve().parents[2]
    for seed in ("1",):
        subprocess.run(
            [sys.executable, "-c", code, str(tmp_path / "b.usdc")],
            check=True,
            cwd=root,
            env={**os.environ, "PYTHONHASHSEED": seed},
            capture_output=True,
        )
        assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()


# ---- what other programs see ----


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Usd.Stage:
    path = tmp_path_factory.mktemp("asset") / "a.usdc"
    make_asset(odd=False).save(path)
    return Usd.Stage.Open(str(path))


def test_the_stage_declares_our_units(stage: Usd.Stage) -> None:
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetRootLayer().pseudoRoot.GetInfo("kilogramsPerUnit") == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/Asset"


def test_splats_are_linear_and_ordered_as_usd_wants(stage: Usd.Stage) -> None:
    rest = make_asset(odd=False).gaussians.gaussians()
    prim = stage.GetPrimAtPath("/Asset/Splats")
    assert prim.GetTypeName() == "ParticleField3DGaussianSplat"
    np.testing.assert_array_equal(np.array(prim.GetAttribute("positions").Get()), rest.means.numpy())
    np.testing.assert_array_equal(np.array(prim.GetAttribute("scales").Get()), rest.scales.numpy())
    np.testing.assert_array_equal(np.array(prim.GetAttribute("opacities").Get()), rest.opacities.numpy())
    first = prim.GetAttribute("orientations").Get()[0]
    assert [first.GetReal(), *first.GetImaginary()] == rest.quats[0].tolist()
    coefficients = prim.GetAttribute("radiance:sphericalHarmonicsCoefficients")
    assert coefficients.GetMetadata("elementSize") == 4
    assert coefficients.GetMetadata("interpolation") == "vertex"
    assert coefficients.GetColorSpace() == "srgb_rec709_scene"
    low, high = np.array(prim.GetAttribute("extent").Get())
    reach = 3 * rest.scales.max(1).values[:, None]
    np.testing.assert_allclose(low, (rest.means - reach).min(0).values, rtol=1e-6)
    np.testing.assert_allclose(high, (rest.means + reach).max(0).values, rtol=1e-6)


def test_gprims_do_not_nest(stage: Usd.Stage) -> None:
    for prim in stage.Traverse():
        if prim.IsA(UsdGeom.Gprim):
            assert not prim.GetParent().IsA(UsdGeom.Gprim), prim.GetPath()


def test_usd_validators_find_nothing(stage: Usd.Stage) -> None:
    assert validation_errors(stage) == []


def test_usd_validators_are_awake() -> None:
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Mesh.Define(stage, "/A")
    UsdGeom.Points.Define(stage, "/A/B")
    assert validation_errors(stage)


def validation_errors(stage: Usd.Stage) -> list[str]:
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    errors = UsdValidation.ValidationContext(validators).Validate(stage)
    return [f"{e.GetName()}: {e.GetMessage()}" for e in errors]


# ---- parts that do not fit ----


def test_scaling_resizes_mesh_gaussians_and_tets() -> None:
    asset = make_asset(odd=False)
    big = asset.scaled(2.0)
    before, after = asset.gaussians.gaussians(), big.gaussians.gaussians()
    torch.testing.assert_close(after.means, 2 * before.means)
    torch.testing.assert_close(after.scales, 2 * before.scales)
    assert asset.tets is not None and big.tets is not None
    np.testing.assert_allclose(big.tets.volumes(), 8 * asset.tets.volumes(), rtol=1e-6)
    assert big.embedding is asset.embedding
    assert asset.scaled(1.0) is asset
    for bad in (0.0, -1.0, float("nan"), float("inf")):
        with pytest.raises(AssetError, match="scale must be"):
            asset.scaled(bad)


def test_summary_counts_and_weighs() -> None:
    asset = make_asset(odd=False)
    summary = asset.summary()
    assert (summary["gaussians"], summary["sh_degree"], summary["tets"]) == (200, 1, 2)
    assert asset.tets is not None and asset.material is not None
    volume = float((asset.tets.volumes() * asset.tets.fill).sum())
    assert summary["mass"] == pytest.approx(volume * asset.material.density)
    np.testing.assert_allclose(summary["size"], [2, 2, 2], rtol=1e-5)


def broken_parts() -> list[tuple[str, dict]]:
    asset = make_asset()
    g, tets, embedding = asset.gaussians, asset.tets, asset.embedding
    assert tets is not None and embedding is not None and asset.vertex_colors is not None
    nan = g.vertices.clone()
    nan[3, 1] = float("nan")
    flipped = TetMesh(tets.vertices, np.ascontiguousarray(tets.tets[:, [1, 0, 2, 3]]), tets.fill, "tetwild")
    return [
        ("faces holds 99", {"gaussians": replace(g, faces=torch.full_like(g.faces, 99))}),
        ("faces holds -1", {"gaussians": replace(g, faces=torch.full_like(g.faces, -1))}),
        ("face_ids holds 5000", {"gaussians": replace(g, face_ids=torch.full_like(g.face_ids, 5000))}),
        (r"barycentrics\[\d+\] must sum to 1", {"gaussians": replace(g, barycentrics=2 * g.barycentrics)}),
        (r"vertices\[3\] is not finite", {"gaussians": replace(g, vertices=nan)}),
        ("log_scales must be float32", {"gaussians": replace(g, log_scales=g.log_scales.double())}),
        (r"opacity_logits must be float32 \[200\]", {"gaussians": replace(g, opacity_logits=g.sh[:9, 0, 0])}),
        ("sh must be", {"gaussians": replace(g, sh=g.sh[:, :2])}),
        ("is empty", {"gaussians": replace(g, faces=g.faces[:0])}),
        ("vertex_colors must be", {"vertex_colors": asset.vertex_colors[:3]}),
        ("come together", {"embedding": None}),
        ("tet_ids holds 3", {"embedding": replace(embedding, tet_ids=embedding.tet_ids + np.int32(2))}),
        (r"weights\[\d+\] must sum to 1", {"embedding": replace(embedding, weights=2 * embedding.weights)}),
        ("volume", {"tets": flipped}),
        ("fill must lie", {"tets": replace(tets, fill=np.zeros(2, np.float32))}),
        ("holds 7, but there are 5", {"tets": replace(tets, tets=np.full((2, 4), 7, np.int32))}),
        ("JSON", {"provenance": {"x": object()}}),
        ("JSON", {"provenance": {"x": float("nan")}}),
    ]


@pytest.mark.parametrize(("message", "change"), broken_parts(), ids=lambda v: v if isinstance(v, str) else "")
def test_parts_that_do_not_fit_are_refused(message: str, change: dict) -> None:
    with pytest.raises(AssetError, match=message):
        replace(make_asset(), **change)


# ---- files that cannot be read ----


def test_unreadable_files_say_why_in_one_line(tmp_path: Path) -> None:
    good = tmp_path / "good.usdc"
    make_asset().save(good)
    data = good.read_bytes()
    cases = {
        "missing.usdc": (None, "no such file"),
        "short.usdc": (data[: len(data) // 2], "truncated"),
        "empty.usdc": (b"", "cannot be read as USD"),
        "noise.usdc": (b"hello, this is no USD file at all", "cannot be read as USD"),
        "noise.usda": (b"hello", "cannot be read as USD"),
        "noise.usdz": (b"PK\x03\x04hello", "cannot be read as USD"),
        "mesh.obj": (b"v 0 0 0\n", "gdpro import"),
    }
    for name, (content, message) in cases.items():
        path = tmp_path / name
        if content is not None:
            path.write_bytes(content)
        with pytest.raises(AssetError, match=message) as caught:
            Asset.load(path)
        assert name in str(caught.value) and "\n" not in str(caught.value)
    with pytest.raises(AssetError, match="is a folder"):
        Asset.load(tmp_path)


def test_usd_of_others_is_no_asset(tmp_path: Path) -> None:
    path = tmp_path / "scene.usda"
    stage = Usd.Stage.CreateNew(str(path))
    UsdGeom.Mesh.Define(stage, "/A")
    stage.Save()
    del stage
    with pytest.raises(AssetError, match="not a gdpro asset file"):
        Asset.load(path)
    assert kind(path) == "mesh" and not is_asset(path)
    empty = tmp_path / "empty.usda"
    empty.write_text("#usda 1.0\n")
    assert kind(empty) == "unknown"
    (tmp_path / "a.obj").write_text("v 0 0 0\n")
    assert kind(tmp_path / "a.obj") == "mesh"
    (tmp_path / "a.txt").write_text("x")
    assert kind(tmp_path / "a.txt") == "unknown"
    with pytest.raises(AssetError, match="no such file"):
        kind(tmp_path / "absent.usdc")


@pytest.mark.parametrize(
    ("prim", "attribute", "message"),
    [
        ("/Asset/Splats", "gdpro:binding:rotations", "rotations is missing"),
        ("/Asset/Mesh", "gdpro:embedding:weights", "weights is missing"),
        ("/Asset/PhysicsMaterial", "gdpro:material", "is not a material"),
        ("/Asset/Splats", None, "Splats is missing"),
    ],
)
def test_damaged_assets_name_what_is_missing(
    tmp_path: Path, prim: str, attribute: str | None, message: str
) -> None:
    path = tmp_path / "a.usda"
    make_asset().save(path)
    stage = Usd.Stage.Open(str(path))
    if attribute is None:
        stage.RemovePrim(prim)
    else:
        stage.GetPrimAtPath(prim).RemoveProperty(attribute)
    stage.Save()
    del stage
    with pytest.raises(AssetError, match=message) as caught:
        Asset.load(path)
    assert "a.usda" in str(caught.value)


def test_wrong_sizes_and_newer_versions_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.usda"
    make_asset().save(path)
    layer = Sdf.Layer.FindOrOpen(str(path))
    layer.GetAttributeAtPath("/Asset/Splats.gdpro:binding:logScales").default = [(0, 0, 0)]
    layer.Save()
    with pytest.raises(AssetError, match=r"logScales must be float32 \[200, 3\], got float32 \[1, 3\]"):
        Asset.load(path)
    layer.GetAttributeAtPath("/Asset.gdpro:formatVersion").default = 99
    layer.Save()
    del layer
    with pytest.raises(AssetError, match="format version 99"):
        Asset.load(path)


def test_damaged_bytes_are_an_error_or_a_warning(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Blanked blocks anywhere in the file: never a silent change, never a foreign exception."""
    path = tmp_path / "a.usdc"
    asset = make_asset(400)
    asset.save(path)
    assert_same(asset, Asset.load(path))
    assert not caplog.records
    data = path.read_bytes()
    refused = 0
    for start in range(0, len(data) - 300, 997):
        path.write_bytes(
            data[:start] + bytes(b ^ 0x55 for b in data[start : start + 300]) + data[start + 300 :]
        )
        caplog.clear()
        try:
            found = Asset.load(path)
        except AssetError as error:
            refused += 1
            assert "a.usdc" in str(error)
            continue
        if not caplog.records:
            assert_same(asset, found)
    assert refused > 3


# ---- files that cannot be written ----


@posix_only
def test_paths_that_cannot_be_written_are_refused(tmp_path: Path) -> None:
    asset = make_asset()
    with pytest.raises(AssetError, match=r"must end in \.usdc"):
        asset.save(tmp_path / "a.obj")
    with pytest.raises(RequestError, match="does not exist"):
        asset.save(tmp_path / "absent" / "a.usdc")
    (tmp_path / "file").write_text("")
    with pytest.raises(RequestError, match="is not a folder"):
        asset.save(tmp_path / "file" / "a.usdc")
    (tmp_path / "folder.usdc").mkdir()
    with pytest.raises(RequestError, match="it is a folder"):
        asset.save(tmp_path / "folder.usdc")
    os.mkfifo(tmp_path / "pipe.usdc")
    with pytest.raises(RequestError, match="not a regular file"):
        asset.save(tmp_path / "pipe.usdc")


def test_a_folder_without_permission_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(RequestError, match="no permission"):
        make_asset().save(tmp_path / "a.usdc")
    assert os.listdir(tmp_path) == []


@posix_only
def test_a_full_disk_leaves_the_old_file(tmp_path: Path) -> None:
    """A limit on file size makes USD's own writes fail, as a full disk does."""
    paths = [tmp_path / f"a{suffix}" for suffix in SUFFIXES]
    for path in paths:
        make_asset().save(path)
    before = [path.read_bytes() for path in paths]
    code = """
import resource, sys
from gdpro_sim.errors import OutputError
from tests.asset.sample import make_asset
asset = make_asset(20_000)
asset.gaussians.gaussians()
resource.setrlimit(resource.RLIMIT_FSIZE, (40_000, resource.RLIM_INFINITY))
for path in sys.argv[1:]:
    try:
        asset.save(path)
    except OutputError as error:
        print("REFUSED", error)
"""
    root = Path(__file__).resolve().parents[2]
    command = [sys.executable, "-c", code, *map(str, paths)]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True)
    for path in paths:
        assert f"REFUSED cannot write {path}" in done.stdout, done.stdout + done.stderr
    assert [path.read_bytes() for path in paths] == before
    assert len(os.listdir(tmp_path)) == len(paths)


def test_a_failing_rename_removes_the_temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OutputError, match="no space left"):
        make_asset().save(tmp_path / "a.usdc")
    assert os.listdir(tmp_path) == []


def test_bits_helper_sees_negative_zero() -> None:
    with pytest.raises(AssertionError):
        assert_bits("x", np.array([0.0], np.float32), np.array([-0.0], np.float32))
