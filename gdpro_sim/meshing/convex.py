"""Rigid shapes of meshes: convex pieces (CoACD), primitives of the same volume and inertia, and exact mass
properties."""

from __future__ import annotations

import logging
import math
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.optimize import brentq

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.remesh import decimate
from gdpro_sim.meshing.repair import check_arrays, validate
from gdpro_sim.meshing.tetmesh import TetMesh

logger = logging.getLogger(__name__)

WORKER = "gdpro_sim.meshing.convex_worker"
TIME_LIMIT = 300.0
FACES = 2_000
"""A finer mesh is decimated to this many faces before it is decomposed: pieces are coarser anyway."""

PrimitiveKind = Literal["box", "sphere", "capsule", "cylinder"]
PRIMITIVES: tuple[str, ...] = get_args(PrimitiveKind)


@dataclass(frozen=True)
class MassProperties:
    """Of a solid of density 1. Lengths in m.

    volume:  m^3
    centre:  [3] m, centre of mass
    inertia: [3, 3] m^5 about the centre, axes as the mesh's
    """

    volume: float
    centre: np.ndarray
    inertia: np.ndarray


@dataclass(frozen=True)
class ConvexPieces:
    """Convex polyhedra that together fill a mesh.

    vertices: [P, 3] float32 m, piece after piece
    faces:    [Q, 3] int32, outward, counted from their piece's first vertex
    counts:   [n, 2] int32, vertices and faces of each piece
    concavity: largest left in a piece, as a share of the mesh's size
    """

    vertices: np.ndarray
    faces: np.ndarray
    counts: np.ndarray
    concavity: float = 1.0

    def __len__(self) -> int:
        return len(self.counts)

    def __iter__(self) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """(vertices [p, 3], faces [q, 3]) of each piece."""
        ends = np.cumsum(self.counts, axis=0)
        for (a, b), (n, m) in zip(ends, self.counts, strict=True):
            yield self.vertices[a - n : a], self.faces[b - m : b]

    def scaled(self, factor: float) -> ConvexPieces:
        return replace(self, vertices=self.vertices * np.float32(factor))


@dataclass(frozen=True)
class Primitive:
    """A solid around `position` [3] m, turned by `rotation` [3, 3].

    size: m: box half extents; sphere radius; capsule and cylinder (along Z) radius and half length, the
          capsule's without its round ends
    """

    kind: PrimitiveKind
    size: tuple[float, ...]
    position: np.ndarray
    rotation: np.ndarray


def mass_properties(vertices: np.ndarray, faces: np.ndarray) -> MassProperties:
    """Exact volume integrals of a closed mesh, [V, 3] m and [F, 3] outward, in float64.

    Mirtich 1996, "Fast and Accurate Computation of Polyhedral Mass Properties", J. Graphics Tools 1, as
    trimesh evaluates them. Raises MeshError for a mesh that is not closed or encloses nothing.
    """
    import trimesh

    report = validate(vertices, faces)
    if not report.watertight or report.volume <= 0.0:
        raise MeshError(
            f"the mesh is not closed with normals outward ({report.boundary_edges} open edges, volume "
            f"{report.volume:.3g} m^3), so it has no volume to weigh"
        )
    points = np.asarray(vertices, np.float64)
    middle = points.mean(axis=0)  # integrals about a near point lose no digits
    found = trimesh.triangles.mass_properties((points - middle)[faces], density=1.0, skip_inertia=False)
    return MassProperties(
        float(found["volume"]), np.asarray(found["center_mass"]) + middle, np.asarray(found["inertia"])
    )


def tet_mass_properties(mesh: TetMesh) -> MassProperties:
    """The same of tets, weighted by their fill: exact for straight elements.

    The second moments of a tetrahedron are V/20 (sum x_i x_i^T + 16 c c^T), c its centroid.
    """
    corners = mesh.vertices.astype(np.float64)[mesh.tets]
    volume = mesh.volumes() * mesh.fill
    total = float(volume.sum())
    centre = (volume[:, None] * corners.mean(axis=1)).sum(axis=0) / total
    corners = corners - centre
    middle = corners.mean(axis=1)
    second = np.einsum("t,tai,taj->ij", volume, corners, corners)
    second += 16.0 * np.einsum("t,ti,tj->ij", volume, middle, middle)
    second /= 20.0
    return MassProperties(total, centre, np.trace(second) * np.eye(3) - second)


