"""Opens what a generation starts from: a prompt, a mesh file, photos with cameras, a splat cloud."""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.files import sha256_of
from gdpro_sim.generation import objects
from gdpro_sim.generation.config import GenerationConfig
from gdpro_sim.generation.guidance.procedural import ProceduralGuidance
from gdpro_sim.generation.guidance.views import MeshGuidance, PhotoGuidance, SplatGuidance
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.pipeline import Source
from gdpro_sim.generation.priors.hull import HullPrior
from gdpro_sim.generation.priors.mesh import MeshPrior
from gdpro_sim.generation.priors.procedural import ProceduralPrior
from gdpro_sim.generation.priors.sphere import SpherePrior
from gdpro_sim.generation.protocols import CoarseMesh, Guidance, Prior, UnitFrame
from gdpro_sim.meshing.load import load_mesh
from gdpro_sim.meshing.surface import SurfaceMesh

log = logging.getLogger(__name__)

LONG = 1800.0
"""s a run may be expected to take on a CPU before the user is asked."""


@dataclass(frozen=True)
class Inputs:
    """What a run starts from. Paths are text, as the user gave them.

    prompt: alone, or with a mesh whose look a diffusion model is to change
    mesh, images, splat: a mesh file, a folder of photos with cameras, a .ply or .splat of Gaussians
    background: colour key for photos without alpha: "white" or "black"
    color, up, scale: of the mesh file, as in `gdpro_sim.meshing.load.load_mesh`; up also of photos and splats
    ignore_unknown: words the built-in vocabulary lacks are recorded and left out
    sha256: of the input's files, filled in by `pinned`
    """

    prompt: str = ""
    mesh: str | None = None
    images: str | None = None
    splat: str | None = None
    background: str | None = None
    color: str | None = None
    up: str = "auto"
    scale: float | None = None
    ignore_unknown: bool = False
    sha256: str = ""

    def __post_init__(self) -> None:
        given = [name for name in ("mesh", "images", "splat") if getattr(self, name) is not None]
        if len(given) > 1:
            raise RequestError(f"give one input, got {' and '.join(given)}")
        if not given and not self.prompt.strip():
            raise RequestError(
                "nothing to generate from: give a prompt (`gdpro vocabulary` lists the words), or a mesh, "
                "photos or a splat cloud"
            )

    def pinned(self) -> Inputs:
        """With the SHA-256 of the input's files, so that a run is not continued with others.

        Raises RequestError for a missing file.
        """
        path = self.mesh or self.images or self.splat
        if path is None:
            return self
        file = Path(path)
        if not file.exists():
            raise RequestError(f"{path}: no such file")
        if file.is_file():
            return replace(self, sha256=sha256_of(file))
        digest = hashlib.sha256()
        for inner in sorted(p for p in file.rglob("*") if p.is_file()):
            digest.update(f"{inner.relative_to(file)} {sha256_of(inner)}\n".encode())
        return replace(self, sha256=digest.hexdigest())

    def to_json(self) -> dict[str, Any]:
        return asdict(self)

    @staticmethod
    def from_json(data: dict[str, Any]) -> Inputs:
        return Inputs(**{f.name: data[f.name] for f in fields(Inputs) if f.name in data})


def open_source(
    inputs: Inputs, config: GenerationConfig, seed: int, *, device: str = "cpu", accept_slow: bool = False
) -> Source:
    """Reads the inputs and makes the guidance and the prior that `config` names.

    Raises RequestError, GuidanceError, MeshError.
    """
    if inputs.sha256 and inputs.pinned().sha256 != inputs.sha256:
        path = inputs.mesh or inputs.images or inputs.splat
        raise RequestError(f"{path} has changed since the run began; start anew in another folder")
    if inputs.images is not None:
        return _from_photos(inputs, config, seed, device)
    if inputs.splat is not None:
        return _from_splat(inputs, config, device)
    if inputs.mesh is not None:
        return _from_mesh(inputs, config, seed, device, accept_slow)
    return _from_prompt(inputs, config, seed, device, accept_slow)


def _from_prompt(
    inputs: Inputs, config: GenerationConfig, seed: int, device: str, accept_slow: bool
) -> Source:
    record: dict[str, Any] = {}
    guidance: Guidance
    frame = None
    if config.guidance.kind == "procedural":
        spec = objects.parse(inputs.prompt, ignore_unknown=inputs.ignore_unknown)
        record["read_as"] = spec.describe()
        made = ProceduralGuidance(spec, config.guidance, seed, device=device)
        guidance, frame = made, made.frame
    elif config.guidance.kind == "diffusers":
        guidance = _diffusion(inputs.prompt, config, device, accept_slow)
    else:
        raise GuidanceError(
            "guidance views needs something to look at: --from-mesh, --from-images or --from-splat"
        )
    prior, make = _prior(inputs, config, seed, device, frame=frame)
    record["prior"] = prior.describe()
    own = config.prior.kind in ("procedural", "sphere")
    return Source(_name(inputs.prompt), inputs.prompt, guidance, make, frame if own else None, None, record)


