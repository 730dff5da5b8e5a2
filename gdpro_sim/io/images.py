"""PNG pictures, H.264 video and contact sheets, each written whole or not at all."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import imageio
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from gdpro_sim.files import atomic_write


def write_png(path: str | Path, picture: np.ndarray) -> None:
    """Write one uint8 picture [H, W, 3], or [H, W, 4] with opacity. Raises OutputError."""
    with atomic_write(path) as temporary:
        Image.fromarray(picture).save(temporary, format="PNG", compress_level=2)


def read_png(path: str | Path) -> np.ndarray:
    """Read one picture as uint8 [H, W, 3]; one that is not opaque is laid on white."""
    with Image.open(path) as image:
        if image.mode == "RGBA":
            white = Image.new("RGBA", image.size, "white")
            return np.asarray(Image.alpha_composite(white, image).convert("RGB"))
        return np.asarray(image.convert("RGB"))


def write_video(path: str | Path, pictures: Iterable[np.ndarray], fps: float) -> None:
    """Write uint8 [H, W, 3] pictures of even size as H.264 (yuv420p). Raises OutputError."""
    with (
        atomic_write(path) as temporary,
        imageio.get_writer(
            temporary,
            format="FFMPEG",  # type: ignore[arg-type]
            mode="I",
            fps=fps,
            codec="libx264",
            pixelformat="yuv420p",
            macro_block_size=2,
            ffmpeg_log_level="error",
            output_params=["-crf", "18", "-preset", "medium", "-movflags", "+faststart"],
        ) as writer,
    ):
        for picture in pictures:
            writer.append_data(picture)  # type: ignore[attr-defined]


def write_contact_sheet(
    path: str | Path,
    pictures: Sequence[np.ndarray],
    labels: Sequence[str],
    *,
    columns: int = 4,
    width: int = 1600,
) -> None:
    """Write a grid of pictures with a label in each corner. Raises OutputError."""
    cell_w = width // columns
    first = pictures[0]
    cell_h = round(cell_w * first.shape[0] / first.shape[1])
    rows = math.ceil(len(pictures) / columns)
    sheet = Image.new("RGB", (columns * cell_w, rows * cell_h), "white")
    font = ImageFont.load_default(size=max(12, cell_w // 22))
    for index, (picture, label) in enumerate(zip(pictures, labels, strict=True)):
        cell = Image.fromarray(picture).resize((cell_w - 4, cell_h - 4), Image.Resampling.LANCZOS)
        ImageDraw.Draw(cell).text((10, 8), label, fill=(60, 64, 70), font=font)
        sheet.paste(cell, ((index % columns) * cell_w + 2, (index // columns) * cell_h + 2))
    with atomic_write(path) as temporary:
        sheet.save(temporary, format="PNG")


def frame_name(index: int) -> str:
    """File name of picture number `index` of a sequence."""
    return f"frame_{index:05d}.png"


def remove_frames_from(folder: Path, count: int) -> None:
    """Delete the pictures from number `count` on: they belong to an earlier, longer run of this folder."""
    for old in folder.glob("frame_*.png"):
        number = old.stem.removeprefix("frame_")
        if number.isdigit() and int(number) >= count:
            old.unlink()


def spread(count: int, cells: int) -> list[int]:
    """`cells` frame numbers spread evenly over `count` frames, first and last included."""
    if count <= cells:
        return list(range(count))
    return [round(i * (count - 1) / (cells - 1)) for i in range(cells)]


__all__ = [
    "frame_name",
    "read_png",
    "remove_frames_from",
    "spread",
    "write_contact_sheet",
    "write_png",
    "write_video",
]
