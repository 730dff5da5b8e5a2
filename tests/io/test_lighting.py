"""Lights against closed forms: Lambert's law, colours, exposure, domes, opacity."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from gdpro_sim.gaussians import SH_C0, Gaussians
from gdpro_sim.io.lighting import BOUNCE, GAMMA, LightState, ShadowMaps, rig_of, studio_rig
from gdpro_sim.io.preview import Renderer, Studio, frame_camera
from gdpro_sim.io.staging import Staging
from gdpro_sim.simulation.lights import LIGHTS
from gdpro_sim.simulation.scene import check_scene
from tests.io.test_preview import ball

WHITE = (1.0, 1.0, 1.0)


def patch(height: float = 0.0, half: float = 0.5, opacity: float = 0.999) -> Gaussians:
    """A horizontal square of grey Gaussians."""
    steps = torch.linspace(-half, half, 33)
    x, y = torch.meshgrid(steps, steps, indexing="ij")
    n = x.numel()
    means = torch.stack([x.flatten(), y.flatten(), torch.full((n,), height)], 1)
    width = 0.8 * 2 * half / 32
    scales = torch.tensor([[width, width, 1e-3]]).repeat(n, 1)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1)
    return Gaussians(means, quats, scales, torch.full((n,), opacity), torch.zeros((n, 1, 3)))


def shown(g: Gaussians, normals: torch.Tensor, maps: ShadowMaps, which: int) -> np.ndarray:
    """What a Gaussian's colour was multiplied with: light to the power 1 / 2.2, without gloss."""
    behind = torch.tensor([0.0, 0.0, -9.0])  # no highlight there
    return 2.0 * (0.5 + SH_C0 * maps.light(g, normals, behind).sh[which, 0]).numpy()


