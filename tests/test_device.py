"""Work spread over threads."""

from __future__ import annotations

import threading
import time

import pytest

from gdpro_sim import device


@pytest.fixture(autouse=True)
def threads_as_before():
    before = device.thread_count()
    yield
    device.set_thread_count(before)


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize(("count", "minimum"), [(0, 1), (1, 1), (7, 1), (1000, 1), (1000, 300), (10, 100)])
def test_ranges_cover_everything_once(threads: int, count: int, minimum: int) -> None:
    device.set_thread_count(threads)
    seen = [0] * count

    def work(begin: int, end: int) -> None:
        assert begin < end
        for i in range(begin, end):
            seen[i] += 1

    device.run_chunks(work, count, minimum)
    assert seen == [1] * count


def test_a_thread_that_is_held_up_leaves_work_to_the_others() -> None:
    device.set_thread_count(2)
    done: dict[int, int] = {}
    held = threading.get_ident()

    def work(begin: int, end: int) -> None:
        if threading.get_ident() == held:
            time.sleep(0.2)
        done[threading.get_ident()] = done.get(threading.get_ident(), 0) + 1

    device.run_chunks(work, 8)
    assert sum(done.values()) == 8
    assert done.get(held, 0) <= 2


def test_an_exception_ends_the_rest_and_is_raised() -> None:
    device.set_thread_count(2)
    begun = []

    def work(begin: int, end: int) -> None:
        begun.append(begin)
        time.sleep(0.05)
        if begin == 0:
            raise RuntimeError("no")

    with pytest.raises(RuntimeError, match="no"):
        device.run_chunks(work, 8)
    count = len(begun)
    assert count <= 8
    time.sleep(0.2)
    assert len(begun) == count
