"""What asset and simulation files look like: pictures of them, and their Gaussians."""

from __future__ import annotations

import difflib
import logging
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset, kind
from gdpro_sim.cameras import Cameras
from gdpro_sim.device import resolve_device, serial_torch
from gdpro_sim.errors import RequestError, SceneError
from gdpro_sim.files import atomic_write, prepare_folder, remove_stale
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.images import frame_name, read_png, remove_frames_from, write_png, write_video
from gdpro_sim.io.obstacles import Obstacles
from gdpro_sim.io.passes import check_passes, remove_passes_from, write_exr
from gdpro_sim.io.preview import Renderer, Studio
from gdpro_sim.io.staging import Scenery, Staging, named_cameras
from gdpro_sim.io.turntable import studio_around, turntable_cameras
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.simulation.callbacks import Callback
from gdpro_sim.simulation.colliders import Collider, MeshCollider, compile_collider
from gdpro_sim.simulation.frame import Frame
from gdpro_sim.simulation.scene import Scene, check_scene, read_mapping
from gdpro_sim.simulation.view import MAIN

logger = logging.getLogger(__name__)

VIEW_KEYS = ("camera", "cameras", "lights", "render")
"""Of a scene: how it is looked at."""

TURNED = {"azimuth", "elevation", "distance"}
"""Values of a camera that say where it stands."""

Drawn = tuple[np.ndarray, dict[str, np.ndarray]]
"""A picture and its passes."""


@dataclass(frozen=True)
class Look:
    """How a file is looked at, where it is not as its scene says.

    camera:     name of one of the scene's cameras
    view:       keys `camera`, `cameras`, `lights`, `render` as a scene has them, in place of the scene's
    changes:    of the camera: azimuth, elevation, fov in degrees, distance in m, width and height in pixels;
                a direction given here makes it stand still
    orbit:      turns about the target, over all frames
    lights:     as a scene has them, or the name of a set
    render:     changes of `render`: shading, background, exposure, catch_shadows
    """

    camera: str = MAIN
    view: dict[str, Any] = field(default_factory=dict)
    changes: dict[str, Any] = field(default_factory=dict)
    orbit: float | None = None
    lights: Any = None
    render: dict[str, Any] = field(default_factory=dict)

    def apply(self, scene: dict[str, Any], bodies: Sequence[str], duration: float, source: str) -> Scene:
        """A scene with these cameras and lights; `scene` has what is not said here.

        Raises SceneError or RequestError where they are not right, or the camera is unknown.
        """
        unknown = sorted(set(self.view) - set(VIEW_KEYS))
        if unknown:
            raise RequestError(f"a view has the keys {', '.join(VIEW_KEYS)}; got {', '.join(unknown)}")
        names = [name for name in bodies if re.fullmatch("[A-Za-z_][A-Za-z0-9_]*", name)] or ["body"]
        data: dict[str, Any] = {key: scene[key] for key in VIEW_KEYS if key in scene} | self.view
        data |= {"bodies": [{"asset": "-", "name": name} for name in names], "duration": duration}
        if self.lights is not None:
            data["lights"] = self.lights
        data["render"] = {**(data.get("render") or {}), **self.render}
        checked = check_scene(data, source)
        cameras = named_cameras(checked.camera, checked.cameras)
        if self.camera not in cameras:
            near = difflib.get_close_matches(self.camera, cameras, n=1)
            hint = f" (did you mean {near[0]!r}?)" if near else ""
            raise RequestError(
                f"{source}: there is no camera {self.camera!r}{hint}; cameras: {', '.join(cameras)}"
            )
        chosen = cameras[self.camera].model_dump(mode="json", exclude={"name", "preview"}) | self.changes
        if TURNED & set(self.changes):
            chosen |= {"eye": None, "motion": (), "orbit": None}
        if self.orbit is not None:
            chosen["orbit"] = {"turns": self.orbit}
        if chosen == checked.camera.model_dump(mode="json"):
            return checked
        return check_scene({**data, "camera": chosen, "cameras": ()}, source)


