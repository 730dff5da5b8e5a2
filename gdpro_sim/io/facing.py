"""Which way the Gaussians of bodies face in a picture."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras


class Facing:
    """Normals of bodies seen by a camera.

    Where no two triangles share a vertex the surface has come apart, or never was one: its pieces have no
    inside, and are lit on the side that is seen.
    """

    def __init__(self, bodies: Sequence[BoundGaussians]) -> None:
        self._bodies = [(bound, bound.is_loose) for bound in bodies]

    @property
    def turns(self) -> bool:
        """Whether normals depend on the camera."""
        return any(loose for _, loose in self._bodies)

    def normals(self, vertices: Sequence[np.ndarray], camera: Cameras) -> torch.Tensor:
        """[N, 3] unit, of the Gaussians of all bodies, carried by their `vertices` [V, 3] m, seen by one."""
        found = []
        for (bound, loose), moved in zip(self._bodies, vertices, strict=True):
            normals = bound.normals(torch.from_numpy(moved))
            if loose:
                corners = torch.from_numpy(moved).to(normals)[bound.faces.long()[bound.face_ids.long()]]
                towards = camera.positions[0].to(normals) - corners.mean(dim=1)
                away = (normals * towards).sum(dim=1, keepdim=True) < 0.0
                normals = torch.where(away, -normals, normals)
            found.append(normals)
        return torch.cat(found)


__all__ = ["Facing"]
