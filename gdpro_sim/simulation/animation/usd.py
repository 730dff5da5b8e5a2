"""Motion out of USD stages: time-sampled points, moving transforms, UsdSkel skins and blend shapes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.load import check_file, merge_parts
from gdpro_sim.meshing.usd_reader import open_stage, read_stage
from gdpro_sim.simulation.animation.source import Motion

Points = Callable[[Any], np.ndarray]
"""Vertices [V, 3] of a prim, in the stage's frame, at a time code."""


def read_animated_usd(path: Path, fps: float | None) -> Motion:
    """Every visible mesh of a stage, between its first and last time code.

    Raises MeshError for a stage in which nothing moves, and for meshes whose faces or number of points do.
    """
    from pxr import UsdGeom

    check_file(path)
    stage = open_stage(path)
    look, prims = read_stage(stage, path)
    rate = float(stage.GetTimeCodesPerSecond()) or 24.0
    skins = _skins(stage)
    for prim in prims:
        mesh = UsdGeom.Mesh(prim)
        for attribute in (mesh.GetFaceVertexCountsAttr(), mesh.GetFaceVertexIndicesAttr()):
            if attribute.ValueMightBeTimeVarying():
                raise MeshError(
                    f"{path}: the faces of {prim.GetPath()} change over time; only meshes whose topology "
                    "stays can carry Gaussians"
                )
    codes = _time_codes(stage, prims, skins)
    if not codes:
        raise MeshError(f"{path}: nothing in it moves: no mesh, transform or skeleton has time samples")
    begin, end = codes[0], codes[-1]
    if stage.HasAuthoredTimeCodeRange():
        begin, end = float(stage.GetStartTimeCode()), float(stage.GetEndTimeCode())
        if end <= begin:
            begin, end = codes[0], codes[-1]
    if end <= begin:
        raise MeshError(f"{path}: its only time sample is at {begin:g}; one moment is no motion")
    counts = [len(part.vertices) for part in look.parts]
    moving = _Moving(path, stage, prims, skins, counts)
    still = moving.at(begin)
    first = 0
    for part, count in zip(look.parts, counts, strict=True):  # the look stands where the motion starts
        part.vertices = still[first : first + count]
        first += count
    merged = merge_parts(look.parts)
    return Motion(
        path,
        look,
        merged.faces.astype(np.int32),
        still,
        lambda time: moving.at(time * rate),
        fps or (float(stage.GetFramesPerSecond()) if stage.HasAuthoredMetadata("framesPerSecond") else rate),
        begin / rate,
        end / rate,
    )


class _Moving:
    """The meshes of a stage at any time. It holds the stage, without which prims are invalid."""

    def __init__(
        self, path: Path, stage: Any, prims: list[Any], skins: dict[Any, tuple[Any, Any]], counts: list[int]
    ) -> None:
        self._path = path
        self._stage = stage
        self._prims = prims
        self._counts = counts
        self._movers = [_mover(prim, skins.get(prim.GetPath())) for prim in prims]

    def at(self, code: float) -> np.ndarray:
        """Vertices [V, 3] of all meshes, in the stage's frame. Raises MeshError."""
        from pxr import Usd

        found = [mover(Usd.TimeCode(code)) for mover in self._movers]
        for prim, points, count in zip(self._prims, found, self._counts, strict=True):
            if len(points) != count:
                raise MeshError(
                    f"{self._path}: {prim.GetPath()} has {len(points):,} points at time code {code:g}, but "
                    f"{count:,} at first: the topology must not change"
                )
        return np.concatenate(found)


def _time_codes(stage: Any, prims: list[Any], skins: dict[Any, tuple[Any, Any]]) -> list[float]:
    """Time codes at which something about the meshes is written."""
    from pxr import UsdGeom

    codes: set[float] = set()
    for prim in prims:
        codes.update(UsdGeom.Mesh(prim).GetPointsAttr().GetTimeSamples())
        above = prim
        while above and not above.IsPseudoRoot():
            if above.IsA(UsdGeom.Xformable):
                codes.update(UsdGeom.Xformable(above).GetTimeSamples())
            above = above.GetParent()
        if prim.GetPath() in skins:
            skeleton, _ = skins[prim.GetPath()]
            animation = skeleton.GetAnimQuery()
            if animation:
                codes.update(animation.GetJointTransformTimeSamples())
                codes.update(animation.GetBlendShapeWeightTimeSamples())
    return sorted(codes)


def _skins(stage: Any) -> dict[Any, tuple[Any, Any]]:
    """Skeleton and skinning queries of the meshes that have them, by path."""
    from pxr import Usd, UsdSkel

    found = {}
    predicate = Usd.TraverseInstanceProxies()
    for prim in Usd.PrimRange(stage.GetPseudoRoot(), predicate):
        if not prim.IsA(UsdSkel.Root):
            continue
        cache = UsdSkel.Cache()
        root = UsdSkel.Root(prim)
        cache.Populate(root, predicate)
        for binding in cache.ComputeSkelBindings(root, predicate):
            skeleton = cache.GetSkelQuery(binding.GetSkeleton())
            for query in binding.GetSkinningTargets():
                if skeleton and query.GetPrim():
                    found[query.GetPrim().GetPath()] = (skeleton, query)
    return found


def _mover(prim: Any, skin: tuple[Any, Any] | None) -> Points:
    from pxr import UsdGeom, UsdSkel, Vt

    mesh = UsdGeom.Mesh(prim)

    def placed(points: Any, owner: Any, code: Any) -> np.ndarray:
        matrix = np.array(UsdGeom.Xformable(owner).ComputeLocalToWorldTransform(code), np.float64)
        return np.asarray(points, np.float64) @ matrix[:3, :3] + matrix[3, :3]

    if skin is None:
        return lambda code: placed(mesh.GetPointsAttr().Get(code), prim, code)
    skeleton, query = skin
    shapes = UsdSkel.BlendShapeQuery(UsdSkel.BindingAPI(prim)) if query.HasBlendShapes() else None
    indices = shapes.ComputeBlendShapePointIndices() if shapes else None
    offsets = shapes.ComputeSubShapePointOffsets() if shapes else None

    def skinned(code: Any) -> np.ndarray:
        points = Vt.Vec3fArray(mesh.GetPointsAttr().Get(code))
        animation = skeleton.GetAnimQuery()
        if shapes and animation:
            weights = animation.ComputeBlendShapeWeights(code)
            mapper = query.GetBlendShapeMapper()
            weights = mapper.Remap(weights) if mapper else weights
            shapes.ComputeDeformedPoints(*shapes.ComputeSubShapeWeights(weights), indices, offsets, points)
        if not query.HasJointInfluences():
            return placed(points, prim, code)
        if not query.ComputeSkinnedPoints(skeleton.ComputeSkinningTransforms(code), points, code):
            raise MeshError(
                f"{prim.GetPath()}: UsdSkel cannot skin it: its joint indices or weights do not fit its "
                "points"
            )
        return placed(points, skeleton.GetPrim(), code)

    return skinned


__all__ = ["read_animated_usd"]
