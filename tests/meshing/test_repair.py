from __future__ import annotations

import numpy as np
import pytest

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.remesh import decimate, subdivide
from gdpro_sim.meshing.repair import (
    clean,
    consistent_winding,
    duplicate_faces,
    outward_orientation,
    signed_volume,
    turn_faces,
    validate,
    weld,
)
from tests.meshing.shapes import cube, joined, sheet, sphere


def test_cube_report_is_exact() -> None:
    report = validate(*cube())
    assert report.watertight and report.components == 1 and report.degenerate_faces == 0
    assert report.area == pytest.approx(6.0) and report.volume == pytest.approx(1.0)


def test_sphere_volume_approaches_closed_form() -> None:
    report = validate(*sphere(4, 0.5))
    assert report.volume == pytest.approx(np.pi / 6.0, rel=5e-3) and report.volume < np.pi / 6.0
    assert report.area == pytest.approx(np.pi, rel=5e-3)


def test_volume_does_not_depend_on_the_origin() -> None:
    v, f = sphere(2)
    assert signed_volume(v + np.float32(1000.0), f) == pytest.approx(signed_volume(v, f), rel=1e-3)


def test_open_and_non_manifold_edges_are_counted() -> None:
    v, f = sheet(4)
    assert validate(v, f).boundary_edges == 16
    v, f = cube()
    fin = np.concatenate([v, [[2.0, 2.0, 2.0]]]).astype(np.float32)
    report = validate(fin, np.concatenate([f, [[0, 1, 8]]]).astype(np.int32))
    assert report.non_manifold_edges == 1 and not report.watertight


def test_weld_closes_a_triangle_soup() -> None:
    v, f = sphere(2)
    soup = v[f].reshape(-1, 3)
    assert not validate(soup, np.arange(len(soup)).reshape(-1, 3)).watertight
    report = validate(*weld(soup, np.arange(len(soup)).reshape(-1, 3)))
    assert report.watertight and report.vertices == len(v)


def test_clean_sews_seams_that_rounding_opened() -> None:
    v, f = sphere(2)
    soup = v[f].reshape(-1, 3).astype(np.float64)
    soup += 1e-8 * np.random.default_rng(0).standard_normal(soup.shape)
    assert validate(*clean(soup, np.arange(len(soup)).reshape(-1, 3))).watertight


@pytest.mark.parametrize("share", [0.1, 0.45, 1.0])
def test_flipped_faces_are_turned_back(share: float) -> None:
    v, f = sphere(3)
    mask = np.random.default_rng(1).random(len(f)) < share
    v2, f2 = clean(v, turn_faces(f, mask))
    assert validate(v2, f2).watertight
    assert signed_volume(v2, f2) == pytest.approx(signed_volume(v, f), rel=1e-6)


def test_winding_is_made_consistent_per_piece() -> None:
    a, b = sphere(2), sphere(2)
    _, f = joined(a, (b[0] + np.float32(5.0), b[1]))
    mask = np.zeros(len(f), bool)
    mask[: len(f) // 8] = mask[-5:] = True
    turned, pieces = consistent_winding(turn_faces(f, mask))
    assert np.array_equal(turned, mask) and pieces.max() == 1


def test_a_cavity_stays_a_cavity() -> None:
    outer, inner = sphere(3, 1.0), sphere(2, 0.5)
    v, f = joined(outer, (inner[0], inner[1][:, ::-1]))
    assert not outward_orientation(v, f).any()
    assert outward_orientation(v, f[:, ::-1]).all()


def test_a_single_flipped_piece_among_several_is_turned() -> None:
    a, b = sphere(2), sphere(2)
    v, f = joined(a, (b[0] + np.float32(5.0), b[1][:, ::-1]))
    assert outward_orientation(v, f).sum() == len(b[1])


def test_duplicates_keep_the_first() -> None:
    f = np.asarray([[0, 1, 2], [3, 1, 2], [2, 0, 1], [2, 1, 0]], np.int32)
    assert duplicate_faces(f).tolist() == [False, False, True, True]


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (np.zeros((3, 2)), np.zeros((1, 3), int), "shape"),
        (np.zeros((3, 3)), np.zeros((1, 4), int), "triangles"),
        (np.zeros((3, 3)), np.zeros((0, 3), int), "0 faces"),
        (np.zeros((3, 3)), np.asarray([[0, 1, 3]]), "outside 0..2"),
        (np.zeros((3, 3)), np.asarray([[0, 1, -1]]), "-1 is outside"),
        (np.full((3, 3), np.nan), np.asarray([[0, 1, 2]]), "NaN"),
        (np.zeros((3, 3)), np.asarray([[0.0, 1.0, 2.0]]), "integers"),
    ],
)
def test_broken_arrays_are_refused(vertices: np.ndarray, faces: np.ndarray, words: str) -> None:
    with pytest.raises(MeshError, match=words):
        validate(vertices, faces)


def test_nothing_but_degenerate_faces_is_refused() -> None:
    with pytest.raises(MeshError, match="zero area"):
        clean(np.zeros((3, 3), np.float32), np.asarray([[0, 1, 2]]))


@pytest.mark.parametrize("edge", [0.9, 0.4, 0.13])
def test_subdivision_stays_watertight_and_exact(edge: float) -> None:
    v, f = cube()
    v = v * np.asarray([1.0, 2.0, 0.3], np.float32)
    fine, faces, parents, corners = subdivide(v, f, edge)
    report = validate(fine, faces)
    assert report.watertight and report.volume == pytest.approx(0.6, rel=1e-5)
    longest = np.linalg.norm(fine[faces] - fine[faces[:, [1, 2, 0]]], axis=2).max()
    assert longest <= edge * 1.0001
    # Corners locate every new vertex in its parent, so any attribute can follow.
    assert np.allclose(np.einsum("fcp,fpd->fcd", corners, v[f[parents]]), fine[faces], atol=1e-6)


def test_subdivision_of_a_sphere_stays_watertight() -> None:
    v, f = sphere(2)
    v = v * np.asarray([1.0, 3.0, 0.2], np.float32)  # edges of very different lengths
    assert validate(*subdivide(v, f, 0.15)[:2]).watertight


def test_subdivision_refuses_too_many_faces() -> None:
    with pytest.raises(MeshError, match="longer edge"):
        subdivide(*cube(), 0.01, max_faces=1000)


def test_decimation_stays_watertight_and_keeps_volume() -> None:
    v, f = sphere(5)
    few, faces = decimate(v, f, 2000)
    report = validate(few, faces)
    assert report.watertight and report.faces <= 2200
    assert report.volume == pytest.approx(signed_volume(v, f), rel=5e-3)


def test_decimation_does_not_depend_on_place_or_size() -> None:
    v, f = sphere(4)
    far = (v * 1e-3 + np.float32(2.0)).astype(np.float32)
    few, faces = decimate(far, f, 800)
    assert len(faces) <= 900 and validate(few, faces).volume == pytest.approx(1e-9 * 4.19, rel=0.03)
