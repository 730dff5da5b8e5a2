"""Photos with cameras from every layout that is read give the same scene; what cannot guide is refused."""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from gdpro_sim.cameras import Cameras
from gdpro_sim.errors import GuidanceError, RequestError
from gdpro_sim.generation.guidance.views import PhotoGuidance
from gdpro_sim.generation.photos import Photos
from gdpro_sim.generation.protocols import UnitFrame
from gdpro_sim.generation.renders import MeshRenderer
from gdpro_sim.io.photos import ScenePhotos, read_photos
from tests.generation.photo_scene import ball_and_box, cameras_around, photos_of

SCALE, CENTRE, SIZE = 0.2, (3.0, -1.0, 2.0), (72, 54)
COUNT = 10


@pytest.fixture(scope="module")
def cameras() -> Cameras:
    return cameras_around(COUNT, SIZE, scale=SCALE, centre=CENTRE)


@pytest.fixture(scope="module")
def truth(cameras: Cameras) -> Photos:
    """The scene as photos in its own frame: an object a fifth the size, away from the origin."""
    near = cameras_around(COUNT, SIZE)
    drawn = photos_of(ball_and_box(), near)
    return Photos(cameras.viewmats.double().numpy(), cameras.Ks.double().numpy(), drawn.pictures, drawn.names)


