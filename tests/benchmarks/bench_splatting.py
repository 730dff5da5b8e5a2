"""Time of one forward image through `gdpro_sim.splatting.rasterization`, as a Markdown table.

    python -m tests.benchmarks.bench_splatting [--repeats 15] [--png image.png]

Scene: N Gaussians on a bumpy sphere that fills the frame, tangential scale sqrt(4 pi / N) times a lognormal
factor, normal scale 0.3 of it, opacity sigmoid(N(0.8, 1.5)). Wall times are medians; CPU times (all threads
together) are minima, since they grow with what else runs on a shared machine.
"""

from __future__ import annotations

import argparse
import math
import time
from pathlib import Path

import torch

from gdpro_sim import device
from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import rgb_to_sh
from gdpro_sim.splatting import rasterization
from tests.benchmarks.machine import machine

CASES = ((10_000, 256), (10_000, 512), (50_000, 512), (200_000, 512))


def bumpy_sphere(count: int, degree: int, seed: int = 0) -> dict[str, torch.Tensor]:
    """Gaussians on a sphere of radius about 1 m, coloured by direction."""
    g = torch.Generator().manual_seed(seed)
    normal = torch.nn.functional.normalize(torch.randn(count, 3, generator=g), dim=1)
    x, y, z = normal.unbind(1)
    radius = 1.0 + 0.08 * torch.sin(5 * x) * torch.sin(6 * y) * torch.sin(4 * z + 1)
    scale = math.sqrt(4 * math.pi / count) * torch.exp(0.3 * torch.randn(count, 2, generator=g))
    sh = 0.1 * torch.randn(count, (degree + 1) ** 2, 3, generator=g)
    sh[:, 0] = rgb_to_sh(0.5 + 0.5 * normal)
    return {
        "means": normal * radius[:, None],
        # The rotation that turns +z into the normal, not normalised.
        "quats": torch.stack([1 + z, -y, x, torch.zeros_like(x)], 1),
        "scales": torch.cat([scale, 0.3 * scale[:, :1]], 1),
        "opacities": torch.sigmoid(0.8 + 1.5 * torch.randn(count, generator=g)),
        "colors": sh,
    }


def front_camera(size: int) -> Cameras:
    """A camera 3.2 m away whose frame the sphere fills."""
    return Cameras.look_at(
        [[0.0, -3.2, 0.6]], [0.0, 0.0, 0.0], vertical_fov=2 * math.asin(1.05 / 3.25), width=size, height=size
    )


def measure(
    scene: dict[str, torch.Tensor], cameras: Cameras, degree: int, repeats: int
) -> tuple[float, float]:
    """Median wall and least CPU time of one image, ms."""
    walls, cpus = [], []
    for _ in range(repeats + 2):
        wall, cpu = time.perf_counter(), time.process_time()
        rasterization(
            **scene,
            viewmats=cameras.viewmats,
            Ks=cameras.Ks,
            width=cameras.width,
            height=cameras.height,
            sh_degree=degree,
        )
        walls.append((time.perf_counter() - wall) * 1e3)
        cpus.append((time.process_time() - cpu) * 1e3)
    return sorted(walls[2:])[repeats // 2], min(cpus[2:])


def write_png(path: Path) -> None:
    import imageio.v3 as iio

    scene, cameras = bumpy_sphere(50_000, 3), front_camera(512)
    image, _, _ = rasterization(
        **scene, viewmats=cameras.viewmats, Ks=cameras.Ks, width=512, height=512, sh_degree=3
    )
    iio.imwrite(path, (image[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument(
        "--png", type=Path, help="also write an image of the scene (50k Gaussians, 512 x 512)"
    )
    arguments = parser.parse_args()
    start = time.perf_counter()
    measure(bumpy_sphere(100, 0), front_camera(64), 0, 1)
    first = time.perf_counter() - start
    cores = device.thread_count()
    print(f"\n{machine()}\n\nFirst image, with whatever had to be compiled: {first:.1f} s\n")
    print(
        "| Gaussians @ pixels | SH degree | 1 thread: wall / CPU ms | " + f"{cores} threads: wall / CPU ms |"
    )
    print("|---|---|---|---|")
    for count, size in CASES:
        for degree in (0, 3):
            scene, cameras = bumpy_sphere(count, degree), front_camera(size)
            cells = []
            for threads in (1, cores):
                device.set_thread_count(threads)
                torch.set_num_threads(threads)
                cells.append("{:.1f} / {:.1f}".format(*measure(scene, cameras, degree, arguments.repeats)))
            print(f"| {count // 1000}k @ {size}² | {degree} | {cells[0]} | {cells[1]} |", flush=True)
    if arguments.png:
        write_png(arguments.png)


if __name__ == "__main__":
    main()
