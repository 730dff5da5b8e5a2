"""Several assets made into one: each turned, resized and moved, their shells glued or left side by side."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from scipy import sparse
from scipy.sparse import csgraph
from scipy.spatial.transform import Rotation

from gdpro_sim.asset.asset import Asset
from gdpro_sim.asset.importer import tetrahedralize_asset, versions
from gdpro_sim.asset.prims import to_numpy
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import sh_to_rgb
from gdpro_sim.materials import Material
from gdpro_sim.meshing.convex import ConvexPieces
from gdpro_sim.meshing.tetmesh import Embedding, TetMesh

log = logging.getLogger(__name__)

Anchor = Literal["bottom", "center", "origin"]
Vector = tuple[float, float, float]

UNSTATED = "not stated"
"""Licence of a part whose provenance has no "license"."""

NOBODY = "none: made from words by the built-in generator"
"""Licence of a part in which there is nothing of anybody else's: no mesh, no photos, no trained weights."""


@dataclass(frozen=True)
class ComposedPart:
    """An asset and where it goes in a composition.

    position: m, of the anchor
    rotation: degrees about X, then Y, then Z
    scale:    uniform, > 0
    size:     m, longest side of its bounding box before it is turned; in place of `scale`
    anchor:   point of the turned asset that `position` places: its own origin, the middle of its bounding
              box, or the middle of that box's lower side
    name:     default: the asset's
    """

    asset: Asset
    position: Vector = (0.0, 0.0, 0.0)
    rotation: Vector = (0.0, 0.0, 0.0)
    scale: float = 1.0
    size: float | None = None
    anchor: Anchor = "origin"
    name: str | None = None


def compose(
    parts: Sequence[ComposedPart | Asset],
    *,
    name: str = "composition",
    glue: bool = True,
    target_tets: int = 6_000,
    on_progress: Callable[[str], None] | None = None,
) -> Asset:
    """One asset of several: a mesh of all their shells with all their Gaussians.

    glue:        fill the union of all shells with fresh tets, so that parts that overlap are one body; parts
                 that do not touch any other are named in the log. Otherwise parts keep the tets they have,
                 each its own, and nothing holds them together; where one has none, there are none at all
    target_tets: of the union, as in `gdpro_sim.meshing.tetrahedralize.tetrahedralize`; 0 makes none

    Spherical harmonics turn with their part, and lower degrees are filled up with zeros. Each part becomes a
    vertex group of its name; what it is made of goes with the group where it is not what the first part is
    made of. Names that clash get a number. The provenance lists the parts with their SHA-256, licence and own
    provenance. One part left as it is gives the same mesh, Gaussians and tets back.

    >>> body, head = Asset.load("body.usdc"), Asset.load("head.usdc")  # doctest: +SKIP
    >>> compose([body, ComposedPart(head, position=(0, 0, 0.3), size=0.2)])  # doctest: +SKIP

    Raises AssetError for no parts, for a transform that is not finite or has a scale <= 0, and MeshError
    where the union cannot be filled.
    """
    if not parts:
        raise AssetError(f"composition {name!r} has no parts; give one at least")
    items = [part if isinstance(part, ComposedPart) else ComposedPart(part) for part in parts]
    names = _names(items)
    placed = [_placed(item, label) for item, label in zip(items, names, strict=True)]
    counts = [len(asset.gaussians.vertices) for asset in placed]
    ends = np.cumsum(counts)
    groups: dict[str, np.ndarray] = {}
    materials: dict[str, Material] = {}
    main = placed[0].material
    for label, asset, end, count in zip(names, placed, ends, counts, strict=True):
        first = int(end) - count
        if len(placed) > 1:
            groups[label] = np.arange(first, end, dtype=np.int32)
            if asset.material is not None and asset.material != main:
                materials[label] = asset.material
        for inner, ids in asset.groups.items():
            own = inner if len(placed) == 1 else f"{label}_{inner}"
            groups[own] = (ids + first).astype(np.int32)
            if inner in asset.group_materials:
                materials[own] = asset.group_materials[inner]
    result = Asset(
        name=name,
        gaussians=_joined([asset.gaussians for asset in placed]),
        vertex_colors=_colors(placed),
        material=main,
        provenance=_provenance(items, names),
        pieces=_pieces(placed),
        groups=groups,
        group_materials=materials,
    )
    if len(placed) == 1 or not glue:
        return _with_merged_tets(result, placed, names)
    if target_tets == 0:
        return result
    loose = [label for label, asset in zip(names, placed, strict=True) if asset.gaussians.is_loose]
    if loose:
        log.warning("%s: no tets: part %r is a splat cloud without a mesh", name, loose[0])
        return result
    result = tetrahedralize_asset(result, target_tets=target_tets, on_progress=on_progress)
    _tell_apart(result, names, counts)
    return result


