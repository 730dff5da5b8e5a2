"""Motion out of glTF 2.0: moving nodes, skins (linear blend skinning) and morph targets."""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy import sparse
from scipy.spatial.transform import Rotation

from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.load import check_file, merge_parts
from gdpro_sim.meshing.rawmesh import RawMesh, RawPart
from gdpro_sim.meshing.surface import MeshMaterial
from gdpro_sim.meshing.trimesh_reader import corner_looks
from gdpro_sim.simulation.animation.gltf_file import GltfFile
from gdpro_sim.simulation.animation.source import Motion

log = logging.getLogger(__name__)

DRAWN = (0, 1, 4, 5)
"""Modes of primitives that trimesh makes something of: points, lines, triangles, strips."""

TRIANGLES = (4, 5)


@dataclass
class _Pose:
    """Of all nodes at one moment: translations [n, 3], rotations [n, 4] xyzw, scales [n, 3], and the morph
    weights of those that have some."""

    translation: np.ndarray
    rotation: np.ndarray
    scale: np.ndarray
    weights: dict[int, np.ndarray]


@dataclass(frozen=True)
class Channel:
    """What one animated property of a node is over time (glTF 2.0, 3.11 and appendix C).

    times:  [n] s, ascending
    values: [n, C]; of a cubic spline [n, 3, C]: in-tangent, value, out-tangent
    """

    node: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str

    def at(self, time: float) -> np.ndarray:
        """[C] at `time` s; held before the first and after the last key."""
        after = int(np.searchsorted(self.times, time, side="right"))
        cubic = self.interpolation == "CUBICSPLINE"
        if after == 0 or after == len(self.times) or self.interpolation == "STEP":
            value = self.values[max(after - 1, 0)]
            return value[1] if cubic else value
        a, b = after - 1, after
        length = self.times[b] - self.times[a]
        t = (time - self.times[a]) / length
        if cubic:
            (_, start, out), (inward, end, _) = self.values[a], self.values[b]
            value = (
                (2.0 * t**3 - 3.0 * t**2 + 1.0) * start
                + length * (t**3 - 2.0 * t**2 + t) * out
                + (3.0 * t**2 - 2.0 * t**3) * end
                + length * (t**3 - t**2) * inward
            )
            return value / np.linalg.norm(value) if self.path == "rotation" else value
        if self.path == "rotation":
            return slerp(self.values[a], self.values[b], t)
        return (1.0 - t) * self.values[a] + t * self.values[b]


def slerp(a: np.ndarray, b: np.ndarray, t: float) -> np.ndarray:
    """Between unit quaternions [4] along the shorter arc."""
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    if cosine > 0.9999995:
        value = (1.0 - t) * a + t * b
    else:
        angle = np.arccos(cosine)
        value = (np.sin((1.0 - t) * angle) * a + np.sin(t * angle) * b) / np.sin(angle)
    return value / np.linalg.norm(value)


@dataclass(frozen=True)
class _Skin:
    """joints [J] node ids, inverse bind matrices [J, 4, 4]."""

    joints: np.ndarray
    inverse: np.ndarray


@dataclass(frozen=True)
class _Shape:
    """One primitive as one node shows it.

    targets: [M, V, 3] displacements of its morph targets
    skin:    or None: it follows its node
    weights: [V, J] sparse, of the skin's joints
    """

    node: int
    positions: np.ndarray
    targets: np.ndarray
    skin: _Skin | None
    weights: Any


