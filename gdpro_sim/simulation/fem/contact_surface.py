"""Which triangles may touch each other, and a cheap certificate that none of them can within a motion."""

from __future__ import annotations

from typing import NamedTuple

import ipctk
import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from gdpro_sim.errors import SolverError
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.simulation.model import Model


class Piece(NamedTuple):
    """One body's boundary.

    name:     of the body
    vertices: (begin, end) into the surface's vertices
    faces:    [F, 3] int32, ids among the piece's own vertices
    size:     m, diagonal of its box at the start
    edge:     m, median length of its edges at the start
    """

    name: str
    vertices: tuple[int, int]
    faces: np.ndarray
    size: float
    edge: float


class Surface:
    """The boundaries of all bodies' tets as one collision mesh; a body is a `Piece`.

    A model without bodies has one piece for each connected part. A lattice's boundary lies outside the
    body's own surface by `Model.contact_offset`: such bodies touch that much earlier than they look.

    ids:    [S] vertices of the model on the surface, ascending within each piece
    pieces: in the order of the model's bodies
    owner:  [S] int32 number of the piece
    body:   [P] number of the piece that each vertex of the model belongs to
    """

    def __init__(self, model: Model) -> None:
        faces, _ = boundary(model.tets)
        self.body = owner = _owners(model)
        used = np.unique(faces)
        self.ids = used[np.argsort(owner[used], kind="stable")]
        place = np.full(len(model.vertices), -1, np.int64)
        place[self.ids] = np.arange(len(self.ids))
        self.faces = np.asfortranarray(place[faces].astype(np.int32))
        self.edges = np.asfortranarray(ipctk.edges(self.faces))
        self.rest = self.positions(model.vertices.astype(np.float64))
        self.owner = owner[self.ids].astype(np.int32)
        names = [body.name for body in model.bodies]
        self.pieces = []
        for k in range(int(self.owner.max(initial=-1)) + 1):
            begin, end = (int(i) for i in np.searchsorted(self.owner, [k, k + 1]))
            own = self.faces[self.owner[self.faces[:, 0]] == k] - begin
            corners = self.rest[begin:end][own]
            edge = float(np.median(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)))
            size = float(np.linalg.norm(np.ptp(self.rest[begin:end], axis=0)))
            name = names[k] if names else f"part {k}"
            self.pieces.append(Piece(name, (begin, end), own.astype(np.int32), size, edge))

    def positions(self, x: np.ndarray) -> np.ndarray:
        """Surface vertices of model vertices x [P, 3], as the IPC Toolkit wants them."""
        return np.asfortranarray(x[self.ids])

    def mesh(self) -> ipctk.CollisionMesh:
        return ipctk.CollisionMesh(self.rest, self.edges, self.faces)

    def piece_mesh(self, piece: Piece) -> ipctk.CollisionMesh:
        begin, end = piece.vertices
        faces = np.asfortranarray(piece.faces)
        return ipctk.CollisionMesh(self.rest[begin:end].copy(order="F"), ipctk.edges(faces), faces)

    def boxes(self, *positions: np.ndarray, margin: float) -> np.ndarray:
        """[pieces, 2, 3] lowest and highest corners over all `positions` [S, 3], grown by `margin`."""
        starts = [piece.vertices[0] for piece in self.pieces]
        low = np.min([np.minimum.reduceat(x, starts) for x in positions], axis=0)
        high = np.max([np.maximum.reduceat(x, starts) for x in positions], axis=0)
        return np.stack([low - margin, high + margin], axis=1)

    def near(self, *positions: np.ndarray, margin: float) -> list[tuple[int, int]]:
        """Pairs of pieces whose boxes, grown by half the `margin` each, overlap."""
        boxes = self.boxes(*positions, margin=0.5 * margin)
        low, high = boxes[:, 0], boxes[:, 1]
        meet = np.all((low[:, None] <= high[None]) & (low[None] <= high[:, None]), axis=2)
        return [(int(i), int(j)) for i, j in np.argwhere(np.triu(meet, 1))]

    def check_apart(self) -> None:
        """Raise SolverError, naming both, where two bodies overlap at the start."""
        for i, j in self.near(self.rest, margin=0.0):
            first, second = self.pieces[i], self.pieces[j]
            if self._overlap(first, second):
                shift = self._way_out(first, second)
                raise SolverError(
                    f"bodies {first.name!r} and {second.name!r} overlap at the start; move them at least "
                    f"{shift:.3g} m further apart, or turn body_contact off"
                )

    def _overlap(self, first: Piece, second: Piece) -> bool:
        a, b = self.rest[slice(*first.vertices)], self.rest[slice(*second.vertices)]
        faces = np.asfortranarray(np.concatenate([first.faces, second.faces + np.int32(len(a))]))
        mesh = ipctk.CollisionMesh(np.asfortranarray(np.concatenate([a, b])), ipctk.edges(faces), faces)
        mesh.can_collide = ipctk.make_vertex_patches_filter(
            np.repeat(np.array([0, 1], np.int32), [len(a), len(b)])
        )
        if ipctk.has_intersections(mesh, mesh.rest_positions):
            return True
        # One may lie wholly inside the other.
        inside = SurfaceIndex(b, second.faces, winding=True).inside(a[:1])
        return bool(inside[0] or SurfaceIndex(a, first.faces, winding=True).inside(b[:1])[0])

    def _way_out(self, first: Piece, second: Piece) -> float:
        """How far the boxes of two pieces reach into each other along the axis where it is least, m."""
        boxes = self.boxes(self.rest, margin=0.0)
        i, j = self.pieces.index(first), self.pieces.index(second)
        return float(np.minimum(boxes[i, 1] - boxes[j, 0], boxes[j, 1] - boxes[i, 0]).min())


