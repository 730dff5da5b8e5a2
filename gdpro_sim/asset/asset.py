"""The asset: what generation makes and simulation takes, in one USD file with nothing lost."""

from __future__ import annotations

import hashlib
import json
import logging
import math
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from pxr import Sdf, Usd

from gdpro_sim.asset import prims, stage
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import sh_to_rgb
from gdpro_sim.materials import Material
from gdpro_sim.meshing.convex import ConvexPieces
from gdpro_sim.meshing.tetmesh import Embedding, TetMesh

log = logging.getLogger(__name__)

_SUM_TOLERANCE = 1e-3


@dataclass(frozen=True)
class Asset:
    """Bound Gaussians and, optionally, what simulation needs. SI units, Z up, the asset's own frame.

    name:          any text
    gaussians:     mesh and the Gaussians on it, on any device; files hold no device, loading gives the CPU
    vertex_colors: [V, 3] float32, sRGB in [0, 1], or None
    tets:          tetrahedra around the mesh, or None for an asset that is only shown
    embedding:     where the mesh's vertices sit in `tets`; present exactly when `tets` is
    material:      proposed by whoever made the asset, overridable in a scene
    pieces:        convex pieces for rigid contact, or None where nobody has needed them yet
    groups:        named sets of the mesh's vertices: ascending int32 ids, at least one
    group_materials: of groups that are made of something else than `material`
    provenance:    JSON values: source file, SHA-256, versions, seed, command

    Raises AssetError where the parts do not fit together.
    """

    name: str
    gaussians: BoundGaussians
    vertex_colors: np.ndarray | None = None
    tets: TetMesh | None = None
    embedding: Embedding | None = None
    material: Material | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    pieces: ConvexPieces | None = None
    groups: dict[str, np.ndarray] = field(default_factory=dict)
    group_materials: dict[str, Material] = field(default_factory=dict)

    def __post_init__(self) -> None:
        _check_binding(self.name, self.gaussians)
        vertex_count = len(self.gaussians.vertices)
        if self.vertex_colors is not None:
            _check_array(self.name, "vertex_colors", self.vertex_colors, np.float32, (vertex_count, 3))
        if (self.tets is None) != (self.embedding is None):
            raise AssetError(f"asset {self.name!r}: tets and embedding come together, one of them is missing")
        if self.tets is not None and self.embedding is not None:
            _check_tets(self.name, self.tets)
            _check_embedding(self.name, self.embedding, vertex_count, len(self.tets.tets))
        if self.pieces is not None:
            _check_pieces(self.name, self.pieces)
        _check_groups(self.name, self.groups, self.group_materials, vertex_count)
        try:
            normal = json.loads(json.dumps(self.provenance, allow_nan=False))
        except (TypeError, ValueError) as error:
            raise AssetError(f"asset {self.name!r}: provenance must hold JSON values: {error}") from error
        object.__setattr__(self, "provenance", normal)

    def save(self, path: str | Path) -> None:
        """Write the asset to a `.usdc`, `.usda` or `.usdz` file, whole or not at all.

        The same asset gives the same bytes. Raises AssetError for another suffix, RequestError where the path
        cannot be written, OutputError where writing fails (disk full).
        """
        stage.check_suffix(path)
        layer = Sdf.Layer.CreateAnonymous(".usdc")
        _author(layer, self)
        stage.export_layer(layer, path)
        log.info("saved asset %s: %d Gaussians to %s", self.name, len(self.gaussians), path)

    @staticmethod
    def load(path: str | Path) -> Asset:
        """Read an asset back bit for bit, on the CPU.

        Raises AssetError for a missing, corrupt or foreign file and for an unsupported format version.
        """
        layer = stage.open_layer(path)
        usd_stage, root = stage.open_root(layer, path, "asset")
        with stage.reading(path):
            asset = _read(usd_stage, root)
            if root.GetAttribute("gdpro:digest").Get() != asset.digest:
                log.warning("%s differs from what was saved: it was edited, or it is damaged", path)
            return asset

    def scaled(self, factor: float) -> Asset:
        """The asset resized uniformly by `factor` > 0: all its parts. Raises AssetError."""
        if not (math.isfinite(factor) and factor > 0.0):
            raise AssetError(f"asset {self.name!r}: scale must be a finite number > 0, got {factor}")
        if factor == 1.0:
            return self
        tets = self.tets
        if tets is not None:
            tets = replace(tets, vertices=tets.vertices * np.float32(factor))
        pieces = None if self.pieces is None else self.pieces.scaled(factor)
        return replace(self, gaussians=self.gaussians.scaled(factor), tets=tets, pieces=pieces)

    @property
    def digest(self) -> str:
        """SHA-256 of everything the asset holds, so that a damaged file is noticed and parts are known again.

        Of materials what differs from defaults, and of groups only where there are some, so that files from
        before a field came still fit.
        """
        return _digest(self)

    def summary(self) -> dict[str, Any]:
        """What the asset holds, as JSON values: counts, size in m, volume in m^3, mass in kg, material."""
        g = self.gaussians
        vertices = prims.to_numpy(g.vertices)
        low, high = vertices.min(0), vertices.max(0)
        result: dict[str, Any] = {
            "name": self.name,
            "gaussians": len(g),
            "sh_degree": math.isqrt(g.sh.shape[1]) - 1,
            "vertices": len(vertices),
            "faces": len(g.faces),
            "vertex_colors": self.vertex_colors is not None,
            "bounds_min": [float(x) for x in low],
            "bounds_max": [float(x) for x in high],
            "size": [float(x) for x in high - low],
        }
        if self.tets is not None:
            volume = float((self.tets.volumes() * self.tets.fill).sum())
            result["tets"] = len(self.tets.tets)
            result["tet_vertices"] = len(self.tets.vertices)
            result["tet_method"] = self.tets.method
            result["volume"] = volume
            if self.material is not None and not self.group_materials:
                result["mass"] = volume * self.material.density
        if self.pieces is not None:
            result["convex_pieces"] = len(self.pieces)
        if self.material is not None:
            result["material"] = self.material.model_dump()
        if self.groups:
            result["groups"] = {name: len(ids) for name, ids in self.groups.items()}
        if self.group_materials:
            result["group_materials"] = {k: m.model_dump() for k, m in self.group_materials.items()}
        result["provenance"] = self.provenance
        return result


