"""Small animated files with known positions: skins, morph targets and moving nodes as GLB."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


class Glb:
    """Collects arrays and JSON, and writes one .glb."""

    def __init__(self) -> None:
        self.json: dict[str, Any] = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "bufferViews": [],
            "accessors": [],
        }
        self.binary = b""

    def view(self, data: bytes) -> int:
        self.binary += b"\0" * (-len(self.binary) % 4)
        self.json["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data)}
        )
        self.binary += data
        return len(self.json["bufferViews"]) - 1

    def array(self, values: Any, kind: str = "f4", *, normalized: bool = False) -> int:
        array = np.ascontiguousarray(values, "<" + kind)
        width = 1 if array.ndim == 1 else int(np.prod(array.shape[1:]))
        item: dict[str, Any] = {
            "bufferView": self.view(array.tobytes()),
            "componentType": COMPONENTS[kind],
            "count": len(array),
            "type": TYPES[width],
        }
        if normalized:
            item["normalized"] = True
        if width == 3:
            item |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
        self.json["accessors"].append(item)
        return len(self.json["accessors"]) - 1

    def texture(self, picture: np.ndarray) -> int:
        """A material with `picture` [H, W, 3] uint8 as its base colour."""
        data = io.BytesIO()
        Image.fromarray(picture).save(data, format="PNG")
        self.json["images"] = [{"bufferView": self.view(data.getvalue()), "mimeType": "image/png"}]
        self.json["textures"] = [{"source": 0}]
        self.json["materials"] = [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}]
        return 0

    def animate(self, node: int, path: str, times: Any, values: Any, how: str = "LINEAR") -> None:
        """Add a channel to the only animation."""
        found = self.json.setdefault("animations", [{"name": "move", "channels": [], "samplers": []}])[0]
        sampler = {"input": self.array(times), "output": self.array(values), "interpolation": how}
        found["samplers"].append(sampler)
        target = {"node": node, "path": path}
        found["channels"].append({"sampler": len(found["samplers"]) - 1, "target": target})

    def save(self, path: Path) -> Path:
        self.binary += b"\0" * (-len(self.binary) % 4)
        text = json.dumps({**self.json, "buffers": [{"byteLength": len(self.binary)}]}).encode()
        text += b" " * (-len(text) % 4)
        chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
        chunks += struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        path.write_bytes(struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks)
        return path


def tube(
    rings: int = 13, sides: int = 16, *, radius: float = 0.12
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A closed tube of length 1 along Y: vertices [V, 3], faces [F, 3], uv [V, 2]; its seam is doubled."""
    turn = np.linspace(0.0, 2.0 * np.pi, sides + 1)
    turn[-1] = 0.0  # the seam closes to the bit
    height = np.linspace(0.0, 1.0, rings)
    y, a = np.meshgrid(height, turn, indexing="ij")
    side = np.stack([radius * np.cos(a), y, -radius * np.sin(a)], -1).reshape(-1, 3)
    uv = np.stack(np.meshgrid(np.linspace(0, 1, sides + 1), height), -1).reshape(-1, 2)
    row = sides + 1
    faces = []
    for i in range(rings - 1):
        for j in range(sides):
            p, q = i * row + j, (i + 1) * row + j
            faces += [(p, p + 1, q + 1), (p, q + 1, q)]
    bottom, top = len(side), len(side) + 1
    last = (rings - 1) * row
    for j in range(sides):
        faces += [(bottom, j + 1, j), (top, last + j, last + j + 1)]
    vertices = np.concatenate([side, [[0.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    return vertices, np.array(faces), np.concatenate([uv, [[0.5, 0.0], [0.5, 1.0]]])


def quaternion(axis: tuple[float, float, float], degrees: float) -> list[float]:
    """xyzw."""
    half = np.radians(degrees) / 2.0
    return [*(np.sin(half) * np.asarray(axis)).tolist(), float(np.cos(half))]


def share(y: np.ndarray) -> np.ndarray:
    """Weight of the upper joint of a bent tube at height y."""
    return np.clip((y - 0.3) / 0.4, 0.0, 1.0)


def bent(vertices: np.ndarray, degrees: float) -> np.ndarray:
    """Linear blend skinning of the tube: its upper half turned about Z around (0, 0.5, 0)."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    middle = np.array([0.0, 0.5, 0.0])
    w = share(vertices[:, 1])[:, None]
    return (1.0 - w) * vertices + w * ((vertices - middle) @ turn.T + middle)


def bending_tube(path: Path, *, how: str = "LINEAR", degrees: float = 80.0, extra: bool = False) -> Path:
    """A textured tube whose upper joint turns by `degrees` in 1 s and back in another.

    extra: weights spread over JOINTS_0 and JOINTS_1, as normalised bytes
    """
    vertices, faces, uv = tube()
    glb = Glb()
    y, x = np.mgrid[0:64, 0:64]
    stripes = np.where(((x // 8 + y // 8) % 2)[..., None], [230, 90, 40], [40, 90, 200]).astype(np.uint8)
    w = share(vertices[:, 1])
    attributes = {
        "POSITION": glb.array(vertices),
        "TEXCOORD_0": glb.array(np.column_stack([uv[:, 0], 1.0 - uv[:, 1]])),
    }
    if extra:
        low = np.round(255.0 * (1.0 - w)).astype(int)
        none = np.zeros_like(low)
        joints = np.zeros((len(w), 4), int)
        attributes |= {
            "JOINTS_0": glb.array(joints, "u1"),
            "WEIGHTS_0": glb.array(np.column_stack([low, none, none, none]), "u1", normalized=True),
            "JOINTS_1": glb.array(joints + np.array([1, 0, 0, 0]), "u1"),
            "WEIGHTS_1": glb.array(np.column_stack([255 - low, none, none, none]), "u1", normalized=True),
        }
    else:
        attributes |= {
            "JOINTS_0": glb.array(np.tile([0, 1, 0, 0], (len(w), 1)), "u2"),
            "WEIGHTS_0": glb.array(np.column_stack([1.0 - w, w, 0.0 * w, 0.0 * w])),
        }
    inverse = np.tile(np.eye(4), (2, 1, 1))
    inverse[1, 3, 1] = -0.5  # column-major
    glb.json["meshes"] = [
        {"primitives": [{"attributes": attributes, "indices": glb.array(faces.ravel(), "u4"), "material": 0}]}
    ]
    glb.texture(stripes)
    glb.json["nodes"] = [
        {"name": "root", "children": [1, 2]},
        {"name": "tube", "mesh": 0, "skin": 0, "translation": [9.0, 9.0, 9.0]},  # skins ignore their node
        {"name": "lower", "children": [3]},
        {"name": "upper", "translation": [0.0, 0.5, 0.0]},
    ]
    glb.json["skins"] = [{"joints": [2, 3], "inverseBindMatrices": glb.array(inverse.reshape(2, 16))}]
    still, turned = quaternion((0, 0, 1), 0.0), quaternion((0, 0, 1), degrees)
    values = [still, turned, still]
    if how == "CUBICSPLINE":
        values = [part for value in values for part in ([0.0] * 4, value, [0.0] * 4)]
    glb.animate(3, "rotation", [0.0, 1.0, 2.0], values, how)
    return glb.save(path)


__all__ = ["Glb", "bending_tube", "bent", "quaternion", "share", "tube"]
