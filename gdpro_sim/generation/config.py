"""Every number of generation in one place: `default` is sized for a CPU, `paper` is the paper's.

Sources: *paper* GaussianDreamerPro (arXiv 2406.18462); *code* its released code, LucidDreamer (arXiv
2311.11284), SuGaR and 2DGS; *ours* chosen here. Lengths are in the unit frame (bounding sphere of radius 1).
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from gdpro_sim.errors import RequestError


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, validate_default=True)


class ScoreConfig(_Part):
    """Score distillation: ISM, or SDS to compare with."""

    method: Literal["ism", "sds"] = Field(default="ism", description="ism (paper) or sds (DreamFusion)")
    guidance_scale: float = Field(default=7.5, ge=0.0, description="classifier-free guidance (paper: 7.5)")
    gradient_scale: float = Field(default=0.1, gt=0.0, description="factor on the gradient (code: 0.1)")
    warmup: int = Field(
        default=1000, ge=0, description="iterations over which omega falls from 1 to 0 (code: 1000)"
    )
    t_min: int = Field(default=20, ge=1, le=999, description="smallest diffusion step (code: 20)")
    t_max: int = Field(
        default=500, ge=2, le=1000, description="largest step once warmed up, excluded (code: 500)"
    )
    t_warmup: int = Field(default=480, ge=0, le=980, description="added to t_max at the start (code: 480)")
    interval: int = Field(default=80, ge=1, description="s = t - interval once warmed up (code: 80)")
    interval_warmup: int = Field(
        default=20, ge=0, description="added to the interval at the start (code: 20)"
    )
    inversion_stride: int = Field(
        default=200, ge=1, description="stride of the DDIM inversion, steps (code: 200)"
    )
    shared_noise: float = Field(
        default=0.1, ge=0.0, description="weight of noise shared by a channel (code: 0.1)"
    )
    flip_probability: float = Field(
        default=0.5,
        ge=0.0,
        le=1.0,
        description="mirror the batch; camera-conditioned guidance never (code: 0.5)",
    )
    depth_probability: float = Field(
        default=0.2,
        ge=0.0,
        le=1.0,
        description="share of iterations that show disparity as an image (code: 0.2)",
    )
    nan_limit: int = Field(
        default=20, ge=0, description="iterations with NaN from the model before the run stops (ours)"
    )


class GuidanceConfig(_Part):
    kind: Literal["procedural", "views", "diffusers"] = Field(
        default="procedural", description="who judges the pictures"
    )
    model: str | None = Field(default=None, description="diffusers: local directory, or a hub id")
    negative_prompt: str = Field(
        default="unrealistic, blurry, low quality, out of focus, ugly, low contrast, dull, low-resolution, "
        "oversaturation",
        description="diffusers: negative prompt (code)",
    )
    view_prompts: bool = Field(
        default=True, description="diffusers: append front, side and back view (paper)"
    )
    perp_neg: bool = Field(
        default=False, description="diffusers: Perp-Neg (arXiv 2304.04968), off by default (code)"
    )
    space: Literal["auto", "latent", "pixel"] = Field(default="auto", description="diffusers: what is noised")
    dtype: Literal["auto", "float32", "float16", "bfloat16"] = Field(
        default="auto", description="auto: half on CUDA"
    )
    cpu_offload: bool = Field(
        default=False, description="diffusers: move parts to the GPU one by one (accelerate)"
    )
    instances: int = Field(
        default=1, ge=1, le=16, description="procedural: seeded variants K in the posterior mean"
    )
    kernel_width: float = Field(
        default=0.0, ge=0.0, description="closed form: width h of each variant, in colour units"
    )
    jitter: float = Field(
        default=0.0, ge=0.0, description="closed form: random shift of the target per step (ablation)"
    )
    resolution: int = Field(
        default=192, ge=64, le=512, description="procedural: cells across the reference surface"
    )


class PriorConfig(_Part):
    kind: Literal["procedural", "mesh", "shap-e", "hull", "sphere"] = Field(
        default="procedural", description="where the coarse mesh comes from; hull: from photos with alpha"
    )
    file: str | None = Field(default=None, description="mesh: its file")
    model: str | None = Field(default=None, description="shap-e: local directory, or a hub id")
    cap3d: str | None = Field(
        default=None, description="shap-e: Cap3D's fine-tuned prior weights, a .pth file (paper)"
    )
    prompt: str | None = Field(
        default=None, description="prompt of the prior where it differs from the main one (code)"
    )
    resolution: int = Field(
        default=28, ge=8, le=256, description="cells across the coarse surface (ours: coarse on purpose)"
    )
    guidance_scale: float = Field(default=15.0, ge=0.0, description="shap-e (paper: 15)")
    steps: int = Field(default=64, ge=1, description="shap-e: Karras steps (paper: 64)")


class CameraConfig(_Part):
    """Random training cameras; pairs are ranges at the first iteration and once tightened."""

    radius: tuple[float, float] = Field(default=(5.2, 5.5), description="distance at the start (code)")
    radius_late: tuple[float, float] = Field(
        default=(4.6, 5.2), description="distance at the end (code: 3.5 to 5.0)"
    )
    fov: tuple[float, float] = Field(
        default=(0.44, 0.60), description="vertical, rad, at the start (code: 0.32 to 0.60)"
    )
    fov_late: tuple[float, float] = Field(
        default=(0.34, 0.50), description="vertical, rad, at the end (code: 0.16 to 0.60)"
    )
    polar: tuple[float, float] = Field(
        default=(15.0, 150.0), description="degrees from +Z (paper: 30 to 150; ours looks into vessels)"
    )
    jitter_centre: float = Field(default=0.03, ge=0.0, description="standard deviation of the eye (code)")
    jitter_target: float = Field(
        default=0.03, ge=0.0, description="standard deviation of the point looked at (code)"
    )
    jitter_up: float = Field(default=0.02, ge=0.0, description="standard deviation of the up vector (code)")
    tighten: float = Field(
        default=0.5, ge=0.0, le=1.0, description="share of the run over which the ranges move (ours)"
    )


class StageConfig(_Part):
    """What both stages have in common."""

    batch: int = Field(default=2, ge=1, description="views an iteration (paper: 4)")
    supersample: int = Field(
        default=2, ge=1, le=4, description="views are reduced by this before guidance (paper: 2)"
    )
    lr_color: float = Field(default=4e-2, gt=0.0, description="(paper: 5e-3)")
    lr_sh: float = Field(default=1e-3, gt=0.0, description="higher SH bands (code: 2.5e-4)")
    lr_opacity: float = Field(default=5e-2, gt=0.0, description="(paper: 5e-2; code of stage 2: 5e-3)")
    lr_rotation: float = Field(default=1e-2, gt=0.0, description="(paper: 5e-4)")
    lr_last: float = Field(
        default=0.1, gt=0.0, le=1.0, description="last over first rate of all but positions (paper: 1)"
    )
    sh_degree: int = Field(
        default=0, ge=0, le=3, description="highest SH degree (paper: 3, in stage 2 0; code: 3)"
    )


class SurfelConfig(StageConfig):
    """Stage 1."""

    kind: Literal["surfels", "gaussians"] = Field(
        default="surfels", description="2D surfels (paper) or 3D Gaussians"
    )
    iterations: int = Field(default=350, ge=0, description="(paper: 5000)")
    resolution: int = Field(default=320, ge=16, description="pixels across a rendered view (paper: 1024)")
    initial: int = Field(
        default=6000, ge=16, description="surfels at the start (paper: the prior's vertices)"
    )
    maximum: int = Field(default=16000, ge=16, description="hard cap on the count (ours)")
    initial_opacity: float = Field(default=0.1, gt=0.0, lt=1.0, description="(code: 0.1)")
    lr_position: float = Field(default=1e-3, gt=0.0, description="Adam, first step (paper: 1.6e-5 x extent)")
    lr_position_final: float = Field(default=1e-4, gt=0.0, description="Adam, last step (log decay)")
    lr_scale: float = Field(default=1e-2, gt=0.0, description="(paper: 5e-4)")
    sh_every: int = Field(default=500, ge=1, description="iterations between degrees (code: 500)")
    tv: float = Field(
        default=0.0, ge=0.0, description="weight of total variation of colour and depth (paper: 10)"
    )
    normal_consistency: float = Field(
        default=500.0,
        ge=0.0,
        description="weight, from the end of densification on (code: 0.1, which a summed score drowns)",
    )
    distortion: float = Field(
        default=0.0, ge=0.0, description="weight of depth distortion (2DGS: 100 to 1000; code: 0)"
    )
    densify_from: int = Field(default=40, ge=0, description="first iteration (code: 100)")
    densify_until: int = Field(default=230, ge=0, description="last iteration (code: 2500)")
    densify_every: int = Field(default=30, ge=1, description="(code: 100)")
    densify_gradient: float = Field(
        default=0.25, gt=0.0, description="view-space position gradient, NDC (code: 2e-4)"
    )
    split_factor: float = Field(
        default=1.6, gt=1.0, description="a split one's scale is divided by this (code: 1.6)"
    )
    split_size: float = Field(
        default=0.01, gt=0.0, description="larger ones are split, smaller cloned, x extent (code)"
    )
    prune_opacity: float = Field(default=0.005, ge=0.0, lt=1.0, description="(code: 0.005)")
    reset_every: int = Field(default=0, ge=0, description="opacity reset, 0: never (code: 400)")


class ExtractionConfig(_Part):
    points: Literal["rendered-depth", "level-set", "centres"] = Field(
        default="rendered-depth", description="what Poisson is given; centres: the paper's own"
    )
    cameras: int = Field(default=24, ge=6, description="views the points are cast from (code: 15)")
    resolution: int = Field(default=256, ge=32, description="pixels across such a view (ours)")
    level: float = Field(default=0.3, gt=0.0, description="density of the level set (code: 0.3)")
    depth: int = Field(default=8, ge=4, le=11, description="octree depth of screened Poisson (code: 10)")
    trim: float = Field(
        default=0.05,
        ge=0.0,
        lt=1.0,
        description="least support, as a quantile of the density; watertight off",
    )
    watertight: bool = Field(default=True, description="closed, as physics needs it (ours)")
    keep: Literal["largest", "all"] = Field(default="largest", description="components kept (paper: largest)")
    triangles: int = Field(default=6000, ge=20, description="target count of stage 2's mesh (code: 40000)")


class RefinementConfig(StageConfig):
    """Stage 2."""

    mode: Literal["bound", "frozen", "unbound", "textured-mesh"] = Field(
        default="bound", description="bound; others ablate"
    )
    iterations: int = Field(default=250, ge=0, description="(paper: 5000)")
    resolution: int = Field(default=384, ge=16, description="pixels across a rendered view (paper: 1024)")
    per_triangle: int = Field(
        default=10, ge=1, description="Gaussians on a triangle: 1, 3, 4, 6, 10, ... (code: 55)"
    )
    initial_opacity: float = Field(default=0.7, gt=0.0, lt=1.0, description="(paper: 0.7)")
    lr_vertex: float = Field(default=2e-3, gt=0.0, description="Adam, first step (paper: 1.6e-4 x extent)")
    lr_vertex_final: float = Field(default=2e-4, gt=0.0, description="Adam, last step (log decay)")
    lr_scale: float = Field(default=2e-2, gt=0.0, description="(paper: 5e-4)")
    smoothing: float = Field(
        default=3.0, ge=0.0, description="lambda of vertex steps (1 + lambda L)^-1, Large Steps (paper: 0)"
    )
    flatness: float = Field(
        default=0.2, gt=0.0, le=1.0, description="first scale along the normal over in-plane (paper: 1)"
    )
    tv: float = Field(default=0.0, ge=0.0, description="weight of total variation of colour (paper: 10)")
    scale: float = Field(default=0.1, ge=0.0, description="weight of the mean scale (paper)")
    normal_consistency: float = Field(
        default=0.3, ge=0.0, description="weight over adjacent faces (code: 0.3)"
    )
    eps2d: float = Field(
        default=0.05,
        ge=0.0,
        description="screen-space dilation while learning, px^2: a wide one shrinks the mesh (code: 0.3)",
    )
    laplacian: float = Field(
        default=0.0, ge=0.0, description="weight of the uniform Laplacian (available in code)"
    )


class OutputConfig(_Part):
    turntable_views: int = Field(
        default=6, ge=0, le=120, description="pictures a stage's turntable sheet has"
    )
    picture_size: int = Field(default=256, ge=32, le=2048, description="pixels across each of them")
    checkpoint_every: int = Field(default=50, ge=1, description="iterations between checkpoints")
    tets: bool = Field(
        default=False,
        description="fill with tetrahedra now; they do not repeat to the bit (else: when simulated)",
    )
    target_tets: int = Field(default=6000, ge=50, description="about how many")
    material: str | None = Field(default=None, description="physical preset; none: what the prior proposes")
    height: float | None = Field(
        default=None, gt=0.0, description="m; none: the prior's size, 0.3 where it knows none"
    )


class GenerationConfig(_Part):
    score: ScoreConfig = ScoreConfig()
    guidance: GuidanceConfig = GuidanceConfig()
    prior: PriorConfig = PriorConfig()
    cameras: CameraConfig = CameraConfig()
    surfels: SurfelConfig = SurfelConfig()
    extraction: ExtractionConfig = ExtractionConfig()
    refinement: RefinementConfig = RefinementConfig()
    output: OutputConfig = OutputConfig()


PRESETS: dict[str, dict[str, dict[str, Any]]] = {
    "draft": {
        "guidance": {"resolution": 96},
        "surfels": {
            "iterations": 120,
            "initial": 4000,
            "maximum": 8000,
            "resolution": 192,
            "densify_until": 90,
        },
        "extraction": {"resolution": 192, "depth": 7, "triangles": 3000},
        "refinement": {"iterations": 120, "resolution": 256, "per_triangle": 6},
    },
    "default": {},
    "high": {
        "guidance": {"resolution": 256},
        "surfels": {
            "iterations": 900,
            "initial": 12000,
            "maximum": 40000,
            "resolution": 384,
            "densify_until": 600,
        },
        "extraction": {"cameras": 32, "resolution": 384, "depth": 9, "triangles": 16000},
        "refinement": {"iterations": 700, "resolution": 640},
    },
    "paper": {
        "cameras": {
            "polar": (30.0, 150.0),
            "radius_late": (3.5, 5.0),
            "fov": (0.32, 0.60),
            "fov_late": (0.16, 0.60),
        },
        "surfels": {
            "iterations": 5000,
            "batch": 4,
            "resolution": 1024,
            "supersample": 2,
            "initial": 100_000,
            "maximum": 1_000_000,
            "lr_position": 1.6e-5,
            "lr_position_final": 1.6e-7,
            "lr_color": 5e-3,
            "lr_sh": 2.5e-4,
            "lr_scale": 5e-4,
            "lr_rotation": 5e-4,
            "lr_last": 1.0,
            "sh_degree": 3,
            "normal_consistency": 0.1,
            "tv": 10.0,
            "densify_gradient": 2e-4,
            "densify_from": 100,
            "densify_until": 2500,
            "densify_every": 100,
            "reset_every": 400,
        },
        "extraction": {
            "points": "level-set",
            "cameras": 15,
            "resolution": 512,
            "depth": 10,
            "triangles": 40_000,
        },
        "refinement": {
            "iterations": 5000,
            "batch": 4,
            "resolution": 1024,
            "supersample": 2,
            "per_triangle": 55,
            "lr_vertex": 1.6e-4,
            "lr_vertex_final": 1.6e-6,
            "lr_color": 5e-3,
            "lr_sh": 2.5e-4,
            "lr_scale": 5e-4,
            "lr_rotation": 5e-4,
            "lr_last": 1.0,
            "eps2d": 0.3,
            "smoothing": 0.0,
            "flatness": 1.0,
            "tv": 10.0,
            "scale": 1.0,
        },
        "prior": {"resolution": 128},
        "guidance": {"resolution": 384},
    },
}
"""What differs from the defaults. `paper` asks for a GPU; the others are sized for two CPU cores."""


def load_config(
    preset: str = "default",
    file: str | Path | None = None,
    overrides: Iterable[str] = (),
    base: Mapping[str, Any] | None = None,
) -> GenerationConfig:
    """A configuration from a preset, a YAML file over it, `base` over that, and "part.field=value" last.

    Raises RequestError naming the field, the value and what it must be.
    """
    if preset not in PRESETS:
        raise RequestError(f"quality must be one of {', '.join(PRESETS)}, got {preset!r}")
    values: dict[str, Any] = {part: dict(fields) for part, fields in PRESETS[preset].items()}
    if file is not None:
        _merge(values, _read(Path(file)), str(file))
    _merge(values, base or {}, "options")
    for item in overrides:
        key, equals, text = item.partition("=")
        part, dot, name = key.strip().partition(".")
        if not (equals and dot and part and name):
            raise RequestError(f"--set {item}: give PART.FIELD=VALUE, for instance surfels.iterations=500")
        try:
            value = yaml.safe_load(text)
        except yaml.YAMLError:
            raise RequestError(f"--set {item}: {text!r} is no YAML value") from None
        _merge(values, {part: {name: value}}, f"--set {item}")
    try:
        return GenerationConfig.model_validate(values)
    except ValidationError as error:
        raise RequestError(_reason(error)) from None


def _read(path: Path) -> dict[str, Any]:
    try:
        data = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError) as error:
        raise RequestError(f"{path}: cannot be read ({getattr(error, 'strerror', None) or error})") from None
    except yaml.YAMLError as error:
        raise RequestError(f"{path}: not YAML: {' '.join(str(error).split())}") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise RequestError(
            f"{path}: must hold parts with fields, for instance `surfels: {{iterations: 500}}`"
        )
    return data


def _merge(values: dict[str, Any], more: Mapping[str, Any], where: str) -> None:
    known = GenerationConfig.model_fields
    for part, fields in more.items():
        if part not in known:
            raise RequestError(f"{where}: no part {part!r}{_near(part, known)}; parts: {', '.join(known)}")
        if not isinstance(fields, Mapping):
            raise RequestError(f"{where}: {part} must hold fields, got {fields!r}")
        names = getattr(known[part].annotation, "model_fields", {})
        for name in fields:
            if name not in names:
                raise RequestError(f"{where}: {part} has no field {name!r}{_near(str(name), names)}")
        values.setdefault(part, {}).update(fields)


def _near(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), n=1)
    return f" (did you mean {near[0]!r}?)" if near else ""


def _reason(error: ValidationError) -> str:
    first = error.errors()[0]
    where = ".".join(str(x) for x in first["loc"])
    return f"{where}: {first['msg']}, got {first.get('input')!r}"


__all__ = [
    "PRESETS",
    "CameraConfig",
    "ExtractionConfig",
    "GenerationConfig",
    "GuidanceConfig",
    "OutputConfig",
    "PriorConfig",
    "RefinementConfig",
    "ScoreConfig",
    "StageConfig",
    "SurfelConfig",
    "load_config",
]
