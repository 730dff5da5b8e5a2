"""Friction and restitution as MuJoCo takes them.

A contact is a spring and a dashpot on the relative acceleration: a = -k r - b v while it pushes (`solref`
given as (-k, -b)). All rigid bodies share k: of two bodies the less bouncy one, with the larger b, counts.
"""

from __future__ import annotations

import functools
from typing import Any

import mujoco
import numpy as np

STEPS = 0.15
"""k is so that the contact's angular frequency times the time step is this: twenty steps an impact."""

PHASES = 64
"""Begins of an impact within a step that are averaged."""

LEAST = 0.15
"""A smaller restitution asks for so much damping in a step that sliding bodies hop."""

SHARE = 0.95
"""`solimp`: the share of the spring's acceleration in a contact's. Nearer to 1, what slides chatters."""

IMPEDANCE = (SHARE, SHARE, 0.001, 0.5, 2.0)

_OWN = mujoco.MjSpec()
DEFAULT = _OWN.default
"""MuJoCo's own defaults: what we add has none of those that a base sets for its parts."""

FLEX_REFERENCE = (0.01, 1.0)
"""`solref` of what touches a flex: time constant in s, and damping ratio."""


def restitution_of(damping: float | np.ndarray) -> np.ndarray:
    """Speed after an impact over speed before, of damping ratios b / (2 sqrt(k)), in steps of `STEPS`.

    The mean over where in a step the impact begins. In the limit of short steps it is that of a spring and
    dashpot that never pull (Schwager & Poeschel 2007, Granular Matter 9).
    """
    ratio = np.asarray(damping, float)[..., None]
    r = -STEPS * (np.arange(PHASES) + 0.5) / PHASES  # in units of speed over frequency
    v = np.full((*ratio.shape[:-1], PHASES), -1.0)
    for _ in range(int(40.0 / STEPS)):
        v = v + STEPS * np.where(r < 0.0, np.maximum(-r - 2.0 * ratio * v, 0.0), 0.0)
        r = r + STEPS * v
    return np.asarray(np.maximum(v, 0.0).mean(axis=-1))


@functools.cache
def _table() -> tuple[np.ndarray, np.ndarray]:
    """Restitutions [n], rising, and the damping ratios that give them."""
    ratios = np.linspace(2.0, 0.0, 513)
    return restitution_of(ratios), ratios


def damping_of(restitution: float) -> float:
    """The damping ratio with that restitution, in [LEAST, 1]."""
    return 0.0 if restitution >= 1.0 else float(np.interp(restitution, *_table()))


def reference(restitution: float, timestep: float) -> tuple[float, float]:
    """`solref` of a rigid body: (-k, -b)."""
    omega = STEPS / timestep
    return -omega * omega * SHARE, -2.0 * damping_of(max(restitution, LEAST)) * omega


def set_contact(item: Any, friction: float, solref: tuple[float, float], *, condim: int = 3) -> None:
    """Contact parameters of a geom or flex."""
    item.contype = item.conaffinity = 1
    item.condim, item.priority = condim, 0
    item.friction = [friction, 0.005, 0.0001]
    item.solref, item.solimp, item.solmix = list(solref), list(IMPEDANCE), 1.0
    item.margin = item.gap = 0.0


def add_pair(spec: mujoco.MjSpec, a: Any, b: Any, friction: float, solref: tuple[float, float]) -> None:
    """Friction of two geoms that is neither's own."""
    pair = spec.add_pair(DEFAULT)
    pair.geomname1, pair.geomname2 = a.name, b.name
    pair.condim, pair.margin, pair.gap = 3, 0.0, 0.0
    pair.friction = [friction, friction, 0.005, 0.0001, 0.0001]
    pair.solref, pair.solimp = list(solref), list(IMPEDANCE)


__all__ = [
    "DEFAULT",
    "FLEX_REFERENCE",
    "IMPEDANCE",
    "LEAST",
    "add_pair",
    "damping_of",
    "reference",
    "restitution_of",
    "set_contact",
]
