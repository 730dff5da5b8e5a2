"""Warp kernels and device functions. They know nothing of torch, files, scenes or the command line."""
