"""What fitting Gaussians to images is scored by; every function is differentiable and returns one number.

Images are [..., H, W, D] (any leading axes, D channels) of float32 or float64, the layout of `rasterization`.
"""

from __future__ import annotations

import torch

from gdpro_sim.splatting.checks import check_choice
from gdpro_sim.splatting.images import check_alike, check_images

SSIM_WINDOW, SSIM_SIGMA = 11, 1.5
"""Width and standard deviation of SSIM's Gaussian window in pixels."""


def l1(images: torch.Tensor, targets: torch.Tensor) -> torch.Tensor:
    """Mean absolute difference of two stacks of images [..., H, W, D].

    Raises ValueError where shapes, dtypes or devices differ.
    """
    check_images("images", images)
    check_alike(("images", "targets"), images, targets)
    return (images - targets).abs().mean()


def psnr(images: torch.Tensor, targets: torch.Tensor, *, data_range: float = 1.0) -> torch.Tensor:
    """Peak signal-to-noise ratio 10 log10(data_range^2 / mean squared difference) in dB; infinity if equal.

    One mean over all of [..., H, W, D]: take it image by image where the mean of PSNRs is wanted.
    Raises ValueError where shapes, dtypes or devices differ.
    """
    check_images("images", images)
    check_alike(("images", "targets"), images, targets)
    return 10.0 * torch.log10(_positive(data_range) ** 2 / (images - targets).square().mean())


def ssim(
    images: torch.Tensor, targets: torch.Tensor, *, data_range: float = 1.0, padding: str = "valid"
) -> torch.Tensor:
    """Mean structural similarity of two stacks of images [..., H, W, D], in [-1, 1]; the loss is 1 minus it.

    Each channel on its own, 11 x 11 Gaussian window of sigma 1.5 px, K1 = 0.01, K2 = 0.03.
    padding "valid": only windows wholly inside the image count, so H, W >= 11 (the paper, scikit-image);
    "same": one window for each pixel, zeros outside the image (the code of 3D Gaussian Splatting).
    Raises ValueError where shapes, dtypes or devices differ, or images are smaller than a window.

    Source: Wang et al., "Image Quality Assessment: From Error Visibility to Structural Similarity" (2004),
    eq. 13, population (co)variances.
    """
    check_images("images", images)
    check_alike(("images", "targets"), images, targets)
    same = check_choice("padding", padding, ("valid", "same")) == "same"
    height, width = images.shape[-3:-1]
    if not same and min(height, width) < SSIM_WINDOW:
        raise ValueError(
            f"images must be at least {SSIM_WINDOW} pixels wide and high for SSIM, got {width} x {height}; "
            'use padding="same"'
        )
    c1, c2 = (0.01 * _positive(data_range)) ** 2, (0.03 * data_range) ** 2
    x, y = (i.movedim(-1, -3).reshape(-1, height, width) for i in (images, targets))
    mean_x, mean_y, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y]), same).chunk(5)
    mean_xx, mean_yy, mean_xy = mean_x * mean_x, mean_y * mean_y, mean_x * mean_y
    luminance = (2.0 * mean_xy + c1) / (mean_xx + mean_yy + c1)
    structure = (2.0 * (xy - mean_xy) + c2) / ((xx - mean_xx) + (yy - mean_yy) + c2)
    return (luminance * structure).mean()


def total_variation(images: torch.Tensor, *, power: int = 1) -> torch.Tensor:
    """Mean of |difference|^power of horizontal neighbours plus that of vertical ones, over [..., H, W, D].

    power 1: anisotropic total variation (after Rudin, Osher and Fatemi, 1992), which keeps edges;
    power 2: its smooth relative, often given the same name, which spreads them.
    An image one pixel wide or high has no differences that way. Raises ValueError for a malformed image.
    """
    check_images("images", images)
    if power not in (1, 2):
        raise ValueError(f"power must be 1 or 2, got {power!r}")
    total = images.new_zeros(())
    for axis in (-3, -2):
        if images.shape[axis] > 1:
            difference = images.diff(dim=axis)
            total = total + (difference.abs() if power == 1 else difference.square()).mean()
    return total


def normal_consistency(
    normals: torch.Tensor, depth_normals: torch.Tensor, alphas: torch.Tensor, *, minimum_alpha: float = 0.95
) -> torch.Tensor:
    """Mean of 1 - |n . n_depth| over the pixels whose alpha exceeds `minimum_alpha`; zero if there are none.

    normals [..., H, W, 3] as blended, depth_normals [..., H, W, 3] from the depth image
    (`gdpro_sim.splatting.depth.depth_to_normals`), alphas [..., H, W, 1]. Both normals are taken as they are,
    not normalised: where surfels along a ray disagree their blended normal is short, which costs too.
    Pixels without a normal from depth (zero: the border of the image) do not count. The choice of pixels has
    no gradient. Raises ValueError where shapes, dtypes or devices do not fit.

    Source: Huang et al., "2D Gaussian Splatting" (2024), eq. 14, with the absolute value and the threshold of
    "GaussianDreamerPro" (2024).
    """
    check_images("normals", normals, channels=3)
    check_images("alphas", alphas, channels=1)
    check_alike(("normals", "depth_normals"), normals, depth_normals)
    check_alike(("normals' last channel", "alphas"), normals[..., -1:], alphas)
    counted = (alphas[..., 0] > minimum_alpha) & (depth_normals != 0).any(-1)
    errors = 1.0 - (normals * depth_normals).sum(-1).abs()
    return torch.where(counted, errors, torch.zeros_like(errors)).sum() / counted.sum().clamp(min=1)


def distortion(distort: torch.Tensor) -> torch.Tensor:
    """Mean of a distortion image [..., H, W, 1], as `rasterization_2dgs` with `distloss=True` gives it.

    Source: Huang et al., "2D Gaussian Splatting" (2024), eq. 13. Raises ValueError for a malformed image.
    """
    return check_images("distort", distort, channels=1).mean()


def _blur(planes: torch.Tensor, same: bool) -> torch.Tensor:
    """Gaussian window over planes [P, H, W], as the channels of one image: two depthwise convolutions."""
    half = SSIM_WINDOW // 2
    offsets = torch.arange(-half, half + 1, dtype=planes.dtype, device=planes.device)
    window = torch.exp(-0.5 * (offsets / SSIM_SIGMA) ** 2)
    window = window / window.sum()
    count = len(planes)
    out = planes[None]
    for across in (True, False):
        kernel = window.view((1, 1, 1, -1) if across else (1, 1, -1, 1)).expand(count, -1, -1, -1)
        margin = ((0, half) if across else (half, 0)) if same else (0, 0)
        out = torch.nn.functional.conv2d(out, kernel, padding=margin, groups=count)
    return out[0]


def _positive(data_range: float) -> float:
    if not data_range > 0.0:
        raise ValueError(f"data_range must be > 0, got {data_range!r}")
    return data_range


__all__ = ["distortion", "l1", "normal_consistency", "psnr", "ssim", "total_variation"]