@dataclass
class _Scene:
    """Nodes of a file, in an order in which parents come first."""

    file: GltfFile
    order: list[int] = field(default_factory=list)
    parents: dict[int, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        nodes = self.file.list_of("nodes")
        scenes = self.file.list_of("scenes")
        inner = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in inner]
        if scenes:
            roots = scenes[self.file.json.get("scene", 0)].get("nodes", [])
        waiting = list(reversed(roots))
        met: set[int] = set()
        while waiting:
            node = waiting.pop()
            if node in met:
                raise MeshError(f"{self.file.path}: node {node} has two parents; the file is damaged")
            met.add(node)
            self.order.append(node)
            for child in reversed(nodes[node].get("children", [])):
                self.parents[child] = node
                waiting.append(child)
        self._fixed = {
            k: np.array(node["matrix"], np.float64).reshape(4, 4).T
            for k, node in enumerate(nodes)
            if "matrix" in node
        }

    def rest(self) -> _Pose:
        nodes, meshes = self.file.list_of("nodes"), self.file.list_of("meshes")
        weights = {}
        for k, node in enumerate(nodes):
            if "mesh" in node:
                own = node.get("weights", meshes[node["mesh"]].get("weights"))
                if own is not None:
                    weights[k] = np.array(own, np.float64)

        def table(key: str, default: list[float]) -> np.ndarray:
            return np.array([node.get(key, default) for node in nodes], np.float64)

        return _Pose(
            table("translation", [0.0, 0.0, 0.0]),
            table("rotation", [0.0, 0.0, 0.0, 1.0]),
            table("scale", [1.0, 1.0, 1.0]),
            weights,
        )

    def matrices(self, pose: _Pose) -> np.ndarray:
        """From each node to the world, [n, 4, 4]; nodes outside the scene stay at the origin."""
        count = len(pose.translation)
        local = np.tile(np.eye(4), (count, 1, 1))
        local[:, :3, :3] = Rotation.from_quat(pose.rotation).as_matrix() * pose.scale[:, None, :]
        local[:, :3, 3] = pose.translation
        for k, matrix in self._fixed.items():
            local[k] = matrix
        world = np.tile(np.eye(4), (count, 1, 1))
        for node in self.order:
            parent = self.parents.get(node)
            world[node] = local[node] if parent is None else world[parent] @ local[node]
        return world


def read_gltf(path: Path, fps: float, clip: str | None) -> Motion:
    """A glTF scene under one of its animations. Raises MeshError for one without."""
    check_file(path)
    file = GltfFile(path)
    try:
        scene = _Scene(file)
        name, channels = _animation(file, clip)
        shapes, look = _shapes(scene)
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise MeshError(f"{path}: is damaged: {type(error).__name__} {error}") from error
    if not channels:
        raise MeshError(f"{path}: its animation {name!r} moves no node; choose another, or export it again")
    rest = scene.rest()

    def vertices(pose: _Pose) -> np.ndarray:
        world = scene.matrices(pose)
        return np.concatenate([_placed(shape, pose, world) for shape in shapes])

    def at(time: float) -> np.ndarray:
        pose = _Pose(rest.translation.copy(), rest.rotation.copy(), rest.scale.copy(), dict(rest.weights))
        for channel in channels:
            if channel.path == "weights":
                pose.weights[channel.node] = channel.at(time)
            else:
                getattr(pose, channel.path)[channel.node] = channel.at(time)
        return vertices(pose)

    still = vertices(rest)
    first = 0
    for part in look.parts:
        part.vertices = still[first : first + len(part.vertices)]
        first += len(part.vertices)
    begin = min(float(channel.times[0]) for channel in channels)
    end = max(float(channel.times[-1]) for channel in channels)
    if end <= begin:
        raise MeshError(f"{path}: its animation {name!r} is one moment at {begin:g} s, no motion")
    faces = merge_parts(look.parts).faces.astype(np.int32)
    return Motion(path, look, faces, still, at, fps, begin, end, notes=(f"animation {name!r}",))


def _placed(shape: _Shape, pose: _Pose, world: np.ndarray) -> np.ndarray:
    """World positions [V, 3]: morphed, then skinned or carried by the node."""
    points = shape.positions
    weights = pose.weights.get(shape.node)
    if len(shape.targets) and weights is not None:
        points = points + np.einsum("m,mvc->vc", weights[: len(shape.targets)], shape.targets)
    if shape.skin is None:
        matrix = world[shape.node]
        return points @ matrix[:3, :3].T + matrix[:3, 3]
    joints = world[shape.skin.joints] @ shape.skin.inverse
    blended = (shape.weights @ joints[:, :3].reshape(len(joints), 12)).reshape(-1, 3, 4)
    return np.einsum("vij,vj->vi", blended[:, :, :3], points) + blended[:, :, 3]


