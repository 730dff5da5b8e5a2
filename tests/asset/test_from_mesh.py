from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from gdpro_sim.asset.from_mesh import (
    EVEN_COUNTS,
    barycentric_table,
    bind_mesh,
    counts_per_face,
    even_table,
    vertex_colors,
)
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import sh_to_rgb
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.repair import face_areas, validate
from gdpro_sim.meshing.surface import SurfaceMesh
from tests.meshing.shapes import cube, shared, sheet, sphere, textured_square, warp_asset


def points_of(bound: BoundGaussians) -> np.ndarray:
    corner = bound.vertices.numpy().astype(np.float64)[bound.faces.numpy()[bound.face_ids.numpy()]]
    return np.einsum("nc,ncd->nd", bound.barycentrics.numpy(), corner)


@pytest.mark.parametrize("count", [1, 3, 4, 6, 10, 15, 28, 55])
def test_barycentric_tables(count: int) -> None:
    table = barycentric_table(count)
    assert table.shape == (count, 3) and np.allclose(table.sum(1), 1.0) and table.min() > 0.0
    assert np.allclose(table.mean(0), 1.0 / 3.0)
    assert len(np.unique(table.round(12), axis=0)) == count


def test_barycentric_tables_of_the_method() -> None:
    assert np.allclose(barycentric_table(3)[0], [0.5, 0.25, 0.25])
    assert np.allclose(barycentric_table(4)[1], [2 / 3, 1 / 6, 1 / 6])
    assert np.allclose(barycentric_table(6)[3], [1 / 6, 5 / 12, 5 / 12])
    assert np.allclose(barycentric_table(10)[0], [1 / 12, 1 / 12, 10 / 12])
    for count in (0, -1, 2, 5, 7):
        with pytest.raises(MeshError, match="k \\(k"):
            barycentric_table(count)


@pytest.mark.parametrize("count", EVEN_COUNTS)
def test_even_tables(count: int) -> None:
    table = even_table(count)
    assert table.shape == (count, 3) and np.allclose(table.sum(1), 1.0) and table.min() > 0.0
    assert np.allclose(table.mean(0), 1.0 / 3.0)


def test_counts_follow_area_and_repeat() -> None:
    areas = np.random.default_rng(0).lognormal(0.0, 1.0, 4000)
    counts = counts_per_face(areas, 20_000, seed=3)
    assert abs(counts.sum() - 20_000) < 200 and set(np.unique(counts)) <= set(EVEN_COUNTS)
    middle = (counts > 1) & (counts < 25)
    density = counts[middle] / areas[middle]
    assert density.std() / density.mean() < 0.3
    assert np.array_equal(counts, counts_per_face(areas, 20_000, seed=3))


@pytest.mark.parametrize("budget", [100, 1000, 20_000])
@pytest.mark.parametrize("shape", ["cube", "sphere", "sheet", "dense"])
def test_budget_is_met(shape: str, budget: int) -> None:
    v, f = {"cube": cube(), "sphere": sphere(3), "sheet": sheet(), "dense": sphere(6)}[shape]
    bound = bind_mesh(SurfaceMesh.from_arrays(v, f), budget=budget)
    assert 0.85 * budget <= len(bound) <= 1.2 * budget
    assert np.bincount(bound.face_ids.numpy(), minlength=len(bound.faces)).min() >= 1
    if shape != "sheet":
        assert validate(bound.vertices.numpy(), bound.faces.numpy()).watertight
    for name in ("rotations", "log_scales", "opacity_logits", "sh", "barycentrics"):
        value = getattr(bound, name)
        assert value.dtype == torch.float32 and bool(torch.isfinite(value).all())


def test_simulation_surface_has_a_sane_size() -> None:
    for v, f in (cube(), sphere(3), sphere(6)):
        faces = len(bind_mesh(SurfaceMesh.from_arrays(v, f)).faces)
        assert 5_000 <= faces <= 15_000


def test_same_seed_same_bytes() -> None:
    mesh = SurfaceMesh.from_arrays(*sphere(3))
    first, second = bind_mesh(mesh, budget=3000, seed=1), bind_mesh(mesh, budget=3000, seed=1)
    other = bind_mesh(mesh, budget=3000, seed=2)
    for name in first.__dataclass_fields__:
        assert torch.equal(getattr(first, name), getattr(second, name))
    assert not torch.equal(first.barycentrics[:3000], other.barycentrics[:3000]) or len(first) != len(other)


def test_bad_requests_are_refused() -> None:
    mesh = SurfaceMesh.from_arrays(*cube())
    with pytest.raises(MeshError, match="budget must be >= 100, got 7"):
        bind_mesh(mesh, budget=7)
    with pytest.raises(MeshError, match="occlusion"):
        bind_mesh(mesh, occlusion=2.0)


