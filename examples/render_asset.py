"""Splat an asset with gsplat's arguments: import a mesh, stretch it, rasterise colour and depth.

python examples/render_asset.py [MESH] [OUT.png]
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch
import warp

from gdpro_sim import Cameras, import_mesh, rasterization
from gdpro_sim.io.images import write_png


def main(mesh: str, out: str) -> None:
    asset = import_mesh(mesh, budget=20_000, color="#7fb069", tets=False)
    rest = asset.gaussians.vertices
    size = float((rest.amax(0) - rest.amin(0)).max())
    stretched = rest * torch.tensor([1.0, 1.0, 1.4])  # any deformed vertices will do
    g = asset.gaussians.gaussians(stretched)
    middle = g.means.mean(0).tolist()
    cameras = Cameras.look_at(
        [[middle[0] + 2.2 * size, middle[1] - 1.6 * size, middle[2] + 0.8 * size]],
        middle,
        vertical_fov=0.7,
        width=480,
        height=480,
    )
    colors, alphas, _ = rasterization(
        g.means,
        g.quats,
        g.scales,
        g.opacities,
        g.sh,
        cameras.viewmats,
        cameras.Ks,
        cameras.width,
        cameras.height,
        sh_degree=g.sh_degree,
        backgrounds=torch.ones(1, 3),
        render_mode="RGB+ED",
    )
    depth = colors[0, ..., 3][alphas[0, ..., 0] > 0.5]
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    write_png(out, (colors[0, ..., :3].clamp(0, 1) * 255).to(torch.uint8).numpy())
    print(f"{len(g)} Gaussians, depth {float(depth.min()):.3f} to {float(depth.max()):.3f} m, wrote {out}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    bunny = Path(warp.__file__).parent / "examples/assets/bunny.usd"
    main(arguments[0] if arguments else str(bunny), arguments[1] if len(arguments) > 1 else "out/asset.png")
