"""Guidance by known views: the renders of a mesh or of Gaussians at any camera, or photos at their own.

The score is the closed form over those pictures: what follows it is fitted to them through the whole
pipeline.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.generation.cameras import view_batch
from gdpro_sim.generation.config import GuidanceConfig
from gdpro_sim.generation.guidance.closed_form import ClosedFormScore
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.protocols import ViewBatch
from gdpro_sim.generation.renders import GaussianRenderer, MeshRenderer, Renders
from gdpro_sim.meshing.surface import SurfaceMesh

SMALLEST = 8.0
"""Pixels: photos in which the unit sphere is smaller show nothing worth learning."""


class Renderer(Protocol):
    """Draws something in the unit frame from any camera."""

    def render(self, cameras: Cameras) -> Renders: ...


class RenderedGuidance(ClosedFormScore):
    """Targets drawn at the views' own cameras: K renderers, one target each.

    description: what `describe` gives; device: where the renderers draw
    """

    def __init__(
        self,
        renderers: Sequence[Renderer],
        config: GuidanceConfig,
        description: Mapping[str, Any],
        *,
        device: torch.device | str = "cpu",
    ) -> None:
        super().__init__(kernel_width=config.kernel_width, jitter=config.jitter, device=device)
        if not renderers:
            raise GuidanceError("a guidance by renders needs something to render")
        self.renderers = tuple(renderers)
        self._description = {
            **description,
            "kernel_width": config.kernel_width,
            "jitter": config.jitter,
        }

    def targets(self, views: ViewBatch) -> torch.Tensor:
        return torch.stack(
            [r.render(views.cameras).image(views.kind, views.backgrounds) for r in self.renderers]
        )

    def describe(self) -> dict[str, Any]:
        return dict(self._description)


class MeshGuidance(RenderedGuidance):
    """The renders of a mesh given in the unit frame, its colours unlit."""

    def __init__(
        self, mesh: SurfaceMesh, config: GuidanceConfig | None = None, *, device: str = "cpu"
    ) -> None:
        renderer = MeshRenderer(mesh, device=device)
        description = {
            "kind": "views",
            "of": "mesh",
            "label": "fitted to renders of the given mesh; nothing is made up",
            "source": mesh.source,
            "sha256": mesh.sha256,
            "faces": len(mesh.faces),
        }
        super().__init__([renderer], config or GuidanceConfig(), description, device=renderer.device)


class SplatGuidance(RenderedGuidance):
    """The renders of 3D Gaussians given in the unit frame, on the device they lie on."""

    def __init__(self, gaussians: Gaussians, config: GuidanceConfig | None = None) -> None:
        description = {
            "kind": "views",
            "of": "gaussians",
            "label": "fitted to renders of the given Gaussians; nothing is made up",
            "gaussians": len(gaussians),
        }
        super().__init__(
            [GaussianRenderer(gaussians)],
            config or GuidanceConfig(),
            description,
            device=gaussians.means.device,
        )


class PhotoGuidance(ClosedFormScore):
    """Photos, judged only at their own cameras, over whatever background a view has.

    photos: in the unit frame. A view is a square of a photo around the object, brought to the view's size.
    """

    def __init__(
        self, photos: Photos, config: GuidanceConfig | None = None, *, device: torch.device | str = "cpu"
    ) -> None:
        config = config or GuidanceConfig()
        super().__init__(kernel_width=config.kernel_width, jitter=config.jitter, device=device)
        self.photos = photos
        self.useful = [i for i in range(len(photos)) if _shows(photos, i)]
        if not self.useful:
            raise GuidanceError(
                "no photo shows the object: check that cameras, masks and photos belong together"
            )

    def views(self, proposed: ViewBatch, generator: torch.Generator) -> ViewBatch:
        """As many views of photos drawn at random, none twice before all came; colours, never disparity."""
        count = len(proposed.cameras)
        which: list[int] = []
        while len(which) < count:
            order = torch.randperm(len(self.useful), generator=generator).tolist()
            which += [self.useful[i] for i in order]
        where = torch.rand(count, 2, generator=generator, dtype=torch.float64).numpy()
        size = (proposed.cameras.width, proposed.cameras.height)
        chosen = view_batch(self.photos.views(which[:count], where, size), proposed.backgrounds)
        return super().views(chosen, generator)

    def targets(self, views: ViewBatch) -> torch.Tensor:
        if views.kind != "rgb":
            raise GuidanceError("photos show colours, not disparity")
        seen = self.photos.seen_by(views.cameras).to(self.alphas_cumprod.device)
        return (seen[..., :3] + (1.0 - seen[..., 3:]) * views.backgrounds.to(seen)[:, None, None])[None]

    def describe(self) -> dict[str, Any]:
        return {
            "kind": "views",
            "of": "photos",
            "label": "fitted to the given photos at their own cameras; sides that no photo shows are free",
            "photos": len(self.useful),
            "kernel_width": self.kernel_width,
            "jitter": self.jitter,
        }


def _shows(photos: Photos, index: int) -> bool:
    """Something of the object is in the photo, and not only a few pixels across."""
    low, high = photos.box(index)
    return bool((high - low).min() >= SMALLEST and (photos.pictures[index][..., 3] > 127).any())


__all__ = ["MeshGuidance", "PhotoGuidance", "RenderedGuidance", "SplatGuidance"]
