"""A folder of photos with cameras, as what generation looks at: upright, in the unit frame, with opacity."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from scipy import ndimage

from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.generation.photos import LEAST, Photos, too_few
from gdpro_sim.generation.priors.hull import Silhouettes
from gdpro_sim.generation.protocols import UnitFrame
from gdpro_sim.io.posed import Pose, read_poses
from gdpro_sim.io.splat import TURNS
from gdpro_sim.meshing.rawmesh import image_array

log = logging.getLogger(__name__)

LARGEST = 512
"""Longest side in pixels; larger photos are reduced: training views have about 200 across the object."""

OPAQUE = 250
"""A picture without a pixel below this opacity has no alpha worth the name."""

KEYS = {"white": 255, "black": 0}
KEY_TOLERANCE = 20
"""How far from the background's colour a pixel of it may be, of 255."""

AGREE = 0.9
"""Share of the photos that must show the point the cameras look at."""

PROBES = 40
"""Points across the cube in which the object is looked for."""

ROOM = 1.15


@dataclass(frozen=True)
class ScenePhotos:
    """What a folder of photos holds.

    photos:      in the unit frame, Z up
    frame:       that frame, in the lengths of the cameras' file (turned upright)
    description: JSON values for the provenance
    """

    photos: Photos
    frame: UnitFrame
    description: dict[str, Any]


def read_photos(
    folder: str | Path, *, background: str | None = None, up: str = "auto", largest: int = LARGEST
) -> ScenePhotos:
    """Read the photos of `folder` and their cameras, see `read_poses` for where these may lie.

    Opacity is the photos' own alpha, or masks/NAME.png (also NAME's suffix replaced by .png; white: the
    object), or, where `background` is "white" or "black", what differs from that colour inward from the
    picture's rim.
    up:      the cameras' axis that points up (x y z -x -y -z); auto: z for transforms.json, and for COLMAP,
             which does not know, what is up for the cameras on average
    largest: pixels; photos with a longer side are reduced

    Raises GuidanceError for what cannot guide: no cameras, fewer than two photos, missing or unreadable
    files, sizes that do not belong together, no opacity, cameras that do not look at one object.
    """
    if background is not None and background not in KEYS:
        raise RequestError(f"background must be white or black, got {background!r}")
    if up != "auto" and up not in TURNS:
        raise RequestError(f"up must be auto or one of {', '.join(TURNS)}, got {up!r}")
    root = Path(folder)
    poses, kind = read_poses(root)
    if len(poses) < LEAST:
        raise too_few(len(poses))
    base = root.parent if root.is_file() else root
    pictures, ks, opacity = [], [], []
    for pose in poses:
        picture, source, size = _picture(base, pose, background, largest)
        k = pose.intrinsics(*size)
        k[0] *= picture.shape[1] / size[0]
        k[1] *= picture.shape[0] / size[1]
        pictures.append(picture)
        ks.append(k)
        opacity.append(source)
    bare = [pose.name for pose, source in zip(poses, opacity, strict=True) if source is None]
    if bare:
        more = f" and {len(bare) - 1} more" if len(bare) > 1 else ""
        raise GuidanceError(
            f"{bare[0]}{more}: nothing tells the object from its background; give RGBA pictures, or masks/"
            f"{Path(bare[0]).stem}.png, or --background white (or black) where it stands before that colour"
        )
    raw = Photos(
        np.stack([pose.viewmat for pose in poses]),
        np.stack(ks),
        tuple(pictures),
        tuple(pose.name for pose in poses),
    )
    turn, how = _upright(raw, up, kind)
    raw = raw.turned(turn)
    frame = _frame_of(raw, folder)
    shapes = sorted({(p.shape[1], p.shape[0]) for p in pictures})
    description = {
        "cameras": kind,
        "photos": len(raw),
        "sizes_px": [list(shape) for shape in shapes[:8]],
        "opacity": sorted({str(source) for source in opacity}),
        "up": how,
        "centre": list(frame.centre),
        "radius": frame.radius,
    }
    log.info(
        "%s: %d photos with cameras from %s, opacity from %s", folder, len(raw), kind, description["opacity"]
    )
    return ScenePhotos(raw.in_frame(frame), frame, description)


