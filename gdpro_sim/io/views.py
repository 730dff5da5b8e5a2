"""What asset and simulation files look like: pictures of them, and their Gaussians."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset, kind
from gdpro_sim.device import resolve_device, serial_torch
from gdpro_sim.errors import MeshError, RequestError
from gdpro_sim.files import prepare_folder, remove_stale
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.facing import Facing
from gdpro_sim.io.images import frame_name, remove_frames_from, write_png
from gdpro_sim.io.obstacles import Obstacles
from gdpro_sim.io.preview import Renderer, Studio, frame_camera
from gdpro_sim.io.turntable import studio_around, turntable_cameras
from gdpro_sim.io.usd import SimulationReader
from gdpro_sim.simulation.callbacks import Callback
from gdpro_sim.simulation.colliders import compile_collider
from gdpro_sim.simulation.frame import Frame
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.view import Camera

logger = logging.getLogger(__name__)


@serial_torch()
def render_file(
    file: str | Path,
    output: str | Path,
    *,
    views: int = 24,
    camera: dict[str, Any] | None = None,
    shading: str = "studio",
    background: str = "studio",
    device: str = "auto",
    on_progress: Callable[[str, int, int], None] | None = None,
) -> list[Path]:
    """Write `frame_00000.png` … into the folder `output` and return the paths.

    An asset is drawn from `views` sides, a simulation once per frame. camera: azimuth, elevation, fov in
    degrees, width and height in pixels; what it leaves out is the simulation's own camera.
    Raises RequestError or AssetError for a file that is neither.
    """
    path, folder = Path(file), Path(output)
    name = resolve_device(device)
    what = _kind(path)
    report = on_progress or (lambda phase, done, total: None)
    prepare_folder(folder, frame_name(0))
    remove_stale(folder)
    written: list[Path] = []

    def write(picture: np.ndarray, total: int) -> None:
        written.append(folder / frame_name(len(written)))
        write_png(written[-1], picture)
        report("render", len(written), total)

    if what == "asset":
        view = {**Camera().model_dump(), **(camera or {})}
        bound = Asset.load(path).gaussians.to(name)
        gaussians, normals = bound.gaussians(), bound.normals()
        low, high = bound.vertices.amin(0).cpu().numpy(), bound.vertices.amax(0).cpu().numpy()
        renderer = Renderer(
            turntable_cameras(low, high, views, view),
            studio_around(low, high, float(low[2]), shading, background),
        )
        for index in range(views):
            write(renderer.render(gaussians, normals, index), views)
        remove_frames_from(folder, views)
        return written
    reader = SimulationReader(path)
    renderer = _recorded(reader, camera or {}, shading, background)
    obstacles = _obstacles(reader, name)
    facing = Facing([body.gaussians.to(name) for body in reader.bodies])
    for frame in reader:
        normals = facing.normals([body.vertices for body in frame.bodies], renderer.cameras[0])
        shown = obstacles.added_to(frame.gaussians().to(name), normals, frame.time, frame.colliders)
        write(renderer.render(*shown), len(reader))
    remove_frames_from(folder, len(reader))
    return written


def _recorded(reader: SimulationReader, camera: dict[str, Any], shading: str, background: str) -> Renderer:
    """A renderer that shows what the run's own pictures show, unless `camera` says otherwise."""
    scene, preview = reader.metadata.get("scene"), reader.metadata.get("preview")
    if scene is None or preview is None:
        boxes = np.array([_bounds(reader.frame(i)) for i in sorted({0, len(reader) // 2, len(reader) - 1})])
        low, high = boxes[:, 0].min(0), boxes[:, 1].max(0)
        view = {**Camera().model_dump(), **camera}
        return Renderer(frame_camera(low, high, **view), studio_around(low, high, None, shading, background))
    view = {**scene["camera"], **camera}
    if {"azimuth", "elevation"} & set(camera):
        view["eye"] = None
    studio = Studio(**{**preview["studio"], "shading": shading, "background": background})
    return Renderer(frame_camera(preview["low"], preview["high"], **view), studio)


def _obstacles(reader: SimulationReader, device: str) -> Obstacles:
    """What the bodies of a recorded scene meet; meshes as far as their files are still found."""
    scene, preview = reader.metadata.get("scene"), reader.metadata.get("preview")
    if scene is None or preview is None or not scene.get("colliders"):
        return Obstacles((), np.zeros(3), np.ones(3), device)
    colliders = []
    for options in Scene.model_validate(scene).colliders:
        if isinstance(options.motion, Callback):  # the frames say where it was: no code runs here
            options = options.model_copy(update={"motion": ()})
        try:
            colliders.append(compile_collider(options, lambda file: Path(reader.path).parent / file))
        except MeshError as error:
            logger.warning("a collider is not drawn: %s", error)
    return Obstacles(colliders, np.asarray(preview["low"]), np.asarray(preview["high"]), device)


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


__all__ = ["gaussians_of", "render_file"]
