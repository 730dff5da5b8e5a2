"""CPU threads that share the pieces of a launch, and launches recorded for them.

Waking a thread that sleeps takes as long as a small kernel runs. So a thread that has run out of pieces waits
a little, spinning, before it sleeps: launches that follow each other closely find it awake.
"""

from __future__ import annotations

import ctypes
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from gdpro_sim.kernels import threads as kernels

PATIENCE = 1.5e-4
"""Seconds that a thread without work spins before it sleeps."""

NAP = 2.0e-5
"""Seconds between looks at pieces that other threads hold for longer than that."""


class Command:
    """A recorded launch. On a CPU its arguments lie side by side in memory, as the kernel takes them.

    `wp.Launch.launch` puts them there anew at every launch, which takes longer than a small kernel runs.
    numbers:   what the owner last put into it
    names:     of the kernel's arguments
    arguments: on a CPU, the structure that the kernel takes
    """

    def __init__(self, command: wp.Launch, numbers: list[Any]) -> None:
        self._command, self.numbers = command, numbers
        self._direct = command.device.is_cpu and command.block_dim <= 1
        if not self._direct:
            return
        bounds, *params = command.params
        self.names, kind = _layout(command.kernel, params)
        self.arguments = kind()
        for name, param in zip(self.names, params, strict=True):
            setattr(self.arguments, name, param)
        self._call = command.hooks.forward
        self._where = ctypes.byref(bounds), ctypes.byref(self.arguments)

    def put(self, index: int, value: Any) -> None:
        """Give argument number `index` another value."""
        self._command.set_param_at_index(index, value)
        if self._direct:
            setattr(self.arguments, self.names[index], self._command.params[index + 1])

    def function(self) -> int:
        """Address of the compiled kernel, on a CPU."""
        return ctypes.cast(self._call, ctypes.c_void_p).value or 0

    def bounds(self, counts: Sequence[int]) -> Any:
        """Launch bounds over each of these numbers of indices, on a CPU."""
        before = self._command.params[0].size
        found = (type(self._command.params[0]) * len(counts))()
        for i, count in enumerate(counts):
            self._command.set_dim(count)
            found[i] = self._command.params[0]
        self._command.set_dim(before)
        return found

    def launch(self) -> None:
        if self._direct:
            self._call(*self._where)
        else:
            self._command.launch()


_layouts: dict[wp.Kernel, tuple[list[str], type[ctypes.Structure]]] = {}


def _layout(kernel: wp.Kernel, params: Sequence[Any]) -> tuple[list[str], type[ctypes.Structure]]:
    """Names of a kernel's arguments, and the structure in which it takes them."""
    known = _layouts.get(kernel)
    if known is None:
        names = [argument.label for argument in kernel.adj.args]
        fields = [(name, type(param)) for name, param in zip(names, params, strict=True)]
        known = _layouts[kernel] = names, type("Arguments", (ctypes.Structure,), {"_fields_": fields})
    return known


class Plan:
    """A recorded launch of `kernel(start, ...)` on a CPU, cut into ranges of indices to run side by side.

    varying: arguments by name that differ from range to range, a value for each
    """

    def __init__(
        self,
        command: Command,
        ranges: Sequence[tuple[int, int]],
        varying: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.command = command
        self.count = len(ranges)
        self._arguments = (type(command.arguments) * self.count)()
        self._varying = dict(varying or {})
        self._varying[command.names[0]] = [begin for begin, _ in ranges]
        bounds = command.bounds([end - begin for begin, end in ranges])
        self._held = (
            bounds,
            np.array(
                [
                    [ctypes.addressof(each[i]) for i in range(self.count)]
                    for each in (bounds, self._arguments)
                ],
                np.uint64,
            ),
        )
        self.job = command.function(), *(int(row.ctypes.data) for row in self._held[1]), self.count
        self.refresh()

    def refresh(self) -> None:
        """Take over what was put into the command."""
        size = ctypes.sizeof(self.command.arguments)
        for i, arguments in enumerate(self._arguments):
            ctypes.memmove(ctypes.byref(arguments), ctypes.byref(self.command.arguments), size)
            for name, values in self._varying.items():
                setattr(arguments, name, values[i])


class Crew:
    """`threads` threads, the one that calls among them."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._job: wp.array = wp.zeros(kernels.JOB, dtype=wp.uint64, device="cpu")
        self._view = self._job.numpy()
        self._rests = _rests(PATIENCE)
        self._calls: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._busy = threading.Lock()
        self._give = _record(kernels.give, [self._job, 0, 0, 0, 0, self._rests])
        self._wait = _record(kernels.wait, [self._job, self._rests])
        for number in range(1, threads):
            name = f"gdpro_{number}"
            threading.Thread(
                target=_serve, args=(self._calls, self._job, self._rests), name=name, daemon=True
            ).start()

    def run(self, plan: Plan) -> None:
        """Returns when all pieces have ended. Where another thread's pieces run, these run on this thread."""
        if self.threads == 1 or plan.count == 1 or not self._busy.acquire(blocking=False):
            alone = _record(kernels.run_alone, [*plan.job])
            alone.launch()
            return
        try:
            for _ in range(min(self.threads, plan.count) - 1 - int(self._view[kernels.AWAKE])):
                self._calls.put(True)
            told = self._give.arguments
            told.function, told.bounds, told.arguments, told.count = plan.job
            self._give.launch()
        finally:  # Ctrl-C may come before this line: the pieces are at work all the same
            self._finish()
            self._busy.release()

    def _finish(self) -> None:
        interrupted: BaseException | None = None
        while int(self._view[kernels.DONE]) != int(self._view[kernels.COUNT]):
            try:
                time.sleep(NAP)
                self._wait.launch()
            except BaseException as error:  # they write to the caller's memory until they end
                interrupted = error
        if interrupted is not None:
            raise interrupted

    def close(self) -> None:
        """Let the threads end."""
        for _ in range(1, self.threads):
            self._calls.put(False)


def _record(kernel: wp.Kernel, inputs: list[Any]) -> Command:
    return Command(wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True), [])


def _serve(calls: queue.SimpleQueue[bool], job: wp.array, rests: int) -> None:
    command = _record(kernels.serve, [job, rests])
    while calls.get():
        command.launch()


def _rests(seconds: float) -> int:
    """How many pauses of the processor take about `seconds`."""
    job: wp.array = wp.zeros(kernels.JOB, dtype=wp.uint64, device="cpu")
    count = 1000
    command = _record(kernels.serve, [job, count])
    command.launch()
    begin = time.perf_counter()
    command.launch()
    return max(1, round(seconds * count / max(time.perf_counter() - begin, 1e-7)))


__all__ = ["Command", "Crew", "Plan"]
