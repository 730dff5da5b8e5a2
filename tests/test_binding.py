"""Bound Gaussians follow their mesh: rest, rigid motion, affine maps, harmonics, degenerate triangles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gdpro_sim.binding import BoundGaussians, TriangleBinding, sh_basis, vertex_normals
from gdpro_sim.device import set_thread_count, thread_count
from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import rotation_matrices
from tests.reference.binding import bind, covariances, follow


def make_bound(seed: int = 0, faces: int = 40, per_face: int = 3, degree: int = 0) -> BoundGaussians:
    """Random, unconnected triangles with random Gaussians on them."""
    rng = np.random.default_rng(seed)
    n = faces * per_face
    weights = rng.dirichlet((2.0, 2.0, 2.0), n)
    as_tensor = lambda a, t=torch.float32: torch.tensor(np.asarray(a), dtype=t)  # noqa: E731
    return BoundGaussians(
        vertices=as_tensor(rng.normal(size=(3 * faces, 3))),
        faces=as_tensor(np.arange(3 * faces).reshape(-1, 3), torch.int32),
        face_ids=as_tensor(np.repeat(np.arange(faces), per_face), torch.int32),
        barycentrics=as_tensor(weights),
        rotations=as_tensor(rng.normal(size=(n, 2))),
        log_scales=as_tensor(rng.uniform(-4.0, -1.0, size=(n, 3))),
        opacity_logits=as_tensor(rng.normal(size=n)),
        sh=as_tensor(rng.normal(size=(n, (degree + 1) ** 2, 3))),
    )


def test_rest_vertices_give_the_rest_gaussians_bit_for_bit() -> None:
    bound = make_bound(degree=3)
    rest, again = bound.gaussians(), bound.gaussians(bound.vertices.clone())
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert torch.equal(getattr(rest, name), getattr(again, name)), name
    assert torch.equal(rest.sh, bound.sh)
    torch.testing.assert_close(rest.scales, bound.log_scales.exp())


@pytest.mark.parametrize("seed", range(4))
def test_matches_the_float64_reference_on_random_deformations(seed: int) -> None:
    bound = make_bound(seed, degree=2)
    moved = bound.vertices + 0.4 * torch.randn(
        bound.vertices.shape, generator=torch.Generator().manual_seed(seed)
    )
    got = bound.gaussians(moved)
    means, covariance, sh = follow(bound, moved)
    np.testing.assert_allclose(got.means.numpy(), means, atol=2e-6)
    size = np.linalg.norm(covariance, axis=(1, 2), keepdims=True)
    error = np.abs(covariances(got) - covariance) / size
    assert (
        np.quantile(error, 0.99) < 1e-4 and error.max() < 1e-2
    )  # the tail: nearly flat triangles in float32
    error = np.abs(got.sh.numpy() - sh)
    assert np.quantile(error, 0.99) < 1e-3


def test_rigid_motion_moves_every_gaussian_rigidly() -> None:
    bound = make_bound(1, degree=3)
    turn = Rotation.from_euler("xyz", [40, -75, 160], degrees=True)
    shift = np.array([0.3, -2.0, 1.0])
    moved = torch.tensor(turn.apply(bound.vertices.numpy()) + shift, dtype=torch.float32)
    rest, got = bound.gaussians(), bound.gaussians(moved)
    np.testing.assert_allclose(got.means.numpy(), turn.apply(rest.means.numpy()) + shift, atol=3e-6)
    matrix = turn.as_matrix()
    expected = matrix @ covariances(rest) @ matrix.T
    np.testing.assert_allclose(covariances(got), expected, atol=2e-6)
    torch.testing.assert_close(got.scales, rest.scales, rtol=2e-4, atol=0.0)
    # The radiance seen along a turned direction is the radiance seen along the direction before.
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before = np.einsum("mk,nkc->nmc", sh_basis(3, directions), rest.sh.numpy())
    after = np.einsum("mk,nkc->nmc", sh_basis(3, turn.apply(directions)), got.sh.numpy())
    np.testing.assert_allclose(after, before, atol=2e-4)


def test_a_stretched_triangle_stretches_its_gaussians() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    bound = BoundGaussians(
        vertices,
        torch.tensor([[0, 1, 2]], dtype=torch.int32),
        torch.zeros(1, dtype=torch.int32),
        torch.full((1, 3), 1 / 3),
        torch.tensor([[1.0, 0.0]]),
        torch.log(torch.tensor([[0.01, 0.1, 0.2]])),
        torch.zeros(1),
        torch.zeros((1, 1, 3)),
    )
    moved = vertices * torch.tensor([3.0, 0.5, 1.0])
    got = bound.gaussians(moved)
    torch.testing.assert_close(got.scales, torch.tensor([[0.01, 0.3, 0.1]]))
    sheared = vertices.clone()
    sheared[2, 0] = 1.0  # F = [[1, 1], [0, 1]]
    expected = np.diag([0.0, 0.0, 0.01**2])
    f = np.array([[1.0, 1.0], [0.0, 1.0]])
    expected[:2, :2] = f @ np.diag([0.01, 0.04]) @ f.T
    np.testing.assert_allclose(covariances(bound.gaussians(sheared))[0], expected, atol=1e-7)


def test_axes_do_not_jump_between_frames() -> None:
    bound = make_bound(2)
    drift = torch.randn(bound.vertices.shape, generator=torch.Generator().manual_seed(5))
    previous = bound.gaussians(bound.vertices + 1e-6 * drift)
    jumps = 0
    for step in range(1, 100):
        current = bound.gaussians(bound.vertices + 1e-3 * step * drift)
        cosine = (current.quats * previous.quats).sum(1).abs()
        jumps += int((cosine < 0.98).sum())
        previous = current
    # A triangle that nearly collapses on its way may turn fast; swapped axes would show in every frame.
    assert jumps <= 6, f"{jumps} of {99 * len(bound)}"


def test_collapsed_and_empty_inputs_stay_finite() -> None:
    bound = make_bound(3, degree=1)
    moved = bound.vertices.clone()
    moved[0:3] = 1.0
    moved[3:6, 1:] = 0.0
    got = bound.gaussians(moved)
    for tensor in (got.means, got.quats, got.scales, got.sh):
        assert torch.isfinite(tensor).all()
    empty = make_bound(0, faces=0)
    assert len(empty.gaussians()) == 0


def test_thread_count_does_not_change_a_bit() -> None:
    bound = make_bound(4, faces=8000, degree=1)
    moved = bound.vertices * 1.3
    before = thread_count()
    try:
        results = []
        for threads in (1, 2, 5):
            set_thread_count(threads)
            results.append(bound.gaussians(moved))
    finally:
        set_thread_count(before)
    for other in results[1:]:
        for name in ("means", "quats", "scales", "sh"):
            assert torch.equal(getattr(results[0], name), getattr(other, name)), name


def test_wrong_vertices_are_refused() -> None:
    bound = make_bound()
    with pytest.raises(AssetError, match=r"float32 \[120, 3\]"):
        bound.gaussians(bound.vertices[:-1])
    with pytest.raises(AssetError, match="float64"):
        bound.gaussians(bound.vertices.double())
    with pytest.raises(AssetError, match="scale must be"):
        bound.scaled(0.0)


def test_scaled_resizes_thickness_too() -> None:
    bound = make_bound()
    big = bound.scaled(2.0).gaussians()
    torch.testing.assert_close(big.scales, 2.0 * bound.gaussians().scales)
    torch.testing.assert_close(big.means, 2.0 * bound.gaussians().means)


def test_vertex_normals_point_out_of_a_tetrahedron() -> None:
    vertices = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    faces = torch.tensor([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], dtype=torch.int32)
    normals = vertex_normals(vertices, faces)
    assert ((normals * (vertices - vertices.mean(0))).sum(1) > 0).all()


def test_normals_are_smooth_on_a_ball_and_sharp_on_a_cube() -> None:
    for mesh in (trimesh.creation.icosphere(subdivisions=3), trimesh.creation.box().subdivide().subdivide()):
        n = len(mesh.faces)
        weights = torch.tensor([[0.6, 0.3, 0.1]]).repeat(n, 1)
        bound = BoundGaussians(
            torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32),
            torch.tensor(np.asarray(mesh.faces), dtype=torch.int32),
            torch.arange(n, dtype=torch.int32),
            weights,
            torch.tensor([[1.0, 0.0]]).repeat(n, 1),
            torch.zeros((n, 3)),
            torch.zeros(n),
            torch.zeros((n, 1, 3)),
        )
        points = bound.gaussians().means
        if n > 1000:
            expected = torch.nn.functional.normalize(points, dim=1)
        else:  # the face of the cube that a point lies on
            axis = points.abs().argmax(dim=1)
            expected = torch.nn.functional.one_hot(axis, 3) * points.gather(1, axis[:, None]).sign()
        assert (bound.normals() * expected).sum(1).min() > 0.999


def test_learnable_binding_gives_the_bits_of_the_asset() -> None:
    bound = make_bound(3)
    shuffled = torch.randperm(len(bound), generator=torch.Generator().manual_seed(0))
    bound = replace(bound, face_ids=bound.face_ids[shuffled])
    binding = TriangleBinding(bound.faces, bound.face_ids, bound.barycentrics, len(bound.vertices))
    means, quats, scales = binding(bound.vertices, bound.rotations, bound.log_scales)
    rest = bound.gaussians()
    assert torch.equal(means, rest.means)
    assert torch.equal(quats, rest.quats)
    assert torch.equal(scales, rest.scales)


@pytest.mark.parametrize("seed", range(3))
def test_gradients_of_the_binding_match_the_reference(seed: int) -> None:
    """Shared vertices, face ids in any order; the loss reads rotations, not quaternions' signs."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    g = torch.Generator().manual_seed(seed)
    vertices = torch.tensor(mesh.vertices).float() + 0.1 * torch.randn(len(mesh.vertices), 3, generator=g)
    faces = torch.tensor(mesh.faces, dtype=torch.int32)
    n = 3 * len(faces)
    face_ids = (torch.arange(n) // 3)[torch.randperm(n, generator=g)].int()
    weights = torch.rand(n, 3, generator=g)
    weights /= weights.sum(1, keepdim=True)
    rotations, log_scales = torch.randn(n, 2, generator=g), torch.randn(n, 3, generator=g)
    factors = [
        torch.randn(n, 3, generator=g),
        torch.randn(n, 3, 3, generator=g),
        torch.randn(n, 3, generator=g),
    ]

    inputs = [t.clone().requires_grad_() for t in (vertices, rotations, log_scales)]
    means, quats, scales = TriangleBinding(faces, face_ids, weights, len(vertices))(*inputs)
    got = sum((a * b).sum() for a, b in zip((means, rotation_matrices(quats), scales), factors, strict=True))
    got.backward()

    wanted = [t.double().requires_grad_() for t in (vertices, rotations, log_scales)]
    rest = bind(wanted[0], faces, face_ids, weights.double(), wanted[1], wanted[2])
    total = sum((a * b.double()).sum() for a, b in zip(rest, factors, strict=True))
    total.backward()
    torch.testing.assert_close(got.double(), total, rtol=1e-4, atol=1e-4)
    for a, b in zip(inputs, wanted, strict=True):
        scale = float(b.grad.abs().max())
        torch.testing.assert_close(a.grad.double(), b.grad, rtol=1e-3, atol=1e-5 * scale)


def test_a_triangle_without_area_gives_finite_gradients() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 1, 1]], dtype=torch.int32)
    inputs = [
        torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]).requires_grad_(),
        torch.tensor([[1.0, 0.0], [0.0, 0.0]]).requires_grad_(),
        torch.zeros(2, 3).requires_grad_(),
    ]
    binding = TriangleBinding(faces, torch.arange(2, dtype=torch.int32), torch.full((2, 3), 1 / 3), 3)
    sum((part * torch.arange(part.numel()).view_as(part)).sum() for part in binding(*inputs)).backward()
    assert all(torch.isfinite(t.grad).all() for t in inputs)
