"""Datasets: many randomised rollouts of one MuJoCo scene, with states, pictures, depth and labels.

A rollout is a function of the seed and its number alone. Its file `rollout.json` is written last: what has
one is finished and never done again, so a run that was stopped continues to the same bytes, and a dataset
can be made longer.
"""

from __future__ import annotations

import csv
import hashlib
import json
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

import gdpro_sim
from gdpro_sim.asset import Asset
from gdpro_sim.device import resolve_device, serial_torch, set_thread_count, thread_count
from gdpro_sim.errors import OutputError, RequestError, SceneError
from gdpro_sim.files import atomic_write, claimed, prepare_folder, remove_stale, sha256_of
from gdpro_sim.io.perception import CHANNELS, Photographer
from gdpro_sim.io.record import fingerprint
from gdpro_sim.simulation.callbacks import callbacks_of, with_code
from gdpro_sim.simulation.compile import check_files, check_supported, load_assets
from gdpro_sim.simulation.effects import check_effects
from gdpro_sim.simulation.mujoco.batch import run_batch
from gdpro_sim.simulation.mujoco.solver import SolverMuJoCo
from gdpro_sim.simulation.mujoco.trajectory import BACKGROUND, FLOOR, Layout, Trajectory
from gdpro_sim.simulation.mujoco_model import SoftBody
from gdpro_sim.simulation.mujoco_options import MujocoOptions
from gdpro_sim.simulation.placement import material_of
from gdpro_sim.simulation.randomize import Variations, draw, expand
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import Scene, check_scene, load_scene

log = logging.getLogger(__name__)

Progress = Callable[[str, int, int], None]
"""Called with (phase, done, total); total 0 means the length is not known."""

FORMAT, VERSION = "gdpro-rollouts", 1

TOGETHER = 64
"""Rollouts that are simulated at once, at most."""

MEMORY = 512 << 20
"""Bytes that they may take."""

OVERLAP = 0.05
"""Share of the smallest body's size that things may start inside each other without a warning."""

ARRAYS = {
    "time": "[T] s",
    "scales": "[B] of the bodies among `labels`: their size over that of bodies/NAME.npz",
    "positions": "[T, P, 3] m, of each of `poses`: origin of the body's asset frame; of links their own",
    "quaternions": "[T, P, 4] wxyz, w >= 0: turns that frame to the world",
    "centers": "[T, P, 3] m, centres of mass",
    "velocities": "[T, P, 3] m/s, of the centres of mass",
    "angular_velocities": "[T, P, 3] rad/s, world axes",
    "qpos": "[T, Q] of `joints`, in MuJoCo's own order",
    "qvel": "[T, V] of `joints`",
    "controls": "[T, U] of `actuators`",
    "sensors": "[T, S] of `sensors`",
    "vertices.NAME": "[T, V, 3] float32 m, of a soft body's tets, see bodies/NAME.npz",
    "contact_frames": "[M] frame of each contact",
    "contact_labels": "[M, 2] labels of what touches",
    "contact_positions": "[M, 3] m",
    "contact_normals": "[M, 3] unit, from the first to the second",
    "contact_distances": "[M] m, negative where they overlap",
    "contact_forces": "[M, 3] N, on the second, world axes",
    "intrinsics": "[F, C, 3, 3] pixels, of each of `images.cameras`; pixel centres lie at +0.5",
    "extrinsics": "[F, C, 4, 4] world to camera (OpenCV: +z forward, +y down), at each of `images.frames`",
}
"""What stands in a rollout's states.npz: T frames, P poses, C cameras, F frames with pictures."""


@dataclass
class Dataset:
    """Where a dataset lies, and how long its parts took (seconds of this run)."""

    output: Path
    count: int
    resumed: int
    failed: int
    frames: int
    pictures: int
    steps: int
    seconds: dict[str, float] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """Plain data for `--json`."""
        return {**asdict(self), "output": str(self.output)}


@dataclass(frozen=True)
class _Plan:
    """What all rollouts of a dataset share."""

    scene: Scene
    variations: Variations
    assets: dict[str, Asset]
    layout: Layout
    photographer: Photographer | None
    frames: tuple[int, ...]
    folder: Path
    device: str
    threads: int


