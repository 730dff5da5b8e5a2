"""Runs with several cameras and lights: their pictures, their USD, rendered again, continued after a stop."""

from __future__ import annotations

import subprocess
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
import trimesh
from PIL import Image
from pxr import Gf, Usd, UsdGeom, UsdLux

from gdpro_sim.errors import GdproError
from gdpro_sim.io.images import read_png
from gdpro_sim.io.passes import write_exr
from gdpro_sim.io.preview import Studio
from gdpro_sim.io.record import Recording, record
from gdpro_sim.io.staging import Staging, named_cameras
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.io.views import Look, read_view, render_file
from gdpro_sim.simulation.scene import load_scene

SCENE = """
bodies:
  - {asset: cube.ply, name: cube, budget: 300, position: [0, 0, 0.3], velocity: [1, 0, 1], material: jelly}
fps: 50
duration: 0.08
camera: {width: 96, height: 64, orbit: {turns: 0.5}, motion: {time: 0.08, fov: 50}}
cameras:
  - {name: chase, follow: cube, width: 64, height: 64}
  - {name: still, eye: [1, -1, 0.6], width: 64, height: 48}
  - {name: spare, azimuth: 10, width: 32, height: 32, preview: false}
lights:
  - kind: distant
    azimuth: 20
    elevation: 40
    color: "#ff8040"
    softness: 3
    motion: {time: 0.08, azimuth: 90}
  - {kind: dome, intensity: 0.4}
solver: {kind: mpm, particles: 300}
"""


class Stop(Exception):
    pass


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("views")
    trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().export(path / "cube.ply")
    (path / "scene.yaml").write_text(SCENE)
    return path


@pytest.fixture(scope="module")
def run(folder: Path) -> Recording:
    return record(folder / "scene.yaml", folder / "run", device="cpu")


def test_each_camera_has_its_pictures(run: Recording) -> None:
    for name, size in (("frames", (96, 64)), ("frames_chase", (64, 64)), ("frames_still", (64, 48))):
        pictures = sorted((run.output / name).glob("*.png"))
        assert len(pictures) == 5
        assert Image.open(pictures[0]).size == size
    assert not (run.output / "frames_spare").exists()
    assert sorted(Path(video).name for video in run.more_videos) == ["preview_chase.mp4", "preview_still.mp4"]
    assert all(Path(video).exists() for video in [run.video, *run.more_videos])
    assert (run.output / "contact_sheet_chase.png").exists()


def test_rendering_again_gives_the_same_bytes_from_every_camera(run: Recording, folder: Path) -> None:
    for name, place in (("main", "frames"), ("chase", "frames_chase"), ("still", "frames_still")):
        for path in render_file(run.simulation, folder / "again", look=Look(name), device="cpu"):
            assert path.read_bytes() == (run.output / place / path.name).read_bytes(), (name, path.name)
    (spare, *_) = render_file(run.simulation, folder / "spare", look=Look("spare"), device="cpu")
    assert read_png(spare).shape == (32, 32, 3)


def test_a_stopped_run_with_a_camera_that_follows_continues_to_the_same_bytes(
    run: Recording, folder: Path
) -> None:
    def stop(phase: str, done: int, total: int) -> None:
        if phase == "simulate" and done == 3:
            raise Stop

    with pytest.raises(Stop):
        record(folder / "scene.yaml", folder / "stopped", device="cpu", on_progress=stop)
    second = record(folder / "scene.yaml", folder / "stopped", device="cpu")
    assert second.resumed_frames == 3
    assert second.simulation.read_bytes() == run.simulation.read_bytes()
    for path in run.output.glob("frames*/*.png"):
        assert (second.output / path.relative_to(run.output)).read_bytes() == path.read_bytes(), path.name


