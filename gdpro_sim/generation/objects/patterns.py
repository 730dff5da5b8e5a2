"""Surface patterns as functions of the 3D point, so that they do not depend on a mesh.

Points are [3, N] in the object's normalised frame: its axis through x = y = 0, its height centred on z = 0,
its largest extent 1. A pattern mixes a base and a second colour by a weight [N] in [0, 1].
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

Weight = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""Points [3, N], unit normals [3, N] and a seed to the second colour's weight [N] float32."""


def smoothstep(low: float, high: float, value: np.ndarray) -> np.ndarray:
    """0 below `low`, 1 above `high`, a cubic between."""
    t = np.clip((value - np.float32(low)) / np.float32(high - low), 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)


def noise(p: np.ndarray, seed: int) -> np.ndarray:
    """Value noise [N] in [0, 1] at points [3, N]: hashed lattice values, smoothly interpolated."""
    cell = np.floor(p).astype(np.int64)
    f = (p - cell).astype(np.float32)
    f = f * f * (3.0 - 2.0 * f)
    out = np.zeros(p.shape[1], np.float32)
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                weight = (f[0] if i else 1 - f[0]) * (f[1] if j else 1 - f[1]) * (f[2] if k else 1 - f[2])
                out += weight * _hash(cell[0] + i, cell[1] + j, cell[2] + k, seed)
    return out


def _hash(i: np.ndarray, j: np.ndarray, k: np.ndarray, seed: int) -> np.ndarray:
    """Lattice values in [0, 1) by integer mixing (the finaliser of MurmurHash3)."""
    h = (i * 0x8DA6B343 + j * 0xD8163841 + k * 0xCB1AB31F + seed * 0x9E3779B1) & 0xFFFFFFFF
    h = ((h ^ (h >> 16)) * 0x85EBCA6B) & 0xFFFFFFFF
    h = ((h ^ (h >> 13)) * 0xC2B2AE35) & 0xFFFFFFFF
    return ((h ^ (h >> 16)) >> 8).astype(np.float32) / np.float32(1 << 24)


def fractal_noise(p: np.ndarray, seed: int, octaves: int = 3) -> np.ndarray:
    """Octaves of `noise`, each half as strong and twice as fine; [N] in [0, 1]."""
    total, scale = np.zeros(p.shape[1], np.float32), 0.0
    for octave in range(octaves):
        weight = 0.5**octave
        total += np.float32(weight) * noise(p * np.float32(2.0**octave), seed + octave)
        scale += weight
    return total / np.float32(scale)


def _square(phase: np.ndarray, share: float = 0.5, edge: float = 0.04) -> np.ndarray:
    """1 over `share` of each unit of `phase`, 0 over the rest, soft by `edge`."""
    distance = np.abs(phase - np.round(phase))
    return 1.0 - smoothstep(0.5 * share - edge, 0.5 * share + edge, distance)


def _around(p: np.ndarray, n: np.ndarray, count: float) -> tuple[np.ndarray, np.ndarray]:
    """Coordinates on the surface: around the axis (`count` units a turn) and along it, both of about the same
    length; level ground takes y and x."""
    turn = np.arctan2(p[1], p[0]) * np.float32(count / (2 * np.pi))
    unit = np.float32(2.2 / count)
    level = np.abs(n[2]) > 0.8
    return np.where(level, p[1] / unit, turn), np.where(level, p[0] / unit, p[2] / unit)


