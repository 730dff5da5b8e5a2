"""What the inside of a body is made of, where its asset has vertex groups of other materials."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.asset import Asset
from gdpro_sim.materials import Material
from gdpro_sim.simulation.placement import material_of
from gdpro_sim.simulation.scene_body import SceneBody


def materials_at(
    body: SceneBody, asset: Asset, points: np.ndarray
) -> tuple[tuple[Material, ...], np.ndarray]:
    """Materials of a body, its main one first, and the number of each of `points` [n, 3] m among them, [n].

    points: in the frame of `asset`. Each is made of what the nearest vertex of the asset's mesh is; of the
    groups that hold a vertex the last counts. A material that the scene gives the body is that of all of it.
    """
    main = material_of(body, asset)
    if body.material is not None or not asset.group_materials:
        return (main,), np.zeros(len(points), np.int32)
    vertices = asset.gaussians.vertices.cpu().numpy()
    matter = np.zeros(len(vertices), np.int32)
    for number, name in enumerate(asset.group_materials, start=1):
        matter[asset.groups[name]] = number
    _, nearest = cKDTree(vertices).query(points)
    return (main, *asset.group_materials.values()), matter[nearest]


__all__ = ["materials_at"]
