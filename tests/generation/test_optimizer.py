"""Adam over named rows: torch's numbers, rows that come and go, state to the bit."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.generation.optimizer import Adam


def gradients(count: int, seed: int) -> list[torch.Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [
        torch.randn(count, 3, generator=g) * 10.0 ** float(torch.randn((), generator=g)) for _ in range(6)
    ]


def test_steps_are_torchs_with_a_rate_that_falls_geometrically() -> None:
    start = torch.randn(5, 3, generator=torch.Generator().manual_seed(0))
    own = Adam({"a": start}, {"a": (0.1, 0.001)})
    theirs = start.clone().requires_grad_()
    reference = torch.optim.Adam([theirs], eps=1e-15)
    for i, gradient in enumerate(gradients(5, 1)):
        share = i / 5
        reference.param_groups[0]["lr"] = 0.1 * 0.01**share
        own["a"].grad, theirs.grad = gradient.clone(), gradient.clone()
        own.step(share)
        reference.step()
    torch.testing.assert_close(own["a"], theirs)
    assert own["a"].grad is None


def test_a_leaf_without_gradient_stays() -> None:
    adam = Adam({"a": torch.ones(2, 1), "b": torch.ones(2, 1)}, {"a": (0.1, 0.1), "b": (0.1, 0.1)})
    for _ in range(2):
        adam["a"].grad = torch.ones(2, 1)
        adam.step(0.0)
    assert torch.equal(adam["b"], torch.ones(2, 1))
    torch.testing.assert_close(adam["a"], torch.full((2, 1), 0.8))


def test_rows_keep_their_moments_when_gathered_and_new_ones_start_afresh() -> None:
    first, second = gradients(4, 2)[:2]
    rows, fresh = torch.tensor([3, 1, 1]), torch.tensor([False, False, True])
    adam = Adam({"a": torch.zeros(4, 3)}, {"a": (0.1, 0.1)})
    adam["a"].grad = first.clone()
    adam.step(0.0)
    kept = adam.state_dict()
    adam.regather(rows, fresh)
    after = adam.state_dict()
    assert torch.equal(after["a"], kept["a"][rows])
    for moment in ("a.first", "a.second"):
        assert torch.equal(after[moment][:2], kept[moment][rows[:2]])
        assert not after[moment][2].any()
    adam["a"].grad = second[:3].clone()
    adam.step(0.0)
    assert len(adam["a"]) == 3


def test_state_goes_on_to_the_same_bits() -> None:
    whole, saved = (Adam({"a": torch.ones(4, 3)}, {"a": (0.1, 0.01)}) for _ in range(2))
    for i, gradient in enumerate(gradients(4, 3)):
        if i == 3:
            saved = Adam({"a": torch.zeros(7, 3)}, {"a": (0.1, 0.01)})
            saved.load_state_dict(whole.state_dict())
        for adam in (whole, saved):
            adam["a"].grad = gradient.clone()
            adam.step(i / 5)
    assert all(torch.equal(saved.state_dict()[k], v) for k, v in whole.state_dict().items())


def test_what_does_not_fit_is_refused() -> None:
    with pytest.raises(ValueError, match="must name the parameters"):
        Adam({"a": torch.ones(1)}, {"b": (1.0, 1.0)})
    adam = Adam({"a": torch.ones(4, 3)}, {"a": (0.1, 0.1)})
    other = Adam({"a": torch.ones(4, 2)}, {"a": (0.1, 0.1)}).state_dict()
    with pytest.raises(ValueError, match=r"a must be \[rows"):
        adam.load_state_dict(other)
    with pytest.raises(KeyError):
        adam.load_state_dict({"steps": torch.tensor(1)})
