"""A compiled scene as one MuJoCo model: ground, obstacles, bodies, and a user's own MJCF under them."""

from __future__ import annotations

import logging
import math
import warnings
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.meshing.convex import decompose, mass_properties
from gdpro_sim.simulation.colliders import Collider
from gdpro_sim.simulation.model import Model
from gdpro_sim.simulation.mujoco import rigid, soft
from gdpro_sim.simulation.mujoco.base import read_base
from gdpro_sim.simulation.mujoco.contacts import (
    DEFAULT,
    FLEX_REFERENCE,
    LEAST,
    add_pair,
    reference,
    set_contact,
)
from gdpro_sim.simulation.mujoco_model import MujocoWorld, RigidBody, Shape, SoftBody

log = logging.getLogger(__name__)

NEWTON_ITERATIONS, CG_ITERATIONS = 100, 500
"""At most, where a scene does not say."""

NEWTON_VERTICES = 1500
"""Of full flexes, up to which Newton's method is used beside rigid bodies that move."""

CONVEX = 0.99
"""A mesh that fills this share of its convex hull is taken as convex."""

FIRM = (0.99, 0.999, 0.001, 0.5, 2.0)
"""`solimp` of what holds two bodies to each other."""

MEMORY = 64 << 20
"""Bytes of MuJoCo's stack and contact arena at least; more where there are many points."""


@dataclass(frozen=True)
class World:
    """A spec and what of it is ours.

    spec:      not yet compiled
    names:     of every body of `Model.bodies`, as the spec knows it
    points:    of every soft body, None for a rigid one
    obstacles: of every collider of `Model.colliders`: the body that is moved, "" where it stands
    obstacle_geoms: of every collider: the names of its geoms
    geoms:     names of all geoms that are not the base's
    renamed:   (our name, the name taken), where the base had ours already
    start:     (qpos, qvel, ctrl) of the base's keyframe that it starts from, or None
    """

    spec: mujoco.MjSpec
    names: tuple[str, ...]
    points: tuple[soft.Points | None, ...]
    obstacles: tuple[str, ...]
    renamed: tuple[tuple[str, str], ...]
    start: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None
    obstacle_geoms: tuple[tuple[str, ...], ...] = ()
    geoms: frozenset[str] = frozenset()


def build(model: Model) -> World:
    """The spec of a model. Raises SceneError for a base that MuJoCo cannot read, or pins it cannot hold."""
    world = model.mujoco
    if world is None:
        raise SceneError("the model has nothing for MuJoCo")
    spec, start = read_base(world)
    taken = _names(spec)
    renamed: list[tuple[str, str]] = []

    def name(wanted: str) -> str:
        free, k = wanted, 2
        while free in taken or any(other.startswith(f"{free}_") for other in taken):
            free, k = f"{wanted}-{k}", k + 1
        if free != wanted:
            renamed.append((wanted, free))
        taken.add(free)
        return free

    _options(spec, model, world)
    step = world.settings.timestep
    geoms: list[
        tuple[float, list[Any], tuple[float, float]]
    ] = []  # friction, geoms, solref of each rigid body
    names = [name(body.name) for body in world.bodies]
    points: list[soft.Points | None] = []
    weight = max(_weight(world), 1.0)
    for body, title in zip(world.bodies, names, strict=True):
        if isinstance(body, RigidBody):
            _, shapes = rigid.add_rigid(spec, body, title, step, weight)
            geoms.append((body.friction, shapes, reference(body.restitution, step)))
            points.append(None)
        else:
            carriers = [(names[tie.body], _rigid(world, tie.body).centre) for tie in body.ties]
            points.append(soft.add_soft(spec, body, title, carriers))
    _weigh(spec, world, names, points)
    _pairs(spec, geoms)
    for a, b in world.welds:
        _weld(spec, names[a], names[b], step)
    ours = [geom.name for _, shapes, _ in geoms for geom in shapes]
    if model.ground is not None:
        floor = spec.worldbody.add_geom(DEFAULT, name=name("ground"), type=mujoco.mjtGeom.mjGEOM_PLANE)
        floor.pos, floor.size = [0.0, 0.0, model.ground.height], [0.0, 0.0, 1.0]
        _passive(floor, 0.0)
        ours.append(floor.name)
    made = [_obstacle(spec, collider, name(collider.name), weight, geoms) for collider in model.colliders]
    return World(
        spec,
        tuple(names),
        tuple(points),
        tuple(moved for moved, _ in made),
        tuple(renamed),
        start,
        tuple(own for _, own in made),
        frozenset([*ours, *(geom for _, own in made for geom in own)]),
    )


def compile_spec(spec: mujoco.MjSpec, where: str = "the scene") -> mujoco.MjModel:
    """Raises SceneError with MuJoCo's own message."""
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            compiled = spec.compile()
        for item in said:
            log.debug("%s: %s", where, " ".join(str(item.message).split()))
        return compiled
    except (ValueError, mujoco.FatalError) as error:
        raise SceneError(f"{where}: MuJoCo cannot compile it: {' '.join(str(error).split())}") from None


