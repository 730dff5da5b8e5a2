"""Rigid bodies that pins hold: where they are taken, what they push, and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset
from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.compile import check_supported, compile_scene
from gdpro_sim.simulation.model import Model, Solver
from gdpro_sim.simulation.run import solver_of
from gdpro_sim.simulation.scene import check_scene
from tests.simulation.cubes import SIDE, cube_asset

SLIDE = {"side": "top", "motion": [{"time": 0.5, "translation": [0.3, 0, 0]}]}


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    return cube_asset(tmp_path_factory.mktemp("cube"))


def compiled(asset: Asset, *bodies: dict[str, Any], **scene: Any) -> Model:
    pusher = {"material": "wood", "mujoco": {"shape": "box"}, "position": [-0.2, 0, 0]}
    listed = [{"name": f"b{k}", "asset": "cube.ply", **(pusher if k == 0 else {}), **b} for k, b in
              enumerate(bodies)]  # fmt: skip
    made = check_scene({"name": "s", "bodies": listed, "solver": {"kind": "mujoco"}, **scene})
    check_supported(made)
    return compile_scene(made, {body.name: asset for body in made.bodies})


def run(model: Model, seconds: float) -> Solver:
    solver = solver_of(model)
    for _ in range(round(50 * seconds)):
        solver.step(0.02)
    return solver


def test_a_rigid_body_goes_where_its_pin_takes_it(cube: Asset) -> None:
    turn = {"time": 0.2, "translation": [0, 0, 0.1], "rotation": [0, 0, 60]}
    pin = {"group": "lid", "motion": turn, "pivot": [0, 0, 0]}
    model = compiled(cube, {"pins": pin})
    rest = model.bodies[0].surface.astype(float)
    found = run(model, 0.2).surface_positions(0)
    expected = rest @ Rotation.from_euler("z", 60, degrees=True).as_matrix().T + np.array([0, 0, 0.1])
    np.testing.assert_allclose(found, expected, atol=1e-6)
    still = run(compiled(cube, {"pins": {"side": "top"}, "position": [0, 0, 1]}), 0.1)
    assert still.surface_positions(0)[:, 2].min() == pytest.approx(1.0, abs=1e-6)


@pytest.mark.parametrize(
    ("other", "solver"),
    [
        ({"material": "wood", "mujoco": {"shape": "box"}}, {"kind": "mujoco"}),
        ({"material": "jelly", "solver": "fem"}, {"kind": "coupled", "step": 0.01}),
    ],
)
def test_what_it_meets_does_not_stop_it(cube: Asset, other: dict[str, Any], solver: dict[str, Any]) -> None:
    found = run(compiled(cube, {"pins": SLIDE}, {"position": [0, 0, 0], **other}, solver=solver), 0.5)
    front = found.surface_positions(0)[:, 0].max()
    assert front == pytest.approx(-0.2 + 0.3 + 0.5 * SIDE, abs=1e-4)
    pushed = found.surface_positions(1)
    assert pushed[:, 0].mean() > front + 0.4 * SIDE and pushed[:, 0].min() > front - 0.2 * SIDE
    assert found.diagnostics().momentum[0] > 0.1  # of what is pushed alone: it weighs a million times less


def test_a_soft_body_that_is_tied_to_it_comes_along(cube: Asset) -> None:
    soft = {"material": "jelly", "mujoco": {"form": "full"}, "position": [-0.2, 0, 1.102 * SIDE]}
    ties = {"bodies": ["b1", "b0"], "distance": 0.2 * SIDE}
    model = compiled(cube, {"pins": SLIDE}, soft, attachments=ties, gravity=[0, 0, 0])
    found = run(model, 0.5)
    moved = found.surface_positions(1) - model.bodies[1].surface
    foot = model.bodies[1].surface[:, 2] < model.bodies[1].surface[:, 2].min() + 0.05 * SIDE
    np.testing.assert_allclose(moved[foot].mean(axis=0), [0.3, 0, 0], atol=0.05 * SIDE)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (
            {"pins": SLIDE, "mujoco": {"joint": "fixed"}},
            r"bodies\[b0\].pins: hold all of a rigid body",
        ),
        ({"pins": [SLIDE, {"side": "bottom"}]}, "one holds all of a rigid body; leave out the others"),
        ({"pins": {"side": "top", "release": 1}}, "MuJoCo holds its vertices all the time"),
        ({"pins": {"vertices": [0]}}, "counts vertices of tets"),
        ({"pins": {"group": "ldi"}}, r"no vertex group 'ldi' \(did you mean 'lid'\?\)"),
        (
            {"pins": {"side": "top", "fraction": 1}, "mujoco": {"form": "full"}},
            r"hold every vertex of a full flex, which MuJoCo cannot have; let it be rigid",
        ),
    ],
)
def test_refused(cube: Asset, body: dict[str, Any], said: str) -> None:
    with pytest.raises(SceneError, match=said) as caught:
        compiled(cube, body)
    assert "\n" not in str(caught.value)
