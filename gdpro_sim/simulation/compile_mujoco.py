"""Scene -> Model for MuJoCo: rigid bodies are weighed and given shapes, soft ones become flexes."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from gdpro_sim.asset import Asset, tetrahedralize_asset
from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.materials import FLOW_LAWS, Material
from gdpro_sim.meshing.convex import (
    PRIMITIVES,
    ConvexPieces,
    MassProperties,
    decompose,
    fit_primitive,
    mass_properties,
    tet_mass_properties,
)
from gdpro_sim.meshing.repair import validate
from gdpro_sim.simulation.colliders import PlaneCollider, compile_collider
from gdpro_sim.simulation.compile_forces import Placed, chosen_pins
from gdpro_sim.simulation.compile_mujoco_forces import apply_loads
from gdpro_sim.simulation.conditions import Motion
from gdpro_sim.simulation.model import Body, Ground, Model
from gdpro_sim.simulation.mujoco_model import (
    Control,
    Joint,
    MujocoWorld,
    Reduction,
    RigidBody,
    Shape,
    SoftBody,
)
from gdpro_sim.simulation.mujoco_options import MujocoBody, MujocoOptions
from gdpro_sim.simulation.placement import Placement, material_of, place_bodies
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody

log = logging.getLogger(__name__)

FULL_TETS = 10_000
"""MuJoCo carries no more tets at a useful speed where every vertex moves."""

REDUCED_TETS = 30_000
"""The same where a grid of nodes carries them."""

STIFF = 1e8
"""Pa, from which a body is rigid where the scene does not say."""

CELLS = 4
"""Of a grid along the longest side, where the scene does not say."""

RESTITUTION = {
    "rubber": 0.75, "silicone": 0.5, "foam": 0.3, "plush": 0.2, "wood": 0.5, "leather": 0.3, "paper": 0.2,
    "aluminium": 0.5, "steel": 0.6, "copper": 0.4, "gold": 0.3, "silver": 0.4, "plastic": 0.6, "glass": 0.7,
    "ceramic": 0.5, "brick": 0.3, "stone": 0.4, "concrete": 0.3,
}  # fmt: skip
"""Of materials by preset, against something hard and at a few m/s; chosen, as tables differ widely."""


def form_of(body: SceneBody, asset: Asset) -> str:
    """ "rigid" or how a soft body is reduced."""
    form = (body.mujoco or MujocoBody()).form
    if form != "auto":
        return form
    return "rigid" if material_of(body, asset).young >= STIFF else "full"


def prepare(body: SceneBody, asset: Asset, on_progress: Callable[[str], None]) -> Asset:
    """The asset with what its body needs: tets that MuJoCo carries, or convex pieces. Raises MeshError."""
    form = form_of(body, asset)
    if form == "rigid":
        own = body.mujoco or MujocoBody()
        other = asset.pieces is not None and own.concavity != asset.pieces.concavity
        if own.shape == "pieces" and (
            asset.pieces is None or (other and "concavity" in own.model_fields_set)
        ):
            on_progress("decomposing into convex pieces")
            return replace(asset, pieces=_decomposed(body, asset))
        return asset
    limit = _limit(form)
    if asset.tets is None:
        return tetrahedralize_asset(asset, target_tets=min(body.tets, limit), on_progress=on_progress)
    if len(asset.tets.tets) > limit:
        count = len(asset.tets.tets)
        asset = tetrahedralize_asset(asset, target_tets=limit // 2, on_progress=on_progress)
        assert asset.tets is not None
        log.warning(
            "body %r: %s tets are too many for a %s flex (at most %s); simulated with %s instead, its "
            "look is as it was", body.name, f"{count:,}", form, f"{limit:,}", f"{len(asset.tets.tets):,}",
        )  # fmt: skip
    return asset


def compile_mujoco(
    scene: Scene, options: MujocoOptions, assets: dict[str, Asset], *, device: str = "cpu"
) -> Model:
    """A `Model` of rigid and soft bodies for MuJoCo, which runs on the CPU; Gaussians go to `device`.

    Raises SceneError for what MuJoCo cannot do, meshes that cannot be weighed, and pins that hold nothing.
    """
    check_supported(scene)
    made: list[RigidBody | SoftBody] = []
    bodies: list[Body] = []
    for body, placement in zip(scene.bodies, place_bodies(scene, assets), strict=True):
        where = f"{scene.name}: body {body.name!r}"
        material = material_of(body, placement.asset)
        form = form_of(body, assets[body.name])
        if form == "rigid":
            made.append(_rigid(scene, where, body, placement, material))
        else:
            made.append(_soft(scene, where, body, placement, material, form))  # type: ignore[arg-type]
        bodies.append(
            Body(
                name=body.name,
                gaussians=placement.asset.gaussians.to(device),
                surface=placement.surface,
                embedding=None if form == "rigid" else placement.asset.embedding,
                placement=placement,
            )
        )
    soft = any(isinstance(item, SoftBody) for item in made)
    for item in made:
        if soft and isinstance(item, RigidBody) and item.restitution > 0.5:
            log.warning(
                "body %r: beside soft bodies it bounces at about 0.8 of its restitution of %.2g",
                item.name, item.restitution,
            )  # fmt: skip
    world = replace(_base(scene, options), bodies=tuple(made), settings=options.settings(soft))
    model = Model.without_tets(
        bodies=tuple(bodies),
        gravity=scene.gravity,
        ground=None if scene.ground is None else Ground(scene.ground.height),
        colliders=tuple(compile_collider(item, scene.resolve) for item in scene.colliders),
        device=device,
    )
    return apply_loads(scene, _numbered(replace(model, mujoco=world), assets))


def _base(scene: Scene, options: MujocoOptions) -> MujocoWorld:
    """A world without bodies: the base, and what drives it."""
    return MujocoWorld(
        base=None if options.base is None else scene.resolve(options.base),
        keyframe=options.keyframe,
        controls=tuple(
            Control(name, np.array([key.time for key in keys]), np.array([key.value for key in keys]))
            for name, keys in options.controls.items()
        ),
        callback=options.controller,
    )


def _numbered(model: Model, assets: dict[str, Asset]) -> Model:
    """The model with its bodies' points, the tets of the soft ones, and where each body's begin."""
    world = model.mujoco
    assert world is not None
    firsts = world.firsts()
    tets, fill, bodies = [np.zeros((0, 4), np.int32)], [np.zeros(0, np.float32)], []
    begin = 0
    for body, item, first, end in zip(model.bodies, world.bodies, firsts[:-1], firsts[1:], strict=True):
        count = 0
        mesh = assets[body.name].tets
        if isinstance(item, SoftBody) and mesh is not None:
            count = len(item.tets)
            tets.append(item.tets.astype(np.int32) + np.int32(first))
            fill.append(mesh.fill)
        bodies.append(replace(body, vertex_range=(first, end), tet_range=(begin, begin + count)))
        begin += count
    return replace(
        model,
        bodies=tuple(bodies),
        vertices=np.concatenate([np.zeros((0, 3)), *(item.points for item in world.bodies)]).astype(
            np.float32
        ),
        tets=np.concatenate(tets),
        fill=np.concatenate(fill),
    )


# ---- rigid ----


def _rigid(scene: Scene, where: str, body: SceneBody, placement: Placement, material: Material) -> RigidBody:
    own = body.mujoco or MujocoBody()
    motion = _taken(scene, body, own, placement)
    solid = _weighed(where, placement)
    mass = solid.volume * material.density
    joint = Joint(
        "fixed" if body.pins else own.joint,
        anchor=own.anchor if own.anchor is not None else _three(solid.centre),
        axis=own.axis or Joint().axis,
        damping=own.joint_damping,
        limits=_limits(own),
    )
    restitution = own.restitution
    if restitution is None:
        restitution = RESTITUTION.get(material.preset or "", 0.0)
    return RigidBody(
        name=body.name,
        shapes=_shapes(where, own, placement, solid),
        mass=mass,
        centre=solid.centre,
        inertia=material.density * solid.inertia,
        surface=placement.surface.astype(np.float64),
        joint=joint,
        friction=material.friction,
        restitution=restitution,
        velocity=body.velocity,
        angular_velocity=body.angular_velocity,
        motion=motion,
    )


def _taken(scene: Scene, body: SceneBody, own: MujocoBody, placement: Placement) -> Motion | None:
    """Where its pins take a rigid body: they hold all of it."""
    if not body.pins:
        return None
    where = f"{scene.name}: bodies[{body.name}].pins"
    if own.joint != "free":
        raise SceneError(f"{where}: hold all of a rigid body; leave out `mujoco.joint`, or the pins")
    if len(body.pins) > 1:
        raise SceneError(f"{where}: one holds all of a rigid body; leave out the others")
    item = Placed(scene, body.name, placement.surface, 0, "point", placement)
    (ids,) = chosen_pins(body, item)
    return item.motion(body.pins[0], ids, ids) if body.pins[0].motion else None


def _weighed(where: str, placement: Placement) -> MassProperties:
    """Of the mesh where it is one closed shell, else of the tets: shells may overlap; placed."""
    asset = placement.asset
    vertices = asset.gaussians.vertices.cpu().numpy().astype(np.float64)
    faces = asset.gaussians.faces.cpu().numpy()
    report = validate(vertices, faces)
    closed = report.watertight and report.volume > 0.0
    if closed and (report.components == 1 or asset.tets is None):
        solid = mass_properties(vertices, faces)
    elif asset.tets is not None:
        solid = tet_mass_properties(asset.tets)
    else:
        raise SceneError(
            f"{where}: its mesh is not closed ({report.boundary_edges} open edges), so it has no mass; close "
            "it, or import it with tets"
        )
    turn = placement.turn
    return MassProperties(solid.volume, placement(solid.centre[None])[0], turn @ solid.inertia @ turn.T)


def _shapes(where: str, own: MujocoBody, placement: Placement, solid: MassProperties) -> tuple[Shape, ...]:
    if own.shape in PRIMITIVES:
        fit = fit_primitive(own.shape, solid, placement.turn)  # type: ignore[arg-type]
        return (Shape(fit.kind, fit.size, fit.position - solid.centre, fit.rotation),)
    if own.shape == "hull":
        try:
            pieces = decompose(
                placement.asset.gaussians.vertices.cpu().numpy(),
                placement.asset.gaussians.faces.cpu().numpy(),
                most=1,
            )
        except MeshError as error:
            raise SceneError(f"{where}: {error}") from None
    elif placement.asset.pieces is None:
        raise SceneError(f"{where}: its asset has no convex pieces; choose another `shape`")
    else:
        pieces = placement.asset.pieces
    return tuple(Shape("mesh", vertices=placement(v) - solid.centre, faces=f) for v, f in pieces)


def _decomposed(body: SceneBody, asset: Asset) -> ConvexPieces:
    vertices, faces = asset.gaussians.vertices.cpu().numpy(), asset.gaussians.faces.cpu().numpy()
    try:
        return decompose(vertices, faces, threshold=(body.mujoco or MujocoBody()).concavity)
    except MeshError as error:
        raise MeshError(f"{body.name}: {error}") from error


def _limits(own: MujocoBody) -> tuple[float, float] | None:
    if own.limits is None:
        return None
    low, high = own.limits
    return (float(np.radians(low)), float(np.radians(high))) if own.joint == "hinge" else (low, high)


# ---- soft ----


def _soft(
    scene: Scene, where: str, body: SceneBody, placement: Placement, material: Material, form: Reduction
) -> SoftBody:
    asset = placement.asset
    if material.model in FLOW_LAWS or material.tensile_strength is not None:
        raise SceneError(f"{where}: flows or tears, which MuJoCo cannot simulate: choose the solver `mpm`")
    if asset.tets is None or asset.embedding is None:
        raise SceneError(f"{where}: its asset has no tetrahedra")
    if len(asset.tets.tets) > _limit(form):
        raise SceneError(
            f"{where}: {len(asset.tets.tets):,} tets are too many for a {form} flex (at most "
            f"{_limit(form):,}); import it with fewer, or load it with `load_assets`, which makes fewer"
        )
    law = "stable_neo_hookean" if form == "full" else "stvk"
    if material.model != law or material.yield_stress is not None:
        log.info("%s: the material's law is %s, MuJoCo's is %s", where, material.model, law)
    own = body.mujoco or MujocoBody()
    vertices = placement(asset.tets.vertices)
    mass = asset.tets.volumes() * asset.tets.fill * material.density
    masses = np.bincount(asset.tets.tets.ravel(), weights=np.repeat(mass / 4.0, 4), minlength=len(vertices))
    pinned, motions = _pins(scene, body, vertices, placement)
    if form == "full" and pinned.all():
        raise SceneError(
            f"{where}: its pins hold every vertex of a full flex, which MuJoCo cannot have; let it be rigid "
            "(`mujoco: {form: rigid}`), or pin less"
        )
    size = np.ptp(vertices, axis=0)
    cells = own.cells or tuple(int(n) for n in np.clip(np.round(CELLS * size / size.max()), 1, CELLS))
    return SoftBody(
        name=body.name,
        vertices=vertices,
        tets=asset.tets.tets,
        masses=masses,
        young=material.young,
        poisson=material.poisson,
        damping=material.rayleigh_stiffness,
        friction=material.friction,
        reduction=form,
        cells=(1, 1, 1) if form == "full" else cells,  # type: ignore[arg-type]
        pinned=pinned,
        motions=motions,
        velocity=body.velocity,
        angular_velocity=body.angular_velocity,
        radius=2e-3 * float(size.max()),
        self_contact=own.self_contact,
    )


def _pins(
    scene: Scene, body: SceneBody, vertices: np.ndarray, placement: Placement
) -> tuple[np.ndarray, tuple[Motion, ...]]:
    item = Placed(scene, body.name, vertices, 0, placement=placement)
    pinned = np.zeros(len(vertices), bool)
    motions = []
    for pin, ids in zip(body.pins, chosen_pins(body, item), strict=True):
        fresh = ids[~pinned[ids]]
        pinned[fresh] = True
        if pin.motion and len(fresh):
            motions.append(item.motion(pin, ids, fresh))
    return pinned, tuple(motions)


def _limit(form: str) -> int:
    return FULL_TETS if form == "full" else REDUCED_TETS


def _three(values: np.ndarray) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in values)
    return x, y, z


# ---- checks ----


STUCK = {
    "fixed": ("velocity", "angular_velocity"), "hinge": ("velocity",), "ball": ("velocity",),
    "slide": ("angular_velocity",),
}  # fmt: skip
"""What bodies on a joint cannot start with."""


def check_base_file(scene: Scene) -> None:
    """Raise SceneError where the file of a base does not exist."""
    options = scene.mujoco_options
    if options is not None and options.base is not None and not scene.resolve(options.base).is_file():
        key = "solver.base" if options is scene.solver else "solver.mujoco.base"
        raise SceneError(f"{scene.name}: {key}: {scene.resolve(options.base)}: no such file")


def check_supported(scene: Scene) -> None:
    """Raise SceneError for what only other solvers can do, and for a base that MuJoCo cannot read."""
    for body in scene.bodies:
        for key in ("parts", "particles"):
            if getattr(body, key):
                raise SceneError(
                    f"{scene.name}: bodies[{body.name}].{key}: belongs to MPM (`solver: {{kind: mpm}}`)"
                )
        joint = "free" if body.mujoco is None else body.mujoco.joint
        for key in STUCK.get(joint, ()):
            if any(getattr(body, key)):
                raise SceneError(
                    f"{scene.name}: bodies[{body.name}].{key}: the joint {joint!r} does not let it; leave it "
                    "out"
                )
        for k, pin in enumerate(body.pins):
            if pin.release is not None or pin.start > 0.0:
                raise SceneError(
                    f"{scene.name}: bodies[{body.name}].pins[{k}]: MuJoCo holds its vertices all the time; "
                    "leave out `start` and `release`, or choose the FEM solver"
                )
    if scene.ground is not None and scene.ground.boundary != "separate":
        raise SceneError(f"{scene.name}: ground.boundary: {scene.ground.boundary!r} is MPM's; leave it out")
    for k, collider in enumerate(scene.colliders):
        where = f"{scene.name}: colliders[{k}]"
        if isinstance(collider, PlaneCollider) and collider.motion:
            raise SceneError(f"{where}.motion: a plane stands still in MuJoCo; give a large box")
        if collider.boundary != "separate" or collider.start or collider.end is not None:
            raise SceneError(f"{where}: `boundary`, `start` and `end` are MPM's; leave them out")
        if collider.mass is not None:
            raise SceneError(f"{where}.mass: is MPM's; in MuJoCo make it a body, which is rigid or soft")
    check_base_file(scene)
    options = scene.mujoco_options
    if options is not None and options.base is not None:
        from gdpro_sim.simulation.mujoco.base import read_base  # brings MuJoCo

        read_base(_base(scene, options))


__all__ = [
    "FULL_TETS",
    "REDUCED_TETS",
    "RESTITUTION",
    "check_base_file",
    "check_supported",
    "compile_mujoco",
    "form_of",
    "prepare",
]