def _picture(
    base: Path, pose: Pose, background: str | None, largest: int
) -> tuple[np.ndarray, str | None, tuple[int, int]]:
    """A photo as uint8 RGBA, where its opacity is from (None: nowhere), and its size in the file."""
    rgba = _read(pose.path)
    height, width = rgba.shape[:2]
    mask = _mask_of(base, pose)
    source = None
    if mask is not None:
        alpha = _read(mask)
        if alpha.shape[:2] != (height, width):
            raise GuidanceError(
                f"{mask} is {alpha.shape[1]} x {alpha.shape[0]} px, but its photo {pose.name} is {width} x "
                f"{height} px; masks must have the size of their photos"
            )
        # A mask is grey, or it is white with an alpha of its own.
        own = alpha[..., 3].min() < OPAQUE
        rgba[..., 3] = alpha[..., 3] if own else alpha[..., :3].mean(2).round().astype(np.uint8)
        source = "masks"
    elif rgba[..., 3].min() < OPAQUE:
        source = "alpha"
    elif background is not None:
        rgba[..., 3] = _keyed(rgba[..., :3], KEYS[background])
        source = f"{background} background"
    if max(width, height) > largest:
        scale = largest / max(width, height)
        size = max(1, round(width * scale)), max(1, round(height * scale))
        rgba = np.array(Image.fromarray(rgba, "RGBA").resize(size, Image.Resampling.BOX))
    return np.ascontiguousarray(rgba), source, (width, height)


def _read(path: Path) -> np.ndarray:
    try:
        with Image.open(path) as image:
            return image_array(image).copy()
    except Exception as error:  # Pillow raises many kinds for broken files
        raise GuidanceError(f"{path} cannot be read as a picture ({error})") from None


def _mask_of(base: Path, pose: Pose) -> Path | None:
    """The mask of a photo: as the cameras' file names it, or in masks/, under the photo's name."""
    if pose.mask is not None:
        if not pose.mask.is_file():
            raise GuidanceError(f"{pose.name}: its mask {pose.mask} does not exist")
        return pose.mask
    name = Path(pose.name)
    folder = base / "masks"
    names = (str(name.with_suffix(".png")), f"{name}.png", f"{name.stem}.png", f"{name.name}.png")
    return next((folder / n for n in names if (folder / n).is_file()), None)


def _keyed(rgb: np.ndarray, key: int) -> np.ndarray:
    """Opacity: 0 for pixels of the key colour that hang together with the rim, 255 for the others."""
    like = np.abs(rgb.astype(np.int16) - key).max(2) <= KEY_TOLERANCE
    labels, _ = ndimage.label(like)
    rim = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    return np.where(np.isin(labels, rim[rim > 0]), 0, 255).astype(np.uint8)