def decompose(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    threshold: float = 0.1,
    most: int | None = None,
    seed: int = 0,
    time_limit: float = TIME_LIMIT,
) -> ConvexPieces:
    """Convex pieces of a mesh, [V, 3] m and [F, 3]; the same input and seed give the same pieces.

    CoACD (Wei et al. 2022, "Approximate Convex Decomposition for 3D Meshes with Collision-Aware Concavity and
    Tree Search"). `threshold` is the largest concavity left in a piece, as a share of the mesh's size;
    `most` bounds the number of pieces. Open meshes are closed by voxels first. Raises MeshError.
    """
    if not 0.01 <= threshold <= 1.0:
        raise MeshError(f"threshold must lie in [0.01, 1], got {threshold}")
    if most is not None and most < 1:
        raise MeshError(f"at least one convex piece is needed, got {most}")
    check_arrays(vertices, faces)
    v, f = np.asarray(vertices, np.float64), np.asarray(faces, np.int32)
    if most == 1:
        return _joined([_hull(v[np.unique(f)])])
    if len(f) > FACES:
        w, g = decimate(v, f, FACES)
        v, f = w.astype(np.float64), g
    low, high = v.min(axis=0), v.max(axis=0)
    centre, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    started = time.monotonic()
    points, counts = _run((v - centre) / size, f, threshold, most or -1, seed, time_limit)
    if not len(counts):
        raise MeshError("convex decomposition found no piece: the mesh encloses no volume; give it thickness")
    # Hulls anew: what CoACD returns may be flat or not closed where pieces are thin.
    ends = np.cumsum(counts)
    hulls = [_hull(points[end - n : end] * size + centre) for end, n in zip(ends, counts, strict=True)]
    pieces = replace(_joined([hull for hull in hulls if hull is not None]), concavity=float(threshold))
    logger.info("%d faces in %d convex pieces in %.1f s", len(f), len(pieces), time.monotonic() - started)
    return pieces


def _hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """The convex hull's vertices and outward faces; None where it is flat."""
    import trimesh

    try:
        hull = trimesh.convex.convex_hull(np.asarray(points, np.float32).astype(np.float64))
    except Exception:  # Qhull's own errors and trimesh's, for points in one plane
        return None
    if not hull.volume > 1e-9 * float(np.ptp(points, axis=0).max()) ** 3:
        return None
    return hull.vertices.astype(np.float32), hull.faces.astype(np.int32)


def _joined(hulls: list[tuple[np.ndarray, np.ndarray] | None]) -> ConvexPieces:
    kept = [hull for hull in hulls if hull is not None]
    if not kept:
        raise MeshError("the mesh is flat and has no convex piece; give it thickness")
    return ConvexPieces(
        np.concatenate([v for v, _ in kept]),
        np.concatenate([f for _, f in kept]),
        np.array([[len(v), len(f)] for v, f in kept], np.int32),
    )


