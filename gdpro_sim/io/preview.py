"""Preview pictures: Gaussians under studio lights, with soft shadows on a gridded floor.

Each light is a camera far away: its splatted alpha and depth say how much of it reaches a point. One key
light in a few jittered copies and a ring of sky lights give soft shadows, contact shadows and occlusion
to Gaussians and floor alike. Colours are display-referred; light is applied with a 2.2 power.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import warp as wp

from gdpro_sim.cameras import Cameras
from gdpro_sim.device import beside_torch, device_name, launch_chunked
from gdpro_sim.gaussians import SH_C0, Gaussians
from gdpro_sim.kernels.shading import gather_light
from gdpro_sim.splatting import rasterization

GAMMA = 2.2
MAP_SIZE = 160
FLOOR_SIZE = 224
CASTERS = 20_000
KEY_SHARE = 0.66
BOUNCE = 0.10
GLOSS = 0.16
KEY_LIGHTS = 6


@dataclass(frozen=True)
class Studio:
    """What surrounds the Gaussians.

    shading:    "studio" (lights and shadows) or "none" (colours as they are)
    background: "studio" (gradient and gridded floor), "white" or "black"
    ground:     height of the floor in m, or None for no floor
    scale:      size of the subject in m; sets the grid spacing and where the floor fades out
    focus:      m; the floor fades out around it, and the key light stands beside the camera that sees it
    """

    shading: str = "studio"
    background: str = "studio"
    ground: float | None = 0.0
    scale: float = 1.0
    focus: tuple[float, float, float] = (0.0, 0.0, 0.0)


@functools.cache
def _lights(azimuth: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions towards the lights [L, 3] and their weights [L]; the key light's copies come first.

    azimuth: degrees, where the camera stands; the key light stands to its left. A horizontal surface in full
    light receives 1.
    """
    directions: list[tuple[float, float, float]] = []
    weights: list[float] = []

    def add(azimuth_degrees: float, elevation_degrees: float, weight: float) -> None:
        a, e = math.radians(azimuth_degrees), math.radians(elevation_degrees)
        directions.append((math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)))
        weights.append(weight / math.sin(e))

    for k in range(KEY_LIGHTS):  # a disc of light, sampled in a spiral (Vogel 1979)
        radius, turn = 7.0 * math.sqrt((k + 0.5) / KEY_LIGHTS), 2.399963 * k
        add(azimuth - 48.0 + radius * math.cos(turn), 47.0 + radius * math.sin(turn), KEY_SHARE / KEY_LIGHTS)
    ring = ((22.0, 5, 0.3), (50.0, 4, 0.45), (82.0, 1, 0.25))
    for elevation, count, share in ring:
        for k in range(count):
            add(azimuth + 30.0 + 360.0 * (k + 0.5) / count, elevation, (1.0 - KEY_SHARE) * share / count)
    return np.array(directions), np.array(weights)


