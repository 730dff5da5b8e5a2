"""Learning the vertices of a mesh so that it stays one: smooth steps, no flipped or collapsed triangles."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array, diags_array
from scipy.sparse.linalg import splu

from gdpro_sim.binding import face_normals
from gdpro_sim.meshing.repair import edge_keys

REACH = 0.2
"""Longest step of a vertex over its shortest edge."""

FOLD = 0.5
"""Least cosine between a face's normals before and after a step."""

NARROW = 0.02
"""Area over the squared longest edge below which no face may get narrower; 0.43 for an equilateral one."""

ROUNDS = 10
"""How often vertices are held back before a step is given up."""


class MeshDescent:
    """Steps and regularisers for vertices [V, 3] under `faces` [F, 3] int32, which never change.

    smoothing: lambda of (1 + lambda L)^-1 with the graph Laplacian L, through which gradients and steps go;
               0: neither does. After Nicolet et al., "Large Steps in Inverse Rendering of Geometry" (2021).
    """

    def __init__(self, faces: torch.Tensor, count: int, smoothing: float = 0.0) -> None:
        self.faces, self.count = faces, count
        triangles = faces.cpu().numpy()
        keys, _ = edge_keys(triangles)
        order = np.argsort(keys, kind="stable")
        again = np.flatnonzero(keys[order][1:] == keys[order][:-1])
        halves = np.stack([order[again], order[again + 1]], 1)
        base = int(triangles.max()) + 1
        unique = np.unique(keys)
        edges = np.stack([unique // base, unique % base], 1)
        self._neighbours = torch.from_numpy(halves // 3).to(faces.device)
        self._edges = torch.from_numpy(edges).to(faces.device)
        self._degrees = torch.bincount(self._edges.ravel(), minlength=count)
        self._solver = None
        if smoothing > 0.0:
            ends = np.concatenate([edges, edges[:, ::-1]])
            adjacency = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count))
            laplacian = diags_array(self._degrees.cpu().numpy().astype(np.float64)) - adjacency
            self._solver = splu((diags_array(np.ones(count)) + smoothing * laplacian).tocsc())

    def smooth(self, values: torch.Tensor) -> torch.Tensor:
        """(1 + lambda L)^-1 of values [V, 3]: what is even passes, what differs from neighbours is damped."""
        if self._solver is None:
            return values
        solved = self._solver.solve(values.detach().cpu().numpy().astype(np.float64))
        return torch.from_numpy(solved).to(values)

    @torch.no_grad()
    def moved(self, vertices: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
        """`vertices` after a `step` [V, 3], shortened or left out where it would spoil the mesh.

        No vertex goes farther than REACH times its shortest edge; the corners stay of a face that would turn
        by more than FOLD allows, or be narrower than NARROW and than it was.
        """
        i, j = self._edges.unbind(1)
        lengths = (vertices[i] - vertices[j]).norm(dim=1)
        shortest = torch.full_like(vertices[:, 0], torch.inf)
        for ends in (i, j):
            shortest.scatter_reduce_(0, ends, lengths, "amin")
        limit = torch.where(torch.isfinite(shortest), REACH * shortest, 0.0)
        after = vertices + step * (limit / step.norm(dim=1).clamp(min=1e-30)).clamp(max=1.0)[:, None]
        corners = self.faces.long()
        normals, roundness = _shapes(vertices[corners])
        suspects = torch.arange(len(corners), device=corners.device)
        for _ in range(ROUNDS):
            at = corners[suspects]
            turned, narrow = _shapes(after[at])
            bad = (normals[suspects] * turned).sum(1) < FOLD
            bad |= (narrow < NARROW) & (narrow < roundness[suspects])
            # A face whose corners all stay is as it was.
            bad &= (after[at] != vertices[at]).flatten(1).any(1)
            if not bool(bad.any()):
                return after
            stay = at[bad].ravel()
            after[stay] = vertices[stay]
            held = torch.zeros(self.count, dtype=torch.bool, device=corners.device)
            held[stay] = True
            suspects = torch.nonzero(held[corners].any(1))[:, 0]
        return vertices.clone()

    def normal_consistency(self, vertices: torch.Tensor) -> torch.Tensor:
        """Mean of 1 - cosine between the normals of faces that share an edge."""
        normals = face_normals(vertices, self.faces)
        a, b = self._neighbours.unbind(1)
        return (1.0 - (normals[a] * normals[b]).sum(1)).sum() / max(1, len(a))

    def laplacian(self, vertices: torch.Tensor) -> torch.Tensor:
        """Mean distance of a vertex from the mean of its neighbours (uniform Laplacian)."""
        i, j = self._edges.unbind(1)
        sums = torch.zeros_like(vertices).index_add(0, i, vertices[j]).index_add(0, j, vertices[i])
        joined = self._degrees > 0
        offsets = vertices - sums / self._degrees.clamp(min=1)[:, None]
        return offsets[joined].norm(dim=1).sum() / max(1, int(joined.sum()))


def _shapes(corners: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit normals [F, 3] of triangles [F, 3, 3], and area over the squared longest edge [F]."""
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normals = torch.linalg.cross(ab, ac)
    twice = normals.norm(dim=1)
    squares = torch.stack([ab.square().sum(1), ac.square().sum(1), (ac - ab).square().sum(1)])
    longest = squares.amax(0).clamp(min=1e-30)
    return normals / twice.clamp(min=1e-30)[:, None], 0.5 * twice / longest


__all__ = ["FOLD", "NARROW", "REACH", "MeshDescent"]
