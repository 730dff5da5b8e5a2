"""Transfers between MPM particles and grid, against a readable float64 step, in tiles and one by one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import warp as wp

from gdpro_sim import device as devices
from gdpro_sim.errors import SolverError
from gdpro_sim.kernels import mpm_grid, mpm_particles
from gdpro_sim.kernels import particles as rows
from gdpro_sim.simulation.mpm.grid import Grid
from tests.reference import mpm as reference

KERNELS = ("quadratic", "cubic")
SPACING = 0.1
H = 2e-3


@pytest.fixture(autouse=True)
def threads_as_they_were() -> Iterator[None]:
    before = devices.thread_count()
    yield
    devices.set_thread_count(before)


@dataclass
class Case:
    """Particles with everything random, and the float64 particles they stand for."""

    positions: np.ndarray
    total: bool = True
    seed: int = 0
    fields: np.ndarray = field(init=False)
    forces: np.ndarray = field(init=False)

    def __post_init__(self) -> None:
        rng, count = np.random.default_rng(self.seed), len(self.positions)
        f = np.zeros((rows.ROWS if self.total else rows.TOTAL, count), np.float32)
        f[rows.POSITION : rows.POSITION + 3] = self.positions.T
        f[rows.VELOCITY : rows.VELOCITY + 3] = rng.normal(size=(3, count))
        f[rows.AFFINE : rows.AFFINE + 9] = 5.0 * rng.normal(size=(9, count))
        for row in (rows.DEFORMATION, rows.TOTAL)[: 1 + self.total]:
            f[row : row + 9] = np.eye(3).reshape(9, 1) + 0.2 * rng.normal(size=(9, count))
        f[rows.MASS] = rng.uniform(0.5, 2.0, count)
        f[rows.VOLUME] = rng.uniform(0.5, 2.0, count) * SPACING**3 / 8
        f[rows.STRESS : rows.STRESS + 6] = 3.0 * rng.normal(size=(6, count))
        self.fields = f
        xx, yy, zz, xy, xz, yz = f[rows.STRESS : rows.STRESS + 6].astype(np.float64)
        self.forces = np.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz], axis=1).reshape(-1, 3, 3)

    def _matrix(self, row: int) -> np.ndarray:
        return self.fields[row : row + 9].T.reshape(-1, 3, 3).astype(np.float64)

    def cloud(self) -> reference.Cloud:
        f = self.fields.astype(np.float64)
        return reference.Cloud(
            f[rows.POSITION : rows.POSITION + 3].T,
            f[rows.VELOCITY : rows.VELOCITY + 3].T,
            self._matrix(rows.AFFINE),
            self._matrix(rows.DEFORMATION),
            f[rows.MASS],
            f[rows.VOLUME],
        )

    def densities(self, kernel: str) -> tuple[np.ndarray, np.ndarray]:
        """Of the grid around each particle, kg/m^3, and their change over a cell."""
        cloud = self.cloud()
        reach = reference.stencil(kernel, cloud.positions, SPACING)
        nothing = np.zeros_like(self.forces)
        nodes = reference.to_grid(cloud, reach, affine=False, forces=nothing, h=H, inertia=1.0)
        shares = reach.weights * nodes.masses[nodes.places] / SPACING**3
        inertia = 1.0 / 4.0 if kernel == "quadratic" else 1.0 / 3.0
        slopes = np.einsum("pn,pni->pi", shares, reach.arms / SPACING) / inertia
        return shares.sum(axis=1), np.linalg.norm(slopes, axis=1)

    def grid(self, kernel: str, **options: Any) -> Grid:
        matter = np.zeros(len(self.positions), np.int32)
        options = {"max_cells": 1 << 31, "device": "cpu", **options}
        grid = Grid(self.fields, matter, spacing=SPACING, kernel=kernel, **options)
        grid.sort()
        return grid

    def step(self, kernel: str, transfer: str = "apic", flip: float = 0.0) -> reference.Cloud:
        cloud = self.cloud()
        return reference.step(
            cloud,
            H,
            spacing=SPACING,
            kernel=kernel,
            transfer=transfer,
            flip_ratio=flip,
            stress=lambda _: self.forces / cloud.volumes[:, None, None],
        )


def random_case(count: int = 700, **options: Any) -> Case:
    """Around the origin, so that half the coordinates are negative; blocks hold 0 to 40 particles."""
    rng = np.random.default_rng(1)
    return Case(rng.normal(scale=(0.5, 0.4, 0.3), size=(count, 3)).astype(np.float32), **options)


def values_of(grid: Grid) -> dict[tuple[int, ...], np.ndarray]:
    """(velocity, mass) of every node with mass, by its number."""
    inside = np.stack(np.unravel_index(np.arange(64), (4, 4, 4)), axis=1)
    numbers = (4 * grid.blocks.numpy()[:, None, :] + inside).reshape(-1, 3)
    values = grid.values.numpy()
    return {tuple(n): v for n, v in zip(numbers.tolist(), values, strict=True) if v[3] > 0.0}


def substep(grid: Grid, transfer: str = "apic", flip: float = 0.0) -> None:
    """As `SolverMPM` does it."""
    affine = 0.0 if transfer == "pic" else 1.0
    if flip > 0.0:
        grid.scatter(0.0, affine, (0.0, 0.0, 0.0))
        grid.keep()
    grid.scatter(H, affine, (0.0, 0.0, -9.81 * H))
    if flip > 0.0:
        grid.give_change()
    grid.gather(H, flip)


def assert_dense(grid: Grid, case: Case, kernel: str) -> None:
    density, slope = case.densities(kernel)
    np.testing.assert_allclose(grid.rows(rows.DENSITY, 1)[:, 0], density, rtol=1e-5)
    np.testing.assert_allclose(grid.rows(rows.SLOPE, 1)[:, 0], slope, rtol=1e-5, atol=1e-4 * density.max())


def assert_moved(grid: Grid, expected: reference.Cloud) -> None:
    """Positions and deformations with what rounding has cut off are exact to the transfer's own rounding."""
    velocity = np.abs(expected.velocities).max()
    gradient = np.abs(expected.affine).max()
    low = grid.rows(rows.POSITION_LOW, 3).astype(np.float64)
    np.testing.assert_allclose(
        grid.rows(rows.POSITION, 3) + low, expected.positions, rtol=0, atol=2e-6 * H * velocity
    )
    np.testing.assert_allclose(grid.rows(rows.VELOCITY, 3), expected.velocities, rtol=0, atol=2e-6 * velocity)
    affine = grid.rows(rows.AFFINE, 9).reshape(-1, 3, 3)
    np.testing.assert_allclose(affine, expected.affine, rtol=0, atol=4e-6 * gradient)
    F = grid.rows(rows.DEFORMATION, 9) + grid.rows(rows.DEFORMATION_LOW, 9).astype(np.float64)
    np.testing.assert_allclose(F.reshape(-1, 3, 3), expected.deformations, rtol=0, atol=8e-6 * H * gradient)


