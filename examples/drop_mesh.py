"""Drop a mesh from Python: build a scene, run it frame by frame, look at the Gaussians, write everything.

python examples/drop_mesh.py [MESH] [OUT]
"""

from __future__ import annotations

import sys
from pathlib import Path

import gdpro_sim
from gdpro_sim.simulation.scene import check_scene


def main(mesh: str, out: str) -> None:
    scene = check_scene(
        {
            "name": "drop_mesh",
            "bodies": [
                {
                    "name": "thing",
                    "asset": mesh,
                    "size": 0.2,
                    "position": [0.0, 0.0, 0.1],
                    "material": {"preset": "silicone", "young": 5e4},
                    "budget": 3000,
                    "tets": 300,
                }
            ],
            "duration": 0.5,
            "camera": {"width": 320, "height": 240},
        }
    )
    for frame in gdpro_sim.simulate(scene):
        lowest = float(frame.gaussians().means[:, 2].min())
        contacts = frame.diagnostics.contacts
        print(f"t = {frame.time:.3f} s   lowest Gaussian at {lowest:+.4f} m   {contacts} contacts")
    recording = gdpro_sim.record(scene, out)
    print(f"wrote {recording.simulation} and {recording.video}")


if __name__ == "__main__":
    arguments = sys.argv[1:]
    default = "package:warp/examples/assets/cube.usd"
    main(
        arguments[0] if arguments else default,
        arguments[1] if len(arguments) > 1 else str(Path("out/drop_mesh")),
    )
