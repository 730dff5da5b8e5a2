"""Fit random Gaussians to pictures of a mesh, and print how well they show it from cameras they never saw.

python examples/fit_views.py [MESH] [--surfels] [--gaussians 5000] [--size 128] [--seconds 60] [-o OUT]

The mesh is drawn by casting rays: colour, alpha and normals. Gaussians start anywhere in its bounding box and
follow Adam; every step takes a few pictures over a random background, so that a stray Gaussian shows up in
front of one colour or another and is cleared away. Writes OUT/held_out.png (target and fit, then target and
fitted normals) and OUT/fit.ply.
"""

from __future__ import annotations

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import warp
from torch import Tensor

from gdpro_sim import Cameras, Gaussians, RasterOptions
from gdpro_sim.binding import face_normals, vertex_normals
from gdpro_sim.device import serial_torch
from gdpro_sim.errors import GdproError
from gdpro_sim.files import prepare_folder
from gdpro_sim.gaussians import rgb_to_sh
from gdpro_sim.io.images import write_png
from gdpro_sim.io.ply import write_ply
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.proximity import SurfaceIndex
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.splatting import losses, rasterization, rasterization_2dgs

HELD_OUT, TRAIN, BATCH = 8, 64, 2
SSIM, DISTORTION, NORMALS = 0.2, 0.5, 0.05
"""Weights of the losses beside L1; the last two are for surfels."""

RAYS = 3
"""Rays across and down a pixel."""


@dataclass(frozen=True)
class Views:
    """Cameras and what they see, [V, H, W, .]: rgb (over black), alphas, unit normals (zero off the mesh)."""

    cameras: Cameras
    rgb: Tensor
    alphas: Tensor
    normals: Tensor


def sphere(count: int, turn: float) -> np.ndarray:
    """Evenly spread unit vectors (a Fibonacci lattice), turned by `turn` radians about the vertical."""
    i = np.arange(count) + 0.5
    z = 0.95 * (1.0 - 2.0 * i / count)
    angle = math.pi * (1.0 + math.sqrt(5.0)) * i + turn
    return np.stack([np.sqrt(1 - z * z) * np.cos(angle), np.sqrt(1 - z * z) * np.sin(angle), z], 1)


def draw(mesh: SurfaceMesh, index: SurfaceIndex, eyes: np.ndarray, size: int) -> Views:
    """Pictures of a mesh from `eyes` [V, 3], each pixel the mean of RAYS x RAYS rays."""
    centre = 0.5 * (mesh.vertices.min(0) + mesh.vertices.max(0))
    reach = np.linalg.norm(mesh.vertices - centre, axis=1).max() * 1.02
    distance = np.linalg.norm(eyes[0] - centre)
    cameras = Cameras.look_at(
        eyes, centre, vertical_fov=2 * math.asin(reach / distance), width=size, height=size
    )
    corners = corner_normals(mesh)
    colors = SurfaceColors(mesh)
    steps = (np.arange(size * RAYS) + 0.5) / RAYS
    x, y = np.meshgrid(steps, steps)
    pixels = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    out = []
    for viewmat, K, eye in zip(cameras.viewmats.numpy(), cameras.Ks.numpy(), eyes, strict=True):
        rays = pixels @ np.linalg.inv(K).T @ viewmat[:3, :3]
        faces, barycentric = index.first_hit(np.broadcast_to(eye, rays.shape), rays)
        hit = np.flatnonzero(faces >= 0)
        faces, barycentric = faces[hit], barycentric[hit]
        normal = np.einsum("nc,ncd->nd", barycentric, corners[faces])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        normal *= -np.sign(np.einsum("nd,nd->n", normal, rays[hit]))[:, None]
        # Light from above and a little from the side: plain meshes show their shape, and the colour of a
        # point does not depend on who looks.
        light = 0.65 + 0.35 * (normal @ np.asarray([0.36, -0.48, 0.8]))
        values = np.zeros((len(rays), 7), np.float32)
        values[hit, :3] = colors.at(faces, barycentric)[:, :3] * light[:, None]
        values[hit, 3] = 1.0
        values[hit, 4:] = normal
        out.append(values.reshape(size, RAYS, size, RAYS, 7).mean((1, 3)))
    rgb, alphas, normals = torch.from_numpy(np.stack(out)).split([3, 1, 3], dim=-1)
    return Views(cameras, rgb, alphas, torch.nn.functional.normalize(normals, dim=-1))


