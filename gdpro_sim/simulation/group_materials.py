"""What the inside of a body is made of, where its asset has vertex groups of other materials."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.asset import Asset
from gdpro_sim.materials import Material
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.repair import edge_keys, face_components
from gdpro_sim.simulation.placement import material_of
from gdpro_sim.simulation.scene_body import SceneBody

MOST_SHELLS = 64
"""Of more shells in one mesh the nearest vertex of all decides."""


def materials_at(
    body: SceneBody, asset: Asset, points: np.ndarray
) -> tuple[tuple[Material, ...], np.ndarray]:
    """Materials of a body, its main one first, and the number of each of `points` [n, 3] m among them, [n].

    points: in the frame of `asset`. Each is made of what the nearest vertex of the shell around it is; of
    shells in each other, and of groups that hold a vertex, the last counts. A material that the scene gives
    the body is that of all of it.
    """
    main = material_of(body, asset)
    if body.material is not None or not asset.group_materials:
        return (main,), np.zeros(len(points), np.int32)
    vertices = asset.gaussians.vertices.cpu().numpy()
    matter = np.zeros(len(vertices), np.int32)
    for number, name in enumerate(asset.group_materials, start=1):
        matter[asset.groups[name]] = number
    found = matter[cKDTree(vertices).query(points)[1]]
    for faces in _closed_shells(asset.gaussians.faces.cpu().numpy()):
        inside = SurfaceIndex(vertices, faces, winding=True).inside(points)
        shell = np.unique(faces)
        found[inside] = matter[shell[cKDTree(vertices[shell]).query(points[inside])[1]]]
    return (main, *asset.group_materials.values()), found


def _closed_shells(faces: np.ndarray) -> list[np.ndarray]:
    """Faces of each closed piece of a mesh, where there are several, in order."""
    labels = face_components(faces)
    count = int(labels.max()) + 1
    if not 1 < count <= MOST_SHELLS:
        return []
    shells = (faces[labels == k] for k in range(count))
    return [shell for shell in shells if (np.unique(edge_keys(shell)[0], return_counts=True)[1] == 2).all()]


__all__ = ["materials_at"]
