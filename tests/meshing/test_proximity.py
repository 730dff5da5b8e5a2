"""Rays against a mesh, compared with the plane equation."""

from __future__ import annotations

import numpy as np

from gdpro_sim.meshing.proximity import SurfaceIndex

SQUARE = np.asarray([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 1], [2, 0, 1], [2, 2, 1]], np.float64)
FACES = np.asarray([[0, 1, 2], [0, 2, 3], [4, 5, 6]], np.int32)


def test_first_hit_is_the_nearest_from_either_side() -> None:
    index = SurfaceIndex(SQUARE, FACES)
    origins = np.asarray([[1.5, 0.5, 3.0], [1.5, 0.5, -3.0], [0.5, 1.5, 3.0], [5.0, 0.0, 3.0]])
    directions = np.asarray([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]])
    faces, barycentrics = index.first_hit(origins, directions)
    assert faces.tolist() == [2, 0, 1, -1]
    points = np.einsum("nc,ncd->nd", barycentrics[:3], SQUARE[FACES[faces[:3]]])
    np.testing.assert_allclose(points[:, :2], origins[:3, :2], atol=1e-6)


def test_slanted_rays_keep_precision_far_from_the_origin() -> None:
    rng = np.random.default_rng(0)
    shift = np.asarray([1e4, -2e4, 5e3])
    index = SurfaceIndex(SQUARE[:4] + shift, FACES[:2])
    targets = np.column_stack([rng.uniform(0.1, 1.9, (200, 2)), np.zeros(200)])
    origins = targets + rng.uniform(-1.0, 1.0, (200, 3)) + [0.0, 0.0, 2.0]
    faces, barycentrics = index.first_hit(origins + shift, targets - origins)
    assert (faces >= 0).all()
    points = np.einsum("nc,ncd->nd", barycentrics, SQUARE[FACES[faces]])
    np.testing.assert_allclose(points, targets, atol=1e-5)
