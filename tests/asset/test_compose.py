"""Composed assets: every part where it should be, nothing lost, and one body where parts overlap."""

from __future__ import annotations

import json
import logging
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from gdpro_sim.asset import Asset, ComposedPart, compose
from gdpro_sim.binding import sh_basis
from gdpro_sim.cameras import Cameras
from gdpro_sim.cli import main
from gdpro_sim.errors import AssetError, SceneError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.compose import load_composition
from gdpro_sim.materials import Material
from gdpro_sim.meshing.convex import ConvexPieces
from gdpro_sim.meshing.repair import signed_volume
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.mujoco_model import RigidBody
from gdpro_sim.simulation.scene import check_scene
from gdpro_sim.splatting import rasterization
from tests.asset.sample import assert_same, make_asset, make_bound, sphere

TURN = (20.0, -35.0, 130.0)


def plain(name: str, **kwargs: Any) -> Asset:
    return replace(make_asset(odd=False, **kwargs), name=name)


def ball(name: str, material: str | None = None) -> Asset:
    """A sphere of radius 1 without tets."""
    preset = None if material is None else Material.model_validate(material)
    return Asset(name=name, gaussians=make_bound(200, degree=0, rings=10), material=preset)


def steel(young: float) -> Material:
    return Material(young=young, poisson=0.3, density=100.0)


def test_one_part_as_it_is_comes_back_bit_for_bit() -> None:
    asset = make_asset(degree=2)
    assert_same(replace(compose([asset], name=asset.name), provenance=asset.provenance), asset)


def test_a_composition_renders_like_its_parts_together() -> None:
    one, other = plain("one", degree=3), plain("other", degree=1)
    whole = compose(
        [one, ComposedPart(other, position=(1.5, 0.4, -0.3), rotation=TURN, scale=0.7)], glue=False
    )
    turn = Rotation.from_euler("xyz", TURN, degrees=True).as_matrix()
    small = other.gaussians.scaled(0.7)
    moved = (small.vertices.double().numpy() @ turn.T + [1.5, 0.4, -0.3]).astype(np.float32)
    apart = Gaussians.concatenate([one.gaussians.gaussians(), small.gaussians(torch.from_numpy(moved))])
    cameras = Cameras.look_at([(4.0, -5.0, 3.0)], (0.7, 0.0, 0.0), vertical_fov=0.7, width=64, height=48)

    def picture(g: Gaussians) -> torch.Tensor:
        inputs = (g.means, g.quats, g.scales, g.opacities, g.sh, cameras.viewmats, cameras.Ks)
        return rasterization(*inputs, cameras.width, cameras.height, sh_degree=g.sh_degree)[0]

    together = picture(whole.gaussians.gaussians())
    assert float(together.std()) > 0.05
    assert torch.allclose(together, picture(apart), atol=1e-5)


def test_colours_turn_with_their_part() -> None:
    asset = plain("one", degree=3)
    whole = compose([ComposedPart(asset, rotation=TURN)])
    turn = Rotation.from_euler("xyz", TURN, degrees=True).as_matrix()
    seen = np.random.default_rng(0).normal(size=(20, 3))
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    before = np.einsum("dk,nkc->ndc", sh_basis(3, seen), asset.gaussians.sh.numpy())
    after = np.einsum("dk,nkc->ndc", sh_basis(3, seen @ turn.T), whole.gaussians.sh.numpy())
    assert np.allclose(after, before, atol=2e-5)


