"""Memory that is used again, never while a tensor still lies on it."""

from __future__ import annotations

import gc
import threading

import pytest
import torch

from gdpro_sim.splatting import buffers, rasterization
from tests.splatting.scenes import cameras, cloud, features

CPU = torch.device("cpu")
LARGE = (1000, 1000)


@pytest.fixture(autouse=True)
def nothing_kept():
    gc.collect()
    buffers.clear()
    yield
    buffers.clear()


def test_memory_is_used_again_once_every_view_is_gone() -> None:
    tensor = buffers.empty(LARGE, torch.float32, CPU)
    place, view = tensor.data_ptr(), tensor[10:]
    assert place % 64 == 0
    del tensor
    assert buffers.free_bytes() == 0
    other = buffers.empty(LARGE, torch.float32, CPU)
    assert other.data_ptr() != place
    del view
    assert buffers.free_bytes() >= 4_000_000
    again = buffers.empty((999, 1000), torch.float32, CPU)
    assert again.data_ptr() == place
    assert buffers.free_bytes() == 0


def test_types_and_shapes() -> None:
    for dtype in (torch.float32, torch.int32, torch.int16):
        tensor = buffers.empty((600, 700, 2), dtype, CPU)
        assert tensor.shape == (600, 700, 2)
        assert tensor.dtype == dtype
        assert tensor.is_contiguous()
    assert buffers.empty((0, 3), torch.float32, CPU).shape == (0, 3)
    strided = torch.zeros(700, 600).T
    assert buffers.empty_like(strided).is_contiguous()


def test_small_tensors_and_hoards_are_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    del_me = buffers.empty((10, 10), torch.float32, CPU)
    del del_me
    assert buffers.free_bytes() == 0
    monkeypatch.setattr(buffers, "LARGEST_SUM", 10_000_000)
    tensors = [buffers.empty(LARGE, torch.float32, CPU) for _ in range(4)]
    del tensors
    assert 0 < buffers.free_bytes() <= 10_000_000


def test_images_of_earlier_calls_keep_their_values() -> None:
    scene, views = cloud(2000, 0), cameras(1, 300, 300)
    images = [rasterization(**scene, colors=features(2000, 3, i), **views)[0] for i in range(3)]
    again = [rasterization(**scene, colors=features(2000, 3, i), **views)[0] for i in range(3)]
    for first, second in zip(images, again, strict=True):
        assert torch.equal(first, second)
    assert not torch.equal(images[0], images[1])


def test_from_several_threads() -> None:
    failures = []

    def work(number: int) -> None:
        for _ in range(50):
            tensor = buffers.empty((300, 300), torch.int32, CPU).fill_(number)
            if not bool((tensor == number).all()):
                failures.append(number)

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert not failures