def _names(spec: mujoco.MjSpec) -> set[str]:
    """Names of a base that ours must not meet; MuJoCo wants them unique within each kind of thing."""
    kinds = (spec.bodies, spec.joints, spec.geoms, spec.meshes, spec.flexes)
    return {item.name for kind in kinds for item in kind if item.name}


def _options(spec: mujoco.MjSpec, model: Model, world: MujocoWorld) -> None:
    option, settings = spec.option, world.settings
    soft_bodies = [body for body in world.bodies if isinstance(body, SoftBody)]
    option.timestep, option.gravity = settings.timestep, list(model.gravity)
    option.tolerance = settings.tolerance
    option.impratio = settings.impratio
    option.cone = (
        mujoco.mjtCone.mjCONE_ELLIPTIC if settings.cone == "elliptic" else mujoco.mjtCone.mjCONE_PYRAMIDAL
    )
    # A state that is not finite is an error of ours to report, never a reason to start anew.
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
    if soft_bodies:
        # Only this integrator takes the elasticity of flexes implicitly.
        option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
        option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_DIAGEXACT)
        option.solver = mujoco.mjtSolver.mjSOL_CG if _large(world) else mujoco.mjtSolver.mjSOL_NEWTON
        count = sum(len(body.vertices) for body in soft_bodies)
        spec.memory = max(spec.memory, MEMORY + 200_000 * count)
    elif world.base is None:
        # What slides chatters least with the discrete one, but it takes a fifth of every bounce's speed.
        bouncy = any(b.restitution > LEAST for b in world.bodies if isinstance(b, RigidBody))
        kind = mujoco.mjtIntegrator.mjINT_IMPLICIT if bouncy else mujoco.mjtIntegrator.mjINT_DISCRETE
        option.integrator, option.solver = kind, mujoco.mjtSolver.mjSOL_NEWTON
    if settings.solver != "auto":
        newton = settings.solver == "newton"
        option.solver = mujoco.mjtSolver.mjSOL_NEWTON if newton else mujoco.mjtSolver.mjSOL_CG
    conjugate = option.solver == mujoco.mjtSolver.mjSOL_CG
    option.iterations = settings.iterations or (CG_ITERATIONS if conjugate else NEWTON_ITERATIONS)


def _large(world: MujocoWorld) -> bool:
    """Whether conjugate gradients solve the contacts of full flexes sooner than Newton's method.

    They hardly converge where a rigid body that moves touches a flex: it weighs so much more than a vertex.
    """
    full = [body for body in world.bodies if isinstance(body, SoftBody) and body.reduction == "full"]
    moving = world.base is not None or any(
        isinstance(body, RigidBody) and body.joint.kind != "fixed" for body in world.bodies
    )
    return bool(full) and not (moving and sum(len(body.vertices) for body in full) <= NEWTON_VERTICES)


def _rigid(world: MujocoWorld, number: int) -> RigidBody:
    body = world.bodies[number]
    assert isinstance(body, RigidBody)
    return body


def _weigh(
    spec: mujoco.MjSpec, world: MujocoWorld, names: list[str], points: list[soft.Points | None]
) -> None:
    """Give rigid bodies the mass of what is tied to them; those that are driven are heavy enough."""
    tied = {tie.body for body in world.bodies if isinstance(body, SoftBody) for tie in body.ties}
    for number in sorted(number for number in tied if _rigid(world, number).motion is None):
        carried = [item for item in points if item is not None]
        chosen = [np.array([owner == names[number] for owner in item.owners]) for item in carried]
        where = np.concatenate([item.positions[own] for item, own in zip(carried, chosen, strict=True)])
        mass = np.concatenate([item.masses[own] for item, own in zip(carried, chosen, strict=True)])
        rigid.load_mass(spec.body(names[number]), _rigid(world, number), where, mass)


def _weld(spec: mujoco.MjSpec, a: str, b: str, step: float) -> None:
    """Hold two bodies to each other as they stand; they do not touch then."""
    held = spec.add_equality(DEFAULT, type=mujoco.mjtEq.mjEQ_WELD, objtype=mujoco.mjtObj.mjOBJ_BODY)
    held.name1, held.name2 = a, b
    data = np.zeros_like(held.data)  # a relative pose without a quaternion is that of the start
    data[10] = 1.0  # torques count as much as forces
    held.data = data
    held.solref, held.solimp = [2.0 * step, 1.0], list(FIRM)
    spec.add_exclude(bodyname1=a, bodyname2=b)


def _passive(geom: Any, friction: float) -> None:
    """A geom whose partner decides: friction and stiffness are the larger of two."""
    geom.rgba = [0.85, 0.85, 0.85, 1.0]
    set_contact(geom, friction, FLEX_REFERENCE)