# ---- reading ----


def _animation(file: GltfFile, clip: str | None) -> tuple[str, list[Channel]]:
    found = file.list_of("animations")
    names = [str(item.get("name", number)) for number, item in enumerate(found)]
    if not found:
        skinned = " (it has a skin, in one pose)" if file.list_of("skins") else ""
        raise MeshError(
            f"{file.path}: has no animation{skinned}; export it with one, or import it as it is: gdpro import"
        )
    number = 0
    if clip is not None:
        if clip in names:
            number = names.index(clip)
        elif clip.isdigit() and int(clip) < len(names):
            number = int(clip)
        else:
            raise MeshError(f"{file.path}: has no animation {clip!r}; it has {', '.join(map(repr, names))}")
    elif len(found) > 1:
        log.warning(
            "%s has %d animations, %r is taken; choose another with `clip`: %s",
            file.path.name, len(found), names[0], ", ".join(names),
        )  # fmt: skip
    channels = []
    for channel in found[number]["channels"]:
        target = channel["target"]
        if "node" not in target or target["path"] not in ("translation", "rotation", "scale", "weights"):
            log.warning(
                "%s: its animation of %s is left out", file.path.name, target.get("path", "a property")
            )
            continue
        channels.append(_channel(file, target, found[number]["samplers"][channel["sampler"]]))
    return names[number], channels


def _channel(file: GltfFile, target: dict[str, Any], sampler: dict[str, Any]) -> Channel:
    times = file.accessor(sampler["input"]).astype(np.float64)
    values = file.accessor(sampler["output"]).astype(np.float64)
    how = sampler.get("interpolation", "LINEAR")
    if how not in ("LINEAR", "STEP", "CUBICSPLINE"):
        raise MeshError(f"{file.path}: interpolation must be LINEAR, STEP or CUBICSPLINE, got {how}")
    if not len(times) or (np.diff(times) <= 0.0).any():
        raise MeshError(f"{file.path}: keyframe times of node {target['node']} do not ascend")
    rows = (len(times), 3, -1) if how == "CUBICSPLINE" else (len(times), -1)
    return Channel(target["node"], target["path"], times, values.reshape(rows), how)


def _shapes(scene: _Scene) -> tuple[list[_Shape], RawMesh]:
    """Every primitive under every node that shows it, and how it looks."""
    file = scene.file
    nodes, meshes = file.list_of("nodes"), file.list_of("meshes")
    looks, messages = _looks(file)
    shapes, look = [], RawMesh(up="y", messages=messages)
    for node in scene.order:
        if "mesh" not in nodes[node]:
            continue
        number = nodes[node]["mesh"]
        for which, primitive in enumerate(meshes[number]["primitives"]):
            if primitive.get("mode", 4) not in TRIANGLES:
                messages.append(f"skipped a primitive of mesh {number} that has no triangles")
                continue
            shape = _shape(file, node, primitive, nodes[node].get("skin"))
            shapes.append(shape)
            look.parts.append(_part(file, primitive, shape, looks.get((number, which))))
    if not shapes:
        raise MeshError(f"{file.path}: holds no triangles; export a triangle mesh")
    return shapes, look


def _looks(file: GltfFile) -> tuple[dict[tuple[int, int], Any], list[str]]:
    """What trimesh makes of each primitive, by mesh and primitive; it lists them in the file's order."""
    import trimesh

    keys = [
        (number, which)
        for number, mesh in enumerate(file.list_of("meshes"))
        for which, primitive in enumerate(mesh["primitives"])
        if primitive.get("mode", 4) in DRAWN
    ]
    try:
        found = list(trimesh.load_scene(str(file.path), process=False).geometry.values())
    except Exception as error:  # its parsers raise whatever they raise
        return {}, [f"textures and colours cannot be read ({error}); it gets the default colour"]
    if len(found) != len(keys):
        return {}, ["textures and colours could not be matched to the meshes; it gets the default colour"]
    return dict(zip(keys, found, strict=True)), []


