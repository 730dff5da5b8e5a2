"""Generation as one run of stages: prior, surfels, extraction, bound Gaussians, asset.

Every stage is also a function or class of its own (`priors`, `surfels.SurfelStage`, `extraction.extract`,
`refinement.RefinementStage`); this module only carries results from one to the next, and keeps them in a
`Store` so that a run that was stopped goes on to the same bytes.
"""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
import torch

from gdpro_sim.asset import Asset, tetrahedralize_asset, versions
from gdpro_sim.binding import BoundGaussians
from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.cameras import held_out, view_batch
from gdpro_sim.generation.config import GenerationConfig
from gdpro_sim.generation.evaluation import render
from gdpro_sim.generation.extraction import extract
from gdpro_sim.generation.guidance.views import RenderedGuidance
from gdpro_sim.generation.protocols import CoarseMesh, Guidance, Stage, StepReport, UnitFrame
from gdpro_sim.generation.refinement import RefinementStage
from gdpro_sim.generation.surfels import SurfelStage
from gdpro_sim.materials import Material
from gdpro_sim.meshing.color import SurfaceColors
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh

log = logging.getLogger(__name__)

DEFAULT_HEIGHT = 0.3
"""m, of an object whose prior knows no size."""

PACKAGES = ("gdpro-sim", "warp-lang", "torch", "numpy", "gpytoolbox", "diffusers", "transformers")


@dataclass(frozen=True)
class Source:
    """What a run generates from.

    name:     of the asset
    prompt:   empty where there is none (a mesh, photos, a splat cloud)
    guidance: judges the pictures
    prior:    makes the coarse mesh, in metres; None where `splat` starts the run
    frame:    unit frame of the guidance's pictures; None: around the prior's mesh
    splat:    in the unit frame; takes the place of prior and stage 1
    record:   JSON values for the provenance: prior, inputs with their SHA-256, what a prompt was read as
    """

    name: str
    prompt: str
    guidance: Guidance
    prior: Callable[[], CoarseMesh] | None
    frame: UnitFrame | None
    splat: Gaussians | None = None
    record: Mapping[str, Any] = field(default_factory=dict)


class Store(Protocol):
    """Where a run puts what it must not lose."""

    def load(self, name: str) -> dict[str, torch.Tensor] | None: ...

    def save(self, name: str, tensors: Mapping[str, torch.Tensor]) -> None: ...


class Observer:
    """Told what happens; does nothing. Override what is of interest."""

    def phase(self, name: str) -> None:
        """A part without steps begins: "prior", "extraction", "output"."""

    def stepped(self, stage: Stage, report: StepReport) -> None:
        """One iteration of a stage is done."""

    def finished(
        self, name: str, shown: SurfaceMesh | Gaussians | BoundGaussians, figures: Mapping[str, Any]
    ) -> None:
        """A part is done: "prior", "surfels", "extraction" or "refinement". `shown` is in the unit frame."""


class _Memory:
    """A store for runs that are not to be resumed: keeps nothing."""

    def load(self, name: str) -> dict[str, torch.Tensor] | None:
        return None

    def save(self, name: str, tensors: Mapping[str, torch.Tensor]) -> None:
        return None


