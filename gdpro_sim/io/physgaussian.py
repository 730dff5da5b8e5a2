"""PhysGaussian's configurations (JSON) as scenes.

Xie et al. 2024, PhysGaussian: Physics-Integrated 3D Gaussians for Generative Dynamics; what its keys mean is
taken from the published code (utils/decode_param.py, mpm_solver_warp). Its matter is centred at (1, 1, 1) of
a box of 2 m and `scale` (by default 1) m long; the scene keeps that space, turned so that up is +Z.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset, kind
from gdpro_sim.errors import RequestError, SceneError
from gdpro_sim.files import atomic_write, check_writable
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.cloud import cloud_asset, is_cloud, read_cloud
from gdpro_sim.io.splat import TURNS, rotated
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.simulation.compile import load_assets
from gdpro_sim.simulation.compile_mpm import starting_points
from gdpro_sim.simulation.regions import SLACK
from gdpro_sim.simulation.scene import Scene, check_scene
from gdpro_sim.simulation.solver_options import MpmOptions

MIDDLE = np.ones(3)
"""m, of the simulated matter."""

FOREVER = 100.0
"""s; PhysGaussian says 1e3 or 999 for never."""

LAYERS = 50
"""Of a sequential release; PhysGaussian's code puts this in place of `num_layers`."""

KEYS = {
    "material", "grid_lim", "n_grid", "nu", "E", "yield_stress", "hardening", "xi", "friction_angle",
    "plastic_viscosity", "g", "density", "rpic_damping", "opacity_threshold", "grid_v_damping_scale",
    "additional_material_params", "boundary_conditions", "substep_dt", "frame_dt", "frame_num",
    "rotation_degree", "rotation_axis", "sim_area", "scale", "mpm_space_viewpoint_center",
    "mpm_space_vertical_upward_axis", "default_camera_index", "init_azimuthm", "init_elevation",
    "init_radius", "move_camera", "delta_a", "delta_e", "delta_r", "particle_filling", "show_hint",
}  # fmt: skip
"""That the scene follows, or says why not. `show_hint` only prints where a camera of the cloud stands."""

CONDITION_KEYS = {
    "cuboid": {"point", "size", "velocity", "start_time", "end_time", "reset"},
    "surface_collider": {"point", "normal", "surface", "friction", "start_time", "end_time"},
    "bounding_box": set(),
    "particle_impulse": {"force", "num_dt", "point", "size", "start_time"},
    "enforce_particle_translation": {"point", "size", "velocity", "start_time", "end_time"},
    "enforce_particle_velocity_rotation": {
        "point", "normal", "half_height_and_radius", "rotation_scale", "translation_scale", "start_time",
        "end_time",
    },
    "release_particles_sequentially": {
        "normal", "start_position", "end_position", "num_layers", "start_time", "end_time",
    },
}  # fmt: skip
"""That PhysGaussian reads of each boundary condition."""

PART_KEYS = {"point", "size", "E", "nu", "density"}
"""The same of `additional_material_params`."""

FEW = 2
"""Boxes that a message names."""


@dataclass(frozen=True)
class Converted:
    """A scene, and a line for each thing of the configuration that it does not follow to the letter."""

    scene: Scene
    messages: tuple[str, ...]


