"""Cameras of photos as other tools leave them: transforms.json (NeRF and its descendants) and COLMAP models.

Both become poses in OpenCV axes with pixel centres at +0.5. Lenses must be free of distortion.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gdpro_sim.errors import GuidanceError

PICTURES = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp")
UNDISTORT = (
    "undistort the photos first, for instance with `colmap image_undistorter --image_path images "
    "--input_path sparse/0 --output_path undistorted`"
)
TRANSFORMS = ("transforms.json", "transforms_train.json")
MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0", "colmap/sparse", ".")


@dataclass(frozen=True)
class Pose:
    """One photo's camera.

    name:    of the photo, as the cameras' file has it
    path:    of the photo
    viewmat: [4, 4] world -> camera, OpenCV axes
    focal:   (fx, fy) pixels, or None where the angles of view are known instead
    angles:  (across, down) rad; down None: as many pixels to a radian as across
    middle:  (cx, cy) pixels, None: the picture's middle
    size:    (width, height) that the pixels are of, None: whatever the photo has
    mask:    picture of its opacity, where the file names one
    """

    name: str
    path: Path
    viewmat: np.ndarray
    focal: tuple[float, float] | None
    angles: tuple[float, float | None] | None = None
    middle: tuple[float, float] | None = None
    size: tuple[int, int] | None = None
    mask: Path | None = None

    def intrinsics(self, width: int, height: int) -> np.ndarray:
        """K [3, 3] for a photo of this size, float64.

        A photo of another size but the same shape has scaled intrinsics. Raises GuidanceError for another
        shape.
        """
        across, down = 1.0, 1.0
        if self.size is not None and self.size != (width, height):
            across, down = width / self.size[0], height / self.size[1]
            if abs(across * self.size[1] - height) > 1.0:
                raise GuidanceError(
                    f"{self.name} is {width} x {height} px, but its camera is for {self.size[0]} x "
                    f"{self.size[1]} px; give the photos that the cameras were estimated on"
                )
        if self.focal is not None:
            fx, fy = self.focal[0] * across, self.focal[1] * down
        else:
            assert self.angles is not None
            fx = fy = 0.5 * width / math.tan(0.5 * self.angles[0])
            if self.angles[1] is not None:
                fy = 0.5 * height / math.tan(0.5 * self.angles[1])
        cx, cy = (0.5 * width, 0.5 * height) if self.middle is None else self.middle
        if self.middle is not None:
            cx, cy = cx * across, cy * down
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def read_poses(folder: str | Path) -> tuple[list[Pose], str]:
    """The cameras of a folder of photos and what they were read from: "transforms.json" or "COLMAP".

    folder: holds transforms.json (or transforms_train.json), or a COLMAP model in sparse/0, sparse or itself,
            with the photos in images/; or it is a transforms file.
    Raises GuidanceError for a missing folder, one without cameras, a broken file, a distorted lens, and
    photos that are missing.
    """
    root = Path(folder)
    if not root.exists():
        raise GuidanceError(f"{folder}: no such folder")
    if root.is_file():
        if root.suffix.lower() != ".json":
            raise GuidanceError(f"{folder} is a file; give the folder of the photos, or a transforms.json")
        poses, kind = _transforms(root), "transforms.json"
    elif found := next((root / name for name in TRANSFORMS if (root / name).is_file()), None):
        poses, kind = _transforms(found), "transforms.json"
    elif model := next((root / name for name in MODEL_FOLDERS if _is_model(root / name)), None):
        poses, kind = _colmap(root, model), "COLMAP"
    else:
        pictures = [p for p in root.rglob("*") if p.suffix.lower() in PICTURES]
        raise GuidanceError(
            f"{folder} holds {len(pictures)} pictures but no cameras; add transforms.json, or a COLMAP model "
            "in sparse/0 (`colmap automatic_reconstructor` makes one)"
        )
    if not poses:
        raise GuidanceError(f"{folder}: its {kind} lists no photos")
    missing = [pose for pose in poses if not pose.path.is_file()]
    if missing:
        raise GuidanceError(
            f"{len(missing)} of {len(poses)} photos are missing, the first is {missing[0].path}; put them "
            f"there or take them out of the {kind}"
        )
    return poses, kind


def _transforms(path: Path) -> list[Pose]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise GuidanceError(f"{path} cannot be read: {error}") from None
    frames = data.get("frames") if isinstance(data, dict) else None
    if not isinstance(frames, list):
        raise GuidanceError(f"{path} has no list of frames; it is no transforms.json")
    return [_frame(path, data, frame, number) for number, frame in enumerate(frames)]


def _frame(path: Path, shared: Mapping[str, Any], frame: Any, number: int) -> Pose:
    """One entry of `frames`; what it does not say itself, the file says for all."""
    where = f"{path}: frames[{number}]"
    if not isinstance(frame, dict) or not isinstance(frame.get("file_path"), str):
        raise GuidanceError(f"{where} has no file_path")
    name = frame["file_path"].replace("\\", "/")
    try:
        to_world = np.asarray(frame["transform_matrix"], np.float64)
    except (KeyError, TypeError, ValueError):
        raise GuidanceError(f"{where} ({name}) has no transform_matrix of numbers") from None
    if to_world.shape not in ((4, 4), (3, 4)):
        raise GuidanceError(
            f"{where} ({name}): transform_matrix must be 4 x 4, got {' x '.join(map(str, to_world.shape))}"
        )
    if not np.isfinite(to_world).all():
        raise GuidanceError(f"{name}: its camera has NaN or infinite numbers; remove it or estimate again")

    def number_of(key: str) -> float | None:
        value = frame.get(key, shared.get(key))
        if value is None:
            return None
        try:
            return float(value)
        except (TypeError, ValueError):
            raise GuidanceError(f"{where} ({name}): {key} must be a number, got {value!r}") from None

    lens = {key: number_of(key) for key in ("k1", "k2", "k3", "k4", "p1", "p2")}
    bent = [key for key, value in lens.items() if value]
    if bent or "FISHEYE" in str(frame.get("camera_model", shared.get("camera_model", ""))).upper():
        raise GuidanceError(
            f"{path}: {name} was taken through a distorting lens ({', '.join(bent)}); {UNDISTORT}"
        )
    width, height = number_of("w"), number_of("h")
    size = (round(width), round(height)) if width and height else None
    fx, fy = number_of("fl_x"), number_of("fl_y")
    across, down = number_of("camera_angle_x"), number_of("camera_angle_y")
    if fx is None and (across is None or not 0.0 < across < math.pi):
        raise GuidanceError(f"{path}: {name} has neither fl_x (px) nor camera_angle_x (rad)")
    if fx is not None and size is None:
        raise GuidanceError(f"{path}: {name} has fl_x but not w and h, the size in pixels that it is for")
    cx, cy = number_of("cx"), number_of("cy")
    rotation = to_world[:3, :3] * np.array([1.0, -1.0, -1.0])  # OpenGL's y up, z back, to OpenCV's
    view = np.eye(4)
    view[:3, :3] = rotation.T
    view[:3, 3] = -rotation.T @ to_world[:3, 3]
    mask = frame.get("mask_path")
    return Pose(
        name,
        _picture(path.parent / name),
        view,
        None if fx is None else (fx, fx if fy is None else fy),
        None if across is None else (across, down),
        None if cx is None or cy is None else (cx, cy),
        size,
        path.parent / mask if isinstance(mask, str) else None,
    )


def _picture(path: Path) -> Path:
    """A photo's path, with the suffix that Blender's transforms leave out."""
    if path.is_file():
        return path
    return next((p for p in (path.with_name(path.name + s) for s in PICTURES) if p.is_file()), path)


# COLMAP's models: name, how many numbers, and whether the first is one focal length for both directions.
_MODELS = {
    0: ("SIMPLE_PINHOLE", 3, True),
    1: ("PINHOLE", 4, False),
    2: ("SIMPLE_RADIAL", 4, True),
    3: ("RADIAL", 5, True),
    4: ("OPENCV", 8, False),
    5: ("OPENCV_FISHEYE", 8, False),
    6: ("FULL_OPENCV", 12, False),
    7: ("FOV", 5, False),
    8: ("SIMPLE_RADIAL_FISHEYE", 4, True),
    9: ("RADIAL_FISHEYE", 5, True),
    10: ("THIN_PRISM_FISHEYE", 12, False),
}
_STRAIGHT = ("SIMPLE_PINHOLE", "PINHOLE")
_PERHAPS = ("SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Without distortion where all its numbers are zero."""


