"""Run a scene and write everything: asset, time-sampled USD, pictures, video, contact sheet, metrics.

Every finished frame is kept in `.resume/` (solver state, surfaces, figures) until the run is complete, so a
run that was stopped or killed continues where it was, to the same bytes.
"""

from __future__ import annotations

import csv
import glob
import hashlib
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

import gdpro_sim
from gdpro_sim.asset import Asset
from gdpro_sim.device import resolve_device, serial_torch
from gdpro_sim.errors import RequestError
from gdpro_sim.files import atomic_write, claimed, prepare_folder, remove_stale, sha256_of
from gdpro_sim.io.images import (
    frame_name,
    read_png,
    remove_frames_from,
    spread,
    write_contact_sheet,
    write_png,
    write_video,
)
from gdpro_sim.io.obstacles import Obstacles, with_obstacles
from gdpro_sim.io.preview import Studio
from gdpro_sim.io.resume import Store, StoredFrame
from gdpro_sim.io.staging import Scenery, Staging, named_cameras
from gdpro_sim.io.usd import SimulationWriter, body_records
from gdpro_sim.simulation.callbacks import Callback, callbacks_of, with_code
from gdpro_sim.simulation.compile import check_files, check_supported, load_assets
from gdpro_sim.simulation.model import Diagnostics
from gdpro_sim.simulation.placement import material_of
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import Scene, load_scene
from gdpro_sim.simulation.scene_body import SceneBody
from gdpro_sim.simulation.view import MAIN

Progress = Callable[[str, int, int], None]
"""Called with (phase, done, total); total 0 means the length is not known."""

RESUME_FORMAT = 2
"""Raise it when frames of an earlier version must not be continued."""

IMPLICIT = ("newton_iterations", "cg_iterations", "residual", "converged", "contact_energy", "force_energy")
"""Figures that the explicit MPM has not: its metrics leave them out."""

SPREAD = 0.3
"""How far to each side pictures expect matter to flow, as a multiple of its height at the start."""

WIDE = 6.0
"""Walls this many times further apart than a body is wide are not shown whole."""

PHASES = ("solve", "resplat", "render", "write")


