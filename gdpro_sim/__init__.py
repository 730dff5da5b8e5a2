"""Physically simulatable Gaussian assets.

Public names are imported on first use, so `import gdpro_sim` is light and starts no backend.
"""

from __future__ import annotations

import importlib
import os
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Torch's threads wait for work by spinning, on the cores that ours need. OpenMP reads this when torch is
# imported: where that came first, it changes nothing.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

_PUBLIC = {
    "Asset": "gdpro_sim.asset",
    "ComposedPart": "gdpro_sim.asset",
    "BoundGaussians": "gdpro_sim.binding",
    "Cameras": "gdpro_sim.cameras",
    "Gaussians": "gdpro_sim.gaussians",
    "Frame": "gdpro_sim.simulation.frame",
    "GdproError": "gdpro_sim.errors",
    "Material": "gdpro_sim.materials",
    "RasterOptions": "gdpro_sim.splatting",
    "Simulation": "gdpro_sim.simulation.run",
    "Scene": "gdpro_sim.simulation.scene",
    "animate": "gdpro_sim.io.animate",
    "compose": "gdpro_sim.asset",
    "generate": "gdpro_sim.io.generate",
    "import_mesh": "gdpro_sim.asset",
    "load_scene": "gdpro_sim.simulation.scene",
    "rasterization": "gdpro_sim.splatting",
    "rasterization_2dgs": "gdpro_sim.splatting",
    "record": "gdpro_sim.io.record",
    "rollout": "gdpro_sim.io.dataset",
    "simulate": "gdpro_sim.simulation.run",
}

if TYPE_CHECKING:
    from gdpro_sim.asset import Asset, ComposedPart, compose, import_mesh
    from gdpro_sim.binding import BoundGaussians
    from gdpro_sim.cameras import Cameras
    from gdpro_sim.errors import GdproError
    from gdpro_sim.gaussians import Gaussians
    from gdpro_sim.io.animate import animate
    from gdpro_sim.io.dataset import rollout
    from gdpro_sim.io.generate import generate
    from gdpro_sim.io.record import record
    from gdpro_sim.materials import Material
    from gdpro_sim.simulation.frame import Frame
    from gdpro_sim.simulation.run import Simulation, simulate
    from gdpro_sim.simulation.scene import Scene, load_scene
    from gdpro_sim.splatting import RasterOptions, rasterization, rasterization_2dgs


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        value = getattr(importlib.import_module(_PUBLIC[name]), name)
        globals()[name] = value
        return value
    raise AttributeError(f"module 'gdpro_sim' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *_PUBLIC])


__all__ = [
    "Asset",
    "BoundGaussians",
    "Cameras",
    "ComposedPart",
    "Frame",
    "Gaussians",
    "GdproError",
    "Material",
    "RasterOptions",
    "Scene",
    "Simulation",
    "animate",
    "compose",
    "generate",
    "import_mesh",
    "load_scene",
    "rasterization",
    "rasterization_2dgs",
    "record",
    "rollout",
    "simulate",
]
