from __future__ import annotations

import logging
import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing import tetrahedralize as module
from gdpro_sim.meshing.embedding import boundary, embed_surface
from gdpro_sim.meshing.lattice import KUHN
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.repair import signed_volume, validate
from gdpro_sim.meshing.tetmesh import Embedding, TetMesh
from gdpro_sim.meshing.tetrahedralize import TetwildError, tetrahedralize
from tests.meshing.shapes import cube, joined, sheet, sphere, warp_asset


def check(mesh: TetMesh, volume: float, rel: float) -> None:
    assert (mesh.volumes() > 0.0).all()
    assert float((mesh.volumes() * mesh.fill).sum()) == pytest.approx(volume, rel=rel)
    assert 0 <= mesh.tets.min() and mesh.tets.max() == len(mesh.vertices) - 1
    assert len(np.unique(mesh.tets)) == len(mesh.vertices)


def bend_twist_stretch(points: np.ndarray, centre: np.ndarray, size: float) -> np.ndarray:
    """A smooth deformation in units of the bounding box's diagonal."""
    y = (points - centre) / size
    angle = 1.2 * y[:, 2]
    c, s = np.cos(angle), np.sin(angle)
    x = c * y[:, 0] - s * y[:, 1]
    return np.stack([x, s * y[:, 0] + c * y[:, 1] + 0.3 * y[:, 2] ** 2, 1.2 * y[:, 2]], 1)


def carried(mesh: TetMesh, embedding: Embedding, moved: np.ndarray) -> np.ndarray:
    return np.einsum("vw,vwc->vc", embedding.weights.astype(np.float64), moved[mesh.tets[embedding.tet_ids]])


def embedding_error(mesh: TetMesh, vertices: np.ndarray) -> float:
    embedding = embed_surface(mesh, vertices)
    v = vertices.astype(np.float64)
    centre, size = v.mean(0), float(np.linalg.norm(np.ptp(v, axis=0)))
    moved = bend_twist_stretch(mesh.vertices.astype(np.float64), centre, size)
    assert np.abs(carried(mesh, embedding, mesh.vertices.astype(np.float64)) - v).max() < 1e-6 * size
    error = np.linalg.norm(carried(mesh, embedding, moved) - bend_twist_stretch(v, centre, size), axis=1)
    return float(error.mean())


def test_kuhn_tets_fill_the_cube() -> None:
    edges = (KUHN[:, 1:] - KUHN[:, :1]).astype(float)
    assert np.allclose(np.linalg.det(edges) / 6.0, 1.0 / 6.0)


def test_bunny_by_tetwild() -> None:
    mesh = load_mesh(warp_asset("bunny.usd"))
    tets = tetrahedralize(mesh.vertices, mesh.faces, method="tetwild")
    assert tets.method == "tetwild" and 3000 <= len(tets.tets) <= 8000
    check(tets, signed_volume(mesh.vertices, mesh.faces), 0.05)
    assert embedding_error(tets, mesh.vertices) < 3e-4
    embedding = embed_surface(tets, mesh.vertices)
    assert np.abs(embedding.weights).max() < 4.0
    assert np.abs(embedding.weights.sum(1, dtype=np.float64) - 1.0).max() < 1e-6
    assert embedding.weights.dtype == np.float32 and embedding.tet_ids.dtype == np.int32


def test_bunny_by_lattice() -> None:
    mesh = load_mesh(warp_asset("bunny.usd"))
    tets = tetrahedralize(mesh.vertices, mesh.faces, method="lattice")
    assert tets.method == "lattice" and 3000 <= len(tets.tets) <= 10_000
    assert 0.0 < tets.fill.min() < 1.0 and tets.fill.max() == 1.0
    check(tets, signed_volume(mesh.vertices, mesh.faces), 0.02)
    assert embedding_error(tets, mesh.vertices) < 5e-4
    assert embed_surface(tets, mesh.vertices).weights.min() > -0.2
    again = tetrahedralize(mesh.vertices, mesh.faces, method="lattice")
    assert np.array_equal(again.tets, tets.tets) and np.array_equal(again.fill, tets.fill)


@pytest.mark.parametrize("method", ["tetwild", "lattice"])
def test_cube_volume_and_size(method: str) -> None:
    v, f = cube()
    mesh = tetrahedralize(v, f, method=method, target_tets=1000)
    check(mesh, 1.0, 0.03)
    assert 200 <= len(mesh.tets) <= 2500
    coarse = tetrahedralize(v, f, method=method, edge_length=0.5)
    assert len(coarse.tets) < len(mesh.tets)


