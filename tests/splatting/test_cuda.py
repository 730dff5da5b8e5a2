"""The CUDA path gives the CPU's images and gradients, where there is a GPU."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.splatting import contributions, rasterization, rasterization_2dgs
from tests.conditions import needs_gpu
from tests.splatting.scenes import cameras, cloud, features, harmonics


def on_gpu(arguments: dict[str, object]) -> dict[str, object]:
    return {k: v.cuda() if isinstance(v, torch.Tensor) else v for k, v in arguments.items()}


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
        moved = on_gpu(arguments)
        cuda_image, cuda_alpha, cuda_meta = rasterization(**moved, sh_degree=degree, render_mode=mode)
        assert cuda_image.device.type == "cuda"
        # Rounding differs, so a few pixels at a threshold may move by 1/255.
        difference = (cuda_image.cpu() - image).abs()
        assert (difference > 1e-4).float().mean() < 1e-3
        assert difference.median() < 1e-6
        assert ((cuda_alpha.cpu() - alpha).abs() > 1e-4).float().mean() < 1e-3
        assert abs(len(cuda_meta["flatten_ids"]) - len(meta["flatten_ids"])) <= 5
        torch.testing.assert_close(contributions(cuda_meta).cpu(), contributions(meta), rtol=1e-2, atol=0.1)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("degree", [None, 3])
@pytest.mark.parametrize("surfels", [False, True])
def test_gradients_equal_those_of_the_cpu(degree: int | None, surfels: bool) -> None:
    scene, views = cloud(500, 1), cameras(2, 100, 75)
    colors = features(500, 3, 1) if degree is None else harmonics(500, 3, 1)
    arguments = {**scene, "colors": colors, "backgrounds": features(2, 3, 2), **views}
    names = ["means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats", "Ks"]
    results = []
    for placed in (arguments, on_gpu(arguments)):
        leaves = {name: placed[name].detach().requires_grad_() for name in names}
        render = rasterization_2dgs if surfels else rasterization
        image, alpha, *rest = render(**{**placed, **leaves}, sh_degree=degree, render_mode="RGB+D")
        generator = torch.Generator().manual_seed(3)
        outputs = [image, alpha, *(t for t in rest if isinstance(t, torch.Tensor))]
        weights = [torch.randn(t.shape, generator=generator).to(t.device) for t in outputs]
        loss = sum((t * w).sum() for t, w in zip(outputs, weights, strict=True))
        results.append(torch.autograd.grad(loss, list(leaves.values())))
    for name, cpu, gpu in zip(names, *results, strict=True):
        # A Gaussian at a threshold in one pixel counts there on one side only.
        error = (gpu.cpu() - cpu).norm() / cpu.norm()
        assert error < 1e-2, (name, error.item())