def read_view(path: str | Path) -> dict[str, Any]:
    """What a YAML file says of cameras and lights. Raises SceneError."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SceneError(f"{path}: cannot be read as text: {error}") from None
    return read_mapping(text, str(path), f"a view is a mapping of some of {', '.join(VIEW_KEYS)}")


@serial_torch()
def render_file(
    file: str | Path,
    output: str | Path,
    *,
    views: int = 24,
    look: Look | None = None,
    passes: Sequence[str] = (),
    pass_format: str = "exr",
    video: bool = False,
    fps: float | None = None,
    device: str = "auto",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[Path]:
    """Write `frame_00000.png` … into the folder `output` and return the paths.

    A simulation is drawn once per frame. An asset is drawn from `views` sides, or where its camera moves,
    `views` times at `fps` frames per second.

    passes: of "depth", "normal" and "alpha", see `Renderer.passes`: `depth_00000.exr` … (float32, exact), or
            with `pass_format` "npz" all in `passes_00000.npz`
    video:  also write `preview.mp4`, with `fps` frames per second; default: the simulation's, 24 of an asset

    Raises RequestError or AssetError for a file that is neither, SceneError for a camera that cannot be.
    """
    path, folder = Path(file), Path(output)
    name, look = resolve_device(device), look or Look()
    wanted = check_passes(passes)
    if pass_format not in ("exr", "npz"):
        raise RequestError(f"passes are written as exr or npz, got {pass_format!r}")
    if fps is not None and not fps > 0.0:
        raise RequestError(f"fps must be > 0, got {fps:g}")
    if _kind(path) == "asset":
        rate, total = fps or 24.0, views
        frames = _asset_frames(path, look, views, rate, name, bool(wanted))
    else:
        reader = SimulationReader(path)
        rate, total = fps or reader.fps, len(reader)
        frames = _simulation_frames(reader, look, name, bool(wanted))
    report = on_progress or (lambda phase, done, total: None)
    prepare_folder(folder, frame_name(0))
    remove_stale(folder)
    written: list[Path] = []
    for picture, found in frames:
        index = len(written)
        written.append(folder / frame_name(index))
        write_png(written[-1], picture)
        kept = {what: found[what] for what in wanted}
        if kept and pass_format == "npz":
            with atomic_write(folder / f"passes_{index:05d}.npz") as temporary:
                np.savez_compressed(temporary, **kept)  # type: ignore[arg-type]
        elif kept:
            for what, image in kept.items():
                write_exr(folder / f"{what}_{index:05d}.exr", image)
        report("render", len(written), total)
    remove_frames_from(folder, total)
    remove_passes_from(folder, total if wanted else 0)
    if video:
        write_video(folder / "preview.mp4", (read_png(picture) for picture in written), rate)
    return written


def _asset_frames(
    path: Path, look: Look, views: int, fps: float, device: str, passes: bool
) -> Iterator[Drawn]:
    """Pictures of an asset at rest."""
    scene = look.apply({}, [path.stem], views / fps, path.name)
    if scene.camera.follow is not None:
        raise RequestError(f"{path.name} is an asset at rest: there is nothing to follow")
    bound = Asset.load(path).gaussians.to(device)
    gaussians, normals = bound.gaussians(), bound.normals()
    low, high = bound.vertices.amin(0).cpu().numpy(), bound.vertices.amax(0).cpu().numpy()
    studio = _with_render(studio_around(low, high, float(low[2]), "studio", "studio"), scene)
    times = np.arange(views) / fps
    turntable = scene.camera.still and scene.camera.eye is None
    described = {"azimuth", "elevation", "distance", "fov", "width", "height", "target"}
    around = turntable_cameras(low, high, views, scene.camera.model_dump(include=described))
    still = [bound.vertices.cpu().numpy()]
    staging = Staging({MAIN: scene.camera}, scene.lights, low, high, times, [(path.stem, bound)], studio)
    renderer = Renderer(around, studio if turntable else staging.studio)

    def pictures() -> Iterator[Drawn]:
        for index in range(views):
            shot = staging.next(still)
            view, lights = shot.cameras[MAIN], shot.lights
            if turntable:  # it turns before lights that stand still
                view = renderer.cameras[index]
                lights = staging.lights_at(times[index], studio.seen_from(view.positions[0]))
            maps = renderer.shadows(gaussians, view, None if shot.studio else lights)
            picture = renderer.render(gaussians, normals, view, maps)
            yield picture, renderer.passes(gaussians, normals, view) if passes else {}

    return pictures()


def _simulation_frames(reader: SimulationReader, look: Look, device: str, passes: bool) -> Iterator[Drawn]:
    """Pictures of a simulation, which shows what the run's own pictures show unless `look` says otherwise."""
    recorded, preview = reader.metadata.get("scene") or {}, reader.metadata.get("preview")
    scene = look.apply(recorded, reader.body_names, max(reader.times[-1], 1e-3), reader.path.name)
    if preview is None:
        boxes = np.array([_bounds(reader.frame(i)) for i in sorted({0, len(reader) // 2, len(reader) - 1})])
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        studio = studio_around(low, high, None, "studio", "studio")
    else:
        low, high = np.asarray(preview["low"]), np.asarray(preview["high"])
        studio = Studio(**preview["studio"])
    if not scene.lights and (TURNED & set(look.changes) or "camera" in look.view):
        studio = replace(studio, azimuth=None)  # the key light stands beside the new camera
    bodies = [(body.name, body.gaussians.to(device)) for body in reader.bodies]
    staging = Staging(
        {MAIN: scene.camera},
        scene.lights,
        low,
        high,
        np.asarray(reader.times),
        bodies,
        _with_render(studio, scene),
    )
    scenery = Scenery(
        [bound for _, bound in bodies], _obstacles(reader, device, staging.first), staging.studio, device
    )

    def pictures() -> Iterator[Drawn]:
        for frame in reader:
            shot = staging.next([body.vertices for body in frame.bodies])
            yield scenery.draw(frame, shot, [MAIN], passes)[MAIN]

    return pictures()


def _with_render(studio: Studio, scene: Scene) -> Studio:
    return replace(studio, **scene.render.model_dump())


def _obstacles(reader: SimulationReader, device: str, view: Cameras | None) -> Obstacles:
    """What the bodies of a recorded scene meet, and parts of a base."""
    scene, preview = reader.metadata.get("scene"), reader.metadata.get("preview")
    if scene is None or preview is None or not (scene.get("colliders") or reader.links):
        return Obstacles((), np.zeros(3), np.ones(3), device)
    colliders: list[Collider] = []
    for number, options in enumerate(Scene.model_validate(scene).colliders):
        if isinstance(options.motion, Callback):  # the frames say where it was: no code runs here
            options = options.model_copy(update={"motion": ()})
        if isinstance(options, MeshCollider):
            if options.visible and number not in reader.obstacles:
                logger.warning("collider %r is not drawn: %s does not hold it", options.name, reader.path)
            seen = reader.obstacles.get(number, Collider(options.name, "box", visible=False))
            motion = options.compiled(np.asarray(options.position)) if options.motion else None
            colliders.append(replace(seen, motion=motion))
        else:
            colliders.append(compile_collider(options))
    box = np.asarray(preview["low"]), np.asarray(preview["high"])
    return Obstacles([*colliders, *reader.links], *box, device, view)


def gaussians_of(file: str | Path, frame: int = 0) -> Gaussians:
    """The Gaussians of an asset at rest, or of one frame of a simulation, all bodies together.

    Raises RequestError for a file that is neither, or a frame past the end.
    """
    path = Path(file)
    if _kind(path) == "asset":
        return Asset.load(path).gaussians.gaussians()
    reader = SimulationReader(path)
    if frame >= len(reader):
        raise RequestError(f"{path} has frames 0-{len(reader) - 1}, got {frame}")
    return reader.frame(frame).gaussians()


def _kind(path: Path) -> str:
    what = kind(path)
    if what not in ("asset", "simulation"):
        raise RequestError(
            f"{path} is neither an asset nor a simulation; turn a mesh into an asset first: "
            f"gdpro import {path} -o {path.stem}.usdc"
        )
    return what


def _bounds(frame: Frame) -> tuple[np.ndarray, np.ndarray]:
    points = np.concatenate([body.vertices for body in frame.bodies])
    return points.min(axis=0), points.max(axis=0)


__all__ = ["Look", "gaussians_of", "read_view", "render_file"]
