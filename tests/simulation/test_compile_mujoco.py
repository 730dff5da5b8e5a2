"""Scenes for MuJoCo: what is compiled, what is refused, and what plain MuJoCo reads of it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.cli import app
from gdpro_sim.errors import SceneError
from gdpro_sim.simulation import compile_mujoco
from gdpro_sim.simulation.compile import compile_scene
from gdpro_sim.simulation.compile_mujoco import prepare
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco_model import RigidBody, SoftBody
from gdpro_sim.simulation.run import Simulation
from gdpro_sim.simulation.scene import Scene, check_scene
from tests.meshing.shapes import sphere, write_obj

RADIUS, DENSITY = 0.1, 1100.0

PLAIN = """
import sys, mujoco, json
model = mujoco.MjModel.from_xml_path(sys.argv[1]) if sys.argv[1].endswith("xml") else (
    mujoco.MjModel.from_binary_path(sys.argv[1]))
data = mujoco.MjData(model)
mujoco.mj_resetDataKeyframe(model, data, 0)
for _ in range(50):
    mujoco.mj_step(model, data)
assert "gdpro_sim" not in sys.modules
print(json.dumps({"mass": float(model.body_mass.sum()), "warnings": sum(w.number for w in data.warning)}))
"""


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    path = write_obj(tmp_path_factory.mktemp("ball") / "ball.obj", *sphere(3, RADIUS))
    asset = import_mesh(path, budget=2000, tets=False)
    return tetrahedralize_asset(asset, target_tets=600, method="lattice")


def scene_of(*bodies: dict, **scene: object) -> Scene:
    whole = [{"name": f"b{k}", "asset": "ball.usdc", "material": "rubber", **b} for k, b in enumerate(bodies)]
    return check_scene({"bodies": whole, "solver": {"kind": "mujoco"}, **scene})


def compiled(asset: Asset, *bodies: dict, **scene: object) -> Model:
    made = scene_of(*bodies, **scene)
    return compile_scene(made, {body.name: asset for body in made.bodies})


def test_rigid_and_soft_bodies_in_one_scene(ball: Asset) -> None:
    scene = scene_of(
        {"position": [0, 0, 0.1], "mujoco": {"form": "rigid", "shape": "sphere"}},
        {"position": [0.5, 0, 0.1], "rotation": [10, 20, 30], "mujoco": {"form": "rigid", "shape": "hull"}},
        {"position": [1.0, 0, 0.1], "mujoco": {"form": "trilinear", "cells": [2, 2, 2]}},
        {"position": [1.5, 0, 0.1], "mujoco": {"form": "full"}},
        duration=0.5,
    )  # fmt: skip
    simulation = Simulation(scene, {body.name: ball for body in scene.bodies}, device="cpu")
    assert simulation.model.mujoco is not None
    kinds = [type(body) for body in simulation.model.mujoco.bodies]
    assert kinds == [RigidBody, RigidBody, SoftBody, SoftBody]
    frames = list(simulation)
    assert len(frames) == 16
    for body, first, last in zip(scene.bodies, frames[0].bodies, frames[-1].bodies, strict=True):
        assert first.vertices[:, 2].min() == pytest.approx(0.1, abs=1e-4)
        assert -0.01 < last.vertices[:, 2].min() < 0.03, body.name
        np.testing.assert_allclose(
            last.gaussians.means.mean(0).numpy(), last.vertices.mean(0), atol=0.02, err_msg=body.name
        )
    turned = frames[-1].bodies[1].vertices - frames[-1].bodies[1].vertices.mean(0)
    rest = frames[0].bodies[1].vertices - frames[0].bodies[1].vertices.mean(0)
    np.testing.assert_allclose(turned @ turned[0], rest @ rest[0], atol=1e-6)


def test_a_scene_has_a_base_with_actuators(ball: Asset, tmp_path: Path) -> None:
    (tmp_path / "arm.xml").write_text(
        "<mujoco><worldbody><body name='arm' pos='0 0 1'><joint name='turn' axis='0 1 0' damping='1'/>"
        "<geom type='capsule' fromto='0 0 0 .3 0 0' size='.02'/></body></worldbody>"
        "<actuator><position name='turn' joint='turn' kp='100'/></actuator></mujoco>"
    )
    keys = [{"time": 0, "value": 0}, {"time": 0.3, "value": 1}]
    scene = scene_of(
        {"position": [1, 0, 0], "mujoco": {"form": "rigid", "shape": "sphere"}},
        solver={"kind": "mujoco", "base": str(tmp_path / "arm.xml"), "controls": {"turn": keys}},
        duration=1.0,
    )
    assert scene.files[-1].endswith("arm.xml")
    simulation = Simulation(scene, {"b0": ball}, device="cpu")
    assert len(list(simulation)) == 31
    assert float(simulation.solver.mjdata.joint("turn").qpos[0]) == pytest.approx(1.0, abs=0.1)  # type: ignore[attr-defined]


def test_mass_and_inertia_are_the_meshs(ball: Asset) -> None:
    model = compiled(ball, {"size": 0.4, "mujoco": {"form": "rigid", "shape": "box"}})
    assert model.mujoco is not None
    body = model.mujoco.bodies[0]
    assert isinstance(body, RigidBody)
    exact = DENSITY * 4.0 / 3.0 * np.pi * 0.2**3
    assert body.mass == pytest.approx(exact, rel=0.02)
    np.testing.assert_allclose(body.inertia, 0.4 * body.mass * 0.2**2 * np.eye(3), rtol=0.02, atol=1e-3)
    np.testing.assert_allclose(body.centre, [0, 0, 0.2], atol=1e-3)
    assert body.restitution == pytest.approx(0.75)


def test_forms_follow_stiffness_and_shapes_are_made_once(
    ball: Asset, caplog: pytest.LogCaptureFixture
) -> None:
    steel, jelly = scene_of({"material": "steel"}, {"material": "jelly"}).bodies
    made = prepare(steel, ball, lambda phase: None)
    assert made.pieces is not None and len(made.pieces) == 1
    assert prepare(steel, made, lambda phase: None) is made
    assert prepare(jelly, ball, lambda phase: None) is ball


def test_too_many_tets_are_made_fewer_and_it_is_said(
    ball: Asset, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(compile_mujoco, "FULL_TETS", 400)
    (body,) = scene_of({"material": "jelly"}).bodies
    assert ball.tets is not None and len(ball.tets.tets) > 400
    with pytest.raises(SceneError, match="too many for a full flex"):
        compiled(ball, {"material": "jelly"})
    coarser = prepare(body, ball, lambda phase: None)
    assert coarser.tets is not None and len(coarser.tets.tets) < len(ball.tets.tets)
    assert coarser.gaussians is ball.gaussians
    assert "too many" in caplog.text and "its look is as it was" in caplog.text


def test_pieces_are_kept_in_the_file(ball: Asset, tmp_path: Path) -> None:
    made = prepare(scene_of({"material": "steel"}).bodies[0], ball, lambda phase: None)
    made.save(tmp_path / "ball.usdc")
    again = Asset.load(tmp_path / "ball.usdc")
    assert made.pieces is not None and again.pieces is not None
    for key in ("vertices", "faces", "counts"):
        np.testing.assert_array_equal(getattr(again.pieces, key), getattr(made.pieces, key))
    assert again.pieces.concavity == made.pieces.concavity
    assert again.summary()["convex_pieces"] == 1


@pytest.mark.parametrize(
    ("body", "scene", "message"),
    [
        ({"mujoco": {"form": "rigid", "cells": [1, 1, 1]}}, {}, "cells.* belongs to a soft body"),
        ({"mujoco": {"form": "full", "joint": "hinge"}}, {}, "joint.* belongs to a rigid body"),
        ({"mujoco": {"joint": "free", "axis": [0, 0, 1]}}, {}, "axis.* belongs to a joint hinge or slide"),
        ({"mujoco": {"joint": "hinge", "limits": [5, 5]}}, {}, "upper limit must lie above"),
        ({"mujoco": {"joint": "slide", "axis": [0, 0, 1], "limits": [1, 2]}}, {}, "starts at 0, .* 1 to 2"),
        ({"mujoco": {"joint": "fixed"}, "velocity": [1, 0, 0]}, {}, "velocity: the joint 'fixed' does not"),
        ({"mujoco": {"form": "rigid"}}, {"solver": {"kind": "fem"}}, "mujoco: belongs to"),
        ({"mujoco": {"joint": "hinge"}}, {}, "a hinge needs an `axis`"),
        ({"mujoco": {"form": "soft"}}, {}, "must be 'auto', 'rigid', 'full', 'trilinear' or 'quadratic'"),
        ({"particles": 100}, {}, "particles: belongs to MPM"),
        ({}, {"colliders": {"kind": "plane", "motion": {"time": 1}}}, "motion: a plane stands still"),
        (
            {"material": "steel", "mujoco": {"shape": "box"},
             "impulses": {"side": "top", "velocity": [0, 0, 1]}},
            {}, "cannot gain a velocity alone",
        ),
        ({"material": "steel", "mujoco": {"shape": "box"}, "pressures": {"pressure": 5}}, {}, "does nothing"),
        ({"material": "water"}, {}, "flows or tears"),
        ({"material": "jelly", "pins": {"side": "top", "release": 1}}, {}, "leave out `start` and `release`"),
        ({}, {"solver": {"kind": "mujoco", "controls": {"a": []}}}, "at least one keyframe"),
        (
            {},
            {"solver": {"kind": "mujoco", "base": "x.xml",
                        "controls": {"a": [{"time": 1, "value": 0}, {"time": 1, "value": 1}]}}},
            "keyframes must be in order of time",
        ),
        ({}, {"solver": {"kind": "mujoco", "keyframe": "home"}}, "belongs to a `base`"),
        ({}, {"colliders": {"kind": "sphere", "radius": 1, "boundary": "slip"}}, "are MPM's"),
    ],
)  # fmt: skip
def test_what_mujoco_cannot_do_is_said_in_one_line(
    ball: Asset, body: dict, scene: dict, message: str
) -> None:
    with pytest.raises(SceneError, match=message) as error:
        compiled(ball, body, **scene)
    assert "\n" not in str(error.value)


def test_open_meshes_are_weighed_by_their_tets_or_not_at_all(ball: Asset) -> None:
    bound = ball.gaussians
    faces = bound.faces[:-1]
    bound = replace(bound, faces=faces, face_ids=bound.face_ids.clamp(max=len(faces) - 1))
    open_ball = replace(ball, gaussians=bound)
    body = {"mujoco": {"form": "rigid", "shape": "sphere"}}
    model = compiled(open_ball, body)
    assert model.mujoco is not None
    assert model.mujoco.bodies[0].mass == pytest.approx(DENSITY * 4 / 3 * np.pi * 1e-3, rel=0.1)  # type: ignore[union-attr]
    with pytest.raises(SceneError, match="not closed"):
        compiled(replace(open_ball, tets=None, embedding=None), body)


@pytest.mark.parametrize("form", ["rigid", "full", "trilinear"])
def test_plain_mujoco_reads_the_folder(ball: Asset, tmp_path: Path, form: str) -> None:
    ball.save(tmp_path / "ball.usdc")
    target = tmp_path / "model"
    run = CliRunner().invoke(
        app, ["mjcf", str(tmp_path / "ball.usdc"), "-o", str(target), "--form", form, "--json"]
    )
    assert run.exit_code == 0, run.output
    summary = json.loads(run.stdout.splitlines()[-1])
    for file in ("model.xml", "model.mjb"):
        plain = subprocess.run(
            [sys.executable, "-c", PLAIN, str(target / file)], capture_output=True, text=True, cwd=tmp_path
        )
        assert plain.returncode == 0, plain.stderr
        found = json.loads(plain.stdout)
        assert found["mass"] == pytest.approx(summary["mass_kg"], rel=1e-5)
        assert found["warnings"] == 0


def test_the_folder_of_a_coupled_scene_has_its_base(tmp_path: Path) -> None:
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        "bodies: {asset: package:warp/examples/assets/sphere.usd, size: 0.1, position: [0.1, 0, 0.3],\n"
        "  material: wood, mujoco: {shape: sphere}, budget: 500}\n"
        "solver: {kind: coupled, mujoco: {base: package:gdpro_sim.scenes/see_saw.xml}}\n"
    )
    run = CliRunner().invoke(app, ["mjcf", str(scene), "-o", str(tmp_path / "model"), "--json"])
    assert run.exit_code == 0, run.output
    assert json.loads(run.stdout)["degrees_of_freedom"] == 1 + 6  # the plate's hinge, and a free ball
