"""Pictures of meshes against closed forms and the plain way of casting rays; of Gaussians; disparity."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.device import set_thread_count, thread_count
from gdpro_sim.gaussians import Gaussians, rgb_to_sh
from gdpro_sim.generation.cameras import held_out, ring
from gdpro_sim.generation.renders import GaussianRenderer, MeshRenderer, corner_normals, disparity
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh
from gdpro_sim.splatting import rasterization
from tests.conditions import needs_gpu
from tests.meshing import shapes

WHITE = (1.0, 1.0, 1.0, 1.0)


def coloured(v: np.ndarray, f: np.ndarray, base: tuple[float, ...] = WHITE, seed: int = 0) -> SurfaceMesh:
    """Random colours at corners, opaque."""
    colors = np.random.default_rng(seed).integers(0, 256, (len(f), 3, 4), np.uint8)
    colors[..., 3] = 255
    return SurfaceMesh(v, f, None, colors, np.zeros(len(f), np.int32), (MeshMaterial("m", base),))


def square(texture: np.ndarray, *, cutout: bool = False, colors: np.ndarray | None = None) -> SurfaceMesh:
    """The square x, y in [-0.5, 0.5] at z = 0 with a texture across it."""
    v, f = shapes.sheet(1)
    material = MeshMaterial("m", WHITE, texture, cutout)
    uv = v[f][..., :2].copy()
    return SurfaceMesh(v - np.float32([0.5, 0.5, 0]), f, uv, colors, np.zeros(2, np.int32), (material,))


def above(distance: float, size: int, fov: float = 0.3) -> Cameras:
    """Straight down on the origin."""
    return Cameras.look_at([[0.0, 0.0, distance]], (0.0, 0.0, 0.0), vertical_fov=fov, width=size, height=size)


def points_seen(cameras: Cameras, depths: torch.Tensor) -> torch.Tensor:
    """World points [C, H, W, 3] at the pixels' depths."""
    y, x = torch.meshgrid(
        torch.arange(cameras.height) + 0.5, torch.arange(cameras.width) + 0.5, indexing="ij"
    )
    local = torch.einsum(
        "cij,hwj->chwi", torch.linalg.inv(cameras.Ks), torch.stack([x, y, torch.ones_like(x)], -1)
    )
    turned = torch.einsum("cji,chwj->chwi", cameras.viewmats[:, :3, :3], local * depths)
    return turned + cameras.positions[:, None, None]


def test_a_sphere_is_where_and_as_large_as_it_should_be() -> None:
    radius, distance = 0.7, 5.0
    cameras = held_out(3, 128)
    mesh = SurfaceMesh.from_arrays(*shapes.sphere(5, radius), color=(0.2, 0.5, 0.8))
    seen = MeshRenderer(mesh, normals=True).render(cameras, rays=4)
    disc = float(cameras.Ks[0, 0, 0]) * radius / math.sqrt(distance**2 - radius**2)
    areas = seen.alphas.sum((1, 2, 3))
    assert torch.allclose(areas, torch.full((3,), math.pi * disc**2), rtol=2e-3)
    whole = seen.alphas[..., 0] > 0.999
    points = points_seen(cameras, seen.depths)[whole]
    assert float((points.norm(dim=1) - radius).abs().max()) < 4e-3  # several depths within an edge pixel
    middle = points_seen(cameras, seen.depths)[:, 64, 64]
    assert torch.allclose(middle.norm(dim=1), torch.full((3,), radius), atol=1e-3)
    normals = torch.nn.functional.normalize(points)
    assert float((seen.normals[whole] * normals).sum(1).min()) > math.cos(math.radians(3.0))
    assert torch.allclose(seen.rgb, seen.alphas * torch.tensor([0.2, 0.5, 0.8]), atol=1e-6)
    empty = seen.alphas[..., 0] == 0.0
    assert float(seen.depths[empty].abs().max()) == 0.0
    assert float(seen.normals[empty].abs().max()) == 0.0


