"""Tetrahedra for a surface: fTetWild in a guarded subprocess, a regular lattice where that fails."""

from __future__ import annotations

import logging
import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.lattice import lattice
from gdpro_sim.meshing.remesh import decimate
from gdpro_sim.meshing.repair import check_arrays, clean, face_areas, signed_volume, validate, winding_number
from gdpro_sim.meshing.tetmesh import TetMesh

logger = logging.getLogger(__name__)

WORKER = "gdpro_sim.meshing.tetwild_worker"
METHODS = ("auto", "tetwild", "lattice")

SURFACE_SHARE = 1.5
"""Tets that fTetWild makes over regular ones of the edge length: those at the surface are finer."""

COARSE = 0.08
"""Edges longer than this share of the diagonal need fTetWild's coarsening pass to come about. It costs time
and shape quality (mean 0.75 against 0.85 on the bunny), so finer meshes go without."""

EPSILON = 5e-3
"""Default envelope over the bounding box's diagonal: a fifth of the time of 1e-3, a volume within 1 to 2
%."""

LEAST_PIECE = 1e-3
LATTICE_FACES = 5000
POCKET_WINDING, POCKET_POINTS, POCKET_FACES = 0.62, 200, 4000
MEMORY = 8 << 30
MIN_TETS, MAX_TETS = 20, 2_000_000


class TetwildError(MeshError):
    """fTetWild gave no usable tets."""


def tetrahedralize(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    target_tets: int = 5000,
    edge_length: float | None = None,
    epsilon: float | None = None,
    time_limit: float = 60.0,
    method: str = "auto",
) -> TetMesh:
    """Fill a triangle surface, vertices [V, 3] m and faces [F, 3], with tets of positive volume.

    target_tets: about how many, less exactly below 2500; ignored when `edge_length` (m) is given
    epsilon:     how far the tets' surface may lie from the mesh, as a share of the bounding box's diagonal
    time_limit:  seconds fTetWild may take before it is ended
    method:      "tetwild", "lattice", or "auto": fTetWild (Hu et al. 2020), and on its failure the lattice,
                 with a warning in the log and `TetMesh.method == "lattice"`

    The surface is decimated to about the tets' resolution first. Open, self-intersecting and flipped meshes
    work.
    fTetWild is not deterministic: keep its result. Raises `MeshError` for broken arrays, a flat mesh, a mesh
    that encloses nothing, and (method "tetwild") when fTetWild fails or runs out of time.
    """
    if method not in METHODS:
        raise MeshError(f"tetrahedralization method must be one of {', '.join(METHODS)}, got {method!r}")
    if not MIN_TETS <= target_tets <= MAX_TETS:
        raise MeshError(f"target_tets must lie in {MIN_TETS}..{MAX_TETS}, got {target_tets}")
    for name, value in (("edge_length", edge_length), ("epsilon", epsilon), ("time_limit", time_limit)):
        if value is not None and not (math.isfinite(value) and value > 0.0):
            raise MeshError(f"{name} must be > 0, got {value}")
    check_arrays(np.asarray(vertices), np.asarray(faces))
    v, f = clean(np.asarray(vertices, np.float32), np.asarray(faces))
    _reject_flat(v)
    if method == "lattice":
        mesh = _lattice(v, f, target_tets, edge_length)
    else:
        try:
            mesh = _tetwild(v, f, target_tets, edge_length, epsilon, time_limit)
        except TetwildError as error:
            if method == "tetwild":
                raise
            logger.warning("%s; using a regular tet lattice instead, coarser at the surface", error)
            mesh = _lattice(v, f, target_tets, edge_length)
    _check_volume(v, f, mesh)
    return mesh


def _reject_flat(v: np.ndarray) -> None:
    centred = v.astype(np.float64) - v.mean(0)
    spread = np.linalg.eigvalsh(centred.T @ centred)
    if spread[0] <= 1e-12 * spread[2]:
        raise MeshError(
            "the mesh is flat and encloses no volume; give it thickness (Blender: Solidify modifier)"
        )


