"""Cameras and lights of a scene, frame after frame, and the pictures of its frames."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from pydantic import TypeAdapter

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.camera_paths import CameraPath, Follower
from gdpro_sim.io.facing import Facing
from gdpro_sim.io.lighting import GAMMA, LightState
from gdpro_sim.io.obstacles import Obstacles
from gdpro_sim.io.preview import Renderer, Studio
from gdpro_sim.io.tracks import Track
from gdpro_sim.meshing.load import parse_color
from gdpro_sim.simulation.frame import Frame
from gdpro_sim.simulation.lights import LIGHTS, DistantLight, LightOptions
from gdpro_sim.simulation.view import MAIN, Camera, NamedCamera

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Shot:
    """How one moment is seen.

    cameras: one view each, by name
    focus:   [3] m, what a camera follows, by its name; the floor fades out around it
    lights:  as they are then
    studio:  whether they are the studio's own, which are drawn as they always were
    """

    cameras: dict[str, Cameras]
    focus: dict[str, tuple[float, float, float]]
    lights: tuple[LightState, ...]
    studio: bool


class Staging:
    """The cameras and lights of a scene; frames are asked for one after the other, from the first.

    cameras:   by name, the main one first
    lights:    none for the studio's
    low, high: corners of the box in m that cameras should see, where nothing says where they stand
    times:     [F] s of the frames
    bodies:    (name, binding) of each
    studio:    what surrounds them; `Staging.studio` is the same with lights beside the first camera

    Raises SceneError where a camera's eye meets its target.
    """

    def __init__(
        self,
        cameras: dict[str, Camera],
        lights: Sequence[LightOptions],
        low: np.ndarray,
        high: np.ndarray,
        times: np.ndarray,
        bodies: Sequence[tuple[str, BoundGaussians]],
        studio: Studio,
    ) -> None:
        self._cameras = cameras
        self._times = times
        self._paths = {
            name: CameraPath(camera, low, high, times, _place(name)) for name, camera in cameras.items()
        }
        self._names = [name for name, _ in bodies]
        self._faces = [bound.faces for _, bound in bodies]
        interval = float(times[1] - times[0]) if len(times) > 1 else 1.0
        self._followers = {
            name: Follower(bodies[self._followed(camera)][1], camera.follow.smoothing, interval)
            for name, camera in cameras.items()
            if camera.follow is not None
        }
        self._own_lights = bool(lights)
        self._lamps = [_Lamp(light) for light in lights or _studio_lights()]
        self._inside: set[tuple[str, str]] = set()
        self._next = 0
        if studio.azimuth is None:
            studio = replace(studio, azimuth=self._paths[next(iter(cameras))].first_azimuth(studio))
        self.studio = studio

    def next(self, surfaces: Sequence[np.ndarray]) -> Shot:
        """How the next frame is seen, whose bodies have their vertices [V, 3] m at `surfaces`."""
        time = float(self._times[self._next])
        views, focus = {}, {}
        for name, camera in self._cameras.items():
            middle = None
            if camera.follow is not None:
                vertices = surfaces[self._followed(camera)]
                middle = self._followers[name].next(vertices)
                x, y, z = middle.tolist()
                focus[name] = (x, y, z)
                if self._next == 0:
                    low, high = vertices.min(axis=0).astype(float), vertices.max(axis=0).astype(float)
                    self._paths[name].follow(low, high)
            views[name] = self._paths[name].at(time, middle)
            self._warn_inside(name, views[name], surfaces)
        self._next += 1
        assert self.studio.azimuth is not None
        return Shot(views, focus, self.lights_at(time, self.studio.azimuth), not self._own_lights)

    @property
    def first(self) -> Cameras | None:
        """Where the main camera first stands; None for one that goes along with a body."""
        name, camera = next(iter(self._cameras.items()))
        return None if camera.follow is not None else self._paths[name].at(0.0)

    def lights_at(self, time: float, azimuth: float) -> tuple[LightState, ...]:
        """The lights at a time in s; azimuth: degrees, of the camera that some of them stand beside."""
        return tuple(lamp.at(time, azimuth) for lamp in self._lamps)

    def _followed(self, camera: Camera) -> int:
        assert camera.follow is not None
        return self._names.index(camera.follow.body)

    def _warn_inside(self, name: str, view: Cameras, surfaces: Sequence[np.ndarray]) -> None:
        """Say once that a camera is in a body: it sees its inside."""
        eye = view.positions[0].double().numpy()
        for body, faces, vertices in zip(self._names, self._faces, surfaces, strict=True):
            if (name, body) in self._inside:
                continue
            if (eye < vertices.min(axis=0)).any() or (eye > vertices.max(axis=0)).any():
                continue
            if abs(_winding(eye, vertices.astype(np.float64), faces.cpu().numpy())) > 0.5:
                self._inside.add((name, body))
                log.warning(
                    "%s is inside %s at %.2f s", _place(name), body, self._times[self._next]
                )  # fmt: skip


def named_cameras(main: Camera, more: Sequence[NamedCamera]) -> dict[str, Camera]:
    """A scene's cameras by name, the main one first."""
    return {MAIN: main, **{camera.name: camera for camera in more}}


