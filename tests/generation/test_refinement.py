"""Stage 2: Gaussians that ride on a learning mesh, its ablations, runs that go on to the bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.gaussians import Surfels, sh_to_rgb
from gdpro_sim.generation.config import RefinementConfig
from gdpro_sim.generation.guidance.views import MeshGuidance
from gdpro_sim.generation.refinement import RefinementStage, bound_start
from gdpro_sim.generation.surfels import SurfelStage
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.repair import face_normals, validate
from tests.conditions import needs_gpu
from tests.generation.meshes import ball, small

MODES = ["bound", "frozen", "unbound", "textured-mesh"]


def stage_of(mode: str, steps: int = 0, **settings: object) -> RefinementStage:
    """A coarse, too small ball that should look like a larger, finer one."""
    config = small(refinement={"mode": mode, "iterations": 8, **settings})
    stage = RefinementStage(ball(2, 0.75), MeshGuidance(ball(3)), config, 1)
    for _ in range(steps):
        stage.step()
    return stage


@pytest.mark.parametrize("count", [1, 3, 4, 6, 10])
def test_the_start_is_the_methods(count: int) -> None:
    mesh = ball(1)
    start = bound_start(mesh, RefinementConfig(per_triangle=count, flatness=0.5))
    assert len(start) == count * len(mesh.faces)
    corners = torch.from_numpy(mesh.vertices)[torch.from_numpy(mesh.faces).long()]
    at = start.gaussians()
    centroids = at.means.view(-1, count, 3).mean(1)
    torch.testing.assert_close(centroids, corners.mean(1), atol=1e-5, rtol=0.0)
    shortest = (corners - corners[:, [1, 2, 0]]).norm(dim=2).amin(1)
    wanted = (shortest * math.sqrt(3.0) / (3.0 * math.sqrt(count))).repeat_interleave(count)
    torch.testing.assert_close(at.scales, wanted[:, None] * torch.tensor([0.5, 1.0, 1.0]))
    torch.testing.assert_close(at.opacities, torch.full_like(wanted, 0.7))
    shown = SurfaceColors(mesh).at(start.face_ids.numpy(), start.barycentrics.numpy())[:, :3]
    np.testing.assert_allclose(sh_to_rgb(at.sh[:, 0]).numpy(), shown, atol=1e-6)


def test_vertices_learn_and_gaussians_ride() -> None:
    stage = stage_of("bound", 8, lr_vertex=1e-2)
    result, start = stage.result(), bound_start(ball(2, 0.75), RefinementConfig(per_triangle=3))
    assert float((result.vertices - start.vertices).norm(dim=1).min()) > 1e-4
    for name in ("faces", "face_ids", "barycentrics"):
        assert torch.equal(getattr(result, name), getattr(start, name)), name
    corners = result.vertices[result.faces.long()][result.face_ids.long()]
    riding = (corners * result.barycentrics[:, :, None]).sum(1)
    torch.testing.assert_close(stage.gaussians().means, riding)
    for name in ("rotations", "log_scales", "opacity_logits", "sh"):
        assert not torch.equal(getattr(result, name), getattr(start, name)), name


def test_frozen_means_stay_and_the_rest_learns() -> None:
    stage = stage_of("frozen", 8)
    result, start = stage.result(), bound_start(ball(2, 0.75), RefinementConfig(per_triangle=3))
    assert torch.equal(result.vertices, start.vertices)
    assert torch.equal(stage.gaussians().means, start.gaussians().means)
    assert not torch.equal(result.log_scales, start.log_scales)


def test_unbound_starts_bound_or_where_stage_one_ended() -> None:
    bound = bound_start(ball(2, 0.75), RefinementConfig(per_triangle=3)).gaussians()
    stage = stage_of("unbound")
    for name in ("means", "scales", "sh"):
        torch.testing.assert_close(getattr(stage.gaussians(), name), getattr(bound, name))
    stage.step()
    assert not torch.equal(stage.gaussians().means, bound.means)
    with pytest.raises(RequestError, match="ride no mesh"):
        stage.result()
    config = small(refinement={"mode": "unbound"})
    first = SurfelStage(ball(2), MeshGuidance(ball(3)), config, 0).result()
    assert isinstance(first, Surfels)
    second = RefinementStage(ball(2), MeshGuidance(ball(3)), config, 0, start=first)
    assert torch.equal(second.gaussians().means, first.means)
    with pytest.raises(RequestError, match="only unbound takes"):
        RefinementStage(ball(2), MeshGuidance(ball(3)), small(), 0, start=first)


def test_a_textured_mesh_learns_its_colours_alone() -> None:
    config = small(refinement={"mode": "textured-mesh", "iterations": 25, "lr_color": 0.1})
    grey = ball(2)
    grey = grey.__class__(
        grey.vertices, grey.faces, None, np.full_like(grey.colors, 128), grey.material_ids, grey.materials
    )
    stage = RefinementStage(grey, MeshGuidance(ball(3)), config, 1)
    reports = [stage.step() for _ in range(25)]
    assert all(r.psnr is not None for r in reports)
    assert np.mean([r.psnr for r in reports[-3:]]) > reports[0].psnr + 4.0
    mesh = stage.mesh()
    assert np.array_equal(mesh.vertices, grey.vertices)
    up = 0.5 + 0.4 * mesh.vertices[:, 2] / 0.8
    assert np.abs(stage.vertex_colors()[:, 1] - up).mean() < 0.08
    assert np.array_equal(stage.result().vertices.numpy(), grey.vertices)


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("stop", [1, 5])
def test_a_stage_taken_up_again_ends_in_the_same_bytes(mode: str, stop: int) -> None:
    whole, part, again = (
        stage_of(mode, 7, sh_degree=1),
        stage_of(mode, stop, sh_degree=1),
        stage_of(mode, sh_degree=1),
    )
    again.load_state_dict({k: v.clone() for k, v in part.state_dict().items()})
    assert again.iteration == stop
    for _ in range(7 - stop):
        again.step()
    wanted, got = whole.state_dict(), again.state_dict()
    assert list(wanted) == list(got)
    assert all(torch.equal(wanted[k], got[k]) for k in wanted)


def test_pictures_and_mesh_come_nearer_to_the_target() -> None:
    settings = {"iterations": 50, "lr_vertex": 2e-2, "lr_vertex_final": 5e-3, "resolution": 48}
    stage = RefinementStage(ball(2, 0.7), MeshGuidance(ball(3)), small(refinement=settings), 0)
    psnrs = [r.psnr for r in (stage.step() for _ in range(50)) if r.psnr is not None]
    assert np.mean(psnrs[-8:]) > np.mean(psnrs[:4]) + 3.0
    radii = stage.result().vertices.norm(dim=1)
    assert abs(float(radii.mean()) - 0.8) < 0.06
    assert float(radii.std()) < 0.02


def test_the_mesh_stays_usable_under_steps_that_are_far_too_long() -> None:
    stage = stage_of("bound", 8, lr_vertex=1.0, lr_vertex_final=1.0)
    mesh = stage.mesh()
    report = validate(mesh.vertices, mesh.faces)
    assert report.watertight
    start = ball(2, 0.75)
    outward = np.einsum(
        "fc,fc->f", face_normals(mesh.vertices, mesh.faces), mesh.vertices[mesh.faces].mean(1)
    )
    assert (outward > 0.0).mean() > 0.98
    assert len(mesh.faces) == len(start.faces)


def test_vertex_colours_are_those_of_the_gaussians_around() -> None:
    stage = stage_of("bound")
    colors = stage.vertex_colors()
    mesh = ball(2, 0.75)
    assert colors.shape == mesh.vertices.shape
    assert colors.dtype == np.float32
    up = 0.5 + 0.4 * mesh.vertices[:, 2] / np.abs(mesh.vertices[:, 2]).max()
    assert np.abs(colors[:, 1] - up).max() < 0.1


def test_what_cannot_be_bound_is_refused() -> None:
    guidance, mesh = MeshGuidance(ball(2)), ball(1)
    with pytest.raises(MeshError, match="Gaussians per triangle"):
        RefinementStage(mesh, guidance, small(refinement={"per_triangle": 5}), 0)
    empty = mesh.__class__(mesh.vertices, mesh.faces[:0], None, None, mesh.material_ids[:0], mesh.materials)
    with pytest.raises(MeshError, match="no faces"):
        RefinementStage(empty, guidance, small(), 0)
    state = stage_of("bound").state_dict()
    with pytest.raises(ValueError, match="rows"):
        RefinementStage(mesh, guidance, small(), 0).load_state_dict(state)


@pytest.mark.cuda
@needs_gpu
def test_a_step_on_the_gpu_is_that_of_the_cpu() -> None:
    reports = []
    for device in ("cpu", "cuda"):
        stage = RefinementStage(ball(2), MeshGuidance(ball(3), device=device), small(), 0)
        reports.append(stage.step())
        assert stage.result().vertices.device.type == device
    assert reports[1].loss == pytest.approx(reports[0].loss, rel=1e-2)
