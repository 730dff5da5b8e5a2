"""Splatting on a GPU beside gsplat's CUDA rasteriser; run by `bench_splatting --device cuda`."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import torch

from gdpro_sim.device import resolve_device
from gdpro_sim.errors import DeviceError
from gdpro_sim.splatting import rasterization
from tests.benchmarks.machine import machine
from tests.benchmarks.splatting_scene import bumpy_sphere, front_camera

COUNTS, SIZE, DEGREE = (50_000, 200_000, 1_000_000), 1024, 3


def median_ms(function: Callable[[], object], repeats: int) -> float:
    """Median wall time from an idle GPU to an idle GPU."""
    walls = []
    for _ in range(repeats + 3):
        torch.cuda.synchronize()
        begin = time.perf_counter()
        function()
        torch.cuda.synchronize()
        walls.append((time.perf_counter() - begin) * 1e3)
    return sorted(walls[3:])[repeats // 2]


def gsplat_rasterization() -> tuple[Callable[..., Any] | None, str]:
    """gsplat's function, tried on one Gaussian so that its kernels are built; or None and why not."""
    try:
        import gsplat

        scene = {name: tensor.cuda() for name, tensor in bumpy_sphere(1, 0).items()}
        render(gsplat.rasterization, scene, 64, 0)
        torch.cuda.synchronize()
    except Exception as error:  # whatever a missing package, compiler or driver raises
        first = str(error).strip().split("\n")[0]
        return None, f"gsplat's CUDA kernels do not run here ({type(error).__name__}: {first})"
    return gsplat.rasterization, f"gsplat {gsplat.__version__}"


def render(
    function: Callable[..., Any], scene: dict[str, torch.Tensor], size: int, degree: int
) -> torch.Tensor:
    cameras = front_camera(size)
    image, _, _ = function(
        **scene,
        viewmats=cameras.viewmats.cuda(),
        Ks=cameras.Ks.cuda(),
        width=size,
        height=size,
        sh_degree=degree,
        packed=False,
    )
    return image


def print_cuda(repeats: int) -> None:
    """Print the table, or one line that says why there is none."""
    try:
        resolve_device("cuda")
    except DeviceError as error:
        print(f"not measured: {error}")
        return
    if not torch.cuda.is_available():
        print("not measured: this build of torch has no CUDA")
        return
    peer, note = gsplat_rasterization()
    print(
        f"\n{machine('cuda')}\n\n{note}. Median ms at {SIZE}², SH {DEGREE}: forward / forward + backward.\n"
    )
    print("| Gaussians | gdpro-sim | gsplat | ratio |\n|---|---|---|---|")
    weights = torch.rand(1, SIZE, SIZE, 3, generator=torch.Generator().manual_seed(1)).cuda()
    for count in COUNTS:
        inputs = {name: tensor.cuda() for name, tensor in bumpy_sphere(count, DEGREE).items()}
        learned = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}

        def times(
            function: Callable[..., Any],
            inputs: dict[str, torch.Tensor] = inputs,
            learned: dict[str, torch.Tensor] = learned,
        ) -> tuple[float, float]:
            def both() -> None:
                loss = (render(function, learned, SIZE, DEGREE) * weights).sum()
                torch.autograd.grad(loss, list(learned.values()))

            return median_ms(lambda: render(function, inputs, SIZE, DEGREE), repeats), median_ms(
                both, repeats
            )

        ours = times(rasterization)
        cells = f"{ours[0]:.2f} / {ours[1]:.2f}"
        if peer is None:
            print(f"| {count:,} | {cells} | not measured | |", flush=True)
            continue
        theirs = times(peer)
        ratios = f"{theirs[0] / ours[0]:.2f} / {theirs[1] / ours[1]:.2f}"
        print(f"| {count:,} | {cells} | {theirs[0]:.2f} / {theirs[1]:.2f} | {ratios} |", flush=True)


__all__ = ["print_cuda"]