def _run(
    vertices: np.ndarray, faces: np.ndarray, threshold: float, most: int, seed: int, time_limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """Points and counts of CoACD in a subprocess, killed at the time limit and on any interruption."""
    with tempfile.TemporaryDirectory(prefix="gdpro-convex-") as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(
            source, vertices=vertices, faces=faces, threshold=threshold, most=most, seed=seed,
            seconds=math.ceil(time_limit) + 5,
        )  # fmt: skip
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", WORKER, str(source), str(target)],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            _, errors = process.communicate(timeout=time_limit)
        except subprocess.TimeoutExpired:
            raise MeshError(
                f"convex decomposition passed its time limit of {time_limit:g} s; raise the threshold, "
                "simplify the mesh, or take a primitive"
            ) from None
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stderr is not None:
                process.stderr.close()
        if process.returncode != 0 or not target.is_file():
            lines = errors.decode("utf-8", "replace").strip().splitlines()
            raise MeshError(
                f"convex decomposition failed ({lines[-1][:200] if lines else process.returncode}); repair "
                "the mesh, or take a primitive"
            )
        with np.load(target, allow_pickle=False) as data:
            return data["vertices"], data["counts"]


# ---- primitives ----


SAME = 0.01
"""Moments that differ by less than this share are taken as equal: their axes could be any."""


def fit_primitive(kind: PrimitiveKind, solid: MassProperties, frame: np.ndarray | None = None) -> Primitive:
    """The primitive with a solid's volume, centre, principal axes and, as far as its kind can, inertia.

    A box takes the ratios of all three moments; capsule and cylinder lie along the axis whose moment differs
    most from the other two and take the ratio of it to their mean. Where moments are equal, as a cube's are,
    the axes are as near to those of `frame` [3, 3] as can be; None: the world's.
    """
    moments, axes = _principal(solid.inertia, np.eye(3) if frame is None else frame)
    volume = solid.volume
    if kind == "sphere":
        return Primitive(kind, ((0.75 * volume / math.pi) ** (1.0 / 3.0),), solid.centre, np.eye(3))
    if kind == "box":
        squares = np.maximum(0.5 * moments.sum() - moments, 1e-12 * moments.sum())
        edges = np.sqrt(squares)
        half = 0.5 * edges * (volume / edges.prod()) ** (1.0 / 3.0)
        return Primitive(kind, tuple(float(x) for x in half), solid.centre, axes)
    alone = 0 if moments[1] - moments[0] >= moments[2] - moments[1] else 2
    across = np.delete(moments, alone).mean()
    ratio = across / moments[alone]  # of the moment across the axis to the one along it
    order = [1, 2, 0] if alone == 0 else [0, 1, 2]
    turned = axes[:, order]
    if kind == "cylinder":
        # I along = m r^2 / 2, I across = m (3 r^2 + L^2) / 12, so L^2 / r^2 = 6 ratio - 3.
        shape = math.sqrt(max(6.0 * ratio - 3.0, 1e-4))
        radius = (volume / (math.pi * shape)) ** (1.0 / 3.0)
    else:
        shape = _capsule_shape(ratio)
        radius = (volume / (math.pi * (shape + 4.0 / 3.0))) ** (1.0 / 3.0)
    return Primitive(kind, (radius, 0.5 * shape * radius), solid.centre, turned)


def _principal(inertia: np.ndarray, frame: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Moments [3], ascending, and their axes [3, 3], right-handed, in columns."""
    moments, axes = np.linalg.eigh(inertia)
    near = np.diff(moments) < SAME * moments[2]
    if near.all():
        axes = frame.copy()
    elif near.any():
        alone = axes[:, 2 if near[0] else 0]
        first = frame[:, np.argmin(np.abs(frame.T @ alone))]
        first = first - (first @ alone) * alone
        first /= np.linalg.norm(first)
        pair = [first, np.cross(alone, first)]
        axes = np.column_stack([*pair, alone] if near[0] else [alone, *pair])
    if np.linalg.det(axes) < 0.0:
        axes[:, 0] *= -1.0
    return moments, axes


def _capsule_shape(ratio: float) -> float:
    """Length of the straight part over the radius, of the capsule with that ratio of moments."""

    def excess(x: float) -> float:
        rod, ball = math.pi * x, 4.0 / 3.0 * math.pi
        along = 0.5 * rod + 0.4 * ball
        # Half balls: their own moment about the ball's centre, moved out by x / 2 (offset 3/8 of the radius).
        across = rod * (3.0 + x * x) / 12.0 + ball * (0.4 + x * x / 4.0 + 3.0 / 8.0 * x)
        return across / along - ratio

    least = 1e-3
    if excess(least) >= 0.0:
        return least
    return float(brentq(excess, least, 1e3))


__all__ = [
    "PRIMITIVES",
    "ConvexPieces",
    "MassProperties",
    "Primitive",
    "PrimitiveKind",
    "decompose",
    "fit_primitive",
    "mass_properties",
    "tet_mass_properties",
]
