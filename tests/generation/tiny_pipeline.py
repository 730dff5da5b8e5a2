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
