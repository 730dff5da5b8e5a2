"""Rows of the float32 array [rows, N] that holds all MPM particles: one row for each number of a particle.

    POSITION         3  m, world
    POSITION_LOW     3  m, what rounding has cut off the position
    VELOCITY         3  m/s
    AFFINE           9  velocity gradient at the particle, 1/s, row by row
    DEFORMATION      9  elastic deformation gradient, row by row
    DEFORMATION_LOW  9  what rounding has cut off it
    STRESS           6  Kirchhoff stress times volume at rest, J: xx yy zz xy xz yz
    MASS             1  kg
    VOLUME           1  m^3 at rest
    SPEED            1  m/s, of sound in the particle plus its own: bounds the next step
    INTERNAL         4  what the material remembers; its law says what of
    TOTAL            9  deformation gradient since the start, elastic or not; only where some material flows
    DENSITY          1  kg/m^3, of the grid around the particle, as if matter went on inside obstacles where
                        there is a fluid; only where some material flows
    SLOPE            1  kg/m^3, by how much that changes over a cell where it is steepest

A substep changes positions and strains by less than float32 can add to them: the sum of a number and its LOW
part is what is meant (Kahan's compensated summation).

The matter of a particle (int32, a row of the table of materials) and its number in the model (int32) stand in
arrays of their own. Particles are sorted by place, again and again: nothing else may be kept by index.
"""

from __future__ import annotations

import warp as wp

wp.set_module_options({"enable_backward": False})

POSITION = wp.constant(0)
POSITION_LOW = wp.constant(3)
VELOCITY = wp.constant(6)
AFFINE = wp.constant(9)
DEFORMATION = wp.constant(18)
DEFORMATION_LOW = wp.constant(27)
STRESS = wp.constant(36)
MASS = wp.constant(42)
VOLUME = wp.constant(43)
SPEED = wp.constant(44)
INTERNAL = wp.constant(45)
TOTAL = wp.constant(49)
DENSITY = wp.constant(58)
SLOPE = wp.constant(59)
ROWS = wp.constant(60)


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


@wp.func
def read_compensated(particles: wp.array2d[float], row: int, low: int, i: int) -> wp.mat33d:
    """The matrix of nine rows from `row` on, with what its rows from `low` on add."""
    m = wp.mat33d()
    for k in range(9):
        m[k // 3, k % 3] = wp.float64(particles[row + k, i]) + wp.float64(particles[low + k, i])
    return m


@wp.func
def write_compensated(m: wp.mat33d, row: int, low: int, i: int, particles: wp.array2d[float]):
    """The other way."""
    for k in range(9):
        high = float(m[k // 3, k % 3])
        particles[row + k, i] = high
        particles[low + k, i] = float(m[k // 3, k % 3] - wp.float64(high))