def run(
    source: Source,
    config: GenerationConfig,
    seed: int,
    *,
    store: Store | None = None,
    observer: Observer | None = None,
) -> Asset:
    """Every stage in turn; what `store` already holds is not done again.

    The same source, configuration, seed and machine give the same bytes on a CPU, however often the run was
    stopped. Raises GuidanceError, MeshError, OutputError.
    """
    if config.refinement.mode not in ("bound", "frozen"):
        raise RequestError(
            f"refinement.mode {config.refinement.mode!r} gives no bound asset; it is for `gdpro ablate`"
        )
    kept, watcher = store or _Memory(), observer or Observer()
    figures: dict[str, Any] = {}
    # at the size the refined Gaussians are made for: smaller pictures blur them
    size = min(config.refinement.resolution // config.refinement.supersample, 256)
    frame, material, knows_size = source.frame, None, True
    if source.splat is None:
        if source.prior is None:
            raise RequestError(f"{source.name}: neither a prior nor a splat cloud to start from")
        watcher.phase("prior")
        coarse = _prior(source.prior, kept)
        material, knows_size = coarse.material, coarse.description.get("metric", True)
        figures["prior"] = dict(coarse.description)
        frame = frame or UnitFrame.around(coarse.surface.vertices)
        mesh = frame.to_unit(coarse.surface)
        watcher.finished("prior", mesh, figures["prior"])
        first = SurfelStage(mesh, source.guidance, config, seed)
        run_stage(first, kept, watcher, config.output.checkpoint_every)
        learned = first.gaussians()
        figures["surfels"] = {
            "iterations": first.iteration,
            "gaussians": len(learned),
            "psnr": held_out_psnr(source.guidance, learned, size),
        }
        watcher.finished("surfels", learned, figures["surfels"])
        cloud: Any = first.result()
    else:
        cloud = source.splat
    if frame is None:
        raise RequestError(f"{source.name}: a splat cloud needs its unit frame")
    watcher.phase("extraction")
    basic = _extraction(cloud, config, kept)
    figures["extraction"] = {"vertices": len(basic.vertices), "triangles": len(basic.faces)}
    watcher.finished("extraction", basic, figures["extraction"])
    second = RefinementStage(basic, source.guidance, config, seed)
    run_stage(second, kept, watcher, config.output.checkpoint_every)
    bound = second.result()
    figures["refinement"] = {
        "iterations": second.iteration,
        "gaussians": len(bound),
        "psnr": held_out_psnr(source.guidance, bound.gaussians(), size),
    }
    watcher.finished("refinement", bound, figures["refinement"])
    watcher.phase("output")
    return _asset(source, config, seed, bound, second.vertex_colors(), frame, material, knows_size, figures)


def held_out_psnr(guidance: Guidance, gaussians: Gaussians, size: int, views: int = 8) -> float | None:
    """PSNR in dB on white from cameras that no stage saw, against what `guidance` draws there.

    size: pixels across the pictures. None where the guidance draws nothing at any camera: photos, diffusion
    models.
    """
    if not isinstance(guidance, RenderedGuidance):
        return None
    white = torch.ones(views, 3)
    batch = view_batch(held_out(views, size), white)
    with torch.no_grad():
        return round(guidance.psnr(render(gaussians, batch.cameras).over(white), batch), 2)


def run_stage(stage: Stage, store: Store, observer: Observer, every: int) -> None:
    """Steps until done, from where `store` left it; keeps the state every `every` iterations and at the end.

    Raises GuidanceError where the stage's state in the store belongs to another configuration.
    """
    state = store.load(stage.name)
    if state is not None:
        try:
            stage.load_state_dict(state)
        except (KeyError, ValueError, RuntimeError) as error:
            raise GuidanceError(
                f"the checkpoint of {stage.name} does not fit this run ({error}); "
                "start anew in an empty folder"
            ) from error
    while stage.iteration < stage.iterations:
        observer.stepped(stage, stage.step())
        if stage.iteration % every == 0 or stage.iteration == stage.iterations:
            store.save(stage.name, stage.state_dict())


def _prior(make: Callable[[], CoarseMesh], store: Store) -> CoarseMesh:
    found = store.load("prior")
    if found is None:
        coarse = make()
        words = json.dumps({"material": coarse.material, "description": dict(coarse.description)})
        found = {
            **pack_mesh(coarse.surface),
            "words": torch.frombuffer(bytearray(words.encode()), dtype=torch.uint8),
        }
        store.save("prior", found)
    words = json.loads(bytes(found["words"].tolist()).decode())
    return CoarseMesh(unpack_mesh(found), words["material"], words["description"])


def _extraction(cloud: Any, config: GenerationConfig, store: Store) -> SurfaceMesh:
    found = store.load("extraction")
    if found is None:
        found = pack_mesh(extract(cloud, config.extraction))
        store.save("extraction", found)
    return unpack_mesh(found)


def pack_mesh(mesh: SurfaceMesh) -> dict[str, torch.Tensor]:
    """A mesh with one colour per corner as tensors: vertices, faces, colors."""
    colors = mesh.colors
    if colors is None or any(m.texture is not None or m.base_color != (1.0,) * 4 for m in mesh.materials):
        count = len(mesh.faces)
        corners = np.tile(np.eye(3, dtype=np.float32), (count, 1))
        rgba = SurfaceColors(mesh).at(np.repeat(np.arange(count), 3), corners)
        colors = (rgba.reshape(count, 3, 4) * 255.0 + 0.5).astype(np.uint8)
    return {
        "vertices": torch.from_numpy(np.ascontiguousarray(mesh.vertices)),
        "faces": torch.from_numpy(np.ascontiguousarray(mesh.faces)),
        "colors": torch.from_numpy(np.ascontiguousarray(colors)),
    }


def unpack_mesh(tensors: Mapping[str, torch.Tensor]) -> SurfaceMesh:
    """The mesh that `pack_mesh` took apart."""
    faces = tensors["faces"].numpy()
    return SurfaceMesh(
        tensors["vertices"].numpy(),
        faces,
        None,
        tensors["colors"].numpy(),
        np.zeros(len(faces), np.int32),
        (MeshMaterial("generated", (1.0, 1.0, 1.0, 1.0)),),
    )


def _asset(
    source: Source,
    config: GenerationConfig,
    seed: int,
    bound: BoundGaussians,
    colors: np.ndarray,
    frame: UnitFrame,
    material: str | None,
    knows_size: bool,
    figures: Mapping[str, Any],
) -> Asset:
    """The result in metres, with everything that says how it was made."""
    bound = bound.to("cpu")
    unit = bound.vertices.numpy()
    radius, centre = frame.radius, frame.centre
    height = config.output.height or (None if knows_size else DEFAULT_HEIGHT)
    if height is not None:
        radius = height / max(float(np.ptp(unit[:, 2])), 1e-6)
        centre = (0.0, 0.0, -radius * float(unit[:, 2].min()))
    moved = bound.scaled(radius)
    moved = replace(moved, vertices=moved.vertices + torch.tensor(centre, dtype=torch.float32))
    chosen = config.output.material or material
    asset = Asset(
        name=source.name,
        gaussians=moved,
        vertex_colors=colors,
        material=None if chosen is None else Material.model_validate({"preset": chosen}),
        provenance={
            "made_by": "gdpro generate",
            "prompt": source.prompt,
            "seed": seed,
            "guidance": source.guidance.describe(),
            **source.record,
            "stages": dict(figures),
            "config": config.model_dump(mode="json"),
            "versions": versions(PACKAGES),
        },
    )
    if config.output.tets:
        asset = tetrahedralize_asset(asset, target_tets=config.output.target_tets)
    log.info("generated %s: %d Gaussians on %d faces", asset.name, len(moved), len(moved.faces))
    return asset


__all__ = ["Observer", "Source", "Store", "held_out_psnr", "pack_mesh", "run", "run_stage", "unpack_mesh"]
