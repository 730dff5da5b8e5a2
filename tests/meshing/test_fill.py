"""Filling shapes with particles: where they lie, how far apart, and how much they hold."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.asset.from_splats import bind_splats
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.meshing.fill import (
    TILE,
    TILE_RADIUS,
    Filling,
    Pattern,
    blue_noise_tile,
    fill_bound,
    fill_mesh,
    fill_splats,
    fill_tets,
)
from gdpro_sim.meshing.lattice import lattice
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import signed_volume
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.meshing.tetmesh import TetMesh
from tests.meshing.shapes import cube, joined, sheet, sphere
from tests.reference.filling import physgaussian_filling

PATTERNS = get_args(Pattern)


def torus() -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.torus(0.5, 0.2, major_sections=48, minor_sections=24)
    turned = mesh.vertices @ trimesh.transformations.rotation_matrix(0.7, [1, 2, 3])[:3, :3].T
    return np.asarray(turned, np.float32), np.asarray(mesh.faces, np.int32)


def total(filling: Filling) -> float:
    return float(filling.volumes.sum(dtype=np.float64))


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("shape", [cube, sphere, torus])
def test_volume_is_exact_and_points_lie_inside(shape: object, pattern: Pattern) -> None:
    v, f = shape()  # type: ignore[operator]
    volume = signed_volume(v, f)
    spacing = (volume / 4000) ** (1 / 3)
    filling = fill_mesh(v, f, spacing, pattern=pattern)
    assert filling.points.dtype == filling.volumes.dtype == np.float32
    assert abs(total(filling) / volume - 1.0) < 1e-6
    assert SurfaceIndex(v, f, winding=True).inside(filling.points).all()
    assert abs(filling.spacing / spacing - 1.0) < 0.03, "as many particles as the spacing asks for"
    apart = cKDTree(filling.points).query(filling.points, k=2)[0][:, 1] / spacing
    least, mean = {"lattice": (0.9, 0.97), "jittered": (0.48, 0.74), "blue-noise": (0.74, 0.87)}[pattern]
    assert apart.min() > least and apart.mean() > mean and apart.max() < 1.6
    # The surface is near particles everywhere, and particles are near in every part.
    samples = np.random.default_rng(0).dirichlet([1, 1, 1], len(f))
    on_surface = np.einsum("fc,fcd->fd", samples, v[f])
    assert cKDTree(filling.points).query(on_surface)[0].max() < 2.0 * spacing


def test_a_box_gets_its_lattice() -> None:
    v, f = cube()
    filling = fill_mesh(v * [2.0, 1.0, 0.5], f, 0.12, pattern="lattice")
    assert len(filling) == 17 * 8 * 4
    np.testing.assert_allclose(filling.volumes, 1.0 / len(filling), rtol=1e-6)
    np.testing.assert_allclose(np.unique(filling.points[:, 2].round(6)), [0.0625, 0.1875, 0.3125, 0.4375])


@pytest.mark.parametrize("pattern", PATTERNS)
def test_the_seed_decides(pattern: Pattern) -> None:
    v, f = sphere()
    first, again, other = (fill_mesh(v, f, 0.15, pattern=pattern, seed=s) for s in (1, 1, 2))
    assert first.points.tobytes() == again.points.tobytes()
    assert first.volumes.tobytes() == again.volumes.tobytes()
    assert (first.points.tobytes() == other.points.tobytes()) == (pattern == "lattice")


def test_blue_noise_has_no_close_pair_and_no_direction() -> None:
    tile = blue_noise_tile(0)
    assert len(tile) == TILE**3
    assert cKDTree(tile, boxsize=TILE).query(tile, k=2)[0][:, 1].min() >= TILE_RADIUS
    # Power of the structure factor at low frequencies is far below white noise's 1, the same along all axes.
    waves = (
        [(k, 0, 0) for k in (1, 2, 3)] + [(0, k, 0) for k in (1, 2, 3)] + [(1, 1, 0), (0, 2, 2), (1, 2, 2)]
    )
    for wave in waves:
        phase = 2 * np.pi * tile @ np.asarray(wave) / TILE
        assert abs(np.exp(1j * phase).sum()) ** 2 / len(tile) < 0.6


def test_thin_parts_get_a_layer() -> None:
    v, f = cube()
    plate = (v - 0.5) * [1.0, 1.0, 0.02]
    for turn in (np.eye(3), trimesh.transformations.rotation_matrix(0.5, [1, 1, 0.3])[:3, :3]):
        filling = fill_mesh(plate @ turn.T, f, 0.1)
        assert abs(total(filling) / 0.02 - 1.0) < 1e-6
        local = filling.points @ turn
        assert (np.abs(local[:, 2]) < 0.01).all()
        x, y = np.meshgrid(np.linspace(-0.5, 0.5, 20), np.linspace(-0.5, 0.5, 20))
        there = np.stack([x.ravel(), y.ravel()], 1)
        assert cKDTree(local[:, :2]).query(there)[0].max() < 0.2, "no hole in the layer"
    # An ear on a head: a thin fin on a ball, which holds little.
    both = joined(sphere(3, 0.3), (plate * [0.5, 0.5, 1.0] + [0.0, 0.6, 0.0], f))
    filling = fill_mesh(*both, 0.1)
    fin = filling.points[:, 1] > 0.34
    assert fin.sum() >= 12
    assert filling.volumes[fin].sum() < 2.5 * 0.25 * 0.02


def test_overlaps_count_once_and_cavities_are_empty() -> None:
    ball = sphere(4, 0.5)
    lens = 2 * np.pi * 0.25**2 * (3 * 0.5 - 0.25) / 3  # of two unit-diameter balls half a metre apart
    union = 2 * signed_volume(*ball) - lens
    filling = fill_mesh(*joined(ball, (ball[0] + np.float32([0.5, 0, 0]), ball[1])), 0.04)
    assert total(filling) == pytest.approx(union, rel=0.01)
    hollow = joined(ball, (ball[0] * np.float32(0.6), ball[1][:, [0, 2, 1]]))
    filling = fill_mesh(*hollow, 0.05)
    assert abs(total(filling) / signed_volume(*hollow) - 1.0) < 1e-6
    assert np.linalg.norm(filling.points, axis=1).min() > 0.29


def test_open_and_inverted_surfaces() -> None:
    v, f = sphere(3, 0.5)
    inverted = fill_mesh(v, f[:, [0, 2, 1]], 0.1)
    assert total(inverted) == pytest.approx(signed_volume(v, f))
    opened = fill_mesh(v, f[v[f].mean(1)[:, 2] < 0.45], 0.05)
    assert total(opened) == pytest.approx(signed_volume(v, f), rel=0.03)
    with pytest.raises(MeshError, match=r"no particle lies inside .* encloses no volume"):
        fill_mesh(*sheet(), 0.1)


def test_wrong_requests_are_refused() -> None:
    v, f = cube()
    with pytest.raises(MeshError, match=r"use at least 0\.0029"):
        fill_mesh(v, f, 1e-3)
    with pytest.raises(MeshError, match="finite number > 0 m, got nan"):
        fill_mesh(v, f, float("nan"))
    with pytest.raises(MeshError, match="pattern must be one of jittered, lattice, blue-noise, got 'fcc'"):
        fill_mesh(v, f, 0.1, pattern="fcc")  # type: ignore[arg-type]
    with pytest.raises(MeshError, match="without tets"):
        fill_tets(TetMesh(v, np.zeros((0, 4), np.int32), np.zeros(0, np.float32), "lattice"), 0.1)


@pytest.mark.parametrize("pattern", PATTERNS)
def test_tets_give_their_material(pattern: Pattern) -> None:
    v, f = sphere(3, 0.5)
    tets = lattice(v, f, target_tets=2000)
    assert (tets.fill < 1.0).any()
    filling = fill_tets(tets, 0.05, pattern=pattern)
    assert abs(total(filling) / float((tets.volumes() * tets.fill).sum()) - 1.0) < 1e-6
    assert len(filling) == pytest.approx(total(filling) / 0.05**3, rel=0.05)
    radius = np.linalg.norm(filling.points, axis=1)
    assert (radius > 0.5).mean() < 0.15, "few outside of the ball, where cells are partly filled"


def cloud(shape: tuple[np.ndarray, np.ndarray], budget: int = 8000) -> Gaussians:
    return bind_mesh(SurfaceMesh.from_arrays(*shape), budget=budget).gaussians()


@pytest.mark.parametrize("shape", [sphere, torus])
def test_a_cloud_is_filled_to_its_surface(shape: object) -> None:
    v, f = shape()  # type: ignore[operator]
    volume = signed_volume(v, f)
    spacing = (volume / 10_000) ** (1 / 3)
    filling = fill_splats(cloud((v, f)), spacing)
    assert total(filling) == pytest.approx(volume, rel=0.03)
    index = SurfaceIndex(v, f, winding=True)
    assert index.inside(filling.points).mean() > 0.96
    wanted = fill_mesh(v, f, spacing).points
    assert (cKDTree(filling.points).query(wanted)[0] > 1.5 * spacing).mean() < 0.002


def test_physgaussians_filling_holds_air() -> None:
    v, f = sphere(3, 0.5)
    flat, spacing = cloud((v, f), 4000), 0.05
    round_ones = replace(flat, scales=torch.full_like(flat.scales, 0.5 * spacing))
    volume = signed_volume(v, f)
    theirs, ours = physgaussian_filling(round_ones, spacing), fill_splats(round_ones, spacing)
    assert theirs[1].sum() > 1.15 * volume, "1.23 measured: the shell's outer half counts"
    assert total(ours) == pytest.approx(volume, rel=0.03)
    # Its particles crowd where the Gaussians are, and share cells: masses differ.
    assert len(theirs[0]) > 1.5 * len(ours)
    assert theirs[1].max() / theirs[1].min() > 4.0 and ours.volumes.max() == ours.volumes.min()
    # Flat Gaussians fall between the corners of its cells: rays find holes, and the inside stays empty.
    assert physgaussian_filling(flat, spacing)[1].sum() < 0.6 * volume
    assert total(fill_splats(flat, spacing)) == pytest.approx(volume, rel=0.03)


def test_a_vessel_stays_hollow_and_a_scan_may_lack_its_bottom() -> None:
    v, f = sphere(4, 0.5)
    centres = v[f].mean(1)
    without_bottom = cloud((v, f[centres[:, 2] > -0.35]))
    assert total(fill_splats(without_bottom, 0.05)) > 0.9 * signed_volume(v, f)
    without_top = cloud((v, f[centres[:, 2] < 0.2]))
    assert total(fill_splats(without_top, 0.05)) < 0.35 * signed_volume(v, f)
    shut = fill_splats(without_bottom, 0.05, open_side=None)
    assert total(shut) < 0.7 * signed_volume(v, f)


def test_bound_gaussians_choose_their_way() -> None:
    v, f = sphere(3, 0.5)
    bound = bind_mesh(SurfaceMesh.from_arrays(v, f), budget=8000)
    volume = signed_volume(bound.vertices.numpy(), bound.faces.numpy())
    assert abs(total(fill_bound(bound, 0.05)) / volume - 1.0) < 1e-6
    assert total(fill_bound(bind_splats(bound.gaussians()), 0.05)) == pytest.approx(volume, rel=0.03)


def test_clouds_that_cannot_be_filled() -> None:
    splats = cloud(sphere(2, 0.5), 1000)
    faint = Gaussians(splats.means, splats.quats, splats.scales, splats.opacities * 0.01, splats.sh)
    with pytest.raises(MeshError, match=r"nowhere as dense as 0\.5"):
        fill_splats(faint, 0.05)
    with pytest.raises(MeshError, match="no Gaussian of the cloud is visible"):
        fill_splats(
            Gaussians(splats.means, splats.quats, splats.scales, splats.opacities * 0, splats.sh), 0.05
        )
    with pytest.raises(MeshError, match="too many"):
        fill_splats(
            Gaussians(splats.means * 1e4, splats.quats, splats.scales, splats.opacities, splats.sh), 0.05
        )
    with pytest.raises(MeshError, match="open_side must be one of left"):
        fill_splats(splats, 0.05, open_side="below")  # type: ignore[arg-type]
    with pytest.raises(MeshError, match="threshold must be > 0"):
        fill_splats(splats, 0.05, threshold=0.0)
    nan = splats.means.clone()
    nan[0] = torch.nan
    kept = fill_splats(Gaussians(nan, splats.quats, splats.scales, splats.opacities, splats.sh), 0.1)
    assert np.isfinite(kept.points).all()
