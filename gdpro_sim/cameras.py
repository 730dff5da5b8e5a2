"""Pinhole cameras in the OpenCV convention (+z forward, +y down), world Z up."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch


@dataclass(frozen=True)
class Cameras:
    """C cameras sharing one image size.

    viewmats: [C, 4, 4] float32, world -> camera
    Ks:       [C, 3, 3] float32, pixels; pixel centres lie at +0.5
    """

    viewmats: torch.Tensor
    Ks: torch.Tensor
    width: int
    height: int

    def __len__(self) -> int:
        return int(self.viewmats.shape[0])

    @staticmethod
    def look_at(
        eyes: Sequence[Sequence[float]] | np.ndarray,
        targets: Sequence[Sequence[float]] | Sequence[float] | np.ndarray,
        *,
        vertical_fov: float,
        width: int,
        height: int,
        up: Sequence[float] = (0.0, 0.0, 1.0),
    ) -> Cameras:
        """Cameras at `eyes` [C, 3] m looking at `targets` [C, 3] or [3] m; `vertical_fov` in radians.

        Raises ValueError where an eye coincides with its target. A view along `up` takes the world axis most
        across it as up.
        """
        eye = np.atleast_2d(np.asarray(eyes, dtype=np.float64))
        target = np.broadcast_to(np.atleast_2d(np.asarray(targets, dtype=np.float64)), eye.shape)
        forward = target - eye
        distance = np.linalg.norm(forward, axis=1, keepdims=True)
        if np.any(distance < 1e-12):
            raise ValueError("camera eye and target coincide")
        forward = forward / distance
        ups = np.broadcast_to(np.asarray(up, dtype=np.float64), eye.shape).copy()
        parallel = np.linalg.norm(np.cross(forward, ups), axis=1) < 1e-6
        ups[parallel] = np.eye(3)[np.abs(forward[parallel]).argmin(axis=1)]
        right = np.cross(forward, ups)
        right /= np.linalg.norm(right, axis=1, keepdims=True)
        down = np.cross(forward, right)
        view = np.zeros((len(eye), 4, 4))
        view[:, 0, :3], view[:, 1, :3], view[:, 2, :3] = right, down, forward
        view[:, :3, 3] = -np.einsum("cij,cj->ci", view[:, :3, :3], eye)
        view[:, 3, 3] = 1.0
        focal = 0.5 * height / math.tan(0.5 * vertical_fov)
        k = np.array([[focal, 0.0, 0.5 * width], [0.0, focal, 0.5 * height], [0.0, 0.0, 1.0]])
        return Cameras(
            torch.tensor(view, dtype=torch.float32),
            torch.tensor(np.tile(k, (len(eye), 1, 1)), dtype=torch.float32),
            width,
            height,
        )

    @property
    def positions(self) -> torch.Tensor:
        """Camera centres in the world, [C, 3] m."""
        rotation = self.viewmats[:, :3, :3]
        return -torch.einsum("cji,cj->ci", rotation, self.viewmats[:, :3, 3])


__all__ = ["Cameras"]
