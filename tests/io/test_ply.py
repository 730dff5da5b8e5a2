"""Gaussians to PLY and back."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from gdpro_sim.errors import AssetError, RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.ply import read_ply, write_ply
from tests.conditions import posix_only


def sample(degree: int, count: int = 40) -> Gaussians:
    rng = torch.Generator().manual_seed(degree)
    return Gaussians(
        torch.randn(count, 3, generator=rng),
        torch.randn(count, 4, generator=rng),
        torch.rand(count, 3, generator=rng) * 0.1 + 1e-6,
        torch.rand(count, generator=rng),
        torch.randn(count, (degree + 1) ** 2, 3, generator=rng),
    )


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_gaussians_come_back(tmp_path: Path, degree: int) -> None:
    g = sample(degree)
    write_ply(tmp_path / "g.ply", g)
    again = read_ply(tmp_path / "g.ply")
    for name in ("means", "quats", "sh"):
        assert torch.equal(getattr(g, name), getattr(again, name)), name
    torch.testing.assert_close(again.scales, g.scales, rtol=2e-6, atol=0)
    torch.testing.assert_close(again.opacities, g.opacities, rtol=0, atol=1e-6)
    assert os.listdir(tmp_path) == ["g.ply"]


def test_the_layout_is_the_one_viewers_know(tmp_path: Path) -> None:
    g = sample(1, 3)
    write_ply(tmp_path / "g.ply", g)
    header, body = (tmp_path / "g.ply").read_bytes().split(b"end_header\n", 1)
    names = [line.split()[-1] for line in header.decode().splitlines() if line.startswith("property")]
    wanted = [
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
        *(f"f_rest_{i}" for i in range(9)),
    ]
    wanted += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    assert names == wanted
    rows = np.frombuffer(body, "<f4").reshape(3, -1)
    # f_rest is channel-major: all red coefficients, then green, then blue.
    np.testing.assert_array_equal(rows[1, 9:18], g.sh[1, 1:].T.reshape(-1).numpy())
    np.testing.assert_allclose(rows[:, names.index("scale_0")], np.log(g.scales[:, 0].numpy()), rtol=1e-6)


def test_extreme_opacities_and_scales_stay_finite(tmp_path: Path) -> None:
    g = sample(0, 3)
    g.opacities[:] = torch.tensor([0.0, 1.0, 0.5])
    g.scales[0] = 0.0
    write_ply(tmp_path / "g.ply", g)
    again = read_ply(tmp_path / "g.ply")
    torch.testing.assert_close(again.opacities, g.opacities, rtol=0, atol=2e-7)
    assert bool(torch.isfinite(again.scales).all())


def test_files_that_hold_no_gaussians_say_so(tmp_path: Path) -> None:
    write_ply(tmp_path / "good.ply", sample(1))
    data = (tmp_path / "good.ply").read_bytes()
    cases = {
        "short.ply": (data[:-8], "truncated"),
        "noise.ply": (b"hello", "not a PLY file"),
        "text.ply": (b"ply\nformat ascii 1.0\nelement vertex 0\nend_header\n", "text PLY"),
        "mesh.ply": (
            b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
            b"property float z\nend_header\n" + bytes(12),
            "f_dc_0 is missing",
        ),
        "odd.ply": (data.replace(b"f_rest_8", b"f_other8"), "8 f_rest_"),
    }
    for name, (content, message) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(AssetError, match=message):
            read_ply(tmp_path / name)
    with pytest.raises(AssetError, match="no such file"):
        read_ply(tmp_path / "absent.ply")


@posix_only
def test_device_nodes_are_not_replaced(tmp_path: Path) -> None:
    """Renaming over /dev/null, as root, would destroy it; a named pipe stands in for it here."""
    os.mkfifo(tmp_path / "pipe.ply")
    with pytest.raises(RequestError, match="not a regular file"):
        write_ply(tmp_path / "pipe.ply", sample(0, 1))
    assert os.listdir(tmp_path) == ["pipe.ply"]
