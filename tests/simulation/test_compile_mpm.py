"""Scene -> Model of particles: volumes, places, materials, holds and loads; what cannot run is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh

from gdpro_sim.asset import Asset, import_mesh
from gdpro_sim.asset.from_splats import bind_splats
from gdpro_sim.errors import SceneError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.materials import Material
from gdpro_sim.simulation.compile import compile_scene, load_assets
from gdpro_sim.simulation.conditions import FOREVER, Force, Impulse
from gdpro_sim.simulation.model import Model, Particles
from gdpro_sim.simulation.mpm import SolverMPM
from gdpro_sim.simulation.run import solver_of
from gdpro_sim.simulation.scene import check_scene, load_scene

VOLUME = 0.2**3


@pytest.fixture(scope="module")
def cube(tmp_path_factory: pytest.TempPathFactory) -> Asset:
    """A cube of 0.2 m without tets."""
    path = tmp_path_factory.mktemp("cube") / "cube.ply"
    trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().export(path)
    return import_mesh(path, budget=400, tets=False)


def compiled(
    asset: Asset, *, solver: dict[str, object] | None = None, scene: object = None, **body: object
) -> Model:
    data = {
        "bodies": [{"name": "cube", "asset": "cube.ply", **body}],
        "solver": {"kind": "mpm", "particles": 800, **(solver or {})},
        **(scene if isinstance(scene, dict) else {}),
    }
    return compile_scene(check_scene(data), {"cube": asset})


def particles_of(model: Model) -> Particles:
    assert model.particles is not None
    return model.particles


def test_particles_fill_the_body_where_it_stands(cube: Asset) -> None:
    model = compiled(cube, position=[1, 2, 3], rotation=[0, 0, 45], size=0.4, velocity=[1, 0, 0])
    particles = particles_of(model)
    assert 600 < len(particles) < 1000
    assert particles.volumes.sum(dtype=np.float64) == pytest.approx(8 * VOLUME, rel=1e-5)
    low, high = particles.positions.min(0), particles.positions.max(0)
    np.testing.assert_allclose([0.5 * (low + high)[0], 0.5 * (low + high)[1]], [1, 2], atol=0.03)
    assert low[2] > 3.0 and high[2] < 3.4 and high[0] - low[0] > 0.45, "it is turned"
    np.testing.assert_array_equal(particles.velocities, np.tile(np.float32([1, 0, 0]), (len(particles), 1)))
    assert model.mpm.grid_spacing == pytest.approx(2.0 * particles.spacing, rel=0.1), "8 a cell"
    assert model.bodies[0].particle_range == (0, len(particles)) and model.bodies[0].patches is None
    assert isinstance(solver_of(model), SolverMPM)


def test_resolution(cube: Asset) -> None:
    for solver, spacing in (
        ({"particles": None, "grid_spacing": 0.04}, 0.02),
        ({"particles": None, "grid_spacing": 0.04, "particles_per_cell": 27}, 0.04 / 3),
    ):
        model = compiled(cube, solver=solver)
        assert model.mpm.grid_spacing == 0.04
        assert particles_of(model).spacing == pytest.approx(spacing, rel=0.05)
    own = compiled(cube, particles=300)
    assert 200 < len(particles_of(own)) < 400
    with pytest.raises(SceneError, match=r"'cube': 10 particles are .* more than a cell of 0.04 m"):
        compiled(cube, particles=10, solver={"particles": None, "grid_spacing": 0.04})
    with pytest.raises(SceneError, match="give either `particles` or `grid_spacing`"):
        compiled(cube, solver={"grid_spacing": 0.04})
    same = [particles_of(compiled(cube, solver={"fill": "blue-noise"})).positions for _ in range(2)]
    np.testing.assert_array_equal(*same)


def test_several_bodies_and_materials(cube: Asset) -> None:
    data = {
        "bodies": [
            {"name": "sand", "asset": "a.ply", "material": "sand"},
            {"name": "jelly", "asset": "a.ply", "material": "jelly", "position": [0.5, 0, 0]},
            {"name": "more", "asset": "a.ply", "material": "sand", "position": [1.0, 0, 0]},
        ],
        "solver": {"kind": "mpm", "particles": 900},
    }
    model = compile_scene(check_scene(data), dict.fromkeys(("sand", "jelly", "more"), cube))
    particles = particles_of(model)
    assert [material.preset for material in particles.materials] == ["sand", "jelly"]
    for body, matter, loose in zip(model.bodies, (0, 1, 0), (True, False, True), strict=True):
        part = slice(*body.particle_range)
        assert (particles.matter[part] == matter).all()
        assert (body.patches is not None) == loose
        assert len(body.surface) == len(body.gaussians.vertices)
    assert (np.diff(model.bodies[0].patches) >= 0).all()
    inside = len(model.bodies[0].gaussians) - len(cube.gaussians)
    assert inside > 0, "it has Gaussians inside"


def test_parts_of_another_material(cube: Asset) -> None:
    hard = {"preset": "rubber", "density": 3000.0}
    model = compiled(cube, material="jelly", parts={"side": "top", "fraction": 0.5, "material": hard})
    particles = particles_of(model)
    np.testing.assert_array_equal(particles.matter == 1, particles.positions[:, 2] >= 0.1)
    centre = np.array([0.0, 0.0, (0.05 * 1050 + 0.15 * 3000) / 4050])
    spun = compiled(cube, material="jelly", angular_velocity=[0, 5, 0],
                    parts={"side": "top", "fraction": 0.5, "material": hard})  # fmt: skip
    velocities = np.cross([0, 5, 0], particles.positions - centre)
    np.testing.assert_allclose(particles_of(spun).velocities, velocities, atol=0.02)
    gradients = particles_of(spun).gradients
    assert gradients is not None
    np.testing.assert_allclose(
        gradients[0] @ [0.1, 0.2, 0.3], np.cross([0, 5, 0], [0.1, 0.2, 0.3]), rtol=1e-6
    )


def test_pins_and_pushes(cube: Asset) -> None:
    up = {"time": 1.0, "translation": [0, 0, 1]}
    model = compiled(
        cube,
        pins=[
            {"side": "bottom", "fraction": 0.3},
            {"side": "top", "fraction": 0.3, "start": 0.5, "release": 2.0, "motion": up},
        ],
        forces={"force": [1, 2, 3], "side": "left", "fraction": 0.5},
        impulses={"velocity": [0, 0, 2], "time": 0.1},
    )
    particles, (still, moved) = particles_of(model), model.holds
    assert still.motion is None and still.release == FOREVER and moved.motion is not None
    assert (particles.positions[still.particles, 2] < 0.07).all() and len(still.particles) > 50
    assert (moved.start, moved.release) == (0.5, 2.0)
    np.testing.assert_array_equal(moved.motion.times, [0.0, 0.5, 1.0])
    np.testing.assert_array_equal(moved.motion.translations[:, 2], [0.0, 0.0, 1.0])
    force, push = model.loads
    assert isinstance(force, Force) and isinstance(push, Impulse)
    np.testing.assert_allclose(force.forces.sum(0), [1, 2, 3])
    np.testing.assert_allclose(push.impulses.sum(0), [0, 0, 2 * 1050 * VOLUME], rtol=1e-5)


def test_pins_at_odds_are_refused(cube: Asset) -> None:
    for second in ({"release": 1.0}, {"motion": {"time": 1.0, "translation": [1, 0, 0]}}):
        with pytest.raises(SceneError, match=r"pins\[0\] and pins\[1\] both hold particle \d+ at"):
            compiled(
                cube, pins=[{"side": "top", "fraction": 0.5}, {"side": "left", "fraction": 0.5, **second}]
            )
    later = compiled(cube, pins=[{"side": "top", "release": 1.0}, {"side": "top", "start": 1.0}])
    assert len(later.holds) == 2
    with pytest.raises(SceneError, match=r"vertices: counts vertices of tets"):
        compiled(cube, pins={"vertices": [0]})
    with pytest.raises(SceneError, match=r"pins\[0\]: the box holds no particle; the body spans"):
        compiled(cube, pins={"minimum": [5, 5, 5]})


def test_clouds_without_a_mesh_are_filled(tmp_path: Path) -> None:
    points = torch.from_numpy(np.float32(trimesh.creation.icosphere(subdivisions=4, radius=0.1).vertices))
    n = len(points)
    cloud = Gaussians(
        points, torch.tensor([[1.0, 0, 0, 0]]).repeat(n, 1), torch.full((n, 3), 0.006), torch.full((n,), 0.9),
        torch.zeros((n, 1, 3)),
    )  # fmt: skip
    Asset("ball", bind_splats(cloud)).save(tmp_path / "ball.usdc")
    data = {"bodies": [{"asset": "ball.usdc", "position": [0, 0, 0.01]}], "folder": tmp_path,
            "solver": {"kind": "mpm", "particles": 1000}}  # fmt: skip
    scene = check_scene(data)
    assets = load_assets(scene)
    assert assets["ball"].tets is None
    model = compile_scene(scene, assets)
    particles = particles_of(model)
    centre = particles.positions.mean(0)
    assert particles.volumes.sum() == pytest.approx(4 / 3 * np.pi * 0.1**3, rel=0.25)
    assert np.linalg.norm(particles.positions - centre, axis=1).min() < 0.03, "inside too"
    solver = solver_of(model)
    np.testing.assert_array_equal(solver.surface_positions(0), model.bodies[0].surface)


@pytest.mark.parametrize(
    ("body", "scene", "solver", "expected"),
    [
        ({}, {"wind": {"velocity": [1, 0, 0]}}, {}, "wind: the MPM solver has none"),
        ({"pressures": {"pressure": 1}}, {}, {}, r"bodies\[cube\].pressures: the MPM solver has none"),
        (
            {},
            {
                "springs": {
                    "ends": [{"body": "cube", "point": [0, 0, 0]}, {"point": [0, 0, 1]}],
                    "stiffness": 1,
                }
            },
            {},
            "springs: the MPM solver has none",
        ),
        ({"position": [0, 0, -1]}, {}, {}, "starts 1 m below the ground"),
        (
            {"material": {"preset": "jelly", "model": "linear"}},
            {},
            {},
            "body 'cube': the law \"linear\" means",
        ),
        (
            {"material": {"preset": "water", "bulk_modulus": 0}},
            {},
            {},
            "material.bulk_modulus: must be greater",
        ),
        (
            {"material": "steel"},
            {},
            {"max_substeps": 100},
            r"steel of 2.1e\+11 Pa.* substeps a frame .*at most 100",
        ),
        ({}, {}, {"max_cells": 100}, r"need a grid of .* cells of .* \(at most 100\): use fewer"),
        ({}, {}, {"domain": [[-1, -1, 0], [1, 1, 0.1]]}, r"'cube' reaches from .* outside solver.domain"),
        ({}, {}, {"domain": [[0, 0, 0], [1, 1, 0]]}, "domain: the upper corner must lie above the lower"),
        ({}, {}, {"cfl": 1.5}, "solver.cfl: must be less than or equal to 1, got 1.5"),
        ({}, {}, {"substep": 3}, r"solver.substep: unknown key \(did you mean `substeps`\?\)"),
        ({"material": {"preset": "jelly", "young": 0}}, {}, {}, "young: must be greater than 0, got 0"),
        (
            {"material": {"preset": "jelly", "poisson": 0.5}},
            {},
            {},
            "poisson: must be less than 0.5, got 0.5",
        ),
        (
            {"pins": {"side": "top", "start": 2, "release": 1}},
            {},
            {},
            r"release must be after start \(2 s\), got 1 s",
        ),
    ],
)
def test_what_cannot_run_is_refused(
    cube: Asset, body: dict[str, object], scene: dict[str, object], solver: dict[str, object], expected: str
) -> None:
    with pytest.raises(SceneError, match=expected) as caught:
        compiled(cube, solver=solver, scene=scene, **body)
    assert "\n" not in str(caught.value)


def test_overlapping_bodies_are_refused(cube: Asset) -> None:
    def two(gap: float) -> Model:
        bodies = [{"name": name, "asset": "cube.ply", "position": [0, 0, z]}
                  for name, z in (("lower", 0.0), ("upper", 0.2 + gap))]  # fmt: skip
        data = {"bodies": bodies, "solver": {"kind": "mpm", "particles": 4000}}
        return compile_scene(check_scene(data), {"lower": cube, "upper": cube})

    assert len(two(0.0).bodies) == 2, "bodies that touch"
    with pytest.raises(SceneError, match="bodies 'lower' and 'upper' overlap at the start, around"):
        two(-0.05)


def test_open_meshes_are_filled_by_their_tets_or_refused(cube: Asset) -> None:
    for faces in (cube.gaussians.faces[:2], cube.gaussians.faces[:1]):
        ids = torch.zeros_like(cube.gaussians.face_ids)
        sheet = replace(cube.gaussians, faces=faces, face_ids=ids)
        with pytest.raises(SceneError, match=r"body 'cube': .*the mesh encloses no volume"):
            compiled(replace(cube, gaussians=sheet))


def test_fem_refuses_what_is_for_mpm(cube: Asset) -> None:
    for body, expected in (
        ({"material": "sand"}, "body 'cube': the law \"drucker_prager\" flows"),
        ({"particles": 100}, "`particles` belongs to MPM"),
        ({"parts": {"side": "top", "material": "jelly"}}, "`parts` belongs to MPM"),
        ({"pins": {"side": "top", "start": 1}}, r"pins\[0\].start: belongs to MPM"),
    ):
        data = {"bodies": [{"name": "cube", "asset": "cube.ply", **body}]}
        assets = {"cube": _with_tets(cube)}
        with pytest.raises(SceneError, match=expected):
            compile_scene(check_scene(data), assets)


def test_assets_that_only_mpm_can_simulate_get_its_default_scene(cube: Asset, tmp_path: Path) -> None:
    loose = Asset("cloud", bind_splats(cube.gaussians.gaussians()))
    for name, asset, kind in (
        ("jelly", cube, "fem"),
        ("sand", replace(cube, material=Material.model_validate("sand")), "mpm"),
        ("cloud", loose, "mpm"),
    ):
        asset.save(tmp_path / f"{name}.usdc")
        assert load_scene(tmp_path / f"{name}.usdc").solver.kind == kind, name


def _with_tets(asset: Asset) -> Asset:
    from gdpro_sim.asset import tetrahedralize_asset

    return tetrahedralize_asset(asset, target_tets=300, method="lattice")
