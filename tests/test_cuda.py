"""CUDA: every kernel module compiles without a GPU; with one, the pipeline gives what the CPU gives."""

from __future__ import annotations

import importlib
from pathlib import Path

import pytest
import torch
import trimesh
import warp as wp

import gdpro_sim
from gdpro_sim.simulation.scene import check_scene
from tests.conditions import needs_gpu
from tests.test_binding import make_bound

KERNELS = Path(__file__).resolve().parents[1] / "kernels"


def kernel_modules() -> list[str]:
    return sorted(
        path.stem for path in KERNELS.glob("*.py") if "@wp.kernel" in path.read_text(encoding="utf-8")
    )


@pytest.mark.parametrize("name", kernel_modules())
def test_kernels_compile_for_cuda_without_a_gpu(name: str, tmp_path: Path) -> None:
    module = importlib.import_module(f"gdpro_sim.kernels.{name}")
    wp.compile_aot_module(module, arch=90, module_dir=tmp_path, use_ptx=True)
    (built,) = tmp_path.glob("*.ptx")
    text = built.read_text(encoding="utf-8")
    kernels = wp.get_module(module.__name__).kernels.values()
    assert kernels
    for kernel in kernels:
        assert f"{kernel.key}_" in text


@pytest.mark.cuda
@needs_gpu
def test_binding_equals_cpu() -> None:
    bound = make_bound(1, degree=3)
    moved = bound.vertices * 1.1 + 0.3
    cpu, gpu = bound.gaussians(moved), bound.to("cuda").gaussians(moved.cuda())
    for name in ("means", "quats", "scales", "sh"):
        torch.testing.assert_close(getattr(gpu, name).cpu(), getattr(cpu, name), rtol=1e-4, atol=1e-5)


@pytest.mark.cuda
@needs_gpu
def test_a_whole_run_on_the_gpu(tmp_path: Path) -> None:
    trimesh.creation.icosphere(subdivisions=2, radius=0.1).export(tmp_path / "ball.obj")
    body = {"asset": str(tmp_path / "ball.obj"), "position": [0, 0, 0.05], "budget": 1500, "tets": 150}
    scene = check_scene({"bodies": [body], "duration": 0.3, "camera": {"width": 96, "height": 64}})
    recording = gdpro_sim.record(scene, tmp_path / "gpu", device="cuda")
    assert recording.video.stat().st_size > 0
    # The same asset on the CPU: tets are not repeatable.
    body = {"asset": str(recording.assets[0]), "name": "ball", "position": [0, 0, 0.05]}
    again = check_scene({"bodies": [body], "duration": 0.3})
    heights = [
        [float(frame.gaussians().means[:, 2].mean()) for frame in gdpro_sim.simulate(again, device=device)]
        for device in ("cpu", "cuda")
    ]
    torch.testing.assert_close(torch.tensor(heights[1]), torch.tensor(heights[0]), rtol=0.0, atol=1e-3)
