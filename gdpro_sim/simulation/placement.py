"""Where a scene puts its bodies, and what they are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset
from gdpro_sim.errors import SceneError
from gdpro_sim.materials import Material
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

FALLBACK_MATERIAL = "jelly"


@dataclass(frozen=True)
class Placement:
    """From an asset's frame to the world.

    asset:   at the body's own size, in its own frame
    turn:    [3, 3] rotation
    shift:   [3] m
    surface: [V, 3] float32 m, the asset's mesh in the world
    """

    asset: Asset
    turn: np.ndarray
    shift: np.ndarray
    surface: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """World positions [n, 3] float64 m of points [n, 3] m in the asset's frame."""
        return points.astype(np.float64) @ self.turn.T + self.shift

    def velocities(self, body: SceneBody, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Initial velocities [n, 3] float32 m/s at world `points` of a body that spins about `centre` m."""
        spin = np.cross(np.asarray(body.angular_velocity)[None, :], points - centre)
        return (spin + np.asarray(body.velocity)).astype(np.float32)


def place(scene: Scene, body: SceneBody, asset: Asset) -> Placement:
    """Scale, turn and shift. Raises SceneError for a body that starts below the ground."""
    rest = asset.gaussians.vertices.cpu().numpy()
    factor = body.scale
    if body.size is not None:
        factor = body.size / float(np.ptp(rest, axis=0).max())
    asset = asset.scaled(factor)
    rest = asset.gaussians.vertices.cpu().numpy().astype(np.float64)
    turn = Rotation.from_euler("xyz", body.rotation, degrees=True).as_matrix()
    turned = rest @ turn.T
    shift = np.asarray(body.position) - _anchor(turned, body.anchor)
    surface = (turned + shift).astype(np.float32)
    _check_above_ground(scene, body, surface)
    return Placement(asset, turn, shift, surface)


def material_of(body: SceneBody, asset: Asset) -> Material:
    """The scene's, else the asset's, else jelly."""
    return body.material or asset.material or Material.model_validate(FALLBACK_MATERIAL)


def _anchor(points: np.ndarray, anchor: str) -> np.ndarray:
    low, high = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (low + high)
    if anchor == "bottom":
        return np.array([centre[0], centre[1], low[2]])
    return centre if anchor == "center" else np.zeros(3)


def _check_above_ground(scene: Scene, body: SceneBody, surface: np.ndarray) -> None:
    if scene.ground is None:
        return
    low, extent = float(surface[:, 2].min()), float(np.ptp(surface[:, 2]))
    below = scene.ground.height - low
    if below > 0.05 * extent:
        raise SceneError(
            f"{scene.name}: body {body.name!r} starts {below:.3g} m below the ground at z = "
            f"{scene.ground.height:g} m; raise its position by at least that much"
        )


__all__ = ["Placement", "material_of", "place"]
