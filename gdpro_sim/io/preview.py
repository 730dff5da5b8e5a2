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

from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import SH_C0, Gaussians
from gdpro_sim.splatting import rasterization

GAMMA = 2.2
MAP_SIZE = 160
FLOOR_SIZE = 224
KEY_SHARE = 0.66
BOUNCE = 0.10
GLOSS = 0.16


@dataclass(frozen=True)
class Studio:
    """What surrounds the Gaussians.

    shading:    "studio" (lights and shadows) or "none" (colours as they are)
    background: "studio" (gradient and gridded floor), "white" or "black"
    ground:     height of the floor in m, or None for no floor
    scale:      size of the subject in m; sets the grid spacing and where the floor fades out
    """

    shading: str = "studio"
    background: str = "studio"
    ground: float | None = 0.0
    scale: float = 1.0


@functools.cache
def _lights(azimuth: int) -> tuple[np.ndarray, np.ndarray]:
    """Directions towards the lights [L, 3] and their weights [L]; the key light stands beside the camera.

    A horizontal surface in full light receives 1.
    """
    directions: list[tuple[float, float, float]] = []
    weights: list[float] = []

    def add(azimuth_degrees: float, elevation_degrees: float, weight: float) -> None:
        a, e = math.radians(azimuth_degrees), math.radians(elevation_degrees)
        directions.append((math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)))
        weights.append(weight / math.sin(e))

    for turn, lift in ((-5.0, -3.0), (5.0, -4.0), (-4.0, 4.0), (4.0, 5.0)):
        add(azimuth - 48.0 + turn, 47.0 + lift, KEY_SHARE / 4.0)
    ring = ((22.0, 5, 0.3), (50.0, 4, 0.45), (82.0, 1, 0.25))
    for elevation, count, share in ring:
        for k in range(count):
            add(azimuth + 30.0 + 360.0 * (k + 0.5) / count, elevation, (1.0 - KEY_SHARE) * share / count)
    return np.array(directions), np.array(weights)


@dataclass(frozen=True)
class _ShadowMaps:
    cameras: Cameras
    alpha: torch.Tensor
    depth: torch.Tensor
    bias: float
    softness: float

    def visibility(self, points: torch.Tensor) -> torch.Tensor:
        """How much of each light reaches `points` [M, 3]; [L, M] in [0, 1]."""
        view = self.cameras.viewmats.to(points)
        local = torch.einsum("lij,mj->lmi", view[:, :3, :3], points) + view[:, None, :3, 3]
        k = self.cameras.Ks.to(points)
        z = local[..., 2].clamp_min(1e-6)
        u = k[:, None, 0, 0] * local[..., 0] / z + k[:, None, 0, 2]
        v = k[:, None, 1, 1] * local[..., 1] / z + k[:, None, 1, 2]
        grid = torch.stack([2.0 * u / self.cameras.width - 1.0, 2.0 * v / self.cameras.height - 1.0], -1)
        maps = torch.stack([self.alpha, self.depth], 1)
        sampled = torch.nn.functional.grid_sample(maps, grid[:, :, None, :], align_corners=False)[..., 0]
        alpha, depth = sampled[:, 0], sampled[:, 1]
        behind = (local[..., 2] - depth / alpha.clamp_min(1e-6) - self.bias) / self.softness
        return 1.0 - alpha * behind.clamp(0.0, 1.0)


def _shadow_maps(gaussians: Gaussians, directions: np.ndarray) -> _ShadowMaps:
    low = gaussians.means.amin(0).double().cpu().numpy()
    high = gaussians.means.amax(0).double().cpu().numpy()
    centre, radius = 0.5 * (low + high), max(0.55 * float(np.linalg.norm(high - low)), 1e-6)
    distance = 24.0 * radius
    cameras = Cameras.look_at(
        centre + distance * directions,
        centre,
        vertical_fov=2.0 * math.asin(radius / distance),
        width=MAP_SIZE,
        height=MAP_SIZE,
    )
    device = gaussians.means.device
    depth, alpha, _ = rasterization(
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities,
        torch.zeros((len(gaussians), 1), device=device),
        cameras.viewmats.to(device),
        cameras.Ks.to(device),
        cameras.width,
        cameras.height,
        near_plane=radius,
        render_mode="D",
    )
    texel = 2.0 * radius / MAP_SIZE
    return _ShadowMaps(cameras, alpha[..., 0], depth[..., 0], 2.5 * texel, 3.0 * texel)


