"""Where a scene puts its bodies, and what they are made of."""

from __future__ import annotations

import difflib
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset
from gdpro_sim.asset.composition import anchor_point
from gdpro_sim.errors import SceneError
from gdpro_sim.materials import Material
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.simulation.options import Vector, color_of
from gdpro_sim.simulation.regions import Region
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

FALLBACK_MATERIAL = "jelly"

TOLERANCE = 0.15
"""How far red, green and blue of a vertex may be off a painted colour."""


@dataclass(frozen=True)
class Placement:
    """From an asset's frame to the world.

    asset:   at the body's own size, in its own frame
    turn:    [3, 3] rotation
    shift:   [3] m
    surface: [V, 3] float32 m, the asset's mesh in the world
    written: turn and shift of the body that this is a copy of; None: it is no copy
    colors:  [V, 3] sRGB of the asset's vertices, whatever colour a copy has; None: it has none
    """

    asset: Asset
    turn: np.ndarray
    shift: np.ndarray
    surface: np.ndarray
    written: tuple[np.ndarray, np.ndarray] | None = None
    colors: np.ndarray | None = None

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """World positions [n, 3] float64 m of points [n, 3] m in the asset's frame."""
        return points.astype(np.float64) @ self.turn.T + self.shift

    def as_written(self, points: np.ndarray) -> np.ndarray:
        """World points [n, 3] m of a copy, moved to where its body stands without copies."""
        if self.written is None:
            return points
        turn, shift = self.written
        moved: np.ndarray = (points - self.shift) @ self.turn @ turn.T + shift
        return moved

    def from_written(self, point: np.ndarray) -> np.ndarray:
        """The other way, of one point [3] m."""
        if self.written is None:
            return point
        turn, shift = self.written
        return self((point - shift)[None] @ turn)[0]

    def painted(self, where: str, region: Region) -> np.ndarray:
        """[V] bool: the surface vertices that a region's group or colour chooses.

        Raises SceneError, `where` first, for a group or a colour that the asset has not.
        """
        chosen = np.zeros(len(self.surface), bool)
        if region.group is not None:
            names = list(self.asset.groups)
            if region.group not in names:
                near = difflib.get_close_matches(region.group, names, n=1)
                hint = f" (did you mean {near[0]!r}?)" if near else ""
                raise SceneError(
                    f"{where}.group: the asset has no vertex group {region.group!r}{hint}; groups: "
                    f"{', '.join(names) or 'none'}"
                )
            chosen[self.asset.groups[region.group]] = True
            return chosen
        if self.colors is None:
            raise SceneError(f"{where}.painted: the asset's vertices have no colours; give a group or a box")
        tolerance = TOLERANCE if region.tolerance is None else region.tolerance
        off = np.abs(self.colors - np.asarray(color_of(str(region.painted)))).max(axis=1)
        chosen = off <= tolerance
        if not chosen.any():
            nearest = "".join(
                f"{round(255 * float(c)):02x}" for c in np.clip(self.colors[off.argmin()], 0, 1)
            )
            raise SceneError(
                f"{where}.painted: no vertex is painted {region.painted} within {tolerance:g}; the nearest "
                f"colour, #{nearest}, is {off.min():.2g} off"
            )
        return chosen

    def velocities(self, body: SceneBody, points: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Initial velocities [n, 3] float32 m/s at world `points` of a body that spins about `centre` m."""
        spin = np.cross(np.asarray(body.angular_velocity)[None, :], points - centre)
        return (spin + np.asarray(body.velocity)).astype(np.float32)


def place_bodies(scene: Scene, assets: dict[str, Asset]) -> list[Placement]:
    """Where each body's asset stands; copies share what a copy's colour does not change.

    Raises SceneError for a body that starts below the ground, and copies that overlap.
    """
    sized: dict[tuple[str, float | None, float], Asset] = {}
    placements = []
    for body in scene.bodies:
        asset = assets[body.name]
        colors = assets.get(body.source, asset).vertex_colors
        key = body.source, body.size, body.scale
        scaled = sized.get(key)
        if scaled is None:
            sized[key] = scaled = _sized(body, asset)
        elif asset.gaussians.sh is not scaled.gaussians.sh:
            scaled = replace(
                scaled,
                gaussians=replace(scaled.gaussians, sh=asset.gaussians.sh),
                vertex_colors=asset.vertex_colors,
            )
        placements.append(_placed(scene, body, scaled, colors))
    _check_copies_apart(scene, placements)
    return placements


def place(scene: Scene, body: SceneBody, asset: Asset) -> Placement:
    """Scale, turn and shift. Raises SceneError for a body that starts below the ground."""
    return _placed(scene, body, _sized(body, asset), asset.vertex_colors)


def _sized(body: SceneBody, asset: Asset) -> Asset:
    factor = body.scale
    if body.size is not None:
        factor = body.size / float(np.ptp(asset.gaussians.vertices.cpu().numpy(), axis=0).max())
    return asset.scaled(factor)


def _placed(scene: Scene, body: SceneBody, asset: Asset, colors: np.ndarray | None) -> Placement:
    rest = asset.gaussians.vertices.cpu().numpy().astype(np.float64)

    def stand(position: Vector, rotation: Vector) -> tuple[np.ndarray, np.ndarray]:
        turn = Rotation.from_euler("xyz", rotation, degrees=True).as_matrix()
        return turn, np.asarray(position) - anchor_point(rest @ turn.T, body.anchor)

    turn, shift = stand(body.position, body.rotation)
    written = None if body.copied is None else stand(body.copied.position, body.copied.rotation)
    surface = (rest @ turn.T + shift).astype(np.float32)
    _check_above_ground(scene, body, surface)
    return Placement(asset, turn, shift, surface, written, colors)


def material_of(body: SceneBody, asset: Asset) -> Material:
    """The scene's, else the asset's, else jelly."""
    return body.material or asset.material or Material.model_validate(FALLBACK_MATERIAL)


def _check_copies_apart(scene: Scene, placements: list[Placement]) -> None:
    """Raise SceneError for copies of one body of which one has vertices within the other."""
    groups: dict[str, list[int]] = {}
    for k, body in enumerate(scene.bodies):
        if body.copied is not None and not placements[k].asset.gaussians.is_loose:
            groups.setdefault(body.source, []).append(k)
    for ids in groups.values():
        low = np.array([placements[k].surface.min(axis=0) for k in ids])
        high = np.array([placements[k].surface.max(axis=0) for k in ids])
        reach = float(np.linalg.norm(high - low, axis=1).max())
        faces = placements[ids[0]].asset.gaussians.faces.cpu().numpy()
        for i, j in sorted(cKDTree(0.5 * (low + high)).query_pairs(reach)):
            if (low[i] > high[j]).any() or (low[j] > high[i]).any():
                continue
            a, b = (placements[ids[n]].surface for n in (i, j))
            for one, other in ((a, b), (b, a)):
                near = other[((other > one.min(0)) & (other < one.max(0))).all(axis=1)]
                if len(near) and SurfaceIndex(one, faces, winding=True).inside(near).any():
                    names = " and ".join(repr(scene.bodies[ids[n]].name) for n in (i, j))
                    raise SceneError(
                        f"{scene.name}: copies {names} overlap at the start; raise `spacing`, lower "
                        "`jitter`, or move their poses apart"
                    )


def _check_above_ground(scene: Scene, body: SceneBody, surface: np.ndarray) -> None:
    if scene.ground is None or body.animation is not None:  # what moves by itself may rest elsewhere
        return
    low, extent = float(surface[:, 2].min()), float(np.ptp(surface[:, 2]))
    below = scene.ground.height - low
    if below > 0.05 * extent:
        raise SceneError(
            f"{scene.name}: body {body.name!r} starts {below:.3g} m below the ground at z = "
            f"{scene.ground.height:g} m; raise its position by at least that much"
        )


__all__ = ["Placement", "material_of", "place", "place_bodies"]