@dataclass
class Recording:
    """Where the results lie and how long each phase took (seconds of this run)."""

    output: Path
    assets: list[Path]
    simulation: Path
    frames: Path
    video: Path
    contact_sheet: Path
    metrics: Path
    frame_count: int
    resumed_frames: int
    gaussians: int
    tets: int
    particles: int
    more_videos: list[str] = field(default_factory=list)
    seconds: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain data for `--json`."""
        data = {k: str(v) if isinstance(v, Path) else v for k, v in asdict(self).items()}
        return {**data, "assets": [str(path) for path in self.assets]}


@serial_torch()
def record(
    scene: Scene | str | Path,
    output: str | Path,
    *,
    device: str = "auto",
    fresh: bool = False,
    allow_code: bool = False,
    on_progress: Progress | None = None,
) -> Recording:
    """Simulate `scene` and write its results into the folder `output`.

    `allow_code` lets the Python files run that the scene names (`motion: {callback: …}`).

    A run of the same scene that was interrupted there is continued, unless `fresh`. Raises RequestError (also
    SceneError, MeshError, AssetError, DeviceError) before anything runs, also where another run writes into
    that folder, SolverError or OutputError later; finished frames stay on disk and the next call continues
    after them.
    """
    checked = with_code(scene if isinstance(scene, Scene) else load_scene(scene), allow_code)
    device = resolve_device(device)
    with claimed(output):
        return _record(checked, output, device, fresh, on_progress or (lambda phase, done, total: None))


def _record(checked: Scene, output: str | Path, device: str, fresh: bool, report: Progress) -> Recording:
    begin = time.perf_counter()
    seconds: dict[str, float] = {}
    check_supported(checked)
    if any(body.prompt is not None for body in checked.bodies):
        from gdpro_sim.io.generated import with_generated

        checked = with_generated(checked, output, device=device, on_progress=report)
        seconds["generate"] = time.perf_counter() - begin
    check_files(checked)
    names = list(dict.fromkeys(body.source for body in checked.bodies))
    file_names = ["asset.usdc" if len(names) == 1 else f"asset_{name}.usdc" for name in names]
    asset_paths = [Path(output) / file for file in file_names]
    _keep_inputs(checked, asset_paths)
    folder = prepare_folder(output, "simulation.usdc")
    remove_stale(folder)
    for name in _drawn(checked):
        remove_stale(prepare_folder(folder / named("frames", name), frame_name(0)))
    store = Store(folder / ".resume", fingerprint(checked, device), fresh)

    begin = time.perf_counter()
    report("prepare", 0, 0)
    kept = dict(zip(names, asset_paths, strict=True)) if store.has_assets(asset_paths) else None
    assets = load_assets(checked, stored=kept, on_progress=lambda phase: report(phase, 0, 0))
    if kept is None:
        _save_assets(assets, names, asset_paths)
        store.assets_saved(asset_paths)
    simulation = Simulation(checked, assets, device=device)
    seconds["prepare"] = time.perf_counter() - begin

    low, high = reach(checked, simulation)
    studio = studio_of(checked, simulation)
    bodies = [(body.name, body.gaussians) for body in simulation.model.bodies]
    times = np.arange(len(simulation)) / checked.fps
    cameras = named_cameras(checked.camera, checked.cameras)
    staging = Staging(cameras, checked.lights, low, high, times, bodies, studio)
    preview = {"low": low.tolist(), "high": high.tolist(), "studio": asdict(staging.studio)}
    obstacles = Obstacles(simulation.obstacles, low, high, device, staging.first)
    scenery = Scenery([bound for _, bound in bodies], obstacles, staging.studio, device)
    rows = _run(simulation, folder, store, staging, scenery, preview, report)

    begin = time.perf_counter()
    for name in _drawn(checked):
        _write_film(folder, name, len(simulation), checked.fps, report)
    _write_metrics(folder / "metrics.csv", rows)
    seconds.update(
        {phase: sum(row[f"ms_{phase}"] for row in rows[store.resumed :]) / 1e3 for phase in PHASES}
    )
    seconds["video"] = time.perf_counter() - begin
    store.finish()
    model = simulation.model
    return Recording(
        output=folder,
        assets=asset_paths,
        simulation=folder / "simulation.usdc",
        frames=folder / "frames",
        video=folder / "preview.mp4",
        more_videos=[str(folder / named("preview.mp4", c.name)) for c in checked.cameras if c.preview],
        contact_sheet=folder / "contact_sheet.png",
        metrics=folder / "metrics.csv",
        frame_count=len(simulation),
        resumed_frames=store.resumed,
        gaussians=sum(len(body.gaussians) for body in model.bodies),
        tets=len(model.tets),
        particles=0 if model.particles is None else len(model.particles),
        seconds={k: round(v, 3) for k, v in seconds.items()},
    )


def _run(
    simulation: Simulation,
    folder: Path,
    store: Store,
    staging: Staging,
    scenery: Scenery,
    preview: dict[str, Any],
    report: Progress,
) -> list[dict[str, Any]]:
    """Every frame: solve (or take it from an interrupted run), re-splat, draw, write."""
    total = len(simulation)
    model = simulation.model
    explicit = model.particles is not None and model.coupling is None and model.mpm.integrator == "explicit"
    rows: list[dict[str, Any]] = []
    report("simulate", 0, total)
    simulation.solver.reset()
    scene = simulation.scene
    with SimulationWriter(
        folder / "simulation.usdc",
        scene.fps,
        body_records(simulation.model, simulation.assets),
        metadata={
            "scene": scene.model_dump(mode="json"),
            "preview": preview,
            "version": gdpro_sim.__version__,
        },
        gravity=scene.gravity,
        ground=None if scene.ground is None else scene.ground.height,
        colliders=model.colliders,
        links=simulation.obstacles[len(model.colliders) :],
    ) as writer:
        for index in range(total):
            stored = store.load(index)
            if stored is None:
                simulation.advance(index)
                done = StoredFrame(
                    simulation.surfaces(),
                    simulation.solver.diagnostics(),
                    simulation.milliseconds["solve"],
                    simulation.colliders(),
                )
            else:
                done = stored
                if index == store.resumed - 1:
                    simulation.solver.load_state_dict(store.state())
            frame = simulation.frame(index, done.surfaces, done.diagnostics, done.colliders)

            begin = time.perf_counter()
            shot = staging.next(done.surfaces)
            paths = {n: folder / named("frames", n) / frame_name(index) for n in _drawn(scene)}
            missing = [n for n, path in paths.items() if stored is None or not path.exists()]
            pictures = scenery.draw(frame, shot, missing)
            drawn = time.perf_counter()
            for name, (picture, _) in pictures.items():
                write_png(paths[name], picture)
            writer.add(frame, shot)
            if stored is None:
                store.save(index, done, simulation.solver.state_dict())
            written = time.perf_counter()
            milliseconds = {
                "solve": done.solve,
                "resplat": simulation.milliseconds["resplat"],
                "render": 1e3 * (drawn - begin),
                "write": 1e3 * (written - drawn),
            }
            rows.append(_row(index, done.diagnostics, milliseconds, IMPLICIT if explicit else ()))
            report("simulate", index + 1, total)
        report("usd", 0, 0)
        begin = time.perf_counter()
    rows[-1]["ms_write"] += 1e3 * (time.perf_counter() - begin)
    return rows


def named(file: str, camera: str) -> str:
    """Name of a folder or file of one camera: the main one's is `file` itself."""
    stem, dot, suffix = file.partition(".")
    return file if camera == MAIN else f"{stem}_{camera}{dot}{suffix}"


