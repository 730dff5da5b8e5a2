"""The default prior: the built-in parametric library, deliberately coarse."""

from __future__ import annotations

from typing import Any

from gdpro_sim.generation.config import PriorConfig
from gdpro_sim.generation.objects import build, parse
from gdpro_sim.generation.protocols import CoarseMesh


class ProceduralPrior:
    """A closed mesh of `config.resolution` cells across, each part in its plain base colour.

    ignore_unknown: go on without words the library does not know
    """

    def __init__(self, config: PriorConfig, *, ignore_unknown: bool = False) -> None:
        self.config = config
        self.ignore_unknown = ignore_unknown

    def mesh(self, prompt: str, seed: int) -> CoarseMesh:
        """One closed piece in metres, front +X, base at z = 0. Raises GuidanceError for what it cannot
        read."""
        spec = parse(prompt, ignore_unknown=self.ignore_unknown)
        made = build(spec, seed)
        surface = made.surface(self.config.resolution, detail=False)
        return CoarseMesh(surface, made.material, {**self.describe(), "object": made.describe()})

    def describe(self) -> dict[str, Any]:
        """JSON values for the provenance."""
        return {
            "kind": "procedural",
            "label": "built-in parametric library (procedural generation, not open text-to-3D)",
            "resolution": self.config.resolution,
        }


__all__ = ["ProceduralPrior"]