def light(gaussians: Gaussians, normals: torch.Tensor, cameras: Cameras) -> tuple[Gaussians, _ShadowMaps]:
    """Gaussians with studio light multiplied into their colours, and the shadow maps that were made for it.

    normals: [N, 3] unit. The key light stands on the side of the first camera.
    """
    eye = cameras.positions[0].to(gaussians.means)
    middle = gaussians.means.mean(0)
    azimuth = round(math.degrees(math.atan2(float(eye[1] - middle[1]), float(eye[0] - middle[0]))))
    directions, weights = _lights(azimuth)
    maps = _shadow_maps(gaussians, directions)
    towards = torch.tensor(directions, dtype=torch.float32, device=gaussians.means.device)
    strength = torch.tensor(weights, dtype=torch.float32, device=gaussians.means.device)
    visible = maps.visibility(gaussians.means + normals * maps.bias)
    cosine = (normals @ towards.T).clamp_min(0.0).T
    received = (strength[:, None] * cosine * visible).sum(0) + BOUNCE * (1.0 - 0.5 * normals[:, 2])
    factor = received.clamp(0.0, 1.6).pow(1.0 / GAMMA)

    # Blinn-Phong highlight of the key light; Schlick-free, it only has to read as a glossy surface.
    to_eye = torch.nn.functional.normalize(eye - gaussians.means, dim=1)
    half = torch.nn.functional.normalize(to_eye + towards[:4].mean(0), dim=1)
    gloss = GLOSS * (normals * half).sum(1).clamp_min(0.0).pow(60.0) * visible[:4].mean(0)

    sh = gaussians.sh * factor[:, None, None]
    sh[:, 0] += ((0.5 * factor - 0.5 + gloss) / SH_C0)[:, None]
    return replace(gaussians, sh=sh), maps


@dataclass(frozen=True)
class _Backdrop:
    """What lies behind the Gaussians and does not change while the camera stands still.

    sky:    [H, W, 3] what is seen where there is no floor
    base:   [H, W, 3] the floor in full light, grid included
    fade:   [H, W, 1] how much of the floor shows before it melts into the sky
    uv:     [H, W, 2] where a pixel's floor point lies in the floor's shade map
    centre: [2] m, half: m; the square the shade map covers
    """

    sky: torch.Tensor
    base: torch.Tensor
    fade: torch.Tensor
    uv: torch.Tensor
    centre: torch.Tensor
    half: float

    def picture(self, maps: _ShadowMaps | None, height: float) -> torch.Tensor:
        """The backdrop under the shadows of `maps`, [H, W, 3]."""
        base = self.base
        if maps is not None:
            shade = _floor_shade(maps, self.centre, self.half, height)
            sampled = torch.nn.functional.grid_sample(
                shade[None, None], self.uv[None], padding_mode="border", align_corners=False
            )
            base = base * sampled[0, 0, :, :, None]
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
    centre = _looked_at(cameras, studio).to(device)
    reach = torch.linalg.norm(hit - centre, dim=-1, keepdim=True)
    base = torch.tensor([0.835, 0.845, 0.855], device=device).expand(h, w, 3)
    spacing = 10.0 ** math.floor(math.log10(max(studio.scale, 1e-6) * 0.8))
    foot = 0.75 * (t / k[1, 1]) / (-lift).clamp_min(0.02)  # metres of floor under a pixel
    for step, half, strength in ((spacing, 0.008 * spacing, 0.05), (5.0 * spacing, 0.012 * spacing, 0.10)):
        nearest = (hit / step - torch.round(hit / step)).abs() * step
        cover = ((half + 0.5 * foot - nearest) / foot).clamp(0.0, 1.0) * (2.0 * half / foot).clamp(max=1.0)
        base = base - strength * (1.0 - (1.0 - cover).prod(-1, keepdim=True))
    fade = torch.exp(-((reach / (5.0 * studio.scale)) ** 2)) * below
    half = 3.0 * studio.scale
    return _Backdrop(sky, base, fade, (hit - centre) / half, centre, half)


