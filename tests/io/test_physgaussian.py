"""PhysGaussian's configurations as scenes, and splat clouds as assets."""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset
from gdpro_sim.cli import main
from gdpro_sim.errors import RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.cloud import import_cloud, is_cloud
from gdpro_sim.io.describe import describe
from gdpro_sim.io.physgaussian import Converted, convert
from gdpro_sim.io.ply import write_ply
from gdpro_sim.io.splat import TURNS
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.scene import load_scene

BOX = {"point": [1, 1, 1.0], "size": [0.5, 0.4, 0.2]}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A box of 4 x 2 x 1, as a mesh and as a cloud of Gaussians on its surface with a faint one far off."""
    path = tmp_path_factory.mktemp("physgaussian")
    mesh = trimesh.creation.box((4.0, 2.0, 1.0))
    mesh.export(path / "box.ply")
    points = np.concatenate([trimesh.sample.sample_surface_even(mesh, 4000, seed=0)[0], [[50.0, 0, 0]]])
    n = len(points)
    opacities = torch.full((n,), 0.95)
    opacities[-1] = 0.01
    cloud = Gaussians(
        torch.from_numpy(np.float32(points)), torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1),
        torch.full((n, 3), 0.05), opacities, torch.zeros((n, 1, 3)),
    )  # fmt: skip
    write_ply(path / "cloud.ply", cloud)
    return path


def converted(folder: Path, asset: str = "box.ply", particles: int | None = None, **config: Any) -> Converted:
    (folder / "config.json").write_text(json.dumps({"g": [0, 0, -9.8], **config}))
    return convert(folder / "config.json", folder / asset, folder / "scene.yaml", particles=particles)


def test_time_space_and_grid(folder: Path) -> None:
    made = converted(folder, frame_dt=4e-2, frame_num=50, n_grid=100, scale=0.6, density=300, E=2e4, nu=0.3)
    scene = made.scene
    assert load_scene(folder / "scene.yaml") == scene
    assert (scene.fps, scene.duration, scene.gravity) == (25, 2.0, (0.0, 0.0, -9.8))
    assert scene.ground is None and scene.solver.kind == "mpm"
    assert scene.solver.grid_spacing == pytest.approx(0.02)
    body = scene.bodies[0]
    assert (body.size, body.anchor, body.position) == (0.6, "center", (1.0, 1.0, 1.0))
    assert body.material is not None
    assert (body.material.model, body.material.young, body.material.density) == ("corotated", 2e4, 300.0)
    assert converted(folder, particles=500).scene.solver.particles == 500  # type: ignore[union-attr]


def test_turned_matter_keeps_its_scale(folder: Path) -> None:
    scene = converted(folder, particles=400, rotation_degree=[90.0, 45.0], rotation_axis=[1, 0]).scene
    model = compile_scene(scene, load_assets(scene))
    low, high = model.bodies[0].surface.min(0), model.bodies[0].surface.max(0)
    np.testing.assert_allclose(0.5 * (low + high), [1, 1, 1], atol=1e-5)
    # 4 x 2 x 1 about Y: 1 x 2 x 4; then 45 degrees about X: 1 x 4.243 x 4.243, made 1 m long.
    np.testing.assert_allclose(high - low, [1 / (6 / math.sqrt(2)), 1, 1], rtol=1e-4)


def test_another_axis_up(folder: Path) -> None:
    up = {"mpm_space_vertical_upward_axis": [0, -1, 0], "g": [0, 9.8, 0]}
    impulse = {"type": "particle_impulse", "force": [0, -1, 0], **BOX}
    scene = converted(folder, **up, boundary_conditions=[{"type": "surface_collider", "point": [1, 1.3, 1],
        "normal": [0, -1, 0], "surface": "slip", "friction": 0, "start_time": 0, "end_time": 1e3}, impulse],
    ).scene  # fmt: skip
    np.testing.assert_allclose(scene.gravity, [0, 0, -9.8], atol=1e-6)
    plane = scene.colliders[0]
    assert plane.kind == "plane" and plane.boundary == "slip"
    np.testing.assert_allclose(plane.normal, [0, 0, 1], atol=1e-6)
    assert plane.position[2] == pytest.approx(0.7)
    push = scene.bodies[0].impulses[0]
    assert push.velocity is not None and push.velocity[2] > 0


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"material": "sand", "friction_angle": 30}, {"model": "drucker_prager", "friction_angle": 30.0}),
        ({"material": "sand"}, {"friction_angle": 25.0}),
        (
            {"material": "metal", "yield_stress": 100, "hardening": 1, "xi": 0.1, "E": 1e5, "nu": 0.25},
            {"model": "stvk_hencky", "yield_stress": math.sqrt(1.5) * 100, "hardening": 0.3 * 4e4},
        ),
        ({"material": "plasticine", "yield_stress": 300}, {"yield_stress": math.sqrt(1.5) * 300}),
        (
            {"material": "foam", "yield_stress": 50, "plastic_viscosity": 8},
            {"model": "herschel_bulkley", "yield_stress": 50.0, "viscosity": 4.0},
        ),
        ({"material": "foam", "yield_stress": 50}, {"model": "stvk_hencky"}),
        ({"material": "snow"}, {"model": "snow"}),
        ({"grid_v_damping_scale": 0.9999, "substep_dt": 1e-4}, {"rayleigh_mass": 1.0}),
    ],
)
def test_materials(folder: Path, config: dict[str, Any], expected: dict[str, Any]) -> None:
    material = converted(folder, **config).scene.bodies[0].material
    assert material is not None
    for key, value in expected.items():
        found = getattr(material, key)
        assert found == (value if isinstance(value, str) else pytest.approx(value, rel=1e-3)), key


@pytest.mark.parametrize(
    ("up", "turned"), [([0, 0, 1], []), ([0, 1, 0], [135.0, 30.0]), ([0, -1, 0], [45.0, 6.5])]
)
def test_the_camera_stands_where_physgaussians_does(folder: Path, up: list[int], turned: list[float]) -> None:
    """Theirs (utils/camera_view_utils.py) stands on a sphere around a point, in the cloud's own frame."""
    axes = [0, 2][: len(turned)]
    angles = {"init_azimuthm": -36.7, "init_elevation": 8.0, "init_radius": 2.0}
    steps = {"move_camera": True, "delta_a": 0.4, "delta_e": 0.1, "delta_r": 0.0}
    view = converted(
        folder, rotation_degree=turned, rotation_axis=axes, mpm_space_vertical_upward_axis=up, frame_num=50,
        frame_dt=0.02, default_camera_index=-1, **angles, **steps,
    ).scene.camera  # fmt: skip
    turn = np.eye(3)
    for degree, axis in zip(turned, axes, strict=True):
        turn = Rotation.from_euler("xyz"[axis], degree, degrees=True).as_matrix() @ turn
    vertical = turn.T @ up
    first = np.ones(3) - vertical.sum() * vertical
    first /= np.linalg.norm(first)
    second = np.cross(first, vertical)
    for frame in (0, 50):
        azimuth, elevation = np.radians([-36.7 + 0.4 * frame, 8.0 + 0.1 * frame])
        across = np.cos(azimuth) * first + np.sin(azimuth) * second
        theirs = turn @ (np.cos(elevation) * across + np.sin(elevation) * vertical)
        to_scene = np.asarray(TURNS[{(0, 0, 1): "z", (0, 1, 0): "y", (0, -1, 0): "-y"}[tuple(up)]])
        assert view.orbit is not None and view.orbit.rate is not None
        a = np.radians(view.azimuth + view.orbit.rate * frame * 0.02)
        heights = [view.elevation, view.motion[0].elevation or 0.0]
        e = np.radians(heights[frame > 0])
        ours = [np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)]
        np.testing.assert_allclose(ours, to_scene @ theirs, atol=1e-6)
    still = converted(folder, default_camera_index=-1, **angles, **{**steps, "move_camera": False})
    assert still.scene.camera.orbit is None and not still.scene.camera.motion
    assert any("`init_radius`" in line for line in still.messages)


