"""A rigid motion of a bound mesh gives the rigidly moved picture, view-dependent colours included."""

from __future__ import annotations

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation

from gdpro_sim.binding import BoundGaussians
from gdpro_sim.cameras import Cameras
from gdpro_sim.splatting import rasterization


def test_moving_mesh_and_camera_together_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    n = len(mesh.faces)
    bound = BoundGaussians(
        torch.tensor(np.asarray(mesh.vertices), dtype=torch.float32),
        torch.tensor(np.asarray(mesh.faces), dtype=torch.int32),
        torch.arange(n, dtype=torch.int32),
        torch.full((n, 3), 1.0 / 3.0),
        torch.tensor(rng.normal(size=(n, 2)), dtype=torch.float32),
        torch.tensor(np.log(rng.uniform(0.01, 0.08, size=(n, 3))), dtype=torch.float32),
        torch.tensor(rng.normal(1.0, 1.0, size=n), dtype=torch.float32),
        torch.tensor(0.4 * rng.normal(size=(n, 16, 3)), dtype=torch.float32),
    )
    turn = Rotation.from_euler("xyz", [25, -110, 65], degrees=True).as_matrix()
    shift = np.array([1.0, -0.5, 2.0])
    moved = torch.tensor(mesh.vertices @ turn.T + shift, dtype=torch.float32)
    camera = Cameras.look_at([[1.5, -1.0, 0.8]], [0.0, 0.0, 0.0], vertical_fov=0.7, width=120, height=100)
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = turn, shift
    followed = torch.tensor(camera.viewmats.double().numpy() @ np.linalg.inv(motion), dtype=torch.float32)

    def picture(vertices: torch.Tensor | None, viewmats: torch.Tensor) -> torch.Tensor:
        g = bound.gaussians(vertices)
        image, alpha, _ = rasterization(
            g.means, g.quats, g.scales, g.opacities, g.sh, viewmats, camera.Ks, 120, 100, sh_degree=3
        )
        return torch.cat([image, alpha], dim=-1)[0]

    still, after = picture(None, camera.viewmats), picture(moved, followed)
    assert still[..., 3].max() > 0.9
    difference = (still - after).abs()
    assert difference.median() < 1e-5
    # Rounding flips a few pixels across the 1/255 cut.
    assert (difference > 2e-3).float().mean() < 2e-3 and difference.max() < 0.02