@pytest.mark.parametrize("kernel", KERNELS)
def test_splines_sum_to_one_and_have_their_moments(kernel: str) -> None:
    """The oracle itself: partition of unity, no first moment, D along each axis (Jiang et al. 2015)."""
    x = np.random.default_rng(0).uniform(-3.0, 3.0, (200, 3))
    reach = reference.stencil(kernel, x, SPACING)
    np.testing.assert_allclose(reach.weights.sum(axis=1), 1.0, rtol=1e-13)
    np.testing.assert_allclose(np.einsum("nk,nki->ni", reach.weights, reach.arms), 0.0, atol=1e-15)
    second = np.einsum("nk,nki,nkj->nij", reach.weights, reach.arms, reach.arms)
    D = reference.inertia(kernel, SPACING) * np.eye(3)
    np.testing.assert_allclose(second, np.tile(D, (200, 1, 1)), atol=1e-16)


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_oracle_keeps_momenta(kernel: str) -> None:
    case = random_case(100)
    D = reference.inertia(kernel, SPACING)
    before, cloud = case.cloud(), case.cloud()
    for _ in range(5):
        cloud = reference.step(cloud, H, spacing=SPACING, kernel=kernel, gravity=(0.0, 0.0, 0.0))
    for one, other in zip(reference.momenta(before, D), reference.momenta(cloud, D), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-11)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("affine", [0.0, 1.0])
