"""CPU threads that share the pieces of a launch, and launches recorded for them.

Waking a thread that sleeps takes as long as a small kernel runs. So a thread that has run out of pieces waits
a little, spinning, before it sleeps: launches that follow each other closely find it awake.
"""

from __future__ import annotations

import copy
import ctypes
import queue
import threading
import time
from collections.abc import Mapping, Sequence
from typing import Any

import warp as wp

from gdpro_sim.kernels import threads as kernels

PATIENCE = 1.5e-4
"""Seconds that a thread without work spins before it sleeps."""

NAP = 2.0e-5
"""Seconds between looks at pieces that other threads hold for longer than that."""


class Signature:
    """How a compiled kernel is called on a CPU: with launch bounds and a structure of its arguments.

    names: of the arguments, the first of which is `start`
    kind:  the structure
    """

    def __init__(self, recorded: wp.Launch) -> None:
        _, *params = recorded.params
        self.names = [argument.label for argument in recorded.kernel.adj.args]
        fields = [(name, type(param)) for name, param in zip(self.names, params, strict=True)]
        self.kind: Any = type("Arguments", (ctypes.Structure,), {"_fields_": fields})
        self.call = recorded.hooks.forward
        self.address = ctypes.cast(self.call, ctypes.c_void_p).value or 0
        # Without the arguments, whose memory would be kept.
        self._recorded = copy.copy(recorded)
        self._recorded.params, self._recorded.fwd_args = recorded.params[:1], None
        self._bounds: dict[tuple[int, ...], Any] = {}

    def bounds(self, counts: tuple[int, ...]) -> Any:
        """Launch bounds over each of these numbers of indices, side by side in memory."""
        found = self._bounds.get(counts)
        if found is None:
            if len(self._bounds) >= MAX_BOUNDS:
                self._bounds.clear()
            found = (type(self._recorded.params[0]) * len(counts))()
            for i, count in enumerate(counts):
                self._recorded.set_dim(count)
                found[i] = self._recorded.params[0]
            self._bounds[counts] = found
        return found


MAX_BOUNDS = 256
"""Divisions into ranges that a signature remembers before it forgets them all."""

_signatures: dict[wp.Kernel, Signature] = {}


def signature_of(kernel: wp.Kernel, inputs: list[Any]) -> Signature:
    """The signature of a kernel for a CPU. `inputs` are arguments of the right kinds."""
    known = _signatures.get(kernel)
    if known is None:
        recorded = wp.launch(kernel, dim=1, inputs=inputs, device="cpu", record_cmd=True)
        known = _signatures[kernel] = Signature(recorded)
    return known


class Packed:
    """Arguments of one launch on a CPU, all of them numbers or arrays' descriptors, without Warp's checks."""

    def __init__(self, signature: Signature, values: Sequence[Any]) -> None:
        self.signature = signature
        self.arguments = signature.kind(*values)

    def launch(self, count: int) -> None:
        """Run over `count` indices on this thread."""
        bounds = self.signature.bounds((count,))
        self.signature.call(ctypes.byref(bounds), ctypes.byref(self.arguments))


class Command:
    """A recorded launch. On a CPU its arguments lie side by side in memory, as the kernel takes them.

    `wp.Launch.launch` puts them there anew at every launch, which takes longer than a small kernel runs.
    numbers:   what the owner last put into it
    arguments: on a CPU, the structure that the kernel takes
    """

    def __init__(self, command: wp.Launch, numbers: list[Any]) -> None:
        self._command, self.numbers = command, numbers
        self._direct = command.device.is_cpu and command.block_dim <= 1
        if not self._direct:
            return
        bounds, *params = command.params
        known = _signatures.get(command.kernel)
        if known is None:
            known = _signatures[command.kernel] = Signature(command)
        self.signature = known
        self.arguments = known.kind(*params)
        self._where = ctypes.byref(bounds), ctypes.byref(self.arguments)

    def put(self, index: int, value: Any) -> None:
        """Give argument number `index` another value."""
        self._command.set_param_at_index(index, value)
        if self._direct:
            setattr(self.arguments, self.signature.names[index], self._command.params[index + 1])

    def launch(self) -> None:
        if self._direct:
            self.signature.call(*self._where)
        else:
            self._command.launch()


class Plan:
    """A recorded launch of `kernel(start, ...)` on a CPU, cut into ranges of indices to run side by side.

    varying: arguments by name that differ from range to range, a value for each
    """

    def __init__(
        self,
        command: Command | Packed,
        ranges: Sequence[tuple[int, int]],
        varying: Mapping[str, Sequence[int]] | None = None,
    ) -> None:
        self.command = command
        self.count = len(ranges)
        signature = command.signature
        self._arguments = (signature.kind * self.count)()
        self._varying = dict(varying or {})
        self._varying[signature.names[0]] = [begin for begin, _ in ranges]
        bounds = signature.bounds(tuple(end - begin for begin, end in ranges))
        self._held = bounds, _addresses(bounds), _addresses(self._arguments)
        where = (ctypes.addressof(addresses) for addresses in self._held[1:])
        self.job = signature.address, *where, self.count
        self.refresh()

    def refresh(self) -> None:
        """Take over what was put into the command."""
        size = ctypes.sizeof(self.command.arguments)
        for i, arguments in enumerate(self._arguments):
            ctypes.memmove(ctypes.byref(arguments), ctypes.byref(self.command.arguments), size)
            for name, values in self._varying.items():
                setattr(arguments, name, values[i])


def _addresses(items: Any) -> Any:
    """Where the items of a ctypes array lie."""
    size, first = ctypes.sizeof(items._type_), ctypes.addressof(items)
    return (ctypes.c_uint64 * len(items))(*range(first, first + size * len(items), size))


class Crew:
    """`threads` threads, the one that calls among them."""

    def __init__(self, threads: int) -> None:
        self.threads = threads
        self._job: wp.array = wp.zeros(kernels.JOB, dtype=wp.uint64, device="cpu")
        self._view = self._job.numpy()
        self._rests = _rests(PATIENCE)
        self._calls: queue.SimpleQueue[bool] = queue.SimpleQueue()
        self._busy = threading.Lock()
        self._give = _record(kernels.give, [self._job, 0, 0, 0, 0])
        self._join = _record(kernels.join, [self._job, self._rests])
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
            told = self._give.arguments
            told.function, told.bounds, told.arguments, told.count = plan.job
            self._give.launch()
            # Whoever falls asleep after this look has seen the job first.
            for _ in range(min(self.threads, plan.count) - 1 - int(self._view[kernels.AWAKE])):
                self._calls.put(True)
        finally:  # Ctrl-C may come before this line: the pieces are at work all the same
            self._finish()
            self._busy.release()

    def _finish(self) -> None:
        """Take part, until all pieces given out are done."""
        interrupted: BaseException | None = None
        while True:
            try:
                self._join.launch()
                if int(self._view[kernels.DONE]) == int(self._view[kernels.COUNT]):
                    break
                time.sleep(NAP)
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


__all__ = ["Command", "Crew", "Packed", "Plan", "signature_of"]
