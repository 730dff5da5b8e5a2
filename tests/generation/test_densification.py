"""Gaussians are cloned, split and pruned where the method says, and never beyond the cap."""

from __future__ import annotations

import math

import pytest
import torch

from gdpro_sim.generation.config import SurfelConfig
from gdpro_sim.generation.densification import RESET_OPACITY, Densification
from gdpro_sim.generation.optimizer import Adam

RULES = SurfelConfig(
    maximum=16,
    densify_from=0,
    densify_until=100,
    densify_every=10,
    densify_gradient=1.0,
    split_size=0.1,
    split_factor=1.6,
    prune_opacity=0.05,
    reset_every=0,
)


def scene(axes: int = 2) -> Adam:
    """Six Gaussians: the first three small, the others large; the fifth is transparent."""
    size = torch.tensor([0.01, 0.02, 0.05, 0.2, 0.3, 0.4])
    leaves = {
        "means": torch.arange(18.0).view(6, 3),
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(6, 1),
        "log_scales": size.log()[:, None].repeat(1, axes),
        "logits": torch.logit(torch.tensor([0.5, 0.5, 0.5, 0.5, 0.01, 0.5])),
        "dc": torch.rand(6, 1, 3, generator=torch.Generator().manual_seed(0)),
    }
    adam = Adam(leaves, dict.fromkeys(leaves, (1e-9, 1e-9)))
    for value in adam.parameters.values():
        value.grad = torch.ones_like(value)
    adam.step(0.0)
    return adam


def collected(lengths: list[float], rules: SurfelConfig = RULES) -> Densification:
    """Gradients of these lengths in NDC, seen by one camera of 20 x 10 pixels."""
    densification = Densification(rules, len(lengths), torch.device("cpu"))
    shifts = torch.zeros(1, len(lengths), 2)
    shifts[0, :, 0] = torch.tensor(lengths) / 10.0
    densification.collect(shifts, torch.ones(1, len(lengths), 2, dtype=torch.int32), 20, 10)
    return densification


def test_gradients_are_averaged_over_the_views_that_see_a_gaussian() -> None:
    densification = Densification(RULES, 2, torch.device("cpu"))
    shifts = torch.tensor([[[0.3, 0.0], [1.0, 0.0]], [[0.0, 0.8], [9.0, 9.0]]])
    radii = torch.tensor([[[4, 4], [4, 4]], [[4, 4], [0, 0]]], dtype=torch.int32)
    densification.collect(shifts, radii, 20, 10)
    torch.testing.assert_close(densification.mean_gradients(), torch.tensor([(3.0 + 4.0) / 2, 10.0]))


@pytest.mark.parametrize("axes", [2, 3])
def test_small_ones_are_cloned_large_ones_split_transparent_ones_dropped(axes: int) -> None:
    adam, before = scene(axes), scene(axes)
    densification = collected([2.0, 0.5, 0.5, 3.0, 9.0, 0.5])
    densification.update(adam, 10, torch.Generator().manual_seed(1))
    kept = [0, 1, 2, 3, 5]
    assert len(adam["means"]) == 7
    for name in before.parameters:
        same = [0, 1, 2, 4] if name in ("means", "log_scales") else [0, 1, 2, 3, 4]
        assert torch.equal(adam[name][same], before[name][[kept[i] for i in same]]), name
    # the clone of the first, and both halves of the fourth
    for name in before.parameters:
        assert torch.equal(adam[name][5], before[name][0]), name
    smaller = before["log_scales"][3] - math.log(1.6)
    for half in (3, 6):
        torch.testing.assert_close(adam["log_scales"][half], smaller)
        away = (adam["means"][half] - before["means"][3]).detach().abs()
        assert 0.0 < float(away.max()) < 5 * 0.2
        if axes == 2:  # surfels stay in their plane
            assert float(away[2]) == 0.0
    state = adam.state_dict()
    assert not state["dc.first"][[3, 5, 6]].any()
    assert state["dc.first"][[0, 1, 2, 4]].all()
    assert not densification.mean_gradients().any()


def test_the_cap_lets_the_neediest_in() -> None:
    adam = scene()
    collected([2.0, 3.0, 4.0, 0.0, 9.0, 0.0], RULES.model_copy(update={"maximum": 16})).update(
        adam, 10, torch.Generator()
    )
    assert len(adam["means"]) == 8
    for cap, clones in ((6, [2]), (5, []), (1, [])):
        adam, before = scene(), scene()
        rules = RULES.model_construct(**{**RULES.model_dump(), "maximum": cap})
        collected([2.0, 3.0, 4.0, 0.0, 9.0, 0.0], rules).update(adam, 10, torch.Generator())
        assert len(adam["means"]) == 5 + len(clones)
        assert torch.equal(adam["means"][5:], before["means"][clones])


def test_nothing_happens_out_of_turn() -> None:
    for iteration in (9, 11, 110):
        adam = scene()
        collected([9.0] * 6).update(adam, iteration, torch.Generator())
        assert len(adam["means"]) == 6


def test_the_last_gaussian_stays() -> None:
    adam = scene()
    adam["logits"].data.fill_(-20.0)
    collected([0.0] * 6).update(adam, 10, torch.Generator())
    assert len(adam["means"]) == 1


def test_a_reset_leaves_little_opacity_and_no_momentum() -> None:
    rules = RULES.model_copy(update={"reset_every": 7})
    adam = scene()
    collected([0.0] * 6, rules).update(adam, 7, torch.Generator())
    opacities = adam["logits"].detach().sigmoid()
    assert float(opacities.max()) == pytest.approx(RESET_OPACITY)
    assert not adam.state_dict()["logits.first"].any()
    assert adam.state_dict()["means.first"].any()
