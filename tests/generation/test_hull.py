"""The visual hull holds the object, fits its outlines, and takes its colours from the photos."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.priors.hull import HullPrior, Silhouettes, hull, vertex_colors
from gdpro_sim.generation.protocols import CoarseMesh
from gdpro_sim.generation.renders import MeshRenderer
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import validate
from gdpro_sim.meshing.surface import SurfaceMesh
from tests.generation.photo_scene import ball_and_box, cameras_around, photos_of
from tests.meshing import shapes


@pytest.fixture(scope="module")
def photos() -> Photos:
    return photos_of(ball_and_box(), cameras_around(16, (96, 80)))


@pytest.fixture(scope="module")
def made(photos: Photos) -> CoarseMesh:
    return HullPrior(photos).mesh("", 0)


def test_the_hull_is_closed_and_holds_the_object(made: CoarseMesh) -> None:
    surface = made.surface
    report = validate(surface.vertices, surface.faces)
    assert report.watertight
    assert report.components == 1
    mesh = ball_and_box()
    probes = np.random.default_rng(0).uniform(-1, 1, (20000, 3))
    inside = SurfaceIndex(mesh.vertices, mesh.faces, winding=True).inside(probes)
    held = SurfaceIndex(surface.vertices, surface.faces, winding=True).inside(probes)
    assert (inside & held).sum() / inside.sum() > 0.97
    assert held.sum() / inside.sum() < 1.35


def test_its_outlines_are_those_of_the_photos(made: CoarseMesh) -> None:
    cameras = cameras_around(16, (96, 80))
    outline = MeshRenderer(made.surface).render(cameras).alphas > 0.5
    truth = MeshRenderer(ball_and_box()).render(cameras).alphas > 0.5
    union = (outline | truth).sum((1, 2, 3))
    assert float(((outline & truth).sum((1, 2, 3)) / union).min()) > 0.95


def test_it_is_coloured_by_the_photos(made: CoarseMesh) -> None:
    surface = made.surface
    assert surface.colors is not None
    corner, colors = surface.vertices[surface.faces], surface.colors[..., :3] / 255.0
    red = np.abs(colors - [0.8, 0.1, 0.1]).max(2) < 0.05
    blue = np.abs(colors - [0.1, 0.2, 0.7]).max(2) < 0.05
    assert red[corner[..., 2] > 0.3].mean() > 0.98
    assert blue[corner[..., 2] < -0.2].mean() > 0.98


def test_a_ball_s_distances_are_right_where_the_outline_is_near() -> None:
    v, f = shapes.sphere(4, 0.6)
    known = photos_of(SurfaceMesh.from_arrays(v, f), cameras_around(24, (160, 160)))
    rim = np.array([[0.6, 0.7, 0.5], [0.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    assert Silhouettes(known).distance(rim) == pytest.approx([0.0, 0.1, -0.1], abs=0.03)


def test_one_wrong_mask_among_many_takes_nothing_away() -> None:
    known = photos_of(ball_and_box(), cameras_around(24, (64, 48)))
    wrong = known.pictures[3].copy()
    wrong[:, :32, 3] = 0
    holed = replace(known, pictures=(*known.pictures[:3], wrong, *known.pictures[4:]))
    volumes = [validate(*hull(p, 40)).volume for p in (known, holed)]
    assert 0.93 * volumes[0] < volumes[1] <= volumes[0]  # half of it, were the wrong one believed


def test_photos_that_do_not_belong_together_are_refused(photos: Photos) -> None:
    views = photos.viewmats.copy()
    views[:, 0, 3] += np.where(np.arange(len(views)) % 2, 1.0, -1.0)
    with pytest.raises(GuidanceError, match="no point in common"):
        hull(replace(photos, viewmats=views))


def test_vertices_no_photo_sees_take_their_neighbours_colour() -> None:
    mesh = SurfaceMesh.from_arrays(*shapes.sphere(3, 0.6), color=(0.3, 0.6, 0.9))
    known = photos_of(mesh, cameras_around(12)).chosen([0, 2])  # from below, all on one side
    colors = vertex_colors(mesh.vertices, mesh.faces, known)
    assert np.abs(colors - [0.3, 0.6, 0.9]).max() < 0.02


def test_the_description_is_json_and_claims_no_size(made: CoarseMesh) -> None:
    said = json.loads(json.dumps(dict(made.description)))
    assert said["kind"] == "hull"
    assert said["photos"] == 16
    assert said["metric"] is False
