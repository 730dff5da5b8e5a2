"""Disks of fluids lie on the surface that their particles stand for, whatever it is: closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gdpro_sim.device import set_thread_count, thread_count
from gdpro_sim.errors import SolverError
from gdpro_sim.gaussians import sh_to_rgb
from gdpro_sim.simulation.mpm.fluid_look import THICKNESS, FluidLook, fluid
from tests.simulation.test_mpm_look import bar

S = 0.01


def lattice(counts: tuple[int, int, int], jitter: float = 0.25) -> np.ndarray:
    """Particles S apart around the origin, their topmost layer half a spacing below z = 0."""
    cells = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
    points = S * (cells + 0.5 - 0.5 * np.array([counts[0], counts[1], 2 * counts[2]]))
    noise = np.random.default_rng(0).uniform(-jitter, jitter, points.shape)
    return (points + S * noise).astype(np.float32)


def disks(look: FluidLook, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Middles, normals and standard deviations."""
    corners = look.surface(points).astype(np.float64).reshape(-1, 3, 3)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(normals, axis=1, keepdims=True)
    return corners.mean(1), normals / lengths, 0.5 * np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)


def test_a_flat_surface_is_drawn_flat_and_where_it_is() -> None:
    points = lattice((24, 24, 8))
    middles, normals, sigma = disks(FluidLook(len(points), S), points)
    inner = (np.abs(points[:, :2]) < 7.0 * S).all(axis=1)
    top = inner & (points[:, 2] > -S)
    assert np.abs(middles[top, 2]).max() < 0.25 * S  # the particles: half a spacing below, give or take
    assert middles[top, 2].std() < 0.5 * points[top, 2].std()
    assert (normals[top, 2] > np.cos(np.radians(10.0))).all()
    deep = inner & (points[:, 2] < -2.5 * S) & (points[:, 2] > -5.0 * S)
    assert np.abs(middles[deep] - points[deep]).max() < 0.1 * S
    # Disks of neighbours close the surface: nowhere in it is farther than 1.5 standard deviations from one.
    probes = np.random.default_rng(1).uniform(-6.0 * S, 6.0 * S, (500, 2))
    gaps = np.linalg.norm(probes[:, None] - middles[top][None, :, :2], axis=2) / sigma[top]
    assert gaps.min(axis=1).max() < 1.5


def test_a_ball_is_round() -> None:
    points = lattice((30, 30, 30)) + np.array([0.0, 0.0, 15.0 * S], np.float32)
    radius = 12.0 * S
    points = points[np.linalg.norm(points, axis=1) < radius]
    middles, normals, _ = disks(FluidLook(len(points), S), points)
    outer = np.linalg.norm(points, axis=1) > radius - 0.6 * S
    distance = np.linalg.norm(middles[outer], axis=1)
    assert abs(distance.mean() - radius) < 0.35 * S and distance.std() < 0.2 * S
    cosine = (normals[outer] * middles[outer]).sum(1) / distance
    assert np.degrees(np.arccos(cosine.clip(-1.0, 1.0))).max() < 20.0


def test_a_film_is_closed_and_a_drop_is_small() -> None:
    film = lattice((24, 24, 1), jitter=0.2)
    middles, normals, sigma = disks(FluidLook(len(film), S), film)
    inner = (np.abs(film[:, :2]) < 8.0 * S).all(axis=1)
    assert (np.abs(normals[inner, 2]) > 0.95).all()
    assert np.abs(middles[inner] - film[inner]).max() < 0.5 * S
    sparse = film * np.array([1.5, 1.5, 1.0], np.float32)
    wider = disks(FluidLook(len(film), S), sparse)[2]
    assert wider[inner].mean() > 1.2 * sigma[inner].mean()  # it closes gaps of what spreads
    drop = disks(FluidLook(1, S), np.zeros((1, 3), np.float32))
    assert np.isfinite(drop[0]).all() and drop[2][0] < 0.7 * sigma[inner].mean()


def test_turning_the_fluid_turns_what_is_seen() -> None:
    points = lattice((12, 10, 6))
    turn = Rotation.from_rotvec([0.4, -0.9, 0.3]).as_matrix()
    look = FluidLook(len(points), S)
    a, n, sigma = disks(look, points)
    b, m, again = disks(look, (points @ turn.T).astype(np.float32))
    on_top = np.abs(a - points).max(axis=1) > 0.3 * S
    assert on_top.any()
    assert np.abs(a @ turn.T - b)[on_top].max() < 1e-2 * S
    assert ((n @ turn.T) * m)[on_top].sum(1).min() > 0.99
    np.testing.assert_allclose(sigma, again, rtol=1e-3)


def test_any_number_of_threads_gives_the_same_bytes() -> None:
    points = lattice((20, 20, 6))
    before = thread_count()
    try:
        seen = []
        for threads in (1, 2, 8):
            set_thread_count(threads)
            seen.append(FluidLook(len(points), S).surface(points).tobytes())
    finally:
        set_thread_count(before)
    assert seen[0] == seen[1] == seen[2]


def test_particles_in_one_place_give_finite_disks() -> None:
    points = np.zeros((40, 3), np.float32)
    middles, normals, sigma = disks(FluidLook(40, S), points)
    assert np.isfinite(middles).all() and np.isfinite(normals).all() and (sigma > 0.0).all()


def test_a_body_seen_as_fluid_keeps_its_colours() -> None:
    bound, filling = bar()
    seen = fluid(bound, filling)
    at_rest = seen.gaussians.gaussians()
    assert len(at_rest) == len(filling) and seen.gaussians.is_loose
    assert seen.vertex_colors.shape == (3 * len(filling), 3)
    torch.testing.assert_close(
        at_rest.scales[:, 0], torch.full((len(filling),), THICKNESS * filling.spacing), rtol=1e-4, atol=0.0
    )
    left = at_rest.means[:, 0] < -0.1
    assert (at_rest.sh[left, 0, 0] > 0.99).all() and (at_rest.sh[left, 0, 2].abs() < 1e-6).all()
    colors = sh_to_rgb(at_rest.sh[:, 0]).clamp(0.0, 1.0).repeat_interleave(3, 0)
    np.testing.assert_allclose(seen.vertex_colors, colors.numpy(), atol=1e-6)


def test_what_is_wrong_is_said() -> None:
    with pytest.raises(SolverError, match="has particles"):
        FluidLook(0, S)
    with pytest.raises(SolverError, match="3 particles got positions"):
        FluidLook(3, S).surface(np.zeros((2, 3), np.float32))