def test_colours_and_depth_of_a_slanted_plane_are_linear_on_it() -> None:
    v, f = shapes.sheet(1)
    v = v - np.float32([0.5, 0.5, 0.0])
    ramp = np.clip(v[f] + 0.5, 0, 1) * 255  # red along x, green along y
    colors = np.concatenate([ramp.round().astype(np.uint8), np.full((len(f), 3, 1), 255, np.uint8)], 2)
    colors[..., 2] = 0
    mesh = SurfaceMesh(v, f, None, colors, np.zeros(len(f), np.int32), (MeshMaterial("m", WHITE),))
    cameras = Cameras.look_at([[1.5, -1.0, 2.0]], (0, 0, 0), vertical_fov=0.5, width=96, height=80)
    seen = MeshRenderer(mesh).render(cameras, rays=1)
    whole = seen.alphas[..., 0] == 1.0
    assert int(whole.sum()) > 500
    points = points_seen(cameras, seen.depths)[whole]
    assert float(points[:, 2].abs().max()) < 1e-5
    assert torch.allclose(seen.rgb[whole][:, :2], points[:, :2] + 0.5, atol=1e-4)


@pytest.mark.parametrize("base", [WHITE, (0.8, 0.6, 0.4, 1.0)])
def test_the_same_as_casting_rays_one_by_one(base: tuple[float, ...]) -> None:
    """SurfaceIndex and SurfaceColors, as examples/fit_views.py draws."""
    mesh, rays, size = coloured(*shapes.sphere(2, 0.8), base), 3, 24
    cameras = ring(2, size)
    seen = MeshRenderer(mesh).render(cameras, rays=rays)
    steps = (np.arange(size * rays) + 0.5) / rays
    x, y = np.meshgrid(steps, steps)
    pixels = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    index, colors = SurfaceIndex(mesh.vertices, mesh.faces), SurfaceColors(mesh)
    for c, eye in enumerate(cameras.positions.numpy()):
        directions = pixels @ np.linalg.inv(cameras.Ks[c].numpy()).T @ cameras.viewmats[c, :3, :3].numpy()
        faces, barycentric = index.first_hit(np.broadcast_to(eye, directions.shape), directions)
        values = np.zeros((len(directions), 4), np.float32)
        values[faces >= 0, :3] = colors.at(faces[faces >= 0], barycentric[faces >= 0])[:, :3]
        values[faces >= 0, 3] = 1.0
        picture = torch.from_numpy(values.reshape(size, rays, size, rays, 4).mean((1, 3)))
        apart = (torch.cat([seen.rgb[c], seen.alphas[c]], -1) - picture).abs()
        # A base that is not white is multiplied in at the corners, not at every point.
        assert float(apart.mean()) < (1e-5 if base == WHITE else 1e-3)
        assert float(apart.quantile(0.99)) < (1e-4 if base == WHITE else 1e-2)


def test_a_near_texture_is_interpolated_as_surface_colors_does() -> None:
    texture = np.random.default_rng(1).integers(0, 256, (5, 7, 4), np.uint8)
    colors = np.random.default_rng(2).integers(100, 256, (2, 3, 4), np.uint8)
    colors[..., 3] = 255
    mesh = square(texture, colors=colors)
    cameras = above(3.0, 64)
    seen = MeshRenderer(mesh).render(cameras, rays=1)
    points = points_seen(cameras, seen.depths)[seen.alphas[..., 0] == 1.0].numpy()
    faces, barycentric = SurfaceIndex(mesh.vertices, mesh.faces).closest(points)
    expected = SurfaceColors(mesh).at(faces, barycentric)[:, :3]
    apart = np.abs(seen.rgb[seen.alphas[..., 0] == 1.0].numpy() - expected)
    assert np.quantile(apart, 0.995) < 2e-4  # a point on the diagonal may take the other face


def test_a_far_texture_is_averaged() -> None:
    texture = np.zeros((256, 256, 4), np.uint8)
    texture[::2, ::2] = texture[1::2, 1::2] = 255  # a chequerboard of single texels
    seen = MeshRenderer(square(texture)).render(above(4.0, 32), rays=1)
    inside = seen.rgb[seen.alphas[..., 0] == 1.0]
    assert len(inside) > 200
    assert float((inside - 0.5).abs().max()) < 0.01


