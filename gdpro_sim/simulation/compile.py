"""Scene -> Model: load the assets, place them in the world, gather tets or particles in one set of arrays."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset, import_mesh, kind, tetrahedralize_asset
from gdpro_sim.errors import SceneError
from gdpro_sim.materials import Material
from gdpro_sim.meshing.tetmesh import TetMesh
from gdpro_sim.simulation.animation_options import AnimationOptions
from gdpro_sim.simulation.collider_shapes import check_not_swallowed
from gdpro_sim.simulation.colliders import MeshCollider, compile_collider
from gdpro_sim.simulation.compile_animation import (
    animated_asset,
    compile_animation,
    motion_file,
    moves_itself,
)
from gdpro_sim.simulation.compile_animation import check_supported as animation_supports
from gdpro_sim.simulation.compile_coupled import as_part, compile_coupled, coupled_supports, part_of
from gdpro_sim.simulation.compile_forces import apply_conditions, distance_outside
from gdpro_sim.simulation.compile_mpm import check_supported as mpm_supports
from gdpro_sim.simulation.compile_mpm import compile_particles
from gdpro_sim.simulation.compile_mujoco import check_base_file, compile_mujoco, prepare
from gdpro_sim.simulation.compile_mujoco import check_supported as mujoco_supports
from gdpro_sim.simulation.copies import colored
from gdpro_sim.simulation.group_materials import materials_at
from gdpro_sim.simulation.model import Body, Ground, Model
from gdpro_sim.simulation.mujoco_options import MujocoOptions
from gdpro_sim.simulation.placement import material_of, place_bodies
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.scene_body import SceneBody
from gdpro_sim.simulation.solver_options import CoupledOptions, FemOptions, MpmOptions

log = logging.getLogger(__name__)


def check_files(scene: Scene) -> None:
    """Raise SceneError for the first file a scene names that does not exist."""
    for body in scene.bodies:
        if body.prompt is not None:
            raise SceneError(
                f"{scene.name}: bodies[{body.name}].prompt: generate it first (`gdpro simulate` and "
                "gdpro_sim.record do), and give the asset's file"
            )
        masks = {f"masks.{name}": mask for name, mask in body.masks.items()}
        for key, reference in {"asset": body.asset, "texture": body.texture, **masks}.items():
            if reference is not None and not scene.resolve(reference).exists():
                path = scene.resolve(reference)
                raise SceneError(f"{scene.name}: bodies[{body.name}].{key}: {path}: no such file")
        if body.animation is not None and not motion_file(scene, body).exists():
            path = motion_file(scene, body)
            raise SceneError(f"{scene.name}: bodies[{body.name}].animation.file: {path}: no such file")
    check_base_file(scene)
    for k, collider in enumerate(scene.colliders):
        if isinstance(collider, MeshCollider) and not scene.resolve(collider.file).exists():
            path = scene.resolve(collider.file)
            raise SceneError(f"{scene.name}: colliders[{k}].file: {path}: no such file")


def load_assets(
    scene: Scene,
    *,
    stored: dict[str, Path] | None = None,
    on_progress: Callable[[str], None] | None = None,
) -> dict[str, Asset]:
    """The asset of every body, with tets where the solver needs them, by body name; meshes are imported.

    Copies of a body share one, in their colours, which stands as it is under the body's own name. `stored`
    names asset files of an earlier run of the same scene, by body: they are taken as they are, because
    tetrahedralization is not repeatable. Raises MeshError, AssetError or SceneError.
    """
    check_files(scene)
    check_supported(scene)
    tell = on_progress or (lambda phase: None)
    assets: dict[str, Asset] = {}
    for body in scene.bodies:
        if body.source not in assets:
            assets[body.source] = (
                Asset.load(stored[body.source])
                if stored and body.source in stored
                else _load_asset(scene, body, tell)
            )
        if body.copied is not None:
            asset = assets[body.source]
            color = body.copied.color
            assets[body.name] = asset if color is None else colored(asset, color)
    return assets


def _load_asset(scene: Scene, body: SceneBody, tell: Callable[[str], None]) -> Asset:
    path = scene.resolve(body.asset)
    tell(f"preparing {body.source}")
    if moves_itself(scene, body):
        asset = animated_asset(scene, body, on_progress=tell)
    elif kind(path) == "asset":
        ignored = [k for k in ("color", "texture", "masks") if getattr(body, k)]
        if ignored:
            raise SceneError(
                f"{scene.name}: bodies[{body.source}].{ignored[0]}: applies to a mesh, but {path.name} is "
                f"an asset with colours and groups of its own; remove the key"
            )
        asset = Asset.load(path)
    else:
        asset = import_mesh(
            path,
            name=body.source,
            budget=body.budget,
            color=body.color,
            texture=None if body.texture is None else scene.resolve(body.texture),
            up=body.up,
            tets=part_of(scene, body) == "fem",
            target_tets=body.tets,
            seed=scene.seed,
            masks={name: scene.resolve(mask) for name, mask in body.masks.items()},
            on_progress=tell,
        )
    part = part_of(scene, body, asset)
    if asset.gaussians.is_loose and part != "mpm":
        raise SceneError(
            f"{scene.name}: body {body.source!r}: {path.name} is a splat cloud without a mesh, which only "
            "MPM can simulate (`solver: {kind: mpm}`); `gdpro generate --from-splat` makes an asset with "
            "a mesh"
        )
    if part == "mujoco":
        asset = prepare(as_part(scene, body), asset, tell)
    if asset.tets is None and part == "fem":
        # At the asset's own size: the caller may place several bodies of one asset at several sizes.
        asset = tetrahedralize_asset(asset, target_tets=body.tets, on_progress=tell)
    if asset.material is None or body.material is not None:
        asset = replace(asset, material=material_of(body, asset))
    if body.material is not None:
        asset = replace(asset, group_materials={})
    return asset


def check_supported(scene: Scene) -> None:
    """Raise SceneError for what the scene's solver cannot do, as far as the scene alone says it."""
    if isinstance(scene.solver, MpmOptions):
        mpm_supports(scene)
    elif isinstance(scene.solver, MujocoOptions):
        mujoco_supports(scene)
    elif isinstance(scene.solver, CoupledOptions):
        coupled_supports(scene, scene.solver, check_supported)
    elif isinstance(scene.solver, AnimationOptions):
        animation_supports(scene)
    elif isinstance(scene.solver, FemOptions):
        _fem_supports(scene)