# ---- checks ----


def _check_array(asset: str, name: str, a: Any, dtype: type, shape: tuple[int, ...]) -> None:
    if not isinstance(a, np.ndarray) or a.dtype != dtype or a.shape != shape:
        got = f"{a.dtype} {list(a.shape)}" if isinstance(a, np.ndarray) else type(a).__name__
        raise AssetError(f"asset {asset!r}: {name} must be {np.dtype(dtype).name} {list(shape)}, got {got}")
    if a.dtype.kind == "f" and not np.isfinite(a).all():
        where = int(np.argwhere(~np.isfinite(a))[0][0])
        raise AssetError(f"asset {asset!r}: {name}[{where}] is not finite")


def _check_indices(asset: str, name: str, a: np.ndarray, count: int, what: str) -> None:
    if a.size and (int(a.min()) < 0 or int(a.max()) >= count):
        bad = int(a.min()) if int(a.min()) < 0 else int(a.max())
        raise AssetError(f"asset {asset!r}: {name} holds {bad}, but there are {count} {what}")


def _check_sums(asset: str, name: str, weights: np.ndarray) -> None:
    # Relative to the weights: those of a vertex far outside its tet are large and cancel.
    off = np.abs(weights.sum(1, dtype=np.float64) - 1.0) / np.maximum(np.abs(weights).max(1), 1.0)
    if off.size and float(off.max()) > _SUM_TOLERANCE:
        row = int(off.argmax())
        raise AssetError(f"asset {asset!r}: {name}[{row}] must sum to 1, sums to {weights[row].sum():g}")