def test_boundary_conditions(folder: Path) -> None:
    rotation = {
        "type": "enforce_particle_velocity_rotation", "point": [1, 1, 1.1], "normal": [0, 0, 1],
        "half_height_and_radius": [0.2, 0.1], "rotation_scale": 2.0, "translation_scale": 0.5,
    }  # fmt: skip
    translation = {"type": "enforce_particle_translation", **BOX, "velocity": [0, 0.2, 0]}
    conditions = [
        {"type": "bounding_box"},
        {"type": "cuboid", **BOX, "velocity": [0.1, 0, 0], "start_time": 0.5, "end_time": 1.5, "reset": 1},
        {**translation, "start_time": 0.25, "end_time": 0.75},
        {**rotation, "start_time": 0.0, "end_time": 0.3},
        {**rotation, "start_time": 0.3, "end_time": 1e3, "rotation_scale": 0.0, "translation_scale": 0.0},
    ]  # fmt: skip
    made = converted(folder, frame_num=200, n_grid=100, boundary_conditions=conditions)
    scene, body = made.scene, made.scene.bodies[0]
    assert scene.solver.kind == "mpm" and scene.solver.domain is not None
    np.testing.assert_allclose(scene.solver.domain, [[0.04] * 3, [1.94] * 3])
    (cuboid,) = scene.colliders
    assert cuboid.kind == "box" and cuboid.size == (1.0, 0.8, 0.4) and cuboid.boundary == "sticky"
    assert (cuboid.start, cuboid.end, cuboid.visible) == (0.5, pytest.approx(1.5015), False)
    assert [key.time for key in cuboid.motion] == [0.5, 1.5]
    np.testing.assert_allclose(cuboid.motion[1].translation, [0.1, 0, 0])
    moved, turned, held = body.pins
    assert (moved.start, moved.release) == (0.25, 0.75) and moved.motion[-1].time == 0.75
    np.testing.assert_allclose(moved.motion[-1].translation, [0, 0.1, 0], atol=1e-7)
    np.testing.assert_allclose([moved.minimum, moved.maximum], [[0.5, 0.6, 0.8], [1.5, 1.4, 1.2]])
    # Against the normal: PhysGaussian's second axis is first x normal.
    np.testing.assert_allclose(turned.motion[0].rotation, [0, 0, -math.degrees(0.6)], rtol=1e-6)
    np.testing.assert_allclose(turned.motion[0].translation, [0, 0, 0.15])
    assert turned.pivot == (1.0, 1.0, 1.1) and (turned.start, turned.release) == (0.0, 0.3)
    assert (held.start, held.release, held.motion) == (0.3, None, ())


