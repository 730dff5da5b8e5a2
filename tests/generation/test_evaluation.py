"""Figures with known answers."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.gaussians import Gaussians, rgb_to_sh
from gdpro_sim.generation.cameras import held_out
from gdpro_sim.generation.evaluation import (
    evaluate,
    inconsistency,
    render,
    sample,
    sharpness,
    surface_figures,
    visible_strays,
)
from gdpro_sim.generation.renders import MeshRenderer, Renders
from gdpro_sim.meshing.surface import SurfaceMesh


def ball(radius: float = 0.8, subdivisions: int = 4) -> SurfaceMesh:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return SurfaceMesh.from_arrays(mesh.vertices, mesh.faces, color=(0.8, 0.3, 0.1))


def blobs(positions: list[list[float]], opacity: float = 0.9, size: float = 0.02) -> Gaussians:
    n = len(positions)
    return Gaussians(
        torch.tensor(positions), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), size),
        torch.full((n,), opacity), rgb_to_sh(torch.full((n, 1, 3), 0.3)),
    )  # fmt: skip


def test_a_mesh_equals_itself() -> None:
    mesh = ball()
    figures = evaluate(mesh, MeshRenderer(mesh), truth=mesh, views=3, resolution=48)
    assert figures.psnr == math.inf and figures.ssim == pytest.approx(1.0)
    assert figures.chamfer == pytest.approx(0.0, abs=1e-6) and figures.f_score == 1.0
    assert figures.normal_error == pytest.approx(0.0, abs=0.1)
    assert figures.sharpness == pytest.approx(1.0) and figures.strays is None
    assert figures.inconsistency < 0.01
    assert set(figures.to_json()) >= {"psnr", "chamfer", "strays"}


def test_a_colour_off_by_a_tenth_is_20_db_where_the_object_is() -> None:
    mesh, cameras = ball(), held_out(2, 48)
    darker = replace(mesh, materials=(replace(mesh.materials[0], base_color=(0.7, 0.2, 0.0, 1.0)),))
    figures = evaluate(darker, MeshRenderer(mesh), views=2, resolution=48)
    share = float(MeshRenderer(mesh).render(cameras).alphas.square().mean())
    assert figures.psnr == pytest.approx(20.0 - 10.0 * math.log10(share), abs=0.05)
    assert figures.chamfer is None and figures.strays is None


def test_concentric_spheres_are_a_known_distance_apart() -> None:
    near = surface_figures(ball(0.80), ball(0.81), np.random.default_rng(0))
    assert near[0] == pytest.approx(0.01, rel=0.05)
    assert near[1] == 1.0 and near[2] < 3.0  # diagonal 2.8: 1 % is 0.028
    far = surface_figures(ball(0.80), ball(0.90), np.random.default_rng(0))
    assert far[0] == pytest.approx(0.1, rel=0.02) and far[1] == 0.0


def test_what_no_picture_can_show_does_not_count() -> None:
    whole, kernel = ball(0.80), ball(0.30)
    filled = SurfaceMesh.from_arrays(
        np.concatenate([whole.vertices, kernel.vertices]),
        np.concatenate([whole.faces, kernel.faces + len(whole.vertices)]),
    )
    for pair in ((filled, whole), (whole, filled)):
        chamfer, f_score, angle = surface_figures(*pair, np.random.default_rng(0))
        assert chamfer == pytest.approx(0.0, abs=1e-6) and f_score == 1.0 and angle < 0.1
    with pytest.raises(MeshError, match="inside out"):
        inverted = SurfaceMesh.from_arrays(whole.vertices, whole.faces[:, ::-1])
        surface_figures(inverted, whole, np.random.default_rng(0))


def test_half_a_surface_has_full_precision_and_half_the_recall() -> None:
    whole = ball()
    upper = whole.faces[whole.vertices[whole.faces].mean(1)[:, 2] > 0.0]
    half = SurfaceMesh.from_arrays(whole.vertices, upper)
    _, f_score, _ = surface_figures(half, whole, np.random.default_rng(0), samples=8000)
    recall = 0.5 + 0.5 * 0.01 * whole.diagonal / 0.8  # and a rim as wide as the threshold, by zones
    assert f_score == pytest.approx(2.0 * recall / (1.0 + recall), abs=0.02)


def test_tilted_planes_differ_by_their_angle() -> None:
    side = np.array([[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * 0.5
    faces = np.array([[0, 1, 2], [0, 2, 3]])
    turn = trimesh.transformations.rotation_matrix(math.radians(10.0), [1, 0, 0])[:3, :3]
    flat, tilted = (SurfaceMesh.from_arrays(v, faces) for v in (side, side @ turn.T))
    assert surface_figures(flat, tilted, np.random.default_rng(0))[2] == pytest.approx(10.0, abs=0.05)


def test_samples_are_even() -> None:
    points, normals = sample(ball(), 20_000, np.random.default_rng(0))
    assert np.abs(points.mean(0)).max() < 0.02
    assert np.linalg.norm(points, axis=1) == pytest.approx(0.8, abs=0.005)
    assert (points * normals).sum(1) == pytest.approx(0.8, abs=0.01)


def test_sharpness_is_the_share_of_the_contrast() -> None:
    step = torch.zeros(1, 16, 32, 3)
    step[:, :, 16:] = 0.8
    assert sharpness(step, step) == pytest.approx(1.0)
    assert sharpness(0.5 * step + 0.1, step) == pytest.approx(0.5)
    assert sharpness(torch.full_like(step, 0.3), step) == 0.0
    # Over n pixels a step rises by 2 / n of itself in a central difference of two.
    blurred = torch.zeros_like(step)
    blurred[:, :, 12:20] = (0.8 * (torch.arange(8) + 0.5) / 8)[:, None]
    blurred[:, :, 20:] = 0.8
    assert sharpness(blurred, step) == pytest.approx(0.25, abs=1e-6)
    assert sharpness(step, torch.zeros_like(step)) == 1.0, "no edges"


def test_strays_count_by_what_is_seen_of_them() -> None:
    truth, cameras = ball(0.5), held_out(4, 64)
    on = [[0.5, 0.0, 0.0], [-0.5, 0.0, 0.0], [0.0, 0.5, 0.0]]
    assert visible_strays(blobs(on), truth, cameras) == 0.0
    off = blobs([[0.9, 0.0, 0.0], [-0.9, 0.0, 0.0]])
    assert visible_strays(off, truth, cameras) == 1.0
    # Three alike on the surface and one off it, nothing in front of each other; nearly the same size in view.
    mixed = visible_strays(blobs([*on, [0.0, 0.0, 0.8]]), truth, cameras)
    assert mixed == pytest.approx(0.25, abs=0.03)
    faint = replace(blobs([*on, [0.0, 0.0, 0.8]]), opacities=torch.tensor([0.9, 0.9, 0.9, 0.0]))
    assert visible_strays(faint, truth, cameras) == 0.0


def test_views_that_differ_by_a_tenth_are_inconsistent_by_it() -> None:
    """A flat wall seen by two cameras side by side; every second view is 0.1 brighter."""
    cameras = Cameras.look_at(
        [[0.0, -4.0, 0.0], [0.5, -4.0, 0.0]],
        [[0.0, 0, 0], [0.5, 0, 0]],
        vertical_fov=0.5,
        width=32,
        height=32,
    )
    rgb = torch.full((2, 32, 32, 3), 0.4)
    rgb[1] += 0.1
    ones = torch.ones(2, 32, 32, 1)
    assert inconsistency(Renders(cameras, rgb, ones, 4.0 * ones)) == pytest.approx(0.1, abs=1e-6)
    # Depths that do not agree: no point is the same.
    depths = torch.cat([4.0 * ones[:1], 3.0 * ones[1:]])
    assert inconsistency(Renders(cameras, rgb, ones, depths)) == 0.0


def test_reprojection_finds_the_same_point() -> None:
    """A wall painted with a ramp: the second camera sees it shifted by what parallax says."""
    cameras = Cameras.look_at(
        [[0.0, -4.0, 0.0], [0.3, -4.0, 0.0]],
        [[0.0, 0, 0], [0.3, 0, 0]],
        vertical_fov=0.5,
        width=64,
        height=64,
    )
    across = 4.0 * (torch.arange(64) + 0.5 - 32.0) / float(cameras.Ks[0, 0, 0])
    ramps = torch.stack([0.5 + 0.3 * across, 0.5 + 0.3 * (across + 0.3)])
    rgb = ramps[:, None, :, None].expand(2, 64, 64, 3).contiguous()
    ones = torch.ones(2, 64, 64, 1)
    assert inconsistency(Renders(cameras, rgb, ones, 4.0 * ones)) < 1e-5


def test_gaussians_are_drawn_as_their_reference() -> None:
    """Averaged down from twice the size, alpha and depth included."""
    cameras = held_out(2, 32)
    drawn = render(blobs([[0.0, 0.0, 0.0]], size=0.3), cameras)
    assert drawn.rgb.shape == (2, 32, 32, 3) and drawn.depths.shape == (2, 32, 32, 1)
    assert float(drawn.alphas[0, 16, 16]) == pytest.approx(0.9, abs=0.02)
    assert float(drawn.depths[0, 16, 16]) == pytest.approx(5.0, abs=1e-3)
    assert float(drawn.rgb[0, 16, 16, 0]) == pytest.approx(0.3 * float(drawn.alphas[0, 16, 16]), abs=1e-3)
    with pytest.raises(RequestError, match="views must be >= 2"):
        evaluate(ball(), MeshRenderer(ball()), views=1)
