"""Scene -> Model: bodies stand where the scene says, whatever their tets are made of."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from gdpro_sim.asset import Asset, import_mesh, tetrahedralize_asset
from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.compile import compile_scene
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


def test_wrong_placements_are_refused(ball: Asset) -> None:
    with pytest.raises(SceneError, match=r"starts 0\.1 m below the ground"):
        compiled(ball, position=[0, 0, -0.1])
    with pytest.raises(SceneError, match=r"pins\[0\]: the box holds no vertex; the body spans"):
        compiled(ball, pins={"minimum": [5, 5, 5]})
    with pytest.raises(SceneError, match="no tetrahedra"):
        compiled(replace(ball, tets=None, embedding=None))


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
