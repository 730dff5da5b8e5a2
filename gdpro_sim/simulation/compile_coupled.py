"""Scene -> Model for several solvers at once: a sub-scene each, and rigid bodies that soft ones meet."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset
from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.meshing.embedding import boundary
from gdpro_sim.meshing.repair import validate
from gdpro_sim.simulation.colliders import Collider, mesh_collider, shape_collider
from gdpro_sim.simulation.compile_mujoco import STIFF
from gdpro_sim.simulation.copies import members
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


def coupled_supports(scene: Scene, options: CoupledOptions, check_part: Callable[[Scene], None]) -> None:
    """Raise SceneError for what the parts cannot do, as far as the scene alone says it.

    check_part: the same for a scene with one solver
    """
    known = [body for body in scene.bodies if body.solver != "auto" or body.mujoco or body.material]
    named = {body.name: part_of(scene, body) for body in known}
    _check_supported(scene, named)
    for _, part_scene in _sub_scenes(scene, options, named):
        check_part(part_scene)


def compile_coupled(
    scene: Scene, options: CoupledOptions, assets: dict[str, Asset], compile_part: Compile
) -> Model:
    """A `Model` with the models of every part; `compile_part` makes the model of a scene with one solver.

    Raises SceneError for what the parts cannot do, and forces between bodies of two of them.
    """
    from gdpro_sim.simulation.coupled.base import base_links  # brings MuJoCo

    named = {body.name: part_of(scene, body, assets[body.name]) for body in scene.bodies}
    _check_supported(scene, named)
    parts: dict[PartName, Model] = {
        part: compile_part(part_scene, assets) for part, part_scene in _sub_scenes(scene, options, named)
    }
    _warn_apart(named)
    links, still = rigid_links(parts["mujoco"])
    of_base, stands = base_links(parts["mujoco"])
    for part in ("fem", "mpm"):
        if part in parts:
            parts[part] = replace(parts[part], colliders=(*parts[part].colliders, *still, *stands))
    if "fem" in parts:
        _warn_small(
            parts["fem"], (*still, *stands, *(c for link in (*links, *of_base) for c in link.colliders))
        )
    numbers = {body.name: (part, k) for part in parts for k, body in enumerate(parts[part].bodies)}
    return _joined(Coupling(
        parts, tuple(numbers[body.name] for body in scene.bodies), (*links, *of_base), step=options.step,
        iterations=options.iterations, tolerance=options.tolerance,
    ))  # fmt: skip


def _joined(coupling: Coupling) -> Model:
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


def _sub_scenes(
    scene: Scene, options: CoupledOptions, named: dict[str, str]
) -> Iterator[tuple[PartName, Scene]]:
    """A scene with one solver for each part that has bodies, and for MuJoCo, whose base may have all."""
    for part in PARTS:
        bodies = tuple(body for body in scene.bodies if named.get(body.name) == part)
        ground = scene.ground
        if part == "mujoco":
            bodies = tuple(as_part(scene, body) for body in bodies)
            if ground is not None and "mpm" in named.values():  # to rigid bodies it is as hard as any
                ground = ground.model_copy(update={"boundary": "separate"})
        elif not bodies:
            continue
        given = getattr(options, part)
        if isinstance(given, FemOptions | MpmOptions):
            # Theirs are per frame.
            steps = math.ceil(1.0 / (scene.fps * options.step) - 1e-9)
            update: dict[str, float] = {"substeps": -(-given.substeps // steps)}
            if "newton_tolerance" not in given.model_fields_set:
                update["newton_tolerance"] = NEWTON_TOLERANCE
            given = given.model_copy(update=update)
        yield (
            part,
            scene.model_copy(
                update={"bodies": bodies, "solver": given, "ground": ground, **_forces(scene, named, part)}
            ),
        )


def _forces(scene: Scene, named: dict[str, str], part: str) -> dict[str, Any]:
    """Springs, attachments and wind on bodies of a part."""
    copies = members(scene.bodies)

    def ours(names: Iterable[str | None]) -> list[str]:
        """Bodies of the part that have one of the names, their own or that of all copies."""
        meant = [body for name in names if name is not None for body in copies[name]]
        return [body for body in dict.fromkeys(meant) if named.get(body) == part]

    winds = [
        air.model_copy(update={"bodies": tuple(ours(named if air.bodies is None else air.bodies))})
        for air in scene.wind
    ]
    return {
        "springs": tuple(item for item in scene.springs if ours(end.body for end in item.ends)),
        "attachments": tuple(item for item in scene.attachments if ours(item.bodies)),
        "wind": tuple(air for air in winds if air.bodies),
    }


# ---- rigid bodies as obstacles ----


def rigid_links(model: Model) -> tuple[tuple[Link, ...], tuple[Collider, ...]]:
    """Rigid bodies of MuJoCo's model that are pushed, and the solids of those that stand or are taken along.

    Raises SceneError.
    """
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
            still += (replace(solid, motion=body.motion) for solid in solids)
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
        if body.mujoco is not None and named.get(body.name) != "mujoco":
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
    ties = [(f"springs[{k}]", [end.body for end in spring.ends]) for k, spring in enumerate(scene.springs)]
    ties += [(f"attachments[{k}]", list(tie.bodies)) for k, tie in enumerate(scene.attachments)]
    copies = members(scene.bodies)
    for place, names in ties:
        held = {name: named[copies[name][0]] for name in names if name and copies[name][0] in named}
        if len(set(held.values())) > 1:
            said = " and ".join(f"{name!r} ({part})" for name, part in held.items())
            raise SceneError(
                f"{scene.name}: {place}: holds bodies of two solvers together, {said}, which meet by contact "
                "alone; give both the same `solver`"
            )
    for k, air in enumerate(scene.wind):
        blown = named if air.bodies is None else [body for name in air.bodies for body in copies[name]]
        unmoved = [name for name in blown if named.get(name) == "mpm"]
        if unmoved:
            raise SceneError(
                f"{scene.name}: wind[{k}].bodies: name the bodies it blows on; MPM's know no wind: "
                f"{', '.join(unmoved)}"
            )


def _warn_apart(named: dict[str, str]) -> None:
    """FEM and MPM have no contact with each other."""
    fem, mpm = ([name for name, part in named.items() if part == kind] for kind in ("fem", "mpm"))
    if fem and mpm:
        log.warning(
            "bodies of FEM (%s) and of MPM (%s) meet rigid ones, but pass through each other",
            ", ".join(fem), ", ".join(mpm),
        )  # fmt: skip


def _warn_small(model: Model, solids: tuple[Collider, ...]) -> None:
    """Tell of obstacles that fit between a FEM body's vertices, which alone touch."""
    for body in model.bodies:
        tets = model.tets[slice(*body.tet_range)]
        corners = model.vertices[boundary(tets)[0]].astype(np.float64)
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        length = float(np.quantile(edges, 0.9))
        # The ball that stands on an equilateral triangle's corners, its middle in their plane.
        small = {item.name: _thickness(item) for item in solids if _thickness(item) < length / math.sqrt(3.0)}
        if small:
            name, size = min(small.items(), key=lambda pair: pair[1])
            wanted = len(tets) * (length / (math.sqrt(3.0) * size)) ** 3
            log.warning(
                "%r (half thickness %.3g m) may sink in between the vertices of %r, which alone touch, up to "
                "%.3g m apart: give %r about %s `tets`", name, size, body.name, length, body.name,
                f"{float(f'{wanted:.1g}'):,.0f}",
            )  # fmt: skip


def _thickness(solid: Collider) -> float:
    """Half of the middle one of a solid's three extents, m: what a plate's edge or a rod has is the least."""
    if solid.kind == "plane":
        return math.inf
    if solid.vertices is not None:
        return float(np.sort(np.ptp(solid.vertices, axis=0))[1]) / 2.0
    return float(np.sort(solid.size)[1]) if solid.kind == "box" else solid.size[0]


__all__ = ["as_part", "compile_coupled", "coupled_supports", "part_of", "rigid_links"]
