"""Scene -> Model: bodies stand where the scene says, whatever their tets are made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.cli import main
from gdpro_sim.errors import AssetError, SceneError
from gdpro_sim.materials import LAWS
from gdpro_sim.simulation.compile import check_files, compile_scene, load_assets
from gdpro_sim.simulation.conditions import Force, Impulse, Pressure, Wind
from gdpro_sim.simulation.fem import SolverFEM
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.scene import check_scene


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A sphere of radius 0.1 m, filled with a lattice; its upper half has four times as many triangles."""
    path = tmp_path_factory.mktemp("ball") / "ball.ply"
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    upper = np.flatnonzero(mesh.triangles_center[:, 2] > 0)
    mesh.subdivide(face_index=upper).export(path)
    asset = import_mesh(path, budget=2000, tets=False)
    return tetrahedralize_asset(asset, target_tets=3000, method="lattice")


def compiled(asset: Asset, **body: object) -> Model:
    scene = {"bodies": [{"name": "ball", "asset": "ball.usdc", **body}], "gravity": [0, 0, -9.81]}
    return compile_scene(check_scene(scene), {"ball": asset})


def test_a_lattice_body_stands_on_its_surface_not_on_its_lattice(ball: Asset) -> None:
    model = compiled(ball, material="rubber")
    assert model.vertices[:, 2].min() < -1e-4, "lattice nodes reach below the ground"
    solver = SolverFEM(model)
    assert solver.diagnostics().contact_energy == 0.0
    highest = 0.0
    for _ in range(20):
        solver.step(1 / 60)
        highest = max(highest, float(solver.surface_positions(0)[:, 2].min()))
    assert highest < 1e-3, "it does not hop"
    assert abs(float(solver.surface_positions(0)[:, 2].min())) < 2e-3, "it neither hovers nor sinks"


def test_a_spinning_body_stays_where_it_is(ball: Asset) -> None:
    model = compiled(ball, position=[0, 0, 1], angular_velocity=[0, 10, 0], material="rubber")
    diagnostics = SolverFEM(model).diagnostics()
    assert ball.tets is not None
    mass = 1100.0 * float((ball.tets.volumes() * ball.tets.fill).sum())
    assert np.linalg.norm(diagnostics.momentum) / mass < 1e-4
    assert diagnostics.angular_momentum[1] == pytest.approx(0.4 * mass * 0.1**2 * 10, rel=0.15)


def test_placement(ball: Asset) -> None:
    turned = compiled(ball, size=0.5, position=[1, 2, 3], rotation=[30, 40, 50])
    surface = turned.bodies[0].surface
    middle = 0.5 * (surface.min(0) + surface.max(0))
    np.testing.assert_allclose([middle[0], middle[1], surface[:, 2].min()], [1, 2, 3], atol=1e-5)
    centred = compiled(ball, anchor="center", position=[0, 0, 2]).bodies[0].surface
    np.testing.assert_allclose(0.5 * (centred.min(0) + centred.max(0)), [0, 0, 2], atol=1e-6)


@pytest.mark.parametrize(
    ("scene", "message"),
    [
        ({"solver": {"kind": "mpm"}, "wind": {}}, "wind: the MPM solver has none"),
        ({"solver": {"kind": "mpm"}, "body": {"pressures": {"pressure": 1}}}, "pressures: the MPM solver"),
        ({"body": {"material": "sand"}}, "flows, which FEM cannot simulate"),
        ({"body": {"particles": 9}}, "`particles` belongs to MPM"),
        ({"body": {"pins": {"side": "top", "start": 1}}}, r"pins\[0\].start: belongs to MPM"),
        ({"ground": {"boundary": "slip"}}, "ground.boundary: 'slip' belongs to MPM"),
        ({"colliders": {"kind": "sphere", "radius": 1, "mass": 1}}, r"colliders\[0\].mass: belongs to MPM"),
        (
            {"colliders": {"kind": "sphere", "radius": 1, "end": 1}, "solver": {"kind": "animation"}},
            r"colliders\[0\].end: has no effect without physics",
        ),
        (
            {"solver": {"kind": "mujoco"}, "body": {"pins": {"side": "top", "release": 1}}},
            "leave out `start`",
        ),
    ],
)
def test_what_a_solver_cannot_do_is_said_before_assets_are_made(
    tmp_path: Path, scene: dict, message: str
) -> None:
    (tmp_path / "broken.obj").write_text("nothing that could be imported")
    body = {"asset": "broken.obj", **scene.pop("body", {})}
    with pytest.raises(SceneError, match=message):
        load_assets(check_scene({"bodies": [body], "folder": tmp_path, **scene}))


