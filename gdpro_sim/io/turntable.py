"""Turntables: something at rest, seen from all sides in the preview's studio."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch

from gdpro_sim.asset.from_mesh import bind_mesh
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.images import write_contact_sheet
from gdpro_sim.io.preview import Renderer, Studio, frame_camera
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.splatting.normals import shortest_axes

VIEW = {"azimuth": 35.0, "elevation": 18.0, "fov": 28.0}
"""Degrees, of a turntable's first picture."""

MESH_BUDGET = 20_000
"""Gaussians a plain mesh is shown with."""


def turntable_cameras(low: np.ndarray, high: np.ndarray, views: int, view: dict[str, Any]) -> Cameras:
    """`views` cameras in a circle that see the box `low`..`high` (m); `view` as for `frame_camera`."""
    turns = [
        frame_camera(low, high, **{**view, "azimuth": view["azimuth"] + 360.0 * i / views})
        for i in range(views)
    ]
    return Cameras(
        torch.cat([t.viewmats for t in turns]),
        torch.cat([t.Ks for t in turns]),
        turns[0].width,
        turns[0].height,
    )


def studio_around(
    low: np.ndarray, high: np.ndarray, ground: float | None, shading: str, background: str
) -> Studio:
    """The studio for a subject in the box `low`..`high` (m)."""
    x, y, z = (0.5 * (low + high)).tolist()
    return Studio(shading, background, ground, float((high - low).max()), (x, y, z))


def turntable(shown: SurfaceMesh | Gaussians | BoundGaussians, views: int, size: int) -> list[np.ndarray]:
    """`views` lit pictures from all around, each uint8 [size, size, 3].

    A mesh is shown through Gaussians bound to it; loose Gaussians are lit by their shortest axes.
    """
    if isinstance(shown, SurfaceMesh):
        shown = bind_mesh(shown, budget=max(MESH_BUDGET, 2 * len(shown.faces)))
    normals = None
    if isinstance(shown, BoundGaussians):
        gaussians, normals = shown.gaussians(), shown.normals()
        low, high = shown.vertices.amin(0).cpu().numpy(), shown.vertices.amax(0).cpu().numpy()
    else:
        gaussians = shown
        solid = gaussians.means[gaussians.opacities >= 0.3 * gaussians.opacities.max()]
        ends = torch.tensor([0.01, 0.99], device=solid.device)
        low, high = torch.quantile(solid[:100_000], ends, dim=0).cpu().numpy()
    cameras = turntable_cameras(low, high, views, {**VIEW, "width": size, "height": size})
    renderer = Renderer(cameras, studio_around(low, high, float(low[2]), "studio", "studio"))
    pictures = []
    for index in range(views):
        facing = normals
        if facing is None:
            view = cameras.viewmats[index : index + 1].to(gaussians.means)
            facing = shortest_axes(gaussians.means, gaussians.quats, gaussians.scales, view)[0]
        pictures.append(renderer.render(gaussians, facing, index))
    return pictures


def write_turntable(
    path: str | Path, shown: SurfaceMesh | Gaussians | BoundGaussians, views: int, size: int
) -> None:
    """One picture with all of `turntable`, three abreast. Raises OutputError."""
    pictures = turntable(shown, views, size)
    columns = min(views, 3)
    write_contact_sheet(path, pictures, [""] * views, columns=columns, width=columns * (size + 4))


__all__ = ["studio_around", "turntable", "turntable_cameras", "write_turntable"]
