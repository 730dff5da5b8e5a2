"""Animation without physics: vertices that a file moves carry bound Gaussians."""

from gdpro_sim.simulation.animation.source import Motion, VertexSource, open_motion, save_motion

__all__ = ["Motion", "VertexSource", "open_motion", "save_motion"]
