"""Guidance by known views: its targets are the pictures; photos come only from their own cameras."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from gdpro_sim.errors import GuidanceError
from gdpro_sim.gaussians import Gaussians, rgb_to_sh
from gdpro_sim.generation.cameras import held_out, ring, view_batch
from gdpro_sim.generation.config import GuidanceConfig
from gdpro_sim.generation.guidance.views import (
    MeshGuidance,
    PhotoGuidance,
    RenderedGuidance,
    SplatGuidance,
)
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.protocols import UnitFrame, ViewBatch
from gdpro_sim.generation.renders import GaussianRenderer, MeshRenderer
from tests.generation.photo_scene import ball_and_box, cameras_around, photos_of

COLORS = torch.tensor([[1.0, 1.0, 1.0], [0.2, 0.4, 0.6]])


@pytest.fixture(scope="module")
def photos() -> Photos:
    return photos_of(ball_and_box(), cameras_around(8))


def proposed(batch: int, resolution: int = 32) -> ViewBatch:
    colors = torch.rand(batch, 3, generator=torch.Generator().manual_seed(1))
    return view_batch(ring(batch, resolution), colors)


@pytest.mark.parametrize("kind", ["rgb", "disparity"])
def test_targets_of_a_mesh_are_its_renders(kind: str) -> None:
    mesh = ball_and_box()
    guidance = MeshGuidance(mesh)
    views = replace(view_batch(held_out(2, 40), COLORS), kind=kind)
    expected = MeshRenderer(mesh).render(views.cameras).image(kind, COLORS)
    assert torch.equal(guidance.targets(views), expected[None])
    assert guidance.psnr(expected, views) > 100.0
    assert guidance.views(views, torch.Generator()) is views
    assert guidance.uses_cameras


def test_targets_of_gaussians_are_their_renders() -> None:
    draw = torch.Generator().manual_seed(0)
    sh = rgb_to_sh(torch.rand(200, 1, 3, generator=draw))
    quats = torch.nn.functional.normalize(torch.randn(200, 4, generator=draw))
    means = 0.3 * torch.randn(200, 3, generator=draw)
    cloud = Gaussians(means, quats, torch.full((200, 3), 0.06), torch.full((200,), 0.9), sh)
    views = view_batch(held_out(2, 40), COLORS)
    expected = GaussianRenderer(cloud).render(views.cameras).over(COLORS)
    assert torch.equal(SplatGuidance(cloud).targets(views), expected[None])


def test_one_target_for_each_renderer() -> None:
    renderers = [MeshRenderer(ball_and_box(scale)) for scale in (1.0, 0.5)]
    views = view_batch(ring(2, 24))
    targets = RenderedGuidance(renderers, GuidanceConfig(kernel_width=0.1), {}).targets(views)
    assert targets.shape == (2, 2, 24, 24, 3)
    assert float((targets[0] - targets[1]).abs().max()) > 0.5
    with pytest.raises(GuidanceError, match="something to render"):
        RenderedGuidance([], GuidanceConfig(), {})


def test_descriptions_are_json_and_say_what_the_pictures_are(photos: Photos) -> None:
    config = GuidanceConfig(kernel_width=0.25, jitter=0.1)
    for guidance, of in (
        (MeshGuidance(ball_and_box(), config), "mesh"),
        (PhotoGuidance(photos, config), "photos"),
    ):
        said = json.loads(json.dumps(guidance.describe()))
        assert (said["kind"], said["of"]) == ("views", of)
        assert "fitted to" in said["label"]
        assert (said["kernel_width"], said["jitter"]) == (0.25, 0.1)


def test_photos_are_drawn_from_the_generator_none_twice(photos: Photos) -> None:
    guidance = PhotoGuidance(photos)
    first = guidance.views(proposed(8), torch.Generator().manual_seed(5))
    again = guidance.views(proposed(8), torch.Generator().manual_seed(5))
    other = guidance.views(proposed(8), torch.Generator().manual_seed(6))
    assert torch.equal(first.cameras.viewmats, again.cameras.viewmats)
    assert torch.equal(first.cameras.Ks, again.cameras.Ks)
    assert not torch.equal(first.cameras.viewmats, other.cameras.viewmats)
    assert len(torch.unique(first.cameras.viewmats, dim=0)) == 8
    known = torch.tensor(photos.viewmats, dtype=torch.float32)
    assert all((known == view).all((1, 2)).any() for view in first.cameras.viewmats)
    more = guidance.views(proposed(11), torch.Generator().manual_seed(5))
    assert len(torch.unique(more.cameras.viewmats, dim=0)) == 8
    assert torch.equal(first.backgrounds, proposed(8).backgrounds)


def test_a_view_of_a_photo_is_what_its_camera_sees(photos: Photos) -> None:
    guidance = PhotoGuidance(photos)
    views = guidance.views(proposed(8), torch.Generator().manual_seed(0))
    assert (views.cameras.width, views.cameras.height) == (32, 32)
    truth = MeshRenderer(ball_and_box()).render(views.cameras, rays=6).over(views.backgrounds)
    target = guidance.targets(views)[0]
    assert float((target - truth).abs().mean()) < 4e-3
    assert guidance.psnr(truth, views) > 33.0
    eyes = views.cameras.positions
    assert torch.allclose(views.azimuths, torch.atan2(eyes[:, 1], eyes[:, 0]), atol=1e-6)


def test_photos_that_do_not_show_the_object_are_never_drawn(photos: Photos) -> None:
    empty = np.zeros_like(photos.pictures[2])
    views = photos.viewmats.copy()
    views[5, 0, 3] += 50.0  # the object is far out of the picture
    known = replace(photos, viewmats=views, pictures=(*photos.pictures[:2], empty, *photos.pictures[3:]))
    guidance = PhotoGuidance(known)
    assert guidance.useful == [0, 1, 3, 4, 6, 7]
    drawn = guidance.views(proposed(12), torch.Generator().manual_seed(0)).cameras.viewmats
    gone = torch.tensor(known.viewmats[[2, 5]], dtype=torch.float32)
    assert not (drawn[:, None] == gone).all((2, 3)).any()
    assert guidance.describe()["photos"] == 6
    with pytest.raises(GuidanceError, match="no photo shows the object"):
        PhotoGuidance(replace(photos, pictures=(empty,) * 8))


def test_disparity_is_never_asked_of_photos(photos: Photos) -> None:
    guidance = PhotoGuidance(photos)
    views = guidance.views(replace(proposed(2), kind="disparity"), torch.Generator())
    assert views.kind == "rgb"
    with pytest.raises(GuidanceError, match="not disparity"):
        guidance.targets(replace(views, kind="disparity"))


def test_other_cameras_than_the_photos_are_refused(photos: Photos) -> None:
    with pytest.raises(GuidanceError, match="other cameras than their own"):
        PhotoGuidance(photos).targets(proposed(2))


def test_pixels_are_means_over_their_area() -> None:
    cameras = cameras_around(2, (16, 16))
    draw = np.random.default_rng(0)
    pictures = tuple(draw.integers(0, 256, (16, 16, 4), np.uint8) for _ in range(2))
    known = Photos(cameras.viewmats.double().numpy(), cameras.Ks.double().numpy(), pictures, ("a", "b"))
    half = replace(cameras, Ks=cameras.Ks * torch.tensor([0.5, 0.5, 1.0])[:, None], width=8, height=8)
    rgba = pictures[1].astype(np.float64) / 255.0
    rgba[..., :3] *= rgba[..., 3:]
    blocks = rgba.reshape(8, 2, 8, 2, 4).mean((1, 3))
    assert np.abs(known.seen_by(half)[1].numpy() - blocks).max() < 1e-5
    third = replace(cameras, Ks=cameras.Ks * torch.tensor([5 / 16, 5 / 16, 1.0])[:, None], width=5, height=5)
    assert np.abs(known.seen_by(third)[1].numpy().mean((0, 1)) - rgba.mean((0, 1))).max() < 1e-5
    whole = known.seen_by(cameras)[1].numpy()
    assert np.abs(whole - rgba).max() < 1e-5


def test_the_square_stays_within_the_photo_and_around_the_object(photos: Photos) -> None:
    corner, side = photos.square(0, np.zeros(2))
    assert (corner >= 0.0).all()
    assert corner[0] + side <= 64.0
    assert corner[1] + side <= 48.0
    assert 40.0 < side < 48.0  # the sphere at distance 4 in a view of 0.6 rad
    wide = photos_of(ball_and_box(), cameras_around(4, (64, 24), fov=0.3))
    left, side = wide.square(0, np.array([0.0, 0.5]))
    right, _ = wide.square(0, np.array([1.0, 0.5]))
    assert side == 24.0
    assert right[0] - left[0] > 15.0
    assert left[1] == right[1] == 0.0


def test_moving_the_world_moves_the_cameras_with_it(photos: Photos) -> None:
    frame = UnitFrame((1.0, -2.0, 0.5), 3.0)
    assert np.allclose(photos.in_frame(frame).centres, (photos.centres - frame.centre) / 3.0)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    turned = photos.turned(turn)
    assert np.allclose(turned.centres, photos.centres @ turn.T)
    point = np.array([0.1, 0.2, 0.3])
    before = photos.viewmats[:, :3, :3] @ point + photos.viewmats[:, :3, 3]
    assert np.allclose(turned.viewmats[:, :3, :3] @ (turn @ point) + turned.viewmats[:, :3, 3], before)
    assert photos.chosen([3, 5]).names == ("photo_3.png", "photo_5.png")


def test_photos_refuse_what_cannot_be(photos: Photos) -> None:
    with pytest.raises(GuidanceError, match="1 photo with a camera; at least 2"):
        photos.chosen([0])
    views = photos.viewmats.copy()
    views[3, 0, 3] = np.nan
    with pytest.raises(GuidanceError, match=r"photo_3\.png.*NaN"):
        replace(photos, viewmats=views)
    views = photos.viewmats.copy()
    views[2, :3, :3] *= 2.0
    with pytest.raises(GuidanceError, match=r"photo_2\.png.*rotation"):
        replace(photos, viewmats=views)
    views = photos.viewmats.copy()
    views[4] = views[1]
    with pytest.raises(GuidanceError, match=r"photo_1\.png and photo_4\.png have the same camera"):
        replace(photos, viewmats=views)
    ks = photos.Ks.copy()
    ks[5, 1, 1] = -10.0
    with pytest.raises(GuidanceError, match=r"photo_5\.png.*focal"):
        replace(photos, Ks=ks)
    with pytest.raises(ValueError, match="viewmats"):
        replace(photos, viewmats=photos.viewmats[:3])
