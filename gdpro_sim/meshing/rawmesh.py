"""What a file reader hands to `load_mesh`: parts in the file's own axes and units, not yet cleaned."""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.surface import MeshMaterial

WHITE = (1.0, 1.0, 1.0, 1.0)

MAX_FACES = 3_000_000
"""More triangles than this are refused: reading and decimating them takes about 2 GB of memory at that
size."""


@dataclass
class RawPart:
    """One piece: vertices [V, 3] float64 (node transforms applied), faces [F, 3], per-corner attributes.

    groups: [F] bool of the faces in each, by the file's names for parts that are no materials
    """

    vertices: np.ndarray
    faces: np.ndarray
    material_ids: np.ndarray
    materials: list[MeshMaterial]
    uv: np.ndarray | None = None
    colors: np.ndarray | None = None
    groups: dict[str, np.ndarray] = field(default_factory=dict)


@dataclass
class RawMesh:
    """All pieces of a file. `up` is its vertical axis, `unit` its length unit in metres."""

    parts: list[RawPart] = field(default_factory=list)
    up: str = "z"
    unit: float = 1.0
    messages: list[str] = field(default_factory=list)


def too_many_faces(path: Path, faces: int) -> MeshError:
    """The error for a mesh above `MAX_FACES`."""
    return MeshError(
        f"{path}: {faces:,} faces is above the limit of {MAX_FACES:,}; decimate it first, for instance with "
        "MeshLab or Blender's Decimate modifier"
    )


def image_array(image: Any) -> np.ndarray:
    """A PIL image as uint8 RGBA [H, W, 4]; 16-bit and float greys are scaled to 8 bits."""
    if image.mode.startswith("I") or image.mode == "F":
        grey = np.asarray(image, np.float64)
        full = 1.0 if image.mode == "F" else 65535.0
        rgb = np.clip(grey / full * 255.0 + 0.5, 0, 255).astype(np.uint8)
        return np.stack([rgb, rgb, rgb, np.full_like(rgb, 255)], axis=2)
    return np.ascontiguousarray(np.asarray(image.convert("RGBA"), np.uint8))


def read_image(source: Path | bytes, name: str) -> np.ndarray:
    """Read an image as uint8 RGBA [H, W, 4]; raises `MeshError` naming `name` when it cannot be read."""
    from PIL import Image

    try:
        with Image.open(io.BytesIO(source) if isinstance(source, bytes) else source) as image:
            array = image_array(image)
    except FileNotFoundError:
        raise MeshError(f"texture {name} does not exist") from None
    except Exception as error:  # Pillow raises many kinds for broken files
        raise MeshError(f"texture {name} cannot be read ({error}); give a PNG or JPEG image") from error
    if not array.size:
        raise MeshError(f"texture {name} has no pixels")
    return array


__all__ = ["MAX_FACES", "WHITE", "RawMesh", "RawPart", "image_array", "read_image", "too_many_faces"]
