"""Code written for gsplat, with the import changed."""

from __future__ import annotations

import pytest
import torch
from gsplat.strategy import DefaultStrategy

from gdpro_sim.splatting import rasterization
from tests.splatting.scenes import cameras, cloud, harmonics


@pytest.mark.parametrize("absgrad", [False, True])
def test_densification_by_gsplats_own_strategy(absgrad: bool) -> None:
    """gsplat's strategy reads gradients of `means2d`, radii and sizes from `meta`; clones, splits, prunes."""
    count = 60
    scene, views = cloud(count, 0), cameras(2, 60, 50)
    target, _, _ = rasterization(**scene, colors=harmonics(count, 1, 0), **views, sh_degree=1)
    start = cloud(count, 1)
    params = torch.nn.ParameterDict(
        {
            "means": start["means"],
            "quats": start["quats"],
            "scales": start["scales"].log(),
            "opacities": torch.logit(start["opacities"]),
            "sh": harmonics(count, 1, 1),
        }
    )
    optimizers = {name: torch.optim.Adam([p], lr=2e-2) for name, p in params.items()}
    rules = {"refine_start_iter": 5, "refine_every": 5, "reset_every": 1000, "grow_grad2d": 1e-5}
    strategy = DefaultStrategy(**rules, absgrad=absgrad)
    state = strategy.initialize_state(scene_scale=1.0)
    losses = []
    for step in range(40):
        colors, _, info = rasterization(
            params["means"],
            params["quats"],
            params["scales"].exp(),
            torch.sigmoid(params["opacities"]),
            params["sh"],
            views["viewmats"],
            views["Ks"],
            views["width"],
            views["height"],
            sh_degree=1,
            packed=False,
            absgrad=absgrad,
            sparse_grad=False,
            rasterize_mode="classic",
            distributed=False,
            camera_model="pinhole",
        )
        strategy.step_pre_backward(params, optimizers, state, step, info)
        loss = (colors - target).abs().mean()
        loss.backward()
        losses.append(loss.item())
        for optimizer in optimizers.values():
            optimizer.step()
            optimizer.zero_grad(set_to_none=True)
        strategy.step_post_backward(params, optimizers, state, step, info, packed=False)
    assert len(params["means"]) > count
    assert losses[-1] < 0.85 * losses[0]


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"packed": True}, ValueError, "packed must be False, the only choice here, got True"),
        ({"camera_model": "fisheye"}, ValueError, "camera_model must be 'pinhole', the only choice here"),
        ({"tile_size": 16.0}, ValueError, "tile_size must be 16, the only choice here, got 16.0"),
        ({"channel_chunks": 4}, TypeError, "unexpected argument 'channel_chunks'"),
    ],
)
def test_what_is_not_offered_is_named(
    arguments: dict[str, object], error: type[Exception], message: str
) -> None:
    with pytest.raises(error, match=message):
        rasterization(**cloud(4, 0), colors=torch.rand(4, 3), **cameras(1, 8, 8), **arguments)
