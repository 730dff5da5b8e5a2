"""Cameras over time against closed forms: orbits, keyframes, bodies that are followed."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import SceneError
from gdpro_sim.io.camera_paths import CameraPath, Follower
from gdpro_sim.io.preview import Studio, frame_camera
from gdpro_sim.io.staging import Staging
from gdpro_sim.io.tracks import Track
from gdpro_sim.simulation.scene import check_scene
from gdpro_sim.simulation.view import Camera, Orbit

LOW, HIGH = np.array([-1.0, -2.0, 0.0]), np.array([1.0, 0.5, 3.0])
TIMES = np.linspace(0.0, 2.0, 41)


def path(**camera: Any) -> CameraPath:
    return CameraPath(Camera.model_validate(camera), LOW, HIGH, TIMES)


def eye(one: CameraPath, time: float) -> np.ndarray:
    return one.at(time).positions[0].numpy()


def body(radius: float = 0.2) -> BoundGaussians:
    mesh = trimesh.creation.icosphere(subdivisions=1, radius=radius)
    n = len(mesh.faces)
    return BoundGaussians(
        torch.tensor(mesh.vertices, dtype=torch.float32),
        torch.tensor(np.asarray(mesh.faces), dtype=torch.int32),
        torch.arange(n, dtype=torch.int32),
        torch.full((n, 3), 1.0 / 3.0),
        torch.tensor([[1.0, 0.0]]).repeat(n, 1),
        torch.full((n, 3), -3.0),
        torch.full((n,), 4.0),
        torch.zeros((n, 1, 3)),
    )


def test_a_track_goes_through_its_keyframes_and_rests_at_its_ends() -> None:
    keys = [(0.5, (1.0, 0.0)), (1.0, (3.0, 1.0)), (2.0, (3.5, -1.0)), (3.0, (0.0, 0.0))]
    for smooth in (True, False):
        track = Track(keys, smooth)
        for time, value in [(0.0, keys[0][1]), *keys, (9.0, keys[-1][1])]:
            np.testing.assert_allclose(track.at(time), value, atol=1e-12)
    np.testing.assert_allclose(Track(keys, False).at(1.5), [3.25, 0.0])
    slow = Track(keys, True)
    assert np.abs(slow.at(0.501) - slow.at(0.5)).max() < 5e-5, "it starts from rest"
    # Catmull and Rom: at 1 s the slope is that between the neighbours.
    slope = (slow.at(1.0 + 1e-5) - slow.at(1.0 - 1e-5)) / 2e-5
    np.testing.assert_allclose(slope, [2.5 / 1.5, -1.0 / 1.5], rtol=1e-4)


def test_a_limited_track_does_not_overshoot() -> None:
    keys = [(0.0, (0.0,)), (1.0, (0.1,)), (1.1, (10.0,)), (3.0, (10.0,)), (4.0, (2.0,))]
    values = np.array([Track(keys, True, within=True).at(t)[0] for t in np.linspace(0, 4, 400)])
    assert values.min() >= -1e-9 and values.max() <= 10.0 + 1e-9
    assert max(Track(keys, True).at(t)[0] for t in np.linspace(0, 4, 400)) > 10.1


@pytest.mark.parametrize(
    ("orbit", "angle"),
    [
        ({"turns": 1}, 90.0),
        ({"turns": -0.5}, -45.0),
        ({"period": 1.0}, 180.0),
        ({"rate": 30.0}, 15.0),
        ({"turns": 1, "start": 0.25, "end": 0.75}, 180.0),
        ({"turns": 2, "ease": True}, 720.0 * (3 * 0.25**2 - 2 * 0.25**3)),
    ],
)
def test_an_orbit_turns_by_its_closed_form(orbit: dict[str, Any], angle: float) -> None:
    target = np.array([0.2, -0.1, 0.5])
    start = np.array([2.0, 1.0, 1.5])
    for camera in (
        {"eye": start.tolist(), "target": target.tolist()},
        {
            "target": target.tolist(),
            "azimuth": math.degrees(math.atan2(1.1, 1.8)),
            "elevation": math.degrees(math.atan2(1.0, math.hypot(1.1, 1.8))),
            "distance": float(np.linalg.norm(start - target)),
        },
    ):
        one = path(**camera, orbit=Orbit.model_validate(orbit))
        a = math.radians(angle)
        c, s = math.cos(a), math.sin(a)
        away = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ (start - target)
        np.testing.assert_allclose(eye(one, 0.5), target + away, atol=1e-5)
        # The target stays in the middle of the picture.
        local = one.at(0.5).viewmats[0].double().numpy() @ np.append(target, 1.0)
        np.testing.assert_allclose(local[:3], [0.0, 0.0, np.linalg.norm(start - target)], atol=1e-5)


def test_keyframes_start_from_the_cameras_own_values() -> None:
    one = path(
        azimuth=0.0,
        elevation=0.0,
        distance=2.0,
        target=(0, 0, 0),
        fov=40.0,
        interpolation="linear",
        motion=[{"time": 1.0, "azimuth": 90.0}, {"time": 2.0, "distance": 4.0, "fov": 20.0}],
    )
    np.testing.assert_allclose(eye(one, 0.0), [2, 0, 0], atol=1e-6)
    r = math.sqrt(0.5)
    np.testing.assert_allclose(eye(one, 0.5), [2.5 * r, 2.5 * r, 0], atol=1e-5)
    np.testing.assert_allclose(eye(one, 2.0), [0, 4, 0], atol=1e-5)
    assert float(one.at(1.0).Ks[0, 1, 1]) == pytest.approx(0.5 * 720 / math.tan(math.radians(15.0)), rel=1e-6)
    by_eye = path(eye=(3, 0, 1), target=(0, 0, 0), motion=[{"time": 2.0, "eye": (0, 3, 1)}])
    np.testing.assert_allclose(eye(by_eye, 1.0), [1.5, 1.5, 1.0], atol=1e-6)


def test_a_moving_camera_that_fits_sees_its_box_at_every_time() -> None:
    one = path(orbit={"turns": 1}, motion=[{"time": 2.0, "elevation": 70.0}])
    corners = np.array([[x, y, z, 1.0] for x in (-1, 1) for y in (-2, 0.5) for z in (0, 3)])
    for time in TIMES:
        view = one.at(float(time))
        local = corners @ view.viewmats[0].numpy().T
        pixels = local[:, :3] @ view.Ks[0].numpy().T
        pixels = pixels[:, :2] / pixels[:, 2:]
        assert (local[:, 2] > 0).all() and (pixels >= 0).all() and (pixels <= [960, 720]).all()
    away = [float(np.linalg.norm(eye(one, float(t)) - [0, -0.75, 1.5])) for t in TIMES]
    assert np.ptp(away) < 1e-5, "the distance does not pump"


def test_a_camera_whose_keyframes_stand_still_is_the_still_camera() -> None:
    still = frame_camera(LOW, HIGH, azimuth=-60, elevation=14, fov=32, width=960, height=720)
    assert torch.equal(path().at(1.3).viewmats, still.viewmats)
    held = path(motion=[{"time": 1.0, "azimuth": -60.0}])
    torch.testing.assert_close(held.at(1.3).viewmats, still.viewmats, atol=1e-6, rtol=1e-6)
    assert torch.equal(held.at(0.0).viewmats, held.at(1.9).viewmats)


def test_a_body_is_followed_as_the_spring_says() -> None:
    one, dt, tau = body(), 0.02, 0.15

    def lags(place: Any, smoothing: float, count: int = 100) -> np.ndarray:
        follower = Follower(one, smoothing, dt)
        rest = one.vertices.numpy()
        way = [np.array(place(k * dt)) for k in range(count)]
        return np.array([p - follower.next((rest + p).astype(np.float32)) for p in way])

    assert np.abs(lags(lambda t: (3 * t, 0, t), tau)).max() < 1e-5, "no lag at constant velocity"
    assert np.abs(lags(lambda t: (math.sin(9 * t), 0, 0), 0.0)).max() < 1e-6
    falling = lags(lambda t: (0, 0, -4.905 * t * t), tau)
    assert falling[-1, 2] == pytest.approx(-9.81 * tau**2, rel=0.01)
    # A kick of 2 m/s at 0.2 s: e(t) = 2 t exp(-t / tau), exactly.
    kicked = lags(lambda t: (2.0 * max(t - 0.2, 0.0), 0, 0), tau)[:, 0]
    t = np.maximum(np.arange(100) * dt - 0.2, 0.0)
    np.testing.assert_allclose(kicked, 2.0 * t * np.exp(-t / tau), atol=1e-5)


def staging(camera: dict[str, Any]) -> Staging:
    cameras = {"main": Camera.model_validate(camera)}
    return Staging(cameras, (), LOW, HIGH, TIMES, [("ball", body())], Studio())


def test_a_followed_body_stays_in_the_middle_and_at_its_distance() -> None:
    rest = body().vertices.numpy()
    along = staging({"follow": "ball", "width": 200, "height": 100})
    panning = staging({"follow": {"body": "ball", "smoothing": 0.0}, "eye": (0, -5, 1)})
    reach = []
    for k in range(len(TIMES)):
        place = np.array([2.0 * TIMES[k], 1.0, 3.0 * TIMES[k]])
        for one in (along, panning):
            shot = one.next([(rest + place).astype(np.float32)])
            view = shot.cameras["main"]
            local = view.viewmats[0].double().numpy() @ np.append(place, 1.0)
            assert abs(local[0]) < 1e-4 and abs(local[1]) < 1e-4
            assert shot.focus["main"] == pytest.approx(place, abs=1e-4)
            if one is along:
                reach.append(local[2])
            else:
                np.testing.assert_allclose(view.positions[0], [0, -5, 1], atol=1e-5)
    assert np.ptp(reach) < 1e-4


def test_a_camera_in_a_body_is_told_once(caplog: pytest.LogCaptureFixture) -> None:
    inside = staging({"eye": (0.05, 0.0, 0.0), "target": (1, 0, 0)})
    corner = staging({"eye": (0.17, 0.17, 0.17), "target": (1, 0, 0)})  # in its box, not in the ball
    for one in (corner, inside):
        assert not caplog.messages
        for _ in range(3):
            one.next([body().vertices.numpy()])
    assert caplog.messages == ["camera is inside ball at 0.00 s"]


def test_an_eye_that_meets_its_target_is_named_with_its_time() -> None:
    crossing = {
        "eye": (1, 0, 0),
        "target": (0, 0, 0),
        "motion": [{"time": 2.0, "eye": (-1, 0, 0)}],
        "interpolation": "linear",
    }
    with pytest.raises(SceneError, match=r"camera: eye and target meet at 1 s"):
        path(**crossing)
    with pytest.raises(SceneError, match="give another eye, or a target"):
        path(eye=(0.0, -0.75, 1.5))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"camera": {"follow": "bal"}}, r"camera.follow: there is no body 'bal' \(did you mean 'ball'\?\)"),
        ({"camera": {"follow": "ball", "target": [0, 0, 0]}}, "`follow` sets the target"),
        ({"camera": {"motion": [{"time": 1, "fov": 9}, {"time": 1, "fov": 8}]}}, "in order of time, got 1 s"),
        ({"camera": {"motion": {"time": 1}}}, r"camera.motion\[0\]: a keyframe needs one of eye"),
        ({"camera": {"motion": {"time": 1, "fov": 150}}}, r"camera.motion\[0\].fov: must be less than 150"),
        ({"camera": {"eye": [1, 1, 1], "motion": {"time": 1, "azimuth": 5}}}, "exclude each other"),
        ({"camera": {"orbit": {"turns": 1, "rate": 3}}}, "camera.orbit: give one of"),
        ({"camera": {"orbit": {"start": 3}}}, "before the scene's end at 3 s"),
        ({"camera": {"orbit": {"start": 1, "end": 1}}}, "must end after it starts"),
        ({"cameras": {"name": "main"}}, r"cameras\[0\].name: `camera` is named 'main'"),
        ({"cameras": [{"name": "a"}, {"name": "a"}]}, r"two cameras are named 'a'"),
        ({"cameras": {"fov": 30}}, r"cameras\[0\].name: is required"),
        ({"lights": "sunste"}, r"no lights 'sunste' \(did you mean 'sunset'\?\)"),
        ({"lights": {"kind": "spot"}}, r"lights\[0\].kind: must be 'distant', 'dome'"),
        ({"lights": {"kind": "distant", "direction": [0, 0, 0]}}, "direction must not be zero"),
        ({"lights": {"kind": "dome", "motion": {"time": 0, "azimuth": 3}}}, "a dome is everywhere"),
        ({"lights": {"kind": "dome", "color": "ruby"}}, "write #rrggbb or a CSS name"),
        ({"render": {"background": "stripes"}}, "must be studio, transparent, #rrggbb or a CSS colour name"),
    ],
)
def test_what_cannot_be_is_told_before_the_run(change: dict[str, Any], message: str) -> None:
    with pytest.raises(SceneError, match=message):
        check_scene({"bodies": [{"asset": "ball.ply"}], **change})
