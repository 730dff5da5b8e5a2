"""A regular tetrahedral lattice around a surface: coarse, but it exists for any mesh that encloses
something."""

from __future__ import annotations

import itertools

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.tetmesh import TetMesh

LEAST_FILL = 0.05
"""Fill of an element that the surface crosses but no sample falls in: it must carry the surface, so it keeps
mass."""

VOLUME_SAMPLES = 40_000
TET_SAMPLES = 32
NO_VOLUME = (
    "the mesh encloses no volume (a sheet, or a surface with large openings); close it or give it thickness"
)


def _kuhn_tets() -> np.ndarray:
    """Six tets of the unit cube along its main diagonal (Kuhn 1960), corners as offsets; [6, 4, 3], positive
    volumes.

    Tet of axis order (a, b, c) holds the points whose local coordinates obey x_a >= x_b >= x_c.
    """
    out = []
    for order in itertools.permutations(range(3)):
        corners = np.zeros((4, 3), np.int64)
        for step, axis in enumerate(order):
            corners[step + 1 :, axis] = 1
        if np.linalg.det((corners[1:] - corners[0]).astype(float)) < 0.0:
            corners = corners[[0, 2, 1, 3]]
        out.append(corners)
    return np.asarray(out)


KUHN = _kuhn_tets()
KUHN_ORDER = {order: i for i, order in enumerate(itertools.permutations(range(3)))}


def lattice(
    vertices: np.ndarray, faces: np.ndarray, *, target_tets: int, edge_length: float | None = None
) -> TetMesh:
    """Cubes of six tets each wherever the surface or its inside is; `fill` is each tet's share inside the
    surface.

    Inside means a generalised winding number above one half (Jacobson et al. 2013), so open and
    self-intersecting surfaces work. `edge_length` (m) is the cube's edge; without it, it is chosen for about
    `target_tets`. Raises `MeshError` when the surface encloses nothing.
    """
    v = np.asarray(vertices, np.float64)
    low, high = v.min(0), v.max(0)
    index = SurfaceIndex(v, faces, winding=True)
    if edge_length is None:
        probes = low + np.random.default_rng(0).random((VOLUME_SAMPLES, 3)) * (high - low)
        volume = float(index.inside(probes).mean() * np.prod(high - low))
        if volume <= 0.0:
            raise MeshError(NO_VOLUME)
        edge_length = (6.0 * volume / target_tets) ** (1.0 / 3.0)
        for _ in range(12):
            tets, origin = _cells(v, faces, index, edge_length)
            if len(tets) * 6 <= 2.0 * target_tets:
                break
            edge_length *= 1.2
    else:
        tets, origin = _cells(v, faces, index, edge_length)
    return _fill(v, faces, index, tets, origin, edge_length)


def surface_points(v: np.ndarray, faces: np.ndarray, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Points [M, 3] on every face no further apart than about half of `size` m, and their faces [M].

    A face's corners are among them; of a face longer than 32 times `size` they lie further apart.
    """
    corner = v[faces]
    edges = np.linalg.norm(corner - np.roll(corner, -1, axis=1), axis=2).max(1)
    steps = np.clip(np.ceil(edges / (0.5 * size)), 1, 64).astype(np.int64)
    parts, owners = [], []
    for n in np.unique(steps):
        grid = np.asarray([(i, j, n - i - j) for i in range(n + 1) for j in range(n + 1 - i)], np.float64) / n
        rows = np.flatnonzero(steps == n)
        parts.append(np.einsum("gc,fcd->fgd", grid, corner[rows]).reshape(-1, 3))
        owners.append(np.repeat(rows, len(grid)))
    return np.concatenate(parts), np.concatenate(owners)


def _cells(
    v: np.ndarray, faces: np.ndarray, index: SurfaceIndex, size: float
) -> tuple[np.ndarray, np.ndarray]:
    """Cubes [C, 3] (integer coordinates) that hold inside or surface points, and the lattice's origin [3]
    m."""
    low, high = v.min(0), v.max(0)
    shape = np.maximum(np.ceil((high - low) / size - 1e-9), 1).astype(np.int64)
    if int(shape.prod()) > 20_000_000:
        raise MeshError(
            f"a lattice of {size:g} m cubes would need {int(shape.prod()):,} cubes; use a longer edge"
        )
    origin = 0.5 * (low + high) - 0.5 * shape * size
    centres = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1).reshape(-1, 3)
    keep = index.inside(origin + (centres + 0.5) * size)
    touched = np.clip(((surface_points(v, faces, size)[0] - origin) / size).astype(np.int64), 0, shape - 1)
    keep[np.ravel_multi_index(tuple(touched.T), tuple(shape))] = True
    return centres[keep], origin


def _fill(
    v: np.ndarray, faces: np.ndarray, index: SurfaceIndex, cells: np.ndarray, origin: np.ndarray, size: float
) -> TetMesh:
    corners = (cells[:, None, None] + KUHN).reshape(-1, 4, 3)  # [6 C, 4, 3] integer
    stride = cells.max(0) + 2
    keys = np.ravel_multi_index(tuple(corners.reshape(-1, 3).T), tuple(stride))
    unique, tets = np.unique(keys, return_inverse=True)
    tets = tets.reshape(-1, 4)
    nodes = origin + np.stack(np.unravel_index(unique, tuple(stride)), 1) * size
    # Uniform barycentric weights are the gaps between sorted uniforms. Drawn anew for each tet: a common
    # pattern would be biased wherever the surface runs along the lattice.
    cuts = np.sort(np.random.default_rng(0).random((len(tets), TET_SAMPLES, 3)), axis=2)
    weights = np.diff(cuts, axis=2, prepend=0.0, append=1.0)
    samples = np.einsum("tsw,twc->tsc", weights, nodes[tets])
    fill = index.inside(samples.reshape(-1, 3)).reshape(len(tets), -1).mean(1)
    # Tets the surface passes through stay even when no sample is inside them: they carry its vertices.
    local = (surface_points(v, faces, size)[0] - origin) / size
    cube = np.clip(local.astype(np.int64), 0, cells.max(0))
    lookup = np.full(tuple(cells.max(0) + 1), -1, np.int64)
    lookup[tuple(cells.T)] = np.arange(len(cells))
    order = np.argsort(-(local - cube), axis=1, kind="stable")
    kuhn = np.asarray([KUHN_ORDER[(a, b, 3 - a - b)] for a in range(3) for b in range(3) if b != a])
    which = kuhn[order[:, 0] * 2 + order[:, 1] - (order[:, 1] > order[:, 0])]
    owner = lookup[tuple(cube.T)]
    touched = np.zeros(len(tets), bool)
    touched[(owner * 6 + which)[owner >= 0]] = True
    if not (fill > 0.0).any():
        raise MeshError(NO_VOLUME)
    keep = (fill > 0.0) | touched
    fill = np.maximum(fill, LEAST_FILL)[keep]
    used, compact = np.unique(tets[keep], return_inverse=True)
    return TetMesh(
        nodes[used].astype(np.float32),
        compact.reshape(-1, 4).astype(np.int32),
        np.minimum(fill, 1.0).astype(np.float32),
        "lattice",
    )


__all__ = ["NO_VOLUME", "lattice", "surface_points"]
