"""Losses and normals from depth against closed forms, second implementations and finite differences."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.ndimage import correlate1d
from torch import Tensor

from gdpro_sim.cameras import Cameras
from gdpro_sim.splatting import losses
from gdpro_sim.splatting.depth import depth_to_normals

F64 = torch.float64


def images(*shape: int, seed: int = 0) -> Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=F64)


# --- L1, PSNR ----------------------------------------------------------------


def test_l1_and_psnr_of_a_constant_difference() -> None:
    a = images(2, 5, 4, 3)
    b = a + 0.1 * torch.sign(images(2, 5, 4, 3, seed=1) - 0.5)
    assert float(losses.l1(a, b)) == pytest.approx(0.1)
    assert float(losses.psnr(a, b)) == pytest.approx(20.0)
    assert float(losses.psnr(255 * a, 255 * b, data_range=255.0)) == pytest.approx(20.0)
    assert float(losses.l1(a, a)) == 0.0
    assert math.isinf(float(losses.psnr(a, a)))


# --- SSIM --------------------------------------------------------------------


def ssim_by_scipy(a: np.ndarray, b: np.ndarray, padding: str) -> float:
    """One channel [H, W] at a time, with scipy's correlation."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()

    def blur(image: np.ndarray) -> np.ndarray:
        out = correlate1d(correlate1d(image, window, 0, mode="constant"), window, 1, mode="constant")
        return out[5:-5, 5:-5] if padding == "valid" else out

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    cov = blur(a * b) - mean_a * mean_b
    top = (2 * mean_a * mean_b + 1e-4) * (2 * cov + 9e-4)
    return float((top / ((mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4))).mean())


@pytest.mark.parametrize("padding", ["valid", "same"])
def test_ssim_is_that_of_a_second_implementation(padding: str) -> None:
    a, b = images(2, 16, 13, 3), images(2, 16, 13, 3, seed=1)
    b = 0.6 * a + 0.4 * b
    pairs = [(a[i, ..., j].numpy(), b[i, ..., j].numpy()) for i in range(2) for j in range(3)]
    expected = np.mean([ssim_by_scipy(x, y, padding) for x, y in pairs])
    assert float(losses.ssim(a, b, padding=padding)) == pytest.approx(expected, abs=1e-12)
    assert float(losses.ssim(a, a, padding=padding)) == pytest.approx(1.0)
    assert float(losses.ssim(a, b, padding=padding)) == pytest.approx(
        float(losses.ssim(255 * a, 255 * b, padding=padding, data_range=255.0))
    )


def test_ssim_of_flat_images() -> None:
    """Without variance only the luminance term is left."""
    a, b = torch.full((11, 11, 1), 0.2, dtype=F64), torch.full((11, 11, 1), 0.8, dtype=F64)
    expected = (2 * 0.2 * 0.8 + 1e-4) / (0.2**2 + 0.8**2 + 1e-4)
    assert float(losses.ssim(a, b)) == pytest.approx(expected)


def test_ssim_of_opposite_images_is_negative() -> None:
    a = images(20, 20, 3)
    assert float(losses.ssim(a, 1.0 - a)) < -0.9


def test_ssim_asks_for_a_window() -> None:
    a = images(10, 30, 1)
    with pytest.raises(ValueError, match=r'at least 11 pixels wide and high.*30 x 10.*padding="same"'):
        losses.ssim(a, a)
    assert float(losses.ssim(a, a, padding="same")) == pytest.approx(1.0)
    with pytest.raises(ValueError, match="padding must be one of valid, same"):
        losses.ssim(a, a, padding="reflect")
    with pytest.raises(ValueError, match="data_range must be > 0"):
        losses.ssim(a, a, padding="same", data_range=0.0)


# --- Total variation ---------------------------------------------------------


def test_total_variation_of_a_ramp_and_of_a_step() -> None:
    y, x = torch.meshgrid(torch.arange(6, dtype=F64), torch.arange(8, dtype=F64), indexing="ij")
    ramp = (0.1 * x - 0.2 * y)[None, ..., None]
    assert float(losses.total_variation(ramp)) == pytest.approx(0.3)
    assert float(losses.total_variation(ramp, power=2)) == pytest.approx(0.05)
    step = (x >= 4).to(F64)[..., None]
    assert float(losses.total_variation(step)) == pytest.approx(1 / 7)
    assert float(losses.total_variation(torch.full((4, 4, 3), 0.3))) == 0.0


def test_total_variation_of_a_line_and_of_a_pixel() -> None:
    line = torch.tensor([0.0, 1.0, 0.0], dtype=F64)
    assert float(losses.total_variation(line.view(1, 3, 1))) == 1.0
    assert float(losses.total_variation(line.view(3, 1, 1))) == 1.0
    assert float(losses.total_variation(line.view(1, 1, 3))) == 0.0
    with pytest.raises(ValueError, match="power must be 1 or 2"):
        losses.total_variation(line.view(1, 3, 1), power=3)


# --- Normals and distortion --------------------------------------------------


