"""What the figures were measured on."""

from __future__ import annotations

import datetime
import os
import platform

import warp as wp

from gdpro_sim.device import resolve_device, thread_count

VECTOR_FLAGS = "-march=native" + (
    " -mprefer-vector-width=512" if platform.machine().lower() in ("x86_64", "amd64") else ""
)
"""Compiler flags of benchmark kernels on vectors of 16 lanes, as those of the splatting kernels."""


def machine(device: str = "cpu") -> str:
    """One line: processor (and GPU), cores, threads, load, versions, date."""
    name = platform.processor() or platform.machine()
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as info:
            name = next(line.split(":", 1)[1].strip() for line in info if line.startswith("model name"))
    except (OSError, StopIteration):
        pass
    resolved = resolve_device(device)
    gpu = "" if resolved == "cpu" else f", {wp.get_device(resolved).name}"
    return (
        f"{name}{gpu}, {os.cpu_count()} cores, {thread_count()} threads, load {os.getloadavg()[0]:.1f}, "
        f"Python {platform.python_version()}, Warp {wp.config.version}, {datetime.date.today().isoformat()}"
    )


__all__ = ["VECTOR_FLAGS", "machine"]
