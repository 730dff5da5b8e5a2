"""Scenes with a solver for each body: who simulates what, and what is refused before a run."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.compile import check_supported, compile_scene
from gdpro_sim.simulation.compile_coupled import as_part, part_of
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco_model import RigidBody
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import Scene, check_scene
from tests.meshing.shapes import sphere, write_obj

RADIUS = 0.1


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    path = write_obj(tmp_path_factory.mktemp("ball") / "ball.obj", *sphere(2, RADIUS))
    return tetrahedralize_asset(import_mesh(path, budget=400, tets=False), target_tets=200, method="lattice")


def scene_of(*bodies: dict[str, Any], **scene: Any) -> Scene:
    whole = [{"name": f"b{k}", "asset": "ball.obj", "material": "jelly", **b} for k, b in enumerate(bodies)]
    return check_scene({"bodies": whole, "solver": {"kind": "coupled"}, **scene})


def compiled(asset: Asset, *bodies: dict[str, Any], **scene: Any) -> Model:
    made = scene_of(*bodies, **scene)
    return compile_scene(made, {body.name: asset for body in made.bodies})


RIGID = {"mujoco": {"shape": "sphere"}, "position": [0, 0, 0.25]}


@pytest.mark.parametrize(
    ("body", "part"),
    [
        ({}, "fem"),
        ({"material": "steel"}, "mujoco"),
        ({"mujoco": {}}, "mujoco"),
        ({"material": "sand"}, "mpm"),
        ({"particles": 500}, "mpm"),
        ({"solver": "mpm"}, "mpm"),
        ({"solver": "mujoco"}, "mujoco"),
        ({"material": "steel", "solver": "fem"}, "fem"),
    ],
)
def test_each_body_has_its_solver(ball: Asset, body: dict[str, Any], part: str) -> None:
    scene = scene_of(body)
    assert part_of(scene, scene.bodies[0], ball) == part
    if part == "mujoco":
        own = as_part(scene, scene.bodies[0]).mujoco
        assert own is not None and own.form == "rigid"


def test_one_model_of_all_in_the_order_of_the_scene(ball: Asset, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.WARNING):
        model = compiled(
            ball,
            RIGID,
            {"solver": "mpm", "position": [0.5, 0, 0]},
            {},
            {"mujoco": {"shape": "box", "joint": "fixed"}, "position": [-0.5, 0, 0]},
            solver={"kind": "coupled", "step": 0.01, "fem": {"substeps": 8}, "mpm": {"particles": 400}},
            fps=25,
        )
    assert "FEM (b2) and of MPM (b1)" in caplog.text
    coupling = model.coupling
    assert coupling is not None and model.mujoco is not None and model.particles is not None
    assert [body.name for body in model.bodies] == ["b0", "b1", "b2", "b3"]
    assert coupling.places == (("mujoco", 0), ("mpm", 0), ("fem", 0), ("mujoco", 1))
    assert coupling.parts["fem"].fem.substeps == 2  # 8 per frame of 4 steps
    assert np.ptp(model.bodies[2].tet_range) == len(model.tets) and np.ptp(model.bodies[0].tet_range) == 0
    assert np.ptp(model.bodies[1].particle_range) == len(model.particles)
    (link,) = coupling.links
    assert [item.kind for item in link.colliders] == ["sphere"] and link.colliders[0].motion is None
    for part in ("fem", "mpm"):
        assert [item.kind for item in coupling.parts[part].colliders] == ["box"]  # the one that is fixed
    assert not coupling.parts["mujoco"].colliders and not model.colliders
    assert all(isinstance(body, RigidBody) for body in model.mujoco.bodies)


@pytest.mark.parametrize("size", [0.4, 0.02])
def test_tells_of_what_fits_between_vertices(
    ball: Asset, size: float, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        compiled(ball, {**RIGID, "size": size}, {"position": [0.5, 0, 0]})
    told = [line for line in caplog.messages if line.startswith("'b0' (half thickness 0.00")]
    assert len(told) == (size < 0.1)
    if told:  # edges are ten times its half thickness: six times too long
        assert "give 'b1' about 60,000 `tets`" in told[0]


def test_frames_of_a_ball_that_a_jelly_holds_up(ball: Asset) -> None:
    scene = scene_of(
        {**RIGID, "position": [0, 0, 0.2]},
        {"material": {"preset": "jelly", "young": 5e4}},
        duration=0.2, fps=20, solver={"kind": "coupled", "step": 0.01},
    )  # fmt: skip
    simulation = Simulation(scene, {body.name: ball for body in scene.bodies}, device="cpu")
    frames = list(simulation)
    heights = [float(frame.bodies[0].vertices[:, 2].min()) for frame in frames]
    assert len(frames) == 5 and all(frame.diagnostics.converged for frame in frames)
    assert heights[0] == pytest.approx(0.2, abs=1e-3)
    assert heights[-1] > 0.2 - 0.5 * 9.81 * 0.2**2 + 0.1  # it would have fallen through


@pytest.mark.parametrize(
    ("bodies", "scene", "said"),
    [
        ([{"solver": "mpm"}], {"solver": {}}, r"bodies\[b0\].solver: 'mpm' in a scene whose solver is fem"),
        ([{"solver": "fem", "mujoco": {}}], {}, r"bodies\[b0\].mujoco: belongs to .* body's solver is fem"),
        ([{"mujoco": {"form": "full"}}], {}, "bodies of MuJoCo are rigid in a coupled scene"),
        ([RIGID], {"solver": {"kind": "coupled", "fem": {"integrator": "quasi-static"}}}, "have no duration"),
        ([RIGID], {"solver": {"kind": "coupled", "step": 0}}, "solver.step: .*greater than 0"),
        ([RIGID], {"solver": {"kind": "coupled", "stepp": 1}}, r"did you mean `step`\?"),
        ([RIGID], {"solver": {"kind": "coupled", "fem": {"substep": 1}}}, r"did you mean `substeps`\?"),
        (
            [RIGID, {}],
            {"springs": {"ends": [{"body": "b0", "point": [0, 0, 0.3]}, {"body": "b1", "point": [0, 0, 0.1]}],
                         "stiffness": 1}},
            r"springs\[0\]: holds bodies of two solvers together, 'b0' \(mujoco\) and 'b1' \(fem\)",
        ),
        ([RIGID, {"solver": "mpm"}], {"wind": {"velocity": [1, 0, 0]}}, "MPM's know no wind: b1"),
        (
            [RIGID], {"colliders": {"kind": "sphere", "radius": 0.1, "mass": 1.0}},
            r"colliders\[0\].mass: in a coupled scene what moves freely is a body",
        ),
        ([{**RIGID, "pins": {"box": [[-1, -1, 0], [1, 1, 1]]}}], {}, "pins"),
        ([{"material": "sand", "solver": "fem"}], {}, "flows, which FEM cannot simulate"),
        ([{}], {"ground": {"boundary": "sticky"}}, "ground.boundary: 'sticky' belongs to MPM"),
        ([RIGID], {"ground": {"boundary": "sticky"}}, "ground.boundary: 'sticky' is MPM's"),
        (
            [{"solver": "mpm", "copies": {"count": 2, "spacing": 1}}], {"wind": {"bodies": ["b0"]}},
            r"wind\[0\].bodies: .* MPM's know no wind: b0_0, b0_1",
        ),
    ],
)  # fmt: skip
def test_refused_before_a_run(
    ball: Asset, bodies: list[dict[str, Any]], scene: dict[str, Any], said: str
) -> None:
    with pytest.raises(SceneError, match=said) as error:
        check_supported(scene_of(*bodies, **scene))
        compiled(ball, *bodies, **scene)
    assert "\n" not in str(error.value)


def test_forces_find_the_bodies_of_their_part(ball: Asset) -> None:
    copies = {"count": 2, "spacing": 0.3, "poses": None}
    spring = {"ends": [{"body": "b0", "point": [0, 0, 0.1]}, {"point": [0, 0, 1]}], "stiffness": 10}
    bodies: list[dict[str, Any]] = [{"copies": copies}, {**RIGID, "position": [0, 0, 1]}]
    model = compiled(ball, *bodies, springs=spring, wind=[{}, {"bodies": ["b0"]}, {"bodies": ["b1"]}])
    assert model.coupling is not None
    fem, rigid = (model.coupling.parts[part] for part in ("fem", "mujoco"))
    assert fem.springs is not None and len(fem.springs.stiffness) == 2 and rigid.springs is None
    assert len(fem.loads) == 2 and len(rigid.loads) == 2
    assert len(compiled(ball, {}, wind={}).coupling.parts["mujoco"].loads) == 0  # type: ignore[union-attr]


def test_the_ground_may_hold_particles_alone(ball: Asset) -> None:
    model = compiled(
        ball, {"solver": "mpm", "position": [0.5, 0, 0]}, RIGID, ground={"boundary": "sticky"},
        solver={"kind": "coupled", "mpm": {"particles": 400}},
    )  # fmt: skip
    assert model.coupling is not None
    boundaries = {part: item.ground.boundary for part, item in model.coupling.parts.items() if item.ground}
    assert boundaries == {"mpm": "sticky", "mujoco": "separate"}


def test_a_missing_base_is_named(tmp_path: Path) -> None:
    from gdpro_sim.simulation.compile import check_files

    write_obj(tmp_path / "ball.obj", *sphere(0))
    scene = scene_of(RIGID, solver={"kind": "coupled", "mujoco": {"base": "arm.xml"}}, folder=tmp_path)
    with pytest.raises(SceneError, match=r"solver.mujoco.base: .*arm.xml: no such file"):
        check_files(scene)