@dataclass(frozen=True)
class _Lens:
    focal: tuple[float, float]
    middle: tuple[float, float]
    size: tuple[int, int]


def _is_model(folder: Path) -> bool:
    return any(
        (folder / f"cameras{s}").is_file() and (folder / f"images{s}").is_file() for s in (".bin", ".txt")
    )


def _colmap(root: Path, model: Path) -> list[Pose]:
    suffix = ".bin" if (model / "cameras.bin").is_file() and (model / "images.bin").is_file() else ".txt"
    cameras, images = model / f"cameras{suffix}", model / f"images{suffix}"
    binary = suffix == ".bin"
    try:
        lenses = dict((_cameras_bin if binary else _cameras_txt)(cameras))
        rows = list((_images_bin if binary else _images_txt)(images))
    except (OSError, ValueError, IndexError, KeyError, struct.error, UnicodeDecodeError) as error:
        raise GuidanceError(
            f"{model}: its COLMAP model cannot be read ({type(error).__name__}: {error}); export it again "
            "with `colmap model_converter`"
        ) from None
    folder = next((f for f in (root / "images", model.parent / "images", root) if f.is_dir()), root)
    out = []
    for name, quaternion, translation, camera in sorted(rows, key=lambda row: row[0]):
        if camera not in lenses:
            raise GuidanceError(f"{images}: {name} has camera {camera}, which {cameras.name} does not list")
        view = np.eye(4)
        view[:3, :3] = _rotation(np.asarray(quaternion, np.float64))
        view[:3, 3] = translation
        if not np.isfinite(view).all():
            raise GuidanceError(
                f"{name}: its camera has NaN or infinite numbers; remove it or estimate again"
            )
        lens = lenses[camera]
        out.append(Pose(name, folder / name, view, lens.focal, None, lens.middle, lens.size))
    return out