def test_everything_of_every_part_is_kept(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    pieces = ConvexPieces(*(np.asarray(a) for a in sphere(4)), np.array([[26, 48]], np.int32), 0.2)
    pieces = replace(pieces, counts=np.array([[len(pieces.vertices), len(pieces.faces)]], np.int32))
    one = replace(plain("ball", degree=1), pieces=pieces, provenance={"license": "CC0"})
    inner = {"tip": np.array([0, 3], np.int32)}
    other = replace(
        plain("ball", degree=0), vertex_colors=None, pieces=pieces, groups=inner,
        group_materials={"tip": steel(5.0)}, material=steel(7.0),
    )  # fmt: skip
    count = len(one.gaussians.vertices)
    with caplog.at_level(logging.WARNING):
        whole = compose([one, ComposedPart(other, position=(3.0, 0.0, 0.0), size=1.0)], glue=False)
    assert "part 1 is named 'ball' like an earlier one; it becomes 'ball_2'" in caplog.text

    whole.save(tmp_path / "whole.usdc")
    assert_same(Asset.load(tmp_path / "whole.usdc"), whole)
    loaded = Asset.load(tmp_path / "whole.usdc")
    assert {k: v.tolist() for k, v in loaded.groups.items()} == {
        "ball": list(range(count)), "ball_2": list(range(count, 2 * count)),
        "ball_2_tip": [count, count + 3],
    }  # fmt: skip
    assert loaded.group_materials == {"ball_2": steel(7.0), "ball_2_tip": steel(5.0)}
    assert loaded.pieces is not None and len(loaded.pieces) == 2
    assert np.allclose(loaded.pieces.vertices[len(pieces.vertices) :].mean(0), [3.0, 0.0, 0.0], atol=1e-3)
    listed = loaded.provenance["composed_of"]
    assert [part["sha256"] for part in listed] == [one.digest, other.digest]
    assert loaded.provenance["licenses"] == ["CC0", "not stated"]
    assert listed[1]["scale"] == pytest.approx(0.5, rel=1e-6)
    assert whole.gaussians.sh.shape[1] == 4, "the lower degree is filled up"
    assert not whole.gaussians.sh[200:, 1:].any()
    assert whole.vertex_colors is not None and np.ptp(whole.vertex_colors[count:], axis=0).max() == 0.0

    assert whole.tets is not None and one.tets is not None and whole.embedding is not None
    assert float(whole.tets.volumes().sum()) == pytest.approx(
        1.125 * float(one.tets.volumes().sum()), rel=1e-5
    )
    corners = whole.tets.vertices[whole.tets.tets[whole.embedding.tet_ids]]
    again = np.einsum("vw,vwc->vc", whole.embedding.weights, corners)
    assert one.embedding is not None
    first = np.einsum(
        "vw,vwc->vc", one.embedding.weights, one.tets.vertices[one.tets.tets[one.embedding.tet_ids]]
    )
    assert np.allclose(again[:count], first) and np.allclose(
        again[count:], 0.5 * first + [3.0, 0, 0], atol=1e-5
    )


def test_licences_of_what_a_part_is_made_of() -> None:
    words = {"guidance": {"kind": "procedural"}, "prior": {"kind": "procedural"}}
    scanned = {**words, "prior": {"kind": "mesh"}}
    made = [replace(ball(f"b{k}"), provenance=found) for k, found in enumerate(
        (words, scanned, {"license": "CC0"}))]  # fmt: skip
    inner = compose(made[1:], target_tets=0)
    assert inner.provenance["licenses"] == ["CC0", "not stated"]
    whole = compose([made[0], inner], target_tets=0)
    assert whole.provenance["licenses"] == [
        "CC0", "none: made from words by the built-in generator", "not stated"
    ]  # fmt: skip
    assert whole.provenance["composed_of"][1]["license"] == "CC0, not stated"


def test_tets_are_dropped_where_a_part_has_none(caplog: pytest.LogCaptureFixture) -> None:
    whole = compose([plain("one"), ball("bare")], glue=False)
    assert whole.tets is None and "tets dropped, because part 'bare' has none" in caplog.text


def test_overlapping_parts_become_one_body_of_two_materials(caplog: pytest.LogCaptureFixture) -> None:
    whole = compose(
        [ball("low", "jelly"), ComposedPart(ball("high", "rubber"), position=(0.0, 0.0, 1.5), scale=0.8),
         ComposedPart(ball("far"), position=(9.0, 0.0, 0.0))],
        target_tets=600,
    )  # fmt: skip
    assert "part 'far' does not touch the rest" in caplog.text and "high" not in caplog.text
    assert whole.tets is not None and whole.embedding is not None
    # Two caps: Weisstein, "Sphere-Sphere Intersection", MathWorld.
    r, s, d = 1.0, 0.8, 1.5
    lens = math.pi * (r + s - d) ** 2 * (d**2 + 2 * d * (r + s) - 3 * (r - s) ** 2) / (12 * d)
    union = 4.0 / 3.0 * math.pi * (2.0 + 0.8**3) - lens
    flat = signed_volume(*sphere(10)) / (4.0 / 3.0 * math.pi)  # of the balls' polyhedra
    assert float(whole.tets.volumes().sum()) == pytest.approx(flat * union, rel=0.05)
    corners = whole.tets.vertices[whole.tets.tets[whole.embedding.tet_ids]]
    again = np.einsum("vw,vwc->vc", whole.embedding.weights, corners)
    assert np.allclose(again, whole.gaussians.vertices.numpy(), atol=1e-4), "buried vertices as well"

    scene: dict[str, Any] = {"bodies": [{"name": "man", "asset": "x", "anchor": "origin"}], "ground": None}
    jelly, rubber = (np.float32(Material.model_validate(name).young) for name in ("jelly", "rubber"))

    def off(points: np.ndarray) -> np.ndarray:
        """Distance from the middle of the high ball, of radius 0.8."""
        return np.linalg.norm(points - [0.0, 0.0, 1.5], axis=1)

    fem = compile_scene(check_scene(scene), {"man": whole})
    apart = off(fem.vertices[fem.tets].mean(axis=1))
    assert (fem.young[apart < 0.7] == rubber).all() and (apart < 0.7).sum() > 10
    assert (fem.young[apart > 0.9] == jelly).all(), "also near the part of its shell that is buried"
    mpm = compile_scene(check_scene({**scene, "solver": {"kind": "mpm", "particles": 600}}), {"man": whole})
    assert mpm.particles is not None
    young = np.array([m.young for m in mpm.particles.materials], np.float32)[mpm.particles.matter]
    apart = off(mpm.particles.positions)
    assert (young[apart < 0.7] == rubber).all() and (young[apart > 0.9] == jelly).all()
    scene["bodies"][0]["mujoco"] = {"form": "rigid", "shape": "sphere"}
    rigid = compile_scene(check_scene({**scene, "solver": {"kind": "mujoco"}}), {"man": whole}).mujoco
    assert rigid is not None and isinstance(rigid.bodies[0], RigidBody)
    mass = float(whole.tets.volumes().sum()) * Material.model_validate("jelly").density
    assert rigid.bodies[0].mass == pytest.approx(mass, rel=1e-6), "what overlaps weighs once"


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"scale": 0.0}, "part 'one': scale must be a finite number > 0, got 0.0; turn it with rotation"),
        ({"scale": -1.0}, "got -1.0"),
        ({"size": -0.5}, "size must be a finite number > 0 m, got -0.5"),
        ({"size": 1.0, "scale": 2.0}, "either scale or size"),
        ({"position": (0.0, math.nan, 0.0)}, "position must be three finite numbers"),
        ({"rotation": (0.0, 1.0)}, "rotation must be three finite numbers"),
        ({"anchor": "middle"}, "anchor must be one of bottom, center, origin, got 'middle'"),
    ],
)
def test_wrong_parts_are_refused(part: dict[str, Any], message: str) -> None:
    with pytest.raises(AssetError, match=message.replace("(", r"\(")):
        compose([ComposedPart(ball("one"), **part)])


