"""Gaussians as PLY in the layout of the original 3DGS release, which most viewers read.

Binary little-endian float32: x y z, nx ny nz (zero), f_dc_*, f_rest_* (channel-major), opacity (logit),
scale_* (log), rot_* (wxyz).
"""

from __future__ import annotations

import logging
import re
from pathlib import Path

import numpy as np
import torch

from gdpro_sim.errors import AssetError
from gdpro_sim.files import atomic_write
from gdpro_sim.gaussians import Gaussians

log = logging.getLogger(__name__)

_LOGIT_LIMIT = 16.0  # sigmoid(16) = 1 - 1.1e-7: an opacity of exactly 0 or 1 stays finite
_SMALLEST_SCALE = 1e-30
_MAX_HEADER = 1 << 16
_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1",
    "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write one set of Gaussians. Raises RequestError or OutputError where the file cannot be written."""
    g = gaussians
    n, k = len(g), g.sh.shape[1]
    sh = g.sh.detach().cpu().numpy()
    opacities = g.opacities.detach().cpu().numpy().astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.clip(np.log(opacities) - np.log1p(-opacities), -_LOGIT_LIMIT, _LOGIT_LIMIT)
    scales = g.scales.detach().cpu().numpy().astype(np.float64)
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(3 * (k - 1))]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    table = np.concatenate(
        [
            g.means.detach().cpu().numpy(),
            np.zeros((n, 3)),
            sh[:, 0],
            sh[:, 1:].transpose(0, 2, 1).reshape(n, -1),
            logits[:, None],
            np.log(np.maximum(scales, _SMALLEST_SCALE)),
            g.quats.detach().cpu().numpy(),
        ],
        axis=1,
    ).astype("<f4")
    header = ["ply", "format binary_little_endian 1.0", f"element vertex {n}"]
    header += [f"property float {name}" for name in names]
    with atomic_write(path) as temporary:
        temporary.write_bytes(("\n".join([*header, "end_header"]) + "\n").encode("ascii") + table.tobytes())


def read_ply(path: str | Path) -> Gaussians:
    """Read Gaussians on the CPU; quaternions are given back as stored.

    Raises AssetError for a missing or truncated file and for a PLY that holds no Gaussians.
    """
    file = Path(path)
    if not file.is_file():
        raise AssetError(f"{path}: no such file")
    data = file.read_bytes()
    count, dtype, offset = _header(data, path)
    if len(data) < offset + count * dtype.itemsize:
        needed, there = count * dtype.itemsize, len(data) - offset
        raise AssetError(f"{path} is truncated: {count} Gaussians need {needed} bytes, {there} are there")
    rows = np.frombuffer(data, dtype, count, offset)
    names = set(dtype.names or ())
    rest = sorted((s for s in names if s.startswith("f_rest_")), key=lambda s: int(s[7:]))
    if len(rest) not in (0, 9, 24, 45):
        raise AssetError(f"{path} has {len(rest)} f_rest_* properties, expected 0, 9, 24 or 45")

    def columns(*wanted: str) -> np.ndarray:
        missing = [s for s in wanted if s not in names]
        if missing:
            raise AssetError(f"{path} is not a Gaussian PLY: property {missing[0]} is missing")
        return np.stack([rows[s].astype(np.float32) for s in wanted], 1)

    dc = columns("f_dc_0", "f_dc_1", "f_dc_2")[:, None]
    sh = dc
    if rest:
        sh = np.concatenate([dc, columns(*rest).reshape(count, 3, -1).transpose(0, 2, 1)], 1)
    logits = columns("opacity")[:, 0].astype(np.float64)
    return Gaussians(
        torch.from_numpy(columns("x", "y", "z")),
        torch.from_numpy(columns("rot_0", "rot_1", "rot_2", "rot_3")),
        torch.from_numpy(
            np.exp(columns("scale_0", "scale_1", "scale_2").astype(np.float64)).astype(np.float32)
        ),
        torch.from_numpy((1.0 / (1.0 + np.exp(-logits))).astype(np.float32)),
        torch.from_numpy(np.ascontiguousarray(sh)),
    )


def _header(data: bytes, path: str | Path) -> tuple[int, np.dtype, int]:
    """(rows, row layout, offset of the first row) of the `vertex` element, which must come first."""
    end = re.search(rb"end_header\r?\n", data[:_MAX_HEADER])
    if not data.startswith(b"ply") or end is None:
        raise AssetError(f"{path} is not a PLY file")
    lines = data[: end.start()].decode("ascii", "replace").split("\n")
    order, count, fields, element = "", -1, [], ""
    for words in (line.split() for line in lines):
        match words:
            case ["format", "binary_little_endian", *_]:
                order = "<"
            case ["format", "binary_big_endian", *_]:
                order = ">"
            case ["element", name, number]:
                if not element and name != "vertex":
                    raise AssetError(f"{path} is not a Gaussian PLY: its first element is {name}, not vertex")
                element = name
                if name == "vertex":
                    count = int(number)
            case ["property", "list", *_] if element == "vertex":
                raise AssetError(f"{path} is not a Gaussian PLY: a vertex property is a list")
            case ["property", kind, name] if element == "vertex":
                if kind not in _TYPES:
                    raise AssetError(f"{path}: unknown PLY type {kind}")
                fields.append((name, order + _TYPES[kind]))
    if not order:
        raise AssetError(f"{path} is a text PLY; only binary Gaussian PLY files are read")
    if count < 0 or not fields:
        raise AssetError(f"{path} is not a Gaussian PLY: it has no vertices")
    return count, np.dtype(fields), end.end()


__all__ = ["read_ply", "write_ply"]
