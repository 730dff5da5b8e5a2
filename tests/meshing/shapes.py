"""Small meshes with known volumes, and files made of them."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

DATA = Path(__file__).resolve().parents[3] / "shared" / "data"


def cube() -> tuple[np.ndarray, np.ndarray]:
    """Unit cube around (0.5, 0.5, 0.5), 12 outward faces."""
    v = np.asarray([(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1)], np.float32)
    quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    f = np.asarray([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    return v, f


def sphere(subdivisions: int = 3, radius: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Icosphere of 20 * 4^subdivisions faces."""
    import trimesh

    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def sheet(count: int = 8) -> tuple[np.ndarray, np.ndarray]:
    """Flat unit square in z = 0."""
    x, y = np.meshgrid(np.linspace(0, 1, count + 1), np.linspace(0, 1, count + 1), indexing="ij")
    v = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], 1).astype(np.float32)
    i = (np.arange(count)[:, None] * (count + 1) + np.arange(count)).ravel()
    n = count + 1
    f = np.concatenate([np.stack([i, i + n, i + n + 1], 1), np.stack([i, i + n + 1, i + 1], 1)])
    return v, f.astype(np.int32)


def joined(*parts: tuple[np.ndarray, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Several meshes as one, nothing welded."""
    offsets = np.cumsum([0, *(len(v) for v, _ in parts)])
    return np.concatenate([v for v, _ in parts]), np.concatenate(
        [f + o for (_, f), o in zip(parts, offsets, strict=False)]
    ).astype(np.int32)


def write_obj(path: Path, v: np.ndarray, f: np.ndarray, head: str = "") -> Path:
    """An OBJ of plain triangles."""
    lines = [head, *(f"v {x} {y} {z}" for x, y, z in v), *(f"f {a} {b} {c}" for a, b, c in f + 1)]
    path.write_text("\n".join(lines) + "\n")
    return path


def write_ply(path: Path, v: np.ndarray, f: np.ndarray) -> Path:
    """A binary PLY, exactly the given arrays."""
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(v)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(f)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.zeros(len(f), [("n", "u1"), ("i", "<i4", 3)])
    rows["n"], rows["i"] = 3, f
    path.write_bytes(head.encode() + v.astype("<f4").tobytes() + rows.tobytes())
    return path


def textured_square(path: Path, name: str = "square") -> Path:
    """An OBJ square in z = 0 with UV over a 2 x 2 image: red green over blue white, v up; Z-up
    coordinates."""
    from PIL import Image

    image = np.asarray([[(255, 0, 0), (0, 255, 0)], [(0, 0, 255), (255, 255, 255)]], np.uint8)
    Image.fromarray(np.repeat(np.repeat(image, 8, 0), 8, 1)).save(path / f"{name}.png")
    obj = path / f"{name}.obj"
    obj.write_text(
        "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 2/2 3/3\nf 1/1 3/3 4/4\n"
    )
    return obj


def warp_asset(name: str) -> Path:
    """A mesh that the warp package carries; skips where it does not."""
    spec = importlib.util.find_spec("warp")
    assert spec is not None and spec.origin is not None
    path = Path(spec.origin).parent / "examples" / "assets" / name
    if not path.is_file():
        pytest.skip(f"this build of warp carries no {name}")
    return path


def shared(name: str) -> Path:
    """A file of the shared data folder; skips where it is absent."""
    path = DATA / name
    if not path.is_file():
        pytest.skip(f"{path} is absent")
    return path