def anchor_point(points: np.ndarray, anchor: Anchor) -> np.ndarray:
    """[3] m: the point of a body with vertices `points` [V, 3] m that its position places."""
    low, high = points.min(axis=0), points.max(axis=0)
    centre = 0.5 * (low + high)
    if anchor == "bottom":
        return np.array([centre[0], centre[1], low[2]])
    return centre if anchor == "center" else np.zeros(3)


# ---- one part ----


def _names(items: Sequence[ComposedPart]) -> list[str]:
    """Of the parts, each once: later ones of the same name get a number."""
    wanted = [item.name or item.asset.name or "part" for item in items]
    chosen: list[str] = []
    for label in wanted:
        fresh, number = label, 1
        while fresh in chosen or (number > 1 and fresh in wanted):
            number += 1
            fresh = f"{label}_{number}"
        if fresh != label:
            log.warning("part %d is named %r like an earlier one; it becomes %r", len(chosen), label, fresh)
        chosen.append(fresh)
    return chosen


def _placed(item: ComposedPart, label: str) -> Asset:
    """The asset resized, turned and shifted."""
    factor = _factor(item, label)
    for key in ("position", "rotation"):
        value = getattr(item, key)
        if len(value) != 3 or not all(math.isfinite(x) for x in value):
            raise AssetError(f"part {label!r}: {key} must be three finite numbers, got {list(value)}")
    if item.anchor not in get_args(Anchor):
        raise AssetError(
            f"part {label!r}: anchor must be one of {', '.join(get_args(Anchor))}, got {item.anchor!r}"
        )
    asset = item.asset.scaled(factor)
    turn = Rotation.from_euler("xyz", item.rotation, degrees=True).as_matrix()
    turned = to_numpy(asset.gaussians.vertices).astype(np.float64) @ turn.T
    shift = np.asarray(item.position, np.float64) - anchor_point(turned, item.anchor)
    if not any(item.rotation) and not shift.any():
        return asset

    def move(points: np.ndarray) -> np.ndarray:
        return (points.astype(np.float64) @ turn.T + shift).astype(np.float32)

    vertices = torch.from_numpy(move(to_numpy(asset.gaussians.vertices))).to(asset.gaussians.device)
    sh = asset.gaussians.sh
    if any(item.rotation):
        sh = asset.gaussians.gaussians(vertices).sh
    pieces = asset.pieces
    return replace(
        asset,
        gaussians=replace(asset.gaussians, vertices=vertices, sh=sh),
        tets=None if asset.tets is None else replace(asset.tets, vertices=move(asset.tets.vertices)),
        pieces=None if pieces is None else replace(pieces, vertices=move(pieces.vertices)),
    )


def _factor(item: ComposedPart, label: str) -> float:
    if item.size is not None:
        if item.scale != 1.0:
            raise AssetError(f"part {label!r}: give either scale or size, one of the two")
        if not (math.isfinite(item.size) and item.size > 0.0):
            raise AssetError(f"part {label!r}: size must be a finite number > 0 m, got {item.size}")
        return item.size / float(np.ptp(to_numpy(item.asset.gaussians.vertices), axis=0).max())
    if not (math.isfinite(item.scale) and item.scale > 0.0):
        raise AssetError(
            f"part {label!r}: scale must be a finite number > 0, got {item.scale}; turn it with rotation "
            "instead of mirroring it"
        )
    return item.scale


# ---- all of them ----


def _joined(bounds: Sequence[BoundGaussians]) -> BoundGaussians:
    if len(bounds) == 1:
        return bounds[0]
    bounds = [bound.to("cpu") for bound in bounds]
    vertex_ends = np.cumsum([len(b.vertices) for b in bounds])
    face_ends = np.cumsum([len(b.faces) for b in bounds])
    most = max(b.sh.shape[1] for b in bounds)

    def all_of(key: str) -> torch.Tensor:
        return torch.cat([getattr(b, key) for b in bounds])

    return BoundGaussians(
        vertices=all_of("vertices"),
        faces=torch.cat(
            [b.faces + int(e) - len(b.vertices) for b, e in zip(bounds, vertex_ends, strict=True)]
        ),
        face_ids=torch.cat(
            [b.face_ids + int(e) - len(b.faces) for b, e in zip(bounds, face_ends, strict=True)]
        ),
        barycentrics=all_of("barycentrics"),
        rotations=all_of("rotations"),
        log_scales=all_of("log_scales"),
        opacity_logits=all_of("opacity_logits"),
        sh=torch.cat([torch.nn.functional.pad(b.sh, (0, 0, 0, most - b.sh.shape[1])) for b in bounds]),
    )


