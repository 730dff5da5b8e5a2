"""Obstacles in pictures: they stand where the solver's do, and every way of drawing a run shows them."""

from __future__ import annotations

import functools
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from pxr import Usd, UsdGeom
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import import_mesh
from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians, rotation_matrices
from gdpro_sim.io.images import read_png
from gdpro_sim.io.obstacles import BASE, FINE, LEAST, Obstacles, surface_of, with_obstacles
from gdpro_sim.io.record import record
from gdpro_sim.io.views import render_file
from gdpro_sim.meshing.repair import validate
from gdpro_sim.simulation.colliders import Collider, compile_collider
from gdpro_sim.simulation.scene import check_scene

LOW, HIGH = np.array([-0.5, -0.5, 0.0]), np.array([0.5, 0.5, 0.5])


def collider(**options: object) -> Collider:
    scene = check_scene({"bodies": [{"asset": "a.obj"}], "colliders": options})
    return compile_collider(scene.colliders[0])


def drawn(item: Collider, time: float = 0.0) -> np.ndarray:
    """Means of the Gaussians of one obstacle, [N, 3] m."""
    none = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    gaussians, normals = Obstacles([item], LOW, HIGH).added_to(none, torch.zeros(0, 3), time)
    assert len(gaussians) == len(normals) > 1000
    return gaussians.means.numpy()


@pytest.mark.parametrize(
    ("options", "half"),
    [
        ({"kind": "box", "size": [0.2, 0.4, 0.6]}, [0.1, 0.2, 0.3]),
        ({"kind": "sphere", "radius": 0.2}, [0.2, 0.2, 0.2]),
        ({"kind": "capsule", "radius": 0.1, "length": 0.4}, [0.1, 0.1, 0.3]),
        ({"kind": "cylinder", "radius": 0.1, "length": 0.4}, [0.1, 0.1, 0.2]),
    ],
)
def test_shapes_are_as_large_as_they_are(options: dict[str, object], half: list[float]) -> None:
    middle = np.array([1.0, 2.0, 3.0])
    means = drawn(collider(**options, position=middle.tolist()))
    np.testing.assert_allclose(means.min(0), middle - half, atol=0.012)
    np.testing.assert_allclose(means.max(0), middle + half, atol=0.012)


def test_a_plane_is_drawn_below_its_free_side_where_bodies_are() -> None:
    means = drawn(collider(kind="plane", position=[0, 0, 0.1], rotation=[0, 30, 0]))
    height = (means - [0, 0, 0.1]) @ np.array([0.5, 0.0, np.sqrt(0.75)])
    assert height.max() < 1e-6 and height.min() > -0.05
    assert np.linalg.norm(means.mean(0) - [0, 0, 0.2]) < 0.2


def test_obstacles_move_and_are_kept_in_view() -> None:
    item = collider(
        kind="box",
        size=[0.2, 0.2, 0.2],
        motion=[{"time": 1, "translation": [2, 0, 0], "rotation": [0, 0, 90]}],
    )
    np.testing.assert_allclose(drawn(item, 0.5).mean(0), [1, 0, 0], atol=0.01)
    low, high = with_obstacles([item], LOW, HIGH)
    np.testing.assert_allclose(high, [2.1, 0.5, 0.5], atol=1e-6)
    np.testing.assert_allclose(low, [-0.5, -0.5, -0.1], atol=1e-6)
    far_larger = collider(kind="box", size=[50, 50, 1])
    np.testing.assert_array_equal(with_obstacles([far_larger], LOW, HIGH), (LOW, HIGH))


