"""Studio pictures: light falls where it should, shadows lie on the floor, cameras see their box."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.gaussians import rgb_to_sh
from gdpro_sim.io.preview import Renderer, Studio, frame_camera


def ball(
    radius: float = 0.2, height: float = 0.4, color: tuple[float, float, float] = (0.8, 0.3, 0.2)
) -> BoundGaussians:
    mesh = trimesh.creation.icosphere(subdivisions=4, radius=radius)
    n = len(mesh.faces)
    sh = rgb_to_sh(torch.tensor(color)).expand(n, 1, 3).contiguous()
    return BoundGaussians(
        torch.tensor(mesh.vertices + np.array([0.0, 0.0, height]), dtype=torch.float32),
        torch.tensor(np.asarray(mesh.faces), dtype=torch.int32),
        torch.arange(n, dtype=torch.int32),
        torch.full((n, 3), 1.0 / 3.0),
        torch.tensor([[1.0, 0.0]]).repeat(n, 1),
        torch.log(torch.tensor([[0.002, 0.012, 0.012]])).repeat(n, 1),
        torch.full((n,), 4.0),
        sh,
    )


def camera(width: int = 160, height: int = 120, **changes: float) -> object:
    view = {"azimuth": -60.0, "elevation": 25.0, "fov": 40.0, **changes}
    return frame_camera([-0.5, -0.5, 0.0], [0.5, 0.5, 0.7], width=width, height=height, **view)  # type: ignore[arg-type]


def picture(studio: Studio, bound: BoundGaussians | None = None) -> np.ndarray:
    bound = bound or ball()
    renderer = Renderer(camera(), studio)  # type: ignore[arg-type]
    return renderer.render(bound.gaussians(), bound.normals()).astype(float)


def test_the_lit_side_is_brighter_and_the_floor_has_a_shadow() -> None:
    lit = picture(Studio(scale=0.4))
    empty = picture(Studio(scale=0.4), ball(height=-100.0))
    red = lit[..., 0] - lit[..., 2] > 40
    ys, xs = np.nonzero(red)
    assert 300 < len(ys) < 4000
    upper, lower = ys < np.quantile(ys, 0.3), ys > np.quantile(ys, 0.8)
    top, bottom = lit[ys[upper], xs[upper]], lit[ys[lower], xs[lower]]
    assert top.mean() > 1.3 * bottom.mean()
    darker = (empty - lit).mean(-1) > 15
    assert (darker & ~red).sum() > 100, "a shadow on the floor"
    assert np.abs(lit[:10] - empty[:10]).max() < 3, "the sky does not change"


def test_a_raised_ball_casts_its_shadow_further_away() -> None:
    empty = picture(Studio(scale=0.4), ball(height=-100.0))

    def shadow(height: float) -> np.ndarray:
        lit = picture(Studio(scale=0.4), ball(height=height))
        dark = ((empty - lit).mean(-1) > 15) & (lit[..., 0] - lit[..., 2] < 30)
        return np.argwhere(dark).mean(axis=0)

    touching, raised = shadow(0.2), shadow(0.5)
    assert np.linalg.norm(raised - touching) > 5


def test_without_shading_the_colours_are_the_gaussians_own() -> None:
    plain = picture(Studio(shading="none", background="black"))
    middle = plain[plain[..., 0] > 150]
    assert np.allclose(middle.mean(0), [204, 76.5, 51], atol=6)
    assert picture(Studio(shading="none", background="white"))[0].min() == 255


def test_the_camera_sees_its_whole_box() -> None:
    for azimuth in (-60.0, 10.0, 135.0):
        for elevation in (-20.0, 14.0, 80.0):
            cameras = frame_camera(
                [-1, -2, 0],
                [1, 0.5, 3],
                azimuth=azimuth,
                elevation=elevation,
                fov=32.0,
                width=200,
                height=100,
            )
            corners = np.array([[x, y, z, 1.0] for x in (-1, 1) for y in (-2, 0.5) for z in (0, 3)])
            local = corners @ cameras.viewmats[0].numpy().T
            assert (local[:, 2] > 0).all()
            pixels = local[:, :3] @ cameras.Ks[0].numpy().T
            pixels = pixels[:, :2] / pixels[:, 2:]
            assert (pixels >= 0).all() and (pixels <= [200, 100]).all()
    with pytest.raises(ValueError, match="coincide"):
        frame_camera([0, 0, 0], [1, 1, 1], azimuth=0, elevation=0, fov=30, width=8, height=8,
                     eye=[0.5, 0.5, 0.5])  # fmt: skip
