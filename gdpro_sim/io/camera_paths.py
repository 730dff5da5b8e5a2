"""Where the cameras of a scene are at any time."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import SceneError
from gdpro_sim.io.preview import Studio, fitting_distance, frame_camera
from gdpro_sim.io.tracks import Track
from gdpro_sim.simulation.view import Camera, Orbit

ROOM = 1.8
"""A followed body gets a picture this many times its size."""

SAMPLES = 240
"""Moments at which the distance of a moving camera is fitted."""


class CameraPath:
    """One camera over time.

    low, high: corners of the box in m that it should see, where nothing says how far it stands
    times:     [F] s of the frames; an orbit ends with them
    place:     of the camera in the scene, for messages

    Raises SceneError where its eye meets its target at one of `times`.
    """

    def __init__(
        self, camera: Camera, low: np.ndarray, high: np.ndarray, times: np.ndarray, place: str = "camera"
    ) -> None:
        self._camera, self._place = camera, place
        self._low, self._high = np.asarray(low, float), np.asarray(high, float)
        self._end = float(times[-1])
        self._still: Cameras | None = None
        self._forward = np.array([1.0, 0.0, 0.0])
        if camera.still:
            try:
                self._still = frame_camera(
                    low,
                    high,
                    azimuth=camera.azimuth,
                    elevation=camera.elevation,
                    fov=camera.fov,
                    width=camera.width,
                    height=camera.height,
                    eye=camera.eye,
                    target=camera.target,
                    distance=camera.distance,
                )
            except ValueError:
                middle = [round(float(x), 6) for x in 0.5 * (self._low + self._high)]
                raise SceneError(
                    f"{place}: eye {list(camera.eye or ())} is the middle of what it should look at "
                    f"({middle}); give another eye, or a target"
                ) from None
            return
        self._fov = self._track("fov", [camera.fov])
        self._azimuth = self._track("azimuth", [camera.azimuth])
        self._elevation = self._track("elevation", [camera.elevation])
        target = 0.5 * (self._low + self._high) if camera.target is None else np.asarray(camera.target)
        self._target = self._track("target", target.tolist())
        self._sampled = times if len(times) <= SAMPLES else np.linspace(times[0], times[-1], SAMPLES)
        self._distance: Track | None = None
        self._eye: Track | None = None
        if camera.follow is None:
            self._place_eye(None)
            for time in times.tolist():
                if np.linalg.norm(np.subtract(*self._line(time, None))) < 1e-6:
                    raise SceneError(
                        f"{place}: eye and target meet at {time:g} s, at "
                        f"{[round(float(x), 4) for x in self._line(time, None)[1]]}; move a keyframe, or "
                        "write `interpolation: linear`"
                    )

    @property
    def by_eye(self) -> bool:
        """Whether places of the eye are given, not angles."""
        camera = self._camera
        return camera.eye is not None or any(key.eye is not None for key in camera.motion)

    def first_azimuth(self, studio: Studio) -> float:
        """Degrees at which it stands at the start; of one that goes along with a body, roughly."""
        camera = self._camera
        if camera.follow is None:
            return studio.seen_from(self.at(0.0).positions[0])
        if self.by_eye:
            given = [key.eye for key in camera.motion if key.eye is not None]
            return studio.seen_from(camera.eye or given[0])
        return float(self._azimuth.at(0.0)[0]) + self._turned(0.0)

    def follow(self, low: np.ndarray, high: np.ndarray) -> None:
        """The box in m of the body that it follows, at the start; needed before `at`."""
        middle, half = 0.5 * (low + high), 0.5 * ROOM * (high - low)
        self._low, self._high = middle - half, middle + half
        self._place_eye(middle)

    def at(self, time: float, followed: np.ndarray | None = None) -> Cameras:
        """The view at a time in s; followed: [3] m, middle of the body that it follows."""
        if self._still is not None:
            return self._still
        eye, target = self._line(time, followed)
        reach = float(np.linalg.norm(target - eye))
        if reach < 1e-6:  # a body that is followed has come to the eye
            target = eye + self._forward
        else:
            self._forward = (target - eye) / reach
        camera = self._camera
        return Cameras.look_at(
            eye,
            target,
            vertical_fov=math.radians(float(self._fov.at(time)[0])),
            width=camera.width,
            height=camera.height,
        )

    def _track(self, name: str, own: Sequence[float]) -> Track:
        """Keyframes of one value, from the camera's own at time 0."""
        keys = []
        for key in self._camera.motion:
            value = getattr(key, name)
            if value is not None:
                keys.append((key.time, value if isinstance(value, tuple) else (value,)))
        if not keys or keys[0][0] > 0.0:
            keys.insert(0, (0.0, tuple(own)))
        return Track(keys, self._camera.interpolation == "smooth", within=len(own) == 1)

    def _place_eye(self, followed: np.ndarray | None) -> None:
        """Find what keyframes of the eye, or of the distance, start from."""
        camera = self._camera
        own = camera.distance
        if own is None and camera.eye is None:
            moments = self._sampled[:1] if self.by_eye else self._sampled
            own = max(
                fitting_distance(
                    self._low,
                    self._high,
                    self._target.at(time) if followed is None else followed,
                    azimuth=float(self._azimuth.at(time)[0]) + self._turned(time),
                    elevation=float(self._elevation.at(time)[0]),
                    fov=camera.fov,
                    width=camera.width,
                    height=camera.height,
                )
                for time in moments.tolist()
            )
        if not self.by_eye:
            assert own is not None  # angles exclude an eye
            self._distance = self._track("distance", [own])
            return
        eye = camera.eye
        if eye is None:
            assert own is not None
            target = self._target.at(0.0) if followed is None else followed
            x, y, z = target + own * self._outward(0.0)
            eye = (float(x), float(y), float(z))
        self._eye = self._track("eye", list(eye))

    def _outward(self, time: float) -> np.ndarray:
        a = math.radians(float(self._azimuth.at(time)[0]))
        e = math.radians(float(self._elevation.at(time)[0]))
        return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])

    def _turned(self, time: float) -> float:
        """Degrees that the orbit has turned."""
        orbit = self._camera.orbit
        return 0.0 if orbit is None else _orbit_angle(orbit, time, self._end)

    def _line(self, time: float, followed: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Eye and target [3] m."""
        camera = self._camera
        if camera.follow is None:
            target = self._target.at(time)
        else:
            assert followed is not None
            target = followed + np.asarray(camera.follow.offset)
        if self._eye is not None:
            away = self._eye.at(time) - target
        else:
            assert self._distance is not None
            away = float(self._distance.at(time)[0]) * self._outward(time)
        turn = math.radians(self._turned(time))
        if turn != 0.0:
            c, s = math.cos(turn), math.sin(turn)
            away = np.array([c * away[0] - s * away[1], s * away[0] + c * away[1], away[2]])
        return target + away, target


def _orbit_angle(orbit: Orbit, time: float, end: float) -> float:
    last = end if orbit.end is None else orbit.end
    length = last - orbit.start
    if length <= 0.0:
        return 0.0
    total = 360.0 * (1.0 if orbit.turns is None else orbit.turns)
    if orbit.period is not None:
        total = 360.0 * length / orbit.period
    if orbit.rate is not None:
        total = orbit.rate * length
    share = min(max((time - orbit.start) / length, 0.0), 1.0)
    if orbit.ease:
        share = share * share * (3.0 - 2.0 * share)
    return total * share


class Follower:
    """The smoothed middle of a body, frame after frame.

    It answers as a critically damped spring with a damper against the body's velocity: x'' = w^2 (c - x) +
    2 w (c' - x'), w = 1 / smoothing, solved exactly for a middle c that goes straight from frame to frame. A
    body at constant velocity is followed without lag, one at constant acceleration a with a lag of
    a smoothing^2.

    smoothing: s; 0 follows exactly
    interval:  s between frames
    """

    def __init__(self, body: BoundGaussians, smoothing: float, interval: float) -> None:
        vertices = body.vertices.double().cpu().numpy()
        faces = body.faces.long().cpu().numpy()
        a, b, c = (vertices[faces[:, k]] for k in range(3))
        areas = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
        weights = np.zeros(len(vertices))
        for k in range(3):
            np.add.at(weights, faces[:, k], areas)
        if weights.sum() <= 0.0:
            weights[:] = 1.0
        self._weights = weights / weights.sum()
        self._smoothing, self._interval = smoothing, interval
        self._middle: np.ndarray | None = None
        self._velocity: np.ndarray | None = None
        self._lag, self._lag_velocity = np.zeros(3), np.zeros(3)

    def next(self, vertices: np.ndarray) -> np.ndarray:
        """[3] m, at the next frame, whose vertices are [V, 3] m."""
        middle = self._weights @ vertices.astype(np.float64)
        if self._middle is not None and self._smoothing > 0.0:
            velocity = (middle - self._middle) / self._interval
            if self._velocity is not None:  # the camera starts with the body's own velocity
                self._lag_velocity = self._lag_velocity + velocity - self._velocity
            self._velocity = velocity
            w, dt = 1.0 / self._smoothing, self._interval
            decay = math.exp(-w * dt)
            drift = self._lag_velocity + w * self._lag
            self._lag_velocity = decay * (self._lag_velocity - w * dt * drift)
            self._lag = decay * (self._lag + dt * drift)
        self._middle = middle
        smoothed: np.ndarray = middle - self._lag
        return smoothed


__all__ = ["CameraPath", "Follower"]