def _fem_supports(scene: Scene) -> None:
    """Raise SceneError for what only MPM can do."""
    belongs = "belongs to MPM (`solver: {kind: mpm}`)"
    for body in scene.bodies:
        made = () if body.material is None else (body.material,)
        _check_elements(f"{scene.name}: body {body.name!r}", body, made)
        for k, pin in enumerate(body.pins):
            if pin.start > 0.0:
                raise SceneError(f"{scene.name}: bodies[{body.name}].pins[{k}].start: {belongs}")
    if scene.ground is not None and scene.ground.boundary != "separate":
        raise SceneError(f"{scene.name}: ground.boundary: {scene.ground.boundary!r} {belongs}")
    for k, collider in enumerate(scene.colliders):
        key = collider.mpm_only()
        if key is not None:
            raise SceneError(f"{scene.name}: colliders[{k}].{key}: {belongs}")


def compile_scene(scene: Scene, assets: dict[str, Asset], *, device: str = "cpu") -> Model:
    """Place every body and gather the arrays of a `Model` for `device`.

    Raises SceneError where a body starts below the ground, has bad elements or a material that the solver
    cannot simulate, or pins and loads select nothing or contradict themselves.
    """
    options = scene.solver
    if isinstance(options, MpmOptions):
        return compile_particles(scene, options, assets, device=device)
    if isinstance(options, MujocoOptions):
        _tell_one_material(assets)
        return compile_mujoco(scene, options, assets, device=device)
    if isinstance(options, AnimationOptions):
        return compile_animation(scene, assets, device=device)
    if isinstance(options, CoupledOptions):
        return compile_coupled(scene, options, assets, partial(compile_scene, device=device))
    bodies: list[Body] = []
    columns: dict[str, list[np.ndarray]] = {
        key: []
        for key in (
            "vertices", "velocities", "tets", "fill", "young", "poisson", "density",
            "rayleigh_mass", "rayleigh_stiffness", "law", "yield_stress", "hardening", "friction",
            "contact_offset",
        )
    }  # fmt: skip
    vertex_begin = tet_begin = 0
    offsets: dict[int, np.ndarray] = {}
    for body, placement in zip(scene.bodies, place_bodies(scene, assets), strict=True):
        asset = placement.asset
        where = f"{scene.name}: body {body.name!r}"
        if asset.tets is None or asset.embedding is None:
            raise SceneError(f"{where}: its asset has no tetrahedra")
        _check_vertices(where, asset.tets)
        made, matter = materials_at(body, asset, asset.tets.vertices[asset.tets.tets].mean(axis=1))
        _check_elements(where, body, made)
        vertices = placement(asset.tets.vertices)
        centre = _centre_of_mass(asset.tets, vertices, np.array([m.density for m in made])[matter])

        count = len(vertices)
        columns["vertices"].append(vertices.astype(np.float32))
        columns["velocities"].append(placement.velocities(body, vertices, centre))
        columns["tets"].append(asset.tets.tets + np.int32(vertex_begin))
        columns["fill"].append(asset.tets.fill)
        for key in ("young", "poisson", "density", "rayleigh_mass", "rayleigh_stiffness", "hardening"):
            columns[key].append(np.array([getattr(m, key) for m in made], np.float32)[matter])
        yields = [np.inf if m.yield_stress is None else m.yield_stress for m in made]
        columns["yield_stress"].append(np.array(yields, np.float32)[matter])
        columns["law"].append(np.array([m.law for m in made], np.int32)[matter])
        _, touching = materials_at(body, asset, asset.tets.vertices)
        columns["friction"].append(np.array([m.friction for m in made], np.float32)[touching])
        if id(asset.tets) not in offsets:  # copies share theirs
            rest = asset.gaussians.vertices.cpu().numpy().astype(np.float64)
            faces = asset.gaussians.faces.cpu().numpy()
            offsets[id(asset.tets)] = distance_outside(asset.tets.vertices, rest, faces).astype(np.float32)
        columns["contact_offset"].append(offsets[id(asset.tets)])
        bodies.append(
            Body(
                name=body.name,
                gaussians=asset.gaussians.to(device),
                surface=placement.surface,
                embedding=asset.embedding,
                vertex_range=(vertex_begin, vertex_begin + count),
                tet_range=(tet_begin, tet_begin + len(asset.tets.tets)),
                placement=placement,
            )
        )
        vertex_begin += count
        tet_begin += len(asset.tets.tets)
    arrays: dict[str, Any] = {key: np.concatenate(parts) for key, parts in columns.items()}
    model = Model(
        bodies=tuple(bodies),
        **arrays,
        pinned=np.zeros(vertex_begin, bool),
        gravity=scene.gravity,
        ground=None if scene.ground is None else Ground(**scene.ground.model_dump()),
        colliders=tuple(compile_collider(item, scene.resolve) for item in scene.colliders),
        fem=options.settings(),
        device=device,
    )
    check_not_swallowed(scene.name, model)
    return apply_conditions(scene, model)


