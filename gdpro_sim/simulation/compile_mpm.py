"""Scene -> Model for MPM: bodies filled with particles, and everything checked that can be before a run."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from gdpro_sim.asset import Asset
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import MeshError, SceneError
from gdpro_sim.materials import Material
from gdpro_sim.meshing.fill import Filling, Pattern, fill_bound, fill_tets
from gdpro_sim.meshing.lattice import NO_VOLUME
from gdpro_sim.meshing.repair import validate
from gdpro_sim.simulation.colliders import compile_collider
from gdpro_sim.simulation.compile_forces import Placed, chosen_pins, compile_pushes
from gdpro_sim.simulation.conditions import FOREVER, Hold, Load
from gdpro_sim.simulation.group_materials import materials_at
from gdpro_sim.simulation.model import Body, Ground, Model, MpmSettings, Particles
from gdpro_sim.simulation.mpm.matter import flows
from gdpro_sim.simulation.placement import Placement, place_bodies
from gdpro_sim.simulation.scene import Scene
from gdpro_sim.simulation.solver_options import MpmOptions

PARTICLES = 30_000
"""Of all bodies together, where the scene does not say."""

ROUGH = 24
"""Particles along a body's longest side in the filling that measures its volume."""

NOTHING = 1.0e-7
"""Volume over the longest side's cube below which a body is none: a leaf a thousandth as thick has 1e-3."""

CLOSE = 0.35
"""Particles of two bodies that are nearer than this, in spacings, are in each other: filled space has one
that near to almost a fifth of its points, and bodies that merely touch have hardly any."""

FEW = 20
"""So many are no overlap: surfaces touch."""


def compile_particles(
    scene: Scene, options: MpmOptions, assets: dict[str, Asset], *, device: str = "cpu"
) -> Model:
    """Fill every body with particles where it stands, and gather the arrays of a `Model` for `device`.

    Bodies that flow or tear get surfaces that may come apart. Raises SceneError for what MPM cannot do,
    bodies that cannot be filled, overlap or stand outside the walls, and steps too short or grids too large.
    """
    check_supported(scene)
    placements = place_bodies(scene, assets)
    fillings: Fillings = {}
    spacings, grid_spacing = _resolution(scene, options, placements, fillings)
    materials: dict[Material, int] = {}
    bodies: list[Body] = []
    columns: dict[str, list[np.ndarray]] = {
        key: [] for key in ("positions", "velocities", "volumes", "matter", "gradients")
    }
    begin = 0
    for body, placement, spacing in zip(scene.bodies, placements, spacings, strict=True):
        where = f"{scene.name}: body {body.name!r}"
        filling = _filled(where, placement.asset, spacing, options.fill, scene.seed, fillings)
        points = placement(filling.points)
        volumes = filling.volumes.astype(np.float64)
        count = len(filling)
        own, within = materials_at(body, placement.asset, filling.points)
        made = (*own, *(part.material for part in body.parts))
        if any(item.model == "linear" for item in made):
            raise SceneError(
                f'{where}: the law "linear" means nothing for bodies that turn, and MPM bodies may; choose '
                '"stable_neo_hookean", or the FEM solver'
            )
        if options.integrator == "implicit" and any(flows(item) for item in made):
            raise SceneError(
                f"{where}: its material flows, yields or tears, which the implicit integrator cannot do; use "
                "`integrator: explicit`"
            )
        numbers = np.array([materials.setdefault(item, len(materials)) for item in made], np.int32)
        matter = numbers[within]
        chosen = Placed(scene, body.name, points, begin, "particle", placement)
        for k, part in enumerate(body.parts):
            matter[chosen.select(part, f"parts[{k}]")] = numbers[len(own) + k]
        density = np.array([item.density for item in materials])[matter]
        mass = volumes * density
        centre = (mass[:, None] * points).sum(axis=0) / mass.sum()
        columns["positions"].append(points.astype(np.float32))
        columns["velocities"].append(placement.velocities(body, points, centre))
        spin = np.cross(np.asarray(body.angular_velocity), np.eye(3)).T.astype(np.float32)
        columns["gradients"].append(np.broadcast_to(spin, (count, 3, 3)))
        columns["volumes"].append(filling.volumes)
        columns["matter"].append(matter)
        bodies.append(
            replace(
                _surface(body.name, placement, filling, made, device),
                particle_range=(begin, begin + count),
                placement=placement,
            )
        )
        begin += count
    arrays = {key: np.concatenate(parts) for key, parts in columns.items()}
    total = arrays["volumes"].sum(dtype=np.float64)
    particles = Particles(
        **arrays, materials=tuple(materials), spacing=float((total / len(arrays["volumes"])) ** (1.0 / 3.0))
    )
    settings = options.settings(grid_spacing)
    _check_apart(scene, bodies, particles, grid_spacing / options.particles_per_cell ** (1.0 / 3.0))
    _check_domain(scene, bodies, particles, settings)
    _check_cells(scene, particles, settings, grid_spacing)
    _check_substeps(scene, particles, settings, grid_spacing)
    model = Model.without_tets(
        particles,
        bodies=tuple(bodies),
        gravity=scene.gravity,
        ground=None if scene.ground is None else Ground(**scene.ground.model_dump()),
        mpm=settings,
        colliders=tuple(compile_collider(item, scene.resolve) for item in scene.colliders),
        device=device,
    )
    return _with_conditions(scene, model)