def _colors(placed: Sequence[Asset]) -> np.ndarray | None:
    """Vertex colours of all; a part without any gets its Gaussians' mean colour where another has some."""
    if all(asset.vertex_colors is None for asset in placed):
        return None
    found = []
    for asset in placed:
        colors = asset.vertex_colors
        if colors is None:
            mean = np.clip(to_numpy(sh_to_rgb(asset.gaussians.sh[:, 0])).mean(axis=0), 0.0, 1.0)
            colors = np.tile(mean.astype(np.float32), (len(asset.gaussians.vertices), 1))
        found.append(colors)
    return np.concatenate(found)


def _pieces(placed: Sequence[Asset]) -> ConvexPieces | None:
    """Convex pieces of all, where all have some."""
    found = [asset.pieces for asset in placed if asset.pieces is not None]
    if len(found) < len(placed):
        return None
    return ConvexPieces(
        np.concatenate([p.vertices for p in found]),
        np.concatenate([p.faces for p in found]),
        np.concatenate([p.counts for p in found]),
        max(p.concavity for p in found),
    )


def _with_merged_tets(result: Asset, placed: Sequence[Asset], names: Sequence[str]) -> Asset:
    """With the tets that the parts have, side by side."""
    found = [(a.tets, a.embedding) for a in placed if a.tets is not None and a.embedding is not None]
    if len(found) < len(placed):
        lacking = [label for label, asset in zip(names, placed, strict=True) if asset.tets is None]
        if found:
            log.warning("%s: tets dropped, because part %r has none", result.name, lacking[0])
        return result
    meshes = [tets for tets, _ in found]
    vertex_ends = np.cumsum([len(t.vertices) for t in meshes])
    tet_ends = np.cumsum([len(t.tets) for t in meshes])
    methods = {t.method for t in meshes}
    return replace(
        result,
        tets=TetMesh(
            np.concatenate([t.vertices for t in meshes]),
            np.concatenate(
                [t.tets + np.int32(e - len(t.vertices)) for t, e in zip(meshes, vertex_ends, strict=True)]
            ),
            np.concatenate([t.fill for t in meshes]),
            methods.pop() if len(methods) == 1 else "lattice",
        ),
        embedding=Embedding(
            np.concatenate(
                [e.tet_ids + np.int32(end - len(t.tets)) for (t, e), end in zip(found, tet_ends, strict=True)]
            ),
            np.concatenate([e.weights for _, e in found]),
        ),
    )


def _tell_apart(asset: Asset, names: Sequence[str], counts: Sequence[int]) -> None:
    """Say which parts the tets do not hold together with the first."""
    assert asset.tets is not None and asset.embedding is not None
    tets = asset.tets.tets
    count = len(asset.tets.vertices)
    rows, columns = tets[:, [0, 0, 0]].ravel(), tets[:, 1:].ravel()
    graph = sparse.coo_matrix((np.ones(len(rows), bool), (rows, columns)), shape=(count, count))
    label = csgraph.connected_components(graph, directed=False)[1][tets[asset.embedding.tet_ids][:, 0]]
    ends = np.cumsum(counts)
    held = [set(label[end - n : end].tolist()) for end, n in zip(ends, counts, strict=True)]
    reached = set(held[0])
    while any(reached & other and not other <= reached for other in held):
        reached.update(*(other for other in held if reached & other))
    apart = [name for name, other in zip(names, held, strict=True) if not reached & other]
    if apart:
        log.warning(
            "%s: %s not touch the rest and will come off in a simulation, through the rest unless the solver "
            "has `self_contact`; move parts into each other to glue them", asset.name,
            f"part {apart[0]!r} does" if len(apart) == 1 else f"parts {apart} do",
        )  # fmt: skip


def licenses(provenance: Mapping[str, Any]) -> list[str]:
    """Of what an asset with this provenance is made of."""
    if "license" in provenance:
        return [str(provenance["license"])]
    if "composed_of" in provenance:
        return [str(one) for one in provenance["licenses"]]
    made = [provenance.get(key) for key in ("guidance", "prior")]
    own = all(isinstance(item, dict) and item.get("kind") == "procedural" for item in made)
    return [NOBODY if own else UNSTATED]


def _provenance(items: Sequence[ComposedPart], names: Sequence[str]) -> dict[str, Any]:
    listed = [
        {
            "name": label,
            "sha256": item.asset.digest,
            "license": ", ".join(licenses(item.asset.provenance)),
            "position": list(item.position),
            "rotation": list(item.rotation),
            "scale": _factor(item, label),
            "anchor": item.anchor,
            "provenance": item.asset.provenance,
        }
        for item, label in zip(items, names, strict=True)
    ]
    return {
        "composed_of": listed,
        "licenses": sorted({one for item in items for one in licenses(item.asset.provenance)}),
        "versions": versions(),
    }


__all__ = ["Anchor", "ComposedPart", "anchor_point", "compose", "licenses"]