def _sizes(v: np.ndarray, f: np.ndarray, target_tets: int, edge_length: float | None) -> tuple[float, int]:
    """Edge length in m, and the number of surface triangles fTetWild gets."""
    area = float(face_areas(v, f).sum())
    if edge_length is None:
        volume = abs(signed_volume(v, f))
        # A regular tet's volume is l^3 / (6 sqrt 2), a regular triangle's area sqrt(3) / 4 l^2.
        edge_length = max(
            (6.0 * math.sqrt(2.0) * volume * SURFACE_SHARE / target_tets) ** (1.0 / 3.0),
            math.sqrt(area * SURFACE_SHARE * 4.0 / math.sqrt(3.0) / target_tets),
        )
    triangles = area * 4.0 / math.sqrt(3.0) / edge_length**2
    return edge_length, int(np.clip(1.5 * triangles, 1000, 8000))


def _lattice(v: np.ndarray, f: np.ndarray, target_tets: int, edge_length: float | None) -> TetMesh:
    if len(f) > LATTICE_FACES:  # inside tests take time with the faces, and the cubes see no more detail
        v, f = decimate(v, f, LATTICE_FACES)
    return _finish(lattice(v, f, target_tets=target_tets, edge_length=edge_length))


def _tetwild(
    v: np.ndarray,
    f: np.ndarray,
    target_tets: int,
    edge_length: float | None,
    epsilon: float | None,
    limit: float,
) -> TetMesh:
    edge, triangles = _sizes(v, f, target_tets, edge_length)
    if len(f) > triangles:
        v, f = decimate(v, f, triangles)
    low, high = v.min(0).astype(np.float64), v.max(0).astype(np.float64)
    centre, diagonal = 0.5 * (low + high), float(np.linalg.norm(high - low))
    relative = min(edge / diagonal, 0.5)
    started = time.monotonic()
    points, tets = run_tetwild(
        (v.astype(np.float64) - centre) / diagonal,
        f,
        relative,
        epsilon or min(EPSILON, 0.1 * relative),
        limit,
    )
    if not len(tets):
        raise TetwildError(
            "fTetWild returned no tets: the mesh encloses no volume it can see (a sheet, or walls thinner "
            f"than {2.0 * (epsilon or EPSILON) * diagonal:.2g} m); give it thickness or lower epsilon"
        )
    if tets.min() < 0 or tets.max() >= len(points) or not np.isfinite(points).all():
        raise TetwildError("fTetWild returned a broken mesh; repair the input, or use method='lattice'")
    out = (points * diagonal + centre).astype(np.float32)
    mesh = _finish(TetMesh(out, tets.astype(np.int32), np.ones(len(tets), np.float32), "tetwild"))
    logger.info("fTetWild: %d faces to %d tets in %.1f s", len(f), len(mesh.tets), time.monotonic() - started)
    return mesh


