"""How the rasterisers behave as parts of an autograd graph."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim import device
from gdpro_sim.splatting import contributions, rasterization, rasterization_2dgs, slabs
from tests.splatting.scenes import cameras, cloud, features

BOTH = pytest.mark.parametrize("render", [rasterization, rasterization_2dgs])


def leaves(count: int) -> dict[str, torch.Tensor]:
    scene = {**cloud(count, 0), "colors": features(count, 3, 0)}
    return {name: value.requires_grad_() for name, value in scene.items()}


@BOTH
def test_second_derivatives_are_refused(render) -> None:
    scene = leaves(10)
    image, alpha, *_ = render(**scene, **cameras(1, 20, 20), render_mode="RGB+D")
    loss = (image.square().sum() + alpha.sum()).reshape(())
    (gradient,) = torch.autograd.grad(loss, scene["means"], create_graph=True)
    with pytest.raises(RuntimeError):
        (loss + gradient.square().sum()).backward()


@BOTH
@pytest.mark.parametrize(("count", "views"), [(0, 1), (5, 0), (0, 0)])
def test_nothing_to_draw_has_gradients_too(render, count: int, views: int) -> None:
    scene = leaves(count)
    placed = cameras(1, 9, 7)
    matrices = {name: placed[name][:views].clone().requires_grad_() for name in ("viewmats", "Ks")}
    image, alpha, *_ = render(**scene, **matrices, width=9, height=7)
    (image.sum() + alpha.sum()).backward()
    for tensor in (*scene.values(), *matrices.values()):
        assert torch.equal(tensor.grad, torch.zeros_like(tensor))


@BOTH
def test_contributions_of_nothing(render) -> None:
    scene = {name: value.detach() for name, value in leaves(5).items()}
    views = cameras(1, 9, 7)
    *_, meta = render(**scene, **views)
    assert contributions(meta, torch.zeros(1, 7, 9, 0)).shape == (1, 5, 0)
    none = {**views, "viewmats": torch.zeros(0, 4, 4), "Ks": torch.zeros(0, 3, 3)}
    *_, meta = render(**scene, **none)
    assert contributions(meta).shape == (0, 5)
    batch = {name: value[None] for name, value in scene.items()}
    *_, meta = render(**batch, viewmats=views["viewmats"][None], Ks=views["Ks"][None], width=9, height=7)
    with pytest.raises(ValueError, match="meta has batch axes"):
        contributions(meta)


@BOTH
def test_many_slabs_give_the_same_bits(render, monkeypatch: pytest.MonkeyPatch) -> None:
    """Slabs of less than a row of tiles: nearly everything is spilled and merged."""
    before = device.thread_count()
    views = cameras(2, 100, 75)
    results = []
    try:
        for threads, rows in ((1, 4.0), (2, 0.5), (8, 0.2)):
            device.set_thread_count(threads)
            monkeypatch.setattr(slabs, "SMALLEST_SLAB", rows)
            scene = leaves(300)
            image, alpha, *_ = render(**scene, **views, render_mode="RGB+D")
            (image.square().sum() + alpha.square().sum()).backward()
            results.append([value.grad for value in scene.values()])
    finally:
        device.set_thread_count(before)
    for other in results[1:]:
        for one, two in zip(results[0], other, strict=True):
            assert torch.equal(one, two)


def test_opacities_and_depths_of_both_kinds() -> None:
    scene = {name: value.detach() for name, value in leaves(30).items()}
    views = cameras(1, 40, 40)
    _, _, gaussians = rasterization(**scene, **views)
    *_, surfels = rasterization_2dgs(**scene, **views)
    drawn = (gaussians["radii"] > 0).all(-1) & (surfels["radii"] > 0).all(-1)
    assert drawn.sum() > 15
    for name in ("opacities", "depths"):
        torch.testing.assert_close(gaussians[name][drawn], surfels[name][drawn], rtol=1e-5, atol=1e-6)
