"""Soft bodies as MuJoCo flexes, with masses of their own: MuJoCo would share a body's mass evenly."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.errors import SceneError
from gdpro_sim.simulation.mujoco.contacts import DEFAULT, FLEX_REFERENCE, set_contact
from gdpro_sim.simulation.mujoco.rigid import COLOR, add_driven
from gdpro_sim.simulation.mujoco_model import SoftBody

LEAST_NODE = 1e-3
"""A node of a grid has at least this share of the mean node's mass: the body may not reach it."""

LIGHT = 0.3
"""A node whose cells are all less full than this goes with another: it would flutter."""

HELD = 0.5
"""A node is held where pinned vertices make up this share of what it carries."""


@dataclass(frozen=True)
class Points:
    """What moves of a flex: vertices, or nodes of a grid.

    positions: [n, 3] m; masses: [n] kg
    names:     of their bodies, empty for what is held, or goes with another
    owners:    of the bodies that carry them, their own or others
    local:     [n, 3] m, where they are in their owners' frames
    """

    positions: np.ndarray
    masses: np.ndarray
    names: tuple[str, ...]
    owners: tuple[str, ...]
    local: np.ndarray


def add_soft(
    spec: mujoco.MjSpec, body: SoftBody, name: str, carriers: Sequence[tuple[str, np.ndarray]] = ()
) -> Points:
    """The flex, a body for every free vertex or node, and one for every motion of pins. Raises SceneError.

    carriers: name and centre [3] m of the rigid body of each of the body's ties
    """
    held = np.zeros(len(body.vertices), bool) if body.pinned is None else body.pinned.copy()
    driver = np.full(len(body.vertices), -1)
    drivers = [(pin_name(name, k), np.zeros(3)) for k in range(len(body.motions))]
    for k, motion in enumerate(body.motions):
        driver[motion.vertices] = k
    for k, tie in enumerate(body.ties, len(drivers)):
        driver[tie.vertices], held[tie.vertices] = k, True
    drivers += carriers
    positions, masses = body.vertices, body.masses
    leader = np.arange(len(positions))
    if body.reduction != "full":
        positions, weights = grid(body)
        masses, held, driver = _of_nodes(body, weights, held, driver)
        leader = _leaders(body, positions, held)
        masses = np.bincount(leader, weights=masses, minlength=len(masses))
    for k in range(len(body.motions)):
        add_driven(spec, pin_name(name, k), float(body.masses.sum()))
    names = [""] * len(positions)
    least = 1e-12
    for i in np.flatnonzero(~held & (leader == np.arange(len(positions)))).tolist():
        names[i] = f"{name}_{i}"
        point = spec.worldbody.add_body(name=names[i], pos=positions[i].tolist())
        point.explicitinertial, point.mass = True, max(float(masses[i]), least)
        point.ipos, point.inertia = [0.0, 0.0, 0.0], [1e-6 * max(float(masses[i]), least)] * 3
        for axis in np.eye(3).tolist():
            point.add_joint(DEFAULT, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    owners = [
        names[leader[i]] or (drivers[driver[i]][0] if driver[i] >= 0 else "world")
        for i in range(len(positions))
    ]
    origins = np.stack([np.zeros(3), *(origin for _, origin in drivers)])[driver + 1]
    local = positions - np.where(held[:, None], origins, positions[leader])
    flex = spec.add_flex(name=name, dim=3)
    flex.elem = body.tets.ravel().tolist()
    if body.reduction == "full":
        flex.vertbody = owners
        if held.any():
            flex.vert = local.ravel().tolist()
    else:
        flex.order = 1 if body.reduction == "trilinear" else 2
        flex.cellcount = list(body.cells)
        flex.nodebody = owners
        flex.node = local.ravel().tolist()
        flex.vertbody = ["world"] * len(body.vertices)
        flex.vert = body.vertices.ravel().tolist()
    flex.young, flex.poisson, flex.damping = body.young, body.poisson, body.damping
    flex.elastic3d = int(body.stable)
    flex.radius, flex.rgba = body.radius, list(COLOR)
    flex.selfcollide = (
        mujoco.mjtFlexSelf.mjFLEXSELF_AUTO if body.self_contact else mujoco.mjtFlexSelf.mjFLEXSELF_NONE
    )
    set_contact(flex, body.friction, FLEX_REFERENCE)
    return Points(positions, masses, tuple(names), tuple(owners), local)


def pin_name(name: str, k: int) -> str:
    """Of the body that motion `k` of a soft body moves."""
    return f"{name}_pin{k}"


def grid(body: SoftBody) -> tuple[np.ndarray, np.ndarray]:
    """Nodes [n, 3] m of the grid around a body, Z fastest, and their weights [P, n] at its vertices."""
    low, high = _box(body)
    order = 1 if body.reduction == "trilinear" else 2
    counts = [order * c + 1 for c in body.cells]
    axes = [np.linspace(a, b, n) for a, b, n in zip(low, high, counts, strict=True)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    each = []
    for axis, (a, b, cells, count) in enumerate(zip(low, high, body.cells, counts, strict=True)):
        at = (body.vertices[:, axis] - a) / (b - a) * cells
        cell = np.clip(at.astype(int), 0, cells - 1)
        t = at - cell
        values = [1.0 - t, t] if order == 1 else [(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)]
        weights = np.zeros((len(at), count))
        rows = np.arange(len(at))
        for k, value in enumerate(values):
            weights[rows, order * cell + k] += value
        each.append(weights)
    return nodes, np.einsum("pi,pj,pk->pijk", *each).reshape(len(body.vertices), -1)


def _box(body: SoftBody) -> tuple[np.ndarray, np.ndarray]:
    """Corners of the grid [3], [3] m: around the body, and so that all nodes are numbers of six digits.

    MJCF keeps no more, and a grid must be a grid still when it is read back.
    """
    low, high = body.vertices.min(axis=0), body.vertices.max(axis=0)
    intervals = np.asarray(body.cells) * (1 if body.reduction == "trilinear" else 2)
    unit = 10.0 ** (math.floor(math.log10(float(np.abs([low, high]).max()))) - 5)
    first = np.floor(low / unit)
    step = np.ceil((high / unit - first) / intervals)
    return first * unit, (first + step * intervals) * unit


def _leaders(body: SoftBody, positions: np.ndarray, held: np.ndarray) -> np.ndarray:
    """[n] the node that each goes with: itself, or the nearest free one where the body does not reach it.

    MuJoCo lets nothing move by itself that has no elasticity, and what has little flutters.
    """
    free = ~held & (_filling(body) > LIGHT)
    leader = np.arange(len(positions))
    loose = ~held & ~free
    if loose.any() and free.any():
        leader[loose] = np.flatnonzero(free)[cKDTree(positions[free]).query(positions[loose])[1]]
    return leader


def _filling(body: SoftBody) -> np.ndarray:
    """[n] of each node: how full of tets the fullest of its cells is, 1 being full."""
    low, high = _box(body)
    cells, order = np.asarray(body.cells), 1 if body.reduction == "trilinear" else 2
    corners = body.vertices[body.tets]
    at = np.clip(((corners.mean(axis=1) - low) / (high - low) * cells).astype(int), 0, cells - 1)
    volumes = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    full = np.zeros(cells)
    np.add.at(full, tuple(at.T), volumes / ((high - low) / cells).prod())
    found = np.zeros(order * cells + 1)
    for i, j, k in np.argwhere(full > 0.0):
        x, y, z = (slice(order * c, order * c + order + 1) for c in (i, j, k))
        found[x, y, z] = np.maximum(found[x, y, z], full[i, j, k])
    return found.ravel()


def _of_nodes(
    body: SoftBody, weights: np.ndarray, pinned: np.ndarray, driver: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Masses [n], held [n] and drivers [n] of the nodes that carry vertices by `weights` [P, n]."""
    total = body.masses.sum()
    if body.reduction == "trilinear":
        masses = body.masses @ weights
    else:  # row sums may be negative; diagonal scaling is not (Hinton, Rock & Zienkiewicz 1976)
        masses = body.masses @ weights**2
    masses = np.maximum(masses, LEAST_NODE * total / weights.shape[1])
    masses *= total / masses.sum()
    carried = (weights**2).sum(axis=0) + 1e-12
    held = (weights[pinned] ** 2).sum(axis=0) > HELD * carried
    if pinned.any() and not held.any():
        raise SceneError(
            f"body {body.name!r}: its pins are smaller than a cell of the {body.reduction} grid of "
            f"{list(body.cells)} cells, which can hold none of its nodes; give more `cells`, larger pins, or "
            "`form: full`"
        )
    moved = np.full(weights.shape[1], -1)
    for k in range(len(body.motions)):
        share = (weights[driver == k] ** 2).sum(axis=0)
        moved[held & (share > HELD * carried)] = k
    return masses, held, moved


def velocities(body: SoftBody, positions: np.ndarray) -> np.ndarray:
    """Initial velocities [n, 3] m/s of points that move with the body."""
    return np.cross(np.asarray(body.angular_velocity), positions - body.centre) + np.asarray(body.velocity)


def flex_vertices(data: Any, begin: int, count: int) -> np.ndarray:
    """Positions [count, 3] m of a flex's vertices."""
    return np.asarray(data.flexvert_xpos).reshape(-1, 3)[begin : begin + count]


__all__ = ["Points", "add_soft", "flex_vertices", "grid", "pin_name", "velocities"]
