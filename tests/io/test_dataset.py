"""Datasets of rollouts: what they hold, and that they are the same however they were made."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from gdpro_sim.asset import import_mesh, tetrahedralize_asset
from gdpro_sim.cli import app
from gdpro_sim.errors import GdproError
from gdpro_sim.io.dataset import rollout, scene_of_rollout
from gdpro_sim.simulation.compile import load_assets
from gdpro_sim.simulation.run import Simulation
from tests.meshing.shapes import sphere, write_obj

RADIUS = 0.1

SCENE = """
bodies:
  - name: ball
    asset: ball.usdc
    position: [0, 0, 0.2]
    material: wood
    mujoco: {form: rigid, shape: sphere}
  - {name: jelly, asset: ball.usdc, position: [0.3, 0, 0.1], mujoco: {form: trilinear, cells: [2, 2, 2]}}
colliders:
  - {kind: box, name: wall, size: [0.05, 0.6, 0.3], position: [-0.4, 0, 0.15]}
fps: 20
duration: 0.2
solver: {kind: mujoco}
camera: {width: 96, height: 72, target: [0, 0, 0.1], distance: 1.6}
randomize:
  bodies.ball:
    position: [[-0.1, -0.1, 0.1], [0.0, 0.1, 0.3]]
    rotation: any
    size: [0.15, 0.25]
  bodies.jelly.material.young: {low: 1.0e4, high: 1.0e6, distribution: log_uniform}
  bodies.*.velocity.y: [-1, 1]
  camera.azimuth: [-90, -30]
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset")
    asset = import_mesh(write_obj(path / "ball.obj", *sphere(4, RADIUS)), budget=4000, tets=False)
    tetrahedralize_asset(asset, target_tets=200, method="lattice").save(path / "ball.usdc")
    (path / "scene.yaml").write_text(SCENE)
    rollout(path / "scene.yaml", path / "made", count=2, cameras=2, threads=1)
    return path


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def read(folder: Path, index: int) -> tuple[dict[str, Any], dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The record of a rollout, its arrays and its pictures."""
    where = folder / "rollouts" / f"{index:05d}"
    record = json.loads((where / "rollout.json").read_text())
    with np.load(where / "states.npz", allow_pickle=False) as data:
        arrays = {key: data[key] for key in data.files}
    return record, arrays, {name: np.asarray(Image.open(where / name)) for name in record["images"]}


def test_a_rollout_is_the_run_of_its_scene(folder: Path) -> None:
    record, arrays, _ = read(folder / "made", 1)
    scene = scene_of_rollout(folder / "made", 1)
    simulation = Simulation(scene, load_assets(scene), device="cpu")
    assert record["parameters"]["bodies.jelly.material.young"] == scene.bodies[1].material.young
    with np.load(folder / "made/bodies/ball.npz") as data:
        mesh = {key: data[key] for key in data.files}
    with np.load(folder / "made/bodies/jelly.npz") as data:
        soft = {key: data[key] for key in data.files}
    for frame in range(scene.frame_count):
        simulation.advance(frame)
        ball, jelly = simulation.surfaces()
        w, x, y, z = arrays["quaternions"][frame, 0]
        turn = np.array([
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ])  # fmt: skip
        placed = arrays["scales"][0] * mesh["vertices"] @ turn.T + arrays["positions"][frame, 0]
        np.testing.assert_allclose(placed, ball, atol=1e-6)
        corners = arrays["vertices.jelly"][frame][soft["tets"][soft["embedding_tets"]]]
        np.testing.assert_allclose(
            np.einsum("vw,vwc->vc", soft["embedding_weights"], corners), jelly, atol=1e-6
        )
    assert arrays["time"][-1] == pytest.approx(0.2)
    centre = ball.min(axis=0) / 2 + ball.max(axis=0) / 2
    np.testing.assert_allclose(arrays["centers"][-1, 0], centre, atol=5e-4)


def test_motion_obeys_the_numbers_drawn(folder: Path) -> None:
    for index in range(2):
        record, arrays, _ = read(folder / "made", index)
        start = record["parameters"]["bodies.ball.position"]
        radius = 0.5 * record["parameters"]["bodies.ball.size"]
        np.testing.assert_allclose(arrays["centers"][0, 0], [*start[:2], start[2] + radius], atol=1e-3)
        assert arrays["velocities"][0, 0, 1] == pytest.approx(record["parameters"]["bodies.ball.velocity.y"])
        t = arrays["time"][2]
        fall = arrays["centers"][0, 0, 2] - arrays["centers"][2, 0, 2]
        if start[2] > 0.06:
            assert fall == pytest.approx(0.5 * 9.81 * t * t, rel=0.03)


def test_contacts_carry_weight_and_name_what_touches(folder: Path) -> None:
    about = json.loads((folder / "made/dataset.json").read_text())
    assert [row["name"] for row in about["labels"]] == ["background", "floor", "ball", "jelly", "wall"]
    assert about["poses"] == ["ball"]
    _, arrays, _ = read(folder / "made", 0)
    pairs = {tuple(sorted(pair)) for pair in arrays["contact_labels"].tolist()}
    assert (1, 3) in pairs and pairs <= {(1, 2), (1, 3), (2, 3), (2, 4)}
    sign = np.where(arrays["contact_labels"][:, 0] == 1, 1.0, -1.0)
    floor = (arrays["contact_labels"] == 1).any(axis=1)
    assert (sign * arrays["contact_forces"][:, 2])[floor].min() >= 0.0
    assert len(arrays["contact_frames"]) == len(arrays["contact_positions"]) == len(floor)


def test_pictures_agree_with_states_through_the_cameras(folder: Path) -> None:
    about = json.loads((folder / "made/dataset.json").read_text())
    whole = 0
    assert about["images"]["cameras"] == ["main", "main_1"] and about["images"]["frames"] == [4]
    for index in range(2):
        record, arrays, pictures = read(folder / "made", index)
        assert len(pictures) == 2 * 3
        radius = 0.5 * record["parameters"]["bodies.ball.size"]
        for f, frame in enumerate(about["images"]["frames"]):
            for c, camera in enumerate(about["images"]["cameras"]):
                k, view = arrays["intrinsics"][f, c], arrays["extrinsics"][f, c]
                labels = pictures[f"{camera}_{frame:05d}_segmentation.png"]
                depth = pictures[f"{camera}_{frame:05d}_depth.png"] * about["images"]["depth_unit"]
                rgb = pictures[f"{camera}_{frame:05d}_rgb.png"]
                assert labels.shape == depth.shape == rgb.shape[:2] == (72, 96)
                here = view[:3, :3] @ arrays["centers"][frame, 0] + view[:3, 3]
                y, x = np.nonzero(labels == 2)
                seen = np.array([x.mean() + 0.5, y.mean() + 0.5])
                image = k @ here
                size = k[0, 0] * radius / here[2]  # pixels
                if len(x) > 0.85 * np.pi * size**2:  # nothing stands before it
                    np.testing.assert_allclose(seen, image[:2] / image[2], atol=0.8)
                    assert -0.5 < np.sqrt(len(x) / np.pi) - size < 2.0  # splats are blurred by a pixel
                    whole += 1
                    nearest = depth[labels == 2].min()
                    assert nearest == pytest.approx(here[2] - radius, abs=0.15 * radius)
                # the floor's pixels, back in the world, lie on it
                y, x = np.nonzero((labels == 1) & (depth > 0))
                rays = np.stack([x + 0.5, y + 0.5, np.ones(len(x))]) * depth[y, x]
                world = view[:3, :3].T @ (np.linalg.inv(k) @ rays - view[:3, 3:])
                assert np.abs(world[2]).max() < 2e-3
    assert whole >= 2


def test_the_table_holds_what_was_drawn(folder: Path) -> None:
    with open(folder / "made/parameters.csv", newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with np.load(folder / "made/parameters.npz", allow_pickle=False) as data:
        table = {key: data[key] for key in data.files}
    assert len(rows) == 2 and table["bodies.ball.position"].shape == (2, 3)
    for index, row in enumerate(rows):
        record, _, _ = read(folder / "made", index)
        assert [float(row[f"bodies.ball.position.{a}"]) for a in "xyz"] == record["parameters"][
            "bodies.ball.position"
        ]
        assert float(row["camera.azimuth"]) == table["camera.azimuth"][index]
        assert row["camera.azimuth#1"] != row["camera.azimuth"]
        assert (row["frames"], row["error"]) == ("5", "")


def test_threads_do_not_change_a_byte_and_datasets_grow(folder: Path) -> None:
    grown = folder / "grown"
    rollout(folder / "scene.yaml", grown, count=1, cameras=2, threads=2)
    made = rollout(folder / "scene.yaml", grown, count=2, cameras=2, threads=2)
    assert (made.resumed, made.count, made.pictures) == (1, 2, 6)
    assert files_of(grown) == files_of(folder / "made")


class Stopped(Exception):
    pass


def test_a_stopped_run_goes_on_to_the_same_bytes(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from gdpro_sim.io import perception

    target, whole = folder / "stopped", perception.write_png
    calls = []

    def stopping(path: Path, picture: np.ndarray) -> None:
        calls.append(path)
        if len(calls) == 8:  # in the second rollout
            raise Stopped
        whole(path, picture)

    monkeypatch.setattr(perception, "write_png", stopping)
    with pytest.raises(Stopped):
        rollout(folder / "scene.yaml", target, count=2, cameras=2)
    assert not json.loads((target / "dataset.json").read_text())["complete"]
    kept = files_of(target / "rollouts/00000")
    monkeypatch.setattr(perception, "write_png", whole)
    (target / "rollouts/00001/.main.0123456789ab.tmp.png").write_bytes(b"cut off")
    made = rollout(folder / "scene.yaml", target, count=2, cameras=2)
    assert made.resumed == 1 and files_of(target / "rollouts/00000") == kept
    assert files_of(target) == files_of(folder / "made")


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"seed": 1}, "another scene, seed, options or version"),
        ({"images": "all"}, "another scene, seed, options or version"),
        ({"count": 1}, "holds a dataset of 2 rollouts; give --count 2 or more"),
        ({"count": 0}, "count must be at least 1, got 0"),
        ({"images": "some"}, "images must be none, last, all"),
        ({"channels": ["rgb", "flow"]}, "channels must be of rgb, depth, segmentation"),
        ({"randomize": {"bodies.bull.size": [1, 2]}}, "did you mean 'ball'"),
        ({"randomize": {}}, "nothing is drawn at random"),
        ({"scene": "jelly_bunny"}, "this scene's solver is fem"),
    ],
)
def test_wrong_requests_are_told_before_anything_runs(
    folder: Path, options: dict[str, Any], message: str
) -> None:
    given = {"scene": folder / "scene.yaml", "count": 2, "cameras": 2, **options}
    before = files_of(folder / "made")
    with pytest.raises(GdproError, match=message):
        rollout(given.pop("scene"), folder / "made", **given)
    assert files_of(folder / "made") == before


def test_files_of_others_are_never_replaced(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "rollouts").mkdir()
    (tmp_path / "rollouts/mine.txt").write_text("mine")
    with pytest.raises(GdproError, match="holds other files named like a dataset's"):
        rollout(folder / "scene.yaml", tmp_path, count=1, fresh=True)
    assert (tmp_path / "rollouts/mine.txt").read_text() == "mine"


def test_only_rollouts_that_are_there_have_scenes(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(GdproError, match="has rollouts 0 to 1, got 2"):
        scene_of_rollout(folder / "made", 2)
    with pytest.raises(GdproError, match="holds no dataset"):
        scene_of_rollout(tmp_path, 0)


def test_the_command(folder: Path, tmp_path: Path) -> None:
    shutil.copy(folder / "ball.usdc", tmp_path)
    text = SCENE.split("randomize:")[0].split("camera:")[0]
    (tmp_path / "scene.yaml").write_text(text)
    (tmp_path / "draw.yaml").write_text("randomize: {gravity.z: [-10, -9]}\n")
    arguments = ["rollout", str(tmp_path / "scene.yaml"), "-o", str(tmp_path / "out"), "--count", "2"]
    done = CliRunner().invoke(app, [*arguments, "--images", "none", "--json"])
    assert done.exit_code != 0 and "nothing is drawn" in str(done.exception)
    arguments += ["--config", str(tmp_path / "draw.yaml"), "--images", "none", "--json", "-q"]
    done = CliRunner().invoke(app, arguments)
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["count"] == 2
    assert json.loads((tmp_path / "out/dataset.json").read_text())["complete"]
    assert not list((tmp_path / "out/rollouts").rglob("*.png"))