def _drawn(scene: Scene) -> list[str]:
    """Cameras whose pictures a run draws."""
    return [MAIN, *(camera.name for camera in scene.cameras if camera.preview)]


def _write_film(folder: Path, camera: str, count: int, fps: float, report: Progress) -> None:
    """Video and contact sheet of one camera."""
    frames = folder / named("frames", camera)
    pictures = [frames / frame_name(i) for i in range(count)]
    remove_frames_from(frames, count)
    write_video(folder / named("preview.mp4", camera), _read_all(pictures, report), fps)
    chosen = spread(count, 12)
    labels = [f"t = {i / fps:.2f} s" for i in chosen]
    sheet = folder / named("contact_sheet.png", camera)
    write_contact_sheet(sheet, [read_png(pictures[i]) for i in chosen], labels)


def _read_all(pictures: list[Path], report: Progress) -> Iterator[np.ndarray]:
    for done, path in enumerate(pictures):
        report("video", done, len(pictures))
        yield read_png(path)


def _row(
    index: int, diagnostics: Diagnostics, milliseconds: dict[str, float], left_out: tuple[str, ...]
) -> dict[str, Any]:
    """One line of metrics.csv: figures of the solver, then wall milliseconds per phase."""
    row: dict[str, Any] = {"frame": index}
    units = {
        "time": "time_s", "kinetic_energy": "kinetic_energy_J", "elastic_energy": "elastic_energy_J",
        "gravity_energy": "gravity_energy_J", "contact_energy": "contact_energy_J",
        "max_penetration": "max_penetration_m", "force_energy": "force_energy_J",
    }  # fmt: skip
    for key, value in asdict(diagnostics).items():
        if key in left_out:
            continue
        if key in ("momentum", "angular_momentum"):
            unit = "kg_m_per_s" if key == "momentum" else "kg_m2_per_s"
            row.update(
                {f"{key}_{axis}_{unit}": component for axis, component in zip("xyz", value, strict=True)}
            )
        else:
            row[units.get(key, key)] = value
    row.update({f"ms_{phase}": round(value, 3) for phase, value in milliseconds.items()})
    return row


