"""Training cameras keep to their ranges and their generator; evaluation cameras are where they say."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gdpro_sim.generation.cameras import DISTANCE, CameraSchedule, held_out, ring, view_batch
from gdpro_sim.generation.config import CameraConfig
from gdpro_sim.generation.protocols import ViewBatch, step_generator

STILL = {"jitter_centre": 0.0, "jitter_target": 0.0, "jitter_up": 0.0}


def sample(iteration: int, batch: int = 200, background: str = "mixed", **config: object) -> ViewBatch:
    schedule = CameraSchedule(CameraConfig(**config), 64)
    return schedule.sample(iteration, 100, batch, step_generator(3, "surfels", iteration), background)


def fovs(views: ViewBatch) -> np.ndarray:
    return 2.0 * np.arctan(0.5 * views.cameras.height / views.cameras.Ks[:, 1, 1].double().numpy())


@pytest.mark.parametrize(
    ("iteration", "radius", "fov"),
    [(0, (5.2, 5.5), (0.44, 0.60)), (25, (4.9, 5.35), (0.39, 0.55)), (80, (4.6, 5.2), (0.34, 0.50))],
)
def test_ranges_move_from_first_to_late(
    iteration: int, radius: tuple[float, float], fov: tuple[float, float]
) -> None:
    views = sample(iteration, **STILL)
    for values, (low, high) in ((views.cameras.positions.norm(dim=1).numpy(), radius), (fovs(views), fov)):
        assert low - 1e-5 <= values.min() < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < values.max() <= high + 1e-5


def test_no_tightening_is_late_from_the_start() -> None:
    assert float(sample(0, tighten=0.0, **STILL).cameras.positions.norm(dim=1).max()) <= 5.2 + 1e-5


def test_directions_cover_the_sphere_between_the_polar_angles_evenly() -> None:
    views = sample(0, batch=2000, polar=(30.0, 150.0), **STILL)
    z = np.sin(views.elevations.double().numpy())
    edge = math.cos(math.radians(30.0))
    assert np.abs(z).max() <= edge + 1e-6
    share = np.histogram(z, 10, (-edge, edge))[0] / len(z)
    assert np.abs(share - 0.1).max() < 0.03
    share = np.histogram(views.azimuths.numpy(), 8, (-math.pi, math.pi))[0] / len(z)
    assert np.abs(share - 0.125).max() < 0.002  # spread around the object, not merely random


def test_still_cameras_look_at_the_origin_upright() -> None:
    views = sample(0, batch=8, **STILL)
    origin = views.cameras.viewmats[:, :3, 3]
    assert torch.allclose(origin[:, :2], torch.zeros(8, 2), atol=1e-5)
    up = views.cameras.viewmats[:, :3, 2]  # +Z in camera axes: upwards is -y
    assert float(up[:, 0].abs().max()) < 1e-6
    assert float(up[:, 1].max()) < 0.0


def test_jitter_moves_eye_target_and_up_by_its_deviation() -> None:
    eye = sample(0, batch=4000, **{**STILL, "jitter_centre": 0.1, "radius": (5.0, 5.0)})
    assert float(eye.cameras.positions.norm(dim=1).std()) == pytest.approx(0.1, rel=0.06)
    target = sample(0, batch=4000, **{**STILL, "jitter_target": 0.05})
    assert float(target.cameras.viewmats[:, :2, 3].std()) == pytest.approx(0.05, rel=0.06)
    up = sample(0, batch=4000, **{**STILL, "jitter_up": 0.02, "polar": (90.0, 90.0)})
    assert float(up.cameras.viewmats[:, 0, 2].std()) == pytest.approx(0.02, rel=0.06)


def test_angles_are_those_of_the_eye() -> None:
    views = sample(0, batch=16)
    eyes = views.cameras.positions
    assert torch.allclose(views.azimuths, torch.atan2(eyes[:, 1], eyes[:, 0]), atol=1e-6)
    assert torch.allclose(views.elevations, torch.asin(eyes[:, 2] / eyes.norm(dim=1)), atol=1e-6)


def test_a_third_of_the_backgrounds_each() -> None:
    colors = sample(0, batch=3000).backgrounds
    white, black = (colors == 1.0).all(1), (colors == 0.0).all(1)
    assert [float(m.float().mean()) for m in (white, black)] == pytest.approx([1 / 3, 1 / 3], abs=0.03)
    rest = colors[~white & ~black]
    assert 0.45 < float(rest.mean()) < 0.55
    assert float((rest[:, 0] - rest[:, 1]).abs().mean()) > 0.2


@pytest.mark.parametrize(("background", "value"), [("white", 1.0), ("black", 0.0)])
def test_one_background_for_all_leaves_the_cameras_alone(background: str, value: float) -> None:
    views = sample(0, batch=5, background=background)
    assert (views.backgrounds == value).all()
    assert torch.equal(views.cameras.viewmats, sample(0, batch=5).cameras.viewmats)
    assert len(torch.unique(sample(0, batch=5, background="random").backgrounds, dim=0)) == 5


def test_an_iteration_draws_the_same_again_and_another_does_not() -> None:
    first, again, other = sample(7), sample(7), sample(8)
    assert torch.equal(first.cameras.viewmats, again.cameras.viewmats)
    assert torch.equal(first.cameras.Ks, again.cameras.Ks)
    assert torch.equal(first.backgrounds, again.backgrounds)
    assert not torch.equal(first.cameras.viewmats, other.cameras.viewmats)


@pytest.mark.parametrize("cameras", [ring(6, 64), held_out(12, 64)], ids=["ring", "held_out"])
def test_fixed_cameras_see_the_whole_unit_sphere(cameras: object) -> None:
    points = torch.nn.functional.normalize(torch.randn(500, 3, generator=torch.Generator().manual_seed(0)))
    at = torch.einsum("cij,nj->cni", cameras.viewmats[:, :3, :3], points) + cameras.viewmats[:, None, :3, 3]
    pixels = torch.einsum("cij,cnj->cni", cameras.Ks, at)
    pixels = pixels[..., :2] / pixels[..., 2:]
    assert float(pixels.min()) > 0.0
    assert float(pixels.max()) < 64.0
    assert float(pixels.max()) > 61.0  # and little else
    assert torch.allclose(cameras.positions.norm(dim=1), torch.tensor(DISTANCE), atol=1e-5)


def test_ring_goes_round_from_where_it_is_told() -> None:
    views = view_batch(ring(4, 32, elevation=20.0, azimuth=-90.0))
    assert np.degrees(views.azimuths.numpy()) == pytest.approx([-90.0, 0.0, 90.0, 180.0], abs=1e-3)
    assert np.degrees(views.elevations.numpy()) == pytest.approx([20.0] * 4, abs=1e-3)
    assert (views.backgrounds == 1.0).all()
    assert views.kind == "rgb"


def test_held_out_cameras_are_apart_and_within_the_polar_range() -> None:
    eyes = torch.nn.functional.normalize(held_out(12, 32).positions)
    nearest = (eyes @ eyes.T - 2.0 * torch.eye(12)).amax(1)
    assert float(nearest.max()) < math.cos(math.radians(25.0))
    assert float(eyes[:, 2].abs().max()) < math.cos(math.radians(30.0))
