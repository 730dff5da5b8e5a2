"""Work spread over threads."""

from __future__ import annotations

import os
import signal
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


@wp.kernel
def visit(start: int, seen: wp.array[int], value: int):
    i = start + wp.tid()
    seen[i] = seen[i] + value


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize(("count", "minimum"), [(0, 1), (1, 1), (7, 1), (1000, 1), (1000, 300), (10, 100)])
def test_ranges_cover_everything_once(threads: int, count: int, minimum: int) -> None:
    device.set_thread_count(threads)
    bounds = device.split(count, minimum)
    assert bounds[0] == 0 and bounds[-1] == count
    assert len(bounds) == 2 or min(np.diff(bounds)) >= minimum
    seen = wp.zeros(count, dtype=int, device="cpu")
    for _ in range(20):
        device.launch_chunked(visit, count, [seen, 3], device="cpu", minimum=minimum)
    assert (seen.numpy() == 60).all()


def test_arguments_that_differ_from_range_to_range() -> None:
    device.set_thread_count(2)
    seen = wp.zeros(10, dtype=int, device="cpu")
    device.launch_ranges(visit, [2, 4, 4, 9], [seen, 0], {"value": [5, 6, 7]})
    assert seen.numpy().tolist() == [0, 0, 5, 5, 7, 7, 7, 7, 7, 0]


def test_threads_sleep_without_work_and_wake_again() -> None:
    device.set_thread_count(3)
    seen = wp.zeros(100, dtype=int, device="cpu")
    for pause in (0.0, 0.01, 0.0):
        time.sleep(pause)
        device.launch_chunked(visit, 100, [seen, 1], device="cpu", minimum=1)
    assert (seen.numpy() == 3).all()
    time.sleep(0.05)
    idle = time.process_time()
    time.sleep(0.2)
    assert time.process_time() - idle < 0.1


def test_launches_of_several_threads_do_not_mix() -> None:
    device.set_thread_count(2)
    all_seen = [wp.zeros(500, dtype=int, device="cpu") for _ in range(3)]

    def launch(seen: wp.array) -> None:
        for _ in range(200):
            device.launch_chunked(visit, 500, [seen, 1], device="cpu", minimum=1)

    threads = [threading.Thread(target=launch, args=(seen,)) for seen in all_seen]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all((seen.numpy() == 200).all() for seen in all_seen)


@pytest.mark.skipif(not hasattr(signal, "setitimer"), reason="no timers here")
def test_an_interrupted_launch_is_whole_or_not_at_all() -> None:
    device.set_thread_count(2)
    seen = wp.zeros(5000, dtype=int, device="cpu")

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGALRM, interrupt)
    try:
        for k in range(60):
            with pytest.raises(KeyboardInterrupt):
                # Again after a while: an interrupt inside some object's finalizer is lost.
                signal.setitimer(signal.ITIMER_REAL, 0.002 + 1e-5 * k, 0.5)
                while True:
                    device.launch_chunked(visit, 5000, [seen, 1], device="cpu", minimum=1)
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            time.sleep(1e-3)
            assert np.ptp(seen.numpy()) == 0
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
    assert seen.numpy()[0] > 0


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_child_has_threads_of_its_own() -> None:
    device.set_thread_count(2)
    seen = wp.zeros(100, dtype=int, device="cpu")
    device.launch_chunked(visit, 100, [seen, 1], device="cpu", minimum=1)
    child = os.fork()
    if child == 0:
        device.launch_chunked(visit, 100, [seen, 1], device="cpu", minimum=1)
        os._exit(0 if (seen.numpy() == 2).all() else 1)
    assert os.waitpid(child, 0)[1] == 0
    assert (seen.numpy() == 1).all()


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
