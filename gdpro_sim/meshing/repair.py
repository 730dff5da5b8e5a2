"""Mesh validation and repair: welding, degenerate and duplicate faces, winding, outward orientation.

Everything here works on plain arrays: vertices [V, 3] and faces [F, 3]. Functions that drop or turn faces
return what they did, so that per-corner attributes can follow.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial import cKDTree

from gdpro_sim.errors import MeshError

CORNER_SWAP = (0, 2, 1)
"""Corner order of a turned face."""

NESTING_CHECKS = 64


@dataclass(frozen=True)
class MeshReport:
    """Facts about a triangle mesh.

    boundary_edges:     edges with one face (0 for a closed mesh)
    non_manifold_edges: edges with three or more faces
    flipped_edges:      edges whose two faces run along them in the same direction
    degenerate_faces:   faces of (nearly) no area
    components:         pieces connected over shared vertices
    area, volume:       m^2 and signed m^3 (the volume of an open mesh is that of its cone over the centroid)
    """

    vertices: int
    faces: int
    boundary_edges: int
    non_manifold_edges: int
    flipped_edges: int
    degenerate_faces: int
    components: int
    area: float
    volume: float

    @property
    def watertight(self) -> bool:
        """Closed, manifold along every edge and consistently wound."""
        return self.faces > 0 and not (self.boundary_edges or self.non_manifold_edges or self.flipped_edges)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Cross products of the face edges (twice the area long) in float64; [F, 3]."""
    v = np.asarray(vertices, np.float64)
    a = v[faces[:, 0]]
    return np.cross(v[faces[:, 1]] - a, v[faces[:, 2]] - a)


def face_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Face areas in float64, m^2; [F]."""
    return 0.5 * np.linalg.norm(face_normals(vertices, faces), axis=1)


def signed_volume(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Signed volume in m^3 by the divergence theorem, measured from the centroid of the vertices in use."""
    if not len(faces):
        return 0.0
    v = np.asarray(vertices, np.float64)
    centre = v[faces].mean((0, 1))
    return float(np.einsum("fc,fc->", v[faces[:, 0]] - centre, face_normals(vertices, faces)) / 6.0)


def edge_keys(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Undirected edge of each half edge as one int64 key, and whether it runs from the lower index; [3F]
    each.

    Half edge 3 f + i of face f runs from corner i to corner (i + 1) mod 3.
    """
    a = faces.astype(np.int64).ravel()
    b = faces[:, [1, 2, 0]].astype(np.int64).ravel()
    count = int(faces.max()) + 1 if len(faces) else 1
    return np.minimum(a, b) * count + np.maximum(a, b), a < b


def degenerate_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of faces with a repeated corner, or lower than 1e-7 of their longest edge; bool [F]."""
    if not len(faces):
        return np.zeros(0, bool)
    v = np.asarray(vertices, np.float64)
    longest = np.max(
        [((v[faces[:, i]] - v[faces[:, (i + 1) % 3]]) ** 2).sum(1) for i in range(3)], axis=0
    )  # squared
    return 2.0 * face_areas(vertices, faces) <= 1e-7 * longest


def face_components(faces: np.ndarray) -> np.ndarray:
    """Label of each face's piece, pieces connected over shared vertices; int32 [F]."""
    if not len(faces):
        return np.zeros(0, np.int32)
    count = int(faces.max()) + 1
    rows = np.concatenate([faces[:, 0], faces[:, 1]])
    cols = np.concatenate([faces[:, 1], faces[:, 2]])
    graph = sparse.coo_matrix((np.ones(len(rows), bool), (rows, cols)), shape=(count, count))
    labels = csgraph.connected_components(graph, directed=False)[1][faces[:, 0]]
    return np.unique(labels, return_inverse=True)[1].astype(np.int32)


def validate(vertices: np.ndarray, faces: np.ndarray) -> MeshReport:
    """Measure a mesh; raises `MeshError` for arrays that are no mesh at all (shape, index range, NaN)."""
    check_arrays(vertices, faces)
    keys, forward = edge_keys(faces)
    _, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    ups = np.bincount(inverse, weights=forward, minlength=len(counts))
    components = face_components(faces)
    return MeshReport(
        vertices=len(vertices),
        faces=len(faces),
        boundary_edges=int((counts == 1).sum()),
        non_manifold_edges=int((counts > 2).sum()),
        flipped_edges=int(((counts == 2) & (ups != 1)).sum()),
        degenerate_faces=int(degenerate_faces(vertices, faces).sum()),
        components=int(components.max()) + 1 if len(faces) else 0,
        area=float(face_areas(vertices, faces).sum()),
        volume=signed_volume(vertices, faces),
    )


def check_arrays(vertices: np.ndarray, faces: np.ndarray, name: str = "mesh") -> None:
    """Raise `MeshError` unless the arrays are a mesh with finite vertices and faces within range."""
    if vertices.ndim != 2 or vertices.shape[1] != 3:
        raise MeshError(f"{name}: vertices must have shape [V, 3], got {vertices.shape}")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"{name}: faces must have shape [F, 3] (triangles), got {faces.shape}")
    if not np.issubdtype(faces.dtype, np.integer):
        raise MeshError(f"{name}: faces must be integers, got {faces.dtype}")
    if not len(vertices) or not len(faces):
        raise MeshError(
            f"{name}: {len(vertices)} vertices and {len(faces)} faces; at least one triangle is needed"
        )
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(vertices):
        raise MeshError(f"{name}: face index {low if low < 0 else high} is outside 0..{len(vertices) - 1}")
    bad = int((~np.isfinite(vertices).all(1)).sum())
    if bad:
        raise MeshError(f"{name}: {bad} of {len(vertices)} vertices are NaN or infinite; remove them first")


def weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Merge vertices at the very same place and drop unused ones.

    Returns vertices [V', 3] and faces [F, 3] in the same face order; faces may become degenerate.
    """
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    compact = np.cumsum(used) - 1
    v = vertices[used] + np.zeros(1, vertices.dtype)  # + 0 turns -0.0 into 0.0
    f = compact[faces]
    order = np.lexsort((v[:, 2], v[:, 1], v[:, 0]))
    sorted_v = v[order]
    new = np.ones(len(v), bool)
    new[1:] = (sorted_v[1:] != sorted_v[:-1]).any(1)
    first = order[new]
    # Keep the file's vertex order: it keeps neighbours near each other in memory.
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    group = np.empty(len(v), np.int64)
    group[order] = rank[np.cumsum(new) - 1]
    v = v[np.sort(first)]
    f = group[f]
    return np.ascontiguousarray(v), np.ascontiguousarray(f.astype(np.int32))


def weld_seams(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Faces [F, 3] whose open edges are sewn where rounding alone keeps vertices apart (1e-6 of the
    diagonal).

    Only vertices on open edges move together, and only if that closes edges. The vertices stay as they are.
    """
    keys, _ = edge_keys(faces)
    _, first, counts = np.unique(keys, return_index=True, return_counts=True)
    half = first[counts == 1]
    if not len(half):
        return faces
    ends = np.concatenate([faces.ravel()[half], faces[:, [1, 2, 0]].ravel()[half]])
    rim = np.unique(ends)
    tolerance = 1e-6 * float(np.linalg.norm(np.ptp(vertices.astype(np.float64), axis=0)))
    pairs = cKDTree(vertices[rim]).query_pairs(tolerance, output_type="ndarray")
    if not len(pairs):
        return faces
    graph = sparse.coo_matrix((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(len(rim),) * 2)
    labels = csgraph.connected_components(graph, directed=False)[1]
    target = np.arange(len(vertices))
    target[rim] = rim[np.unique(labels, return_index=True)[1]][labels]
    sewn = target[faces].astype(faces.dtype)
    _, counts = np.unique(edge_keys(sewn)[0], return_counts=True)
    return sewn if int((counts == 1).sum()) < len(half) else faces


def duplicate_faces(faces: np.ndarray) -> np.ndarray:
    """Mask of faces whose three vertices an earlier face already joins, in whatever order; bool [F]."""
    key = np.sort(faces, axis=1)
    order = np.lexsort((key[:, 2], key[:, 1], key[:, 0]))
    same = (key[order][1:] == key[order][:-1]).all(1)
    mask = np.zeros(len(faces), bool)
    mask[order[1:][same]] = True  # lexsort is stable: the first of a run is the earliest
    return mask


def consistent_winding(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Faces to turn so that neighbours over a manifold edge agree; each piece follows most of its faces.

    Returns the mask of faces to turn, bool [F], and each face's piece (over manifold edges), int32 [F].
    """
    count = len(faces)
    keys, forward = edge_keys(faces)
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    start = np.flatnonzero(np.r_[True, sorted_keys[1:] != sorted_keys[:-1]])
    size = np.diff(np.r_[start, len(sorted_keys)])
    pair = start[size == 2]
    first, second = order[pair], order[pair + 1]
    a, b = first // 3, second // 3
    disagree = forward[first] == forward[second]
    once = np.unique(np.minimum(a, b) * count + np.maximum(a, b), return_index=True)[1]
    inconsistent = bool(disagree.any())
    a, b, disagree = a[once], b[once], disagree[once]
    graph = sparse.coo_matrix((np.ones(len(a), bool), (a, b)), shape=(count, count))
    pieces, labels = csgraph.connected_components(graph, directed=False)
    if not inconsistent:
        return np.zeros(count, bool), labels.astype(np.int32)
    # Weight 1 + disagreement, so that the sparse matrix keeps the zero entries.
    weights = sparse.csr_matrix((1.0 + disagree, (a, b)), shape=(count, count))
    tree = csgraph.minimum_spanning_tree(weights)
    tree = tree + tree.T
    parent = np.arange(count)
    roots = np.unique(labels, return_index=True)[1]
    turned = np.zeros(count, bool)
    # One breadth-first search serves every piece: a virtual root reaches one face of each.
    rooted = sparse.bmat([[tree, None], [None, sparse.csr_matrix((1, 1))]]).tolil()
    rooted[count, roots] = 1.0
    _, predecessor = csgraph.breadth_first_order(rooted.tocsr(), count, directed=False)
    predecessor = predecessor[:count]
    inner = np.flatnonzero((predecessor >= 0) & (predecessor < count))
    parent[inner] = predecessor[inner]
    turned[inner] = np.asarray(tree[inner, parent[inner]]).ravel() > 1.5
    while True:  # pointer jumping: parity of the path to the root
        above = parent[parent]
        if np.array_equal(above, parent):
            break
        turned = turned ^ turned[parent]
        parent = above
    share = np.bincount(labels, weights=turned, minlength=pieces) / np.bincount(labels, minlength=pieces)
    return turned ^ (share > 0.5)[labels], labels.astype(np.int32)


def winding_number(point: np.ndarray, triangles: np.ndarray) -> float:
    """Generalised winding number of one point over triangles [F, 3, 3] (Van Oosterom & Strackee 1983)."""
    d = triangles - point
    length = np.linalg.norm(d, axis=2)
    det = np.einsum("fc,fc->f", d[:, 0], np.cross(d[:, 1], d[:, 2]))
    dots = [
        np.einsum("fc,fc->f", d[:, i], d[:, j]) * length[:, k]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
    ]
    return float(np.arctan2(det, length.prod(1) + sum(dots)).sum() / (2.0 * np.pi))


def outward_orientation(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Mask of faces to turn so that normals point outward; bool [F].

    Pieces are connected over manifold edges. Every piece is turned whose volume is negative, except a cavity:
    a piece inside another one.
    """
    labels = consistent_winding(faces)[1]
    v = np.asarray(vertices, np.float64)
    count = int(labels.max()) + 1 if len(faces) else 0
    # Divergence theorem per piece, from the piece's own centroid so that open pieces have a meaning too.
    normals = face_normals(vertices, faces)
    sizes = np.bincount(labels, minlength=count)
    centroid = v[faces].mean(1)
    sums = np.stack([np.bincount(labels, weights=centroid[:, i], minlength=count) for i in range(3)], 1)
    centres = sums / np.maximum(sizes, 1)[:, None]
    flux = np.einsum("fc,fc->f", v[faces[:, 0]] - centres[labels], normals)
    volumes = np.bincount(labels, weights=flux, minlength=count) / 6.0
    scale = np.bincount(labels, weights=np.linalg.norm(normals, axis=1), minlength=count) ** 1.5
    # Everything inside out is turned first; the pieces are then judged as they would lie.
    whole = bool(volumes.sum() < -1e-9 * scale.sum())
    turn = (-volumes if whole else volumes) < -1e-9 * scale
    inward = np.flatnonzero(turn)
    for piece in inward[np.argsort(-np.abs(volumes[inward]))][:NESTING_CHECKS]:
        others = labels != piece
        point = centroid[np.flatnonzero(~others)[0]]
        if others.any() and abs(winding_number(point, v[faces[others]])) > 0.5:
            turn[piece] = False
    turn ^= whole
    return turn[labels]


def turn_faces(faces: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Copy of per-corner data [F, 3, ...] with corners 1 and 2 swapped where `mask`."""
    out = faces.copy()
    out[mask] = out[mask][:, list(CORNER_SWAP)]
    return out


def clean(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weld, drop degenerate and duplicate faces, agree on winding and turn normals outward.

    For arrays without attributes; `load_mesh` does the same with them. Raises `MeshError` when nothing is
    left.
    """
    check_arrays(vertices, faces)
    v, f = weld(np.asarray(vertices), np.asarray(faces))
    f = weld_seams(v, f)
    f = f[~degenerate_faces(v, f)]
    f = f[~duplicate_faces(f)] if len(f) else f
    if not len(f):
        raise MeshError("mesh: every face has zero area; nothing is left to simulate or draw")
    f = turn_faces(f, consistent_winding(f)[0])
    f = turn_faces(f, outward_orientation(v, f))
    return weld(v, f)


__all__ = [
    "MeshReport",
    "check_arrays",
    "clean",
    "consistent_winding",
    "degenerate_faces",
    "duplicate_faces",
    "edge_keys",
    "face_areas",
    "face_components",
    "face_normals",
    "outward_orientation",
    "signed_volume",
    "turn_faces",
    "validate",
    "weld",
    "weld_seams",
    "winding_number",
]
