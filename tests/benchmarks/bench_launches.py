"""What it costs to share a small launch among CPU threads: microseconds of a vector sum, by threads.

    python -m tests.benchmarks.bench_launches [--threads 1 2 3]

Prints a Markdown table and the machine it was made on: the median and the least of 400 recorded launches one
after the other, and what a launch costs after a millisecond in which the threads have fallen asleep.
"""

from __future__ import annotations

import argparse
import time

import numpy as np
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.kernels import fem
from tests.benchmarks.machine import machine

REPEATS = 400


def measure(count: int, threads: int, pause: float, repeats: int) -> np.ndarray:
    """Microseconds of each launch over `count` vectors, `pause` s apart."""
    devices.set_thread_count(threads)
    launches = devices.Launches("cpu")
    a, out = (wp.zeros(count, dtype=wp.vec3d, device="cpu") for _ in range(2))
    times = []
    for _ in range(repeats):
        time.sleep(pause)
        begin = time.perf_counter()
        launches(fem.combine, count, [a, 2.0, a, 1.0, wp.vec3d()], [out], minimum=64)
        times.append(1e6 * (time.perf_counter() - begin))
    return np.array(times[5:])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    options = parser.parse_args()
    print(f"{machine()}\n")
    print("| vectors | threads | median | least | after a pause |\n|---|---|---|---|---|")
    for count in (1000, 20_000, 200_000):
        for threads in options.threads:
            close = measure(count, threads, 0.0, REPEATS)
            apart = measure(count, threads, 1e-3, REPEATS // 4)
            print(
                f"| {count:,} | {threads} | {np.median(close):.0f} | {close.min():.0f} "
                f"| {np.median(apart):.0f} |"
            )


if __name__ == "__main__":
    main()
