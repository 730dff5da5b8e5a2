"""Guidance by a diffusion model, with tiny random pipelines loaded from the disk as a user's are."""

from __future__ import annotations

import json
import math
import shutil
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.device import serial_torch
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import GuidanceConfig, ScoreConfig
from gdpro_sim.generation.guidance import diffusers as diffusers_guidance
from gdpro_sim.generation.guidance import prompts
from gdpro_sim.generation.guidance.diffusers import DiffusersGuidance
from gdpro_sim.generation.ism import ScoreDistillation
from gdpro_sim.generation.pretrained import quiet
from gdpro_sim.generation.protocols import ViewBatch, step_generator
from tests.conditions import needs_gpu
from tests.generation import tiny_pipeline

PROMPT = "a red mug"
SIZE = tiny_pipeline.RESOLUTION


@pytest.fixture(autouse=True)
def one_thread(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Networks this small take longer on several threads."""
    monkeypatch.setattr(diffusers_guidance, "thread_count", lambda: 1)
    with serial_torch():
        yield


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_pipeline.stable_diffusion(tmp_path_factory.mktemp("sd"))


@pytest.fixture(scope="module")
def original(saved: Path) -> Any:
    """The pipeline as diffusers gives it, to compare with."""
    from diffusers import StableDiffusionPipeline

    with quiet():
        return StableDiffusionPipeline.from_pretrained(saved, local_files_only=True)


def guidance(folder: Path | str | None, **options: Any) -> DiffusersGuidance:
    device = options.pop("device", "cpu")
    return DiffusersGuidance(
        options.pop("prompt", PROMPT), GuidanceConfig(kind="diffusers", model=str(folder) if folder else None,
                                                      **options), device=device
    )  # fmt: skip


def looking(*azimuths: float, size: int = SIZE) -> ViewBatch:
    eyes = [[5.0 * math.cos(a), 5.0 * math.sin(a), 0.0] for a in azimuths]
    cameras = Cameras.look_at(eyes, [0.0, 0.0, 0.0], vertical_fov=0.5, width=size, height=size)
    count = len(azimuths)
    return ViewBatch(cameras, torch.zeros(count, 3), torch.tensor(azimuths), torch.zeros(count))


VIEWS = looking(0.3, -2.2)


def pictures(batch: int = 2, size: int = SIZE, seed: int = 0) -> torch.Tensor:
    return torch.rand(batch, size, size, 3, generator=torch.Generator().manual_seed(seed))


def noise(batch: int = 2, seed: int = 1) -> torch.Tensor:
    return torch.randn(batch, SIZE // 8, SIZE // 8, 4, generator=torch.Generator().manual_seed(seed))


def embedding(pipeline: Any, text: str) -> torch.Tensor:
    tokens = pipeline.tokenizer(
        text, padding="max_length", max_length=77, truncation=True, return_tensors="pt"
    )
    with torch.no_grad():
        return pipeline.text_encoder(tokens.input_ids)[0][0]


def direct(pipeline: Any, x: torch.Tensor, t: int, embeddings: list[torch.Tensor]) -> torch.Tensor:
    """One picture at a time through the network itself."""
    with torch.no_grad():
        parts = [
            pipeline.unet(x[b : b + 1].permute(0, 3, 1, 2), t, encoder_hidden_states=e[None]).sample
            for b, e in enumerate(embeddings)
        ]
    return torch.cat(parts).permute(0, 2, 3, 1)


def prompted(pipeline: Any) -> list[torch.Tensor]:
    """Embeddings of the prompt for the azimuths of VIEWS, 0.3 and -2.2 rad."""
    front, side, back = (embedding(pipeline, f"{PROMPT}, {v} view") for v in ("front", "side", "back"))
    quarter = math.pi / 2
    first, second = 0.3 / quarter, 2.2 / quarter - 1.0
    return [(1 - first) * front + first * side, (1 - second) * side + second * back]


def test_latents_are_the_encoders_mean(saved: Path, original: Any) -> None:
    guide = guidance(saved)
    assert guide.native_resolution == SIZE and guide.space == "latent" and not guide.uses_cameras
    images = pictures()
    x0 = guide.encode(images, VIEWS)
    assert x0.shape == (2, SIZE // 8, SIZE // 8, 4) and x0.is_contiguous() and x0.dtype == torch.float32
    with torch.no_grad():
        latents = original.vae.encode(2.0 * images.permute(0, 3, 1, 2) - 1.0).latent_dist.mean
    expected = latents.permute(0, 2, 3, 1) * original.vae.config.scaling_factor
    torch.testing.assert_close(x0.detach(), expected, rtol=1e-4, atol=1e-5)


def test_pictures_of_other_sizes_are_resized(saved: Path) -> None:
    guide = guidance(saved)
    images = pictures(size=96).requires_grad_()
    x0 = guide.encode(images, looking(0.0, 1.0, size=96))
    assert x0.shape == (2, 8, 8, 4)
    x0.square().sum().backward()
    assert images.grad is not None and float(images.grad.abs().min(-1).values.max()) > 0.0
    with pytest.raises(ValueError, match="must be square"):
        guide.encode(images[:, :50], VIEWS)


def test_predictions_equal_the_networks_own(saved: Path, original: Any) -> None:
    guide = guidance(saved)
    x, t = noise(), 321
    expected = {
        "empty": [embedding(original, "")] * 2,
        "negative": [embedding(original, guide.config.negative_prompt)] * 2,
        "prompt": prompted(original),
    }
    for condition, embeddings in expected.items():
        got = guide.noise_prediction(x, t, condition, VIEWS)
        assert got.is_contiguous() and got.dtype == torch.float32
        torch.testing.assert_close(got, direct(original, x, t, embeddings), rtol=1e-4, atol=2e-5)
    negative, prompt = (direct(original, x, t, expected[c]) for c in ("negative", "prompt"))
    assert float((negative - prompt).abs().max()) > 1e-3
    mixed = guide.guided(x, t, VIEWS, 7.5)
    torch.testing.assert_close(mixed, negative + 7.5 * (prompt - negative), rtol=1e-3, atol=2e-4)
    plain = guidance(saved, view_prompts=False).noise_prediction(x, t, "prompt", VIEWS)
    expected_plain = direct(original, x, t, [embedding(original, PROMPT)] * 2)
    torch.testing.assert_close(plain, expected_plain, rtol=1e-4, atol=2e-5)


def test_perp_neg_repels_the_other_views(saved: Path, original: Any) -> None:
    guide = guidance(saved, perp_neg=True)
    x, t = noise(), 400
    one = {name: direct(original, x, t, [embedding(original, text)] * 2)
           for name, text in (("negative", guide.config.negative_prompt), ("front", f"{PROMPT}, front view"),
                              ("side", f"{PROMPT}, side view"))}  # fmt: skip
    prompt = direct(original, x, t, prompted(original))
    weights = prompts.repulsion_weights(VIEWS.azimuths)
    positive = prompts.perp_neg(one["negative"], prompt, torch.stack([one["front"], one["side"]]), weights)
    expected = one["negative"] + 7.5 * (positive - one["negative"])
    got = guide.guided(x, t, VIEWS, 7.5)
    torch.testing.assert_close(got, expected, rtol=1e-3, atol=2e-4)
    assert float((got - guidance(saved).guided(x, t, VIEWS, 7.5)).abs().max()) > 1e-3


@pytest.mark.parametrize("kind", ["v_prediction", "sample"])
def test_other_kinds_of_prediction_become_noise(kind: str, saved: Path, tmp_path: Path) -> None:
    from diffusers import DDIMScheduler

    folder = tiny_pipeline.stable_diffusion(tmp_path, prediction_type=kind)
    x, t = noise(), 500
    output = guidance(saved).noise_prediction(x, t, "empty", VIEWS)  # the same weights, read as they are
    got = guidance(folder).noise_prediction(x, t, "empty", VIEWS)
    scheduler = DDIMScheduler.from_pretrained(folder, subfolder="scheduler", clip_sample=False)
    scheduler.set_timesteps(1000)
    clean = scheduler.step(output, t, x).pred_original_sample
    alpha = scheduler.alphas_cumprod[t]
    torch.testing.assert_close(got, (x - alpha.sqrt() * clean) / (1 - alpha).sqrt(), rtol=1e-4, atol=1e-5)


def test_a_schedule_that_ends_in_pure_noise_stays_finite(tmp_path: Path) -> None:
    folder = tiny_pipeline.stable_diffusion(
        tmp_path, prediction_type="v_prediction", rescale_betas_zero_snr=True
    )
    guide = guidance(folder)
    assert 0.0 < float(guide.alphas_cumprod[-1]) < 1e-6
    assert bool(torch.isfinite(guide.noise_prediction(noise(), 999, "prompt", VIEWS)).all())


def test_interval_score_matching_end_to_end(saved: Path) -> None:
    """Loaded from the disk, through encoder and network, back to the pictures; the same bytes again."""
    score = ScoreDistillation(guidance(saved), ScoreConfig())
    gradients = []
    for _ in range(2):
        images = pictures().requires_grad_()
        loss, result = score.loss(images, VIEWS, 900, step_generator(0, "surfels", 900))
        loss.backward()
        assert result.invalid == 0 and result.gradient.shape == (2, 8, 8, 4)
        assert bool(torch.isfinite(images.grad).all()) and float(images.grad.abs().max()) > 0.0
        gradients.append(images.grad)
    assert torch.equal(*gradients)


def test_the_gradient_goes_back_through_the_encoder(saved: Path) -> None:
    guide = guidance(saved)
    score = ScoreDistillation(guide, ScoreConfig(flip_probability=0.0))
    images = pictures(size=96).requires_grad_()
    views = looking(0.3, -2.2, size=96)
    loss, result = score.loss(images, views, 2000, step_generator(0, "s", 0))
    (pull,) = torch.autograd.grad(loss, images)
    (expected,) = torch.autograd.grad(guide.encode(images, views), images, result.gradient)
    torch.testing.assert_close(pull, expected)
    assert float(pull.abs().max()) > 0.0


def test_pixels_of_deepfloyd(tmp_path: Path) -> None:
    guide = guidance(tiny_pipeline.deepfloyd(tmp_path))
    assert guide.space == "pixel" and guide.native_resolution == tiny_pipeline.PIXELS
    images = pictures(size=tiny_pipeline.PIXELS).requires_grad_()
    views = looking(0.3, -2.2, size=tiny_pipeline.PIXELS)
    x0 = guide.encode(images, views)
    torch.testing.assert_close(x0, 2.0 * images - 1.0)
    loss, result = ScoreDistillation(guide, ScoreConfig()).loss(images, views, 0, step_generator(0, "s", 0))
    loss.backward()
    # Pixels go through no network: the gradient arrives as it is, twice for [-1, 1] (or mirrored).
    assert result.gradient.shape == images.shape
    assert any(torch.allclose(images.grad, 2.0 * g) for g in (result.gradient, result.gradient.flip(2)))
    # Of what the network says only the noise counts, not the variance beside it.
    predicted = guide.noise_prediction(x0.detach(), 300, "empty", views)
    with torch.no_grad():
        output = guide._unet(
            x0.permute(0, 3, 1, 2), 300, encoder_hidden_states=guide._embeddings["empty"].expand(2, -1, -1)
        ).sample
    assert output.shape[1] == 6
    torch.testing.assert_close(predicted, output[:, :3].permute(0, 2, 3, 1), rtol=1e-4, atol=1e-5)
    # Reduced fourfold, noise of standard deviation 0.29 averages out.
    reduced = guide.encode(pictures(size=4 * tiny_pipeline.PIXELS), views)
    assert float(reduced.detach().std()) < 2.0 * 0.29 / 3.0
    with pytest.raises(
        GuidanceError, match=r"guidance.space=latent, but .* works on pixels: use auto or pixel"
    ):
        guidance(tmp_path, space="latent")


def test_half_precision_on_a_cpu_is_bfloat16(saved: Path) -> None:
    x, t = noise(), 321
    full = guidance(saved).noise_prediction(x, t, "prompt", VIEWS)
    guide = guidance(saved, dtype="bfloat16")
    half = guide.noise_prediction(x, t, "prompt", VIEWS)
    assert half.dtype == torch.float32 and guide.describe()["dtype"] == "bfloat16"
    torch.testing.assert_close(half, full, rtol=0.05, atol=0.05)
    assert not torch.equal(half, full)
    assert guide.encode(pictures(), VIEWS).dtype == torch.float32
    with pytest.raises(GuidanceError, match="float16 needs a GPU"):
        guidance(saved, dtype="float16")


def test_the_estimate_grows_with_the_work(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 0.5, 10.0, 12.0] * 4)
    guide = guidance(saved)
    assert guide.seconds_per_iteration(ScoreConfig(), 1, 10) > 0.0
    monkeypatch.setattr("time.perf_counter", lambda: next(clock))
    # Encoding takes 0.5 s and an evaluation 2 s, of which SDS needs two for each picture.
    assert guide.seconds_per_iteration(ScoreConfig(method="sds"), 3, 10) == pytest.approx(3 * (0.5 + 2 * 2.0))
    perp = guidance(saved, perp_neg=True).seconds_per_iteration(ScoreConfig(method="sds"), 3, 10)
    assert perp == pytest.approx(3 * (0.5 + 4 * 2.0))


def test_a_prompt_that_is_too_long_is_told(saved: Path, caplog: pytest.LogCaptureFixture) -> None:
    guidance(saved, negative_prompt="ugly")
    assert not caplog.records
    guidance(saved, negative_prompt=40 * "ugly ")
    assert "the model reads 77 of the 162 tokens of 'ugly ugly" in caplog.text


def test_what_it_says_of_itself(saved: Path) -> None:
    words = guidance(saved, perp_neg=True).describe()
    assert json.loads(json.dumps(words)) == words
    assert words["model"] == str(saved) and words["revision"] is None
    assert words["prompt"] == PROMPT and words["perp_neg"] is True
    assert words["prediction"] == "epsilon" and words["parameters"] > 10_000


def test_nan_in_the_weights_is_counted_and_ends_the_run(saved: Path, tmp_path: Path) -> None:
    from diffusers import UNet2DConditionModel

    shutil.copytree(saved, tmp_path / "sd")
    with quiet():
        unet = UNet2DConditionModel.from_pretrained(saved / "unet")
        with torch.no_grad():
            unet.conv_out.bias[0] = float("nan")
        unet.save_pretrained(tmp_path / "sd" / "unet")
    score = ScoreDistillation(guidance(tmp_path / "sd"), ScoreConfig(nan_limit=1))
    assert score.gradient(pictures(), VIEWS, 0, step_generator(0, "s", 0)).invalid > 0
    with pytest.raises(GuidanceError, match=r"past score.nan_limit=1 .*the diffusers model"):
        score.gradient(pictures(), VIEWS, 1, step_generator(0, "s", 1))


def test_requests_that_contradict_themselves(saved: Path) -> None:
    with pytest.raises(GuidanceError, match="the prompt is empty"):
        guidance(saved, prompt="  ")
    with pytest.raises(GuidanceError, match=r"perp_neg tells views apart: it needs guidance.view_prompts"):
        guidance(saved, perp_neg=True, view_prompts=False)
    with pytest.raises(GuidanceError, match=r"guidance.space=pixel, but .* works on latents"):
        guidance(saved, space="pixel")
    with pytest.raises(GuidanceError, match=r"cpu_offload moves parts to a GPU, and there is none"):
        guidance(saved, cpu_offload=True)


def test_models_that_are_not_there(saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path / "cache"))
    passing = r"pass --guidance diffusers --model DIR with a"
    with pytest.raises(GuidanceError, match=rf"no diffusion model given: {passing} directory"):
        guidance(None)
    for missing in ("nobody/no-such-model", tmp_path / "nowhere"):
        with pytest.raises(
            GuidanceError, match=rf"no directory '.*', and no such model .*{passing} directory"
        ):
            guidance(missing)
    (tmp_path / "empty").mkdir()
    with pytest.raises(
        GuidanceError, match=rf"empty holds no model_index.json: {passing.replace(' a', '')} the"
    ):
        guidance(tmp_path / "empty")
    checkpoint = tmp_path / "model.safetensors"
    checkpoint.write_bytes(b"x")
    with pytest.raises(GuidanceError, match=rf"is a file: {passing} pipeline's directory"):
        guidance(checkpoint)


def test_a_model_in_the_hubs_cache_needs_no_network(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(constants, "HF_HUB_CACHE", str(tmp_path))
    cached, commit = tmp_path / "models--someone--tiny-sd", "0123456789abcdef" * 2 + "01234567"
    shutil.copytree(saved, cached / "snapshots" / commit)
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text(commit)
    guide = guidance("someone/tiny-sd")
    words = guide.describe()
    assert words["model"] == "someone/tiny-sd" and words["revision"] == commit
    expected = guidance(saved).noise_prediction(noise(), 300, "prompt", VIEWS)
    assert torch.equal(guide.noise_prediction(noise(), 300, "prompt", VIEWS), expected)


def test_models_that_are_damaged(saved: Path, tmp_path: Path) -> None:
    def damaged(name: str) -> Path:
        return Path(shutil.copytree(saved, tmp_path / name))

    (damaged("index") / "model_index.json").write_text("{")
    with pytest.raises(GuidanceError, match=r"model_index.json cannot be read .*download the model again"):
        guidance(tmp_path / "index")
    weights = damaged("cut") / "unet" / "diffusion_pytorch_model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    (damaged("unetless") / "unet" / "diffusion_pytorch_model.safetensors").unlink()
    shutil.rmtree(damaged("textless") / "text_encoder")
    for name in ("cut", "unetless", "textless"):
        with pytest.raises(
            GuidanceError, match=rf"{name} cannot be loaded as a StableDiffusionPipeline"
        ) as raised:
            guidance(tmp_path / name)
        assert "\n" not in str(raised.value)


def test_models_of_another_kind(saved: Path, tmp_path: Path) -> None:
    def of_kind(kind: str) -> Path:
        folder = tmp_path / kind
        folder.mkdir()
        (folder / "model_index.json").write_text(json.dumps({"_class_name": kind}))
        return folder

    for kind, reason in (("StableDiffusionXLPipeline", "second text encoder"),
                         ("StableDiffusion3Pipeline", "flow-matching"), ("FluxPipeline", "flow-matching"),
                         ("StableDiffusionUpscalePipeline", "another task")):  # fmt: skip
        with pytest.raises(
            GuidanceError, match=rf"is a {kind}, .*{reason}.*; pass a Stable Diffusion 1 or 2"
        ):
            guidance(of_kind(kind))
    with pytest.raises(GuidanceError, match=r"is a DDPMPipeline; pass a"):
        guidance(of_kind("DDPMPipeline"))
    inpainting = tiny_pipeline.stable_diffusion(tmp_path / "inpainting", channels=9)
    with pytest.raises(GuidanceError, match="takes 9 channels and gives 4"):
        guidance(inpainting)
    short = tiny_pipeline.stable_diffusion(tmp_path / "short", num_train_timesteps=100)
    with pytest.raises(GuidanceError, match="trained with 100 steps of noise; 1000 are needed"):
        guidance(short)


def test_without_the_extra_the_error_names_it(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [n for n in sys.modules if n == "transformers" or n.startswith("transformers.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "transformers", None)
    with pytest.raises(
        GuidanceError, match=r"need diffusers and transformers .*pip install 'gdpro-sim\[diff"
    ):
        guidance(saved)


@pytest.mark.cuda
@needs_gpu
@pytest.mark.parametrize("dtype", ["float32", "float16", "bfloat16"])
@pytest.mark.parametrize("offload", [False, True])
def test_cuda_in_every_precision(saved: Path, dtype: str, offload: bool) -> None:
    """Gradients of half precision lie near those of float32, and offloading changes nothing."""

    def pulled(device: str, **options: Any) -> torch.Tensor:
        score = ScoreDistillation(guidance(saved, device=device, **options), ScoreConfig())
        images = pictures().to(device).requires_grad_()
        loss, result = score.loss(images, VIEWS, 0, step_generator(0, "s", 0))
        loss.backward()
        assert result.invalid == 0
        return images.grad.cpu()

    expected = pulled("cpu")
    got = pulled("cuda", dtype=dtype, cpu_offload=offload)
    similarity = torch.nn.functional.cosine_similarity(expected.flatten(), got.flatten(), dim=0)
    assert similarity > (0.999 if dtype == "float32" else 0.9)