def test_sequential_release_and_parts(folder: Path) -> None:
    release = {"type": "release_particles_sequentially", "normal": [1, 0, 0], "start_position": 1.5,
               "end_position": 0.5, "num_layers": 50, "start_time": 0.0, "end_time": 1.5}  # fmt: skip
    part = {**BOX, "nu": 0.2, "E": 1e6}
    made = converted(folder, "cloud.ply", particles=2000, n_grid=100, density=700, frame_num=200,
                     boundary_conditions=[release], additional_material_params=[part])  # fmt: skip
    pins = made.scene.bodies[0].pins
    times = {round(pin.minimum[0], 3): pin.release for pin in pins if pin.minimum is not None}
    assert times[0.5] == pytest.approx(1.5) and min(t for t in times.values() if t) == pytest.approx(0.03)
    assert all((pin.minimum or (0,))[0] > 0.45 for pin in pins), "slabs beside the matter are left out"
    assert any("pins: boxes that hold nothing" in line and "more" in line for line in made.messages)
    model = compile_scene(made.scene, load_assets(made.scene))
    held = np.concatenate([hold.particles for hold in model.holds])
    assert model.particles is not None
    assert sorted(held) == np.flatnonzero(model.particles.positions[:, 0] < 1.5).tolist(), "each by one slab"
    late = converted(folder, "cloud.ply", boundary_conditions=[{**release, "start_time": 0.75}]).scene
    assert {pin.start for pin in late.bodies[0].pins} == {0.75}
    assert min(pin.release or 0.0 for pin in late.bodies[0].pins) > 0.75
    material = made.scene.bodies[0].parts[0].material
    assert (material.young, material.poisson, material.density) == (1e6, 0.2, 700.0)


