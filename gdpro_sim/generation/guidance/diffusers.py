"""Guidance by a text-to-image diffusion model through diffusers: what the paper uses.

Stable Diffusion (and its like) noises latents, DeepFloyd IF pixels; both predict in one call the noise of
several prompts. Nothing is downloaded where the model lies on the disk, and the text encoder is let go once
the prompts are encoded.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Iterator, Sequence
from typing import Any

import torch

from gdpro_sim.device import beside_torch, resolve_device, thread_count
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import GuidanceConfig, ScoreConfig
from gdpro_sim.generation.diffusion import STEPS, Schedule, combine, guidance_mix
from gdpro_sim.generation.guidance import prompts
from gdpro_sim.generation.ism import mean_evaluations
from gdpro_sim.generation.pretrained import (
    EXTRA,
    find_pipeline,
    import_diffusers,
    load_pipeline,
    quiet,
    refuse,
)
from gdpro_sim.generation.protocols import Condition, ViewBatch

log = logging.getLogger(__name__)

OPTION = "--guidance diffusers --model DIR"

ACCEPTED = {"StableDiffusionPipeline": "Stable Diffusion 1 or 2 model", "IFPipeline": "DeepFloyd IF model"}

REFUSED = {
    "StableDiffusionXL": "whose second text encoder and size conditioning have no adapter here yet",
    "StableDiffusion3": "a flow-matching model, which interval score matching has no adapter for here yet",
    "Flux": "a flow-matching model, which interval score matching has no adapter for here yet",
    "StableDiffusion": "a variant made for another task than text to image",
}

ABSENT = {
    "StableDiffusionPipeline": {
        "safety_checker": None,
        "feature_extractor": None,
        "image_encoder": None,
        "requires_safety_checker": False,
    },
    "IFPipeline": {
        "safety_checker": None,
        "feature_extractor": None,
        "watermarker": None,
        "requires_safety_checker": False,
    },
}
"""Parts of a pipeline that guidance has no use for."""

TOKENS = 77
"""Tokens of a prompt that the text encoders of both kinds of pipelines read."""

SMALLEST_ALPHA = 2.0**-24
"""alpha_bar of schedules that end in pure noise, where it would be zero."""

HALF_GRADIENT_SCALE = 128.0
"""Gradients travel through a float16 encoder times this, so that small ones do not round to zero."""


class DiffusersGuidance:
    """A diffusion model that has read the prompt.

    prompt: what the object is; with `config.view_prompts` the side that is seen is appended
    config: model, negative prompt, Perp-Neg, space, precision, offloading
    device: where the model runs ("auto": a GPU where there is one)

    Pictures of any square size are resized to what the model was made for. Latents are the mean of the
    encoder's distribution, not a draw of it. Everything noised has its channels last. Raises GuidanceError
    where the model cannot be had, or is of a kind that does not fit.
    """

    uses_cameras: bool = False
    """Only through |azimuth|, which a mirrored picture shares."""

    def __init__(self, prompt: str, config: GuidanceConfig, *, device: str = "auto") -> None:
        if not prompt.strip():
            raise GuidanceError("the prompt is empty: say what the object is")
        if config.perp_neg and not config.view_prompts:
            raise GuidanceError("guidance.perp_neg tells views apart: it needs guidance.view_prompts")
        self.prompt = prompt
        self.config = config
        self.device = torch.device(resolve_device(device))
        self.dtype = _dtype(config.dtype, self.device)
        if config.cpu_offload and self.device.type == "cpu":
            raise GuidanceError("guidance.cpu_offload moves parts to a GPU, and there is none: leave it off")
        self.folder = find_pipeline(config.model, OPTION)
        refuse(self.folder, ACCEPTED, REFUSED)
        pipeline = load_pipeline(self.folder, OPTION, dtype=self.dtype, **ABSENT[self.folder.kind])
        self.space = _space(config.space, pipeline, self.folder.model)
        self.prediction, self.alphas_cumprod = _schedule(pipeline.scheduler, self.folder.model)
        self.alphas_cumprod = self.alphas_cumprod.to(self.device)
        self._steps = Schedule(self.alphas_cumprod)
        self._embeddings = self._encode_prompts(pipeline)
        self._unet = pipeline.unet.eval().requires_grad_(False)
        self._vae = pipeline.vae.eval().requires_grad_(False) if self.space == "latent" else None
        self._check_model()
        self._offload: Any = None
        self._place()
        self.native_resolution: int = self._sample_size() * self._reduction()
        log.info("%s: %s, %s, %d px", self.folder.model, self.folder.kind, self.dtype, self.native_resolution)

    def views(self, proposed: ViewBatch, generator: torch.Generator) -> ViewBatch:
        """`proposed`: the model knows any view."""
        return proposed

    def encode(self, images: torch.Tensor, views: ViewBatch) -> torch.Tensor:
        """Pictures [B, H, H, 3] in [0, 1] as latents [B, h, h, 4] or as pixels in [-1, 1], float32."""
        return self._encoded(images)

    def noise_prediction(
        self, x_t: torch.Tensor, t: int, condition: Condition, views: ViewBatch
    ) -> torch.Tensor:
        """Predicted noise of x_t [B, h, w, c], float32."""
        return self._predict(x_t, t, [self._condition(condition, views, len(x_t))])[0]

    def guided(self, x_t: torch.Tensor, t: int, views: ViewBatch, scale: float) -> torch.Tensor:
        """e_neg + scale (e_prompt - e_neg), or with Perp-Neg in e_prompt's place; one call of the model."""
        wanted = [self._condition(name, views, len(x_t)) for name in ("negative", "prompt")]
        if not self.config.perp_neg:
            negative, positive = self._predict(x_t, t, wanted)
            return guidance_mix(negative, positive, scale)
        wanted += [self._repeated(name, len(x_t)) for name in prompts.VIEWS[:2]]
        negative, positive, *repelled = self._predict(x_t, t, wanted)
        weights = prompts.repulsion_weights(views.azimuths)
        with torch.no_grad(), beside_torch(x_t):
            positive = prompts.perp_neg(negative, positive, torch.stack(repelled), weights)
        return guidance_mix(negative, positive, scale)

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "diffusers",
            "label": "text-to-image diffusion model",
            "model": self.folder.model,
            "revision": self.folder.revision,
            "pipeline": self.folder.kind,
            "prompt": self.prompt,
            "negative_prompt": self.config.negative_prompt,
            "view_prompts": self.config.view_prompts,
            "perp_neg": self.config.perp_neg,
            "space": self.space,
            "prediction": self.prediction,
            "resolution": self.native_resolution,
            "dtype": str(self.dtype).removeprefix("torch."),
            "parameters": sum(p.numel() for p in self._unet.parameters()),
        }

    def seconds_per_iteration(self, score: ScoreConfig, batch: int, iterations: int) -> float:
        """What an iteration will take in guidance, from one measured evaluation and one encoding; s.

        The mean over `iterations` of the evaluations of the model that `score` asks for, each for `batch`
        pictures. Rendering is not in it. Takes a few evaluations' time.
        """
        size = self.native_resolution
        images = torch.full((1, size, size, 3), 0.5, device=self.device, requires_grad=True)
        x = self._encoded(images).detach()
        empty = [self._repeated("empty", 1)]
        self._predict(x, STEPS // 2, empty)  # the first is slower

        def timed(work: Any) -> float:
            self._wait()
            begin = time.perf_counter()
            work()
            self._wait()
            return time.perf_counter() - begin

        encoding = timed(lambda: self._encoded(images).sum().backward())
        evaluation = timed(lambda: self._predict(x, STEPS // 2, empty))
        evaluations = mean_evaluations(score, iterations)
        if self.config.perp_neg:
            evaluations += len(prompts.VIEWS[:2])
        return batch * (encoding + evaluations * evaluation)

    def _encoded(self, images: torch.Tensor) -> torch.Tensor:
        if images.ndim != 4 or images.shape[-1] != 3 or images.shape[1] != images.shape[2]:
            raise ValueError(f"images must be square, [B, H, H, 3], got {list(images.shape)}")
        size = self.native_resolution
        x = images.to(self.device, torch.float32).permute(0, 3, 1, 2)
        if x.shape[-1] != size:
            x = torch.nn.functional.interpolate(
                x, (size, size), mode="bilinear", antialias=x.shape[-1] > size, align_corners=False
            )
        x = 2.0 * x - 1.0
        if self._vae is not None:
            if self._offload is not None:
                self._offload.offload()
            scale = HALF_GRADIENT_SCALE if self.dtype == torch.float16 else 1.0
            with _all_threads(self.device):
                x = _ScaledGradient.apply(x, 1.0 / scale).to(self.dtype)
                x = self._vae.encode(x).latent_dist.mode().float() * self._vae.config.scaling_factor
                x = _ScaledGradient.apply(x, scale)
        return x.permute(0, 2, 3, 1).contiguous()

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)

    def _predict(self, x_t: torch.Tensor, t: int, wanted: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Predicted noise of x_t for each of some prompts' embeddings [B, L, D], in one call of the model."""
        count, channels = len(wanted), x_t.shape[-1]
        with torch.no_grad(), _all_threads(self.device):
            x = x_t.to(self.device, self.dtype).permute(0, 3, 1, 2)
            output = self._unet(
                torch.cat([x] * count),
                torch.full((count * len(x),), t, device=self.device, dtype=torch.int64),
                encoder_hidden_states=torch.cat(list(wanted)),
            ).sample
            # Some models predict a variance too, in as many channels again.
            output = output[:, :channels].permute(0, 2, 3, 1)
            return [self._noise(part, x_t, t) for part in output.chunk(count)]

    def _noise(self, output: torch.Tensor, x_t: torch.Tensor, t: int) -> torch.Tensor:
        """The noise in x_t from what the model says of it: the one place that knows predictions' kinds."""
        signal, sigma = self._steps.signal(t), self._steps.sigma(t)
        if self.prediction == "v_prediction":  # v = signal e - sigma x_0
            return combine(output, signal, x_t, sigma)
        if self.prediction == "sample":
            return combine(x_t, 1.0 / sigma, output, -signal / sigma)
        return output.float().contiguous()

    def _condition(self, condition: Condition, views: ViewBatch, batch: int) -> torch.Tensor:
        """Embeddings [B, L, D] of a condition for each view."""
        if condition != "prompt" or not self.config.view_prompts:
            return self._repeated(condition, batch)
        if len(views.azimuths) != batch:
            raise ValueError(f"{batch} pictures but {len(views.azimuths)} azimuths")
        shares = prompts.view_weights(views.azimuths.to(self.device, torch.float32))
        stack = torch.stack([self._embeddings[view].float() for view in prompts.VIEWS])
        return torch.einsum("bv,vld->bld", shares, stack).to(self.dtype)

    def _repeated(self, name: str, batch: int) -> torch.Tensor:
        embedding = self._embeddings[name]
        return embedding.expand(batch, *embedding.shape)

    def _encode_prompts(self, pipeline: Any) -> dict[str, torch.Tensor]:
        """Embeddings [L, D] by name; afterwards the pipeline holds no text encoder any more."""
        texts = {"empty": "", "negative": self.config.negative_prompt, "prompt": self.prompt}
        if self.config.view_prompts:
            texts.update(zip(prompts.VIEWS, prompts.view_texts(self.prompt), strict=True))
        if pipeline.text_encoder is None or pipeline.tokenizer is None:
            raise GuidanceError(
                f"{self.folder.model} has no text encoder: pass {OPTION} with a whole pipeline"
            )
        embeddings = {}
        with torch.no_grad(), _all_threads(self.device), quiet():
            pipeline.text_encoder.to(self.device)
            for name, text in texts.items():
                tokens = len(pipeline.tokenizer(text).input_ids)
                if tokens > TOKENS:
                    log.warning("the model reads %d of the %d tokens of %r", TOKENS, tokens, text)
                encoded = pipeline.encode_prompt(
                    text, device=self.device, num_images_per_prompt=1, do_classifier_free_guidance=False
                )
                embeddings[name] = encoded[0][0].detach().to(self.device, self.dtype)
        pipeline.text_encoder = pipeline.tokenizer = None
        return embeddings

    def _check_model(self) -> None:
        config = self._unet.config
        channels = 3 if self._vae is None else self._vae.config.latent_channels
        if config.in_channels != channels or config.out_channels not in (channels, 2 * channels):
            raise GuidanceError(
                f"{self.folder.model} takes {config.in_channels} channels and gives {config.out_channels}, "
                f"where text to image has {channels}: it was made for another task; pass another model"
            )

    def _place(self) -> None:
        """Bring the model to its device, or under accelerate's care; the encoder, for gradients, stays."""
        if self._vae is not None:
            self._vae.to(self.device)
            self._vae.enable_slicing()
        if not self.config.cpu_offload:
            self._unet.to(self.device)
            return
        try:
            from accelerate import cpu_offload_with_hook
        except ImportError as error:
            raise GuidanceError(f"guidance.cpu_offload needs accelerate ({error}): {EXTRA}") from error
        self._unet, self._offload = cpu_offload_with_hook(self._unet, self.device)

    def _sample_size(self) -> int:
        size = self._unet.config.sample_size
        return int(size if isinstance(size, int) else size[0])

    def _reduction(self) -> int:
        """Pixels to a latent, along a side."""
        return 1 if self._vae is None else 2 ** (len(self._vae.config.block_out_channels) - 1)


class _ScaledGradient(torch.autograd.Function):
    """The same numbers; their gradient times a factor."""

    @staticmethod
    def forward(ctx: Any, x: torch.Tensor, factor: float) -> torch.Tensor:  # type: ignore[override]
        ctx.factor = factor
        return x.view_as(x)

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None]:
        return gradients[0] * ctx.factor, None


@contextlib.contextmanager
def _all_threads(device: torch.device) -> Iterator[None]:
    """On a CPU, let torch's operators use every core inside the block: a network is worth it."""
    if device.type != "cpu":
        yield
        return
    before = torch.get_num_threads()
    torch.set_num_threads(thread_count())
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _dtype(name: str, device: torch.device) -> torch.dtype:
    if name == "auto":
        return torch.float16 if device.type == "cuda" else torch.float32
    if name == "float16" and device.type == "cpu":
        raise GuidanceError("guidance.dtype=float16 needs a GPU: use float32 or bfloat16 on a CPU")
    return {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}[name]


def _space(wanted: str, pipeline: Any, model: str) -> str:
    """ "latent" where the pipeline has an encoder, else "pixel"; GuidanceError where the other is wanted."""
    found = "pixel" if getattr(pipeline, "vae", None) is None else "latent"
    if wanted not in ("auto", found):
        raise GuidanceError(f"guidance.space={wanted}, but {model} works on {found}s: use auto or {found}")
    return found


def _schedule(scheduler: Any, model: str) -> tuple[str, torch.Tensor]:
    """What the model predicts, and its alphas_cumprod [1000]. Raises GuidanceError."""
    diffusers = import_diffusers()
    config = scheduler.config
    prediction = config.get("prediction_type", "epsilon")
    if prediction not in ("epsilon", "v_prediction", "sample"):
        raise GuidanceError(
            f"{model} predicts {prediction!r}; pass a model that predicts epsilon, v_prediction or sample"
        )
    with quiet():
        ddim = diffusers.DDIMScheduler.from_config(config)  # for its schedule alone: it takes no step
    alphas = ddim.alphas_cumprod
    if alphas.shape != (STEPS,):
        raise GuidanceError(f"{model} was trained with {len(alphas)} steps of noise; {STEPS} are needed")
    return prediction, alphas.float().clamp(min=SMALLEST_ALPHA)


__all__ = ["DiffusersGuidance"]
