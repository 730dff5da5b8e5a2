"""Splat clouds without a mesh as assets: MPM fills them with particles, pictures show them as they are."""

from __future__ import annotations

from pathlib import Path

from gdpro_sim.asset import Asset
from gdpro_sim.asset.from_splats import bind_splats
from gdpro_sim.asset.importer import versions
from gdpro_sim.files import sha256_of
from gdpro_sim.gaussians import Gaussians
from gdpro_sim.io.ply import read_ply
from gdpro_sim.io.splat import read_splat, splat_in_unit_frame
from gdpro_sim.materials import Material

HEADER = 1 << 14


def is_cloud(path: str | Path) -> bool:
    """Whether a file holds Gaussians: a .splat, or a .ply with their properties."""
    file = Path(path)
    if file.suffix.lower() == ".splat":
        return True
    if file.suffix.lower() != ".ply" or not file.is_file():
        return False
    with file.open("rb") as stream:
        return b"property float f_dc_0" in stream.read(HEADER)


def read_cloud(path: str | Path) -> Gaussians:
    """Its Gaussians on the CPU. Raises AssetError."""
    return read_splat(path) if Path(path).suffix.lower() == ".splat" else read_ply(path)


def cloud_asset(name: str, cloud: Gaussians, path: str | Path, material: Material | None = None) -> Asset:
    """An asset of a cloud, each Gaussian on a small triangle of its own; `path` is where it came from."""
    source = {"source": Path(path).name, "sha256": sha256_of(path), "versions": versions()}
    return Asset(name, bind_splats(cloud), material=material, provenance=source)


def import_cloud(
    path: str | Path,
    *,
    name: str | None = None,
    up: str = "auto",
    scale: float | None = None,
    material: Material | None = None,
) -> Asset:
    """An asset of a cloud, upright, its middle at the origin, without Gaussians that are faint or far off.

    up: the axis that points up, one of x y z -x -y -z; auto is -y, as in most reconstructions from photos
    scale: multiplies lengths

    Raises AssetError for a file that cannot be read, RequestError for another `up`.
    """
    cloud, frame = splat_in_unit_frame(read_cloud(path), up=up)
    asset = cloud_asset(name or Path(path).stem, cloud, path, material)
    return asset.scaled(frame.radius * (1.0 if scale is None else scale))


__all__ = ["cloud_asset", "import_cloud", "is_cloud", "read_cloud"]