@pytest.mark.parametrize("elevation", [90.0, 60.0, 30.0])
def test_a_distant_light_follows_lambert_with_its_colour(elevation: float) -> None:
    g = patch()
    normals = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(g), 1)
    e = math.radians(elevation)
    color = np.array([1.0, 0.5, 0.1])
    light = LightState((math.cos(e), 0.0, math.sin(e)), 0.8, (1.0, 0.5, 0.1))
    maps = ShadowMaps(g, rig_of([light], 0.0))
    arriving = 0.8 * color * math.sin(e)
    expected = (arriving + 0.5 * BOUNCE * arriving) ** (1.0 / GAMMA)
    np.testing.assert_allclose(shown(g, normals, maps, len(g) // 2), expected, rtol=1e-4)
    brighter = ShadowMaps(g, rig_of([light], 0.0).exposed(-1.0))
    np.testing.assert_allclose(
        shown(g, normals, brighter, len(g) // 2), expected * 0.5 ** (1.0 / GAMMA), rtol=1e-4
    )
    turned = torch.tensor([[0.0, 0.6, 0.8]]).repeat(len(g), 1)
    expected = (0.8 * arriving + (1.0 - 0.5 * 0.8) * BOUNCE * arriving) ** (1.0 / GAMMA)
    np.testing.assert_allclose(shown(g, turned, maps, len(g) // 2), expected, rtol=1e-4)


def test_lights_add_up_and_what_stands_between_takes_one_away() -> None:
    floor, roof = patch(half=1.0), patch(height=0.5, half=0.3)
    g = Gaussians.concatenate([floor, roof])
    normals = torch.tensor([[0.0, 0.0, 1.0]]).repeat(len(g), 1)
    high = LightState((0.0, 0.0, 1.0), 0.5, (1.0, 0.0, 0.0))
    side = LightState((0.8, 0.0, 0.6), 0.5, (0.0, 0.0, 1.0))
    maps = ShadowMaps(g, rig_of([high, side], 0.0))
    bounce = 0.5 * BOUNCE * np.array([0.5, 0.0, 0.3])
    middle = len(floor) // 2
    under = (np.array([0.0, 0.0, 0.3]) + bounce) ** (1.0 / GAMMA)
    np.testing.assert_allclose(shown(g, normals, maps, middle), under, atol=0.02)
    open_ = (np.array([0.5, 0.0, 0.3]) + bounce) ** (1.0 / GAMMA)
    np.testing.assert_allclose(shown(g, normals, maps, 33 * 16 + 1), open_, atol=0.01)


def test_a_dome_gives_an_open_floor_its_intensity_and_domes_add() -> None:
    rig = rig_of([LightState(None, 0.5, (1.0, 0.5, 0.25)), LightState(None, 0.25, WHITE)], 10.0)
    np.testing.assert_allclose(rig.full, [0.75, 0.5, 0.375])
    np.testing.assert_allclose((rig.weights * rig.directions[:, 2]).sum(), 1.0)
    np.testing.assert_allclose(np.linalg.norm(rig.directions, axis=1), 1.0)


@pytest.mark.parametrize("softness", [0.0, 1.0, 7.0, 40.0])
def test_samples_of_a_light_lie_in_its_disc(softness: float) -> None:
    rig = rig_of([LightState((0.6, 0.0, 0.8), 2.0, WHITE, softness)], 0.0)
    assert rig.weights.sum() == pytest.approx(2.0)
    angles = np.degrees(np.arccos((rig.directions @ [0.6, 0.0, 0.8]).clip(-1, 1)))
    assert angles.max() <= softness + 1e-4 and (softness < 7.0 or angles.max() > 0.8 * softness)
    assert rig.colors.shape == (1, 1), "white light costs one channel"


def test_the_studios_key_light_stands_to_the_left_of_the_camera() -> None:
    rig = studio_rig(30)
    assert rig.full == pytest.approx(1.0, abs=0)
    key = rig.directions[:6].mean(0)
    assert math.degrees(math.atan2(key[1], key[0])) == pytest.approx(30.0 - 48.0, abs=0.5)
    assert (rig.weights * rig.directions[:, 2]).sum() == pytest.approx(1.0)


CAMERA = frame_camera(
    [-0.5, -0.5, 0.0], [0.5, 0.5, 0.7], azimuth=-60, elevation=25, fov=40, width=160, height=120
)


def drawn(studio: Studio, lights: list[LightState] | None = None) -> np.ndarray:
    one, bound = Renderer(CAMERA, studio), ball()
    g, normals = bound.gaussians(), bound.normals()
    return one.render(g, normals, 0, one.shadows(g, 0, lights)).astype(float)


def test_the_set_named_studio_looks_like_the_studio() -> None:
    scene = check_scene({"bodies": [{"asset": "-", "name": "ball"}], "lights": "studio"})
    assert scene.lights == ()
    own = check_scene({"bodies": [{"asset": "-", "name": "ball"}], "lights": LIGHTS["studio"]})
    box = np.zeros(3), np.ones(3)
    staging = Staging(
        {"main": own.camera}, own.lights, *box, np.zeros(1), [("ball", ball())], Studio(azimuth=-60.0)
    )
    shot = staging.next([ball().vertices.numpy()])
    assert not shot.studio
    difference = drawn(Studio(scale=0.4), list(shot.lights)) - drawn(Studio(scale=0.4))
    assert np.abs(difference).mean() < 0.6


def test_coloured_light_colours_the_ball_and_the_shadow() -> None:
    red = LightState((0.5, -0.5, 0.7071), 0.9, (1.0, 0.2, 0.2))
    blue = LightState(None, 0.4, (0.3, 0.4, 1.0))
    picture = drawn(Studio(scale=0.4), [red, blue])
    empty = drawn(Studio(scale=0.4, shading="none"))
    dark = picture.mean(-1) < picture[60:, :30].mean() - 25
    outside = np.abs(empty[..., 0] - empty[..., 2]) < 25
    shadow, floor = picture[dark & outside], picture[100:, :20].reshape(-1, 3)
    assert len(shadow) > 50
    assert (shadow[:, 2] / shadow[:, 0]).mean() > 1.2 * (floor[:, 2] / floor[:, 0]).mean()


def test_a_transparent_picture_over_a_colour_is_the_picture_on_that_colour() -> None:
    for name, value in (("white", 255.0), ("#336699", np.array([0x33, 0x66, 0x99], float))):
        clear = drawn(Studio(scale=0.4, background="transparent"))
        assert clear.shape[-1] == 4
        share = clear[..., 3:] / 255.0
        solid = drawn(Studio(scale=0.4, background=name))
        np.testing.assert_allclose(clear[..., :3] * share + (1.0 - share) * value, solid, atol=2.0)
    assert clear[..., 3].min() == 0.0 and clear[..., 3].max() > 250.0


def test_caught_shadows_lie_where_the_floors_do() -> None:
    clear = drawn(Studio(scale=0.4, background="transparent"))[..., 3]
    caught = drawn(Studio(scale=0.4, background="transparent", catch_shadows=True))
    floor = drawn(Studio(scale=0.4))
    far = ball(height=-100.0)
    empty = Renderer(CAMERA, Studio(scale=0.4)).render(far.gaussians(), far.normals()).astype(float)
    away = clear == 0.0
    dark = ((empty - floor).mean(-1) > 15) & away
    assert dark.sum() > 100
    assert (caught[..., 3][dark] > 8).all(), "opaque where the floor is dark"
    assert (caught[dark][:, :3] == 0).all(), "a shadow is black"
    assert caught[:10, :, 3].max() == 0.0


def test_cameras_in_turn_and_again_give_the_same_bytes() -> None:
    bound = ball()
    g, normals = bound.gaussians(), bound.normals()
    small = {"fov": 30, "width": 64, "height": 48}
    front, other = (
        frame_camera([-1, -1, 0], [1, 1, 1], azimuth=azimuth, elevation=40, **small) for azimuth in (-60, 80)
    )
    fresh = [Renderer(one, Studio(scale=0.4, azimuth=-60.0)).render(g, normals) for one in (front, other)]
    renderer = Renderer(studio=Studio(scale=0.4, azimuth=-60.0))
    for _ in range(3):  # not kept, kept, from what is kept
        maps = renderer.shadows(g, front)
        for one, expected in zip((front, other), fresh, strict=True):
            np.testing.assert_array_equal(renderer.render(g, normals, one, maps), expected)
    for azimuth in range(4):  # cameras that move leave nothing behind
        moved = frame_camera(
            [-1, -1, 0], [1, 1, 1], azimuth=azimuth, elevation=4, fov=30, width=16, height=16
        )
        renderer.render(g, normals, moved, maps)
    assert len(renderer._backdrops) <= 4


def test_passes_hold_distance_direction_and_opacity() -> None:
    bound = ball(radius=0.2, height=0.4)
    eye = np.array([0.0, -3.0, 0.4])
    camera = frame_camera(
        [-1, -1, 0],
        [1, 1, 1],
        azimuth=0,
        elevation=0,
        fov=20,
        width=64,
        height=64,
        eye=eye,
        target=(0, 0, 0.4),
    )
    found = Renderer(camera).passes(bound.gaussians(), bound.normals())
    assert found["alpha"][32, 32] > 0.98 and found["alpha"][2, 2] == 0.0
    assert found["depth"][32, 32] == pytest.approx(2.8, abs=0.02) and found["depth"][2, 2] == 0.0
    np.testing.assert_allclose(found["normal"][32, 32], [0, -1, 0], atol=0.05)
    assert found["normal"][20, 32, 2] > 0.5
    assert all(image.dtype == np.float32 for image in found.values())