def test_normal_consistency_of_a_known_angle() -> None:
    n = torch.tensor([0.0, 0.0, -1.0], dtype=F64).expand(2, 4, 5, 3).clone()
    tilted = torch.tensor([math.sin(0.3), 0.0, -math.cos(0.3)], dtype=F64).expand(2, 4, 5, 3).clone()
    alphas = torch.ones(2, 4, 5, 1, dtype=F64)
    loss = 1.0 - math.cos(0.3)
    assert float(losses.normal_consistency(n, tilted, alphas)) == pytest.approx(loss)
    assert float(losses.normal_consistency(n, -tilted, alphas)) == pytest.approx(loss)
    # Half-covered pixels and those without a normal from depth do not count, however wrong.
    alphas[0] = 0.95
    n[0] = torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    tilted[1, 0] = 0.0
    assert float(losses.normal_consistency(n, tilted, alphas)) == pytest.approx(loss)
    none = losses.normal_consistency(n.requires_grad_(), tilted, 0.0 * alphas)
    none.backward()
    assert float(none.detach()) == 0.0 and n.grad is not None and not n.grad.any()


def test_distortion_is_the_mean() -> None:
    assert float(losses.distortion(torch.tensor([[[1.0], [2.0]], [[3.0], [6.0]]]))) == 3.0


# --- Normals from depth ------------------------------------------------------


def camera(width: int = 9, height: int = 7) -> tuple[Tensor, Tensor]:
    views = Cameras.look_at(
        [[2.0, 1.0, 0.5], [-1.0, 2.0, 1.0]], [0.0, 0.1, 0.0], vertical_fov=0.7, width=width, height=height
    )
    Ks = views.Ks.to(F64)
    Ks[:, 0, 0] *= 1.2
    Ks[:, 0, 1] = 0.8
    Ks[:, 0, 2] += 1.3
    viewmats = views.viewmats.to(F64)
    u, _, v = torch.linalg.svd(viewmats[:, :3, :3])
    viewmats[:, :3, :3] = u @ v  # orthogonal to float64
    return viewmats, Ks


