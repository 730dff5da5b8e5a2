"""Points, polygons and groups of Wavefront OBJ files as they are written.

Mesh readers split vertices where normals differ, and forget which group a face was in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gdpro_sim.errors import MeshError


@dataclass(frozen=True)
class ObjFile:
    """points [V, 3] float64.

    polygons: int64, of each in turn how many corners it has and which points they are
    groups:   numbers of the polygons in each, by the names after `g` and `o`
    """

    points: np.ndarray
    polygons: np.ndarray
    groups: dict[str, list[int]] = field(default_factory=dict)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Polygons as fans: corners [T, 3] int64, and the number of the polygon of each [T]."""
        fans: list[tuple[int, int, int]] = []
        owners: list[int] = []
        rest: Sequence[int] = self.polygons.tolist()
        at = number = 0
        while at < len(rest):
            corners = rest[at + 1 : at + 1 + rest[at]]
            fans += [(corners[0], corners[k], corners[k + 1]) for k in range(1, len(corners) - 1)]
            owners += [number] * (len(corners) - 2)
            at, number = at + 1 + rest[at], number + 1
        return np.asarray(fans, np.int64).reshape(-1, 3), np.asarray(owners, np.int64)


def read_obj(file: Path) -> ObjFile:
    """Raises MeshError for a file that is damaged or has no polygons."""
    points: list[bytes] = []
    polygons: list[int] = []
    groups: dict[str, list[int]] = {}
    named: dict[bytes, list[bytes]] = {}
    count = 0
    try:
        for line in file.read_bytes().splitlines():
            if line.startswith(b"v "):
                points.append(b" ".join(line.split()[1:4]))
            elif line.startswith(b"f "):
                corners = [int(corner.split(b"/")[0]) for corner in line.split()[1:]]
                polygons += [len(corners), *(c - 1 if c > 0 else len(points) + c for c in corners)]
                for names in named.values():
                    for name in names:
                        groups.setdefault(name.decode("utf-8", "replace"), []).append(count)
                count += 1
            elif line.startswith((b"g ", b"o ")):
                named[line[:1]] = line.split()[1:] if line[:1] == b"g" else [line[2:].strip()]
        numbers = np.array(b" ".join(points).split(), dtype=np.float64)
    except ValueError as error:
        raise MeshError(f"{file}: cannot be read as OBJ ({error}); the file is damaged") from error
    if not polygons or len(numbers) != 3 * len(points):
        raise MeshError(f"{file}: holds no triangles; export a triangle mesh")
    return ObjFile(numbers.reshape(-1, 3), np.asarray(polygons, np.int64), groups)


__all__ = ["ObjFile", "read_obj"]