# ---- filling ----


def starting_points(scene: Scene, options: MpmOptions, assets: dict[str, Asset]) -> list[np.ndarray]:
    """Where the particles of each body stand at the start, [n, 3] float64 m each.

    Raises SceneError for bodies that cannot be filled.
    """
    placements = place_bodies(scene, assets)
    fillings: Fillings = {}
    spacings, _ = _resolution(scene, options, placements, fillings)
    found = []
    for body, placement, spacing in zip(scene.bodies, placements, spacings, strict=True):
        where = f"{scene.name}: body {body.name!r}"
        filling = _filled(where, placement.asset, spacing, options.fill, scene.seed, fillings)
        found.append(placement(filling.points))
    return found


Fillings = dict[tuple[int, float, str, int], Filling]


def _resolution(
    scene: Scene, options: MpmOptions, placements: list[Placement], known: Fillings
) -> tuple[list[float], float]:
    """Distance between particles of each body, and the grid's, m."""
    cell = options.particles_per_cell ** (1.0 / 3.0)
    wanted = [body.particles for body in scene.bodies]
    volumes = []
    for body, placement in zip(scene.bodies, placements, strict=True):
        size = float(np.ptp(placement.surface, axis=0).max())
        where = f"{scene.name}: body {body.name!r}"
        rough = _filled(where, placement.asset, size / ROUGH, "lattice", 0, known)
        volume = float(rough.volumes.sum(dtype=np.float64))
        if volume < NOTHING * size**3:
            raise SceneError(f"{where}: {NO_VOLUME}")
        volumes.append(volume)
    if options.grid_spacing is not None:
        common = options.grid_spacing / cell
    else:
        shared = sum(v for v, own in zip(volumes, wanted, strict=True) if own is None)
        common = (shared / (options.particles or PARTICLES)) ** (1.0 / 3.0)
    spacings = [
        common if own is None else (volume / own) ** (1.0 / 3.0)
        for volume, own in zip(volumes, wanted, strict=True)
    ]
    grid_spacing = options.grid_spacing or max(spacings) * cell
    for body, spacing in zip(scene.bodies, spacings, strict=True):
        if spacing > 1.001 * grid_spacing:
            raise SceneError(
                f"{scene.name}: body {body.name!r}: {body.particles:,} particles are {spacing:.3g} m apart, "
                f"more than a cell of {grid_spacing:.3g} m, and would fall apart; give more particles, or a "
                "larger solver.grid_spacing"
            )
    return spacings, grid_spacing


