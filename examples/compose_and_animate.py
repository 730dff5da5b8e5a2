"""Compose balls into a caterpillar from Python, and let a motion of one's own make it crawl, without physics.

python examples/compose_and_animate.py [OUT]
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import trimesh

import gdpro_sim
from gdpro_sim.asset import Asset, ComposedPart

COLORS = ("crimson", "gold", "limegreen", "gold", "limegreen")


class Crawl:
    """Vertices of an asset that a wave runs through: any object with these names can move an asset."""

    fps, begin, end = 10.0, 0.0, 1.0

    def __init__(self, asset: Asset) -> None:
        self.rest = asset.gaussians.vertices.numpy().astype(np.float64)
        self.faces = asset.gaussians.faces.numpy()

    def vertices(self, time: float) -> np.ndarray:
        moved = self.rest.copy()
        phase = 2.0 * np.pi * (self.rest[:, 0] / 0.6 + time)
        moved[:, 2] += 0.04 * (1.0 + np.sin(phase))
        moved[:, 0] += 0.02 * np.cos(phase)
        return moved


def main(out: Path) -> None:
    out.mkdir(parents=True, exist_ok=True)
    trimesh.creation.icosphere(subdivisions=2, radius=0.1).export(out / "ball.obj")
    balls = [
        gdpro_sim.import_mesh(out / "ball.obj", name=f"ball_{k}", budget=1500, color=color, tets=False)
        for k, color in enumerate(COLORS)
    ]
    parts = [
        ComposedPart(ball, position=(-0.14 * k, 0.0, 0.0), scale=1.2 if k == 0 else 1.0, anchor="bottom")
        for k, ball in enumerate(balls)
    ]
    caterpillar = gdpro_sim.compose(parts, name="caterpillar", target_tets=0)
    caterpillar.save(out / "caterpillar.usdc")
    print(f"{len(caterpillar.gaussians)} Gaussians in parts {', '.join(caterpillar.groups)}")
    recording = gdpro_sim.animate(
        caterpillar, out / "crawl", motion=Crawl(caterpillar), camera={"width": 240, "height": 160}
    )
    print(f"wrote {recording.frame_count} frames, {recording.simulation} and {recording.video}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/compose_and_animate"))
