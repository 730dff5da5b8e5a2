"""Surfaces that follow particles: exact where matter is, and nothing across gaps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
import warp as wp
from scipy.spatial.transform import Rotation

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.asset.from_splats import bind_splats
from gdpro_sim.binding import BoundGaussians, sh_basis
from gdpro_sim.device import set_thread_count, thread_count
from gdpro_sim.errors import AssetError, MeshError, SolverError
from gdpro_sim.gaussians import Gaussians, rotation_matrices
from gdpro_sim.io.preview import Renderer, Studio, frame_camera
from gdpro_sim.kernels.mpm_look import bound_deformations
from gdpro_sim.meshing.fill import Filling, fill_mesh
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.simulation.mpm.look import NEEDLE, Look, Unwelded, anisotropies, unweld
from tests.reference.look import blend, bounded

STRETCH, ANISOTROPY = 4.0, 2.5


def bar() -> tuple[BoundGaussians, Filling]:
    """1 x 0.2 x 0.2 m along X, red on the left and blue on the right."""
    mesh = trimesh.creation.box((1.0, 0.2, 0.2)).subdivide_to_size(0.06)
    bound = bind_mesh(SurfaceMesh.from_arrays(mesh.vertices, mesh.faces), budget=4000)
    sh = torch.zeros_like(bound.sh)
    right = bound.gaussians().means[:, 0] > 0.0
    sh[right, 0, 2], sh[~right, 0, 0] = 1.0, 1.0
    bound = replace(bound, sh=sh)
    return bound, fill_mesh(bound.vertices.numpy(), bound.faces.numpy(), 0.033)


@pytest.fixture(scope="module")
def torn() -> tuple[BoundGaussians, Filling, Unwelded]:
    bound, filling = bar()
    return bound, filling, unweld(bound, filling)


def identity(count: int) -> np.ndarray:
    return np.tile(np.eye(3, dtype=np.float32), (count, 1, 1))


def covariances(g: Gaussians) -> np.ndarray:
    axes = rotation_matrices(g.quats.double())
    return (axes @ torch.diag_embed(g.scales.double() ** 2) @ axes.transpose(1, 2)).numpy()


def elongation(g: Gaussians) -> np.ndarray:
    """Longest over middle axis: what makes a needle."""
    scales = g.scales.sort(1).values
    return (scales[:, 2] / scales[:, 1]).numpy()


def looks(torn: tuple[BoundGaussians, Filling, Unwelded]) -> tuple[tuple[Look, np.ndarray], ...]:
    """Whole and in patches, each with its rest surface."""
    bound, filling, parts = torn
    whole, cut = bound.vertices.numpy(), parts.gaussians.vertices.numpy()
    return (Look(whole, filling.points), whole), (
        Look(cut, filling.points, patches=parts.patches),
        cut,
    )


def test_rest_is_exact_to_the_bit(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    points = torn[1].points
    for look, rest in looks(torn):
        assert look.surface(points, identity(len(points))).tobytes() == rest.tobytes()


def test_affine_motion_is_exact(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    points = torn[1].points
    turn = Rotation.from_euler("xyz", [40, -70, 110], degrees=True).as_matrix()
    a = turn @ np.array([[1.3, 0.2, 0.0], [0.0, 0.9, 0.1], [0.0, 0.0, 1.1]])
    shift = np.array([0.5, -2.0, 1.0])
    moved = (points @ a.T + shift).astype(np.float32)
    for look, rest in looks(torn):
        surface = look.surface(moved, np.tile(a.astype(np.float32), (len(points), 1, 1)))
        np.testing.assert_allclose(surface, rest @ a.T + shift, atol=2e-6)


def test_a_whole_surface_equals_the_reference(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    points = torn[1].points
    rng = np.random.default_rng(0)
    moved = (points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32)
    f = (np.eye(3) + rng.normal(0.0, 0.1, (len(points), 3, 3))).astype(np.float32)
    look, rest = looks(torn)[0]
    surface = look.surface(moved, f)
    for v in range(0, len(rest), 37):
        expected = blend(rest[v].astype(float), points.astype(float), moved.astype(float), f.astype(float))
        np.testing.assert_allclose(surface[v], expected, atol=1e-5)


def test_bounds_equal_the_reference() -> None:
    rng = np.random.default_rng(1)
    f = rng.normal(0.0, 1.0, (300, 3, 3)) * np.exp(rng.normal(0.0, 2.0, (300, 1, 1)))
    f[:100] = np.eye(3) + rng.normal(0.0, 0.3, (100, 3, 3))
    f[100] = np.nan
    f[101] = np.diag([9.0, 9.0, 0.01])
    f[102] = np.diag([9.0, 1.0, 1.0])
    f[103] = 0.0
    given = f.astype(np.float32)
    out = wp.empty(len(f), dtype=wp.mat33, device="cpu")
    wp.launch(
        bound_deformations,
        len(f),
        inputs=[0, wp.array(given, dtype=wp.mat33, device="cpu"), STRETCH, ANISOTROPY],
        outputs=[out],
        device="cpu",
    )
    result = out.numpy() + np.eye(3)
    for k in range(len(f)):
        if k == 103:
            continue
        np.testing.assert_allclose(
            result[k], bounded(given[k].astype(float), STRETCH, ANISOTROPY), atol=2e-4, err_msg=str(k)
        )
    np.testing.assert_array_equal(result[100], np.eye(3))
    np.testing.assert_array_equal(result[103], np.eye(3))
    np.testing.assert_allclose(result[101], np.diag([4.0, 4.0, 1.6]), atol=1e-6)
    np.testing.assert_allclose(result[102], np.diag([2.5, 1.0, 1.0]), atol=1e-6)
    values = np.linalg.svd(result, compute_uv=False)
    assert values.max() <= STRETCH * (1 + 1e-5) and values.min() >= (1 - 1e-5) / STRETCH
    assert (values[:, 0] / values[:, 2]).max() <= ANISOTROPY * (1 + 1e-5)
    assert (np.linalg.det(result) > 0.0).all()


def pulled(filling: Filling, gap: float) -> tuple[np.ndarray, np.ndarray]:
    """The bar torn at its middle: the right half moves off and turns; gradients near the tear run wild."""
    x = filling.points.astype(np.float64)
    right = x[:, 0] > 0.0
    turn = Rotation.from_euler("z", 20, degrees=True).as_matrix()
    moved, f = x.copy(), np.tile(np.eye(3), (len(x), 1, 1))
    moved[right] = x[right] @ turn.T + [gap, 0, 0]
    f[right] = turn
    wild = 1.0 + 30.0 * np.exp(-((x[:, 0] / 0.04) ** 2))
    return moved.astype(np.float32), (f * wild[:, None, None] ** [1.0, -0.5, -0.5]).astype(np.float32)


def test_a_torn_bar_has_no_needles_and_nothing_spans_the_gap(
    torn: tuple[BoundGaussians, Filling, Unwelded],
) -> None:
    bound, filling, parts = torn
    gap = 0.5
    cut = parts.gaussians
    surface = looks(torn)[1][0].surface(*pulled(filling, gap))
    now = cut.gaussians(torch.from_numpy(surface))
    assert (elongation(now) / elongation(cut.gaussians())).max() <= ANISOTROPY * 1.001
    faces = cut.faces.numpy()
    edges = np.linalg.norm(surface[faces] - surface[np.roll(faces, 1, axis=1)], axis=2)
    rest = cut.vertices.numpy()
    before = np.linalg.norm(rest[faces] - rest[np.roll(faces, 1, axis=1)], axis=2)
    assert (edges / before).max() <= STRETCH
    middle = np.abs(surface[:, 0] - 0.5 * gap) < 0.1
    assert not middle.any(), "the gap's middle is empty"
    # The welded mesh spans it, and PhysGaussian's F S F^T is a needle there: this is what the cut is for.
    whole = looks(torn)[0][0].surface(*pulled(filling, gap))
    assert (np.abs(whole[bound.faces.numpy()] - whole[np.roll(bound.faces.numpy(), 1, axis=1)])).max() > 0.3
    _, f = pulled(filling, gap)
    assert np.linalg.cond(f).max() > 50.0


def test_what_is_long_at_rest_is_not_pulled_to_a_needle(
    torn: tuple[BoundGaussians, Filling, Unwelded],
) -> None:
    """However long the mesh's Gaussians are: longer than `NEEDLE` only as they were."""
    _, filling, parts = torn
    long = parts.gaussians.log_scales.clone()
    long[::7, 1] += 1.0
    cut = replace(parts.gaussians, log_scales=long)
    most = anisotropies(cut, parts.patches)
    assert most.min() == 1.0 and most.max() == ANISOTROPY
    look = Look(cut.vertices.numpy(), filling.points, patches=parts.patches, anisotropy=most)
    now = cut.gaussians(torch.from_numpy(look.surface(*pulled(filling, 0.5))))
    before = elongation(cut.gaussians())
    assert (elongation(now) / np.maximum(before, NEEDLE)).max() <= 1.02
    assert before.max() > NEEDLE and (elongation(now) / before).max() > 1.5
    at_rest = look.surface(filling.points, identity(len(filling)))
    assert at_rest.tobytes() == cut.vertices.numpy().tobytes()


