"""Gaussians bound to a triangle mesh: the asset's shape, and how it follows deformed vertices.

Binding after GaussianDreamerPro (arXiv 2406.18462): a Gaussian sits at frozen barycentric weights of one
triangle; its rotation is the triangle's frame turned in its plane by a learned complex number. The moved
triangle's affine map F carries the covariance (F S F^T) and the rotation part of F turns the spherical
harmonics.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from gdpro_sim.errors import AssetError
from gdpro_sim.gaussians import Gaussians


@dataclass(frozen=True)
class BoundGaussians:
    """N Gaussians on a triangle mesh; every tensor lives on one device.

    vertices:       [V, 3] float32 m, rest positions
    faces:          [F, 3] int32, counter-clockwise seen from outside
    face_ids:       [N] int32, the triangle each Gaussian rides
    barycentrics:   [N, 3] float32, frozen weights, rows sum to 1
    rotations:      [N, 2] float32, complex number (x, y); R = [e0, x e1 + y e2, -y e1 + x e2] after
                    normalisation, e0 the unit normal, e1 along v1 - v0, e2 = e0 x e1
    log_scales:     [N, 3] float32, log standard deviations in m: along the normal, then the two in-plane axes
    opacity_logits: [N] float32
    sh:             [N, K, 3] float32, K in {1, 4, 9, 16}
    """

    vertices: torch.Tensor
    faces: torch.Tensor
    face_ids: torch.Tensor
    barycentrics: torch.Tensor
    rotations: torch.Tensor
    log_scales: torch.Tensor
    opacity_logits: torch.Tensor
    sh: torch.Tensor

    def __len__(self) -> int:
        return int(self.face_ids.shape[0])
