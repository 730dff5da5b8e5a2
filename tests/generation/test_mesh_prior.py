"""A mesh as a prior comes out closed, in one piece where it can, coloured like the original."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.errors import MeshError
from gdpro_sim.generation.priors.mesh import MeshPrior, closed
from gdpro_sim.generation.priors.sphere import SpherePrior
from gdpro_sim.generation.protocols import UnitFrame
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import validate
from gdpro_sim.meshing.surface import SurfaceMesh
from tests.generation.photo_scene import ball_and_box
from tests.meshing import shapes


def open_ball() -> SurfaceMesh:
    """A coloured ball of radius 0.5 without its top: red for x > 0, green else."""
    v, f = shapes.sphere(4, 0.5)
    f = f[v[f].mean(1)[:, 2] < 0.4]
    colors = np.full((len(f), 3, 4), 255, np.uint8)
    red = v[f].mean(1)[:, 0] > 0.0
    colors[red, :, 1:3] = 0
    colors[~red, :, 0] = colors[~red, :, 2] = 0
    mesh = SurfaceMesh.from_arrays(v, f, color=(1.0, 1.0, 1.0))
    return replace(mesh, colors=colors)


def test_a_closed_piece_stays_as_it_is() -> None:
    mesh = SurfaceMesh.from_arrays(*shapes.sphere(3))
    made = MeshPrior(mesh).mesh("", 0)
    assert made.surface is mesh
    assert made.description["done"] == []
    assert made.description["given"]["closed"] is True
    assert made.description["metric"] is True


def test_an_opening_gets_a_lid() -> None:
    mesh = open_ball()
    made, done = closed(mesh, cells=48)
    report = validate(made.vertices, made.faces)
    assert report.watertight
    assert report.components == 1
    assert "open edges" in done[0]
    # The cap of height 0.1 is missing from the ball: something flat lies in its place.
    whole = 4.0 / 3.0 * np.pi * 0.5**3
    assert 0.93 * whole < report.volume < 1.01 * whole
    assert float(made.vertices[:, 2].max()) < 0.5
    lid = made.vertices[np.linalg.norm(made.vertices[:, :2], axis=1) < 0.15]
    lid = lid[lid[:, 2] > 0.0]
    assert 0.36 < lid[:, 2].min() <= lid[:, 2].max() < 0.5


def test_colours_come_from_the_closest_point() -> None:
    made, _ = closed(open_ball(), cells=48)
    assert made.colors is not None
    away = np.abs(made.vertices[made.faces][..., 0]) > 0.05
    red = made.vertices[made.faces][..., 0] > 0.0
    assert (made.colors[away & red][:, :3] == [255, 0, 0]).all()
    assert (made.colors[away & ~red][:, :3] == [0, 255, 0]).all()
    assert (made.colors[..., 3] == 255).all()


def test_pieces_that_overlap_become_one() -> None:
    mesh = ball_and_box()
    made, done = closed(mesh, cells=48)
    report = validate(made.vertices, made.faces)
    assert report.watertight
    assert report.components == 1
    assert "2 pieces" in done[0]
    union = SurfaceIndex(mesh.vertices, mesh.faces, winding=True)
    probes = np.random.default_rng(0).uniform(-1, 1, (20000, 3))
    inside = union.inside(probes)
    again = SurfaceIndex(made.vertices, made.faces, winding=True).inside(probes)
    assert (inside & again).sum() / (inside | again).sum() > 0.95


def test_pieces_apart_are_kept_and_told_of() -> None:
    v, f = shapes.cube()
    mesh = SurfaceMesh.from_arrays(*shapes.joined((v, f), (v + np.float32([3.0, 0, 0]), f)))
    made, done = closed(mesh, cells=40)
    assert validate(made.vertices, made.faces).components == 2
    assert any("2 pieces do not touch" in line for line in done)
    assert made.messages[-len(done) :] == tuple(done)


def test_a_sheet_is_given_a_thickness() -> None:
    v, f = shapes.sheet(6)
    made, done = closed(SurfaceMesh.from_arrays(v, f), cells=32)
    report = validate(made.vertices, made.faces)
    assert report.watertight
    assert any("thickness" in line for line in done)
    assert np.ptp(made.vertices[:, 2]) == pytest.approx(2 * 0.75 / 32, rel=0.2)


def test_many_faces_become_fewer_and_stay_closed() -> None:
    for mesh in (SurfaceMesh.from_arrays(*shapes.sphere(4, 0.7)), ball_and_box()):
        made, done = closed(mesh, cells=40, faces=2000)
        report = validate(made.vertices, made.faces)
        assert report.watertight
        assert report.faces <= 2200
        assert done[-1].startswith("reduced ")


def test_a_file_is_read_and_described(tmp_path: Path) -> None:
    path = shapes.write_obj(tmp_path / "ball.obj", *shapes.sphere(2))
    made = MeshPrior(path).mesh("", 0)
    said = json.loads(json.dumps(dict(made.description)))
    assert said["source"] == str(path)
    assert len(said["sha256"]) == 64
    with pytest.raises(MeshError, match="does not exist"):
        MeshPrior(tmp_path / "none.obj")


def test_no_prior_is_a_ball_in_the_middle() -> None:
    frame = UnitFrame((1.0, 2.0, 3.0), 4.0)
    made = SpherePrior(frame).mesh("", 0)
    distance = np.linalg.norm(made.surface.vertices - np.float32(frame.centre), axis=1)
    assert distance == pytest.approx(np.full(len(distance), 2.0), abs=1e-5)
    assert validate(made.surface.vertices, made.surface.faces).watertight
    assert made.description["metric"] is False