def _place(name: str) -> str:
    return "camera" if name == MAIN else f"cameras[{name}]"


def _winding(point: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> float:
    """How often a surface winds about a point (Van Oosterom and Strackee 1983): 1 inside a closed one."""
    a, b, c = (vertices[faces[:, k]] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(side, axis=1) for side in (a, b, c))
    volume = np.einsum("ij,ij->i", a, np.cross(b, c))
    dots = [np.einsum("ij,ij->i", x, y) for x, y in ((a, b), (b, c), (c, a))]
    angles = np.arctan2(volume, la * lb * lc + dots[0] * lc + dots[1] * la + dots[2] * lb)
    return float(angles.sum() / (2.0 * np.pi))


class _Lamp:
    """One light over time."""

    def __init__(self, light: LightOptions) -> None:
        self._light = light
        red, green, blue = (channel**GAMMA for channel in parse_color(light.color))
        self._color = (red, green, blue)
        self._intensity = self._track("intensity")
        if isinstance(light, DistantLight):
            self._azimuth, self._elevation = self._track("azimuth"), self._track("elevation")

    def _track(self, name: str) -> Track:
        keys = [
            (key.time, (getattr(key, name),)) for key in self._light.motion if getattr(key, name) is not None
        ]
        if not keys or keys[0][0] > 0.0:
            keys.insert(0, (0.0, (getattr(self._light, name),)))
        return Track(keys, self._light.interpolation == "smooth", within=True)

    def at(self, time: float, azimuth: float) -> LightState:
        """At a time in s; azimuth: degrees, where the main camera first stands."""
        light = self._light
        intensity = float(self._intensity.at(time)[0])
        if not isinstance(light, DistantLight):
            return LightState(None, intensity, self._color)
        if light.direction is not None:
            towards = -np.asarray(light.direction) / np.linalg.norm(light.direction)
        else:
            a = np.radians(float(self._azimuth.at(time)[0]) + (azimuth if light.relative else 0.0))
            e = np.radians(float(self._elevation.at(time)[0]))
            towards = np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
        x, y, z = towards.tolist()
        return LightState((x, y, z), intensity, self._color, light.softness)


def _studio_lights() -> list[LightOptions]:
    """What stands for the studio's lights in other programs."""
    return TypeAdapter(list[LightOptions]).validate_python(LIGHTS["studio"])


class Scenery:
    """Pictures of frames: bodies and obstacles, in a studio, under the lights of a shot.

    bodies: bindings, in the order of the frames' bodies, on the device that draws
    """

    def __init__(
        self, bodies: Sequence[BoundGaussians], obstacles: Obstacles, studio: Studio, device: str = "cpu"
    ) -> None:
        self._facing = Facing(bodies)
        self._obstacles = obstacles
        self._device = device
        self._renderer = Renderer(studio=studio)

    def draw(
        self, frame: Frame, shot: Shot, names: Sequence[str], passes: bool = False
    ) -> dict[str, tuple[np.ndarray, dict[str, np.ndarray]]]:
        """Picture, and passes (see `Renderer.passes`) where asked for, of the cameras `names`."""
        gaussians: Gaussians = frame.gaussians().to(self._device)
        lights = None if shot.studio else shot.lights
        shown: tuple[Gaussians, torch.Tensor] | None = None
        maps = None
        drawn = {}
        for name in names:
            view = shot.cameras[name]
            if shown is None or self._facing.turns:
                normals = self._facing.normals([body.vertices for body in frame.bodies], view)
                shown = self._obstacles.added_to(gaussians, normals, frame.time, frame.colliders)
            if maps is None:
                maps = self._renderer.shadows(shown[0], view, lights)
            picture = self._renderer.render(*shown, view, maps, shot.focus.get(name))
            drawn[name] = picture, self._renderer.passes(*shown, view) if passes else {}
        return drawn


__all__ = ["Scenery", "Shot", "Staging", "named_cameras"]
