"""Cameras, working volume, up direction, triangulation, agreement and refinement of cameras."""
