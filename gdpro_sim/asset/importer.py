"""From a mesh file to an asset: read, bind Gaussians, tetrahedralize, embed, and say how it was made."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset.asset import Asset
from gdpro_sim.asset.from_mesh import bind_mesh, vertex_colors
from gdpro_sim.asset.groups import mask_groups, named_groups
from gdpro_sim.asset.prims import to_numpy
from gdpro_sim.asset.stage import kind
from gdpro_sim.errors import AssetError, MeshError
from gdpro_sim.materials import Material
from gdpro_sim.meshing.embedding import embed_surface
from gdpro_sim.meshing.load import USD_SUFFIXES, load_mesh
from gdpro_sim.meshing.surface import SurfaceMesh
from gdpro_sim.meshing.tetrahedralize import tetrahedralize

log = logging.getLogger(__name__)

Phase = Callable[[str], None]

_PACKAGES = ("gdpro-sim", "warp-lang", "trimesh", "pytetwild", "numpy")


def import_mesh(
    path: str | Path,
    *,
    name: str | None = None,
    budget: int = 50_000,
    color: str | None = None,
    texture: str | Path | None = None,
    up: str = "auto",
    scale: float | None = None,
    material: Material | None = None,
    tets: bool = True,
    target_tets: int = 6_000,
    edge_length: float | None = None,
    tet_method: str = "auto",
    seed: int = 0,
    masks: Mapping[str, str | Path] | None = None,
    license: str | None = None,
    on_progress: Phase | None = None,
) -> Asset:
    """Make an asset of a mesh file.

    name:        default: the file's name without its suffix
    budget:      about how many Gaussians
    color, texture, up, scale: as in `gdpro_sim.meshing.load.load_mesh`
    material:    stored in the asset; a scene may override it
    tets:        False leaves them out: enough to show the asset; simulation adds them when it needs them
    target_tets, edge_length (m), tet_method: as in `gdpro_sim.meshing.tetrahedralize.tetrahedralize`
    seed:        of every random draw; Gaussians repeat to the bit, fTetWild's tets do not
    masks:       images over the mesh's UV map by name: what they paint white becomes a vertex group; each of
                 several materials, group of an OBJ and subset of faces in USD is one of its own
    license:     the mesh's, kept in the asset's provenance and in that of what is composed of it
    on_progress: called with the name of each phase as it begins

    >>> import_mesh("bunny.obj", budget=20_000).save("bunny.usdc")  # doctest: +SKIP

    Raises MeshError for a mesh that cannot be read, bound or filled with tets, and AssetError where `path`
    already is one of our own files.
    """
    path = Path(path)
    if path.suffix.lower() in USD_SUFFIXES and path.is_file():
        found = kind(path)
        if found in ("asset", "simulation"):
            way = (
                "use it as it is, without importing" if found == "asset" else "import the mesh it was made of"
            )
            raise AssetError(f"{path} is already a gdpro {found}; {way}")
    if on_progress is not None:
        on_progress("reading the mesh")
    mesh = load_mesh(path, texture=texture, color=color, up=up, scale=scale)
    options = {
        "color": color,
        "texture": None if texture is None else Path(texture).name,
        "up": up,
        "scale": scale,
    }
    asset = bind_asset(
        mesh,
        name=name if name is not None else path.stem,
        source=path,
        options=options,
        budget=budget,
        material=material,
        tets=tets,
        target_tets=target_tets,
        edge_length=edge_length,
        tet_method=tet_method,
        seed=seed,
        on_progress=on_progress,
    )
    if masks:
        painted = mask_groups(path, masks, asset.gaussians, up=up, scale=scale)
        asset = replace(asset, groups={**asset.groups, **painted})
    if license is not None:
        asset = replace(asset, provenance={**asset.provenance, "license": license})
    return asset


def bind_asset(
    mesh: SurfaceMesh,
    *,
    name: str,
    source: Path,
    options: dict[str, Any],
    budget: int = 50_000,
    material: Material | None = None,
    tets: bool = True,
    target_tets: int = 6_000,
    edge_length: float | None = None,
    tet_method: str = "auto",
    seed: int = 0,
    on_progress: Phase | None = None,
) -> Asset:
    """Make an asset of a mesh that was read from `source`; options as in `import_mesh`.

    options: JSON values for the provenance, which say how the mesh was read
    """
    tell: Phase = on_progress or (lambda phase: None)
    for message in mesh.messages:
        log.warning("%s: %s", source.name, message)
    tell("binding Gaussians")
    bound = bind_mesh(mesh, budget=budget, seed=seed)
    provenance: dict[str, Any] = {
        "source": source.name,
        "sha256": mesh.sha256,
        "seed": seed,
        "options": {"budget": budget, **options},
        "messages": list(mesh.messages),
        "versions": versions(),
    }
    asset = Asset(
        name=name,
        gaussians=bound,
        vertex_colors=vertex_colors(mesh, bound),
        material=material,
        provenance=provenance,
        groups=named_groups(mesh, bound),
    )
    if tets:
        asset = tetrahedralize_asset(
            asset,
            surface=(mesh.vertices, mesh.faces),
            target_tets=target_tets,
            edge_length=edge_length,
            method=tet_method,
            on_progress=on_progress,
        )
    log.info("imported %s: %d Gaussians on %d faces", source.name, len(bound), len(bound.faces))
    return asset


def tetrahedralize_asset(
    asset: Asset,
    *,
    surface: tuple[np.ndarray, np.ndarray] | None = None,
    target_tets: int = 6_000,
    edge_length: float | None = None,
    method: str = "auto",
    on_progress: Phase | None = None,
) -> Asset:
    """The asset with fresh tets around its mesh and the mesh embedded in them.

    surface: vertices [V, 3] and faces [F, 3] to fill, where the asset's mesh is a coarser copy of them (mass
    must not depend on the number of Gaussians). Other options as in
    `gdpro_sim.meshing.tetrahedralize.tetrahedralize`; they are added to the provenance.
    Raises MeshError.
    """
    tell: Phase = on_progress or (lambda phase: None)
    vertices = to_numpy(asset.gaussians.vertices)
    filled = surface or (vertices, to_numpy(asset.gaussians.faces))
    tell("filling with tetrahedra")
    try:
        tets = tetrahedralize(*filled, target_tets=target_tets, edge_length=edge_length, method=method)
    except MeshError as error:
        raise MeshError(f"{asset.name}: {error}") from error
    tell("embedding the surface")
    embedding = embed_surface(tets, vertices)
    made = {
        "target_tets": target_tets,
        "edge_length": edge_length,
        "requested_method": method,
        "method": tets.method,
        "versions": versions(),
    }
    return replace(asset, tets=tets, embedding=embedding, provenance={**asset.provenance, "tets": made})


def versions(packages: Sequence[str] = _PACKAGES) -> dict[str, str]:
    """Versions of `packages`, by default this one and those that shape an import; "unknown" if absent."""
    found = {}
    for package in packages:
        try:
            found[package] = metadata.version(package)
        except metadata.PackageNotFoundError:
            found[package] = "unknown"
    return found


__all__ = ["bind_asset", "import_mesh", "tetrahedralize_asset", "versions"]