def test_a_recorded_run_shows_its_obstacles_again(tmp_path: Path) -> None:
    trimesh.creation.box((0.1, 0.1, 0.1)).export(tmp_path / "block.ply")
    asset = import_mesh(tmp_path / "block.ply", budget=500, target_tets=60)
    asset.save(tmp_path / "block.usdc")
    text = (
        "bodies: [{asset: block.usdc, position: [0, 0, 0.3], material: foam}]\nduration: 0.1\n"
        "camera: {width: 96, height: 64}\n"
    )
    pictures = []
    for name, more in (
        ("bare", ""),
        (
            "with",
            "colliders:\n"
            "- {kind: sphere, radius: 0.1, position: [0, 0, 0.1]}\n"
            "- {kind: mesh, file: block.ply, position: [0.2, 0, 0.1],\n"
            "   motion: {time: 0.1, rotation: [0, 0, 40]}}\n"
            "- {kind: plane, position: [0, 0, -1]}\n",
        ),
    ):
        (tmp_path / f"{name}.yaml").write_text(text + more)
        run = record(tmp_path / f"{name}.yaml", tmp_path / name)
        (tmp_path / f"{name}_moved").mkdir()  # the files of the scene are not beside it any more
        moved = run.simulation.rename(tmp_path / f"{name}_moved/simulation.usdc")
        again = render_file(moved, tmp_path / f"{name}_again")
        assert len(again) == run.frame_count
        for index, path in enumerate(again):
            first = read_png(run.frames / path.name).astype(int)
            assert np.abs(first - read_png(path)).max() <= 2, index
        pictures.append(first)
    stage = Usd.Stage.Open(str(moved))
    block = stage.GetPrimAtPath("/Simulation/Obstacles/mesh_1")
    turned = np.array(UsdGeom.Xformable(block).GetLocalTransformation(Usd.TimeCode(run.frame_count - 1)))
    point = np.array([0.25, 0, 0.1, 1]) @ turned  # half a side from the pivot
    angle = np.radians(40)
    assert np.allclose(point[:3], [0.2 + 0.05 * np.cos(angle), 0.05 * np.sin(angle), 0.1])
    assert not stage.GetPrimAtPath("/Simulation/Obstacles/sphere_0").GetAttribute("xformOpOrder").Get()
    assert len(stage.GetPrimAtPath("/Simulation/Obstacles").GetChildren()) == 2
    assert np.abs(pictures[1] - pictures[0]).max() > 50


@pytest.mark.parametrize(("height", "lowest"), [(0.2, 0.0), (-0.3, -0.302)])
def test_a_terrain_is_shown_down_to_the_floor(height: float, lowest: float) -> None:
    heights = [[0.0, 0.1], [0.0, 0.0]]
    terrain = collider(kind="heightfield", size=[0.4, 0.4], position=[0, 0, height], heights=heights)
    vertices, faces = surface_of(terrain, LOW, HIGH)
    assert vertices[:, 2].min() + height == pytest.approx(lowest) and vertices[:, 2].max() == 0.1
    assert terrain.vertices is not None and terrain.vertices[:, 2].min() == pytest.approx(-0.2)
    assert validate(vertices, faces).watertight


def covariances(gaussians: Gaussians) -> torch.Tensor:
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None]
    return axes @ axes.transpose(1, 2)


def test_what_moves_is_drawn_turned_and_shifted() -> None:
    key = {"time": 1, "translation": [0.5, -1, 2], "rotation": [30, 0, 90]}
    shown = Obstacles([collider(kind="box", size=[0.2, 0.3, 0.4], motion=[key])], LOW, HIGH)
    none = Gaussians(*(torch.zeros(0, *shape) for shape in ((3,), (4,), (3,), (), (1, 3))))
    before, outward = shown.added_to(none, torch.zeros(0, 3), 0.0)
    after, facing = shown.added_to(none, torch.zeros(0, 3), 1.0)
    turn = torch.tensor(Rotation.from_rotvec([30, 0, 90], degrees=True).as_matrix()).float()
    close = functools.partial(torch.testing.assert_close, rtol=0.0, atol=1e-5)
    close(after.means, before.means @ turn.T + torch.tensor([0.5, -1.0, 2.0]))
    close(facing, outward @ turn.T)
    close(covariances(after), turn @ covariances(before) @ turn.T, atol=1e-9)


def test_parts_of_a_base_are_drawn_as_finely_as_they_are_seen() -> None:
    def part(half: float, x: float, y: float = 0.0) -> Collider:
        place = np.array([x, y, 0.0])
        return Collider("part", "box", size=(half, half, half), position=place, color=(0.5, 0.5, 0.5))

    view = Cameras.look_at([3.0, 0.0, 0.0], [0.0, 0.0, 0.0], vertical_fov=0.7, width=200, height=200)
    parts = [part(0.1, 0.0), part(0.1, 1.5), part(0.05, 0.0), part(0.1, 6.0), part(0.1, 1.5, 1.0)]
    shown = Obstacles(parts, LOW, HIGH, view=view)
    far, near, small, behind, beside = (count for _, count in shown.counts)
    exact = 6 * 0.2**2 * (view.Ks[0, 0, 0].item() / 1.5 / FINE) ** 2
    assert near == pytest.approx(exact, rel=0.3)
    assert 0.2 < far / near < 0.35
    assert far > small and behind <= LEAST
    assert 0.15 < beside / near < 0.35, "it may come in"
    many = Obstacles([part(0.2, 1.5)] * 40, LOW, HIGH, view=view).counts
    assert sum(count for _, count in many) <= BASE