def test_nodes_get_the_momentum_and_mass_of_the_oracle(kernel: str, affine: float) -> None:
    case = random_case()
    grid, cloud = case.grid(kernel), case.cloud()
    grid.scatter(H, affine, (0.1, 0.2, 0.3))
    expected = reference.to_grid(
        cloud,
        reference.stencil(kernel, cloud.positions, SPACING),
        affine=affine > 0.0,
        forces=case.forces,
        h=H,
        inertia=reference.inertia(kernel, SPACING),
    )
    found = values_of(grid)
    heavy = expected.masses > 1e-4
    numbers = [tuple(n) for n in expected.numbers[heavy].tolist()]
    assert set(numbers) <= set(found)
    got = np.array([found[n] for n in numbers], np.float64)
    np.testing.assert_allclose(got[:, 3], expected.masses[heavy], rtol=2e-5)
    momentum = got[:, 3:] * (got[:, :3] - [0.1, 0.2, 0.3])
    wanted = (expected.masses[:, None] * expected.velocities)[heavy]
    np.testing.assert_allclose(momentum, wanted, atol=3e-6 * np.abs(wanted).max())
    mass = grid.values.numpy()[:, 3].sum(dtype=np.float64)
    assert mass == pytest.approx(cloud.masses.sum(), rel=1e-6)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("transfer", "flip"), [("apic", 0.0), ("pic", 0.0), ("flip", 0.95), ("flip", 1.0)])
@pytest.mark.parametrize("total", [False, True])
def test_a_substep_is_the_oracles(kernel: str, transfer: str, flip: float, total: bool) -> None:
    case = random_case(total=total)
    grid = case.grid(kernel)
    substep(grid, transfer, flip)
    expected = case.step(kernel, transfer, flip)
    assert_moved(grid, expected)
    if total:
        start = case._matrix(rows.TOTAL)
        got = grid.rows(rows.TOTAL, 9).reshape(-1, 3, 3)
        np.testing.assert_allclose(got, start + H * expected.affine @ start, atol=3e-6)
        assert_dense(grid, case, kernel)


def one_by_one(grid: Grid, transfer: str = "apic", flip: float = 0.0) -> None:
    """The substep of a GPU, one particle at a time on one CPU thread."""
    count = len(grid.ids)
    affine = 0.0 if transfer == "pic" else 1.0

    def launch(kernel: wp.Kernel, dim: int, *arguments: Any) -> None:
        wp.launch(kernel, dim=dim, inputs=[0, *arguments], device="cpu")

    def scatter(h: float, change: wp.vec3) -> None:
        grid.values.zero_()
        common = (grid.width, h, SPACING, affine)
        place = (grid.owners, grid.coords, grid.neighbors)
        launch(mpm_particles.scatter_particles, count, *common, *place, grid.particles, grid.values)
        launch(mpm_grid.momentum_to_velocity, len(grid.values), change, grid.values)

    if flip > 0.0:
        scatter(0.0, wp.vec3())
        grid.keep()
    scatter(H, wp.vec3(0.0, 0.0, -9.81 * H))
    place = (grid.owners, grid.coords, grid.neighbors)
    if flip > 0.0:
        assert grid.change is not None
        launch(mpm_grid.change_of_velocity, len(grid.values), grid.values, grid.change)
        launch(
            mpm_particles.add_change_particles,
            count,
            grid.width,
            SPACING,
            *place,
            grid.change,
            grid.particles,
        )
    launch(
        mpm_particles.gather_particles,
        count,
        *(grid.width, H, SPACING, flip),
        *(*place, grid.values, grid.particles, grid.strayed),
    )


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("transfer", "flip"), [("apic", 0.0), ("pic", 0.0), ("flip", 0.95)])
def test_one_by_one_is_the_oracles(kernel: str, transfer: str, flip: float) -> None:
    """What a GPU does."""
    case = random_case()
    grid = case.grid(kernel)
    one_by_one(grid, transfer, flip)
    assert_moved(grid, case.step(kernel, transfer, flip))
    assert_dense(grid, case, kernel)


