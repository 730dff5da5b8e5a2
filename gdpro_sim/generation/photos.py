"""Photos of one object with known cameras, as plain arrays, and how a part of a photo becomes a view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError
from gdpro_sim.generation.protocols import UnitFrame

MARGIN = 1.05
"""Around the unit sphere in a view made of a photo."""

LEAST = 2
"""Fewer photos tell nothing about depth."""


def too_few(count: int) -> GuidanceError:
    """The error for fewer photos than `LEAST`."""
    return GuidanceError(
        f"{count} photo{'s' * (count != 1)} with a camera; at least {LEAST} from different sides are needed "
        "(20 to 200 work well)"
    )


@dataclass(frozen=True)
class Photos:
    """N photos, each of its own size.

    viewmats: [N, 4, 4] float64, world -> camera, OpenCV axes, rigid
    Ks:       [N, 3, 3] float64, pixels; pixel centres lie at +0.5
    pictures: N uint8 [H, W, 4], sRGB-encoded colour and opacity, not multiplied
    names:    N, for messages

    Raises GuidanceError for fewer than two photos, numbers that are not finite, a view matrix that is not
    rigid, or two cameras with the same pose (a view then could not tell whose it is).
    """

    viewmats: np.ndarray
    Ks: np.ndarray
    pictures: tuple[np.ndarray, ...]
    names: tuple[str, ...]

    def __post_init__(self) -> None:
        n = len(self.pictures)
        if n < LEAST:
            raise too_few(n)
        if self.viewmats.shape != (n, 4, 4) or self.Ks.shape != (n, 3, 3) or len(self.names) != n:
            raise ValueError(
                f"{n} photos need viewmats [{n}, 4, 4], Ks [{n}, 3, 3] and {n} names, got "
                f"{self.viewmats.shape}, {self.Ks.shape} and {len(self.names)}"
            )
        for name, view, k in zip(self.names, self.viewmats, self.Ks, strict=True):
            if not (np.isfinite(view).all() and np.isfinite(k).all()):
                raise GuidanceError(
                    f"{name}: its camera has NaN or infinite numbers; remove it or estimate again"
                )
            rotation = view[:3, :3]
            if np.abs(rotation @ rotation.T - np.eye(3)).max() > 1e-3 or np.linalg.det(rotation) < 0.0:
                raise GuidanceError(f"{name}: its camera's rotation is not one (mirrored, scaled or skewed)")
            if not (k[0, 0] > 0.0 and k[1, 1] > 0.0):
                raise GuidanceError(f"{name}: focal lengths must be > 0 px, got {k[0, 0]:g} and {k[1, 1]:g}")
        first: dict[bytes, str] = {}
        for name, view in zip(self.names, self.viewmats, strict=True):
            twin = first.setdefault((np.round(view, 6) + 0.0).tobytes(), name)
            if twin != name:
                raise GuidanceError(
                    f"{twin} and {name} have the same camera; keep one of them, or estimate the cameras again"
                )

    def __len__(self) -> int:
        return len(self.pictures)

    @property
    def centres(self) -> np.ndarray:
        """Camera centres [N, 3]."""
        return -np.einsum("nji,nj->ni", self.viewmats[:, :3, :3], self.viewmats[:, :3, 3])

    def in_frame(self, frame: UnitFrame) -> Photos:
        """The same photos with the cameras in the unit frame."""
        moved = self.viewmats.copy()
        centre = np.asarray(frame.centre)
        moved[:, :3, 3] = (moved[:, :3, :3] @ centre + moved[:, :3, 3]) / frame.radius
        return replace(self, viewmats=moved)

    def turned(self, rotation: np.ndarray) -> Photos:
        """The same photos in a world turned by `rotation` [3, 3]: x becomes rotation @ x."""
        moved = self.viewmats.copy()
        moved[:, :3, :3] = moved[:, :3, :3] @ np.asarray(rotation).T
        return replace(self, viewmats=moved)

    def chosen(self, which: Sequence[int] | np.ndarray) -> Photos:
        """Some of the photos."""
        return Photos(
            self.viewmats[which],
            self.Ks[which],
            tuple(self.pictures[i] for i in which),
            tuple(self.names[i] for i in which),
        )

    def camera(self, index: int) -> Cameras:
        """The camera of one photo at its full size."""
        height, width = self.pictures[index].shape[:2]
        view, k = (torch.tensor(a[index : index + 1], dtype=torch.float32) for a in (self.viewmats, self.Ks))
        return Cameras(view, k, width, height)

    def box(self, index: int) -> tuple[np.ndarray, np.ndarray]:
        """The part of a photo that may show the unit sphere: corners (x, y), pixels; empty where none does.

        The photos must be in the unit frame.
        """
        height, width = self.pictures[index].shape[:2]
        view, k = self.viewmats[index], self.Ks[index]
        size = np.array([width, height], np.float64)
        z = view[2, 3]
        if z < -1.0:  # behind the camera
            return np.zeros(2), np.zeros(2)
        if z <= MARGIN:  # the camera is beside or within the sphere: everything may show it
            return np.zeros(2), size
        focal = np.array([k[0, 0], k[1, 1]])
        middle = focal * view[:2, 3] / z + k[:2, 2]
        reach = MARGIN * focal / np.sqrt(z * z - 1.0)
        return np.clip(middle - reach, 0.0, size), np.clip(middle + reach, 0.0, size)

    def square(self, index: int, where: np.ndarray) -> tuple[np.ndarray, float]:
        """A square of a photo around the unit sphere: corner (x, y) and side, pixels; never beyond the photo.

        where: (x, y) in [0, 1], which part to take where the object is wider than the photo is high (or the
        other way round). The photos must be in the unit frame.
        """
        height, width = self.pictures[index].shape[:2]
        low, high = self.box(index)
        side = float(min(max((high - low).max(), 1.0), width, height))
        slack = high - low - side
        corner = np.where(slack > 0.0, low + np.asarray(where) * slack, low + 0.5 * slack)
        return np.clip(corner, 0.0, np.array([width, height]) - side), side

    def views(self, which: Sequence[int], where: np.ndarray, resolution: tuple[int, int]) -> Cameras:
        """Cameras of squares of the photos `which` [B], at `resolution` (width, height); see `square`."""
        scaled = []
        for row, index in enumerate(which):
            corner, side = self.square(index, where[row])
            k = self.Ks[index].copy()
            k[:2, 2] -= corner
            k[0] *= resolution[0] / side
            k[1] *= resolution[1] / side
            scaled.append(k)
        return Cameras(
            torch.tensor(self.viewmats[list(which)], dtype=torch.float32),
            torch.tensor(np.stack(scaled), dtype=torch.float32),
            *resolution,
        )

    def seen_by(self, cameras: Cameras) -> torch.Tensor:
        """What cameras made by `views` see, resampled over each pixel's area: [B, H, W, 4] float32.

        Colour is multiplied by opacity. Raises GuidanceError for a camera whose pose is no photo's.
        """
        views, ks = cameras.viewmats.double().cpu().numpy(), cameras.Ks.double().cpu().numpy()
        known = self.viewmats.astype(np.float32)
        out = []
        for view, k in zip(views, ks, strict=True):
            apart = np.abs(known - view).max((1, 2))
            index = int(apart.argmin())
            if apart[index] > 0.0:
                raise GuidanceError("photos show nothing at other cameras than their own")
            own = self.Ks[index]
            step = np.array([own[0, 0] / k[0, 0], own[1, 1] / k[1, 1]])  # photo pixels in one of the view
            corner = own[:2, 2] - k[:2, 2] * step
            picture = self.pictures[index]
            rows = corner[1] + step[1] * np.arange(cameras.height + 1)
            columns = corner[0] + step[0] * np.arange(cameras.width + 1)
            out.append(_resampled(picture, rows, columns))
        return torch.stack(out)


def _resampled(picture: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> torch.Tensor:
    """Means of a picture over a grid of cells with edges at `rows` [H + 1] and `columns` [W + 1], pixels.

    float32 [H, W, 4], colour times opacity. Sums up to an edge are whole numbers, so nothing is rounded
    before the difference of two of them is taken.
    """
    rows, columns = np.clip(rows, 0.0, picture.shape[0]), np.clip(columns, 0.0, picture.shape[1])
    top, left = int(rows[0]), int(columns[0])
    part = picture[top : int(np.ceil(rows[-1])), left : int(np.ceil(columns[-1]))]
    products = part.astype(np.uint16) * part[..., 3:]
    products[..., 3] = part[..., 3] * np.uint16(255)
    means = _means(products, rows - top, np.int64 if len(part) > 30_000 else np.int32)
    means = _means(means.swapaxes(0, 1), columns - left, np.float64).swapaxes(0, 1)
    return torch.from_numpy(np.clip(means / 255.0**2, 0.0, 1.0).astype(np.float32))


def _means(values: np.ndarray, edges: np.ndarray, kind: type[np.generic]) -> np.ndarray:
    """Means of values [N, ...] along the first axis between edges [M + 1] in [0, N]; float64 [M, ...]."""
    sums = np.zeros((len(values) + 1, *values.shape[1:]), kind)
    np.cumsum(values, axis=0, dtype=kind, out=sums[1:])
    whole = np.minimum(edges.astype(np.int64), len(values) - 1)
    part = (edges - whole).reshape(-1, *[1] * (values.ndim - 1))
    up_to = sums[whole] * (1.0 - part) + sums[whole + 1] * part
    lengths = np.maximum(np.diff(edges), 1e-12).reshape(-1, *[1] * (values.ndim - 1))
    return np.diff(up_to, axis=0) / lengths


__all__ = ["LEAST", "Photos", "too_few"]
