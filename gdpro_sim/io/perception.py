"""Pictures of rollouts as perception takes them: colour, depth, instance labels, camera matrices."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import SceneError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.camera_paths import CameraPath
from gdpro_sim.io.facing import Facing
from gdpro_sim.io.images import write_png
from gdpro_sim.io.obstacles import Obstacles
from gdpro_sim.io.preview import Renderer
from gdpro_sim.io.record import reach, studio_of
from gdpro_sim.io.staging import Staging
from gdpro_sim.simulation.mujoco.trajectory import BACKGROUND, FLOOR, Layout
from gdpro_sim.simulation.randomize import Variations, draw
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.view import MAIN, Camera, NamedCamera
from gdpro_sim.splatting import rasterization

CHANNELS = ("rgb", "depth", "segmentation")

PROBES = 8
"""Draws whose paths cameras without an eye are placed to see."""

FINE, COARSE = 1e-4, 1e-3
"""m, units of depth pictures: what is near is told to a tenth of a millimetre."""

COVERED = 0.5
"""A pixel shows what covers at least this share of it."""


def depth_and_labels(
    gaussians: Gaussians, labels: torch.Tensor, camera: Cameras, ground: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Depth [H, W] float32 m along the optical axis, inf where nothing is seen, and labels [H, W] int32.

    labels: [N] int64 of every Gaussian. A pixel has the label of what contributes most to it, `FLOOR` where
    the plane z = ground shows, else `BACKGROUND`; its depth is the mean of the Gaussians that it shows,
    weighted as they are blended. `camera` is one.
    """
    device = gaussians.means.device
    known, columns = torch.unique(labels.to(device), return_inverse=True)
    features = torch.nn.functional.one_hot(columns, max(len(known), 1)).to(torch.float32)
    image, alpha, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        features,
        camera.viewmats.to(device),
        camera.Ks.to(device),
        camera.width,
        camera.height,
        render_mode="RGB+ED",
    )
    covered = (alpha[0, ..., 0] >= COVERED).cpu().numpy()
    found = known[image[0, ..., :-1].argmax(dim=-1)].cpu().numpy()
    floor = _floor_depth(camera, ground)
    behind = np.where(np.isfinite(floor), FLOOR, BACKGROUND)
    depth = np.where(covered, image[0, ..., -1].cpu().numpy(), floor).astype(np.float32)
    return depth, np.where(covered, found, behind).astype(np.int32)


def _floor_depth(camera: Cameras, ground: float | None) -> np.ndarray:
    """Depth [H, W] m of the plane z = ground, inf where it is not seen from above."""
    view, k = camera.viewmats[0].double().numpy(), camera.Ks[0].double().numpy()
    eye = camera.positions[0].double().numpy()
    nothing = np.full((camera.height, camera.width), np.inf)
    if ground is None or eye[2] <= ground:
        return nothing
    x = (np.arange(camera.width) + 0.5 - k[0, 2]) / k[0, 0]
    y = (np.arange(camera.height) + 0.5 - k[1, 2]) / k[1, 1]
    fall = x[None, :] * view[0, 2] + y[:, None] * view[1, 2] + view[2, 2]  # of a ray one metre deep
    return np.divide(ground - eye[2], fall, out=nothing, where=fall < -1e-9)


def depth_units(depth: np.ndarray, unit: float) -> np.ndarray:
    """Depth [H, W] in m as uint16 multiples of `unit` m; 0 where there is none, or it is too far."""
    steps = np.round(depth / unit)
    return np.where(steps <= np.iinfo(np.uint16).max, steps, 0.0).astype(np.uint16)


@dataclass(frozen=True)
class Shots:
    """Pictures of one rollout: matrices [F, C, 3, 3] and [F, C, 4, 4], file names, what cameras drew."""

    intrinsics: np.ndarray
    extrinsics: np.ndarray
    files: list[str]
    values: dict[str, Any]