@dataclass(frozen=True)
class _ShadowMaps:
    """One alpha and depth image per light, and the sphere in m that they cover."""

    centre: torch.Tensor
    radius: float
    directions: torch.Tensor
    weights: torch.Tensor
    cameras: Cameras
    alpha: torch.Tensor
    depth: torch.Tensor
    bias: float
    softness: float

    def gather(self, points: torch.Tensor, normals: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Light of the key and of the sky, and the key's visibility, at points and unit normals [M, 3]."""
        device = points.device
        light = torch.empty((len(points), 3), dtype=torch.float32, device=device)
        with beside_torch(points):
            launch_chunked(
                gather_light,
                len(points),
                [
                    wp.from_torch(points.contiguous(), dtype=wp.vec3),
                    wp.from_torch(normals.contiguous(), dtype=wp.vec3),
                    wp.from_torch(self.alpha.contiguous()),
                    wp.from_torch(self.depth.contiguous()),
                    wp.from_torch(self.cameras.viewmats.to(device).contiguous(), dtype=wp.mat44),
                    float(self.cameras.Ks[0, 0, 0]),
                    wp.from_torch(self.directions, dtype=wp.vec3),
                    wp.from_torch(self.weights),
                    KEY_LIGHTS,
                    self.bias,
                    self.softness,
                ],
                [wp.from_torch(light, dtype=wp.vec3)],
                device=device_name(points),
                minimum=2048,
            )
        return light.unbind(1)


def _shadow_maps(gaussians: Gaussians, directions: np.ndarray, weights: np.ndarray) -> _ShadowMaps:
    low = gaussians.means.amin(0).double().cpu().numpy()
    high = gaussians.means.amax(0).double().cpu().numpy()
    centre, radius = 0.5 * (low + high), max(0.55 * float(np.linalg.norm(high - low)), 1e-6)
    distance = 24.0 * radius
    # A small map needs no more than some Gaussians, each grown to cover for those left out.
    stride = math.ceil(len(gaussians) / CASTERS)
    casters = Gaussians(
        gaussians.means[::stride],
        gaussians.quats[::stride],
        gaussians.scales[::stride] * math.sqrt(stride),
        gaussians.opacities[::stride],
        gaussians.sh[::stride],
    )
    cameras = Cameras.look_at(
        centre + distance * directions,
        centre,
        vertical_fov=2.0 * math.asin(radius / distance),
        width=MAP_SIZE,
        height=MAP_SIZE,
    )
    device = gaussians.means.device
    depth, alpha, _ = rasterization(
        casters.means,
        casters.quats,
        casters.scales,
        casters.opacities,
        torch.zeros((len(casters), 1), device=device),
        cameras.viewmats.to(device),
        cameras.Ks.to(device),
        cameras.width,
        cameras.height,
        near_plane=radius,
        render_mode="D",
    )
    texel = 2.0 * radius / MAP_SIZE
    as_tensor = functools.partial(torch.tensor, dtype=torch.float32, device=device)
    middle, towards, strength = as_tensor(centre), as_tensor(directions), as_tensor(weights)
    return _ShadowMaps(
        middle, radius, towards, strength, cameras, alpha[..., 0], depth[..., 0], 2.5 * texel, 3.0 * texel
    )


def light(
    gaussians: Gaussians, normals: torch.Tensor, cameras: Cameras, studio: Studio
) -> tuple[Gaussians, _ShadowMaps]:
    """Gaussians with studio light multiplied into their colours, and the shadow maps that were made for it.

    normals: [N, 3] unit. The key light stands on the side of the first camera.
    """
    eye = cameras.positions[0].to(gaussians.means)
    across = [float(eye[k]) - studio.focus[k] for k in (0, 1)]
    directions, weights = _lights(round(math.degrees(math.atan2(across[1], across[0]))))
    maps = _shadow_maps(gaussians, directions, weights)
    key, sky, seen = maps.gather(gaussians.means + normals * maps.bias, normals)
    factor = (key + sky + BOUNCE * (1.0 - 0.5 * normals[:, 2])).clamp(0.0, 1.6).pow(1.0 / GAMMA)

    # Blinn-Phong highlight of the key light; Schlick-free, it only has to read as a glossy surface.
    to_eye = torch.nn.functional.normalize(eye - gaussians.means, dim=1)
    half = torch.nn.functional.normalize(to_eye + maps.directions[:KEY_LIGHTS].mean(0), dim=1)
    gloss = GLOSS * (normals * half).sum(1).clamp_min(0.0).pow(60.0) * seen

    sh = gaussians.sh * factor[:, None, None]
    sh[:, 0] += ((0.5 * factor - 0.5 + gloss) / SH_C0)[:, None]
    return replace(gaussians, sh=sh), maps


@dataclass(frozen=True)
class _Backdrop:
    """What lies behind the Gaussians and does not change while the camera stands still.

    sky:    [H, W, 3] what is seen where there is no floor
    base:   [H, W, 3] the floor in full light, grid included
    fade:   [H, W, 1] how much of the floor shows before it melts into the sky
    floor:  [H, W, 2] m, the floor point a pixel sees
    height: of the floor, m
    """

    sky: torch.Tensor
    base: torch.Tensor
    fade: torch.Tensor
    floor: torch.Tensor
    height: float

    def picture(self, maps: _ShadowMaps | None) -> torch.Tensor:
        """The backdrop under the shadows of `maps`, [H, W, 3]."""
        base = self.base
        if maps is not None:
            centre = maps.centre[:2].to(self.floor)
            half = 2.0 * maps.radius + 1.2 * max(float(maps.centre[2]) - self.height, 0.0)
            shade = _floor_shade(maps, centre, half, self.height)
            uv = ((self.floor - centre) / half)[None]
            darkening = torch.nn.functional.grid_sample(1.0 - shade[None, None], uv, align_corners=False)
            base = base * (1.0 - darkening[0, 0, :, :, None])
        return self.sky + (base - self.sky) * self.fade


def _backdrop(cameras: Cameras, studio: Studio, device: torch.device) -> _Backdrop | torch.Tensor:
    """Floor and sky of the first camera, or a plain colour [H, W, 3]."""
    h, w = cameras.height, cameras.width
    if studio.background != "studio":
        return torch.full((h, w, 3), 1.0 if studio.background == "white" else 0.0, device=device)
    view, k = cameras.viewmats[0].to(device), cameras.Ks[0].to(device)
    ys, xs = torch.meshgrid(
        torch.arange(h, device=device) + 0.5, torch.arange(w, device=device) + 0.5, indexing="ij"
    )
    local = torch.stack([(xs - k[0, 2]) / k[0, 0], (ys - k[1, 2]) / k[1, 1], torch.ones_like(xs)], -1)
    rays = torch.nn.functional.normalize(local @ view[:3, :3], dim=-1)
    eye = cameras.positions[0].to(device)
    lift = rays[..., 2:3]
    top, horizon = (
        torch.tensor([0.80, 0.85, 0.90], device=device),
        torch.tensor([0.95, 0.955, 0.96], device=device),
    )
    sky = horizon + (top - horizon) * lift.clamp(0.0, 1.0).pow(0.7)
    if studio.ground is None or float(eye[2]) <= studio.ground:
        return sky
    below = lift < -1e-4
    t = (studio.ground - eye[2]) / torch.where(below, lift, torch.full_like(lift, -1e-4))
    hit = (eye + rays * t)[..., :2]
    focus = torch.tensor(studio.focus[:2], dtype=torch.float32, device=device)
    reach = torch.linalg.norm(hit - focus, dim=-1, keepdim=True)
    base = torch.tensor([0.835, 0.845, 0.855], device=device).expand(h, w, 3)
    spacing = 10.0 ** math.floor(math.log10(max(studio.scale, 1e-6) * 0.8))
    foot = 0.75 * (t / k[1, 1]) / (-lift).clamp_min(0.02)  # metres of floor under a pixel
    for step, half, strength in ((spacing, 0.008 * spacing, 0.05), (5.0 * spacing, 0.012 * spacing, 0.10)):
        nearest = (hit / step - torch.round(hit / step)).abs() * step
        cover = ((half + 0.5 * foot - nearest) / foot).clamp(0.0, 1.0) * (2.0 * half / foot).clamp(max=1.0)
        base = base - strength * (1.0 - (1.0 - cover).prod(-1, keepdim=True))
    fade = torch.exp(-((reach / (5.0 * studio.scale)) ** 2)) * below
    return _Backdrop(sky, base, fade, hit, studio.ground)


def _floor_shade(maps: _ShadowMaps, centre: torch.Tensor, half: float, height: float) -> torch.Tensor:
    """Brightness of the floor under the lights on a square around `centre`, [S, S], display-referred."""
    device = centre.device
    steps = (torch.arange(FLOOR_SIZE, device=device) + 0.5) / FLOOR_SIZE * 2.0 - 1.0
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    points = torch.stack(
        [centre[0] + half * x, centre[1] + half * y, torch.full_like(x, height)], -1
    ).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], device=device).expand(len(points), 3)
    key, sky = (light.reshape(FLOOR_SIZE, FLOOR_SIZE) for light in maps.gather(points, up)[:2])
    # A few sky lights stand for the whole sky: blur what they draw, not the key light's shadow.
    offsets = torch.arange(-7, 8, device=device)
    kernel = torch.exp(-0.5 * (offsets / 3.0) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(sky[None, None], (7, 7, 7, 7), mode="replicate")
    sky = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    sky = torch.nn.functional.conv2d(sky, kernel.view(1, 1, -1, 1))[0, 0]
    return 0.06 + 0.94 * (key + sky).clamp(0.0, 1.0).pow(1.0 / GAMMA)


class Renderer:
    """Draws frames from fixed cameras; what lies behind them is kept while the camera is the same.

    cameras: any number; each is lit for its own side
    """

    def __init__(self, cameras: Cameras, studio: Studio | None = None) -> None:
        self.studio = studio or Studio()
        self.cameras = [
            replace(cameras, viewmats=cameras.viewmats[i : i + 1], Ks=cameras.Ks[i : i + 1])
            for i in range(len(cameras))
        ]
        self._backdrop: tuple[tuple[int, str], _Backdrop | torch.Tensor] | None = None

    def render(self, gaussians: Gaussians, normals: torch.Tensor, camera: int = 0) -> np.ndarray:
        """One picture, uint8 [H, W, 3]. normals: [N, 3] unit, used by studio shading."""
        device = gaussians.means.device
        one = self.cameras[camera]
        lit, maps = gaussians, None
        if self.studio.shading == "studio" and len(gaussians):
            lit, maps = light(gaussians, normals, one, self.studio)
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
        key = (camera, str(device))
        if self._backdrop is None or self._backdrop[0] != key:
            self._backdrop = key, _backdrop(one, self.studio, device)
        backdrop = self._backdrop[1]
        if isinstance(backdrop, _Backdrop):
            backdrop = backdrop.picture(maps)
        picture = color[0] + (1.0 - alpha[0]) * backdrop
        return (picture.clamp(0.0, 1.0) * 255.0 + 0.5).to(torch.uint8).cpu().numpy()


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
) -> Cameras:
    """One camera that sees the box `low`..`high` (m); angles in degrees. `eye` and `target` override."""
    low, high = np.asarray(low, float), np.asarray(high, float)
    centre = 0.5 * (low + high) if target is None else np.asarray(target, float)
    vertical = math.radians(fov)
    if eye is None:
        a, e = math.radians(azimuth), math.radians(elevation)
        direction = np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])
        right = np.array([-math.sin(a), math.cos(a), 0.0])
        upward = np.cross(direction, right)
        corners = np.array(
            [[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])]
        )
        offset = corners - centre
        tan_v = math.tan(0.5 * vertical)
        tan_h = tan_v * width / height
        depth = offset @ direction
        needed = np.maximum(np.abs(offset @ right) / tan_h, np.abs(offset @ upward) / tan_v) + depth
        distance = max(1.06 * float(needed.max()), 1e-3)
        eye = centre + distance * direction
    return Cameras.look_at(np.asarray(eye, float), centre, vertical_fov=vertical, width=width, height=height)


__all__ = ["Renderer", "Studio", "frame_camera", "light"]
