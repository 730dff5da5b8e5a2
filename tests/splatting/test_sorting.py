"""Orders by depth."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim import device
from gdpro_sim.splatting import sorting


@pytest.fixture(autouse=True)
def threads_as_before():
    before = device.thread_count()
    yield
    device.set_thread_count(before)


@pytest.mark.parametrize("threads", [1, 2, 3])
@pytest.mark.parametrize(("cameras", "count"), [(1, 0), (0, 3), (1, 1), (3, 700), (2, 3 * sorting.PART + 5)])
def test_orders_are_those_of_a_stable_sort(cameras: int, count: int, threads: int) -> None:
    device.set_thread_count(threads)
    g = torch.Generator().manual_seed(count)
    depths = 10.0 ** (60.0 * torch.rand(cameras, count, generator=g) - 30.0)
    depths[:, ::3] = 2.5  # equal ones
    depths[:, 1::7] = torch.inf
    depths[:, 2::11] = 0.0
    keys, order = sorting.keys_and_order(cameras, count, depths.device)
    keys[:, :count] = depths
    order[:, :count] = torch.arange(cameras * count).view(cameras, count)
    sorting.sort_by_depth(keys, order, count)
    expected = torch.argsort(depths, dim=1, stable=True) + count * torch.arange(cameras)[:, None]
    assert torch.equal(order[:, :count].long(), expected)