@serial_torch()
def rollout(
    scene: Scene | str | Path,
    output: str | Path,
    *,
    count: int,
    seed: int | None = None,
    randomize: dict[str, Any] | str | Path | None = None,
    images: str | int = "last",
    cameras: int = 1,
    channels: Sequence[str] = CHANNELS,
    threads: int | None = None,
    device: str = "auto",
    fresh: bool = False,
    allow_code: bool = False,
    on_progress: Progress | None = None,
) -> Dataset:
    """Run a MuJoCo scene `count` times with values drawn at random, and write a dataset into a folder.

    randomize: paths and their ranges in place of the scene's `randomize`, or a YAML file of them
    images:    frames to draw: "none", "last", "all", or a number n for every n-th
    cameras:   views from the scene's `camera`, each with draws of its own
    channels:  of every picture: rgb, depth, segmentation
    threads:   of MuJoCo and of the renderer; default: all
    fresh:     replace the dataset that the folder holds
    allow_code: run the Python files that the scene names; what they give must depend on arguments alone

    A dataset of the same scene, seed and options is continued where it was stopped, and made longer where
    `count` is larger. Raises RequestError (also SceneError, MeshError, AssetError, DeviceError) before
    anything runs, also where another run writes into that folder, OutputError later; finished rollouts stay.
    A rollout that MuJoCo cannot finish is kept as far as it came, with the reason.

        gdpro_sim.rollout("drop.yaml", "dataset", count=200, randomize={"bodies.cup.rotation": "any"})
    """
    checked = _scene_of(scene, seed, randomize)
    if count < 1:
        raise RequestError(f"count must be at least 1, got {count}")
    if cameras < 1:
        raise RequestError(f"cameras must be at least 1, got {cameras}; `images` none draws no pictures")
    if threads is not None and threads < 1:
        raise RequestError(f"threads must be at least 1, got {threads}")
    frames = _picture_frames(images, checked.frame_count)
    for channel in channels:
        if channel not in CHANNELS:
            raise RequestError(f"channels must be of {', '.join(CHANNELS)}, got {channel!r}")
    if frames and not channels:
        raise RequestError("give at least one channel, or `images` none")
    expand(checked, checked.randomize)
    checked = with_code(checked, allow_code)
    check_supported(checked)
    check_files(checked)
    device = resolve_device(device)
    before, wanted = thread_count(), threads or thread_count()
    set_thread_count(wanted)
    try:
        options = {"images": list(frames), "cameras": cameras, "channels": list(channels)}
        with claimed(output):
            return _make(checked, Path(output), count, options, wanted, device, fresh, on_progress)
    finally:
        set_thread_count(before)


def _make(
    scene: Scene,
    output: Path,
    count: int,
    options: dict[str, Any],
    threads: int,
    device: str,
    fresh: bool,
    on_progress: Progress | None,
) -> Dataset:
    report = on_progress or (lambda phase, done, total: None)
    seconds: dict[str, float] = dict.fromkeys(("prepare", "simulate", "draw", "write"), 0.0)
    begin = time.perf_counter()
    report("prepare", 0, 0)
    mark = hashlib.sha256(
        f"{VERSION} {mujoco.__version__} {json.dumps(options)} {fingerprint(scene, device)}".encode()
    ).hexdigest()
    folder, known = _open(output, mark, count, fresh)
    assets = _assets(scene, folder, known, lambda phase: report(phase, 0, 0))
    scene = _with_materials(scene, assets)
    variations = expand(scene, scene.randomize)
    frames = tuple(options["images"])
    check_effects(scene, variations, assets, pictures=bool(frames))
    simulation = Simulation(scene, assets, device=device)
    assert isinstance(simulation.solver, SolverMuJoCo)
    layout, photographer = Layout(simulation.solver), None
    if frames:
        views, channels = options["cameras"], tuple(options["channels"])
        photographer = Photographer(simulation, layout, variations, views=views, channels=channels)
    plan = _Plan(scene, variations, assets, layout, photographer, frames, folder, device, threads)
    about = _about(plan, simulation, mark, options)
    _write_json(folder / "dataset.json", {**about, "count": count, "complete": False})
    for body, placed in zip(scene.bodies, simulation.model.bodies, strict=True):
        _write_body(folder / "bodies" / f"{body.name}.npz", assets[body.name], placed.embedding is not None)
    seconds["prepare"] = time.perf_counter() - begin

    missing = [k for k in range(count) if not (_rollout_folder(folder, k) / "rollout.json").is_file()]
    resumed, pictures = count - len(missing), 0
    report("simulate", resumed, count)
    for done in _chunks(plan, missing, simulation, seconds):
        pictures += done
        finished = sum(1 for k in missing if (_rollout_folder(folder, k) / "rollout.json").is_file())
        report("simulate", resumed + finished, count)
    records = [_read_json(_rollout_folder(folder, k) / "rollout.json") for k in range(count)]
    _write_table(folder, records)
    _write_json(folder / "dataset.json", {**about, "count": count, "complete": True})
    _warn_overlap(records, simulation)
    steps = simulation.solver.substeps(1.0 / scene.fps)
    return Dataset(
        output=folder,
        count=count,
        resumed=resumed,
        failed=sum(record["error"] is not None for record in records),
        frames=scene.frame_count,
        pictures=pictures,
        steps=steps * sum(max(0, records[k]["frames"] - 1) for k in missing),
        seconds={key: round(value, 3) for key, value in seconds.items()},
    )


