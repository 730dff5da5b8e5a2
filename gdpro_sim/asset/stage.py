"""Opening and saving USD layers, and telling our files from others."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from pxr import Kind, Sdf, Tf, Usd, UsdGeom, UsdPhysics

from gdpro_sim.errors import AssetError, OutputError
from gdpro_sim.files import atomic_write, remove_quietly
from gdpro_sim.meshing.load import TRIMESH_SUFFIXES, USD_SUFFIXES

FORMAT_VERSION = 1
"""Version of the `gdpro:` attributes, written as `gdpro:formatVersion`."""

WRITABLE_SUFFIXES = (".usdc", ".usda", ".usdz")

_ZIP_EPOCH = (
    631152000  # 1990-01-01: the time stored inside a .usdz, so that the same asset gives the same bytes
)

FileKind = Literal["asset", "simulation", "mesh", "unknown"]


def new_stage(layer: Sdf.Layer, root: str, kind: FileKind) -> Usd.Stage:
    """A stage on an empty layer in our units (Z up, m, kg) with its root prim `/root` marked as ours."""
    stage = Usd.Stage.Open(layer)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
    prim = UsdGeom.Xform.Define(stage, f"/{root}").GetPrim()
    stage.SetDefaultPrim(prim)
    Usd.ModelAPI(prim).SetKind(Kind.Tokens.component if kind == "asset" else Kind.Tokens.assembly)
    set_custom(prim, "gdpro:kind", Sdf.ValueTypeNames.String, kind)
    set_custom(prim, "gdpro:formatVersion", Sdf.ValueTypeNames.Int, FORMAT_VERSION)
    return stage


def set_custom(prim: Usd.Prim, name: str, type_name: Sdf.ValueTypeName, value: object) -> None:
    """Author a uniform custom attribute."""
    prim.CreateAttribute(name, type_name, True, Sdf.VariabilityUniform).Set(value)


def check_suffix(path: str | Path) -> None:
    """Raise AssetError unless `path` ends in a suffix that we write."""
    if Path(path).suffix.lower() not in WRITABLE_SUFFIXES:
        raise AssetError(f"cannot write {path}: the name must end in {', '.join(WRITABLE_SUFFIXES)}")


def export_layer(layer: Sdf.Layer, path: str | Path) -> None:
    """Write `layer` to `path` (.usdc, .usda, .usdz), whole or not at all.

    Raises AssetError for another suffix, RequestError or OutputError where it cannot be written.
    """
    check_suffix(path)
    with atomic_write(path) as temporary:
        if temporary.suffix.lower() != ".usdz":
            _export(layer, temporary, path)
            return
        inner = temporary.with_suffix(".usdc")
        try:
            _export(layer, inner, path)
            pack(inner, temporary, Path(path).stem, path)
        finally:
            remove_quietly(inner)


def pack(inner: Path, archive: Path, stem: str, shown: str | Path) -> None:
    """Put one .usdc into a .usdz named `archive`; `shown` names the file in errors."""
    name = Tf.MakeValidIdentifier(stem) + ".usdc"
    try:
        os.utime(inner, (_ZIP_EPOCH, _ZIP_EPOCH))
        writer = Sdf.ZipFileWriter.CreateNew(str(archive))
        done = writer is not None and bool(writer.AddFile(str(inner), name)) and writer.Save()
    except Tf.ErrorException as error:
        raise OutputError(f"cannot write {shown}: {usd_message(error)}") from error
    if not done:
        raise OutputError(f"cannot write {shown}: the .usdz archive could not be written (disk full?)")


def _export(layer: Sdf.Layer, temporary: Path, shown: str | Path) -> None:
    try:
        done = layer.Export(str(temporary))
    except Tf.ErrorException as error:
        raise OutputError(f"cannot write {shown}: {usd_message(error)}") from error
    if not done:
        raise OutputError(f"cannot write {shown}: USD could not write it (disk full?)")


def usd_message(error: Exception) -> str:
    """The first message inside a USD exception, without source lines."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    text = lines[0] if lines else "unknown USD error"
    return text.rsplit(" : ", 1)[-1].strip("'")


def check_readable(path: str | Path) -> Path:
    """The path, if a regular file is there. Raises AssetError."""
    file = Path(path)
    if file.is_dir():
        raise AssetError(f"{path} is a folder, not a file")
    if not file.is_file():
        raise AssetError(f"{path}: no such file")
    if not os.access(file, os.R_OK):
        raise AssetError(f"{path}: no permission to read it")
    return file


