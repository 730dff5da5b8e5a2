"""What lies behind the Gaussians of a picture: sky, gridded floor, the shadows on it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.io.lighting import GAMMA, ShadowMaps
from gdpro_sim.meshing.load import parse_color

if TYPE_CHECKING:
    from gdpro_sim.io.preview import Studio

FLOOR_SIZE = 224


@dataclass(frozen=True)
class Floor:
    """The floor that a camera sees.

    base:   [H, W, 3] in full light, grid included; None where it only catches shadows
    fade:   [H, W, 1] how much of it shows before it melts into what is behind
    points: [H, W, 2] m, where a pixel sees it
    height: m
    """

    base: torch.Tensor | None
    fade: torch.Tensor
    points: torch.Tensor
    height: float

    def darkening(self, maps: ShadowMaps) -> torch.Tensor:
        """Of each colour by shadows, [H, W, C] in [0, 1]."""
        centre = maps.centre[:2].to(self.points)
        half = 2.0 * maps.radius + 1.2 * max(float(maps.centre[2]) - self.height, 0.0)
        shade = _floor_shade(maps, centre, half, self.height)
        uv = ((self.points - centre) / half)[None]
        found = torch.nn.functional.grid_sample(1.0 - shade[None], uv, align_corners=False)
        return found[0].permute(1, 2, 0)


@dataclass(frozen=True)
class Backdrop:
    """What lies behind the Gaussians and does not change while the camera stands still.

    behind: [H, W, 3] what is seen where there is no floor; None for nothing (transparent)
    floor:  or None
    lit:    whether `behind` is a surface under the lights, as the studio's is
    """

    behind: torch.Tensor | None
    floor: Floor | None
    lit: bool

    def picture(self, maps: ShadowMaps | None) -> tuple[torch.Tensor, torch.Tensor | None]:
        """Colours [H, W, 3] under the shadows of `maps`, times their opacity [H, W, 1]; None: opaque."""
        behind, floor = self.behind, self.floor
        if floor is not None and floor.base is None:
            shadow = floor.fade * (0.0 if maps is None else floor.darkening(maps).mean(-1, keepdim=True))
            if behind is None:
                return shadow.new_zeros((*shadow.shape[:2], 3)), shadow
            return behind * (1.0 - shadow), None
        if behind is None:
            return torch.zeros(3), torch.zeros(1)
        if maps is not None and self.lit and bool((maps.full != 1.0).any()):
            tint = maps.full.clamp(0.0, 1.6).pow(1.0 / GAMMA)
        else:
            tint = None
        if floor is None or floor.base is None:
            return behind if tint is None else behind * tint, None
        base = floor.base if maps is None else floor.base * (1.0 - floor.darkening(maps))
        shown = behind + (base - behind) * floor.fade
        return shown if tint is None else shown * tint, None


def backdrop(camera: Cameras, studio: Studio, device: torch.device) -> Backdrop:
    """Floor and sky of one camera, or a plain colour."""
    h, w = camera.height, camera.width
    if studio.background == "transparent":
        behind, rays = None, None
    elif studio.background != "studio":
        behind = torch.tensor(parse_color(studio.background), device=device).expand(h, w, 3)
    if studio.background != "studio" and not studio.catch_shadows:
        return Backdrop(behind, None, False)
    view, k = camera.viewmats[0].to(device), camera.Ks[0].to(device)
    ys, xs = torch.meshgrid(
        torch.arange(h, device=device) + 0.5, torch.arange(w, device=device) + 0.5, indexing="ij"
    )
    local = torch.stack([(xs - k[0, 2]) / k[0, 0], (ys - k[1, 2]) / k[1, 1], torch.ones_like(xs)], -1)
    rays = torch.nn.functional.normalize(local @ view[:3, :3], dim=-1)
    eye = camera.positions[0].to(device)
    lift = rays[..., 2:3]
    if studio.background == "studio":
        top, horizon = (
            torch.tensor([0.80, 0.85, 0.90], device=device),
            torch.tensor([0.95, 0.955, 0.96], device=device),
        )
        behind = horizon + (top - horizon) * lift.clamp(0.0, 1.0).pow(0.7)
    lit = studio.background == "studio"
    if studio.ground is None or float(eye[2]) <= studio.ground:
        return Backdrop(behind, None, lit)
    below = lift < -1e-4
    t = (studio.ground - eye[2]) / torch.where(below, lift, torch.full_like(lift, -1e-4))
    hit = (eye + rays * t)[..., :2]
    focus = torch.tensor(studio.focus[:2], dtype=torch.float32, device=device)
    reach = torch.linalg.norm(hit - focus, dim=-1, keepdim=True)
    fade = torch.exp(-((reach / (5.0 * studio.scale)) ** 2)) * below
    base = None
    if lit:
        base = torch.tensor([0.835, 0.845, 0.855], device=device).expand(h, w, 3)
        spacing = 10.0 ** math.floor(math.log10(max(studio.scale, 1e-6) * 0.8))
        foot = 0.75 * (t / k[1, 1]) / (-lift).clamp_min(0.02)  # metres of floor under a pixel
        for step, half, strength in (
            (spacing, 0.008 * spacing, 0.05),
            (5.0 * spacing, 0.012 * spacing, 0.10),
        ):
            nearest = (hit / step - torch.round(hit / step)).abs() * step
            cover = ((half + 0.5 * foot - nearest) / foot).clamp(0.0, 1.0) * (2.0 * half / foot).clamp(
                max=1.0
            )
            base = base - strength * (1.0 - (1.0 - cover).prod(-1, keepdim=True))
    return Backdrop(behind, Floor(base, fade, hit, studio.ground), lit)


def _floor_shade(maps: ShadowMaps, centre: torch.Tensor, half: float, height: float) -> torch.Tensor:
    """Brightness of the floor under the lights on a square around `centre`, against the open floor's.

    [C, S, S], display-referred.
    """
    device = centre.device
    steps = (torch.arange(FLOOR_SIZE, device=device) + 0.5) / FLOOR_SIZE * 2.0 - 1.0
    y, x = torch.meshgrid(steps, steps, indexing="ij")
    points = torch.stack(
        [centre[0] + half * x, centre[1] + half * y, torch.full_like(x, height)], -1
    ).reshape(-1, 3)
    up = torch.tensor([0.0, 0.0, 1.0], device=device).expand(len(points), 3)
    light = maps.gather(points, up)[0].T.reshape(-1, FLOOR_SIZE, FLOOR_SIZE)
    total = None
    for arriving, color, blurred in zip(light, maps.colors, maps.blurred, strict=True):
        colored = (_blur(arriving) if blurred else arriving) * color[:, None, None]
        total = colored if total is None else total + colored
    assert total is not None  # a rig has lights
    open_floor = maps.full.clamp_min(1e-6)[:, None, None]
    return 0.06 + 0.94 * (total / open_floor).clamp(0.0, 1.0).pow(1.0 / GAMMA)


def _blur(light: torch.Tensor) -> torch.Tensor:
    """A few samples stand for a whole sky: blur what they draw, [S, S]."""
    offsets = torch.arange(-7, 8, device=light.device)
    kernel = torch.exp(-0.5 * (offsets / 3.0) ** 2)
    kernel = kernel / kernel.sum()
    padded = torch.nn.functional.pad(light[None, None], (7, 7, 7, 7), mode="replicate")
    rows = torch.nn.functional.conv2d(padded, kernel.view(1, 1, 1, -1))
    return torch.nn.functional.conv2d(rows, kernel.view(1, 1, -1, 1))[0, 0]


__all__ = ["Backdrop", "backdrop"]