def test_wrong_placements_are_refused(ball: Asset) -> None:
    with pytest.raises(SceneError, match=r"starts 0\.1 m below the ground"):
        compiled(ball, position=[0, 0, -0.1])
    with pytest.raises(SceneError, match=r"pins\[0\]: the box holds no vertex; the body spans"):
        compiled(ball, pins={"minimum": [5, 5, 5]})
    with pytest.raises(SceneError, match="no tetrahedra"):
        compiled(replace(ball, tets=None, embedding=None))


def test_wrong_elements_are_refused(ball: Asset) -> None:
    assert ball.tets is not None
    tets = ball.tets.tets.copy()
    tets[7] = tets[7][[1, 0, 2, 3]]
    with pytest.raises(AssetError, match=r"asset 'ball': tet 7 has volume -.* must be > 0"):
        replace(ball, tets=replace(ball.tets, tets=tets))
    flat = ball.tets.vertices.copy()
    flat[tets[7][0]] = flat[tets[7][1]]
    with pytest.raises(AssetError, match=r"has volume .*, must be > 0"):
        replace(ball, tets=replace(ball.tets, vertices=flat))
    with pytest.raises(AssetError, match="the tet mesh is empty"):
        replace(ball, tets=replace(ball.tets, tets=tets[:0], fill=ball.tets.fill[:0]))
    lone = np.concatenate([ball.tets.vertices, np.zeros((2, 3), np.float32)])
    with pytest.raises(SceneError, match=rf"vertex {len(lone) - 2} belongs to no tetrahedron \(2 such\)"):
        compiled(replace(ball, tets=replace(ball.tets, vertices=lone)))


def test_pins_are_joined(ball: Asset) -> None:
    pins = [
        {"side": "bottom", "fraction": 0.2},
        {"center": [0, 0, 0.2], "radius": 0.05, "release": 1.0},
        {"minimum": [0.08, -1, -1]},
        {"vertices": [3, 5]},
    ]
    model = compiled(ball, pins=pins)
    x = model.vertices.astype(float)
    height = np.ptp(x[:, 2])
    top = np.linalg.norm(x - [0, 0, 0.2], axis=1) <= 0.05
    wanted = (x[:, 2] <= x[:, 2].min() + 0.2 * height) | top | (x[:, 0] >= 0.08)
    wanted[[3, 5]] = True
    np.testing.assert_array_equal(model.pinned, wanted)
    assert model.release is not None
    np.testing.assert_array_equal(np.isfinite(model.release), top)
    assert not model.motions


def test_pins_that_contradict_each_other_are_refused(ball: Asset) -> None:
    up = [{"time": 1.0, "translation": [0, 0, 1]}]
    turn = [{"time": 1.0, "rotation": [0, 0, 90]}]
    for first, second in (({}, {"motion": up}), ({"release": 1.0}, {}), ({"motion": turn}, {"motion": turn})):
        pins = [{"side": "top", "fraction": 0.3, **first}, {"side": "right", "fraction": 0.3, **second}]
        with pytest.raises(
            SceneError, match=r"bodies\[ball\]: pins\[0\] and pins\[1\] both hold vertex \d+ at"
        ):
            compiled(ball, pins=pins)
    pins = [{"side": side, "fraction": 0.3, "motion": up} for side in ("top", "right")]
    model = compiled(ball, pins=pins)
    assert sum(len(motion.vertices) for motion in model.motions) == model.pinned.sum()
    np.testing.assert_array_equal(model.motions[0].times, [0.0, 1.0])


