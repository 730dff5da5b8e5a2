"""The default guidance: the renders of a parametric object that the built-in vocabulary names.

A prompt becomes a seeded object (`gdpro_sim.generation.objects`), the object its pictures at whatever cameras
are asked for, and the pictures a closed-form score. This is procedural generation fitted through the whole
pipeline: nothing was learned from images, and words outside the vocabulary mean nothing to it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from gdpro_sim.generation.config import GuidanceConfig
from gdpro_sim.generation.guidance.views import RenderedGuidance
from gdpro_sim.generation.objects import ObjectSpec, build
from gdpro_sim.generation.protocols import UnitFrame
from gdpro_sim.generation.renders import MeshRenderer

LABEL = (
    "procedural: a parametric object of the built-in vocabulary, fitted by its own renders; not text-to-3D"
)


class ProceduralGuidance(RenderedGuidance):
    """K seeded instances of what a prompt was read as, `config.instances`, at `config.resolution` cells.

    Instance k is built with seed + k, so the first is the one the procedural prior makes from `seed`.

    frame: the unit frame of the pictures: around all instances, in metres
    """

    def __init__(
        self, spec: ObjectSpec, config: GuidanceConfig | None = None, seed: int = 0, *, device: str = "cpu"
    ) -> None:
        config = config or GuidanceConfig()
        built = [build(spec, seed + k) for k in range(config.instances)]
        surfaces = [instance.surface(config.resolution) for instance in built]
        self.frame = UnitFrame.around(np.concatenate([surface.vertices for surface in surfaces]))
        self.surfaces = tuple(self.frame.to_unit(surface) for surface in surfaces)
        renderers = [MeshRenderer(surface, device=device) for surface in self.surfaces]
        description: dict[str, Any] = {
            "kind": "procedural",
            "label": LABEL,
            "instances": [instance.describe() for instance in built],
            "faces": [len(surface.faces) for surface in surfaces],
        }
        super().__init__(renderers, config, description, device=renderers[0].device)


__all__ = ["LABEL", "ProceduralGuidance"]
