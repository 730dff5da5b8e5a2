"""glTF 2.0 files as arrays: JSON, buffers and accessors.

Written here because mesh readers drop what moves: trimesh reads meshes and materials, neither skins nor
animations, and pygltflib hands out JSON and bytes without decoding accessors.
"""

from __future__ import annotations

import base64
import json
import struct
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

from gdpro_sim.errors import MeshError

MAGIC, JSON_CHUNK, BINARY_CHUNK = 0x46546C67, 0x4E4F534A, 0x004E4942
COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}

HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_punctual", "KHR_mesh_quantization")
"""Starts of names of extensions without which shape and motion are read all the same."""


class GltfFile:
    """A .glb or .gltf with what it refers to. Raises MeshError for one that is damaged or needs what is not
    read here (compression with Draco or meshopt, for instance)."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            data = path.read_bytes()
        except OSError as error:
            raise MeshError(f"{path} cannot be read: {error.strerror or error}") from error
        self._binary = b""
        try:
            if data[:4] == struct.pack("<I", MAGIC):
                data = self._chunks(data)
            self.json: dict[str, Any] = json.loads(data)
            version = str(self.json["asset"]["version"])
        except (ValueError, KeyError, TypeError, struct.error) as error:
            raise MeshError(f"{path}: cannot be read as glTF ({error}); the file is damaged") from error
        if not version.startswith("2."):
            raise MeshError(f"{path}: is glTF {version}; only glTF 2.0 is read, export it again")
        needed = [e for e in self.json.get("extensionsRequired", []) if not str(e).startswith(HARMLESS)]
        if needed:
            several = "s" if len(needed) > 1 else ""
            raise MeshError(
                f"{path}: needs the extension{several} {', '.join(needed)}, which cannot be read; export "
                "it without compression (`gltf-transform copy IN OUT` decompresses)"
            )
        self._buffers: dict[int, bytes] = {}

    def list_of(self, key: str) -> list[dict[str, Any]]:
        """The file's objects of one kind: "nodes", "meshes", …"""
        return list(self.json.get(key, []))

    def accessor(self, index: int) -> np.ndarray:
        """Its values [n] or [n, C], as they are; normalised integers as floats. Raises MeshError."""
        try:
            return self._accessor(self.json["accessors"][index])
        except (KeyError, IndexError, ValueError, TypeError) as error:
            raise MeshError(f"{self.path}: accessor {index} is damaged ({error})") from error

    def _accessor(self, item: dict[str, Any]) -> np.ndarray:
        dtype, width, count = np.dtype(COMPONENTS[item["componentType"]]), WIDTHS[item["type"]], item["count"]
        values = np.zeros((count, width), dtype)
        if "bufferView" in item:
            values = self._view(item["bufferView"], item.get("byteOffset", 0), dtype, width, count)
        if "sparse" in item:
            values = values.copy()
            where, what = item["sparse"]["indices"], item["sparse"]["values"]
            size = item["sparse"]["count"]
            kind = np.dtype(COMPONENTS[where["componentType"]])
            rows = self._view(where["bufferView"], where.get("byteOffset", 0), kind, 1, size)[:, 0]
            values[rows] = self._view(what["bufferView"], what.get("byteOffset", 0), dtype, width, size)
        if item.get("normalized"):
            if dtype.kind == "f":
                raise ValueError("floats cannot be normalized")
            values = np.maximum(values.astype(np.float64) / np.iinfo(dtype).max, -1.0)
        return values[:, 0] if item["type"] == "SCALAR" else values

    def _view(self, index: int, offset: int, dtype: np.dtype, width: int, count: int) -> np.ndarray:
        view = self.json["bufferViews"][index]
        row = dtype.itemsize * width
        stride = view.get("byteStride", row)
        begin = view.get("byteOffset", 0) + offset
        data = self._buffer(view["buffer"])
        if count and begin + stride * (count - 1) + row > len(data):
            raise ValueError(f"it reaches past the {len(data)} bytes of its buffer")
        return np.ndarray((count, width), dtype, data, begin, (stride, dtype.itemsize))

    def _buffer(self, index: int) -> bytes:
        if index not in self._buffers:
            uri = self.json["buffers"][index].get("uri")
            if uri is None:
                self._buffers[index] = self._binary
            elif uri.startswith("data:"):
                self._buffers[index] = base64.b64decode(uri.partition(",")[2])
            else:
                file = self.path.parent / unquote(uri)
                if not file.is_file():
                    raise MeshError(f"{self.path}: its buffer {uri} is missing beside it")
                self._buffers[index] = file.read_bytes()
        return self._buffers[index]

    def _chunks(self, data: bytes) -> bytes:
        """The JSON of a GLB; keeps its binary chunk."""
        text = b""
        at = 12
        while at + 8 <= len(data):
            length, kind = struct.unpack_from("<II", data, at)
            if at + 8 + length > len(data):
                raise ValueError("it ends inside a chunk")
            if kind == JSON_CHUNK:
                text = data[at + 8 : at + 8 + length]
            elif kind == BINARY_CHUNK:
                self._binary = data[at + 8 : at + 8 + length]
            at += 8 + length
        return text


__all__ = ["GltfFile"]
