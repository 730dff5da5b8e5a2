"""Depth, normal and alpha of pictures, as files for compositing."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np

from gdpro_sim.errors import OutputError, RequestError
from gdpro_sim.files import atomic_write

PASSES = ("depth", "normal", "alpha")


def check_passes(passes: Sequence[str]) -> tuple[str, ...]:
    """The passes asked for, in their order. Raises RequestError for unknown ones."""
    for name in passes:
        if name not in PASSES:
            raise RequestError(f"passes are {', '.join(PASSES)}, got {name!r}")
    return tuple(name for name in PASSES if name in passes)


def write_exr(path: str | Path, image: np.ndarray) -> None:
    """Write float32 [H, W] (channel Y) or [H, W, 3] (R, G, B) as OpenEXR, exactly. Raises OutputError."""
    height, width = image.shape[:2]
    planes, layout = (image, "grayf32le")
    if image.ndim == 3:  # ffmpeg's order of planes
        planes, layout = np.moveaxis(image, -1, 0)[[1, 2, 0]], "gbrpf32le"
    command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-f", "rawvideo"]
    command += ["-pix_fmt", layout, "-s", f"{width}x{height}", "-i", "-"]
    command += ["-c:v", "exr", "-compression", "zip16", "-f", "image2pipe", "-"]
    with atomic_write(path) as temporary:
        pixels = np.ascontiguousarray(planes, "<f4").tobytes()
        done = subprocess.run(command, input=pixels, capture_output=True)
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise OutputError(f"{path} cannot be written: {said[-1] if said else 'ffmpeg failed'}")
        temporary.write_bytes(done.stdout)


def remove_passes_from(folder: Path, count: int) -> None:
    """Delete the passes of frame `count` and later: they belong to an earlier, longer run of this folder."""
    for name in (*PASSES, "passes"):
        for old in folder.glob(f"{name}_*.*"):
            number = old.stem.removeprefix(f"{name}_")
            ours = len(number) == 5 and number.isdigit() and old.suffix in (".exr", ".npz")
            if ours and int(number) >= count:
                old.unlink()


__all__ = ["PASSES", "check_passes", "remove_passes_from", "write_exr"]
