"""Shap-E as a prior: a short prompt becomes a coarse mesh with vertex colours, through diffusers.

A latent is sampled as Shap-E's own code does it (Karras steps, Heun's method, guidance 15) and read as the
weights of a small network: signed distance and colour of any point in a box. diffusers keeps its
marching-cubes tables in the checkpoint; here the field is asked for on a grid and Warp's are used.

Source: Jun and Nichol, "Shap-E" (arXiv 2305.02463); the weights of Luo et al., "Cap3D" (arXiv 2306.07279),
which the paper uses, are Shap-E's text-conditional model fine-tuned.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp

from gdpro_sim.device import resolve_device
from gdpro_sim.errors import GuidanceError
from gdpro_sim.files import sha256_of
from gdpro_sim.generation.config import PriorConfig
from gdpro_sim.generation.pretrained import find_pipeline, first_line, load_pipeline, quiet, refuse
from gdpro_sim.generation.protocols import CoarseMesh
from gdpro_sim.meshing.surface import MeshMaterial, SurfaceMesh

log = logging.getLogger(__name__)

OPTION = "--prior shap-e --prior-model DIR"

ACCEPTED = {"ShapEPipeline": "Shap-E text-to-3D pipeline"}

REFUSED = {"ShapEImg2Img": "which starts from a picture"}

SIGMAS = (1e-3, 160.0)
"""Smallest and largest noise of Shap-E's own sampler."""

HEIGHT = 0.3
"""m; Shap-E knows no unit."""

CHUNK = 1 << 16
"""Points asked for at once."""

Field = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Signed distance [N], positive inside and not to scale, and sRGB colours [N, 3] of points [N, 3]."""

RENAMED = (
    ("time_embedding.linear_1.", "time_embed.c_fc."),
    ("time_embedding.linear_2.", "time_embed.c_proj."),
    ("proj_in.", "input_proj."),
    ("embedding_proj.", "clip_embed."),
    ("positional_embedding", "pos_emb"),
    ("norm_in.", "ln_pre."),
    ("norm_out.", "ln_post."),
    ("proj_to_clip_embeddings.", "output_proj."),
    ("transformer_blocks.", "backbone.resblocks."),
    (".attn1.to_out.0.", ".attn.c_proj."),
    (".ff.net.0.proj.", ".mlp.c_fc."),
    (".ff.net.2.", ".mlp.c_proj."),
    (".norm1.", ".ln_1."),
    (".norm3.", ".ln_2."),
)
"""Parts of names in diffusers' prior, and in Shap-E's own."""

UNTRAINED = ("clip_mean", "clip_std")
"""Parameters of diffusers' prior that Shap-E has no use for."""


class ShapEPrior:
    """Shap-E from a local directory or the hub's cache, with Cap3D's weights where `config.cap3d` names them.

    Nothing is loaded before a mesh is asked for, and nothing kept after. On a CPU a mesh takes long: the
    real model is asked 127 times, seconds to half a minute each.
    """

    def __init__(self, config: PriorConfig, *, device: str = "auto") -> None:
        """Raises GuidanceError where there is no such model, or the Cap3D file is missing."""
        self.config = config
        self.device = torch.device(resolve_device(device))
        self.folder = find_pipeline(config.model, OPTION)
        refuse(self.folder, ACCEPTED, REFUSED)
        self._cap3d = None if config.cap3d is None else Path(config.cap3d).expanduser()
        if self._cap3d is not None and not self._cap3d.is_file():
            raise GuidanceError(
                f"{config.cap3d} is not a file: prior.cap3d takes Cap3D's fine-tuned Shap-E weights (.pth)"
            )

    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """A closed coloured mesh, 0.3 m high and standing on z = 0, for `config.prompt` or else `prompt`.

        The same seed and machine give the same mesh on a CPU. Raises GuidanceError where the prompt is empty,
        the files are damaged, or the sampled object has no surface.
        """
        text = (self.config.prompt or prompt).strip()
        if not text:
            raise GuidanceError("the prompt is empty: Shap-E needs one, e.g. --prior-prompt 'a red mug'")
        pipeline = load_pipeline(self.folder, OPTION)
        if self._cap3d is not None:
            load_fine_tuned(pipeline.prior, self._cap3d)
        pipeline.to(self.device)
        if self.device.type == "cpu":
            log.info("Shap-E runs on a CPU: the full-sized model takes the better part of an hour")
        field = decoded(pipeline.shap_e_renderer, self._sample(pipeline, text, seed))
        vertices, faces, colors = surface(field, pipeline.shap_e_renderer.volume, self.config.resolution)
        if not len(faces):
            raise GuidanceError(
                f"Shap-E gave no surface for {text!r} and seed {seed}; try another seed or prompt"
            )
        mesh = SurfaceMesh(
            _standing(vertices),
            faces,
            None,
            np.ascontiguousarray(colors[faces]),
            np.zeros(len(faces), np.int32),
            (MeshMaterial("shap-e", (1.0, 1.0, 1.0, 1.0)),),
        )
        description = {**self.describe(), "prompt": text, "seed": seed, "metric": False}
        return CoarseMesh(mesh, None, description)

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "shap-e",
            "model": self.folder.model,
            "revision": self.folder.revision,
            "cap3d_sha256": self._cap3d_sha256,
            "guidance_scale": self.config.guidance_scale,
            "steps": self.config.steps,
            "resolution": self.config.resolution,
        }

    @cached_property
    def _cap3d_sha256(self) -> str | None:
        return None if self._cap3d is None else sha256_of(self._cap3d)

    def _sample(self, pipeline: Any, text: str, seed: int) -> torch.Tensor:
        """A latent [1, D, L]."""
        smallest, largest = SIGMAS
        pipeline.scheduler.register_to_config(sigma_min=smallest, sigma_max=largest, use_karras_sigmas=True)
        pipeline.set_progress_bar_config(disable=True)
        with quiet():
            return pipeline(
                text,
                num_inference_steps=self.config.steps,
                guidance_scale=self.config.guidance_scale,
                generator=torch.Generator().manual_seed(seed),
                output_type="latent",
            ).images[:1]


