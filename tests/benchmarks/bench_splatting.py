"""Time of images and their gradients through the public functions, as Markdown tables.

    python -m tests.benchmarks.bench_splatting [--repeats 15] [--only times rates stages surfels] [--png FILE]
    python -m tests.benchmarks.bench_splatting --device cuda

Scene: N Gaussians on a bumpy sphere that fills the frame, tangential scale sqrt(4 pi / N) times a lognormal
factor, normal scale 0.3 of it, opacity sigmoid(N(0.8, 1.5)). "fwd" is an image of tensors that need no
gradient; "fwd+bwd" is an image, loss = sum(image * fixed weights), and its gradients at means, quats, scales,
opacities and colours through autograd. Wall times are medians; CPU times (all threads together) are minima,
since they grow with what else runs on a shared machine. Torch has as many threads for the loss.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from gdpro_sim import device
from gdpro_sim.splatting import RasterOptions, rasterization, rasterization_2dgs
from gdpro_sim.splatting.compositing import Blending, blend
from gdpro_sim.splatting.projection import View, project
from gdpro_sim.splatting.tiles import count_and_fill
from tests.benchmarks.machine import machine
from tests.benchmarks.splatting_scene import blended_pairs, bumpy_sphere, front_camera
from tests.benchmarks.vector_bound import VectorBound, vector_bound

CASES = ((10_000, 256), (10_000, 512), (50_000, 512), (200_000, 512))

PEER = {
    (10_000, 256): (67.0, 118.0),
    (10_000, 512): (313.0, 491.0),
    (50_000, 512): (313.0, 516.0),
    (200_000, 512): (466.0, 782.0),
}
"""OpenSplat's C++ CPU rasteriser on the same scene, wall ms forward and forward + backward: measured once, on
two quiet cores of another hour, and not again in this run. Of 10k @ 512 only its CPU time is known."""

TABLES = ("times", "rates", "stages", "surfels")


@dataclass(frozen=True)
class Timing:
    """Median wall and least CPU time of all threads, ms."""

    wall: float
    cpu: float

    def __str__(self) -> str:
        return f"{self.wall:.1f} / {self.cpu:.1f}"


def measure(function: Callable[[], object], repeats: int) -> Timing:
    """Call `function` two times to warm up, then `repeats` times."""
    walls, cpus = [], []
    for _ in range(repeats + 2):
        wall, cpu = time.perf_counter(), time.process_time()
        function()
        walls.append((time.perf_counter() - wall) * 1e3)
        cpus.append((time.process_time() - cpu) * 1e3)
    return Timing(sorted(walls[2:])[repeats // 2], min(cpus[2:]))


def use_threads(count: int) -> None:
    device.set_thread_count(count)
    torch.set_num_threads(count)


class Case:
    """N Gaussians seen at size x size pixels with SH `degree`, and the work that is timed."""

    def __init__(self, count: int, size: int, degree: int) -> None:
        self.count, self.size, self.degree = count, size, degree
        self.inputs = bumpy_sphere(count, degree)
        self.learned = {name: tensor.clone().requires_grad_() for name, tensor in self.inputs.items()}
        cameras = front_camera(size)
        self.camera: dict[str, Any] = {
            "viewmats": cameras.viewmats,
            "Ks": cameras.Ks,
            "width": size,
            "height": size,
            "sh_degree": degree,
        }
        g = torch.Generator().manual_seed(1)
        self.weights = [torch.rand(1, size, size, channels, generator=g) for channels in (3, 1, 3, 1)]

    @property
    def name(self) -> str:
        return f"{self.count // 1000}k @ {self.size}²"

    def forward(self) -> Any:
        return rasterization(**self.inputs, **self.camera)

    def both(self) -> None:
        image, _, _ = rasterization(**self.learned, **self.camera)
        self.backward(image)

    def backward(self, *images: Tensor) -> None:
        loss = sum(
            ((image * w).sum() for image, w in zip(images, self.weights, strict=False)), torch.zeros(())
        )
        torch.autograd.grad(loss, list(self.learned.values()))

    def geometry(self, inputs: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """RGB, alpha, normals and expected depth of 3D Gaussians."""
        image, alphas, meta = rasterization(
            **inputs, **self.camera, render_mode="RGB+ED", options=RasterOptions(normals=True)
        )
        return image[..., :3], alphas, meta["normals"], image[..., 3:]

    def surfels(self, inputs: dict[str, Tensor]) -> tuple[Tensor, ...]:
        """RGB, alpha, normals and expected depth of surfels."""
        image, alphas, normals, *_ = rasterization_2dgs(**inputs, **self.camera, render_mode="RGB+ED")
        return image[..., :3], alphas, normals, image[..., 3:]

    def timed(
        self, draw: Callable[[dict[str, Tensor]], tuple[Tensor, ...]], repeats: int
    ) -> tuple[Timing, Timing]:
        """fwd and fwd+bwd of images drawn by `draw`."""
        forward = measure(lambda: draw(self.inputs), repeats)
        return forward, measure(lambda: self.backward(*draw(self.learned)), repeats)


def stages(case: Case, repeats: int) -> dict[str, Timing]:
    """Time of each stage of an image with gradients, one after the other."""
    camera, learned = case.camera, case.learned
    view = View(camera["viewmats"], camera["Ks"], case.size, case.size, 0.01, 1e10, 0.0, 0.3, False)
    gaussians = (learned["means"], learned["quats"], learned["scales"], learned["opacities"])
    blending, background = Blending(view, 3, -1, True, False), torch.zeros(1, 3)

    def projected() -> Any:
        return project(gaussians, learned["colors"], case.degree, view)

    projection = projected()
    lists = count_and_fill(projection, view)
    leaf = replace(
        projection,
        records=projection.records.detach().requires_grad_(),
        means2d=projection.means2d.detach().requires_grad_(),
    )

    def composited() -> Tensor:
        return blend(leaf, lists, None, background, blending).image

    def composite_backward() -> tuple[Tensor, ...]:
        return torch.autograd.grad(image, [leaf.records, leaf.means2d], case.weights[0], retain_graph=True)

    image = composited()
    gradients = composite_backward()

    def project_backward() -> None:
        outputs = [projection.records, projection.means2d]
        torch.autograd.grad(outputs, list(learned.values()), gradients, retain_graph=True)

    return {
        "project": measure(projected, repeats),
        "tiles": measure(lambda: count_and_fill(projection, view), repeats),
        "composite": measure(composited, repeats),
        "composite backward": measure(composite_backward, repeats),
        "project backward": measure(project_backward, repeats),
    }


def table(header: str) -> None:
    print(f"\n{header}\n|{'---|' * (header.count('|') - 1)}")


def print_times(repeats: int, cores: int) -> None:
    print("\n## Wall / CPU ms of an image\n")
    print(
        "Peer: OpenSplat (C++ on the CPU), wall ms, a published figure measured on another hour; "
        "* its CPU time. Ratio: the peer's time over ours with all cores, forward and forward + backward."
    )
    counts = sorted({1, cores})
    ours = " | ".join(f"{n} thread{'s' * (n > 1)}: fwd | fwd+bwd" for n in counts)
    table(f"| Gaussians @ pixels | SH | {ours} | peer fwd / fwd+bwd | ratio |")
    for count, size in CASES:
        for degree in (0, 3):
            case, cells = Case(count, size, degree), []
            for threads in counts:
                use_threads(threads)
                forward, both = measure(case.forward, repeats), measure(case.both, repeats)
                cells += [str(forward), str(both)]
            peer = PEER[count, size]
            star = "*" if (count, size) == (10_000, 512) else ""
            print(
                f"| {case.name} | {degree} | {' | '.join(cells)} | {peer[0]:.0f} / {peer[1]:.0f}{star} "
                f"| {peer[0] / forward.wall:.1f} / {peer[1] / both.wall:.1f} |",
                flush=True,
            )


def print_rates(repeats: int, bound: VectorBound) -> None:
    print("\n## Blended pairs per second and core\n")
    print(
        "A pair is a pixel and a Gaussian with a weight above zero, counted once in float32. M pairs per "
        "CPU second on one thread, SH 0: over the whole image through the public function (backward: fwd+bwd "
        "less fwd), and over the compositing kernels alone, with the percentage of the vector bound: "
        f"{bound.forward / 1e6:.0f} M lane evaluations/s forward, {bound.backward / 1e6:.0f} M backward "
        "(`tests/benchmarks/vector_bound.py`)."
    )
    table(
        "| Gaussians @ pixels | M pairs | M list entries | fwd | fwd, compositing alone | bwd "
        "| bwd, compositing alone |"
    )
    use_threads(1)
    for count, size in CASES:
        case = Case(count, size, 0)
        meta = case.forward()[2]
        pairs, entries = blended_pairs(meta) / 1e6, len(meta["flatten_ids"]) / 1e6
        forward, both = measure(case.forward, repeats).cpu, measure(case.both, repeats).cpu
        parts = stages(case, repeats)
        cells = []
        for whole, alone, limit in (
            (forward, parts["composite"].cpu, bound.forward),
            (both - forward, parts["composite backward"].cpu, bound.backward),
        ):
            for milliseconds in (whole, alone):
                rate = pairs / milliseconds * 1e3
                cells.append(f"{rate:.0f} ({1e8 * rate / limit:.0f} %)")
        print(f"| {case.name} | {pairs:.2f} | {entries:.2f} | {' | '.join(cells)} |", flush=True)


def print_stages(repeats: int, cores: int) -> None:
    print("\n## Stages, wall / CPU ms\n")
    print("SH 3. Sum: of the stages; what fwd+bwd takes beyond it are checks, the loss and autograd.")
    names = "project | tiles | composite | composite backward | project backward"
    table(f"| Gaussians @ pixels | threads | {names} | sum | fwd+bwd |")
    for count, size in CASES:
        case = Case(count, size, 3)
        for threads in sorted({1, cores}):
            use_threads(threads)
            parts, both = stages(case, repeats), measure(case.both, repeats)
            total = Timing(sum(p.wall for p in parts.values()), sum(p.cpu for p in parts.values()))
            cells = " | ".join(str(p) for p in [*parts.values(), total, both])
            print(f"| {case.name} | {threads} | {cells} |", flush=True)


def print_surfels(repeats: int, cores: int) -> None:
    print("\n## Surfels, wall / CPU ms\n")
    print(
        f"RGB + alpha + depth + normals, SH 0, {cores} threads; the loss takes all four. Ratios of wall "
        "times: to 3D Gaussians with RGB alone, and with the same outputs."
    )
    table(
        "| Gaussians @ pixels | 3D, RGB: fwd | fwd+bwd | 3D, all: fwd | fwd+bwd | surfels, all: fwd "
        "| fwd+bwd | to 3D RGB | to 3D all |"
    )
    use_threads(cores)
    for count, size in CASES:
        case = Case(count, size, 0)
        rgb = measure(case.forward, repeats), measure(case.both, repeats)
        full, flat = case.timed(case.geometry, repeats), case.timed(case.surfels, repeats)
        ratios = [
            " / ".join(f"{a.wall / b.wall:.2f}" for a, b in zip(flat, base, strict=True))
            for base in (rgb, full)
        ]
        cells = " | ".join([str(t) for t in (*rgb, *full, *flat)] + ratios)
        print(f"| {case.name} | {cells} |", flush=True)


def write_png(path: Path) -> None:
    import imageio.v3 as iio

    image = Case(50_000, 512, 3).forward()[0]
    iio.imwrite(path, (image[0].clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0] if __doc__ else None)
    parser.add_argument("--repeats", type=int, default=15)
    parser.add_argument(
        "--only", nargs="+", choices=TABLES, default=TABLES, metavar="TABLE", help=", ".join(TABLES)
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument(
        "--png", type=Path, help="also write an image of the scene (50k Gaussians, 512 x 512)"
    )
    arguments = parser.parse_args()
    if arguments.device == "cuda":
        from tests.benchmarks.bench_splatting_cuda import print_cuda

        print_cuda(arguments.repeats)
        return
    repeats, cores = arguments.repeats, device.thread_count()
    begin = time.perf_counter()
    small = Case(100, 64, 0)
    small.both()
    first = time.perf_counter() - begin
    print(f"\n{machine()}\n\nFirst image and gradients, with whatever had to be compiled: {first:.1f} s")
    if "times" in arguments.only:
        print_times(repeats, cores)
    if "rates" in arguments.only:
        print_rates(repeats, vector_bound())
    if "stages" in arguments.only:
        print_stages(repeats, cores)
    if "surfels" in arguments.only:
        print_surfels(repeats, cores)
    print(f"\n{machine()}")
    if arguments.png:
        write_png(arguments.png)


if __name__ == "__main__":
    main()
