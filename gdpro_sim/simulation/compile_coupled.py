"""Scene -> Model for several solvers at once: a sub-scene each, and rigid bodies that soft ones meet."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gdpro_sim.asset import Asset
from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.meshing.repair import validate
from gdpro_sim.simulation.colliders import Collider, mesh_collider, shape_collider
from gdpro_sim.simulation.compile_mujoco import STIFF
from gdpro_sim.simulation.model import Body, Coupling, Link, Model, PartName
from gdpro_sim.simulation.mujoco_model import RigidBody, Shape
from gdpro_sim.simulation.mujoco_options import MujocoBody
from gdpro_sim.simulation.placement import material_of
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody
from gdpro_sim.simulation.solver_options import CoupledOptions, FemOptions, MpmOptions

log = logging.getLogger(__name__)

PARTS: tuple[PartName, ...] = ("fem", "mpm", "mujoco")

NEWTON_TOLERANCE = 1e-4
"""m/s, of implicit soft bodies where the scene does not say: what they leave over a light rigid body feels
times the ratio of masses."""

Compile = Callable[[Scene, dict[str, Asset]], Model]


def part_of(scene: Scene, body: SceneBody, asset: Asset | None = None) -> str:
    """Which solver a body is for: the scene's, or in a coupled scene its own.

    asset: its own material counts where the scene gives none; None: a mesh has none
    """
    if not isinstance(scene.solver, CoupledOptions):
        return scene.solver.kind
    if body.solver != "auto":
        return body.solver
    if body.mujoco is not None:
        return "mujoco"
    material = body.material if asset is None else material_of(body, asset)
    loose = asset is not None and asset.gaussians.is_loose
    if body.parts or body.particles or loose or (material and material.mpm_only() is not None):
        return "mpm"
    return "mujoco" if material and material.young >= STIFF else "fem"


def as_part(scene: Scene, body: SceneBody) -> SceneBody:
    """A body as MuJoCo gets it: rigid in a coupled scene. Raises SceneError for what is said to be soft."""
    own = body.mujoco or MujocoBody()
    if not isinstance(scene.solver, CoupledOptions) or own.form == "rigid":
        return body
    if own.form != "auto" or "self_contact" in own.model_fields_set:
        said = f"form: {own.form}" if own.form != "auto" else "self_contact"
        raise SceneError(
            f"{scene.name}: bodies[{body.name}].mujoco.{said}: bodies of MuJoCo are rigid in a coupled "
            "scene; leave it out, or write `solver: fem` for a soft one"
        )
    return body.model_copy(update={"mujoco": own.model_copy(update={"form": "rigid"})})


def compile_coupled(
    scene: Scene, options: CoupledOptions, assets: dict[str, Asset], compile_part: Compile
) -> Model:
    """A `Model` with the models of every part; `compile_part` makes the model of a scene with one solver.

    Raises SceneError for what the parts cannot do, and forces that act on bodies of other parts.
    """
    kinds = [part_of(scene, body, assets[body.name]) for body in scene.bodies]
    named = {body.name: kind for body, kind in zip(scene.bodies, kinds, strict=True)}
    _check_supported(scene, named)
    parts: dict[PartName, Model] = {}
    places: list[tuple[PartName, int]] = [("fem", 0)] * len(kinds)
    for part in PARTS:
        chosen = [k for k, kind in enumerate(kinds) if kind == part]
        if chosen or part == "mujoco":
            for number, k in enumerate(chosen):
                places[k] = (part, number)
            parts[part] = compile_part(_sub_scene(scene, options, part, chosen), assets)
    _warn_apart(named)
    from gdpro_sim.simulation.coupled.base import base_links  # brings MuJoCo

    links, still = rigid_links(parts["mujoco"])
    more, stands = base_links(parts["mujoco"])
    links, still = (*links, *more), (*still, *stands)
    for part in ("fem", "mpm"):
        if part in parts:
            parts[part] = replace(parts[part], colliders=(*parts[part].colliders, *still))
    return _joined(scene, Coupling(
        parts, tuple(places), links, step=options.step, iterations=options.iterations,
        tolerance=options.tolerance,
    ))  # fmt: skip


def _joined(scene: Scene, coupling: Coupling) -> Model:
    """The whole: arrays of every part, bodies in the scene's order."""
    parts = coupling.parts
    bodies: list[Body] = []
    for part, number in coupling.places:
        body = parts[part].bodies[number]
        bodies.append(body if part != "mujoco" else replace(body, vertex_range=(0, 0), tet_range=(0, 0)))
    rigid = parts["mujoco"]
    base = parts.get("fem", parts.get("mpm", rigid))
    return replace(
        base,
        bodies=tuple(bodies),
        colliders=rigid.colliders,
        particles=parts["mpm"].particles if "mpm" in parts else None,
        mpm=parts["mpm"].mpm if "mpm" in parts else base.mpm,
        mujoco=rigid.mujoco,
        coupling=coupling,
    )