def test_a_cloud_is_cut_turned_and_scaled(folder: Path) -> None:
    made = converted(folder, "cloud.ply", particles=1500, rotation_degree=[90.0], rotation_axis=[2],
                     sim_area=[-5, 5, -5, 5, -0.25, 5], opacity_threshold=0.02)  # fmt: skip
    assert any(line.startswith("`sim_area`: the ") for line in made.messages)
    asset = Asset.load(folder / "scene_asset.usdc")
    means = asset.gaussians.gaussians().means.numpy()
    # Of 2 x 4 x 1 the upper three quarters are left, open below, and 4 becomes 1 m.
    np.testing.assert_allclose(np.ptp(means, axis=0), [0.5, 1, 0.1875], rtol=0.05)
    np.testing.assert_allclose(means.min(0) + means.max(0), 0, atol=1e-5)
    model = compile_scene(made.scene, load_assets(made.scene))
    assert model.particles is not None
    assert model.particles.volumes.sum() == pytest.approx(0.5 * 0.1875, rel=0.25), "it is filled"


def test_impulses_follow_the_cloud(folder: Path) -> None:
    impulse = {"type": "particle_impulse", "force": [-0.18, 0, 0], "num_dt": 2, "start_time": 0.5}
    config = {"density": 200, "substep_dt": 1e-4, "boundary_conditions": [impulse]}
    (alone,) = converted(folder, **config).scene.bodies[0].impulses
    assert alone.velocity is not None and alone.time == 0.5 and not alone.chosen
    assert alone.velocity[0] == pytest.approx(-0.18 * 2e-4 / (200 * 0.04**3))
    (shared,) = converted(folder, "cloud.ply", **config).scene.bodies[0].impulses
    assert shared.velocity is not None and shared.velocity[0] < 3 * alone.velocity[0], "several share a cell"


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        ({"material": "water"}, "material 'water' is none of jelly, metal"),
        ({"material": "metal"}, "material 'metal' needs a yield_stress > 0"),
        ({"boundary_conditions": [{"type": "hug"}]}, "boundary condition 'hug' is none of cuboid"),
        ({"boundary_conditions": [{"type": "cuboid"}]}, "'cuboid' lacks or misstates 'size'"),
        ({"nu": 0.5}, "poisson: must be less than 0.5"),
        ({"E": 0}, "young: must be greater than 0"),
        ({"rotation_degree": [1.0]}, "do not fit together"),
        ({"rotation_degree": 1.0, "rotation_axis": 0}, "do not fit together"),
        ({"n_grid": 0}, "n_grid must be a finite number > 0, got 0"),
        ({"frame_dt": "fast"}, "frame_dt must be a finite number > 0, got 'fast'"),
        ({"g": [0, 0]}, "g must be three finite numbers"),
        ({"mpm_space_viewpoint_center": 1}, "mpm_space_viewpoint_center must be three finite numbers"),
        ({"boundary_conditions": {"type": "bounding_box"}}, "boundary_conditions must be a list of mappings"),
        ({"additional_material_params": [{**BOX, "nu": 0.3}]}, "_params lacks or misstates 'E'"),
        ({"boundary_conditions": [{"type": "particle_impulse", "force": "up"}]}, "'particle_impulse' lacks"),
    ],
)  # fmt: skip
def test_wrong_configurations_are_refused(folder: Path, config: dict[str, Any], expected: str) -> None:
    with pytest.raises(RequestError, match=expected):
        converted(folder, **config)