def test_holes_of_a_cutout_texture_show_what_is_behind() -> None:
    texture = np.full((2, 2, 4), 255, np.uint8)
    texture[:, 1, 3] = 0
    front = square(texture, cutout=True)
    opaque = MeshRenderer(square(texture)).render(above(3.0, 32), rays=2)
    seen = MeshRenderer(front).render(above(3.0, 32), rays=2)
    assert float(opaque.alphas[0, 16, 12]) == float(opaque.alphas[0, 16, 20]) == 1.0
    middle = seen.alphas[0, 4:28, 4:28]
    assert float(middle.max()) > 0.95
    assert float(middle.min()) < 0.05
    assert float(middle.mean()) == pytest.approx(0.5, abs=0.02)


def test_half_opaque_faces_blend_with_those_behind() -> None:
    v, f = shapes.sheet(1)
    v = v - np.float32([0.5, 0.5, 0.0])
    both = shapes.joined((v + np.float32([0, 0, 0.2]), f), (v, f))
    materials = (MeshMaterial("glass", (1.0, 0.0, 0.0, 0.25)), MeshMaterial("wall", (0.0, 0.0, 1.0, 1.0)))
    mesh = SurfaceMesh(*both, None, None, np.int32([0, 0, 1, 1]), materials)
    seen = MeshRenderer(mesh).render(above(3.0, 16), rays=1)
    assert torch.allclose(seen.rgb[0, 8, 8], torch.tensor([0.25, 0.0, 0.75]), atol=1e-5)
    assert float(seen.alphas[0, 8, 8]) == pytest.approx(1.0)
    assert float(seen.depths[0, 8, 8]) == pytest.approx(0.25 * 2.8 + 0.75 * 3.0, abs=1e-5)


@pytest.mark.parametrize("rays", [1, 2, 3])
def test_the_z_buffer_and_cast_rays_give_the_same_pictures(rays: int) -> None:
    mesh = coloured(*shapes.joined(shapes.sphere(2, 0.9), shapes.sphere(1, 0.5)))
    cameras = Cameras.look_at(
        [[2.5, 0.4, 0.8], [0.0, -1.2, -0.3]], (0, 0, 0.1), vertical_fov=0.7, width=40, height=30
    )
    renderer = MeshRenderer(mesh, normals=True)
    seen = renderer.render(cameras, rays)
    renderer._opaque = False
    cast = renderer.render(cameras, rays)
    for name, limit in (("rgb", 1e-4), ("alphas", 1e-6), ("depths", 1e-4), ("normals", 1e-3)):
        apart = (getattr(seen, name) - getattr(cast, name)).abs().amax(-1)
        # A sample on the edge of two faces, or of the object, may go to either.
        assert float((apart > limit).float().mean()) < 0.004, name
    assert float(seen.alphas.min()) == 0.0
    assert float(seen.alphas.max()) == 1.0


def test_a_camera_within_the_sphere_around_a_mesh_sees_its_inside() -> None:
    renderer = MeshRenderer(SurfaceMesh.from_arrays(*shapes.sphere(3, 1.0)), normals=True)
    inside = Cameras.look_at([[0.3, 0.0, 0.0]], (0, 0, 0), vertical_fov=1.0, width=16, height=16)
    seen = renderer.render(inside)
    assert float(seen.alphas.min()) == 1.0
    assert float(seen.depths[0, 8, 8]) == pytest.approx(1.3, abs=0.02)
    assert float(seen.normals[0, 8, 8, 0]) > 0.98  # towards the camera


@pytest.fixture
def threads() -> Iterator[None]:
    before = thread_count()
    yield
    set_thread_count(before)


def test_the_same_bytes_for_any_number_of_threads(threads: None) -> None:
    mesh = coloured(*shapes.sphere(3, 0.9))
    pictures = []
    for count in (1, 2, 5):
        set_thread_count(count)
        seen = MeshRenderer(mesh, normals=True).render(ring(2, 48))
        pictures.append([t.numpy().tobytes() for t in (seen.rgb, seen.alphas, seen.depths, seen.normals)])
    assert pictures[0] == pictures[1] == pictures[2]


def test_corner_normals_are_round_on_a_sphere_and_flat_on_a_cube() -> None:
    v, f = shapes.sphere(3)
    round_ = corner_normals(SurfaceMesh.from_arrays(v, f))
    assert float((round_ * v[f]).sum(2).min()) > 0.999
    v, f = shapes.cube()
    flat = corner_normals(SurfaceMesh.from_arrays(v, f))
    assert np.allclose(np.abs(flat).max(2), 1.0)


