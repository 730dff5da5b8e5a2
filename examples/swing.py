"""Script a scene in Python: copies of a cube, a paddle that a function moves, and a loop that watches them.

python examples/swing.py [OUT]
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

import gdpro_sim
from gdpro_sim.simulation.scene import check_scene


def swing(time: float) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """Where the paddle is after `time` s: translation in m, rotation vector in degrees."""
    return (0.0, 0.0, 0.03 * math.sin(12.0 * time)), (0.0, 25.0 * math.sin(6.0 * time), 0.0)


def main(out: str) -> None:
    scene = check_scene(
        {
            "name": "swing",
            "bodies": {
                "name": "cube",
                "asset": "package:warp/examples/assets/cube.usd",
                "size": 0.08,
                "position": [0.0, 0.0, 0.3],
                "material": "wood",
                "mujoco": {"shape": "box"},
                "budget": 300,
                "copies": {"grid": [3, 1, 1], "spacing": 0.12, "colors": ["tomato", "gold", "teal"]},
            },
            "colliders": {
                "kind": "box", "size": [0.5, 0.2, 0.02], "position": [0.0, 0.0, 0.2], "friction": 0.2,
                "motion": swing,
            },
            "solver": {"kind": "mujoco"},
            "fps": 24,
            "duration": 0.3,
            "camera": {"width": 160, "height": 120},
        }
    )  # fmt: skip
    for frame in gdpro_sim.simulate(scene):
        heights = "  ".join(f"{body.name} {body.vertices[:, 2].min():.3f}" for body in frame.bodies)
        print(f"t = {frame.time:.3f} s   {heights}")
        if frame.diagnostics.contacts:
            print("the first cube has landed")
            break
    recording = gdpro_sim.record(scene, out)
    print(f"wrote {recording.simulation} and {recording.contact_sheet}")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else str(Path("out/swing")))
