"""Work spread over threads."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest
import warp as wp

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


@pytest.mark.parametrize("threads", [1, 3])
def test_recorded_launches_see_new_numbers_and_other_arrays(threads: int) -> None:
    from gdpro_sim.kernels import fem

    device.set_thread_count(threads)
    launches = device.Launches("cpu")
    a, b, out, other = (wp.zeros(100, dtype=wp.vec3d, device="cpu") for _ in range(4))
    a.fill_(wp.vec3d(1.0, 2.0, 3.0))
    b.fill_(wp.vec3d(10.0, 0.0, 0.0))
    nothing, shift = wp.vec3d(), wp.vec3d(0.0, 0.0, 0.5)
    for weight, constant, target in (
        (2.0, nothing, out),
        (3.0, nothing, out),
        (3.0, shift, out),
        (3.0, shift, other),
        (2, nothing, out),
    ):
        launches(fem.combine, 100, [a, weight, b, 1.0, constant], [target], minimum=10)
        expected = weight * np.array([1.0, 2.0, 3.0]) + np.array([10.0, 0.0, 0.0]) + np.array(constant)
        assert np.array_equal(target.numpy(), np.tile(expected, (100, 1)))
    launches(fem.combine, 0, [a, 1.0, b, 1.0, nothing], [out])
    launches(fem.combine, 60, [a, 0.0, b, 0.0, nothing], [out], minimum=10)
    assert not out.numpy()[:60].any() and out.numpy()[60:].all(axis=1).any()


def test_recorded_launches_forget_arrays_that_come_and_go() -> None:
    from gdpro_sim.kernels import fem

    launches = device.Launches("cpu")
    a = wp.zeros(4, dtype=wp.vec3d, device="cpu")
    for _ in range(device.MAX_RECORDED + 5):
        passing = wp.zeros(4, dtype=wp.vec3d, device="cpu")
        launches(fem.combine, 4, [a, 1.0, a, 1.0, wp.vec3d()], [passing])
    assert 0 < len(launches._recorded) <= device.MAX_RECORDED