def _check_binding(asset: str, g: BoundGaussians) -> None:
    arrays = {f.name: prims.to_numpy(getattr(g, f.name)) for f in fields(g)}
    n, v, f = len(arrays["face_ids"]), len(arrays["vertices"]), len(arrays["faces"])
    if v == 0 or f == 0 or n == 0:
        raise AssetError(f"asset {asset!r} is empty: {v} vertices, {f} faces, {n} Gaussians")
    sh = arrays["sh"]
    if sh.ndim != 3 or sh.shape[1] not in (1, 4, 9, 16):
        raise AssetError(f"asset {asset!r}: sh must be float32 [{n}, 1|4|9|16, 3], got {list(sh.shape)}")
    shapes: dict[str, tuple[type, tuple[int, ...]]] = {
        "vertices": (np.float32, (v, 3)),
        "faces": (np.int32, (f, 3)),
        "face_ids": (np.int32, (n,)),
        "barycentrics": (np.float32, (n, 3)),
        "rotations": (np.float32, (n, 2)),
        "log_scales": (np.float32, (n, 3)),
        "opacity_logits": (np.float32, (n,)),
        "sh": (np.float32, (n, sh.shape[1], 3)),
    }
    for name, (dtype, shape) in shapes.items():
        _check_array(asset, name, arrays[name], dtype, shape)
    _check_indices(asset, "faces", arrays["faces"], v, "vertices")
    _check_indices(asset, "face_ids", arrays["face_ids"], f, "faces")
    _check_sums(asset, "barycentrics", arrays["barycentrics"])


def _check_tets(asset: str, tets: TetMesh) -> None:
    if len(tets.tets) == 0:
        raise AssetError(f"asset {asset!r}: the tet mesh is empty")
    _check_array(asset, "tets.vertices", tets.vertices, np.float32, tets.vertices.shape)
    _check_indices(asset, "tets.tets", tets.tets, len(tets.vertices), "tet vertices")
    if not (np.isfinite(tets.fill).all() and (tets.fill > 0).all() and (tets.fill <= 1).all()):
        raise AssetError(f"asset {asset!r}: tets.fill must lie in (0, 1]")
    volumes = tets.volumes()
    if not (volumes > 0).all():
        worst = int(volumes.argmin())
        raise AssetError(f"asset {asset!r}: tet {worst} has volume {volumes[worst]:g} m^3, must be > 0")


def _check_embedding(asset: str, embedding: Embedding, vertex_count: int, tet_count: int) -> None:
    _check_array(asset, "embedding.tet_ids", embedding.tet_ids, np.int32, (vertex_count,))
    _check_array(asset, "embedding.weights", embedding.weights, np.float32, (vertex_count, 4))
    _check_indices(asset, "embedding.tet_ids", embedding.tet_ids, tet_count, "tets")
    _check_sums(asset, "embedding.weights", embedding.weights)


def _check_pieces(asset: str, pieces: ConvexPieces) -> None:
    n, m = (int(x) for x in pieces.counts.sum(axis=0))
    _check_array(asset, "pieces.vertices", pieces.vertices, np.float32, (n, 3))
    _check_array(asset, "pieces.faces", pieces.faces, np.int32, (m, 3))
    for k, (vertices, faces) in enumerate(pieces):
        _check_indices(asset, f"pieces[{k}].faces", faces, len(vertices), "vertices")


def _check_groups(
    asset: str, groups: dict[str, np.ndarray], materials: dict[str, Material], vertex_count: int
) -> None:
    for name, ids in groups.items():
        _check_array(asset, f"groups[{name!r}]", ids, np.int32, (len(ids),))
        if not name or not len(ids) or (np.diff(ids) <= 0).any():
            raise AssetError(f"asset {asset!r}: group {name!r} must have a name and ascending vertex ids")
        _check_indices(asset, f"groups[{name!r}]", ids, vertex_count, "vertices")
    for name in materials:
        if name not in groups:
            raise AssetError(f"asset {asset!r}: group_materials names {name!r}, which is no group")


# ---- file ----


def _digest(asset: Asset) -> str:
    material = "" if asset.material is None else asset.material.model_dump_json(exclude_defaults=True)
    method = asset.tets.method if asset.tets is not None else ""
    result = hashlib.sha256(json.dumps([asset.name, asset.provenance, material, method]).encode())
    arrays = [prims.to_numpy(getattr(asset.gaussians, f.name)) for f in fields(asset.gaussians)]
    if asset.vertex_colors is not None:
        arrays.append(asset.vertex_colors)
    if asset.tets is not None and asset.embedding is not None:
        arrays += [asset.tets.vertices, asset.tets.tets, asset.tets.fill]
        arrays += [asset.embedding.tet_ids, asset.embedding.weights]
    if asset.pieces is not None:
        arrays += [asset.pieces.vertices, asset.pieces.faces, asset.pieces.counts]
    for name, ids in asset.groups.items():
        other = asset.group_materials.get(name)
        text = "" if other is None else other.model_dump_json(exclude_defaults=True)
        result.update(json.dumps([name, text]).encode())
        arrays.append(ids)
    for array in arrays:
        result.update(np.ascontiguousarray(array).data)
    return result.hexdigest()