def _warn_overlap(records: list[dict[str, Any]], simulation: Simulation) -> None:
    """Say once that things start inside each other: they fly apart."""
    most = OVERLAP * min(float(np.ptp(body.surface, axis=0).max()) for body in simulation.model.bodies)
    deep = [record["rollout"] for record in records if record["start_penetration"] > most]
    if deep:
        log.warning(
            "%d of %d rollouts start with things more than %.2g m inside each other (first: %d; see "
            "start_penetration): narrow the ranges of positions", len(deep), len(records), most, deep[0],
        )  # fmt: skip


# ---- the request ----


def _scene_of(
    scene: Scene | str | Path, seed: int | None, randomize: dict[str, Any] | str | Path | None
) -> Scene:
    """The scene with its seed and variations. Raises SceneError."""
    checked = scene if isinstance(scene, Scene) else load_scene(scene)
    if not isinstance(checked.solver, MujocoOptions):
        raise SceneError(
            f"{checked.name}: rollouts run in MuJoCo, this scene's solver is {checked.solver.kind}; choose "
            "`solver: {kind: mujoco}`, or `gdpro simulate`, one run at a time"
        )
    given = {key: getattr(checked, key) for key in checked.model_fields_set}
    given["folder"] = checked.folder
    if seed is not None:
        given["seed"] = seed
    source = checked.name
    if randomize is not None:
        given["randomize"] = randomize
        if isinstance(randomize, str | Path):
            given["randomize"], source = _read_variations(Path(randomize)), str(randomize)
    checked = check_scene(given, source)
    if not checked.randomize:
        raise SceneError(
            f"{checked.name}: nothing is drawn at random; give the scene a `randomize:` section, or a file "
            "with one"
        )
    return checked


def _read_variations(path: Path) -> Any:
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        reason = getattr(error, "strerror", None) or error
        raise RequestError(f"{path}: cannot be read as text: {reason}") from None
    except yaml.YAMLError as error:
        raise RequestError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    if isinstance(data, dict) and set(data) == {"randomize"}:
        data = data["randomize"]
    if not isinstance(data, dict) or not data:
        raise RequestError(f"{path}: holds paths and their ranges, such as `gravity.z: [-10, -9.6]`")
    return data


def _picture_frames(images: str | int, frames: int) -> tuple[int, ...]:
    if images == "none":
        return ()
    if images == "last":
        return (frames - 1,)
    if images == "all":
        return tuple(range(frames))
    if str(images).isdigit() and int(images) >= 1:
        return tuple(range(0, frames, int(images)))
    raise RequestError(f"images must be none, last, all, or a number n for every n-th, got {images!r}")