def test_usd_cameras_see_points_where_ours_do(run: Recording, folder: Path) -> None:
    stage = Usd.Stage.Open(str(run.simulation))
    reader = SimulationReader(run.simulation)
    scene = load_scene(folder / "scene.yaml")
    preview = reader.metadata["preview"]
    staging = Staging(
        named_cameras(scene.camera, scene.cameras),
        scene.lights,
        np.asarray(preview["low"]),
        np.asarray(preview["high"]),
        np.asarray(reader.times),
        [(body.name, body.gaussians) for body in reader.bodies],
        Studio(**preview["studio"]),
    )
    points = np.random.default_rng(0).uniform(-0.2, 0.5, (20, 3))
    for index, frame in enumerate(reader):
        shot = staging.next([body.vertices for body in frame.bodies])
        for name, ours in shot.cameras.items():
            path = f"/Simulation/Cameras/{'main_cam' if name == 'main' else name}"
            frustum = UsdGeom.Camera(stage.GetPrimAtPath(path)).GetCamera(index).frustum
            matrix = frustum.ComputeViewMatrix() * frustum.ComputeProjectionMatrix()
            local = np.c_[points, np.ones(20)] @ ours.viewmats[0].double().numpy().T
            pixels = local[:, :3] @ ours.Ks[0].double().numpy().T
            u, v = (pixels[:, :2] / pixels[:, 2:]).T
            theirs = np.array([matrix.Transform(Gf.Vec3d(*point)) for point in points])
            seen = local[:, 2] > 0.01
            np.testing.assert_allclose(
                (0.5 + 0.5 * theirs[seen, 0]) * ours.width, u[seen], rtol=1e-4, atol=5e-3
            )
            np.testing.assert_allclose(
                (0.5 - 0.5 * theirs[seen, 1]) * ours.height, v[seen], rtol=1e-4, atol=5e-3
            )
        sun = UsdLux.DistantLight(stage.GetPrimAtPath("/Simulation/Lights/distant_0"))
        towards = UsdGeom.Xformable(sun).GetLocalTransformation(index).TransformDir(Gf.Vec3d(0, 0, 1))
        np.testing.assert_allclose(towards, shot.lights[0].direction, atol=1e-9)
        assert sun.GetIntensityAttr().Get(index) == pytest.approx(np.pi * 0.9)
        np.testing.assert_allclose(sun.GetColorAttr().Get(), (1.0, (128 / 255) ** 2.2, (64 / 255) ** 2.2))
    assert sun.GetAngleAttr().Get() == 6.0
    dome = UsdLux.DomeLight(stage.GetPrimAtPath("/Simulation/Lights/dome_1"))
    assert dome.GetIntensityAttr().Get() == pytest.approx(0.4)
    still = UsdGeom.Camera(stage.GetPrimAtPath("/Simulation/Cameras/still"))
    assert not still.GetFocalLengthAttr().GetTimeSamples()
    assert not UsdGeom.Xformable(still).TransformMightBeTimeVarying()
    near, _ = still.GetClippingRangeAttr().Get()
    assert near == pytest.approx(0.01)


def test_another_look_at_a_simulation(run: Recording, folder: Path) -> None:
    (folder / "view.yaml").write_text(
        "camera: {azimuth: 0, width: 32, height: 32, follow: cube}\nlights: moonlight\n"
    )
    look = Look(view=read_view(folder / "view.yaml"), orbit=1.0, render={"background": "transparent"})
    pictures = render_file(
        run.simulation, folder / "look", look=look, passes=["depth", "alpha"], pass_format="npz", video=True
    )
    assert Image.open(pictures[0]).mode == "RGBA" and Image.open(pictures[0]).size == (32, 32)
    assert (folder / "look" / "preview.mp4").stat().st_size > 500
    with np.load(folder / "look" / "passes_00002.npz") as data:
        assert set(data.files) == {"depth", "alpha"}
        assert (data["depth"] > 0.1).sum() > 20 and data["alpha"].dtype == np.float32
    assert not (folder / "look" / "depth_00002.exr").exists()


def test_an_asset_turns_or_the_camera_goes_round_it(run: Recording, folder: Path) -> None:
    small = {"width": 32, "height": 32}
    turned = render_file(run.assets[0], folder / "turn", views=2, look=Look(changes=small))
    plain = [read_png(path).astype(float) for path in turned]
    lit = render_file(run.assets[0], folder / "turn", views=2, look=Look(changes=small, lights="sunset"))
    assert np.abs(read_png(lit[0]).astype(float) - plain[0]).mean() > 5
    round_ = render_file(run.assets[0], folder / "turn", views=3, look=Look(changes=small, orbit=1.0))
    assert len(list((folder / "turn").glob("frame_*.png"))) == 3
    first, last = read_png(round_[0]), read_png(round_[2])
    np.testing.assert_allclose(first.astype(float), last.astype(float), atol=3.0)


def test_an_exr_holds_its_numbers(tmp_path: Path) -> None:
    image = np.random.default_rng(1).normal(size=(6, 10, 3)).astype(np.float32) * 1e3
    for data, layout, order in ((image, "gbrpf32le", [2, 0, 1]), (image[..., 0], "grayf32le", None)):
        write_exr(tmp_path / "a.exr", data)
        command = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-i", str(tmp_path / "a.exr")]
        raw = subprocess.run(
            [*command, "-f", "rawvideo", "-pix_fmt", layout, "-"],
            capture_output=True,
            check=True,
        ).stdout
        planes = np.frombuffer(raw, "<f4").reshape(-1, 6, 10)
        back = planes[0] if order is None else np.moveaxis(planes[order], 0, -1)
        np.testing.assert_array_equal(back, data)


@pytest.mark.parametrize(
    ("look", "passes", "message"),
    [
        (Look("chaise"), (), r"there is no camera 'chaise' \(did you mean 'chase'\?\); cameras: main, chase"),
        (Look(lights="dusk"), (), "there are no lights 'dusk'"),
        (Look(view={"solver": {}}), (), "a view has the keys camera, cameras, lights, render; got solver"),
        (Look(view={"camera": {"follow": "ball"}}), (), "there is no body 'ball'"),
        (Look(changes={"distance": -1.0}), (), "camera.distance: must be greater than 0"),
        (Look(render={"background": "plaid"}), (), "render.background: must be studio"),
        (Look(), ["colour"], "passes are depth, normal, alpha, got 'colour'"),
    ],
)
def test_what_cannot_be_rendered_is_told_first(
    look: Look, passes: list[str], message: str, run: Recording, folder: Path
) -> None:
    with pytest.raises(GdproError, match=message):
        render_file(run.simulation, folder / "nothing", look=look, passes=passes)
    assert not (folder / "nothing").exists()
