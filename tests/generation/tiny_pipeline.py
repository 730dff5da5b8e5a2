"""Diffusion pipelines with random weights, a few megabytes, saved as a user's model lies on the disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from gdpro_sim.generation.pretrained import quiet

RESOLUTION = 64
"""Pixels across the pictures of `stable_diffusion`, eight to a latent."""

PIXELS = 16
"""Pixels across the pictures of `deepfloyd`."""

CHARACTERS = [chr(c) for c in range(33, 127)]


def clip_tokenizer() -> Any:
    from transformers import CLIPTokenizer

    tokens = [*CHARACTERS, *(c + "</w>" for c in CHARACTERS), "<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={t: i for i, t in enumerate(tokens)}, merges=[], model_max_length=77)


def clip_config(tokenizer: Any, hidden: int = 32) -> Any:
    from transformers import CLIPTextConfig

    return CLIPTextConfig(
        vocab_size=len(tokenizer),
        hidden_size=hidden,
        intermediate_size=2 * hidden,
        num_hidden_layers=2,
        num_attention_heads=4,
        projection_dim=hidden,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
    )


def unet(channels: int, sample_size: int, **options: Any) -> Any:
    from diffusers import UNet2DConditionModel

    return UNet2DConditionModel(
        sample_size=sample_size,
        in_channels=channels,
        out_channels=options.pop("out_channels", channels),
        block_out_channels=(32, 64),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        cross_attention_dim=32,
        attention_head_dim=8,
        norm_num_groups=8,
        **options,
    )


@quiet()
def stable_diffusion(folder: Path, *, channels: int = 4, **schedule: Any) -> Path:
    """Save a Stable Diffusion pipeline; `schedule` goes to its DDIM scheduler, `channels` is the UNet's."""
    from diffusers import AutoencoderKL, DDIMScheduler, StableDiffusionPipeline
    from transformers import CLIPTextModel

    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    blocks = 4
    vae = AutoencoderKL(
        block_out_channels=(8, 8, 16, 16),
        down_block_types=("DownEncoderBlock2D",) * blocks,
        up_block_types=("UpDecoderBlock2D",) * blocks,
        latent_channels=4,
        norm_num_groups=4,
        sample_size=RESOLUTION,
    )
    options = {
        "beta_start": 0.00085,
        "beta_end": 0.012,
        "beta_schedule": "scaled_linear",
        "steps_offset": 1,
        "set_alpha_to_one": False,
        **schedule,
    }
    pipeline = StableDiffusionPipeline(
        vae=vae,
        text_encoder=CLIPTextModel(clip_config(tokenizer)),
        tokenizer=tokenizer,
        unet=unet(channels, RESOLUTION // 2 ** (blocks - 1), out_channels=4),
        scheduler=DDIMScheduler(**options),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder)
    return folder


@quiet()
def deepfloyd(folder: Path) -> Path:
    """Save a DeepFloyd IF pipeline: pixels, a T5 encoder, a predicted variance beside the noise."""
    from diffusers import DDPMScheduler, IFPipeline
    from transformers import T5Config, T5EncoderModel, T5Tokenizer

    torch.manual_seed(0)
    special = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -1.0)]
    tokenizer = T5Tokenizer(vocab=[*special, *((c, -2.0) for c in CHARACTERS)], extra_ids=0)
    config = T5Config(vocab_size=len(tokenizer), d_model=24, d_kv=8, d_ff=48, num_layers=2, num_heads=3)
    pipeline = IFPipeline(
        tokenizer=tokenizer,
        text_encoder=T5EncoderModel(config),
        unet=unet(3, PIXELS, out_channels=6, encoder_hid_dim=24, encoder_hid_dim_type="text_proj"),
        scheduler=DDPMScheduler(beta_schedule="squaredcos_cap_v2", variance_type="learned_range"),
        safety_checker=None,
        feature_extractor=None,
        watermarker=None,
        requires_safety_checker=False,
    )
    pipeline.save_pretrained(folder)
    return folder


LATENT = 12
"""Numbers in a row of the latents of `shap_e`."""

RADIUS = 0.6
"""About that of the object which `shap_e` always gives."""


@quiet()
def shap_e(folder: Path) -> Path:
    """Save a Shap-E pipeline whose every latent is nearly the same object.

    That is a ball of RADIUS, longer along z, red growing with x and green with y; blue stays at one half.
    """
    from diffusers import HeunDiscreteScheduler, PriorTransformer, ShapEPipeline
    from diffusers.pipelines.shap_e import ShapERenderer
    from transformers import CLIPTextModelWithProjection

    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    hidden, inputs = 8, 93
    prior = PriorTransformer(
        num_attention_heads=2,
        attention_head_dim=8,
        num_layers=2,
        embedding_dim=LATENT,
        num_embeddings=hidden,
        additional_embeddings=0,
        time_embed_act_fn="gelu",
        norm_in_type="layer",
        encoder_hid_proj_type=None,
        added_emb_type=None,
        time_embed_dim=32,
        embedding_proj_dim=32,
        clip_embed_dim=2 * LATENT,
    )
    renderer = ShapERenderer(
        param_names=("nerstf.mlp.0.weight",),
        param_shapes=((hidden, inputs),),
        d_latent=LATENT,
        d_hidden=hidden,
        n_hidden_layers=1,
        insert_direction_at=None,
    )
    _ball(renderer, hidden, inputs)
    pipeline = ShapEPipeline(
        prior=prior,
        text_encoder=CLIPTextModelWithProjection(clip_config(tokenizer)),
        tokenizer=tokenizer,
        scheduler=HeunDiscreteScheduler(
            beta_schedule="exp", prediction_type="sample", use_karras_sigmas=True
        ),
        shap_e_renderer=renderer,
    )
    pipeline.save_pretrained(folder)
    return folder


def _ball(renderer: Any, hidden: int, inputs: int) -> None:
    """Weights by hand: the encoded position is [x, sin(2^k x), cos(2^k x)], axes in turn."""
    position = torch.randn(1, 3)
    from diffusers.pipelines.shap_e.renderer import encode_position

    encoded = encode_position(position)[0]
    cosines = [int((encoded - torch.cos(position[0, axis])).abs().argmin()) for axis in range(3)]
    first, last = torch.zeros(hidden, inputs), torch.zeros(12, hidden)
    bias = torch.zeros(hidden)
    first[0, cosines[0]] = first[0, cosines[1]] = 1.0
    first[0, cosines[2]] = 0.5
    bias[0] = 10.0  # where silu is the identity
    for row, axis in ((1, 0), (2, 1)):
        first[row, axis] = 1.0
        bias[row] = 10.0
    last[0, 0] = 1.0
    last[3, 1], last[4, 2] = 4.0, 4.0
    offsets = torch.zeros(12)
    offsets[0] = -(10.0 + 2.5 - 0.5 * RADIUS**2)
    offsets[3] = offsets[4] = -40.0
    (projection,) = renderer.params_proj.projections.values()
    with torch.no_grad():
        projection.norm.weight.fill_(1e-3)
        projection.norm.bias.zero_()
        projection.proj.bias.copy_(first.flatten())
        renderer.mlp.mlp[0].bias.copy_(bias)
        renderer.mlp.mlp[1].weight.copy_(last)
        renderer.mlp.mlp[1].bias.copy_(offsets)