@pytest.mark.cuda
@needs_gpu
def test_cuda_draws_what_the_cpu_draws() -> None:
    mesh, cameras = coloured(*shapes.sphere(3, 0.9)), held_out(2, 48)
    cpu = MeshRenderer(mesh, normals=True).render(cameras)
    gpu = MeshRenderer(mesh, device="cuda", normals=True).render(cameras)
    for name in ("rgb", "alphas", "depths", "normals"):
        apart = (getattr(gpu, name).cpu() - getattr(cpu, name)).abs().amax(-1)
        assert float((apart > 1e-3).float().mean()) < 0.004, name


def test_over_a_background_and_as_an_image() -> None:
    cameras = ring(2, 32)
    seen = MeshRenderer(coloured(*shapes.sphere(2, 0.6))).render(cameras)
    backgrounds = torch.tensor([[1.0, 1.0, 1.0], [0.1, 0.2, 0.3]])
    over = seen.over(backgrounds)
    assert torch.equal(over[1, 0, 0], backgrounds[1])
    assert torch.equal(over[:, 16, 16], seen.rgb[:, 16, 16])
    assert torch.equal(seen.image("rgb", backgrounds), over)
    assert torch.equal(seen.image("disparity", backgrounds), disparity(seen.depths, seen.alphas, cameras))


def test_disparity_runs_from_one_to_a_tenth_over_the_unit_sphere() -> None:
    cameras = held_out(2, 2)
    depths = torch.tensor([3.5, 4.0, 5.0, 6.0]).view(1, 2, 2, 1).repeat(2, 1, 1, 1).requires_grad_()
    alphas = torch.ones(2, 2, 2, 1)
    grey = disparity(depths, alphas, cameras)
    assert grey.shape == (2, 2, 2, 3)
    expected = torch.tensor([1.0, 1.0, 0.55, 0.1]).view(1, 2, 2, 1).expand(2, 2, 2, 3)
    assert torch.allclose(grey, expected, atol=1e-5)
    assert torch.allclose(disparity(depths, 0.5 * alphas, cameras), 0.5 * expected, atol=1e-5)
    assert float(disparity(depths, 0.0 * alphas, cameras).detach().abs().max()) == 0.0
    (slope,) = torch.autograd.grad(grey[:, 1, 0].sum(), depths)
    assert torch.allclose(slope[:, 1, 0, 0], torch.full((2,), -3 * 0.45))


def test_gaussians_are_drawn_over_black() -> None:
    draw = torch.Generator().manual_seed(0)
    means = 0.3 * torch.randn(300, 3, generator=draw)
    sh = rgb_to_sh(torch.rand(300, 1, 3, generator=draw))
    quats = torch.tensor([[1.0, 0.0, 0.0, 0.0]]).expand(300, 4).contiguous()
    g = Gaussians(means, quats, torch.full((300, 3), 0.05), torch.full((300,), 0.8), sh)
    cameras = ring(2, 48)
    seen = GaussianRenderer(g).render(cameras, rays=1)
    arguments = (means, quats, g.scales, g.opacities, sh, cameras.viewmats, cameras.Ks, 48, 48)
    backgrounds = torch.tensor([[1.0, 0.5, 0.0]] * 2)
    image, alphas, _ = rasterization(*arguments, sh_degree=0, backgrounds=backgrounds)
    assert torch.allclose(seen.over(backgrounds), image, atol=1e-5)
    assert torch.equal(seen.alphas, alphas)
    assert float(seen.depths[alphas == 0].abs().max()) == 0.0
    finer = Cameras(cameras.viewmats, cameras.Ks * torch.tensor([2.0, 2.0, 1.0])[:, None], 96, 96)
    reduced = (
        GaussianRenderer(g).render(finer, rays=1).over(backgrounds).view(2, 48, 2, 48, 2, 3).mean((2, 4))
    )
    assert torch.allclose(GaussianRenderer(g).render(cameras).over(backgrounds), reduced, atol=1e-5)
    assert 3.5 < float(seen.depths[alphas > 0.5].min()) < float(seen.depths.max()) < 6.5
