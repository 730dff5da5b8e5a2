"""Readable float64 oracle of `BoundGaussians.gaussians`: each triangle's 3 x 3 affine map in turn."""

from __future__ import annotations

import numpy as np
import torch
from scipy.linalg import polar
from scipy.spatial.transform import Rotation

from gdpro_sim.binding import BoundGaussians, sh_basis
from gdpro_sim.gaussians import Gaussians


def covariances(gaussians: Gaussians) -> np.ndarray:
    """[N, 3, 3] float64 covariance matrices."""
    matrix = Rotation.from_quat(gaussians.quats.double().numpy(), scalar_first=True).as_matrix()
    squares = gaussians.scales.double().numpy() ** 2
    return np.einsum("nij,nj,nkj->nik", matrix, squares, matrix)


def unit(v: np.ndarray) -> np.ndarray:
    return v / np.linalg.norm(v)


def edges_and_normal(corners: np.ndarray) -> np.ndarray:
    """Columns: the two edges from the first corner and the unit normal."""
    a, b, c = corners
    return np.stack([b - a, c - a, unit(np.cross(b - a, c - a))], axis=1)


def follow(bound: BoundGaussians, vertices: object) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means [N, 3], covariances F S F^T [N, 3, 3] and turned SH [N, K, 3] for moved vertices."""
    rest = bound.vertices.double().numpy()
    moved = np.asarray(vertices, dtype=np.float64)
    faces = bound.faces.numpy()
    degree = int(round(bound.sh.shape[1] ** 0.5)) - 1
    directions = np.random.default_rng(1).normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    basis = sh_basis(degree, directions)
    means, covariance, sh = [], [], []
    for i in range(len(bound)):
        face = faces[int(bound.face_ids[i])]
        f = edges_and_normal(moved[face]) @ np.linalg.inv(edges_and_normal(rest[face]))
        a, b, c = rest[face]
        e0, e1 = unit(np.cross(b - a, c - a)), unit(b - a)
        e2 = np.cross(e0, e1)
        x, y = unit(bound.rotations[i].double().numpy())
        r = np.stack([e0, x * e1 + y * e2, -y * e1 + x * e2], axis=1)
        s = np.exp(2.0 * bound.log_scales[i].double().numpy())
        means.append(bound.barycentrics[i].double().numpy() @ moved[face])
        covariance.append(f @ r @ np.diag(s) @ r.T @ f.T)
        turn = polar(f)[0]
        values = sh_basis(degree, directions @ turn) @ bound.sh[i].double().numpy()
        sh.append(np.linalg.lstsq(basis, values, rcond=None)[0])
    return np.array(means), np.array(covariance), np.array(sh)


def bind(
    vertices: torch.Tensor,
    faces: torch.Tensor,
    face_ids: torch.Tensor,
    barycentrics: torch.Tensor,
    rotations: torch.Tensor,
    log_scales: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means [N, 3], rotation matrices [N, 3, 3] and scales [N, 3] at rest, for torch's autograd."""
    corners = vertices[faces.long()][face_ids.long()]
    normalize = torch.nn.functional.normalize
    e1 = normalize(corners[:, 1] - corners[:, 0], dim=1)
    e0 = normalize(torch.linalg.cross(e1, corners[:, 2] - corners[:, 0]), dim=1)
    e2 = torch.linalg.cross(e0, e1)
    x, y = normalize(rotations, dim=1).split(1, dim=1)
    rotation = torch.stack([e0, x * e1 + y * e2, x * e2 - y * e1], dim=2)
    return (corners * barycentrics[:, :, None]).sum(1), rotation, log_scales.exp()
