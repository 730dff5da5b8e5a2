"""Convex pieces, primitives and mass properties."""

from __future__ import annotations

import numpy as np
import pytest

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.convex import PRIMITIVES, decompose, fit_primitive, mass_properties
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.simulation.verification.models import tet_box


def l_shape() -> tuple[np.ndarray, np.ndarray]:
    """Two bars at a right angle: 0.3 x 0.1 x 0.1 m each, sharing a cube. Vertices, outward faces."""
    vertices, tets = tet_box((3, 3, 1), (0.3, 0.3, 0.1))
    middle = vertices[tets].mean(axis=1)
    return vertices, boundary(tets[(middle[:, 0] < 0.1) | (middle[:, 1] < 0.1)])[0]


def test_an_l_is_two_boxes_and_the_same_ones_each_time() -> None:
    vertices, faces = l_shape()
    pieces = decompose(vertices, faces)
    again = decompose(vertices, faces)
    assert len(pieces) == 2
    assert np.array_equal(pieces.vertices, again.vertices) and np.array_equal(pieces.counts, again.counts)
    volumes = [mass_properties(v, f).volume for v, f in pieces]
    assert sum(volumes) == pytest.approx(0.005, rel=0.02)
    np.testing.assert_array_equal(pieces.scaled(2.0).vertices, 2.0 * pieces.vertices)


def test_one_piece_is_the_hull() -> None:
    pieces = decompose(*l_shape(), most=1)
    assert len(pieces) == 1
    ((vertices, faces),) = list(pieces)
    assert mass_properties(vertices, faces).volume == pytest.approx(0.1 * (0.09 - 0.02), rel=1e-5)


def test_bad_meshes_are_refused() -> None:
    vertices, faces = l_shape()
    with pytest.raises(MeshError, match="not closed"):
        mass_properties(vertices, faces[1:])
    with pytest.raises(MeshError, match="not closed"):
        mass_properties(vertices, faces[:, ::-1])
    with pytest.raises(MeshError, match="flat"):
        decompose(vertices * [1, 1, 0], faces, most=1)
    with pytest.raises(MeshError, match="threshold"):
        decompose(vertices, faces, threshold=0.0)


@pytest.mark.parametrize("kind", PRIMITIVES)
def test_primitives_keep_centre_and_a_long_axis(kind: str) -> None:
    vertices, tets = tet_box((4, 1, 1), (0.8, 0.2, 0.2), (1.0, 2.0, 3.0))
    fit = fit_primitive(kind, mass_properties(vertices, boundary(tets)[0]))  # type: ignore[arg-type]
    np.testing.assert_allclose(fit.position, [1.4, 2.1, 3.1], atol=1e-12)
    np.testing.assert_allclose(fit.rotation @ fit.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(fit.rotation) == pytest.approx(1.0)
    if kind in ("capsule", "cylinder"):
        assert abs(fit.rotation[0, 2]) == pytest.approx(1.0)
        assert fit.size[1] > 2.0 * fit.size[0]
