"""Clouds from files: the .splat layout byte by byte, bad files, and the way into the unit frame."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import AssetError, RequestError
from gdpro_sim.gaussians import Gaussians, rgb_to_sh, sh_to_rgb
from gdpro_sim.generation.renders import GaussianRenderer
from gdpro_sim.io.splat import TURNS, read_splat, rotated, splat_in_unit_frame

TURN = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])


def record(mean: tuple[float, ...], scale: tuple[float, ...], *byte: int) -> bytes:
    return struct.pack("<6f8B", *mean, *scale, *byte)


def cloud(count: int = 400, degree: int = 0, seed: int = 0) -> Gaussians:
    """Gaussians within about a metre of (1, 2, 3)."""
    g = torch.Generator().manual_seed(seed)
    sh = 0.2 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    sh[:, 0] = rgb_to_sh(torch.rand(count, 3, generator=g))
    return Gaussians(
        torch.tensor([1.0, 2.0, 3.0]) + torch.rand(count, 3, generator=g) - 0.5,
        torch.nn.functional.normalize(torch.randn(count, 4, generator=g)),
        0.02 + 0.05 * torch.rand(count, 3, generator=g),
        0.3 + 0.6 * torch.rand(count, generator=g),
        sh,
    )


def test_records_are_read_as_the_format_says(tmp_path: Path) -> None:
    path = tmp_path / "two.splat"
    path.write_bytes(
        record((1.0, -2.0, 3.0), (0.1, 0.2, 0.3), 255, 0, 51, 128, 255, 128, 128, 128)
        + record((0.0, 0.5, 0.0), (1e-3, 1e-3, 1e-3), 10, 20, 30, 0, 128, 0, 128, 128)
    )
    g = read_splat(path)
    assert g.means.tolist() == [[1.0, -2.0, 3.0], [0.0, 0.5, 0.0]]
    assert torch.allclose(g.scales[0], torch.tensor([0.1, 0.2, 0.3]))
    assert torch.allclose(sh_to_rgb(g.sh[0, 0]), torch.tensor([1.0, 0.0, 0.2]), atol=1e-6)
    assert g.opacities.tolist() == pytest.approx([128 / 255, 0.0])
    assert torch.allclose(g.quats, torch.tensor([[1.0, 0.0, 0.0, 0.0], [0.0, -1.0, 0.0, 0.0]]))
    assert g.sh_degree == 0


def test_files_that_are_no_splat_are_refused(tmp_path: Path) -> None:
    with pytest.raises(AssetError, match="no such file"):
        read_splat(tmp_path / "none.splat")
    path = tmp_path / "bad.splat"
    path.write_bytes(b"")
    with pytest.raises(AssetError, match="0 bytes"):
        read_splat(path)
    good = record((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), *[200] * 8)
    path.write_bytes(good * 3 + good[:7])
    with pytest.raises(AssetError, match=r"103 bytes.*7 bytes are left over"):
        read_splat(path)
    path.write_bytes(good + record((float("nan"), 0.0, 0.0), (0.1, 0.1, 0.1), *[200] * 8))
    with pytest.raises(AssetError, match="1 of 2 records"):
        read_splat(path)


def test_no_rotation_at_all_is_taken_as_none(tmp_path: Path) -> None:
    path = tmp_path / "one.splat"
    path.write_bytes(record((0.0, 0.0, 0.0), (0.1, 0.1, 0.1), *[255] * 4, *[128] * 4))
    assert read_splat(path).quats.tolist() == [[1.0, 0.0, 0.0, 0.0]]


@pytest.mark.parametrize("up", TURNS)
def test_the_named_axis_points_up(up: str) -> None:
    axis = np.eye(3)["xyz".index(up[-1])] * (-1.0 if up.startswith("-") else 1.0)
    turn = np.asarray(TURNS[up])
    assert np.allclose(turn @ axis, [0.0, 0.0, 1.0])
    assert np.linalg.det(turn) == pytest.approx(1.0)


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_a_turned_cloud_looks_the_same_to_a_turned_camera(degree: int) -> None:
    g = cloud(degree=degree)
    eye, target, up = np.array([4.0, 3.0, 4.0]), np.array([1.0, 2.0, 3.0]), np.array([0.0, 0.1, 1.0])
    views = [
        Cameras.look_at([t @ eye], t @ target, vertical_fov=0.5, width=40, height=40, up=t @ up)
        for t in (np.eye(3), TURN)
    ]
    before = GaussianRenderer(g).render(views[0])
    after = GaussianRenderer(rotated(g, TURN)).render(views[1])
    assert float((before.rgb - after.rgb).abs().max()) < 2e-4
    assert float((before.depths - after.depths).abs().max()) < 1e-4
    if degree:
        stiff = Gaussians(
            *(getattr(rotated(g, TURN), n) for n in ("means", "quats", "scales", "opacities")), g.sh
        )
        assert float((before.rgb - GaussianRenderer(stiff).render(views[1]).rgb).abs().max()) > 0.05


def test_into_the_unit_frame_and_back() -> None:
    g = cloud()
    unit, frame = splat_in_unit_frame(g, up="z")
    distance = unit.means.norm(dim=1)
    assert 0.9 < float(distance.max()) <= 1.05
    back = torch.from_numpy(frame.to_metres(unit.means.numpy()))
    nearest = torch.cdist(back.double(), g.means.double()).amin(1)
    assert float(nearest.max()) < 1e-5
    assert torch.allclose(unit.scales.mean() * frame.radius, g.scales.mean(), rtol=0.02)
    assert frame.centre == pytest.approx((1.0, 2.0, 3.0), abs=0.05)


def test_auto_is_minus_y_up() -> None:
    g = cloud()
    unit, frame = splat_in_unit_frame(g)
    again, _ = splat_in_unit_frame(g, up="-y")
    assert torch.equal(unit.means, again.means)
    assert frame.centre == pytest.approx((1.0, 3.0, -2.0), abs=0.05)
    with pytest.raises(RequestError, match="up must be"):
        splat_in_unit_frame(g, up="up")


def test_strays_faint_and_broken_ones_are_left_out() -> None:
    g = cloud()
    g.means[0] = torch.tensor([200.0, 0.0, 0.0])
    g.opacities[1] = 0.001
    g.means[2, 1] = float("nan")
    g.quats[3] = 0.0
    unit, frame = splat_in_unit_frame(g, up="z")
    assert len(unit) <= 396
    assert len(unit) > 385
    assert frame.radius < 1.1
    assert float(unit.means.norm(dim=1).max()) <= 1.06
    assert bool(unit.means.isfinite().all())


def test_nothing_to_see_is_refused() -> None:
    g = cloud(10)
    with pytest.raises(AssetError, match="0 Gaussians that can be seen"):
        splat_in_unit_frame(Gaussians(g.means, g.quats, g.scales, 0.0 * g.opacities, g.sh))
    with pytest.raises(AssetError, match="same place"):
        splat_in_unit_frame(Gaussians(0.0 * g.means, g.quats, g.scales, g.opacities, g.sh))
