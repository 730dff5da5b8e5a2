"""Rows of the float32 array [rows, N] that holds all MPM particles: one row for each number of a particle.

    POSITION     3  m, world
    VELOCITY     3  m/s
    AFFINE       9  velocity gradient at the particle, 1/s, row by row
    DEFORMATION  9  elastic deformation gradient, row by row
    STRESS       6  Kirchhoff stress times volume at rest, J: xx yy zz xy xz yz
    MASS         1  kg
    VOLUME       1  m^3 at rest
    SPEED        1  m/s, of sound in the particle plus its own: bounds the next step
    INTERNAL     4  what the material remembers; its law says what of
    TOTAL        9  deformation gradient since the start, elastic or not; only where some material flows

The matter of a particle (int32, a row of the table of materials) and its number in the model (int32) stand in
arrays of their own. Particles are sorted by place, again and again: nothing else may be kept by index.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

POSITION = wp.constant(0)
VELOCITY = wp.constant(3)
AFFINE = wp.constant(6)
DEFORMATION = wp.constant(15)
STRESS = wp.constant(24)
MASS = wp.constant(30)
VOLUME = wp.constant(31)
SPEED = wp.constant(32)
INTERNAL = wp.constant(33)
TOTAL = wp.constant(37)
ROWS = wp.constant(46)


@wp.func
def read_vector(particles: wp.array2d[float], row: int, i: int) -> wp.vec3:
    """Rows row .. row + 2 of particle i."""
    return wp.vec3(particles[row, i], particles[row + 1, i], particles[row + 2, i])


@wp.func
def read_matrix(particles: wp.array2d[float], row: int, i: int) -> wp.mat33:
    """Rows row .. row + 8, row by row."""
    return wp.matrix_from_rows(
        read_vector(particles, row, i), read_vector(particles, row + 3, i), read_vector(particles, row + 6, i)
    )


@wp.func
def write_vector(v: wp.vec3, row: int, i: int, particles: wp.array2d[float]):
    """The other way."""
    for k in range(3):
        particles[row + k, i] = v[k]


@wp.func
def write_matrix(m: wp.mat33, row: int, i: int, particles: wp.array2d[float]):
    """The other way."""
    for k in range(9):
        particles[row + k, i] = m[k // 3, k % 3]
