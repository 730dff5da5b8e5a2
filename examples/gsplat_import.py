"""A gsplat training loop on the CPU: one line changed, the import.

python examples/gsplat_import.py [OUT.png]

    from gsplat import rasterization              # before
    from gdpro_sim.splatting import rasterization # after

Everything else is as gsplat's users write it: argument names and shapes, activated scales and opacities,
quaternions wxyz, spherical harmonics, `packed=False`, and `info["means2d"].retain_grad()` for the gradients
that densification looks at. 500 random Gaussians learn an image of two coloured corners on white.
"""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from gdpro_sim.io.images import write_png
from gdpro_sim.splatting import rasterization


def main(out: str) -> None:
    torch.manual_seed(0)
    device = torch.device("cpu")
    width = height = 96
    target = torch.ones(height, width, 3, device=device)
    target[: height // 2, : width // 2] = torch.tensor([1.0, 0.1, 0.1])
    target[height // 2 :, width // 2 :] = torch.tensor([0.1, 0.2, 1.0])

    count = 500
    splats = torch.nn.ParameterDict(
        {
            "means": 2.0 * torch.rand(count, 3, device=device) - 1.0,
            "quats": torch.rand(count, 4, device=device),
            "scales": torch.full((count, 3), -2.5, device=device),
            "opacities": torch.zeros(count, device=device),
            "sh0": torch.zeros(count, 1, 3, device=device),
        }
    )
    optimizers = [
        torch.optim.Adam([{"params": splats[name], "lr": rate, "name": name}])
        for name, rate in {
            "means": 1e-2,
            "quats": 1e-2,
            "scales": 2e-2,
            "opacities": 5e-2,
            "sh0": 5e-2,
        }.items()
    ]
    viewmats = torch.eye(4, device=device)[None]
    viewmats[0, 2, 3] = 4.0
    Ks = torch.tensor([[[180.0, 0.0, width / 2], [0.0, 180.0, height / 2], [0.0, 0.0, 1.0]]], device=device)

    for step in range(151):
        renders, alphas, info = rasterization(
            means=splats["means"],
            quats=splats["quats"],
            scales=torch.exp(splats["scales"]),
            opacities=torch.sigmoid(splats["opacities"]),
            colors=splats["sh0"],
            viewmats=viewmats,
            Ks=Ks,
            width=width,
            height=height,
            sh_degree=0,
            packed=False,
            backgrounds=torch.ones(1, 3, device=device),
            render_mode="RGB",
            rasterize_mode="classic",
        )
        info["means2d"].retain_grad()
        loss = torch.nn.functional.mse_loss(renders[0], target)
        loss.backward()
        if step % 25 == 0:
            pull = info["means2d"].grad.norm(dim=-1).mean()
            seen = int((info["radii"] > 0).all(-1).sum())
            print(f"step {step:3d}  loss {loss.item():.5f}  mean |means2d.grad| {pull:.2e}  {seen} visible")
        for optimizer in optimizers:
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
    Path(out).parent.mkdir(parents=True, exist_ok=True)
    write_png(out, (renders[0].detach().clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy())
    print(f"mean alpha {alphas.mean().item():.3f}, wrote {out}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "out/gsplat_import.png")