def _diffusion(prompt: str, config: GenerationConfig, device: str, accept_slow: bool) -> Guidance:
    """A diffusion model; on a CPU only with the user's word, after saying how long it will take."""
    from gdpro_sim.generation.guidance.diffusers import DiffusersGuidance

    guidance = DiffusersGuidance(prompt, config.guidance, device=device)
    if guidance.device.type == "cpu" and not accept_slow:
        seconds = sum(
            guidance.seconds_per_iteration(config.score, stage.batch, stage.iterations) * stage.iterations
            for stage in (config.surfels, config.refinement)
        )
        if seconds > LONG:
            raise GuidanceError(
                f"{config.guidance.model} on this CPU would take about {_duration(seconds)}; use a CUDA "
                "device, --quality draft, or start it all the same with --yes"
            )
        log.warning("the diffusion model runs on the CPU: about %s", _duration(seconds))
    return guidance


def _duration(seconds: float) -> str:
    for unit, length in (("days", 86400.0), ("hours", 3600.0), ("minutes", 60.0)):
        if seconds >= 2.0 * length:
            return f"{seconds / length:.0f} {unit}"
    return f"{seconds:.0f} seconds"


def _from_mesh(inputs: Inputs, config: GenerationConfig, seed: int, device: str, accept_slow: bool) -> Source:
    path = Path(inputs.mesh or "")
    mesh = load_mesh(path, color=inputs.color, up=inputs.up, scale=inputs.scale)
    frame = UnitFrame.around(mesh.vertices)
    guidance: Guidance
    if config.guidance.kind == "diffusers":
        guidance = _diffusion(inputs.prompt, config, device, accept_slow)
    elif config.guidance.kind == "views":
        guidance = MeshGuidance(frame.to_unit(mesh), config.guidance, device=device)
    else:
        raise GuidanceError(f"guidance {config.guidance.kind} looks at no mesh: use views or diffusers")
    prior, make = _prior(inputs, config, seed, device, mesh=mesh)
    record = {"prior": prior.describe(), "source": path.name, "sha256": inputs.sha256}
    return Source(path.stem, inputs.prompt, guidance, make, frame, None, record)


def _from_photos(inputs: Inputs, config: GenerationConfig, seed: int, device: str) -> Source:
    from gdpro_sim.io.photos import read_photos

    path = Path(inputs.images or "")
    seen = config.refinement.resolution // config.refinement.supersample
    scene = read_photos(path, background=inputs.background, up=inputs.up, largest=max(512, 2 * seen))
    guidance = PhotoGuidance(scene.photos, config.guidance, device=device)
    frame = UnitFrame((0.0, 0.0, 0.0), 1.0)  # photos and hull are in the unit frame already
    prior, make = _prior(inputs, config, seed, device, photos=scene.photos, frame=frame)
    record = {
        "prior": prior.describe(),
        "source": path.name,
        "sha256": inputs.sha256,
        "photos": scene.description,
    }
    return Source(path.resolve().name, inputs.prompt, guidance, make, frame, None, record)


def _from_splat(inputs: Inputs, config: GenerationConfig, device: str) -> Source:
    from gdpro_sim.io.ply import read_ply
    from gdpro_sim.io.splat import read_splat, splat_in_unit_frame

    path = Path(inputs.splat or "")
    cloud = read_splat(path) if path.suffix.lower() == ".splat" else read_ply(path)
    unit, frame = splat_in_unit_frame(cloud, up=inputs.up)
    guidance = SplatGuidance(unit.to(device), config.guidance)
    record = {"source": path.name, "sha256": inputs.sha256, "gaussians": len(cloud), "kept": len(unit)}
    return Source(path.stem, inputs.prompt, guidance, None, frame, unit.to(device), record)


def _prior(
    inputs: Inputs,
    config: GenerationConfig,
    seed: int,
    device: str,
    *,
    mesh: SurfaceMesh | None = None,
    photos: Photos | None = None,
    frame: UnitFrame | None = None,
) -> tuple[Prior, Callable[[], CoarseMesh]]:
    """The prior that `config` names, and a call that runs it."""
    settings = config.prior
    prior: Prior
    if settings.kind == "procedural":
        prior = ProceduralPrior(settings, ignore_unknown=inputs.ignore_unknown)
    elif settings.kind == "sphere":
        prior = SpherePrior(frame) if frame is not None else SpherePrior()
    elif settings.kind == "shap-e":
        from gdpro_sim.generation.priors.shap_e import ShapEPrior

        prior = ShapEPrior(settings, device=device)
    elif settings.kind == "hull":
        if photos is None:
            raise GuidanceError("prior hull is carved from photos: it goes with --from-images")
        prior = HullPrior(photos)
    elif settings.file is not None:
        prior = MeshPrior(load_mesh(settings.file, color=inputs.color, up=inputs.up, scale=inputs.scale))
    elif mesh is not None:
        prior = MeshPrior(mesh)
    else:
        raise GuidanceError("prior mesh needs a file: --prior mesh --prior-model FILE, or --from-mesh FILE")
    prompt = settings.prompt or inputs.prompt
    if settings.kind in ("procedural", "shap-e") and not prompt.strip():
        raise GuidanceError(f"prior {settings.kind} needs words: give a prompt, or --prior-prompt")
    return prior, lambda: prior.mesh(prompt, seed)


def _name(prompt: str) -> str:
    words = [w for w in prompt.lower().replace("_", " ").split() if w not in ("a", "an", "the")]
    return "_".join("".join(ch for ch in w if ch.isalnum()) for w in words[:6]) or "asset"


__all__ = ["Inputs", "open_source"]
