"""The CUDA path gives the CPU's image, where there is a GPU."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.splatting import rasterization
from tests.conditions import needs_gpu
from tests.splatting.scenes import cameras, cloud, features, harmonics


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("mode", ["RGB", "RGB+ED", "D"])
def test_cuda_equals_cpu(mode: str) -> None:
    scene, views = cloud(2000, 0), cameras(2, 200, 150)
    for colors, degree in (
        (harmonics(2000, 3, 0), 3),
        (features(2000, 3, 0), None),
        (features(2000, 7, 0), None),
    ):
        arguments = {**scene, "colors": colors, **views}
        image, alpha, meta = rasterization(**arguments, sh_degree=degree, render_mode=mode)
        moved = {k: v.cuda() if isinstance(v, torch.Tensor) else v for k, v in arguments.items()}
        cuda_image, cuda_alpha, cuda_meta = rasterization(**moved, sh_degree=degree, render_mode=mode)
        assert cuda_image.device.type == "cuda"
        # Rounding differs, so a few pixels at a threshold may move by 1/255.
        difference = (cuda_image.cpu() - image).abs()
        assert (difference > 1e-4).float().mean() < 1e-3
        assert difference.median() < 1e-6
        assert ((cuda_alpha.cpu() - alpha).abs() > 1e-4).float().mean() < 1e-3
        assert abs(len(cuda_meta["flatten_ids"]) - len(meta["flatten_ids"])) <= 5