def _upright(photos: Photos, up: str, kind: str) -> tuple[np.ndarray, str]:
    """Rotation that makes Z up, and how it was chosen."""
    if up != "auto":
        return np.asarray(TURNS[up], np.float64), up
    if kind != "COLMAP":
        return np.eye(3), "z"
    mean = -photos.viewmats[:, 1, :3].mean(0)  # the cameras' own up
    length = float(np.linalg.norm(mean))
    if length < 0.2:
        log.info("the cameras have no common up; the axes stay as they are")
        return np.eye(3), "z"
    a, z = mean / length, np.array([0.0, 0.0, 1.0])
    axis, cosine = np.cross(a, z), float(a @ z)
    if cosine < -0.999999:
        return np.diag([1.0, -1.0, -1.0]), "the cameras' mean"
    cross = np.array([[0.0, -axis[2], axis[1]], [axis[2], 0.0, -axis[0]], [-axis[1], axis[0], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine), "the cameras' mean"


def _frame_of(photos: Photos, folder: str | Path) -> UnitFrame:
    """The unit frame around what the silhouettes have in common, in the photos' own lengths."""
    centre = _looked_at(photos, folder)
    rough = UnitFrame(tuple(centre.tolist()), ROOM * _reach(photos, centre))
    for _ in range(2):  # the second time in a cube that fits
        silhouettes = Silhouettes(photos.in_frame(rough))
        steps = np.linspace(-1.0, 1.0, PROBES)
        points = np.stack(np.meshgrid(steps, steps, steps, indexing="ij")).reshape(3, -1)
        inside = points[:, silhouettes.distance(points) < 0.0]
        if not inside.shape[1]:
            raise GuidanceError(
                f"{folder}: the photos' silhouettes have no point in common; check that cameras and photos "
                "belong together, and that alpha or the masks show the object (white) and not its background"
            )
        found = UnitFrame.around(rough.to_metres(inside.T))
        # Points are inside; the surface is up to a cell further.
        rough = UnitFrame(found.centre, found.radius + rough.radius * (steps[1] - steps[0]))
    return rough


def _rays(photos: Photos) -> tuple[np.ndarray, np.ndarray]:
    """Which photos show something, and the unit directions [M, 3] to the middle of what they show."""
    shown, out = [], []
    for index, picture in enumerate(photos.pictures):
        rows, columns = np.nonzero(picture[..., 3] > 127)
        if len(rows):
            pixel = np.array([columns.mean() + 0.5, rows.mean() + 0.5, 1.0])
            ray = photos.viewmats[index, :3, :3].T @ np.linalg.solve(photos.Ks[index], pixel)
            shown.append(index)
            out.append(ray / np.linalg.norm(ray))
    return np.asarray(shown, np.int64), np.asarray(out).reshape(-1, 3)


def _looked_at(photos: Photos, folder: str | Path) -> np.ndarray:
    """The point nearest to all rays through the middle of what the photos show.

    Raises GuidanceError where there is none, or most photos do not show it.
    """
    shown, rays = _rays(photos)
    if len(shown) < LEAST:
        raise GuidanceError(
            f"{folder}: {len(shown)} photos show an object; the others are empty by their opacity"
        )
    across = np.eye(3) - rays[:, :, None] * rays[:, None]
    matrix = across.sum(0)
    wrong = "the cameras do not look at one object"
    way_out = "photos must be taken around it, and poses be camera to world (transforms.json) or COLMAP's"
    if np.linalg.eigvalsh(matrix)[0] < 1e-4 * len(shown):
        raise GuidanceError(f"{folder}: {wrong}: they all look the same way; {way_out}")
    point = np.linalg.solve(matrix, np.einsum("nij,nj->i", across, photos.centres[shown]))
    misses = []
    for index in shown:
        x = photos.viewmats[index, :3, :3] @ point + photos.viewmats[index, :3, 3]
        u, v = (photos.Ks[index] @ x)[:2] / (x[2] if abs(x[2]) > 1e-12 else 1e-12)
        height, width = photos.pictures[index].shape[:2]
        if x[2] <= 0.0 or not (0.0 <= u <= width and 0.0 <= v <= height):
            misses.append(photos.names[index])
    if len(misses) > (1.0 - AGREE) * len(shown):
        raise GuidanceError(
            f"{folder}: {wrong}: {len(misses)} of {len(shown)} look elsewhere, {misses[0]} first; {way_out}"
        )
    if misses:
        log.info("%d photos do not show the middle of the object: %s", len(misses), ", ".join(misses[:5]))
    return point


def _reach(photos: Photos, centre: np.ndarray) -> float:
    """About the radius of a sphere around `centre` that holds what the photos show."""
    found = []
    for index, picture in enumerate(photos.pictures):
        x = photos.viewmats[index, :3, :3] @ centre + photos.viewmats[index, :3, 3]
        rows, columns = np.nonzero(picture[..., 3] > 127)
        if x[2] <= 0.0 or not len(rows):
            continue
        k = photos.Ks[index]
        u, v = (k @ x)[:2] / x[2]
        pixels = np.hypot(columns + 0.5 - u, rows + 0.5 - v).max()
        found.append(pixels * x[2] / (0.5 * (k[0, 0] + k[1, 1])))
    return float(np.quantile(found, AGREE))


__all__ = ["ScenePhotos", "read_photos"]
