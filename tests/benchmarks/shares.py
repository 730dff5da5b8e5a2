"""Where the wall time of a step goes."""

from __future__ import annotations

import time
from collections import defaultdict
from typing import Any

import warp as wp


class Shares:
    """Wall time by part; what a part calls of another counts there alone.

    parts:   those of a step, in the order of the table; the last one is what no other claims
    seconds: of each, as long as they are counted for
    """

    def __init__(self, parts: tuple[str, ...], device: str) -> None:
        self.parts, self.seconds = parts, defaultdict[str, float](float)
        self._part, self._since, self._device = "", time.perf_counter(), device

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Count calls of a method for `part` from now on."""
        original = getattr(owner, name)

        def timed(*inputs: Any, **options: Any) -> Any:
            before = self.switch(part)
            try:
                return original(*inputs, **options)
            finally:
                self.switch(before)

        setattr(owner, name, timed)

    def switch(self, part: str) -> str:
        """Count on for `part`, which need not be one of `parts`; the part counted for until now."""
        wp.synchronize_device(self._device)
        now, before = time.perf_counter(), self._part
        self.seconds[before] += now - self._since
        self._part, self._since = part, now
        return before

    def begin(self) -> None:
        """A step begins."""
        self.switch(self.parts[-1])

    def end(self) -> None:
        """It has ended."""
        self.switch("")

    def columns(self) -> str:
        """Per cent of the whole, as columns of a Markdown table."""
        whole = sum(self.seconds[part] for part in self.parts)
        return "".join(f" {100 * self.seconds[part] / whole:.0f} % |" for part in self.parts)


__all__ = ["Shares"]
