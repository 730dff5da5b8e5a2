"""What a file holds, as plain data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.asset import Asset, kind
from gdpro_sim.io.cloud import is_cloud, read_cloud
from gdpro_sim.io.usd import SimulationReader


def describe(file: str | Path) -> dict[str, Any]:
    """Facts about an asset, a simulation, a mesh or a splat cloud. Raises AssetError or MeshError."""
    path = Path(file)
    what = kind(path)
    if what == "asset":
        return {"kind": "asset", **Asset.load(path).summary()}
    if what == "simulation":
        reader = SimulationReader(path)
        return {
            "kind": "simulation",
            "frames": len(reader),
            "fps": reader.fps,
            "duration_s": reader.times[-1] - reader.times[0],
            "bodies": {
                body.name: {"gaussians": len(body.gaussians), "vertices": len(body.gaussians.vertices)}
                for body in reader.bodies
            },
            "precision": reader.precision,
            "bytes": path.stat().st_size,
        }
    if path.is_file() and is_cloud(path):
        cloud = read_cloud(path)
        return {
            "kind": "splat cloud",
            "gaussians": len(cloud),
            "sh_degree": cloud.sh_degree,
            "size_m": np.ptp(cloud.means.numpy(), axis=0).round(6).tolist(),
            "bytes": path.stat().st_size,
        }
    from gdpro_sim.meshing.load import load_mesh

    mesh = load_mesh(path)
    return {
        "kind": "mesh",
        "vertices": len(mesh.vertices),
        "faces": len(mesh.faces),
        "size_m": np.ptp(mesh.vertices, axis=0).round(6).tolist(),
        "sha256": mesh.sha256,
        "messages": list(mesh.messages),
    }


__all__ = ["describe"]
