"""Shap-E as a prior, with a tiny pipeline whose object is known, saved and loaded as a user's is."""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from gdpro_sim.device import serial_torch
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.config import PriorConfig
from gdpro_sim.generation.pretrained import quiet
from gdpro_sim.generation.priors import shap_e
from gdpro_sim.generation.priors.shap_e import ShapEPrior
from gdpro_sim.generation.protocols import CoarseMesh
from tests.generation import tiny_pipeline


@pytest.fixture(autouse=True)
def one_thread() -> Iterator[None]:
    with serial_torch():
        yield


@pytest.fixture(scope="module")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny_pipeline.shap_e(tmp_path_factory.mktemp("shap_e"))


def prior(folder: Path | str | None, **options: Any) -> ShapEPrior:
    values = {"resolution": 24, "steps": 4, **options}
    return ShapEPrior(
        PriorConfig(kind="shap-e", model=str(folder) if folder else None, **values), device="cpu"
    )


@pytest.fixture(scope="module")
def made(saved: Path) -> CoarseMesh:
    return prior(saved).mesh("a ball", 3)


def test_the_mesh_is_closed_outward_and_stands_in_metres(made: CoarseMesh) -> None:
    mesh = made.surface
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6.0
    assert volume > 0.0
    low, high = mesh.vertices.min(0), mesh.vertices.max(0)
    np.testing.assert_allclose(high[2] - low[2], 0.3, rtol=1e-5)
    np.testing.assert_allclose([*(low + high)[:2], low[2]], 0.0, atol=1e-6)
    assert made.description["metric"] is False and made.material is None
    # The field is cos x + cos y + cos(z) / 2 - (5 / 2 - 0.18): its half axes are known.
    half = np.array([math.acos(1.0 - 0.18), math.acos(1.0 - 0.18), math.acos(1.0 - 2 * 0.18)])
    np.testing.assert_allclose((high - low) / (high - low)[2], half / half[2], rtol=0.03)


def test_the_front_turns_to_plus_x_and_colours_stay_srgb(made: CoarseMesh) -> None:
    """Shap-E's front is -Y, where the object is least green: that side must face +X afterwards."""
    mesh = made.surface
    assert mesh.colors is not None
    scale = float(mesh.vertices[:, 2].max()) / (2.0 * math.acos(1.0 - 2 * 0.18))
    x, y = (mesh.vertices[mesh.faces][..., axis].astype(np.float64) / scale for axis in (0, 1))
    sigmoid = lambda v: 255.0 / (1.0 + np.exp(-4.0 * v))  # noqa: E731
    red, green, blue = (mesh.colors[..., i].astype(np.float64) for i in range(3))
    np.testing.assert_allclose(green, sigmoid(-x), atol=12.0)
    np.testing.assert_allclose(red, sigmoid(y), atol=12.0)
    assert np.ptp(red) > 150.0 and np.ptp(green) > 150.0
    np.testing.assert_allclose(blue, 127.5, atol=1.0)
    assert (mesh.colors[..., 3] == 255).all()


def test_it_equals_what_diffusers_reads_from_the_same_latent(saved: Path) -> None:
    """The field on a grid and the colours, after `decode_to_mesh`'s way of setting the network's weights."""
    from diffusers import ShapEPipeline

    with quiet():
        pipeline = ShapEPipeline.from_pretrained(saved, local_files_only=True)
    renderer = pipeline.shap_e_renderer
    latent = torch.randn(1, 8, tiny_pipeline.LATENT, generator=torch.Generator().manual_seed(0))
    before = {name: value.clone() for name, value in renderer.state_dict().items()}
    field = shap_e.decoded(renderer, latent)
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(1)) * 2.0 - 1.0
    distances, colors = field(points)
    assert all(torch.equal(value, before[name]) for name, value in renderer.state_dict().items())
    with torch.no_grad():
        renderer.mlp.mlp[0].weight.copy_(renderer.params_proj(latent)["nerstf.mlp.0.weight"][0])
        expected = renderer.mlp(
            position=points[None], direction=None, ts=None, nerf_level="fine", rendering_mode="stf"
        )
    torch.testing.assert_close(distances, expected.signed_distance[0, :, 0])
    torch.testing.assert_close(colors, expected.channels[0])


