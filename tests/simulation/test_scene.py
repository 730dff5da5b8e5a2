"""Scenes: shipped ones load, wrong ones say which file, key and value are wrong and what is allowed."""

from __future__ import annotations

from pathlib import Path

import pytest

from gdpro_sim.errors import SceneError
from gdpro_sim.generation import objects
from gdpro_sim.materials import PRESETS, Material
from gdpro_sim.simulation.scene import Scene, check_scene, load_scene, scene_names

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
        (MINIMAL + "solver: {kind: mpm}", "solver.kind: must be 'fem'"),
        (MINIMAL + "duration: 0", "duration: must be greater than 0"),
        (MINIMAL + "folder: /", "unknown key `folder`"),
    ],
)
def test_wrong_scenes_are_refused(tmp_path: Path, text: str, expected: str) -> None:
    with pytest.raises(SceneError, match=expected) as caught:
        load_text(tmp_path, text)
    assert caught.value.exit_code == 2
    assert str(tmp_path / "scene.yaml") in str(caught.value)
    assert "\n" not in str(caught.value)


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
    assert mu == pytest.approx(material.young / (2 * (1 + material.poisson)))
    assert lam + 2 * mu / 3 == pytest.approx(
        material.young / (3 * (1 - 2 * material.poisson))
    )  # bulk modulus


def test_presets_can_be_overridden() -> None:
    material = Material.model_validate({"preset": "rubber", "young": 2e6})
    assert material.young == 2e6 and material.density == PRESETS["rubber"]["density"]