def test_nothing_is_left_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    tetrahedralize(*cube(), method="tetwild", edge_length=0.5)
    assert not list(tmp_path.iterdir())


def test_far_away_and_small() -> None:
    v, f = sphere(3)
    moved = (v * 0.01 + np.asarray([50.0, -20.0, 5.0])).astype(np.float32)
    mesh = tetrahedralize(moved, f, target_tets=500)
    check(mesh, signed_volume(moved, f), 0.05)


def opened(share: float) -> tuple[np.ndarray, np.ndarray]:
    v, f = sphere(3)
    return v, f[v[f].mean(1)[:, 2] < share]


HOSTILE = {
    "open": opened(0.8),
    "flipped": (sphere(3)[0], sphere(3)[1][:, ::-1]),
    "half flipped": (sphere(3)[0], np.concatenate([sphere(3)[1][:640], sphere(3)[1][640:, ::-1]])),
    "crossing": joined(sphere(3), (sphere(3)[0] + np.float32(0.7), sphere(3)[1])),
    "degenerate": (sphere(3)[0], np.concatenate([sphere(3)[1], [[0, 0, 1], [5, 6, 5]]])),
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("method", ["tetwild", "lattice"])
def test_hostile_meshes(name: str, method: str) -> None:
    v, f = HOSTILE[name]
    mesh = tetrahedralize(v, f.astype(np.int32), method=method, target_tets=800)
    ball = signed_volume(*sphere(3))
    distance = 0.7 * 3**0.5
    union = 2 * ball - np.pi * (4 + distance) * (2 - distance) ** 2 / 12  # two unit balls, their lens once
    check(mesh, union if name == "crossing" else ball, 0.12 if name == "open" else 0.06)


def test_two_bodies_stay_two() -> None:
    v, f = joined(sphere(2), (sphere(2)[0] * np.float32(0.3) + np.float32(3.0), sphere(2)[1]))
    mesh = tetrahedralize(v, f, target_tets=1500)
    check(mesh, signed_volume(v, f), 0.05)
    assert (mesh.vertices[:, 0] > 2.0).any()


@pytest.mark.parametrize("method", ["auto", "tetwild", "lattice"])
def test_flat_sheet_is_refused(method: str) -> None:
    with pytest.raises(MeshError, match=r"flat.*thickness"):
        tetrahedralize(*sheet(), method=method)


def test_curved_sheet_is_refused() -> None:
    v, f = sheet(16)
    v[:, 2] = 0.2 * np.sin(3 * v[:, 0]) * np.cos(2 * v[:, 1])
    with pytest.raises(MeshError, match="no volume"):
        tetrahedralize(v, f, target_tets=500)


def test_time_limit_is_honoured_and_falls_back_loudly(caplog: pytest.LogCaptureFixture) -> None:
    v, f = sphere(4)
    started = time.monotonic()
    with pytest.raises(TetwildError, match=r"time limit of 0\.2 s"):
        tetrahedralize(v, f, method="tetwild", time_limit=0.2)
    assert time.monotonic() - started < 5.0
    with caplog.at_level(logging.WARNING):
        mesh = tetrahedralize(v, f, time_limit=0.2, target_tets=500)
    assert mesh.method == "lattice" and "lattice instead" in caplog.text


def test_a_crash_is_an_error_not_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "WORKER", "gdpro_sim.meshing.no_such_worker")
    with pytest.raises(TetwildError, match="exit code 1"):
        tetrahedralize(*cube(), method="tetwild", target_tets=100)
    assert tetrahedralize(*cube(), target_tets=100).method == "lattice"


@pytest.mark.skipif(os.name != "posix", reason="signals")
def test_interruption_leaves_no_process_behind() -> None:
    code = (
        "import signal, threading, os, subprocess, numpy as np\n"
        "import gdpro_sim.meshing.tetrahedralize as m\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # a background shell ignores it\n"
        "made = []\n"
        "class Spy(subprocess.Popen):\n"
        "    def __init__(self, *a, **k):\n"
        "        super().__init__(*a, **k); made.append(self)\n"
        "m.subprocess.Popen = Spy\n"
        "from tests.meshing.shapes import sphere\n"
        "v, f = sphere(5)\n"
        "threading.Timer(1.0, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "try:\n"
        "    m.run_tetwild(v.astype(float), f, 0.01, 1e-4, 100.0)\n"
        "except KeyboardInterrupt:\n"
        "    print('stopped', made[0].poll())\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert out.stdout.split() == ["stopped", "-9"], out.stderr


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "magic"}, "auto, tetwild, lattice"),
        ({"target_tets": 3}, "target_tets"),
        ({"edge_length": -1.0}, "edge_length"),
        ({"time_limit": 0.0}, "time_limit"),
        ({"epsilon": float("nan")}, "epsilon"),
    ],
)
def test_bad_options_are_refused(options: dict, words: str) -> None:
    with pytest.raises(MeshError, match=words):
        tetrahedralize(*cube(), **options)