def _write_metrics(path: Path, rows: list[dict[str, Any]]) -> None:
    with atomic_write(path) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def reach(scene: Scene, simulation: Simulation) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the box in m that the camera should show: flight, landing and slide of every body."""
    boxes = []
    motions = simulation.model.animation or (None,) * len(scene.bodies)
    for body, placed, motion in zip(scene.bodies, simulation.model.bodies, motions, strict=True):
        if motion is not None:
            boxes.append(motion.bounds(scene.duration))
            continue
        low, high = placed.surface.min(axis=0).astype(float), placed.surface.max(axis=0).astype(float)
        friction = material_of(body, simulation.assets[body.name]).friction
        for shift in _path(scene, body, low, float((high - low).max()), friction):
            boxes.append((low + shift, high + shift))
        if placed.patches is not None:
            boxes.append(_spread(boxes[-1], simulation.model.mpm.domain))
    low, high = np.min([b[0] for b in boxes], axis=0), np.max([b[1] for b in boxes], axis=0)
    low, high = with_obstacles(simulation.obstacles, low, high, scene.duration)
    if scene.ground is not None:
        low[2] = min(low[2], scene.ground.height)
        spread_out = 0.12 * (high[:2] - low[:2])
        low[:2] -= spread_out
        high[:2] += spread_out
    return low, high


def _spread(
    box: tuple[np.ndarray, np.ndarray], domain: tuple[tuple[float, ...], tuple[float, ...]] | None
) -> tuple[np.ndarray, np.ndarray]:
    """Where matter that flows may come to lie: as far again as it is high, or as walls let it."""
    low, high = box[0].copy(), box[1].copy()
    reach = SPREAD * float(high[2] - low[2])
    low[:2] -= reach
    high[:2] += reach
    if domain is not None:
        walls = np.asarray(domain)[:, :2]
        wide = np.ptp(walls, axis=0) > WIDE * np.ptp(np.stack(box), axis=0)[:2]
        low[:2] = np.where(wide, np.maximum(low[:2], walls[0]), walls[0])
        high[:2] = np.where(wide, np.minimum(high[:2], walls[1]), walls[1])
    return low, high


def _path(scene: Scene, body: SceneBody, low: np.ndarray, size: float, friction: float) -> list[np.ndarray]:
    """Where a body is likely to go, as shifts of its box: a throw, then a slide that friction ends."""
    if body.pins:
        keys = [shift for pin in body.pins for shift in pin.shifts(scene.duration)]
        sag = np.array([0.0, 0.0, -0.3 * size])
        return [np.zeros(3), sag, *keys, *(way + sag for way in keys)]
    shifts: list[np.ndarray] = []
    velocity, gravity = np.asarray(body.velocity), np.asarray(scene.gravity)
    for t in np.linspace(0.0, scene.duration, 60):
        shift = velocity * t + 0.5 * gravity * t * t
        if scene.ground is None:
            shift = np.clip(shift, -2.0 * size, 2.0 * size)
        elif low[2] + shift[2] < scene.ground.height:
            speed = float(np.linalg.norm(velocity[:2]))
            brake = max(friction * abs(float(gravity[2])), 1e-6)
            slide = min(speed / (2.0 * brake), scene.duration - t)
            shift[:2] += velocity[:2] * slide
            shift[2] = scene.ground.height - low[2]
            return [*shifts, shift]
        shifts.append(shift)
    return shifts


def studio_of(scene: Scene, simulation: Simulation) -> Studio:
    sizes = [float(np.ptp(body.surface, axis=0).max()) for body in simulation.model.bodies]
    middle = np.mean([body.surface.mean(axis=0) for body in simulation.model.bodies], axis=0)
    return Studio(
        shading=scene.render.shading,
        background=scene.render.background,
        exposure=scene.render.exposure,
        catch_shadows=scene.render.catch_shadows,
        ground=None if scene.ground is None else scene.ground.height,
        scale=max(sizes),
        focus=(float(middle[0]), float(middle[1]), float(middle[2])),
    )


def _save_assets(assets: dict[str, Asset], names: list[str], paths: list[Path]) -> None:
    for name, path in zip(names, paths, strict=True):
        assets[name].save(path)


def fingerprint(scene: Scene, device: str) -> str:
    """Hash of what decides the frames: scene, files (and those of the same stem), device, versions."""
    versions = f"{gdpro_sim.__version__} {RESUME_FORMAT} {wp.config.version}"
    digest = hashlib.sha256(f"{versions}\n{device}\n{scene.model_dump_json()}".encode())
    for reference in scene.files:
        path = scene.resolve(reference)
        beside = path.parent.glob(f"{glob.escape(path.stem)}.*")  # .mtl, textures, buffers
        inside = path.iterdir() if path.is_dir() else ()
        for file in sorted({path, *beside, *inside}):
            if file.is_file():
                digest.update(sha256_of(file).encode())
    for callback in callbacks_of(scene):
        digest.update(_sampled(scene, callback))
    return digest.hexdigest()


def _sampled(scene: Scene, callback: Callback) -> bytes:
    """What a function of time gives at every frame, until it fails: it may depend on more than its file."""
    values = []
    for index in range(scene.frame_count):
        try:
            values.append(repr(callback.function(index / scene.fps)))  # type: ignore[misc]
        except Exception as error:  # the run will say it when it comes there
            values.append(type(error).__name__)
            break
    return "\n".join(values).encode()


def _keep_inputs(scene: Scene, outputs: list[Path]) -> None:
    """Raise RequestError where a result would be written over a file the scene reads."""
    written = {os.path.realpath(path) for path in outputs}
    for path in map(scene.resolve, scene.files):
        if os.path.realpath(path) in written:
            raise RequestError(
                f"the results would overwrite {path}, which the scene reads; choose another output folder"
            )


__all__ = ["Recording", "fingerprint", "reach", "record", "studio_of"]
