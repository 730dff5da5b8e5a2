"""3D Gaussians as plain tensors, and the spherical-harmonics colour convention."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch

SH_C0 = 0.28209479177387814
"""Zeroth real spherical harmonic, 1 / (2 sqrt(pi))."""


@dataclass(frozen=True)
class Gaussians:
    """N anisotropic 3D Gaussians; all tensors float32 on one device.

    means:     [N, 3] metres
    quats:     [N, 4] wxyz, need not be normalised
    scales:    [N, 3] metres, linear standard deviations along the rotated axes
    opacities: [N]    in [0, 1]
    sh:        [N, K, 3] spherical-harmonics coefficients, K = (degree + 1)**2; colour = SH(direction) + 0.5
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self) -> None:
        n = self.means.shape[0]
        wanted = {"means": (n, 3), "quats": (n, 4), "scales": (n, 3), "opacities": (n,)}
        for name, shape in wanted.items():
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise ValueError(f"Gaussians.{name} must have shape {shape}, got {got}")
        if (
            self.sh.ndim != 3
            or self.sh.shape[0] != n
            or self.sh.shape[1] not in (1, 4, 9, 16)
            or self.sh.shape[2] != 3
        ):
            raise ValueError(f"Gaussians.sh must have shape ({n}, 1|4|9|16, 3), got {tuple(self.sh.shape)}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        return int(round(self.sh.shape[1] ** 0.5)) - 1

    def to(self, device: str | torch.device) -> Gaussians:
        """The same Gaussians with every tensor on `device`."""
        return Gaussians(*(getattr(self, f.name).to(device) for f in fields(self)))

    @staticmethod
    def concatenate(parts: list[Gaussians]) -> Gaussians:
        """Join several sets into one; lower SH degrees are padded with zeros."""
        k = max(p.sh.shape[1] for p in parts)
        sh = [torch.nn.functional.pad(p.sh, (0, 0, 0, k - p.sh.shape[1])) for p in parts]
        return Gaussians(
            torch.cat([p.means for p in parts]),
            torch.cat([p.quats for p in parts]),
            torch.cat([p.scales for p in parts]),
            torch.cat([p.opacities for p in parts]),
            torch.cat(sh),
        )


def rgb_to_sh(rgb: torch.Tensor) -> torch.Tensor:
    """DC coefficient of an RGB colour in [0, 1], any leading shape."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(dc: torch.Tensor) -> torch.Tensor:
    """RGB colour of a DC coefficient, not clamped."""
    return dc * SH_C0 + 0.5


__all__ = ["SH_C0", "Gaussians", "rgb_to_sh", "sh_to_rgb"]
