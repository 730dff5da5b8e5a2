"""Light on Gaussians: distant lights and a dome, with soft shadows.

Each sample of a light is a camera far away: its splatted alpha and depth say how much of it reaches a point.
Jittered copies of a distant light, and a ring of samples of the dome, give soft shadows, contact shadows and
occlusion to Gaussians and floor alike. Colours are display-referred; light is applied with a 2.2 power.
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
CASTERS = 20_000
KEY_SHARE = 0.66
KEY_ELEVATION = 47.0
KEY_SOFTNESS = 7.0
BOUNCE = 0.10
GLOSS = 0.16
KEY_LIGHTS = 6
MOST_SAMPLES = 16
RING = ((22.0, 5, 0.3), (50.0, 4, 0.45), (82.0, 1, 0.25))
"""Samples of the sky: degrees above the horizon, how many, their share of what a floor receives."""


@dataclass(frozen=True)
class LightState:
    """A light at one moment.

    direction: [3] unit, towards it; None for a dome
    intensity: light that a surface facing it receives (dome: a floor under it); 1 shows white as white
    color:     linear RGB
    softness:  degrees, its radius in the sky
    """

    direction: tuple[float, float, float] | None
    intensity: float
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    softness: float = 0.0


@dataclass(frozen=True)
class Rig:
    """Samples of lights, in groups of one colour; distant lights come first.

    directions: [L, 3] towards the samples
    weights:    [L] light that a surface facing a sample receives
    first:      [G + 1] group g holds the samples from first[g] up to first[g + 1]
    colors:     [G, 3] linear RGB, or [G, 1] where all light is white
    gloss:      [G, 3] or [G, 1] strength of highlights; 0 for a dome
    horizontal: [G] light that an open floor receives
    blurred:    [G] whether few samples stand for a wide light: shadows on the floor are blurred
    """

    directions: np.ndarray
    weights: np.ndarray
    first: np.ndarray
    colors: np.ndarray
    gloss: np.ndarray
    horizontal: np.ndarray
    blurred: tuple[bool, ...]

    @functools.cached_property
    def full(self) -> np.ndarray:
        """Light of each colour that an open floor receives, [3] or [1]."""
        total: np.ndarray = (self.colors * self.horizontal[:, None]).sum(axis=0)
        return total

    def exposed(self, stops: float) -> Rig:
        """The same light, 2 ** stops times as bright in the picture."""
        if stops == 0.0:
            return self
        gain = 2.0**stops
        return replace(self, colors=self.colors * gain, gloss=self.gloss * gain ** (1.0 / GAMMA))


def _towards(azimuth: float, elevation: float) -> tuple[float, float, float]:
    a, e = math.radians(azimuth), math.radians(elevation)
    return math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)


@functools.cache
def studio_rig(azimuth: int) -> Rig:
    """One key light and a sky, all white. A horizontal surface in full light receives 1.

    azimuth: degrees, where the camera stands; the key light stands to its left
    """
    directions: list[tuple[float, float, float]] = []
    weights: list[float] = []

    def add(azimuth_degrees: float, elevation_degrees: float, weight: float) -> None:
        directions.append(_towards(azimuth_degrees, elevation_degrees))
        weights.append(weight / math.sin(math.radians(elevation_degrees)))

    for radius, turn in _disc(KEY_LIGHTS, KEY_SOFTNESS):
        add(
            azimuth - 48.0 + radius * math.cos(turn),
            KEY_ELEVATION + radius * math.sin(turn),
            KEY_SHARE / KEY_LIGHTS,
        )
    for elevation, count, share in RING:
        for k in range(count):
            add(azimuth + 30.0 + 360.0 * (k + 0.5) / count, elevation, (1.0 - KEY_SHARE) * share / count)
    return Rig(
        np.array(directions),
        np.array(weights),
        np.array([0, KEY_LIGHTS, len(directions)]),
        np.ones((2, 1)),
        np.array([[1.0], [0.0]]),
        np.array([KEY_SHARE, 1.0 - KEY_SHARE]),
        (False, True),
    )


def _disc(count: int, radius: float) -> list[tuple[float, float]]:
    """Radius and angle (rad) of points spread over a disc, in a spiral (Vogel 1979)."""
    return [(radius * math.sqrt((k + 0.5) / count), 2.399963 * k) for k in range(count)]


def rig_of(lights: Sequence[LightState], azimuth: float) -> Rig:
    """Samples of `lights`; `azimuth` in degrees turns those of the sky."""
    directions: list[np.ndarray] = []
    weights: list[float] = []
    first, colors, gloss, horizontal = [0], [], [], []
    distant = [light for light in lights if light.direction is not None]
    for light in distant:
        towards = np.asarray(light.direction)
        across = np.cross(towards, np.eye(3)[np.abs(towards).argmin()])
        across /= np.linalg.norm(across)
        along = np.cross(towards, across)
        count = 1
        if light.softness > 0.0:
            count = min(max(round(KEY_LIGHTS * light.softness / KEY_SOFTNESS), 1), MOST_SAMPLES)
        for radius, turn in _disc(count, math.radians(light.softness) if count > 1 else 0.0):
            aside = math.cos(turn) * across + math.sin(turn) * along
            directions.append(math.cos(radius) * towards + math.sin(radius) * aside)
            weights.append(light.intensity / count)
        first.append(len(directions))
        colors.append(np.asarray(light.color))
        studio = KEY_SHARE / math.sin(math.radians(KEY_ELEVATION))
        gloss.append((light.intensity / studio * np.asarray(light.color)) ** (1.0 / GAMMA))
        horizontal.append(light.intensity * max(float(towards[2]), 0.0))
    domes = [light for light in lights if light.direction is None]
    if domes:
        for elevation, count, share in RING:
            for k in range(count):
                directions.append(np.array(_towards(azimuth + 30.0 + 360.0 * (k + 0.5) / count, elevation)))
                weights.append(share / count / math.sin(math.radians(elevation)))
        first.append(len(directions))
        colors.append(np.sum([light.intensity * np.asarray(light.color) for light in domes], axis=0))
        gloss.append(np.zeros(3))
        horizontal.append(1.0)
    rig = Rig(
        np.array(directions),
        np.array(weights),
        np.array(first),
        np.array(colors),
        np.array(gloss),
        np.array(horizontal),
        (False,) * len(distant) + (True,) * bool(domes),
    )
    if np.ptp(rig.colors, axis=1).max() == 0.0:
        return replace(rig, colors=rig.colors[:, :1], gloss=rig.gloss[:, :1])
    return rig


class ShadowMaps:
    """How much light of a rig reaches any point past `gaussians`: one alpha and depth image per sample.

    centre, radius: [3] m and m, the sphere that they cover
    full:           [C] light of each colour that an open floor receives
    """

    def __init__(self, gaussians: Gaussians, rig: Rig) -> None:
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
            centre + distance * rig.directions,
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
        as_tensor = functools.partial(torch.tensor, dtype=torch.float32, device=device)
        texel = 2.0 * radius / MAP_SIZE
        self.centre, self.radius = as_tensor(centre), radius
        self.bias, self._softness = 2.5 * texel, 3.0 * texel
        self.blurred = rig.blurred
        self.colors, self.full = as_tensor(rig.colors), as_tensor(rig.full)
        self._gloss = as_tensor(rig.gloss)
        self._directions, self._weights = as_tensor(rig.directions), as_tensor(rig.weights)
        self._groups = [slice(a, b) for a, b in zip(rig.first[:-1], rig.first[1:], strict=True)]
        self._first = torch.tensor(rig.first, dtype=torch.int32, device=device)
        self._cameras, self._alpha, self._depth = cameras, alpha[..., 0], depth[..., 0]
        self._lit: tuple[torch.Tensor, torch.Tensor, torch.Tensor] | None = None

    def gather(self, points: torch.Tensor, normals: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Light of each group before its colour, and its visibility, [M, G]; points m, unit normals."""
        device = points.device
        light = torch.empty((len(points), len(self._groups)), dtype=torch.float32, device=device)
        seen = torch.empty_like(light)
        with beside_torch(points):
            launch_chunked(
                gather_light,
                len(points),
                [
                    wp.from_torch(points.contiguous(), dtype=wp.vec3),
                    wp.from_torch(normals.contiguous(), dtype=wp.vec3),
                    wp.from_torch(self._alpha.contiguous()),
                    wp.from_torch(self._depth.contiguous()),
                    wp.from_torch(self._cameras.viewmats.to(device).contiguous(), dtype=wp.mat44),
                    float(self._cameras.Ks[0, 0, 0]),
                    wp.from_torch(self._directions, dtype=wp.vec3),
                    wp.from_torch(self._weights),
                    wp.from_torch(self._first),
                    self.bias,
                    self._softness,
                ],
                [wp.from_torch(light), wp.from_torch(seen)],
                device=device_name(points),
                minimum=2048,
            )
        return light, seen

    def light(self, gaussians: Gaussians, normals: torch.Tensor, eye: torch.Tensor) -> Gaussians:
        """`gaussians` with the light multiplied into their colours, as `eye` [3] m sees them.

        normals: [N, 3] unit. What does not depend on the eye is kept for the next one.
        """
        if self._lit is None or self._lit[0] is not normals:
            light, seen = self.gather(gaussians.means + normals * self.bias, normals)
            total = light[:, :1] * self.colors[0]
            for group in range(1, len(self._groups)):
                total = total + light[:, group : group + 1] * self.colors[group]
            bounce = (BOUNCE * (1.0 - 0.5 * normals[:, 2]))[:, None] * self.full
            factor = (total + bounce).clamp(0.0, 1.6).pow(1.0 / GAMMA)
            self._lit = normals, factor, seen
        _, factor, seen = self._lit

        # Blinn-Phong highlights; Schlick-free, they only have to read as a glossy surface.
        to_eye = torch.nn.functional.normalize(eye - gaussians.means, dim=1)
        shine = torch.zeros_like(factor)
        for group, samples in enumerate(self._groups):
            if self.blurred[group]:
                continue
            half = torch.nn.functional.normalize(to_eye + self._directions[samples].mean(0), dim=1)
            gloss = GLOSS * (normals * half).sum(1).clamp_min(0.0).pow(60.0) * seen[:, group]
            shine = shine + gloss[:, None] * self._gloss[group]

        sh = gaussians.sh * factor[:, None, :]
        sh[:, 0] += (0.5 * factor - 0.5 + shine) / SH_C0
        return replace(gaussians, sh=sh)


__all__ = ["GAMMA", "LightState", "Rig", "ShadowMaps", "rig_of", "studio_rig"]
