"""Cameras, the working volume, the up direction, refinement."""