def _owners(model: Model) -> np.ndarray:
    """[P] number of the body each vertex belongs to; of the connected part where the model has no bodies."""
    count = len(model.vertices)
    if model.bodies:
        owner = np.empty(count, np.int64)
        for k, body in enumerate(model.bodies):
            owner[slice(*body.vertex_range)] = k
        return owner
    rows, columns = model.tets[:, [0, 1, 2]].ravel(), model.tets[:, [1, 2, 3]].ravel()
    graph = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(count, count))
    labels = connected_components(graph, directed=False)[1]
    # Numbered over the vertices that tets use: one that none uses is a part of its own.
    used = np.zeros(count, bool)
    used[model.tets] = True
    owner = np.zeros(count, np.int64)
    owner[used] = np.unique(labels[used], return_inverse=True)[1]
    return owner


def clearance(mesh: ipctk.CollisionMesh, x: np.ndarray, reach: float) -> float:
    """Least distance of two elements of `mesh` at x [V, 3] that share no vertex, m, or `reach` if larger."""
    candidates = ipctk.Candidates()
    candidates.build(mesh, x, 0.5 * reach)
    collisions = ipctk.NormalCollisions()
    collisions.build(candidates, mesh, x, reach)
    if collisions.empty():
        return reach
    return min(reach, float(np.sqrt(collisions.compute_minimum_distance(mesh, x))))


def strayed(reference: np.ndarray, *positions: np.ndarray) -> float:
    """Farthest that any point of `positions` [V, 3] lies from the reference moved rigidly, m.

    The turn is the one that fits the first of `positions` best (Kabsch 1976); each has its own shift. Points
    on the straight way between two of them stray no farther.
    """
    arms = reference - reference.mean(axis=0)
    centred = [x - x.mean(axis=0) for x in positions]
    u, _, vt = np.linalg.svd(arms.T @ centred[0])
    flip = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt)) or 1.0])
    turned = arms @ (u @ flip @ vt)
    return float(np.sqrt(max(((x - turned) ** 2).sum(axis=1).max(initial=0.0) for x in centred)))


__all__ = ["Piece", "Surface", "clearance", "strayed"]
