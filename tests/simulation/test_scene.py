"""Scenes: shipped ones load, wrong ones say which file, key and value are wrong and what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from pydantic import BaseModel

from gdpro_sim.cli import main
from gdpro_sim.errors import SceneError
from gdpro_sim.generation import objects
from gdpro_sim.materials import PRESETS, Material
from gdpro_sim.simulation.forces import (
    AirFlow,
    Attachment,
    ConstantForce,
    Pin,
    Push,
    Spring,
    SpringEnd,
    SurfacePressure,
)
from gdpro_sim.simulation.motions import Keyframe
from gdpro_sim.simulation.scene import Scene, check_scene, load_scene, scene_names
from gdpro_sim.simulation.scene_body import SceneBody

MINIMAL = "bodies:\n  - asset: thing.obj\n"


def load_text(tmp_path: Path, text: str) -> Scene:
    path = tmp_path / "scene.yaml"
    path.write_text(text)
    return load_scene(path)


def test_shipped_scenes_load_and_their_assets_exist() -> None:
    assert "jelly_bunny" in scene_names()
    for name in scene_names():
        scene = load_scene(name)
        assert scene.name == name and scene.description
        for body in scene.bodies:
            if body.prompt is None:
                assert scene.resolve(body.asset).is_file(), body.asset
            else:
                assert objects.parse(body.prompt).noun


def test_defaults_and_relative_paths(tmp_path: Path) -> None:
    scene = load_text(tmp_path, MINIMAL)
    assert scene.bodies[0].name == "thing"
    assert scene.resolve("thing.obj") == tmp_path / "thing.obj"
    assert scene.gravity == (0.0, 0.0, -9.81)
    assert scene.frame_count == 91


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("bodies: []", "bodies: must hold at least one item"),
        ("a: [", "not valid YAML at line 1"),
        (MINIMAL + "fps: 24\nfps: 30", "line 4, column 1: the key 'fps' stands there twice"),
        (MINIMAL + "camera: {eye: [1, 1, 1], target: [1, 1, 1]}", "camera: eye and target coincide"),
        ("- 1", "a scene is a mapping"),
        ("", "a scene is a mapping"),
        (
            MINIMAL + "gravty: [0, 0, 0]",
            r"gravty: unknown key \(did you mean `gravity`\?\); allowed: .*ground",
        ),
        (MINIMAL + "    colour: red", r"bodies\[0\].colour: unknown key \(did you mean `color`\?\)"),
        (MINIMAL + "    color: reddish", r"bodies\[0\].color: colour 'reddish' is unknown; write #rrggbb"),
        (MINIMAL + "    size: 20cm", r"bodies\[0\].size: must be a number, got '20cm'"),
        (MINIMAL + "gravity: -9.81", "gravity: must be a list, got -9.81"),
        (MINIMAL + "camera: 3", "camera: must be a mapping of keys to values, got 3"),
        (MINIMAL + "fps: 29.97", "fps: must be a whole number, got a number with"),
        (MINIMAL + "    material: jely", "unknown material 'jely'.*did you mean 'jelly'.*steel"),
        (
            MINIMAL + "    material: {preset: jelly, young: -3}",
            r"bodies\[0\].material.young: .*greater than 0, got -3",
        ),
        (MINIMAL + "    material: {preset: jelly, poisson: 0.5}", "poisson: must be less than 0.5, got 0.5"),
        (MINIMAL + "    material: {preset: jelly, young: .inf}", "young: .*finite"),
        (MINIMAL + "    material: {young: 1.0e5, density: 1}", "material.poisson: is required"),
        (MINIMAL + "    position: [0, 0, .nan]", r"position\[2\]: .*finite"),
        (MINIMAL + "    size: 0", "size: must be greater than 0"),
        (MINIMAL + "  - asset: other/thing.ply", "two bodies are named 'thing'"),
        (MINIMAL + "camera: {width: 33}", "width: must be even"),
        (MINIMAL + "solver: {kind: mpn}", "solver.kind: must be 'fem', 'mpm', 'mujoco', .*got 'mpn'"),
        (MINIMAL + "duration: 0", "duration: must be greater than 0"),
        (MINIMAL + "folder: /", "unknown key `folder`"),
        (MINIMAL + "fps: 0", "fps: must be greater than or equal to 1, got 0"),
        (MINIMAL + "    material: {preset: jelly, density: 0}", "density: must be greater than 0, got 0"),
        (
            MINIMAL + "    pins: {}",
            r"pins\[0\]: give a box \(minimum, maximum\), a sphere .* or vertices to pin",
        ),
        (MINIMAL + "    pins: {side: up}", r"pins\[0\].side: must be 'bottom', 'top', .*, got 'up'"),
        (MINIMAL + "    pins: {sid: top}", r"pins\[0\].sid: unknown key \(did you mean `side`\?\)"),
        (
            MINIMAL + "    pins: {side: top, radius: 1, center: [0, 0, 0]}",
            "give one of box, sphere, side, group, painted and v",
        ),
        (MINIMAL + "    pins: {radius: 1}", "a sphere needs both `center` and `radius`"),
        (MINIMAL + "    pins: {fraction: 0.1, vertices: [1]}", "`fraction` belongs to a `side`"),
        (
            MINIMAL + "    pins: {vertices: [-1]}",
            r"vertices\[0\]: must be greater than or equal to 0, got -1",
        ),
        (
            MINIMAL + "    pins: {minimum: [0, 0, 1], maximum: [1, 1, 0]}",
            r"pins\[0\].maximum: must not lie below minimum \[0.0, 0.0, 1.0\]",
        ),
        (MINIMAL + "    pins: {side: top, pivot: [0, 0, 0]}", "`pivot` belongs to a `motion`"),
        (MINIMAL + "    pins: {side: top, release: 0}", "release: must be greater than 0, got 0"),
        (
            MINIMAL + "    pins: {side: top, motion: [{time: 2}, {time: 1}]}",
            r"motion: keyframes must be in order of time, got 2 s, 1 s",
        ),
        (
            MINIMAL + "    pins: {side: top, motion: {time: 0, translation: [0, 0, 1]}}",
            "motion: the keyframe at time 0 must have no translation",
        ),
        (
            MINIMAL + "    forces: {force: [0, 0, 1], start: 2, end: 1}",
            r"end must be after start \(2 s\), got 1 s",
        ),
        (MINIMAL + "    impulses: {time: 1}", r"impulses\[0\]: give either `impulse` \(N s\) or `velocity`"),
        (MINIMAL + "    pressures: {side: top}", r"pressures\[0\].pressure: is required"),
        (MINIMAL + "wind: {density: 0}", r"wind\[0\].density: must be greater than 0, got 0"),
        (
            MINIMAL + "wind: {bodies: [thin]}",
            r"wind\[0\].bodies: there is no body 'thin' \(did you mean 'thing'\?",
        ),
        (
            MINIMAL + "springs: {ends: [{point: [0, 0, 0]}, {body: rope, vertex: 1}], stiffness: 1}",
            r"springs\[0\].ends\[1\].body: there is no body 'rope'; bodies: thing",
        ),
        (
            MINIMAL + "springs: {ends: [{point: [0, 0, 0]}, {point: [1, 0, 0]}], stiffness: 1}",
            r"springs\[0\]: one of the two ends must be on a body",
        ),
        (
            MINIMAL + "springs: {ends: [{point: [0, 0, 0]}, {body: thing}], stiffness: 1}",
            r"ends\[1\]: give either `point` \(m\) or `vertex`",
        ),
        (
            MINIMAL + "springs: {ends: [{point: [0, 0, 0]}, {vertex: 3}], stiffness: 1}",
            r"ends\[1\]: `vertex` needs a `body`",
        ),
        (MINIMAL + "attachments: {bodies: [thing, thing]}", "an attachment ties two different bodies"),
        (
            MINIMAL + "    impulses: {velocity: [0, 0, 1]}\nsolver: {integrator: quasi-static}",
            r"bodies\[thing\].impulses: have no effect without inertia",
        ),
        (MINIMAL + "solver: {contact_gap: 0}", "contact_gap: must be greater than 0"),
        (MINIMAL + "colliders: {radius: 1}", r"colliders\[0\].kind: is required"),
        (MINIMAL + "colliders: {kind: cube}", r"colliders\[0\].kind: must be 'plane', 'box', .*, got 'cube'"),
        (MINIMAL + "colliders: {kind: sphere}", r"colliders\[0\].radius: is required"),
        (
            MINIMAL + "colliders: [{kind: plane}, {kind: sphere, radius: 1, radios: 1}]",
            r"colliders\[1\].radios: unknown key \(did you mean `radius`\?\)",
        ),
        (
            MINIMAL + "colliders: {kind: plane, motion: {time: 0, rotation: [0, 1, 0]}}",
            r"colliders\[0\].motion: the keyframe at time 0 must have no",
        ),
    ],
)
def test_wrong_scenes_are_refused(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(SceneError, match=expected) as caught:
        load_text(tmp_path, text)
    assert caught.value.exit_code == 2
    assert str(tmp_path / "scene.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


def test_text_in_another_encoding_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_bytes(MINIMAL.encode() + "description: Café".encode("latin-1"))
    with pytest.raises(SceneError, match=r"byte \d+ is not UTF-8; save it as UTF-8 text"):
        load_scene(path)


def test_yaml_and_python_say_the_same(tmp_path: Path) -> None:
    text = """bodies:
  - asset: thing.obj
    pins:
      - side: bottom
        fraction: 0.1
      - {center: [0, 0, 1], radius: 0.2, release: 1.5, motion: {time: 1, rotation: [0, 0, 90]}}
    forces: {force: [0, 0, 10], side: top}
    impulses: {velocity: [1, 0, 0], time: 0.5}
    pressures: {pressure: -500}
  - {asset: thing.obj, name: other}
