"""Image formation: Gaussians and cameras in, colour, alpha and depth images out."""

from gdpro_sim.splatting.contributions import contributions
from gdpro_sim.splatting.rasterization import RasterOptions, rasterization
from gdpro_sim.splatting.surfels import rasterization_2dgs

__all__ = ["RasterOptions", "contributions", "rasterization", "rasterization_2dgs"]