def convert(
    config: str | Path, asset: str | Path, output: str | Path, *, particles: int | None = None
) -> Converted:
    """Write the scene of a configuration as YAML to `output`.

    asset:     an asset, a mesh, or a cloud (.ply, .splat): of a cloud what the configuration keeps of it is
               written as an asset beside the scene
    particles: to aim for, in place of the grid's spacing

    Raises RequestError for a configuration that cannot be read or followed, AssetError, MeshError.
    """
    path = Path(output)
    if path.suffix.lower() not in (".yaml", ".yml"):
        raise RequestError(f"output {output} must end in .yaml")
    check_writable(path)
    data = _read(config)
    work = _Conversion(data, str(config))
    body = work.body(Path(asset), path)
    scene = work.scene(body, particles)
    scene["name"] = path.stem
    try:
        checked = check_scene({**scene, "folder": path.resolve().parent}, str(config))
        if work.leave_out_empty(scene["bodies"][0], checked):
            checked = check_scene({**scene, "folder": path.resolve().parent}, str(config))
    except SceneError as error:
        raise RequestError(str(error)) from None
    with atomic_write(path) as temporary:
        head = f"# From the PhysGaussian configuration {Path(config).name}.\n"
        temporary.write_text(
            head + yaml.safe_dump(_plain(scene), sort_keys=False, default_flow_style=None), encoding="utf-8"
        )
    return Converted(checked, tuple(dict.fromkeys(work.messages)))