class Photographer:
    """Takes the pictures of a dataset: every rollout from the same cameras, but for what is drawn of them.

    views: cameras made of the scene's `camera`, with draws of their own; the scene's `cameras` follow them
    Raises SceneError where several views would be the same.
    """

    def __init__(
        self,
        simulation: Simulation,
        layout: Layout,
        variations: Variations,
        *,
        views: int,
        channels: tuple[str, ...],
    ) -> None:
        self.scene, self.variations, self.channels = simulation.scene, variations, channels
        self._views, self._device, self._layout = views, simulation.device, layout
        if any(camera.follow is not None for camera in (self.scene.camera, *self.scene.cameras)):
            raise SceneError(
                f"{self.scene.name}: cameras of a dataset do not `follow` bodies: leave it out, or draw "
                "`camera.target`"
            )
        moved = [item.path for item in variations if item.path.startswith("camera.")]
        self._spread = views > 1 and not moved
        if self._spread and self.scene.camera.eye is not None:
            raise SceneError(
                f"{self.scene.name}: {views} cameras at one `eye` take the same picture; draw `camera.eye`, "
                "or describe them in `cameras`"
            )
        boxes = [reach(self.scene, simulation)]
        for index in range(PROBES):
            scene, _ = draw(self.scene, variations, self.scene.seed, index)
            boxes.append(reach(scene, Simulation(scene, simulation.assets, device=simulation.device)))
        self.low = np.min([low for low, _ in boxes], axis=0)
        self.high = np.max([high for _, high in boxes], axis=0)
        self._times = np.arange(self.scene.frame_count) / self.scene.fps
        self.names = list(self._cameras(0)[0])
        self.unit = FINE if self._farthest() < FINE * np.iinfo(np.uint16).max else COARSE
        drawn = any(item.path.startswith("colliders.") for item in variations)
        self._obstacles = None if drawn else self._obstacles_of(simulation)

    def about(self) -> dict[str, Any]:
        """What dataset.json says of pictures."""
        return {
            "files": "rollouts/NNNNN/CAMERA_FRAME_CHANNEL.png",
            "cameras": self.names,
            "sizes": [[camera.width, camera.height] for camera in self._cameras(0)[0].values()],
            "rgb": "uint8 [H, W, 3] sRGB",
            "depth": f"uint16 [H, W] in units of {self.unit:g} m along the optical axis; 0: none",
            "depth_unit": self.unit,
            "segmentation": "uint8 or uint16 [H, W], a label of `labels`",
        }

    def shoot(
        self,
        simulation: Simulation,
        index: int,
        surfaces: Mapping[int, list[np.ndarray]],
        poses: Mapping[int, np.ndarray | None],
        folder: Path,
    ) -> Shots:
        """Draw rollout `index` at the frames of `surfaces` and `poses`; writes PNG files into `folder`."""
        cameras, values = self._cameras(index)
        scene, obstacles = simulation.scene, self._obstacles or self._obstacles_of(simulation)
        bodies = [(body.name, body.gaussians) for body in simulation.model.bodies]
        bound = [gaussians for _, gaussians in bodies]
        labels = [torch.full((len(one),), FLOOR + 1 + k) for k, one in enumerate(bound)]
        labels += [torch.full((count,), self._layout.obstacle_labels[k]) for k, count in obstacles.counts]
        owners, facing = torch.cat(labels), Facing(bound)
        staging = Staging(
            cameras, scene.lights, self.low, self.high, self._times, bodies, studio_of(scene, simulation)
        )
        renderer = Renderer(self._first(cameras["main"]), staging.studio)
        files: list[str] = []
        matrices: list[tuple[np.ndarray, np.ndarray]] = []
        for frame, time in enumerate(self._times.tolist()):
            moved = surfaces.get(frame)
            shot = staging.next(moved or [body.surface for body in simulation.model.bodies])
            if moved is None:
                continue
            gaussians = Gaussians.concatenate(
                [one.gaussians(torch.from_numpy(v)) for one, v in zip(bound, moved, strict=True)]
            )
            maps = None
            for name, camera in shot.cameras.items():
                normals = facing.normals(moved, camera)
                shown = obstacles.added_to(gaussians, normals, time, poses[frame])
                pictures: dict[str, np.ndarray] = {}
                if "rgb" in self.channels:
                    maps = maps or renderer.shadows(shown[0], camera, None if shot.studio else shot.lights)
                    pictures["rgb"] = renderer.render(*shown, camera, maps)
                if {"depth", "segmentation"} & set(self.channels):
                    depth, found = depth_and_labels(shown[0], owners, camera, staging.studio.ground)
                    pictures["depth"] = depth_units(depth, self.unit)
                    pictures["segmentation"] = found.astype(np.uint8 if found.max() < 256 else np.uint16)
                for channel in self.channels:
                    files.append(f"{name}_{frame:05d}_{channel}.png")
                    write_png(folder / files[-1], pictures[channel])
                matrices.append((camera.Ks[0].double().numpy(), camera.viewmats[0].double().numpy()))
        shape = (len(surfaces), len(cameras))
        return Shots(
            np.array([k for k, _ in matrices]).reshape(*shape, 3, 3),
            np.array([view for _, view in matrices]).reshape(*shape, 4, 4),
            files,
            values,
        )

    def _cameras(self, index: int) -> tuple[dict[str, Camera], dict[str, Any]]:
        """The cameras of a rollout by name, and what was drawn of those but the first."""
        cameras: dict[str, Camera] = {}
        values: dict[str, Any] = {}
        named: tuple[NamedCamera, ...] = ()
        for k in range(self._views):
            scene, drawn = draw(self.scene, self.variations, self.scene.seed, index, camera=k)
            camera = scene.camera
            if self._spread:
                turned = camera.azimuth + 360.0 * k / self._views
                camera = camera.model_copy(update={"azimuth": turned})
            cameras[f"{MAIN}_{k}" if k else MAIN] = camera
            if k:
                values |= {f"{path}#{k}": v for path, v in drawn.items() if path.startswith("camera.")}
            else:
                named = scene.cameras
        return cameras | {camera.name: camera for camera in named}, values

    def _first(self, camera: Camera) -> Cameras:
        """Where a camera stands at the start."""
        return CameraPath(camera, self.low, self.high, self._times).at(0.0, None)

    def _farthest(self) -> float:
        """m, from a camera of the first draws to what lies farthest from it."""
        corners = np.stack(np.meshgrid(*zip(self.low, self.high, strict=True)), axis=-1).reshape(-1, 3)
        eyes = [
            self._first(camera).positions[0].numpy()
            for index in range(PROBES)
            for camera in self._cameras(index)[0].values()
        ]
        return float(np.linalg.norm(corners[:, None] - np.array(eyes), axis=-1).max())

    def _obstacles_of(self, simulation: Simulation) -> Obstacles:
        return Obstacles(
            simulation.obstacles, self.low, self.high, self._device, self._first(self.scene.camera)
        )


__all__ = ["CHANNELS", "Photographer", "Shots", "depth_and_labels", "depth_units"]