wind: {velocity: [5, 0, 0]}
springs: {ends: [{body: thing, point: [0, 0, 1]}, {body: other, vertex: 3}], stiffness: 100}
attachments: {bodies: [thing, other]}
"""
    body = SceneBody(
        asset="thing.obj",
        pins=(
            Pin(side="bottom", fraction=0.1),
            Pin(center=(0, 0, 1), radius=0.2, release=1.5, motion=(Keyframe(time=1, rotation=(0, 0, 90)),)),
        ),
        forces=(ConstantForce(force=(0, 0, 10), side="top"),),
        impulses=(Push(velocity=(1, 0, 0), time=0.5),),
        pressures=(SurfacePressure(pressure=-500),),
    )
    scene = Scene(
        name="scene",
        bodies=(body, SceneBody(asset="thing.obj", name="other")),
        wind=(AirFlow(velocity=(5, 0, 0)),),
        springs=(
            Spring(
                ends=(SpringEnd(body="thing", point=(0, 0, 1)), SpringEnd(body="other", vertex=3)),
                stiffness=100,
            ),
        ),
        attachments=(Attachment(bodies=("thing", "other")),),
        folder=tmp_path,
    )
    assert load_text(tmp_path, text) == scene


@pytest.mark.parametrize(
    "options", [AirFlow, Attachment, ConstantForce, Keyframe, Pin, Push, Spring, SpringEnd, SurfacePressure]
)
def test_every_option_is_described(options: type[BaseModel]) -> None:
    assert options.__doc__
    for name, field in options.model_fields.items():
        assert field.description, name


def test_every_wrong_value_is_named(tmp_path: Path) -> None:
    with pytest.raises(SceneError) as caught:
        load_text(tmp_path, MINIMAL + "fps: 0\nduration: -1\n")
    assert len(str(caught.value).splitlines()) == 2


def test_missing_files_and_names() -> None:
    with pytest.raises(SceneError, match="did you mean 'jelly_bunny'"):
        load_scene("jelly_buny")
    with pytest.raises(SceneError, match="no such file"):
        load_scene("/nowhere/scene.yaml")
    for package in ("nosuchpackage", "..", "a.b", ""):
        scene = check_scene({"bodies": [{"asset": f"package:{package}/a.obj"}]})
        with pytest.raises(SceneError, match=f"no installed Python package {package!r}"):
            scene.resolve(scene.bodies[0].asset)


@pytest.mark.parametrize("name", PRESETS)
def test_presets_are_physical(name: str) -> None:
    material = Material.model_validate(name)
    assert material.preset == name
    lam, mu = material.lame
    if material.model != "fluid":
        assert mu == pytest.approx(material.young / (2 * (1 + material.poisson)))
    assert lam + 2 * mu / 3 == pytest.approx(
        material.young / (3 * (1 - 2 * material.poisson))
    )  # bulk modulus


def test_presets_can_be_overridden() -> None:
    material = Material.model_validate({"preset": "rubber", "young": 2e6})
    assert material.young == 2e6 and material.density == PRESETS["rubber"]["density"]


def test_the_reference_is_what_the_command_prints(monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    monkeypatch.setattr("sys.argv", ["gdpro", "scenes", "--reference"])
    with pytest.raises(SystemExit):
        main()
    printed = capsys.readouterr().out
    for key in ("copies", "spacing", "callback", "painted", "friction", "young", "rest_length"):
        assert f"| `{key}` |" in printed, key
    assert "`copied`" not in printed and "`folder`" not in printed
    stored = (Path(__file__).parents[2] / "docs/scenes.md").read_text(encoding="utf-8")
    assert stored == printed, "run: gdpro scenes --reference > docs/scenes.md"


def test_another_seed_draws_other_copies(tmp_path: Path) -> None:
    path = tmp_path / "s.yaml"
    path.write_text(MINIMAL + "    copies: {count: 2, spacing: 1, jitter: {position: 0.2}}\n")
    one, two, again = (load_scene(path, seed=seed).bodies for seed in (1, 2, 1))
    assert one == again and one != two
    assert load_scene(path, seed=2).seed == 2
