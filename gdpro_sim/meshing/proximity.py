"""Closest points on a surface, rays and inside tests, over a Warp bounding-volume hierarchy on the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np

RAY_LIFT = 1e-3
"""How far above the surface its own rays start, as a share of the bounding box's diagonal."""


class SurfaceIndex:
    """A triangle surface ready for closest-point and inside queries.

    Queries run in float32 after centring and scaling the mesh to unit size, so that a small or far-away mesh
    loses no precision. vertices [V, 3] m, faces [F, 3].
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, *, winding: bool = False) -> None:
        import warp as wp

        from gdpro_sim import device  # noqa: F401  (quiets Warp before it starts)

        v = np.asarray(vertices, np.float64)
        low, high = v.min(0), v.max(0)
        self._centre = 0.5 * (low + high)
        self._scale = 1.0 / (float(np.linalg.norm(high - low)) or 1.0)
        self._mesh = wp.Mesh(
            points=wp.array(self._unit(v), dtype=wp.vec3, device="cpu"),
            indices=wp.array(np.ascontiguousarray(faces, np.int32).ravel(), dtype=wp.int32, device="cpu"),
            support_winding_number=winding,
        )

    def _unit(self, points: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray((np.asarray(points, np.float64) - self._centre) * self._scale, np.float32)

    def closest(
        self, points: np.ndarray, normals: np.ndarray | None = None, *, reach: float = np.inf
    ) -> tuple[np.ndarray, np.ndarray]:
        """Nearest face [N] int32 and barycentric coordinates [N, 3] float32 of the nearest point on it.

        With unit `normals` [N, 3], a face on the other side of a thin wall gives way to one that looks the
        same way and lies along the normal within `reach` metres.
        """
        import warp as wp

        from gdpro_sim.device import launch_chunked
        from gdpro_sim.kernels import proximity as kernels

        count = len(points)
        face = wp.empty(count, dtype=wp.int32, device="cpu")
        barycentric = wp.empty(count, dtype=wp.vec3, device="cpu")
        where: Any = wp.array(self._unit(points), dtype=wp.vec3, device="cpu")
        if normals is None:
            launch_chunked(
                kernels.closest_point, count, [self._mesh.id, where], [face, barycentric], device="cpu"
            )
        else:
            launch_chunked(
                kernels.closest_point_facing,
                count,
                [
                    self._mesh.id,
                    where,
                    wp.array(np.ascontiguousarray(normals, np.float32), dtype=wp.vec3, device="cpu"),
                    float(min(reach * self._scale, 1e10)),
                ],
                [face, barycentric],
                device="cpu",
            )
        weights = np.clip(barycentric.numpy(), 0.0, 1.0)
        return face.numpy(), weights / weights.sum(1, keepdims=True)

    def first_hit(self, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """First face each ray meets, from either side: faces [N] int32, -1 for none, and barycentrics [N, 3].

        origins [N, 3] m; directions [N, 3] of any length.
        """
        import warp as wp

        from gdpro_sim.device import launch_chunked
        from gdpro_sim.kernels import proximity as kernels

        count = len(origins)
        face = wp.empty(count, dtype=wp.int32, device="cpu")
        barycentric = wp.empty(count, dtype=wp.vec3, device="cpu")
        where: Any = wp.array(self._unit(origins), dtype=wp.vec3, device="cpu")
        towards: Any = wp.array(np.ascontiguousarray(directions, np.float32), dtype=wp.vec3, device="cpu")
        inputs = [self._mesh.id, where, towards]
        launch_chunked(kernels.first_hit, count, inputs, [face, barycentric], device="cpu")
        return face.numpy(), barycentric.numpy()

    def openness(
        self, points: np.ndarray, normals: np.ndarray, *, reach: float, rays: int = 64
    ) -> np.ndarray:
        """Share in [0, 1] of the hemisphere over each surface point with nothing in it within `reach` m; [N].

        points [N, 3] m on the surface, unit normals [N, 3]. Cosine-weighted: 1 minus ambient occlusion.
        """
        import warp as wp

        from gdpro_sim.device import launch_chunked
        from gdpro_sim.kernels import proximity as kernels

        out = wp.empty(len(points), dtype=wp.float32, device="cpu")
        where: Any = wp.array(self._unit(points), dtype=wp.vec3, device="cpu")
        up: Any = wp.array(np.ascontiguousarray(normals, np.float32), dtype=wp.vec3, device="cpu")
        inputs = [self._mesh.id, where, up, rays, RAY_LIFT, float(reach * self._scale)]
        launch_chunked(kernels.openness, len(points), inputs, [out], device="cpu")
        return out.numpy()

    def inside(self, points: np.ndarray, level: float = 0.5) -> np.ndarray:
        """Whether each point lies inside: generalised winding number above `level`, open meshes too; bool
        [N].

        The index must have been made with `winding=True`.
        """
        import warp as wp

        from gdpro_sim.device import launch_chunked
        from gdpro_sim.kernels import proximity as kernels

        flag = wp.empty(len(points), dtype=wp.int32, device="cpu")
        where: Any = wp.array(self._unit(points), dtype=wp.vec3, device="cpu")
        launch_chunked(
            kernels.inside, len(points), [self._mesh.id, where, float(level)], [flag], device="cpu"
        )
        return flag.numpy() > 0


__all__ = ["SurfaceIndex"]