def test_a_tear_opens_without_a_jump(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    _, filling, _ = torn
    look, _ = looks(torn)[1]
    x = filling.points
    before = None
    for gap in np.linspace(0.0, 0.1, 201):
        moved = x.copy()
        moved[x[:, 0] > 0.0, 0] += np.float32(gap)
        surface = look.surface(moved, identity(len(x)))
        if before is not None:
            assert np.abs(surface - before).max() < 10 * 0.1 / 200
        before = surface


def test_unwelding_keeps_every_gaussian(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    bound, _, parts = torn
    before, after = bound.gaussians(), parts.gaussians.gaussians()
    n = len(bound)
    assert len(parts.gaussians.faces) > len(bound.faces) + parts.grains, "long triangles were split"
    np.testing.assert_allclose(after.means[:n], before.means, atol=1e-7)
    assert torch.equal(after.scales[:n], before.scales) and torch.equal(after.sh[:n], before.sh)
    same = covariances(before)
    np.testing.assert_allclose(covariances(after)[:n], same, atol=1e-5 * np.abs(same).max())
    grains = after.means[n:].numpy()
    assert parts.grains == len(grains) > 100
    depth = np.minimum(0.1 - np.abs(grains[:, 1:]).max(1), 0.5 - np.abs(grains[:, 0]))
    assert (depth >= 2.99 * after.scales[n:, 0].numpy()).all(), "no grain shows at rest"
    # Interior colours are those of the surface around them.
    left = grains[:, 0] < -0.1
    assert (after.sh[n:, 0, 0].numpy()[left] > 0.9).all() and (after.sh[n:, 0, 2].numpy()[left] < 0.1).all()
    assert (np.diff(parts.patches) >= 0).all() and len(parts.patches) == len(parts.gaussians.vertices)


def test_short_triangles_are_left_alone() -> None:
    bound, _ = bar()
    coarse = fill_mesh(bound.vertices.numpy(), bound.faces.numpy(), 0.08)
    parts = unweld(bound, coarse, grains=10, vertex_colors=np.ones((len(bound.vertices), 3), np.float32))
    n = len(bound)
    assert torch.equal(parts.gaussians.gaussians().means[:n], bound.gaussians().means)
    assert torch.equal(parts.gaussians.rotations[:n], bound.rotations)
    assert parts.grains <= 30, "grains are few when few are asked for"
    assert parts.vertex_colors is not None and parts.vertex_colors.shape == parts.gaussians.vertices.shape


def test_rest_looks_as_before(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    bound, _, parts = torn
    camera = frame_camera((-0.6, -0.6, -0.6), (0.6, 0.6, 0.6), azimuth=40, elevation=20, fov=35,
                          width=160, height=120)  # fmt: skip
    renderer = Renderer(camera, Studio(ground=-0.1))
    pictures = [renderer.render(b.gaussians(), b.normals()).astype(float) for b in (bound, parts.gaussians)]
    error = np.mean((pictures[0] - pictures[1]) ** 2)
    assert 10.0 * np.log10(255.0**2 / max(error, 1e-12)) > 50.0


def test_a_patch_turns_covariance_and_colour(torn: tuple[BoundGaussians, Filling, Unwelded]) -> None:
    bound, filling, _ = torn
    rng = np.random.default_rng(2)
    sh = torch.from_numpy(rng.normal(size=(len(bound), 9, 3)).astype(np.float32))
    parts = unweld(replace(bound, sh=sh), filling)
    cut = parts.gaussians
    turn = Rotation.from_euler("xyz", [30, 50, -80], degrees=True).as_matrix()
    look = Look(cut.vertices.numpy(), filling.points, patches=parts.patches)
    f = np.tile(turn.astype(np.float32), (len(filling), 1, 1))
    now = cut.gaussians(torch.from_numpy(look.surface((filling.points @ turn.T).astype(np.float32), f)))
    rest = cut.gaussians()
    expected = turn @ covariances(rest) @ turn.T
    np.testing.assert_allclose(covariances(now), expected, atol=1e-4 * np.abs(expected).max())
    directions = rng.normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = np.einsum("dk,nkc->ndc", sh_basis(2, directions), now.sh.double().numpy())
    seen_before = np.einsum("dk,nkc->ndc", sh_basis(2, directions @ turn), rest.sh.double().numpy())
    np.testing.assert_allclose(seen, seen_before, atol=2e-3)
    # Stretch within the triangle's plane is F S F^T there; bars along X lie in every face they touch.
    stretch = np.diag([1.8, 1.0, 1.0])
    f = np.tile(stretch.astype(np.float32), (len(filling), 1, 1))
    now = cut.gaussians(torch.from_numpy(look.surface((filling.points @ stretch).astype(np.float32), f)))
    side = np.abs(rest.means[: len(bound), 0].numpy()) < 0.45
    expected = (stretch @ covariances(rest) @ stretch.T)[: len(bound)][side]
    np.testing.assert_allclose(covariances(now)[: len(bound)][side], expected, atol=1e-4 * expected.max())


def test_any_number_of_threads_gives_the_same_bytes(
    torn: tuple[BoundGaussians, Filling, Unwelded],
) -> None:
    _, filling, _ = torn
    rng = np.random.default_rng(3)
    repeat = 4
    points = np.concatenate([filling.points + 2 * k for k in range(repeat)]).astype(np.float32)
    moved = (points + rng.normal(0, 0.01, points.shape)).astype(np.float32)
    f = (np.eye(3) + rng.normal(0, 0.5, (len(points), 3, 3))).astype(np.float32)
    before = thread_count()
    results: list[bytes] = []
    try:
        for threads in (1, 2, 5):
            set_thread_count(threads)
            for _, rest in looks(torn):
                surface = np.concatenate([rest + 2 * k for k in range(repeat)]).astype(np.float32)
                patches = np.arange(len(surface), dtype=np.int32) // 3
                results.append(Look(surface, points).surface(moved, f).tobytes())
                results.append(Look(surface, points, patches=patches).surface(moved, f).tobytes())
    finally:
        set_thread_count(before)
    assert results[:4] == results[4:8] == results[8:]


def test_one_particle_carries_a_surface() -> None:
    corners = np.eye(3, dtype=np.float32)
    point = np.zeros((1, 3), np.float32)
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix().astype(np.float32)[None]
    for patches in (None, np.zeros(3, np.int32)):
        surface = Look(corners, point, patches=patches).surface(point + 1.0, turn)
        np.testing.assert_allclose(surface, corners @ turn[0].T + 1.0, atol=1e-6)


def test_wrong_arguments_are_refused() -> None:
    corners, point = np.eye(3, dtype=np.float32), np.zeros((2, 3), np.float32)
    with pytest.raises(SolverError, match="no particle"):
        Look(corners, point[:0])
    with pytest.raises(SolverError, match="must be >= 1, got"):
        Look(corners, point, stretch=0.5)
    with pytest.raises(SolverError, match="ascending"):
        Look(corners, point, patches=np.array([1, 0, 0]))
    with pytest.raises(SolverError, match="over 2 particles"):
        Look(corners, point).surface(point[:1], identity(1))
    bound, _ = bar()
    crumbs = Filling(point, np.full(2, 1e-12, np.float32))
    with pytest.raises(MeshError, match=r"particles 0\.0001 m apart would cut .* 1,000,000 triangles"):
        unweld(bound, crumbs)


def test_a_cloud_keeps_its_gaussians() -> None:
    rng = np.random.default_rng(4)
    n = 300
    cloud = Gaussians(
        torch.from_numpy(rng.normal(size=(n, 3)).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(n, 4)).astype(np.float32)),
        torch.from_numpy(np.exp(rng.normal(-4, 1, (n, 3))).astype(np.float32)),
        torch.from_numpy(rng.random(n).astype(np.float32)),
        torch.from_numpy(rng.normal(size=(n, 4, 3)).astype(np.float32)),
    )
    bound = bind_splats(cloud)
    again = bound.gaussians()
    np.testing.assert_allclose(again.means, cloud.means, atol=1e-6)
    size = np.abs(covariances(cloud)).max((1, 2), keepdims=True)
    np.testing.assert_allclose(covariances(again) / size, covariances(cloud) / size, atol=1e-3)
    np.testing.assert_allclose(again.opacities, cloud.opacities, atol=2e-6)
    turn = Rotation.from_euler("xyz", [10, 80, 30], degrees=True).as_matrix()
    moved = bound.gaussians((bound.vertices.double() @ torch.from_numpy(turn).T).float())
    expected = turn @ covariances(cloud) @ turn.T
    np.testing.assert_allclose(covariances(moved) / size, expected / size, atol=2e-3)
    with pytest.raises(AssetError, match="without Gaussians"):
        bind_splats(
            Gaussians(*(getattr(cloud, k)[:0] for k in ("means", "quats", "scales", "opacities", "sh")))
        )