def _with_materials(scene: Scene, assets: dict[str, Asset]) -> Scene:
    """Bodies say what they are made of, so that it can be drawn."""
    bodies = [
        body.model_copy(update={"material": material_of(body, assets[body.name])}) for body in scene.bodies
    ]
    return scene.model_copy(update={"bodies": tuple(bodies)})


# ---- the folder ----


def _rollout_folder(folder: Path, index: int) -> Path:
    return folder / "rollouts" / f"{index:05d}"


def _open(output: Path, mark: str, count: int, fresh: bool) -> tuple[Path, dict[str, Any]]:
    """The folder, and the dataset.json of the same dataset that it holds. Raises RequestError."""
    folder = prepare_folder(output, "dataset.json")
    known: dict[str, Any] = {}
    if (folder / "dataset.json").is_file():
        try:
            known = _read_json(folder / "dataset.json")
        except OutputError:
            pass
    if (not known and any((folder / "rollouts").glob("*"))) or known.get("format", FORMAT) != FORMAT:
        raise RequestError(f"{folder} holds other files named like a dataset's; give another folder")
    if known and (fresh or known.get("fingerprint") != mark):
        if not fresh:
            raise RequestError(
                f"{folder} holds a dataset of another scene, seed, options or version; give another folder, "
                "or --fresh to replace it"
            )
        for name in ("rollouts", "assets", "bodies"):
            shutil.rmtree(folder / name, ignore_errors=True)
        for name in ("parameters.csv", "parameters.npz", "dataset.json"):
            (folder / name).unlink(missing_ok=True)
        known = {}
    if known.get("count", 0) > count:
        raise RequestError(
            f"{folder} holds a dataset of {known['count']} rollouts; give --count {known['count']} or more, "
            "or --fresh to replace it"
        )
    for name in ("rollouts", "assets", "bodies"):
        prepare_folder(folder / name, "x")
        remove_stale(folder / name)
    remove_stale(folder)
    return folder, known


def _assets(
    scene: Scene, folder: Path, known: dict[str, Any], tell: Callable[[str], None]
) -> dict[str, Asset]:
    """Assets as they are stored: tetrahedra are not repeatable. Raises RequestError."""
    paths = {body.name: folder / "assets" / f"{body.source}.usdc" for body in scene.bodies}
    sums = known.get("assets", {})
    if not sums or any(not p.is_file() or sums.get(p.name) != sha256_of(p) for p in paths.values()):
        if any((folder / "rollouts").glob("*/rollout.json")):
            raise RequestError(
                f"{folder}/assets is not what its rollouts were made of; give --fresh to replace the dataset"
            )
        assets = load_assets(scene, on_progress=tell)
        for path in sorted(set(paths.values())):
            name = next(name for name, own in paths.items() if own == path)
            assets[name].save(path)
    return load_assets(scene, stored=paths, on_progress=tell)


def _about(plan: _Plan, simulation: Simulation, mark: str, options: dict[str, Any]) -> dict[str, Any]:
    """dataset.json but for what changes while the dataset grows."""
    layout, scene = plan.layout, plan.scene
    labels = [(BACKGROUND, "background", "none"), (FLOOR, "floor", "none")]
    labels += [(thing.label, thing.name, thing.kind) for thing in layout.things]
    pictures: dict[str, Any] = {"frames": options["images"], "channels": options["channels"]}
    if plan.photographer is not None:
        pictures |= plan.photographer.about()
    joint = ("name", "kind", "qpos", "qpos_size", "qvel", "qvel_size")
    return {
        "format": FORMAT,
        "version": VERSION,
        "fingerprint": mark,
        "made_with": {"gdpro_sim": gdpro_sim.__version__, "mujoco": mujoco.__version__},
        "seed": scene.seed,
        "fps": scene.fps,
        "frames": scene.frame_count,
        "units": "m, kg, s, N, rad (angles of the scene: degrees); Z up; quaternions wxyz",
        "arrays": ARRAYS,
        "labels": [dict(zip(("label", "name", "kind"), row, strict=True)) for row in labels],
        "poses": [thing.name for thing, _ in layout.posed],
        "joints": [dict(zip(joint, row, strict=True)) for row in layout.joints],
        "actuators": list(layout.actuators),
        "sensors": [
            dict(zip(("name", "first", "size"), row, strict=True)) for row in layout.sensors
        ],
        "images": pictures,
        "randomize": [item.model_dump(mode="json", exclude_none=True) for item in plan.variations],
        "assets": {path.name: sha256_of(path) for path in sorted((plan.folder / "assets").glob("*.usdc"))},
        "scene": scene.model_dump(mode="json", exclude={"randomize"}),
    }  # fmt: skip