def _sub_scene(scene: Scene, options: CoupledOptions, part: PartName, chosen: list[int]) -> Scene:
    bodies = tuple(scene.bodies[k] for k in chosen)
    if part == "mujoco":
        bodies = tuple(as_part(scene, body) for body in bodies)
    given = getattr(options, part)
    if isinstance(given, FemOptions | MpmOptions):
        # Theirs are per frame.
        steps = math.ceil(1.0 / (scene.fps * options.step) - 1e-9)
        update: dict[str, float] = {"substeps": -(-given.substeps // steps)}
        if "newton_tolerance" not in given.model_fields_set:
            update["newton_tolerance"] = NEWTON_TOLERANCE
        given = given.model_copy(update=update)
    forces = {} if part == "fem" else {"springs": (), "attachments": (), "wind": ()}
    return scene.model_copy(update={"bodies": bodies, "solver": given, **forces})


# ---- rigid bodies as obstacles ----


def rigid_links(model: Model) -> tuple[tuple[Link, ...], tuple[Collider, ...]]:
    """Rigid bodies of MuJoCo's model that move, and the solids of those that stand. Raises SceneError."""
    assert model.mujoco is not None
    links: list[Link] = []
    still: list[Collider] = []
    for k, body in enumerate(model.mujoco.bodies):
        assert isinstance(body, RigidBody)
        solids = tuple(_solid(body, shape) for shape in body.shapes)
        if len(solids) > 1:
            faces = model.bodies[k].gaussians.faces.cpu().numpy()
            report = validate(body.surface, faces)
            if report.watertight and report.volume > 0.0:  # better than its convex pieces
                solids = (_meshed(body, body.surface, faces, np.zeros(3)),)
        if body.joint.kind == "fixed":
            still += solids
        else:
            links.append(Link(k, of_base=False, colliders=solids))
    return tuple(links), tuple(still)


def _solid(body: RigidBody, shape: Shape) -> Collider:
    position = body.centre + shape.position
    if shape.kind == "mesh":
        assert shape.vertices is not None and shape.faces is not None
        return _meshed(body, shape.vertices, shape.faces, position)
    return shape_collider(
        shape.kind, shape.size, name=body.name, position=position, rotation=shape.rotation,
        friction=body.friction, visible=False,
    )  # fmt: skip


def _meshed(body: RigidBody, vertices: np.ndarray, faces: np.ndarray, position: np.ndarray) -> Collider:
    try:
        return mesh_collider(
            vertices, faces, name=body.name, position=position, friction=body.friction, visible=False
        )
    except MeshError as error:
        raise SceneError(f"body {body.name!r}: {error}") from None


# ---- checks ----


def _check_supported(scene: Scene, named: dict[str, str]) -> None:
    """Raise SceneError for what no part can do with the bodies it has."""
    for body in scene.bodies:
        if body.mujoco is not None and named[body.name] != "mujoco":
            raise SceneError(
                f"{scene.name}: bodies[{body.name}].mujoco: belongs to MuJoCo, but the body's solver is "
                f"{named[body.name]}"
            )
    for k, collider in enumerate(scene.colliders):
        if collider.mass is not None:
            raise SceneError(
                f"{scene.name}: colliders[{k}].mass: in a coupled scene what moves freely is a body with "
                "`solver: mujoco`"
            )
    ours = [name for name, part in named.items() if part == "fem"]
    used = [
        *((f"springs[{k}]", end.body) for k, spring in enumerate(scene.springs) for end in spring.ends),
        *((f"attachments[{k}]", name) for k, ties in enumerate(scene.attachments) for name in ties.bodies),
        *(
            (f"wind[{k}]", name)
            for k, air in enumerate(scene.wind)
            for name in (named if air.bodies is None else air.bodies)
        ),
    ]
    for place, name in used:
        if name is not None and named[name] != "fem":
            raise SceneError(
                f"{scene.name}: {place}: acts on bodies of FEM alone, but the solver of {name!r} is "
                f"{named[name]}; FEM's are: {', '.join(ours) or 'none'}"
            )


def _warn_apart(named: dict[str, str]) -> None:
    """FEM and MPM have no contact with each other."""
    fem, mpm = ([name for name, part in named.items() if part == kind] for kind in ("fem", "mpm"))
    if fem and mpm:
        log.warning(
            "bodies of FEM (%s) and of MPM (%s) meet rigid ones, but pass through each other",
            ", ".join(fem), ", ".join(mpm),
        )  # fmt: skip


__all__ = ["as_part", "compile_coupled", "part_of", "rigid_links"]