def _rotation(q: np.ndarray) -> np.ndarray:
    """Rotation matrix of a quaternion wxyz of any length."""
    w, x, y, z = q / max(float(np.linalg.norm(q)), 1e-300)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _lens(path: Path, model: str, size: tuple[int, int], numbers: tuple[float, ...], one: bool) -> _Lens:
    used = 3 if one else 4
    bent = model not in _STRAIGHT and (model not in _PERHAPS or any(numbers[used:]))
    if bent:
        raise GuidanceError(f"{path}: camera model {model} has a distorting lens; {UNDISTORT}")
    fx, fy = (numbers[0], numbers[0]) if one else (numbers[0], numbers[1])
    return _Lens((fx, fy), (numbers[used - 2], numbers[used - 1]), size)


def _cameras_bin(path: Path) -> Iterator[tuple[int, _Lens]]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        number, kind, width, height = struct.unpack_from("<iiQQ", data, at)
        model, length, one = _MODELS[kind]
        numbers = struct.unpack_from(f"<{length}d", data, at + 24)
        at += 24 + 8 * length
        yield number, _lens(path, model, (width, height), numbers, one)


def _cameras_txt(path: Path) -> Iterator[tuple[int, _Lens]]:
    by_name = {name: (length, one) for name, length, one in _MODELS.values()}
    for line in _lines(path):
        words = line.split()
        if not words:
            continue
        length, one = by_name[words[1]]
        numbers = tuple(float(w) for w in words[4 : 4 + length])
        if len(numbers) != length:
            raise ValueError(
                f"camera {words[0]} of model {words[1]} needs {length} numbers, got {len(numbers)}"
            )
        yield int(words[0]), _lens(path, words[1], (int(words[2]), int(words[3])), numbers, one)


_Row = tuple[str, tuple[float, ...], tuple[float, ...], int]
"""Name, quaternion wxyz, translation and camera of a photo."""


def _images_bin(path: Path) -> Iterator[_Row]:
    data = path.read_bytes()
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        numbers = struct.unpack_from("<7d", data, at + 4)
        (camera,) = struct.unpack_from("<i", data, at + 60)
        end = data.index(b"\0", at + 64)
        name = data[at + 64 : end].decode("utf-8")
        (points,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + 24 * points
        yield name, numbers[:4], numbers[4:], camera


def _images_txt(path: Path) -> Iterator[_Row]:
    # Every other line lists points, and may be empty.
    for line in list(_lines(path))[::2]:
        words = line.split(maxsplit=9)
        if not words:
            continue
        numbers = tuple(float(w) for w in words[1:8])
        yield words[9].strip(), numbers[:4], numbers[4:], int(words[8])


def _lines(path: Path) -> Iterator[str]:
    for line in path.read_text(encoding="utf-8").splitlines():
        if not line.lstrip().startswith("#"):
            yield line


__all__ = ["PICTURES", "Pose", "read_poses"]
