"""Device choice, and Warp launches spread over CPU cores.

Warp runs a CPU launch serially on the calling thread but releases the GIL while it does, so several
launches over disjoint index ranges, one per thread, use several cores. Kernels launched through
`launch_chunked` take `start: int` as their first argument and work on index `start + wp.tid()`; each index
must write memory no other index writes (plain Warp atomics are not atomic on the CPU).
"""

from __future__ import annotations

import contextlib
import itertools
import os
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import warp as wp

from gdpro_sim.crew import Command, Crew, Packed, Plan, signature_of
from gdpro_sim.errors import DeviceError

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
_crew: Crew | None = None


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
    global _threads, _crew
    if count < 1:
        raise DeviceError(f"thread count must be >= 1, got {count}")
    _threads = count
    if _crew is not None and _crew.threads != count:
        _crew.close()
        _crew = None


PIECES = 4
"""Ranges for each thread, so that one that is held up leaves work to the others."""


def _crew_of() -> Crew:
    global _crew
    if _crew is None:
        _crew = Crew(thread_count())
    return _crew


def split(count: int, minimum: int = 1) -> list[int]:
    """Bounds of contiguous ranges that cover `range(count)`, a few for each CPU thread.

    `minimum` is the fewest indices worth a range of their own.
    """
    pieces = 1 if thread_count() == 1 else min(PIECES * thread_count(), max(1, count // max(1, minimum)))
    return [count * i // pieces for i in range(pieces + 1)]


def _forget_crew() -> None:
    """A forked child has none of its parent's threads: start anew there."""
    global _crew
    _crew = None


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_crew)


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
    launch_ranges(kernel, split(count, minimum), [*inputs, *outputs])


def launch_ranges(
    kernel: wp.Kernel,
    bounds: Sequence[int],
    arguments: Sequence[Any],
    varying: Mapping[str, Sequence[int]] | None = None,
) -> None:
    """Launch `kernel(start, *arguments)` on the CPU over the ranges between `bounds`, side by side.

    varying: arguments by name that differ from range to range, a value for each; as `arguments` have them
             they do not count
    """
    begin, count = bounds[0], bounds[-1] - bounds[0]
    if count == 0:
        return
    inputs = [begin, *arguments]
    whole = len(bounds) == 2 and not varying
    if all(isinstance(value, _PLAIN) for value in inputs):
        packed = Packed(signature_of(kernel, inputs), inputs)
        if whole:
            packed.launch(count)
        else:
            _crew_of().run(Plan(packed, list(itertools.pairwise(bounds)), varying))
    elif whole:
        wp.launch(kernel, dim=count, inputs=inputs, device="cpu")
    else:
        recorded = wp.launch(kernel, dim=count, inputs=inputs, device="cpu", record_cmd=True)
        _crew_of().run(Plan(Command(recorded, []), list(itertools.pairwise(bounds)), varying))


_PLAIN = int, float, type(wp.zeros(1, dtype=int, device="cpu").__ctype__())
"""Arguments of a kernel that need no packing: numbers, and descriptors of arrays."""


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
        self._commands: dict[tuple[int, int], Command] = {}
        self._plans: dict[tuple[int, int], tuple[Command, Plan]] = {}

    def launch(self, begin: int, end: int, numbers: list[Any]) -> None:
        """`numbers` are the arguments that are no arrays or structs, in order."""
        command = self._commands.get((begin, end))
        if command is None:
            command = self._commands[begin, end] = self._record(begin, end, numbers)
        else:
            self._renew(command, numbers)
        command.launch()

    def spread(self, count: int, pieces: int, numbers: list[Any]) -> None:
        """Launch over `count` indices in `pieces` ranges, which threads of the CPU take as they come free."""
        found = self._plans.get((count, pieces))
        if found is None:
            bounds = [count * i // pieces for i in range(pieces + 1)]
            command = self._record(0, count, numbers)
            plan = Plan(command, list(itertools.pairwise(bounds)))
            self._plans[count, pieces] = command, plan
        else:
            command, plan = found
            if self._renew(command, numbers):
                plan.refresh()
        _crew_of().run(plan)

    def _record(self, begin: int, end: int, numbers: list[Any]) -> Command:
        arguments = list(self._arguments)
        for place, number in zip(self._places, numbers, strict=True):
            arguments[place] = number
        inputs = [begin, *arguments]
        recorded = wp.launch(
            self._kernel, dim=end - begin, inputs=inputs, device=self._device, record_cmd=True
        )
        return Command(recorded, list(numbers))

    def _renew(self, command: Command, numbers: list[Any]) -> bool:
        """Put numbers into a command; whether any was new."""
        known, changed = command.numbers, False
        for k, number in enumerate(numbers):
            if known[k] is not number and known[k] != number:
                command.put(self._places[k] + 1, number)
                known[k] = number
                changed = True
        return changed


__all__ = [
    "PIECES",
    "Launches",
    "beside_torch",
    "device_name",
    "launch_chunked",
    "launch_ranges",
    "resolve_device",
    "serial_torch",
    "set_thread_count",
    "split",
    "thread_count",
]