def _author(layer: Sdf.Layer, asset: Asset) -> None:
    usd_stage = stage.new_stage(layer, "Asset", "asset")
    root = usd_stage.GetDefaultPrim()
    stage.set_custom(root, "gdpro:name", prims.T.String, asset.name)
    stage.set_custom(root, "gdpro:provenance", prims.T.String, json.dumps(asset.provenance))
    stage.set_custom(root, "gdpro:digest", prims.T.String, asset.digest)
    parent = root.GetPath()
    bound = asset.gaussians
    rest = bound.gaussians()
    average = prims.to_numpy(sh_to_rgb(rest.sh[:, 0])).mean(0, dtype=np.float64)
    mesh = prims.define_mesh(
        usd_stage,
        parent,
        prims.to_numpy(bound.vertices),
        prims.to_numpy(bound.faces),
        asset.vertex_colors,
        average,
    )
    splats = prims.SplatPrims.define(usd_stage, parent, rest, prims.SplatSample.of(rest))
    prims.write_binding(mesh, splats.splats, bound)
    tets = None
    if asset.tets is not None and asset.embedding is not None:
        tets = prims.define_tets(usd_stage, parent, asset.tets)
        root.AddAppliedSchema("PhysicsDeformableBodyAPI")
        embedding = asset.embedding
        stage.set_custom(mesh, "gdpro:embedding:tetIds", prims.T.IntArray, prims.ints(embedding.tet_ids))
        stage.set_custom(mesh, "gdpro:embedding:weights", prims.T.Float4Array, prims.vec4f(embedding.weights))
    if asset.pieces is not None:
        prims.define_pieces(usd_stage, parent, asset.pieces)
    if asset.material is not None:
        prims.define_material(usd_stage, parent, asset.material, tets)
    if asset.groups:
        prims.define_groups(usd_stage, mesh, asset.groups, asset.group_materials)


def _read(usd_stage: Usd.Stage, root: Usd.Prim) -> Asset:
    path = root.GetPath()
    mesh = usd_stage.GetPrimAtPath(path.AppendChild("Mesh"))
    splats = usd_stage.GetPrimAtPath(path.AppendChild("Splats"))
    tet_prim = usd_stage.GetPrimAtPath(path.AppendChild("Tets"))
    material_prim = usd_stage.GetPrimAtPath(path.AppendChild("PhysicsMaterial"))
    pieces_prim = usd_stage.GetPrimAtPath(path.AppendChild("Pieces"))
    for name, prim in (("Mesh", mesh), ("Splats", splats)):
        if not prim:
            raise AssetError(f"prim {path.AppendChild(name)} is missing; the file is damaged")
    bound = prims.read_binding(mesh, splats)
    vertex_count = len(bound.vertices)
    colors = None
    if mesh.GetAttribute("gdpro:vertexColors"):
        colors = prims.read(mesh, "gdpro:vertexColors", np.float32, (vertex_count, 3))
    tets = embedding = None
    if tet_prim:
        tets = prims.read_tets(tet_prim)
        embedding = Embedding(
            prims.read(mesh, "gdpro:embedding:tetIds", np.int32, (vertex_count,)),
            prims.read(mesh, "gdpro:embedding:weights", np.float32, (vertex_count, 4)),
        )
    try:
        provenance = json.loads(root.GetAttribute("gdpro:provenance").Get() or "{}")
    except ValueError as error:
        raise AssetError(f"gdpro:provenance is not JSON: {error}") from error
    name = root.GetAttribute("gdpro:name").Get()
    groups, materials = prims.read_groups(mesh)
    return Asset(
        name=str(name if name is not None else ""),
        gaussians=bound,
        vertex_colors=colors,
        tets=tets,
        embedding=embedding,
        material=prims.read_material(material_prim) if material_prim else None,
        provenance=provenance,
        pieces=prims.read_pieces(pieces_prim) if pieces_prim else None,
        groups=groups,
        group_materials=materials,
    )


__all__ = ["Asset"]
