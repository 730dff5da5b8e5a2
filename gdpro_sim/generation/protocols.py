"""What the parts of generation hand to each other: views, guidance, priors, stages.

Generation works in a unit frame: the object's bounding sphere has radius 1 and its centre at the origin, Z
up, its front towards +X. `UnitFrame` goes between that frame and metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.meshing.surface import SurfaceMesh

Condition = Literal["prompt", "negative", "empty"]
"""What a noise prediction is asked for: the prompt, the negative prompt, or nothing."""

ImageKind = Literal["rgb", "disparity"]


@dataclass(frozen=True)
class UnitFrame:
    """From the asset's own frame in metres to the unit frame: unit = (x - centre) / radius."""

    centre: tuple[float, float, float]
    radius: float

    @staticmethod
    def around(vertices: np.ndarray) -> UnitFrame:
        """Centre of the bounding box of vertices [V, 3] and the radius that holds them all."""
        v = np.asarray(vertices, np.float64)
        centre = 0.5 * (v.min(0) + v.max(0))
        radius = float(np.linalg.norm(v - centre, axis=1).max())
        return UnitFrame((float(centre[0]), float(centre[1]), float(centre[2])), radius)

    def to_unit(self, mesh: SurfaceMesh) -> SurfaceMesh:
        """`mesh`, given in metres, in the unit frame."""
        moved = (mesh.vertices.astype(np.float64) - self.centre) / self.radius
        return replace(mesh, vertices=moved.astype(np.float32))

    def to_metres(self, points: np.ndarray) -> np.ndarray:
        """Points [N, 3] of the unit frame in metres, float32."""
        return (np.asarray(points, np.float64) * self.radius + self.centre).astype(np.float32)


@dataclass(frozen=True)
class ViewBatch:
    """What one iteration looks at: C cameras in the unit frame and what is behind the object.

    backgrounds: [C, 3] in [0, 1]
    azimuths:    [C] rad in (-pi, pi], of the camera seen from the object, 0 in front of it (+X)
    elevations:  [C] rad, above the horizontal
    kind:        what the images are: colours, or disparity in [0, 1] repeated to three channels
    """

    cameras: Cameras
    backgrounds: torch.Tensor
    azimuths: torch.Tensor
    elevations: torch.Tensor
    kind: ImageKind = "rgb"


class Guidance(Protocol):
    """A denoiser that says how pictures should look (an epsilon-predicting diffusion model, or its like)."""

    @property
    def alphas_cumprod(self) -> torch.Tensor:
        """[1000], falling, on the device of the model."""

    @property
    def uses_cameras(self) -> bool:
        """The prediction depends on where the camera is (then pictures must not be mirrored)."""

    @property
    def native_resolution(self) -> int | None:
        """Pixels across a picture the model was made for; None: any."""

    def views(self, proposed: ViewBatch, generator: torch.Generator) -> ViewBatch:
        """The views to render in place of `proposed`: itself, unless only some cameras are known."""

    def encode(self, images: torch.Tensor, views: ViewBatch) -> torch.Tensor:
        """Pictures [B, H, W, 3] in [0, 1] as what is noised, [B, h, w, c]; differentiable."""

    def noise_prediction(
        self, x_t: torch.Tensor, t: int, condition: Condition, views: ViewBatch
    ) -> torch.Tensor:
        """Predicted noise of x_t [B, ...] at step t in [0, 999], the shape of x_t; no gradient."""

    def guided(self, x_t: torch.Tensor, t: int, views: ViewBatch, scale: float) -> torch.Tensor:
        """Classifier-free guidance: e_neg + scale (e_prompt - e_neg), or Perp-Neg's mix of it."""

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance: kind, model, and the honest label of what it is."""


@dataclass(frozen=True)
class CoarseMesh:
    """What a prior gives: a coarse coloured closed mesh in metres, its front towards +X, Z up.

    material: name of a preset in `gdpro_sim.materials`, or None where the prior knows none
    """

    surface: SurfaceMesh
    material: str | None = None
    description: Mapping[str, Any] = field(default_factory=dict)


class Prior(Protocol):
    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """A coarse mesh for the prompt. Raises GuidanceError, MeshError."""

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""


@dataclass(frozen=True)
class StepReport:
    """One iteration's figures. psnr in dB where a reference picture exists; gaussians: how many there are.

    seconds: wall time by part: "render", "guidance", "backward", "optimizer", "other"
    """

    iteration: int
    loss: float
    psnr: float | None
    gaussians: int
    seconds: Mapping[str, float] = field(default_factory=dict)


class Stage(Protocol):
    """An optimisation that runs step by step and can be put away and taken up to the bit."""

    name: str
    iterations: int
    iteration: int
    """Finished iterations, 0 at the start; done at `iterations`."""

    def step(self) -> StepReport: ...

    def gaussians(self) -> Gaussians:
        """What there is now, as 3D Gaussians in the unit frame; for pictures and metrics, no gradient."""

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Everything the next step depends on, moments of the optimizer and `iteration` included."""

    def load_state_dict(self, state: Mapping[str, torch.Tensor]) -> None: ...


def step_generator(seed: int, stage: str, iteration: int) -> torch.Generator:
    """The random numbers of one iteration: a function of seed, stage and iteration alone.

    A resumed run therefore draws what an uninterrupted one would have drawn.
    """
    words = np.random.SeedSequence([seed, iteration, *stage.encode()]).generate_state(2, np.uint64)
    return torch.Generator().manual_seed(int(words[0] >> np.uint64(1)))


__all__ = [
    "CoarseMesh",
    "Condition",
    "Guidance",
    "ImageKind",
    "Prior",
    "Stage",
    "StepReport",
    "UnitFrame",
    "ViewBatch",
    "step_generator",
]