def run_tetwild(
    vertices: np.ndarray, faces: np.ndarray, edge_length: float, epsilon: float, time_limit: float
) -> tuple[np.ndarray, np.ndarray]:
    """fTetWild on valid arrays in a subprocess; vertices float64 [P, 3] and tets int32 [T, 4], unchecked.

    `edge_length` and `epsilon` are shares of the bounding box's diagonal. The process is killed at
    `time_limit` seconds and on any interruption. Raises `MeshError` for a time-out, a crash or an error
    inside it.
    """
    with tempfile.TemporaryDirectory(prefix="gdpro-tet-") as folder:
        source, target = Path(folder, "in.npz"), Path(folder, "out.npz")
        np.savez(
            source,
            vertices=vertices,
            faces=faces,
            edge_length=edge_length,
            epsilon=epsilon,
            coarsen=edge_length > COARSE,
            seconds=math.ceil(time_limit) + 5,
            bytes=MEMORY,
        )
        command = [sys.executable, "-P", "-m", WORKER, str(source), str(target)]
        process = subprocess.Popen(
            command,
            cwd=folder,  # fTetWild leaves a file of its own where it runs
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        try:
            _, errors = process.communicate(timeout=time_limit)
        except subprocess.TimeoutExpired:
            raise TetwildError(
                f"fTetWild passed its time limit of {time_limit:g} s; raise the limit, simplify the mesh, or "
                "use method='lattice'"
            ) from None
        finally:
            if process.poll() is None:
                process.kill()
                process.wait()
            if process.stderr is not None:
                process.stderr.close()
        if process.returncode != 0 or not target.is_file():
            lines = errors.decode("utf-8", "replace").strip().splitlines()
            how = (
                f"signal {-process.returncode}"
                if process.returncode < 0
                else f"exit code {process.returncode}"
            )
            reason = f": {lines[-1][:200]}" if lines else ""
            raise TetwildError(f"fTetWild failed ({how}{reason}); repair the mesh, or use method='lattice'")
        with np.load(target, allow_pickle=False) as data:
            return data["vertices"].reshape(-1, 3), data["tets"].reshape(-1, 4)


def _finish(mesh: TetMesh) -> TetMesh:
    """Positive volumes only, pieces of any weight only, vertices in use only."""
    volumes = mesh.volumes()
    tets = mesh.tets.copy()
    tets[volumes < 0.0] = tets[volumes < 0.0][:, [0, 2, 1, 3]]
    volumes = np.abs(volumes)
    solid = volumes > 1e-7 * volumes.mean()
    if not solid.any() or volumes[~solid].sum() > 0.01 * volumes.sum():
        raise TetwildError(
            "tetrahedralization gave degenerate elements; repair the mesh, or use method='lattice'"
        )
    tets, fill, volumes = tets[solid], mesh.fill[solid], volumes[solid]
    count = len(mesh.vertices)
    rows, cols = tets[:, [0, 0, 0]].ravel(), tets[:, 1:].ravel()
    graph = sparse.coo_matrix((np.ones(len(rows), bool), (rows, cols)), shape=(count, count))
    piece = np.unique(
        csgraph.connected_components(graph, directed=False)[1][tets[:, 0]], return_inverse=True
    )[1]
    weight = np.bincount(piece, weights=volumes * fill)
    crumbs = weight < LEAST_PIECE * weight.sum()
    if crumbs.any() and not crumbs.all():
        logger.info("dropped %d loose crumbs of %.2g m^3", int(crumbs.sum()), float(weight[crumbs].sum()))
        keep = ~crumbs[piece]
        tets, fill = tets[keep], fill[keep]
    used, compact = np.unique(tets, return_inverse=True)
    return TetMesh(
        np.ascontiguousarray(mesh.vertices[used]),
        np.ascontiguousarray(compact.reshape(-1, 4).astype(np.int32)),
        np.ascontiguousarray(fill),
        mesh.method,
    )


def _check_volume(v: np.ndarray, f: np.ndarray, mesh: TetMesh) -> None:
    """Refuse the pockets of a sheet; warn where tets and surface disagree about the volume."""
    report = validate(v, f)
    if report.boundary_edges:
        # Deep inside a nearly closed surface the winding number is nearly 1, in the pocket of a sheet just
        # above 1/2.
        if len(f) > POCKET_FACES:
            v, f = decimate(v, f, POCKET_FACES)
        centres = mesh.vertices.astype(np.float64)[mesh.tets].mean(1)
        some = np.random.default_rng(0).choice(len(centres), min(POCKET_POINTS, len(centres)), replace=False)
        triangles = v.astype(np.float64)[f]
        if np.median([winding_number(centres[i], triangles) for i in some]) < POCKET_WINDING:
            raise MeshError(
                "the mesh is an open sheet and encloses no volume; close it or give it thickness "
                "(Blender: Solidify modifier)"
            )
    total = float((mesh.volumes() * mesh.fill).sum())
    if report.watertight and abs(total - report.volume) > 0.15 * abs(report.volume):
        logger.warning(
            "the tets hold %.4g m^3 but the surface encloses %.4g m^3; overlapping parts or thin walls "
            "differ that much, more tets or a smaller epsilon may help",
            total,
            report.volume,
        )


__all__ = ["METHODS", "TetwildError", "tetrahedralize"]
