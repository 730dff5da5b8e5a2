"""Clouds of 3D Gaussians that others made: the .splat format, and any cloud brought into the unit frame.

A .splat file is records of 32 bytes and nothing else: position 3 float32, scale 3 float32 (standard
deviations), colour and opacity 4 bytes, rotation 4 bytes (wxyz, 128 is 0); the layout of antimatter15/splat.
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
import torch

from gdpro_sim.binding import sh_basis
from gdpro_sim.errors import AssetError, RequestError
from gdpro_sim.gaussians import Gaussians, rgb_to_sh
from gdpro_sim.generation.protocols import UnitFrame

log = logging.getLogger(__name__)

RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

TURNS: dict[str, tuple[tuple[float, ...], ...]] = {
    "z": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "-z": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "y": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "-y": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "x": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "-x": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
}
"""Rotation that takes the axis that points up to +Z."""

FAINT = 1.0 / 255.0
"""Opacity below which nothing is drawn."""

TAIL = 0.01
"""Share of the opacity beyond each side of the box whose middle is the unit frame's centre."""

MAIN = 0.995
"""Share of the cloud's opacity that the unit sphere holds; what lies beyond is stray."""

SLACK = 1.05
"""The unit sphere's radius over that of the share, and how far beyond it Gaussians are kept."""


def read_splat(path: str | Path) -> Gaussians:
    """Read a .splat file on the CPU; SH degree 0.

    Raises AssetError for a missing or empty file, a size that is no multiple of 32, and numbers that are not
    finite.
    """
    file = Path(path)
    if not file.is_file():
        raise AssetError(f"{path}: no such file")
    data = file.read_bytes()
    if not data or len(data) % RECORD.itemsize:
        raise AssetError(
            f"{path}: {len(data)} bytes is no .splat file: it holds records of {RECORD.itemsize} bytes"
            + (
                ""
                if not data
                else f", and {len(data) % RECORD.itemsize} bytes are left over; download it again"
            )
        )
    rows = np.frombuffer(data, RECORD)
    means, scales = rows["mean"].astype(np.float32), rows["scale"].astype(np.float32)
    bad = int((~(np.isfinite(means).all(1) & np.isfinite(scales).all(1) & (scales >= 0.0).all(1))).sum())
    if bad:
        raise AssetError(
            f"{path}: {bad} of {len(rows)} records hold NaN, infinite or negative sizes: no .splat file"
        )
    rgba = rows["rgba"].astype(np.float32) / np.float32(255.0)
    quats = (rows["quat"].astype(np.float32) - 128.0) / 128.0
    quats[(quats == 0.0).all(1)] = (1.0, 0.0, 0.0, 0.0)
    return Gaussians(
        torch.from_numpy(means),
        torch.nn.functional.normalize(torch.from_numpy(quats), dim=1),
        torch.from_numpy(scales),
        torch.from_numpy(np.ascontiguousarray(rgba[:, 3])),
        rgb_to_sh(torch.from_numpy(np.ascontiguousarray(rgba[:, None, :3]))),
    )


def splat_in_unit_frame(cloud: Gaussians, *, up: str = "auto") -> tuple[Gaussians, UnitFrame]:
    """A cloud in the unit frame, upright and without strays, and that frame in the upright cloud's lengths.

    up: the axis that points up, one of x y z -x -y -z; auto is -y, as in most reconstructions from photos.
    Gaussians too faint to be drawn, with numbers that are not finite, or far off the rest are left out.
    Raises RequestError for another `up`, AssetError where nothing is left.
    """
    if up != "auto" and up not in TURNS:
        raise RequestError(f"up must be auto or one of {', '.join(TURNS)}, got {up!r}")
    finite = torch.stack(
        [getattr(cloud, n).flatten(1).isfinite().all(1) for n in ("means", "quats", "scales", "sh")]
    ).all(0)
    shown = finite & (cloud.opacities >= FAINT) & (cloud.quats.norm(dim=1) > 0.0)
    if int(shown.sum()) < 4:
        raise AssetError(
            f"the cloud has {int(shown.sum())} Gaussians that can be seen; nothing can be made of it"
        )
    turned = rotated(_rows(cloud, shown), np.asarray(TURNS["-y" if up == "auto" else up], np.float64))
    means = turned.means.double().numpy()
    weights = turned.opacities.double().numpy()
    low, high = (_quantile(means, weights, q) for q in (TAIL, 1.0 - TAIL))
    centre = 0.5 * (low + high)
    distance = np.linalg.norm(means - centre, axis=1)
    radius = SLACK * float(_quantile(distance[:, None], weights, MAIN)[0])
    if not radius > 0.0:
        raise AssetError("every Gaussian of the cloud lies at the same place; nothing can be made of it")
    near = torch.from_numpy(distance <= SLACK * radius)
    left_out = len(cloud) - int(near.sum())
    if left_out:
        log.info("left out %d of %d Gaussians: faint, broken or far off the rest", left_out, len(cloud))
    kept = _rows(turned, near)
    frame = UnitFrame((float(centre[0]), float(centre[1]), float(centre[2])), radius)
    moved = (kept.means.double() - torch.from_numpy(centre)) / radius
    return (
        Gaussians(moved.float(), kept.quats, kept.scales / radius, kept.opacities, kept.sh),
        frame,
    )


def rotated(cloud: Gaussians, rotation: np.ndarray) -> Gaussians:
    """The cloud turned about the origin by `rotation` [3, 3], its view-dependent colours with it."""
    r = np.asarray(rotation, np.float64)
    if np.array_equal(r, np.eye(3)):
        return cloud
    means = (cloud.means.double() @ torch.from_numpy(r).T).float()
    w, x, y, z = cloud.quats.double().unbind(1)
    qw, qx, qy, qz = _quaternion(r)
    quats = torch.stack(
        [
            qw * w - qx * x - qy * y - qz * z,
            qw * x + qx * w + qy * z - qz * y,
            qw * y - qx * z + qy * w + qz * x,
            qw * z + qx * y - qy * x + qz * w,
        ],
        1,
    ).float()
    return Gaussians(means, quats, cloud.scales, cloud.opacities, _turned_sh(cloud.sh, cloud.sh_degree, r))


def _turned_sh(sh: torch.Tensor, degree: int, rotation: np.ndarray) -> torch.Tensor:
    """Coefficients of the colour that, seen from d, is what it was seen from R^T d."""
    if degree == 0:
        return sh
    directions = np.random.default_rng(0).normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    turn = np.linalg.pinv(sh_basis(degree, directions)) @ sh_basis(degree, directions @ rotation)
    return torch.einsum("jk,nkc->njc", torch.from_numpy(turn), sh.double()).float()


def _quaternion(rotation: np.ndarray) -> tuple[float, float, float, float]:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return float(w), float(x), float(y), float(z)


def _rows(cloud: Gaussians, mask: torch.Tensor) -> Gaussians:
    return Gaussians(
        cloud.means[mask], cloud.quats[mask], cloud.scales[mask], cloud.opacities[mask], cloud.sh[mask]
    )


def _quantile(values: np.ndarray, weights: np.ndarray, share: float) -> np.ndarray:
    """Weighted quantile of each column of `values` [N, C]."""
    out = []
    for column in values.T:
        order = np.argsort(column, kind="stable")
        total = np.cumsum(weights[order])
        out.append(column[order][min(int(np.searchsorted(total, share * total[-1])), len(column) - 1)])
    return np.asarray(out)


__all__ = ["read_splat", "rotated", "splat_in_unit_frame"]