def corner_normals(mesh: SurfaceMesh) -> np.ndarray:
    """Unit normals of each face's corners [F, 3, 3]: the vertices', the face's own along sharp edges."""
    vertices, faces = torch.from_numpy(mesh.vertices), torch.from_numpy(mesh.faces)
    flat = face_normals(vertices, faces)[:, None]
    smooth = vertex_normals(vertices, faces)[faces.long()]
    return torch.where((smooth * flat).sum(2, keepdim=True) > 0.8, smooth, flat).numpy()


class Model:
    """What is learned, in the spaces Adam moves in: logarithms of scales, logits of opacities and colours."""

    def __init__(self, count: int, low: np.ndarray, high: np.ndarray, *, surfels: bool, seed: int) -> None:
        g = torch.Generator().manual_seed(seed)
        low_, high_ = torch.from_numpy(low), torch.from_numpy(high)
        self.surfels = surfels
        self.extent = float((high_ - low_).norm())
        spacing = self.extent / count ** (1 / 3)
        self.means = low_ + (high_ - low_) * torch.rand(count, 3, generator=g)
        self.quats = torch.randn(count, 4, generator=g)
        self.log_scales = torch.full((count, 3), math.log(0.25 * spacing))
        self.logits = torch.full((count,), math.log(0.1 / 0.9))
        self.colors = torch.zeros(count, 3)
        # Learning rates of the first and the last step.
        self.rates = {
            "means": (4e-3 * self.extent, 4e-5 * self.extent),
            "quats": (2e-2, 2e-3),
            "log_scales": (2e-2, 2e-3),
            "logits": (5e-2, 1e-2),
            "colors": (5e-2, 5e-3),
        }
        groups = []
        for name, (first, _) in self.rates.items():
            groups.append({"params": [getattr(self, name).requires_grad_()], "lr": first, "name": name})
        self.adam = torch.optim.Adam(groups, eps=1e-15)

    def set_progress(self, share: float) -> None:
        """Learning rates fall geometrically while `share` goes from 0 to 1."""
        for group in self.adam.param_groups:
            first, last = self.rates[group["name"]]
            group["lr"] = first * (last / first) ** share

    def gaussians(self) -> Gaussians:
        """What was learned as 3D Gaussians; surfels become thin ones."""
        scales = self.log_scales.exp()
        if self.surfels:
            flat = 0.01 * scales[:, :2].amin(dim=1, keepdim=True)
            scales = torch.cat([scales[:, :2], flat], dim=1)
        sh = rgb_to_sh(self.colors.sigmoid())[:, None]
        return Gaussians(self.means, self.quats, scales, self.logits.sigmoid(), sh)

    def render(self, cameras: Cameras, which: list[int], backgrounds: Tensor) -> dict[str, Tensor]:
        """rgb over `backgrounds`, alphas, blended normals; of surfels normals from depth and distortion."""
        arguments = {
            "means": self.means,
            "quats": self.quats,
            "scales": self.log_scales.exp(),
            "opacities": self.logits.sigmoid(),
            "colors": self.colors.sigmoid(),
            "viewmats": cameras.viewmats[which],
            "Ks": cameras.Ks[which],
            "width": cameras.width,
            "height": cameras.height,
            "backgrounds": backgrounds,
        }
        if self.surfels:
            rgbd, alphas, normals, from_depth, distort, _, _ = rasterization_2dgs(
                **arguments, render_mode="RGB+ED"
            )
            return {
                "rgb": rgbd[..., :3],
                "alphas": alphas,
                "normals": normals,
                "from_depth": from_depth,
                "distort": distort,
            }
        with_normals = RasterOptions(normals=not torch.is_grad_enabled())
        rgb, alphas, meta = rasterization(**arguments, options=with_normals)
        return {"rgb": rgb, "alphas": alphas, "normals": meta.get("normals")}


def step(model: Model, views: Views, which: list[int], share: float) -> float:
    """One step of Adam on pictures `which`; returns the loss."""
    backgrounds = torch.rand(len(which), 3)
    target = views.rgb[which] + (1.0 - views.alphas[which]) * backgrounds[:, None, None]
    images = model.render(views.cameras, which, backgrounds)
    loss = (1.0 - SSIM) * losses.l1(images["rgb"], target)
    loss = loss + SSIM * (1.0 - losses.ssim(images["rgb"], target, padding="same"))
    if model.surfels:
        loss = loss + DISTORTION * losses.distortion(images["distort"]) / model.extent
        agreement = losses.normal_consistency(images["normals"], images["from_depth"], images["alphas"])
        loss = loss + NORMALS * min(1.0, 2.0 * share) * agreement
    model.adam.zero_grad()
    loss.backward()
    model.set_progress(share)
    model.adam.step()
    return float(loss.detach())