def open_layer(path: str | Path, *, lazy: bool = False) -> Sdf.Layer:
    """Open a USD file.

    By default the layer is private (it never shares state with another stage on the same file). `lazy` reads
    arrays from the file when they are asked for, which long simulations need.
    Raises AssetError for a missing file, a file that is not USD, and a truncated or corrupt one.
    """
    file = check_readable(path)
    if file.suffix.lower() not in USD_SUFFIXES:
        raise AssetError(
            f"{path} is not a USD file (.usdc, .usda, .usdz); make an asset of a mesh with `gdpro import`"
        )
    try:
        if lazy:
            held = Sdf.Layer.Find(str(file.resolve()))
            layer = held or Sdf.Layer.FindOrOpen(str(file.resolve()))
            if held:
                held.Reload()
        else:
            layer = Sdf.Layer.OpenAsAnonymous(str(file))
    except Tf.ErrorException as error:
        raise AssetError(
            f"{path} cannot be read as USD, it may be truncated: {usd_message(error)}"
        ) from error
    if layer is None:
        raise AssetError(f"{path} cannot be read as USD, it may be truncated or corrupt")
    return layer


@contextlib.contextmanager
def reading(place: str | Path) -> Iterator[None]:
    """Put `place` in front of an AssetError, and make one of what USD raises on a damaged array."""
    try:
        yield
    except AssetError as error:
        raise AssetError(f"{place}: {error}") from error
    except Tf.ErrorException as error:
        raise AssetError(f"{place} is damaged: {usd_message(error)}") from error


def open_root(layer: Sdf.Layer, path: str | Path, kind: FileKind) -> tuple[Usd.Stage, Usd.Prim]:
    """The stage and root prim of one of our files, checked for its kind and version.

    Raises AssetError where the file is something else or newer than this package.
    """
    with reading(path):
        found, version = _signature(layer)
    if found != kind:
        what = f"it holds {'an' if found == 'asset' else 'a'} {found}" if found else "it has no `gdpro:kind`"
        hint = "; make one of a mesh with `gdpro import`" if kind == "asset" and not found else ""
        raise AssetError(f"{path} is not a gdpro {kind} file: {what}{hint}")
    if version != FORMAT_VERSION:
        raise AssetError(
            f"{path} has format version {version}, this package reads version {FORMAT_VERSION}; "
            "upgrade gdpro-sim or write the file again"
        )
    with reading(path):
        stage = Usd.Stage.Open(layer)
        return stage, stage.GetDefaultPrim()


def _signature(layer: Sdf.Layer) -> tuple[str | None, int | None]:
    """(`gdpro:kind`, `gdpro:formatVersion`) of the default prim, None where absent."""
    root = Sdf.Path.absoluteRootPath.AppendChild(layer.defaultPrim) if layer.defaultPrim else None
    values = []
    for name in ("gdpro:kind", "gdpro:formatVersion"):
        spec = layer.GetAttributeAtPath(root.AppendProperty(name)) if root else None
        values.append(spec.default if spec else None)
    return values[0], values[1]


def kind(path: str | Path) -> FileKind:
    """What a file is: one of our assets, one of our simulations, a mesh to import, or something else.

    Raises AssetError for a missing file or a corrupt USD file.
    """
    file = check_readable(path)
    suffix = file.suffix.lower()
    if suffix in TRIMESH_SUFFIXES:
        return "mesh"
    if suffix not in USD_SUFFIXES:
        return "unknown"
    layer = open_layer(file, lazy=True)
    with reading(path):
        found, _ = _signature(layer)
        if found == "asset":
            return "asset"
        if found == "simulation":
            return "simulation"
        stage = Usd.Stage.Open(layer, Usd.Stage.LoadAll)
        return "mesh" if any(prim.IsA(UsdGeom.Mesh) for prim in stage.Traverse()) else "unknown"


def is_asset(path: str | Path) -> bool:
    """Whether a file is one of our assets. Raises AssetError for a missing file or a corrupt USD file."""
    return kind(path) == "asset"


__all__ = [
    "FORMAT_VERSION",
    "FileKind",
    "check_readable",
    "check_suffix",
    "export_layer",
    "is_asset",
    "kind",
    "new_stage",
    "open_layer",
    "open_root",
    "pack",
    "reading",
    "set_custom",
    "usd_message",
]
