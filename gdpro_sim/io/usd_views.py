"""Cameras and lights of a simulation file, for programs that show USD.

    /Simulation/Cameras/main_cam   UsdGeom.Camera of the scene's `camera`; usdview and usdrecord look for it
    /Simulation/Cameras/<name>     of each of its `cameras`
    /Simulation/Lights/<kind>_<n>  UsdLux.DistantLight or UsdLux.DomeLight

What stays the same has no time samples. A distant light of intensity 1 here has pi there, normalised, so that
a white Lambertian surface facing it has radiance 1; a dome's intensity is the same in both.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from pxr import Gf, Sdf, Usd, UsdGeom, UsdLux

from gdpro_sim.cameras import Cameras
from gdpro_sim.io.lighting import LightState
from gdpro_sim.simulation.view import MAIN

APERTURE = 24.0
"""Height of the film in mm; only its ratio to the focal length shows."""

CLIPPING = (0.01, 10_000.0)
"""m, nearest and farthest that cameras see; the nearest is the preview's own."""

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
"""Between cameras that look along +z with y down (OpenCV) and along -z with y up (USD)."""


class ViewPrims:
    """Prims of cameras, by name, and of lights; those of the first frame stay.

    root: path of the simulation, under which Cameras and Lights come to lie
    """

    def __init__(
        self, stage: Usd.Stage, root: Sdf.Path, cameras: Mapping[str, Cameras], lights: Sequence[LightState]
    ) -> None:
        folder = root.AppendChild("Cameras")
        UsdGeom.Scope.Define(stage, folder)
        self._cameras = {
            name: _CameraPrim(stage, folder.AppendChild("main_cam" if name == MAIN else name), camera)
            for name, camera in cameras.items()
        }
        folder = root.AppendChild("Lights")
        UsdGeom.Scope.Define(stage, folder)
        self._lights = [
            _LightPrim(
                stage, folder.AppendChild(f"{'dome' if light.direction is None else 'distant'}_{k}"), light
            )
            for k, light in enumerate(lights)
        ]

    def set(self, cameras: Mapping[str, Cameras], lights: Sequence[LightState], code: float) -> None:
        """Cameras and lights at a time code; codes increase."""
        for name, camera in cameras.items():
            self._cameras[name].set(camera, code)
        for prim, light in zip(self._lights, lights, strict=True):
            prim.set(light, code)


class _Sampled:
    """An attribute that gets time samples only where its value changes; the first is its default."""

    def __init__(self, attribute: Any) -> None:
        self._attribute = attribute
        self._value: Any = None
        self._code = self._written = -math.inf

    def set(self, value: Any, code: float) -> None:
        if self._value is None:
            self._attribute.Set(value)
        elif value != self._value:
            if self._written != self._code:
                self._attribute.Set(self._value, self._code)
            self._attribute.Set(value, code)
            self._written = code
        self._value, self._code = value, code


class _CameraPrim:
    def __init__(self, stage: Usd.Stage, path: Sdf.Path, camera: Cameras) -> None:
        prim = UsdGeom.Camera.Define(stage, path)
        prim.CreateProjectionAttr(UsdGeom.Tokens.perspective)
        prim.CreateVerticalApertureAttr(APERTURE)
        prim.CreateHorizontalApertureAttr(APERTURE * camera.width / camera.height)
        prim.CreateClippingRangeAttr(Gf.Vec2f(*CLIPPING))
        self._matrix = _Sampled(prim.AddTransformOp())
        self._focal = _Sampled(prim.CreateFocalLengthAttr())

    def set(self, camera: Cameras, code: float) -> None:
        pose = np.linalg.inv(camera.viewmats[0].double().numpy()) @ FLIP
        self._matrix.set(Gf.Matrix4d(pose.T), code)
        self._focal.set(APERTURE * float(camera.Ks[0, 1, 1]) / camera.height, code)


class _LightPrim:
    def __init__(self, stage: Usd.Stage, path: Sdf.Path, light: LightState) -> None:
        kind = UsdLux.DomeLight if light.direction is None else UsdLux.DistantLight
        prim = kind.Define(stage, path)
        prim.CreateColorAttr(Gf.Vec3f(*light.color))
        self._intensity = _Sampled(prim.CreateIntensityAttr())
        self._matrix: _Sampled | None = None
        if light.direction is not None:
            prim.CreateNormalizeAttr(True)
            prim.CreateAngleAttr(2.0 * light.softness)
            self._matrix = _Sampled(prim.AddTransformOp())

    def set(self, light: LightState, code: float) -> None:
        if light.direction is None or self._matrix is None:
            self._intensity.set(light.intensity, code)
            return
        self._intensity.set(math.pi * light.intensity, code)
        back = Gf.Rotation(Gf.Vec3d(0.0, 0.0, 1.0), Gf.Vec3d(*light.direction))
        self._matrix.set(Gf.Matrix4d(back, Gf.Vec3d(0.0)), code)


__all__ = ["ViewPrims"]