def _filled(
    where: str, asset: Asset, spacing: float, pattern: Pattern, seed: int, known: Fillings
) -> Filling:
    """In the asset's frame: of its mesh; of its tets, where it has some and its mesh is open.

    `known` holds those made before: copies share them.
    """
    key = id(asset.gaussians.vertices), spacing, pattern, seed
    if key not in known:
        known[key] = _fill(where, asset, spacing, pattern, seed)
    return known[key]


def _fill(where: str, asset: Asset, spacing: float, pattern: Pattern, seed: int) -> Filling:
    bound = asset.gaussians
    try:
        if asset.tets is not None:
            faces = bound.faces.cpu().numpy()
            if validate(bound.vertices.cpu().numpy(), faces).boundary_edges:
                return fill_tets(asset.tets, spacing, pattern=pattern, seed=seed)
        return fill_bound(bound, spacing, pattern=pattern, seed=seed)
    except MeshError as error:
        raise SceneError(f"{where}: {error}") from None


def _surface(
    name: str, placement: Placement, filling: Filling, materials: tuple[Material, ...], device: str
) -> Body:
    """The body's look: its own mesh, a surface that may come apart, or a fluid's."""
    asset = placement.asset
    gaussians: BoundGaussians = asset.gaussians
    if all(item.mpm_only() is None for item in materials):
        return Body(name, gaussians.to(device), placement.surface, None)
    # Imported here: most scenes need not wait for it.
    if all(item.model == "fluid" for item in materials):
        from gdpro_sim.simulation.mpm.fluid_look import fluid

        seen = fluid(gaussians, filling)
        return Body(
            name,
            seen.gaussians.to(device),
            placement(seen.gaussians.vertices.numpy()).astype(np.float32),
            None,
            patches=np.repeat(np.arange(len(filling), dtype=np.int32), 3),
            vertex_colors=seen.vertex_colors,
            spacing=filling.spacing,
        )
    from gdpro_sim.simulation.mpm.look import unweld

    soup = unweld(gaussians.to("cpu"), filling, vertex_colors=asset.vertex_colors)
    surface = placement(soup.gaussians.vertices.numpy()).astype(np.float32)
    return Body(
        name,
        soup.gaussians.to(device),
        surface,
        None,
        patches=soup.patches,
        vertex_colors=soup.vertex_colors,
    )


# ---- boundary conditions and loads ----


def _with_conditions(scene: Scene, model: Model) -> Model:
    particles = model.particles
    assert particles is not None
    holds: list[Hold] = []
    loads: list[Load] = []
    density = np.array([item.density for item in particles.materials])
    mass = particles.volumes.astype(np.float64) * density[particles.matter]
    for body, placed in zip(scene.bodies, model.bodies, strict=True):
        part = slice(*placed.particle_range)
        item = Placed(scene, body.name, particles.positions[part], part.start, "particle", placed.placement)
        for pin, ids in zip(body.pins, chosen_pins(body, item), strict=True):
            release = FOREVER if pin.release is None else pin.release
            held = (item.first + ids).astype(np.int32)
            holds.append(Hold(held, item.motion(pin, ids, held) if pin.motion else None, pin.start, release))
        loads += compile_pushes(body, item, mass[part])
    return replace(model, holds=tuple(holds), loads=tuple(loads))


# ---- checks ----


def check_supported(scene: Scene) -> None:
    """Raise SceneError for what only other solvers can do, as far as a scene alone says it."""
    absent = {
        "wind": bool(scene.wind),
        "springs": bool(scene.springs),
        "attachments": bool(scene.attachments),
        **{f"bodies[{body.name}].pressures": bool(body.pressures) for body in scene.bodies},
    }
    for place_, given in absent.items():
        if given:
            raise SceneError(
                f"{scene.name}: {place_}: the MPM solver has none; remove it, or choose the FEM solver"
            )