@pytest.mark.parametrize(
    ("v", "f"),
    [
        (np.zeros((0, 3)), np.zeros((0, 3), np.int32)),
        (cube()[0], cube()[1] + 100),
        (cube()[0] * np.float32(np.nan), cube()[1]),
    ],
)
def test_broken_arrays_never_reach_tetwild(v: np.ndarray, f: np.ndarray) -> None:
    with pytest.raises(MeshError):
        tetrahedralize(v, f)


def single_tet() -> TetMesh:
    v = np.asarray([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], np.float32)
    return TetMesh(v, np.asarray([[0, 1, 2, 3]], np.int32), np.ones(1, np.float32), "tetwild")


def test_embedding_closed_form() -> None:
    points = np.asarray([(0.25, 0.25, 0.25), (1.0, 1.0, 0.0), (-0.5, 0.0, 0.0), (0.0, 0.0, 1.0)])
    embedding = embed_surface(single_tet(), points)
    expected = [(0.25, 0.25, 0.25, 0.25), (-1, 1, 1, 0), (1.5, -0.5, 0, 0), (0, 0, 0, 1)]
    assert np.allclose(embedding.weights, expected, atol=1e-7)


def test_embedding_finds_the_tet_that_holds_each_point() -> None:
    mesh = tetrahedralize(*cube(), method="lattice", target_tets=600)
    rng = np.random.default_rng(0)
    weights = rng.dirichlet(np.ones(4), 2000)
    tets = rng.integers(0, len(mesh.tets), 2000)
    points = np.einsum("vw,vwc->vc", weights, mesh.vertices.astype(np.float64)[mesh.tets[tets]])
    embedding = embed_surface(mesh, points)
    assert embedding.weights.min() > -1e-5 and (embedding.tet_ids == tets).mean() > 0.999


def test_embedding_takes_the_nearest_tet_outside() -> None:
    v, f = sphere(3)
    mesh = tetrahedralize(v, f, method="lattice", target_tets=300)
    points = (v * 1.3).astype(np.float64)
    embedding = embed_surface(mesh, points)
    faces, owners = boundary(mesh.tets)
    # Brute force over dense samples of the boundary triangles.
    grid = np.asarray([(i, j, 12 - i - j) for i in range(13) for j in range(13 - i)]) / 12.0
    samples = np.einsum("gc,fcd->fgd", grid, mesh.vertices.astype(np.float64)[faces])
    for i in range(0, len(points), 40):
        distance = np.linalg.norm(samples - points[i], axis=2).min(1)
        own = distance[owners == embedding.tet_ids[i]]
        if np.abs(embedding.weights[i]).max() < 3.9 and len(own):
            assert own.min() <= distance.min() + 0.03


def test_embedding_avoids_slivers() -> None:
    v = np.asarray([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0.3, 0.3, 1e-3), (0.3, 0.3, -1)], np.float32)
    mesh = TetMesh(v, np.asarray([[0, 1, 2, 3], [0, 2, 1, 4]], np.int32), np.ones(2, np.float32), "tetwild")
    assert (mesh.volumes() > 0).all()
    embedding = embed_surface(mesh, np.asarray([(0.3, 0.3, 0.1)]))
    assert embedding.tet_ids[0] == 1 and np.abs(embedding.weights).max() < 2.0


def test_embedding_is_fast_and_guards_its_input() -> None:
    mesh = tetrahedralize(*sphere(3), method="lattice", target_tets=5000)
    v, _ = sphere(5)
    embed_surface(mesh, v[:10])
    started = time.monotonic()
    embed_surface(mesh, v)  # 10,242 vertices
    assert time.monotonic() - started < 2.0
    with pytest.raises(MeshError, match="NaN"):
        embed_surface(mesh, np.full((1, 3), np.nan))
    with pytest.raises(MeshError, match="shape"):
        embed_surface(mesh, np.zeros((3, 2)))


def test_boundary_is_closed_and_outward() -> None:
    mesh = tetrahedralize(*sphere(3), method="lattice", target_tets=400)
    faces, _ = boundary(mesh.tets)
    report = validate(mesh.vertices, faces)
    assert report.boundary_edges == 0
    assert report.volume == pytest.approx(float(mesh.volumes().sum()), rel=1e-5)
