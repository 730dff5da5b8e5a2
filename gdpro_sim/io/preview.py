"""Preview pictures: Gaussians under lights, with soft shadows on a gridded floor."""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.backdrop import Backdrop, backdrop
from gdpro_sim.io.lighting import LightState, ShadowMaps, rig_of, studio_rig
from gdpro_sim.splatting import rasterization

KEPT_BACKDROPS = 4
"""Of cameras that stand still."""


@dataclass(frozen=True)
class Studio:
    """What surrounds the Gaussians.

    shading:    "studio" (lights and shadows) or "none" (colours as they are)
    background: "studio" (gradient and gridded floor), "transparent" or a colour, see `parse_color`
    ground:     height of the floor in m, or None for no floor
    scale:      size of the subject in m; sets the grid spacing and where the floor fades out
    focus:      m; the floor fades out around it, and the key light stands beside the camera that sees it
    azimuth:    degrees, of the camera that the lights stand beside; None: beside each camera that looks
    exposure:   stops
    catch_shadows: without the studio's background, the floor is seen by its shadows alone
    """

    shading: str = "studio"
    background: str = "studio"
    ground: float | None = 0.0
    scale: float = 1.0
    focus: tuple[float, float, float] = (0.0, 0.0, 0.0)
    azimuth: float | None = None
    exposure: float = 0.0
    catch_shadows: bool = False

    def seen_from(self, eye: Sequence[float] | torch.Tensor) -> float:
        """Azimuth in degrees at which an eye [3] m stands."""
        across = [float(eye[k]) - self.focus[k] for k in (0, 1)]
        return math.degrees(math.atan2(across[1], across[0]))


