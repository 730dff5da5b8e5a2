"""Steps of a learning mesh: what smoothing passes, what is held back, and the two regularisers."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from gdpro_sim.binding import face_normals
from gdpro_sim.generation.mesh_descent import FOLD, REACH, MeshDescent
from tests.meshing.shapes import cube, sheet, sphere


def tensors(mesh: tuple[np.ndarray, np.ndarray]) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(mesh[0]), torch.from_numpy(mesh[1])


def test_smoothing_solves_its_equation_and_passes_what_is_even() -> None:
    vertices, faces = tensors(sphere(1))
    count = len(vertices)
    adjacency = np.zeros((count, count))
    for a, b, c in faces.tolist():
        for i, j in ((a, b), (b, c), (c, a)):
            adjacency[i, j] = adjacency[j, i] = 1.0
    matrix = np.eye(count) + 7.0 * (np.diag(adjacency.sum(1)) - adjacency)
    descent = MeshDescent(faces, count, 7.0)
    values = torch.randn(count, 3, generator=torch.Generator().manual_seed(0))
    smooth = descent.smooth(values)
    np.testing.assert_allclose(matrix @ smooth.double().numpy(), values.numpy(), atol=1e-5)
    even = torch.ones(count, 3)
    torch.testing.assert_close(descent.smooth(even), even)
    assert torch.equal(MeshDescent(faces, count).smooth(values), values)


def test_a_step_within_bounds_is_taken_whole() -> None:
    vertices, faces = tensors(sphere(2))
    step = 0.01 * torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0))
    moved = MeshDescent(faces, len(vertices)).moved(vertices, step)
    torch.testing.assert_close(moved, vertices + step)


def test_a_long_step_ends_at_a_share_of_the_shortest_edge() -> None:
    vertices, faces = tensors(cube())
    moved = MeshDescent(faces, len(vertices)).moved(vertices, torch.tensor([[3.0, 0.0, 4.0]]).repeat(8, 1))
    torch.testing.assert_close(moved - vertices, REACH * torch.tensor([[0.6, 0.0, 0.8]]).repeat(8, 1))


@pytest.mark.parametrize("seed", range(3))
def test_no_step_turns_a_face_over(seed: int) -> None:
    vertices, faces = tensors(sphere(2))
    descent, g = MeshDescent(faces, len(vertices)), torch.Generator().manual_seed(seed)
    for _ in range(15):
        before = face_normals(vertices, faces)
        vertices = descent.moved(vertices, torch.randn(vertices.shape, generator=g))
        assert float((before * face_normals(vertices, faces)).sum(1).min()) >= FOLD
        assert torch.isfinite(vertices).all()


def test_a_narrow_face_gets_no_narrower_but_may_recover() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0.5, 0.015, 0]])
    descent = MeshDescent(torch.tensor([[0, 1, 2]], dtype=torch.int32), 3)
    down = torch.tensor([[0.0, 0, 0], [0, 0, 0], [0, -0.01, 0]])
    assert torch.equal(descent.moved(vertices, down), vertices)
    torch.testing.assert_close(descent.moved(vertices, -down), vertices - down)


def test_regularisers_on_shapes_with_known_values() -> None:
    vertices, faces = tensors(cube())
    # of 18 edges 12 have a right angle between their faces, 6 lie in a flat side
    assert float(MeshDescent(faces, 8).normal_consistency(vertices)) == pytest.approx(12 / 18)
    vertices, faces = tensors(sheet(4))
    descent = MeshDescent(faces, len(vertices))
    assert float(descent.normal_consistency(vertices)) == pytest.approx(0.0, abs=1e-6)
    inner = ((vertices[:, :2] > 0.01) & (vertices[:, :2] < 0.99)).all(1)
    bumped = vertices.clone()
    bumped[inner.nonzero()[4, 0], 2] += 0.1
    assert float(descent.laplacian(bumped)) > float(descent.laplacian(vertices))
    bumped.requires_grad_()
    descent.laplacian(bumped).backward()
    assert torch.isfinite(bumped.grad).all()