def load_fine_tuned(prior: Any, file: Path) -> None:
    """Put the weights of Shap-E's own text-conditional model, as Cap3D saves them, into diffusers' prior.

    Nothing is unpickled but tensors. Raises GuidanceError where the file is not such a checkpoint, or of a
    model of another size.
    """
    try:
        checkpoint = torch.load(file, map_location="cpu", weights_only=True)
        weights = checkpoint.get("model_state_dict", checkpoint)
        prior.load_state_dict(_renamed(prior, weights), strict=False)
    except Exception as error:  # a wrong file surfaces as almost anything
        raise GuidanceError(
            f"{file} does not fit Shap-E's prior ({first_line(error)}); "
            "prior.cap3d takes Cap3D's fine-tuned Shap-E weights (.pth)"
        ) from error


def _renamed(prior: Any, weights: Mapping[str, torch.Tensor]) -> dict[str, torch.Tensor]:
    """Every parameter of diffusers' prior from Shap-E's own. Raises KeyError with the name it lacks."""
    heads = prior.config.num_attention_heads
    found = {}
    for name, parameter in prior.state_dict().items():
        if name in UNTRAINED:
            continue
        theirs, part = name, None
        for index, letter in enumerate("qkv"):
            if f".attn1.to_{letter}." in name:
                theirs, part = name.replace(f".attn1.to_{letter}.", ".attn.c_qkv."), index
        for ours, other in RENAMED:
            if theirs.startswith(ours) or (ours.startswith(".") and ours in theirs):
                theirs = theirs.replace(ours, other, 1)
        value = weights[f"wrapped.{theirs}"]
        if part is not None:
            # Rows are q, k, v of the first head, then of the second, and so on.
            value = value.reshape(heads, 3, -1, *value.shape[1:])[:, part].flatten(0, 1)
        found[name] = value[None] if value.ndim == parameter.ndim - 1 else value
    return found


def decoded(renderer: Any, latent: torch.Tensor) -> Field:
    """The field that a latent stands for: it gives most weights of the renderer's network."""
    with torch.no_grad():
        projected = renderer.params_proj(latent)
    weights = {name.removeprefix("nerstf."): value[0] for name, value in projected.items()}
    network = renderer.mlp

    def ask(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.no_grad():
            output = torch.func.functional_call(
                network,
                weights,
                kwargs={
                    "position": points[None].to(latent),
                    "direction": None,
                    "ts": None,
                    "nerf_level": "fine",
                    "rendering_mode": "stf",
                },
            )
        return output.signed_distance[0, :, 0].float(), output.channels[0].float()

    return ask


def surface(field: Field, volume: Any, cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices [V, 3] float32, faces [F, 3] int32 outward, and sRGB colours [V, 4] uint8.

    cells: across the box `volume`, beyond which nothing is inside. The colour head's own numbers are
    sRGB-encoded: diffusers' mesh decoder turns them into linear ones at the end, which is left out here.
    """
    from warp.geometry import IsoSurfaceMarchingCubes

    low, high = volume.bbox_min.double().cpu().numpy(), volume.bbox_max.double().cpu().numpy()
    axes = [torch.linspace(float(a), float(b), cells + 1) for a, b in zip(low, high, strict=True)]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    inner = torch.cat([field(part)[0].cpu() for part in points.split(CHUNK)])
    # A node on the surface would give faces without area.
    inner = torch.where(inner.abs() < 1e-6, inner.new_full((), -1e-6), inner)
    grid = inner.new_full((cells + 3,) * 3, -1.0)
    grid[1:-1, 1:-1, 1:-1] = inner.view((cells + 1,) * 3)
    if not bool((grid > 0.0).any()):
        return np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 4), np.uint8)
    step = (high - low) / cells
    negative_inside: Any = wp.array(-grid.numpy(), dtype=float, device="cpu")
    found, indices = IsoSurfaceMarchingCubes.extract(
        negative_inside, lower=tuple(low - step), upper=tuple(high + step)
    )
    vertices, faces = found.numpy(), indices.numpy().reshape(-1, 3)
    rgb = torch.cat([field(part)[1].cpu() for part in torch.from_numpy(vertices).split(CHUNK)])
    colors = np.full((len(vertices), 4), 255, np.uint8)
    colors[:, :3] = (rgb.clamp(0.0, 1.0).numpy() * 255.0 + 0.5).astype(np.uint8)
    return vertices, np.ascontiguousarray(faces, dtype=np.int32), colors


def _standing(vertices: np.ndarray) -> np.ndarray:
    """Turned from Shap-E's front (-Y) to ours (+X), Z up in both; `HEIGHT` high, centred, on z = 0; m."""
    turned = np.stack([-vertices[:, 1], vertices[:, 0], vertices[:, 2]], 1).astype(np.float64)
    low, high = turned.min(0), turned.max(0)
    turned -= [0.5 * (low[0] + high[0]), 0.5 * (low[1] + high[1]), low[2]]
    return (turned * (HEIGHT / max(high[2] - low[2], 1e-6))).astype(np.float32)


__all__ = ["ShapEPrior", "decoded", "load_fine_tuned", "surface"]
