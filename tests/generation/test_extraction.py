"""Surfaces taken from Gaussians that were made from known meshes."""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians, Surfels, rotation_matrices
from gdpro_sim.generation.config import ExtractionConfig
from gdpro_sim.generation.extraction import (
    OrientedPoints,
    discs_towards,
    extract,
    oriented_points,
    reconstruct,
)
from gdpro_sim.generation.level_set import Density
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import validate
from gdpro_sim.meshing.surface import SurfaceMesh

QUICK = ExtractionConfig(cameras=14, resolution=112, depth=7, triangles=2500)


def shape(name: str) -> trimesh.Trimesh:
    if name == "sphere":
        return trimesh.creation.icosphere(subdivisions=3, radius=0.9)
    if name == "torus":
        return trimesh.creation.torus(0.65, 0.25, major_sections=64, minor_sections=32)
    return trimesh.creation.box((1.0, 1.2, 0.8))


@cache
def gaussians_of(name: str, budget: int = 6000) -> Gaussians:
    mesh = shape(name)
    surface = SurfaceMesh.from_arrays(mesh.vertices, mesh.faces, color=(0.8, 0.2, 0.1))
    return bind_mesh(surface, budget=budget, occlusion=0.0).gaussians()


def surfels_of(name: str) -> Surfels:
    """The same, flat: seen from far away every disc is the Gaussian's own."""
    g = gaussians_of(name)
    order = torch.argsort(g.scales, dim=1, descending=True)
    axes = torch.gather(rotation_matrices(g.quats), 2, order[:, None].expand(-1, 3, -1))
    axes[:, :, 2] = torch.linalg.cross(axes[:, :, 0], axes[:, :, 1])
    matrices = torch.eye(4).repeat(len(g), 1, 1)
    matrices[:, :3, :3] = axes
    quats = np.stack([trimesh.transformations.quaternion_from_matrix(m) for m in matrices.double().numpy()])
    scales = torch.gather(g.scales, 1, order)[:, :2].contiguous()
    return Surfels(g.means, torch.tensor(quats, dtype=torch.float32), scales, g.opacities, g.sh)


def distances(surface: SurfaceMesh, truth: trimesh.Trimesh) -> tuple[np.ndarray, float]:
    """How far samples of either lie from the other, and the mean angle between their normals in degrees."""
    found = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    apart, angles = [], []
    for a, b in ((found, truth), (truth, found)):
        points, faces = trimesh.sample.sample_surface(a, 4000, seed=1)
        where, weights = SurfaceIndex(b.vertices, b.faces).closest(np.asarray(points))
        nearest = np.einsum("nc,ncd->nd", weights, b.vertices[b.faces[where]])
        apart.append(np.linalg.norm(points - nearest, axis=1))
        angles.append((a.face_normals[faces] * b.face_normals[where]).sum(1))
    return np.concatenate(apart), float(np.degrees(np.arccos(np.clip(np.concatenate(angles), -1, 1))).mean())


@pytest.mark.parametrize(
    ("name", "flat", "mode", "mean", "angle"),
    [
        ("sphere", False, "rendered-depth", 0.002, 3.0),
        ("torus", True, "rendered-depth", 0.005, 7.0),
        ("box", False, "rendered-depth", 0.009, 9.0),
        ("sphere", False, "centres", 0.003, 3.0),
    ],
)
def test_the_known_surface_comes_back_closed(
    name: str, flat: bool, mode: str, mean: float, angle: float
) -> None:
    cloud = surfels_of(name) if flat else gaussians_of(name)
    surface = extract(cloud, replace_config(points=mode))
    report = validate(surface.vertices, surface.faces)
    assert report.watertight and report.components == 1 and report.degenerate_faces == 0
    assert 0.9 * 2500 < report.faces < 1.1 * 2500
    found = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert found.euler_number == (0 if name == "torus" else 2)
    assert report.volume > 0.0, "wound outward"
    apart, normals = distances(surface, shape(name))
    assert apart.mean() < mean and normals < angle
    assert surface.colors is not None
    assert np.abs(surface.colors[..., :3].astype(int) - [204, 51, 26]).max() <= 3


def replace_config(**changes: object) -> ExtractionConfig:
    return QUICK.model_copy(update=changes)


@cache
def torus_surface() -> SurfaceMesh:
    return extract(gaussians_of("torus"), QUICK)