def test_what_is_not_followed_is_named(folder: Path) -> None:
    cut = {"type": "surface_collider", "point": [1, 1, 1], "normal": [0, 0, 1], "surface": "cut", "tilt": 2}
    part = {**BOX, "nu": 0.2, "E": 1e6, "yield_stress": 1e3}
    made = converted(folder, magic=1, rpic_damping=0.5, sim_area=[0] * 6, frame_dt=0.015, softening=0.2,
                     opacity_threshold=0.1, particle_filling={"n_grid": 100}, substep_dt=1e-4,
                     additional_material_params=[part], boundary_conditions=[cut])  # fmt: skip
    said = "\n".join(made.messages)
    for words in (
        "`magic` is not",
        "`rpic_damping` 0.5",
        "`sim_area` is for",
        "67 frames per",
        "'cut' is not",
        "surface_collider: `tilt` is not",
        "additional_material_params: `yield_stress` is not",
        "`softening` is not",
        "`opacity_threshold` is for",
        "`particle_filling`: the body is filled",
        "substeps follow the speed of sound",
    ):
        assert words in said
    assert len(made.messages) == len(set(made.messages)) and all("\n" not in line for line in made.messages)


def run_main(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    monkeypatch.setattr(sys, "argv", ["gdpro", *arguments])
    with pytest.raises(SystemExit) as stopped:
        main()
    return int(stopped.value.code or 0)


def test_command_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(folder)
    (folder / "config.json").write_text(json.dumps({"g": [0, 0, -9.8], "magic": 1}))
    assert (
        run_main(monkeypatch, "convert", "config.json", "--asset", "box.ply", "-o", "new.yaml", "--json") == 0
    )
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert notes[0] == "`magic` is not followed" and "here the body is filled" in notes[1]
    assert load_scene(folder / "new.yaml").bodies[0].asset == "box.ply"
    for wrong, expected in (
        (("scene.yaml", "--asset", "box.ply", "-o", "x.yaml"), "cannot be read as JSON"),
        (("config.json", "--asset", "none.ply", "-o", "x.yaml"), "none.ply: no such file"),
        (("config.json", "--asset", "box.ply", "-o", "x.txt"), "must end in .yaml"),
    ):
        assert run_main(monkeypatch, "convert", *wrong) == 2
        errors = capsys.readouterr().err
        assert expected in errors and len(errors.strip().splitlines()) == 1
    assert (
        run_main(
            monkeypatch, "import", "cloud.ply", "-o", "cloud.usdc", "--up", "z", "--material", "jelly", "-q"
        )
        == 0
    )
    asset = Asset.load(folder / "cloud.usdc")
    assert asset.tets is None and asset.material is not None
    assert run_main(monkeypatch, "import", "cloud.ply", "-o", "x.usdc", "--color", "red") == 2
    assert "is a splat cloud" in capsys.readouterr().err


def test_clouds_are_told_from_meshes(folder: Path) -> None:
    assert is_cloud(folder / "cloud.ply") and not is_cloud(folder / "box.ply")
    facts = describe(folder / "cloud.ply")
    assert (facts["kind"], facts["gaussians"], facts["sh_degree"]) == ("splat cloud", 4001, 0)
    assert not is_cloud(folder / "missing.ply") and is_cloud("any.splat")
    asset = import_cloud(folder / "cloud.ply", up="z", scale=0.5)
    means = asset.gaussians.gaussians().means.numpy()
    np.testing.assert_allclose(np.ptp(means, axis=0), [2.0, 1.0, 0.5], rtol=0.03)
    np.testing.assert_allclose(means.min(0) + means.max(0), 0, atol=0.05)