class Renderer:
    """Draws frames; what lies behind them is kept while a camera stands still.

    cameras: any number, to be named by their numbers; each is lit for its own side, unless the studio says
             otherwise
    """

    def __init__(self, cameras: Cameras | None = None, studio: Studio | None = None) -> None:
        self.studio = studio or Studio()
        self.cameras: list[Cameras] = []
        if cameras is not None:
            for view, k in zip(cameras.viewmats.split(1), cameras.Ks.split(1), strict=True):
                self.cameras.append(replace(cameras, viewmats=view, Ks=k))
        self._backdrops: OrderedDict[tuple[object, ...], Backdrop | None] = OrderedDict()

    def shadows(
        self, gaussians: Gaussians, camera: int | Cameras = 0, lights: Sequence[LightState] | None = None
    ) -> ShadowMaps | None:
        """What `render` needs to know of the lights; cameras that see the same moment may share it.

        lights: None for the studio's own, which stand beside the camera unless the studio says where
        """
        if self.studio.shading != "studio" or not len(gaussians):
            return None
        azimuth = self.studio.azimuth
        if azimuth is None:
            azimuth = self.studio.seen_from(self._one(camera).positions[0])
        rig = studio_rig(round(azimuth)) if lights is None else rig_of(lights, azimuth)
        return ShadowMaps(gaussians, rig.exposed(self.studio.exposure))

    def render(
        self,
        gaussians: Gaussians,
        normals: torch.Tensor,
        camera: int | Cameras = 0,
        maps: ShadowMaps | None = None,
        focus: tuple[float, float, float] | None = None,
    ) -> np.ndarray:
        """One picture, uint8 [H, W, 3], or [H, W, 4] (not premultiplied) where the background is transparent.

        normals: [N, 3] unit, used by shading
        camera:  number of one of the renderer's cameras, or another one
        maps:    of `shadows`, where several cameras share it
        focus:   [3] m, what the floor fades out around; default: the studio's
        """
        device = gaussians.means.device
        one = self._one(camera)
        maps = maps or self.shadows(gaussians, one)
        lit = gaussians
        if maps is not None:
            lit = maps.light(gaussians, normals, one.positions[0].to(gaussians.means))
        color, alpha, _ = rasterization(
            lit.means,
            lit.quats,
            lit.scales,
            lit.opacities,
            lit.sh,
            one.viewmats.to(device),
            one.Ks.to(device),
            one.width,
            one.height,
            sh_degree=lit.sh_degree,
        )
        behind, opacity = self._behind(one, focus or self.studio.focus, device).picture(maps)
        picture = color[0] + (1.0 - alpha[0]) * behind.to(device)
        if opacity is not None:
            cover = alpha[0] + (1.0 - alpha[0]) * opacity.to(device)
            picture = torch.cat([picture / cover.clamp_min(1e-6), cover], dim=-1)
        return (picture.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy()

    def passes(
        self, gaussians: Gaussians, normals: torch.Tensor, camera: int | Cameras = 0
    ) -> dict[str, np.ndarray]:
        """What a picture shows besides colour, float32, of the Gaussians alone; 0 where there are none.

        depth:  [H, W] m along the camera's axis
        normal: [H, W, 3] unit, in world space
        alpha:  [H, W] opacity
        """
        device = gaussians.means.device
        one = self._one(camera)
        blended, alpha, _ = rasterization(
            gaussians.means,
            gaussians.quats,
            gaussians.scales,
            gaussians.opacities,
            normals,
            one.viewmats.to(device),
            one.Ks.to(device),
            one.width,
            one.height,
            render_mode="RGB+ED",
        )
        facing = torch.nn.functional.normalize(blended[0, ..., :3], dim=-1)
        found = {"depth": blended[0, ..., 3], "normal": facing, "alpha": alpha[0, ..., 0]}
        return {name: image.cpu().numpy() for name, image in found.items()}

    def _one(self, camera: int | Cameras) -> Cameras:
        return camera if isinstance(camera, Cameras) else self.cameras[camera]

    def _behind(self, camera: Cameras, focus: tuple[float, float, float], device: torch.device) -> Backdrop:
        """A backdrop is kept when a camera is seen for the second time: one that moves never is."""
        matrices = camera.viewmats.numpy().tobytes() + camera.Ks.numpy().tobytes()
        key = matrices, camera.width, camera.height, tuple(focus), str(device)
        known = self._backdrops.get(key)
        if known is None:
            known = backdrop(camera, replace(self.studio, focus=focus), device)
            self._backdrops[key] = known if key in self._backdrops else None
            if len(self._backdrops) > KEPT_BACKDROPS:
                self._backdrops.popitem(last=False)
        self._backdrops.move_to_end(key)
        return known


def fitting_distance(
    low: np.ndarray,
    high: np.ndarray,
    target: np.ndarray,
    *,
    azimuth: float,
    elevation: float,
    fov: float,
    width: int,
    height: int,
) -> float:
    """How far in m an eye must be from `target` [3] to see the box `low`..`high` (m); angles in degrees."""
    direction = _outward(azimuth, elevation)
    a = math.radians(azimuth)
    right = np.array([-math.sin(a), math.cos(a), 0.0])
    upward = np.cross(direction, right)
    corners = np.array(
        [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
    )
    offset = corners - target
    tan_v = math.tan(0.5 * math.radians(fov))
    tan_h = tan_v * width / height
    depth = offset @ direction
    needed = np.maximum(np.abs(offset @ right) / tan_h, np.abs(offset @ upward) / tan_v) + depth
    return max(1.06 * float(needed.max()), 1e-3)


def _outward(azimuth: float, elevation: float) -> np.ndarray:
    a, e = math.radians(azimuth), math.radians(elevation)
    return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


def frame_camera(
    low: Sequence[float] | np.ndarray,
    high: Sequence[float] | np.ndarray,
    *,
    azimuth: float,
    elevation: float,
    fov: float,
    width: int,
    height: int,
    eye: Sequence[float] | np.ndarray | None = None,
    target: Sequence[float] | None = None,
    distance: float | None = None,
) -> Cameras:
    """One camera that sees the box `low`..`high` (m); angles in degrees.

    `eye` and `target` override, or `distance` in m from the target. Raises ValueError where eye and target
    coincide.
    """
    low, high = np.asarray(low, float), np.asarray(high, float)
    centre = 0.5 * (low + high) if target is None else np.asarray(target, float)
    if eye is None:
        if distance is None:
            distance = fitting_distance(
                low, high, centre, azimuth=azimuth, elevation=elevation, fov=fov, width=width, height=height
            )
        eye = centre + distance * _outward(azimuth, elevation)
    return Cameras.look_at(
        np.asarray(eye, float), centre, vertical_fov=math.radians(fov), width=width, height=height
    )


__all__ = ["Renderer", "Studio", "fitting_distance", "frame_camera"]