def test_no_parts_and_damaged_groups_are_refused() -> None:
    with pytest.raises(AssetError, match="has no parts"):
        compose([])
    for groups, materials, message in (
        ({"g": np.array([3, 1], np.int32)}, {}, "ascending"),
        ({"g": np.array([10**6], np.int32)}, {}, "vertices"),
        ({}, {"g": steel(1.0)}, "which is no group"),
    ):
        with pytest.raises(AssetError, match=message):
            replace(ball("one"), groups=groups, group_materials=materials)


def test_compositions_are_written_in_yaml_and_on_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    ball("ball").save(tmp_path / "ball.usdc")
    (tmp_path / "man.yaml").write_text(
        "parts:\n  - {asset: ball.usdc, anchor: bottom}\n"
        "  - {asset: ball.usdc, name: head, size: 1, anchor: bottom, position: [0, 0, 1.8], material: wood}\n"
        "tets: 0\n"
    )
    monkeypatch.chdir(tmp_path)

    def gdpro(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["gdpro", *arguments])
        with pytest.raises(SystemExit) as stopped:
            main()
        done = capsys.readouterr()
        return int(stopped.value.code or 0), done.out, done.err

    code, said, _ = gdpro("compose", "man.yaml", "-o", "a.usdc", "--json")
    assert code == 0 and json.loads(said)["groups"] == {"ball": 182, "head": 182}
    parts = ["--part", "ball.usdc anchor=bottom"]
    parts += [
        "--part",
        "ball.usdc name=head size=1 anchor=bottom position=0,0,1.8 material=wood license='CC BY 4.0'",
    ]
    assert gdpro("compose", *parts, "-o", "b.usdc", "--tets", "0", "-q")[0] == 0
    one, other = Asset.load("a.usdc"), Asset.load("b.usdc")
    assert torch.equal(one.gaussians.vertices, other.gaussians.vertices)
    assert one.summary()["bounds_max"][2] == pytest.approx(2.8, rel=1e-6)
    assert other.group_materials["head"].preset == "wood"
    assert other.provenance["licenses"] == ["CC BY 4.0", "not stated"]
    for arguments, expected in (
        (["-o", "x.usdc"], "either a composition file or --part"),
        (["missing.yaml", "-o", "x.usdc"], "missing.yaml: no such file"),
        (["man.yaml", "-o", "x.txt"], "must end in .usdc"),
        (["--part", "none.usdc", "-o", "x.usdc"], "none.usdc: no such file"),
        (["--part", "ball.usdc scale=-2", "-o", "x.usdc"], "--part: parts[0].scale"),
        (["--part", "ball.usdc position=1,2", "-o", "x.usdc"], "parts[0].position"),
        (["--part", "ball.usdc sise=2", "-o", "x.usdc"], "did you mean `size`"),
        (["--part", "ball.usdc 2", "-o", "x.usdc"], "must be KEY=VALUE"),
    ):
        code, _, errors = gdpro("compose", *arguments)
        assert code == 2 and expected in errors, (arguments, errors)
    (tmp_path / "bad.yaml").write_text("[1]")
    with pytest.raises(SceneError, match="a composition is a mapping"):
        load_composition(tmp_path / "bad.yaml")


def test_a_scene_material_is_that_of_the_whole_composition(tmp_path: Path) -> None:
    compose([ball("a", "jelly"), ball("b", "rubber")], target_tets=0).save(tmp_path / "two.usdc")
    scene = check_scene(
        {"bodies": [{"asset": str(tmp_path / "two.usdc"), "material": "wood"}], "solver": {"kind": "mpm"}}
    )
    loaded = load_assets(scene)["two"]
    assert loaded.material is not None and loaded.material.preset == "wood" and not loaded.group_materials