def coverage(bound: BoundGaussians, samples: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """Alpha a ray along `normal` meets at each sample of a flat surface, every Gaussian counted: [S]."""
    gaussians = bound.gaussians()
    means = gaussians.means.numpy().astype(np.float64)
    from scipy.spatial import cKDTree
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    covariance = np.einsum("nij,nj,nkj->nik", axes, gaussians.scales.numpy().astype(np.float64) ** 2, axes)
    keep = [i for i in range(3) if abs(normal[i]) < 0.5]
    plane = np.linalg.inv(covariance[:, keep][:, :, keep])
    near = cKDTree(means).query(samples, k=40)[1]
    offset = (samples[:, None] - means[near])[..., keep]
    power = np.einsum("ski,skij,skj->sk", offset, plane[near], offset)
    alpha = gaussians.opacities.numpy()[near] * np.exp(-0.5 * power)
    return 1.0 - np.prod(1.0 - alpha, axis=1)


@pytest.mark.parametrize("aspect", [1.0, 3.0])
def test_a_surface_has_no_holes_from_one_side(aspect: float) -> None:
    v, f = sheet(12)
    v = v * np.asarray([1.0, aspect, 1.0], np.float32)
    v[:, :2] += 0.02 * np.random.default_rng(0).standard_normal((len(v), 2)).astype(np.float32)
    bound = bind_mesh(SurfaceMesh.from_arrays(v, f), budget=3000)
    samples = np.random.default_rng(1).random((2000, 3)) * [0.8, 0.8 * aspect, 0.0] + [0.1, 0.1 * aspect, 0.0]
    alpha = coverage(bound, samples, np.asarray([0.0, 0.0, 1.0]))
    assert alpha.mean() > 0.95 and np.quantile(alpha, 0.01) > 0.85


def test_gaussians_are_thin_flat_and_aligned() -> None:
    bound = bind_mesh(SurfaceMesh.from_arrays(*sphere(3)), budget=8000)
    scales = bound.log_scales.exp()
    assert bool((scales[:, 0] < 0.25 * scales[:, 1:].min(1).values).all())
    assert torch.sigmoid(bound.opacity_logits).mean() == pytest.approx(0.95, abs=1e-4)
    gaussians = bound.gaussians()
    from scipy.spatial.transform import Rotation

    axes = Rotation.from_quat(gaussians.quats.numpy()[:, [1, 2, 3, 0]]).as_matrix()
    thin = axes[np.arange(len(axes)), :, gaussians.scales.numpy().argmin(1)]
    outward = points_of(bound) / np.linalg.norm(points_of(bound), axis=1, keepdims=True)
    assert np.abs(np.einsum("nc,nc->n", thin, outward)).min() > 0.98


def test_covariance_follows_the_triangle() -> None:
    """The Gaussian of an affine image is the affine image of the equilateral triangle's isotropic
    Gaussian."""
    from gdpro_sim.asset.from_mesh import COVERAGE, _covariances

    equilateral = np.asarray([(0, 0, 0), (1, 0, 0), (0.5, 0.75**0.5, 0)])
    shape = np.asarray([[1.7, 0.4, 0], [0.3, 0.9, 0], [0, 0, 1.0]])
    corner = (equilateral @ shape.T)[None]
    share = 0.5 * np.linalg.norm(np.cross(corner[0, 1], corner[0, 2])) / 4
    turn, logs = _covariances(corner, np.asarray([share]))
    e1 = corner[0, 1] / np.linalg.norm(corner[0, 1])
    e2 = np.cross([0, 0, 1.0], e1)
    a = turn[0, 0] * e1 + turn[0, 1] * e2
    b = -turn[0, 1] * e1 + turn[0, 0] * e2
    got = np.exp(2 * logs[0, 1]) * np.outer(a, a) + np.exp(2 * logs[0, 2]) * np.outer(b, b)
    spacing = np.sqrt(2 / np.sqrt(3) * (np.sqrt(3) / 4) / 4)
    want = (COVERAGE * spacing) ** 2 * shape[:2, :2] @ shape[:2, :2].T
    assert np.allclose(got[:2, :2], want, rtol=1e-9)


def test_colours_sit_at_their_texels(tmp_path: Path) -> None:
    bound = bind_mesh(load_mesh(textured_square(tmp_path), up="z"), budget=4000)
    points, rgb = points_of(bound), sh_to_rgb(bound.sh[:, 0]).numpy()
    for corner, color in {(0, 1): (1, 0, 0), (1, 1): (0, 1, 0), (0, 0): (0, 0, 1), (1, 0): (1, 1, 1)}.items():
        offset = np.abs(points[:, :2] - np.asarray(corner))
        inner = (offset.max(1) < 0.4) & (offset.min(1) > 0.08)  # textures wrap around at the rim
        assert inner.sum() > 300 and np.allclose(rgb[inner], color, atol=2e-3)


def test_a_minified_texture_does_not_alias(tmp_path: Path) -> None:
    from PIL import Image

    path = textured_square(tmp_path)
    board = (np.indices((512, 512)).sum(0) % 2 * 255).astype(np.uint8)
    Image.fromarray(board).save(tmp_path / "square.png")
    rgb = sh_to_rgb(bind_mesh(load_mesh(path), budget=400).sh[:, 0]).numpy()
    assert np.abs(rgb - 0.5).max() < 0.05


def test_decimation_looks_colours_up_on_the_original() -> None:
    v, f = sphere(6)
    colors = np.zeros((len(f), 3, 4), np.uint8)
    colors[..., 3] = 255
    colors[..., 0] = np.where(v[f][..., 2] > 0, 255, 0)
    plain = SurfaceMesh.from_arrays(v, f, color=(1.0, 1.0, 1.0))
    mesh = SurfaceMesh(v, f, None, colors, plain.material_ids, plain.materials)
    bound = bind_mesh(mesh, budget=6000)
    assert len(bound.faces) < len(f) / 10
    points, red = points_of(bound), sh_to_rgb(bound.sh[:, 0, 0]).numpy()
    clear = np.abs(points[:, 2]) > 0.1
    assert np.allclose(red[clear], points[clear, 2] > 0, atol=2e-3)


def test_thin_walls_keep_their_own_side() -> None:
    """A plate 2 mm thick, red above and blue below: decimation must not mix the sides."""
    from gdpro_sim.meshing.remesh import subdivide

    v, f = cube()
    v, f, _, _ = subdivide(v * np.asarray([1.0, 1.0, 0.002], np.float32), f, 0.02)
    colors = np.zeros((len(f), 3, 4), np.uint8)
    colors[..., 3] = 255
    above = v[f].mean(1)[:, 2] > 0.001
    colors[above, :, 0] = colors[~above, :, 2] = 255
    plain = SurfaceMesh.from_arrays(v, f, color=(1.0, 1.0, 1.0))
    bound = bind_mesh(SurfaceMesh(v, f, None, colors, plain.material_ids, plain.materials), budget=20_000)
    points, rgb = points_of(bound), sh_to_rgb(bound.sh[:, 0]).numpy()
    inner = (np.abs(points[:, :2] - 0.5) < 0.45).all(1)
    assert ((rgb[inner, 0] > 0.5) == (points[inner, 2] > 0.001)).all()


def test_plain_meshes_are_darker_in_their_hollows_only() -> None:
    grey = (0.5, 0.5, 0.5)
    ball = sh_to_rgb(bind_mesh(SurfaceMesh.from_arrays(*sphere(3), color=grey), budget=2000).sh[:, 0]).numpy()
    assert np.allclose(ball, 0.5, atol=1e-6), "nothing shades a convex body"
    v, f = sphere(3)
    low = v.copy()
    low[:, 2] -= 2.05  # two balls that nearly touch shade each other there
    pair = SurfaceMesh.from_arrays(np.concatenate([v, low]), np.concatenate([f, f + len(v)]), color=grey)
    bound = bind_mesh(pair, budget=4000)
    height, red = points_of(bound)[:, 2], sh_to_rgb(bound.sh[:, 0, 0]).numpy()
    gap = np.abs(height + 1.025) < 0.08
    assert red[gap].mean() < 0.45 and red[height > 0.8].mean() > 0.49
    flat = sh_to_rgb(bind_mesh(pair, budget=4000, occlusion=0.0).sh[:, 0]).numpy()
    assert np.allclose(flat, 0.5, atol=1e-6)


def test_vertex_colors(tmp_path: Path) -> None:
    mesh = load_mesh(textured_square(tmp_path), up="z")
    bound = bind_mesh(mesh, budget=2000)
    colors, where = vertex_colors(mesh, bound), bound.vertices.numpy()
    assert colors.shape == where.shape and colors.dtype == np.float32
    inner = np.abs(where[:, :2] - [0.0, 1.0]).max(1) < 0.4
    inner &= (where[:, 0] > 0.05) & (where[:, 1] < 0.95)
    assert np.allclose(colors[inner], [1, 0, 0], atol=0.02)


def test_spot_and_bunny() -> None:
    spot = bind_mesh(load_mesh(shared("spot.obj")))
    assert 42_500 <= len(spot) <= 60_000 and validate(spot.vertices.numpy(), spot.faces.numpy()).watertight
    assert np.ptp(sh_to_rgb(spot.sh[:, 0, 0]).numpy()) > 0.5
    bunny = bind_mesh(load_mesh(warp_asset("bunny.usd")))
    assert 42_500 <= len(bunny) <= 60_000
    area = face_areas(bunny.vertices.numpy(), bunny.faces.numpy()).sum()
    assert area == pytest.approx(6.35, rel=0.02)
