"""Named vertex groups of an imported mesh: its materials, its named parts, and those painted as images."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gdpro_sim.asset.prims import to_numpy
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.surface import SurfaceMesh

MOST = 64
"""More materials or parts than this are no groups that anybody would name."""


def named_groups(mesh: SurfaceMesh, bound: BoundGaussians) -> dict[str, np.ndarray]:
    """Vertices of `bound` by the names of the mesh's parts, and of its materials where it has several.

    Ascending int32 ids. Vertices on a border belong to both sides. Materials of one name are one group, which
    stands for a part of that name, too.
    """
    names = dict.fromkeys(material.name for material in mesh.materials)
    owners = np.array([material.name for material in mesh.materials])[mesh.material_ids]
    chosen = dict(mesh.groups) if len(mesh.groups) <= MOST else {}
    if 1 < len(names) <= MOST:
        chosen |= {name: owners == name for name in names if name}
    if not chosen:
        return {}
    faces = to_numpy(bound.faces)
    nearest, _ = _centres(mesh, bound)
    groups = {name: np.unique(faces[own[nearest]]).astype(np.int32) for name, own in chosen.items()}
    return {name: ids for name, ids in groups.items() if len(ids)}


def mask_groups(
    path: Path, masks: Mapping[str, str | Path], bound: BoundGaussians, *, up: str, scale: float | None
) -> dict[str, np.ndarray]:
    """Vertices of `bound` on faces whose middles a mask image paints white, by name; ascending int32 ids.

    The images lie over the UV map of the mesh file `path`. up, scale: as the mesh was read. Raises MeshError
    for a mesh without UV coordinates, an image that cannot be read, and one that paints no face.
    """
    groups = {}
    for name, mask in masks.items():
        mesh = load_mesh(path, texture=mask, up=up, scale=scale)
        values = SurfaceColors(mesh).at(*_centres(mesh, bound))[:, :3].mean(axis=1)
        ids = np.unique(to_numpy(bound.faces)[values >= 0.5]).astype(np.int32)
        if not len(ids):
            raise MeshError(
                f"group {name!r}: {mask} paints no face of {path.name}: white belongs to the group, and the "
                f"brightest face is {values.max():.2g} of it"
            )
        groups[name] = ids
    return groups


def _centres(mesh: SurfaceMesh, bound: BoundGaussians) -> tuple[np.ndarray, np.ndarray]:
    """Where on `mesh` the middles of the faces of `bound` lie: face [F] and barycentric weights [F, 3]."""
    middles = to_numpy(bound.vertices)[to_numpy(bound.faces)].mean(axis=1)
    return SurfaceIndex(mesh.vertices, mesh.faces).closest(middles)


__all__ = ["mask_groups", "named_groups"]