def _floor_shade(maps: _ShadowMaps, centre: torch.Tensor, half: float, height: float) -> torch.Tensor:
    """Brightness of the floor under the lights on a square around `centre`, [S, S], display-referred."""
    device = centre.device
    steps = (torch.arange(FLOOR_SIZE, device=device) + 0.5) / FLOOR_SIZE * 2.0 - 1.0
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    points = torch.stack(
        [centre[0] + half * x, centre[1] + half * y, torch.full_like(x, height)], -1
    ).reshape(-1, 3)
    directions = -maps.cameras.viewmats[:, 2, :3].to(device)
    weights = torch.tensor(_lights(0)[1], dtype=torch.float32, device=device) * directions[:, 2]
    visible = (weights[:, None] * maps.visibility(points)).reshape(-1, FLOOR_SIZE, FLOOR_SIZE)
    key, sky = visible[:4].sum(0), visible[4:].sum(0)
    # A few sky lights stand for the whole sky: blur what they draw, not the key light's shadow.
    offsets = torch.arange(-7, 8, device=device)
    kernel = torch.exp(-0.5 * (offsets / 3.0) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(sky[None, None], (7, 7, 7, 7), mode="replicate")
    sky = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    sky = torch.nn.functional.conv2d(sky, kernel.view(1, 1, -1, 1))[0, 0]
    return 0.08 + 0.92 * (key + sky).clamp(0.0, 1.0).pow(1.0 / GAMMA)


def _looked_at(cameras: Cameras, studio: Studio) -> torch.Tensor:
    """Where the first camera's axis meets the floor (or the point below a camera that looks up), [2]."""
    eye, forward = cameras.positions[0], cameras.viewmats[0, 2, :3]
    down = float(-forward[2])
    height = float(eye[2]) - float(studio.ground or 0.0)
    t = min(height / down, 12.0 * studio.scale) if down > 1e-3 else 4.0 * studio.scale
    return (eye + forward * t)[:2]


class Renderer:
    """Draws frames from fixed cameras; what does not change between frames is made once.

    cameras: any number; each is lit for its own side
    """

    def __init__(self, cameras: Cameras, studio: Studio | None = None) -> None:
        self.studio = studio or Studio()
        self.cameras = [
            replace(cameras, viewmats=cameras.viewmats[i : i + 1], Ks=cameras.Ks[i : i + 1])
            for i in range(len(cameras))
        ]
        self._backdrops: dict[tuple[int, str], _Backdrop | torch.Tensor] = {}

    def render(self, gaussians: Gaussians, normals: torch.Tensor, camera: int = 0) -> np.ndarray:
        """One picture, uint8 [H, W, 3]. normals: [N, 3] unit, used by studio shading."""
        device = gaussians.means.device
        one = self.cameras[camera]
        lit, maps = gaussians, None
        if self.studio.shading == "studio" and len(gaussians):
            lit, maps = light(gaussians, normals, one)
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
        if key not in self._backdrops:
            self._backdrops[key] = _backdrop(one, self.studio, device)
        backdrop = self._backdrops[key]
        if isinstance(backdrop, _Backdrop):
            backdrop = backdrop.picture(maps, float(self.studio.ground or 0.0))
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
        distance = max(1.12 * float(needed.max()), 1e-3)
        eye = centre + distance * direction
    return Cameras.look_at(np.asarray(eye, float), centre, vertical_fov=vertical, width=width, height=height)


__all__ = ["Renderer", "Studio", "frame_camera", "light"]
