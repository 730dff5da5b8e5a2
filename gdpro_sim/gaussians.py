"""3D Gaussians and surfels as plain tensors, and the spherical-harmonics colour convention."""

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
        _check_shapes(self, 3)

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


@dataclass(frozen=True)
class Surfels:
    """N flat Gaussians on discs (2D Gaussians); all tensors float32 on one device.

    means:     [N, 3] metres
    quats:     [N, 4] wxyz, need not be normalised; the third rotated axis is the normal
    scales:    [N, 2] metres, linear standard deviations along the first two rotated axes
    opacities: [N]    in [0, 1]
    sh:        [N, K, 3] spherical-harmonics coefficients, K = (degree + 1)**2; colour = SH(direction) + 0.5
    """

    means: torch.Tensor
    quats: torch.Tensor
    scales: torch.Tensor
    opacities: torch.Tensor
    sh: torch.Tensor

    def __post_init__(self) -> None:
        _check_shapes(self, 2)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    @property
    def sh_degree(self) -> int:
        return int(round(self.sh.shape[1] ** 0.5)) - 1

    @property
    def normals(self) -> torch.Tensor:
        """Unit normals [N, 3]."""
        return rotation_matrices(self.quats)[:, :, 2]

    def to(self, device: str | torch.device) -> Surfels:
        """The same surfels with every tensor on `device`."""
        return Surfels(*(getattr(self, f.name).to(device) for f in fields(self)))

    def gaussians(self, flatness: float = 0.01) -> Gaussians:
        """The same discs as 3D Gaussians, `flatness` times their shorter axis thick."""
        thin = flatness * self.scales.amin(dim=1, keepdim=True)
        scales = torch.cat([self.scales, thin], dim=1)
        return Gaussians(self.means, self.quats, scales, self.opacities, self.sh)


def _check_shapes(value: Gaussians | Surfels, axes: int) -> None:
    """Raise ValueError unless the tensors fit together; scales are [N, `axes`]."""
    name, n = type(value).__name__, value.means.shape[0]
    wanted = {"means": (n, 3), "quats": (n, 4), "scales": (n, axes), "opacities": (n,)}
    for part, shape in wanted.items():
        got = tuple(getattr(value, part).shape)
        if got != shape:
            raise ValueError(f"{name}.{part} must have shape {shape}, got {got}")
    sh = tuple(value.sh.shape)
    if len(sh) != 3 or sh[0] != n or sh[1] not in (1, 4, 9, 16) or sh[2] != 3:
        raise ValueError(f"{name}.sh must have shape ({n}, 1|4|9|16, 3), got {sh}")


def rotation_matrices(quats: torch.Tensor) -> torch.Tensor:
    """Rotation matrices [N, 3, 3], whose columns are the rotated axes, of quaternions [N, 4] wxyz."""
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def rgb_to_sh(rgb: torch.Tensor) -> torch.Tensor:
    """DC coefficient of an RGB colour in [0, 1], any leading shape."""
    return (rgb - 0.5) / SH_C0


def sh_to_rgb(dc: torch.Tensor) -> torch.Tensor:
    """RGB colour of a DC coefficient, not clamped."""
    return dc * SH_C0 + 0.5


__all__ = ["SH_C0", "Gaussians", "Surfels", "rgb_to_sh", "rotation_matrices", "sh_to_rgb"]