def rays(Ks: Tensor, width: int, height: int) -> Tensor:
    """Viewing directions with z = 1, [C, H, W, 3], camera space."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)], -1).to(F64)
    return torch.einsum("cij,hwj->chwi", torch.linalg.inv(Ks), pixels)


def test_normals_of_a_plane() -> None:
    viewmats, Ks = camera()
    normal = torch.nn.functional.normalize(torch.tensor([0.2, 0.7, 0.5], dtype=F64), dim=0)
    rotation, shift = viewmats[:, :3, :3], viewmats[:, :3, 3]
    in_camera = rotation @ normal
    offset = 0.2 + (in_camera * shift).sum(-1)  # n . x = 0.2 in the world
    directions = rays(Ks, 9, 7)
    depth = offset[:, None, None] / torch.einsum("chwi,ci->chw", directions, in_camera)
    assert bool((depth > 0).all())
    out = depth_to_normals(depth[..., None], viewmats, Ks)
    towards = torch.sign(-torch.einsum("chwi,ci->chw", directions, in_camera))[..., None]
    assert torch.allclose(out[:, 1:-1, 1:-1], (towards * normal)[:, 1:-1, 1:-1], atol=1e-12)
    border = torch.ones(7, 9, dtype=torch.bool)
    border[1:-1, 1:-1] = False
    assert not out[:, border].any()


def test_normals_are_crossed_central_differences_facing_the_camera() -> None:
    viewmats, Ks = camera()
    depth = 1.0 + images(2, 7, 9, 1)
    points = depth * rays(Ks, 9, 7)
    world = torch.einsum("cij,chwi->chwj", viewmats[:, :3, :3], points - viewmats[:, None, None, :3, 3])
    down = world[:, 2:, 1:-1] - world[:, :-2, 1:-1]
    right = world[:, 1:-1, 2:] - world[:, 1:-1, :-2]
    expected = torch.nn.functional.normalize(torch.cross(down, right, dim=-1), dim=-1)
    out = depth_to_normals(depth, viewmats, Ks)[:, 1:-1, 1:-1]
    assert torch.allclose(out, expected, atol=1e-12)
    eyes = -torch.einsum("cij,ci->cj", viewmats[:, :3, :3], viewmats[:, :3, 3])
    assert bool(((eyes[:, None, None] - world[:, 1:-1, 1:-1]) * out).sum(-1).gt(0).all())


def test_normals_do_not_depend_on_the_unit_of_length() -> None:
    viewmats, Ks = camera()
    depth = (1.0 + images(2, 7, 9, 1)).float()
    out = depth_to_normals(depth, viewmats.float(), Ks.float())
    assert torch.allclose(depth_to_normals(1e-12 * depth, viewmats.float(), Ks.float()), out, atol=1e-5)
    assert torch.allclose(depth_to_normals(1e12 * depth, viewmats.float(), Ks.float()), out, atol=1e-5)


def test_without_depth_there_is_no_normal() -> None:
    viewmats, Ks = camera()
    depth = torch.zeros(2, 7, 9, 1, dtype=F64)
    depth[:, :, 5:] = 2.0
    depth.requires_grad_()
    out = depth_to_normals(depth, viewmats, Ks)
    assert not out[:, :, :5].any()
    assert torch.allclose(out[:, 1:-1, 5:-1].norm(dim=-1), torch.ones(1, dtype=F64))
    (out * images(2, 7, 9, 3)).sum().backward()
    assert depth.grad is not None and bool(depth.grad.isfinite().all())


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 9), (7, 2)])
def test_small_images_have_no_normals(height: int, width: int) -> None:
    viewmats, Ks = camera()
    out = depth_to_normals(images(2, height, width, 1), viewmats, Ks)
    assert out.shape == (2, height, width, 3) and not out.any()


# --- Gradients ---------------------------------------------------------------

GRADIENTS: dict[str, tuple[Callable[..., Tensor], tuple[Tensor, ...]]] = {
    "l1": (losses.l1, (images(2, 4, 3, 2), images(2, 4, 3, 2, seed=1))),
    "psnr": (losses.psnr, (images(2, 4, 3, 2), images(2, 4, 3, 2, seed=1))),
    "ssim valid": (losses.ssim, (images(11, 12, 1), images(11, 12, 1, seed=1))),
    "ssim same": (
        lambda a, b: losses.ssim(a, b, padding="same"),
        (images(4, 5, 2), images(4, 5, 2, seed=1)),
    ),
    "total variation": (losses.total_variation, (images(2, 4, 5, 2),)),
    "total variation squared": (lambda a: losses.total_variation(a, power=2), (images(2, 4, 5, 2),)),
    "normal consistency": (
        lambda n, m: losses.normal_consistency(n, m, 0.9 + 0.1 * images(2, 4, 5, 1)),
        (images(2, 4, 5, 3) - 0.5, images(2, 4, 5, 3, seed=1) - 0.5),
    ),
    "distortion": (losses.distortion, (images(2, 4, 5, 1),)),
    "normals from depth": (depth_to_normals, (1.0 + images(2, 5, 6, 1), *camera(6, 5))),
}


@pytest.mark.parametrize("name", GRADIENTS)
def test_gradients(name: str) -> None:
    function, arguments = GRADIENTS[name]
    assert torch.autograd.gradcheck(function, tuple(a.clone().requires_grad_() for a in arguments))


# --- Bad input ---------------------------------------------------------------

PAIRS: list[Callable[[object, object], Tensor]] = [losses.l1, losses.psnr, losses.ssim]  # type: ignore[list-item]


@pytest.mark.parametrize("loss", PAIRS)
def test_pairs_must_match(loss: Callable[[object, object], Tensor]) -> None:
    a = images(12, 12, 3)
    with pytest.raises(ValueError, match=r"targets must have the shape of images, \[12, 12, 3\], got"):
        loss(a, a[:11])
    with pytest.raises(
        ValueError, match=r"targets must be torch.float64 on cpu as images is, got torch.float32"
    ):
        loss(a, a.float())
    with pytest.raises(ValueError, match=r"images must have shape \[..., H, W, D\]"):
        loss(a[0], a[0])
    with pytest.raises(ValueError, match="no axis of an image empty"):
        loss(a[:0], a[:0])
    with pytest.raises(ValueError, match="images must hold floating-point values"):
        loss(a.byte(), a.byte())
    with pytest.raises(ValueError, match="images must be a torch tensor"):
        loss(a.numpy(), a)
    with pytest.raises(ValueError, match="targets must be a torch tensor"):
        loss(a, a.numpy())


def test_normals_must_match() -> None:
    n, alphas = images(2, 4, 5, 3), images(2, 4, 5, 1)
    with pytest.raises(ValueError, match=r"normals must have shape \[..., H, W, 3\]"):
        losses.normal_consistency(n[..., :2], n, alphas)
    with pytest.raises(ValueError, match="depth_normals must have the shape of normals"):
        losses.normal_consistency(n, n[0], alphas)
    with pytest.raises(ValueError, match=r"alphas must have shape \[..., H, W, 1\]"):
        losses.normal_consistency(n, n, n)
    with pytest.raises(ValueError, match="alphas must have the shape of"):
        losses.normal_consistency(n, n, alphas[:1])
    with pytest.raises(ValueError, match=r"distort must have shape \[..., H, W, 1\]"):
        losses.distortion(n)
    with pytest.raises(ValueError, match="images must have shape"):
        losses.total_variation(n[0, 0])


def test_cameras_must_match_the_depth() -> None:
    viewmats, Ks = camera()
    depth = images(2, 7, 9, 1)
    with pytest.raises(ValueError, match=r"depth must have shape \[C, H, W, 1\]"):
        depth_to_normals(depth[0], viewmats, Ks)
    with pytest.raises(ValueError, match=r"viewmats must have shape \[2, 4, 4\], one for each depth image"):
        depth_to_normals(depth, viewmats[:1], Ks)
    with pytest.raises(ValueError, match=r"Ks must have shape \[2, 3, 3\]"):
        depth_to_normals(depth, viewmats, viewmats)
    with pytest.raises(ValueError, match=r"Ks must be .* on cpu as depth is, got"):
        depth_to_normals(depth, viewmats, Ks.float())
