"""Taichi kernels: arrays in, arrays out. No files, no policy, no Python loops over data."""
