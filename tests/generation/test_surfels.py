"""Stage 1: an even start on the mesh, surfels that turn to the surface, runs that go on to the bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from gdpro_sim.errors import MeshError
from gdpro_sim.gaussians import Gaussians, Surfels, rotation_matrices, sh_to_rgb
from gdpro_sim.generation.config import GuidanceConfig
from gdpro_sim.generation.guidance.views import MeshGuidance
from gdpro_sim.generation.surfels import SurfelStage, facing, sample_surface
from gdpro_sim.meshing.surface import SurfaceMesh
from tests.conditions import needs_gpu
from tests.generation.meshes import ball, small


def test_points_are_spread_evenly_over_the_area() -> None:
    mesh = ball(3, 0.8, stretch=0.5)
    faces, weights = sample_surface(mesh, 400, torch.Generator().manual_seed(0))
    assert weights.min() >= 0.0
    np.testing.assert_allclose(weights.sum(1), 1.0, atol=1e-6)
    corners = mesh.vertices[mesh.faces]
    points = np.einsum("nc,ncd->nd", weights, corners[faces])
    apart = cKDTree(points).query(points, k=2)[0][:, 1]
    areas = 0.5 * np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    lattice = math.sqrt(2.0 / math.sqrt(3.0) * areas.sum() / 400)
    # Points thrown at random are 0.47 lattice spacings from their nearest, with a deviation of half of that.
    assert apart.mean() > 0.65 * lattice
    assert apart.std() < 0.25 * apart.mean()
    upper = (points[:, 2] > 0.2).mean()
    assert upper == pytest.approx(areas[corners[:, :, 2].mean(1) > 0.2].sum() / areas.sum(), abs=0.03)


def test_a_mesh_without_area_is_refused() -> None:
    flat = SurfaceMesh.from_arrays(np.zeros((3, 3)), np.asarray([[0, 1, 2]]))
    with pytest.raises(MeshError, match="no area"):
        sample_surface(flat, 10, torch.Generator())


def test_facing_turns_z_to_any_direction() -> None:
    wanted = torch.randn(50, 3, generator=torch.Generator().manual_seed(0))
    wanted = torch.nn.functional.normalize(
        torch.cat([wanted, torch.tensor([[0.0, 0, 1], [0, 0, -1]])]), dim=1
    )
    torch.testing.assert_close(rotation_matrices(facing(wanted))[:, :, 2], wanted, atol=1e-5, rtol=0.0)


def test_the_start_lies_on_the_mesh_in_its_colours() -> None:
    mesh = ball(3)
    stage = SurfelStage(mesh, MeshGuidance(mesh), small(), 0)
    start = stage.result()
    assert isinstance(start, Surfels)
    assert len(start) == 200
    radii = start.means.norm(dim=1)
    torch.testing.assert_close(radii, torch.full_like(radii, 0.8), atol=0.01, rtol=0.0)
    outward = (start.normals * start.means / radii[:, None]).sum(1)
    assert float(outward.min()) > 0.99
    torch.testing.assert_close(start.opacities, torch.full_like(radii, 0.1))
    up = 0.5 + 0.4 * start.means[:, 2] / 0.8
    torch.testing.assert_close(sh_to_rgb(start.sh[:, 0, 1]), up, atol=0.03, rtol=0.0)
    near = cKDTree(start.means.numpy()).query(start.means.numpy(), k=4)[0][:, 1:]
    np.testing.assert_allclose(start.scales[:, 0], np.sqrt((near**2).mean(1)), rtol=1e-4)


def tilted(stage: SurfelStage, degrees: float) -> None:
    """Turn every surfel by `degrees` about an axis in its plane."""
    state = stage.state_dict()
    w, x, y, z = state["adam.quats"].unbind(1)
    half = math.radians(0.5 * degrees)
    angle = torch.rand(len(w), generator=torch.Generator().manual_seed(5)) * 2.0 * math.pi
    c, a, b = math.cos(half), math.sin(half) * angle.cos(), math.sin(half) * angle.sin()
    state["adam.quats"] = torch.stack(
        [w * c - x * a - y * b, w * a + x * c - z * b, w * b + y * c + z * a, z * c + x * b - y * a], 1
    )
    stage.load_state_dict(state)


def tilt(stage: SurfelStage, mesh: SurfaceMesh) -> float:
    """Mean angle in degrees between the surfels' normals and a ball's."""
    surfels = stage.result()
    assert isinstance(surfels, Surfels)
    outward = torch.nn.functional.normalize(surfels.means, dim=1)
    return math.degrees(float(torch.acos((surfels.normals * outward).sum(1).abs().clamp(max=1.0)).mean()))


def test_surfels_turn_to_the_surface() -> None:
    """Nothing but the pictures says which way the surface faces."""
    mesh = ball(3)
    settings = {"iterations": 60, "resolution": 48, "initial": 250, "initial_opacity": 0.8}
    settings |= {"lr_rotation": 3e-2, "densify_until": 0, "normal_consistency": 0.0, "tv": 0.0}
    config = small(surfels=settings)
    stage = SurfelStage(mesh, MeshGuidance(mesh), config, 0)
    tilted(stage, 35.0)
    before = tilt(stage, mesh)
    assert before == pytest.approx(35.0, abs=1.0)
    for _ in range(stage.iterations):
        stage.step()
    assert tilt(stage, mesh) < 0.6 * before


def test_pictures_come_nearer_to_the_targets() -> None:
    settings = {"iterations": 40, "initial": 400, "maximum": 600, "densify_from": 5, "densify_every": 10}
    settings |= {"densify_gradient": 0.5, "resolution": 48, "initial_opacity": 0.5, "lr_position": 5e-3}
    config = small(surfels=settings, score={"depth_probability": 0.0})
    stage = SurfelStage(ball(1, 0.7), MeshGuidance(ball(3)), config, 0)
    reports = [stage.step() for _ in range(40)]
    psnrs = [r.psnr for r in reports]
    assert all(p is not None for p in psnrs)
    assert np.mean(psnrs[-5:]) > np.mean(psnrs[:5]) + 3.5
    assert 400 < reports[-1].gaussians <= 600
    assert reports[-1].iteration == 40
    assert set(reports[-1].seconds) == {"render", "guidance", "backward", "optimizer", "other"}


def test_disparity_pictures_have_no_psnr_and_still_teach() -> None:
    config = small(score={"depth_probability": 1.0})
    stage = SurfelStage(ball(1), MeshGuidance(ball(3)), config, 0)
    before = stage.result().means.clone()
    assert stage.step().psnr is None
    assert not torch.equal(stage.result().means, before)


@pytest.mark.parametrize("kind", ["surfels", "gaussians"])
@pytest.mark.parametrize("stop", [1, 5, 7])
def test_a_stage_taken_up_again_ends_in_the_same_bytes(kind: str, stop: int) -> None:
    """Across densification, a reset, a higher SH degree, jitter and disparity."""
    settings = {"kind": kind, "densify_from": 0, "densify_every": 3, "densify_until": 6, "sh_degree": 1}
    settings |= {"densify_gradient": 0.1, "sh_every": 4, "reset_every": 5, "distortion": 1.0}
    config = small(surfels=settings, score={"depth_probability": 0.3}, guidance={"jitter": 0.05})
    mesh = ball(2)

    def stage() -> SurfelStage:
        return SurfelStage(mesh, MeshGuidance(ball(3), GuidanceConfig(jitter=0.05)), config, 3)

    whole, part = stage(), stage()
    for _ in range(8):
        whole.step()
    for _ in range(stop):
        part.step()
    again = stage()
    again.load_state_dict({k: v.clone() for k, v in part.state_dict().items()})
    assert again.iteration == stop
    for _ in range(8 - stop):
        again.step()
    wanted, got = whole.state_dict(), again.state_dict()
    assert list(wanted) == list(got)
    assert all(torch.equal(wanted[k], got[k]) for k in wanted)
    assert len(whole.result()) > 200


def test_the_ramp_opens_higher_bands_one_by_one() -> None:
    config = small(surfels={"sh_degree": 2, "sh_every": 3, "densify_until": 0})
    stage = SurfelStage(ball(1), MeshGuidance(ball(3)), config, 0)
    moved = []
    for _ in range(7):
        stage.step()
        rest = stage.result().sh[:, 1:]
        moved.append((bool(rest[:, :3].any()), bool(rest[:, 3:].any())))
    assert moved == [(False, False)] * 3 + [(True, False)] * 3 + [(True, True)]


def test_three_dimensional_gaussians_take_the_same_way() -> None:
    stage = SurfelStage(ball(2), MeshGuidance(ball(3)), small(surfels={"kind": "gaussians"}), 0)
    stage.step()
    result = stage.result()
    assert isinstance(result, Gaussians)
    assert torch.equal(stage.gaussians().means, result.means)


def test_guidance_sees_pictures_reduced_by_the_supersampling() -> None:
    config = small(surfels={"resolution": 64, "supersample": 2})
    guidance = MeshGuidance(ball(3))
    seen = []
    inner = guidance.encode
    guidance.encode = lambda images, views: seen.append(images.shape) or inner(images, views)  # type: ignore
    SurfelStage(ball(2), guidance, config, 0).step()
    assert seen == [(2, 32, 32, 3)]


def test_a_state_that_does_not_fit_is_refused() -> None:
    mesh = ball(1)
    stage = SurfelStage(mesh, MeshGuidance(mesh), small(), 0)
    state = stage.state_dict()
    with pytest.raises(ValueError, match="as many rows"):
        stage.load_state_dict({**state, "adam.logits": state["adam.logits"][:-1]})
    coloured = SurfelStage(mesh, MeshGuidance(mesh), small(surfels={"sh_degree": 1}), 0)
    with pytest.raises(KeyError):
        coloured.load_state_dict(state)
    with pytest.raises(ValueError, match=r"unexpected: rest"):
        stage.load_state_dict(coloured.state_dict())


@pytest.mark.cuda
@needs_gpu
def test_a_step_on_the_gpu_is_that_of_the_cpu() -> None:
    reports = []
    for device in ("cpu", "cuda"):
        stage = SurfelStage(ball(2), MeshGuidance(ball(3), device=device), small(), 0)
        reports.append(stage.step())
        assert stage.result().means.device.type == device
    assert reports[1].loss == pytest.approx(reports[0].loss, rel=1e-2)