def transforms(folder: Path, photos: Photos, *, angle: bool = False, suffix: bool = True) -> dict[str, Any]:
    """A transforms.json for photos saved in images/; cameras to world in OpenGL axes."""
    (folder / "images").mkdir(parents=True, exist_ok=True)
    frames = []
    for name, view, picture in zip(photos.names, photos.viewmats, photos.pictures, strict=True):
        Image.fromarray(picture, "RGBA").save(folder / "images" / name)
        pose = np.linalg.inv(view) @ np.diag([1.0, -1.0, -1.0, 1.0])
        path = f"images/{name}" if suffix else f"./images/{Path(name).stem}"
        frames.append({"file_path": path, "transform_matrix": pose.tolist()})
    height, width = photos.pictures[0].shape[:2]
    k = photos.Ks[0]
    data: dict[str, Any] = {"frames": frames}
    if angle:
        data["camera_angle_x"] = 2.0 * math.atan(0.5 * width / k[0, 0])
    else:
        data |= {"w": width, "h": height, "fl_x": k[0, 0], "fl_y": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
    return data


def save(folder: Path, data: dict[str, Any], name: str = "transforms.json") -> Path:
    (folder / name).write_text(json.dumps(data))
    return folder


def quaternion(rotation: np.ndarray) -> np.ndarray:
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    return np.array([w, x, y, z])


def colmap(folder: Path, photos: Photos, *, binary: bool, model: str = "PINHOLE", extra: tuple = ()) -> Path:
    """A COLMAP model in sparse/0 for photos saved in images/."""
    transforms(folder, photos)
    sparse = folder / "sparse" / "0"
    sparse.mkdir(parents=True, exist_ok=True)
    height, width = photos.pictures[0].shape[:2]
    k = photos.Ks[0]
    numbers = ([k[0, 0]] if model.startswith("SIMPLE") else [k[0, 0], k[1, 1]]) + [k[0, 2], k[1, 2], *extra]
    rows = [
        (i + 1, *quaternion(view[:3, :3]), *view[:3, 3], 7, name)
        for i, (name, view) in enumerate(zip(photos.names, photos.viewmats, strict=True))
    ]
    if binary:
        kind = {"SIMPLE_PINHOLE": 0, "PINHOLE": 1, "SIMPLE_RADIAL": 2, "OPENCV": 4}[model]
        data = struct.pack("<QiiQQ", 1, 7, kind, width, height) + struct.pack(f"<{len(numbers)}d", *numbers)
        (sparse / "cameras.bin").write_bytes(data)
        data = struct.pack("<Q", len(rows))
        for number, *pose, camera, name in rows:
            data += struct.pack("<i7di", number, *pose, camera) + name.encode() + b"\0"
            data += struct.pack("<Q", 2) + struct.pack("<ddqddq", 1.0, 2.0, -1, 3.0, 4.0, 5)
        (sparse / "images.bin").write_bytes(data)
    else:
        words = " ".join(map(repr, map(float, numbers)))
        (sparse / "cameras.txt").write_text(f"# Cameras\n7 {model} {width} {height} {words}\n")
        lines = ["# Images", "#   two lines each"]
        for i, (number, *pose, camera, name) in enumerate(rows):
            lines.append(f"{number} {' '.join(map(repr, map(float, pose)))} {camera} {name}")
            lines.append("" if i % 2 else "1.0 2.0 -1 3.0 4.0 5")
        (sparse / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


LAYOUTS: dict[str, Callable[[Path, Photos], Path]] = {
    "focal": lambda folder, photos: save(folder, transforms(folder, photos)),
    "angle": lambda folder, photos: save(
        folder, transforms(folder, photos, angle=True, suffix=False), "transforms_train.json"
    ),
    "colmap-binary": lambda folder, photos: colmap(folder, photos, binary=True),
    "colmap-text": lambda folder, photos: colmap(folder, photos, binary=False),
}


@pytest.mark.parametrize("layout", LAYOUTS)
def test_every_layout_gives_the_same_scene(layout: str, tmp_path: Path, truth: Photos) -> None:
    scene = read_photos(LAYOUTS[layout](tmp_path, truth), up="z")
    assert len(scene.photos) == COUNT
    own = truth.chosen([int(Path(name).stem.split("_")[1]) for name in scene.photos.names])
    assert np.abs(scene.frame.to_metres(scene.photos.centres) - own.centres).max() < 1e-4
    assert np.abs(scene.photos.viewmats[:, :3, :3] - own.viewmats[:, :3, :3]).max() < 1e-6
    assert np.allclose(scene.photos.Ks, truth.Ks[0], atol=1e-3)
    assert scene.frame.centre == pytest.approx(CENTRE, abs=0.15 * SCALE)
    assert 0.9 * SCALE < scene.frame.radius < 1.3 * SCALE
    # What the views show is what the object looks like there.
    guidance = PhotoGuidance(scene.photos)
    views = guidance.views(_proposed(4), torch.Generator().manual_seed(0))
    mesh = scene.frame.to_unit(ball_and_box(SCALE, CENTRE))
    seen = MeshRenderer(mesh).render(views.cameras, rays=4).over(views.backgrounds)
    assert guidance.psnr(seen, views) > 28.0


def _proposed(batch: int) -> Any:
    from gdpro_sim.generation.cameras import ring, view_batch

    return view_batch(ring(batch, 40))


@pytest.fixture
def data(tmp_path: Path, truth: Photos) -> dict[str, Any]:
    return transforms(tmp_path, truth)


def refused(folder: Path, pattern: str, **options: Any) -> None:
    with pytest.raises((GuidanceError, RequestError), match=pattern) as caught:
        read_photos(folder, **options)
    assert "\n" not in str(caught.value)


def test_colmap_s_up_is_the_cameras(tmp_path: Path, truth: Photos) -> None:
    tilt = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # Z becomes -Y
    scene = read_photos(colmap(tmp_path, truth.turned(tilt), binary=True))
    assert scene.description["up"] == "the cameras' mean"
    order = [truth.names.index(name) for name in scene.photos.names]
    height = scene.photos.centres[:, 2] * scene.frame.radius
    expected = truth.centres[order, 2]
    assert np.abs((height - height.mean()) - (expected - expected.mean())).max() < 0.02


def test_masks_stand_in_for_alpha(tmp_path: Path, truth: Photos, data: dict[str, Any]) -> None:
    with_alpha = read_photos(save(tmp_path, data))
    (tmp_path / "masks").mkdir()
    for i, (name, picture) in enumerate(zip(truth.names, truth.pictures, strict=True)):
        rgb = picture.copy()
        rgb[..., 3] = 255
        Image.fromarray(rgb, "RGBA").save(tmp_path / "images" / name)
        mask = f"{Path(name).stem}.png" if i % 2 else f"{name}.png"
        Image.fromarray(picture[..., 3]).save(tmp_path / "masks" / mask)
    with_masks = read_photos(tmp_path)
    assert with_masks.description["opacity"] == ["masks"]
    assert with_alpha.description["opacity"] == ["alpha"]
    for a, b in zip(with_alpha.photos.pictures, with_masks.photos.pictures, strict=True):
        assert np.array_equal(a[..., 3], b[..., 3])
    Image.fromarray(np.zeros((10, 12), np.uint8)).save(tmp_path / "masks" / "photo_3.png")
    refused(tmp_path, r"photo_3\.png is 12 x 10 px.*72 x 54")


def test_a_plain_background_is_keyed_from_the_rim(
    tmp_path: Path, truth: Photos, data: dict[str, Any]
) -> None:
    folder = save(tmp_path, data)
    for name, picture in zip(truth.names, truth.pictures, strict=True):
        alpha = picture[..., 3:] / 255.0
        over = picture[..., :3] * alpha + 255.0 * (1.0 - alpha)
        over[24:28, 34:38] = 255.0  # a highlight within the object
        Image.fromarray((over + 0.5).astype(np.uint8)).save(tmp_path / "images" / name)
    refused(folder, r"photo_0\.png and 9 more: nothing tells.*masks/photo_0\.png.*--background white")
    scene = read_photos(folder, background="white")
    assert scene.description["opacity"] == ["white background"]
    for a, b in zip(scene.photos.pictures, truth.pictures, strict=True):
        assert (a[24:28, 34:38, 3] == 255).all()
        assert ((a[..., 3] > 127) != (b[..., 3] > 127)).mean() < 0.02
    refused(folder, "background must be white or black", background="green")


def test_large_photos_are_reduced_with_their_cameras(
    tmp_path: Path, truth: Photos, data: dict[str, Any]
) -> None:
    scene = read_photos(save(tmp_path, data), largest=36)
    assert scene.photos.pictures[0].shape == (27, 36, 4)
    assert np.allclose(scene.photos.Ks[0][:2], 0.5 * truth.Ks[0][:2])


def test_photos_of_another_size_but_the_same_shape_are_scaled(
    tmp_path: Path, truth: Photos, data: dict[str, Any]
) -> None:
    data |= {"w": 144, "h": 108, **{key: 2.0 * data[key] for key in ("fl_x", "fl_y", "cx", "cy")}}
    scene = read_photos(save(tmp_path, data))
    assert np.allclose(scene.photos.Ks, truth.Ks)


def test_every_frame_may_have_its_own_camera(tmp_path: Path, truth: Photos, data: dict[str, Any]) -> None:
    data["frames"][4] |= {"fl_x": 99.0, "fl_y": 98.0, "cx": 30.0}
    scene = read_photos(save(tmp_path, data))
    assert scene.photos.Ks[4][[0, 1, 0, 1], [0, 1, 2, 2]] == pytest.approx([99.0, 98.0, 30.0, 27.0])
    assert np.allclose(scene.photos.Ks[5], truth.Ks[5])


def change(key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data.__setitem__(key, value)


def frame(number: int, key: str, value: Any) -> Callable[[dict[str, Any]], None]:
    return lambda data: data["frames"][number].__setitem__(key, value)


def pose(number: int, row: int, column: int, value: float) -> Callable[[dict[str, Any]], None]:
    return lambda data: data["frames"][number]["transform_matrix"][row].__setitem__(column, value)


def looking_out(data: dict[str, Any]) -> None:
    for one in data["frames"]:
        matrix = np.asarray(one["transform_matrix"])
        matrix[:3, [0, 2]] *= -1.0
        one["transform_matrix"] = matrix.tolist()


def in_parallel(data: dict[str, Any]) -> None:
    first = np.asarray(data["frames"][0]["transform_matrix"])
    for i, one in enumerate(data["frames"]):
        matrix = first.copy()
        matrix[:3, 3] += 50.0 * i * first[:3, 2]
        one["transform_matrix"] = matrix.tolist()
        one["file_path"] = data["frames"][0]["file_path"]


BROKEN: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "nothing listed": (change("frames", []), "lists no photos"),
    "no list": (change("frames", None), "no list of frames"),
    "one photo": (lambda d: d.__setitem__("frames", d["frames"][:1]), "1 photo with a camera; at least 2"),
    "no path": (frame(2, "file_path", None), r"frames\[2\] has no file_path"),
    "missing file": (
        frame(3, "file_path", "images/gone"),
        r"1 of 10 photos are missing, the first is .*gone",
    ),
    "no matrix": (frame(1, "transform_matrix", "x"), r"frames\[1\].*transform_matrix of numbers"),
    "a small matrix": (frame(1, "transform_matrix", [[1, 0], [0, 1]]), "must be 4 x 4, got 2 x 2"),
    "NaN": (pose(5, 0, 3, float("nan")), r"photo_5\.png: its camera has NaN"),
    "scaled": (pose(5, 0, 0, 3.0), r"photo_5\.png: its camera's rotation"),
    "no focal length": (change("fl_x", None), "neither fl_x"),
    "no size": (change("w", None), "not w and h"),
    "a word": (change("fl_x", "wide"), "fl_x must be a number, got 'wide'"),
    "another shape": (change("h", 72), r"photo_0\.png is 72 x 54 px, but its camera is for 72 x 72 px"),
    "a bent lens": (change("k1", 0.1), r"distorting lens \(k1\); undistort.*colmap image_undistorter"),
    "a fisheye": (change("camera_model", "OPENCV_FISHEYE"), "distorting lens"),
    "looking out": (looking_out, "do not look at one object: 10 of 10"),
    "in parallel": (in_parallel, "all look the same way"),
    "no mask": (frame(0, "mask_path", "m.png"), r"mask .*m\.png does not exist"),
}


@pytest.mark.parametrize("case", BROKEN)
def test_broken_transforms_are_refused(case: str, tmp_path: Path, data: dict[str, Any]) -> None:
    breaking, pattern = BROKEN[case]
    breaking(data)
    refused(save(tmp_path, data), pattern)


def test_folders_that_hold_no_scene_are_refused(tmp_path: Path, truth: Photos) -> None:
    refused(tmp_path / "none", "no such folder")
    transforms(tmp_path, truth)
    refused(tmp_path, r"holds 10 pictures but no cameras; add transforms\.json")
    refused(tmp_path / "images" / "photo_0.png", "give the folder")
    (tmp_path / "transforms.json").write_text("{")
    refused(tmp_path, "cannot be read")
    refused(tmp_path, "up must be", up="sideways")


def test_unreadable_pictures_are_named(tmp_path: Path, data: dict[str, Any]) -> None:
    (tmp_path / "images" / "photo_2.png").write_bytes(b"not a picture")
    refused(save(tmp_path, data), r"photo_2\.png cannot be read as a picture")


def test_empty_masks_are_refused(tmp_path: Path, truth: Photos, data: dict[str, Any]) -> None:
    for name in truth.names:
        Image.fromarray(np.zeros((54, 72, 4), np.uint8), "RGBA").save(tmp_path / "images" / name)
    refused(save(tmp_path, data), "0 photos show an object")


def test_silhouettes_without_a_common_point_are_refused(
    tmp_path: Path, truth: Photos, data: dict[str, Any]
) -> None:
    draw = np.random.default_rng(0)
    for name, picture in zip(truth.names, truth.pictures, strict=True):
        moved = np.zeros_like(picture)
        row, column = draw.integers(15, 35), draw.integers(20, 48)
        moved[row : row + 4, column : column + 4] = 255
        Image.fromarray(moved, "RGBA").save(tmp_path / "images" / name)
    refused(save(tmp_path, data), "no point in common")


@pytest.mark.parametrize("binary", [True, False])
def test_colmap_lenses_without_distortion_are_taken(binary: bool, tmp_path: Path, truth: Photos) -> None:
    scene = read_photos(colmap(tmp_path, truth, binary=binary, model="OPENCV", extra=(0.0,) * 4), up="z")
    assert np.allclose(scene.photos.Ks, truth.Ks[0])
    folder = colmap(tmp_path, truth, binary=binary, model="SIMPLE_RADIAL", extra=(0.01,))
    refused(folder, r"SIMPLE_RADIAL has a distorting lens; .*colmap image_undistorter")


@pytest.mark.parametrize("binary", [True, False])
def test_broken_colmap_models_are_refused(binary: bool, tmp_path: Path, truth: Photos) -> None:
    folder = colmap(tmp_path, truth, binary=binary)
    suffix = "bin" if binary else "txt"
    (folder / "transforms.json").unlink(missing_ok=True)
    path = folder / "sparse" / "0" / f"images.{suffix}"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2] if binary else whole.replace(b" 7 photo_3.png", b""))
    refused(folder, "COLMAP model cannot be read")
    path.write_bytes(whole)
    cameras = folder / "sparse" / "0" / f"cameras.{suffix}"
    content = cameras.read_bytes()
    other = content[:8] + b"\x08" + content[9:] if binary else content.replace(b"7 PIN", b"8 PIN")
    cameras.write_bytes(other)
    refused(folder, r"photo_0\.png has camera 7, which")
    cameras.write_bytes(content)
    (folder / "images" / "photo_1.png").unlink()
    refused(folder, "1 of 10 photos are missing")


def test_the_description_is_json(tmp_path: Path, data: dict[str, Any]) -> None:
    scene: ScenePhotos = read_photos(save(tmp_path, data))
    said = json.loads(json.dumps(scene.description))
    assert said["cameras"] == "transforms.json"
    assert said["photos"] == COUNT
    assert said["sizes_px"] == [[72, 54]]
    assert isinstance(scene.frame, UnitFrame)
