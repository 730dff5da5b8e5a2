"""Assets: bound Gaussians with everything simulation needs, in one USD file."""

from gdpro_sim.asset.asset import Asset
from gdpro_sim.asset.composition import ComposedPart, compose
from gdpro_sim.asset.importer import bind_asset, import_mesh, tetrahedralize_asset, versions
from gdpro_sim.asset.stage import is_asset, kind

__all__ = [
    "Asset",
    "ComposedPart",
    "bind_asset",
    "compose",
    "import_mesh",
    "is_asset",
    "kind",
    "tetrahedralize_asset",
    "versions",
]
