"""Timings. The package comes before torch, whose threads then sleep where they have nothing to do."""

import gdpro_sim  # noqa: F401