@torch.no_grad()
def score(model: Model, views: Views) -> tuple[float, float, dict[str, Tensor]]:
    """Mean PSNR (dB, on white), mean angle between normals (degrees, where both are opaque), and images."""
    every = list(range(len(views.cameras)))
    images = model.render(views.cameras, every, torch.ones(len(every), 3))
    target = views.rgb + 1.0 - views.alphas
    psnrs = [losses.psnr(a.clamp(0, 1), b) for a, b in zip(images["rgb"], target, strict=True)]
    both = ((views.alphas > 0.99) & (images["alphas"] > 0.5))[..., 0]
    fitted = torch.nn.functional.normalize(images["normals"], dim=-1)
    angles = torch.acos((fitted * views.normals).sum(-1)[both].clamp(-1, 1))
    return float(torch.stack(psnrs).mean()), math.degrees(float(angles.mean())), images


def sheet(views: Views, images: dict[str, Tensor]) -> np.ndarray:
    """Target and fit, then both normals, one row per camera, uint8."""
    fitted = torch.nn.functional.normalize(images["normals"], dim=-1)
    columns = [
        views.rgb + 1.0 - views.alphas,
        images["rgb"],
        0.5 + 0.5 * views.normals,
        0.5 + 0.5 * fitted * (images["alphas"] > 0.5),
    ]
    rows = torch.cat(columns, dim=2)[:4].flatten(0, 1)
    return (rows.clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    bunny = Path(warp.__file__).parent / "examples/assets/bunny.usd"
    parser.add_argument("mesh", nargs="?", default=str(bunny), help="default: the Stanford bunny")
    parser.add_argument("--surfels", action="store_true", help="2D Gaussians instead of 3D ones")
    parser.add_argument("--gaussians", type=int, default=5000)
    parser.add_argument("--size", type=int, default=128, help="pixels across a picture")
    parser.add_argument("--seconds", type=float, default=60.0, help="of optimisation, at most")
    parser.add_argument("--iterations", type=int, default=2000, help="at most")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("-o", "--out", default="out/fit_views")
    options = parser.parse_args()
    for name in ("gaussians", "size", "seconds", "iterations"):
        if not getattr(options, name) > 0:
            parser.error(f"--{name} must be above 0, got {getattr(options, name)}")
    with serial_torch():
        fit(options)


def fit(options: argparse.Namespace) -> None:
    out = prepare_folder(options.out, "held_out.png")
    torch.manual_seed(options.seed)

    mesh = load_mesh(options.mesh)
    index = SurfaceIndex(mesh.vertices, mesh.faces)
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    distance = 2.0 * mesh.diagonal
    train = draw(mesh, index, 0.5 * (low + high) + distance * sphere(TRAIN, 0.0), options.size)
    test = draw(mesh, index, 0.5 * (low + high) + distance * sphere(HELD_OUT, 1.0), options.size)
    model = Model(options.gaussians, low, high, surfels=options.surfels, seed=options.seed)
    print(f"{Path(options.mesh).name}: {TRAIN} pictures of {options.size}² to fit, {HELD_OUT} held out")

    def report(done: int, spent: float) -> dict[str, Tensor]:
        psnr, angle, images = score(model, test)
        print(
            f"{spent:6.1f} s  step {done:5d}  held-out PSNR {psnr:5.2f} dB  normals off by {angle:4.1f} deg",
            flush=True,
        )
        return images

    spent, shown, order = 0.0, 0.0, []
    for done in range(options.iterations + 1):
        share = max(done / options.iterations, spent / options.seconds)
        if done == 0 or share >= 1.0 or spent - shown > options.seconds / 12:
            images, shown = report(done, spent), spent
        if share >= 1.0:
            break
        begin = time.perf_counter()
        if len(order) < BATCH:
            order = torch.randperm(TRAIN).tolist()
        step(model, train, [order.pop() for _ in range(BATCH)], share)
        spent += time.perf_counter() - begin
    write_png(out / "held_out.png", sheet(test, images))
    with torch.no_grad():
        write_ply(out / "fit.ply", model.gaussians())
    print(f"wrote {out / 'held_out.png'} and {out / 'fit.ply'}")


if __name__ == "__main__":
    try:
        main()
    except (GdproError, OSError) as error:
        raise SystemExit(f"fit_views: {error}") from None