def stripes(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    along = np.where(np.abs(n[2]) > 0.97, p[0], p[2])
    return _square(along / np.float32(0.14) + np.float32(0.25))


def spiral(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """A winding band; on level ground it follows the radius."""
    turn = np.arctan2(p[1], p[0]) / np.float32(2 * np.pi)
    along = np.where(np.abs(n[2]) > 0.9, np.hypot(p[0], p[1]), p[2])
    return _square(along / np.float32(0.2) + turn)


def checker(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    turn, rise = _around(p, n, 16.0)
    return np.abs(_square(0.5 * turn, edge=0.02) - _square(0.5 * rise + 0.25, edge=0.02))


def gradient(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    return smoothstep(-0.45, 0.45, p[2])


def marble(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    bent = 2.2 * fractal_noise(p * 4.0, seed) + 0.6 * fractal_noise(p * 11.0, seed + 7)
    vein = np.abs(np.sin(np.float32(np.pi) * (2.2 * p[0] + 1.7 * p[1] + 2.0 * p[2] + 2.0 * bent)))
    return 0.85 * (1.0 - smoothstep(0.0, 0.28, vein))


def zigzag(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    turn, rise = _around(p, n, 14.0)
    wave = np.abs(turn - np.round(turn))
    return _square(rise + 1.4 * wave)


def plaid(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    turn, rise = _around(p, n, 12.0)
    wide = 0.45 * (_square(turn, 0.5) + _square(rise, 0.5))
    thin = np.maximum(_square(turn + 0.5, 0.1), _square(rise + 0.5, 0.1))
    return np.clip(wide + 0.5 * thin, 0.0, 1.0)


def speckles(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    return smoothstep(0.66, 0.74, noise(p * 24.0, seed))


def grain(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Wood: rings around an axis that lies beside the object, bent by noise."""
    q = p * np.asarray([[7.0], [7.0], [1.4]], np.float32)
    ring = np.hypot(p[0] + 0.55, p[1] - 0.75) * 16.0 + 1.6 * fractal_noise(q, seed, 2)
    return 0.85 * (0.5 + 0.5 * np.sin(np.float32(2 * np.pi) * ring)) ** 2


def bricks(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Mortar between courses of bricks, along whichever of x and y the wall runs."""
    row = p[2] / np.float32(0.055)
    along = np.where(np.abs(n[0]) > np.abs(n[1]), p[1], p[0])
    along = along / np.float32(0.14) + 0.5 * np.mod(np.floor(row), 2.0)
    return np.maximum(_square(row, 0.2, 0.05), _square(along, 0.08, 0.02))


def brushed(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Faint streaks, as on brushed metal."""
    return 0.5 * fractal_noise(p * np.asarray([[6.0], [6.0], [60.0]], np.float32), seed, 2)


def mottled(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Soft blotches, as on stone, clay or moss."""
    return fractal_noise(p * 9.0, seed)


def streaks(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Soft upright streaks around the axis, as on an apple."""
    turn = np.arctan2(p[1], p[0])
    ring = np.stack([np.cos(turn) * 7.0, np.sin(turn) * 7.0, p[2] * 2.0])
    fade = smoothstep(-0.1, 0.5, p[2])
    return smoothstep(0.45, 0.85, fractal_noise(ring.astype(np.float32), seed, 2)) * (0.35 + 0.65 * fade)


def weave(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Wicker: over and under in alternate rows."""
    turn = np.arctan2(p[1], p[0]) / np.float32(2 * np.pi) * 22.0
    row = p[2] / np.float32(0.055)
    return _square(row, 0.2, 0.08) + 0.45 * _square(0.5 * turn + 0.5 * np.floor(row + 0.5), 0.5, 0.1) * (
        1.0 - _square(row, 0.2, 0.08)
    )


def ribs(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Dark creases between lobes: where the surface turns away from the axis's direction."""
    radius = np.maximum(np.hypot(p[0], p[1]), np.float32(1e-6))
    across = np.abs(n[0] * p[1] - n[1] * p[0]) / radius
    return smoothstep(0.35, 0.95, across)


def melon(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Ragged dark bands from pole to pole around the X axis."""
    turn = np.arctan2(p[1], p[2] - 0.02) / np.float32(2 * np.pi) * 9.0
    return _square(turn + 0.35 * fractal_noise(p * 9.0, seed), 0.4, 0.08)


def diamonds(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Lines crossing at a slant, as on a waffle cone or a pineapple."""
    turn = np.arctan2(p[1], p[0]) / np.float32(2 * np.pi) * 9.0
    rise = p[2] / np.float32(0.13)
    return np.maximum(_square(turn + rise, 0.16, 0.07), _square(turn - rise, 0.16, 0.07))


def flutes(p: np.ndarray, n: np.ndarray, seed: int) -> np.ndarray:
    """Upright stripes around the axis."""
    return _square(np.arctan2(p[1], p[0]) / np.float32(2 * np.pi) * 22.0, 0.45, 0.1)


WEIGHTS: dict[str, Weight] = {
    "striped": stripes,
    "checkered": checker,
    "spiral": spiral,
    "gradient": gradient,
    "marbled": marble,
    "zigzag": zigzag,
    "plaid": plaid,
    "speckled": speckles,
    "grain": grain,
    "bricks": bricks,
    "brushed": brushed,
    "mottled": mottled,
    "streaks": streaks,
    "weave": weave,
    "ribs": ribs,
    "melon": melon,
    "diamonds": diamonds,
    "flutes": flutes,
}
"""Patterns that need the point alone; "dotted" needs the surface too (`Dots`)."""


class Dots:
    """Round dots: points near centres that lie on the surface.

    centres: [K, 3] in the object's normalised frame; radius in the same unit
    """

    def __init__(self, centres: np.ndarray, radius: float) -> None:
        from scipy.spatial import cKDTree

        self.radius = radius
        self._tree = cKDTree(centres)

    def __call__(self, p: np.ndarray) -> np.ndarray:
        """Weight [N] of the dots' colour at points [3, N]."""
        distance, _ = self._tree.query(p.T)
        return (1.0 - smoothstep(0.9 * self.radius, 1.1 * self.radius, distance)).astype(np.float32)

    def which(self, p: np.ndarray) -> np.ndarray:
        """Index [N] of the nearest dot."""
        return np.asarray(self._tree.query(p.T)[1])


def spread(points: np.ndarray, spacing: float, generator: np.random.Generator) -> np.ndarray:
    """Some of `points` [N, 3], no two nearer than `spacing` (dart throwing in random order); [K, 3]."""
    from scipy.spatial import cKDTree

    tree = cKDTree(points)
    free = np.ones(len(points), bool)
    chosen = []
    for index in generator.permutation(len(points)):
        if free[index]:
            chosen.append(index)
            free[tree.query_ball_point(points[index], spacing)] = False
    return points[chosen]


__all__ = ["WEIGHTS", "Dots", "fractal_noise", "noise", "smoothstep", "spread"]
