"""Warp kernels of the rod solver."""
