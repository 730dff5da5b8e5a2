"""What both stages share: reduced pictures, views of an iteration, time by part."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.generation.distillation import Clock, Distillation, Shot, nested, reduced, variation
from gdpro_sim.generation.guidance.views import MeshGuidance
from gdpro_sim.generation.renders import disparity
from tests.generation.meshes import ball, small


def distillation(*, depth_probability: float = 0.0, supersample: int = 2) -> Distillation:
    config = small(score={"depth_probability": depth_probability})
    part = config.surfels.model_copy(
        update={"iterations": 10, "batch": 3, "resolution": 32, "supersample": supersample}
    )
    return Distillation("test", MeshGuidance(ball(2)), config, part, 5)


@pytest.mark.parametrize("factor", [1, 2, 3])
def test_reduced_pictures_are_torchs_pooling_and_so_are_gradients(factor: int) -> None:
    g = torch.Generator().manual_seed(0)
    images = torch.rand(2, 4 * factor, 5 * factor, 3, generator=g, dtype=torch.float64).requires_grad_()
    weights = torch.rand(2, 4, 5, 3, generator=g, dtype=torch.float64)
    wanted = torch.nn.functional.avg_pool2d(images.permute(0, 3, 1, 2), factor).permute(0, 2, 3, 1)
    torch.testing.assert_close(reduced(images, factor), wanted)
    (expected,) = torch.autograd.grad((wanted * weights).sum(), images)
    (got,) = torch.autograd.grad((reduced(images, factor) * weights).sum(), images)
    torch.testing.assert_close(got, expected)


def test_an_iteration_always_draws_the_same_views() -> None:
    first, _ = distillation(depth_probability=0.5).look(4)
    again, generator = distillation(depth_probability=0.5).look(4)
    other, _ = distillation(depth_probability=0.5).look(5)
    assert torch.equal(first.cameras.viewmats, again.cameras.viewmats)
    assert torch.equal(first.backgrounds, again.backgrounds)
    assert first.kind == again.kind
    assert not torch.equal(first.cameras.viewmats, other.cameras.viewmats)
    assert isinstance(generator, torch.Generator)


def test_the_share_of_disparity_pictures() -> None:
    kinds = [distillation(depth_probability=0.3).look(i)[0].kind for i in range(60)]
    assert 8 < kinds.count("disparity") < 30
    assert {distillation().look(i)[0].kind for i in range(10)} == {"rgb"}


def test_rendered_cameras_see_the_same_picture_finer() -> None:
    shared = distillation()
    views, _ = shared.look(0)
    finer, backgrounds = shared.rendered(views)
    assert (views.cameras.width, finer.width, finer.height) == (16, 32, 32)
    assert torch.equal(backgrounds, views.backgrounds)
    point = torch.tensor([0.3, -0.2, 0.1, 1.0])
    for coarse, fine in ((views.cameras, finer),):
        a = coarse.Ks @ (coarse.viewmats @ point)[:, :3, None]
        b = fine.Ks @ (fine.viewmats @ point)[:, :3, None]
        torch.testing.assert_close(2.0 * a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:])


def test_disparity_is_shown_where_it_is_asked_for() -> None:
    shared = distillation(depth_probability=1.0, supersample=1)
    views, _ = shared.look(0)
    size = views.cameras.height
    shot = Shot(
        views.cameras,
        torch.zeros(3, size, size, 3),
        torch.full((3, size, size, 1), 5.0),
        torch.full((3, size, size, 1), 0.5),
    )
    wanted = disparity(shot.depths, shot.alphas, views.cameras)
    assert torch.equal(shared.pictures(shot, views), wanted)
    assert float(variation(shot)) == pytest.approx(0.0, abs=1e-6)


def test_parts_of_a_step_add_up() -> None:
    clock = Clock()
    with clock.part("render"):
        torch.randn(100_000).sort()
    seconds = clock.stop()
    assert seconds["render"] > 0.0
    assert seconds["guidance"] == 0.0
    assert seconds["other"] >= 0.0


def test_nested_states_are_found_by_prefix() -> None:
    state = {"adam.a": torch.ones(1), "adam.a.first": torch.zeros(1), "score.n": torch.ones(1)}
    assert set(nested(state, "adam")) == {"a", "a.first"}
