"""From a prompt, a mesh or photos to an asset: prior, surfels, extraction, bound Gaussians."""