def _part(file: GltfFile, primitive: dict[str, Any], shape: _Shape, look: Any) -> RawPart:
    count = len(shape.positions)
    faces = _faces(file, primitive, count)
    if look is None or len(look.vertices) != count or not np.array_equal(look.faces, faces):
        return RawPart(shape.positions, faces, np.zeros(len(faces), np.int32), [MeshMaterial()])
    uv, colors, ids, materials = corner_looks(look, faces, np.ones(len(faces), bool), ".glb")
    return RawPart(shape.positions, faces, ids, materials, uv, colors)


def _faces(file: GltfFile, primitive: dict[str, Any], count: int) -> np.ndarray:
    corners = np.arange(count)
    if "indices" in primitive:
        corners = file.accessor(primitive["indices"]).astype(np.int64)
    if primitive.get("mode", 4) == 5:
        strip = np.lib.stride_tricks.sliding_window_view(corners, 3).copy()
        strip[1::2] = strip[1::2][:, [1, 0, 2]]
        faces = strip
    else:
        faces = corners.reshape(-1, 3)
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        raise MeshError(f"{file.path}: faces point at vertex {int(faces.max())} of {count}; export it again")
    return faces


def _shape(file: GltfFile, node: int, primitive: dict[str, Any], skin: int | None) -> _Shape:
    attributes = primitive["attributes"]
    positions = file.accessor(attributes["POSITION"]).astype(np.float64)
    targets = [
        file.accessor(target["POSITION"]).astype(np.float64)
        if "POSITION" in target
        else np.zeros_like(positions)
        for target in primitive.get("targets", [])
    ]
    stacked = np.stack(targets) if targets else np.zeros((0, *positions.shape))
    if skin is None or "JOINTS_0" not in attributes:
        return _Shape(node, positions, stacked, None, None)
    item = file.list_of("skins")[skin]
    joints = np.array(item["joints"], np.int64)
    inverse = np.tile(np.eye(4), (len(joints), 1, 1))
    if "inverseBindMatrices" in item:
        matrices = file.accessor(item["inverseBindMatrices"]).astype(np.float64)
        inverse = matrices.reshape(-1, 4, 4).transpose(0, 2, 1)
    weights = _joint_weights(file, attributes, len(positions), len(joints))
    return _Shape(node, positions, stacked, _Skin(joints, inverse), weights)


def _joint_weights(file: GltfFile, attributes: dict[str, Any], count: int, joints: int) -> Any:
    """[V, J] sparse; rows sum to 1. A vertex without weights rides on the first joint."""
    rows, columns, values = [], [], []
    number = 0
    while f"JOINTS_{number}" in attributes:
        which = file.accessor(attributes[f"JOINTS_{number}"]).astype(np.int64)
        share = file.accessor(attributes[f"WEIGHTS_{number}"]).astype(np.float64)
        if which.shape != (count, 4) or share.shape != (count, 4):
            raise MeshError(f"{file.path}: JOINTS_{number} and WEIGHTS_{number} do not fit the vertices")
        used = share != 0.0
        if used.any() and int(which[used].max()) >= joints:
            raise MeshError(f"{file.path}: JOINTS_{number} holds {int(which[used].max())} of {joints} joints")
        rows.append(np.nonzero(used)[0])
        columns.append(which[used])
        values.append(share[used])
        number += 1
    row, column, value = (np.concatenate(parts) for parts in (rows, columns, values))
    total = np.bincount(row, weights=value, minlength=count)
    lone = np.flatnonzero(total <= 0.0)
    row, column = np.concatenate([row, lone]), np.concatenate([column, np.zeros(len(lone), np.int64)])
    value = np.concatenate([value, np.ones(len(lone))])
    total[lone] = 1.0
    return sparse.csr_matrix((value / total[row], (row, column)), shape=(count, joints))


__all__ = ["Channel", "read_gltf", "slerp"]