def test_wrong_regions_are_refused(ball: Asset) -> None:
    assert ball.tets is not None
    count = len(ball.tets.vertices)
    with pytest.raises(SceneError, match=rf"pins\[1\].vertices: no vertex {count}; the body has {count}"):
        compiled(ball, pins=[{"side": "top"}, {"vertices": [0, count]}])
    with pytest.raises(SceneError, match=r"forces\[0\]: the sphere of 0.1 m at .* holds no vertex"):
        compiled(ball, forces={"force": [0, 0, 1], "center": [0, 0, 3], "radius": 0.1})
    with pytest.raises(SceneError, match=r"pressures\[0\]: the list of vertices holds no whole triangle"):
        compiled(ball, pressures={"pressure": 1, "vertices": [0]})


def test_loads_sum_to_what_is_said(ball: Asset) -> None:
    model = compiled(
        ball,
        forces={"force": [1, 2, 3], "side": "top", "fraction": 0.3, "end": 2},
        impulses=[{"impulse": [0, 0, 4], "time": 0.5}, {"velocity": [0, 2, 0]}],
        pressures=[{"pressure": 5}, {"pressure": 6, "side": "top", "fraction": 0.5}],
    )
    force, push, kick, closed, part = model.loads
    assert isinstance(force, Force) and isinstance(push, Impulse) and isinstance(kick, Impulse)
    np.testing.assert_allclose(force.forces.sum(0), [1, 2, 3])
    assert force.end == 2.0 and 0 < len(force.vertices) < len(model.vertices)
    np.testing.assert_allclose(push.impulses.sum(0), [0, 0, 4])
    corners = model.vertices.astype(float)[model.tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    mass = (volume * model.fill * model.density).sum()
    np.testing.assert_allclose(kick.impulses.sum(0), [0, 2 * mass, 0], rtol=1e-6)
    assert isinstance(closed, Pressure) and isinstance(part, Pressure)
    assert closed.closed and not part.closed and len(part.faces) < len(closed.faces)


def two_balls(asset: Asset, gap: float = 0.002, **scene: object) -> Model:
    bodies = [
        {"name": "lower", "asset": "ball.usdc", "position": [0, 0, 0]},
        {"name": "upper", "asset": "ball.usdc", "position": [0, 0, 0.2 + gap]},
    ]
    data = {"bodies": bodies, "gravity": [0, 0, -9.81], **scene}
    return compile_scene(check_scene(data), {"lower": asset, "upper": asset})


def test_springs_hold_points(ball: Asset) -> None:
    point, far = [0.03, 0.01, 0.1], [0.0, 0.0, 1.0]
    ends = [{"body": "upper", "point": [0.03, 0.01, 0.302]}, {"body": "lower", "vertex": 4}]
    springs = [
        {"ends": [{"body": "lower", "point": point}, {"point": far}], "stiffness": 10},
        {"ends": ends, "stiffness": 20, "rest_length": 0, "damping": 3},
    ]
    model = two_balls(ball, springs=springs)
    found = model.springs
    assert found is not None
    x = model.vertices.astype(float)
    places = np.einsum("sea,seai->sei", found.weights, x[found.corners]) + found.anchors
    np.testing.assert_allclose(places[0], [point, far], atol=1e-6)
    np.testing.assert_allclose(places[1], [[0.03, 0.01, 0.302], x[4]], atol=1e-6)
    np.testing.assert_allclose(found.rest_length, [np.linalg.norm(np.subtract(point, far)), 0.0], atol=1e-6)
    with pytest.raises(SceneError, match=r"springs\[0\].ends\[0\].point: lies .* m outside 'lower'"):
        two_balls(ball, springs={"ends": [{"body": "lower", "point": far}, {"point": far}], "stiffness": 1})
    with pytest.raises(SceneError, match=r"ends\[0\].vertex: no vertex 99999; 'lower' has"):
        two_balls(
            ball, springs={"ends": [{"body": "lower", "vertex": 99999}, {"point": far}], "stiffness": 1}
        )


def test_attachments_start_at_rest(ball: Asset) -> None:
    model = two_balls(ball, attachments={"bodies": ["upper", "lower"], "distance": 0.02, "stiffness": 500})
    ties = model.springs
    assert ties is not None and len(ties.stiffness) > 3
    x = model.vertices.astype(float)
    places = np.einsum("sea,seai->sei", ties.weights, x[ties.corners])
    np.testing.assert_allclose(places[:, 0], places[:, 1], atol=1e-6)
    assert ties.stiffness.sum() == pytest.approx(500.0)
    elastic = two_balls(ball, attachments={"bodies": ["upper", "lower"], "distance": 0.02}).springs
    assert elastic is not None and (elastic.stiffness > 0.0).all()
    with pytest.raises(
        SceneError, match=r"attachments\[0\]: no chosen vertex .* the nearest is 0\.\d+ m away"
    ):
        two_balls(ball, gap=0.5, attachments={"bodies": ["upper", "lower"]})


def test_attached_bodies_hang_together(ball: Asset) -> None:
    """The ties give by weight / stiffness."""
    bodies = [
        {"name": "lower", "asset": "ball.usdc", "position": [0, 0, 0.1], "material": "rubber"},
        {
            "name": "upper",
            "asset": "ball.usdc",
            "position": [0, 0, 0.302],
            "material": "rubber",
            "pins": {"side": "top"},
        },
    ]
    ties = {"bodies": ["upper", "lower"], "distance": 0.02, "stiffness": 5000}
    solver = {"integrator": "quasi-static", "body_contact": False}
    scene = check_scene({"bodies": bodies, "attachments": ties, "ground": None, "solver": solver})
    model = compile_scene(scene, {"lower": ball, "upper": ball})
    fem = SolverFEM(model)
    fem.step(0.1)
    assert fem.diagnostics().converged
    found = model.springs
    assert found is not None
    opening = np.einsum("sea,seai->sei", found.weights, fem.positions[found.corners])
    assert ball.tets is not None
    weight = 9.81 * 1100.0 * float((ball.tets.volumes() * ball.tets.fill).sum())
    gap = (opening[:, 0] - opening[:, 1]).mean(0)
    np.testing.assert_allclose(gap, [0, 0, weight / 5000.0], atol=1e-3 * weight / 5000.0)


def test_wind_blows_on_the_named_bodies(ball: Asset) -> None:
    model = two_balls(ball, wind=[{"velocity": [1, 0, 0]}, {"bodies": ["upper"], "start": 1, "end": 2}])
    both, upper = model.loads
    assert isinstance(both, Wind) and isinstance(upper, Wind)
    assert len(both.faces) == 2 * len(upper.faces)
    assert upper.faces.min() >= model.bodies[1].vertex_range[0]


def test_a_collider_inside_a_body_is_refused(ball: Asset) -> None:
    body = {"name": "ball", "asset": "ball.ply", "position": [0, 0, 0.5]}
    middle = [0.0, 0.0, 0.5 + 0.5 * float(np.ptp(ball.tets.vertices[:, 2]))]  # type: ignore[union-attr]
    for height, refused in ((0.0, True), (2.0, False)):
        at = [middle[0], middle[1], middle[2] + height]
        scene = check_scene({"bodies": body, "colliders": {"kind": "sphere", "radius": 0.02, "position": at}})
        if refused:
            with pytest.raises(SceneError, match="'sphere' starts inside body 'ball'"):
                compile_scene(scene, {"ball": ball})
        else:
            assert len(compile_scene(scene, {"ball": ball}).colliders) == 1


def test_colliders_are_compiled(ball: Asset, tmp_path: Path) -> None:
    """A ball that comes to rest in a bowl made of a tilted box and a mesh, and one that is pushed."""
    trimesh.creation.box((1.0, 1.0, 0.1)).export(tmp_path / "plate.ply")
    plate = {"kind": "mesh", "file": "plate.ply", "position": [0, 0, 0.1], "up": "z"}
    ram = {
        "kind": "box",
        "size": [0.1, 0.5, 0.5],
        "position": [-0.2, 0, 0.3],
        "motion": {"time": 0.5, "translation": [0.2, 0, 0]},
    }
    body = {"name": "ball", "asset": "ball.usdc", "position": [0, 0, 0.16], "material": "rubber"}
    data = {"bodies": [body], "colliders": [plate, ram], "folder": tmp_path}
    model = compile_scene(check_scene(data), {"ball": ball})
    assert [collider.kind for collider in model.colliders] == ["mesh", "box"]
    solver = SolverFEM(model)
    for _ in range(30):
        solver.step(1 / 60)
    surface = solver.surface_positions(0)
    assert surface[:, 0].min() == pytest.approx(0.05, abs=0.05), "pushed aside"
    assert surface[:, 2].min() == pytest.approx(0.15, abs=0.01), "carried by the plate"
    missing = check_scene({**data, "colliders": {**plate, "file": "none.ply"}})
    with pytest.raises(SceneError, match=r"colliders\[0\].file: .*none.ply: no such file"):
        check_files(missing.model_copy(update={"bodies": ()}))


def test_laws_and_yield_stress_are_compiled(ball: Asset) -> None:
    model = compiled(ball, material={"preset": "aluminium", "yield_stress": 2e8, "hardening": 1e9})
    assert model.law is not None and model.yield_stress is not None and model.hardening is not None
    assert set(model.law.tolist()) == {LAWS.index("stvk_hencky")}
    np.testing.assert_allclose([model.yield_stress[0], model.hardening[0]], [2e8, 1e9])
    elastic = compiled(ball, material={"preset": "jelly", "model": "corotated"})
    assert elastic.law is not None and elastic.yield_stress is not None
    assert set(elastic.law.tolist()) == {LAWS.index("corotated")} and np.isinf(elastic.yield_stress).all()


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("pins: {side: top, motion: [{time: 1}, {time: 0.5}]}", "keyframes must be in order of time"),
        ("pins: {minimum: [5, 5, 5]}", "pins[0]: the box holds no vertex"),
        (
            "pins: [{side: top}, {side: top, release: 0.1}]",
            "pins[0] and pins[1] both hold vertex",
        ),
        ("material: {young: 1.0e5, poisson: 0.5, density: 1000}", "poisson: must be less than 0.5"),
    ],
)
def test_the_command_line_says_it_in_one_line(
    tmp_path: Path, ball: Asset, text: str, expected: str, capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    ball.save(tmp_path / "ball.usdc")
    (tmp_path / "bad.yaml").write_text(f"bodies:\n  - asset: ball.usdc\n    {text}\n")
    output = tmp_path / "out"
    command = ["gdpro", "simulate", str(tmp_path / "bad.yaml"), "-o", str(output), "--quiet"]
    monkeypatch.setattr("sys.argv", command)
    with pytest.raises(SystemExit) as stopped:
        main()
    assert stopped.value.code == 2
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith("gdpro: ") and expected in line


def test_mass_does_not_depend_on_the_number_of_gaussians(tmp_path: Path) -> None:
    path = tmp_path / "sphere.ply"
    trimesh.creation.icosphere(subdivisions=4, radius=0.1).export(path)
    volumes = []
    for budget in (300, 5000):
        tets = import_mesh(path, budget=budget, target_tets=600).tets
        assert tets is not None
        volumes.append(float((tets.volumes() * tets.fill).sum()))
    assert volumes[0] == pytest.approx(volumes[1], rel=0.01)
    assert volumes[1] == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.03)