def _check_apart(scene: Scene, bodies: list[Body], particles: Particles, spacing: float) -> None:
    """Raise SceneError for bodies that overlap."""
    parts = [particles.positions[slice(*body.particle_range)] for body in bodies]
    for (i, a), (j, b) in itertools.combinations(enumerate(parts), 2):
        low = np.maximum(a.min(axis=0), b.min(axis=0)) - spacing
        high = np.minimum(a.max(axis=0), b.max(axis=0)) + spacing
        if (low > high).any():
            continue
        near_a, near_b = (p[((p >= low) & (p <= high)).all(axis=1)] for p in (a, b))
        if not len(near_a) or not len(near_b):
            continue
        distance, _ = cKDTree(near_b).query(near_a, distance_upper_bound=CLOSE * spacing)
        inside = np.isfinite(distance)
        if inside.sum() > FEW:
            middle = _rounded(near_a[inside].mean(axis=0))
            raise SceneError(
                f"{scene.name}: bodies {bodies[i].name!r} and {bodies[j].name!r} overlap at the start, "
                f"around {middle} m; move them apart"
            )


def _rounded(point: np.ndarray) -> list[float]:
    """[3] m for messages."""
    return [float(f"{x:.3g}") + 0.0 for x in point]


def _check_domain(scene: Scene, bodies: list[Body], particles: Particles, settings: MpmSettings) -> None:
    """Raise SceneError for bodies outside the walls."""
    if settings.domain is None:
        return
    low, high = np.asarray(settings.domain)
    for body in bodies:
        points = particles.positions[slice(*body.particle_range)]
        outside = ((points < low) | (points > high)).any(axis=1)
        if outside.any():
            least, most = _rounded(points.min(axis=0)), _rounded(points.max(axis=0))
            raise SceneError(
                f"{scene.name}: body {body.name!r} reaches from {least} to {most} m, outside solver.domain "
                f"{low.tolist()} to {high.tolist()}: move it, or the walls"
            )


def _check_cells(scene: Scene, particles: Particles, settings: MpmSettings, spacing: float) -> None:
    """Raise SceneError where the bodies' box alone has too many cells."""
    size = np.ptp(particles.positions, axis=0)
    cells = math.prod(int(n) for n in np.ceil(size / spacing) + 4)
    if cells > settings.max_cells:
        extent = " x ".join(f"{x:.3g}" for x in size)
        raise SceneError(
            f"{scene.name}: bodies {extent} m apart would need a grid of {cells:,} cells of {spacing:.3g} m "
            f"(at most {settings.max_cells:,}): use fewer particles, a larger solver.grid_spacing, or move "
            "the bodies together"
        )


def _check_substeps(scene: Scene, particles: Particles, settings: MpmSettings, spacing: float) -> None:
    """Raise SceneError where sound alone asks for more explicit substeps a frame than allowed."""
    if settings.integrator != "explicit":
        return
    # Imported here: it brings the solver's kernels.
    from gdpro_sim.simulation.mpm.matter import largest_step, sound_speed

    for material in particles.materials:
        speed = sound_speed(material)
        step = min(settings.cfl * spacing / speed, largest_step(material, spacing))
        count = 1.0 / (scene.fps * step)
        if count > settings.max_substeps:
            name = material.preset or material.model
            raise SceneError(
                f"{scene.name}: {name} of {material.young:.3g} Pa, damping {material.rayleigh_stiffness:.3g} "
                f"s, would take {count:,.0f} substeps a frame on cells of {spacing:.3g} m (at most "
                f"{settings.max_substeps:,}): lower `young` or `rayleigh_stiffness`, use fewer particles, or "
                "the implicit integrator"
            )


__all__ = ["check_supported", "compile_particles", "starting_points"]
