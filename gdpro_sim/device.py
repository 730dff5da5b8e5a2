"""Device choice, and Warp launches spread over CPU cores.

Warp runs a CPU launch serially on the calling thread but releases the GIL while it does, so several
launches over disjoint index ranges, one per thread, use several cores. Kernels launched through
`launch_chunked` take `start: int` as their first argument and work on index `start + wp.tid()`; each index
must write memory no other index writes (plain Warp atomics are not atomic on the CPU).
"""

from __future__ import annotations

import contextlib
import ctypes
import itertools
import os
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from gdpro_sim.errors import DeviceError
from gdpro_sim.kernels.threads import run_pieces

if TYPE_CHECKING:
    import torch

wp.config.log_level = wp.LOG_WARNING


def _start_warp() -> None:
    """Initialise Warp without its native notice that a machine has no CUDA driver ."""
    try:
        saved = os.dup(2)
    except OSError:  # no standard error to keep clean
        wp.init()
        return
    with tempfile.TemporaryFile() as caught:
        sys.stderr.flush()
        os.dup2(caught.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(saved, 2)
            os.close(saved)
            caught.seek(0)
            for line in caught.read().decode(errors="replace").splitlines():
                if "Could not find or load the NVIDIA CUDA driver" not in line:
                    print(line, file=sys.stderr)


_start_warp()

_threads: int | None = None
_pool: ThreadPoolExecutor | None = None


def resolve_device(device: str = "auto") -> str:
    """Return the Warp name of a device: `"cpu"` or `"cuda:N"`.

    `"auto"` is the first CUDA device where there is one, else the CPU. Raises `DeviceError` when the
    named device does not exist on this machine; never falls back to another.
    """
    cuda = [d.alias for d in wp.get_cuda_devices()]
    if device == "auto":
        return cuda[0] if cuda else "cpu"
    if device == "cpu":
        return "cpu"
    name = "cuda:0" if device == "cuda" else device
    if name in cuda:
        return name
    available = ", ".join(["cpu", *cuda])
    raise DeviceError(f"device {device!r} is not available on this machine; choose one of: auto, {available}")


def thread_count() -> int:
    """CPU threads used for one launch: `GDPRO_THREADS`, else the cores this process may use."""
    global _threads
    if _threads is None:
        text = os.environ.get("GDPRO_THREADS", "")
        if text:
            if not text.isdigit() or int(text) < 1:
                raise DeviceError(f"GDPRO_THREADS must be a whole number >= 1, got {text!r}")
            _threads = int(text)
        elif hasattr(os, "sched_getaffinity"):
            _threads = len(os.sched_getaffinity(0))
        else:
            _threads = os.cpu_count() or 1
    return _threads


def set_thread_count(count: int) -> None:
    """Set the number of CPU threads used for one launch; `count` >= 1."""
    global _threads, _pool
    if count < 1:
        raise DeviceError(f"thread count must be >= 1, got {count}")
    _threads = count
    if _pool is not None:
        _pool.shutdown()
        _pool = None


PIECES = 4
"""Ranges for each thread, so that one that is held up leaves work to the others."""


def _workers() -> ThreadPoolExecutor:
    global _pool
    if _pool is None:
        _pool = ThreadPoolExecutor(max_workers=thread_count(), thread_name_prefix="gdpro")
    return _pool


def run_chunks(function: Callable[[int, int], Any], count: int, minimum: int = 1) -> None:
    """Call `function(begin, end)` over contiguous ranges that cover `range(count)`, from several threads.

    `minimum` is the fewest indices worth a range of their own. Threads take ranges in ascending order as they
    come free. Returns, or raises one of the exceptions, when every range has ended: nothing writes to the
    caller's memory afterwards.
    """
    if count <= 0:
        return
    pieces = min(PIECES * thread_count(), max(1, count // max(1, minimum)))
    threads = min(thread_count(), pieces)
    if threads == 1:
        function(0, count)
        return
    pool = _workers()
    bounds = [count * i // pieces for i in range(pieces + 1)]
    numbers = iter(range(pieces))
    lock = threading.Lock()

    def work() -> None:
        while True:
            with lock:
                piece = next(numbers, None)
            if piece is None:
                return
            function(bounds[piece], bounds[piece + 1])

    futures = [pool.submit(work) for _ in range(1, threads)]
    try:
        work()
        wait(futures)
    except BaseException:
        with lock:
            for _ in numbers:  # leave nothing to begin
                pass
        wait(futures)  # an interrupt ends the wait above
        raise
    for future in futures:
        future.result()


def _forget_pool() -> None:
    """A forked child has none of its parent's threads: start anew there."""
    global _pool
    _pool = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)


def device_name(tensor: torch.Tensor) -> str:
    """Warp's name of the device a tensor lies on. Raises DeviceError where Warp has no such device."""
    if tensor.device.type == "cpu":
        return "cpu"
    if tensor.device.type != "cuda":
        raise DeviceError(f"tensors must lie on a CPU or a CUDA device, got {tensor.device}")
    return str(wp.device_from_torch(tensor.device))


@contextlib.contextmanager
def serial_torch() -> Iterator[None]:
    """Run torch's own CPU operators on one thread inside the block.

    Their worker threads spin while they wait and stall behind ours on a busy machine, and sums no longer
    depend on the number of cores.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def beside_torch(tensor: torch.Tensor) -> contextlib.AbstractContextManager[object]:
    """Work of Warp and torch on a tensor's device, side by side.

    On a GPU Warp works on torch's current stream, so neither has to wait for the other. On a CPU torch's
    operators keep to one thread, see `serial_torch`.
    """
    if device_name(tensor) == "cpu":
        return serial_torch()
    import torch

    return wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(tensor.device)))


def launch_chunked(
    kernel: wp.Kernel,
    count: int,
    inputs: Sequence[Any],
    outputs: Sequence[Any] = (),
    *,
    device: str,
    minimum: int = 1024,
) -> None:
    """Launch `kernel(start, *inputs, *outputs)` over `count` indices: once on CUDA, per core on the CPU."""
    if count <= 0:
        return
    if device != "cpu":
        wp.launch(kernel, dim=count, inputs=[0, *inputs], outputs=list(outputs), device=device)
        return
    if thread_count() > 1 and count >= 2 * minimum:
        wp.load_module(kernel.module, device="cpu")

    def launch(begin: int, end: int) -> None:
        wp.launch(kernel, dim=end - begin, inputs=[begin, *inputs], outputs=list(outputs), device="cpu")

    run_chunks(launch, count, minimum)


class Launches:
    """`launch_chunked` for kernels launched again and again over the same arrays: arguments are packed once.

    Packing costs more than running a small kernel. Belongs to the owner of the arrays, which it keeps alive.
    Numbers may differ from call to call. A struct is packed at its first launch: its arrays may change, but
    not be exchanged for others.
    serial: keep every launch on one thread, for problems too small to share out
    """

    def __init__(self, device: str) -> None:
        self.device = device
        self.serial = False
        self._recorded: dict[tuple[Any, ...], _Recorded] = {}

    def __call__(
        self,
        kernel: wp.Kernel,
        count: int,
        inputs: Sequence[Any],
        outputs: Sequence[Any] = (),
        *,
        minimum: int = 1024,
    ) -> None:
        """Launch `kernel(start, *inputs, *outputs)` over `count` indices, on the CPU per core."""
        if count <= 0:
            return
        arguments = [*inputs, *outputs]
        key: list[Any] = [kernel, count]
        numbers = []
        for argument in arguments:
            if _is_held(argument):
                key.append(id(argument))
            else:
                key.append(None)
                numbers.append(argument)
        recorded = self._recorded.get(tuple(key))
        if recorded is None:
            if len(self._recorded) >= MAX_RECORDED:
                self._recorded.clear()
            wp.load_module(kernel.module, device=self.device)
            recorded = self._recorded[tuple(key)] = _Recorded(kernel, arguments, self.device)
        if self.device != "cpu" or self.serial or count < 2 * minimum or thread_count() == 1:
            recorded.launch(0, count, numbers)
        else:
            recorded.spread(count, min(PIECES * thread_count(), count // minimum), numbers)


MAX_RECORDED = 512
"""Launches remembered by one `Launches` before it forgets them all: more means arrays that come and go."""


def _is_held(argument: Any) -> bool:
    """Whether it is an array or a struct."""
    kind = argument.__class__
    return kind is wp.array or (kind is not float and kind is not int and hasattr(argument, "__ctype__"))


class _Recorded:
    """One kernel over one set of arrays: a command for each range of indices seen."""

    def __init__(self, kernel: wp.Kernel, arguments: list[Any], device: str) -> None:
        self._kernel, self._arguments, self._device = kernel, arguments, device
        self._places = [k for k, argument in enumerate(arguments) if not _is_held(argument)]
        self._commands: dict[tuple[int, int], _Command] = {}
        self._plans: dict[tuple[int, int], _Plan] = {}

    def launch(self, begin: int, end: int, numbers: list[Any]) -> None:
        """`numbers` are the arguments that are no arrays or structs, in order."""
        self._command(begin, end, numbers).launch()

    def spread(self, count: int, pieces: int, numbers: list[Any]) -> None:
        """Launch over `count` indices in `pieces` ranges, which threads of the CPU take as they come free."""
        bounds = [count * i // pieces for i in range(pieces + 1)]
        commands = [self._command(a, b, numbers) for a, b in itertools.pairwise(bounds)]
        plan = self._plans.get((count, pieces))
        if plan is None:
            plan = self._plans[count, pieces] = _Plan(commands)
        plan.run()

    def _command(self, begin: int, end: int, numbers: list[Any]) -> _Command:
        """The launch over a range, with these numbers."""
        command = self._commands.get((begin, end))
        if command is None:
            arguments = list(self._arguments)
            for place, number in zip(self._places, numbers, strict=True):
                arguments[place] = number
            recorded = wp.launch(
                self._kernel,
                dim=end - begin,
                inputs=[begin, *arguments],
                device=self._device,
                record_cmd=True,
            )
            command = self._commands[begin, end] = _Command(recorded, list(numbers))
        else:
            known = command.numbers
            for k, number in enumerate(numbers):
                if known[k] is not number and known[k] != number:
                    command.put(self._places[k] + 1, number)
                    known[k] = number
        return command


class _Plan:
    """Recorded launches of one kernel on the CPU, run side by side by several threads."""

    def __init__(self, commands: list[_Command]) -> None:
        addresses = np.array([command.addresses() for command in commands], np.uint64)
        self._counter: wp.array = wp.zeros(1, dtype=int, device="cpu")
        self._next = self._counter.numpy()
        self._pieces = len(commands)
        arrays: list[wp.array] = [wp.array(a, dtype=wp.uint64, device="cpu") for a in addresses.T.copy()]
        inputs = [len(commands), commands[0].function(), *arrays, self._counter]
        self._held = (commands, arrays)
        self._runner = _Command(
            wp.launch(run_pieces, dim=1, inputs=inputs, device="cpu", record_cmd=True), []
        )

    def run(self) -> None:
        """Returns when all pieces have ended."""
        self._next[0] = 0
        threads = min(thread_count(), self._pieces)
        futures = [_workers().submit(self._runner.launch) for _ in range(1, threads)]
        try:
            self._runner.launch()
            wait(futures)
        except BaseException:
            self._next[0] = self._pieces  # leave nothing to begin
            wait(futures)  # an interrupt ends the wait above
            raise
        for future in futures:
            future.result()


class _Command:
    """A recorded launch. On a CPU its arguments lie side by side in memory, as the kernel takes them.

    `wp.Launch.launch` puts them there anew at every launch, which takes longer than a small kernel runs.
    """

    def __init__(self, command: wp.Launch, numbers: list[Any]) -> None:
        self._command, self.numbers = command, numbers
        self._direct = command.device.is_cpu and command.block_dim <= 1
        if not self._direct:
            return
        arguments = command.kernel.adj.args
        bounds, *params = command.params
        self._names = [argument.label for argument in arguments]
        fields = [(name, type(param)) for name, param in zip(self._names, params, strict=True)]
        self._arguments = type("Arguments", (ctypes.Structure,), {"_fields_": fields})()
        for name, param in zip(self._names, params, strict=True):
            setattr(self._arguments, name, param)
        self._call = command.hooks.forward
        self._where = ctypes.byref(bounds), ctypes.byref(self._arguments)

    def put(self, index: int, value: Any) -> None:
        """Give argument number `index` another value."""
        self._command.set_param_at_index(index, value)
        if self._direct:
            setattr(self._arguments, self._names[index], self._command.params[index + 1])

    def function(self) -> int:
        """Address of the compiled kernel, on a CPU."""
        return ctypes.cast(self._call, ctypes.c_void_p).value or 0

    def addresses(self) -> tuple[int, int]:
        """Those of its bounds and arguments, on a CPU."""
        return ctypes.addressof(self._command.params[0]), ctypes.addressof(self._arguments)

    def launch(self) -> None:
        if self._direct:
            self._call(*self._where)
        else:
            self._command.launch()


__all__ = [
    "PIECES",
    "Launches",
    "beside_torch",
    "device_name",
    "launch_chunked",
    "resolve_device",
    "run_chunks",
    "serial_torch",
    "set_thread_count",
    "thread_count",
]