def test_triangles_are_nearly_equilateral() -> None:
    surface = torus_surface()
    corners = surface.vertices[surface.faces].astype(np.float64)
    edges = np.linalg.norm(corners - corners[:, [1, 2, 0]], axis=2)
    doubled = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    quality = 2.0 * np.sqrt(3.0) * doubled / (edges**2).sum(1)  # 1 for an equilateral triangle
    assert quality.mean() > 0.95 and np.quantile(quality, 0.01) > 0.75


def test_the_same_gaussians_give_the_same_bytes() -> None:
    a, b = torus_surface(), extract(gaussians_of("torus"), QUICK)
    assert a.vertices.tobytes() == b.vertices.tobytes() and a.faces.tobytes() == b.faces.tobytes()
    assert a.colors is not None and b.colors is not None and a.colors.tobytes() == b.colors.tobytes()


def test_the_level_set_lies_where_the_density_says() -> None:
    """One isotropic Gaussian: density o exp(-r^2 / 2 s^2) = level at r = s sqrt(2 ln(o / level))."""
    one = Gaussians(
        torch.zeros(1, 3), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), 0.2), torch.tensor([0.9]),
        torch.zeros(1, 1, 3),
    )  # fmt: skip
    directions = torch.nn.functional.normalize(torch.tensor([[-1.0, 0, 0], [-1.0, 0.03, -0.02]]), dim=1)
    origin = torch.tensor([3.0, 0.0, 0.0])
    distance, normals = Density(one).first_crossings(origin, directions, level=0.3, near=1.0, far=5.0)
    radius = 0.2 * np.sqrt(2.0 * np.log(0.9 / 0.3))
    points = origin + distance[:, None] * directions
    assert torch.linalg.norm(points, dim=1).numpy() == pytest.approx(radius, rel=1e-3)
    assert (normals * points).sum(1).numpy() == pytest.approx(radius, rel=1e-3)
    missed, _ = Density(one).first_crossings(origin, -directions, level=0.3, near=1.0, far=5.0)
    assert torch.isinf(missed).all()
    above, _ = Density(one).first_crossings(origin, directions, level=0.95, near=1.0, far=5.0)
    assert torch.isinf(above).all()


@pytest.mark.slow
def test_a_level_set_surface_encloses_the_mesh_closely() -> None:
    surface = extract(gaussians_of("sphere", 1500), replace_config(points="level-set"))
    assert validate(surface.vertices, surface.faces).watertight
    radius = np.linalg.norm(surface.vertices, axis=1)
    assert 0.9 < radius.mean() < 0.95 and radius.std() < 0.01


def test_a_disc_looks_as_its_gaussian_does() -> None:
    """From afar: its covariance across the viewing direction is the Gaussian's, its plane the densest one."""
    g = torch.Generator().manual_seed(3)
    cloud = Gaussians(
        torch.randn(50, 3, generator=g), torch.randn(50, 4, generator=g),
        0.1 * torch.exp(torch.randn(50, 3, generator=g)), torch.rand(50, generator=g), torch.zeros(50, 1, 3),
    )  # fmt: skip
    eye = torch.tensor([4.0, -3.0, 2.0])
    discs = discs_towards(cloud, eye)
    R = rotation_matrices(cloud.quats.double())
    S = (R * cloud.scales.double()[:, None, :] ** 2) @ R.transpose(1, 2)
    Q = rotation_matrices(discs.quats.double())[:, :, :2]
    D = (Q * discs.scales.double()[:, None, :] ** 2) @ Q.transpose(1, 2)
    d = torch.nn.functional.normalize((cloud.means - eye).double(), dim=1)
    across = torch.eye(3).double() - d[:, :, None] * d[:, None, :]
    scale = S.diagonal(dim1=1, dim2=2).amax(1)[:, None, None]
    assert ((across @ (S - D) @ across) / scale).abs().max() < 1e-5
    densest = torch.linalg.solve(S, d[:, :, None])[:, :, 0]
    cosine = torch.nn.functional.cosine_similarity(densest, discs.normals.double(), dim=1).abs()
    assert cosine.min() > 1.0 - 1e-5


def cup() -> trimesh.Trimesh:
    """A cup of revolution: outer radius 0.7, walls 0.12 thick, hollow from the top."""
    profile = [(0, -0.6), (0.7, -0.6), (0.7, 0.6), (0.58, 0.6), (0.58, -0.45), (0, -0.45)]
    dense = np.concatenate([np.linspace(a, b, 12, endpoint=False) for a, b in itertools.pairwise(profile)])
    mesh = trimesh.creation.revolve(np.vstack([dense, profile[-1]]), sections=64)
    return mesh