@pytest.mark.parametrize("kernel", KERNELS)
def test_tiles_and_one_by_one_agree_on_the_nodes(kernel: str) -> None:
    case = random_case()
    grid, other = case.grid(kernel), case.grid(kernel)
    substep(grid)
    one_by_one(other)
    found, wanted = values_of(grid), values_of(other)
    assert set(found) == set(wanted)
    for number, value in wanted.items():
        assert found[number][3] == pytest.approx(value[3], rel=1e-4, abs=1e-10)
    np.testing.assert_array_equal(grid.strayed.numpy(), other.strayed.numpy())


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(
    "place",
    [
        (0.0, 0.0, 0.0),
        (0.05, 0.05, 0.05),
        (-0.05, -0.15, 0.25),
        (0.4, -0.4, 0.8),
        (0.39999998, -0.40000004, 1e-9),
        (-3.21, 7.77, -0.001),
    ],
)
def test_one_particle_alone(kernel: str, place: tuple[float, float, float]) -> None:
    """On nodes, between them, on the edges of blocks, either side of zero."""
    case = Case(np.array([place], np.float32))
    grid = case.grid(kernel)
    assert (grid.occupied, grid.count) == (1, 27)
    substep(grid)
    assert_moved(grid, case.step(kernel))
    grid = case.grid(kernel)
    one_by_one(grid)
    assert_moved(grid, case.step(kernel))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("count", [1, 15, 16, 17, 31, 32, 33, 100])
def test_any_number_of_particles_in_a_block(kernel: str, count: int) -> None:
    """Vectors hold 16 of them; the last may be part filled."""
    x = np.random.default_rng(count).uniform(0.02, 0.36, (count, 3)).astype(np.float32)
    case = Case(x)
    grid = case.grid(kernel)
    substep(grid, "flip", 0.5)
    assert_moved(grid, case.step(kernel, "flip", 0.5))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("way", [one_by_one, substep])
def test_particles_may_stray_a_cell_before_they_are_sorted_anew(kernel: str, way: Any) -> None:
    """Each block reaches the nodes of particles that have moved by up to a cell in any direction."""
    rng = np.random.default_rng(3)
    x = rng.uniform(-0.8, 0.8, (600, 3)).astype(np.float32)
    case = Case(x)
    grid = case.grid(kernel)
    order = grid.ids.numpy()
    moved = (x + rng.uniform(-0.999, 0.999, x.shape) * SPACING).astype(np.float32)
    strayed = Case(moved)
    fields = case.fields[:, order]
    fields[rows.POSITION : rows.POSITION + 3] = moved[order].T
    grid.put(fields)
    way(grid)
    strayed.fields[rows.VELOCITY :] = case.fields[rows.VELOCITY :]
    assert_moved(grid, strayed.step(kernel))


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("cells", [-1.4, 5.4, np.nan])
def test_particles_too_far_from_their_block_are_reported(kernel: str, axis: int, cells: float) -> None:
    """A block's particles have their first nodes in it: the second of 4 cells is well inside."""
    first = {"quadratic": 0.5, "cubic": 1.0}[kernel]
    case = Case(np.full((1, 3), (first + 1.5) * SPACING, np.float32))
    grid = case.grid(kernel)
    case.fields[rows.STRESS : rows.STRESS + 6] = 0.0
    substep(grid)
    assert not grid.has_strayed()
    fields = grid.rows(0, rows.ROWS).T
    fields[rows.VELOCITY : rows.VELOCITY + 3] = 0.0
    fields[rows.AFFINE : rows.AFFINE + 9] = 0.0
    fields[rows.VELOCITY + axis] = (first + cells - 0.1) * SPACING / H - fields[rows.POSITION + axis] / H
    grid.put(fields)
    substep(grid)
    assert grid.has_strayed()
    if np.isfinite(cells):
        grid.sort()
        assert not grid.has_strayed()
    else:
        with pytest.raises(SolverError, match="no numbers"):
            grid.sort()


