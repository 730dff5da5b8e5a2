"""Leading batch axes are scenes one by one."""

from __future__ import annotations

import pytest
import torch

from gdpro_sim.splatting import rasterization, rasterization_2dgs
from tests.splatting.scenes import cameras, cloud, features


def stacked() -> tuple[list[dict[str, torch.Tensor]], dict[str, torch.Tensor], dict[str, object]]:
    scenes = [
        {**cloud(30, i), "colors": features(30, 3, i), "backgrounds": features(2, 3, i)} for i in range(6)
    ]
    both = {name: torch.stack([s[name] for s in scenes]).unflatten(0, (2, 3)) for name in scenes[0]}
    views = cameras(2, 25, 20)
    for name in ("viewmats", "Ks"):
        both[name] = views[name].expand(2, 3, *views[name].shape)
    return scenes, both, views


@pytest.mark.parametrize("render", [rasterization, rasterization_2dgs])
def test_batches_are_scenes_one_by_one(render) -> None:
    scenes, both, views = stacked()
    leaves = {name: value.clone().requires_grad_() for name, value in both.items()}
    *images, meta = render(**leaves, width=25, height=20, render_mode="RGB+ED", packed=False)
    assert images[0].shape == (2, 3, 2, 20, 25, 4)
    assert meta["means2d"].shape == (2, 3, 2, 30, 2)
    assert len(meta["batches"]) == 6
    images[0].square().sum().backward()
    for i, scene in enumerate(scenes):
        one = {name: value.clone().requires_grad_() for name, value in scene.items()}
        *alone, single = render(**one, **views, render_mode="RGB+ED")
        for many, image in zip(images, alone, strict=True):
            assert torch.equal(many[i // 3, i % 3], image)
        assert torch.equal(meta["radii"][i // 3, i % 3], single["radii"])
        alone[0].square().sum().backward()
        for name in one:
            assert torch.equal(leaves[name].grad[i // 3, i % 3], one[name].grad)


def test_axes_that_do_not_fit() -> None:
    _, both, _ = stacked()
    both["opacities"] = both["opacities"][:, :2]
    with pytest.raises(ValueError, match=r"opacities must begin with the batch axes of means, \[2, 3\], got"):
        rasterization(**both, width=25, height=20)
    both["means"] = torch.zeros(0, 30, 3)
    with pytest.raises(ValueError, match="means must hold at least one scene"):
        rasterization(**both, width=25, height=20)


def test_batches_without_gaussians() -> None:
    _, both, _ = stacked()
    none = {n: v[:, :, :0] if n not in ("viewmats", "Ks", "backgrounds") else v for n, v in both.items()}
    image, alpha, _ = rasterization(**none, width=25, height=20)
    assert image.shape == (2, 3, 2, 20, 25, 3)
    assert alpha.abs().max() == 0