@pytest.mark.slow
def test_a_cup_stays_hollow() -> None:
    truth = cup()
    assert truth.volume > 0.0
    cloud = bind_mesh(SurfaceMesh.from_arrays(truth.vertices, truth.faces), budget=12000).gaussians()
    surface = extract(cloud, ExtractionConfig(cameras=24, resolution=160, depth=7, triangles=4000))
    report = validate(surface.vertices, surface.faces)
    assert report.watertight and report.components == 1
    assert trimesh.Trimesh(surface.vertices, surface.faces, process=False).euler_number == 2
    solid = np.pi * 0.7**2 * 1.2
    assert report.volume == pytest.approx(truth.volume, rel=0.25)
    assert report.volume < 0.6 * solid, "a filled cup"
    inside = SurfaceIndex(surface.vertices, surface.faces, winding=True).inside
    hollow = np.array([[x, y, z] for x in (-0.3, 0, 0.3) for y in (-0.3, 0, 0.3) for z in (-0.3, 0, 0.4)])
    assert not inside(hollow).any()


@pytest.mark.slow
def test_strays_and_an_open_ground_leave_one_closed_object() -> None:
    g = torch.Generator().manual_seed(1)
    ball = gaussians_of("sphere")
    ball = replace(ball, means=0.5 * ball.means, scales=0.5 * ball.scales)
    side = torch.linspace(-0.8, 0.8, 60)
    x, y = torch.meshgrid(side, side, indexing="ij")
    n = x.numel()
    ground = Gaussians(
        torch.stack([x.flatten(), y.flatten(), torch.full((n,), -0.45)], 1),
        torch.tensor([1.0, 0, 0, 0]).repeat(n, 1), torch.tensor([0.02, 0.02, 0.001]).repeat(n, 1),
        torch.full((n,), 0.95), torch.zeros(n, 1, 3),
    )  # fmt: skip
    strays = Gaussians(
        torch.rand(60, 3, generator=g) * 1.6 - 0.8, torch.randn(60, 4, generator=g),
        torch.full((60, 3), 0.006), torch.full((60,), 0.9), torch.zeros(60, 1, 3),
    )  # fmt: skip
    cloud = Gaussians.concatenate([ball, ground, strays])
    surface = extract(cloud, QUICK)
    report = validate(surface.vertices, surface.faces)
    assert report.watertight and report.components == 1
    open_ = extract(cloud, replace_config(watertight=False))
    assert validate(open_.vertices, open_.faces).boundary_edges > 20
    nearest = SurfaceIndex(open_.vertices, open_.faces).closest(ball.means.numpy())
    apart = np.einsum("nc,ncd->nd", nearest[1], open_.vertices[open_.faces[nearest[0]]]) - ball.means.numpy()
    assert np.quantile(np.linalg.norm(apart, axis=1), 0.75) < 0.02


def test_errors_name_the_way_out() -> None:
    ball = gaussians_of("sphere")
    with pytest.raises(MeshError, match="nothing opaque"):
        extract(replace(ball, opacities=ball.opacities * 0.01), QUICK)
    none = Gaussians(*(getattr(ball, n)[:0] for n in ("means", "quats", "scales", "opacities", "sh")))
    with pytest.raises(MeshError, match="nothing opaque"):
        extract(none, QUICK)
    few = Gaussians(*(getattr(ball, n)[:30] for n in ("means", "quats", "scales", "opacities", "sh")))
    with pytest.raises(MeshError, match=r"only \d+ surface points"):
        extract(few, replace_config(points="centres"))
    nan = replace(ball, means=torch.full_like(ball.means, float("nan")))
    with pytest.raises(MeshError, match="nothing opaque"):
        extract(nan, QUICK)


def test_poisson_without_agreement_is_refused_or_closed() -> None:
    """Points whose normals all look the same way bound nothing."""
    points = oriented_points(gaussians_of("sphere"), QUICK)
    same = OrientedPoints(points.points, np.tile([0.0, 0.0, 1.0], (len(points), 1)), points.colors)
    try:
        vertices, faces, _ = reconstruct(same, QUICK)
    except MeshError as error:
        assert "extraction." in str(error)
    else:
        assert validate(vertices, faces).watertight
