"""Scene -> Model for animation: every asset's surface rides on the mesh that its motion moves."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from gdpro_sim.asset import Asset, bind_asset
from gdpro_sim.binding import vertex_normals
from gdpro_sim.errors import RequestError, SceneError
from gdpro_sim.simulation.animation import Motion, open_motion
from gdpro_sim.simulation.animation.follow import SurfaceFollower, fit_to_surface, torn
from gdpro_sim.simulation.animation.solver import AnimatedBody
from gdpro_sim.simulation.animation_options import BodyAnimation
from gdpro_sim.simulation.colliders import compile_collider
from gdpro_sim.simulation.model import Body, Ground, Model
from gdpro_sim.simulation.placement import Placement, place_bodies
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

log = logging.getLogger(__name__)

LOOKS = 9
"""Moments of a motion at which its mesh is checked for tearing."""

TORN = 1e-3
"""Share of a motion's size that vertices may part by which its mesh has in one place at rest."""


def motion_file(scene: Scene, body: SceneBody) -> Path:
    """Where the body's motion is read."""
    assert body.animation is not None
    return scene.resolve(body.animation.file or body.asset)


def moves_itself(scene: Scene, body: SceneBody) -> bool:
    """Whether the body's mesh is the very mesh that moves, so that its look comes from the same file."""
    return body.animation is not None and motion_file(scene, body) == scene.resolve(body.asset)


def animated_asset(
    scene: Scene, body: SceneBody, *, on_progress: Callable[[str], None] | None = None
) -> Asset:
    """The mesh in a body's motion as an asset, in the motion's rest pose. Raises MeshError, SceneError."""
    motion = _open(scene, body)
    if on_progress is not None:
        on_progress("reading the mesh")
    texture = None if body.texture is None else scene.resolve(body.texture)
    return bind_asset(
        motion.surface(color=body.color, texture=texture),
        name=body.name,
        source=motion.path,
        options={
            "color": body.color,
            "texture": None if texture is None else texture.name,
            "up": motion.up,
            "scale": motion.scale,
            "motion": list(motion.notes),
        },
        budget=body.budget,
        tets=False,
        seed=scene.seed,
        on_progress=on_progress,
    )


def compile_animation(scene: Scene, assets: dict[str, Asset], *, device: str = "cpu") -> Model:
    """A `Model` whose bodies follow motions.

    Raises SceneError for what has no effect without physics, and for an asset that does not lie on its
    motion's mesh; MeshError for a motion that cannot be read.
    """
    check_supported(scene)
    bodies: list[Body] = []
    animation: list[AnimatedBody | None] = []
    riding: dict[str, tuple[Motion, SurfaceFollower]] = {}
    for body, placement in zip(scene.bodies, place_bodies(scene, assets), strict=True):
        bodies.append(
            Body(
                name=body.name,
                gaussians=placement.asset.gaussians.to(device),
                surface=placement.surface,
                embedding=None,
                placement=placement,
            )
        )
        if body.animation is None:
            animation.append(None)
            continue
        if body.source not in riding:
            riding[body.source] = _riding(scene, body, assets[body.name])
        animation.append(_animated(scene, body, *riding[body.source], assets[body.name], placement))
    model = Model.without_tets(
        bodies=tuple(bodies),
        gravity=scene.gravity,
        ground=None if scene.ground is None else Ground(scene.ground.height),
        colliders=tuple(compile_collider(item, scene.resolve) for item in scene.colliders),
        device=device,
    )
    return replace(model, animation=tuple(animation))


def _open(scene: Scene, body: SceneBody) -> Motion:
    own = body.animation
    assert own is not None
    up = body.up if own.up == "auto" and moves_itself(scene, body) else own.up
    try:
        return open_motion(motion_file(scene, body), fps=own.fps, clip=own.clip, up=up, scale=own.scale)
    except RequestError as error:
        raise type(error)(f"{scene.name}: body {body.name!r}: animation: {error}") from error


