"""Small worlds for MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np

from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.model import Ground, Model
from gdpro_sim.simulation.mujoco_model import MujocoSettings, MujocoWorld, RigidBody, Shape, SoftBody
from gdpro_sim.simulation.verification.models import make_model

DENSITY = 1000.0


def world(
    *bodies: RigidBody | SoftBody,
    ground: bool = False,
    colliders: tuple[Collider, ...] = (),
    gravity: tuple[float, float, float] = (0.0, 0.0, -9.81),
    **settings: Any,
) -> Model:
    """A model of bodies that MuJoCo simulates; `settings` are those of `MujocoSettings`."""
    from dataclasses import replace

    empty = make_model(
        np.zeros((0, 3)), np.zeros((0, 4), np.int32), ground=Ground() if ground else None,
        colliders=colliders, gravity=gravity,
    )  # fmt: skip
    return replace(empty, mujoco=MujocoWorld(bodies, MujocoSettings(**settings)))


def box(
    half: tuple[float, float, float],
    centre: np.ndarray,
    rotation: np.ndarray | None = None,
    **options: Any,
) -> RigidBody:
    """A solid box of `DENSITY`; `options` are fields of `RigidBody`."""
    x, y, z = half
    turn = np.eye(3) if rotation is None else rotation
    mass = DENSITY * 8.0 * x * y * z
    inertia = turn @ np.diag([y * y + z * z, x * x + z * z, x * x + y * y]) @ turn.T * mass / 3.0
    shape = Shape("box", half, rotation=turn)
    return RigidBody(
        "box", (shape,), mass, np.asarray(centre, float), inertia, np.asarray(centre, float)[None], **options
    )


def ball(radius: float, height: float, **options: Any) -> RigidBody:
    """A solid ball of `DENSITY` above the origin; `options` are fields of `RigidBody`."""
    mass = DENSITY * 4.0 / 3.0 * np.pi * radius**3
    centre = np.array([0.0, 0.0, height])
    inertia = 0.4 * mass * radius**2 * np.eye(3)
    return RigidBody("ball", (Shape("sphere", (radius,)),), mass, centre, inertia, centre[None], **options)


def flex(vertices: np.ndarray, tets: np.ndarray, young: float, poisson: float, **options: Any) -> SoftBody:
    """A flex of `DENSITY`; `options` are fields of `SoftBody`."""
    corners = vertices[tets]
    mass = DENSITY * np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6.0
    masses = np.bincount(tets.ravel(), weights=np.repeat(mass / 4.0, 4), minlength=len(vertices))
    return SoftBody("flex", vertices, tets, masses, young, poisson, **options)


__all__ = ["DENSITY", "ball", "box", "flex", "world"]