def test_far_apart_particles_have_blocks_of_their_own() -> None:
    """Memory goes with the particles, not with the box around them; past `max_cells` it is refused."""
    x = np.concatenate([np.zeros((5, 3)), np.full((5, 3), 30.0)]).astype(np.float32)
    x += np.random.default_rng(0).uniform(0.0, 0.1, x.shape).astype(np.float32)
    case = Case(x)
    for kernel in KERNELS:
        grid = case.grid(kernel)
        assert grid.count <= 27 * grid.occupied
        substep(grid)
        assert_moved_far(grid, case.step(kernel))
    with pytest.raises(
        SolverError, match=r"30\.\d x 30\.\d x 30\.\d m apart would need a grid of [\d,]+ cells"
    ):
        case.grid("quadratic", max_cells=1_000_000)
    case.fields[rows.POSITION, 0] = 1e30
    with pytest.raises(SolverError, match="from the origin"):
        case.grid("quadratic")


def assert_moved_far(grid: Grid, expected: reference.Cloud) -> None:
    """Away from the origin a place inside a cell is known to float32 only: 300 cells take 8 bits of it."""
    np.testing.assert_allclose(grid.rows(rows.VELOCITY, 3), expected.velocities, atol=1e-3)
    np.testing.assert_allclose(grid.rows(rows.POSITION, 3), expected.positions, atol=1e-5)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("transfer", "flip"), [("apic", 0.0), ("pic", 0.0), ("flip", 0.95)])
def test_bytes_do_not_depend_on_threads(kernel: str, transfer: str, flip: float) -> None:
    case, digests = random_case(3000), set()
    for threads in (1, 2, 8, 1):
        devices.set_thread_count(threads)
        grid = case.grid(kernel)
        for k in range(6):
            if k == 3 or grid.has_strayed():
                grid.sort()
            substep(grid, transfer, flip)
        digests.add(b"".join(a.numpy().tobytes() for a in (grid.particles, grid.ids, grid.values)))
    assert len(digests) == 1


@pytest.mark.parametrize("kernel", KERNELS)
def test_the_order_that_particles_come_in_is_kept(kernel: str) -> None:
    """Sorting moves rows, matter and numbers together; `rows` gives the model's order back."""
    case = random_case(300)
    matter = np.arange(300, dtype=np.int32)
    grid = Grid(case.fields, matter, spacing=SPACING, kernel=kernel, max_cells=1 << 31, device="cpu")
    grid.sort()
    assert not np.array_equal(grid.ids.numpy(), matter)
    np.testing.assert_array_equal(grid.ids.numpy(), grid.matter.numpy())
    np.testing.assert_array_equal(grid.rows(0, rows.ROWS).T, case.fields)
    owners, starts = grid.owners.numpy(), grid.starts.numpy()
    assert (np.diff(owners) >= 0).all()
    np.testing.assert_array_equal(starts, np.searchsorted(owners, np.arange(grid.occupied + 1)))
    lower = {"quadratic": 0.5, "cubic": 1.0}[kernel]
    x = case.positions[grid.ids.numpy()]
    first = np.floor(x / np.float32(SPACING) - lower).astype(int)
    np.testing.assert_array_equal(first >> 2, grid.coords.numpy()[owners])


def test_small_steps_are_not_lost_far_from_the_origin() -> None:
    """A million steps of 1e-9 m are a millimetre, 8 m from the origin too (float32 steps there by 1e-6 m)."""
    x = np.full((1, 3), 8.03, np.float32)
    case = Case(x)
    case.fields[rows.AFFINE : rows.AFFINE + 9] = 0.0
    case.fields[rows.STRESS : rows.STRESS + 6] = 0.0
    case.fields[rows.VELOCITY : rows.VELOCITY + 3] = [[1e-4], [-1e-4], [5e-5]]
    case.fields[rows.DEFORMATION : rows.DEFORMATION + 9] = np.eye(3).reshape(9, 1)
    grid = case.grid("quadratic")
    steps = 2000
    for _ in range(steps):
        grid.scatter(1e-5, 0.0, (0.0, 0.0, 0.0))
        grid.gather(1e-5, 1.0)
    moved = grid.rows(rows.POSITION, 3) + grid.rows(rows.POSITION_LOW, 3).astype(np.float64) - x
    np.testing.assert_allclose(moved[0], steps * 1e-5 * np.array([1e-4, -1e-4, 5e-5]), rtol=1e-4)
