"""PhysGaussian's particle filling (Xie et al. 2024, section 3.5, and its released code), in float64."""

from __future__ import annotations

import numpy as np

from gdpro_sim.gaussians import Gaussians, rotation_matrices


def physgaussian_filling(
    cloud: Gaussians, cell: float, *, dense: float = 2.0, wall: float = 1.0, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Particles [N, 3] m, the Gaussians' centres first, and their volumes [N] m^3.

    A cell's density is the mean over its corners of sum o exp(-m^2 / 2), within one standard deviation
    rounded up to cells; above `dense` it is filled, above `wall` it stops rays. Cells to fill without a
    Gaussian get a particle at a random place; so do empty cells that rays along +-x, +-y and +z find walled
    in and whose ray along +z enters an odd number of walls. The particles in a cell share its volume.
    """
    rng = np.random.default_rng(seed)
    means = cloud.means.double().numpy()
    axes = rotation_matrices(cloud.quats.double()).numpy()
    scales = np.maximum(cloud.scales.double().numpy(), 1e-4 * cell)
    inverse = np.einsum("nij,nj,nkj->nik", axes, scales**-2.0, axes)
    origin = means.min(0) - 4.0 * cell
    shape = np.ceil((means.max(0) - origin) / cell).astype(int) + 5
    where = np.floor((means - origin) / cell).astype(int)
    density, count = np.zeros(shape), np.zeros(shape, int)
    np.add.at(count, tuple(where.T), 1)
    for n in range(len(means)):
        r = int(np.ceil(scales[n].max() / cell))
        steps = np.arange(-r, r + 1)
        cells = np.stack(np.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3) + where[n]
        cells = cells[((cells >= 0) & (cells < shape)).all(1)]
        corner = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
        off = origin + (cells[:, None] + corner) * cell - means[n]
        weight = np.exp(-0.5 * np.einsum("cki,ij,ckj->ck", off, inverse[n], off)).mean(1)
        density[tuple(cells.T)] += float(cloud.opacities[n]) * weight
    new = (density > dense) & (count == 0)
    count[new] = 1
    walls = density > wall
    walled = np.ones(shape, bool)
    for axis in range(3):
        ahead = np.flip(np.maximum.accumulate(np.flip(walls, axis), axis), axis)
        walled &= np.roll(ahead, -1, axis)
        if axis < 2:
            walled &= np.roll(np.maximum.accumulate(walls, axis), 1, axis)
    entered = walls[:, :, 1:] & ~walls[:, :, :-1]
    times = np.zeros(shape, int)
    times[:, :, :-1] = np.flip(np.cumsum(np.flip(entered, 2), 2), 2)
    inner = (count == 0) & walled & (times % 2 == 1)
    count[inner] = 1
    drawn = np.argwhere(new | inner)
    points = np.concatenate([means, origin + (drawn + rng.random(drawn.shape)) * cell])
    place = np.floor((points - origin) / cell).astype(int)
    shared = np.zeros(shape, int)
    np.add.at(shared, tuple(place.T), 1)
    return points, cell**3 / shared[tuple(place.T)]