def _write_body(path: Path, asset: Asset, soft: bool) -> None:
    """Mesh of an asset, in its own frame at the size it was stored in, and tets of a soft body."""
    arrays = {
        "vertices": asset.gaussians.vertices.cpu().numpy(),
        "faces": asset.gaussians.faces.cpu().numpy(),
    }
    if soft and asset.tets is not None and asset.embedding is not None:
        arrays |= {
            "tet_vertices": asset.tets.vertices,
            "tets": asset.tets.tets,
            "embedding_tets": asset.embedding.tet_ids,
            "embedding_weights": asset.embedding.weights,
        }
    _write_npz(path, arrays)


def _write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    with atomic_write(path) as temporary:
        np.savez_compressed(temporary, **arrays)  # type: ignore[arg-type]


def _write_json(path: Path, data: dict[str, Any]) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise OutputError(f"{path}: cannot be read ({error}); delete its folder and run again") from None
    return data if isinstance(data, dict) else {}


def _write_table(folder: Path, records: list[dict[str, Any]]) -> None:
    """parameters.csv and parameters.npz: a row for every rollout."""
    columns: dict[str, list[Any]] = {"rollout": [record["rollout"] for record in records]}
    for path in records[0]["parameters"]:
        columns[path] = [record["parameters"][path] for record in records]
    columns["frames"] = [record["frames"] for record in records]
    columns["start_penetration"] = [record["start_penetration"] for record in records]
    columns["error"] = [record["error"] or "" for record in records]
    _write_npz(folder / "parameters.npz", {key: np.array(values) for key, values in columns.items()})
    flat: dict[str, list[Any]] = {}
    for key, values in columns.items():
        if isinstance(values[0], list):
            for axis in range(len(values[0])):
                flat[f"{key}.{'xyz'[axis]}"] = [value[axis] for value in values]
        else:
            flat[key] = values
    with (
        atomic_write(folder / "parameters.csv") as temporary,
        open(temporary, "w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(flat)
        writer.writerows(zip(*flat.values(), strict=True))


# ---- rollouts ----


def _chunks(plan: _Plan, missing: list[int], nominal: Simulation, seconds: dict[str, float]) -> Iterator[int]:
    """Simulate, draw and write the missing rollouts, some at a time; yields pictures after each of them."""
    assert isinstance(nominal.solver, SolverMuJoCo)
    model = nominal.solver.mjmodel
    surfaces = sum(body.surface.nbytes for body in nominal.model.bodies) * len(plan.frames)
    points = sum(len(b.vertices) for b in nominal.solver.bodies if isinstance(b, SoftBody))
    states = plan.scene.frame_count * (points * 12 + 8 * model.nq)
    gaussians = sum(80 * len(body.gaussians) for body in nominal.model.bodies)
    each = surfaces + states + gaussians + model.narena // 4
    size = int(np.clip(MEMORY // each, min(plan.threads, TOGETHER), TOGETHER))
    for first in range(0, len(missing), size):
        yield from _some(plan, missing[first : first + size], seconds)


def _some(plan: _Plan, indices: list[int], seconds: dict[str, float]) -> Iterator[int]:
    begin = time.perf_counter()
    simulations: list[Simulation] = []
    solvers: list[SolverMuJoCo] = []
    trajectories: list[Trajectory] = []
    drawn: list[dict[str, Any]] = []
    scales: list[np.ndarray] = []
    for index in indices:
        scene, values = draw(plan.scene, plan.variations, plan.scene.seed, index)
        try:
            simulation = Simulation(scene, plan.assets, device=plan.device)
        except SceneError as error:
            raise SceneError(f"rollout {index}: {error}; narrow its ranges (drawn: {values})") from None
        assert isinstance(simulation.solver, SolverMuJoCo)
        placed = [body.placement for body in simulation.model.bodies]
        poses = [(item.turn, item.shift) for item in placed if item is not None]
        simulations.append(simulation)
        solvers.append(simulation.solver)
        trajectories.append(Trajectory(simulation.solver, plan.layout, poses))
        drawn.append(values)
        pairs = zip(scene.bodies, placed, strict=True)
        scales.append(np.array([_scale(p.asset, plan.assets[b.name]) for b, p in pairs if p is not None]))
    surfaces: list[dict[int, list[np.ndarray]]] = [{} for _ in indices]
    poses_seen: list[dict[int, np.ndarray | None]] = [{} for _ in indices]

    def seen(k: int, frame: int) -> None:
        trajectories[k].see()
        if frame in plan.frames:
            surfaces[k][frame] = simulations[k].surfaces()
            poses_seen[k][frame] = simulations[k].colliders()

    # Functions of the user's are not asked from several threads.
    threads = 1 if any(callbacks_of(plan.scene)) else plan.threads
    failures = run_batch(solvers, plan.scene.frame_count, 1.0 / plan.scene.fps, seen, threads=threads)
    seconds["simulate"] += time.perf_counter() - begin
    for k, index in enumerate(indices):
        folder = prepare_folder(_rollout_folder(plan.folder, index), "rollout.json")
        for old in folder.iterdir():  # of a rollout that was not finished
            old.unlink()
        arrays = {"scales": scales[k], **trajectories[k].arrays()}
        names, values = [], drawn[k]
        if plan.photographer is not None:
            begin = time.perf_counter()
            shots = plan.photographer.shoot(simulations[k], index, surfaces[k], poses_seen[k], folder)
            arrays |= {"intrinsics": shots.intrinsics, "extrinsics": shots.extrinsics}
            names, values = shots.files, {**values, **shots.values}
            seconds["draw"] += time.perf_counter() - begin
        begin = time.perf_counter()
        _write_npz(folder / "states.npz", arrays)
        _write_json(
            folder / "rollout.json",
            {
                "rollout": index,
                "parameters": values,
                "frames": trajectories[k].frames,
                "start_penetration": trajectories[k].start_penetration,
                "error": failures[k],
                "images": names,
            },
        )
        seconds["write"] += time.perf_counter() - begin
        yield len(names)


# ---- reading ----


def scene_of_rollout(dataset: str | Path, index: int, *, files: str | Path = ".") -> Scene:
    """The scene of one rollout, with the values drawn for it and the dataset's own assets.

    files: folder where the scene stood: other files that it names (base, meshes of obstacles) are found there
    Raises RequestError where the folder holds no dataset, or not so many rollouts.

        gdpro_sim.record(scene_of_rollout("dataset", 17), "run_17")
    """
    folder = Path(dataset).absolute()
    if not (folder / "dataset.json").is_file():
        raise RequestError(f"{dataset}: holds no dataset.json; give the folder of a dataset")
    about = _read_json(folder / "dataset.json")
    if not 0 <= index < about["count"]:
        raise RequestError(f"{dataset}: has rollouts 0 to {about['count'] - 1}, got {index}")
    scene = check_scene(
        {**about["scene"], "folder": Path(files).absolute(), "randomize": about["randomize"]}, str(dataset)
    )
    stored = {"color": None, "texture": None, "prompt": None}
    bodies = [
        body.model_copy(update={**stored, "asset": str(folder / f"assets/{body.source}.usdc")})
        for body in scene.bodies
    ]
    scene = scene.model_copy(update={"bodies": tuple(bodies)})
    drawn, _ = draw(scene, scene.randomize, scene.seed, index)
    return drawn.model_copy(update={"randomize": ()})  # type: ignore[no-any-return]


def _scale(placed: Asset, stored: Asset) -> float:
    sizes = [
        float(np.ptp(asset.gaussians.vertices.cpu().numpy(), axis=0).max()) for asset in (placed, stored)
    ]
    return sizes[0] / sizes[1]


__all__ = ["ARRAYS", "FORMAT", "VERSION", "Dataset", "rollout", "scene_of_rollout"]