def _tell_one_material(assets: dict[str, Asset]) -> None:
    for name, asset in assets.items():
        if asset.group_materials and asset.material is not None:
            log.warning(
                "body %r: MuJoCo's bodies are of one material: the density and stiffness of its main one "
                "stand for those of %s", name, ", ".join(map(repr, asset.group_materials)),
            )  # fmt: skip


def _check_elements(where: str, body: SceneBody, made: tuple[Material, ...]) -> None:
    """Raise SceneError for what only MPM can simulate."""
    for material in made:
        reason = material.mpm_only()
        if reason is not None:
            raise SceneError(f"{where}: {reason}")
    for key in ("particles", "parts"):
        if getattr(body, key):
            raise SceneError(f"{where}: `{key}` belongs to MPM (`solver: {{kind: mpm}}`)")


def _check_vertices(where: str, mesh: TetMesh) -> None:
    """Assets refuse elements without volume themselves."""
    used = np.zeros(len(mesh.vertices), bool)
    used[mesh.tets] = True
    if not used.all():
        lone = np.flatnonzero(~used)
        raise SceneError(
            f"{where}: tet vertex {lone[0]} belongs to no tetrahedron ({len(lone)} such); remove them"
        )


def _centre_of_mass(tets: TetMesh, vertices: np.ndarray, density: np.ndarray) -> np.ndarray:
    """Centre of mass [3] of placed tet `vertices` [P, 3]; density [T] kg/m^3."""
    mass = tets.volumes() * tets.fill * density
    return (mass[:, None] * vertices[tets.tets].mean(axis=1)).sum(axis=0) / mass.sum()


__all__ = ["check_files", "check_supported", "compile_scene", "load_assets"]
