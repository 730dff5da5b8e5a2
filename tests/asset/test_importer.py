"""From a mesh file to an asset."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.errors import AssetError, MeshError
from gdpro_sim.materials import Material
from tests.asset.sample import assert_bits, assert_same, make_asset, sphere


@pytest.fixture
def obj(tmp_path: Path) -> Path:
    vertices, faces = sphere(8)
    path = tmp_path / "ball.obj"
    lines = ["v {} {} {}".format(*v) for v in vertices] + ["f {} {} {}".format(*(f + 1)) for f in faces]
    path.write_text("\n".join(lines) + "\n")
    return path


def test_an_import_says_where_it_came_from(obj: Path, tmp_path: Path) -> None:
    phases: list[str] = []
    material = Material.model_validate("rubber")
    asset = import_mesh(
        obj, budget=500, color="tomato", up="z", material=material, tet_method="lattice", target_tets=200,
        seed=3, on_progress=phases.append,
    )  # fmt: skip
    assert asset.name == "ball" and asset.material == material
    assert asset.provenance["source"] == "ball.obj"
    assert asset.provenance["sha256"] == hashlib.sha256(obj.read_bytes()).hexdigest()
    assert asset.provenance["seed"] == 3 and asset.provenance["options"]["color"] == "tomato"
    assert set(asset.provenance["versions"]) == {"gdpro-sim", "warp-lang", "trimesh", "pytetwild", "numpy"}
    assert asset.provenance["tets"]["method"] == "lattice"
    assert phases == [
        "reading the mesh",
        "binding Gaussians",
        "filling with tetrahedra",
        "embedding the surface",
    ]
    assert asset.tets is not None and asset.embedding is not None
    corners = asset.tets.vertices[asset.tets.tets[asset.embedding.tet_ids]]
    carried = np.einsum("vw,vwc->vc", asset.embedding.weights, corners)
    np.testing.assert_allclose(carried, asset.gaussians.vertices.numpy(), atol=1e-5)
    asset.save(tmp_path / "ball.usdc")
    assert_same(asset, Asset.load(tmp_path / "ball.usdc"))


def test_the_same_import_gives_the_same_bytes(obj: Path, tmp_path: Path) -> None:
    for name in ("a.usdc", "b.usdc"):
        import_mesh(obj, budget=400, tet_method="lattice", seed=1).save(tmp_path / name)
    assert (tmp_path / "a.usdc").read_bytes() == (tmp_path / "b.usdc").read_bytes()


def test_tets_can_come_later(obj: Path) -> None:
    asset = import_mesh(obj, budget=400, tets=False, name="thing")
    assert asset.tets is None and asset.name == "thing"
    filled = tetrahedralize_asset(asset, target_tets=100, method="lattice")
    assert filled.tets is not None and filled.provenance["tets"]["target_tets"] == 100
    assert_bits("vertices", asset.gaussians.vertices.numpy(), filled.gaussians.vertices.numpy())


def test_our_own_files_are_not_imported(tmp_path: Path) -> None:
    make_asset().save(tmp_path / "a.usdz")
    with pytest.raises(AssetError, match="already a gdpro asset; use it as it is"):
        import_mesh(tmp_path / "a.usdz")


def test_bad_meshes_are_mesh_errors(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="does not exist"):
        import_mesh(tmp_path / "absent.obj")
    with pytest.raises(MeshError, match="does not exist"):
        import_mesh(tmp_path / "absent.usdc")