def test_the_sampler_is_shap_es_own(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from diffusers import ShapEPipeline

    seen: dict[str, Any] = {}
    call = ShapEPipeline.__call__

    def watched(self: Any, prompt: str, **options: Any) -> Any:
        result = call(self, prompt, **options)
        seen.update(options, prompt=prompt, sigmas=self.scheduler.sigmas.clone())
        return result

    monkeypatch.setattr(ShapEPipeline, "__call__", watched)
    prior(saved, prompt="a short one", steps=6).mesh("a long prompt for the picture model", 3)
    assert seen["prompt"] == "a short one"
    assert seen["guidance_scale"] == 15.0 and seen["num_inference_steps"] == 6
    ramp = np.linspace(0.0, 1.0, 6)
    karras = (160.0 ** (1 / 7) + ramp * (1e-3 ** (1 / 7) - 160.0 ** (1 / 7))) ** 7
    sigmas = seen["sigmas"].double().numpy()
    np.testing.assert_allclose(np.unique(sigmas)[::-1][:6], karras, rtol=1e-4)
    assert PriorConfig().steps == 64


def test_the_same_seed_gives_the_same_bytes(saved: Path, made: CoarseMesh) -> None:
    again, other = (prior(saved).mesh("a ball", seed).surface for seed in (3, 4))
    assert np.array_equal(again.vertices, made.surface.vertices)
    assert np.array_equal(again.faces, made.surface.faces)
    assert again.vertices.shape != other.vertices.shape or not np.array_equal(again.vertices, other.vertices)


def test_what_it_says_of_itself(saved: Path, made: CoarseMesh) -> None:
    words = dict(made.description)
    assert json.loads(json.dumps(words)) == words
    assert words["kind"] == "shap-e" and words["prompt"] == "a ball" and words["seed"] == 3
    assert words["model"] == str(saved) and words["cap3d_sha256"] is None


def original_names(pipeline: Any) -> dict[str, torch.Tensor]:
    """The prior's weights as Shap-E itself names and packs them, head by head; numbers drawn anew."""
    generator = torch.Generator().manual_seed(9)
    own = {
        name: torch.randn(value.shape, generator=generator)
        for name, value in pipeline.prior.state_dict().items()
    }
    packed = {
        "wrapped.pos_emb": own["positional_embedding"][0],
        "wrapped.output_proj.weight": own["proj_to_clip_embeddings.weight"],
        "wrapped.output_proj.bias": own["proj_to_clip_embeddings.bias"],
    }
    pairs = {"time_embed.c_fc": "time_embedding.linear_1", "time_embed.c_proj": "time_embedding.linear_2",
             "input_proj": "proj_in", "clip_embed": "embedding_proj", "ln_pre": "norm_in",
             "ln_post": "norm_out"}  # fmt: skip
    for block in range(2):
        theirs, ours = f"backbone.resblocks.{block}", f"transformer_blocks.{block}"
        pairs |= {f"{theirs}.attn.c_proj": f"{ours}.attn1.to_out.0", f"{theirs}.ln_1": f"{ours}.norm1",
                  f"{theirs}.mlp.c_fc": f"{ours}.ff.net.0.proj", f"{theirs}.mlp.c_proj": f"{ours}.ff.net.2",
                  f"{theirs}.ln_2": f"{ours}.norm3"}  # fmt: skip
        for kind in ("weight", "bias"):
            rows = []
            for head in range(2):
                for letter in "qkv":
                    rows.append(own[f"{ours}.attn1.to_{letter}.{kind}"][8 * head : 8 * head + 8])
            packed[f"wrapped.{theirs}.attn.c_qkv.{kind}"] = torch.cat(rows)
    for theirs, ours in pairs.items():
        for kind in ("weight", "bias"):
            packed[f"wrapped.{theirs}.{kind}"] = own[f"{ours}.{kind}"]
    pipeline.expected = own
    return packed


def test_cap3ds_weights_replace_the_prior(saved: Path, tmp_path: Path) -> None:
    from diffusers import ShapEPipeline

    with quiet():
        pipeline = ShapEPipeline.from_pretrained(saved, local_files_only=True)
    weights = original_names(pipeline)
    file = tmp_path / "cap3d.pth"
    torch.save({"model_state_dict": weights, "epoch": 3}, file)
    shap_e.load_fine_tuned(pipeline.prior, file)
    for name, value in pipeline.prior.state_dict().items():
        if name not in ("clip_mean", "clip_std"):
            assert torch.equal(value, pipeline.expected[name]), name
    made = prior(saved, cap3d=str(file)).mesh("a ball", 3)
    assert len(made.description["cap3d_sha256"]) == 64
    assert not np.array_equal(made.surface.vertices, prior(saved).mesh("a ball", 3).surface.vertices)

    del weights["wrapped.ln_pre.bias"]
    torch.save({"model_state_dict": weights}, file)
    with pytest.raises(
        GuidanceError, match=r"does not fit Shap-E's prior \('wrapped.ln_pre.bias'\); prior.cap3d"
    ):
        prior(saved, cap3d=str(file)).mesh("a ball", 3)
    weights["wrapped.ln_pre.bias"] = torch.zeros(5)
    torch.save({"model_state_dict": weights}, file)
    with pytest.raises(GuidanceError, match=r"does not fit Shap-E's prior"):
        prior(saved, cap3d=str(file)).mesh("a ball", 3)


def test_a_checkpoint_that_would_run_code_is_refused(saved: Path, tmp_path: Path) -> None:
    class Harmful:
        def __reduce__(self) -> tuple[Any, ...]:
            return (Path.touch, (tmp_path / "ran",))

    torch.save({"model_state_dict": Harmful()}, tmp_path / "bad.pth")
    with pytest.raises(GuidanceError, match="does not fit Shap-E's prior"):
        prior(saved, cap3d=str(tmp_path / "bad.pth")).mesh("a ball", 0)
    assert not (tmp_path / "ran").exists()


def test_bad_requests_are_one_clear_line(
    saved: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    passing = r"pass --prior shap-e --prior-model DIR with"
    with pytest.raises(GuidanceError, match=rf"no diffusion model given: {passing}"):
        prior(None)
    (tmp_path / "empty").mkdir()
    with pytest.raises(GuidanceError, match=rf"holds no model_index.json: {passing}"):
        prior(tmp_path / "empty")
    (tmp_path / "empty" / "model_index.json").write_text('{"_class_name": "StableDiffusionPipeline"}')
    with pytest.raises(
        GuidanceError, match=r"is a StableDiffusionPipeline; pass a Shap-E text-to-3D pipeline"
    ):
        prior(tmp_path / "empty")
    (tmp_path / "empty" / "model_index.json").write_text('{"_class_name": "ShapEImg2ImgPipeline"}')
    with pytest.raises(GuidanceError, match=r"is a ShapEImg2ImgPipeline, which starts from a picture"):
        prior(tmp_path / "empty")
    with pytest.raises(GuidanceError, match=r"nowhere.pth is not a file: prior.cap3d takes"):
        prior(saved, cap3d="nowhere.pth")
    with pytest.raises(GuidanceError, match="the prompt is empty"):
        prior(saved).mesh(" ", 0)
    shutil.copytree(saved, tmp_path / "cut")
    (tmp_path / "cut" / "prior" / "diffusion_pytorch_model.safetensors").unlink()
    with pytest.raises(
        GuidanceError, match=rf"cut cannot be loaded as a ShapEPipeline .*{passing} a complete"
    ):
        prior(tmp_path / "cut").mesh("a ball", 0)


def test_an_object_without_a_surface_is_told(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    outside = lambda points: (-torch.ones(len(points)), torch.zeros(len(points), 3))  # noqa: E731
    monkeypatch.setattr(shap_e, "decoded", lambda renderer, latent: outside)
    with pytest.raises(GuidanceError, match=r"no surface for 'a ball' and seed 5; try another seed"):
        prior(saved).mesh("a ball", 5)


def test_an_object_that_fills_its_box_is_closed_at_the_border(saved: Path) -> None:
    from types import SimpleNamespace

    volume = SimpleNamespace(bbox_min=-torch.ones(3), bbox_max=torch.ones(3))
    inside = lambda points: (torch.ones(len(points)), torch.zeros(len(points), 3))  # noqa: E731
    vertices, faces, colors = shap_e.surface(inside, volume, 8)
    edges = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    assert set(np.unique(edges, axis=0, return_counts=True)[1]) == {2}
    np.testing.assert_allclose(np.ptp(vertices, axis=0), 2.25, rtol=1e-6)
    assert (colors[:, :3] == 0).all()
