"""What an iteration of either stage has in common: views, pictures for the guidance, the score, the clock."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch.autograd.function import once_differentiable

from gdpro_sim.cameras import Cameras
from gdpro_sim.generation.cameras import CameraSchedule
from gdpro_sim.generation.config import GenerationConfig, RefinementConfig, SurfelConfig
from gdpro_sim.generation.guidance.closed_form import ClosedFormScore
from gdpro_sim.generation.ism import ScoreDistillation
from gdpro_sim.generation.protocols import Guidance, ViewBatch, step_generator
from gdpro_sim.generation.renders import disparity
from gdpro_sim.splatting import losses


@dataclass(frozen=True)
class Shot:
    """What C cameras see of what is learned, before it is reduced for the guidance; with gradients.

    rgb [C, H, W, 3] over the views' backgrounds, depths [C, H, W, 1] expected z, alphas [C, H, W, 1]
    """

    cameras: Cameras
    rgb: torch.Tensor
    depths: torch.Tensor
    alphas: torch.Tensor


class Clock:
    """Wall time of a step by part."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(("render", "guidance", "backward", "optimizer", "other"), 0.0)
        self._start = time.perf_counter()

    @contextlib.contextmanager
    def part(self, name: str) -> Iterator[None]:
        begin = time.perf_counter()
        yield
        self.seconds[name] += time.perf_counter() - begin

    def stop(self) -> dict[str, float]:
        """Seconds by part; what no part took is "other"."""
        whole = time.perf_counter() - self._start
        self.seconds["other"] = max(0.0, whole - sum(self.seconds.values()))
        return self.seconds


class Distillation:
    """Score distillation for one stage: chooses views, reduces pictures, asks the guidance.

    part: the stage's own configuration; its `resolution` is that of a rendered view, which the guidance sees
    reduced by `supersample`
    """

    def __init__(
        self,
        stage: str,
        guidance: Guidance,
        config: GenerationConfig,
        part: SurfelConfig | RefinementConfig,
        seed: int,
    ) -> None:
        self.stage, self.guidance, self.seed = stage, guidance, seed
        self.iterations, self.batch, self.supersample = part.iterations, part.batch, part.supersample
        self.score = ScoreDistillation(guidance, config.score)
        self.schedule = CameraSchedule(config.cameras, max(1, part.resolution // part.supersample))
        self.depth_probability = config.score.depth_probability

    @property
    def device(self) -> torch.device:
        """Where the guidance works, and so the stage."""
        return self.guidance.alphas_cumprod.device

    def look(self, iteration: int) -> tuple[ViewBatch, torch.Generator]:
        """Views of this iteration as the guidance sees them, and the iteration's random numbers."""
        generator = step_generator(self.seed, self.stage, iteration)
        views = self.schedule.sample(iteration, self.iterations, self.batch, generator, background="mixed")
        if float(torch.rand((), generator=generator)) < self.depth_probability:
            views = replace(views, kind="disparity")
        return self.guidance.views(views, generator), generator

    def rendered(self, views: ViewBatch) -> tuple[Cameras, torch.Tensor]:
        """Cameras to render for `views`, finer by `supersample`, and backgrounds [C, 3]; on the device."""
        cameras, factor = views.cameras, self.supersample
        Ks = cameras.Ks.clone()
        Ks[:, :2] *= factor
        finer = Cameras(
            cameras.viewmats.to(self.device),
            Ks.to(self.device),
            cameras.width * factor,
            cameras.height * factor,
        )
        return finer, views.backgrounds.to(self.device)

    def pictures(self, shot: Shot, views: ViewBatch) -> torch.Tensor:
        """What the guidance is shown: colours or disparity, reduced; [C, H, W, 3]."""
        image = shot.rgb
        if views.kind == "disparity":
            image = disparity(shot.depths, shot.alphas, shot.cameras)
        return image if self.supersample == 1 else reduced(image, self.supersample)

    def judge(
        self, images: torch.Tensor, views: ViewBatch, iteration: int, generator: torch.Generator
    ) -> tuple[torch.Tensor, float | None]:
        """The score's loss, and PSNR of colour pictures where the guidance knows the right ones."""
        loss, _ = self.score.loss(images, views, iteration, generator)
        psnr = None
        if views.kind == "rgb" and isinstance(self.guidance, ClosedFormScore):
            psnr = self.guidance.psnr(images, views)
        return loss, psnr

    def state_dict(self) -> dict[str, torch.Tensor]:
        return self.score.state_dict()

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None:
        self.score.load_state_dict(state)


def reduced(images: torch.Tensor, factor: int) -> torch.Tensor:
    """Means over squares of `factor` x `factor` pixels: [C, H, W, D] -> [C, H / factor, W / factor, D]."""
    return _Reduce.apply(images, factor)


class _Reduce(torch.autograd.Function):
    """On a CPU half the time of torch's pooling, which wants channels first."""

    @staticmethod
    def forward(ctx: Any, images: torch.Tensor, factor: int) -> torch.Tensor:  # type: ignore[override]
        ctx.factor = factor
        rows = sum(images[:, i::factor] for i in range(1, factor)) + images[:, ::factor]
        return (sum(rows[:, :, i::factor] for i in range(1, factor)) + rows[:, :, ::factor]) / factor**2

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        k, g = ctx.factor, gradients[0] / ctx.factor**2
        c, h, w, d = g.shape
        return g[:, :, None, :, None].expand(c, h, k, w, k, d).reshape(c, h * k, w * k, d), None


def variation(shot: Shot) -> torch.Tensor:
    """Total variation of colour and of disparity; one number."""
    grey = disparity(shot.depths, shot.alphas, shot.cameras)[..., :1]
    return losses.total_variation(shot.rgb) + losses.total_variation(grey)


def rates(part: SurfelConfig | RefinementConfig) -> dict[str, tuple[float, float]]:
    """Learning rates, at the first and the last step, of what both stages learn."""

    def calming(rate: float) -> tuple[float, float]:
        return rate, rate * part.lr_last

    return {
        "quats": calming(part.lr_rotation),
        "log_scales": calming(part.lr_scale),
        "logits": (part.lr_opacity,) * 2,  # has far to go, and saturates
        "dc": calming(part.lr_color),
        "rest": calming(part.lr_sh),
    }


def harmonics(leaves: Mapping[str, torch.Tensor]) -> torch.Tensor:
    """Spherical harmonics [N, K, 3] of leaves `dc` and, above degree 0, `rest`."""
    return torch.cat([leaves["dc"], leaves["rest"]], 1) if "rest" in leaves else leaves["dc"]


def flat(parts: Mapping[str, Mapping[str, torch.Tensor]]) -> dict[str, torch.Tensor]:
    """Nested states as one: entry NAME of part PREFIX as `PREFIX.NAME`."""
    return {f"{part}.{k}": v for part, entries in parts.items() for k, v in entries.items()}


def nested(state: Mapping[str, torch.Tensor], prefix: str) -> dict[str, torch.Tensor]:
    """Entries `prefix.NAME` of a flat state as `NAME`."""
    return {k.removeprefix(f"{prefix}."): v for k, v in state.items() if k.startswith(f"{prefix}.")}


__all__ = [
    "Clock",
    "Distillation",
    "Shot",
    "flat",
    "harmonics",
    "nested",
    "rates",
    "reduced",
    "variation",
]