def _read(config: str | Path) -> dict[str, Any]:
    try:
        data = json.loads(Path(config).read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise RequestError(f"{config}: cannot be read as JSON: {error}") from None
    if not isinstance(data, dict):
        raise RequestError(f"{config}: a configuration is a mapping, got {type(data).__name__}")
    if not KEYS & data.keys():
        raise RequestError(f"{config}: holds none of the keys of a PhysGaussian configuration")
    return data


def _plain(value: Any) -> Any:
    """For YAML: lists and floats, rounded to what float32 holds."""
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [_plain(item) for item in value]
    if isinstance(value, float | np.floating):
        return float(f"{value:.7g}") + 0.0
    return value


class _Conversion:
    def __init__(self, data: dict[str, Any], source: str) -> None:
        self.data, self.source = data, source
        self.messages: list[str] = []
        self._name_unknown(set(data), KEYS, "")
        up = self.three("mpm_space_vertical_upward_axis", [0, 0, 1])
        axis = int(np.abs(up).argmax())
        if np.count_nonzero(up) != 1:
            self.say(f"mpm_space_vertical_upward_axis {up.tolist()} is no axis: +Z is up")
            axis, up = 2, np.array([0.0, 0.0, 1.0])
        self.turn = np.asarray(TURNS[f"{'-' if up[axis] < 0 else ''}{'xyz'[axis]}"], float)
        self.substep = self.number("substep_dt", 1e-4, above=0.0)
        frame = self.number("frame_dt", 1e-2, above=0.0)
        self.fps = max(1, round(1.0 / frame))
        if abs(self.fps * frame - 1.0) > 1e-3:
            self.say(f"frame_dt {frame:g} s is taken as {self.fps} frames per second")
        self.duration = self.number("frame_num", 100, above=0.0) * frame
        self.extent = self.number("grid_lim", 2.0, above=0.0)
        self.spacing = self.extent / self.number("n_grid", 50, above=0.0)
        self.density = self.number("density", 200.0)
        degrees, axes = data.get("rotation_degree", []), data.get("rotation_axis", [])
        lists = isinstance(degrees, list) and isinstance(axes, list) and len(degrees) == len(axes)
        if not lists or not all(axis in (0, 1, 2) for axis in axes):
            raise self.wrong(f"rotation_degree {degrees} and rotation_axis {axes} do not fit together")
        self.rotation = np.eye(3)
        for degree, number in zip(degrees, axes, strict=True):
            turned = Rotation.from_euler("xyz"[number], degree, degrees=True).as_matrix()
            self.rotation = turned @ self.rotation
        self.cloud: np.ndarray | None = None  # means of the simulated cloud in PhysGaussian's space

    def say(self, text: str) -> None:
        self.messages.append(text)

    def wrong(self, text: str) -> RequestError:
        return RequestError(f"{self.source}: {text}")

    def number(self, name: str, default: float, *, above: float = -math.inf) -> float:
        """A number of the configuration. Raises RequestError where it is none, or not above a bound."""
        value = self.data.get(name)
        value = default if value is None else value
        if isinstance(value, bool) or not isinstance(value, int | float) or not above < value < math.inf:
            bound = "" if above == -math.inf else f" > {above:g}"
            raise self.wrong(f"{name} must be a finite number{bound}, got {value!r}")
        return float(value)

    def three(self, name: str, default: Any) -> np.ndarray:
        """Three numbers of the configuration. Raises RequestError where they are not."""
        value = self.data.get(name, default)
        try:
            found = np.asarray(value, float)
        except (TypeError, ValueError):
            found = np.zeros(0)
        if found.shape != (3,) or not np.isfinite(found).all():
            raise self.wrong(f"{name} must be three finite numbers, got {value!r}")
        return found

    def _name_unknown(self, given: set[str], known: set[str], where: str) -> None:
        for key in sorted(given - known):
            self.say(f"{where}`{key}` is not followed")

    # ---- the body ----

    def body(self, asset: Path, output: Path) -> dict[str, Any]:
        """The scene's only body, without pins; a cloud is written beside the scene as it is simulated."""
        if not asset.is_file():
            raise RequestError(f"{asset}: no such file")
        filled = "`particle_filling`: the body is filled in a way of its own, evenly"
        without = "without `particle_filling` PhysGaussian moves a hollow shell; here the body is filled"
        self.say(filled if self.data.get("particle_filling") is not None else without)
        rotation, size = self.rotation, self.number("scale", 1.0, above=0.0)
        place: dict[str, Any] = {"name": "body", "position": self.point(MIDDLE)}
        if is_cloud(asset):
            file = output.with_name(f"{output.stem}_asset.usdc")
            self._cloud(asset, rotation, size).save(file)
            return {**place, "asset": file.name, "anchor": "origin"}
        points = self._vertices(asset)
        if self.data.get("sim_area") is not None:
            self.say("`sim_area` is for splat clouds: the whole asset is simulated")
        if "opacity_threshold" in self.data:
            self.say("`opacity_threshold` is for splat clouds: all of the asset is kept")
        turned = points @ rotation.T
        longest = float(np.ptp(turned, axis=0).max())
        angles = Rotation.from_matrix(self.turn @ rotation).as_euler("xyz", degrees=True)
        return {
            **place,
            "asset": os.path.relpath(asset, output.parent),
            "anchor": "center",
            "size": size / longest * float(np.ptp(points, axis=0).max()),
            "rotation": angles,
        }

    def _vertices(self, asset: Path) -> np.ndarray:
        if kind(asset) == "asset":
            return Asset.load(asset).gaussians.vertices.double().numpy()
        return load_mesh(asset).vertices.astype(np.float64)

    def _cloud(self, asset: Path, rotation: np.ndarray, size: float) -> Asset:
        """What is simulated of a cloud, turned, centred at the origin and scaled."""
        cloud = read_cloud(asset)
        keep = cloud.opacities > self.number("opacity_threshold", 0.02)
        turned = rotated(_chosen(cloud, keep), rotation)
        area = self.data.get("sim_area")
        if area is not None:
            if np.shape(area) != (6,):
                raise self.wrong(f"sim_area must be six numbers, got {area!r}")
            low, high = torch.tensor(area[0::2]), torch.tensor(area[1::2])
            inside = ((turned.means > low) & (turned.means < high)).all(1)
            self.say(f"`sim_area`: the {int((~inside).sum()):,} Gaussians outside it are left out")
            turned = _chosen(turned, inside)
        if not len(turned):
            raise self.wrong(f"opacity_threshold and sim_area leave nothing of {asset.name}")
        low, high = turned.means.amin(0), turned.means.amax(0)
        factor = size / float((high - low).max())
        means = (turned.means - 0.5 * (low + high)) * factor
        self.cloud = means.double().numpy() + MIDDLE
        moved = Gaussians(means, turned.quats, turned.scales * factor, turned.opacities, turned.sh)
        return cloud_asset(asset.stem, rotated(moved, self.turn), asset)

    # ---- PhysGaussian's space -> the scene's ----

    def vector(self, v: Any) -> list[float]:
        return _plain(self.turn @ np.asarray(v, float))

    def point(self, p: Any) -> list[float]:
        return _plain(self.turn @ (np.asarray(p, float) - MIDDLE) + MIDDLE)

    def box(self, point: Any, half: Any) -> dict[str, Any]:
        middle, reach = np.asarray(self.point(point)), np.abs(self.turn) @ np.asarray(half, float)
        return {"minimum": _plain(middle - reach), "maximum": _plain(middle + reach)}

    def window(self, condition: dict[str, Any], end_name: str) -> tuple[dict[str, Any], float, float]:
        """Keys of a scene for when something acts, and its start and end in s."""
        start, end = float(condition.get("start_time", 0.0)), float(condition.get("end_time", 1e3))
        keys: dict[str, Any] = {"start": start} if start > 0.0 else {}
        if end < self.duration:
            keys[end_name] = end
        return keys, start, min(end, self.duration)

    # ---- the scene ----

    def scene(self, body: dict[str, Any], particles: int | None) -> dict[str, Any]:
        body["material"] = self.material()
        colliders: list[dict[str, Any]] = []
        solver: dict[str, Any] = {"kind": "mpm"}
        solver.update({"grid_spacing": self.spacing} if particles is None else {"particles": particles})
        damping = self.number("rpic_damping", 0.0)
        if damping < -0.001:
            solver["transfer"] = "pic"
        elif damping > 0.0:
            self.say(f"`rpic_damping` {damping:g} is not followed: transfers are APIC")
        if "substep_dt" in self.data:
            self.say("`substep_dt` tells how hard it damps and pushes; substeps follow the speed of sound")
        for part in self._listed("additional_material_params"):
            self._name_unknown(set(part), PART_KEYS, "additional_material_params: ")
            with self._reading("additional_material_params"):
                body.setdefault("parts", []).append(self._part(part, body["material"]))
        for condition in self._listed("boundary_conditions"):
            self._condition(condition, body, colliders, solver)
        gravity = self.data.get("g", 9.8)
        down = self.three("g", None) if isinstance(gravity, list) else [0.0, 0.0, -self.number("g", 9.8)]
        scene = {
            "description": f"PhysGaussian's configuration {Path(self.source).name}.",
            "bodies": [body],
            "ground": None,
            "gravity": self.vector(down),
            "fps": self.fps,
            "duration": self.duration,
            "camera": self.camera(),
            "solver": solver,
        }
        if colliders:
            scene["colliders"] = colliders
        return scene

    def _listed(self, name: str) -> list[dict[str, Any]]:
        found = self.data.get(name) or []
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.wrong(f"{name} must be a list of mappings")
        return found

    @contextmanager
    def _reading(self, what: str) -> Iterator[None]:
        """Tells where something of a configuration that is missing or of another kind stands."""
        try:
            yield
        except (KeyError, TypeError, IndexError, ValueError) as error:
            raise self.wrong(f"{what} lacks or misstates {error}") from None

    def _part(self, part: dict[str, Any], material: dict[str, Any]) -> dict[str, Any]:
        """Matter of another stiffness and density."""
        changed = {"young": part["E"], "poisson": part["nu"], "density": part.get("density", self.density)}
        return {**self.box(part["point"], part["size"]), "material": {**material, **changed}}

    def camera(self) -> dict[str, Any]:
        target = self.point(self.three("mpm_space_viewpoint_center", MIDDLE))
        view: dict[str, Any] = {"target": target}
        if self.data.get("default_camera_index", 0) != -1:
            if "default_camera_index" in self.data:
                self.say("`default_camera_index`: the cloud's own cameras are not read")
            return view
        names = ("init_azimuthm", "init_elevation", "init_radius", "delta_a", "delta_e", "delta_r")
        azimuth, elevation, radius, *steps = (self.number(name, 0.0) for name in names)
        around, up, away = steps if self.data.get("move_camera") else (0.0, 0.0, 0.0)
        view["azimuth"] = self._azimuth(azimuth)
        view["elevation"] = _upright(elevation)
        if around:  # its angles grow clockwise, per frame
            view["orbit"] = {"rate": -around * self.fps}
        if up:
            end = _upright(elevation + up * self.fps * self.duration)
            view["motion"] = [{"time": self.duration, "elevation": end}]
            view["interpolation"] = "linear"
        if radius or away:
            self.say("`init_radius`, `delta_r`: the camera stands where the body fits into the picture")
        return view

    def _azimuth(self, angle: float) -> float:
        """Degrees from +X in the scene. Theirs count from the part of (1, 1, 1) across the vertical, both in
        the cloud's own frame, clockwise seen from above."""
        vertical = (self.turn @ self.rotation).T @ [0.0, 0.0, 1.0]
        first = np.ones(3)
        if abs(first @ vertical) < 0.01:
            first = np.array([0.72, 0.37, -0.67])
        first -= (first @ vertical) * vertical
        x, y, _ = self.turn @ self.rotation @ first
        return math.degrees(math.atan2(y, x)) - angle

    def material(self) -> dict[str, Any]:
        data = self.data
        name = data.get("material", "jelly")
        young, poisson = self.number("E", 1e5), self.number("nu", 0.4)
        shear = young / (2.0 * (1.0 + poisson))
        made: dict[str, Any] = {"young": young, "poisson": poisson, "density": self.density}
        scale = self.number("grid_v_damping_scale", 1.1)
        if 0.0 < scale < 1.0:  # velocities, each substep
            made["rayleigh_mass"] = -math.log(scale) / self.substep
        stress = self.number("yield_stress", 0.0)
        if name in ("metal", "plasticine", "foam") and not stress > 0.0:
            raise self.wrong(f"material {name!r} needs a yield_stress > 0")
        if name == "jelly":
            return {**made, "model": "corotated"}
        if name in ("metal", "plasticine"):
            # Theirs is a Frobenius norm of the deviatoric stress, and grows by 2 mu xi of the strain's.
            made.update(model="stvk_hencky", yield_stress=math.sqrt(1.5) * stress)
            if data.get("hardening") == 1:
                made["hardening"] = 3.0 * shear * self.number("xi", 0.0)
            if name == "plasticine":
                self.say("material 'plasticine': its softening is not followed, it flows and does not break")
            return made
        if name == "sand":
            return {**made, "model": "drucker_prager", "friction_angle": data.get("friction_angle", 25.0)}
        if name == "snow":
            self.say("material 'snow': PhysGaussian's has no stress; taken as that of Stomakhin et al. 2013")
            return {**made, "model": "snow"}
        if name == "foam":
            viscosity = self.number("plastic_viscosity", 0.0)
            if not viscosity > 0.0:
                return {**made, "model": "stvk_hencky", "yield_stress": stress}
            # Their overstress is viscosity times the norm of the strain rate: rate / sqrt(2) in shear.
            return {**made, "model": "herschel_bulkley", "yield_stress": stress, "viscosity": 0.5 * viscosity}
        raise self.wrong(f"material {name!r} is none of jelly, metal, sand, foam, snow, plasticine")

    def _condition(
        self,
        condition: dict[str, Any],
        body: dict[str, Any],
        colliders: list[dict[str, Any]],
        solver: dict[str, Any],
    ) -> None:

        def add(key: str, *items: dict[str, Any]) -> None:
            body.setdefault(key, []).extend(items)

        kinds = {
            "cuboid": lambda: colliders.append(self._cuboid(condition)),
            "surface_collider": lambda: colliders.extend(self._plane(condition)),
            "bounding_box": lambda: solver.update(domain=self._walls()),
            "particle_impulse": lambda: add("impulses", self._impulse(condition)),
            "enforce_particle_translation": lambda: add("pins", self._translation(condition)),
            "enforce_particle_velocity_rotation": lambda: add("pins", *self._spin(condition)),
            "release_particles_sequentially": lambda: add("pins", *self._release(condition)),
        }
        found = condition.get("type")
        if found not in kinds:
            raise self.wrong(f"boundary condition {found!r} is none of {', '.join(kinds)}")
        self._name_unknown(set(condition), CONDITION_KEYS[found] | {"type"}, f"{found}: ")
        with self._reading(f"boundary condition {found!r}"):
            kinds[found]()

    def leave_out_empty(self, body: dict[str, Any], scene: Scene) -> bool:
        """Leave out boxes that hold no particle: they mean nothing. Whether there were any."""
        keys = [key for key in ("parts", "pins", "impulses") if key in body]
        if not keys:
            return False
        assert isinstance(scene.solver, MpmOptions)
        (points,) = starting_points(scene, scene.solver, load_assets(scene))
        changed = False
        for key in keys:
            holds = [region.select(points).any() for region in getattr(scene.bodies[0], key)]
            empty = [item for item, full in zip(body[key], holds, strict=True) if not full]
            if not empty:
                continue
            changed = True
            body[key] = [item for item, full in zip(body[key], holds, strict=True) if full]
            some = "; ".join(f"{item['minimum']} to {item['maximum']} m" for item in empty[:FEW])
            rest = f" and {len(empty) - FEW} more" if len(empty) > FEW else ""
            self.say(f"{key}: boxes that hold nothing are left out: {some}{rest}")
        return changed

    def _cuboid(self, c: dict[str, Any]) -> dict[str, Any]:
        keys, start, end = self.window(c, "end")
        if c.get("reset") == 1 and "end" in keys:
            keys["end"] += 15.0 * self.substep
        reach = np.abs(self.turn) @ np.asarray(c["size"], float)
        made = {"kind": "box", "position": self.point(c["point"]), "size": 2.0 * reach, "boundary": "sticky"}
        motion = self._motion(np.asarray(c["velocity"], float), start, end)
        return {**made, **keys, **motion, "visible": False}

    def _motion(self, velocity: np.ndarray, start: float, end: float) -> dict[str, Any]:
        if not velocity.any():
            return {}
        moved = {"time": end, "translation": self.vector(velocity * (end - start))}
        return {"motion": [*([{"time": start}] if start > 0.0 else []), moved]}

    def _plane(self, c: dict[str, Any]) -> list[dict[str, Any]]:
        surface = c["surface"]
        if surface == "cut":
            self.say("surface_collider 'cut' is not followed")
            return []
        keys, _, _ = self.window(c, "end")
        boundary = surface if surface in ("sticky", "slip") else "separate"
        if boundary != "sticky":
            self.say(f"surface_collider {surface!r}: PhysGaussian's code sticks to it, the scene does not")
        made = {"kind": "plane", "position": self.point(c["point"]), "normal": self.vector(c["normal"])}
        return [{**made, "boundary": boundary, "friction": float(c.get("friction", 0.0)), **keys}]

    def _walls(self) -> list[list[float]]:
        """Nodes 0 to 2 and the last 3 of each axis let nothing out."""
        low, high = 2.0 * self.spacing, self.extent - 3.0 * self.spacing
        corners = np.array([self.point(np.full(3, end)) for end in (low, high)])
        return [corners.min(axis=0).tolist(), corners.max(axis=0).tolist()]

    def _impulse(self, c: dict[str, Any]) -> dict[str, Any]:
        """Every particle gets the same force for some substeps; here all matter in the box one velocity."""
        point, half = np.asarray(c.get("point", MIDDLE), float), np.asarray(c.get("size", MIDDLE), float)
        mass = self.density * self.spacing**3
        if self.cloud is None:
            self.say("particle_impulse: its force is per particle, of which one a cell is assumed")
        else:
            cells = np.floor(self.cloud / self.spacing).astype(np.int64)
            inside = (np.abs(self.cloud - point) < half).all(axis=1)
            occupied, count = np.unique(cells, axis=0, return_counts=True)
            shares = {tuple(cell): n for cell, n in zip(occupied.tolist(), count.tolist(), strict=True)}
            of_each = [mass / shares[tuple(cell)] for cell in cells[inside].tolist()]
            mass = float(np.mean(of_each)) if of_each else mass
        seconds = self.substep * int(c.get("num_dt", 1))
        change = np.asarray(c["force"], float) * seconds / mass
        whole = {} if "size" not in c and "point" not in c else self.box(point, half)
        return {**whole, "velocity": self.vector(change), "time": float(c.get("start_time", 0.0))}

    def _translation(self, c: dict[str, Any]) -> dict[str, Any]:
        keys, start, end = self.window(c, "release")
        motion = self._motion(np.asarray(c["velocity"], float), 0.0, end - start)
        for key in motion.get("motion", []):
            key["time"] += start
        return {**self.box(c["point"], c["size"]), **keys, **motion}

    def _spin(self, c: dict[str, Any]) -> list[dict[str, Any]]:
        keys, start, end = self.window(c, "release")
        normal = np.asarray(c["normal"], float)
        if np.count_nonzero(normal) != 1:
            self.say(f"enforce_particle_velocity_rotation about {normal.tolist()}: only about axes, left out")
            return []
        self.say("enforce_particle_velocity_rotation: the box around the cylinder is held")
        axis, (height, radius) = int(np.abs(normal).argmax()), c["half_height_and_radius"]
        half = np.full(3, float(radius))
        half[axis] = height
        normal = normal / np.linalg.norm(normal)
        # Its second axis is first x normal, so that it turns clockwise about the normal.
        angle = -math.degrees(float(c["rotation_scale"])) * (end - start)
        shift = float(c["translation_scale"]) * (end - start)
        held: dict[str, Any] = {**self.box(c["point"], half), **keys}
        if angle or shift:
            turned = {"translation": self.vector(shift * normal), "rotation": self.vector(angle * normal)}
            held.update(pivot=self.point(c["point"]), motion=[{"time": end, **turned}])
        return [held]

    def _release(self, c: dict[str, Any]) -> list[dict[str, Any]]:
        """Slabs on both sides of the end position, let go one after another from the outermost in."""
        normal = np.asarray(c["normal"], float)
        axis = int(np.abs(normal).argmax())
        near, far = float(c["end_position"]), float(c["start_position"])
        step, end = abs(far - near) / LAYERS, float(c["end_time"])
        slabs: list[dict[str, Any]] = []
        start = float(c["start_time"])
        for layer in range(LAYERS):
            release = end / LAYERS * (layer + 1)
            if release <= start:
                continue
            keys = {"start": start, "release": release} if start > 0.0 else {"release": release}
            for side in (-1.0, 1.0):
                point, half = MIDDLE.copy(), np.ones(3)
                point[axis] = near + side * step * (LAYERS - layer - 0.5)
                half[axis] = 0.5 * step - 2.0 * SLACK * self.number("scale", 1.0)  # no particle in two
                slabs.append({**self.box(point, half), **keys})
        self.say(f"release_particles_sequentially: {LAYERS} layers, each let go as a whole")
        return slabs


def _upright(elevation: float) -> float:
    """Degrees that a camera may stand at."""
    return min(max(elevation, -89.0), 89.0)


def _chosen(cloud: Gaussians, mask: torch.Tensor) -> Gaussians:
    return Gaussians(
        cloud.means[mask], cloud.quats[mask], cloud.scales[mask], cloud.opacities[mask], cloud.sh[mask]
    )


__all__ = ["Converted", "convert"]
