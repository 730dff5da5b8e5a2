"""Read a dataset of rollouts with NumPy alone: parameters, poses, contacts, pictures, points in the world.

python examples/read_dataset.py [FOLDER]    makes a small one first where the folder holds none
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import warp

SCENE = {
    "name": "tumbling",
    "bodies": [
        {
            "name": name,
            "asset": str(Path(warp.__file__).parent / "examples/assets/cube.usd"),
            "color": color,
            "budget": 3000,
            "size": size,
            "position": [x, 0.0, 0.1],
            "material": "plastic",
            "mujoco": {"form": "rigid", "shape": "box"},
        }
        for name, color, size, x in (("red", "#d8342c", 0.12, -0.15), ("blue", "#2f6fd8", 0.08, 0.15))
    ],
    "solver": {"kind": "mujoco"},
    "duration": 0.5,
    "camera": {"width": 160, "height": 120},
    "randomize": {
        "bodies.*.rotation": "any",
        "bodies.*.velocity": [[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]],
        "bodies.*.material.friction": [0.2, 0.8],
        "camera.azimuth": [-180.0, 180.0],
    },
}


def make(folder: Path) -> None:
    import gdpro_sim
    from gdpro_sim.simulation.scene import check_scene

    gdpro_sim.rollout(check_scene(SCENE), folder, count=4)


def main(folder: Path) -> None:
    if not (folder / "dataset.json").exists():
        make(folder)
    about = json.loads((folder / "dataset.json").read_text())
    names = {row["label"]: row["name"] for row in about["labels"]}
    with np.load(folder / "parameters.npz") as table:
        print(f"{about['count']} rollouts of {about['frames']} frames; drawn: {', '.join(table.files[1:-3])}")
    images = about["images"]
    for k in range(about["count"]):
        rollout = folder / "rollouts" / f"{k:05d}"
        with np.load(rollout / "states.npz") as states:
            rest = np.linalg.norm(states["velocities"][-1], axis=-1)
            touching = states["contact_labels"][states["contact_frames"] == states["time"].size - 1]
            intrinsics, extrinsics = states["intrinsics"], states["extrinsics"]
        pairs = sorted({f"{names[a]}-{names[b]}" for a, b in touching.tolist()})
        print(f"rollout {k}: at the end at {rest.max():.2f} m/s, touching: {', '.join(pairs) or 'nothing'}")
        for f, frame in enumerate(images["frames"]):
            for c, camera in enumerate(images["cameras"]):
                picture = rollout / f"{camera}_{frame:05d}"
                depth = imageio.imread(f"{picture}_depth.png") * images["depth_unit"]
                labels = imageio.imread(f"{picture}_segmentation.png")
                y, x = np.nonzero((depth > 0) & (labels > 1))
                rays = np.stack([x + 0.5, y + 0.5, np.ones(x.size)])
                seen = np.linalg.inv(intrinsics[f, c]) @ rays * depth[y, x]  # m, the camera's axes
                turn, shift = extrinsics[f, c, :3, :3], extrinsics[f, c, :3, 3:]
                world = turn.T @ (seen - shift)
                low, high = world.min(axis=1), world.max(axis=1)
                print(f"  {picture.name}: {x.size} points between {low.round(2)} and {high.round(2)} m")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/read_dataset"))
