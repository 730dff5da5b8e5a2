"""A small cube as an asset, for scenes in tests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import trimesh

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset

SIDE = 0.1
"""Of the cube, m; its middle is the asset's origin."""


def write_cube(path: Path) -> Path:
    """A cube's mesh of 8 x 6 x 2 triangles, in the file `path`."""
    mesh = trimesh.creation.box((SIDE, SIDE, SIDE)).subdivide()
    mesh.export(path)
    return path


def cube_asset(folder: Path, target_tets: int = 40) -> Asset:
    """The cube with tets; vertices of its upper face are red and in the group "lid"."""
    asset = import_mesh(write_cube(folder / "cube.ply"), budget=300, tets=False)
    asset = tetrahedralize_asset(asset, target_tets=target_tets, method="lattice")
    top = asset.gaussians.vertices.numpy()[:, 2] > 0.499 * SIDE
    colors = np.where(top[:, None], np.float32([1, 0, 0]), np.float32([0.5, 0.5, 0.5])).astype(np.float32)
    return replace(asset, vertex_colors=colors, groups={"lid": np.flatnonzero(top).astype(np.int32)})
