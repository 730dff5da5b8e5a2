"""Gaussians and surfels as tensors: shapes, conversions, rotation matrices."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gdpro_sim.gaussians import Gaussians, Surfels, rgb_to_sh, rotation_matrices, sh_to_rgb


def surfels(count: int = 5) -> Surfels:
    g = torch.Generator().manual_seed(0)
    return Surfels(
        torch.randn(count, 3, generator=g),
        torch.randn(count, 4, generator=g),
        torch.rand(count, 2, generator=g) + 0.1,
        torch.rand(count, generator=g),
        torch.randn(count, 4, 3, generator=g),
    )


def test_rotation_matrices_are_scipys() -> None:
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(1)) * 3.0
    wanted = Rotation.from_quat(quats.double().numpy(), scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotation_matrices(quats).numpy(), wanted, atol=1e-6)


def test_surfels_become_thin_gaussians_that_face_the_same_way() -> None:
    discs = surfels()
    solid = discs.gaussians(0.05)
    assert isinstance(solid, Gaussians)
    assert solid.sh_degree == discs.sh_degree == 1
    torch.testing.assert_close(solid.scales[:, 2], 0.05 * discs.scales.min(1).values)
    thin = rotation_matrices(solid.quats)[torch.arange(5), :, solid.scales.argmin(1)]
    torch.testing.assert_close(thin, discs.normals)
    for name in ("means", "quats", "opacities", "sh"):
        assert torch.equal(getattr(solid, name), getattr(discs, name))
    assert len(discs.to("cpu")) == len(solid) == 5


@pytest.mark.parametrize(
    ("kind", "part", "shape", "wanted"),
    [
        (Surfels, "scales", (5, 3), r"Surfels.scales must have shape \(5, 2\), got \(5, 3\)"),
        (Gaussians, "scales", (5, 2), r"Gaussians.scales must have shape \(5, 3\), got \(5, 2\)"),
        (Surfels, "opacities", (5, 1), r"Surfels.opacities must have shape \(5,\)"),
        (Surfels, "sh", (5, 2, 3), r"Surfels.sh must have shape \(5, 1\|4\|9\|16, 3\)"),
        (Gaussians, "sh", (5, 3), r"Gaussians.sh must have shape"),
    ],
)
def test_parts_that_do_not_fit_are_named(kind: type, part: str, shape: tuple[int, ...], wanted: str) -> None:
    axes = 2 if kind is Surfels else 3
    parts = {
        "means": torch.zeros(5, 3),
        "quats": torch.zeros(5, 4),
        "scales": torch.zeros(5, axes),
        "opacities": torch.zeros(5),
        "sh": torch.zeros(5, 1, 3),
    }
    kind(**parts)
    with pytest.raises(ValueError, match=wanted):
        kind(**{**parts, part: torch.zeros(shape)})


def test_colours_survive_the_harmonics() -> None:
    rgb = torch.rand(7, 3, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(sh_to_rgb(rgb_to_sh(rgb)), rgb)