def _riding(scene: Scene, body: SceneBody, asset: Asset) -> tuple[Motion, SurfaceFollower]:
    """A body's motion, and how its asset's surface rides on it."""
    own = body.animation
    assert own is not None
    motion = _open(scene, body)
    follower = _follower(f"{scene.name}: body {body.name!r}", asset, motion, own.tolerance)
    moments = np.linspace(motion.begin, motion.end, LOOKS)
    apart = max(torn(motion.rest, motion.vertices(moment)) for moment in moments)
    size = float(np.linalg.norm(np.ptp(motion.rest, axis=0)))
    if apart > TORN * size:
        log.warning(
            "body %r: vertices of %s that lie in one place at rest come apart by up to %.3g m; its surface "
            "is joined there, and stretches", body.name, motion.path.name, apart,
        )  # fmt: skip
    return motion, follower


def _animated(
    scene: Scene,
    body: SceneBody,
    motion: Motion,
    follower: SurfaceFollower,
    asset: Asset,
    placement: Placement,
) -> AnimatedBody:
    own = body.animation
    assert own is not None
    start, end = _span(f"{scene.name}: body {body.name!r}: animation", own, motion)
    size = float(np.ptp(asset.gaussians.vertices.cpu().numpy(), axis=0).max())
    factor = body.scale if body.size is None else body.size / size
    return AnimatedBody(
        motion, follower, start, end, own.speed, own.loop, factor, placement.turn, placement.shift
    )


def _span(where: str, own: BodyAnimation, motion: Motion) -> tuple[float, float]:
    start = motion.begin if own.start is None else own.start
    end = motion.end if own.end is None else own.end
    slack = 0.5 / motion.fps
    if start < motion.begin - slack or end > motion.end + slack or end <= start:
        raise SceneError(
            f"{where}: {start:g} to {end:g} s is not within the motion, which lasts from {motion.begin:g} to "
            f"{motion.end:g} s"
        )
    return max(start, motion.begin), min(end, motion.end)


def _follower(where: str, asset: Asset, motion: Motion, tolerance: float) -> SurfaceFollower:
    """How the asset rides on the motion: on its rest pose or, where that fits better, its first frame."""
    bound = asset.gaussians.to("cpu")
    if bound.is_loose:
        raise SceneError(f"{where}: a splat cloud has no surface that could follow a motion; give a mesh")
    points = bound.vertices.numpy().astype(np.float64)
    normals = vertex_normals(bound.vertices, bound.faces, bound.welded).numpy()
    fits = [
        fit_to_surface(points, normals, pose, motion.faces)
        for pose in (motion.rest, motion.vertices(motion.begin))
    ]
    best = min(fits, key=lambda fit: float(fit.distance.max()))
    size = float(np.linalg.norm(np.ptp(motion.rest, axis=0)))
    far = best.distance > tolerance * size
    if far.any():
        raise SceneError(
            f"{where}: {int(far.sum()):,} of {len(points):,} vertices lie more than {tolerance * size:.3g} m "
            f"off the mesh of {motion.path.name}, up to {best.distance.max():.3g} m. The asset reaches from "
            f"{_extent(points)} m, the mesh from {_extent(motion.rest)} m: give the motion's own file as the "
            "asset (a skin stands where its joints are, not its node), one made of this mesh, a fitting "
            "`scale` or `up`, or a larger `tolerance`"
        )
    return best.follower


def _extent(points: np.ndarray) -> str:
    low, high = ("[" + ", ".join(f"{x:.3g}" for x in p) + "]" for p in (points.min(0), points.max(0)))
    return f"{low} to {high}"


def check_supported(scene: Scene) -> None:
    """Raise SceneError for what needs a solver that computes motion."""
    none = (0.0, 0.0, 0.0)
    given = {
        "wind": bool(scene.wind),
        "springs": bool(scene.springs),
        "attachments": bool(scene.attachments),
        "ground.boundary": scene.ground is not None and scene.ground.boundary != "separate",
        **{
            f"colliders[{k}].{collider.mpm_only()}": collider.mpm_only() is not None
            for k, collider in enumerate(scene.colliders)
        },
        **{
            f"bodies[{body.name}].{key}": bool(getattr(body, key)) and getattr(body, key) != none
            for body in scene.bodies
            for key in (
                "velocity", "angular_velocity", "pins", "forces", "impulses", "pressures", "parts",
            )
        },
    }  # fmt: skip
    for key, present in given.items():
        if present:
            raise SceneError(
                f"{scene.name}: {key}: has no effect without physics; remove it, or choose another solver"
            )


__all__ = ["animated_asset", "check_supported", "compile_animation", "motion_file", "moves_itself"]