def _weight(world: MujocoWorld) -> float:
    return sum(
        body.mass if isinstance(body, RigidBody) else float(body.masses.sum()) for body in world.bodies
    )


def _pairs(spec: mujoco.MjSpec, geoms: list[tuple[float, list[Any], tuple[float, float]]]) -> None:
    """Friction between rigid bodies is the geometric mean of theirs; MuJoCo would take the larger."""
    for i, (a, shapes, first) in enumerate(geoms):
        for b, others, second in geoms[i + 1 :]:
            if a != b:
                solref = (min(first[0], second[0]), min(first[1], second[1]))
                for one in shapes:
                    for other in others:
                        add_pair(spec, one, other, math.sqrt(a * b), solref)


def _obstacle(
    spec: mujoco.MjSpec,
    collider: Collider,
    title: str,
    weight: float,
    geoms: list[tuple[float, list[Any], tuple[float, float]]],
) -> tuple[str, tuple[str, ...]]:
    """Geoms of an obstacle; returns the body that moves it, "" where it stands still, and their names."""
    parent, shift = spec.worldbody, collider.position
    if collider.motion is not None:
        parent = rigid.add_driven(spec, title, weight, max(*collider.size, 0.1))
        parent.pos, parent.quat = collider.position.tolist(), rigid.quaternion(collider.rotation)
        shift, turn = np.zeros(3), np.eye(3)
    else:
        turn = collider.rotation
    if collider.kind == "plane":
        geom = parent.add_geom(DEFAULT, name=title, type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 1.0])
        geom.pos, geom.quat = shift.tolist(), rigid.quaternion(turn)
        made = [geom]
    elif collider.heights is not None:
        geom = _terrain(spec, parent, collider, title)
        geom.pos, geom.quat = (turn @ _middle(collider) + shift).tolist(), rigid.quaternion(turn)
        made = [geom]
    else:
        placed = [
            Shape(s.kind, s.size, turn @ s.position + shift, turn @ s.rotation, s.vertices, s.faces)
            for s in _shapes(collider)
        ]
        made = rigid.add_shapes(spec, parent, tuple(placed), title, 0.0, FLEX_REFERENCE)
    for geom in made:
        _passive(geom, collider.friction or 0.0)
    if collider.friction is not None:
        for friction, shapes, solref in geoms:
            for shape in shapes:
                for geom in made:
                    add_pair(spec, shape, geom, math.sqrt(friction * collider.friction), solref)
    return title if collider.motion is not None else "", tuple(geom.name for geom in made)


def _terrain(spec: mujoco.MjSpec, parent: Any, collider: Collider, title: str) -> Any:
    assert collider.heights is not None and collider.vertices is not None
    rows, columns = collider.heights.shape
    low, high = collider.vertices.min(axis=0), collider.vertices.max(axis=0)
    least = float(collider.heights.min())
    span = max(float(np.ptp(collider.heights)), 1e-6 * float(high[0] - low[0]))  # MuJoCo takes no flat ones
    spec.add_hfield(
        name=title, nrow=rows, ncol=columns, userdata=((collider.heights - least) / span).ravel().tolist(),
        size=[*(0.5 * (high - low)[:2]).tolist(), span, least - float(low[2])],
    )  # fmt: skip
    return parent.add_geom(DEFAULT, name=title, type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname=title)


def _middle(collider: Collider) -> np.ndarray:
    """[3] m of a terrain: under its middle, where its lowest point is."""
    assert collider.heights is not None and collider.vertices is not None
    low, high = collider.vertices.min(axis=0), collider.vertices.max(axis=0)
    return np.array([*(0.5 * (low + high)[:2]), float(collider.heights.min())])


def _shapes(collider: Collider) -> list[Shape]:
    if collider.kind == "mesh":
        assert collider.vertices is not None and collider.faces is not None
        return mesh_shapes(collider.name, collider.vertices, collider.faces)
    size = {"box": 3, "sphere": 1, "capsule": 2, "cylinder": 2}[collider.kind]
    return [Shape(collider.kind, collider.size[:size])]  # type: ignore[arg-type]


def mesh_shapes(name: str, vertices: np.ndarray, faces: np.ndarray) -> list[Shape]:
    """Convex pieces of an obstacle's mesh; one where it is convex. Raises SceneError."""
    try:
        hull = next(iter(decompose(vertices, faces, most=1)))
        share = mass_properties(vertices, faces).volume / mass_properties(*hull).volume
        pieces = [hull] if share > CONVEX else list(decompose(vertices, faces))
    except MeshError as error:
        raise SceneError(f"collider {name!r}: {error}") from None
    return [Shape("mesh", vertices=v, faces=f) for v, f in pieces]


__all__ = ["World", "build", "compile_spec", "mesh_shapes"]
